"""Contour primitives: radial cross-sections about a centre, scaled to a closed curve around it (section 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import atan2, hypot, inf, pi, radians
from typing import TYPE_CHECKING, Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Param, node, port_type
from nodegraph_tree import profile
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.falloff import CODES, FallOff, derivative, fall_off, steepest_between
from nodegraph_tree.function import (
    ABSENT,
    THRESHOLD,
    Bounds,
    Box,
    ElevationFunction,
    Points,
    Sample,
    empty_sample,
)
from nodegraph_tree.profile import Section, Shape, section

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

Floats = npt.NDArray[np.float64]

_CONTOUR = Kernel("tree_contour", FOLDER / "contour.cl")
_FULL = 2 * pi


@port_type
class Contour(ElevationFunction):
    """Radial sections in a closed curve: f = height + c(u, theta), alpha = g((u - core) / (reach - core)).

    (d, theta) are polar coordinates about the centre, theta from `direction`; u = d / rho(theta) is 0 at the centre and
    1 on the curve.

    Attributes:
        x, y: centre, m.
        height: of the centre, m.
        direction: where theta is 0, radians counter-clockwise from east.
        outline: (n, 5) pieces of rho, rows ``(begin, a, b, c, e)``: rho = a + t (b + t (c + t e)), t = theta - begin,
            rising from begin = 0 to 2 pi.
        angles: theta of the cross-sections, rising within [0, 2 pi).
        sections: radial cross-sections, heights by u; all have the same height at 0.  Their left sides count.
        core, reach: of the weight, in u.
        fall_off: g.
    """

    x: float
    y: float
    height: float
    direction: float
    outline: Floats
    angles: tuple[float, ...]
    sections: tuple[Section, ...]
    core: float
    reach: float
    fall_off: FallOff = "wyvill"

    @cached_property
    def _widest(self) -> float:
        return self.reach * self._radii(0.0, _FULL)[1]

    @cached_property
    def support(self) -> Box:
        """Around the circle that holds the support."""
        return Box(self.x, self.y, self.x, self.y).grown(self._widest)

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Return height and weight.  O(points)."""
        found = empty_sample(points, gradient=gradient)
        dx, dy = points.x - self.x, points.y - self.y
        near = dx * dx + dy * dy < self._widest**2
        if not near.any():
            return found
        dx, dy = dx[near], dy[near]
        d = np.hypot(dx, dy)
        theta = np.mod(np.arctan2(dy, dx) - self.direction, _FULL)
        theta[theta >= _FULL] = 0.0
        rho, rho_rate = self._radius(theta)
        u = d / rho
        c, by_u, by_theta = self._section(u, theta)
        wide = self.reach - self.core
        t = np.maximum(u - self.core, 0.0) / wide
        height, weight = found.height.copy(), found.weight.copy()
        weight[near] = fall_off(self.fall_off, t)
        height[near] = np.where(t < 1, self.height + c, 0.0)
        if not gradient:
            return Sample(height, weight)
        safe = np.maximum(d, 1e-300)
        outward = np.where(d > 0, np.stack([dx, dy]) / safe, 0.0)
        around = np.stack([-outward[1], outward[0]])
        u_slope = outward / rho - around * (rho_rate / rho**2)
        slopes = np.zeros((2, *points.x.shape)), np.zeros((2, *points.x.shape))
        slopes[0][:, near] = np.where(t < 1, by_u * u_slope + around * (by_theta / safe), 0.0)
        slopes[1][:, near] = np.where(t > 0, derivative(self.fall_off, t) / wide * u_slope, 0.0)
        return Sample(height, weight, *slopes)

    def radius(self, theta: Floats) -> Floats:
        """Return rho at angles within [0, 2 pi)."""
        return self._radius(theta)[0]

    def _radius(self, theta: Floats) -> tuple[Floats, Floats]:
        index = np.searchsorted(self.outline[:, 0], theta, side="right") - 1
        begin, a, b, c, e = self.outline[np.maximum(index, 0)].T
        t = theta - begin
        return a + t * (b + t * (c + t * e)), b + t * (2 * c + t * 3 * e)

    @cached_property
    def _sectors(self) -> list[tuple[float, float, int, int]]:
        """(begin, width, section at the begin, section at the end) of the sectors that cover [0, 2 pi]."""
        count = len(self.angles)
        if count == 1:
            return [(0.0, _FULL, 0, 0)]
        ends = [*self.angles, self.angles[0] + _FULL]
        found = [(ends[k], ends[k + 1] - ends[k], k, (k + 1) % count) for k in range(count)]
        if self.angles[0] > 0:
            begin, width, first, last = found[-1]
            found.insert(0, (begin - _FULL, width, first, last))
        return found

    def _section(self, u: Floats, theta: Floats) -> tuple[Floats, Floats, Floats]:
        """Return c and its derivatives by u and theta; between two sections they change over smoothly."""
        c, by_u, by_theta = np.empty_like(u), np.empty_like(u), np.empty_like(u)
        begins = np.array([sector[0] for sector in self._sectors])
        index = np.maximum(np.searchsorted(begins, theta, side="right") - 1, 0)
        for k in np.unique(index).tolist():
            here = index == k
            begin, width, first, last = self._sectors[k]
            a, a_rate = profile.evaluate(self.sections[first].left, u[here])
            b, b_rate = profile.evaluate(self.sections[last].left, u[here])
            t = np.clip((theta[here] - begin) / width, 0.0, 1.0)
            share = t * t * (3 - 2 * t)
            c[here] = a + share * (b - a)
            by_u[here] = a_rate + share * (b_rate - a_rate)
            by_theta[here] = 6 * t * (1 - t) / width * (b - a)
        return c, by_u, by_theta

    # Bounds.

    def _turns(self, box: Box) -> list[tuple[float, float]]:
        """Return intervals of theta within [0, 2 pi] that hold those of a box."""
        if box.west <= self.x <= box.east and box.south <= self.y <= box.north:
            return [(0.0, _FULL)]
        corners = [(x - self.x, y - self.y) for x in (box.west, box.east) for y in (box.south, box.north)]
        middle = atan2(0.5 * (box.south + box.north) - self.y, 0.5 * (box.west + box.east) - self.x)
        # A box that does not hold the centre is seen under less than a half turn.
        off = [(atan2(y, x) - middle + pi) % _FULL - pi for x, y in corners]
        low = (middle + min(off) - self.direction) % _FULL
        high = low + max(off) - min(off)
        room = 1e-12
        if high + room > _FULL:
            return [(max(low - room, 0.0), _FULL), (0.0, high + room - _FULL)]
        if low - room < 0:
            return [(0.0, high + room), (_FULL - room, _FULL)]
        return [(low - room, high + room)]

    def _radii(self, low: float, high: float) -> tuple[float, float, float]:
        """Return least and greatest rho, and the greatest |rho'|, for theta from low to high; exact."""
        ends = np.append(self.outline[1:, 0], _FULL)
        met = (self.outline[:, 0] <= high) & (ends >= low)
        begin, a, b, c, e = self.outline[met].T
        first, last = np.maximum(low, begin) - begin, np.minimum(high, ends[met]) - begin
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.sqrt(np.maximum(c * c - 3 * b * e, 0.0))
            # Stable roots of b + 2 c t + 3 e t^2.
            q = -(c + np.copysign(root, c))
            turns = [q / (3 * e), b / q]
            bend = -c / (3 * e)
        stops = [np.clip(np.nan_to_num(t, nan=0.0, posinf=0.0, neginf=0.0), first, last) for t in (*turns, bend)]
        stops += [first, last]
        values = np.concatenate([a + t * (b + t * (c + t * e)) for t in stops])
        rates = np.concatenate([np.abs(b + t * (2 * c + 3 * e * t)) for t in stops])
        return float(values.min()), float(values.max()), float(rates.max())

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:  # noqa: ARG002
        """Bound everything over the range of d and theta in a box.

        grad u = e_r / rho - e_theta rho' / rho^2, and

            grad f = c_u grad u + e_theta s'(theta) (c_next - c_this) / d,   |s'| <= 3 / (2 sector),

        where |c_next - c_this| / d = (|c_next - c_this| / u) / rho is bounded since all sections agree at the centre.
        Cross-sections, rho and rho' are bounded by their exact extremes.
        """
        part = box.intersection(self.support)
        if part.empty:
            return ABSENT
        d0, d1 = part.distance(self.x, self.y)
        turns = self._turns(part)
        found = [self._radii(*turn) for turn in turns]
        least, most = min(item[0] for item in found), max(item[1] for item in found)
        rate = max(item[2] for item in found)
        near, far = d0 / most, min(d1 / least, self.reach)
        if near >= self.reach:
            return ABSENT
        turned = hypot(1 / least, rate / least**2)
        sectors = [
            sector
            for sector in self._sectors
            if any(sector[0] <= high and low <= sector[0] + sector[1] for low, high in turns)
        ]
        low, high, slope = self._slopes(sectors, near, far, least, turned)
        wide = self.reach - self.core
        t0, t1 = (max(end - self.core, 0.0) / wide for end in (near, far))
        weight_low, weight_high = fall_off(self.fall_off, np.array([min(t1, 1.0), t0])).tolist()
        if d1 / least > self.reach:
            weight_low = 0.0
        ground = slope
        terrain = self.core + self._terrain * wide
        if terrain < far:
            ground = self._slopes(sectors, near, terrain, least, turned)[2] if terrain >= near else 0.0
        steep = steepest_between(self.fall_off, t0, min(t1, 1.0)) * turned / wide
        return Bounds(
            self.height + low, self.height + high, weight_low, weight_high, ground, steep, weight_high * slope, slope
        )

    def _slopes(
        self, sectors: Sequence[tuple[float, float, int, int]], near: float, far: float, least: float, turned: float
    ) -> tuple[float, float, float]:
        """Return least and greatest c in some sectors, and the greatest slope."""
        low, high, slope = inf, -inf, 0.0
        for _, width, first, last in sectors:
            found = [profile.extremes(self.sections[k].left, near, far) for k in (first, last)]
            low, high = min(low, *(item[0] for item in found)), max(high, *(item[1] for item in found))
            steep = max(item[2] for item in found) * turned
            if first != last:
                apart = profile.difference(self.sections[last].left, self.sections[first].left)
                steep += 1.5 / width * profile.steepest_chord(apart, near, far) / least
            slope = max(slope, steep)
        return low, high, slope

    @cached_property
    def _terrain(self) -> float:
        """The greatest t with g(t) >= T."""
        low, high = 0.0, 1.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if fall_off(self.fall_off, np.array(middle)) >= THRESHOLD else (low, middle)
        return high

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Emit the centre as seen from the tile, and the pieces of the outline and the sectors that the tile sees."""
        part = frame.box.intersection(self.support)
        if part.empty or self.bounds(part).absent:
            emitter.nothing()
            return
        turns = self._turns(frame.box)
        ends = np.append(self.outline[1:, 0], _FULL)
        # With room for the angle's rounding.
        seen = np.zeros(len(ends), bool)
        for low, high in turns:
            seen |= (self.outline[:, 0] <= high + 1e-4) & (ends >= low - 1e-4)
        pieces = self.outline[seen]
        sectors = [
            sector
            for sector in self._sectors
            if any(sector[0] <= high + 1e-4 and low - 1e-4 <= sector[0] + sector[1] for low, high in turns)
        ]
        count = max(len(item.left) for item in self.sections)
        wide = self.reach - self.core
        floats = [
            self.x - frame.ox, self.y - frame.oy, float(np.cos(self.direction)), float(np.sin(self.direction)),
            self.height, self.core, 1 / wide, *pieces.ravel().tolist(),
        ]  # fmt: skip
        for begin, width, first, last in sectors:
            floats += [begin, 1 / width]
            for index in (first, last):
                rows = self.sections[index].left
                floats += [float(value) for k in range(count) for value in rows[min(k, len(rows) - 1)]]
        emitter.add(_CONTOUR, floats, [len(pieces), len(sectors), count, CODES[self.fall_off]])


# The node.

Outline = Annotated[
    tuple[tuple[float, float], ...] | None,
    Param("Points of the curve around the centre, in order; none: by radius.", unit="m"),
]
_CENTRE = Param("Centre [x, y].", unit="m")


@node(version=1)
def contour(
    *,
    centre: Annotated[tuple[float, float], _CENTRE] = (0.0, 0.0),
    points: Outline = None,
    radius: Annotated[
        float | tuple[float, ...], Param("Radius of the curve; a list goes around it from the direction.", unit="m")
    ] = 100.0,
    height: Annotated[float, Param("What the heights of the sections are measured from.", unit="m")] = 0.0,
    direction: Annotated[float, Param("Where the first section lies, counter-clockwise from east.", unit="deg")] = 0.0,
    sections: Annotated[
        tuple[tuple[tuple[float, float], ...], ...],
        Param("Radial sections, each a list of [distance from the centre / radius, height]; evenly spread."),
    ] = (((0.0, 0.0),),),
    angles: Annotated[
        tuple[float, ...], Param("Where the sections lie, from the direction; none: evenly spread.", unit="deg")
    ] = (),
    shape: Annotated[Shape, Param("Sections smooth through their points, or straight lines between them.")] = "smooth",
    core: Annotated[float, Param("Up to where the weight is 1, in radii.", ge=0)] = 1.0,
    reach: Annotated[float, Param("Where the weight reaches 0, in radii.", gt=0)] = 1.5,
    fall_off: Annotated[FallOff, Param("How the weight falls from 1 at the core to 0 at the reach.")] = "wyvill",
) -> ElevationFunction:
    """Spread radial sections about a centre, in the shape of a closed curve around it.

        f(p) = height + c_theta(u),   u = d / rho(theta),   alpha(p) = g((u - core) / (reach - core))

    with polar coordinates (d, theta) about the centre and the curve's radius rho, interpolated smoothly through its
    points (a periodic C2 cubic, or where that would overshoot a C1 one).  c is interpolated between the sections by
    angle, with level derivatives at each.  Outside the curve u goes on in proportion.

    Args:
        centre: inside the curve.
        points: of the curve; seen from the centre they must go round once.
        radius: without points.
        height: at which sections have 0.
        direction: from which angles are measured.
        sections: heights by u >= 0; all with the same height at the centre.
        angles: rising within 0 to 360, as many as sections.
        shape: of the sections.
        core: less than the reach.
        reach: of the support.
        fall_off: g: wyvill, cubic, quintic, plateau.

    Raises:
        ValueError: a curve that does not go round the centre once, sections that differ there, or numbers out of range.

    Source: Génevaux et al. 2015, section 4.1, doi:10.1111/cgf.12530.
    """
    if core >= reach:
        raise ValueError("core must be less than reach")
    made = [_radial(item, shape) for item in sections]
    if not made:
        raise ValueError("sections are empty; give one at least")
    if np.ptp([float(item.left[0, 1]) for item in made]) > 1e-9:
        raise ValueError("all sections must have the same height at the centre")
    if angles and len(angles) != len(made):
        raise ValueError(f"angles must be as many as sections: {len(angles)} for {len(made)}")
    spread = np.radians(angles) if angles else np.arange(len(made)) * _FULL / len(made)
    if (np.diff(spread) <= 0).any() or spread[0] < 0 or spread[-1] >= _FULL:
        raise ValueError("angles must rise from 0 to less than 360")
    turn = radians(direction)
    outline = around(centre, points, turn) if points is not None else wheel(radius)
    return Contour(
        centre[0], centre[1], height, turn, outline, tuple(spread.tolist()), tuple(made), core, reach, fall_off
    )


def _radial(points: Sequence[Sequence[float]], shape: Shape) -> Section:
    if any(point[0] < 0 for point in points):
        raise ValueError("distances of radial sections must not be negative")
    return section(points, shape)


def around(centre: tuple[float, float], points: Sequence[Sequence[float]], direction: float) -> Floats:
    """Return the outline through points that go round a centre once, theta from `direction`.

    Raises:
        ValueError: fewer than three points, one that is not finite or at the centre, or turns back as seen from it.
    """
    given = np.array(points, np.float64)
    if len(given) and np.array_equal(given[0], given[-1]):
        given = given[:-1]
    if len(given) < 3 or not np.isfinite(given).all():
        raise ValueError("the curve around the centre needs three finite points or more")
    dx, dy = (given - np.array(centre)).T
    rho = np.hypot(dx, dy)
    if rho.min() <= 1e-9 * rho.max():
        raise ValueError("the curve runs through its centre; move the centre inside")
    theta = np.arctan2(dy, dx) - direction
    step = np.mod(np.diff(np.append(theta, theta[0])) + pi, _FULL) - pi
    if step.sum() < 0:
        theta, rho = theta[::-1], rho[::-1]
        step = np.mod(np.diff(np.append(theta, theta[0])) + pi, _FULL) - pi
    if (step <= 0).any() or abs(step.sum() - _FULL) > 1e-6:
        raise ValueError("seen from the centre, the curve must go round once without turning back; move the centre")
    theta = np.mod(theta, _FULL)
    order = np.argsort(theta, kind="stable")
    return _periodic(theta[order], rho[order])


def wheel(radius: float | Sequence[float]) -> Floats:
    """Return the outline of one radius, or of radii evenly spread around the centre.

    Raises:
        ValueError: a radius that is not positive and finite.
    """
    radii = np.array([radius] if isinstance(radius, (int, float)) else radius, np.float64)
    if not len(radii) or not np.isfinite(radii).all() or (radii <= 0).any():
        raise ValueError("radius must be greater than 0")
    if len(radii) == 1:
        return np.array([[0.0, radii[0], 0.0, 0.0, 0.0]])
    return _periodic(np.arange(len(radii)) * _FULL / len(radii), radii)


def _periodic(theta: Floats, rho: Floats) -> Floats:
    """Return the pieces of a periodic cubic through (theta, rho), theta rising within [0, 2 pi).

    The C2 spline, which is the smoothest, unless it overshoots by more than a tenth of the least radius; then the C1
    cubic that stays between its points.
    """
    width = np.diff(np.append(theta, theta[0] + _FULL))
    if (width <= 1e-12).any():
        raise ValueError("two points of the curve lie in the same direction from the centre; leave one out")
    secant = np.diff(np.append(rho, rho[0])) / width
    before, a = np.roll(secant, 1), np.roll(width, 1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        mean = 3 * (a + width) / ((2 * width + a) / before + (width + 2 * a) / secant)
    kept: Floats = np.where(before * secant > 0, mean, 0.0)
    count = len(theta)
    if count > 2000:
        return _begun_at_0(_pieces(theta, rho, width, secant, kept))
    # The C2 spline's slopes solve the periodic system with the rows of its continuous second derivative.
    table = np.diag(2 / width + 2 / a)
    table[np.arange(count), np.arange(count) - 1] += 1 / a
    table[np.arange(count), (np.arange(count) + 1) % count] += 1 / width
    spline = np.asarray(np.linalg.solve(table, 3 * (secant / width + before / a)), np.float64)
    rows = _pieces(theta, rho, width, secant, spline)
    t = np.linspace(0, 1, 9)[:, None] * width
    inside = rows[:, 1] + t * (rows[:, 2] + t * (rows[:, 3] + t * rows[:, 4]))
    room = 0.1 * float(rho.min())
    low, high = np.minimum(rho, np.roll(rho, -1)), np.maximum(rho, np.roll(rho, -1))
    if (inside < low - room).any() or (inside > high + room).any():
        rows = _pieces(theta, rho, width, secant, kept)
    return _begun_at_0(rows)


def _begun_at_0(rows: Floats) -> Floats:
    """Return pieces of a whole turn with one that begins at 0: the last one, which runs over it, begun anew."""
    if rows[0, 0] > 0:
        begin, p, q, r, s = rows[-1]
        t = _FULL - begin
        head = [0.0, p + t * (q + t * (r + t * s)), q + t * (2 * r + t * 3 * s), r + 3 * s * t, s]
        rows = np.concatenate([[head], rows])
    return rows


def _pieces(theta: Floats, rho: Floats, width: Floats, secant: Floats, slope: Floats) -> Floats:
    after = np.roll(slope, -1)
    return np.column_stack(
        [theta, rho, slope, (3 * secant - 2 * slope - after) / width, (slope + after - 2 * secant) / width**2]
    )
