"""Replacement: each layer takes the place of what lies below it, in order (section 5.2)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import inf, sqrt
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.function import THRESHOLD, Bounds, Box, ElevationFunction, Floats, Points, Sample, product
from nodegraph_tree.presence import (
    STEEPEST,
    presence,
    presence_gradient,
    presence_slope,
    present_slope,
)

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

_REPLACE = Kernel("tree_replace", FOLDER / "operators.cl")


@port_type
class Replace(ElevationFunction):
    """A tree A with layers B in its place, one after the other: f = (1 - a) f_A + a f_B with a = min(alpha_B, 1).

    The weight is alpha_A, or with `grow` (1 - a) alpha_A + a^2, so that B reaches beyond A.  A weight above 1, as
    blends have, is clamped: the printed formula would extrapolate there.

    Beyond the terrain of A, where f_A comes to mean nothing, `grow` lets A count by its `presence` c <= 1 only:
    f = ((1 - a) c f_A + a f_B) / ((1 - a) c + a), the printed formula wherever alpha_A >= T.  As printed, f would jump
    at the edge of A.

    Build it with `replace`, which makes one of nested ones.

    Attributes:
        base: A.
        layers: B, C, ... the last one on top.
        grow: take the weights of the layers into account.
    """

    base: ElevationFunction
    layers: tuple[ElevationFunction, ...]
    grow: bool = False

    @property
    def parts(self) -> Sequence[ElevationFunction]:
        """A and the layers."""
        return (self.base, *self.layers)

    @cached_property
    def support(self) -> Box:
        """That of A, and with `grow` those of the layers as well."""
        box = self.base.support
        for layer in self.layers if self.grow else ():
            box = box.union(layer.support)
        return box

    @cached_property
    def _boxes(self) -> Floats:
        return np.array([layer.support for layer in self.layers]).reshape(-1, 4)

    def reaching(self, box: Box) -> list[ElevationFunction]:
        """Return the layers whose support meets a box, in order."""
        west, south, east, north = self._boxes.T
        hits = (west <= box.east) & (box.west <= east) & (south <= box.north) & (box.south <= north)
        return [self.layers[index] for index in np.flatnonzero(hits)]

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Ask A everywhere and each layer where it reaches."""
        found = self.base.query(points, gradient=gradient)
        copied = False
        for layer in self.layers:
            near = layer.support
            where = (
                (points.x >= near.west) & (points.x <= near.east) & (points.y >= near.south) & (points.y <= near.north)
            )
            if not where.any():
                continue
            if not copied:
                found, copied = copy_of(found), True
            self._lay(found, layer.query(points.taken(where), gradient=gradient), where)
        return found

    def _lay(self, found: Sample, layer: Sample, where: npt.NDArray[np.bool_]) -> None:
        """Put a layer's samples, those at `where`, over what was found so far."""
        height, weight = found.height[where], found.weight[where]
        a = np.minimum(layer.weight, 1.0)
        share = a
        if self.grow:
            there = presence(weight)
            total = a + (1 - a) * there
            share = np.divide(a, total, out=np.zeros_like(a), where=total > 0)
            found.weight[where] = (1 - a) * weight + a * a
        found.height[where] = (1 - share) * height + share * layer.height
        if found.height_gradient is None or found.weight_gradient is None:
            return
        assert layer.height_gradient is not None
        assert layer.weight_gradient is not None
        slope, weight_slope = found.height_gradient[:, where], found.weight_gradient[:, where]
        a_slope = np.where(layer.weight < 1, layer.weight_gradient, 0.0)
        share_slope = a_slope
        if self.grow:
            turned = there * a_slope - a * (1 - a) * presence_gradient(weight, weight_slope)
            share_slope = np.divide(turned, total * total, out=np.zeros_like(turned), where=total * total > 0)
            found.weight_gradient[:, where] = (1 - a) * weight_slope + a_slope * (2 * a - weight)
        found.height_gradient[:, where] = (1 - share) * slope + share * layer.height_gradient
        found.height_gradient[:, where] += share_slope * (layer.height - height)

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound A, then each layer that reaches the box over it; see `over` and `grown_over`."""
        found = self.base.bounds(box, detail)
        for layer in self.reaching(box):
            above = layer.bounds(box, detail)
            if not above.absent:
                found = grown_over(found, above) if self.grow else over(found, above)
        return found

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """A, and each layer over it that reaches the tile."""
        self.base.emit(emitter, frame)
        for layer in self.reaching(frame.box):
            layer.emit(emitter, frame)
            emitter.add(_REPLACE, ints=[int(self.grow)], pushes=-1)


def copy_of(sample: Sample) -> Sample:
    """Return a sample whose arrays may be changed."""
    height, weight, *slopes = sample
    return Sample(height.copy(), weight.copy(), *(None if item is None else item.copy() for item in slopes))


def replace(base: ElevationFunction, layers: Sequence[ElevationFunction], *, grow: bool = False) -> ElevationFunction:
    """Return a tree with layers in its place, joined to those it already has; without layers the tree itself."""
    if not layers:
        return base
    if isinstance(base, Replace) and base.grow == grow:
        return Replace(base.base, (*base.layers, *layers), grow)
    return Replace(base, tuple(layers), grow)


def over(base: Bounds, layer: Bounds) -> Bounds:
    """Bound B over A: grad f = (1 - a) grad f_A + a grad f_B + (f_B - f_A) grad a, a = min(alpha_B, 1).

    a |grad f_B| is at most the flux of B, and a times the slope of B where that is bounded on its whole support.
    """
    if base.absent:
        return base
    least, most = min(layer.weight_low, 1.0), min(layer.weight_high, 1.0)
    spread = max(layer.high - base.low, base.high - layer.low, 0.0)
    pull = product(layer.weight_slope if least < 1 else 0.0, spread)

    def mixed(below: float) -> float:
        # Linear in a, so greatest at an end; or a |grad f_B| by the flux.
        ends = max(product(1 - a, below) + product(a, layer.steepest) for a in (least, most))
        return min(ends, product(1 - least, below) + layer.flux) + pull

    low, high = _between(base, layer, (least, most))
    flux = product(1 - least, base.flux)
    flux += product(base.weight_high, min(layer.flux, product(most, layer.steepest)) + pull)
    return Bounds(
        low,
        high,
        base.weight_low,
        base.weight_high,
        mixed(base.slope),
        base.weight_slope,
        flux,
        mixed(base.steepest),
    )


def _between(base: Bounds, layer: Bounds, shares: tuple[float, float]) -> tuple[float, float]:
    """Bound (1 - w) f_A + w f_B for w between two numbers: linear in all three, so at ends of them."""
    low = min(product(1 - w, base.low) + product(w, layer.low) for w in shares)
    high = max(product(1 - w, base.high) + product(w, layer.high) for w in shares)
    return low, high


def grown_over(base: Bounds, layer: Bounds) -> Bounds:
    """Bound B over A where B reaches beyond A, with the share w = a / D of B, D = a + (1 - a) c.

    grad w = (c grad a - a (1 - a) grad c) / D^2.  On the terrain, alpha_A < T is possible only where a > 1/2, since
    (1 - a) alpha_A + a^2 >= T = 1/2.  There c / D^2 <= 1 (it rises with c) and a (1 - a) / D^2 |grad c| is at most
    4 (1 - s)(1 - a) / a |grad alpha_A| <= 4 (sqrt(2) - 1) |grad alpha_A|, reached at s = 0; elsewhere c = D = 1.  So
    |grad w| <= |grad a| + 4 (sqrt(2) - 1) |grad alpha_A|.  With D >= 1/2, a |grad f_B| / D is at most the slope of B
    where a >= T, and its flux elsewhere, where D = 1.

    On the whole support alpha / D <= max(T, a, alpha) as s <= c, and c / D, a / D <= 1, which gives the flux.
    """
    most, least = min(layer.weight_high, 1.0), min(layer.weight_low, 1.0)
    if base.absent:
        base = Bounds(layer.low, layer.high, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if base.weight_low >= THRESHOLD:
        # On the terrain of A this is the printed formula, but for the weight.
        plain = over(base, layer)
        low, high, slope, support_slope = plain.low, plain.high, plain.slope, plain.support_slope
    else:
        low, high = _between(base, layer, (least, 1.0))  # w >= a
        turned = layer.weight_slope + STEEPEST * (sqrt(2) - 1) * base.weight_slope
        mean = max(base.slope, base.steepest, layer.slope, layer.steepest)
        parts = present_slope(base) + max(layer.slope, min(layer.flux, layer.steepest))
        slope = min(mean, parts) + product(turned, max(high - low, 0.0))
        support_slope = inf
    lowest = min(max(base.weight_low / 2, least), most)
    weight_low = (1 - lowest) * base.weight_low + lowest**2
    weight_high = max((1 - a) * base.weight_high + a * a for a in (least, most))
    weight_slope = product(1 - least, base.weight_slope)
    turn = max(abs(2 * most - base.weight_low), abs(2 * least - base.weight_high))
    weight_slope += product(layer.weight_slope, turn)
    ratio = max(THRESHOLD, most, weight_high)
    spread = max(layer.high - base.low, base.high - layer.low, 0.0)
    flux = product(1 - least, STEEPEST * base.flux) + layer.flux
    flux += product(layer.weight_slope + product(1 - least, presence_slope(base)), spread)
    return Bounds(low, high, weight_low, weight_high, slope, weight_slope, product(ratio, flux), support_slope)
