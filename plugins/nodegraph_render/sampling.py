"""Heights between the centres of cells."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.raster import Raster

Floats = npt.NDArray[np.float64]

EDGE = 1e-9
"""Cells by which rounding may put a point on the edge of a raster outside of it."""


def bilinear(raster: Raster, x: Floats, y: Floats) -> Floats:
    """Return the values of a raster at points: bilinear between the centres around, constant beyond the outer ones.

    NaN where a centre that carries weight is void, and outside of the raster.  `x` and `y` have any one shape and are
    in the coordinates of the raster.
    """
    rows, cols = raster.shape
    dx, dy = raster.cell_size
    across, down = (x - raster.extent.west) / dx - 0.5, (raster.extent.north - y) / dy - 0.5
    low = -0.5 - EDGE
    inside = (across >= low) & (across <= cols - 1 - low) & (down >= low) & (down <= rows - 1 - low)
    across, down = np.clip(np.where(inside, across, 0), 0, cols - 1), np.clip(np.where(inside, down, 0), 0, rows - 1)
    left, top = (
        np.minimum(across.astype(np.int64), max(cols - 2, 0)),
        np.minimum(down.astype(np.int64), max(rows - 2, 0)),
    )
    right, below = np.minimum(left + 1, cols - 1), np.minimum(top + 1, rows - 1)
    across, down = across - left, down - top
    total = np.zeros(across.shape)
    for row, share_down in ((top, 1 - down), (below, down)):
        for col, share_across in ((left, 1 - across), (right, across)):
            weight = share_down * share_across
            # A void without weight, on a straight between two known centres, does not matter.
            total += np.where(weight == 0, 0.0, weight * raster.data[row, col])
    return np.where(inside, total, np.nan)
