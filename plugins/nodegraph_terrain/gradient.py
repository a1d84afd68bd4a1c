"""The gradient of a surface by Horn's 3 x 3 weights: what slope, aspect and hillshade have in common."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.raster import Grid

Floats = npt.NDArray[np.float32]


def require_projected(grid: Grid) -> tuple[float, float]:
    """Return (width, height) of a cell in metres; the cells need not be square.

    Raises:
        ValueError: the grid is in degrees.
    """
    if grid.extent.unit != "m":
        raise ValueError("the raster is in degrees; link it through terrain.reproject to get metres")
    return grid.cell_size


def horn_gradient(heights: Floats, rows: slice, cell: tuple[float, float]) -> tuple[Floats, Floats]:
    """Return the gradient towards east and towards north of some rows of a surface.

    With the neighbours of a cell e named

        a b c
        d e f
        g h i

    dz/dx = ((c - a) + 2 (f - d) + (i - g)) / (8 dx) and dz/dy = ((a - g) + 2 (b - h) + (c - i)) / (8 dy) (Horn 1981).

    A neighbour that is void or outside the raster counts as the point reflection of its opposite through the centre
    (a = 2 e - i, and so on), so an edge has one-sided differences and planes stay exact.  Where both are missing, the
    difference is left out and the weights of the others are scaled up; without any, the surface counts as level along
    that axis.  Void cells have a void gradient.

    Args:
        heights: the whole surface, (rows, cols) float32, m.
        rows: the rows to return the gradient of.
        cell: (width, height) of a cell, m.

    Returns:
        Two float32 arrays of the shape of ``heights[rows]``, dimensionless, NaN where the cell is void.

    References:
        B. K. P. Horn (1981): Hill shading and the reflectance map. Proc. IEEE 69(1). doi:10.1109/PROC.1981.11918.
    """
    first, last, _ = rows.indices(heights.shape[0])
    padded = np.full((last - first + 2, heights.shape[1] + 2), np.nan, np.float32)
    top, bottom = max(0, first - 1), min(heights.shape[0], last + 1)
    padded[top - first + 1 : bottom - first + 1, 1:-1] = heights[top:bottom]

    across = padded[:, 2:] - padded[:, :-2]
    east = across[1:-1] * np.float32(2)
    east += across[:-2]
    east += across[2:]
    east *= np.float32(1 / (8 * cell[0]))
    down = padded[:-2] - padded[2:]
    north = down[:, 1:-1] * np.float32(2)
    north += down[:, :-2]
    north += down[:, 2:]
    north *= np.float32(1 / (8 * cell[1]))

    # Horn's weights leave out the centre.
    void = np.isnan(padded[1:-1, 1:-1])
    east[void] = np.nan
    north[void] = np.nan
    i, j = np.nonzero((np.isnan(east) | np.isnan(north)) & ~void)
    if len(i):
        # Heights relative to the centre: (n, 3, 3).
        window = np.stack([padded[i + di, j + dj] for di in range(3) for dj in range(3)], axis=1)
        window -= window[:, 4:5]
        window = np.where(np.isnan(window), -window[:, ::-1], window).reshape(-1, 3, 3)
        east[i, j] = _weighted(window[:, :, 2] - window[:, :, 0]) / np.float32(2 * cell[0])
        north[i, j] = _weighted(window[:, 0, :] - window[:, 2, :]) / np.float32(2 * cell[1])
    return east, north


def _weighted(differences: Floats) -> Floats:
    """Return the mean of three differences with weights 1, 2, 1, leaving out those that are NaN; 0 without any."""
    missing = np.isnan(differences)
    weights = np.where(missing, np.float32(0), np.array([1, 2, 1], np.float32))
    total = np.where(missing, np.float32(0), differences * weights).sum(axis=1)
    return np.asarray(total / np.maximum(weights.sum(axis=1), np.float32(1)), np.float32)
