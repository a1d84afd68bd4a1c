"""What a blend of patches can be over a piece of ground: never exceeded, and close enough to trace rays by.

Between four neighbouring centres, a *square* of the grid, only their patches F_i count: f = sum_i w_i F_i, with shares
w_i = alpha_i / sum alpha that depend on the place in the square alone.  As the shares add up to 1, for any one of the
patches, F_0,

    |f - F_0| <= sum_i w_i |F_i - F_0|,  min_i F_i <= f <= max_i F_i,
    |grad f| <= |grad F_0| + sum_i w_i (|grad F_i| - |grad F_0|) + sum_i |grad w_i| |F_i - F_0|.

The samples of neighbouring patches lie on each other, so that F_i - F_0 is interpolated from samples like F_i itself.
F_0 is the patch whose centre is nearest; where patches agree, its own range is that of f.

All this is done in the cells between four samples.  Ranges of interpolants come from their Bernstein form as in
`nodegraph_tree.pixels`, those of derivatives after one subdivision; those of w_i and |grad w_i| are the same in all
squares with the same neighbours, and are measured once on a dense grid, to which is added what may lie between its
points.  Cells are joined to blocks of about `BLOCK` by `BLOCK`, for `CHUNK` by `CHUNK` squares at a time, when first
asked for, and kept: 12 bytes a block.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import ceil, floor
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_tree.from_elevation import Interpolation
from nodegraph_tree.pixels import LEVEL, Range

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

BLOCK = 4
"""Samples along the side of a block, about."""

CHUNK = 16
"""Squares whose ranges are computed at a time, along a side; fewer of large patches."""

DENSE = 256
"""Places along the side of a square where shares are measured, at least."""

BENT = 16.0
"""More than the greatest second derivative of a share, per squared radius: 13.4 beside a border, 10.9 elsewhere."""


class Shares(NamedTuple):
    """How patches take part in the cells of a square: `radius` + 1 along a side, of the outer ones a half.

    The first two axes say which neighbours there are along y and x: 0 both, 1 the second alone (before the first
    centre), 2 the first alone; the next two which of them; the last two which cell: (3, 3, 2, 2, cells, cells).

    Attributes:
        most: the greatest w.
        turn: the greatest |grad w|, per radius.
    """

    most: Floats
    turn: Floats


class BlendRanges:
    """Ranges of heights and slopes over any part of a blend.

    Args:
        shape: rows and columns of patches.
        radius: samples in R.
        kind: of interpolation.
        patches: called with rows and columns of patches, returns a new array of their samples with two more on every
            side, (rows, columns, 2 radius + 4, 2 radius + 4).
    """

    def __init__(
        self, shape: tuple[int, int], radius: int, kind: Interpolation, patches: Callable[[Indices, Indices], Floats]
    ) -> None:
        self.shape, self.radius, self.kind, self._patches = shape, radius, kind, patches
        self.blocks = ceil(radius / BLOCK)
        self.edges = tuple([round(radius * k / self.blocks) for k in range(self.blocks + 1)])
        self._chunk = max(1, min(CHUNK, 256 // radius))
        self._known: dict[tuple[int, int], tuple[npt.NDArray[np.float32], Range]] = {}

    def over(self, west: float, east: float, north: float, south: float) -> Range:
        """Return the range over a box, in radii east and south of the first centre; the slope is per radius.

        O(blocks) at its border, and O(chunks) inside; what was not asked before is computed first.
        """
        top, bottom = self._block(north - 1e-6, 0), self._block(south + 1e-6, 0)
        left, right = self._block(west - 1e-6, 1), self._block(east + 1e-6, 1)
        side = self._chunk * self.blocks
        low, high, slope = np.inf, -np.inf, 0.0
        for i in range(top // side, bottom // side + 1):
            rows = slice(max(top - i * side, 0), min(bottom - i * side + 1, side))
            for j in range(left // side, right // side + 1):
                cols = slice(max(left - j * side, 0), min(right - j * side + 1, side))
                table, found = self._at(i, j)
                if rows.stop - rows.start < table.shape[1] or cols.stop - cols.start < table.shape[2]:
                    part = table[:, rows, cols]
                    found = Range(float(part[0].min()), float(part[1].max()), float(part[2].max()))
                low, high, slope = min(low, found.low), max(high, found.high), max(slope, found.slope)
        return Range(low, high, slope)

    def _block(self, place: float, axis: int) -> int:
        """Return the number of the block at a place along an axis; squares begin before the first centre."""
        square = min(max(floor(place), -1), self.shape[axis] - 1)
        inside = int(np.searchsorted(self.edges, (place - square) * self.radius, side="right")) - 1
        return (square + 1) * self.blocks + min(max(inside, 0), self.blocks - 1)

    def _at(self, i: int, j: int) -> tuple[npt.NDArray[np.float32], Range]:
        """Return least and greatest height and slope of the blocks of a chunk, (3, rows, columns), and of all."""
        if (i, j) not in self._known:
            table = self._computed(i, j)
            whole = Range(float(table[0].min()), float(table[1].max()), float(table[2].max()))
            self._known[i, j] = table, whole
        return self._known[i, j]

    def _computed(self, i: int, j: int) -> npt.NDArray[np.float32]:
        squares = [
            np.arange(k * self._chunk, min((k + 1) * self._chunk, count + 1)) - 1
            for k, count in zip((i, j), self.shape, strict=True)
        ]
        around = [
            np.clip(np.append(item, item[-1] + 1), 0, count - 1)
            for item, count in zip(squares, self.shape, strict=True)
        ]
        samples = self._patches(around[0], around[1])
        # Where there is no patch its neighbour's stands for it, so that they do not differ.
        turned = samples.transpose(1, 0, 3, 2)
        for item, count, patch in zip(squares, self.shape, (samples, turned), strict=True):
            if item[0] < 0:
                patch[0, :, self.radius :] = patch[0, :, : -self.radius].copy()
            if item[-1] == count - 1:
                patch[-1, :, : -self.radius] = patch[-1, :, self.radius :].copy()
        there = [
            np.where(item < 0, 1, 2 * (item == count - 1)) for item, count in zip(squares, self.shape, strict=True)
        ]
        # (2, 2, rows, columns, cells, cells)
        most, turn = (np.moveaxis(item[there[0][:, None], there[1]], (2, 3), (0, 1)) for item in shares(self.radius))
        rows, cols, cells = len(squares[0]), len(squares[1]), self.radius + 1
        found = np.empty((3, rows, cols, cells, cells))
        halves = (slice(0, self.radius // 2 + 1), slice(self.radius // 2 + 1, cells))
        for south, down in enumerate(halves):
            for east, across in enumerate(halves):
                place = (..., down, across)
                found[place] = self._part(samples, (south, east), (down, across), Shares(most[place], turn[place]))
        low, high, slope = (
            _blocks(join, item, self.edges).transpose(0, 2, 1, 3).reshape(rows * self.blocks, cols * self.blocks)
            for join, item in zip((np.minimum, np.maximum, np.maximum), found, strict=True)
        )
        outward = (-np.inf, np.inf, np.inf)
        return np.stack(
            [
                np.nextafter(item.astype(np.float32), np.float32(limit))
                for item, limit in zip((low, high, slope), outward, strict=True)
            ]
        )

    def _part(
        self, samples: Floats, nearest: tuple[int, int], cells: tuple[slice, slice], shares: Shares
    ) -> tuple[Floats, Floats, Floats]:
        """Return low, high and slope per radius in the cells nearest to one of the centres, (rows, columns, y, x)."""
        rows, cols = shares.most.shape[2:4]
        nets = {}
        for south in (0, 1):
            for east in (0, 1):
                y, x = (
                    slice(item.start + (1 - side) * self.radius, item.stop + 3 + (1 - side) * self.radius)
                    for item, side in zip(cells, (south, east), strict=True)
                )
                nets[south, east] = _controls(self.kind, samples[south : south + rows, east : east + cols, y, x])
        own = nets.pop(nearest)
        low, high = _joined(np.minimum, own), _joined(np.maximum, own)
        lowest, highest = low.copy(), high.copy()
        steep = _steepest(self.kind, own)
        slope, away = steep * self.radius, np.zeros(steep.shape)
        for place, net in nets.items():
            apart = np.zeros(steep.shape)
            for line, base in zip(net, own, strict=True):
                for a, b in zip(line, base, strict=True):
                    np.maximum(apart, np.abs(a - b), out=apart)
            here = shares.most[place] > 0
            np.minimum(lowest, _joined(np.minimum, net), out=lowest, where=here)
            np.maximum(highest, _joined(np.maximum, net), out=highest, where=here)
            away += shares.most[place] * apart
            slope += shares.turn[place] * apart
            slope += shares.most[place] * np.maximum(_steepest(self.kind, net) - steep, 0.0) * self.radius
        return np.maximum(low - away, lowest), np.minimum(high + away, highest), slope


Net = list[list[Floats]]


def _controls(kind: Interpolation, samples: Floats) -> Net:
    """Return the control points of all cells between samples: those of y in order, of each those of x."""
    return [_line(kind, line, -1) for line in _line(kind, samples, -2)]


def _line(kind: Interpolation, samples: Floats, axis: int) -> list[Floats]:
    moved = np.moveaxis(samples, axis, -1)
    count = moved.shape[-1] - 3
    p = [np.moveaxis(moved[..., i : i + count], -1, axis) for i in range(4)]
    if kind == "bilinear":
        return [p[1], p[2]]
    return [p[1], p[1] + (p[2] - p[0]) / 6, p[2] - (p[3] - p[1]) / 6, p[2]]


def _joined(join: np.ufunc, net: Net) -> Floats:
    """Return the least or greatest control point of each cell."""
    found = net[0][0].copy()
    for line in net:
        for item in line:
            join(found, item, out=found)
    return found


def _steepest(kind: Interpolation, net: Net) -> Floats:
    """Bound |gradient| in each cell, per sample."""
    turned = [list(line) for line in zip(*net, strict=True)]
    return np.asarray(np.hypot(_along(kind, net), _along(kind, turned)))


def _along(kind: Interpolation, net: Net) -> Floats:
    """Bound |derivative by x| in each cell, per sample."""
    found = np.zeros(net[0][0].shape)
    if kind == "bilinear":
        for first, last in net:
            np.maximum(found, np.abs(last - first), out=found)
        return found / (1 - 2 * LEVEL)
    for line in net:
        first, middle, last = (line[k + 1] - line[k] for k in range(3))
        before, after = 0.5 * (first + middle), 0.5 * (middle + last)
        for item in (first, before, 0.5 * (before + after), after, last):
            np.maximum(found, np.abs(item), out=found)
    return 3 * found


def _blocks(join: np.ufunc, cells: Floats, edges: tuple[int, ...]) -> Floats:
    """Join the cells of squares to blocks; those on an edge between blocks, half in either, count for both."""
    starts, ends = list(edges[:-1]), list(edges[1:])
    rows = join(join.reduceat(cells[..., :-1, :], starts, axis=-2), cells[..., ends, :])
    return np.asarray(join(join.reduceat(rows[..., :-1], starts, axis=-1), rows[..., ends]))


@lru_cache(maxsize=16)
def shares(radius: int) -> Shares:
    """Measure the shares of patches in the cells of a square.

    Args:
        radius: samples in R.
    """
    cells = radius + 1
    marks = np.clip(np.arange(cells + 1) - 0.5, 0, radius) / radius
    count = max(3, ceil(DENSE / cells) + 1)
    places = np.linspace(marks[:-1], marks[1:], count, axis=1)
    # The farthest that a place is from those where shares are measured.
    gap = 0.5 * 2**0.5 * float(np.diff(places, axis=1).max())
    # Beyond half a radius from the outer centres weights stay as they are.
    sides = (((0, 1), 0.0, 1.0), ((1,), 0.5, 1.0), ((0,), 0.0, 0.5))
    found = Shares(*(np.zeros((3, 3, 2, 2, cells, cells)) for _ in range(2)))
    for i, (down, top, bottom) in enumerate(sides):
        for j, (across, left, right) in enumerate(sides):
            y, x = np.clip(places, top, bottom).reshape(-1, 1), np.clip(places, left, right).reshape(1, -1)
            inside = {(b, a): np.maximum(1 - (x - a) ** 2 - (y - b) ** 2, 0.0) for b in down for a in across}
            total = np.sum([item**3 for item in inside.values()], axis=0)
            rates = {(b, a): (-6 * item**2 * (x - a), -6 * item**2 * (y - b)) for (b, a), item in inside.items()}
            along, up = (np.sum([item[axis] for item in rates.values()], axis=0) for axis in (0, 1))
            for (b, a), item in inside.items():
                share = item**3 / total
                turn = np.hypot(rates[b, a][0] - share * along, rates[b, a][1] - share * up) / total
                greatest, steepest = (
                    values.reshape(cells, count, cells, count).max(axis=(1, 3)) for values in (share, turn)
                )
                if len(inside) > 1:
                    steepest += gap * BENT
                    greatest = np.minimum(greatest + gap * steepest, 1.0)
                nearest = [
                    np.abs(np.clip(k, lines.min(axis=1), lines.max(axis=1)) - k)
                    for k, lines in ((b, y.reshape(cells, count)), (a, x.reshape(cells, count)))
                ]
                reaches = nearest[0][:, None] ** 2 + nearest[1] ** 2 < 1
                found.most[i, j, b, a] = reaches * greatest
                found.turn[i, j, b, a] = reaches * (len(inside) > 1) * steepest
    return found
