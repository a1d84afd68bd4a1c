"""Rasters at the texels of any window of any level: cubic B-splines with gradients, and bilinear.

A texel is told by whole numbers, its row and column counted from the north-west corner of the scene, so that it lies at
the same place, to the last bit, in whatever window it is asked for.  Where texels are larger than cells, a coarser
level of the raster, means over 2 x 2 cells, stands in for it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import floor, log2
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.interpolation import REACH, spline_coefficients, without_voids
from nodegraph_terrain.raster import Extent

Floats = npt.NDArray[Any]
Index = npt.NDArray[np.int32]


class Places(Protocol):
    """Where the texels of a window lie, and how they read rasters: `Texels`, or those of another map projection."""

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""

    @property
    def cell(self) -> tuple[float, float]:
        """Width and height of a texel, m, by which detail is chosen."""

    def points(self, at: tuple[Any, ...]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return x and y, m, of the texels that indices of rows and columns select."""

    def spline(self, level: Level) -> tuple[Floats, Floats, Floats, npt.NDArray[np.bool_] | None]:
        """Return float32 values, their derivatives per metre towards east and north, and which texels are void."""

    def bilinear(self, level: Level) -> npt.NDArray[np.float32]:
        """Return float32 values, NaN where the cell that a texel lies in is void or there is none."""

    def gradient(self, rise: Floats) -> tuple[Floats, Floats]:
        """Return central differences of values per metre towards east and north; 0 along the border."""


class Texels(NamedTuple):
    """The texels of a window.

    Attributes:
        west, north: corner of the scene, m.
        cell: width and height of a texel, m.
        rows, cols: numbers of rows and columns counted from the corner; may be negative.
    """

    west: float
    north: float
    cell: tuple[float, float]
    rows: range
    cols: range

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return len(self.rows), len(self.cols)

    def x(self) -> npt.NDArray[np.float64]:
        """Return the coordinates of the middles of the columns, m."""
        return self.west + _middles(self.cols) * self.cell[0]

    def y(self) -> npt.NDArray[np.float64]:
        """Return the coordinates of the middles of the rows, m."""
        return self.north - _middles(self.rows) * self.cell[1]

    def points(self, at: tuple[Any, ...]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return x and y, m, of the texels that indices of rows and columns select."""
        return self.x()[at[1]], self.y()[at[0]]

    def spline(self, level: Level) -> tuple[Floats, Floats, Floats, npt.NDArray[np.bool_] | None]:
        """Return float32 values, their derivatives per metre towards east and north, and which texels are void."""
        return spline(level, self)

    def bilinear(self, level: Level) -> npt.NDArray[np.float32]:
        """Return float32 values, NaN where the cell that a texel lies in is void or there is none."""
        return bilinear(level, self)

    def gradient(self, rise: Floats) -> tuple[Floats, Floats]:
        """Return central differences of values per metre towards east and north; 0 along the border."""
        east, north = np.zeros_like(rise), np.zeros_like(rise)
        east[:, 1:-1] = (rise[:, 2:] - rise[:, :-2]) * np.float32(1 / (2 * self.cell[0]))
        north[1:-1] = (rise[:-2] - rise[2:]) * np.float32(1 / (2 * self.cell[1]))
        return east, north


class Taps(NamedTuple):
    """What rows or columns of texels read along one axis of a raster.

    Attributes:
        first: of the cells that are read, (n,).
        weight, slope: of each cell, for values and for derivatives per metre towards greater numbers, (taps, n).
        nearest: the cell that the middle lies in, (n,); -1 outside of the raster.
    """

    first: Index
    weight: npt.NDArray[np.float64]
    slope: npt.NDArray[np.float64]
    nearest: Index


class Level(NamedTuple):
    """A raster and its coarser versions, one of them.

    Attributes:
        values: cells without voids; spline coefficients, `REACH` more on each side, or float32 for bilinear.
        missing: which cells are void; None: none is.
        shape: (rows, columns).
        west, north: corner, m.
        cell: width and height of a cell, m.
    """

    values: Floats
    missing: npt.NDArray[np.bool_] | None
    shape: tuple[int, int]
    west: float
    north: float
    cell: tuple[float, float]

    def taps(self, texels: Texels, cubic: bool) -> tuple[Taps, Taps]:
        """Return what rows and columns of texels read; derivatives are towards south and east."""
        across = (texels.west - self.west + _middles(texels.cols) * texels.cell[0]) / self.cell[0]
        down = (self.north - texels.north + _middles(texels.rows) * texels.cell[1]) / self.cell[1]
        return taps(down, self.cell[1], self.shape[0], cubic), taps(across, self.cell[0], self.shape[1], cubic)

    def holes(self, down: Taps, across: Taps) -> npt.NDArray[np.bool_] | None:
        """Return which texels are void or outside; None: none is."""
        outside = np.logical_or.outer(down.nearest < 0, across.nearest < 0)
        if self.missing is not None:
            outside |= self.missing[np.maximum(down.nearest, 0)[:, None], np.maximum(across.nearest, 0)]
        return outside if outside.any() else None


@dataclass
class Pyramid:
    """A raster in metres and its coarser versions, made when they are asked for.

    Attributes:
        data: (rows, cols) float32, NaN void.
        extent: in metres.
        cubic: whether it is for cubic splines.
    """

    data: npt.NDArray[np.float32]
    extent: Extent
    cubic: bool
    _levels: dict[int, Level] = field(default_factory=dict, repr=False)

    def level_for(self, cell: tuple[float, float]) -> Level:
        """Return the version whose cells are no larger than texels, and more than half as large where there is one."""
        rows, cols = self.data.shape
        ratio = min(cell[0] * cols / self.extent.width, cell[1] * rows / self.extent.height)
        # A ratio of 2 that rounding makes smaller is 2.
        number = min(max(0, floor(log2(ratio) + 1e-9)), max(rows, cols).bit_length() - 1)
        if number not in self._levels:
            self._levels[number] = self._made(number)
        return self._levels[number]

    def _made(self, number: int) -> Level:
        values = self.data
        for _ in range(number):
            values = halved(values)
        missing: npt.NDArray[np.bool_] | None = np.isnan(values)
        assert missing is not None
        if missing.any():
            values = without_voids(values, missing)
        else:
            missing = None
        shape, size = (values.shape[0], values.shape[1]), 2**number
        cell = self.extent.width / self.data.shape[1] * size, self.extent.height / self.data.shape[0] * size
        kept = spline_coefficients(values) if self.cubic else values
        return Level(kept, missing, shape, self.extent.west, self.extent.north, cell)


def halved(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return means over 2 x 2 cells, of the known ones if there are two; a last odd row or column counts twice."""
    even = np.pad(values, [(0, side % 2) for side in values.shape], mode="edge").astype(np.float64)
    four = np.stack([even[i::2, j::2] for i in (0, 1) for j in (0, 1)])
    known = ~np.isnan(four)
    count = known.sum(axis=0)
    mean = np.where(known, four, 0.0).sum(axis=0) / np.maximum(count, 1)
    return np.where(count >= 2, mean, np.nan).astype(np.float32)


def spline(level: Level, texels: Texels) -> tuple[Floats, Floats, Floats, npt.NDArray[np.bool_] | None]:
    """Return float32 values, their derivatives per metre towards east and north, and which texels are void."""
    down, across = level.taps(texels, cubic=True)
    first, last = int(across.first.min()), int(across.first.max()) + 4
    part = level.values[:, first:last]
    rows = [part[down.first + tap] for tap in range(4)]
    values, southward = (
        sum_of(rows[tap] * weights[tap, :, None] for tap in range(4)) for weights in (down.weight, down.slope)
    )
    columns = [across.first - first + tap for tap in range(4)]
    height = sum_of(values[:, columns[tap]] * across.weight[tap] for tap in range(4))
    east = sum_of(values[:, columns[tap]] * across.slope[tap] for tap in range(4))
    north = sum_of(southward[:, columns[tap]] * -across.weight[tap] for tap in range(4))
    single = [array.astype(np.float32) for array in (height, east, north)]
    return single[0], single[1], single[2], level.holes(down, across)


def bilinear(level: Level, texels: Texels) -> npt.NDArray[np.float32]:
    """Return float32 values, NaN where the cell that a texel lies in is void or there is none."""
    down, across = level.taps(texels, cubic=False)
    last = level.shape[0] - 1, level.shape[1] - 1
    rows = sum_of(level.values[np.minimum(down.first + tap, last[0])] * down.weight[tap, :, None] for tap in range(2))
    columns = [np.minimum(across.first + tap, last[1]) for tap in range(2)]
    values = np.asarray(sum_of(rows[:, columns[tap]] * across.weight[tap] for tap in range(2)), np.float32)
    holes = level.holes(down, across)
    if holes is not None:
        values[holes] = np.nan
    return values


def sum_of(terms: Any) -> Any:
    """Return a sum of arrays, added in order into the first."""
    total = next(terms := iter(terms))
    for term in terms:
        total += term
    return total


def _middles(numbers: range) -> npt.NDArray[np.float64]:
    return np.arange(numbers.start, numbers.stop, dtype=np.float64) + 0.5


def taps(place: npt.NDArray[np.float64], cell: float, count: int, cubic: bool) -> Taps:
    """Return the taps of texels whose middles lie so many cells, `cell` metres wide, after the edge of the first."""
    # What lies on the outer edge to within a millionth of a cell is inside.
    inside = (place > -1e-6) & (place < count + 1e-6)
    nearest = np.where(inside, np.clip(np.floor(place), 0, count - 1), -1).astype(np.int32)
    centre = place - 0.5
    if not cubic:
        centre = np.clip(centre, 0, count - 1)
        first = np.clip(np.floor(centre), 0, max(0, count - 2))
        t = centre - first
        slope = np.stack([np.full(t.shape, -1 / cell), np.full(t.shape, 1 / cell)])
        return Taps(first.astype(np.int32), np.stack([1 - t, t]), slope, nearest)
    centre = np.clip(centre, 1.0 - REACH, count + REACH - 3.0)
    first = np.floor(centre)
    t = centre - first
    s = 1 - t
    weight = np.stack([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3]) / 6
    slope = np.stack([-(s**2), 3 * t**2 - 4 * t, 4 * s - 3 * s**2, t**2]) / (2 * cell)
    return Taps((first - 1 + REACH).astype(np.int32), weight, slope, nearest)
