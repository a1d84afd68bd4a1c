"""Curve primitives: a cross-section led along a curve (section 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from math import floor, hypot, inf
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Param, node, port_type
from nodegraph_tree import profile
from nodegraph_tree.device import FOLDER, Kernel, Parameters, Pending
from nodegraph_tree.disc import Relief, relief_parameters
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
from nodegraph_tree.geometry import CurveKind
from nodegraph_tree.layout import Line, Stations, line_of, spread, stations
from nodegraph_tree.profile import Section, Shape
from nodegraph_tree.skeleton import TURN, WINDOW, Found, Skeleton, skeleton

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame, Shared

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_CURVE = Kernel("tree_curve", FOLDER / "curve.cl")
_ROUGH = Kernel("tree_curve_rough", FOLDER / "curve.cl")

_DENSE = 1 << 20
"""Pairs of a point and an arc that are evaluated at a time."""


class Seen(NamedTuple):
    """The arcs that matter in a box, and what is known of them at its middle.

    Attributes:
        arcs: all that matter for anything.
        half: distance from the middle of the box to its corners, m.
        near, far: bounds of the distance to the curve in the box, m.
        found: projections of the middle.
        height, height_slope: (m,) at the middle and its bound of |grad z_i|.
        up, down: which can be the best, of the height's minima and maxima.
        place, place_slope, place_up, place_down: the same of the place.
    """

    arcs: Ints
    half: float
    near: float
    far: float
    found: Found
    height: Floats
    height_slope: Floats
    up: npt.NDArray[np.bool_]
    down: npt.NDArray[np.bool_]
    place: Floats
    place_slope: Floats
    place_up: npt.NDArray[np.bool_]
    place_down: npt.NDArray[np.bool_]


@port_type
class Curve(ElevationFunction):
    """Cross-sections led along a curve: f = z + c(d) + relief, alpha = g((d - core) / (radius - core)).

    d is the distance to the curve, z its height and c the cross-section, both continued over the plane as
    `nodegraph_tree.skeleton` says: beside the curve those of the nearest point.  Several curves that run into each
    other are a `nodegraph_tree.union` of several of these.

    Attributes:
        skeleton: the curve.
        sections: cross-sections; a place between k and k + 1 mixes both.
        radii: beyond which the weight is 0, m, one for each section.
        cores: up to which the weight is 1, m, one for each section.
        fall_off: g.
        relief: roughness of the ground, with its origin at `origin`.
        origin: (x, y), m.
    """

    skeleton: Skeleton
    sections: tuple[Section, ...]
    radii: tuple[float, ...]
    cores: tuple[float, ...]
    fall_off: FallOff = "wyvill"
    relief: Relief = Relief()
    origin: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def support(self) -> Box:
        """Around the curve."""
        return self.skeleton.extent.grown(self.skeleton.radius)

    @cached_property
    def _symmetric(self) -> bool:
        return all(item.symmetric for item in self.sections)

    # Evaluation.

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Return height and weight; points are taken in groups that see few arcs.  O(points * arcs in reach)."""
        found = empty_sample(points, gradient=gradient)
        box = self.support
        inside = (points.x >= box.west) & (points.x <= box.east) & (points.y >= box.south) & (points.y <= box.north)
        places = np.flatnonzero(inside)
        if not len(places):
            return found
        height, weight = found.height.copy(), found.weight.copy()
        slopes = (np.zeros((2, *height.shape)), np.zeros((2, *height.shape))) if gradient else None
        for group in self._groups(points, places):
            x, y = points.x[group], points.y[group]
            arcs = self._reaching(Box(float(x.min()), float(y.min()), float(x.max()), float(y.max())))
            if not len(arcs):
                continue
            step = max(1, _DENSE // len(arcs))
            for begin in range(0, len(group), step):
                some = group[begin : begin + step]
                part = self._evaluate(points.x[some], points.y[some], arcs, gradient)
                height[some], weight[some] = part.height, part.weight
                if slopes is not None and part.height_gradient is not None and part.weight_gradient is not None:
                    slopes[0][:, some], slopes[1][:, some] = part.height_gradient, part.weight_gradient
        inside = weight > 0
        if self.relief.noise is not None and inside.any():
            near = points.taken(inside)
            rough, slope = self.relief.query(
                near.x - self.origin[0], near.y - self.origin[1], near.detail, gradient=gradient
            )
            height[inside] += rough
            if slopes is not None and slope is not None:
                slopes[0][:, inside] += slope
        return Sample(height, weight, *slopes) if slopes is not None else Sample(height, weight)

    def _groups(self, points: Points, places: Ints) -> list[Ints]:
        """Return the places of points, those of a cell together."""
        if len(self.skeleton) <= 24:
            return [places]
        size = self.skeleton.radius
        cells = [np.floor((axis[places] - axis[places[0]]) / size).astype(np.int64) for axis in (points.x, points.y)]
        key = cells[0] * (2 * int(np.abs(cells[1]).max()) + 3) + cells[1]
        order = np.argsort(key, kind="stable")
        return np.split(places[order], 1 + np.flatnonzero(np.diff(key[order])))

    def _evaluate(self, x: Floats, y: Floats, arcs: Ints, gradient: bool) -> Sample:
        """Return the sample at points near the curve, without relief."""
        bone = self.skeleton
        found = bone.project(x, y, arcs, gradient=gradient)
        rows = np.arange(len(x))
        nearest = found.distance.argmin(axis=1)
        d = found.distance[rows, nearest]
        z_arc, z_rate = bone.heights(found.along, arcs)
        z, z_slope = self._continued(found, z_arc, z_rate, bone.lifts[0])
        place, place_slope = self._place(found, arcs)
        side, side_slope = self._side(found, d, nearest)
        c, c_rate, c_place, c_side = self._section(d, place, side)
        radius, radius_rate = self._between(self.radii, place)
        core, core_rate = self._between(self.cores, place)
        wide = radius - core
        t = np.maximum(d - core, 0.0) / wide
        weight = fall_off(self.fall_off, t)
        there = t < 1
        height = np.where(there, z + c, 0.0)
        if found.distance_gradient is None or z_slope is None or place_slope is None or side_slope is None:
            return Sample(height, weight)
        d_slope = found.distance_gradient[:, rows, nearest]
        height_slope = np.where(there, z_slope + c_rate * d_slope + c_place * place_slope + c_side * side_slope, 0.0)
        t_slope = (d_slope - core_rate * place_slope - t * (radius_rate - core_rate) * place_slope) / wide
        weight_slope = np.where(t > 0, derivative(self.fall_off, t) * t_slope, 0.0)
        return Sample(height, weight, height_slope, weight_slope)

    def _continued(self, found: Found, value: Floats, rate: Floats, lift: float) -> tuple[Floats, Floats | None]:
        """Return a field of the skeleton at points and its gradient: the mean of the least and the greatest."""
        rows = np.arange(len(value))
        reached = found.distance < 2 * self.skeleton.radius
        raised = lift * found.distance
        low = np.where(reached, value + raised, inf).argmin(axis=1)
        high = np.where(reached, value - raised, -inf).argmax(axis=1)
        mean = 0.5 * ((value + raised)[rows, low] + (value - raised)[rows, high])
        if found.distance_gradient is None or found.along_gradient is None:
            return mean, None
        slope = np.zeros((2, len(value)))
        for arc, sign in ((low, lift), (high, -lift)):
            slope += 0.5 * (rate[rows, arc] * found.along_gradient[:, rows, arc])
            slope += 0.5 * sign * found.distance_gradient[:, rows, arc]
        return mean, slope

    def _place(self, found: Found, arcs: Ints) -> tuple[Floats, Floats | None]:
        last = len(self.sections) - 1
        if last == 0:
            none = np.zeros(len(found.distance))
            return none, None if found.along_gradient is None else np.zeros((2, len(none)))
        rate = np.broadcast_to(self.skeleton.place_slopes[arcs], found.along.shape)
        value = self.skeleton.place[arcs].mean(axis=1) + rate * found.along
        place, slope = self._continued(found, value, rate, self.skeleton.lifts[1])
        within = (place > 0) & (place < last)
        return np.clip(place, 0.0, last), None if slope is None else np.where(within, slope, 0.0)

    def _side(self, found: Found, d: Floats, nearest: Ints) -> tuple[Floats, Floats | None]:
        """Return which side of the curve points are on, -1 to 1."""
        gradient = found.distance_gradient
        if self._symmetric:
            return np.zeros(len(d)), None if gradient is None else np.zeros((2, len(d)))
        rows = np.arange(len(d))
        window = np.maximum(WINDOW * d, 1e-300)
        fade = np.clip(1 - (found.distance - d[:, None]) / window[:, None], 0.0, 1.0)
        parts, slopes = [], []
        for sign in (1.0, -1.0):
            counted = fade * np.maximum(sign * found.side, 0.0)
            best = counted.argmax(axis=1)
            parts.append(counted[rows, best])
            if gradient is None or found.side_gradient is None:
                continue
            f, s = fade[rows, best], sign * found.side[rows, best]
            own, least = gradient[:, rows, best], gradient[:, rows, nearest]
            fading = (f < 1) & (f > 0)
            ratio = found.distance[rows, best] / np.maximum(d, 1e-300)
            turn = np.where(fading, -(own - ratio * least) / window, 0.0) * s
            turn = turn + f * sign * found.side_gradient[:, rows, best]
            slopes.append(np.where(parts[-1] > 0, turn, 0.0))
        side = 2 * (parts[0] - parts[1])
        if not slopes:
            return np.clip(side, -1.0, 1.0), None
        return np.clip(side, -1.0, 1.0), np.where(np.abs(side) < 1, 2 * (slopes[0] - slopes[1]), 0.0)

    def _section(self, d: Floats, place: Floats, side: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Return c and its derivatives by distance, place and side."""
        value, rate, by_place, by_side = (np.zeros_like(d) for _ in range(4))
        last = len(self.sections) - 1
        below = np.clip(np.floor(place).astype(np.int64), 0, max(last - 1, 0))
        for index in np.unique(below).tolist():
            here = below == index
            for step in range(2 if last else 1):
                where, sign = here, (1.0 if step else -1.0) if last else 0.0
                share = (place[where] - index if step else 1 - (place[where] - index)) if last else 1.0
                item = self.sections[index + step]
                left, left_rate = profile.evaluate(item.left, d[where])
                if self._symmetric:
                    value[where] += share * left
                    rate[where] += share * left_rate
                    by_place[where] += sign * left
                    continue
                right, right_rate = profile.evaluate(item.right, d[where])
                a, b = 0.5 * (1 + side[where]), 0.5 * (1 - side[where])
                value[where] += share * (a * left + b * right)
                rate[where] += share * (a * left_rate + b * right_rate)
                by_place[where] += sign * (a * left + b * right)
                by_side[where] += share * 0.5 * (left - right)
        return value, rate, by_place, by_side

    def _between(self, values: tuple[float, ...], place: Floats) -> tuple[Floats, Floats]:
        """Return numbers of the sections at places, and their rate of change."""
        table = np.array(values)
        if len(table) == 1:
            return np.full(len(place), table[0]), np.zeros(len(place))
        below = np.clip(np.floor(place).astype(np.int64), 0, len(table) - 2)
        rate = table[below + 1] - table[below]
        return table[below] + (place - below) * rate, rate

    # What a box can see.

    def _reaching(self, box: Box) -> Ints:
        """Return the arcs that matter in a box."""
        arcs = self.skeleton.near(box, 2 * self.skeleton.radius)
        if len(arcs) <= 8:
            return arcs
        return self._seen(box, arcs).arcs

    def _seen(self, box: Box, arcs: Ints) -> Seen:
        """Drop the arcs that cannot matter in a box.

        Everything that is compared is Lipschitz, so its value at the middle bounds it: distances with constant 1,
        z_i + L d_i with |grad z_i| + L.  An arc that at its best is worse than another at its worst is dropped.
        """
        bone, radius = self.skeleton, self.skeleton.radius
        x, y = 0.5 * (box.west + box.east), 0.5 * (box.south + box.north)
        half = 0.5 * hypot(box.east - box.west, box.north - box.south)
        found = bone.project(np.array([x]), np.array([y]), arcs, gradient=True)
        d = found.distance[0]
        nearest = float(d.min(initial=inf))
        near, far = max(nearest - half, 0.0), nearest + half
        turned = bone.turned(arcs, x, y, half)
        window = (1 + WINDOW) if not self._symmetric else 1.0
        keep = d - half <= window * far
        sure = d + half < 2 * radius
        height = bone.heights(found.along, arcs)[0][0]
        place = bone.place[arcs].mean(axis=1) + bone.place_slopes[arcs] * found.along[0]
        sets = []
        for value, rate, lift in (
            (height, bone.grades[arcs] * turned, bone.lifts[0]),
            (place, np.abs(bone.place_slopes[arcs]) * turned, bone.lifts[1]),
        ):
            swing = (rate + lift) * half
            up, down = value + lift * d, value - lift * d
            best = (up + swing)[sure].min(initial=inf)
            worst = (down - swing)[sure].max(initial=-inf)
            reached = d - half < 2 * radius
            sets.append((rate, (up - swing <= best) & reached, (down + swing >= worst) & reached))
        (height_slope, up, down), (place_slope, place_up, place_down) = sets
        keep = keep | up | down
        if len(self.sections) > 1:
            keep = keep | place_up | place_down
        return Seen(
            arcs[keep], half, near, far,
            Found(*(None if item is None else item[..., keep] for item in found)),  # type: ignore[arg-type]
            height[keep], height_slope[keep], up[keep], down[keep],
            place[keep], place_slope[keep], place_up[keep], place_down[keep],
        )  # fmt: skip

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        r"""Bound everything in a box.

        |grad f| <= |grad z| + |c'| + |dc/dplace| |grad place| + |dc/dside| |grad side| + |grad relief|.  The module of
        the skeleton bounds the continued fields: |grad z| <= max |grad z_i| + L.  A box that is small beside r is
        bounded by the arcs that can be the best in it: where the same arc is best both ways, or arcs in nearly the
        same direction, L cancels: the second term is L/2 |grad d_i - grad d_k|, and grad d_i turns by at most 1 / d_i
        per metre (by 1 over the distance to its centre inside an arc).  |dc/dside| |grad side| <= `TURN` |c_left -
        c_right| / (2 d), and 0 where a box sees one side only.  Everything else is an exact extreme over the range of
        distances.
        """
        bone, radius = self.skeleton, self.skeleton.radius
        part = box.intersection(self.support)
        if part.empty:
            return ABSENT
        arcs = bone.near(part, 2 * radius)
        if not len(arcs):
            return ABSENT
        half = 0.5 * hypot(part.east - part.west, part.north - part.south)
        last = len(self.sections) - 1
        one_sided = 0
        if half <= 2 * radius and len(arcs) <= 20000:
            seen = self._seen(part, arcs)
            if seen.near >= radius:
                return ABSENT
            near, far = seen.near, seen.far
            low, high = _range(seen.height, seen.height_slope * half, bone.reaches[seen.arcs], seen.up | seen.down)
            slope = self._slope(seen, seen.height_slope, seen.up, seen.down, bone.lifts[0], part)
            first, final, place_slope = 0.0, 0.0, 0.0
            if last:
                first, final = _range(
                    seen.place, seen.place_slope * half, bone.places[seen.arcs], seen.place_up | seen.place_down
                )
                place_slope = self._slope(seen, seen.place_slope, seen.place_up, seen.place_down, bone.lifts[1], part)
            one_sided = self._one_side(seen, part)
        else:
            gap = bone.boxes[arcs]
            dx = np.maximum(np.maximum(gap[:, 0] - part.east, part.west - gap[:, 2]), 0.0)
            dy = np.maximum(np.maximum(gap[:, 1] - part.north, part.south - gap[:, 3]), 0.0)
            near, far = float(np.hypot(dx, dy).min()), inf
            if near >= radius:
                return ABSENT
            low, high = float(bone.reaches[arcs, 0].min()), float(bone.reaches[arcs, 1].max())
            slope = float((bone.grades * bone.anywhere)[arcs].max()) + bone.lifts[0]
            first, final = float(bone.places[arcs, 0].min()), float(bone.places[arcs, 1].max())
            place_slope = float((np.abs(bone.place_slopes) * bone.anywhere)[arcs].max()) + bone.lifts[1]
        stations = range(floor(min(max(first, 0.0), last)), min(floor(min(max(final, 0.0), last)) + 1, last) + 1)
        radii, cores = ([float(values[k]) for k in stations] for values in (self.radii, self.cores))
        widths = [r - c for r, c in zip(radii, cores, strict=True)]
        if near >= max(radii):
            return ABSENT
        far = min(far, max(radii))
        steps = [abs(b - a) for a, b in pairwise(cores)]
        broader = [abs(b - a) for a, b in pairwise(widths)]
        t0 = max(near - max(cores), 0.0) / (max(radii) - max(cores))
        t1 = min(max(far - min(cores), 0.0) / (min(radii) - min(cores)), 1.0)
        if t0 >= 1:
            return ABSENT
        least, most = fall_off(self.fall_off, np.array([t1, t0])).tolist()
        turn = 1 + place_slope * (max(steps, default=0.0) + max(broader, default=0.0))
        weight_slope = steepest_between(self.fall_off, t0, t1) * turn / min(widths)
        c_low, c_high, c_slope = self._section_bounds(stations, near, far, place_slope, one_sided)
        rough_low, rough_high, rough = self.relief.bounds(
            Box(
                part.west - self.origin[0],
                part.south - self.origin[1],
                part.east - self.origin[0],
                part.north - self.origin[1],
            ),
            detail,
        )
        full = slope + c_slope + rough
        ground = full
        terrain = max(cores) + self._terrain * (max(radii) - max(cores))
        if terrain < far:
            ground = 0.0
            if terrain >= near:
                ground = slope + rough + self._section_bounds(stations, near, terrain, place_slope, one_sided)[2]
        return Bounds(
            low + c_low + rough_low, high + c_high + rough_high, least, most, ground, weight_slope, most * full, full
        )

    @cached_property
    def _terrain(self) -> float:
        """The greatest t with g(t) >= T."""
        low, high = 0.0, 1.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if fall_off(self.fall_off, np.array(middle)) >= THRESHOLD else (low, middle)
        return high

    def _section_bounds(
        self, stations: range, near: float, far: float, place_slope: float, one_sided: int
    ) -> tuple[float, float, float]:
        """Return least and greatest c, and the greatest slope that it adds."""
        low, high, slope = inf, -inf, 0.0
        for k in stations:
            item = self.sections[k]
            sides = [item.left] if one_sided > 0 or self._symmetric else [item.right]
            if not one_sided and not self._symmetric:
                sides.append(item.left)
            found = [profile.extremes(pieces, near, far) for pieces in sides]
            low, high = min(low, *(c[0] for c in found)), max(high, *(c[1] for c in found))
            steep = max(c[2] for c in found)
            if len(sides) == 2:
                steep += TURN * profile.steepest_chord(profile.difference(item.left, item.right), near, far) / 2
            slope = max(slope, steep)
        change = 0.0
        for k in stations[:-1] if place_slope else ():
            for a, b in (
                (self.sections[k].left, self.sections[k + 1].left),
                (self.sections[k].right, self.sections[k + 1].right),
            ):
                apart = profile.extremes(profile.difference(a, b), near, far)
                change = max(change, -apart[0], apart[1])
        return low, high, slope + change * place_slope

    def _slope(
        self,
        seen: Seen,
        rates: Floats,
        up: npt.NDArray[np.bool_],
        down: npt.NDArray[np.bool_],
        lift: float,
        box: Box,
    ) -> float:
        """Bound the slope of a continued field in a box."""
        first, second = np.flatnonzero(up), np.flatnonzero(down)
        own = float(rates[up | down].max(initial=0.0))
        if lift == 0 or (len(first) == len(second) == 1 and first[0] == second[0]):
            return own
        if len(first) * len(second) > 2500 or seen.found.distance_gradient is None:
            return own + lift
        x, y = 0.5 * (box.west + box.east), 0.5 * (box.south + box.north)
        mx, my, tx, ty, k, *_ = (item[seen.arcs] for item in self.skeleton.frames)
        u = 1 - k * ((y - my) * tx - (x - mx) * ty) - np.abs(k) * seen.half
        clear = seen.found.distance[0] - seen.half
        with np.errstate(divide="ignore", invalid="ignore"):
            bent = np.where((clear > 0) & (u > 0), np.maximum(1 / clear, np.abs(k) / u), inf)
        gradient = seen.found.distance_gradient[:, 0]
        one, two = gradient[:, first], gradient[:, second]
        apart = np.hypot(one[0][:, None] - two[0], one[1][:, None] - two[1])
        apart = apart + seen.half * (bent[first][:, None] + bent[second])
        apart[first[:, None] == second] = 0.0
        return own + 0.5 * lift * min(float(apart.max()), 2.0)

    def _one_side(self, seen: Seen, box: Box) -> int:
        """Return 1 or -1 where a box lies left or right of all arcs that count for the side, else 0.

        The sine turns by at most 1 / d_i per metre, except at the back of an arc; from 1/2 on it means the side itself.
        """
        if self._symmetric or seen.near <= 0:
            return 0
        x, y = 0.5 * (box.west + box.east), 0.5 * (box.south + box.north)
        d = seen.found.distance[0]
        counts = d - seen.half <= (1 + WINDOW) * seen.far
        mx, my, tx, ty, k, *_ = (item[seen.arcs][counts] for item in self.skeleton.frames)
        u = 1 - k * ((y - my) * tx - (x - mx) * ty) - np.abs(k) * seen.half
        if (u <= 0).any():
            return 0
        side, d = seen.found.side[0][counts], d[counts]
        swing = seen.half / np.maximum(d - seen.half, 1e-300)
        first = d - seen.half <= seen.far
        for sign in (1, -1):
            least = sign * side - swing
            if (least >= 0).all() and (least[first] >= 0.5).all():
                return sign
        return 0

    # On the device.

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Emit the arcs and the sections that matter in the tile, relative to its origin."""
        bone, radius = self.skeleton, self.skeleton.radius
        arcs = bone.near(frame.box, 2 * radius) if self.support.meets(frame.box) else np.zeros(0, np.int64)
        seen = self._seen(frame.box, arcs) if len(arcs) else None
        if seen is None or seen.near >= radius:
            emitter.nothing()
            return
        arcs, last = seen.arcs, len(self.sections) - 1
        first, final = 0, 0
        if last:
            places = _range(
                seen.place, seen.place_slope * seen.half, bone.places[arcs], seen.place_up | seen.place_down
            )
            first, final = (min(max(floor(value), 0), last) for value in places)
            final = min(final + 1, last)
        x, y, tx, ty, k, half, beyond, length, soft, fold = (item[arcs] for item in bone.frames)
        place = bone.place[arcs].mean(axis=1)
        cubic = bone.cubics[arcs].T
        x, y = x - frame.ox, y - frame.oy
        lost = [value - value.astype(np.float32) for value in (x, y)]
        shape = (x, y, tx, ty, k, half, beyond, length, soft, fold)
        table = np.stack([*shape, *cubic, place, bone.place_slopes[arcs], *lost], axis=1)
        floats = [*bone.lifts, 2 * radius, *table.ravel().tolist()]
        chosen = range(first, final + 1)
        left, right = (max(len(getattr(self.sections[j], side)) for j in chosen) for side in ("left", "right"))
        for j in chosen:
            floats += [self.radii[j], self.cores[j], *_padded(self.sections[j].left, left)]
            if not self._symmetric:
                floats += _padded(self.sections[j].right, right)
        ints = [len(arcs), first, len(chosen), left, 0 if self._symmetric else right, CODES[self.fall_off]]
        emitter.add(_CURVE, floats, ints)
        if self.relief.noise is not None:
            emitter.add(_ROUGH, Pending(_rough, self, frame.ox, frame.oy), pushes=0)


def _rough(curves: Sequence[Curve], x: Floats, y: Floats, shared: Shared) -> Parameters:
    east, north = np.array([x, y]) - np.array([item.origin for item in curves]).T
    floats = np.array([[item.relief.amplitude] for item in curves])
    return relief_parameters([item.relief for item in curves], floats, east, north, shared)


def _padded(pieces: Floats, count: int) -> list[float]:
    """Return pieces as numbers, the last one repeated."""
    return [float(value) for index in range(count) for value in pieces[min(index, len(pieces) - 1)]]


def _range(value: Floats, swing: Floats, reaches: Floats, where: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Return the least and greatest value of the arcs that can be the best."""
    low, high = np.maximum(value - swing, reaches[:, 0])[where], np.minimum(value + swing, reaches[:, 1])[where]
    return float(low.min(initial=inf)), float(high.max(initial=-inf))


# The node.

CurvePoints = Annotated[
    tuple[tuple[float, float] | tuple[float, float, float], ...],
    Param("Points [x, y], or [x, y, z] to carry heights.", unit="m", min_length=1),
]
_Along = float | tuple[float, ...]
_KIND = Param("What the points mean: corners, control points of Bezier curves, or points of a smooth spline.")
_SECTIONS = Param("Cross-sections, each a list of [signed distance, height]; left of the curve is positive.")


@node(version=1)
def curve(
    *,
    points: CurvePoints,
    kind: Annotated[CurveKind, _KIND] = "catmull_rom",
    height: Annotated[float, Param("Height at the start, for points without one.", unit="m")] = 0.0,
    slope: Annotated[float, Param("Rise of the curve, m per m along it, for points without height.")] = 0.0,
    sections: Annotated[tuple[tuple[tuple[float, float], ...], ...], _SECTIONS] = (((0.0, 0.0),),),
    positions: Annotated[
        tuple[float, ...], Param("Where the sections are, from 0 at the start to 1; none: evenly spread.")
    ] = (),
    shape: Annotated[Shape, Param("Sections smooth through their points, or straight lines between them.")] = "smooth",
    width: Annotated[_Along, Param("Factor of the distances of the sections; a list is spread along the curve.")] = 1.0,
    radius: Annotated[_Along, Param("Where the weight reaches 0; a list is spread along the curve.", unit="m")] = 100.0,
    core: Annotated[_Along, Param("Up to where the weight is 1; a list is spread along the curve.", unit="m")] = 0.0,
    fall_off: Annotated[FallOff, Param("How the weight falls from 1 at the core to 0 at the radius.")] = "wyvill",
    tolerance: Annotated[float, Param("How far the arcs may be from a smooth curve.", gt=0, unit="m")] = 0.01,
) -> ElevationFunction:
    """Lead cross-sections along a curve.

        f(p) = q_z + c_q(d(p)),   alpha(p) = g((|d(p)| - core) / (radius - core))

    d is the signed distance to the curve (positive to its left), q the nearest point, q_z its height - interpolated
    smoothly and without overshoot between the points - and c_q the cross-section there, a piecewise-quadratic function
    interpolated between the given ones along the arc length.

    Smooth curves are laid as circular arcs that share tangents, within `tolerance`; |d| is the exact distance to them.
    Where branches of the curve meet off the curve (inside bends tighter than the radius, between the legs of a meander)
    q_z and c change over continuously from one to the other, so that f is Lipschitz everywhere; |d| has a crease there,
    which a radius up to that of the tightest bend keeps out of sight.
    A curve that crosses itself at another height climbs between both close to the crossing.  A single point gives a
    round primitive.  Points that repeat the one before are left out.

    Args:
        points: of the curve.  Bezier curves chain: 2 n + 1 points for ``quadratic``, 3 n + 1 for ``cubic``.
        kind: polyline, quadratic, cubic or catmull_rom (centripetal).
        height: of points without z.
        slope: of points without z.
        sections: by rising distance; points on one side only are mirrored; beyond the outermost it goes on level.
        positions: of the sections, rising, as many as sections.
        shape: of the sections.
        width: factors of the sections.
        radius: of the support.
        core: less than the radius.
        fall_off: g: wyvill, cubic, quintic, plateau.
        tolerance: of smooth curves.

    Raises:
        ValueError: points, sections or lengths that make no curve; the sentence says which.

    Source: Génevaux et al. 2015, section 4.1, doi:10.1111/cgf.12530.
    """
    line = line_of(points, kind, tolerance=tolerance, height=height, slope=slope)
    made = stations([profile.section(item, shape) for item in sections], positions, width, radius, core)
    return built(line, made, fall_off=fall_off)


def built(
    line: Line,
    made: Stations,
    place: Floats | None = None,
    *,
    fall_off: FallOff = "wyvill",
    relief: Relief | None = None,
    origin: tuple[float, float] | None = None,
) -> Curve:
    """Return a curve primitive along a line.

    Args:
        line: the curve.
        made: sections, radii and cores.
        place: of the line's nodes among the stations; by default the stations are spread along it.
        fall_off: of the weight.
        relief: roughness.
        origin: of the roughness; by default where the line starts.
    """
    if place is None:
        line, place = spread(line, made)
    radius = max(made.radii)
    bone = skeleton([line.track], [(line.height, line.rise)], [place], radius)
    x, y = line.track.nodes[0].tolist()
    return Curve(bone, made.sections, made.radii, made.cores, fall_off, relief or Relief(), origin or (x, y))
