"""The bend: a tree shifted across an axis, so that the axis becomes a curve (see `warp`)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import hypot, isfinite
from typing import TYPE_CHECKING

import numpy as np

from nodegraph import port_type
from nodegraph_tree.affine import largest_singular_value
from nodegraph_tree.device import FOLDER, Frame, Kernel
from nodegraph_tree.falloff import STEEPEST, derivative, fall_off, steepest_between
from nodegraph_tree.function import Box, ElevationFunction, Floats
from nodegraph_tree.warp import STILL, Instruction, Reach, Shift, Warp

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter

_BEND = Kernel("tree_bend", FOLDER / "warp.cl")


@port_type
class Bend(Warp):
    """A tree bent sideways along an axis, so that the straight axis becomes a curve.

    With s along the axis from its start (x, y), t across it to the left, and length L, points of the tree are moved by
    h(s) g(|t| / reach) to the left: omega^-1(s, t) = (s, t - h(s) g(|t| / reach)).  h is the cubic spline (C2) of L
    that has the given offsets at equal distances and is 0, level and without curvature at both ends and beyond; g is (1
    - u^2)^3.  One to one where t -> t - h g rises: sup |h| max |g'| < reach.

    J = (1, 0; -h' g, 1 - h g' / reach) in the coordinates of the axis.

    Attributes:
        x, y: where the axis starts, m.
        east, north: the direction of the axis, a unit vector.
        length: L, m.
        offsets: of the axis to the left, m, at L / (n + 3) times 2, 3, ..., n + 1.
        reach_across: beyond this distance from the axis nothing moves, m.
    """

    x: float
    y: float
    east: float
    north: float
    length: float
    offsets: tuple[float, ...]
    reach_across: float

    @property
    def step(self) -> float:
        """Distance between the offsets along the axis, m."""
        return self.length / (len(self.offsets) + 3)

    @cached_property
    def coefficients(self) -> Floats:
        """The weights of the B-splines at the offsets' places, so that the spline passes through the offsets."""
        count = len(self.offsets)
        matrix = (4 * np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)) / 6
        return np.linalg.solve(matrix, np.array(self.offsets))

    @cached_property
    def farthest(self) -> float:
        """Sup |h|: at the knots, or where the parabola h' is 0 between two."""
        weights = np.concatenate([np.zeros(4), self.coefficients, np.zeros(4)])
        a, b, c, d = weights[:-3], weights[1:-2], weights[2:-1], weights[3:]
        # h = k0 + k1 u + k2 u^2 + k3 u^3 for u in [0, 1] between two knots.
        k0, k1, k2, k3 = (a + 4 * b + c) / 6, (c - a) / 2, (a - 2 * b + c) / 2, (d - 3 * c + 3 * b - a) / 6
        greatest = float(np.abs(k0).max())
        for row in zip(k0, k1, k2, k3, strict=True):
            for root in np.roots([3 * row[3], 2 * row[2], row[1]]):
                if abs(root.imag) < 1e-9 and 0 < root.real < 1:
                    u = float(root.real)
                    greatest = max(greatest, abs(float(row[0] + u * (row[1] + u * (row[2] + u * row[3])))))
        return greatest

    @cached_property
    def steepest(self) -> float:
        """Sup |h'|: h' is a quadratic spline of weights (c_i - c_(i-1)) / step, and stays within them."""
        return float(np.abs(np.diff(np.concatenate([[0.0], self.coefficients, [0.0]]))).max()) / self.step

    def shift(self, x: Floats, y: Floats, *, gradient: bool = False) -> Shift:
        """Return -h(s) g(t) along the left-hand normal."""
        dx, dy = x - self.x, y - self.y
        along, across = self.east * dx + self.north * dy, self.east * dy - self.north * dx
        distance = np.abs(across) / self.reach_across
        beside = fall_off("wyvill", distance)
        offset, turned = np.zeros_like(along), np.zeros_like(along)
        for index, weight in enumerate(self.coefficients):
            u = along / self.step - (index + 2)
            wide, narrow = np.maximum(2 - np.abs(u), 0), np.maximum(1 - np.abs(u), 0)
            offset += weight / 6 * (wide**3 - 4 * narrow**3)
            turned -= weight / 2 * np.sign(u) * (wide**2 - 4 * narrow**2)
        moved = -offset * beside
        east, north = -self.north, self.east
        if not gradient:
            return Shift(moved * east, moved * north)
        by_along = -turned / self.step * beside
        by_across = -offset * derivative("wyvill", distance) * np.sign(across) / self.reach_across
        # grad of `moved` in x and y, along the constant normal.
        by_x, by_y = by_along * self.east + by_across * east, by_along * self.north + by_across * north
        return Shift(moved * east, moved * north, by_x * east, by_y * east, by_x * north, by_y * north)

    def reach(self, box: Box) -> Reach:
        """Bound the shift by sup |h| g, and J from the greatest |h' g| and 1 + |h g'| / reach beside the box."""
        if self.farthest == 0:
            return STILL
        near, far = 0.0, 1.0
        if all(map(isfinite, box)):
            corners = [(x - self.x, y - self.y) for x in (box.west, box.east) for y in (box.south, box.north)]
            along = [self.east * x + self.north * y for x, y in corners]
            across = [self.east * y - self.north * x for x, y in corners]
            if max(along) <= 0 or min(along) >= self.length:
                return STILL
            near = max(min(across), -max(across), 0.0) / self.reach_across
            far = max(map(abs, across)) / self.reach_across
            if near >= 1:
                return STILL
        beside = float(fall_off("wyvill", np.array(near)))
        stretched = 1 + self.farthest * steepest_between("wyvill", near, min(far, 1.0)) / self.reach_across
        return Reach(
            self.farthest * beside, max(1.0, largest_singular_value((1.0, 0.0, self.steepest * beside, stretched)))
        )

    def instruction(self, emitter: Emitter, frame: Frame, to: tuple[float, float]) -> Instruction:  # noqa: ARG002
        """The axis relative to the frame, and the splines."""
        dx, dy = frame.ox - self.x, frame.oy - self.y
        # Along and across the axis at the frame's origin.
        along, across = self.east * dx + self.north * dy, self.east * dy - self.north * dx
        numbers = [along / self.step, across, self.east, self.north, 1 / self.step, 1 / self.reach_across, *to]
        return _BEND, [*numbers, *self.coefficients.tolist()], [len(self.offsets)]


def bend(
    operand: ElevationFunction,
    *,
    start: tuple[float, float],
    end: tuple[float, float],
    offsets: Sequence[float],
    reach: float,
) -> ElevationFunction:
    """Return a tree bent along the axis from `start` to `end`.

    Raises:
        ValueError: the axis has no length, or the bend would fold the plane.
    """
    length = hypot(end[0] - start[0], end[1] - start[1])
    if not (length > 0 and reach > 0 and all(map(isfinite, (*start, *end, reach, *offsets)))):
        raise ValueError("a bend needs an axis between two different points, finite offsets and a reach above 0")
    east, north = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    x, y = map(float, start)
    bent = Bend(operand, x, y, east, north, length, tuple(map(float, offsets)), float(reach))
    if not offsets or bent.farthest == 0:
        return operand
    least = bent.farthest * STEEPEST["wyvill"]
    if least >= reach:
        raise ValueError(
            f"a bend by {bent.farthest:.4g} m within {reach:g} m folds the ground; give a reach above {least:.4g} m"
        )
    return bent
