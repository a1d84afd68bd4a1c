"""Level of detail: one tree from afar, another from near (section 6)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import inf
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.function import THRESHOLD, Bounds, Box, ElevationFunction, Floats, Points, Sample, product
from nodegraph_tree.presence import STEEPEST, presence, presence_gradient, presence_slope, present_slope

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

_DETAIL = Kernel("tree_level_of_detail", FOLDER / "operators.cl")


@port_type
class LevelOfDetail(ElevationFunction):
    """A coarse tree A up to kappa = k_A, a fine one B from k_B, and between them a mixture of both.

    With t = (kappa - k_A) / (k_B - k_A): f = (1 - t) f_A + t f_B and alpha = (1 - t) alpha_A + t alpha_B.  Where one of
    the two has no terrain and its height means nothing, it counts by its `presence` c: f = ((1 - t) c_A f_A + t c_B
    f_B) / ((1 - t) c_A + t c_B), which is the printed formula where both have terrain.  Gradients are for kappa as it
    is at the point, as if it were constant around.

    Attributes:
        coarse: A.
        fine: B.
        start, end: k_A < k_B, in [0, 1].
    """

    coarse: ElevationFunction
    fine: ElevationFunction
    start: float
    end: float

    @property
    def parts(self) -> Sequence[ElevationFunction]:
        """A and B."""
        return (self.coarse, self.fine)

    @cached_property
    def support(self) -> Box:
        """Around both."""
        return self.coarse.support.union(self.fine.support)

    def mixture(self, detail: Floats | float) -> Floats:
        """Return t for a level of detail."""
        return np.clip((np.asarray(detail, np.float64) - self.start) / (self.end - self.start), 0.0, 1.0)

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Ask A where t < 1 and B where t > 0."""
        t = np.broadcast_to(self.mixture(points.detail), points.x.shape)
        if (t <= 0).all():
            return self.coarse.query(points, gradient=gradient)
        if (t >= 1).all():
            return self.fine.query(points, gradient=gradient)
        size = points.x.shape
        first, second = (
            _partly(part, points, where, gradient) for part, where in ((self.coarse, t < 1), (self.fine, t > 0))
        )
        near, far = t * presence(second.weight), (1 - t) * presence(first.weight)
        total = near + far
        share = np.divide(near, total, out=np.zeros(size), where=total > 0)
        height = (1 - share) * first.height + share * second.height
        weight = (1 - t) * first.weight + t * second.weight
        if not gradient:
            return Sample(height, weight)
        assert first.height_gradient is not None
        assert first.weight_gradient is not None
        assert second.height_gradient is not None
        assert second.weight_gradient is not None
        near_slope = t * presence_gradient(second.weight, second.weight_gradient)
        far_slope = (1 - t) * presence_gradient(first.weight, first.weight_gradient)
        turned = far * near_slope - near * far_slope
        turned = np.divide(turned, total * total, out=np.zeros_like(turned), where=total * total > 0)
        slope = (1 - share) * first.height_gradient + share * second.height_gradient
        slope += turned * (second.height - first.height)
        return Sample(height, weight, slope, (1 - t) * first.weight_gradient + t * second.weight_gradient)

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound the mixture for one kappa.

        With the share w = t c_B / D of B, D = (1 - t) c_A + t c_B,
        grad w = (1 - t) c_A / D . t grad c_B / D - t c_B / D . (1 - t) grad c_A / D: as the first factors of the terms
        sum to 1, |grad w| <= max(t |grad c_B|, (1 - t) |grad c_A|) / D.  As c >= min(alpha / T, 1), alpha / D <= max(T,
        sup alpha_A, sup alpha_B) =: K, and D >= T / K on the terrain.
        """
        t = float(self.mixture(detail))
        if t <= 0:
            return self.coarse.bounds(box, detail)
        if t >= 1:
            return self.fine.bounds(box, detail)
        first, second = self.coarse.bounds(box, detail), self.fine.bounds(box, detail)
        if first.absent or second.absent:
            one, share = (second, t) if first.absent else (first, 1 - t)
            if one.absent:
                return one
            # Its terrain is smaller than alone.
            return one._replace(
                weight_low=share * one.weight_low,
                weight_high=share * one.weight_high,
                weight_slope=share * one.weight_slope,
                flux=share * one.flux,
            )
        low, high = min(first.low, second.low), max(first.high, second.high)
        weight_low = (1 - t) * first.weight_low + t * second.weight_low
        weight_high = (1 - t) * first.weight_high + t * second.weight_high
        weight_slope = (1 - t) * first.weight_slope + t * second.weight_slope
        if min(first.weight_low, second.weight_low) >= THRESHOLD:
            low = product(1 - t, first.low) + product(t, second.low)
            high = product(1 - t, first.high) + product(t, second.high)
            slope = product(1 - t, first.slope) + product(t, second.slope)
            return Bounds(low, high, weight_low, weight_high, slope, weight_slope, product(weight_high, slope), slope)
        ratio = max(THRESHOLD, first.weight_high, second.weight_high)
        turned = product(max(t * presence_slope(second), (1 - t) * presence_slope(first)), high - low)
        parts = product(1 - t, present_slope(first)) + product(t, present_slope(second))
        mean = max(first.slope, first.steepest, second.slope, second.steepest)
        slope = min(mean, product(ratio / THRESHOLD, parts)) + product(ratio / THRESHOLD, turned)
        flux = product(ratio, STEEPEST * ((1 - t) * first.flux + t * second.flux) + turned)
        return Bounds(low, high, weight_low, weight_high, slope, weight_slope, flux, inf)

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Only what the levels of detail in the tile ask for."""
        t = self.mixture(emitter.detail)
        if t.max() <= 0:
            self.coarse.emit(emitter, frame)
        elif t.min() >= 1:
            self.fine.emit(emitter, frame)
        else:
            self.coarse.emit(emitter, frame)
            self.fine.emit(emitter, frame)
            emitter.add(_DETAIL, [self.start, 1 / (self.end - self.start)], pushes=-1)


def _partly(part: ElevationFunction, points: Points, where: npt.NDArray[np.bool_], gradient: bool) -> Sample:
    """Ask a tree at some of the points; elsewhere the answer is that of nothing."""
    if where.all():
        return part.query(points, gradient=gradient)
    size = points.x.shape
    found = part.query(points.taken(where), gradient=gradient)
    height, weight = np.zeros(size), np.zeros(size)
    height[where], weight[where] = found.height, found.weight
    if found.height_gradient is None or found.weight_gradient is None:
        return Sample(height, weight)
    slope, weight_slope = np.zeros((2, *size)), np.zeros((2, *size))
    slope[:, where], weight_slope[:, where] = found.height_gradient, found.weight_gradient
    return Sample(height, weight, slope, weight_slope)
