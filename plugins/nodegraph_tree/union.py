"""Union: landforms of one kind that run into each other, as rivers do at a confluence: the lowest, or highest, of them.

**Definition.**  Take the weight of each tree for the probability that it is there, independently of the others.  The
union is there when any is, and has the height that is expected of the lowest one there.  For two,

    alpha = alpha_A + alpha_B - alpha_A alpha_B,
    f = (alpha_A (1 - alpha_B) f_A + (1 - alpha_A) alpha_B f_B + alpha_A alpha_B M) / alpha,   M = f_A - m(f_A - f_B),

with m(d) = max(d, 0), rounded to (d + k)^2 / (4 k) for |d| < k: the quadratic smooth minimum, up to k / 4 below both.
So where one fades out the other takes over, and where both are there in full a bed cuts through the bank of another
and the crest between two valleys is rounded over heights of about k; the distance to a skeleton with several branches,
whose nearest point jumps, never enters.  k changes from `near` where both have full weight to `far` where one ends:
k = far - (far - near) alpha_A alpha_B, so that banks stay sharp where valley sides do not.

- f is C1 where f_A, f_B and the weights are, and bit for bit that of the only one that is there.
- *Values*: f is a mean of f_A, f_B and M, so it stays between them but for k / 4.
- *Gradient*: with e = (1 - alpha_A) d + alpha_A m, f = f_A - alpha_B e / alpha.  The parts of grad f_A and grad f_B sum
  to a mean, as 0 <= m' <= 1.  grad alpha_A has the coefficient ((1 - alpha_B) (f_A - f) + alpha_B (M - f_B)) / alpha,
  where |f_A - f| <= alpha_B S / alpha and all differences are at most S = sup|f_A - f_B| + k / 4; grad alpha_B
  likewise.  grad k has the coefficient alpha_A alpha_B dm/dk / alpha, 0 <= dm/dk = (k^2 - d^2) / (4 k^2) <= 1/4.

Two may be exchanged.  More are taken in order, each with what the ones before have made; their order shows where three
are close in height, by the rounding, and where three weights are below 1, as an expectation of minima is not a minimum
of expectations.

Source: union as a minimum, and that it may be rounded, is from A. Ricci 1973: A constructive geometry for computer
graphics, Computer Journal 16(2), doi:10.1093/comjnl/16.2.157; the rounding here is that of `tree.carve`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import inf
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_tree.box_index import BoxIndex
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.function import (
    ABSENT,
    NOWHERE,
    THRESHOLD,
    Bounds,
    Box,
    ElevationFunction,
    Floats,
    Points,
    Sample,
    empty_sample,
    product,
)
from nodegraph_tree.replace import copy_of

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

_UNION = Kernel("tree_union", FOLDER / "operators.cl")


@port_type
class Union(ElevationFunction):
    """The lowest of trees, or with `upward` the highest, rounded where they meet.  Weights above 1 count as 1.

    Build it with `union`.

    Attributes:
        operands: the trees, of which two at least.
        near: k where both have full weight, m; greater than 0.
        far: k where the weight of one ends, m; at least `near`.
        upward: the highest.
    """

    operands: tuple[ElevationFunction, ...]
    near: float
    far: float
    upward: bool = False

    @property
    def parts(self) -> Sequence[ElevationFunction]:
        """The operands."""
        return self.operands

    @cached_property
    def support(self) -> Box:
        """Around all operands."""
        box = NOWHERE
        for part in self.operands:
            box = box.union(part.support)
        return box

    @cached_property
    def _index(self) -> BoxIndex:
        return BoxIndex([part.support for part in self.operands])

    def reaching(self, box: Box) -> list[ElevationFunction]:
        """Return the operands whose support meets a box, in order."""
        return [self.operands[number] for number in self._index.meeting(box).tolist()]

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Ask each operand where it reaches."""
        found = copy_of(empty_sample(points, gradient=gradient))
        for part in self.operands:
            near = part.support
            where = (points.x >= near.west) & (points.x <= near.east)
            where &= (points.y >= near.south) & (points.y <= near.north)
            if where.any():
                self._unite(found, part.query(points.taken(where), gradient=gradient), where)
        return found

    def _unite(self, found: Sample, other: Sample, where: npt.NDArray[np.bool_]) -> None:
        """Unite what was found so far with the samples of another one at `where`."""
        sign = -1.0 if self.upward else 1.0
        f, a, b = found.height[where], found.weight[where], np.minimum(other.weight, 1.0)
        both = a * b
        total = a + (1 - a) * b
        safe = np.where(total > 0, total, 1.0)
        k = self.far - (self.far - self.near) * both
        d = sign * (f - other.height)
        m, m_d, m_k = _smooth(d, k)
        e = (1 - a) * d + a * m
        step = b * e / safe
        first, second = a > 0, b > 0
        found.height[where] = np.where(first, f - sign * step, np.where(second, other.height, 0.0))
        found.weight[where] = total
        if found.height_gradient is None or found.weight_gradient is None:
            return
        assert other.height_gradient is not None
        assert other.weight_gradient is not None
        f_slope, a_slope = found.height_gradient[:, where], found.weight_gradient[:, where]
        b_slope = np.where(other.weight < 1, other.weight_gradient, 0.0)
        d_slope = sign * (f_slope - other.height_gradient)
        total_slope = (1 - b) * a_slope + (1 - a) * b_slope
        k_slope = -(self.far - self.near) * (b * a_slope + a * b_slope)
        e_slope = (1 - a) * d_slope + (m - d) * a_slope + a * (m_d * d_slope + m_k * k_slope)
        step_slope = (b_slope * e + b * e_slope - step * total_slope) / safe
        alone = np.where(second, other.height_gradient, 0.0)
        found.height_gradient[:, where] = np.where(first, f_slope - sign * step_slope, alone)
        found.weight_gradient[:, where] = total_slope

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound the operands that reach the box and unite them in order, as this module derives it."""
        found = ABSENT
        for part in self.reaching(box):
            bounds = part.bounds(box, detail)
            if bounds.absent:
                continue
            light, heavy = min(bounds.weight_low, 1.0), min(bounds.weight_high, 1.0)
            bounds = bounds._replace(weight_low=light, weight_high=heavy)
            found = bounds if found.absent else self._united(found, bounds)
        return found

    def _united(self, one: Bounds, two: Bounds) -> Bounds:
        a0, a1, b0, b1 = one.weight_low, one.weight_high, two.weight_low, two.weight_high
        k = self.far - (self.far - self.near) * a0 * b0
        apart = max(one.low - two.high, two.low - one.high, 0.0)
        bulge = max(k - apart, 0.0) ** 2 / (4 * k)
        low, high = min(one.low, two.low), max(one.high, two.high)
        spread = max(one.high - two.low, two.high - one.low) + bulge
        least, most = a0 + (1 - a0) * b0, a1 + (1 - a1) * b1
        turn_a, turn_b = one.weight_slope, two.weight_slope
        rounding = 0.25 * a1 * b1 * (self.far - self.near) * (b1 * turn_a + a1 * turn_b) if bulge > 0 else 0.0

        def slope(total: float) -> float:
            """Bound |grad f| where the weight is at least `total`."""
            if total <= 0:
                return inf
            pull = product(turn_a, spread * min(1.0, b1 * ((1 - b0) / total + 1)))
            pull += product(turn_b, spread * min(1.0, a1 * ((1 - a0) / total + 1)))
            mean = max(one.steepest, two.steepest)
            mean = min(mean, min(one.steepest, one.flux / total) + min(two.steepest, two.flux / total))
            return mean + (pull + rounding) / total

        return Bounds(
            low if self.upward else low - bulge,
            high + bulge if self.upward else high,
            least,
            most,
            slope(max(least, THRESHOLD)),
            product(1 - b0, turn_a) + product(1 - a0, turn_b),
            one.flux + two.flux + product(turn_a + turn_b, spread) + rounding,
            slope(least),
        )

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Unite what reaches the tile."""
        emitter.nothing()
        for part in self.reaching(frame.box):
            part.emit(emitter, frame)
            emitter.add(_UNION, [self.near, self.far], [int(self.upward)], pushes=-1)


def union(operands: Sequence[ElevationFunction], *, near: float, far: float, upward: bool = False) -> ElevationFunction:
    """Return the union of trees, of which there must be one; a single one is itself.

    Args:
        operands: the trees.
        near: over what heights it is rounded where both have full weight, m; greater than 0.
        far: the same where the weight of one ends, m; not less than `near`.
        upward: the highest of them rather than the lowest.
    """
    if len(operands) == 1:
        return operands[0]
    return Union(tuple(operands), near, far, upward)


def _smooth(d: Floats, k: Floats) -> tuple[Floats, Floats, Floats]:
    """Return m(d) and its derivatives by d and k."""
    share = np.clip((d + k) / (2 * k), 0.0, 1.0)
    m = np.where(d < k, k * share * share, d)
    return m, share, share * (1 - share)
