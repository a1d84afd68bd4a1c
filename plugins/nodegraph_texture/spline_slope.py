"""The slope of the ground's spline at the centres of its own cells, fast."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.interpolation import without_voids
from nodegraph_terrain.raster import Elevation
from nodegraph_texture.evaluate import degrees

Floats = npt.NDArray[np.float32]

POLE = 3**0.5 - 2
"""z, of the cubic spline."""

TERMS = 8
"""Of the series, a power of two: what it leaves out is 3e-5 of a difference of heights."""

BLOCK = 1 << 17
"""Cells at a time, which stay in the cache of a core."""


def spline_slope(elevation: Elevation, context: Context | None = None, stop: float = 1.0) -> Floats:
    """Return the slope in degrees that texture.apply_layers has at the centres of cells; NaN where they are void.

    The derivative of an interpolating cubic spline at its knots is

        sum_k -3 z^k (h[i + k] - h[i - k]) / cell,  k = 1, 2, ...,  z = sqrt(3) - 2  (Unser 1999, doi:10.1109/79.799930)

    and with the differences d[i] = h[i + 1] - h[i], as all powers of z from the k-th on sum up to z^k / (1 - z),

        -3 z / (1 - z) sum_k z^k (d[i + k] + d[i - 1 - k]) / cell,  k = 0, 1, ...

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
    dx, dy = elevation.cell_size
    slope = np.empty(elevation.shape, np.float32)
    for part in row_blocks(*elevation.shape, context or Context(), cells=BLOCK, stop=stop):
        rows = wide[part.start : part.stop + 2 * TERMS]
        east = _derivative(rows[TERMS:-TERMS], dx)
        south = _derivative(rows[:, TERMS:-TERMS].T, dy).T
        slope[part] = degrees(east, south)
    if voids:
        slope[missing] = np.nan
    return slope


def _derivative(heights: Floats, cell: float) -> Floats:
    """Return the derivative along the second axis, without the rim of `TERMS`."""
    step = heights[:, 1:] - heights[:, :-1]
    ahead = _geometric_sum(step[:, TERMS:])
    behind = _geometric_sum(step[:, :-TERMS][:, ::-1])[:, ::-1]
    ahead += behind
    # Exact on planes, whatever the series leaves out.
    ahead *= np.float32(0.5 * (1 - POLE) / (1 - POLE**TERMS) / cell)
    return ahead


def _geometric_sum(values: Floats) -> Floats:
    """Return the sum of z^k values[i + k], k < `TERMS`, along the second axis: each step doubles how many."""
    power, width = POLE, 1
    while width < TERMS:
        values = values[:, :-width] + np.float32(power) * values[:, width:]
        power, width = power * power, 2 * width
    return values
