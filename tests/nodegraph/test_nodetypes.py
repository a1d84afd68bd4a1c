"""Declaring nodes: what a signature says, what is refused with a reason, and that a node stays a function."""

from __future__ import annotations

import enum
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import pydantic
import pytest

import nodegraph
from nodegraph import Context, InputFile, InputPath, OutputName, Param, halo, node, pointwise, whole
from nodegraph.errors import PluginError
from nodegraph.parameters import ParameterErrors
from tests.nodegraph import support as toy


class Mode(enum.Enum):
    SOFT = "soft"
    HARD = "hard"


class Corner(pydantic.BaseModel):
    x: float
    y: float = 0.0


class Several(NamedTuple):
    surface: toy.Height
    total: float
    raw: npt.NDArray[np.float32]


@node(version=3, locality=pointwise, title="A title of its own")
def everything(
    surface: toy.Height,
    weights: npt.NDArray[np.float32] | None = None,
    *others: toy.Surface,
    sigma: Annotated[float, Param("How wide.", ge=0, lt=100, unit="m")] = 60.0,
    mode: Literal["a", "b"] = "a",
    corners: Annotated[list[tuple[float, float]], Param(min_length=1, max_length=3)] = [(0.0, 0.0)],  # noqa: B006
    label: str | None = None,
    count: int,
    context: Context,
) -> Several:
    """Do everything at once.

    More about it.
    """
    context.progress(0.5)
    return Several(surface, sigma * count, surface.data)


def test_a_signature_says_everything() -> None:
    assert (everything.id, everything.version, everything.title) == ("local.everything", 3, "A title of its own")
    assert (everything.summary, everything.category) == ("Do everything at once.", "test nodetypes")
    assert everything.help.endswith("More about it.")
    assert everything.locality is pointwise
    ports = [(port.name, port.type, port.optional, port.variadic) for port in everything.inputs]
    assert ports == [
        ("surface", toy.Height, False, False),
        ("weights", np.ndarray, True, False),
        ("others", toy.Surface, False, True),
    ]
    assert [(port.name, port.type) for port in everything.outputs] == [
        ("surface", toy.Height),
        ("total", float),
        ("raw", np.ndarray),
    ]
    fields = everything.parameters.fields
    assert list(fields) == ["sigma", "mode", "corners", "label", "count"]
    assert (fields["sigma"].param.description, fields["sigma"].param.unit, fields["sigma"].default) == (
        "How wide.",
        "m",
        60.0,
    )
    assert [name for name, field in fields.items() if field.required] == ["count"]
    assert everything.context_parameter == "context"
    assert everything.input("surface") is everything.inputs[0]
    assert everything.input("sigma") is None
    assert (everything.output_index("raw"), everything.output_index("out")) == (2, None)
    assert repr(everything) == "<node local.everything v3>"
    assert toy.height.title == "Height"


def test_the_schema_of_parameters_is_json_schema() -> None:
    schema = everything.parameters.json_schema()
    assert schema["required"] == ["count"]
    sigma = schema["properties"]["sigma"]
    assert (sigma["minimum"], sigma["exclusiveMaximum"], sigma["unit"], sigma["description"], sigma["default"]) == (
        0,
        100,
        "m",
        "How wide.",
        60.0,
    )
    assert schema["properties"]["mode"]["enum"] == ["a", "b"]
    assert schema["additionalProperties"] is False


def test_a_node_stays_a_function() -> None:
    surface = toy.Height(np.ones((2, 2), np.float32))
    result = everything(surface, count=2)
    assert result.total == 120.0
    assert everything.__name__ == "everything"
    assert everything.__doc__ == everything.function.__doc__
    assert everything(surface, None, surface, sigma=1.0, count=3, context=Context("mine")).total == 3.0
    assert toy.add(1.0, 2.0) == 3.0
    with pytest.raises(TypeError):
        everything(surface)  # type: ignore[call-arg]


@node(version=1)
def throws_dice(x: float, *, seed: int = 7, other: float = 0.0, context: Context) -> float:
    """Give a number by chance."""
    return float(context.rng.random())


def test_chance_depends_on_type_and_seed_and_nothing_else() -> None:
    def value(**params: Any) -> float:
        graph = toy.toy_graph(throws_dice)
        graph.add(throws_dice, "d", x=graph.add("toy.number", value=params.pop("x", 1.0)), **params)
        return float(graph.run(cache=toy.memory_cache())["d"])

    assert value() == value(other=3.0) == value(x=2.0) == value(seed=7)
    assert value(seed=8) != value()
    assert value(seed=-1) != value(seed=1)
    assert value(seed=2**70) == value(seed=2**70)
    assert throws_dice(1.0) == value(), "a direct call has the node's own seed"
    assert throws_dice(1.0, seed=8) == value(seed=8)


def test_a_call_in_a_notebook_throws_the_dice_of_a_run() -> None:
    """Before its plugin is registered a node has no family yet: the dice must not depend on it."""
    fresh = node(version=1)(throws_dice.function)
    before = [fresh(1.0), fresh(1.0, seed=8), fresh(1.0, seed=np.int64(8))]  # type: ignore[arg-type]
    assert fresh.id == "local.throws_dice"
    graph = toy.toy_graph(fresh)
    assert fresh.family != "local"
    for id, params in (("a", {}), ("b", {"seed": 8})):
        graph.add(fresh, id, x=graph.add("toy.number", value=1.0), **params)
    result = graph.run(cache=toy.memory_cache())
    assert before == [result["a"], result["b"], result["b"]]
    assert fresh(1.0) == result["a"], "and afterwards, too"


def test_the_context_of_a_run_knows_its_node() -> None:
    seen: list[Any] = []

    @node(version=1)
    def looks(x: float, *, ctx: Context) -> float:
        """Look at its context."""
        seen.append((ctx.node, ctx.log.name, ctx.device))
        return x

    graph = toy.toy_graph(looks)
    graph.add(looks, "eyes", x=graph.add("toy.number"))
    graph.run(cache=toy.memory_cache())
    looks(1.0)
    assert seen == [("eyes", "nodegraph.node.eyes", None), ("", "nodegraph.node", None)]


# What is refused.


def unannotated(x) -> float:  # type: ignore[no-untyped-def]
    return 1.0


def no_return(x: float):  # type: ignore[no-untyped-def]
    return 1.0


def keywords(**options: float) -> float:
    return 1.0


def not_a_port(x: list[float]) -> float:
    return 1.0


def with_default(x: float = 1.0) -> float:
    return x


def half_optional(x: float | None) -> float:
    return 1.0


def union(x: float | str) -> float:
    return 1.0


def returns_list(x: float) -> list[float]:
    return [x]


def unresolved(x: "Nowhere") -> float:  # type: ignore[name-defined]  # noqa: F821, UP037
    return 1.0


class BadField(NamedTuple):
    fine: float
    wrong: list[float]


def returns_bad_tuple(x: float) -> BadField:
    raise NotImplementedError


def two_contexts(x: float, *, one: Context, two: Context) -> float:
    return 1.0


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (unannotated, "parameter 'x' needs a type annotation"),
        (no_return, "the return annotation must be a port type or a NamedTuple of them, not None"),
        (keywords, r"'\*\*options' is not allowed; name the parameters"),
        (not_a_port, r"input 'x' has type .*list.*, which is no port type \(declare it: @port_type\)"),
        (with_default, "input 'x' may have no default; make it keyword-only to be a parameter"),
        (half_optional, r"optional input 'x' must read 'Number \| None = None'"),
        (union, r"input 'x' has type float \| str, which is no port type"),
        (returns_list, "the return annotation must be a port type or a NamedTuple of them, not .*list"),
        (unresolved, r"an annotation cannot be resolved \(name 'Nowhere' is not defined\)"),
        (returns_bad_tuple, "output 'wrong' has type .*list.*, which is no port type"),
    ],
)
def test_bad_signatures_are_refused_with_a_reason(function: Callable[..., Any], message: str) -> None:
    declared = node(version=1)(function)
    with pytest.raises(PluginError, match=rf"node '{function.__name__}' \({__name__}\): {message}"):
        declared.inputs  # noqa: B018 - asking is the point
    with pytest.raises(PluginError):
        declared.parameters  # noqa: B018


T = TypeVar("T")


def test_an_unbound_type_variable_is_refused() -> None:
    @node(version=1)
    def anything(x: T) -> T:
        """Take anything at all."""
        return x

    with pytest.raises(PluginError, match="no port type"):
        anything.inputs  # noqa: B018


@pytest.mark.parametrize(
    ("annotation", "default"),
    [
        (np.ndarray, None),
        (Callable[[], int], None),
        (object, 1),
        (Annotated[str, Param(ge=0)], "x"),
        (Annotated[float, Param(min_length=1)], 1.0),
    ],
)
def test_a_parameter_that_is_no_json_is_refused_with_a_reason(annotation: Any, default: Any) -> None:
    def strange(*, p: Any = default) -> float:
        return 1.0

    strange.__annotations__["p"] = annotation
    declared = node(version=1)(strange)
    for value in (default, 5):
        found = None
        try:
            declared.parameters.check({"p": value})
        except (PluginError, ParameterErrors) as error:
            found = error
        assert found is None or "'p'" in str(found) or "a parameter" in str(found)
        assert not isinstance(found, PluginError) or "node 'strange'" in str(found)


@pytest.mark.parametrize(
    "name",
    [
        "copy",
        "json",
        "schema",
        "dict",
        "model_dump",
        "validate",
        "construct",
        "model_config",
        "model_fields",
        "class_",
        "self",
        "cls",
        "_hidden",
        "__dict__",
        "parameter_number_0",
    ],
)
def test_any_name_may_be_a_parameter(name: str) -> None:
    namespace: dict[str, Any] = {}
    exec(f"def named(x: float, *, {name}: float = 2.0) -> float:\n    'Named.'\n    return x * {name}", namespace)
    named = node(version=1)(namespace["named"])
    graph = toy.toy_graph(named)
    graph.add(named, "n", **{"x": graph.add("toy.number")})
    graph.set(f"n.{name}", 5.0)
    assert graph.run(cache=toy.memory_cache())["n"] == 5.0


@pytest.mark.parametrize(
    ("params", "messages"),
    [
        ({}, ["parameter 'count' is missing"]),
        ({"count": 1, "sigma": -1}, ["parameter 'sigma': should be greater than or equal to 0, got -1"]),
        ({"count": 1, "sigma": 100}, ["parameter 'sigma': should be less than 100, got 100"]),
        ({"count": 1, "sigma": "x"}, ["parameter 'sigma': should be a valid number, got \"x\""]),
        ({"count": 1.5}, ["parameter 'count': should be a valid integer, got .*1.5"]),
        ({"count": True}, ["parameter 'count': should be a valid integer, got true"]),
        ({"count": 1, "mode": "c"}, ["parameter 'mode': should be 'a' or 'b', got \"c\""]),
        ({"count": 1, "corners": []}, ["parameter 'corners': .*at least 1 item"]),
        (
            {"count": 1, "corners": [[0, 0], [1, "x"]]},
            [r"parameter 'corners\[1\]\[1\]': should be a valid number, got \"x\""],
        ),
        ({"count": 1, "corners": [[0, 0, 0]]}, [r"parameter 'corners\[0\]': .*at most 2 items"]),
        ({"count": 1, "sgima": 3}, ["unknown parameter 'sgima'; did you mean 'sigma'?"]),
        ({"count": None, "sigma": None, "x": 1}, ["'sigma'", "'count'", "unknown parameter 'x'"]),
        ({"count": 1, "sigma": float("nan")}, ["parameter 'sigma': should be a finite number"]),
        ({"count": 1, "sigma": float("inf")}, ["parameter 'sigma': should be a finite number"]),
        ({"count": 1, "label": object()}, ["not JSON values"]),
    ],
)
def test_wrong_parameters_are_all_said(params: dict[str, Any], messages: list[str]) -> None:
    import re

    with pytest.raises(ParameterErrors) as caught:
        everything.parameters.check(params)
    found = [message for _, message in caught.value.items]
    assert len(found) == len(messages)
    for message in messages:
        assert any(re.search(message.replace("?", r"\?"), item) for item in found), found
    assert all("\n" not in item and len(item) < 200 for item in found)


def test_parameters_arrive_as_they_are_annotated() -> None:
    seen: dict[str, Any] = {}

    @node(version=1)
    def takes(
        *,
        mode: Mode = Mode.SOFT,
        corner: Corner,
        pair: tuple[int, float] = (1, 2.0),
        path: Path = Path("x"),
        whole: float = 1,
    ) -> float:
        """Take rich parameters."""
        seen.update(mode=mode, corner=corner, pair=pair, path=path, whole=whole)
        return 1.0

    graph = toy.toy_graph(takes)
    graph.add(takes, corner={"x": 1}, mode="hard", pair=[3, 4])
    graph.run(cache=toy.memory_cache())
    assert seen == {"mode": Mode.HARD, "corner": Corner(x=1.0), "pair": (3, 4.0), "path": Path("x"), "whole": 1.0}
    assert type(seen["whole"]) is float
    assert type(seen["pair"][1]) is float


def test_non_defaults_are_what_must_be_written() -> None:
    parameters = everything.parameters
    assert parameters.non_defaults({"count": 1, "sigma": 60, "mode": "a", "label": None}) == {"count": 1}
    assert parameters.non_defaults({"count": 1, "sigma": 61}) == {"count": 1, "sigma": 61}
    assert parameters.non_defaults({"nope": 1}) == {"nope": 1}


def test_a_default_out_of_range_is_said_when_it_is_used() -> None:
    @node(version=1)
    def careless(*, p: Annotated[float, Param(ge=0)] = -1.0) -> float:
        """Have a default out of range."""
        return p

    with pytest.raises(ParameterErrors, match="parameter 'p': should be greater than or equal to 0"):
        careless.parameters.check({})
    assert careless.parameters.check({"p": 1}).values == {"p": 1.0}


# Files.


def test_files_are_marked_at_any_depth() -> None:
    @node(version=1)
    def reads(
        *,
        one: InputPath,
        many: tuple[InputPath, ...] = (),
        maybe: InputPath | None = None,
        out: OutputName = "x",
    ) -> str:
        """Read files."""
        return ",".join(path.read_text() for path in (one, *many, *([maybe] if maybe else [])))

    assert [field.name for field in reads.parameters.input_files] == ["one", "many", "maybe"]
    assert [field.name for field in reads.parameters.output_files] == ["out"]


def test_many_files_of_one_parameter_count(in_tmp: Path) -> None:
    @node(version=1)
    def reads(*, many: list[InputPath], maybe: InputPath | None = None) -> str:
        """Read files."""
        return ",".join(path.read_text() for path in (*many, *([maybe] if maybe else [])))

    for name in "abc":
        (in_tmp / name).write_text(name)
    graph = toy.toy_graph(reads)
    graph.add(reads, "r", many=["a", "b"], maybe="c")
    cache = toy.memory_cache()
    assert graph.run(cache=cache)["r"] == "a,b,c"
    assert graph.run(cache=cache, set={"r.many": ["b", "a"], "r.maybe": None})["r"] == "b,a"
    for name, expected in (("b", "a,B,c"), ("c", "a,B,C")):
        (in_tmp / name).write_text(name.upper())
        result = graph.run(cache=cache)
        assert result["r"] == expected
        assert f"{name} changed" in toy.reasons(result)["r"]


def test_sidecars_count(in_tmp: Path) -> None:
    @node(version=1)
    def reads(*, path: Annotated[Path, InputFile(sidecars=(".prj", "*.aux.xml"))]) -> str:
        """Read a file and what lies beside it."""
        beside = [path.with_suffix(".prj"), path.with_name(path.name + ".aux.xml")]
        return "+".join(item.read_text() for item in (path, *beside) if item.exists())

    graph = toy.toy_graph(reads)
    graph.add(reads, "r", path="a.tif")
    cache = toy.memory_cache()
    for name, text in (("a.tif", "t"), ("a.prj", "p"), ("a.tif.aux.xml", "x"), ("a.prj", "q"), ("b.prj", "other")):
        (in_tmp / name).write_text(text)
        expected = "+".join(
            (in_tmp / item).read_text() for item in ("a.tif", "a.prj", "a.tif.aux.xml") if (in_tmp / item).exists()
        )
        result = graph.run(cache=cache)
        assert result["r"] == expected
    assert toy.statuses(result) == {"r": "cached"}


# Locality and twins.


def test_locality_gives_cells() -> None:
    assert pointwise.cells({}, 10.0) == 0
    assert whole.cells({}, 10.0) is None
    assert halo(cells=3).cells({}, 10.0) == 3
    assert halo(cells=lambda radius, **_: radius).cells({"radius": 5}, 10.0) == 5
    metres = halo(metres=lambda sigma, **_: 4 * sigma)
    assert metres.cells({"sigma": 60.0}, 30.0) == 8
    assert metres.cells({"sigma": 60.0}, 31.0) == 8
    assert metres.cells({"sigma": 60.0}, 29.0) == 9
    for options in ({}, {"cells": 1, "metres": lambda **_: 1.0}):
        with pytest.raises(PluginError, match="halo: give either cells or metres"):
            halo(**options)


def test_a_twin_must_take_the_same_parameters() -> None:
    @node(version=1)
    def host(x: float, *, p: float = 1.0) -> float:
        """Be the host."""
        return x * p

    @host.opencl(rtol=1e-4)
    def twin(x: float, *, p: float, context: Context) -> float:
        return x * p

    assert host.twin is not None
    assert (host.twin.function, host.twin.rtol) == (twin, 1e-4)
    with pytest.raises(PluginError, match="its OpenCL twin must take the same parameters"):

        @host.opencl()
        def other(x: float, *, q: float) -> float:
            return x


# Odd functions.


def test_a_cached_or_partial_function_is_a_node() -> None:
    calls: list[float] = []

    @node(version=1)
    @functools.lru_cache
    def remembers(x: float) -> float:
        """Be wrapped in C."""
        calls.append(x)
        return x + 1

    graph = toy.toy_graph(remembers)
    graph.add(remembers, "r", x=graph.add("toy.number"))
    assert graph.run(cache=toy.memory_cache())["r"] == 2.0


def test_the_public_names_are_there() -> None:
    for name in nodegraph.__all__:
        assert getattr(nodegraph, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nope'"):
        nodegraph.nope  # noqa: B018
    assert set(nodegraph.__all__) <= set(dir(nodegraph))


def test_importing_the_package_loads_almost_nothing() -> None:
    code = """
        import sys
        import nodegraph
        heavy = {"numpy", "pydantic", "h5py", "networkx", "pyopencl", "scipy", "rasterio", "matplotlib", "rich"}
        print(sorted(heavy & set(sys.modules)))
        from nodegraph import Graph
        print(sorted((heavy - {"numpy", "pydantic"}) & set(sys.modules)))
    """
    assert toy.python(code).splitlines() == ["[]", "[]"]
