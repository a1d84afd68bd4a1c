"""Cameras that move."""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from nodegraph import port_type
from nodegraph_render.camera import Camera, looking
from nodegraph_render.rays import Doubles


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
