"""A weight by terrain: a tree that appears where another one has certain altitudes and slopes (figure 13)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import hypot, inf, isfinite, radians, sqrt, tan
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from nodegraph import port_type
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.function import ABSENT, THRESHOLD, Bounds, Box, ElevationFunction, Floats, Points, Sample, product
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
        """Bound B, with the weight times what the hats can be for the heights and slopes that A can have in the box."""
        own = self.operand.bounds(box, detail)
        factor = _NOTHING if own.absent else self._factor_bounds(box, detail)
        if factor.most <= 0:
            return ABSENT
        return own._replace(
            weight_low=own.weight_low * factor.least,
            weight_high=own.weight_high * factor.most,
            weight_slope=factor.most * own.weight_slope + product(own.weight_high, factor.slope),
            flux=own.flux * factor.most,
        )

    def _factor_bounds(self, box: Box, detail: float, *, closely: bool = True) -> _Factor:
        """Bound what the weight of B is multiplied by; with `closely` A is asked where it counts, else once around.

        |grad h| <= h' c |grad f_A|; |grad s| <= s' |J|, J the matrix of the differences' gradients.  Each c adds its
        own slope.
        """
        middle = self.terrain.bounds(box, detail)
        if middle.absent:
            return _NOTHING
        least, most, steep = self.altitude.between(middle.low, middle.high)
        found = _Factor(least, most, product(steep, present_slope(middle))).where(_presence_bounds(middle))
        if not self.by_slope or found.most <= 0:
            return found
        slopes = self._slopes_around(box, detail)
        # One question has the answer where the hat is level, and boxes wider than the span overlap too much to differ.
        if closely and slopes.factor(self.steepness).slope > 0 and max(_sides(box)) <= 4 * self.span:
            slopes = slopes.met(self._slopes_beside(box, detail))
        return found.times(slopes.factor(self.steepness).where(slopes.presence))

    def _slopes_around(self, box: Box, detail: float) -> _Slopes:
        """Bound D f_A by the bounds of A in the box and all around.

        |D f_A| <= sqrt(2) sup |grad f_A|, a mean of slopes along the axes, and the two rows of J have at most
        sup(c |grad f_A|) / b each.
        """
        wide = self.terrain.bounds(box.grown(self.span), detail)
        # Where not all around is terrain, the heights are a guess.
        high = sqrt(2) * (wide.slope if wide.weight_low >= THRESHOLD else inf)
        high = min(high, sqrt(0.5) * max(wide.high - wide.low, 0.0) / self.span)
        presence = _presence_bounds(wide)
        every = presence.times(presence).times(presence.times(presence))
        return _Slopes(0.0, high + self._rounding(wide), sqrt(2) * present_slope(wide) / self.span, every)

    def _slopes_beside(self, box: Box, detail: float) -> _Slopes:
        """Bound D f_A by the bounds of A in the four boxes that its points are from: in small ones far tighter."""
        presence, found = _Factor(1.0, 1.0, 0.0), []
        for x, y in _AROUND:
            dx, dy = self.span * x, self.span * y
            beside = self.terrain.bounds(Box(box.west + dx, box.south + dy, box.east + dx, box.north + dy), detail)
            if beside.absent:
                return _Slopes(0.0, 0.0, 0.0, _NOTHING)
            presence = presence.times(_presence_bounds(beside))
            found.append(beside)
        nearest, farthest, rows = [], [], []
        for ahead, behind in (found[:2], found[2:]):
            low, high = ahead.low - behind.high, ahead.high - behind.low
            nearest.append(max(low, -high, 0.0))
            farthest.append(max(high, -low))
            rows.append(present_slope(ahead) + present_slope(behind))
        per = 0.5 / self.span
        rounding = max(map(self._rounding, found))
        low, high = hypot(*nearest) * per - rounding, hypot(*farthest) * per + rounding
        return _Slopes(max(low, 0.0), high, hypot(*rows) * per, presence)

    def _rounding(self, bounds: Bounds) -> float:
        """Return what rounding does to D f_A: level ground measures that much, and it opens a hat that begins at 0."""
        return 64 * EPSILON * (1 + max(abs(bounds.low), abs(bounds.high))) / self.span

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """B, A once or at five points around, and the factor; nothing where the hats are 0 in the tile."""
        detail = emitter.detail
        if isinstance(detail, (int, float)) and self._closed(frame.box, detail):
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

    def _closed(self, box: Box, detail: float) -> bool:
        """Say whether there is nothing in a box, without asking much."""
        return self._factor_bounds(box, detail, closely=False).most <= 0 or self.operand.bounds(box, detail).absent


class _Factor(NamedTuple):
    """What a factor of a weight can be in a box: `least`, `most`, and the greatest `slope`."""

    least: float
    most: float
    slope: float

    def times(self, other: _Factor) -> _Factor:
        """Bound the product of two."""
        slope = product(self.slope, other.most) + product(other.slope, self.most)
        return _Factor(self.least * other.least, self.most * other.most, slope)

    def where(self, presence: _Factor) -> _Factor:
        """Bound the product with a presence c that the slope, a bound of c |grad|, already counts."""
        slope = self.slope + product(presence.slope, self.most)
        return _Factor(self.least * presence.least, self.most * presence.most, slope)


_NOTHING = _Factor(0.0, 0.0, 0.0)


class _Slopes(NamedTuple):
    """What D f_A can be in a box: |D f_A| from `low` to `high`, c |J| up to `turn`, and c, the `presence` of A."""

    low: float
    high: float
    turn: float
    presence: _Factor

    def met(self, other: _Slopes) -> _Slopes:
        """Return what holds where both do."""
        low, high = max(self.low, other.low), min(self.high, other.high)
        presence = other.presence if other.presence.slope <= self.presence.slope else self.presence
        return _Slopes(min(low, high), high, min(self.turn, other.turn), presence)

    def factor(self, hat: Hat) -> _Factor:
        """Bound a hat of |D f_A|, and c times its slope."""
        least, most, steep = hat.between(self.low, self.high)
        return _Factor(least, most, product(steep, self.turn))


def _presence_bounds(bounds: Bounds) -> _Factor:
    least, most = presence(np.array([bounds.weight_low, bounds.weight_high])).tolist()
    return _Factor(least, most, presence_slope(bounds))


def _sides(box: Box) -> tuple[float, float]:
    return box.east - box.west, box.north - box.south


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
