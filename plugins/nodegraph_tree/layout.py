"""What the nodes of curve primitives share: lines from points, and cross-sections spread along them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import isfinite
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_tree.function import THRESHOLD, ElevationFunction, Points
from nodegraph_tree.geometry import (
    CurveKind,
    Floats,
    Track,
    bezier_spans,
    catmull_rom_spans,
    distinct,
    hermite,
    monotone_slopes,
    part_at,
    points_of,
    polyline,
    trace,
)
from nodegraph_tree.profile import Section, mixed, stretched


class Line(NamedTuple):
    """A curve with heights.

    Attributes:
        track: the curve.
        height: at its nodes, m.
        rise: its slope along the curve there.
    """

    track: Track
    height: Floats
    rise: Floats


class Stations(NamedTuple):
    """Cross-sections along a curve.

    Attributes:
        fractions: where they are, from 0 at the start to 1, rising.
        sections: the cross-sections.
        radii, cores: of the weight, m.
    """

    fractions: tuple[float, ...]
    sections: tuple[Section, ...]
    radii: tuple[float, ...]
    cores: tuple[float, ...]


def line_of(
    points: Sequence[Sequence[float]],
    kind: CurveKind,
    *,
    tolerance: float = 0.01,
    height: float = 0.0,
    slope: float = 0.0,
    what: str = "points",
) -> Line:
    """Return the curve of some points; heights are theirs, or start at `height` and rise by `slope`.

    Raises:
        ValueError: points that are missing, not finite, of two kinds, or no chain of Bezier curves.
    """
    nodes, z = points_of(points, what)
    if kind in ("quadratic", "cubic"):
        spans = bezier_spans(nodes if z is None else np.column_stack([nodes, z]), 2 if kind == "quadratic" else 3)
        track, high, rise = trace(spans, tolerance)
        if high is not None and rise is not None:
            return Line(track, high, rise)
        return _sloping(track, height, slope)
    kept = distinct(nodes)
    nodes = nodes[kept]
    if kind == "polyline" or len(nodes) < 3:
        track = polyline(nodes)
    else:
        track = trace(catmull_rom_spans(nodes), tolerance).track
    if z is None:
        return _sloping(track, height, slope)
    return carried(track, track.along[track.marks], z[kept])


def carried(track: Track, along: Floats, z: Floats) -> Line:
    """Return a track with heights given at rising distances along it, smoothly interpolated without overshoot."""
    value, rise = hermite(along, z, monotone_slopes(along, z), track.along)
    return Line(track, value, rise)


def _sloping(track: Track, height: float, slope: float) -> Line:
    along = track.along
    return Line(track, height + slope * along, np.full(len(along), slope))


def divided(line: Line, at: Floats) -> Line:
    """Return a line with more nodes, at given distances along it."""
    along = line.track.along
    total = float(along[-1])
    at = at[(at > 0) & (at < total)]
    gap = np.abs(along[np.clip(np.searchsorted(along, at), 1, len(along) - 1)] - at)
    gap = np.minimum(gap, np.abs(along[np.clip(np.searchsorted(along, at) - 1, 0, len(along) - 1)] - at))
    at = np.unique(at[gap > 1e-9 * total])
    if not len(at):
        return line
    lengths = np.diff(along)
    arc = np.clip(np.searchsorted(along, at, side="right") - 1, 0, len(lengths) - 1)
    share = (at - along[arc]) / lengths[arc]
    nodes, bend = line.track.nodes, line.track.bend
    new, _ = part_at(nodes[arc], nodes[arc + 1], bend[arc], share)
    value, rise = hermite_of(line, arc, share)
    order = np.argsort(np.concatenate([np.arange(len(nodes)), arc + 1 - 0.5 + 0.4 * share]), kind="stable")
    everything = np.concatenate([nodes, new])[order]
    where = np.concatenate([along, at])[order]
    parent = np.concatenate([np.arange(len(nodes)), arc])[order][:-1]
    part = np.divide(np.diff(where), lengths[parent], out=np.ones(len(parent)), where=lengths[parent] > 0)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    track = Track(everything, bend[parent] * part, place[line.track.marks])
    return Line(track, np.concatenate([line.height, value])[order], np.concatenate([line.rise, rise])[order])


def hermite_of(line: Line, arc: npt.NDArray[np.int64], share: Floats) -> tuple[Floats, Floats]:
    """Return heights and slopes inside arcs of a line."""
    length = line.track.lengths[arc]
    a, b = line.height[arc], line.height[arc + 1]
    first, last = line.rise[arc] * length, line.rise[arc + 1] * length
    second, third = 3 * (b - a) - 2 * first - last, first + last - 2 * (b - a)
    value = a + share * (first + share * (second + share * third))
    return value, (first + share * (2 * second + 3 * share * third)) / np.maximum(length, 1e-300)


def stations(
    sections: Sequence[Section],
    positions: Sequence[float],
    width: float | Sequence[float],
    radius: float | Sequence[float],
    core: float | Sequence[float],
) -> Stations:
    """Return cross-sections wherever a section, width, radius or core is given, each interpolated between its own.

    Raises:
        ValueError: numbers that are not finite or positive, positions that do not rise or fit, a core beyond a radius.
    """
    if not sections:
        raise ValueError("sections are empty; give one at least")
    if positions and len(positions) != len(sections):
        raise ValueError(f"positions must be as many as sections: {len(positions)} for {len(sections)}")
    if positions and (not all(0 <= item <= 1 for item in positions) or any(b <= a for a, b in pairwise(positions))):
        raise ValueError("positions must rise within 0 to 1")
    own = np.array(positions) if positions else _even(len(sections))
    wide, far, near = (_listed(item, name) for item, name in ((width, "width"), (radius, "radius"), (core, "core")))
    if (wide <= 0).any() or (far <= 0).any():
        raise ValueError("width and radius must be greater than 0")
    if (near < 0).any():
        raise ValueError("core must not be negative")
    places = [np.array([0.0]) if len(item) == 1 else _even(len(item)) for item in (wide, far, near)]
    fractions = np.unique(np.concatenate([own if len(sections) > 1 else own[:0], *places]))
    if len(fractions) == 2 and fractions[0] == 0 and len(sections) == len(wide) == len(far) == len(near) == 1:
        fractions = fractions[:1]
    w, r, c = (np.interp(fractions, place, item) for place, item in zip(places, (wide, far, near), strict=True))
    if (c >= r).any():
        raise ValueError("core must be less than radius everywhere along the curve")
    found = []
    for fraction, factor in zip(fractions.tolist(), w.tolist(), strict=True):
        after = int(np.searchsorted(own, fraction))
        if after == 0 or after == len(own):
            item = sections[min(after, len(own) - 1)]
        else:
            share = (fraction - own[after - 1]) / (own[after] - own[after - 1])
            item = mixed(sections[after - 1], sections[after], float(share))
        found.append(item if factor == 1 else stretched(item, factor))
    return Stations(tuple(fractions.tolist()), tuple(found), tuple(r.tolist()), tuple(c.tolist()))


def spread(line: Line, made: Stations) -> tuple[Line, Floats]:
    """Return a line with nodes at the stations along it, and the place of each node among them."""
    if len(made.sections) == 1:
        return line, np.zeros(len(line.track.nodes))
    total = float(line.track.along[-1])
    fractions = np.array(made.fractions)
    line = divided(line, fractions * total)
    return line, np.interp(line.track.along / max(total, 1e-300), fractions, np.arange(len(fractions)))


def _even(count: int) -> Floats:
    return np.linspace(0, 1, count) if count > 1 else np.array([0.0])


def _listed(value: float | Sequence[float], name: str) -> Floats:
    listed = [value] if isinstance(value, (int, float)) else list(value)
    if not listed or not all(map(isfinite, listed)):
        raise ValueError(f"{name} must be a finite number or a list of them")
    return np.array(listed, np.float64)


class Foot(NamedTuple):
    """The point of some lines that is nearest to a given one: how far it is, where, and how high."""

    distance: float
    x: float
    y: float
    height: float


def foot(lines: Sequence[Line], x: float, y: float) -> Foot:
    """Return the nearest point of lines.  O(arcs)."""
    from nodegraph_tree.skeleton import skeleton

    places = [np.zeros(len(line.track.nodes)) for line in lines]
    bone = skeleton([line.track for line in lines], [(line.height, line.rise) for line in lines], places, 1e30)
    found = bone.project(np.array([x]), np.array([y]), np.arange(len(bone)))
    arc = int(found.distance[0].argmin())
    length = float(bone.frames.length[arc])
    s = float(np.clip(found.along[0, arc], -length, length))
    share = np.array([0.5 + 0.5 * s / length if length > 0 else 0.5])
    one = np.array([arc])
    where, _ = part_at(bone.start[one], bone.end[one], bone.bend[one], share)
    height = bone.heights(np.array([[s]]), one)[0]
    return Foot(float(found.distance[0, arc]), float(where[0, 0]), float(where[0, 1]), float(height[0, 0]))


def heights_under(terrain: ElevationFunction, nodes: Floats, what: str) -> Floats:
    """Return the heights of a tree at points.

    Raises:
        ValueError: a point lies outside the terrain.
    """
    sample = terrain.query(Points(nodes[:, 0].copy(), nodes[:, 1].copy()))
    bare = np.flatnonzero(sample.weight < THRESHOLD)
    if len(bare):
        x, y = nodes[bare[0]].tolist()
        raise ValueError(f"the {what} leaves its terrain at ({x:.0f}, {y:.0f}); give its points heights")
    return sample.height


def resampled(track: Track, spacing: float) -> tuple[Floats, Floats]:
    """Return points about `spacing` apart on a track, (n, 2), and their distances along it; with both ends."""
    along = track.along
    count = max(int(np.ceil(along[-1] / spacing)), 1) + 1
    if along[-1] == 0:
        return track.nodes[:1], np.zeros(1)
    at = np.linspace(0.0, float(along[-1]), count)
    arc = np.clip(np.searchsorted(along, at, side="right") - 1, 0, len(track.bend) - 1)
    length = along[arc + 1] - along[arc]
    share = np.clip(np.divide(at - along[arc], length, out=np.zeros_like(at), where=length > 0), 0.0, 1.0)
    where, _ = part_at(track.nodes[arc], track.nodes[arc + 1], track.bend[arc], share)
    return where, at


def joined(
    points: Sequence[Sequence[float]],
    line: Line,
    others: Sequence[Line],
    kind: CurveKind,
    reach: float,
    *,
    descend: bool = False,
    what: str = "points",
) -> Line:
    """Return a line whose last point is led to the nearest of other lines, if that is within `reach`, at its height.

    Args:
        points: of the line, as given.
        line: the line as it is.
        others: what it may join.
        kind: of the curve.
        reach: how far the end may be moved, m.
        descend: keep all its heights above the junction.
        what: the name of the points.
    """
    end = line.track.nodes[-1]
    met = foot(others, float(end[0]), float(end[1]))
    if met.distance > reach:
        return line
    moved = [list(point[:2]) for point in points]
    moved[-1] = [met.x, met.y]
    track = line_of(moved, kind, what=what).track
    share = line.track.along / max(float(line.track.along[-1]), 1e-300)
    marks = np.unique(np.concatenate([[0.0], share[line.track.marks], [1.0]]))
    z = np.interp(marks, share, line.height)
    if descend and z[-1] < met.height:
        z = np.maximum(z, met.height)
    else:
        # The difference at the junction is spread along the line.
        z += marks * (met.height - z[-1])
    z[-1] = met.height
    if len(track.nodes) < 2 or track.along[-1] == 0:
        return line
    return carried(track, marks * track.along[-1], z)
