"""The weight of a primitive with a straight border: 1 inside, falling to 0 at the edges over a margin.

The border is convex: the product over its edges of g(1 - d / margin), where d is the distance to the edge, positive
inside, and g a fall-off (`nodegraph_tree.falloff`), which has g(0) = 1 and g'(0) = g(1) = g'(1) = 0: C1, and exactly 0
outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import hypot
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from nodegraph_tree.falloff import CODES, FallOff, Floats, derivative, fall_off, steepest_between
from nodegraph_tree.function import Box

if TYPE_CHECKING:
    from nodegraph_tree.device import Frame


class Weighed(NamedTuple):
    """A weight and its gradient towards east and north, (n,) each."""

    weight: Floats
    east: Floats
    north: Floats


class WeightRange(NamedTuple):
    """What the weight can be in a box, and the greatest length of its gradient."""

    low: float
    high: float
    slope: float


@dataclass(frozen=True)
class Border:
    """A convex polygon with a margin.

    Attributes:
        edges: (east, north, offset) of each edge: d = east x + north y - offset, with (east, north) a unit vector
        inward. margin: m.
        fall_off: g.
    """

    edges: tuple[tuple[float, float, float], ...]
    margin: float
    fall_off: FallOff

    @staticmethod
    def around(corners: Sequence[tuple[float, float]], margin: float, fall_off: FallOff) -> Border:
        """Return the border of a convex polygon, its corners in either sense."""
        edges = []
        following = [*corners[1:], corners[0]]
        area = sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(corners, following, strict=True))
        for (ax, ay), (bx, by) in zip(corners, following, strict=True):
            length = hypot(bx - ax, by - ay) * (1 if area > 0 else -1)
            east, north = -(by - ay) / length, (bx - ax) / length
            edges.append((east, north, east * ax + north * ay))
        return Border(tuple(edges), margin, fall_off)

    def query(self, x: Floats, y: Floats) -> Weighed:
        """Return weights and gradients at points."""
        values, slopes = [], []
        for east, north, offset in self.edges:
            t = np.clip(1 - (east * x + north * y - offset) / self.margin, 0.0, 1.0)
            values.append(fall_off(self.fall_off, t))
            slopes.append(derivative(self.fall_off, t) * (-1 / self.margin))
        weight, gx, gy = np.ones(x.shape), np.zeros(x.shape), np.zeros(x.shape)
        for value in values:
            weight *= value
        for index, (edge, slope) in enumerate(zip(self.edges, slopes, strict=True)):
            for other, value in enumerate(values):
                if other != index:
                    slope = slope * value
            gx += slope * edge[0]
            gy += slope * edge[1]
        return Weighed(weight, gx, gy)

    def bounds(self, box: Box) -> WeightRange:
        """Bound the weight in a finite box.

        Distances are linear, so their ranges are exact.  The gradient is sum_e c_e n_e with 0 <= c_e <= |g_e'| prod g_o
        over the other edges; the length of such a sum is convex in the c_e and so greatest with each at 0 or at its
        most.
        """
        lows, highs, steep = [], [], []
        for edge in self.edges:
            near, far = _range(edge, box)
            t0, t1 = (min(max(1 - d / self.margin, 0.0), 1.0) for d in (far, near))
            low, high = fall_off(self.fall_off, np.array([t1, t0])).tolist()
            lows.append(low)
            highs.append(high)
            steep.append(steepest_between(self.fall_off, t0, t1) / self.margin)
        most = [
            slope * float(np.prod([high for other, high in enumerate(highs) if other != index]))
            for index, slope in enumerate(steep)
        ]
        pulls = [(c * edge[0], c * edge[1]) for c, edge in zip(most, self.edges, strict=True) if c > 0]
        slope = max(hypot(sum(p[0] for p in some), sum(p[1] for p in some)) for some in _subsets(pulls))
        return WeightRange(float(np.prod(lows)), float(np.prod(highs)), slope)

    def device(self, frame: Frame) -> tuple[list[float], list[int]] | None:
        """Return the parameters of ``border`` in ``kernels/image.cl`` for a tile; None if it lies outside.

        Edges whose margin does not reach the tile are left out.
        """
        floats: list[float] = []
        for edge in self.edges:
            near, far = _range(edge, frame.box)
            if far <= 0:
                return None
            if near < self.margin:
                east, north, offset = edge
                here = east * frame.ox + north * frame.oy - offset
                floats += [1 - here / self.margin, -east / self.margin, -north / self.margin]
        return floats, [len(floats) // 3, CODES[self.fall_off]]


def _range(edge: tuple[float, float, float], box: Box) -> tuple[float, float]:
    """Return the least and greatest distance to an edge in a box."""
    east, north, offset = edge
    low = east * (box.west if east > 0 else box.east) + north * (box.south if north > 0 else box.north) - offset
    high = east * (box.east if east > 0 else box.west) + north * (box.north if north > 0 else box.south) - offset
    return low, high


def _subsets(pulls: list[tuple[float, float]]) -> list[list[tuple[float, float]]]:
    return [
        [pull for pull, chosen in zip(pulls, choice, strict=True) if chosen]
        for choice in product((False, True), repeat=len(pulls))
    ]
