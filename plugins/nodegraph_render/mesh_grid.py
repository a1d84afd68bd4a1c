"""The plain mesh of a raster: a vertex per cell centre."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_render.mesh import Mesh, checked_heights, lattice_mesh, whole_squares
from nodegraph_terrain.forecasts import outline
from nodegraph_terrain.raster import Elevation

Ints = npt.NDArray[np.int64]


@node(version=1, locality=whole)
def mesh_grid(
    surface: Elevation,
    *,
    stride: Annotated[int, Param("Take every so manyth row and column, and the last.", ge=1, unit="cells")] = 1,
    context: Context,
) -> Mesh:
    """Make a mesh with one vertex per cell centre.

    The mesh covers every square between four neighbouring (known) cell centres; a square that holds a void is left
    out.  A square is cut along the diagonal whose ends differ less in height, so that crests and valley floors are
    not notched.  Normals are those of the raster (Horn's gradient), UVs run over the raster's extent.  With stride 1
    the vertical error at the cell centres is 0; with a larger one it is not known.  Takes about 70 bytes per vertex.

    Raises:
        ValueError: the raster is in degrees, has fewer than two rows or columns, or no square without a void.

    See mesh_adaptive and mesh_tin for far fewer triangles at a stated error.
    """
    heights = checked_heights(surface)
    rows, cols = (_lines(count, stride) for count in surface.shape)
    whole_ones = _without_voids(whole_squares(heights), rows, cols)
    if not whole_ones.any():
        raise ValueError(f"no square of {stride} cells is free of voids; choose a smaller stride")
    corner = heights[np.ix_(rows, cols)]
    context.progress(0.2, "cutting squares")
    northwest, southeast = corner[:-1, :-1], corner[1:, 1:]
    northeast, southwest = corner[:-1, 1:], corner[1:, :-1]
    # Voids compare as they like: their squares are dropped.
    falling = (np.abs(northwest - southeast) <= np.abs(northeast - southwest))[whole_ones]
    number = rows[:, None] * surface.shape[1] + cols
    square = np.stack(
        [
            number[:-1, :-1][whole_ones],
            number[:-1, 1:][whole_ones],
            number[1:, 1:][whole_ones],
            number[1:, :-1][whole_ones],
        ]
    )
    # Corners go round clockwise, from the one at which the cut starts.
    square = np.where(falling, square, np.roll(square, -1, axis=0))
    cells = np.stack([square[[0, 1, 2]], square[[0, 2, 3]]]).transpose(2, 0, 1).reshape(-1, 3)
    return lattice_mesh(surface, cells, 0.0 if stride == 1 else float("nan"), context)


@mesh_grid.forecast
def _forecast(surface: Forecast, *, stride: int, **_: object) -> Forecast:
    known = outline(surface)
    vertices = (known.rows * known.cols if known else surface.bytes // 4) // stride**2
    return Forecast(68 * vertices, 130 * vertices)


def _lines(count: int, stride: int) -> Ints:
    lines = np.arange(0, count, stride)
    return lines if lines[-1] == count - 1 else np.append(lines, count - 1)


def _without_voids(squares: npt.NDArray[np.bool_], rows: Ints, cols: Ints) -> npt.NDArray[np.bool_]:
    """Return which of the coarse squares between some rows and columns hold only whole fine squares."""
    whole_rows = np.logical_and.reduceat(squares, rows[:-1], axis=0)
    return np.logical_and.reduceat(whole_rows, cols[:-1], axis=1)
