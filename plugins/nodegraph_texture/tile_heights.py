"""How high the ground of a tile can be: what culling and the distance of an eye need to know before it is painted."""

from __future__ import annotations

import math

from nodegraph_terrain.interpolation import REACH
from nodegraph_terrain.raster import Extent
from nodegraph_texture.sampling import Level, Pyramid
from nodegraph_texture.scene import Scene
from nodegraph_tree.function import THRESHOLD, Box

Range = tuple[float, float]

FINEST = (1e-9, 1e-9)
"""Texels that no cell of a raster is smaller than, m."""


def height_range(scene: Scene, box: Extent) -> Range | None:
    """Return bounds of the heights in a box, with the bumps of all layers, m; None where there certainly is no ground.

    A spline lies between the least and the greatest of its coefficients there (its basis is positive and adds up to
    1), a construction tree between its own bounds, and bumps are no higher than the roughness of all layers together.
    """
    bumps = sum(abs(step.layer.roughness) for step in scene.steps)
    if isinstance(scene.ground, Pyramid):
        found = _spline_range(scene.ground.level_for(FINEST), box)
    else:
        bounds = scene.ground.bounds(Box(box.west, box.south, box.east, box.north))
        absent = bounds.absent or bounds.weight_high < THRESHOLD
        found = None if absent else (bounds.low, bounds.high)
    return None if found is None else (found[0] - bumps, found[1] + bumps)


def _spline_range(level: Level, box: Extent) -> Range | None:
    across = _cells(box.west - level.west, box.east - level.west, level.cell[0], level.shape[1])
    down = _cells(level.north - box.north, level.north - box.south, level.cell[1], level.shape[0])
    if across is None or down is None:
        return None
    if level.missing is not None and level.missing[down[0] : down[1], across[0] : across[1]].all():
        return None
    # A texel reads up to two cells beyond the one that it lies in.
    rows, cols = (slice(first + REACH - 2, last + REACH + 2) for first, last in (down, across))
    part = level.values[rows, cols]
    return float(part.min()), float(part.max())


def _cells(start: float, stop: float, cell: float, count: int) -> tuple[int, int] | None:
    """Return the first cell that meets an interval and the one after the last, or None; rounding adds a cell."""
    first, last = max(0, math.floor(start / cell - 1e-6)), min(count, math.ceil(stop / cell + 1e-6))
    return (first, last) if first < last else None
