"""Plugins: what they bring, and that a broken one costs a warning that names it, never the program."""

from __future__ import annotations

import importlib
import inspect
import itertools
import json
import os
import re
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from nodegraph import Family, Format, Graph, GraphError, Migration, Node, Preview, hookimpl, node
from nodegraph.errors import PluginError
from nodegraph.plugins import GROUP, Hooks, Registry, registry
from tests.nodegraph import support as toy

_numbers = itertools.count()


class Installed:
    """A distribution that brings an entry point."""

    def __init__(self, version: str) -> None:
        self.version = version


def point(name: str, module: str, version: str = "1.2.3") -> EntryPoint:
    found = EntryPoint(name, module, GROUP)
    vars(found)["dist"] = Installed(version)
    return found


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., str]]:
    """Write a module of a name of its own where Python finds it, and return the name."""
    monkeypatch.syspath_prepend(tmp_path)
    made: list[str] = []

    def make(source: str) -> str:
        name = f"toy_module_{os.getpid()}_{next(_numbers)}"
        (tmp_path / f"{name}.py").write_text(textwrap.dedent(source))
        importlib.invalidate_caches()
        made.append(name)
        return name

    yield make
    for name in made:
        sys.modules.pop(name, None)


GOOD = """
    from nodegraph import Family, hookimpl, node

    @node(version=1)
    def give(*, value: float = 1.0) -> float:
        '''Give a number.'''
        return value

    @hookimpl
    def nodegraph_families():
        return [Family({family!r}, modules=(__name__,))]
"""


def works(found: Registry, type_id: str = "good.give") -> bool:
    graph = Graph(registry=found)
    graph.add(type_id, "n", value=3.0)
    return bool(graph.run(cache=toy.memory_cache())["n"] == 3.0)


# Loading.


def test_a_plugin_is_loaded_by_its_entry_point(write: Callable[..., str]) -> None:
    found = Registry()
    found.load([point("good", write(GOOD.format(family="good")))])
    plugin = found.plugins["good"]
    assert (plugin.version, plugin.error, [family.name for family in plugin.families]) == ("1.2.3", "", ["good"])
    assert works(found)
    assert found.owner("good.give") is plugin
    assert found.owner("bad.give") is None
    assert plugin.module is not None
    assert found.packages() == {plugin.module.__name__}


HOOK = """
from nodegraph import Family, hookimpl

@hookimpl
def nodegraph_families():
    {body}
"""


def hook(body: str) -> str:
    """Return a plugin whose one hook does `body`."""
    return HOOK.format(body=body)


BROKEN = [
    ("raise RuntimeError('on import')", "RuntimeError: on import"),
    ("import a_module_nobody_has", "No module named 'a_module_nobody_has'"),
    ("def broken(:", "SyntaxError"),
    ("raise SystemExit(3)", "SystemExit: 3"),
    ("from nodegraph import hookimpl\n\n@hookimpl\ndef nodegraph_families(config):\n    return []", "config"),
    ("from nodegraph import hookimpl\n\n@hookimpl\ndef nodegraph_familys():\n    return []", "nodegraph_familys"),
    (
        hook("return 3"),
        "nodegraph_families failed",
    ),
    (
        hook("return [3]"),
        "must list Family objects, not 3",
    ),
    (
        hook("return ['terrain']"),
        "must list Family objects",
    ),
    (
        hook("raise OSError('no')"),
        "nodegraph_families failed (OSError: no)",
    ),
    (
        hook("return [Family('not a name')]"),
        "family 'not a name' must be an identifier",
    ),
    (
        hook("return [Family('x', modules='x.nodes')]"),
        "modules must be a tuple of names",
    ),
    (
        hook("return [Family('twice'), Family('twice')]"),
        "family 'twice' is already registered",
    ),
]


@pytest.mark.parametrize(("source", "message"), BROKEN)
def test_a_broken_plugin_warns_and_the_others_go_on(write: Callable[..., str], source: str, message: str) -> None:
    found = Registry()
    points = [point("broken", write(source)), point("good", write(GOOD.format(family="good")), "2.0")]
    with pytest.warns(RuntimeWarning, match=r"plugin 'broken' 1.2.3 is left out: ") as caught:
        found.load(points)
    assert len(caught) == 1
    assert message in str(caught[0].message)
    assert message in found.plugins["broken"].error
    assert works(found)
    assert found.migrations() == []
    with pytest.raises(GraphError, match=r"unknown node type 'broken.x': plugin 'broken' is left out \("):
        Graph(registry=found).add("broken.x")


def test_a_module_that_is_not_there(write: Callable[..., str]) -> None:
    found = Registry()
    with pytest.warns(RuntimeWarning, match="plugin 'gone' 1.2.3 is left out: .*No module named 'gone_plugin'"):
        found.load([point("gone", "gone_plugin")])


def test_two_plugins_of_one_family(write: Callable[..., str]) -> None:
    found = Registry()
    points = [point("good", write(GOOD.format(family="good"))), point("later", write(GOOD.format(family="good")), "9")]
    with pytest.warns(
        RuntimeWarning, match="plugin 'later' 9 is left out: .*family 'good' is already registered by plugin 'good'"
    ):
        found.load(points)
    assert works(found)


def test_two_plugins_of_one_name(write: Callable[..., str]) -> None:
    found = Registry()
    points = [point("good", write(GOOD.format(family="good"))), point("good", write(GOOD.format(family="other")), "9")]
    with pytest.warns(RuntimeWarning, match="plugin 'good' 9 is left out"):
        found.load(points)
    assert works(found)
    assert found.plugins["good"].error == ""


def test_a_plugin_is_added_whole_or_not_at_all() -> None:
    found = Registry()
    with pytest.raises(PluginError, match="plugin 'half': nodegraph_families failed"):
        found.add(toy.plugin("half", families=lambda: 1 / 0, migrations=lambda: [Migration("a.b", 2)]))
    assert found.plugins == {}
    assert found.migrations() == []
    found.add(toy.plugin("half", families=lambda: [Family("half")]))
    with pytest.raises(PluginError, match="plugin 'half'"):
        found.add(toy.plugin("half", families=lambda: [Family("more")]))
    assert [family.name for family in found.plugins["half"].families] == ["half"]


# Families.


def test_families_are_imported_when_they_are_first_used(write: Callable[..., str]) -> None:
    nodes = write(GOOD.format(family="unused").split("@hookimpl")[0])
    other = write("raise RuntimeError('nobody asked for me')")
    found = Registry()
    found.add(toy.plugin("lazy", families=lambda: [Family("good", modules=(nodes,)), Family("dear", modules=(other,))]))
    assert nodes not in sys.modules
    assert works(found)
    assert nodes in sys.modules
    assert other not in sys.modules
    with pytest.warns(
        RuntimeWarning, match="plugin 'lazy' 1.0 is left out: family 'dear': RuntimeError: nobody asked for me"
    ):
        assert found.find("dear.x") is None
    assert works(found), "its other family, which is there, stays"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert found.find("dear.x") is None, "one warning is enough"
    assert "left out (family 'dear'" in found.why_unknown("dear.x")


def test_a_family_lists_only_what_its_modules_declare(write: Callable[..., str]) -> None:
    base = write(GOOD.format(family="unused").split("@hookimpl")[0])
    user = write(
        f"""
        from {base} import give
        from nodegraph import node

        @node(version=1)
        def own() -> float:
            'Own.'
            return 1.0

        alias = own
        """
    )
    found = Registry()
    found.add(toy.plugin("p", families=lambda: [Family("a", modules=(base,)), Family("b", modules=(user,))]))
    assert [item.id for item in found.nodes()] == ["a.give", "b.own"]


def test_a_node_that_is_declared_twice_is_refused() -> None:
    def declared(module: str) -> Node[..., Any]:
        def twin() -> float:
            """Be one of two."""
            return 1.0

        twin.__module__ = module
        return node(version=1)(twin)

    found = Registry()
    found.add(toy.plugin("p", families=lambda: [Family("f", nodes=(declared("one"), declared("two")))]))
    with pytest.warns(RuntimeWarning, match="node 'f.twin' is already declared in one; choose another name"):
        found.activate_all()


def test_a_badly_declared_node_leaves_the_others_of_its_family() -> None:
    @node(version=1)
    def bad(x: list[float]) -> float:
        """Be declared badly."""
        return 1.0

    @node(version=1)
    def fine(*, value: float = 1.0) -> float:
        """Be fine."""
        return value

    found = Registry()
    found.add(toy.plugin("p", families=lambda: [Family("f", nodes=(bad, fine))]))
    assert [item.id for item in found.nodes()] == ["f.bad", "f.fine"]
    assert works(found, "f.fine")
    graph = Graph.from_json('{"format": "nodegraph/1", "nodes": {"n": {"type": "f.bad"}}}', registry=found)
    with pytest.raises(GraphError, match=r"input 'x' has type .*, which is no port type"):
        graph.validate()


# The other hooks.


@pytest.mark.parametrize(
    ("hook", "message"),
    [
        ({"port_types": lambda: [float, int, 3]}, "nodegraph_port_types must list type objects, not 3"),
        ({"port_types": lambda: [dict]}, "dict is no port type; declare it with @port_type"),
        ({"port_types": lambda: 1 / 0}, "nodegraph_port_types failed (ZeroDivisionError"),
        ({"conversions": lambda: [len]}, "nodegraph_conversions must list Node objects"),
        ({"conversions": lambda: [toy.number]}, "conversion 'number' must have one input, one output"),
        ({"conversions": lambda: [toy.halves]}, "conversion 'halves' must have one input, one output"),
        ({"previews": lambda: [toy.Height]}, "nodegraph_previews must list Preview objects"),
        ({"previews": lambda: 3}, "nodegraph_previews failed"),
    ],
)
def test_a_hook_that_gives_something_else_leaves_the_plugin_out(hook: dict[str, Any], message: str) -> None:
    found = toy.toy_registry()
    found.add(toy.plugin("odd", **hook))
    with pytest.warns(RuntimeWarning, match="plugin 'odd' 1.0 is left out"):
        assert found.conversion(toy.Height, toy.Cover) is None
    assert message in found.plugins["odd"].error
    found.activate_all()
    graph = Graph(registry=found)
    graph.add("toy.number")
    graph.validate()


def test_a_hook_may_give_nothing() -> None:
    found = toy.toy_registry()
    found.add(toy.plugin("quiet", families=lambda: None, conversions=lambda: None, migrations=lambda: ()))
    found.activate_all()
    assert found.plugins["quiet"].error == ""


@pytest.mark.parametrize(
    ("hook", "message"),
    [
        (lambda: [".acme"], "nodegraph_formats must list Format objects, not '.acme'"),
        (lambda: 1 / 0, "nodegraph_formats failed (ZeroDivisionError"),
        (lambda: [Format(dict, (".x",), "Dict", read=lambda path: {})], "is no port type; declare it with @port_type"),
    ],
)
def test_formats_that_are_none_leave_the_others(hook: Callable[[], Any], message: str) -> None:
    found = Registry()
    fine = Format(toy.Height, (".fine",), "Fine", read=lambda path: None)
    found.add(toy.plugin("odd", formats=hook))
    found.add(toy.plugin("sound", formats=lambda: [fine]))
    with pytest.warns(RuntimeWarning, match="plugin 'odd' 1.0 is left out: nodegraph_formats") as caught:
        assert found.formats().find(toy.Height, "a.fine", "read") is fine
    assert len(caught) == 1
    assert message in found.plugins["odd"].error
    assert [item for item, _ in found.formats()] == [fine]


def test_of_two_plugins_with_one_suffix_the_first_by_name_keeps_it(write: Callable[..., str]) -> None:
    """Whichever is used first: the formats of a plugin are no part of its being activated."""
    source = """
        from nodegraph import Family, Format, hookimpl
        from tests.nodegraph import support as toy

        def read(path):
            return {family!r}

        @hookimpl
        def nodegraph_families():
            return [Family({family!r})]

        @hookimpl
        def nodegraph_formats():
            return [Format(toy.Height, (".h", ".{family}"), "Heights", read=read)]
    """
    modules = [write(source.format(family=name)) for name in ("late", "early")]
    found = Registry()
    found.load([point("late", modules[0], "2.0"), point("early", modules[1])])
    found.find("late.nothing")
    message = "plugin 'late' 2.0: format 'Heights' does not get '.h' for Height, which plugin 'early' has already"
    with pytest.warns(RuntimeWarning) as caught:
        formats = found.formats()
    assert [str(item.message) for item in caught] == [message]
    keeper, other = (item for item, _ in formats)
    assert formats.find(toy.Height, "a.h", "read") is keeper
    assert formats.find(toy.Height, "a.late", "read") is other
    assert formats.suffixes(other, "read") == (".late",)
    assert found.plugins["late"].error == "", "all else of it stays"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert found.formats() is formats, "one warning is enough"


def test_formats_are_listed_when_they_are_asked_for() -> None:
    asked: list[str] = []
    found = toy.toy_registry()
    found.add(toy.plugin("lazy", formats=lambda: asked.append("lazy")))
    found.activate_all()
    graph = Graph(registry=found)
    graph.add("toy.number")
    graph.validate()
    assert asked == []
    found.formats()
    found.add(toy.plugin("later", formats=lambda: asked.append("later")))
    found.formats()
    assert asked == ["lazy", "later"]


@pytest.mark.parametrize("rubbish", [lambda: [3], lambda: 1 / 0, lambda: [("a.b", 2)]])
def test_migrations_that_are_none_stop_no_graph(rubbish: Callable[[], Any]) -> None:
    found = toy.toy_registry()
    found.add(toy.plugin("rusty", migrations=rubbish))
    graph = Graph(registry=found)
    graph.add("toy.number", "n")
    with pytest.warns(RuntimeWarning, match="plugin 'rusty' 1.0 is left out: nodegraph_migrations"):
        graph.validate()
    graph.set("n.value", 4.0)
    assert graph.run(cache=toy.memory_cache())["n"] == 4.0


def test_the_preview_of_the_nearest_base_counts() -> None:
    found = Registry()
    previews = [Preview(toy.Surface, lambda value: b"surface"), Preview(toy.Cover, lambda value: b"cover")]
    found.add(toy.plugin("drawer", previews=lambda: previews))
    assert found.preview(toy.Cover) is previews[1]
    assert found.preview(toy.Height) is previews[0]
    assert found.preview(float) is None


def test_a_registered_node_may_be_declared_again() -> None:
    found = Registry()
    before = found.changes

    def declare() -> Node[..., Any]:
        @node(version=1)
        def mine() -> float:
            """Be mine."""
            return 1.0

        return mine

    first, second = found.register(declare()), found.register(declare())
    assert found.find("local.mine") is second is not first
    assert found.changes > before


# The specifications themselves.

SPECIFIED = {name: item for name, item in vars(Hooks).items() if name.startswith("nodegraph_")}
GIVEN: dict[str, tuple[type, Any]] = {
    "nodegraph_families": (Family, Family("acme")),
    "nodegraph_port_types": (type, toy.Height),
    "nodegraph_conversions": (Node, toy.increase),
    "nodegraph_previews": (Preview, Preview(toy.Height, lambda value: b"")),
    "nodegraph_formats": (Format, Format(toy.Height, (".acme",), "Acme", read=lambda path: None)),
    "nodegraph_migrations": (Migration, Migration("acme.x", 2)),
}


@pytest.mark.parametrize("name", SPECIFIED)
def test_every_hook_is_documented_and_called_as_it_says(name: str) -> None:
    """Each hook has one sentence, the signature it shows, and a plugin that implements it and is heard."""
    hook = SPECIFIED[name]
    text = inspect.getdoc(hook) or ""
    assert text.endswith(".")
    assert text.startswith("List ")
    assert list(inspect.signature(hook).parameters) == ["self"], "a hook takes nothing, so none can be called wrongly"
    returned = get_type_hints(hook)["return"]
    kind, example = GIVEN[name]
    (listed,) = get_args(returned)
    assert returned.__origin__ is Sequence
    assert (getattr(listed, "__origin__", None) or listed) is kind

    called: list[str] = []

    def implementation() -> list[Any]:
        called.append(name)
        return [example]

    found = Registry()
    found.add(toy.plugin("acme", **{name.removeprefix("nodegraph_"): implementation}))
    found.activate_all()
    heard = {
        "nodegraph_families": lambda: [family for _, family in found._families.values()],
        "nodegraph_port_types": lambda: [example],
        "nodegraph_conversions": lambda: [found.conversion(float, float)],
        "nodegraph_previews": lambda: [found.preview(toy.Height)],
        "nodegraph_formats": lambda: [found.formats().find(toy.Height, "x.acme", "read")],
        "nodegraph_migrations": lambda: found.migrations(),
    }
    assert heard[name]() == [example]
    assert called[0] == name


def test_no_hook_is_untested() -> None:
    assert set(SPECIFIED) == set(GIVEN)


def test_every_hook_has_a_plugin_that_uses_it_and_a_test_that_says_so() -> None:
    """A hook ships only with a real use: of the first plugin, or (migrations) of the one the tests install."""
    loaded = registry()
    used = {name for plugin in loaded.plugins.values() for name in SPECIFIED if hasattr(plugin.module, name)}
    assert set(SPECIFIED) - used <= {"nodegraph_migrations"}


def test_the_example_in_the_documentation_works() -> None:
    import nodegraph.plugins as module

    source = textwrap.dedent((module.__doc__ or "").split("::\n", 1)[1])
    scope: dict[str, Any] = {"__name__": "acme_example", "Mask": toy.Surface}
    exec(source.replace("mask.extent", "mask.size"), scope)
    example = type(sys)("acme_example")
    vars(example).update(scope)
    sys.modules["acme_example"] = example
    try:
        found = Registry()
        found.add(example)
        assert [item.id for item in found.nodes()] == ["acme.invert"]
        assert found.nodes()[0].summary == "Swap inside and outside."
    finally:
        del sys.modules["acme_example"]


def test_installed_plugins_load_without_a_warning() -> None:
    code = """
        import json
        from nodegraph.plugins import registry
        found = registry()
        print(json.dumps({name: plugin.error for name, plugin in found.plugins.items()}))
        print(len(found.nodes()))
    """
    errors, count = toy.python(code).splitlines()
    assert json.loads(errors)["nodegraph_terrain"] == ""
    assert set(json.loads(errors).values()) == {""}
    assert int(count) > 10


def test_loading_lists_plugins_without_importing_their_nodes() -> None:
    code = """
        import sys
        from nodegraph.plugins import registry
        registry()
        print(sorted({"rasterio", "matplotlib", "scipy", "pyopencl"} & set(sys.modules)))
    """
    assert toy.python(code).strip() == "[]"


def test_hooks_are_marked_by_one_name() -> None:
    assert hookimpl.project_name == GROUP
    assert all(re.fullmatch(r"nodegraph_[a-z_]+", name) for name in SPECIFIED)
