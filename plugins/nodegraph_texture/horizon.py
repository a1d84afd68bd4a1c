"""Horizons: how high the ground stands around every cell, in one direction at a time.

Near a cell every grid line that the ray crosses counts, with heights linear between the two cells beside it, as in
`nodegraph_terrain.shadows`.  Farther away the ground is looked at in coarser steps, which grow with the distance: a
step stands for the highest ground that it passes over.  A direction so takes some hundred steps, however large the
raster.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.shadows import trace

Floats = npt.NDArray[np.float32]

NEAR = 64
"""Crossings that are looked at one by one; behind them steps double where the distance does."""

LOWEST = math.tan(math.radians(0.5))
"""Tangent of the lowest horizon that is followed to its end: what stands lower dims the ground by no thousandth."""

VOID = np.float32(-1e6)
"""Stands for heights that are not known, m: ground that hides nothing."""


@dataclass(frozen=True, slots=True)
class Pyramid:
    """The ground at growing steps.

    Attributes:
        levels: heights, m, `VOID` where not known; level k > 0 has the highest of 2^k by 2^k cells around each.
        relief: greatest minus least known height, m.
    """

    levels: Sequence[Floats]
    relief: float


@dataclass(frozen=True, slots=True)
class Step:
    """One look along a ray, at (1 - fraction) z(cell + near) + fraction z(cell + far) of a level, `distance` m away."""

    level: int
    near: tuple[int, int]
    far: tuple[int, int]
    fraction: float
    distance: float


def pyramid(heights: Floats) -> Pyramid:
    """Return the ground at the steps that rays over it take.

    Args:
        heights: (rows, cols) float32, m, NaN where void; finite elsewhere.
    """
    from scipy.ndimage import maximum_filter

    known = heights[~np.isnan(heights)]
    relief = float(known.max() - known.min()) if known.size else 0.0
    levels = [np.where(np.isnan(heights), VOID, heights)]
    for level in range(1, level_count((heights.shape[0], heights.shape[1]))):
        levels.append(maximum_filter(levels[0], (1 << level) + 1, mode="constant", cval=VOID))
    return Pyramid(levels, relief)


def level_count(shape: tuple[int, int]) -> int:
    """Return how many levels rays over a raster look at: those of 1, 2, 4, ... cells."""
    count = 1
    while NEAR << count < 4 * max(shape):
        count += 1
    return count


def steps(azimuth: float, cell: tuple[float, float], shape: tuple[int, int], relief: float) -> list[Step]:
    """Return where to look along a ray, nearest first.

    Args:
        azimuth: degrees clockwise from the grid's north.
        cell: (width, height) of a cell, m.
        shape: (rows, cols) of the raster.
        relief: greatest minus least height, m.
    """
    if relief <= 0 or max(shape) < 2:
        return []
    ray = trace(azimuth, cell, shape, relief / LOWEST)
    found: list[Step] = []
    crossing, level = 0, 0
    while crossing < len(ray):
        near, far = ((int(place[0]), int(place[1])) for place in (ray.near[crossing], ray.far[crossing]))
        fraction = float(ray.fraction[crossing])
        if level:
            near = far = far if fraction > 0.5 else near
            fraction = 0.0
        found.append(Step(level, near, far, fraction, float(ray.distance[crossing])))
        level = max(0, (crossing // NEAR).bit_length())
        crossing += 1 << level
    return found


def horizon(ground: Pyramid, look: Sequence[Step], rows: slice, context: Context) -> Floats:
    """Return the tangent of the height angle of the horizon for some rows; 0 where nothing stands above the level.

    Args:
        ground: the whole surface.
        look: where along the ray, from `steps`.
        rows: the rows to return.
        context: for cancellation.
    """
    first, last, _ = rows.indices(ground.levels[0].shape[0])
    height, width = ground.levels[0].shape
    here = ground.levels[0][first:last]
    highest = np.zeros(here.shape, np.float32)
    one, other = np.empty((2, *here.shape), np.float32)
    for step in look:
        (i, j), (m, n) = step.near, step.far
        r0, r1 = max(first, -min(i, m)), min(last, height - max(i, m))
        c0, c1 = max(0, -min(j, n)), min(width, width - max(j, n))
        if r0 >= r1 or c0 >= c1:
            continue
        level = ground.levels[step.level]
        a, b = one[: r1 - r0, : c1 - c0], other[: r1 - r0, : c1 - c0]
        if step.fraction > 0:
            np.multiply(level[r0 + i : r1 + i, c0 + j : c1 + j], np.float32(1 - step.fraction), out=a)
            np.multiply(level[r0 + m : r1 + m, c0 + n : c1 + n], np.float32(step.fraction), out=b)
            a += b
            a -= here[r0 - first : r1 - first, c0:c1]
        else:
            np.subtract(level[r0 + i : r1 + i, c0 + j : c1 + j], here[r0 - first : r1 - first, c0:c1], out=a)
        a *= np.float32(1 / step.distance)
        target = highest[r0 - first : r1 - first, c0:c1]
        np.maximum(target, a, out=target)
    context.progress(None)
    return highest


def whole_horizon(heights: Floats, azimuth: float, cell: tuple[float, float], context: Context) -> Floats:
    """Return the tangent of the height angle of the horizon in one direction, of every cell; as `horizon`."""
    ground = pyramid(heights)
    look = steps(azimuth, cell, (heights.shape[0], heights.shape[1]), ground.relief)
    result = np.empty(heights.shape, np.float32)
    for part in row_blocks(heights.shape[0], heights.shape[1], context):
        result[part] = horizon(ground, look, part, context)
    return result
