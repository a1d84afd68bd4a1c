"""Flights of a camera from key frame to key frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np

from nodegraph import Forecast, Param, node
from nodegraph_render.camera import Point
from nodegraph_render.camera_path import CameraPath, Length
from nodegraph_render.clearance import lift_over
from nodegraph_render.course import (
    FINE,
    KNOTS,
    Curve,
    Splines,
    by_time,
    centripetal,
    eased,
    evenly,
    finer,
    splines_through,
)
from nodegraph_render.rays import Doubles
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.raster import Elevation


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
    knots = centripetal(places) if constant_speed else time
    splines = splines_through(knots, places, curve, closed)
    even, fine, along, speed = time, time, knots, np.ones(len(time))
    if constant_speed or ease or ground is not None:
        course = (evenly if constant_speed else by_time)(splines, knots)

        def flown(at: Doubles) -> tuple[Doubles, Doubles]:
            way, rate = eased(at / time[-1], ease)
            along, speed = course(way)
            return along, speed * rate / time[-1]

        even = np.linspace(0, time[-1], _count(ground, splines, knots) + 1)
        fine = finer(even, lambda at: splines.slope(flown(at)[0])[:, :3]) if constant_speed else even
        along, speed = flown(fine)
    values, rates = splines.value(along), splines.slope(along) * speed[:, None]
    if ground is not None:
        lift = lift_over(ground, CameraPath(fine, values, rates, closed), even, clearance)
        values[:, 2] += lift(fine)
        rates[:, 2] += lift(fine, 1)
    made = CameraPath(fine, values, rates, closed)
    _check_apart(made)
    return made


@path.forecast
def _path_forecast(*_: Forecast | None, keys: list[KeyFrame], closed: bool, **__: object) -> Forecast:
    return Forecast(0, about=Length(keys[-1].time - keys[0].time, closed))


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


def _count(ground: Elevation | None, splines: Splines, knots: Doubles) -> int:
    """Return into how many parts a path is cut: fine ones, and half a cell of the ground at most."""
    count = FINE * (len(knots) - 1)
    if ground is not None:
        way = np.linalg.norm(np.diff(splines.value(np.linspace(0, knots[-1], count))[:, :2], axis=0), axis=1).sum()
        count = max(count, math.ceil(2 * way / min(ground.cell_size)))
    return min(count, KNOTS)


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
