"""The camera: from where a terrain is seen."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from typing import Annotated

import numpy as np

from nodegraph import Param, node, port_type
from nodegraph_render.rays import Doubles, Rays
from nodegraph_render.sampling import bilinear
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.raster import Elevation

Point = tuple[float, float, float]
Edges = tuple[float, float, float, float]

FRAME_HEIGHT = 24.0
"""Height of a frame of 35 mm film, mm, in terms of which focal lengths are stated."""


@port_type
class Camera:
    """A pinhole or an orthographic camera in a scene with x east, y north, z up, m.

    Attributes:
        eye: where it stands, m.
        target: a point straight ahead, m: the middle of the picture unless there is a `rise`.
        up: the direction that is up in the picture; not along the view.
        field_of_view: angle that the height of the picture spans, degrees; 0 makes the camera orthographic.
        span: metres that the height of the picture spans, for an orthographic camera.
        rise: how far the picture is shifted up on the image plane, in parts of its height, as by a shift lens;
            `field_of_view` is then that of the same picture in the middle.
    """

    eye: Point
    target: Point
    up: Point = (0.0, 0.0, 1.0)
    field_of_view: float = 45.0
    span: float = 0.0
    rise: float = 0.0

    def __post_init__(self) -> None:
        numbers = (*self.eye, *self.target, *self.up, self.field_of_view, self.span, self.rise)
        if not all(map(math.isfinite, numbers)):
            raise ValueError("a camera needs finite numbers")
        if not 0 <= self.field_of_view < 180:
            raise ValueError(f"a field of view of {self.field_of_view:g} degrees is not possible; give 0 to 179")
        if self.field_of_view == 0 and self.span <= 0:
            raise ValueError("an orthographic camera needs a span above 0 m")
        view, up = np.subtract(self.target, self.eye), np.asarray(self.up, np.float64)
        if not view.any():
            raise ValueError("the camera's eye and target are the same point; move one of them")
        if np.linalg.norm(np.cross(view, up)) <= 1e-9 * np.linalg.norm(view) * np.linalg.norm(up):
            raise ValueError("the camera looks along its up direction; give another up, such as north [0, 1, 0]")

    @cached_property
    def axes(self) -> tuple[Doubles, Doubles, Doubles]:
        """Unit vectors to the right, up and forward in the picture."""
        forward = np.subtract(self.target, self.eye).astype(np.float64)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right /= np.linalg.norm(right)
        return right, np.cross(right, forward), forward

    @property
    def half_height(self) -> float:
        """Half of the picture's height on the image plane: 1 m ahead, or anywhere if orthographic, m."""
        return math.tan(math.radians(self.field_of_view) / 2) if self.field_of_view else self.span / 2

    def rays(self, rows: int, cols: int, first: int = 0, last: int | None = None) -> Rays:
        """Return the rays through the centres of the pixels of some rows of a picture, row by row from the top.

        Args:
            rows, cols: size of the whole picture, pixels, which are square.
            first, last: the rows to return, `last` excluded; by default all.
        """
        right, up, forward = self.axes
        last = rows if last is None else last
        half = self.half_height
        v = (1 + 2 * self.rise - (2 * np.arange(first, last) + 1) / rows) * half
        u = ((2 * np.arange(cols) + 1) / cols - 1) * half * cols / rows
        plane = (v[:, None, None] * up + u[None, :, None] * right).reshape(-1, 3)
        eye = np.asarray(self.eye, np.float64)[None]
        if not self.field_of_view:
            return Rays(eye + plane, forward[None])
        plane += forward
        plane /= np.sqrt(np.einsum("ij,ij->i", plane, plane))[:, None]
        return Rays(eye, plane)

    def band(self, rows: int, first: int, last: int) -> Camera:
        """Return the camera whose whole picture is the rows from `first` to `last` of this one's, of `rows` rows."""
        share = (last - first) / rows
        rise = ((1 - (first + last) / rows) / 2 + self.rise) / share
        if not self.field_of_view:
            return replace(self, span=self.span * share, rise=rise)
        return replace(self, field_of_view=math.degrees(2 * math.atan(self.half_height * share)), rise=rise)


@node(version=1)
def camera(
    ground: Elevation | None = None,
    *,
    eye: Annotated[Point | None, Param("Where the camera stands: x, y, z; none: far enough to fit.", unit="m")] = None,
    target: Annotated[Point | None, Param("What it looks at, with an eye: x, y, z.", unit="m")] = None,
    azimuth: Annotated[
        float, Param("Direction in which a fitted camera looks, clockwise from north.", ge=-360, le=360, unit="deg")
    ] = 0.0,
    pitch: Annotated[
        float, Param("How far down a fitted camera looks: 0 level, 90 straight down.", ge=-90, le=90, unit="deg")
    ] = 30.0,
    extent: Annotated[
        Edges | None, Param("West, south, east, north of what to fit; none: those of the linked raster.", unit="m")
    ] = None,
    low: Annotated[float | None, Param("Lowest height to fit; none: the linked raster's.", unit="m")] = None,
    high: Annotated[float | None, Param("Highest height to fit; none: the linked raster's.", unit="m")] = None,
    aspect: Annotated[float, Param("Width over height of the picture that has to fit.", gt=0, le=1000)] = 16 / 9,
    margin: Annotated[float, Param("Share of the frame left free on each side.", ge=0, le=0.45)] = 0.01,
    field_of_view: Annotated[
        float | None, Param("Angle that the height of the picture spans; none: 45.", ge=0.01, le=170, unit="deg")
    ] = None,
    focal_length: Annotated[
        float | None, Param("Instead, that of a lens in front of a 36 mm x 24 mm frame.", ge=1, le=1e5, unit="mm")
    ] = None,
    orthographic: Annotated[bool, Param("Parallel rays, as on a map: what is far is no smaller.")] = False,
    span: Annotated[
        float | None, Param("Height of an orthographic picture with an eye.", gt=0, le=1e8, unit="m")
    ] = None,
    roll: Annotated[float, Param("Turn of the camera around its view, clockwise.", ge=-360, le=360, unit="deg")] = 0.0,
) -> Camera:
    """Place a camera: by eye and target, or so that a box is in the picture as large as it can be.

    With an `eye` and a `target` it stands there.  Without, it looks along `azimuth` and `pitch` from where all eight
    corners of a box lie in a frame of the stated `aspect`, less `margin` on each side, and touch it: with p = (x, y, z)
    the corners along its right, up and forward axes and s the slope of the frame's edge, its eye e is as far forward as
    x - s z <= e_x - s e_z and -x - s z <= -e_x - s e_z allow for all p, and the same up and down.

    A focal length f (mm) is that on 35 mm film, whose frame is 24 mm high: field of view = 2 atan(12 / f).

    Args:
        ground: gives the box to fit, its extent and heights, where they are not stated; a camera below it is refused.
        eye, target: both or none.
        azimuth, pitch, extent, low, high, aspect, margin: of a fitted camera.
        field_of_view, focal_length: one of them at most.
        orthographic, span: a span makes the camera orthographic, too; a fitted one finds its own.
        roll: the picture turns the other way.

    Raises:
        ValueError: eye and target are one point, one of them is missing, there is nothing to fit, the eye is under the
            linked ground, or what is stated contradicts itself.
    """
    if ground is not None:
        require_projected(ground)
    if field_of_view is not None and focal_length is not None:
        raise ValueError("field of view and focal length say the same; give one of them")
    if (orthographic or span is not None) and (field_of_view is not None or focal_length is not None):
        raise ValueError("an orthographic camera has no field of view and no focal length; give it a span")
    angle = angle_of(focal_length) if focal_length is not None else 45.0 if field_of_view is None else field_of_view
    if (eye is None) != (target is None):
        raise ValueError("a camera is placed by eye and target; give both, or none to fit it to an extent")
    if eye is None or target is None:
        if span is not None:
            raise ValueError("a fitted camera finds its own span; give eye and target, or only 'orthographic'")
        box = _box(ground, extent, low, high)
        placed = fitted(*box, azimuth, pitch, roll, 0.0 if orthographic else angle, aspect, margin)
    else:
        if extent is not None or low is not None or high is not None:
            raise ValueError("a camera with an eye is not fitted; leave out extent, low and high, or the eye")
        if orthographic and span is None:
            raise ValueError("an orthographic camera with an eye needs a span, the metres that its picture is high")
        placed = looking(eye, target, 0.0 if span else angle, span or 0.0, roll)
    if ground is not None:
        _check_above(ground, placed.eye)
    return placed


def angle_of(focal_length: float) -> float:
    """Return the vertical field of view, degrees, of a focal length in terms of 35 mm film, mm."""
    return math.degrees(2 * math.atan(FRAME_HEIGHT / 2 / focal_length))


def looking(eye: Point, target: Point, field_of_view: float, span: float = 0.0, roll: float = 0.0) -> Camera:
    """Return a camera by eye and target; north is up where it looks straight down or up."""
    upright = math.hypot(target[0] - eye[0], target[1] - eye[1]) <= 1e-6 * math.dist(eye, target)
    placed = Camera(eye, target, (0.0, 1.0, 0.0) if upright else (0.0, 0.0, 1.0), field_of_view, span)
    if roll == 0:
        return placed
    right, up, _ = placed.axes
    turn = math.radians(roll)
    return replace(placed, up=_point(up * math.cos(turn) + right * math.sin(turn)))


def fitted(
    extent: Edges,
    low: float,
    high: float,
    azimuth: float,
    pitch: float,
    roll: float = 0.0,
    field_of_view: float = 45.0,
    aspect: float = 16 / 9,
    margin: float = 0.0,
) -> Camera:
    """Return the camera that shows a box as large as its frame can; see `camera`.

    Args:
        extent, low, high: the box, m.
        azimuth, pitch, roll: of the view, degrees.
        field_of_view: degrees; 0: orthographic.
        aspect: width over height of the picture.
        margin: share of the frame left free on each side.
    """
    west, south, east, north = extent
    corners = np.array([(x, y, z) for x in (west, east) for y in (south, north) for z in (low, high)])
    middle = corners.mean(axis=0)
    right, up, forward = _axes(azimuth, pitch, roll)
    # Relative to the middle: coordinates of projected systems are millions of metres.
    x, y, z = ((corners - middle) @ axis for axis in (right, up, forward))
    reach = float(np.abs(z).max())
    size = float(max(np.ptp(x) / aspect, np.ptp(y))) / (1 - 2 * margin)
    if not field_of_view:
        # Nothing is near an orthographic camera; it only has to be in front of the box.
        away = reach + max(size, 1.0)
        eye = middle - away * forward
        return Camera(_point(eye), _point(middle), _point(up), 0.0, max(size, 1e-3))
    half = math.tan(math.radians(field_of_view) / 2) * (1 - 2 * margin)
    slopes, backs, middles = (half * aspect, half), [], []
    for across, slope in zip((x, y), slopes, strict=True):
        positive, negative = (across - slope * z).max(), (-across - slope * z).max()
        backs.append(-(positive + negative) / (2 * slope))
        middles.append((positive - negative) / 2)
    tight = int(np.argmin(backs))
    nearest = min(backs[tight], float(z.min()) - 1e-6 * reach - 1e-3)
    # In a wide frame the closest eye may be a corner of the box, which it could not see: it steps back, and as far
    # aside as this lets it, so that the corner touches the frame.
    middles[tight] += slopes[tight] * (backs[tight] - nearest)
    eye = middle + middles[0] * right + middles[1] * up + nearest * forward
    return Camera(_point(eye), _point(eye - nearest * forward), _point(up), field_of_view)


def _axes(azimuth: float, pitch: float, roll: float) -> tuple[Doubles, Doubles, Doubles]:
    """Return unit vectors to the right, up and forward of a view."""
    heading, down, turn = map(math.radians, (azimuth, pitch, roll))
    right = np.array([math.cos(heading), -math.sin(heading), 0.0])
    level = np.array([math.sin(heading), math.cos(heading), 0.0])
    forward = math.cos(down) * level - np.array([0.0, 0.0, math.sin(down)])
    up = np.cross(right, forward)
    return (
        right * math.cos(turn) - up * math.sin(turn),
        up * math.cos(turn) + right * math.sin(turn),
        forward,
    )


def _box(
    ground: Elevation | None, extent: Edges | None, low: float | None, high: float | None
) -> tuple[Edges, float, float]:
    """Return extent and heights of the box to fit."""
    if ground is None:
        if extent is None or low is None or high is None:
            raise ValueError("there is nothing to fit; link an elevation, state extent, low and high, or give an eye")
    else:
        own = ground.extent
        extent = extent or (own.west, own.south, own.east, own.north)
        if low is None or high is None:
            low_of_ground, high_of_ground = height_range(ground)
            low, high = low_of_ground if low is None else low, high_of_ground if high is None else high
    west, south, east, north = extent
    if west >= east or south >= north:
        raise ValueError(f"the extent {list(extent)} must be west, south, east, north with east > west, north > south")
    if low > high:
        raise ValueError(f"the lowest height to fit, {low:g} m, is above the highest, {high:g} m")
    return extent, low, high


def height_range(ground: Elevation) -> tuple[float, float]:
    """Return the lowest and the highest height of a raster; `ValueError` where all of it is void."""
    known = ground.data[np.isfinite(ground.data)]
    if known.size == 0:
        raise ValueError("the linked elevation is void everywhere; link one with heights")
    return float(known.min()), float(known.max())


def _check_above(ground: Elevation, eye: Point) -> None:
    height = float(bilinear(ground, np.array([eye[0]]), np.array([eye[1]]))[0])
    if eye[2] < height:
        x, y, z = eye
        raise ValueError(
            f"the camera's eye ({x:g}, {y:g}, {z:g}) is under the ground, {height:g} m high there; raise it"
        )


def _point(values: Doubles) -> Point:
    return float(values[0]), float(values[1]), float(values[2])
