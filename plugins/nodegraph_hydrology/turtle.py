"""The turtle: reads a string of symbols as movements, all modules of one bracket depth at a time.

The state is a position and a heading.  Movements within one bracket are cumulative sums from the state at its ``[``,
which belongs to the depth above: reading a string takes as many array operations as it is deep.

Reference: P. Prusinkiewicz, A. Lindenmayer (1990): The algorithmic beauty of plants, sections 1.3 and 1.6.
doi:10.1007/978-1-4613-8476-2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nodegraph_hydrology.lsystem_rules import LString

OPEN, CLOSE, CLOCKWISE, COUNTER, AROUND, MOVE = (ord(symbol) for symbol in "[]+-|f")

Index = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Structure:
    """How a string is nested.

    Attributes:
        depth: (n,) how many brackets are open around each module; a bracket counts as inside of itself.
        opening: (n,) the ``[`` of the innermost bracket around each module, -1 outside of all; its own for a bracket.
        levels: for each depth its modules in order, with the ``[`` of the depth below among them.
    """

    depth: Index
    opening: Index
    levels: list[Index]


def structure(string: LString) -> Structure:
    """Return how the brackets of a string nest."""
    opens, closes = string.codes == OPEN, string.codes == CLOSE
    depth = np.cumsum(opens.astype(np.int64)) - np.cumsum(closes) + closes
    order = np.argsort(depth, kind="stable")
    # Within one depth every bracket begins with its '[': the last one so far is the one around.
    rank = np.maximum.accumulate(np.where(opens[order], np.arange(len(order)), -1))
    opening = np.full(len(order), -1, np.int64)
    inside = depth[order] > 0
    opening[order[inside]] = order[rank[inside]]
    levels = [
        np.flatnonzero((depth == level) & ~closes | (depth == level + 1) & opens)
        for level in range(int(depth.max(initial=-1)) + 1)
    ]
    return Structure(depth, opening, levels)


def group_of(nested: Structure, places: Index, level: int) -> Index:
    """Return for modules of a level the ``[`` that starts their bracket, in numbers that rise with `places`."""
    own = nested.depth[places] == level
    found = np.where(own, nested.opening[places], -1)
    # A '[' of the depth below stands in the bracket of what comes before it, and that begins with its '['.
    return np.maximum.accumulate(found)


def predecessors(string: LString, nested: Structure, drawn: npt.NDArray[np.bool_]) -> Index:
    """Return for each module the last drawn one before it on the way from the start, -1 without one."""
    last = np.full(len(string), -1, np.int64)
    before = np.full(len(string), -1, np.int64)
    for level, places in enumerate(nested.levels):
        group = group_of(nested, places, level)
        marks = np.where(drawn[places] & (nested.depth[places] == level), places, -1)
        sofar = np.maximum.accumulate(marks)
        # Drawn before this bracket began: not of this bracket, whose base is what its '[' saved.
        base = np.where(group >= 0, last[group], -1)
        last[places] = np.where(sofar > group, sofar, base)
        shifted = np.concatenate([[-1], sofar[:-1]])
        before[places] = np.where(shifted > group, shifted, base)
    return before


@dataclass(frozen=True)
class Track:
    """Where the turtle goes: the state after each module, (n, 2) positions and (n,) headings, radians from east."""

    position: Floats
    heading: Floats


def walk(
    string: LString,
    nested: Structure,
    *,
    drawn: npt.NDArray[np.bool_],
    start: tuple[float, float],
    heading: float,
    angle: float,
    step: float,
) -> Track:
    """Return the turtle's state after each module; angles in radians, ``+`` turns clockwise."""
    first = string.values[:, 0]
    turns = np.where(np.isnan(first), angle, np.radians(np.nan_to_num(first)))
    signs = (string.codes == COUNTER).astype(np.float64) - (string.codes == CLOCKWISE)
    turns = np.where(string.codes == AROUND, np.pi, signs * turns)
    moves = np.where(drawn | (string.codes == MOVE), np.where(np.isnan(first), step, first), 0.0)
    position, facing = np.empty((len(string), 2)), np.empty(len(string))
    for level, places in enumerate(nested.levels):
        group = group_of(nested, places, level)
        own = nested.depth[places] == level
        begins = own & (group == places)
        inside = group >= 0
        base_heading = np.where(inside, facing[group], heading)
        facing[places] = base_heading + _summed(np.where(own, turns[places], 0), begins)
        legs = np.where(own, moves[places], 0)[:, None] * _directions(facing[places])
        base = np.where(inside[:, None], position[group], start)
        position[places] = base + _summed(legs, begins)
    return Track(position, facing)


def _directions(heading: Floats) -> Floats:
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def _summed(values: Floats, begins: npt.NDArray[np.bool_]) -> Floats:
    """Return cumulative sums that start anew at each beginning, whose own value counts nothing."""
    total = np.cumsum(values, axis=0)
    started = np.maximum.accumulate(np.where(begins, np.arange(len(begins)), -1))
    base = np.where((started >= 0).reshape(-1, *(1,) * (values.ndim - 1)), total[started], 0.0)
    return total - base
