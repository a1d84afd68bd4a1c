"""Ports: generic, variadic and optional ones, subtypes, and conversions."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nodegraph import Family, Graph, GraphError, codec, node, port_type
from nodegraph.cache import Cache
from nodegraph.errors import PluginError
from nodegraph.plugins import Registry
from nodegraph.porttypes import accepts, all_types, conform, describe, named, nearest_common, shape_text, summary
from tests.nodegraph import support as toy


@pytest.fixture(autouse=True)
def _count_anew() -> None:
    toy.ran()


# Types.


def test_a_subtype_travels_where_its_base_may() -> None:
    assert accepts(toy.Surface, toy.Height)
    assert not accepts(toy.Height, toy.Surface)
    assert not accepts(toy.Height, toy.Cover)
    assert accepts(float, int)
    assert not accepts(int, float)
    assert not accepts(int, bool)
    assert not accepts(float, bool)
    assert accepts(bool, bool)
    graph = toy.toy_graph()
    graph.add("toy.mean", surface=graph.add("toy.height", value=3.0))
    assert graph.run(cache=toy.memory_cache())["mean"] == 3.0


@pytest.mark.parametrize(
    ("value", "target", "expected"),
    [
        (np.float32(2.5), float, 2.5),
        (3, float, 3.0),
        (np.int16(3), int, 3),
        (np.bool_(True), bool, True),
        ("x", str, "x"),
    ],
)
def test_scalars_conform(value: Any, target: type, expected: Any) -> None:
    found = conform(value, target)
    assert (found, type(found)) == (expected, target)


@pytest.mark.parametrize(
    ("value", "target"),
    [(True, int), (True, float), (1.0, int), (None, float), ("1", float), ([1.0], np.ndarray), (1, bool), (1, str)],
)
def test_nothing_else_is_converted(value: Any, target: type) -> None:
    with pytest.raises(TypeError, match=f"expected {describe(target)}"):
        conform(value, target)


def test_declaring_a_type_anew_replaces_it_and_a_stranger_may_have_its_name() -> None:
    @port_type
    class Once:
        """First."""

        x: float

    first = Once

    @port_type  # type: ignore[no-redef]
    class Once:
        """Second."""

        x: float
        y: float = 0.0

    assert named("Once") is not first
    assert named("Once") is Once
    stranger = port_type(type("Once", (), {"__module__": "elsewhere", "__annotations__": {"x": float, "y": float}}))
    assert named("Once") is None
    assert named("elsewhere.Once") is stranger
    # What the cache holds of one is never taken for the other.
    assert codec.seal(Once(1.0, 2.0)) != codec.seal(stranger(1.0, 2.0))
    assert type(codec.decode(codec.encode(stranger(1.0, 2.0)))) is stranger
    with pytest.raises(PluginError, match="must be a frozen dataclass"):
        port_type(dataclasses.make_dataclass("Thawed", [("x", float)]))


def test_types_describe_themselves() -> None:
    assert describe(toy.Height) == "Height"
    assert summary(toy.Height) == "A surface in metres."
    assert summary(np.ndarray) == "A NumPy array of numbers."
    assert {"Number", "Integer", "Boolean", "Text", "Array", "Height"} <= {name for name, _ in all_types()}
    assert shape_text(toy.Height(np.zeros((2, 3), np.float32))) == "(2, 3) float32"
    assert shape_text((np.zeros(2), (np.zeros((5, 5)),))) == "(5, 5) float64"
    assert shape_text(1.0) == ""


# Generic ports.


def test_a_generic_output_has_the_type_of_its_input() -> None:
    graph = toy.toy_graph()
    for kind in ("height", "cover"):
        graph.add("toy.double", f"double_{kind}", surface=graph.add(f"toy.{kind}"))
    graph.add("toy.steepness", height=graph.add("toy.double", "twice", surface="double_height"))
    network = graph.network()
    types = {step.id: step.types for step in network.steps}
    assert types["twice"] == types["double_height"] == (toy.Height,)
    assert types["double_cover"] == (toy.Cover,)
    graph.add("toy.steepness", "wrong", height="double_cover")
    with pytest.raises(GraphError, match=r"takes a Height, but 'double_cover.out' gives a Cover"):
        graph.validate()


def test_a_generic_port_keeps_to_its_bound() -> None:
    graph = toy.toy_graph()
    graph.add("toy.double", surface=graph.add("toy.number"))
    with pytest.raises(GraphError, match=r"takes a Surface, but 'number.out' gives a Number"):
        graph.validate()


@port_type
class Depth(toy.Height):
    """A height above ground."""


def test_a_generic_output_of_several_inputs_has_what_they_have_in_common() -> None:
    @node(version=1)
    def depth() -> Depth:
        """Give a depth."""
        return Depth(np.ones(3, np.float32))

    @node(version=1)
    def larger(first: toy.S, second: toy.S) -> toy.S:
        """Give the one with the larger sum."""
        return max(first, second, key=lambda surface: surface.data.sum())

    @node(version=1)
    def largest(*surfaces: toy.S) -> toy.S:
        """Give the one with the largest sum."""
        return max(surfaces, key=lambda surface: surface.data.sum())

    graph = toy.toy_graph(depth, larger, largest)
    for kind in ("height", "cover", "depth"):
        graph.add(f"toy.{kind}", kind)
    expected = {"height": toy.Height, "cover": toy.Surface, "depth": toy.Height}
    for kind in expected:
        graph.add(larger, f"{kind}_last", first="height", second=kind)
        graph.add(larger, f"{kind}_first", first=kind, second="height")
    graph.add(larger, "depths", first="depth", second="depth")
    graph.add(largest, "heights", surfaces=["depth", "height", "depth"])
    graph.add(largest, "all", surfaces=["depth", "height", "cover"])
    types = {step.id: step.types[0] for step in graph.network().steps}
    assert {kind: types[f"{kind}_last"] for kind in expected} == expected
    assert {kind: types[f"{kind}_first"] for kind in expected} == expected
    assert (types["depths"], types["heights"], types["all"]) == (Depth, toy.Height, toy.Surface)
    graph.add("toy.steepness", "fits", height="depth_last")
    graph.validate()
    graph.add("toy.steepness", "wrong", height="cover_last")
    with pytest.raises(GraphError, match=r"takes a Height, but 'cover_last.out' gives a Surface"):
        graph.validate()


def test_the_nearest_common_type() -> None:
    class Mixin(toy.Surface):
        """A base that is no port type."""

    @port_type
    class Left(toy.Height, Mixin):
        """One of two bases."""

    @port_type
    class Right(toy.Cover, Mixin):
        """Another."""

    assert nearest_common(Left, Right, toy.Surface) is toy.Surface
    assert nearest_common(Left, toy.Height, toy.Surface) is toy.Height
    assert nearest_common(int, float, float) is nearest_common(float, int, float) is float
    assert nearest_common(int, int, float) is int
    assert nearest_common(bool, bool, bool) is bool


def test_a_generic_output_without_an_input_has_its_bound() -> None:
    @node(version=1)
    def pick(*surfaces: toy.S) -> toy.S:
        """Give the first."""
        return surfaces[0] if surfaces else toy.Surface(np.zeros(1))  # type: ignore[return-value]

    graph = toy.toy_graph(pick)
    graph.add(pick, "none")
    graph.add(pick, "one", surfaces=graph.add("toy.height"))
    types = {step.id: step.types for step in graph.network().steps}
    assert types["none"] == (toy.Surface,)
    assert types["one"] == (toy.Height,)


# Variadic and optional ports.


def test_the_order_of_variadic_links_counts() -> None:
    graph = toy.toy_graph()
    for name, value in (("a", 1.0), ("b", 2.0), ("c", 3.0)):
        graph.add("toy.number", name, value=value)
    graph.add("toy.join", "one", first="a", rest=["c", "b"])
    graph.add("toy.join", "two", first="a", rest=["b", "c"])
    graph.add("toy.join", "same", first="a", rest=["b", "c"])
    graph.add("toy.join", "none", first="a")
    result = graph.run(cache=toy.memory_cache())
    assert [result[name] for name in ("one", "two", "same", "none")] == ["1,3,2", "1,2,3", "1,2,3", "1"]
    assert toy.ran()["join"] == 3


def test_which_port_a_value_enters_counts() -> None:
    graph = toy.toy_graph()
    a, b = graph.add("toy.number", "a", value=1.0), graph.add("toy.number", "b", value=2.0)
    graph.add("toy.subtract", "one", a=a, b=b)
    graph.add("toy.subtract", "two", b=a, a=b)
    result = graph.run(cache=toy.memory_cache())
    assert (result["one"], result["two"]) == (-1.0, 1.0)


def test_an_optional_port_gets_none() -> None:
    graph = toy.toy_graph()
    a = graph.add("toy.number", "a", value=1.0)
    graph.add("toy.maybe", "without", x=a)
    graph.add("toy.maybe", "with", x=a, y=a)
    result = graph.run(cache=toy.memory_cache())
    assert (result["without"], result["with"]) == (1.0, 2.0)


# Conversions.


@node(version=1)
def height_as_cover(height: toy.Height) -> toy.Cover:
    """Turn a height into a cover."""
    toy.counted("height_as_cover")
    return toy.Cover(np.clip(height.data, 0, 1))


@node(version=1)
def wooded(cover: toy.Cover) -> float:
    """Take a cover."""
    toy.counted("wooded")
    return float(cover.data.sum())


@node(version=1)
def bare(cover: toy.Cover, *others: toy.Cover) -> float:
    """Take covers."""
    return -float(cover.data.sum() + sum(item.data.sum() for item in others))


def converting(*, late: bool = False) -> Registry:
    registry = toy.toy_registry(wooded, bare)
    for item in (height_as_cover,):
        item.family = "local"
    families = None if late else lambda: [Family("conv", nodes=())]
    registry.add(toy.plugin("converter", families=families, conversions=lambda: [height_as_cover]))
    return registry


def test_a_conversion_is_a_step_of_its_own_and_shared() -> None:
    graph = Graph(registry=converting())
    h = graph.add("toy.height", "h", value=0.5, n=2)
    graph.add("toy.wooded", "w", cover=h)
    graph.add("toy.bare", "b", cover=h, others=[h, h])
    graph.add("toy.steepness", "s", height=h)
    cache = toy.memory_cache()
    result = graph.run(cache=cache)
    assert (result["w"], result["b"]) == (2.0, -6.0)
    assert toy.ran()["height_as_cover"] == 1
    converted = [id for id in result.nodes if "height_as_cover" in id]
    assert converted == ["h:height_as_cover"]
    assert result[converted[0]].data.max() == 0.5
    again = graph.run(cache=cache)
    assert set(toy.statuses(again).values()) == {"cached"}
    assert toy.ran() == {}


def test_a_conversion_is_remembered_between_processes(tmp_path: Path) -> None:
    for _ in range(2):
        graph = Graph(registry=converting())
        graph.add("toy.wooded", "w", cover=graph.add("toy.height", "h"))
        cache = Cache(tmp_path)
        result = graph.run(cache=cache)
        cache.close()
    assert toy.statuses(result) == {"h": "cached", "h:height_as_cover": "cached", "w": "cached"}


def test_a_plugin_of_conversions_alone_counts() -> None:
    graph = Graph(registry=converting(late=True))
    graph.add("toy.wooded", cover=graph.add("toy.height"))
    assert graph.run(cache=toy.memory_cache())["wooded"] == 9.0


def test_no_conversion_goes_backwards() -> None:
    graph = Graph(registry=converting())
    graph.add("toy.steepness", height=graph.add("toy.cover"))
    with pytest.raises(GraphError, match=r"takes a Height, but 'cover.out' gives a Cover"):
        graph.validate()


def test_a_link_that_fits_is_not_converted() -> None:
    graph = Graph(registry=converting())
    graph.add("toy.wooded", cover=graph.add("toy.cover"))
    graph.add("toy.mean", surface=graph.add("toy.height"))
    assert [id for id in graph.run(cache=toy.memory_cache()).nodes if ":" in id] == []


def test_a_conversion_into_a_generic_port() -> None:
    registry = toy.toy_registry()

    @node(version=1)
    def number_as_height(x: float) -> toy.Height:
        """Turn a number into a height."""
        return toy.Height(np.full((1, 1), x, np.float32))

    registry.add(toy.plugin("converter", conversions=lambda: [number_as_height]))
    graph = Graph(registry=registry)
    graph.add("toy.double", "d", surface=graph.add("toy.number", value=2.0))
    result = graph.run(cache=toy.memory_cache())
    assert float(result["d"].data[0, 0]) == 4.0
    graph.add("toy.steepness", height="d")
    assert graph.run(cache=toy.memory_cache())["steepness"] == 0.0


def test_a_failing_conversion_names_itself() -> None:
    @node(version=1)
    def broken_conversion(text: str) -> float:
        """Fail."""
        raise ValueError("cannot read that")

    registry = toy.toy_registry()
    registry.add(toy.plugin("converter", conversions=lambda: [broken_conversion]))
    graph = Graph(registry=registry)
    graph.add("toy.increase", "i", x=graph.add("toy.join", "j", first=graph.add("toy.number")))
    result = graph.run(cache=toy.memory_cache(), check=False)
    assert str(result.errors[0]) == "node 'j:broken_conversion' (converter.broken_conversion): cannot read that"
    assert toy.statuses(result)["i"] == "skipped"
