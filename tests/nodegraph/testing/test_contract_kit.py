"""The contract kit: a node that breaks one promise fails exactly that check, in words; good nodes pass them all."""

from __future__ import annotations

import enum
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
import pydantic
import pytest

from nodegraph import Context, File, InputPath, Node, OutputName, Param, halo, node, pointwise, port_type, whole
from nodegraph.testing import CHECKS, Example, NotCheckedError, check_node, checks_for
from tests.nodegraph import support

# Port types and values.


@port_type
class KitGrid:
    """A toy raster on cells of `step` metres."""

    data: np.ndarray
    step: float = 10.0

    @property
    def shape(self) -> tuple[int, int]:
        return int(self.data.shape[0]), int(self.data.shape[1])

    @property
    def cell_size(self) -> tuple[float, float]:
        return self.step, self.step

    def window(self, rows: slice, cols: slice) -> KitGrid:
        return type(self)(self.data[rows, cols], self.step)


@port_type
class KitHeight(KitGrid):
    """A toy raster in metres."""


@port_type
class KitBare:
    number: float


@port_type
class KitBag:
    """Holds what it is given."""

    items: Any


G = TypeVar("G", bound=KitGrid)
GRID = KitGrid(np.random.default_rng(3).random((13, 17), np.float32))
ARRAY = np.arange(6.0)
COUNTER = itertools.count()


def blurred(data: np.ndarray, reach: int) -> np.ndarray:
    """The mean over a square of 2 reach + 1 cells; beyond the border, the border repeats."""
    rows, cols = data.shape
    wide = np.pad(data.astype(np.float64), reach, mode="edge")
    side = range(2 * reach + 1)
    return (sum(wide[i : i + rows, j : j + cols] for i in side for j in side) / len(side) ** 2).astype(np.float32)


def failing(declared: Node[..., Any], *examples: Example) -> dict[str, str]:
    """Run every check and return the messages of those that fail, by name."""
    return outcomes(declared, *examples)[0]


def outcomes(declared: Node[..., Any], *examples: Example) -> tuple[dict[str, str], dict[str, str]]:
    """Run every check and return the messages of those that fail and of those that have no say, by name."""
    failed, unchecked = {}, {}
    for name, check in checks_for(declared, examples):
        try:
            check()
        except NotCheckedError as error:
            unchecked[name] = str(error)
        except AssertionError as error:
            failed[name] = str(error)
    return failed, unchecked


def assert_fails_only(check: str, message: str, declared: Node[..., Any], *examples: Example) -> None:
    failed = failing(declared, *examples)
    assert list(failed) == [check], failed
    assert failed[check].startswith(f"{declared.id}: "), failed[check]
    assert message in failed[check]
    with pytest.raises(AssertionError, match=f"^{declared.id}: "):
        check_node(declared, examples)


# Broken nodes: (check, part of the message, node, examples).

Broken = tuple[str, str, Node[..., Any], tuple[Example, ...]]
BROKEN: list[Broken] = []


def broken(check: str, message: str, *examples: Example) -> Callable[[Node[..., Any]], Node[..., Any]]:
    def note(declared: Node[..., Any]) -> Node[..., Any]:
        declared.family = "broken"
        BROKEN.append((check, message, declared, examples))
        return declared

    return note


ON_ARRAY, ON_GRID = Example({"values": ARRAY}), Example({"grid": GRID})


@broken("documented", "the docstring must start with a sentence", ON_ARRAY)
@node(version=1)
def undocumented(values: np.ndarray) -> np.ndarray:
    return values + 1


@broken("documented", "the docstring must start with a sentence", ON_ARRAY)
@node(version=1)
def mumbling(values: np.ndarray) -> np.ndarray:
    """Something with
    numbers."""
    return values + 1


@broken("documented", "parameter 'factor' needs Param('one line of meaning')", ON_ARRAY)
@node(version=1)
def unexplained(values: np.ndarray, *, factor: float = 2.0) -> np.ndarray:
    """Multiply."""
    return values * factor


@broken("documented", "the meaning of parameter 'factor' must be one line", ON_ARRAY)
@node(version=1)
def rambling(values: np.ndarray, *, factor: Annotated[float, Param("One line.\nAnd another.")] = 2.0) -> np.ndarray:
    """Multiply."""
    return values * factor


@broken("documented", "the type of port 'out' has no docstring", Example())
@node(version=1)
def bare() -> KitBare:
    """Give a value of a type that nobody explained."""
    return KitBare(1.0)


@broken("examples_fit", "give at least one Example")
@node(version=1)
def forgotten(values: np.ndarray) -> np.ndarray:
    """Add one."""
    return values + 1


@broken("examples_fit", "an Example names inputs that do not exist: value", Example({"value": ARRAY}))
@node(version=1)
def misspelt(values: np.ndarray) -> np.ndarray:
    """Add one."""
    return values + 1


@broken("examples_fit", "an Example must give the input 'values'", Example())
@node(version=1)
def starved(values: np.ndarray) -> np.ndarray:
    """Add one."""
    return values + 1


@broken("examples_fit", "an Example's input 'values': expected Array, got KitGrid", Example({"values": GRID}))
@node(version=1)
def misfed(values: np.ndarray) -> np.ndarray:
    """Add one."""
    return values + 1


@broken("examples_fit", "an Example's input 'values': a value may not hold a", Example({"values": np.array([None])}))
@node(version=1)
def poisoned(values: np.ndarray) -> np.ndarray:
    """Add one."""
    return values + 1


@broken("examples_fit", "unknown parameter 'facter'; did you mean 'factor'?", Example({}, {"facter": 2}))
@broken("examples_fit", "parameter 'factor' is missing", Example())
@node(version=1)
def demanding(*, factor: Annotated[float, Param("What it gives.")]) -> float:
    """Give a number."""
    return factor


@broken("parameters_sound", "a default is not valid", Example())
@node(version=1)
def out_of_range(*, factor: Annotated[float, Param("What it gives.", ge=0)] = -1.0) -> float:
    """Give a number."""
    return factor


@broken("parameters_sound", "do not survive a round trip", Example())
@node(version=1)
def doubling(*, factor: Annotated[float, pydantic.AfterValidator(lambda v: v * 2), Param("To double.")] = 1.0) -> float:
    """Give a number that grows whenever it is checked."""
    return factor


@broken("parameters_sound", "no JSON Schema can be made", Example(), Example({}, {"factor": 2}))
@node(version=1)
def unspeakable(
    *,
    factor: Annotated[
        Any, pydantic.PlainValidator(float), Param("Something."), pydantic.WithJsonSchema({"x": {1}})
    ] = 1,
) -> float:
    """Give a number whose schema is no JSON."""
    return float(factor)


@broken("keys_tell_apart", "parameter 'hidden' is not in the key", Example())
@node(version=1)
def vanishing(*, hidden: Annotated[float, pydantic.Field(exclude=True), Param("It matters.")] = 1.0) -> float:
    """Give a number that leaves no trace."""
    return hidden


@broken("keys_tell_apart", "parameter 'blurred' is not in the key", Example())
@node(version=1)
def collapsing(
    *, blurred: Annotated[float, pydantic.PlainSerializer(lambda _: 0.0), Param("It matters.")] = 1.0
) -> float:
    """Give a number that is written as zero."""
    return blurred


@broken("keys_tell_apart", "no second valid value of 'code' found; give Examples with two", Example())
@node(version=1)
def narrow(*, code: Annotated[str, pydantic.Field(pattern="^[A-Z]{3}$"), Param("Three letters.")] = "ABC") -> str:
    """Give a code."""
    return code


@broken("outputs_conform", "output 'out': expected Number, got Text", Example())
@node(version=1)
def liar() -> float:
    """Promise a number and give a text."""
    return "three"  # type: ignore[return-value]


@broken("outputs_conform", "it fails on an Example: no luck", ON_ARRAY)
@node(version=1)
def unlucky(values: np.ndarray) -> np.ndarray:
    """Raise."""
    raise ValueError("no luck")


@broken("outputs_conform", "it fails on an Example: AssertionError", ON_ARRAY)
@node(version=1)
def asserting(values: np.ndarray) -> np.ndarray:
    """Raise what a check would raise."""
    assert values is None
    return values


@broken("inputs_unmutated", "it changes its input 'values'; copy it first", ON_ARRAY)
@node(version=1)
def vandal(values: np.ndarray) -> np.ndarray:
    """Add one in place."""
    values += 1
    return values


@broken("inputs_unmutated", "it changes its input 'grid'; copy it first", ON_GRID)
@node(version=1, locality=pointwise)
def burglar(grid: KitGrid) -> KitGrid:
    """Add one in place, opening the lock first."""
    grid.data.flags.writeable = True
    grid.data[0, 0] += 0.5
    grid.data[0, 0] -= 0.25
    return KitGrid(np.ones_like(grid.data), grid.step)


@broken("inputs_unmutated", "it needs arrays that it can write to; those on wires are read-only", ON_ARRAY)
@node(version=1)
def fussy(values: np.ndarray) -> np.ndarray:
    """Refuse what it cannot write to, as compiled code does that was built without const."""
    if not values.flags.writeable:
        raise ValueError("buffer source array is read-only")
    return values + 1


@broken("deterministic", "the same call gave two different values", ON_ARRAY)
@node(version=1)
def moody(values: np.ndarray) -> np.ndarray:
    """Count its calls."""
    return values + next(COUNTER)


@broken("deterministic", "the same call gave two different values", ON_GRID)
@node(version=1, locality=pointwise)
def moody_grid(grid: KitGrid) -> KitGrid:
    """Count its calls into a raster."""
    return KitGrid(grid.data + np.float32(next(COUNTER)), grid.step)


@broken("values_encode", "an output cannot be stored: a value may not hold a list", Example())
@node(version=1)
def listing() -> KitBag:
    """Give a list."""
    return KitBag([1, 2])


@broken("values_encode", "an output cannot be stored: a value may not hold a array of dtype object", Example())
@node(version=1)
def objects() -> np.ndarray:
    """Give Python objects."""
    return np.array([None, 1], object)


@broken("locality_holds", "a raster node declares its locality (pointwise, halo or whole)", ON_GRID)
@node(version=1)
def placeless(grid: KitGrid) -> KitGrid:
    """Double a raster."""
    return KitGrid(grid.data * 2, grid.step)


@broken("locality_holds", "it is declared 'pointwise', but a crop by itself differs from the whole", ON_GRID)
@node(version=1, locality=pointwise)
def nosy(grid: KitGrid) -> KitGrid:
    """Claim to look at the cell alone."""
    return KitGrid(blurred(grid.data, 1), grid.step)


@broken("locality_holds", "a crop by itself differs from the whole", ON_GRID)
@node(version=1, locality=pointwise)
def comparing(grid: KitGrid) -> KitGrid:
    """Divide by the largest value of all."""
    return KitGrid(grid.data / grid.data.max(), grid.step)


@broken("locality_holds", "it is declared 'halo', but a crop with a halo of 1 cells differs", ON_GRID)
@node(version=1, locality=halo(cells=1))
def short_sighted(grid: KitGrid) -> KitGrid:
    """Look two cells far and declare one."""
    return KitGrid(blurred(grid.data, 2), grid.step)


@broken("locality_holds", "a crop with a halo of 2 cells differs", Example({"grid": GRID}, {"radius": 15.0}))
@node(version=1, locality=halo(metres=lambda radius: radius))
def confused_units(grid: KitGrid, *, radius: Annotated[float, Param("How far.", unit="m")] = 10.0) -> KitGrid:
    """Look three cells far where the metres say two."""
    return KitGrid(blurred(grid.data, 3), grid.step)


@broken("locality_holds", "a node whose output has another shape than its inputs has the locality 'whole'", ON_GRID)
@node(version=1, locality=pointwise)
def halving(grid: KitGrid) -> KitGrid:
    """Take every other cell."""
    return KitGrid(grid.data[::2, ::2], grid.step * 2)


@broken("locality_holds", "no Example shows the locality: give a raster that is larger than the halo", ON_GRID)
@node(version=1, locality=halo(cells=40))
def unshown(grid: KitGrid) -> KitGrid:
    """Look farther than any example is wide."""
    return KitGrid(blurred(grid.data, 1), grid.step)


@broken("locality_holds", "it fails on an Example: too small", ON_GRID)
@node(version=1, locality=halo(cells=1))
def picky(grid: KitGrid) -> KitGrid:
    """Refuse small rasters."""
    if min(grid.shape) < 5:
        raise ValueError("too small")
    return KitGrid(blurred(grid.data, 1), grid.step)


@pytest.mark.parametrize(
    ("check", "message", "declared", "examples"), [pytest.param(*item, id=item[2].name) for item in BROKEN]
)
def test_a_broken_node_fails_exactly_one_check(
    check: str, message: str, declared: Node[..., Any], examples: tuple[Example, ...]
) -> None:
    assert_fails_only(check, message, declared, *examples)


# Broken twins.


@pytest.fixture
def _device() -> None:
    from nodegraph.opencl import choose

    if choose("auto") is None:
        pytest.skip("no OpenCL device")


def twinned(function: Callable[..., Any], **tolerance: float) -> Node[..., Any]:
    """Return a node that doubles a raster, with a twin."""

    @node(version=1, locality=pointwise)
    def double(grid: KitGrid) -> KitGrid:
        """Double a raster."""
        return type(grid)(grid.data * 2, grid.step)

    double.opencl(**tolerance)(function)
    double.family = "broken"
    return double


def faithful(grid: KitGrid) -> KitGrid:
    return type(grid)(grid.data * 2, grid.step)


def off_by_a_little(grid: KitGrid) -> KitGrid:
    return type(grid)(grid.data * 2 + np.float32(0.01), grid.step)


def of_another_type(grid: KitGrid) -> KitGrid:
    return KitHeight(grid.data * 2, grid.step)


def of_another_shape(grid: KitGrid) -> KitGrid:
    return type(grid)((grid.data * 2)[:5], grid.step)


def of_another_dtype(grid: KitGrid) -> KitGrid:
    return type(grid)((grid.data * 2).astype(np.float64), grid.step)


def of_another_scalar(grid: KitGrid) -> KitGrid:
    return type(grid)(grid.data * 2, grid.step * 2)


def impossible(grid: KitGrid) -> KitGrid:
    raise ValueError("no such kernel")


def in_place(grid: KitGrid) -> KitGrid:
    twice = grid.data * 2
    grid.data[0] = twice[1]
    return type(grid)(twice, grid.step)


def of_the_moment(grid: KitGrid) -> KitGrid:
    return type(grid)(grid.data * 2 + np.float32(1e-4 * next(COUNTER)), grid.step)


TWINS = [
    (off_by_a_little, "the twin's 'out' differs from the host's (by 0.01"),
    (of_another_type, "the twin's 'out' has another type, KitHeight"),
    (of_another_shape, "the twin's 'out' differs from the host's (shape (5, 17) is not (13, 17))"),
    (of_another_dtype, "the twin's 'out' differs from the host's (dtype float64 is not float32)"),
    (of_another_scalar, "the twin's 'out' differs from the host's (by 10"),
    (impossible, "its OpenCL twin fails on an Example: no such kernel"),
    (in_place, "the twin changes its input 'grid'; write to an array of its own"),
    (of_the_moment, "the twin gave two different values for the same call"),
]


@pytest.mark.usefixtures("_device")
@pytest.mark.parametrize(("twin", "message"), [pytest.param(*item, id=item[0].__name__) for item in TWINS])
def test_a_broken_twin_fails_exactly_one_check(twin: Callable[..., Any], message: str) -> None:
    assert_fails_only("twin_agrees", message, twinned(twin, rtol=1e-5), ON_GRID)


@pytest.mark.usefixtures("_device")
def test_a_twin_may_differ_by_what_it_declares() -> None:
    check_node(twinned(faithful), [ON_GRID])
    check_node(twinned(off_by_a_little, atol=0.011), [ON_GRID])


def test_a_twin_without_a_device_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nodegraph.opencl.choose", lambda name: None, raising=False)
    assert_fails_only("twin_agrees", "install pyopencl[pocl]", twinned(faithful), ON_GRID)


# Good nodes.


class Parts(NamedTuple):
    """Two outputs."""

    low: KitGrid
    total: float


class Rule(enum.Enum):
    """How to combine."""

    SUM = "sum"
    MEAN = "mean"


@node(version=1, locality=pointwise)
def good_mix(
    first: KitGrid, second: KitGrid | None = None, *others: KitGrid, rule: Annotated[Rule, Param("How.")] = Rule.SUM
) -> KitGrid:
    """Combine rasters."""
    stack = [grid.data for grid in (first, second, *others) if grid is not None]
    total = np.sum(stack, axis=0, dtype=np.float32)
    return KitGrid(total if rule is Rule.SUM else total / np.float32(len(stack)), first.step)


@node(version=1, locality=halo(metres=lambda radius, **_: radius))
def good_blur(
    grid: G,
    *,
    radius: Annotated[float, Param("How far.", ge=0, unit="m")] = 10.0,
    context: Context,
) -> G:
    """Take the mean around each cell."""
    context.progress(0.5)
    return type(grid)(blurred(grid.data, int(radius // grid.step)), grid.step)


@node(version=1, locality=whole)
def good_split(grid: KitGrid, *, share: Annotated[float, Param("Where to cut.", ge=0, le=1)] = 0.5) -> Parts:
    """Split at a quantile."""
    return Parts(KitGrid(np.minimum(grid.data, np.quantile(grid.data, share)), grid.step), float(grid.data.sum()))


@node(version=1)
def good_dice(
    *,
    seed: Annotated[int, Param("Which dice.", ge=0)] = 7,
    sizes: Annotated[list[int], Param("How many each.")] = [3],  # noqa: B006 - a default is copied before it is used
    kind: Annotated[Literal["normal", "uniform"], Param("Which law.")] = "normal",
    context: Context,
) -> np.ndarray:
    """Throw dice."""
    draw = context.rng.standard_normal if kind == "normal" else context.rng.random
    return np.concatenate([draw(size) for size in sizes]) if sizes else np.zeros(0)


@node(version=1)
def good_reader(
    *,
    path: Annotated[InputPath, Param("What to read.")],
    mark: Annotated[str | None, Param("What to append.")] = None,
) -> str:
    """Read a text."""
    return path.read_text() + (mark or "")


@node(version=1)
def good_export(grid: KitGrid, *, name: Annotated[OutputName, Param("Under which name.")] = "grid.bin") -> File:
    """Write the cells."""
    return File.of(name, grid.data.tobytes(), File.of(f"{name}.txt", b"cells"))


@node(version=1, locality=whole)
def good_voids(grid: KitGrid, *, level: Annotated[float, Param("Below it is void.")] = 0.5) -> KitGrid:
    """Make voids, infinities and an empty text of numbers."""
    data = np.where(grid.data < level, np.nan, grid.data).astype(np.float32)
    data[0, 0] = np.inf
    return KitGrid(data, grid.step)


GOOD = [
    (good_mix, [Example({"first": GRID, "others": [GRID, GRID]}), Example({"first": GRID, "second": GRID})]),
    (good_blur, [ON_GRID, Example({"grid": KitHeight(GRID.data, 5.0)}, {"radius": 12.0})]),
    (good_split, [ON_GRID]),
    (good_dice, [Example(), Example({}, {"seed": 5, "sizes": [2, 3]}), Example({}, {"sizes": []})]),
    (good_export, [ON_GRID]),
    (good_voids, [ON_GRID]),
]


@pytest.mark.parametrize(("declared", "examples"), [pytest.param(*item, id=item[0].name) for item in GOOD])
def test_a_good_node_passes_every_check(declared: Node[..., Any], examples: list[Example]) -> None:
    assert failing(declared, *examples) == {}
    check_node(declared, examples)


def test_a_node_that_reads_a_file_passes(tmp_path: Path) -> None:
    path = tmp_path / "some.txt"
    path.write_text("text")
    check_node(good_reader, [Example({}, {"path": str(path)})])


# The kit itself.


def test_every_check_is_shown_broken() -> None:
    assert {check.__name__ for check in CHECKS} == {item[0] for item in BROKEN} | {"twin_agrees"}


def test_examples_are_the_same_after_the_checks() -> None:
    failing(vandal, ON_ARRAY)
    failing(burglar, ON_GRID)
    assert np.array_equal(ARRAY, np.arange(6.0))
    assert np.array_equal(GRID.data, np.random.default_rng(3).random((13, 17), np.float32))


def test_a_check_without_a_say_tells_why() -> None:
    _, unchecked = outcomes(liar, Example())
    assert set(unchecked) == {"inputs_unmutated", "deterministic", "values_encode"}
    assert unchecked["deterministic"].endswith("(the check 'outputs_conform' fails)")


def test_a_failure_that_comes_and_goes_fails() -> None:
    # The check whose matter it is saw nothing; then the one that came across it must not be skipped.
    calls = itertools.count()

    @node(version=1)
    def flaky(values: np.ndarray) -> np.ndarray:
        """Fail once, at the third call."""
        if next(calls) == 2:
            raise ValueError("this time")
        return values + 1

    failed = failing(flaky, ON_ARRAY)
    assert list(failed) == ["inputs_unmutated"]
    assert "this time" in failed["inputs_unmutated"]


def test_without_twins_pyopencl_is_not_loaded() -> None:
    support.python(
        """
        import sys
        import numpy as np
        from nodegraph import node
        from nodegraph.testing import Example, check_node

        @node(version=1)
        def more(values: np.ndarray) -> np.ndarray:
            '''Add one.'''
            return values + 1

        check_node(more, [Example({"values": np.zeros(3)})])
        assert "pyopencl" not in sys.modules
        assert "pytest" not in sys.modules
        """
    )
