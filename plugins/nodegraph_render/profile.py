"""Heights of a raster along a line."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node
from nodegraph_render.sampling import bilinear
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.polylines import Polylines, reprojected
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_tree.evaluate import Profile

SAMPLES_MAX = 10_000_000
"""More samples along a line are refused as a mistake."""


@node(version=1)
def profile(
    surface: Elevation,
    line: Polylines | None = None,
    *,
    points: Annotated[
        tuple[tuple[float, float], ...], Param("Corners [x, y] of the line, instead of a linked one.", unit="m")
    ] = (),
    line_number: Annotated[int, Param("Which of the linked lines.", ge=0)] = 0,
    spacing: Annotated[
        float | None, Param("Distance between samples along the line; none: the side of a cell.", gt=0, unit="m")
    ] = None,
    context: Context,
) -> Profile:
    """Sample a raster along a line: a profile.

    Samples stand at equal distances along the line, and at its end.  Heights are bilinear between the centres of cells
    and constant from the outer centres to the edge.  A sample is void outside of the raster, and where one of the
    centres around it is.

    Args:
        surface: elevation in metres, on a grid in metres.
        line: lines, of which one is followed; brought to the system of the surface where it has another.
        points: the corners of the line, in coordinates of the surface.
        line_number: which of the linked lines.
        spacing: between samples.
        context: the engine's.

    Returns:
        The profile, as tree.query gives it: weight 1 where a height is known, else 0.

    Raises:
        ValueError: the line is not given, or given twice; it has no length, or nowhere a height.
    """
    cell = require_projected(surface)
    corners = _corners(surface.extent, line, points, line_number)
    legs = np.hypot(*np.diff(corners, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(legs)])
    length = float(along[-1])
    if length == 0:
        raise ValueError("the line has no length; give two different points at least")
    step = spacing if spacing is not None else min(cell)
    if length / step > SAMPLES_MAX:
        raise ValueError(f"{length:g} m in steps of {step:g} m are too many samples; widen the spacing")
    distance = np.append(np.arange(0.0, length * (1 - 1e-12), step), length)
    x, y = (np.interp(distance, along, corners[:, axis]) for axis in (0, 1))
    context.progress(0.3)
    height = bilinear(surface, x, y)
    known = ~np.isnan(height)
    if not known.any():
        raise ValueError("the line meets no height of the surface; check its coordinates and system")
    return Profile(distance, x, y, height, known.astype(np.float64))


def _corners(
    extent: Extent, line: Polylines | None, points: tuple[tuple[float, float], ...], chosen: int
) -> npt.NDArray[np.float64]:
    if (line is None) == (not points):
        raise ValueError("the line is missing or given twice; either link `line` or give points")
    if line is None:
        if len(points) < 2:
            raise ValueError("a line takes two points at least")
        return np.array(points, np.float64)
    if chosen >= len(line):
        raise ValueError(f"there is no line {chosen}; the linked ones are 0 to {len(line) - 1}")
    picked = line.take([chosen])
    if picked.crs and extent.crs and picked.crs != extent.crs:
        picked = reprojected(picked, extent.crs)
    if picked.unit != extent.unit:
        raise ValueError("the line is in degrees and the surface in metres; give both a coordinate system")
    return picked.points[:, :2]
