"""The slope of the ground's spline at the centres of its own cells, fast."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.interpolation import without_voids
from nodegraph_terrain.raster import Elevation
from nodegraph_texture.evaluate import degrees

Floats = npt.NDArray[np.float32]

TERMS = 8
"""Of the series: what it leaves out is 3e-5 of a difference of heights."""

BLOCK = 1 << 17
"""Cells at a time, which stay in the cache of a core."""


def spline_slope(elevation: Elevation, context: Context | None = None, stop: float = 1.0) -> Floats:
    """Return the slope in degrees that texture.apply_layers has at the centres of cells; NaN where they are void.

    The derivative of an interpolating cubic spline at its knots is

        sum_k -3 z^k (h[i + k] - h[i - k]) / cell,   z = sqrt(3) - 2    (Unser 1999, doi:10.1109/79.799930).

    Beyond the border heights go on by point reflection, as the spline does, so that planes stay planes.

    Args:
        elevation: in metres.
        context: where progress is reported, up to `stop`.
        stop: see there.
    """
    missing = np.isnan(elevation.data)
    voids = bool(missing.any())
    heights = without_voids(elevation.data, missing).astype(np.float32) if voids else elevation.data
    wide = np.pad(heights, TERMS, mode="reflect", reflect_type="odd")
    k = np.arange(1, TERMS + 1)
    series = (3**0.5 - 2) ** k
    series /= 2 * (k @ series)  # -3 z^k, but exact on planes with what is left out
    dx, dy = elevation.cell_size
    slope = np.empty(elevation.shape, np.float32)
    for part in row_blocks(*elevation.shape, context or Context(), cells=BLOCK, stop=stop):
        rows = wide[part.start : part.stop + 2 * TERMS]
        east = _derivative(rows[TERMS:-TERMS], series / dx)
        south = _derivative(rows[:, TERMS:-TERMS].T, series / dy).T
        slope[part] = degrees(east, south)
    if voids:
        slope[missing] = np.nan
    return slope


def _derivative(heights: Floats, series: npt.NDArray[Any]) -> Floats:
    """Return the sum of the series along the second axis, without the rim of `TERMS`."""
    size = heights.shape[1] - 2 * TERMS
    total = np.zeros_like(heights[:, TERMS:-TERMS])
    difference = np.empty_like(total)
    for k, weight in enumerate(series.astype(np.float32), start=1):
        after, before = (heights[:, TERMS + offset : TERMS + offset + size] for offset in (k, -k))
        np.subtract(after, before, out=difference)
        difference *= weight
        total += difference
    return total
