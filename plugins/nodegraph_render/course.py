"""The course of a path: splines through its key frames, and how fast they are run through."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np

from nodegraph_render.rays import Doubles

Curve = Literal["smooth", "monotone"]

FINE = 128
"""Knots, at least, between two key frames of a path that keeps a speed, eases or keeps clear of the ground."""
KNOTS = 100_000
"""Knots of a path at most."""
CHANGE = 0.1
"""By how much of itself the velocity may change from knot to knot where a path keeps a speed."""
HALVINGS = 20
"""How often the time between two knots is halved for that; what is sharper still is a cusp."""


class Splines(NamedTuple):
    """The seven coordinates of a camera as a function of a parameter, and their derivatives."""

    value: Callable[[Doubles], Doubles]
    slope: Callable[[Doubles], Doubles]


def centripetal(places: Doubles) -> Doubles:
    """Return centripetal parameters of key frames: apart by the square roots of the eyes' distances."""
    steps = np.sqrt(np.linalg.norm(np.diff(places[:, :3], axis=0), axis=1))
    return np.concatenate([[0.0], np.cumsum(steps)])


def splines_through(knots: Doubles, places: Doubles, curve: Curve, closed: bool) -> Splines:
    """Return splines that pass the places at the knots; see `nodegraph_render.path.path`."""
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
    return Splines(
        lambda u: np.concatenate([where(u), angle(u)], axis=1),
        lambda u: np.concatenate([where(u, 1), angle(u, 1)], axis=1),
    )


def eased(share: Doubles, ease: float) -> tuple[Doubles, Doubles]:
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


def by_time(_: Splines, knots: Doubles) -> Course:
    """Return the course on which the parameter passes evenly."""
    return lambda way: (way * knots[-1], np.full(len(way), knots[-1]))


def evenly(splines: Splines, knots: Doubles) -> Course:
    """Return the course on which the eye is as fast everywhere."""
    from scipy.interpolate import CubicHermiteSpline

    def velocity(u: Doubles) -> Doubles:
        return splines.slope(u)[:, :3]

    def speed(u: Doubles) -> Doubles:
        return np.asarray(np.linalg.norm(velocity(u), axis=1))

    parameter = np.concatenate([np.linspace(a, b, 4 * FINE, endpoint=False) for a, b in pairwise(knots)] + [knots[-1:]])
    parameter = finer(parameter, velocity)
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


def finer(at: Doubles, velocity: Callable[[Doubles], Doubles]) -> Doubles:
    """Return places with others between where the velocity changes fast: in sharp bends, and where it nearly stops."""
    for _ in range(HALVINGS):
        found = velocity(at)
        size = np.linalg.norm(found, axis=1)
        fast = np.linalg.norm(np.diff(found, axis=0), axis=1) > CHANGE * np.minimum(size[1:], size[:-1])
        if not fast.any() or len(at) + np.count_nonzero(fast) > KNOTS:
            break
        at = np.sort(np.concatenate([at, ((at[1:] + at[:-1]) / 2)[fast]]))
    return at
