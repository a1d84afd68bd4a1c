"""File formats: which one a name gets, that it is checked before a run, and that its code counts for the cache."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph import File, Format, Graph, GraphError, InputFile, OutputFile, node
from nodegraph.cache import Cache
from nodegraph.errors import PluginError
from nodegraph.formats import Formats, Use
from nodegraph.plan import fingerprints
from nodegraph.plugins import Registry, registry
from tests.nodegraph import support as toy


def nothing(path: Path) -> None:
    """Read nothing."""


def anything(value: object, name: str, *, scale: float = 1.0) -> File:
    return File.of(name, str(scale).encode())


def form(
    kind: type, *suffixes: str, read: Callable[..., Any] | None = nothing, write: Callable[..., Any] | None = None
) -> Format:
    return Format(kind, suffixes, f"{kind.__name__} in {suffixes[0]}", read, write)


def listed(*formats: Format) -> Formats:
    found = Formats()
    for item in formats:
        assert found.add(item, "acme") == []
    return found


# Declaring.


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"type": dict}, "is no port type"),
        ({"suffixes": ".x"}, "suffixes must be a tuple of at least one"),
        ({"suffixes": ()}, "suffixes must be a tuple of at least one"),
        ({"suffixes": ("x",)}, "suffix 'x' must be like '.abc', in lower case"),
        ({"suffixes": (".x", ".TIF")}, "suffix '.TIF' must be like"),
        ({"suffixes": (".",)}, "suffix '.' must be like"),
        ({"suffixes": (3,)}, "suffix 3 must be like"),
        ({"read": None}, "is neither read nor written"),
        ({"read": len}, "read must be a plain function"),
        ({"write": functools.partial(anything, scale=2.0)}, "write must be a plain function"),
        ({"open": open}, "open must be a plain function"),
        ({"read": "a.module:read"}, "read must be a plain function, not 'a.module:read'"),
    ],
)
def test_a_format_that_cannot_be_one_is_refused(given: dict[str, Any], message: str) -> None:
    whole: dict[str, Any] = {"type": toy.Height, "suffixes": (".x",), "title": "Heights", "read": nothing}
    with pytest.raises(PluginError, match="format 'Heights'") as caught:
        Format(**{**whole, **given})
    assert message in str(caught.value)


def test_a_format_says_what_its_functions_take() -> None:
    @contextmanager
    def opens(path: Path, *, band: int = 1) -> Iterator[int]:
        yield band

    both = Format(toy.Height, (".x",), "Heights", read=nothing, write=anything, open=opens)
    assert both.functions("read") == (opens, nothing)
    assert both.functions("write") == (anything,)
    assert (both.takes("read"), both.takes("write")) == ({"band"}, {"scale"})
    assert form(toy.Height, ".x").functions("write") == ()


# Finding.


def test_the_longest_suffix_counts_and_then_the_nearest_base() -> None:
    base, own, packed = form(toy.Surface, ".x", ".y"), form(toy.Height, ".x"), form(toy.Surface, ".x.gz")
    found = listed(base, own, packed)
    for cls, name, expected in (
        (toy.Height, "a.x", own),
        (toy.Height, "folder.y/A.B.X", own),
        (toy.Height, "a.y", base),
        (toy.Height, "a.x.gz", packed),
        (toy.Cover, "a.x", base),
        (toy.Surface, "a.x", base),
    ):
        assert found.find(cls, name, "read") is expected, (cls, name)
    for cls, name in ((toy.Word, "a.x"), (toy.Height, "a.gz"), (toy.Height, "x"), (toy.Height, ".x")):
        with pytest.raises(ValueError):
            found.find(cls, name, "read")
    with pytest.raises(ValueError):
        found.find(toy.Height, "a.x", "write")


def test_the_empty_suffix_is_for_all_that_no_other_knows() -> None:
    every, special = form(toy.Height, ""), form(toy.Surface, ".x")
    found = listed(every, special)
    assert found.find(toy.Height, "a.x", "read") is special, "a suffix goes before none, whatever the base"
    for name in ("a.y", "a", ".x", "a."):
        assert found.find(toy.Height, name, "read") is every


@given(
    st.lists(st.sampled_from(["", ".a", ".b", ".a.b", ".b.a"]), unique=True), st.text("aAb.", min_size=1, max_size=8)
)
def test_what_is_found_is_what_the_name_ends_in(suffixes: list[str], name: str) -> None:
    formats = {suffix: form(toy.Height, suffix) for suffix in suffixes}
    found = listed(*formats.values())
    fits = [item for item in suffixes if name.lower().endswith(item) and (item == "" or name.lower() != item)]
    if fits:
        assert found.find(toy.Height, name, "read") is formats[max(fits, key=len)]
    else:
        with pytest.raises(ValueError):
            found.find(toy.Height, name, "read")


def test_one_format_reads_and_another_writes() -> None:
    found = Formats()
    reads, writes = form(toy.Height, ".x"), form(toy.Height, ".x", read=None, write=anything)
    assert found.add(reads, "reader") == found.add(writes, "writer") == []
    assert found.find(toy.Height, "a.x", "read") is reads
    assert found.find(toy.Height, "a.x", "write") is writes
    both = form(toy.Height, ".x", ".y", write=anything)
    message = "format 'Height in .x' does not get '.x' for Height, which plugin '{}' has already"
    assert found.add(both, "late") == [message.format("writer")]
    assert found.suffixes(both, "read") == found.suffixes(both, "write") == (".y",)
    assert found.find(toy.Height, "a.x", "read") is reads


@pytest.mark.parametrize(
    ("use", "name", "message"),
    [
        ("read", "a.z", "'a.z' ends in '.z'; choose .x or .y"),
        ("read", "a", "'a' has no suffix; choose .x or .y"),
        ("write", "A.Z", "'A.Z' ends in '.z'; choose .w"),
    ],
)
def test_an_unknown_suffix_is_refused_naming_those_there_are(use: Use, name: str, message: str) -> None:
    found = listed(
        form(toy.Height, ".x", ".xx"), form(toy.Surface, ".y"), form(toy.Word, ".v"),
        form(toy.Height, ".w", read=None, write=anything),
    )  # fmt: skip
    with pytest.raises(ValueError) as caught:
        found.find(toy.Height, name, use)
    assert str(caught.value) == message
    with pytest.raises(ValueError, match=r"no plugin writes files of Word; install one that does, for 'a.z'"):
        found.find(toy.Word, "a.z", "write")


# In a graph.


@node(version=1)
def load(*, path: Annotated[Path | tuple[Path, ...], InputFile(sidecars=(".one",), type=toy.Height)]) -> toy.Height:
    """Load a height."""
    toy.counted("load")
    paths = path if isinstance(path, tuple) else (path,)
    formats = registry().formats()
    values = [formats.find(toy.Height, item.name, "read").functions("read")[0](item) for item in paths]
    return toy.Height(np.asarray(values, np.float32)[None])


@node(version=1)
def save(surface: toy.Surface, *, name: Annotated[str | None, OutputFile(type=toy.Surface)] = "a.x") -> File:
    """Save a surface."""
    toy.counted("save")
    (write,) = registry().formats().find(type(surface), name or "a.x", "write").functions("write")
    file: File = write(surface, name or "a.x")
    return file


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Let the process have one plugin, with the given formats, and no other."""
    numbers = itertools.count()

    def have(*formats: Format) -> None:
        found = Registry()
        found.add(toy.plugin(f"acme_{next(numbers)}", formats=lambda: formats))
        monkeypatch.setattr("nodegraph.plugins.registry", lambda: found)
        monkeypatch.setattr("nodegraph.scopes.registry", lambda: found)
        monkeypatch.setitem(load.function.__globals__, "registry", lambda: found)
        fingerprints.cache_clear()

    yield have
    fingerprints.cache_clear()


def read_number(path: Path) -> float:
    return float(path.read_text())


def read_number_and_sidecar(path: Path) -> float:
    beside = path.with_suffix(".two")
    return float(path.read_text()) + (float(beside.read_text()) if beside.exists() else 0.0)


def write_x(surface: toy.Surface, name: str) -> File:
    return File.of(name, b"x")


def write_own(surface: toy.Cover, name: str) -> File:
    return File.of(name, b"own")


def loading(*paths: Path) -> Graph:
    graph = toy.toy_graph(load)
    graph.add(load, "load", path=[str(path) for path in paths])
    return graph


def test_a_wrong_suffix_is_refused_before_anything_runs(process: Callable[..., None], tmp_path: Path) -> None:
    process(form(toy.Height, ".x"), form(toy.Surface, ".x", read=None, write=write_x))
    graph = toy.toy_graph(load, save)
    graph.add(load, "in", path=str(tmp_path / "a.y"))
    graph.add(save, "out", surface="in", name="b.z")
    graph.add(save, "other", surface="in", name="../b.x")
    graph.add(save, "none", surface="in", name=None)
    toy.ran()
    with pytest.raises(GraphError) as caught:
        graph.run(cache=toy.memory_cache())
    assert [str(item).partition(": ")[2] for item in caught.value.problems] == [
        "node 'in': parameter 'path': 'a.y' ends in '.y'; choose .x",
        "node 'out': parameter 'name': 'b.z' ends in '.z'; choose .x",
        "node 'other': parameter 'name': '../b.x' is no file name inside the output folder; give a relative path "
        "without '..'",
    ]
    assert toy.ran() == {}


def test_another_reader_is_another_key_and_only_for_its_suffix(process: Callable[..., None], tmp_path: Path) -> None:
    cache = toy.memory_cache()
    for name in ("a.x", "a.y"):
        (tmp_path / name).write_text("3")

    def run(*names: str) -> tuple[str, str]:
        result = loading(*[tmp_path / name for name in names]).run(cache=cache)
        toy.ran()
        return result.nodes["load"].status, result.nodes["load"].reason

    number, other = form(toy.Height, ".x", read=read_number), form(toy.Height, ".y", read=read_number)
    process(number, other)
    assert run("a.x")[0] == run("a.y")[0] == run("a.x", "a.y")[0] == "computed"
    assert run("a.x", "a.y") == run("a.x") == run("a.y") == ("cached", "")
    process(number, form(toy.Height, ".y", read=read_number_and_sidecar))
    assert run("a.y") == ("computed", "code changed")
    assert run("a.x") == ("cached", "")
    assert run("a.x", "a.y")[0] == "computed"
    # A format of the base class, where there is one of the class itself, counts for nothing.
    process(number, other, form(toy.Surface, ".y", read=read_number_and_sidecar))
    assert run("a.y")[0] == "cached"


def test_the_sidecars_of_a_format_are_files_that_the_node_reads(process: Callable[..., None], tmp_path: Path) -> None:
    process(Format(toy.Height, (".x",), "With another", read=read_number_and_sidecar, sidecars=(".two",)))
    cache, path = toy.memory_cache(), tmp_path / "a.x"
    path.write_text("3")

    def run() -> tuple[float, str]:
        result = loading(path).run(cache=cache)
        return float(result["load"].data[0, 0]), result.nodes["load"].status

    assert (run(), run()) == ((3.0, "computed"), (3.0, "cached"))
    (tmp_path / "a.two").write_text("4")
    assert (run(), run()) == ((7.0, "computed"), (7.0, "cached"))
    (tmp_path / "a.one").write_text("of the node itself")
    assert run() == (7.0, "computed")
    (tmp_path / "a.three").write_text("of nobody")
    assert run() == (7.0, "cached")


def test_what_a_subclass_would_be_written_in_counts_too(process: Callable[..., None], tmp_path: Path) -> None:
    """A link says `Surface` and may carry a `Cover`: which writer runs is known only when the value is there."""

    @node(version=1)
    def surprise() -> toy.Surface:
        """Give more than it says."""
        return toy.Cover(np.zeros((2, 2), np.float32))

    def run() -> tuple[bytes, str]:
        graph = toy.toy_graph(surprise, save)
        graph.add(surprise, "s")
        graph.add(save, "f", surface="s", name="a.x")
        result = graph.run(cache=cache, out=tmp_path)
        return result["f"].content.tobytes(), result.nodes["f"].status

    cache = toy.memory_cache()
    every = form(toy.Surface, ".x", read=None, write=write_x)
    process(every)
    assert (run(), run()) == ((b"x", "computed"), (b"x", "cached"))
    process(every, form(toy.Cover, ".x", read=None, write=write_own))
    assert (run(), run()) == ((b"own", "computed"), (b"own", "cached"))
    process(form(toy.Cover, ".x", read=None, write=write_own))
    assert run()[0] == b"own", "a suffix that only a subclass knows is no error yet"


def test_two_functions_of_one_file_are_told_apart(process: Callable[..., None]) -> None:
    prints = set()
    readers = [read_number, read_number_and_sidecar, lambda path: 1.0, lambda path: 2.0]
    for reader in readers:
        prints.add(fingerprints().of(load, (reader,)))
        assert fingerprints().of(load, (reader,)) in prints
    assert len(prints | {fingerprints().of(load)}) == len(readers) + 1


# In processes of their own: code in files, and the edit of what a reader imports.

READER = """
    from contextlib import contextmanager
    from pathlib import Path
    from nodegraph import Format, hookimpl
    from tests.nodegraph import support as toy

    LIMITS = (min, max, "a text")

    def read(path):
        from {package}.helper import SHIFT
        return float(path.read_text()) + SHIFT

    @contextmanager
    def open_it(path):
        yield LIMITS[0](read(path), 1e9)

    @hookimpl
    def nodegraph_formats():
        return [Format(toy.Height, (".x",), "Heights", read=read), Format(toy.Height, (".y",), "Other", open=open_it)]
"""
PROGRAM = """
    import importlib, sys
    sys.path.insert(0, sys.argv[1])
    import nodegraph.plugins, nodegraph.scopes
    from nodegraph.plugins import Registry
    found = Registry()
    nodegraph.plugins.registry = nodegraph.scopes.registry = lambda: found
    found.add(importlib.import_module(f"{sys.argv[2]}.plugin"))
    from nodegraph.plan import fingerprints
    from tests.nodegraph.test_formats import load
    for name in ("a.x", "a.y"):
        used = found.formats().find(load.outputs[0].type, name, "read").functions("read")
        print(fingerprints().of(load, used).hex())
    print(*[path.name for path in fingerprints().files(load, used) if sys.argv[2] in str(path)])
"""


def test_an_edit_of_what_a_reader_imports_changes_the_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = f"toy_format_{os.getpid()}"
    folder = tmp_path / package
    folder.mkdir()
    for name, text in {"plugin.py": READER.format(package=package), "helper.py": "SHIFT = 1.0\n"}.items():
        (folder / name).write_text("\n".join(line.removeprefix("    ") for line in text.splitlines()))
        os.utime(folder / name, (1e9, 1e9))

    def now(seed: str) -> list[str]:
        monkeypatch.setenv("PYTHONHASHSEED", seed)
        return toy.python(PROGRAM, tmp_path, package).splitlines()

    before = now("1")
    assert before[2].split() == ["helper.py", "plugin.py"]
    assert now("2") == before, "the same in every process"
    (folder / "helper.py").write_text("SHIFT = 2.0\n")
    after = now("1")
    assert after[0] != before[0]
    assert after[1] != before[1]


def test_a_cached_result_survives_on_disk(process: Callable[..., None], tmp_path: Path) -> None:
    process(form(toy.Height, ".x", read=read_number))
    (tmp_path / "a.x").write_text("3")
    for status in ("computed", "cached"):
        cache = Cache(tmp_path / "cache")
        assert loading(tmp_path / "a.x").run(cache=cache).nodes["load"].status == status
        cache.close()
