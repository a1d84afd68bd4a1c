"""Smooth curves of circular arcs, and the coordinates (s, d) along and across them.

A polyline becomes a G1 curve through all its points: at each inner point the tangent is that of the circle through it
and its neighbours (at the ends that of an arc to the next), and two arcs join each pair (a biarc with equal tangent
lengths; Bolton 1975).  Points on a circle give the circle.

On an arc of curvature k (1/m, positive to the left), in the frame of one of its points - q along the tangent, n to the
left - with D = (1 - k n)^2 + (k q)^2,

    d = (2 n - k (q^2 + n^2)) / (1 + sqrt(D)),    s = atan(k q / (1 - k n)) / k,

which have no difference of like numbers and become n and q where k = 0.  Their gradients are of length 1 and 1 / (1 - k
d), and at right angles.  d is C1 from one arc to the next, s continuous; both are unambiguous within the least radius.
"""

from __future__ import annotations

from math import cos, hypot, sin
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_tree.function import Box

Floats = npt.NDArray[np.float64]

WIDEST = 1.3
"""Greatest turn of one arc, radians: longer ones are divided."""

MOST = 20_000
"""Most points of a line."""


class Along(NamedTuple):
    """(s, d) of points in an arc's frame and their derivatives along q and n."""

    s: Floats
    d: Floats
    s_q: Floats
    s_n: Floats
    d_q: Floats
    d_n: Floats


def along(q: Floats, n: Floats, k: float) -> Along:
    """Return s and d of points (q, n) in the frame of a point of an arc of curvature k; 1 - k n is held above 0."""
    g, z = np.maximum(1 - k * n, 1e-9), k * q
    squared = g * g + z * z
    root = np.sqrt(squared)
    ratio = z / g
    small = np.abs(ratio) < 1e-4
    safe = np.where(small, 1.0, ratio)
    bent = np.where(small, 1 - ratio * ratio / 3, np.arctan(safe) / safe)
    return Along(
        q / g * bent, (2 * n - k * (q * q + n * n)) / (1 + root), g / squared, z / squared, -z / root, g / root
    )


class Arc(NamedTuple):
    """One arc: where it starts, which way, its curvature (1/m) and length (m), and s at its start."""

    x: float
    y: float
    east: float
    north: float
    curvature: float
    length: float
    start: float

    def at(self, s: float, d: float = 0.0) -> tuple[float, float, float, float]:
        """Return the place (x, y) at a distance s along the whole curve and d to its left, and the direction there."""
        turn = self.curvature * (s - self.start)
        # The chord of the part up to s: sin(h) / h of half the turn, turned by half of it.
        half = 0.5 * turn
        chord = (s - self.start) * (sin(half) / half if abs(half) > 1e-8 else 1 - half * half / 6)
        x = self.x + chord * (self.east * cos(half) - self.north * sin(half))
        y = self.y + chord * (self.east * sin(half) + self.north * cos(half))
        east, north = (
            self.east * cos(turn) - self.north * sin(turn),
            self.east * sin(turn) + self.north * cos(turn),
        )
        return x - d * north, y + d * east, east, north

    @property
    def end(self) -> float:
        """Where it ends, as s."""
        return self.start + self.length

    def hull(self, width: float) -> Floats:
        """Return a convex polygon around the strip of half that width, (n, 2)."""
        middle = 0.5 * (self.start + self.end)
        x, y, east, north = self.at(middle)
        corners = [self.at(s, d)[:2] for s, d in ((self.start, width), (self.start, -width))]
        corners += [self.at(s, d)[:2] for s, d in ((self.end, -width), (self.end, width))]
        # The outer rim bulges: add where its tangents at both ends meet, on the normal through the middle.
        out = -width if self.curvature > 0 else width
        reach = (1 - self.curvature * out) / max(cos(0.5 * abs(self.curvature) * self.length), 1e-3)
        bulge = out if self.curvature == 0 else (1 - reach) / self.curvature
        corners.append((x - bulge * north, y + bulge * east))
        return _convex(np.array(corners))

    def reach(self, box: Box, width: float, slack: float) -> tuple[float, float, float, float] | None:
        """Return the ranges (s0, s1, d0, d1) that hold (s, d) of all points of the strip in a box; None without any.

        The strip counts as longer by `slack` at both ends.

        On the side of the centre where the arc is, lines of constant s are straight, so that s is extreme at corners of
        the box; where a corner lies beyond, the whole arc counts.  1 - k d is the distance to the centre over the
        radius.
        """
        k = self.curvature
        x, y, east, north = self.at(0.5 * (self.start + self.end))
        corners = np.array([(cx, cy) for cx in (box.west, box.east) for cy in (box.south, box.north)])
        q = (corners[:, 0] - x) * east + (corners[:, 1] - y) * north
        n = (corners[:, 1] - y) * east - (corners[:, 0] - x) * north
        s0, s1 = self.start - slack, self.end + slack
        if (1 - k * n).min() > 1e-3:
            found = along(q, n, k)
            middle = 0.5 * (self.start + self.end)
            s0, s1 = max(s0, middle + float(found.s.min())), min(s1, middle + float(found.s.max()))
        if k == 0:
            d0, d1 = float(n.min()), float(n.max())
        else:
            # The corners hold the farthest point from the centre; the nearest may lie between them.
            radius = 1 / abs(k)
            cx, cy = x - north / k, y + east / k
            near, _ = box.distance(cx, cy)
            values = along(q, n, k).d if (1 - k * n).min() > 1e-3 else None
            if values is None:
                _, far = box.distance(cx, cy)
                ends = sorted(((radius - near) * (1 if k > 0 else -1), (radius - far) * (1 if k > 0 else -1)))
            else:
                nearest = np.array([[min(max(cx, box.west), box.east), min(max(cy, box.south), box.north)]])
                qn = (nearest[:, 0] - x) * east + (nearest[:, 1] - y) * north
                nn = (nearest[:, 1] - y) * east - (nearest[:, 0] - x) * north
                extra = along(qn, nn, k).d
                ends = [float(min(values.min(), extra.min())), float(max(values.max(), extra.max()))]
            rounding = 1e-9 * (width + 1) + 4e-16 * radius
            d0, d1 = ends[0] - rounding, ends[1] + rounding
        d0, d1 = max(d0, -width), min(d1, width)
        return (s0, s1, d0, d1) if s0 <= s1 and d0 <= d1 else None


def _convex(points: Floats) -> Floats:
    """Return the convex hull of a few points, counter-clockwise (Andrew 1979)."""
    ordered = sorted(map(tuple, points.tolist()))
    sides = []
    for run in (ordered, ordered[::-1]):
        side: list[tuple[float, ...]] = []
        for p in run:
            while len(side) > 1 and (side[-1][0] - side[-2][0]) * (p[1] - side[-2][1]) <= (
                side[-1][1] - side[-2][1]
            ) * (p[0] - side[-2][0]):
                side.pop()
            side.append(p)
        sides += side[:-1]
    return np.array(sides)


def apart(a: Floats, b: Floats, slack: float) -> bool:
    """Say whether an edge of one of two convex polygons separates them, up to an overlap of `slack` metres."""
    for first, second in ((a, b), (b, a)):
        edges = np.roll(first, -1, axis=0) - first
        normals = np.column_stack([edges[:, 1], -edges[:, 0]]) / np.maximum(np.hypot(*edges.T), 1e-300)[:, None]
        level = np.sum(normals * first, axis=1)
        if ((normals @ second.T).min(axis=1) >= level - slack).any():
            return True
    return False


def smooth_curve(points: npt.NDArray[np.float64]) -> list[Arc]:
    """Return the arcs of a G1 curve through points, (n, 2) m; points that repeat count once.

    Raises:
        ValueError: fewer than two distinct points, too many, NaN, or a line that doubles back on itself.
    """
    if points.ndim != 2 or points.shape[1:] != (2,) or not np.isfinite(points).all():
        raise ValueError("the points of a curve must be finite pairs [x, y] in metres")
    if len(points) > MOST:
        raise ValueError(f"a curve of {len(points):,} points is longer than {MOST:,}; simplify the line")
    size = max(float(np.ptp(points, axis=0).max()), 1e-300) if len(points) else 0.0
    far = np.hypot(*np.diff(points, axis=0).T) > 1e-9 * size
    points = points[np.concatenate([[True], far])] if len(points) else points
    if len(points) < 2:
        raise ValueError("a curve needs at least two distinct points")
    chords = np.diff(points, axis=0)
    pulls = chords / np.sum(chords**2, axis=1)[:, None]
    tangents = np.empty_like(points)
    tangents[1:-1] = pulls[:-1] + pulls[1:]
    if len(points) == 2:
        tangents[:] = chords[0]
    else:
        lengths = np.hypot(*tangents[1:-1].T)
        if (lengths <= 1e-3 * np.hypot(*pulls[:-1].T)).any():
            at = points[1 + int(np.argmin(lengths))]
            raise ValueError(f"the curve doubles back on itself at ({at[0]:g}, {at[1]:g}); remove the point or part it")
        tangents[1:-1] /= lengths[:, None]
        for end, inner, chord in ((0, 1, chords[0]), (-1, -2, chords[-1])):
            unit = chord / hypot(*chord)
            tangents[end] = 2 * np.dot(tangents[inner], unit) * unit - tangents[inner]
    tangents /= np.hypot(*tangents.T)[:, None]
    arcs: list[Arc] = []
    for index in range(len(points) - 1):
        _biarc(arcs, points[index], tangents[index], points[index + 1], tangents[index + 1])
    return arcs


def _biarc(arcs: list[Arc], p0: Floats, t0: Floats, p1: Floats, t1: Floats) -> None:
    chord, both = p1 - p0, t0 + t1
    square, bend = float(chord @ chord), 2 * (1 - float(t0 @ t1))
    mean = float(chord @ both)
    if mean <= 1e-6 * square**0.5:
        raise ValueError(f"the curve bends too sharply near ({p0[0]:g}, {p0[1]:g}); add points to its bends")
    # The tangent length d of both arcs: bend d^2 + 2 mean d = square, in the form without cancellation.
    reach = square / (mean + (mean * mean + bend * square) ** 0.5)
    joint = 0.5 * (p0 + p1 + reach * (t0 - t1))
    _arc(arcs, p0, t0, joint)
    # The second arc backwards from its end has the same tangent at the joint.
    _arc(arcs, joint, _mirrored(t1, p1 - joint), p1)


def _mirrored(tangent: Floats, chord: Floats) -> Floats:
    """Return the tangent at the other end of an arc."""
    unit = chord / max(hypot(*chord), 1e-300)
    return np.asarray(2 * float(tangent @ unit) * unit - tangent)


def _arc(arcs: list[Arc], start: Floats, tangent: Floats, end: Floats) -> None:
    chord = end - start
    length = hypot(*chord)
    if length < 1e-9:
        return
    turn = 2 * float(np.arctan2(tangent[0] * chord[1] - tangent[1] * chord[0], tangent @ chord))
    if abs(turn) < 1e-9:
        turn = 0.0
    half = 0.5 * turn
    total = length * (half / sin(half) if half else 1.0)
    first = arcs[-1].end if arcs else 0.0
    parts = max(1, int(np.ceil(abs(turn) / WIDEST)))
    whole = Arc(float(start[0]), float(start[1]), float(tangent[0]), float(tangent[1]), turn / total, total, first)
    for part in range(parts):
        x, y, east, north = whole.at(first + total * part / parts)
        arcs.append(Arc(x, y, east, north, turn / total, total / parts, first + total * part / parts))
