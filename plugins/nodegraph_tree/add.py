"""Addition: heights of one tree on another (section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from nodegraph import port_type
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.function import ABSENT, THRESHOLD, Bounds, Box, ElevationFunction, Points, Sample, product
from nodegraph_tree.presence import STEEPEST, presence, presence_gradient, presence_slope, present_slope
from nodegraph_tree.replace import copy_of

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

_ADD = Kernel("tree_add", FOLDER / "operators.cl")


@port_type
class Add(ElevationFunction):
    """A tree A with the heights of B on it: f = f_A + alpha_B f_B.

    The weight is alpha_A, or with `grow` alpha_A + alpha_B^2, so that B reaches beyond A.  There f_A means nothing:
    with `grow` it is multiplied by the `presence` of A, 1 on its terrain.

    Attributes:
        base: A.
        detail: B; its heights are differences, m.
        grow: take the weight of B into account.
    """

    base: ElevationFunction
    detail: ElevationFunction
    grow: bool = False

    @property
    def parts(self) -> Sequence[ElevationFunction]:
        """A and B."""
        return (self.base, self.detail)

    @cached_property
    def support(self) -> Box:
        """That of A, and with `grow` that of B as well."""
        return self.base.support.union(self.detail.support) if self.grow else self.base.support

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Ask A everywhere and B where it reaches."""
        found = self.base.query(points, gradient=gradient)
        near = self.detail.support
        where = (points.x >= near.west) & (points.x <= near.east) & (points.y >= near.south) & (points.y <= near.north)
        if not self.grow and not where.any():
            return found
        found = copy_of(found)
        if self.grow:
            there = presence(found.weight)
            if found.height_gradient is not None and found.weight_gradient is not None:
                found.height_gradient[:] = there * found.height_gradient
                found.height_gradient[:] += found.height * presence_gradient(found.weight, found.weight_gradient)
            found.height[:] = there * found.height
        if not where.any():
            return found
        extra = self.detail.query(points.taken(where), gradient=gradient)
        found.height[where] += extra.weight * extra.height
        if self.grow:
            found.weight[where] += extra.weight**2
        if found.height_gradient is not None and found.weight_gradient is not None:
            assert extra.height_gradient is not None
            assert extra.weight_gradient is not None
            found.height_gradient[:, where] += (
                extra.weight * extra.height_gradient + extra.height * extra.weight_gradient
            )
            if self.grow:
                found.weight_gradient[:, where] += 2 * extra.weight * extra.weight_gradient
        return found

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound grad f = grad f_A + alpha_B grad f_B + f_B grad alpha_B.

        The middle term is the flux of B.  With `grow` A counts by its presence c, where c |grad f_A| <= 4 alpha_A |grad
        f_A| and |grad c| <= 4 |grad alpha_A|.
        """
        base, extra = self.base.bounds(box, detail), self.detail.bounds(box, detail)
        if extra.absent:
            extra = Bounds(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        if base.absent:
            if not self.grow or extra.weight_high <= 0:
                return ABSENT
            base = Bounds(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        weights = (extra.weight_low, extra.weight_high)
        added = [product(weight, height) for weight in weights for height in (extra.low, extra.high)]
        turned = min(extra.flux, product(extra.weight_high, extra.steepest))
        turned += product(extra.weight_slope, max(abs(extra.low), abs(extra.high)))
        low, high = base.low + min(added), base.high + max(added)
        if not self.grow or (extra.weight_high <= 0 and base.weight_low >= THRESHOLD):
            return Bounds(
                low,
                high,
                base.weight_low,
                base.weight_high,
                base.slope + turned,
                base.weight_slope,
                base.flux + product(base.weight_high, turned),
                base.steepest + turned,
            )
        weight_low = base.weight_low + extra.weight_low**2
        weight_high = base.weight_high + extra.weight_high**2
        weight_slope = base.weight_slope + 2 * product(extra.weight_high, extra.weight_slope)
        if base.weight_low >= THRESHOLD:
            slope = base.slope + turned
            return Bounds(low, high, weight_low, weight_high, slope, weight_slope, product(weight_high, slope), slope)
        least = float(presence(np.array(base.weight_low)))
        faded = [product(share, height) for share in (least, 1.0) for height in (base.low, base.high)]
        fading = product(presence_slope(base), max(abs(base.low), abs(base.high)))
        slope = present_slope(base) + fading + turned
        everywhere = min(product(STEEPEST, base.flux), base.support_slope) + fading + turned
        return Bounds(
            min(faded) + min(added),
            max(faded) + max(added),
            weight_low,
            weight_high,
            slope,
            weight_slope,
            product(weight_high, everywhere),
            everywhere,
        )

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """A, and B on it where B reaches the tile."""
        self.base.emit(emitter, frame)
        if self.detail.support.meets(frame.box):
            self.detail.emit(emitter, frame)
        elif self.grow:
            emitter.nothing()  # what is left of A where its terrain ends
        else:
            return
        emitter.add(_ADD, ints=[int(self.grow)], pushes=-1)


def add(base: ElevationFunction, details: Sequence[ElevationFunction], *, grow: bool = False) -> ElevationFunction:
    """Return a tree with the heights of others on it, one after the other."""
    for detail in details:
        base = Add(base, detail, grow)
    return base
