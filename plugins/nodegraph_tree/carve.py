"""Carving: lower a tree to another where that is lower; and piling, its opposite."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from nodegraph import port_type
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.function import Bounds, Box, ElevationFunction, Floats, Points, Sample, product
from nodegraph_tree.replace import copy_of

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

_CARVE = Kernel("tree_carve", FOLDER / "operators.cl")


@port_type
class Carve(ElevationFunction):
    """A tree A lowered to B where B is lower: f = f_A - a m(f_A - f_B) with a = min(alpha_B, 1), alpha = alpha_A.

    m(d) = max(d, 0), or with a `radius` k > 0 the same with a smooth edge: (d + k)^2 / (4 k) for |d| < k.  The edge
    of what is carved is then rounded (C1) over those heights, and lowered by k / 4 at most.  It is replacement by B
    where B is below A by k or more, and leaves A as it is where B is above it by k or more.

    With `upward`, f = f_A + a m(f_B - f_A): A raised to B where B is higher.

    Attributes:
        base: A.
        layer: B.
        radius: k, m.
        upward: raise rather than lower.
    """

    base: ElevationFunction
    layer: ElevationFunction
    radius: float = 0.0
    upward: bool = False

    @property
    def parts(self) -> Sequence[ElevationFunction]:
        """A and B."""
        return (self.base, self.layer)

    @cached_property
    def support(self) -> Box:
        """That of A."""
        return self.base.support

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Ask A everywhere and B where it reaches."""
        found = self.base.query(points, gradient=gradient)
        near = self.layer.support
        where = (points.x >= near.west) & (points.x <= near.east) & (points.y >= near.south) & (points.y <= near.north)
        if not where.any():
            return found
        found = copy_of(found)
        layer = self.layer.query(points.taken(where), gradient=gradient)
        sign = 1.0 if self.upward else -1.0
        a = np.minimum(layer.weight, 1.0)
        deep = sign * (layer.height - found.height[where])
        moved = self._edge(deep)
        found.height[where] += sign * a * moved
        if found.height_gradient is None:
            return found
        assert layer.height_gradient is not None
        assert layer.weight_gradient is not None
        share = a * self._edge_slope(deep)
        a_slope = np.where(layer.weight < 1, layer.weight_gradient, 0.0)
        slope = found.height_gradient[:, where]
        found.height_gradient[:, where] += share * (layer.height_gradient - slope) + sign * a_slope * moved
        return found

    def _edge(self, deep: Floats) -> Floats:
        """Return m(d)."""
        if self.radius == 0:
            return np.maximum(deep, 0.0)
        over = np.maximum(deep + self.radius, 0.0)
        return np.where(deep < self.radius, over * over / (4 * self.radius), deep)

    def _edge_slope(self, deep: Floats) -> Floats:
        """Return m'(d), in [0, 1]."""
        if self.radius == 0:
            return (deep > 0).astype(np.float64)
        return np.clip((deep + self.radius) / (2 * self.radius), 0.0, 1.0)

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound the carved tree.

        f rises with f_A and with f_B (0 <= a m' <= 1) and only falls (rises, if `upward`) with a, so its extremes are
        at ends of their intervals.  grad f = (1 - a m') grad f_A + a m' grad f_B -+ m grad a, with m at most m(sup d).
        """
        base, layer = self.base.bounds(box, detail), self.layer.bounds(box, detail)
        if base.absent or layer.absent:
            return base
        sign = 1.0 if self.upward else -1.0
        least, most = min(layer.weight_low, 1.0), min(layer.weight_high, 1.0)
        deepest = layer.high - base.low if self.upward else base.high - layer.low
        if deepest <= -self.radius:
            return base

        def height(below: float, above: float, a: float) -> float:
            deep = sign * (above - below)
            return below + sign * product(a, float(self._edge(np.array(deep))))

        ends = (base.low, base.high, layer.low, layer.high)
        if np.isfinite(ends).all():
            low = height(base.low, layer.low, least if self.upward else most)
            high = height(base.high, layer.high, most if self.upward else least)
        else:
            low = base.low if self.upward else min(base.low, layer.low) - self.radius / 4
            high = max(base.high, layer.high) + self.radius / 4 if self.upward else base.high
        moved = float(self._edge(np.array(deepest)))
        pull = product(layer.weight_slope if least < 1 else 0.0, moved)

        shallowest = layer.low - base.high if self.upward else base.low - layer.high
        shares = (
            least * float(self._edge_slope(np.array(shallowest))),
            most * float(self._edge_slope(np.array(deepest))),
        )

        def mixed(below: float) -> float:
            # Linear in the share a m', so greatest at an end; a |grad f_B| is also at most the flux of B.
            ends = max(product(1 - share, below) + product(share, layer.steepest) for share in shares)
            return min(ends, product(1 - shares[0], below) + layer.flux) + pull

        turned = min(layer.flux, product(most, layer.steepest)) + pull
        return Bounds(
            low,
            high,
            base.weight_low,
            base.weight_high,
            mixed(base.slope),
            base.weight_slope,
            base.flux + product(base.weight_high, turned),
            mixed(base.steepest),
        )

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """A, and B out of it where B reaches the tile."""
        self.base.emit(emitter, frame)
        if self.layer.support.meets(frame.box):
            self.layer.emit(emitter, frame)
            edge = [self.radius, 0.25 / self.radius if self.radius > 0 else 0.0]
            emitter.add(_CARVE, edge, [int(self.upward)], pushes=-1)
