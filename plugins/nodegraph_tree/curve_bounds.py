"""What a box can see of a curve primitive, and bounds of the primitive there (section 4.1)."""

from __future__ import annotations

from itertools import pairwise
from math import floor, hypot, inf
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_tree import profile
from nodegraph_tree.falloff import fall_off, steepest_between
from nodegraph_tree.function import ABSENT, Bounds, Box
from nodegraph_tree.skeleton import TURN, WINDOW, Found

if TYPE_CHECKING:
    from nodegraph_tree.curve import Curve

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


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


def reaching(curve: Curve, box: Box) -> Ints:
    """Return the arcs that matter in a box."""
    arcs = curve.skeleton.near(box, 2 * curve.skeleton.radius)
    if len(arcs) <= 8:
        return arcs
    return see(curve, box, arcs).arcs


def see(curve: Curve, box: Box, arcs: Ints) -> Seen:
    """Drop the arcs that cannot matter in a box.

    Everything that is compared is Lipschitz, so its value at the middle bounds it: distances with constant 1,
    z_i + L d_i with |grad z_i| + L.  An arc that at its best is worse than another at its worst is dropped.
    """
    bone, radius = curve.skeleton, curve.skeleton.radius
    x, y = 0.5 * (box.west + box.east), 0.5 * (box.south + box.north)
    half = 0.5 * hypot(box.east - box.west, box.north - box.south)
    found = bone.project(np.array([x]), np.array([y]), arcs, gradient=True)
    d = found.distance[0]
    nearest = float(d.min(initial=inf))
    near, far = max(nearest - half, 0.0), nearest + half
    turned = bone.turned(arcs, x, y, half)
    window = (1 + WINDOW) if not curve.symmetric else 1.0
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
    if len(curve.sections) > 1:
        keep = keep | place_up | place_down
    return Seen(
        arcs[keep], half, near, far,
        Found(*(None if item is None else item[..., keep] for item in found)),  # type: ignore[arg-type]
        height[keep], height_slope[keep], up[keep], down[keep],
        place[keep], place_slope[keep], place_up[keep], place_down[keep],
    )  # fmt: skip


def bounds(curve: Curve, box: Box, detail: float = 1.0) -> Bounds:
    r"""Bound everything in a box.

    |grad f| <= |grad z| + |c'| + |dc/dplace| |grad place| + |dc/dside| |grad side| + |grad relief|.  The module of
    the skeleton bounds the continued fields: |grad z| <= max |grad z_i| + L.  A box that is small beside r is
    bounded by the arcs that can be the best in it: where the same arc is best both ways, or arcs in nearly the
    same direction, L cancels: the second term is L/2 |grad d_i - grad d_k|, and grad d_i turns by at most 1 / d_i
    per metre (by 1 over the distance to its centre inside an arc).  |dc/dside| |grad side| <= `TURN` |c_left -
    c_right| / (2 d), and 0 where a box sees one side only.  Everything else is an exact extreme over the range of
    distances.
    """
    bone, radius = curve.skeleton, curve.skeleton.radius
    part = box.intersection(curve.support)
    if part.empty:
        return ABSENT
    arcs = bone.near(part, 2 * radius)
    if not len(arcs):
        return ABSENT
    half = 0.5 * hypot(part.east - part.west, part.north - part.south)
    last = len(curve.sections) - 1
    one_sided = 0
    if half <= 2 * radius and len(arcs) <= 20000:
        seen = see(curve, part, arcs)
        if seen.near >= radius:
            return ABSENT
        near, far = seen.near, seen.far
        low, high = reached(seen.height, seen.height_slope * half, bone.reaches[seen.arcs], seen.up | seen.down)
        slope = _slope(curve, seen, seen.height_slope, seen.up, seen.down, bone.lifts[0], part)
        first, final, place_slope = 0.0, 0.0, 0.0
        if last:
            first, final = reached(
                seen.place, seen.place_slope * half, bone.places[seen.arcs], seen.place_up | seen.place_down
            )
            place_slope = _slope(curve, seen, seen.place_slope, seen.place_up, seen.place_down, bone.lifts[1], part)
        one_sided = _one_side(curve, seen, part)
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
    radii, cores = ([float(values[k]) for k in stations] for values in (curve.radii, curve.cores))
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
    least, most = fall_off(curve.fall_off, np.array([t1, t0])).tolist()
    turn = 1 + place_slope * (max(steps, default=0.0) + max(broader, default=0.0))
    weight_slope = steepest_between(curve.fall_off, t0, t1) * turn / min(widths)
    c_low, c_high, c_slope = _section_bounds(curve, stations, near, far, place_slope, one_sided)
    rough_low, rough_high, rough = curve.relief.bounds(
        Box(
            part.west - curve.origin[0],
            part.south - curve.origin[1],
            part.east - curve.origin[0],
            part.north - curve.origin[1],
        ),
        detail,
    )
    full = slope + c_slope + rough
    ground = full
    terrain = max(cores) + curve.brim * (max(radii) - max(cores))
    if terrain < far:
        ground = 0.0
        if terrain >= near:
            ground = slope + rough + _section_bounds(curve, stations, near, terrain, place_slope, one_sided)[2]
    return Bounds(
        low + c_low + rough_low, high + c_high + rough_high, least, most, ground, weight_slope, most * full, full
    )


def _section_bounds(
    curve: Curve, stations: range, near: float, far: float, place_slope: float, one_sided: int
) -> tuple[float, float, float]:
    """Return least and greatest c, and the greatest slope that it adds."""
    low, high, slope = inf, -inf, 0.0
    for k in stations:
        item = curve.sections[k]
        sides = [item.left] if one_sided > 0 or curve.symmetric else [item.right]
        if not one_sided and not curve.symmetric:
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
            (curve.sections[k].left, curve.sections[k + 1].left),
            (curve.sections[k].right, curve.sections[k + 1].right),
        ):
            apart = profile.extremes(profile.difference(a, b), near, far)
            change = max(change, -apart[0], apart[1])
    return low, high, slope + change * place_slope


def _slope(
    curve: Curve,
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
    mx, my, tx, ty, k, *_ = (item[seen.arcs] for item in curve.skeleton.frames)
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


def _one_side(curve: Curve, seen: Seen, box: Box) -> int:
    """Return 1 or -1 where a box lies left or right of all arcs that count for the side, else 0.

    The sine turns by at most 1 / d_i per metre, except at the back of an arc; from 1/2 on it means the side itcurve.
    """
    if curve.symmetric or seen.near <= 0:
        return 0
    x, y = 0.5 * (box.west + box.east), 0.5 * (box.south + box.north)
    d = seen.found.distance[0]
    counts = d - seen.half <= (1 + WINDOW) * seen.far
    mx, my, tx, ty, k, *_ = (item[seen.arcs][counts] for item in curve.skeleton.frames)
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


def reached(value: Floats, swing: Floats, reaches: Floats, where: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Return the least and greatest value of the arcs that can be the best."""
    low, high = np.maximum(value - swing, reaches[:, 0])[where], np.minimum(value + swing, reaches[:, 1])[where]
    return float(low.min(initial=inf)), float(high.max(initial=-inf))
