"""Paths of cameras: flights from key frame to key frame, and turntables."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from nodegraph import Forecast, Param, node, port_type
from nodegraph_render.camera import Camera, Point, fitted, height_range, looking
from nodegraph_render.rays import Doubles
from nodegraph_render.sampling import bilinear
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.raster import Elevation

Curve = Literal["smooth", "monotone"]

FINE = 128
"""Knots, at least, between two key frames of a path that keeps a speed, eases or keeps clear of the ground."""
KNOTS = 100_000
"""Knots of a path at most."""
SPARE = 2e-3
"""Cells of the ground by which the eye is raised beyond the clearance."""
CHANGE = 0.1
"""By how much of itself the velocity may change from knot to knot where a path keeps a speed."""
HALVINGS = 20
"""How often the time between two knots is halved for that; what is sharper still is a cusp."""
ALONG = 72
"""Knots of a circle: cubics through them are off by 1.5e-7 of the radius."""


@port_type
class CameraPath:
    """A camera that moves: cubic between knots, and C1 at each.

    Attributes:
        time: when it passes each knot, increasing from 0, s, (n,) float64.
        places: eye x, y, z, target x, y, z, m, and field of view, degrees, at each knot, (n, 7) float64.
        rates: how fast these change there, per second, (n, 7) float64.
        closed: it ends as it begins, and may be repeated without a jolt.
    """

    time: Doubles
    places: Doubles
    rates: Doubles
    closed: bool = False

    @property
    def duration(self) -> float:
        """Seconds from the beginning to the end."""
        return float(self.time[-1])

    def at(self, time: float | Doubles) -> Doubles:
        """Return eye, target and field of view at some times, (..., 7)."""
        return np.asarray(self._curve(time), np.float64)

    def velocity(self, time: float | Doubles) -> Doubles:
        """Return how fast these change, per second, (..., 7)."""
        return np.asarray(self._curve(time, 1), np.float64)

    def camera(self, time: float) -> Camera:
        """Return the camera at a time, s; north is up in a picture straight down."""
        ex, ey, ez, tx, ty, tz, angle = map(float, self.at(min(max(time, 0.0), self.duration)))
        return looking((ex, ey, ez), (tx, ty, tz), angle)

    @cached_property
    def _curve(self) -> Any:
        from scipy.interpolate import CubicHermiteSpline

        return CubicHermiteSpline(self.time, self.places, self.rates)


class Length(NamedTuple):
    """What is known of a path before it is made: `Forecast.about` of one."""

    seconds: float
    closed: bool


@dataclass(frozen=True)
class KeyFrame:
    """Where a camera is at one time.

    Attributes:
        time: s.
        eye, target: x, y, z, m.
        field_of_view: degrees, of the picture's height.
    """

    time: float
    eye: Point
    target: Point
    field_of_view: float = 45.0


@node(version=1)
def path(
    ground: Elevation | None = None,
    *,
    keys: Annotated[
        list[KeyFrame],
        Param("Key frames: time (s), eye and target [x, y, z] (m), field_of_view (degrees, 45).", min_length=2),
    ],
    curve: Annotated[Curve, Param("Round and even, or never beyond the key frames around.")] = "smooth",
    closed: Annotated[bool, Param("End as it begins; the last key frame repeats the first.")] = False,
    constant_speed: Annotated[bool, Param("Fly evenly; of the times only the first and last then count.")] = False,
    ease: Annotated[float, Param("Share of the time in which it gathers speed, and loses it.", ge=0, le=0.5)] = 0.0,
    clearance: Annotated[
        float, Param("Least height of the eye above the linked ground.", ge=0, le=1e5, unit="m")
    ] = 20.0,
) -> CameraPath:
    """Fly a camera smoothly through key frames.

    ``smooth`` is the cubic spline through the eyes and targets, C2, natural at its ends (periodic if `closed`), which
    may swing beyond the key frames; ``monotone`` (PCHIP) is C1 and does not.  The field of view is monotone between key
    frames in either case.

    - `constant_speed` runs through the curve by the length of the eye's way.  The curve is then that of centripetal
      parameters, in which a spline makes no loops.
    - `ease` e makes the speed rise over the first e of the time as 3 u^2 - 2 u^3 and fall as it rose.
    - Where the eye would be less than `clearance` above the linked ground it is raised, as is, by less and less, the
      way for a twentieth of the time before and after: the largest lift needed in that window, smoothed by it.
      Targets stay.  Beside the raster and in voids there is no ground.

    Args:
        ground: what to keep clear of, in metres.
        keys: times increase; the path begins with the first.
        curve, closed, constant_speed, ease, clearance: see above.

    Raises:
        ValueError: times do not increase, an eye is its own target, there or on the way, a closed path does not end as
            it begins, or a path of constant speed stays somewhere.

    References:
        F. N. Fritsch, J. Butland (1984): A method for constructing local monotone piecewise cubic interpolants. SIAM
        J. Sci. Stat. Comput. 5(2). doi:10.1137/0905021.
        E. T. Y. Lee (1989): Choosing nodes in parametric curve interpolation. Computer-Aided Design 21(6).
        doi:10.1016/0010-4485(89)90003-1.
    """
    if ground is not None:
        require_projected(ground)
    time, places = _checked(keys, closed, constant_speed)
    knots = _centripetal(places) if constant_speed else time
    splines = _splines(knots, places, curve, closed)
    even, fine, along, speed = time, time, knots, np.ones(len(time))
    if constant_speed or ease or ground is not None:
        course = (_evenly if constant_speed else _by_time)(splines, knots)

        def flown(at: Doubles) -> tuple[Doubles, Doubles]:
            way, rate = _eased(at / time[-1], ease)
            along, speed = course(way)
            return along, speed * rate / time[-1]

        even = np.linspace(0, time[-1], _count(ground, splines, knots) + 1)
        fine = _finer(even, lambda at: splines.slope(flown(at)[0])[:, :3]) if constant_speed else even
        along, speed = flown(fine)
    values, rates = splines.value(along), splines.slope(along) * speed[:, None]
    if ground is not None:
        lift = _lift(ground, CameraPath(fine, values, rates, closed), even, clearance)
        values[:, 2] += lift(fine)
        rates[:, 2] += lift(fine, 1)
    made = CameraPath(fine, values, rates, closed)
    _check_apart(made)
    return made


@path.forecast
def _path_forecast(*_: Forecast | None, keys: list[KeyFrame], closed: bool, **__: object) -> Forecast:
    return Forecast(0, about=Length(keys[-1].time - keys[0].time, closed))


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


class _Splines(NamedTuple):
    """The seven coordinates of a camera as a function of a parameter, and their derivatives."""

    value: Callable[[Doubles], Doubles]
    slope: Callable[[Doubles], Doubles]


def _checked(keys: list[KeyFrame], closed: bool, constant_speed: bool) -> tuple[Doubles, Doubles]:
    """Return the times, from 0, and places of key frames that can be flown through."""
    if len(keys) < 2:
        raise ValueError("a path needs two key frames or more")
    time = np.array([key.time for key in keys], np.float64)
    places = np.array([(*key.eye, *key.target, key.field_of_view) for key in keys], np.float64)
    if not (np.isfinite(time).all() and np.isfinite(places).all()):
        raise ValueError("a key frame holds a number that is not finite")
    for number, (before, after) in enumerate(pairwise(keys), 2):
        if after.time <= before.time:
            raise ValueError(f"key frame {number} is at {after.time:g} s, not after the one before it; times increase")
        if constant_speed and after.eye == before.eye:
            raise ValueError(
                f"key frames {number - 1} and {number} have one eye, where a constant speed cannot stay; "
                "move one, or turn constant_speed off"
            )
    for number, key in enumerate(keys, 1):
        if not 0 < key.field_of_view < 180:
            raise ValueError(f"key frame {number} has a field of view of {key.field_of_view:g} degrees; give 1 to 170")
        if key.eye == key.target:
            raise ValueError(f"key frame {number} has one point as eye and target; move one of them")
    if closed and (len(keys) < 3 or not np.array_equal(places[0], places[-1])):
        raise ValueError("a closed path needs three key frames or more, the last of which repeats the first")
    return time - time[0], places


def _centripetal(places: Doubles) -> Doubles:
    steps = np.sqrt(np.linalg.norm(np.diff(places[:, :3], axis=0), axis=1))
    return np.concatenate([[0.0], np.cumsum(steps)])


def _splines(knots: Doubles, places: Doubles, curve: Curve, closed: bool) -> _Splines:
    from scipy.interpolate import CubicSpline, PchipInterpolator

    def monotone(values: Doubles) -> Any:
        if not closed:
            return PchipInterpolator(knots, values)
        # A round before and a round after make the slopes at the join those of an inner knot.
        around = np.concatenate([knots[:-1] - knots[-1], knots, knots[1:] + knots[-1]])
        return PchipInterpolator(around, np.concatenate([values[:-1], values, values[1:]]))

    if curve == "smooth":
        where: Any = CubicSpline(knots, places[:, :6], bc_type="periodic" if closed else "natural")
    else:
        where = monotone(places[:, :6])
    angle = monotone(places[:, 6:])
    return _Splines(
        lambda u: np.concatenate([where(u), angle(u)], axis=1),
        lambda u: np.concatenate([where(u, 1), angle(u, 1)], axis=1),
    )


def _count(ground: Elevation | None, splines: _Splines, knots: Doubles) -> int:
    """Return into how many parts a path is cut: fine ones, and half a cell of the ground at most."""
    count = FINE * (len(knots) - 1)
    if ground is not None:
        way = np.linalg.norm(np.diff(splines.value(np.linspace(0, knots[-1], count))[:, :2], axis=0), axis=1).sum()
        count = max(count, math.ceil(2 * way / min(ground.cell_size)))
    return min(count, KNOTS)


def _eased(share: Doubles, ease: float) -> tuple[Doubles, Doubles]:
    """Return the share of the way done at shares of the time, and its rate."""
    if ease == 0:
        return share, np.ones(len(share))

    def rising(t: Doubles) -> tuple[Doubles, Doubles]:
        u = np.minimum(t / ease, 1)
        return ease * (u**3 - u**4 / 2) + np.maximum(t - ease, 0), u * u * (3 - 2 * u)

    late = share > 0.5
    way, rate = rising(np.where(late, 1 - share, share))
    way = way / (1 - ease)
    return np.where(late, 1 - way, way), rate / (1 - ease)


Course = Callable[[Doubles], tuple[Doubles, Doubles]]
"""From shares of the way to the parameters there, and how fast these pass."""


def _by_time(_: _Splines, knots: Doubles) -> Course:
    """Return the course on which the parameter passes evenly."""
    return lambda way: (way * knots[-1], np.full(len(way), knots[-1]))


def _evenly(splines: _Splines, knots: Doubles) -> Course:
    """Return the course on which the eye is as fast everywhere."""
    from scipy.interpolate import CubicHermiteSpline

    def velocity(u: Doubles) -> Doubles:
        return splines.slope(u)[:, :3]

    def speed(u: Doubles) -> Doubles:
        return np.asarray(np.linalg.norm(velocity(u), axis=1))

    parameter = np.concatenate([np.linspace(a, b, 4 * FINE, endpoint=False) for a, b in pairwise(knots)] + [knots[-1:]])
    parameter = _finer(parameter, velocity)
    middle, half = (parameter[1:] + parameter[:-1]) / 2, np.diff(parameter) / 2
    # Gauss-Legendre quadrature of two points.
    pieces = half * (speed(middle - half / math.sqrt(3)) + speed(middle + half / math.sqrt(3)))
    length = np.concatenate([[0.0], np.cumsum(pieces)])
    fast = speed(parameter)
    slowest = int(np.argmin(fast))
    if fast[slowest] <= 1e-6 * length[-1] / knots[-1]:
        x, y, z = splines.value(parameter[slowest : slowest + 1])[0, :3]
        raise ValueError(
            f"the path stops to turn back at ({x:g}, {y:g}, {z:g}), where a constant speed cannot; "
            "lead it round a bend, or turn constant_speed off"
        )
    parameter_at = CubicHermiteSpline(length, parameter, 1 / fast)

    def course(way: Doubles) -> tuple[Doubles, Doubles]:
        along = np.asarray(parameter_at(way * length[-1]))
        return along, length[-1] / speed(along)

    return course


def _finer(at: Doubles, velocity: Callable[[Doubles], Doubles]) -> Doubles:
    """Return places with others between where the velocity changes fast: in sharp bends, and where it nearly stops."""
    for _ in range(HALVINGS):
        found = velocity(at)
        size = np.linalg.norm(found, axis=1)
        fast = np.linalg.norm(np.diff(found, axis=0), axis=1) > CHANGE * np.minimum(size[1:], size[:-1])
        if not fast.any() or len(at) + np.count_nonzero(fast) > KNOTS:
            break
        at = np.sort(np.concatenate([at, ((at[1:] + at[:-1]) / 2)[fast]]))
    return at


def _lift(ground: Elevation, course: CameraPath, time: Doubles, clearance: float) -> Any:
    """Return by how much the eye has to be raised, a cubic spline over the time whose knots are even."""
    from scipy import ndimage
    from scipy.interpolate import CubicHermiteSpline

    mode = "wrap" if course.closed else "nearest"
    parts = 8
    # A little more, so that it is kept between the places where it is measured, too.
    wanted = clearance + SPARE * min(ground.cell_size)
    between = time[:-1, None] + np.diff(time)[:, None] * (np.arange(parts) / parts)
    spots = course.at(np.append(between.ravel(), time[-1]))[:, :3]
    needed = np.nan_to_num(bilinear(ground, spots[:, 0], spots[:, 1]) + wanted - spots[:, 2], nan=0.0)
    needed = np.maximum(needed, 0)
    # Each knot answers for what lies up to the next ones.
    needed = ndimage.maximum_filter1d(needed, 2 * parts + 1, mode="nearest")[::parts]
    if course.closed:
        needed = needed[:-1]
        needed[0] = max(needed[0], needed[-1])
    reach = max(1, len(needed) // 20)
    window = np.hanning(2 * reach + 3)[1:-1]
    lift = ndimage.maximum_filter1d(needed, 2 * reach + 1, mode=mode)
    lift = ndimage.convolve1d(lift, window / window.sum(), mode=mode)
    if course.closed:
        lift = np.append(lift, lift[0])
    slopes = np.gradient(lift, time)
    if course.closed:
        slopes[0] = slopes[-1] = (lift[1] - lift[-2]) / (time[1] - time[0]) / 2
    return CubicHermiteSpline(time, lift, slopes)


def _check_apart(course: CameraPath) -> None:
    """Raise `ValueError` where the eye meets its target."""
    from scipy.optimize import minimize_scalar

    def apart(time: Doubles) -> Doubles:
        places = course.at(time)
        return np.asarray(np.linalg.norm(places[..., :3] - places[..., 3:6], axis=-1))

    time = np.linspace(0, course.duration, 8 * FINE)
    distance = apart(time)
    middle = int(np.clip(np.argmin(distance), 1, len(time) - 2))
    found = minimize_scalar(
        apart, bounds=(time[middle - 1], time[middle + 1]), method="bounded", options={"xatol": 1e-9}
    )
    if min(float(found.fun), distance.min()) <= 1e-6 * distance.max():
        raise ValueError(f"the eye meets its target at {found.x:.3g} s; keep them apart")
