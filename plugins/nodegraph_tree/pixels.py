"""Interpolating the cells of a raster, with exact gradients, and what the result can be over any block of cells.

Positions are in cells: column c and row r, 0 at the centre of the first cell, r growing southward; a raster of n
columns reaches from -1/2 to n - 1/2.  Beyond the outer centres the values go on in a straight line (weights: stay as
they are).

=========  ==================================================================================================  ====
name       what it is                                                                                          is
=========  ==================================================================================================  ====
bilinear   linear between neighbours along either axis, through all values; never beyond them                  C0
bicubic    Catmull-Rom: cubic between neighbours, with the slope of the chord over both neighbours; through    C1
           all values, may overshoot them
spline     uniform cubic B-spline with the values as control points: smooths, never beyond them                C2
smooth     bilinear in 3 t^2 - 2 t^3 instead of t: through all values, level at each centre, never beyond      C1
=========  ==================================================================================================  ====

``bilinear`` is level within `LEVEL` of a cell around each grid line: what float32 makes of a position cannot change the
value at a centre then, so that sampling a raster at its own centres returns it exactly, on any device.

**Bounds of a cell.**  Bilinear: values are between the four corners, and each derivative is greatest on an edge; as
df/dc depends on r alone and df/dr on c alone, both extremes meet in a corner and the bound of the gradient is attained.
Bicubic and spline: in Bernstein form the values stay within the 4 x 4 control points; df/dc is a mean, over the basis
in r, of four parabolas whose extremes are known, and likewise df/dr.

Source: Génevaux et al. 2015, section 7.3.1, doi:10.1111/cgf.12530; its printed bound skips the last row and column, and
does not hold for bicubic interpolation.  E. Catmull, R. Rom 1974, A class of local interpolating splines.
"""

from __future__ import annotations

from math import ceil, floor, log2
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter

Floats = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]
Kind = Literal["bilinear", "bicubic", "spline", "smooth"]

CODES: dict[Kind, int] = {"bilinear": 0, "bicubic": 1, "spline": 2, "smooth": 3}
"""How ``kernels/image.cl`` numbers them."""

PAD = 2
"""Cells added on every side, so that no sample looks outside."""

LEVEL = 2e-5
"""Share of a cell, at either side of it, in which ``bilinear`` is level."""

BLOCK = 1 << 16
"""Cells whose Bernstein form is made at a time."""


class Value(NamedTuple):
    """Values and their derivatives per column and per row, (n,) each."""

    value: Floats
    along: Floats
    down: Floats


class Cells(NamedTuple):
    """What an interpolant can be between each four neighbouring centres: (rows + 1, cols + 1), first from -1 to 0."""

    low: Floats
    high: Floats
    along: Floats
    down: Floats


class Range(NamedTuple):
    """What an interpolant can be over a block of cells; `slope` in the metric of the `Pyramid`."""

    low: float
    high: float
    slope: float


class Pixels:
    """The cells of a raster as a continuous function.

    Args:
        data: (rows, cols), finite.
        kind: of interpolation.
    """

    def __init__(self, data: Singles, kind: Kind) -> None:
        self.kind = kind
        self.rows, self.cols = (int(side) for side in data.shape)
        weights = kind in ("spline", "smooth")
        self.padded: Singles
        if weights:
            self.padded = np.pad(data, PAD, mode="edge")
        else:
            self.padded = np.pad(data.astype(np.float64), PAD, mode="reflect", reflect_type="odd").astype(np.float32)
        self.padded.flags.writeable = False

    def at(self, c: Floats, r: Floats) -> Value:
        """Return values and derivatives at positions; those outside the raster are moved to its edge.

        O(16 n), or O(4 n) for the linear kinds.
        """
        c, r = np.clip(c, -0.5, self.cols - 0.5), np.clip(r, -0.5, self.rows - 0.5)
        left, top = np.floor(c), np.floor(r)
        wx, dx = basis(self.kind, c - left)
        wy, dy = basis(self.kind, r - top)
        taps = len(wx)
        first = 1 - taps // 2
        column, row = left.astype(np.int64) + (PAD + first), top.astype(np.int64) + (PAD + first)
        value, along, down = (np.zeros(c.shape) for _ in range(3))
        for j in range(taps):
            line, slope = np.zeros(c.shape), np.zeros(c.shape)
            for i in range(taps):
                cell = self.padded[row + j, column + i].astype(np.float64)
                line += wx[i] * cell
                slope += dx[i] * cell
            value += wy[j] * line
            along += wy[j] * slope
            down += dy[j] * line
        return Value(value, along, down)

    def device(self, emitter: Emitter, c0: float, r0: float, wide: float, high: float) -> tuple[list[float], list[int]]:
        """Return the parameters by which ``pixels`` of ``kernels/image.cl`` reads this raster.

        Args:
            emitter: of the sampling.
            c0, r0: position of the place that the kernel counts from.
            wide, high: columns and rows per unit that it counts in.
        """
        column, row = floor(c0), floor(r0)
        return (
            [c0 - column, wide, r0 - row, high],
            [emitter.shared.place(self.padded), column, row, self.cols, self.rows, CODES[self.kind]],
        )

    def cells(self) -> Cells:
        """Return the bounds of all cells, O(cells)."""
        data = self.padded.astype(np.float64)
        if self.kind in ("bilinear", "smooth"):
            inner = data[1:-1, 1:-1]
            along, down = np.abs(np.diff(inner, axis=1)), np.abs(np.diff(inner, axis=0))
            steep = 1.5 if self.kind == "smooth" else 1 / (1 - 2 * LEVEL)
            # Only the inner half of the outer cells belongs to the raster.
            inner = inner.copy()
            inner[0], inner[-1] = (inner[0] + inner[1]) / 2, (inner[-1] + inner[-2]) / 2
            inner[:, 0], inner[:, -1] = (inner[:, 0] + inner[:, 1]) / 2, (inner[:, -1] + inner[:, -2]) / 2
            low, high = np.minimum(inner[:, :-1], inner[:, 1:]), np.maximum(inner[:, :-1], inner[:, 1:])
            return Cells(
                np.minimum(low[:-1], low[1:]),
                np.maximum(high[:-1], high[1:]),
                steep * np.maximum(along[:-1], along[1:]),
                steep * np.maximum(down[:, :-1], down[:, 1:]),
            )
        found = Cells(*(np.empty((self.rows + 1, self.cols + 1)) for _ in range(4)))
        step = max(1, BLOCK // (self.cols + 1))
        for start in range(0, self.rows + 1, step):
            part = slice(start, min(start + step, self.rows + 1))
            b = _bernstein(self.kind, _bernstein(self.kind, data[part.start : part.stop + 3], 0), 2)
            # b[j, :, i, :]: control point j of r and i of c of every cell.
            found.low[part], found.high[part] = b.min(axis=(0, 2)), b.max(axis=(0, 2))
            found.along[part] = np.max([_steepest(*(b[j, :, i] for i in range(4))) for j in range(4)], axis=0)
            found.down[part] = np.max([_steepest(*(b[j, :, i] for j in range(4))) for i in range(4)], axis=0)
        return found


def basis(kind: Kind, t: Floats) -> tuple[list[Floats], list[Floats]]:
    """Return the weights of the 2 or 4 cells around a place t in [0, 1] between two centres, and their derivatives."""
    if kind == "bilinear":
        scaled = (t - LEVEL) / (1 - 2 * LEVEL)
        u = np.clip(scaled, 0.0, 1.0)
        rate = np.where((scaled > 0) & (scaled < 1), 1 / (1 - 2 * LEVEL), 0.0)
        return [1 - u, u], [-rate, rate]
    if kind == "smooth":
        u, rate = t * t * (3 - 2 * t), 6 * t * (1 - t)
        return [1 - u, u], [-rate, rate]
    s = 1 - t
    if kind == "bicubic":
        return (
            [-0.5 * t * s * s, 1 + t * t * (1.5 * t - 2.5), 1 + s * s * (1.5 * s - 2.5), -0.5 * s * t * t],
            [-0.5 * s * (s - 2 * t), t * (4.5 * t - 5), s * (5 - 4.5 * s), -0.5 * t * (2 * s - t)],
        )
    return (
        [s**3 / 6, (4 + t * t * (3 * t - 6)) / 6, (4 + s * s * (3 * s - 6)) / 6, t**3 / 6],
        [-s * s / 2, t * (1.5 * t - 2), s * (2 - 1.5 * s), t * t / 2],
    )


def _bernstein(kind: Kind, data: Floats, axis: int) -> Floats:
    """Return the control points of all pieces along an axis: the axis becomes two, (4, pieces)."""
    count = data.shape[axis] - 3
    p = [np.take(data, range(i, i + count), axis) for i in range(4)]
    if kind == "bicubic":
        control = [p[1], p[1] + (p[2] - p[0]) / 6, p[2] - (p[3] - p[1]) / 6, p[2]]
    else:
        control = [
            (p[0] + 4 * p[1] + p[2]) / 6, (2 * p[1] + p[2]) / 3, (p[1] + 2 * p[2]) / 3, (p[1] + 4 * p[2] + p[3]) / 6,
        ]  # fmt: skip
    return np.stack(control, axis=axis)


def _steepest(b0: Floats, b1: Floats, b2: Floats, b3: Floats) -> Floats:
    """Return the greatest |derivative| of cubics with these control points: of a parabola, at an end or its vertex."""
    a, b, c = 3 * (b1 - b0), 3 * (b2 - b1), 3 * (b3 - b2)
    bend = a - 2 * b + c
    with np.errstate(divide="ignore", invalid="ignore"):
        place = (a - b) / bend
        vertex = a - (a - b) * place
    inside = (place > 0) & (place < 1)
    return np.maximum(np.maximum(np.abs(a), np.abs(c)), np.where(inside, np.abs(vertex), 0.0))


def known(heights: Singles, mask: Singles | None, margin: float = 1.0) -> tuple[Singles, Singles | None]:
    """Return heights without voids, and a mask that is 0 at them; None where it would be 1 everywhere.

    Args:
        heights: NaN is a void: it gets the nearest height.
        mask: 0 to 1, of any shape; NaN counts as 0.
        margin: cells over which the mask rises from 0 at the centre of a void to 1.

    Raises:
        ValueError: all heights are void, one is infinite, or there is a mask of another shape besides voids.
    """
    missing = np.isnan(heights)
    if np.isinf(heights).any():
        raise ValueError("the elevation holds infinite heights; mark what is unknown as void (NaN)")
    if missing.all():
        raise ValueError("the elevation is void everywhere; link one with known heights")
    if mask is not None:
        mask = np.clip(np.nan_to_num(mask, nan=0.0), 0.0, 1.0).astype(np.float32)
    if not missing.any():
        return heights, mask
    from scipy import ndimage

    distance = ndimage.distance_transform_edt(~missing)
    nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    filled = np.ascontiguousarray(heights[nearest[0], nearest[1]])
    t = np.minimum(distance / max(margin, 1.0), 1.0)
    own = (t * t * (3 - 2 * t)).astype(np.float32)
    if mask is not None:
        if mask.shape != heights.shape:
            raise ValueError(
                f"an elevation with voids needs a mask of its own shape {heights.shape}, not {mask.shape}; fill the "
                "voids or resample the mask"
            )
        own *= mask
    return filled, own


class Pyramid:
    """Extremes of values and slopes over any block of cells.

    Args:
        low, high, slope: of each cell.

    `over` takes O(1): a block is looked up at the level where it is some ten cells wide, so it grows by a tenth or so.
    Rounded outward to float32: 12 bytes per cell, a third more for the levels above.
    """

    REACH = 12

    def __init__(self, low: Floats, high: Floats, slope: Floats) -> None:
        down, up, steep = (np.asarray(item, np.float32) for item in (low, high, slope))
        ulp = np.float32(1e-7)
        outward = (down - np.abs(down) * ulp, up + np.abs(up) * ulp, steep + steep * ulp)
        self.levels: list[tuple[Singles, Singles, Singles]] = [
            (outward[0].astype(np.float32), outward[1].astype(np.float32), outward[2].astype(np.float32))
        ]
        while max(self.levels[-1][0].shape) > self.REACH:
            lows, highs, slopes = self.levels[-1]
            self.levels.append((_halved(lows, np.minimum), _halved(highs, np.maximum), _halved(slopes, np.maximum)))

    def over(self, c0: float, c1: float, r0: float, r1: float) -> Range:
        """Return the extremes where c0 <= c <= c1 and r0 <= r <= r1; parts outside the raster do not count."""
        rows, cols = self.levels[0][0].shape
        # Cell k lies between the centres k - 1 and k.
        left, right = (min(max(floor(c) + 1, 0), cols - 1) for c in (c0 - 1e-6, c1 + 1e-6))
        top, bottom = (min(max(floor(r) + 1, 0), rows - 1) for r in (r0 - 1e-6, r1 + 1e-6))
        widest = max(right - left, bottom - top) + 1
        level = min(max(0, ceil(log2(widest / self.REACH))), len(self.levels) - 1)
        part = (slice(top >> level, (bottom >> level) + 1), slice(left >> level, (right >> level) + 1))
        lows, highs, slopes = self.levels[level]
        return Range(float(lows[part].min()), float(highs[part].max()), float(slopes[part].max()))


def _halved(data: Singles, join: np.ufunc) -> Singles:
    rows, cols = data.shape
    even = np.pad(data, ((0, rows % 2), (0, cols % 2)), mode="edge")
    across = join(even[:, ::2], even[:, 1::2])
    return np.asarray(join(across[::2], across[1::2]))
