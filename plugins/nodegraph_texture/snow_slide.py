"""Snow that slides off steep ground and comes to rest below.

Source: S. Gruber (2007): A mass-conserving fast algorithm to parameterize gravitational transport and deposition using
digital elevation models. doi:10.1029/2006WR004868; that a slope holds less the steeper it is: M. Bernhardt, K. Schulz
(2010): SnowSlide: A simple routine for calculating gravitational snow transport. doi:10.1029/2010GL043086; the numbers
of its curve, vertical metres by degrees: C. B. Marsh, J. W. Pomeroy, H. S. Wheater (2020): The Canadian Hydrological
Model (CHM) v1.0, doi:10.5194/gmd-13-225-2020, and its source.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph import Context

Doubles = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

NEIGHBOURS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j)

SMALLEST = 1e-3
"""Moving snow that is left where it is, mm: less than what is seen."""


def holding(slope: Floats, density: float) -> Doubles:
    """Return how much snow of a density in kg/m3 a slope in degrees can hold, mm of water: 3178.4 slope^-1.998 m."""
    return np.asarray(density * 3178.4 * np.maximum(slope.astype(np.float64), 0.1) ** -1.998)


def slide(
    snow: Floats, heights: Floats, slope: Floats, density: float, cell: tuple[float, float], context: Context
) -> Floats:
    """Return snow after what ground cannot hold has slid to lower ground; none is lost.

    What is too much for a cell goes to its lower neighbours, in proportion to their steepness, and on from there; a
    cell without any keeps it.  So do the border and the rim of voids towards outside.

    Args:
        snow: mm of water, NaN where void.
        heights: m, NaN where void.
        slope: degrees.
        density: of settled snow, kg/m3.
        cell: (width, height), m.
        context: the engine's.
    """
    rows, cols = heights.shape
    settled = np.where(np.isnan(snow), 0, snow).astype(np.float64).ravel()
    room = np.where(np.isnan(slope), np.inf, holding(slope, density)).ravel()
    height = heights.astype(np.float64).ravel()
    # What moves, and where it is: a list of cells, as few are steep.
    flat = np.flatnonzero(settled > room + SMALLEST)
    moving = settled[flat] - room[flat]
    settled[flat] = room[flat]
    rounds = 0
    while len(flat):
        rounds += 1
        if rounds % 16 == 0:
            context.progress(None)
        row, col = np.divmod(flat, cols)
        falls = np.zeros((len(NEIGHBOURS), len(flat)))
        goals = np.empty(falls.shape, np.intp)
        for (i, j), fall, goal in zip(NEIGHBOURS, falls, goals, strict=True):
            inside = (row + i >= 0) & (row + i < rows) & (col + j >= 0) & (col + j < cols)
            goal[:] = np.where(inside, flat + i * cols + j, flat)
            drop = (height[flat] - height[goal]) / np.hypot(i * cell[1], j * cell[0])
            np.copyto(fall, drop, where=drop > 0)
        total = falls.sum(axis=0)
        settled[flat[total == 0]] += moving[total == 0]
        share = falls * (moving / np.where(total > 0, total, 1))
        arrived = np.bincount(goals.ravel(), share.ravel(), rows * cols)
        flat = np.flatnonzero(arrived)
        moving = np.asarray(arrived[flat], np.float64)
        # What finds room ends here; the rest goes on.
        taken = np.minimum(moving, np.maximum(room[flat] - settled[flat], 0))
        taken = np.where(moving - taken > SMALLEST, taken, moving)
        settled[flat] += taken
        moving -= taken
        flat, moving = flat[moving > 0], moving[moving > 0]
    return np.where(np.isnan(snow), np.nan, settled.reshape(rows, cols)).astype(np.float32)
