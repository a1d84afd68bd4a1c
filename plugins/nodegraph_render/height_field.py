"""Height fields: rasters prepared for following rays, with the greatest heights of ever larger blocks.

The surface is bilinear between the centres of cells.  The square of four neighbouring centres is a *quad*; one with a
void corner is no ground, and the side between ground and no ground belongs to the quad east or south of it.  Positions
are in cells from the centre of the north-western cell: x towards east, y towards south, so that quad (row, column)
spans x from column to column + 1 and y from row to row + 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.gradient import horn_gradient, require_projected
from nodegraph_terrain.raster import Elevation

Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]

SHIFT = 2
"""A block has 2^SHIFT by 2^SHIFT blocks of the level below; four by four took the fewest steps and the least time."""

COARSEST = 16
"""The pyramid ends at a level of so few blocks: a ray crosses them as fast as it would descend to them."""


@dataclass(frozen=True)
class HeightField:
    """A raster and its maximum pyramid (Tevs, Ihrke, Seidel 2008, doi:10.1145/1342250.1342279).

    Attributes:
        heights: of the centres of cells, (rows, cols), m; NaN is a void.
        west, north: of the centre of the north-western cell, m.
        cell: (width, height) of a cell, m.
        pyramid: greatest height over each quad, then over blocks of quads, level by level; -inf where there is none.
        levels: (n, 2) int32: where each level begins in `pyramid`, and how many blocks wide it is.
        bottom: the least height of all, m; infinite where there is none.
        top: the greatest height over ground, m; -inf where there is none.
    """

    heights: Floats
    west: float
    north: float
    cell: tuple[float, float]
    pyramid: Floats
    levels: npt.NDArray[np.int32]
    bottom: float
    top: float

    @property
    def quads(self) -> tuple[int, int]:
        """Rows and columns of quads."""
        return self.heights.shape[0] - 1, self.heights.shape[1] - 1

    @cached_property
    def ground(self) -> npt.NDArray[np.bool_]:
        """Which quads are ground."""
        rows, cols = self.quads
        return self.pyramid[: rows * cols].reshape(rows, cols) > -np.inf

    def gridded(self, origin: Doubles, direction: Doubles) -> tuple[Doubles, Doubles]:
        """Return points and directions in metres as positions in cells and metres of height."""
        scale = np.array([1 / self.cell[0], -1 / self.cell[1], 1.0])
        return (origin - (self.west, self.north, 0.0)) * scale, direction * scale


def height_field(surface: Elevation, context: Context) -> HeightField:
    """Prepare a raster: time and memory linear in its cells (the pyramid has 1.07 floats a cell).

    Raises:
        ValueError: the raster is in degrees, a height is infinite, or there are 2^30 cells or more.
    """
    cell = require_projected(surface)
    heights, (rows, cols) = surface.data, surface.shape
    shapes = [(max(0, rows - 1), max(0, cols - 1))]
    while shapes[-1][0] * shapes[-1][1] > COARSEST:
        shapes.append((-(-shapes[-1][0] >> SHIFT), -(-shapes[-1][1] >> SHIFT)))
    sizes = [high * wide for high, wide in shapes]
    if rows * cols >= 1 << 30:
        raise ValueError(f"a raster of {rows} x {cols} cells is too large to trace; resample or crop it")
    pyramid = np.empty(sum(sizes), np.float32)
    starts = np.cumsum([0, *sizes])
    levels = [
        pyramid[start : start + size].reshape(shape)
        for start, size, shape in zip(starts[:-1], sizes, shapes, strict=True)
    ]
    bottom = np.inf
    for part in row_blocks(rows, cols, context):
        block = heights[part.start : part.stop + 1]
        bottom = np.fmin(bottom, np.fmin.reduce(block, axis=None))
        if np.isinf(block).any():
            raise ValueError("the raster has infinite heights; repair its source, or make them void (NaN)")
        if len(block) > 1 and cols > 1:
            level = levels[0][part.start : part.start + len(block) - 1]
            pairs = np.maximum(block[:-1], block[1:])
            np.maximum(pairs[:, :-1], pairs[:, 1:], out=level)
            level[np.isnan(level)] = -np.inf
    for fine, coarse in pairwise(levels):
        every = 1 << SHIFT
        for part in row_blocks(len(coarse), fine.shape[1] * every, context):
            lines = fine[part.start * every : part.stop * every]
            lines = np.maximum.reduceat(lines, np.arange(0, len(lines), every), axis=0)
            np.maximum.reduceat(lines, np.arange(0, fine.shape[1], every), axis=1, out=coarse[part])
    return HeightField(
        heights=heights,
        west=surface.extent.west + cell[0] / 2,
        north=surface.extent.north - cell[1] / 2,
        cell=cell,
        pyramid=pyramid,
        levels=np.array([(start, wide) for start, (_, wide) in zip(starts[:-1], shapes, strict=True)], np.int32),
        bottom=float(bottom),
        top=float(levels[-1].max(initial=-np.inf)),
    )


def slopes(field: HeightField, context: Context) -> Floats:
    """Return Horn's gradient at the centres of cells, towards east and north, (rows, cols, 2)."""
    rows, cols = field.heights.shape
    gradient = np.empty((rows, cols, 2), np.float32)
    for part in row_blocks(rows, cols, context):
        gradient[part, :, 0], gradient[part, :, 1] = horn_gradient(field.heights, part, field.cell)
    return gradient


def steepest(heights: Floats, cell: tuple[float, float], context: Context) -> float:
    """Return the least Lipschitz constant of a bilinear surface without voids.

    Over a quad the gradient's components are linear, each along the other's axis, so their greatest magnitudes meet
    in a corner: the constant is the greatest sqrt(dx^2 + dy^2) of them.
    """
    squared, (rows, cols) = 0.0, heights.shape
    for part in row_blocks(rows, cols, context):
        block = heights[part.start : part.stop + 1].astype(np.float64)
        if min(block.shape) < 2:
            continue
        across = np.abs(np.diff(block, axis=1)) / cell[0]
        down = np.abs(np.diff(block, axis=0)) / cell[1]
        quads = np.maximum(across[:-1], across[1:]) ** 2 + np.maximum(down[:, :-1], down[:, 1:]) ** 2
        squared = max(squared, float(quads.max()))
    return float(np.sqrt(squared))
