"""Rivers: beds of several kinds along curves, with tributaries that join without a step (section 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import Annotated, Literal

import numpy as np

from nodegraph import Param, node
from nodegraph_tree.curve import Curve, CurvePoints, built
from nodegraph_tree.falloff import FallOff
from nodegraph_tree.function import ElevationFunction
from nodegraph_tree.geometry import CurveKind, Floats, catmull_rom_spans, distinct, trace
from nodegraph_tree.layout import Line, Stations, carried, divided, foot, heights_under, joined, line_of, resampled
from nodegraph_tree.profile import Section, section
from nodegraph_tree.replace import replace
from nodegraph_tree.union import union

RiverKind = Literal["stream", "river", "meander", "main_stem", "braided"]

FLOORS: dict[RiverKind, float] = {"stream": 1.0, "river": 3.0, "meander": 8.0, "main_stem": 5.0, "braided": 1.6}
"""Width of the level ground at the river, in widths of the river."""

DEPTHS: dict[RiverKind, float] = {"stream": 0.25, "river": 0.12, "meander": 0.12, "main_stem": 0.06, "braided": 0.02}
"""Depth of the bed below its banks, in widths of the river."""


@node(version=1)
def river(
    terrain: ElevationFunction | None = None,
    *,
    points: CurvePoints,
    tributaries: Annotated[tuple[CurvePoints, ...], Param("Side rivers, each a list of points from its source.")] = (),
    kind: Annotated[RiverKind, Param("Shape of bed and banks.")] = "river",
    curve: Annotated[
        CurveKind, Param("What the points mean: corners, Bezier control points, or a spline.")
    ] = "catmull_rom",
    width: Annotated[
        float | tuple[float, ...], Param("From bank to bank; a list is spread from source to mouth.", unit="m")
    ] = 20.0,
    tributary_width: Annotated[float, Param("Width of tributaries, times that of the source.", gt=0, le=1)] = 0.6,
    depth: Annotated[
        float | None, Param("Of the bed below the banks; none: by kind and width.", ge=0, unit="m")
    ] = None,
    floor: Annotated[
        float | None, Param("Width of the valley's floor; none: by kind and width.", ge=0, unit="m")
    ] = None,
    radius: Annotated[float, Param("Half width of the valley: where the weight reaches 0.", gt=0, unit="m")] = 250.0,
    valley_slope: Annotated[float, Param("How steeply the valley rises from its floor, m per m.", ge=0, le=10)] = 0.15,
    height: Annotated[float, Param("Of the banks at the source, without terrain or heights.", unit="m")] = 0.0,
    slope: Annotated[float, Param("Fall along the river, without terrain or heights, m per m.", ge=0, le=10)] = 0.005,
    descend: Annotated[bool, Param("Never let the river rise downstream.")] = True,
    seed: Annotated[int, Param("Another number gives other meanders and braids.", ge=0, le=0xFFFFFFFF)] = 0,
    fall_off: Annotated[FallOff, Param("How the weight falls from 1 at the banks to 0 at the radius.")] = "cubic",
) -> ElevationFunction:
    """Lead a river, with tributaries, from source to mouth.

        f(p) = q_z + c(d(p)),   alpha(p) = 1 to beyond the banks, then g, 0 at the radius

    q_z is the height of the banks at the nearest point of the river: that of the points, or of the terrain it is linked
    to, or height - slope * length; with `descend` never higher than upstream.

    =========  ====================================================================  =======  =============
    kind       cross-section                                                         depth    valley floor
    =========  ====================================================================  =======  =============
    stream     a notch, its sides rising on into the valley's                        width/4  the river
    river      a round bed, low banks                                                0.12     3 widths
    meander    a sine-generated course, deep at the outer bank, a bar at the inner   0.12     8 widths
    main_stem  a wide flat bed between natural levees                                0.06     5 widths
    braided    three to six shallow threads that part and join, in gravel            0.02     1.6 widths
    =========  ====================================================================  =======  =============

    A tributary that ends within the radius of what is there already is led to its nearest point and takes its height.
    Each river is a primitive, and together they are their union (`nodegraph_tree.union`): where two meet, the lower one
    is the ground and the edge is rounded, so that beds cut through banks and valleys run into each other without a step
    or a crease.  Rivers that meander or braid are two such unions: valleys along the points, and in their place
    (`tree.replace`) the beds along their own courses.

    Args:
        terrain: what it follows if its points carry no heights.
        points: of the main river, from source to mouth.
        tributaries: of side rivers, likewise.
        kind: of all of them.
        curve: of all of them.
        width: of the main river; meander and braided take one number.
        tributary_width: of the others; meander and braided keep the width.
        depth: of the widest river; narrower ones are as much shallower.
        floor: level ground, up to 1.6 times the radius.
        radius: of the support; more than the width.
        valley_slope: mean rise from floor to radius.
        height: at the source.
        slope: of the river.
        descend: run downhill.
        seed: of courses.
        fall_off: of the weight.

    Raises:
        ValueError: points that make no curve, widths that are not positive or not less than the radius, a list of
            widths for a kind that takes one, or a river that leaves its terrain.

    Source: Génevaux et al. 2015, section 4.1, doi:10.1111/cgf.12530.  Meanders: Langbein and Leopold 1966, USGS
    Professional Paper 422-H (wavelength 11 widths).
    """
    widths = np.array([width] if isinstance(width, (int, float)) else width, np.float64)
    if not len(widths) or not np.isfinite(widths).all() or (widths <= 0).any():
        raise ValueError("width must be a number greater than 0, or a list of them")
    if widths.max() >= radius:
        raise ValueError(f"radius must be more than the width, {widths.max():g} m")
    wide = float(widths.max())
    if kind in ("meander", "braided") and len(widths) > 1:
        raise ValueError(f"a river of kind '{kind}' has one width")
    deep = DEPTHS[kind] * wide if depth is None else depth
    level = min(FLOORS[kind] * wide if floor is None else floor, 1.6 * radius)
    lines: list[Line] = []
    ratios: list[Floats] = []
    for index, own in enumerate((points, *tributaries)):
        what = f"tributaries[{index - 1}]" if index else "points"
        line = _levelled(own, line_of(own, curve, what=what), terrain, radius, height, slope, what)
        if descend:
            line = descending(line)
        if index:
            line = joined(own, line, lines, curve, radius, descend=descend, what=what)
        line = divided(line, np.linspace(0, 1, 17 if len(widths) > 1 and not index else 2)[1:-1] * line.track.along[-1])
        part = line.track.along / max(float(line.track.along[-1]), 1e-300)
        ratio = np.interp(part, np.linspace(0, 1, len(widths)), widths) if len(widths) > 1 else np.full(len(part), wide)
        lines.append(line)
        ratios.append(ratio if not index else np.full(len(part), widths[0] * tributary_width))
    if kind in ("meander", "braided"):
        valley = _one([_valley(0.1 * deep, level, radius, valley_slope)], radius, min(0.5 * level, 0.8 * radius))
        around = _together([built(line, valley, fall_off=fall_off) for line in lines], deep, valley_slope * radius)
        return replace(around, [_bed(kind, lines, wide, deep, np.random.default_rng(seed))])
    sizes = np.unique(np.concatenate([[item.min(), item.max()] for item in ratios]))
    if len(sizes) > 1:
        sizes = np.geomspace(sizes[0], sizes[-1], max(2, min(8, 2 + round(4 * np.log2(sizes[-1] / sizes[0])))))
    sections = [
        _section(kind, size, deep * size / wide, max(level * size / wide, 1.2 * size), radius, valley_slope)
        for size in sizes.tolist()
    ]
    made = Stations(
        tuple(np.linspace(0, 1, len(sizes)).tolist()),
        tuple(sections),
        (radius,) * len(sizes),
        tuple(np.minimum(0.7 * sizes, 0.9 * radius).tolist()),
    )
    places = [np.interp(item, sizes, np.arange(len(sizes))) for item in ratios]
    beds = [built(line, made, place, fall_off=fall_off) for line, place in zip(lines, places, strict=True)]
    return _together(beds, deep, valley_slope * radius)


def _together(parts: Sequence[Curve], depth: float, rise: float) -> ElevationFunction:
    """Unite rivers of a depth in valleys of a rise: the edges of beds are rounded a little, crests of valleys much."""
    near = max(0.3 * depth, 1e-3)
    return union(parts, near=near, far=max(0.3 * rise, near))


def descending(line: Line) -> Line:
    """Return a line whose heights never rise along it: each is at most the least before."""
    nodes, along = resampled(line.track, max(float(line.track.along[-1]) / 4096, 1e-9))
    at = np.union1d(line.track.along, along) if len(nodes) > 1 else along
    z = np.minimum.accumulate(np.interp(at, line.track.along, line.height))
    low = np.minimum.accumulate(line.height)
    if (line.rise <= 1e-12).all() and np.array_equal(low, line.height):
        return line
    return carried(line.track, at, z)


def _one(sections: Sequence[Section], radius: float, core: float) -> Stations:
    """Return sections that share radius and core."""
    count = len(sections)
    return Stations(tuple(np.linspace(0, 1, count).tolist()), tuple(sections), (radius,) * count, (core,) * count)


def _levelled(
    points: CurvePoints,
    line: Line,
    terrain: ElevationFunction | None,
    radius: float,
    height: float,
    slope: float,
    what: str,
) -> Line:
    """Give a line its heights: its own, those of the terrain, or a slope."""
    if len(points[0]) == 3:
        return line
    if terrain is None:
        along = line.track.along
        return Line(line.track, height - slope * along, np.full(len(along), -slope))
    where, along = resampled(line.track, max(radius / 8, float(line.track.along[-1]) / 20000))
    return carried(line.track, along, heights_under(terrain, where, f"river ({what})"))


def _sides(rise: float, edge: float, radius: float, slope: float) -> list[tuple[float, float]]:
    """Return points of a valley's side: level to `edge`, then ever steeper to the radius."""
    top = slope * (radius - edge)
    return [(edge, rise), (0.5 * (edge + radius), rise + 0.4 * top), (radius, rise + top)]


def _valley(rise: float, floor: float, radius: float, slope: float) -> Section:
    return section([(0.0, rise), *_sides(rise, min(0.5 * floor, 0.8 * radius), radius, slope)])


def _section(kind: RiverKind, width: float, depth: float, floor: float, radius: float, slope: float) -> Section:
    """Return the cross-section of a river with its valley."""
    half = 0.5 * width
    edge = min(max(0.5 * floor, 1.2 * half), half + 0.8 * (radius - half))
    if kind == "stream":
        # Sides rise on from the bank.
        bed = [(0.0, -depth), (0.6 * half, -0.45 * depth), (half, 0.0)]
        top = slope * (radius - half)
        return section([*bed, (0.5 * (half + radius), 0.4 * top), (radius, top)])
    sides = _sides(0.1 * depth, edge, radius, slope)
    if kind == "main_stem":
        bed = [(0.0, -depth), (0.85 * half, -0.95 * depth), (half, 0.0)]
        levee = [(1.15 * half, 0.3 * depth), (0.6 * half + 0.4 * edge, 0.15 * depth)] if edge > 2 * half else []
        return section([*bed, *levee, *sides])
    return section([(0.0, -depth), (0.6 * half, -0.85 * depth), (half, 0.0), *sides])


def _bed(
    kind: RiverKind, axes: Sequence[Line], width: float, depth: float, dice: np.random.Generator
) -> ElevationFunction:
    """Return the bed of a river that winds about its axis: the channel of a meander, or threads."""
    lines: list[Line] = []
    count = int(dice.integers(3, 7)) if kind == "braided" else 1
    for axis in axes:
        before = list(lines)
        for thread in range(count):
            if kind == "meander":
                lines.append(_winding(axis, width, before, dice))
            else:
                lines.append(_thread(axis, width, (thread + 0.5) / count - 0.5, before, dice))
    if kind == "braided":
        half = 0.5 * width / (1.5 * count)
        bed = section([(0.0, -depth), (0.5 * half, -0.8 * depth), (half, 0.0), (1.8 * half, 0.1 * depth)])
        made = _one([bed], 3 * half, 1.1 * half)
        return _together([built(line, made, fall_off="cubic") for line in lines], depth, depth)
    half = 0.5 * width
    beds = []
    for bend in (-1.0, 0.0, 1.0):
        # The deepest line moves to the outer bank, which is steep; the inner one is a sloping bar.
        turn = abs(bend)
        wide = half * (1 + 0.25 * turn)
        points = [
            (-1.3 * half, 0.1 * depth), (-half, 0.0), (-0.75 * half, -(0.9 + 0.3 * turn) * depth),
            (0.0, -(0.95 - 0.25 * turn) * depth), (0.75 * half, -(0.9 - 0.75 * turn) * depth),
            (wide, 0.0), (1.3 * wide, 0.1 * depth),
        ]  # fmt: skip
        beds.append(section(points if bend >= 0 else [(-x, z) for x, z in reversed(points)]))
    made = _one(beds, 3 * half, 1.3 * half)
    return _together([built(line, made, _bends(line, width), fall_off="cubic") for line in lines], depth, depth)


def _across(line: Line, spacing: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Return points along a line, their distances along it, and unit vectors ahead and to the left."""
    where, at = resampled(line.track, spacing)
    ahead = np.gradient(where, at, axis=0)
    ahead /= np.maximum(np.hypot(*ahead.T), 1e-12)[:, None]
    return where, at, ahead, np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)


def _rising(t: Floats) -> Floats:
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


def _winding(line: Line, width: float, others: Sequence[Line], dice: np.random.Generator) -> Line:
    """Return meanders about a line, at its heights; they begin and end on it, or end on another channel."""
    total, wavelength = float(line.track.along[-1]), 11 * width
    if total < wavelength:
        return line
    where, at, ahead, left = _across(line, wavelength / 12)
    waves = max(round(total / wavelength), 1)
    # Phase and size wander, so that no bend is like the next.
    knots = np.linspace(0, total, waves + 1)
    phase = 2 * pi * waves * at / total + np.interp(at, knots, dice.uniform(-0.9, 0.9, waves + 1))
    size = width * np.interp(at, knots, dice.uniform(0.7, 1.25, waves + 1))
    size *= _rising(np.minimum(at, total - at) / wavelength)
    # Loops of a sine-generated curve are broad: a second harmonic along the axis opens them.
    nodes = where + left * (2.6 * size * np.sin(phase))[:, None] - ahead * (0.9 * size * np.sin(2 * phase))[:, None]
    return _laid(line, nodes, at, others, 2 * wavelength)


def _thread(line: Line, width: float, middle: float, others: Sequence[Line], dice: np.random.Generator) -> Line:
    """Return a thread of a braided river, at its heights: three waves across its belt."""
    total = float(line.track.along[-1])
    if total < width:
        return line
    where, at, _, left = _across(line, width / 5)
    off = np.full(len(at), 0.8 * middle)
    for wave, share in ((7.0, 0.55), (3.3, 0.3), (1.7, 0.12)):
        length = wave * width * dice.uniform(0.8, 1.25)
        off += share * np.sin(2 * pi * at / length + dice.uniform(0, 2 * pi))
    off *= 0.5 * width * _rising(np.minimum(at, total - at) / (2 * width))
    return _laid(line, where + left * off[:, None], at, others, 3 * width)


def _laid(line: Line, nodes: Floats, at: Floats, others: Sequence[Line], reach: float) -> Line:
    """Return a spline through points with the heights of a line, led over `reach` to the nearest of other lines."""
    z = np.interp(at, line.track.along, line.height)
    if others:
        met = foot(others, *nodes[-1].tolist())
        led = _rising(1 - (at[-1] - at) / min(reach, float(at[-1])))
        nodes = nodes + led[:, None] * (np.array([met.x, met.y]) - nodes[-1])
        z = z + led * (met.height - z[-1])
    kept = distinct(nodes)
    track = trace(catmull_rom_spans(nodes[kept]), 0.01).track
    return carried(track, track.along[track.marks], z[kept])


def _bends(line: Line, width: float) -> Floats:
    """Return the place of each node between right bend, straight and left bend: from curvature over two widths."""
    heading = np.concatenate([[0.0], np.cumsum(2 * line.track.bend)])
    along, reach = line.track.along, 1.2 * width
    turn: Floats = np.interp(along + reach, along, heading) - np.interp(along - reach, along, heading)
    # A bend of radius 2.5 widths is a full one.
    place: Floats = np.clip(1 + turn / (2 * reach) * 2.5 * width, 0.0, 2.0)
    return place
