"""Fingerprints: any code that a node runs changes them, and no other code does."""

from __future__ import annotations

import importlib
import itertools
import os
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from nodegraph import Node, node
from nodegraph.cache import Cache
from nodegraph.fingerprint import Fingerprints
from tests.nodegraph import support as toy

_numbers = itertools.count()

Files = dict[str, str]

PLUGIN: Files = {
    "__init__.py": "TITLE = 'a plugin'\n",
    "nodes.py": """
        import math
        import {name}.helper
        from pathlib import Path
        from nodegraph import node
        from . import sibling
        from .deep.inner import constant
        from {name} import TITLE

        KERNEL = Path(__file__).with_name("work.cl")
        FOLDER = Path(__file__).with_name("kernels")
        FOLDED = FOLDER / "folded.cl"

        @node(version=1)
        def compute(x: float) -> float:
            '''Compute.'''
            from .late import shift
            return x + sibling.STEP + constant() + shift(x)
    """,
    "helper.py": "HELP = 1\n",
    "sibling.py": "from .second import MORE\nSTEP = 1 + MORE\n",
    "second.py": "MORE = 1\n",
    "late.py": "def shift(x):\n    return x\n",
    "deep/__init__.py": "RAISED = True\n",
    "deep/inner.py": "from .. import sibling\nfrom ..helper import HELP\n\ndef constant():\n    return HELP\n",
    "unrelated.py": "from .helper import HELP\nOTHER = HELP\n",
    "work.cl": '#include "common.h"\n__kernel void f() {{}}\n',
    "common.h": '  #  include "deeper.h"\n',
    "deeper.h": "// nothing\n",
    "kernels/folded.cl": '#include "nearby.h"\n',
    "kernels/nearby.h": "// nothing\n",
    "other.cl": "__kernel void g() {{}}\n",
    "twin.py": """
        from .nodes import compute

        @compute.opencl()
        def compute_twin(x: float) -> float:
            '''Compute elsewhere.'''
            from .only_twin import VALUE
            return x + VALUE
    """,
    "only_twin.py": "VALUE = 3\n",
}
COVERED = [
    "nodes.py",
    "helper.py",
    "sibling.py",
    "second.py",
    "late.py",
    "deep/inner.py",
    "__init__.py",
    "work.cl",
    "common.h",
    "deeper.h",
    "kernels/folded.cl",
    "kernels/nearby.h",
]
NOT_COVERED = ["unrelated.py", "other.cl", "deep/__init__.py", "twin.py", "only_twin.py"]


NODE = """
from nodegraph import node

@node(version=1)
def compute(x: float) -> float:
    'Compute.'
    {body}
    return x
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Path]]:
    """Write a plugin package of a name of its own below a folder that Python searches."""
    monkeypatch.syspath_prepend(tmp_path)
    made: list[str] = []

    def write(files: Files = PLUGIN) -> Path:
        name = f"toy_plugin_{os.getpid()}_{next(_numbers)}"
        made.append(name)
        for path, text in files.items():
            target = tmp_path / name / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(textwrap.dedent(text).format(name=name))
            os.utime(target, (1e9, 1e9))
        importlib.invalidate_caches()
        return tmp_path / name

    yield write
    for name in [item for item in sys.modules if item.partition(".")[0] in made]:
        del sys.modules[name]


FRESH = """
    import importlib, sys
    sys.path.insert(0, sys.argv[1])
    from nodegraph.fingerprint import Fingerprints
    module = importlib.import_module(sys.argv[2])
    if len(sys.argv) > 3:
        importlib.import_module(sys.argv[3])
    print(Fingerprints([sys.argv[2].partition(".")[0]]).of(module.compute).hex())
"""


def fresh(folder: Path, *more: str) -> str:
    """Return the fingerprint in a process of its own."""
    return toy.python(FRESH, folder.parent, f"{folder.name}.nodes", *[f"{folder.name}.{item}" for item in more]).strip()


def test_what_a_node_runs_is_covered_and_nothing_else(plugin: Callable[..., Path]) -> None:
    folder = plugin()
    module = importlib.import_module(f"{folder.name}.nodes")
    files = Fingerprints([folder.name]).files(module.compute)
    assert {str(path.relative_to(folder)) for path in files} == set(COVERED)


def test_an_edit_of_anything_covered_changes_it_and_of_nothing_else(plugin: Callable[..., Path]) -> None:
    """One process a file would be slow: files are scanned anew by each `Fingerprints`, and the module is not run."""
    folder = plugin()
    module = importlib.import_module(f"{folder.name}.nodes")
    module.compute(1.0)

    def now() -> bytes:
        return Fingerprints([folder.name]).of(module.compute)

    before = now()
    for name in [*COVERED, *NOT_COVERED]:
        path = folder / name
        original = path.read_bytes()
        path.write_bytes(original + b"# a comment counts: bytes do\n")
        assert (now() != before) == (name in COVERED), name
        path.write_bytes(original)


def test_processes_agree(plugin: Callable[..., Path]) -> None:
    folder = plugin()
    first = fresh(folder)
    assert fresh(folder) == first
    (folder / "second.py").write_text("MORE = 2\n")
    changed = fresh(folder)
    assert changed != first
    assert fresh(folder) == changed
    (folder / "second.py").write_text("MORE = 1\n")
    assert fresh(folder) == first


def test_a_twin_declared_elsewhere_is_covered(plugin: Callable[..., Path]) -> None:
    folder = plugin()
    without, with_twin = fresh(folder), fresh(folder, "twin")
    assert without != with_twin
    (folder / "only_twin.py").write_text("VALUE = 4\n")
    assert fresh(folder) == without
    assert fresh(folder, "twin") != with_twin


def test_another_installation_has_the_same_fingerprint(plugin: Callable[..., Path], tmp_path: Path) -> None:
    import shutil

    folder = plugin()
    elsewhere = tmp_path / "elsewhere" / folder.name
    shutil.copytree(folder, elsewhere)
    assert fresh(elsewhere) == fresh(folder)


def test_strangers_are_not_followed(plugin: Callable[..., Path]) -> None:
    folder = plugin({"nodes.py": NODE.replace("{body}", "import numpy, json")})
    module = importlib.import_module(f"{folder.name}.nodes")
    assert Fingerprints([]).files(module.compute) == [folder / "nodes.py"]


def test_another_plugin_is_followed(plugin: Callable[..., Path]) -> None:
    base = plugin({"tools.py": "STEP = 1\n"})
    user = plugin({"nodes.py": NODE.replace("{body}", f"from {base.name}.tools import STEP")})
    module = importlib.import_module(f"{user.name}.nodes")
    assert Fingerprints([base.name]).files(module.compute) == sorted([base / "tools.py", user / "nodes.py"])


def test_modules_that_import_each_other_end(plugin: Callable[..., Path]) -> None:
    folder = plugin(
        {
            "nodes.py": NODE.replace("{body}", "from . import a"),
            "a.py": "from . import b, nodes\n",
            "b.py": "from . import a\nfrom .missing import nothing\n",
        }
    )
    module = importlib.import_module(f"{folder.name}.nodes")
    assert {path.name for path in Fingerprints([]).files(module.compute)} == {"nodes.py", "a.py", "b.py"}


# A source that is edited while the process runs.


SESSION = """
    import importlib, os, sys, time
    from pathlib import Path
    folder, name, text, early = Path(sys.argv[1]), sys.argv[2], sys.argv[3], sys.argv[4:]
    sys.path.insert(0, str(folder.parent))
    from nodegraph.fingerprint import Fingerprints
    prints = Fingerprints([folder.name])

    def edit():
        time.sleep(0.02)  # beyond the grain of the clock that stamps files
        if text:
            (folder / name).write_text(text)
        else:
            (folder / f"{name}.new").replace(folder / name)

    if early:
        importlib.import_module(f"{folder.name}.{early[0]}")
        edit()
    compute = importlib.import_module(f"{folder.name}.nodes").compute
    print(prints.of(compute).hex())
    if not early:
        edit()
    print(prints.of(compute).hex())
    print(Fingerprints([folder.name]).of(compute).hex())
"""


def session(folder: Path, name: str, text: str, *early: str) -> list[str]:
    """Return fingerprints in one process: after its import, and twice after the edit of a file (or its replacement)."""
    return toy.python(SESSION, folder, name, text, *early).split()


@pytest.mark.parametrize("name", ["nodes.py", "second.py", "helper.py"])
def test_a_source_edited_after_its_import_never_gives_the_key_of_the_new_code(
    plugin: Callable[..., Path], name: str
) -> None:
    folder = plugin()
    old = fresh(folder)
    before, after, anew = session(folder, name, (folder / name).read_text() + "\nEDITED = True\n")
    new = fresh(folder)
    assert before == old
    assert old != new
    assert after not in (old, new)
    assert anew == after


def test_a_helper_edited_before_the_node_was_declared_is_stale_too(plugin: Callable[..., Path]) -> None:
    folder = plugin()
    old = fresh(folder)
    found = session(folder, "second.py", "MORE = 100\n", "second")
    assert not {old, fresh(folder)} & set(found), "the old helper runs, and its file holds the new one"


def test_a_file_moved_into_place_with_an_old_time_is_noticed(plugin: Callable[..., Path]) -> None:
    folder = plugin()
    (folder / "second.py.new").write_text("MORE = 7\n")
    os.utime(folder / "second.py.new", (1e9, 1e9))
    before, after, _ = session(folder, "second.py", "")
    assert after not in (before, fresh(folder))


def test_a_kernel_edited_while_the_process_runs_counts_as_it_is_now(plugin: Callable[..., Path]) -> None:
    """Kernels are read when they are compiled, not when the module is imported."""
    folder = plugin()
    before, after, anew = session(folder, "deeper.h", "#define X 1\n")
    assert before != after == anew == fresh(folder)


def test_an_edited_helper_recomputes_its_nodes_and_only_these(plugin: Callable[..., Path], tmp_path: Path) -> None:
    folder = plugin(
        {
            "__init__.py": "",
            "one.py": NODE.replace("compute", "one").replace("{body}", "from .helper import STEP\n    x = x // STEP"),
            "two.py": NODE.replace("compute", "two").replace("{body}", "x = x + 1"),
            "helper.py": "STEP = 2\n",
        }
    )
    code = """
        import importlib, sys
        sys.path.insert(0, sys.argv[1])
        from tests.nodegraph import support as toy
        from nodegraph.cache import Cache
        one, two = (importlib.import_module(f"{sys.argv[2]}.{name}").__dict__[name] for name in ("one", "two"))
        graph = toy.toy_graph(one, two)
        graph.add(two, "before", x=graph.add("toy.number", "a", value=float(sys.argv[4])))
        graph.add(one, "changed", x="before")
        graph.add(two, "after", x="changed")
        result = graph.run(cache=Cache(sys.argv[3]))
        print(*[f"{run.id}:{run.status}:{run.reason}" for run in result.nodes.values()], sep="\\n")
    """

    def run(value: float) -> list[str]:
        return toy.python(code, folder.parent, folder.name, tmp_path / "cache", value).splitlines()

    run(3)
    assert run(3) == ["a:cached:", "before:cached:", "changed:cached:", "after:cached:"]
    (folder / "helper.py").write_text("STEP = 3\n")
    assert run(3)[2:] == ["changed:computed:code changed", "after:computed:input x changed"]
    (folder / "helper.py").write_text("STEP = 2 + 1\n")
    again = run(3)
    assert again[2:] == ["changed:computed:code changed", "after:cached:"]
    assert all(line.endswith(("cached:", "not stored, as it computes faster than it loads")) for line in again[:2])


# Code that is in no file.


def cell(source: str, names: dict[str, Any] | None = None) -> dict[str, Any]:
    """Run a notebook cell."""
    scope: dict[str, Any] = {"__name__": "a_notebook", "node": node, **(names or {})}
    exec(compile(textwrap.dedent(source), "<cell>", "exec"), scope)
    return scope


CELL = """
    STEP = 1

    def helper(x):
        return inner(x) + STEP

    def inner(x):
        return x if x in {'a', 'b', 'c'} else x

    @node(version=1)
    def compute(x: float) -> float:
        '''Compute.'''
        return [helper(item) for item in (x,)][0]
"""


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("helper(item)", "helper(item) + 1"),
        ("inner(x) + STEP", "inner(x) - STEP"),
        ("else x", "else -x"),
        ("STEP = 1", "STEP = 2"),
        ("'c'}", "'d'}"),
    ],
)
def test_a_notebook_cell_counts_with_what_it_calls(old: str, new: str) -> None:
    def of(source: str) -> bytes:
        return Fingerprints([]).of(cell(source)["compute"])

    assert of(CELL) == of(CELL)
    assert of("\n\n" + CELL) == of(CELL), "line numbers do not count"
    assert of(CELL.replace(old, new)) != of(CELL)


def test_a_notebook_cell_is_the_same_in_every_process(monkeypatch: pytest.MonkeyPatch) -> None:
    code = "from tests.nodegraph.test_fingerprint import *\nprint(Fingerprints([]).of(cell(CELL)['compute']).hex())"
    found = set()
    for seed in ("1", "2", "3"):
        monkeypatch.setenv("PYTHONHASHSEED", seed)
        found.add(toy.python(code).strip())
    assert len(found) == 1


def made(by: Any) -> Node[..., Any]:
    @node(version=1)
    def closing(x: float) -> float:
        """Close over a value."""
        return x + (by if isinstance(by, (int, float)) else by(x))

    return closing


def test_what_a_function_closes_over_counts() -> None:
    def plus(x: float) -> float:
        return x + 1

    def minus(x: float) -> float:
        return x - 1

    values: list[Any] = [1, 2, 1.0, plus, minus]
    prints = [Fingerprints([]).of(made(value)) for value in values]
    assert len(set(prints)) == 5
    assert prints == [Fingerprints([]).of(made(value)) for value in values]
    cache = toy.memory_cache()
    for by in (1, 2):
        closing = made(by)
        graph = toy.toy_graph(closing)
        graph.add(closing, x=graph.add("toy.number"))
        assert graph.run(cache=cache)["closing"] == 1.0 + by


def test_a_decorated_function_counts_with_its_module(plugin: Callable[..., Path]) -> None:
    """The wrapper's own code stands elsewhere; the body it calls stands here."""
    folder = plugin(
        {
            "nodes.py": """
                import numpy as np
                from nodegraph import node

                @node(version=1)
                @np.errstate(all="ignore")
                def compute(x: float) -> float:
                    '''Compute.'''
                    return x + 1
            """
        }
    )
    before = fresh(folder)
    path = folder / "nodes.py"
    path.write_text(path.read_text().replace("x + 1", "x + 2"))
    assert fresh(folder) != before


def test_in_process_edits_do_not_poison_the_cache(plugin: Callable[..., Path], tmp_path: Path) -> None:
    folder = plugin()
    module = importlib.import_module(f"{folder.name}.nodes")
    cache = Cache(tmp_path / "cache")
    graph = toy.toy_graph(module.compute)
    graph.add(module.compute, "c", x=graph.add("toy.number"))
    assert graph.run(cache=cache)["c"] == 5.0
    time.sleep(0.02)
    (folder / "second.py").write_text("MORE = 100\n")
    assert graph.run(cache=cache, force=["c"])["c"] == 5.0, "what runs is what was imported"
    cache.close()
    code = """
        import importlib, sys
        sys.path.insert(0, sys.argv[1])
        from tests.nodegraph import support as toy
        from nodegraph.cache import Cache
        compute = importlib.import_module(f"{sys.argv[2]}.nodes").compute
        graph = toy.toy_graph(compute)
        graph.add(compute, "c", x=graph.add("toy.number"))
        print(graph.run(cache=Cache(sys.argv[3]))["c"])
    """
    assert toy.python(code, folder.parent, folder.name, tmp_path / "cache").strip() == "104.0"


FUNCTION_PLUGIN: Files = {
    "__init__.py": "",
    "base.py": """
        from typing import ClassVar
        from nodegraph import port_type

        @port_type
        class Shape:
            computes: ClassVar[bool] = True

            def at(self) -> float:
                raise NotImplementedError
    """,
    "hill.py": """
        from nodegraph import node, port_type
        from .base import Shape

        @port_type
        class Hill(Shape):
            height: float

            def at(self) -> float:
                return self.height

        @node(version=1)
        def hill() -> Shape:
            '''A hill.'''
            return Hill(2.0)
    """,
    "ask.py": """
        from nodegraph import node
        from .base import Shape

        @node(version=1)
        def ask(shape: Shape) -> float:
            '''Ask a shape.'''
            return shape.at()
    """,
}
ASK = """
    import importlib, sys
    sys.path.insert(0, sys.argv[1])
    from nodegraph import Graph
    from nodegraph.cache import Cache
    hill, ask = (importlib.import_module(f"{sys.argv[2]}.{name}") for name in ("hill", "ask"))
    graph = Graph("shapes")
    graph.add(ask.ask, "ask", shape=graph.add(hill.hill, "hill"))
    cache = Cache(sys.argv[3])
    print(graph.run(["ask"], cache=cache)["ask"])
    cache.close()
"""


def test_an_edit_of_what_a_value_computes_reaches_who_asks_it(plugin: Callable[..., Path], tmp_path: Path) -> None:
    """The hill comes out with the same fields, and the node that asks it does not import its class."""
    folder = plugin(FUNCTION_PLUGIN)

    def asked() -> str:
        return toy.python(ASK, folder.parent, folder.name, tmp_path / "cache").strip()

    assert [asked(), asked()] == ["2.0", "2.0"]
    path = folder / "hill.py"
    path.write_text(path.read_text().replace("return self.height", "return 10 * self.height"))
    assert asked() == "20.0"
