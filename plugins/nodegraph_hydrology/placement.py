"""Laying a patch of terrain over a raster: where each cell of the one takes its height from the other."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.interpolation import REACH, spline_coefficients, without_voids
from nodegraph_terrain.raster import Elevation, Mask

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

ALIGNED = 1e-4
"""Largest distance of cell centres, in cells, at which heights are taken as they are instead of interpolated."""


@dataclass(frozen=True, slots=True)
class Placed:
    """A patch in the cells of another raster.

    Attributes:
        rows, cols: the part of the raster it reaches.
        heights: of the patch, (rows, cols) float64; any number where not known.
        known: where the patch has a height.
        wanted: where its mask is at least a half.
    """

    rows: slice
    cols: slice
    heights: Floats
    known: Bools
    wanted: Bools


@dataclass(frozen=True, slots=True)
class Similarity:
    """Turning, scaling and moving: how the plane of the base maps to rows and columns of the patch.

    Attributes:
        centre: where the centre of the patch comes to lie, in the base's coordinates.
        rotation: counter-clockwise, degrees.
        size: by how much the patch grows.
    """

    centre: tuple[float, float]
    rotation: float
    size: float

    def corners(self, patch: Elevation) -> Floats:
        """Return where the corners of the patch come to lie, (4, 2)."""
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [patch.extent.width / 2, patch.extent.height / 2]
        c, s = cos(radians(self.rotation)), sin(radians(self.rotation))
        return np.asarray(self.size * half @ np.array([[c, s], [-s, c]]) + self.centre)

    def cells_of(self, patch: Elevation, east: Floats, north: Floats) -> tuple[Floats, Floats]:
        """Return fractional rows and columns in the patch (whole at its cell centres) of places in the base."""
        dx, dy = patch.cell_size
        x, y = east - self.centre[0], north - self.centre[1]
        c, s = cos(radians(self.rotation)) / self.size, sin(radians(self.rotation)) / self.size
        rows, cols = patch.shape
        return (rows - 1) / 2 - (c * y - s * x) / dy, (cols - 1) / 2 + (c * x + s * y) / dx


def place(base: Elevation, patch: Elevation, mask: Mask | None, where: Similarity, context: Context) -> Placed | None:
    """Return the patch in the cells of the base, clipped at its edges; None where it lies beside it.

    Heights between the patch's cell centres are those of the interpolating cubic B-spline.  Where the base's cells are
    k times as large as the placed patch's, they are the mean of round(k) by round(k) places.  A place is known where
    the four cells around it are.
    """
    (dx, dy), extent, corners = base.cell_size, base.extent, where.corners(patch)
    (west, south), (east, north) = corners.min(axis=0), corners.max(axis=0)
    cols = _span((west - extent.west) / dx, (east - extent.west) / dx, base.shape[1])
    rows = _span((extent.north - north) / dy, (extent.north - south) / dy, base.shape[0])
    if rows.stop <= rows.start or cols.stop <= cols.start:
        return None
    fine = max(1, round(dy / (where.size * patch.cell_size[1]))), max(1, round(dx / (where.size * patch.cell_size[0])))
    spread = tuple((np.arange(count) + 0.5) / count - 0.5 for count in fine)
    x = extent.west + (np.arange(cols.start, cols.stop) + 0.5) * dx
    y = extent.north - (np.arange(rows.start, rows.stop) + 0.5) * dy
    if fine == (1, 1) and _is_aligned(base, patch, where, rows, cols):
        return Placed(rows, cols, *_copied(patch, mask, where, x, y))
    missing = np.isnan(patch.data)
    coefficients = spline_coefficients(without_voids(patch.data, missing) if missing.any() else patch.data)
    shape = (len(y), len(x))
    heights, known, wanted = np.zeros(shape), np.ones(shape, np.bool_), np.ones(shape, np.bool_)
    mean = 1 / (fine[0] * fine[1])
    for part in row_blocks(*shape, context, stop=0.3):
        share = np.zeros(heights[part].shape)
        for down in spread[0]:
            for across in spread[1]:
                row, col = where.cells_of(patch, x[None, :] + across * dx, y[part, None] - down * dy)
                heights[part] += mean * _sampled(coefficients, row, col, 3)
                known[part] &= _is_known(missing, row, col)
                if mask is not None:
                    share += mean * _sampled(np.nan_to_num(mask.data).astype(np.float64), row, col, 1)
        if mask is not None:
            wanted[part] = share >= 0.5
    return Placed(rows, cols, heights, known, wanted)


def _span(first: float, last: float, count: int) -> slice:
    """Return the cells from `first` to `last` with one more on either side, within the raster."""
    return slice(int(np.clip(np.floor(first) - 1, 0, count)), int(np.clip(np.ceil(last) + 1, 0, count)))


def _is_aligned(base: Elevation, patch: Elevation, where: Similarity, rows: slice, cols: slice) -> bool:
    """Say whether the centres of both rasters' cells coincide."""
    (dx, dy), extent = base.cell_size, base.extent
    x = extent.west + (np.array([cols.start, cols.stop - 1, cols.start]) + 0.5) * dx
    y = extent.north - (np.array([rows.start, rows.start, rows.stop - 1]) + 0.5) * dy
    row, col = where.cells_of(patch, x, y)
    whole = all(bool(np.abs(item - np.rint(item)).max() < ALIGNED) for item in (row, col))
    along = np.abs([col[1] - col[0], row[2] - row[0]])
    cross = np.abs([row[1] - row[0], col[2] - col[0]])
    lengths = [cols.stop - 1 - cols.start, rows.stop - 1 - rows.start]
    # A quarter turn also keeps centres on centres.
    straight = np.allclose(along, lengths, rtol=0, atol=ALIGNED) and cross.max() < ALIGNED
    turned = np.allclose(cross, lengths, rtol=0, atol=ALIGNED) and along.max() < ALIGNED
    return whole and bool(straight or turned)


def _copied(
    patch: Elevation, mask: Mask | None, where: Similarity, east: Floats, north: Floats
) -> tuple[Floats, Bools, Bools]:
    """Return heights, known and wanted at places that are all cell centres of the patch, in any quarter turn of it."""
    along, down = where.cells_of(patch, east, north[0]), where.cells_of(patch, east[0], north)
    turned = round(where.rotation / 90) % 2 == 1
    row, col = np.rint(along[0] if turned else down[0]), np.rint(down[1] if turned else along[1])
    rows, cols = patch.shape
    cells = np.ix_(np.clip(row, 0, rows - 1).astype(np.int64), np.clip(col, 0, cols - 1).astype(np.int64))
    heights = patch.data[cells].astype(np.float64)
    known = ~np.isnan(heights)
    known[(row < 0) | (row >= rows)] = known[:, (col < 0) | (col >= cols)] = False
    heights[np.isnan(heights)] = 0
    wanted = np.ones_like(known) if mask is None else mask.data[cells] >= 0.5
    return (heights.T, known.T, wanted.T) if turned else (heights, known, wanted)


def _sampled(values: Floats, row: Floats, col: Floats, order: int) -> Floats:
    """Return values at fractional cells; cubic ones from spline coefficients extended by `REACH`."""
    from scipy import ndimage

    shift = REACH if order == 3 else 0
    row, col = np.broadcast_arrays(row, col)
    places = [row + shift, col + shift]
    return np.asarray(ndimage.map_coordinates(values, places, order=order, prefilter=False, mode="nearest"))


def _is_known(missing: Bools, row: Floats, col: Floats) -> Bools:
    """Say where all cells around a place are in the patch and known."""
    rows, cols = missing.shape
    near = 1e-6
    inside = (row >= -near) & (row <= rows - 1 + near) & (col >= -near) & (col <= cols - 1 + near)
    known = np.array(inside)
    if missing.any():
        for r in (np.floor(row + near), np.ceil(row - near)):
            for c in (np.floor(col + near), np.ceil(col - near)):
                known &= ~missing[np.clip(r, 0, rows - 1).astype(np.int64), np.clip(c, 0, cols - 1).astype(np.int64)]
    return known
