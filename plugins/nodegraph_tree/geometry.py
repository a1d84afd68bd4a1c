"""Curves in the plane as circular arcs: lines, Bezier curves and Catmull-Rom splines within a stated tolerance.

A `Track` is a chain of arcs, each given by its two ends and by `bend`, half the angle through which it turns (0 for a
straight one).  Arcs are what a distance to a curve is cheapest and smoothest with: the nearest point of one takes a
square root and a division, and where two meet with the same tangent the distance has the same gradient on both sides,
so that no facets show.  Smooth curves become *biarcs* (two arcs that share a tangent where they meet) and keep their
tangent from end to end; polylines keep their corners.

References:
    K. M. Bolton (1975): Biarc curves. Computer-Aided Design 7(2). doi:10.1016/0010-4485(75)90086-X.
    C. Yuksel, S. Schaefer, J. Keyser (2011): Parameterization and applications of Catmull-Rom curves. Computer-Aided
    Design 43(7). doi:10.1016/j.cad.2010.08.008.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
CurveKind = Literal["polyline", "quadratic", "cubic", "catmull_rom"]

MOST_BEND = 0.26
"""Greatest half angle of an arc of a smooth curve, rad (30 degrees of turn)."""

_LEVELS = 14
"""How often an interval of a curve is halved at most."""


class Track(NamedTuple):
    """A chain of circular arcs; arc i runs from node i to node i + 1.

    Attributes:
        nodes: (n + 1, 2) m.
        bend: (n,) half the angle each turns through, rad, positive to the left.
        marks: the nodes that the given points became, rising; of a Bezier curve those it passes through.
    """

    nodes: Floats
    bend: Floats
    marks: Ints

    @property
    def lengths(self) -> Floats:
        """Length of each arc, m."""
        chord = np.hypot(*np.diff(self.nodes, axis=0).T)
        found: Floats = chord / np.sinc(self.bend / np.pi)
        return found

    @property
    def along(self) -> Floats:
        """Distance of each node from the start along the curve, m."""
        return np.concatenate([[0.0], np.cumsum(self.lengths)])


def points_of(points: Sequence[Sequence[float]], what: str = "points") -> tuple[Floats, Floats | None]:
    """Return positions (n, 2) and heights (n,), or None without heights, of points [x, y] or [x, y, z].

    Raises:
        ValueError: no point, a number that is not finite, or points of different kinds.
    """
    if len(points) == 0:
        raise ValueError(f"{what} are empty; give at least one [x, y]")
    sizes = {len(point) for point in points}
    if len(sizes) != 1 or not sizes <= {2, 3}:
        raise ValueError(f"{what} must all be [x, y] or all be [x, y, z]")
    found = np.array(points, np.float64)
    if not np.isfinite(found).all():
        raise ValueError(f"{what} hold a number that is not finite")
    return found[:, :2], (found[:, 2] if found.shape[1] == 3 else None)


def distinct(nodes: Floats) -> Ints:
    """Return the indices of the points that differ from the one before them."""
    scale = np.ptp(nodes, axis=0).max() if len(nodes) else 0.0
    step = np.hypot(*np.diff(nodes, axis=0).T)
    return np.concatenate([[0], 1 + np.flatnonzero(step > 1e-12 * scale)]).astype(np.int64)


def polyline(nodes: Floats) -> Track:
    """Return straight pieces between points that differ; a single point gives one arc of no length."""
    if len(nodes) == 1:
        nodes = np.repeat(nodes, 2, axis=0)
        return Track(nodes, np.zeros(1), np.array([0]))
    return Track(nodes, np.zeros(len(nodes) - 1), np.arange(len(nodes)))


def catmull_rom_spans(nodes: Floats, *, closed: bool = False) -> Floats:
    """Return the cubic Bezier spans, (n, 4, k), of the centripetal Catmull-Rom spline through points (., k).

    Centripetal knots (the square root of the distance) never make cusps or loops inside a span.  Before the first and
    after the last point of an open curve the neighbour is mirrored.
    """
    if closed:
        line = np.concatenate([nodes[-1:], nodes, nodes[:2]])
    else:
        line = np.concatenate([2 * nodes[:1] - nodes[1:2], nodes, 2 * nodes[-1:] - nodes[-2:-1]])
    p0, p1, p2, p3 = (line[k : len(line) - 3 + k] for k in range(4))
    a, b, c = (np.hypot(*(q - p)[:, :2].T)[:, None] ** 0.5 for p, q in ((p0, p1), (p1, p2), (p2, p3)))
    first = (a * a * p2 - b * b * p0 + (2 * a * a + 3 * a * b + b * b) * p1) / (3 * a * (a + b))
    second = (c * c * p1 - b * b * p3 + (2 * c * c + 3 * c * b + b * b) * p2) / (3 * c * (c + b))
    return np.stack([p1, first, second, p2], axis=1)


def bezier_spans(nodes: Floats, degree: Literal[2, 3]) -> Floats:
    """Return the spans, (n, 4, k), of a chain of quadratic or cubic Bezier curves; quadratic ones raised to cubic.

    Raises:
        ValueError: the number of points is not 1 + degree times the number of curves.
    """
    count, rest = divmod(len(nodes) - 1, degree)
    if rest or count < 1:
        name = "quadratic" if degree == 2 else "cubic"
        raise ValueError(f"a chain of {name} Bezier curves needs {degree} n + 1 points, not {len(nodes)}")
    if degree == 3:
        return np.stack([nodes[k : len(nodes) - 3 + k : 3] for k in range(4)], axis=1)
    p, q, r = nodes[:-2:2], nodes[1:-1:2], nodes[2::2]
    return np.stack([p, (p + 2 * q) / 3, (r + 2 * q) / 3, r], axis=1)


class Traced(NamedTuple):
    """A smooth curve as arcs, with heights where it has a third coordinate."""

    track: Track
    height: Floats | None
    rise: Floats | None


def trace(spans: Floats, tolerance: float) -> Traced:
    """Return Bezier spans (n, 4, 2 or 3) as biarcs no farther than `tolerance` from the curve.

    Intervals are halved until every biarc turns by no more than 30 degrees and four points of the curve between its
    ends lie within the tolerance.  O(arcs).  With a third coordinate the heights at the nodes and how they change along
    the curve come along.
    """
    span = np.arange(len(spans))
    start, end = np.zeros(len(spans)), np.ones(len(spans))
    done: list[tuple[Ints, Floats, Floats]] = []
    for level in range(_LEVELS + 1):
        p, q = _at(spans, span, start)[:, :2], _at(spans, span, end)[:, :2]
        middle, first, second = _biarc(p, _tangent(spans, span, start), q, _tangent(spans, span, end))
        bad = np.maximum(np.abs(first), np.abs(second)) > MOST_BEND
        for part in (0.2, 0.4, 0.6, 0.8):
            between = _at(spans, span, start + part * (end - start))[:, :2]
            off = np.minimum(_distance(between, p, middle, first), _distance(between, middle, q, second))
            bad |= off > tolerance
        if level == _LEVELS:
            bad[:] = False
        done.append((span[~bad], start[~bad], end[~bad]))
        span, start, end = span[bad], start[bad], end[bad]
        if not len(span):
            break
        half = 0.5 * (start + end)
        span = np.concatenate([span, span])
        start, end = np.concatenate([start, half]), np.concatenate([half, end])
    span, start, end = (np.concatenate(parts) for parts in zip(*done, strict=True))
    order = np.lexsort((start, span))
    span, start, end = span[order], start[order], end[order]
    p, q = _at(spans, span, start), _at(spans, span, end)
    middle, first, second = _biarc(p[:, :2], _tangent(spans, span, start), q[:, :2], _tangent(spans, span, end))
    nodes = np.concatenate([np.stack([p[:, :2], middle], axis=1).reshape(-1, 2), q[-1:, :2]])
    bend = np.stack([first, second], axis=1).ravel()
    marks = np.concatenate([2 * np.flatnonzero(start == 0), [2 * len(span)]])
    track = Track(nodes, bend, marks.astype(np.int64))
    height = rise = None
    if spans.shape[2] == 3:
        # The middle of a biarc is near the curve's own point there: the parameter in proportion to the lengths.
        lengths = track.lengths.reshape(-1, 2)
        share = np.divide(lengths[:, 0], lengths.sum(1), out=np.full(len(lengths), 0.5), where=lengths.sum(1) > 0)
        inner = start + share * (end - start)
        where = np.concatenate([np.stack([start, inner], axis=1).ravel(), [end[-1]]])
        which = np.concatenate([np.repeat(span, 2), span[-1:]])
        height = _at(spans, which, where)[:, 2]
        speed = _velocity(spans, which, where)
        flat = np.hypot(speed[:, 0], speed[:, 1])
        rise = np.divide(speed[:, 2], flat, out=np.zeros_like(flat), where=flat > 1e-9 * max(1.0, float(flat.max())))
        # At cusps it has no bound: no more than what keeps the cubic between the nodes' heights (Fritsch and Carlson).
        length = track.lengths
        secant = 3 * np.abs(np.divide(np.diff(height), length, out=np.zeros_like(length), where=length > 0))
        most = np.minimum(np.append(secant, np.inf), np.append(np.inf, secant))
        rise = np.clip(rise, -most, most)
    return Traced(track, height, rise)


def through(points: Floats, tangents: Floats) -> Track:
    """Return biarcs through points with given unit tangents, (n, 2) each."""
    middle, first, second = _biarc(points[:-1], tangents[:-1], points[1:], tangents[1:])
    nodes = np.concatenate([np.stack([points[:-1], middle], axis=1).reshape(-1, 2), points[-1:]])
    return Track(nodes, np.stack([first, second], axis=1).ravel(), 2 * np.arange(len(points)))


def part_at(start: Floats, end: Floats, bend: Floats, share: Floats) -> tuple[Floats, Floats]:
    """Return points on arcs, (n, 2), and the unit tangents there; `share` of the length from 0 to 1."""
    chord = end - start
    # To a point at angle 2 b t from the start the chord turns by b (t - 1) and is sin(b t) / sin(b) as long.
    turn = bend * (share - 1)
    size = share * np.sinc(bend * share / np.pi) / np.sinc(bend / np.pi)
    moved = _turned(chord, turn) * size[:, None]
    length = np.maximum(np.hypot(chord[:, 0], chord[:, 1]), 1e-300)
    tangent = _turned(chord / length[:, None], bend * (2 * share - 1))
    return start + moved, tangent


def monotone_slopes(x: Floats, y: Floats) -> Floats:
    """Return slopes at the points of a rising x that make a cubic interpolation keep to the data.

    The weighted harmonic mean of the slopes on both sides, 0 at extremes (Fritsch and Butland 1984,
    doi:10.1137/0905021); at the ends the slope of the outer interval.
    """
    if len(x) < 2:
        return np.zeros(len(x))
    width = np.diff(x)
    secant = np.diff(y) / width
    slopes = np.empty(len(x))
    slopes[0], slopes[-1] = secant[0], secant[-1]
    left, right, a, b = secant[:-1], secant[1:], width[:-1], width[1:]
    same = left * right > 0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        mean = 3 * (a + b) / ((2 * b + a) / left + (b + 2 * a) / right)
    slopes[1:-1] = np.where(same, mean, 0.0)
    return slopes


def hermite(x: Floats, y: Floats, slopes: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Return values and slopes at `at` of the cubic through points with given slopes; constant beyond the ends."""
    if len(x) < 2:
        return np.full(at.shape, y[0]), np.zeros(at.shape)
    inside = np.clip(at, x[0], x[-1])
    index = np.clip(np.searchsorted(x, inside, side="right") - 1, 0, len(x) - 2)
    width = x[index + 1] - x[index]
    t = (inside - x[index]) / width
    rise, first, last = y[index + 1] - y[index], slopes[index] * width, slopes[index + 1] * width
    value = y[index] + t * (first + t * ((3 * rise - 2 * first - last) + t * (first + last - 2 * rise)))
    slope = (first + t * (2 * (3 * rise - 2 * first - last) + t * 3 * (first + last - 2 * rise))) / width
    return value, slope


def _at(spans: Floats, span: Ints, t: Floats) -> Floats:
    p = spans[span]
    t = t[:, None]
    u = 1 - t
    found: Floats = u * u * u * p[:, 0] + 3 * u * t * (u * p[:, 1] + t * p[:, 2]) + t * t * t * p[:, 3]
    return found


def _velocity(spans: Floats, span: Ints, t: Floats) -> Floats:
    p = spans[span]
    t = t[:, None]
    u = 1 - t
    found: Floats = 3 * (u * u * (p[:, 1] - p[:, 0]) + 2 * u * t * (p[:, 2] - p[:, 1]) + t * t * (p[:, 3] - p[:, 2]))
    return found


def _tangent(spans: Floats, span: Ints, t: Floats) -> Floats:
    """Return unit tangents; where the curve stands still, the direction to where it goes (or came from)."""
    speed = _velocity(spans, span, t)[:, :2]
    size = np.hypot(speed[:, 0], speed[:, 1])
    p = spans[span][:, :, :2]
    scale = np.abs(p - p[:, :1]).max(axis=(1, 2))
    still = size <= 1e-7 * scale
    if still.any():
        step = np.where(t[still] > 0.5, -1e-3, 1e-3)
        ahead = _at(spans, span[still], t[still] + step)[:, :2] - _at(spans, span[still], t[still])[:, :2]
        speed[still] = ahead * np.sign(step)[:, None]
        size[still] = np.hypot(speed[still, 0], speed[still, 1])
    none = size == 0
    speed[none], size[none] = (1.0, 0.0), 1.0
    found: Floats = speed / size[:, None]
    return found


def _biarc(p: Floats, t: Floats, q: Floats, u: Floats) -> tuple[Floats, Floats, Floats]:
    """Return where the two arcs from p (tangent t) to q (tangent u) meet, and the half angles of both.

    Both control lengths d equal: d solves |v|^2 = 2 d v.(t + u) + 2 d^2 (1 - t.u) with v = q - p.
    """
    v = q - p
    square, along, apart = (v * v).sum(1), (v * (t + u)).sum(1), 1 - (t * u).sum(1)
    root = np.sqrt(np.maximum(along * along + 2 * apart * square, 0.0))
    # The positive root without cancellation; square / (along + root) is its limit for equal tangents too.
    low = along + root
    d = np.divide(square, low, out=np.zeros_like(low), where=low > 1e-9 * np.sqrt(square))
    middle = 0.5 * (p + q + d[:, None] * (t - u))
    return middle, _half_angle(t, middle - p), _half_angle(q - middle, u)


def _half_angle(first: Floats, second: Floats) -> Floats:
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    found: Floats = np.arctan2(cross, (first * second).sum(1))
    return found


def _distance(x: Floats, p: Floats, q: Floats, bend: Floats) -> Floats:
    """Return the distance of points to arcs that turn by less than a half circle, one to one."""
    chord = np.maximum(np.hypot(*(q - p).T), 1e-300)
    t = (q - p) / chord[:, None]
    most = chord / np.maximum(2 + 2 * np.cos(bend), 1e-6)
    curvature = 2 * np.sin(bend) / chord
    normal = np.stack([-t[:, 1], t[:, 0]], axis=1)
    v = x - (0.5 * (p + q) - normal * (0.5 * chord * np.tan(0.5 * bend))[:, None])
    a, b = (v * t).sum(1), (v * normal).sum(1)
    w = np.hypot(1 - curvature * b, curvature * a)
    m = np.clip(a / np.maximum(w + 1 - curvature * b, 1e-9), -most, most)
    g = 2 * m / (1 + (curvature * m) ** 2)
    found: Floats = np.hypot(a - g, b - g * curvature * m)
    return found


def _turned(v: Floats, angle: Floats) -> Floats:
    co, si = np.cos(angle), np.sin(angle)
    return np.stack([co * v[:, 0] - si * v[:, 1], si * v[:, 0] + co * v[:, 1]], axis=1)
