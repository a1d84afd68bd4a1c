"""The twist: a tree turned about a centre (see `warp`)."""

from __future__ import annotations

from functools import cached_property
from math import isfinite, pi, sqrt
from typing import TYPE_CHECKING

import numpy as np

from nodegraph import port_type
from nodegraph_tree.device import FOLDER, Frame, Kernel
from nodegraph_tree.falloff import fall_off
from nodegraph_tree.function import Box, ElevationFunction, Floats
from nodegraph_tree.warp import STILL, Instruction, Reach, Shift, Warp

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter

_TWIST = Kernel("tree_twist", FOLDER / "warp.cl")


@port_type
class Twist(Warp):
    """A tree turned about a centre by an angle that falls off to 0 at a radius R, by (1 - (r/R)^2)^3 (C2).

    omega^-1 turns each circle back by its angle: one to one whatever the angle.  With the angle a(r), J is a turn times
    a shear by r a'(r), whose largest singular value is k/2 + sqrt(1 + k^2/4), k = r |a'(r)|.

    Attributes:
        x, y: the centre, m.
        radius: R, m.
        angle: at the centre, counter-clockwise, radians.
    """

    x: float
    y: float
    radius: float
    angle: float

    @property
    def farthest(self) -> float:
        """No point leaves its circle."""
        return 2 * self.radius

    @cached_property
    def support(self) -> Box:
        """That of the operand, and the disc if it reaches into that: turning leaves all else in place."""
        inner = self.operand.support
        disc = Box(self.x, self.y, self.x, self.y).grown(self.radius)
        return inner.union(disc) if inner.meets(disc) else inner

    def shift(self, x: Floats, y: Floats, *, gradient: bool = False) -> Shift:
        """Return (R(-a) - I)(p - c)."""
        east, north = x - self.x, y - self.y
        t = np.hypot(east, north) / self.radius
        turn = -self.angle * fall_off("wyvill", t)
        # cos - 1 without losing digits, and exactly 0 outside.
        lost, sine = -2 * np.sin(turn / 2) ** 2, np.sin(turn)
        dx, dy = lost * east - sine * north, lost * north + sine * east
        if not gradient:
            return Shift(dx, dy)
        # grad of the turn: a'(r) (p - c) / r, with g'(t) = -6 t (1 - t^2)^2 there is no division by r.
        rate = self.angle * 6 * np.maximum(1 - t * t, 0) ** 2 / self.radius**2
        spun_x, spun_y = -(north + dy), east + dx  # the derivative by the turn: the turned vector, turned by 90 degrees
        return Shift(
            dx,
            dy,
            lost + spun_x * rate * east,
            -sine + spun_x * rate * north,
            sine + spun_y * rate * east,
            lost + spun_y * rate * north,
        )

    def reach(self, box: Box) -> Reach:
        """Bound the chord 2 r sin(|a| / 2) and the shear |angle| 6 t^2 (1 - t^2)^2, greatest at t = 1/sqrt(3)."""
        near, far = (distance / self.radius for distance in box.distance(self.x, self.y))
        if near >= 1 or self.angle == 0:
            return STILL
        far = min(far, 1.0)
        turn = abs(self.angle) * float(fall_off("wyvill", np.array(near)))
        peak = min(max(1 / sqrt(3), near), far)
        shear = abs(self.angle) * 6 * peak**2 * (1 - peak**2) ** 2
        return Reach(self.radius * far * 2 * np.sin(min(turn, pi) / 2), shear / 2 + sqrt(1 + shear**2 / 4))

    def instruction(self, emitter: Emitter, frame: Frame, to: tuple[float, float]) -> Instruction:  # noqa: ARG002
        """Centre relative to the frame, 1 / radius, angle, what to take off."""
        return _TWIST, [self.x - frame.ox, self.y - frame.oy, 1 / self.radius, -self.angle, *to], []


def twist(operand: ElevationFunction, *, centre: tuple[float, float], radius: float, angle: float) -> ElevationFunction:
    """Return a tree twisted by `angle` radians at the centre, nothing at the radius (m)."""
    if not (radius > 0 and isfinite(radius) and isfinite(angle) and all(map(isfinite, centre))):
        raise ValueError("a twist needs a finite centre and angle and a radius above 0")
    return operand if angle == 0 else Twist(operand, float(centre[0]), float(centre[1]), float(radius), float(angle))
