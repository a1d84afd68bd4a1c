"""Roads: an alignment of straights, clothoids and arcs, a cambered carriageway, and ground cut and filled beside it."""

from __future__ import annotations

from math import pi
from typing import Annotated

import numpy as np

from nodegraph import Param, node
from nodegraph_tree.curve import CurvePoints, built
from nodegraph_tree.falloff import FallOff
from nodegraph_tree.function import ElevationFunction
from nodegraph_tree.geometry import Floats, Ints, Track, distinct, points_of, polyline, through
from nodegraph_tree.layout import Line, carried, heights_under, resampled, stations
from nodegraph_tree.profile import section


@node(version=1)
def road(
    terrain: ElevationFunction | None = None,
    *,
    points: CurvePoints,
    width: Annotated[float, Param("Of the carriageway.", gt=0, unit="m")] = 7.0,
    shoulder: Annotated[float, Param("Of the shoulder on each side.", ge=0, unit="m")] = 1.5,
    camber: Annotated[float, Param("Fall of the carriageway from its middle, m per m.", ge=0, le=0.5)] = 0.025,
    radius: Annotated[float, Param("How far from the axis the ground is cut and filled.", gt=0, unit="m")] = 40.0,
    bend_radius: Annotated[float, Param("Radius of bends, where there is room.", gt=0, unit="m")] = 60.0,
    easing: Annotated[float, Param("Share of the turn of a bend that its clothoids take.", ge=0, le=1)] = 0.6,
    smoothing: Annotated[float, Param("Length over which heights are smoothed.", ge=0, unit="m")] = 150.0,
    height: Annotated[float, Param("Height, without terrain and for points without one.", unit="m")] = 0.0,
    slope: Annotated[float, Param("Rise along the road, without terrain and heights.", ge=-1, le=1)] = 0.0,
    fall_off: Annotated[FallOff, Param("How the weight falls from 1 at the shoulder to 0 at the radius.")] = "cubic",
) -> ElevationFunction:
    """Lead a road through the corners of a polyline.

    *In plan* each corner becomes a clothoid, an arc and a clothoid (curvature rising linearly, constant, falling), in
    the bend radius asked for or the greatest for which tangents fit in half of the legs.  The axis is laid in arcs of
    about 3 degrees, so that curvature rises in small steps.  *In elevation* it follows its points, or the terrain it is
    linked to, or height and slope, smoothed with a raised cosine of the given length; both ends keep their height.

        f(p) = q_z - camber |d|          on the carriageway, twice as steep on the shoulders, level beyond,
        alpha(p) = 1                      up to the edge of the shoulder, then falling to 0 at the radius

    so that replacing a terrain by the road (`tree.replace`) cuts and fills the ground between shoulder and radius.

    Args:
        terrain: what it follows if its points carry no heights.
        points: the corners.
        width: of the carriageway.
        shoulder: added on each side.
        camber: cross fall.
        radius: of the support; more than half the width and the shoulder.
        bend_radius: of arcs.
        easing: 0 for arcs alone, 1 for clothoids alone.
        smoothing: of heights.
        height: at the start.
        slope: of the axis.
        fall_off: of the weight.

    Raises:
        ValueError: points that make no curve, a road wider than the radius, or a road that leaves its terrain.

    Source: Génevaux et al. 2015, section 4.1, doi:10.1111/cgf.12530.
    """
    edge = 0.5 * width + shoulder
    if edge >= radius:
        raise ValueError(f"radius must be more than the road's half width with its shoulder, {edge:g} m")
    nodes, z = points_of(points)
    kept = distinct(nodes)
    track = alignment(nodes[kept], bend_radius, easing)
    if z is not None:
        line = carried(track, track.along[track.marks], z[kept])
    elif terrain is not None:
        where, along = resampled(track, max(radius / 4, float(track.along[-1]) / 20000))
        line = carried(track, along, heights_under(terrain, where, "road"))
    else:
        line = Line(track, height + slope * track.along, np.full(len(track.nodes), slope))
    line = smoothed(line, smoothing)
    fall = [(0.0, 0.0), (0.5 * width, -0.5 * camber * width)]
    if shoulder > 0:
        fall.append((edge, -camber * (0.5 * width + 2 * shoulder)))
    made = stations([section(fall, "straight")], (), 1.0, radius, edge)
    return built(line, made, fall_off=fall_off)


def alignment(nodes: Floats, radius: float, easing: float) -> Track:
    """Return straights, clothoids and arcs through the corners of a polyline, as arcs with common tangents.

    For a turn by D with radius 1 the clothoids turn by a = easing D / 2 each, the arc by the rest.  Its tangent length,
    from corner to the first clothoid, scales with the radius, which is cut where half a leg (the whole of a first or
    last one) is shorter.  Corners that turn back sharper than 178 degrees stay corners of no radius.
    """
    if len(nodes) < 3:
        return polyline(nodes)
    leg = np.diff(nodes, axis=0)
    size = np.hypot(leg[:, 0], leg[:, 1])
    tangent = leg / size[:, None]
    room = 0.5 * size
    room[0], room[-1] = 0.98 * size[0], 0.98 * size[-1]
    if len(size) == 2:
        room = 0.98 * size
    points, headings, marks = [nodes[:1]], [tangent[:1]], [0]
    for corner in range(1, len(nodes) - 1):
        before, after = tangent[corner - 1], tangent[corner]
        turn = float(np.arctan2(before[0] * after[1] - before[1] * after[0], before @ after))
        count = sum(map(len, points))
        if abs(turn) < 1e-6 or abs(turn) > 0.988 * pi:
            points.append(np.stack([nodes[corner], nodes[corner]]) if abs(turn) > 1 else nodes[corner][None])
            headings.append(np.stack([before, after]) if abs(turn) > 1 else before[None])
            marks.append(count)
            continue
        shape, angle, reach = _bend(abs(turn), easing)
        scale = min(radius, float(min(room[corner - 1], room[corner])) / reach)
        side = np.sign(turn)
        across = np.array([-before[1], before[0]]) * side
        start = nodes[corner] - before * (reach * scale)
        points.append(start + scale * (shape[:, :1] * before + shape[:, 1:] * across))
        headings.append(np.cos(angle)[:, None] * before + np.sin(angle)[:, None] * across)
        marks.append(count + len(shape) // 2)
    points.append(nodes[-1:])
    headings.append(tangent[-1:])
    marks.append(sum(map(len, points)) - 1)
    return _through(np.concatenate(points), np.concatenate(headings), np.array(marks, np.int64))


def _bend(turn: float, easing: float) -> tuple[Floats, Floats, float]:
    """Return points (n, 2) and headings of a bend of radius 1 that turns left from the x axis, and its tangent length.

    Headings of a clothoid grow with the square of the length; integrated by Simpson's rule on fine steps.
    """
    ease = 0.5 * easing * turn
    clothoid, arc = 2 * ease, turn - 2 * ease
    total = 2 * clothoid + arc
    count = 2 * max(8, int(np.ceil(turn / 0.12)))
    s = np.linspace(0.0, total, 16 * count + 1)
    rising = np.minimum(s, clothoid) ** 2 / (2 * clothoid) if clothoid > 0 else np.zeros_like(s)
    level = np.clip(s - clothoid, 0.0, arc)
    late = np.clip(s - clothoid - arc, 0.0, clothoid)
    falling = late - late**2 / (2 * clothoid) if clothoid > 0 else np.zeros_like(s)
    heading = rising + level + falling
    step = total / (16 * count)
    values = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    pairs = (values[0:-2:2] + 4 * values[1:-1:2] + values[2::2]) * (step / 3)
    shape = np.concatenate([np.zeros((1, 2)), np.cumsum(pairs, axis=0)])[::8]
    reach = float(shape[-1, 0] - shape[-1, 1] / np.tan(turn))
    return shape, heading[::16], reach


def _through(points: Floats, headings: Floats, marks: Ints) -> Track:
    """Return biarcs through points, but for steps of no length, where a corner stays."""
    track = through(points, headings)
    return Track(track.nodes, track.bend, 2 * marks)


def smoothed(line: Line, length: float) -> Line:
    """Return a line with heights averaged over a raised cosine of a length; both ends stay where they are."""
    along = line.track.along
    total = float(along[-1])
    length = min(length, total)
    if length <= 0 or total <= 0 or float(np.ptp(line.height)) == 0:
        return line
    step = total / max(int(np.ceil(16 * total / length)), 16)
    at = np.linspace(0.0, total, round(total / step) + 1)
    z = np.interp(at, along, line.height)
    half = max(round(0.5 * length / step), 1)
    window = 1 + np.cos(pi * np.arange(-half, half + 1) / (half + 1))
    # Reflected through its ends, so that they do not move.
    ends = np.concatenate([2 * z[0] - z[half:0:-1], z, 2 * z[-1] - z[-2 : -half - 2 : -1]])
    return carried(line.track, at, np.convolve(ends, window / window.sum(), "valid"))
