r"""The skeleton of curve primitives: circular arcs that carry a height and a place, and what they mean off the curve.

**Distance.**  d(p) is the exact distance to the nearest of all arcs: continuous, |grad d| = 1.

**What varies along the curve.**  The height z and the *place* among the cross-sections belong to points of the curve.
Off it the nearest point will do only up to the medial axis, where it jumps to another branch (the other side of a
meander), and heights with it.  A `Skeleton` continues them over the plane without a step.  Each arc i has a field
z_i(p): the height at the projection of p on the arc, run on beyond its ends by up to r / 4 or a quarter of its radius.
With the distances d_i to the arcs,

    z(p) = 1/2 min_i (z_i(p) + L d_i(p)) + 1/2 max_i (z_i(p) - L d_i(p)),       over all i with d_i(p) < 2 r.

Where the nearest arc is the best of both - everywhere near the curve - this is its z_i, the height at the nearest
point; across a medial axis it changes over from one branch to the other with a slope of about L.  For fields that are
constant on their arcs it is the mean of the two Lipschitz extensions of McShane and Whitney.

- *Bound.*  Minima and maxima of functions of slope l have slope l: |grad z| <= max_i |grad z_i| + L.
- *Continuity.*  An arc enters the set at the distance 2 r.  At a point nearer than r to the curve it then is at least r
  farther away than the nearest one, so it cannot be the best if L r is more than the greatest difference of heights of
  arcs within 3 r: L is chosen so (`Skeleton.lifts`).
- *On the curve*, z is given exactly as long as L also exceeds the slope from branch to branch, |dz| / gap, which L is
  raised to, up to `STEEPEST`.  Curves that cross at different heights change over within |dz| / (2 L) of the crossing.

**Side.**  The signed distance changes sign across a medial axis between the left of one branch and the right of
another.  `side` is the sine of the angle between the curve and the direction to p, 1 left and -1 right of it; the
greatest such value among arcs not much farther than the nearest one, each fading out over the window d <= d_i <= 2 d,
is taken for either sign, and the difference of both, doubled and cut at +-1, is the side: 1 or -1 beside a branch, and
between branches, around sharp corners and beyond ends a smooth passage.  Its slope is at most `TURN` / d.

References:
    E. J. McShane (1934): Extension of range of functions. Bull. AMS 40(12). doi:10.1090/S0002-9904-1934-05978-0.
"""

from __future__ import annotations

from functools import cached_property
from math import ceil, inf
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_tree.function import NOWHERE, Box
from nodegraph_tree.geometry import MOST_BEND, Track, part_at

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

STEEPEST = 1.0
"""Most that L is raised to so that heights hold on curves that come close to each other, m per m."""

WINDOW = 1.0
"""Arcs count for the side up to 1 + this times the distance of the nearest."""

TURN = 12.0
"""Greatest slope of the side times the distance.

A window phi = 2 - d_i / d times a sine s turns by at most s |grad phi| + phi |cos| / d_i, which is at most
sqrt((3 - phi)^2 + (phi / (2 - phi))^2) / d <= 3 / d: the length of (|grad phi|, phi / d_i), with |grad phi| at most
(1 + d_i / d) / d.  There are two signs, and the difference is doubled.
"""

_CENTRE = 0.25
"""Share of an arc's radius around its centre within which the projection, undefined there, shrinks to its middle."""

_MOST = 10.0
"""Most that L is raised to, times what continuity needs."""

_BRUTE = 256
"""Up to so many arcs no index is used."""


class Found(NamedTuple):
    """Points (n,) against arcs (m,), (n, m) each; gradients (2, n, m) when asked for.

    Attributes:
        distance: d_i, m.
        along: the continued projection, m from the middle of the arc.
        side: sine of the angle from the curve to the point at the nearest point of the arc.
    """

    distance: Floats
    along: Floats
    side: Floats
    distance_gradient: Floats | None = None
    along_gradient: Floats | None = None
    side_gradient: Floats | None = None


class Frames(NamedTuple):
    """The arcs as they are evaluated, (n,) each.

    Attributes:
        x, y: middle, m.
        tx, ty: unit tangent there.
        curvature: 1/m, positive to the left.
        half: tan(angle of half the arc / 2) / curvature, m: the end in the parameter of the projection.
        beyond: the same where the continuation ends.
        length: half the length, m.
        soft: 1 / (4 e) with e how far the continuation goes in the end, 1/m; it slows down evenly over 2 e.
        fold: 1 where points behind the centre are within reach, so that the projection must be folded back there.
    """

    x: Floats
    y: Floats
    tx: Floats
    ty: Floats
    curvature: Floats
    half: Floats
    beyond: Floats
    length: Floats
    soft: Floats
    fold: Floats


@port_type
class Skeleton:
    """Curves as circular arcs that carry heights and places.

    Attributes:
        start, end: (n, 2) m.
        bend: (n,) half the angle each arc turns through, rad, at most `MOST_BEND` either way.
        height: (n, 4): height at start and end, m, and its slope along the curve there.
        place: (n, 2): place among the cross-sections at start and end.
        radius: r, m: nothing is asked farther from the curves.
    """

    start: Floats
    end: Floats
    bend: Floats
    height: Floats
    place: Floats
    radius: float

    def __len__(self) -> int:
        return len(self.bend)

    @cached_property
    def lengths(self) -> Floats:
        """Length of each arc, m."""
        found: Floats = np.hypot(*(self.end - self.start).T) / np.sinc(self.bend / np.pi)
        return found

    @cached_property
    def _curvature(self) -> Floats:
        chord = np.hypot(*(self.end - self.start).T)
        found: Floats = np.divide(2 * np.sin(self.bend), chord, out=np.zeros_like(chord), where=chord > 0)
        return found

    @cached_property
    def _extra(self) -> Floats:
        """e: how far the continuation of each arc goes beyond its ends, m.

        However short the arc: else the height next to it, at the slope g, would be found on arcs up to g d / L farther
        on, where z_i + L d_i is less by up to g^2 d / (2 L), as d_i grows with the square of the way along only.  With
        e, that way costs more than it gains: L (e + x)^2 / (2 d) > g x for all x, as e = r / 4, d <= r and L >= 3 g;
        in bends tighter than r, e is a quarter of their radius.  Curves shorter than r reach a quarter of their length.
        """
        chain = np.cumsum(self._begins) - 1
        whole = np.bincount(chain, self.lengths)[chain]
        with np.errstate(divide="ignore"):
            found: Floats = np.minimum(0.25 * self.radius, 0.25 / np.abs(self._curvature))
        return np.where(self.lengths > 0, np.minimum(found, 0.25 * whole), 0.0)

    @cached_property
    def _begins(self) -> npt.NDArray[np.bool_]:
        """Which arcs do not start where the one before ends."""
        return np.concatenate([[True], np.any(self.start[1:] != self.end[:-1], axis=1)])

    @cached_property
    def frames(self) -> Frames:
        """The arcs as they are evaluated."""
        v = self.end - self.start
        chord = np.hypot(v[:, 0], v[:, 1])
        none = chord == 0
        safe = np.where(none, 1.0, chord)
        tx, ty = np.where(none, 1.0, v[:, 0] / safe), v[:, 1] / safe
        curvature = self._curvature
        sagitta = 0.5 * chord * np.tan(0.5 * self.bend)
        length = 0.5 * self.lengths
        extra = self._extra
        beyond = length + 2 * extra
        angle = 0.5 * curvature * beyond
        # tan(angle) / curvature, whose limit for straight ones is beyond / 2
        tangent = np.divide(np.tan(angle), angle, out=np.ones_like(angle), where=np.abs(angle) > 1e-12)
        return Frames(
            0.5 * (self.start[:, 0] + self.end[:, 0]) + ty * sagitta,
            0.5 * (self.start[:, 1] + self.end[:, 1]) - tx * sagitta,
            tx,
            ty,
            curvature,
            chord / (2 + 2 * np.cos(self.bend)),
            0.5 * beyond * tangent,
            length,
            np.divide(0.25, extra, out=np.zeros_like(extra), where=extra > 0),
            (np.abs(curvature) * 2 * self.radius > 0.7).astype(np.float64),
        )

    @cached_property
    def cubics(self) -> Floats:
        """Height as a cubic of the distance from the middle of the arc, (n, 4), constant first."""
        length = 0.5 * self.lengths
        a, b, first, last = self.height.T
        # An arc of no length has a height and nothing else.
        sound = length > 1e-9
        length = np.where(sound, length, 1.0)
        first, last = np.where(sound, first * length, 0.0), np.where(sound, last * length, 0.0)
        rise = np.where(sound, b - a, 0.0)
        return np.stack(
            [
                0.5 * (a + b) + 0.25 * (first - last),
                (0.75 * rise - 0.25 * (first + last)) / length,
                0.25 * (last - first) / length**2,
                0.25 * (first + last - rise) / length**3,
            ],
            axis=1,
        )

    @cached_property
    def grades(self) -> Floats:
        """Greatest |slope| of the height along each arc, (n,)."""
        c, length = self.cubics, self.frames.length
        ends = [np.abs(c[:, 1] + t * (2 * c[:, 2] + 3 * c[:, 3] * t)) for t in (-length, length)]
        with np.errstate(divide="ignore", invalid="ignore"):
            turn = np.where(c[:, 3] != 0, -c[:, 2] / (3 * c[:, 3]), 0.0)
        turn = np.clip(np.nan_to_num(turn), -length, length)
        found: Floats = np.maximum(np.maximum(*ends), np.abs(c[:, 1] + turn * (2 * c[:, 2] + 3 * c[:, 3] * turn)))
        return found

    @cached_property
    def place_slopes(self) -> Floats:
        """Slope of the place along each arc, 1/m."""
        step = self.place[:, 1] - self.place[:, 0]
        return np.divide(step, self.lengths, out=np.zeros_like(step), where=self.lengths > 0)

    @cached_property
    def stretch(self) -> Floats:
        """How far the continued projection can be from the nearest point at distances up to 2 r, m.

        A continuation goes e beyond the end of an arc of half length l; where the projection folds back it stays within
        l + e of the middle, and the nearest point within l.
        """
        return np.where(self.frames.fold > 0, 2 * self.frames.length + self._extra, self._extra)

    @cached_property
    def reaches(self) -> Floats:
        """Least and greatest height that z_i takes, (n, 2)."""
        c, length = self.cubics, self.frames.length
        swing = self.grades * (length + self.stretch)
        return np.stack([c[:, 0] - swing, c[:, 0] + swing], axis=1)

    @cached_property
    def places(self) -> Floats:
        """Least and greatest place that the continued places take, (n, 2)."""
        middle = self.place.mean(axis=1)
        swing = np.abs(self.place_slopes) * (self.frames.length + self.stretch)
        return np.stack([middle - swing, middle + swing], axis=1)

    @cached_property
    def lifts(self) -> tuple[float, float]:
        """L for heights and for places (m per m, 1/m): the docstring of this module says what they must be."""
        spacing = self.radius / 8
        counts = np.maximum(np.ceil(self.lengths / spacing), 1).astype(np.int64)
        arc = np.repeat(np.arange(len(self)), counts)
        step = np.arange(len(arc)) - np.repeat(np.cumsum(counts) - counts, counts)
        share = (step + 0.5) / counts[arc]
        where, _ = part_at(self.start[arc], self.end[arc], self.bend[arc], share)
        along = (2 * share - 1) * self.frames.length[arc]
        piece = (self.lengths / counts)[arc]
        # Runs: pieces that follow each other, begun within the same `spacing`; each reaches 2 spacings at most.
        run = np.floor((np.cumsum(piece) - piece) / spacing).astype(np.int64)
        chain = np.cumsum(self._begins[arc] & (step == 0))
        starts = np.flatnonzero(np.concatenate([[True], (np.diff(run) != 0) | (np.diff(chain) != 0)]))
        found = []
        for value, grade in (
            (self.heights(along[None], arc)[0][0], self.grades),
            (self.place.mean(axis=1)[arc] + along * self.place_slopes[arc], np.abs(self.place_slopes)),
        ):
            if float(np.ptp(value)) == 0 and float(grade.max()) == 0:
                found.append(0.0)
                continue
            swing = 0.5 * grade[arc] * piece
            low, high = np.minimum.reduceat(value - swing, starts), np.maximum.reduceat(value + swing, starts)
            spread = self._spread(where[starts], low, high, 3 * self.radius + 4 * spacing)
            needed = (spread + 2 * float((grade * self.stretch).max())) / self.radius
            wanted = min(self._gaps(where[starts], low, high, spacing), STEEPEST)
            # Not so much that float32 would lose the values beside L d: on a curve much shorter than r nobody can tell.
            found.append(max(needed, min(max(3 * float(grade.max()), wanted), _MOST * needed)))
        return found[0], found[1]

    def _spread(self, where: Floats, low: Floats, high: Floats, reach: float) -> float:
        """Return the greatest difference of values between places within `reach` of each other, or somewhat more."""
        if len(where) <= 3000:
            from scipy.spatial import cKDTree

            pairs = cKDTree(where).query_pairs(reach, output_type="ndarray")
            most = float((high - low).max())
            if len(pairs):
                first, second = pairs.T
                gaps = np.maximum(high[first] - low[second], high[second] - low[first])
                most = max(most, float(gaps.max()))
            return most
        cells = np.floor((where - where.min(axis=0)) / reach).astype(np.int64)
        wide = int(cells[:, 0].max()) + 3
        key, place = np.unique((cells[:, 1] + 1) * wide + cells[:, 0] + 1, return_inverse=True)
        least, most_ = np.full(len(key), inf), np.full(len(key), -inf)
        np.minimum.at(least, place, low)
        np.maximum.at(most_, place, high)
        lowest, highest = least.copy(), most_.copy()
        for shift in (-wide - 1, -wide, -wide + 1, -1, 1, wide - 1, wide, wide + 1):
            at = np.clip(np.searchsorted(key, key + shift), 0, len(key) - 1)
            hit = key[at] == key + shift
            lowest[hit] = np.minimum(lowest[hit], least[at[hit]])
            highest[hit] = np.maximum(highest[hit], most_[at[hit]])
        return float((highest - lowest).max())

    def _gaps(self, where: Floats, low: Floats, high: Floats, spacing: float) -> float:
        """Return about the greatest slope from branch to branch, from places somewhat apart."""
        from scipy.spatial import cKDTree

        every = max(1, ceil(len(where) / 3000))
        where, low, high = where[::every], low[::every], high[::every]
        pairs = cKDTree(where).query_pairs(min(2 * self.radius, 40 * spacing * every), output_type="ndarray")
        if not len(pairs):
            return 0.0
        first, second = pairs.T
        far = np.maximum(np.hypot(*(where[first] - where[second]).T), 1e-9)
        found = np.maximum(low[first] - high[second], low[second] - high[first]) / far
        return 1.25 * float(found.max(initial=0.0))

    # Where the arcs are.

    @cached_property
    def boxes(self) -> Floats:
        """Boxes around the arcs, (n, 4): west, south, east, north."""
        chord = np.hypot(*(self.end - self.start).T)
        sagitta = np.abs(0.5 * chord * np.tan(0.5 * self.bend))[:, None]
        low, high = np.minimum(self.start, self.end) - sagitta, np.maximum(self.start, self.end) + sagitta
        return np.concatenate([low, high], axis=1)

    @cached_property
    def extent(self) -> Box:
        """A box around all arcs."""
        if not len(self):
            return NOWHERE
        low, high = self.boxes[:, :2].min(axis=0), self.boxes[:, 2:].max(axis=0)
        return Box(float(low[0]), float(low[1]), float(high[0]), float(high[1]))

    def near(self, box: Box, reach: float) -> Ints:
        """Return the arcs whose boxes are within `reach` of a box, along each axis, rising.  O(found)."""
        west, south, east, north = box.grown(reach).intersection(self.extent.grown(1.0))
        if west > east or south > north:
            return np.zeros(0, np.int64)
        if len(self) <= _BRUTE:
            some = np.arange(len(self))
        else:
            low, size, shape, begins, arcs = self._index
            c0, r0 = (
                int(np.clip((edge - low[axis]) / size, 0, shape[axis] - 1)) for axis, edge in ((0, west), (1, south))
            )
            c1, r1 = (
                int(np.clip((edge - low[axis]) / size, 0, shape[axis] - 1)) for axis, edge in ((0, east), (1, north))
            )
            if (c1 - c0 + 1) * (r1 - r0 + 1) * 4 > shape[0] * shape[1] * 3:
                some = np.arange(len(self))
            else:
                rows = np.arange(r0, r1 + 1) * shape[0]
                parts = [arcs[begins[row + c0] : begins[row + c1 + 1]] for row in rows.tolist()]
                some = np.unique(np.concatenate(parts)) if parts else np.zeros(0, np.int64)
        found = self.boxes[some]
        hit = (found[:, 0] <= east) & (found[:, 2] >= west) & (found[:, 1] <= north) & (found[:, 3] >= south)
        kept: Ints = some[hit]
        return kept

    @cached_property
    def _index(self) -> tuple[Floats, float, tuple[int, int], Ints, Ints]:
        """A grid of cells with the arcs that reach into each, one after the other."""
        low = np.array(self.extent[:2])
        span = np.array(self.extent[2:]) - low
        size = max(2 * self.radius, float(span.max()) / 1024, 1e-6)
        shape = (int(span[0] / size) + 1, int(span[1] / size) + 1)
        corner = np.array(shape) - 1
        first = np.clip(((self.boxes[:, :2] - low) / size).astype(np.int64), 0, corner)
        last = np.clip(((self.boxes[:, 2:] - low) / size).astype(np.int64), 0, corner)
        wide, high = (last - first + 1).T
        counts = wide * high
        arc = np.repeat(np.arange(len(self)), counts)
        step = np.arange(len(arc)) - np.repeat(np.cumsum(counts) - counts, counts)
        cell = (first[arc, 1] + step // wide[arc]) * shape[0] + first[arc, 0] + step % wide[arc]
        order = np.argsort(cell, kind="stable")
        begins = np.searchsorted(cell[order], np.arange(shape[0] * shape[1] + 1))
        return low, size, shape, begins, arc[order]

    # What they are at points.

    def project(self, x: Floats, y: Floats, arcs: Ints, *, gradient: bool = False) -> Found:
        """Project points (n,) on arcs (m,).  O(n m).

        In the frame of an arc (a along, b to the left, from its middle) with curvature k, W = |(1 - k b, k a)| is the
        distance to the centre over the radius, and m = a / (W + 1 - k b) the tangent of half the angle over k, from
        which the nearest point and the length along the arc follow without loss for straight ones.
        """
        frame = [item[arcs] for item in self.frames]
        mx, my, tx, ty, k, half, beyond, length, soft, fold = frame
        vx, vy = x[:, None] - mx, y[:, None] - my
        a, b = vx * tx + vy * ty, vy * tx - vx * ty
        u, w = 1 - k * b, k * a
        far = np.sqrt(u * u + w * w)
        behind = u < 0
        q = np.maximum(far + np.abs(u), 1e-300)
        size = np.abs(a)
        m = np.where(behind | (size > half * q), np.copysign(half, a), a / q)
        past = behind | (size > beyond * q)
        bottom = np.where(past, np.copysign(np.maximum(size, 1e-300), a), 1.0)
        folded = np.where(behind, beyond * k * beyond * w / q, beyond * beyond * q / bottom)
        inner = np.where(past, np.where(fold > 0, folded, np.copysign(beyond, a)), a / q)
        h = k * m
        g = 2 * m / (1 + h * h)
        ea, eb = a - g, b - g * h
        distance = np.hypot(ea, eb)
        angle = k * inner
        arc = 2 * inner * _arctangent(angle * angle)
        extra = np.maximum(np.abs(arc) - length, 0.0)
        arc = np.clip(arc, -length, length) + np.copysign(extra * (1 - extra * soft), arc)
        shrunk = np.minimum(far * (1 / _CENTRE), 1.0)
        along = arc * shrunk
        na, nb = -2 * h / (1 + h * h), (1 - h * h) / (1 + h * h)
        safe = np.maximum(distance, 1e-300)
        side = np.where(distance > 0, (na * ea + nb * eb) / safe, 0.0)
        if not gradient:
            return Found(distance, along, side)
        # d: the unit vector from the nearest point.  Along: |grad| = 1 / W across the line to the centre.
        da, db = ea / safe, eb / safe
        turned = -((inner / np.maximum(beyond, 1e-300)) ** 2 + (k * beyond) ** 2) / (1 + angle * angle)
        rate = np.where(past, np.where(fold > 0, turned, 0.0), 1.0) * (1 - 2 * extra * soft)
        nonzero = np.maximum(far, 1e-300)
        inverse = np.where(far < _CENTRE, 1 / _CENTRE, 1 / nonzero)
        sa, sb = rate * inverse * u / nonzero, rate * inverse * w / nonzero
        pull = np.where(far < _CENTRE, arc / _CENTRE, 0.0)
        sa, sb = sa + pull * k * w / nonzero, sb - pull * k * u / nonzero
        ended = behind | (size > half * q)
        ta, tb = (np.where(ended & (distance > 0), (n - side * e) / safe, 0.0) for n, e in ((na, da), (nb, db)))
        pairs = ((da, db), (sa, sb), (ta, tb))
        return Found(distance, along, side, *(np.stack([p * tx - r * ty, p * ty + r * tx]) for p, r in pairs))

    def heights(self, along: Floats, arcs: Ints) -> tuple[Floats, Floats]:
        """Return z_i and its derivative for continued projections (n, m): straight on beyond the ends."""
        c, length = self.cubics[arcs].T, self.frames.length[arcs]
        s = np.clip(along, -length, length)
        slope = c[1] + s * (2 * c[2] + 3 * s * c[3])
        return c[0] + s * (c[1] + s * (c[2] + s * c[3])) + (along - s) * slope, slope

    def turned(self, arcs: Ints, x: float, y: float, half: float) -> Floats:
        """Bound |grad along| of arcs within `half` of a point: 1 / W, and near a centre what shrinking adds."""
        frame = [item[arcs] for item in self.frames]
        mx, my, tx, ty, k, *_ = frame
        a, b = (x - mx) * tx + (y - my) * ty, (y - my) * tx - (x - mx) * ty
        least = np.hypot(1 - k * b, k * a) - np.abs(k) * half
        return np.where(least >= _CENTRE, 1 / np.maximum(least, _CENTRE), self._most_turned[arcs])

    @cached_property
    def _most_turned(self) -> Floats:
        k, length = np.abs(self.frames.curvature), self.frames.length
        return np.where(k > 0, (1 + k * (length + self._extra)) / _CENTRE, 1.0)

    @cached_property
    def anywhere(self) -> Floats:
        """Bound of |grad along| within 2 r of each arc, (n,)."""
        least = 1 - 2 * self.radius * np.abs(self.frames.curvature)
        return np.where(least >= _CENTRE, 1 / np.maximum(least, _CENTRE), self._most_turned)


def skeleton(
    tracks: list[Track], heights: list[tuple[Floats, Floats]], places: list[Floats], radius: float
) -> Skeleton:
    """Return tracks with heights and slopes, and places, at their nodes as one skeleton.

    Straight arcs longer than 8 r are cut, so that no number a device sees is much larger than the tile and r.
    """
    columns: list[tuple[Floats, ...]] = []
    for track, (height, rise), place in zip(tracks, heights, places, strict=True):
        columns.append(
            (
                track.nodes[:-1], track.nodes[1:], track.bend,
                np.stack([height[:-1], height[1:], rise[:-1], rise[1:]], axis=1),
                np.stack([place[:-1], place[1:]], axis=1),
            )
        )  # fmt: skip
    start, end, bend, high, spot = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    whole = Skeleton(start, end, bend, high, spot, radius)
    bends = np.ceil(np.abs(bend) / MOST_BEND)
    counts = np.maximum(np.maximum(np.ceil(whole.lengths / (8 * radius)), bends), 1).astype(np.int64)
    if not (counts > 1).any():
        return whole
    arc = np.repeat(np.arange(len(bend)), counts)
    step = np.arange(len(arc)) - np.repeat(np.cumsum(counts) - counts, counts)
    ends = []
    for share in (step / counts[arc], (step + 1) / counts[arc]):
        where, _ = part_at(start[arc], end[arc], bend[arc], share)
        where[share == 0], where[share == 1] = start[arc[share == 0]], end[arc[share == 1]]
        s = (2 * share - 1) * whole.frames.length[arc]
        value, slope = whole.heights(s[None], arc)
        ends.append((where, value[0], slope[0], spot[arc, 0] + share * (spot[arc, 1] - spot[arc, 0])))
    (p, a, first, one), (q, b, last, two) = ends
    return Skeleton(
        p, q, (bend / counts)[arc], np.stack([a, b, first, last], axis=1), np.stack([one, two], axis=1), radius
    )


def _arctangent(square: Floats) -> Floats:
    """Return atan(sqrt(square)) / sqrt(square)."""
    root = np.sqrt(square)
    return np.where(root > 1e-4, np.arctan(root) / np.maximum(root, 1e-300), 1 - square / 3)
