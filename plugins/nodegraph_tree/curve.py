"""Curve primitives: a cross-section led along a curve (section 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import floor, inf
from typing import TYPE_CHECKING, Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Param, node, port_type
from nodegraph_tree import profile
from nodegraph_tree.curve_bounds import bounds, reached, reaching, see
from nodegraph_tree.device import FOLDER, Kernel, Parameters, Pending
from nodegraph_tree.disc import Relief, relief_parameters
from nodegraph_tree.falloff import CODES, FallOff, derivative, fall_off
from nodegraph_tree.function import (
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
from nodegraph_tree.skeleton import WINDOW, Found, Skeleton, skeleton

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame, Shared

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_CURVE = Kernel("tree_curve", FOLDER / "curve.cl")
_ROUGH = Kernel("tree_curve_rough", FOLDER / "curve.cl")

_DENSE = 1 << 20
"""Pairs of a point and an arc that are evaluated at a time."""


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
    def symmetric(self) -> bool:
        """True where no cross-section differs from left to right."""
        return all(item.symmetric for item in self.sections)

    @cached_property
    def brim(self) -> float:
        """The greatest t with g(t) >= T: up to there is ground."""
        low, high = 0.0, 1.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if fall_off(self.fall_off, np.array(middle)) >= THRESHOLD else (low, middle)
        return high

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
            arcs = reaching(self, Box(float(x.min()), float(y.min()), float(x.max()), float(y.max())))
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
        if self.symmetric:
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
                if self.symmetric:
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

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound everything in a box; `nodegraph_tree.curve_bounds` says how."""
        return bounds(self, box, detail)

    # On the device.

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Emit the arcs and the sections that matter in the tile, relative to its origin."""
        bone, radius = self.skeleton, self.skeleton.radius
        arcs = bone.near(frame.box, 2 * radius) if self.support.meets(frame.box) else np.zeros(0, np.int64)
        seen = see(self, frame.box, arcs) if len(arcs) else None
        if seen is None or seen.near >= radius:
            emitter.nothing()
            return
        arcs, last = seen.arcs, len(self.sections) - 1
        first, final = 0, 0
        if last:
            places = reached(
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
            if not self.symmetric:
                floats += _padded(self.sections[j].right, right)
        ints = [len(arcs), first, len(chosen), left, 0 if self.symmetric else right, CODES[self.fall_off]]
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
