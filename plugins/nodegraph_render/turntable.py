"""Turntables: circles around a model."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np

from nodegraph import Forecast, Param, node
from nodegraph_render.camera import Point, fitted, height_range
from nodegraph_render.camera_path import CameraPath, Length
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.raster import Elevation

ALONG = 72
"""Knots of a circle: cubics through them are off by 1.5e-7 of the radius."""


@node(version=1)
def turntable(
    ground: Elevation | None = None,
    *,
    target: Annotated[
        Point | None, Param("What it goes around: x, y, z; none: the middle of the linked raster.", unit="m")
    ] = None,
    distance: Annotated[
        float | None, Param("From eye to target; none: all of the linked raster fits.", gt=0, le=1e8, unit="m")
    ] = None,
    pitch: Annotated[float, Param("How far down the camera looks.", ge=-89, le=89, unit="deg")] = 30.0,
    azimuth: Annotated[
        float, Param("Direction in which it looks first, clockwise from north.", ge=-360, le=360, unit="deg")
    ] = 0.0,
    turns: Annotated[float, Param("How often it goes around; negative: the other way.", ge=-1000, le=1000)] = 1.0,
    duration: Annotated[float, Param("Of the path.", gt=0, le=1e6, unit="s")] = 12.0,
    field_of_view: Annotated[
        float, Param("Angle that the height of the picture spans.", ge=0.01, le=170, unit="deg")
    ] = 35.0,
    aspect: Annotated[float, Param("Width over height of the picture that has to fit.", gt=0, le=1000)] = 16 / 9,
) -> CameraPath:
    """Turn a model before a camera: a circle around a target, always looking at it, at an even speed.

    Without a `distance` it is the least at which the box around the linked raster is in the picture all the way round.

    Args:
        ground: gives what is not stated.
        target, distance, pitch: place the circle.
        azimuth, turns, duration: of the movement; the view turns clockwise for positive turns, the terrain the
            other way.  Whole turns make a closed path.
        field_of_view, aspect: of the camera.

    Raises:
        ValueError: neither a raster nor what it would give is stated, the raster is in degrees or void, or `turns`
            is 0.
    """
    if turns == 0:
        raise ValueError("a turntable that makes 0 turns stands still; give 1, or use render.camera")
    box: tuple[tuple[float, float, float, float], float, float] | None = None
    if ground is not None and (target is None or distance is None):
        require_projected(ground)
        extent = ground.extent
        box = (extent.west, extent.south, extent.east, extent.north), *height_range(ground)
    if box is None and (target is None or distance is None):
        raise ValueError("nothing says what to go around; give target and distance, or link an elevation")
    if target is None and box is not None:
        (west, south, east, north), low, high = box
        target = (west + east) / 2, (south + north) / 2, (low + high) / 2
    assert target is not None
    if distance is None and box is not None:
        distance = _around(box, target, pitch, field_of_view, aspect)
    assert distance is not None
    count = math.ceil(ALONG * abs(turns)) + 1
    heading = np.radians(azimuth) + np.linspace(0, 2 * np.pi * turns, count)
    level, turning = distance * math.cos(math.radians(pitch)), 2 * np.pi * turns / duration
    values, rates = np.zeros((count, 7)), np.zeros((count, 7))
    values[:, 0], values[:, 1] = target[0] - level * np.sin(heading), target[1] - level * np.cos(heading)
    rates[:, 0], rates[:, 1] = -level * turning * np.cos(heading), level * turning * np.sin(heading)
    values[:, 2] = target[2] + distance * math.sin(math.radians(pitch))
    values[:, 3:6], values[:, 6] = target, field_of_view
    closed = float(turns).is_integer()
    if closed:
        values[-1], rates[-1] = values[0], rates[0]
    return CameraPath(np.linspace(0, duration, count), values, rates, closed)


@turntable.forecast
def _turntable_forecast(*_: Forecast | None, duration: float, turns: float, **__: object) -> Forecast:
    return Forecast(0, about=Length(duration, float(turns).is_integer()))


def _around(
    box: tuple[tuple[float, float, float, float], float, float],
    target: Point,
    pitch: float,
    field_of_view: float,
    aspect: float,
) -> float:
    """Return the distance from a target at which a box is in the picture from all sides."""
    (west, south, east, north), low, high = box
    corners = np.array([(x, y, z) for x in (west, east) for y in (south, north) for z in (low, high)]) - target
    half = math.tan(math.radians(field_of_view) / 2) * 0.98
    found = 0.0
    for heading in range(360):
        right, up, forward = fitted(*box, heading, pitch).axes
        x, y, z = corners @ right, corners @ up, corners @ forward
        found = max(found, float((np.abs(x) / (half * aspect) - z).max()), float((np.abs(y) / half - z).max()))
    return found
