"""A weight by terrain: a tree that appears where another one has certain altitudes and slopes (figure 13)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import inf, isfinite, radians, sqrt, tan
from typing import TYPE_CHECKING

import numpy as np

from nodegraph import port_type
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.function import ABSENT, Bounds, Box, ElevationFunction, Floats, Points, Sample, product
from nodegraph_tree.presence import presence, presence_gradient, presence_slope, present_slope

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

EPSILON = float(np.finfo(np.float64).eps)

_ALTITUDE, _TERRAIN = (Kernel(f"tree_by_{name}", FOLDER / "operators.cl") for name in ("altitude", "terrain"))
_ENTER, _LEAVE = Kernel("tree_enter", FOLDER / "basic.cl"), Kernel("tree_leave", FOLDER / "basic.cl")

_AROUND = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
_SPREAD = 1e30
"""An end that is not there."""


@port_type
class Hat:
    """A smooth hat of a number v: 0 up to `foot`, 1 from `shoulder` to `brow`, 0 again from `head`; C1.

    S((v - foot) / (shoulder - foot)) S((head - v) / (head - brow)), S(t) = 3 t^2 - 2 t^3, whose slope is 1.5 at most.
    An infinite foot or head leaves that side at 1.
    """

    foot: float
    shoulder: float
    brow: float
    head: float

    @property
    def _rates(self) -> tuple[float, float, float, float]:
        up = (self.foot, 1 / (self.shoulder - self.foot)) if isfinite(self.foot) else (-_SPREAD, 1.0)
        down = (self.head, 1 / (self.head - self.brow)) if isfinite(self.head) else (_SPREAD, 1.0)
        return (*up, *down)

    @property
    def numbers(self) -> tuple[float, float, float, float]:
        """What the kernel's ``hat`` reads: foot, 1 / rise, head, 1 / fall."""
        return self._rates

    def value(self, v: Floats) -> Floats:
        """Return the hat at v."""
        foot, rise, head, fall = self._rates
        up, down = np.clip((v - foot) * rise, 0, 1), np.clip((head - v) * fall, 0, 1)
        return up * up * (3 - 2 * up) * (down * down * (3 - 2 * down))

    def derivative(self, v: Floats) -> Floats:
        """Return the derivative of the hat at v; at most one of its sides changes, since shoulder <= brow."""
        foot, rise, head, fall = self._rates
        up, down = np.clip((v - foot) * rise, 0, 1), np.clip((head - v) * fall, 0, 1)
        return 6 * rise * up * (1 - up) - 6 * fall * down * (1 - down)

    def between(self, low: float, high: float) -> tuple[float, float, float]:
        """Return the least and greatest hat, and its greatest slope, for v from `low` to `high`."""
        ends = self.value(np.clip([low, high], -_SPREAD / 10, _SPREAD / 10))
        least = float(ends.min())
        most = 1.0 if low <= self.brow and high >= self.shoulder else float(ends.max())
        slope = 0.0
        for start, end in ((self.foot, self.shoulder), (self.brow, self.head)):
            if isfinite(start) and isfinite(end) and low < end and high > start:
                near = min(max((start + end) / 2, low), high)  # the slope is greatest half way, and symmetric
                slope = max(slope, abs(float(self.derivative(np.array(near)))))
        return least, most, slope


ANY = Hat(-inf, -inf, inf, inf)
"""The hat that is 1 everywhere."""


@port_type
class ByTerrain(ElevationFunction):
    """A tree B whose weight depends on another one, A: f = f_B, alpha = alpha_B h(f_A) s(|D f_A|) c.

    h and s are hats, and c is the `presence` of A, 1 on its terrain: where A is not, B is not either.

    Slope is measured over a distance, D f(p) = ((f(p + b x) - f(p - b x)) / 2b, (f(p + b y) - f(p - b y)) / 2b), not by
    the gradient: the gradient of a weight by |grad f| would take second derivatives, which trees do not have and which
    nothing bounds.  Central differences over a stated span have an exact gradient from first derivatives, (grad f(p + b
    x) - grad f(p - b x)) / 2b, of |...| <= sup |grad f_A| / b, and roughness smaller than the span does not count.  `c`
    is then the product over the five points.

    Attributes:
        operand: B.
        terrain: A.
        altitude: h, m.
        steepness: s, of the tangent of the slope.
        span: b, m.
    """

    operand: ElevationFunction
    terrain: ElevationFunction
    altitude: Hat
    steepness: Hat
    span: float

    @property
    def parts(self) -> Sequence[ElevationFunction]:
        """B and A."""
        return (self.operand, self.terrain)

    @property
    def by_slope(self) -> bool:
        """True where the slope matters, so that A is asked five times rather than once."""
        return isfinite(self.steepness.foot) or isfinite(self.steepness.head)

    @cached_property
    def support(self) -> Box:
        """That of B, where A reaches."""
        return self.operand.support.intersection(self.terrain.support)

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Ask B everywhere, and A where B is."""
        found = self.operand.query(points, gradient=gradient)
        here = found.weight > 0
        weight = np.zeros_like(found.weight)
        weight_gradient = np.zeros((2, *weight.shape)) if gradient else None
        if not here.any():
            return Sample(found.height, weight, found.height_gradient, weight_gradient)
        factor, turned = self._factor(points.taken(here), gradient=gradient)
        weight[here] = found.weight[here] * factor
        if weight_gradient is not None:
            assert found.weight_gradient is not None
            assert turned is not None
            weight_gradient[:, here] = factor * found.weight_gradient[:, here] + found.weight[here] * turned
        return Sample(found.height, weight, found.height_gradient, weight_gradient)

    def _factor(self, points: Points, *, gradient: bool) -> tuple[Floats, Floats | None]:
        """Return what the weight of B is multiplied by, and its gradient."""
        middle = self.terrain.query(points, gradient=gradient)
        # The factors, each with its gradient; then the product rule.
        factors: list[tuple[Floats, Floats | None]] = [_presence_of(middle)]
        heights = self.altitude.value(middle.height)
        slope = (
            None if middle.height_gradient is None else self.altitude.derivative(middle.height) * middle.height_gradient
        )
        factors.append((heights, slope))
        if self.by_slope:
            around = [
                self.terrain.query(points.moved(points.x + self.span * x, points.y + self.span * y), gradient=gradient)
                for x, y in _AROUND
            ]
            factors.extend(_presence_of(item) for item in around)
            per = 0.5 / self.span
            east, north = (around[0].height - around[1].height) * per, (around[2].height - around[3].height) * per
            steep = np.sqrt(east * east + north * north)
            slope = None
            if gradient:
                rows = [item.height_gradient for item in around if item.height_gradient is not None]
                along_x, along_y = (rows[0] - rows[1]) * per, (rows[2] - rows[3]) * per
                # |D f| has no derivative where it is 0, nor has the hat a slope there.
                unit = np.divide(1.0, steep, out=np.zeros_like(steep), where=steep > 0)
                slope = self.steepness.derivative(steep) * unit * (east * along_x + north * along_y)
            factors.append((self.steepness.value(steep), slope))
        value, turned = factors[0]
        for other, slope in factors[1:]:
            turned = None if turned is None or slope is None else other * turned + value * slope
            value = value * other
        return value, turned

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound B, with the weight times what the hats can be for the heights and slopes that A can have in the box.

        |grad h| <= h' c |grad f_A|; |grad s| <= s' |J|, J the matrix of the differences' gradients, two rows of at
        most sup(c |grad f_A|) / b: |J| <= sqrt(2) sup / b.  Each c adds its own slope.  |D f_A| <= sqrt(2) sup |grad
        f_A|.
        """
        own = self.operand.bounds(box, detail)
        if own.absent:
            return ABSENT
        middle = self.terrain.bounds(box, detail)
        if middle.absent:
            return ABSENT
        least, most, steep = self.altitude.between(middle.low, middle.high)
        least *= float(presence(np.array(middle.weight_low)))
        turned = product(steep, present_slope(middle)) + presence_slope(middle)
        if self.by_slope:
            around = self.terrain.bounds(box.grown(self.span), detail)
            # A mean of slopes along the axes, where the whole neighbourhood is terrain; else the heights are a guess.
            slope = around.slope if around.weight_low >= 0.5 else inf
            slope = min(sqrt(2) * slope, sqrt(0.5) * max(around.high - around.low, 0.0) / self.span)
            # Level ground measures a slope of rounding's size, which opens a hat that begins at 0 by as little.
            slope += 64 * EPSILON * (1 + max(abs(around.low), abs(around.high))) / self.span
            low, high, steep = self.steepness.between(0.0, slope)
            least *= low * float(presence(np.array(around.weight_low))) ** 4
            most *= high
            turned += product(steep, sqrt(2) * present_slope(around) / self.span) + 4 * presence_slope(around)
        if most <= 0:
            return ABSENT
        return own._replace(
            weight_low=own.weight_low * least,
            weight_high=own.weight_high * most,
            weight_slope=most * own.weight_slope + product(own.weight_high, turned),
            flux=own.flux * most,
        )

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """B, A once or at five points around, and the factor; nothing where the hats are 0 in the tile."""
        detail = emitter.detail
        if isinstance(detail, (int, float)) and self.bounds(frame.box, detail).absent:
            emitter.nothing()
            return
        self.operand.emit(emitter, frame)
        self.terrain.emit(emitter, frame)
        if not self.by_slope:
            emitter.add(_ALTITUDE, self.altitude.numbers, pushes=-1)
            return
        one = (1.0, 0.0, 0.0, 1.0)
        for x, y in _AROUND:
            emitter.enter(_ENTER, one)
            self.terrain.emit(emitter, frame.carried(one, (self.span * x, self.span * y)))
            emitter.leave(_LEAVE, [1.0, 0.0])
        emitter.add(_TERRAIN, [*self.altitude.numbers, *self.steepness.numbers, 0.5 / self.span], pushes=-5)


def _presence_of(sample: Sample) -> tuple[Floats, Floats | None]:
    turned = None
    if sample.weight_gradient is not None:
        turned = presence_gradient(sample.weight, sample.weight_gradient)
    return presence(sample.weight), turned


def by_terrain(
    operand: ElevationFunction,
    terrain: ElevationFunction,
    *,
    lowest: float | None = None,
    highest: float | None = None,
    altitude_fade: float = 50.0,
    gentlest: float | None = None,
    steepest: float | None = None,
    slope_fade: float = 10.0,
    span: float = 10.0,
) -> ByTerrain:
    """Return a tree whose weight is full from `lowest` to `highest` (m) and from `gentlest` to `steepest` (degrees).

    It fades to nothing over `altitude_fade` metres and `slope_fade` degrees beyond.

    Raises:
        ValueError: an interval is empty or a fade or the span not above 0.
    """
    if not (altitude_fade > 0 and slope_fade > 0 and span > 0):
        raise ValueError("the fades and the span must be above 0, for weights may not jump")
    if lowest is not None and highest is not None and lowest > highest:
        raise ValueError(f"lowest {lowest:g} m lies above highest {highest:g} m; exchange them")
    if gentlest is not None and steepest is not None and gentlest > steepest:
        raise ValueError(f"gentlest {gentlest:g} deg is steeper than steepest {steepest:g} deg; exchange them")
    altitude = Hat(
        -inf if lowest is None else lowest - altitude_fade,
        -inf if lowest is None else float(lowest),
        inf if highest is None else float(highest),
        inf if highest is None else highest + altitude_fade,
    )

    def tangent(degrees: float) -> float:
        return tan(radians(min(max(degrees, 0.0), 89.9)))

    # A slope is never below 0, so what begins at 0 has no foot.
    flat, upright = gentlest is None or gentlest <= 0, steepest is None or steepest > 89
    steepness = Hat(
        -inf if flat else tangent((gentlest or 0.0) - slope_fade),
        -inf if flat else tangent(gentlest or 0.0),
        inf if upright else tangent(steepest or 0.0),
        inf if upright else tangent((steepest or 0.0) + slope_fade),
    )
    return ByTerrain(operand, terrain, altitude, steepness, float(span))
