"""Rasters along a curve (section 4.2): rivers, canyons and ranges from pictures of straight ones.

The curve is G1, of arcs (`nodegraph_tree.arcs`), with s along and d across it.  Pictures follow one another along s;
each overlaps the next by a stretch in which one fades into the other, so that the heights have no step:

    f = sum_k x_k(s) h_k((s - s_k) / l_k, (w - d) / 2 w),   sum_k x_k = 1,   alpha = g(sides) g(start) g(end)

with x_k C1.  The half width w is less than every radius, so that near the curve (s, d) is unique.  Where the curve
comes near itself, its two parts are blended by their weights.

**From arc to arc.**  An arc counts between the lines across both its ends; in a hair's breadth about such a line,
`HAIR` of the width, the two arcs fade into each other, whose (s, d) agree there to second order.  So nothing is lost or
counted twice where rounding decides on which side a point lies.

**Bounds.**  (s, d) of a box are bounded for each arc (`Arc.reach`) and looked up in the pictures' pyramids.  The
gradients of s and d are at right angles and of length 1 / (1 - k d) and 1.  In a fade of length o the slope grows by
1.5 / (o (1 - k d)) times the difference of the two pictures.  In a hair of width e two arcs of stretches a, b = 1 / (1
- k d) disagree by |q| |a - b| <= e |a - b| / 2 in s, fading at the rate 1 / e: the slope grows by at most half of 1 - b
/ a, and by less than one part in a hundred for what is of second order.
"""

from __future__ import annotations

from functools import cached_property
from math import hypot, isfinite
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Param, node, port_type
from nodegraph_terrain.raster import Elevation
from nodegraph_tree.arcs import Arc, along, apart, smooth_curve
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.falloff import CODES, FallOff, derivative, fall_off, steepest_between
from nodegraph_tree.from_elevation import Interpolation
from nodegraph_tree.function import (
    ABSENT,
    THRESHOLD,
    Bounds,
    Box,
    ElevationFunction,
    Floats,
    Points,
    Sample,
    empty_sample,
)
from nodegraph_tree.images import Picture
from nodegraph_tree.pixels import Pyramid, known

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

Fit = Literal["repeat", "stretch"]

HAIR = 1e-3
"""Width of the fade between arcs, in widths of the strip (less on short arcs)."""

SHARPEST = 0.95
"""Greatest half width over the radius of a bend."""

_PIECE = Kernel("tree_image_curve", FOLDER / "image.cl")
_BLEND = Kernel("tree_blend", FOLDER / "operators.cl")


class Span(NamedTuple):
    """Where a picture lies along the curve: from s = `start` to `end`, m, both fades included."""

    picture: int
    start: float
    end: float


class _Reach(NamedTuple):
    """An arc, and the ranges of s and d that a box can hold of it."""

    arc: int
    s0: float
    s1: float
    d0: float
    d1: float


@port_type
class ImageCurve(ElevationFunction):
    """Rasters along a curve; see the module.

    Attributes:
        pictures: the rasters.
        arcs: (n, 7): the fields of an `Arc`.
        spans: (m, 3): the fields of a `Span`, each but the first starting `overlap` before the end of the one before.
        width: half the width of the strip, less than the least radius, m.
        margin: over which the weight falls to 0 at sides and ends, m.
        overlap: of consecutive pictures, m.
        scale, rise: of the heights, and m.
        fall_off: how the weight falls.
    """

    pictures: tuple[Picture, ...]
    arcs: npt.NDArray[np.float64]
    spans: npt.NDArray[np.float64]
    width: float
    margin: float
    overlap: float
    scale: float = 1.0
    rise: float = 0.0
    fall_off: FallOff = "cubic"

    @cached_property
    def _arcs(self) -> list[Arc]:
        return [Arc(*row) for row in self.arcs.tolist()]

    @cached_property
    def _spans(self) -> list[Span]:
        return [Span(int(row[0]), row[1], row[2]) for row in self.spans.tolist()]

    @property
    def length(self) -> float:
        """Of the curve, m."""
        return self._arcs[-1].end

    @cached_property
    def _hulls(self) -> list[Floats]:
        return [arc.hull(self.width) for arc in self._arcs]

    @cached_property
    def _boxes(self) -> Floats:
        hair = self._slack
        return np.array([[*(hull.min(axis=0) - hair), *(hull.max(axis=0) + hair)] for hull in self._hulls])

    @cached_property
    def support(self) -> Box:
        """Around the strip."""
        west, south, _, _ = self._boxes.min(axis=0).tolist()
        _, _, east, north = self._boxes.max(axis=0).tolist()
        return Box(west, south, east, north)

    @cached_property
    def _hair(self) -> float:
        return min(HAIR * self.width, 0.1 * min(arc.length for arc in self._arcs))

    @cached_property
    def _slack(self) -> float:
        """How far (s) an arc counts beyond its ends: half a hair, stretched as far as the node allows."""
        return 0.5 * self._hair / (1 - SHARPEST)

    @cached_property
    def _doubled(self) -> Floats:
        """Pairs of arcs, (n, 2), that are no neighbours and whose strips may share ground."""
        from scipy.spatial import cKDTree

        boxes = self._boxes
        middle = 0.5 * (boxes[:, :2] + boxes[:, 2:])
        size = float(np.hypot(*(boxes[:, 2:] - boxes[:, :2]).T).max())
        near = cKDTree(middle).query_pairs(size, output_type="ndarray")
        near = near[np.abs(near[:, 0] - near[:, 1]) > 1]
        a, b = boxes[near[:, 0]], boxes[near[:, 1]]
        near = near[((a[:, :2] <= b[:, 2:]) & (b[:, :2] <= a[:, 2:])).all(axis=1)]
        kept = [pair for pair in near.tolist() if not apart(self._hulls[pair[0]], self._hulls[pair[1]], 0.0)]
        return np.array(kept, np.float64).reshape(-1, 2)

    def _near(self, box: Box) -> list[_Reach]:
        """Return the arcs that reach a box, in order."""
        west, south, east, north = self._boxes.T
        hits = (west <= box.east) & (box.west <= east) & (south <= box.north) & (box.south <= north)
        found = []
        for index in np.flatnonzero(hits).tolist():
            part = box.intersection(Box(*self._boxes[index].tolist()))
            ranges = self._arcs[index].reach(part, self.width, self._slack)
            if ranges is not None:
                found.append(_Reach(index, *ranges))
        return found

    def _joint(self, index: int) -> tuple[float, float, float, float]:
        """Return place and direction of the joint before an arc (the end of the curve after the last)."""
        if index < len(self._arcs):
            arc = self._arcs[index]
            return arc.x, arc.y, arc.east, arc.north
        return self._arcs[-1].at(self._arcs[-1].end)

    # Evaluation.

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Return the blend over the arcs near the points, O(points * arcs near them)."""
        found = empty_sample(points, gradient=gradient)
        if not points.x.size:
            return found
        moment, weight = np.zeros(points.x.shape), np.zeros(points.x.shape)
        moment_slope, weight_slope = np.zeros((2, *points.x.shape)), np.zeros((2, *points.x.shape))
        around = Box(*(float(v) for v in (points.x.min(), points.y.min(), points.x.max(), points.y.max())))
        for reach in self._near(around):
            west, south, east, north = self._boxes[reach.arc]
            where = np.flatnonzero((points.x >= west) & (points.x <= east) & (points.y >= south) & (points.y <= north))
            if where.size:
                self._add(reach.arc, points, where, gradient, moment, weight, moment_slope, weight_slope)
        inside = weight > 0
        height = np.divide(moment, weight, out=np.zeros_like(moment), where=inside)
        if not gradient:
            return Sample(height, weight)
        slope = np.divide(moment_slope - height * weight_slope, weight, out=np.zeros_like(moment_slope), where=inside)
        return Sample(height, weight, slope, weight_slope)

    def _add(
        self,
        index: int,
        points: Points,
        where: npt.NDArray[np.int64],
        gradient: bool,
        moment: Floats,
        weight: Floats,
        moment_slope: Floats,
        weight_slope: Floats,
    ) -> None:
        """Add what one arc contributes to some of the points."""
        arc = self._arcs[index]
        ramps = [self._ramp(joint, points.x[where], points.y[where]) for joint in (index, index + 1)]
        share = ramps[0][0] * (1 - ramps[1][0])
        kept = share > 0
        where, share = where[kept], share[kept]
        middle = arc.start + 0.5 * arc.length
        x, y, east, north = arc.at(middle)
        px, py = points.x[where] - x, points.y[where] - y
        place = along(px * east + py * north, py * east - px * north, arc.curvature)
        s = place.s + middle
        weigh = self._weigh(s, place.d)
        kept = weigh[0] > 0
        if not kept.any():
            return
        where, share, s, d = where[kept], share[kept], s[kept], place.d[kept]
        g, g_s, g_d = (item[kept] for item in weigh)
        height, h_s, h_d = self._look(s, d)
        w = share * g
        moment[where] += w * height
        weight[where] += w
        if not gradient:
            return
        # From along and across to east and north.
        s_x, s_y = (place.s_q * east - place.s_n * north)[kept], (place.s_q * north + place.s_n * east)[kept]
        d_x, d_y = (place.d_q * east - place.d_n * north)[kept], (place.d_q * north + place.d_n * east)[kept]
        first, second = ramps
        for axis, (sa, da) in enumerate(((s_x, d_x), (s_y, d_y))):
            # The fade from arc to arc is part of the share.
            rate = first[1 + axis] * (1 - second[0]) - first[0] * second[1 + axis]
            fade = share * (g_s * sa + g_d * da) + rate[self._kept(ramps)][kept] * g
            moment_slope[axis, where] += fade * height + w * (h_s * sa + h_d * da)
            weight_slope[axis, where] += fade

    @staticmethod
    def _kept(ramps: list[tuple[Floats, Floats, Floats]]) -> npt.NDArray[np.bool_]:
        return np.asarray(ramps[0][0] * (1 - ramps[1][0]) > 0)

    def _ramp(self, joint: int, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the share of what follows a joint, 0 to 1, and its gradient."""
        if joint in (0, len(self._arcs)):  # the fall-off at the ends does it
            value = np.full(x.shape, float(joint == 0))
            return value, np.zeros(x.shape), np.zeros(x.shape)
        jx, jy, east, north = self._joint(joint)
        raw = ((x - jx) * east + (y - jy) * north) / self._hair + 0.5
        rate = np.where((raw > 0) & (raw < 1), 1 / self._hair, 0.0)
        return np.clip(raw, 0.0, 1.0), rate * east, rate * north

    def _weigh(self, s: Floats, d: Floats) -> tuple[Floats, Floats, Floats]:
        """Return g(sides) g(start) g(end) and its derivatives along s and d."""
        m = self.margin
        ts = [1 - (self.width - np.abs(d)) / m, 1 - s / m, 1 - (self.length - s) / m]
        side, start, end = (fall_off(self.fall_off, t) for t in ts)
        side_t, start_t, end_t = (derivative(self.fall_off, np.maximum(t, 0.0)) / m for t in ts)
        return side * start * end, side * (end_t * start - start_t * end), side_t * np.sign(d) * start * end

    def _look(self, s: Floats, d: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the heights of the pictures, faded into each other, and their derivatives along s and d."""
        height, h_s, h_d = np.zeros(s.shape), np.zeros(s.shape), np.zeros(s.shape)
        spans = self._spans
        for index, span in enumerate(spans):
            first = 0 if index == 0 else span.start
            last = np.inf if index == len(spans) - 1 else span.end
            where = ((s >= first) if index else np.ones(s.shape, bool)) & (s <= last)
            if not where.any():
                continue
            here = s[where]
            share, rate = np.ones(here.shape), np.zeros(here.shape)
            if index:
                share, rate = _smooth((here - span.start) / self.overlap)
            if index < len(spans) - 1:
                other, fall = _smooth((here - spans[index + 1].start) / self.overlap)
                rate = rate * (1 - other) - share * fall
                share = share * (1 - other)
            rate = rate / self.overlap
            length = span.end - span.start
            look = (
                self.pictures[span.picture].look((here - span.start) / length, 0.5 - d[where] / (2 * self.width)).height
            )
            height[where] += share * look.value
            h_s[where] += share * look.along / length + rate * look.value
            h_d[where] -= share * look.down / (2 * self.width)
        return self.scale * height + self.rise, self.scale * h_s, self.scale * h_d

    # Bounds.

    @cached_property
    def _pyramids(self) -> list[Pyramid]:
        """One for each span: heights, and slopes in metres along s and d."""
        found = []
        for span in self._spans:
            pixels = self.pictures[span.picture].pixels
            cells = pixels.cells()
            wide, high = (span.end - span.start) / pixels.cols, 2 * self.width / pixels.rows
            found.append(Pyramid(cells.low, cells.high, np.hypot(cells.along / wide, cells.down / high)))
        return found

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:  # noqa: ARG002
        """Bound each arc's part, and their sum.

        Neighbours take turns, so that of them the worst counts.  Where strips double, it is a blend: see
        `Blend.bounds`, with as many operands as there are such arcs.
        """
        near = self._near(box)
        parts = [part for part in (self._part(reach, box) for reach in near) if not part.absent]
        if not parts:
            return ABSENT
        low, high = min(part.low for part in parts), max(part.high for part in parts)
        weight_low = parts[0].weight_low if len(parts) == 1 else 0.0
        weight_high, fade = max(part.weight_high for part in parts), max(part.weight_slope for part in parts)
        slope = max(part.slope for part in parts)
        if len(near) > 1:
            hair = 1.01 * (1.5 - 0.5 / self._unevenness(near))
            slope, fade = hair * slope, hair * fade
        indices = {reach.arc for reach in near}
        doubled = {int(i) for pair in self._doubled.tolist() if indices.issuperset(map(int, pair)) for i in pair}
        if not doubled:
            return Bounds(low, high, weight_low, weight_high, slope, fade, weight_high * slope, slope)
        count = 1 + len(doubled)
        flux = count * (weight_high * slope + fade * (high - low))
        return Bounds(low, high, weight_low, count * weight_high, flux / THRESHOLD, count * fade, flux)

    def _unevenness(self, near: list[_Reach]) -> float:
        """Return the greatest stretch over the least, of all arcs in a box."""
        gaps = [1 - self._arcs[reach.arc].curvature * d for reach in near for d in (reach.d0, reach.d1)]
        return max(gaps) / min(gaps)

    def _part(self, reach: _Reach, box: Box) -> Bounds:
        arc, m = self._arcs[reach.arc], self.margin
        stretch = 1 / min(1 - arc.curvature * reach.d0, 1 - arc.curvature * reach.d1)
        most = max(abs(reach.d0), abs(reach.d1))
        least = 0.0 if reach.d0 <= 0 <= reach.d1 else min(abs(reach.d0), abs(reach.d1))
        ranges = [
            (1 - (self.width - least) / m, 1 - (self.width - most) / m),
            (1 - reach.s1 / m, 1 - reach.s0 / m),
            (1 - (self.length - reach.s0) / m, 1 - (self.length - reach.s1) / m),
        ]
        ends = [tuple(min(max(t, 0.0), 1.0) for t in pair) for pair in ranges]
        highs = [float(fall_off(self.fall_off, np.array(near))) for near, _ in ends]
        lows = [float(fall_off(self.fall_off, np.array(far))) for _, far in ends]
        weight_high = highs[0] * highs[1] * highs[2]
        if weight_high <= 0:
            return ABSENT
        steep = [steepest_between(self.fall_off, near, far) / m for near, far in ends]
        across = steep[0] * highs[1] * highs[2]
        lengthwise = highs[0] * max(steep[1] * highs[2], steep[2] * highs[1])
        if steep[1] and steep[2]:
            lengthwise = highs[0] * (steep[1] * highs[2] + steep[2] * highs[1])
        fade = hypot(across, lengthwise * stretch)
        found = []
        slack = self._slack
        for index, span in enumerate(self._spans):
            if (index and reach.s1 + slack < span.start) or (
                index < len(self._spans) - 1 and reach.s0 - slack > span.end
            ):
                continue
            pixels = self.pictures[span.picture].pixels
            per, down = pixels.cols / (span.end - span.start), pixels.rows / (2 * self.width)
            found.append(
                self._pyramids[index].over(
                    (reach.s0 - slack - span.start) * per - 0.5,
                    (reach.s1 + slack - span.start) * per - 0.5,
                    (self.width - reach.d1) * down - 0.5 - 1e-6,
                    (self.width - reach.d0) * down - 0.5 + 1e-6,
                )
            )
        low, high = min(item.low for item in found), max(item.high for item in found)
        slope = max(item.slope for item in found) * max(stretch, 1.0)
        if len(found) > 1:
            slope += 1.5 / self.overlap * stretch * (high - low)
        heights = (self.scale * low + self.rise, self.scale * high + self.rise)
        slope *= abs(self.scale)
        # The weight can only be told from below where the whole box is on this strip.
        inside = all(
            abs(d) < self.width and arc.start + slack < s < arc.end - slack for s, d in self._corners(arc, box)
        )
        lowest = lows[0] * lows[1] * lows[2] if inside else 0.0
        return Bounds(min(heights), max(heights), lowest, weight_high, slope, fade, weight_high * slope, slope)

    @staticmethod
    def _corners(arc: Arc, box: Box) -> list[tuple[float, float]]:
        """Return (s, d) of a box's corners and, as the strip is not convex, of the points around them."""
        if not all(map(isfinite, box)):
            return [(np.nan, np.nan)]
        middle = arc.start + 0.5 * arc.length
        x, y, east, north = arc.at(middle)
        xs, ys = np.meshgrid([box.west, box.east], [box.south, box.north])
        px, py = xs.ravel() - x, ys.ravel() - y
        n = py * east - px * north
        if (1 - arc.curvature * n).min() < 1e-3:
            return [(np.nan, np.nan)]
        found = along(px * east + py * north, n, arc.curvature)
        # Between two corners d leaves its values there by a sagitta at most: of half the diagonal.
        sag = 0.5 * abs(arc.curvature) * ((box.east - box.west) ** 2 + (box.north - box.south) ** 2)
        return list(zip((found.s + middle).tolist(), (found.d + np.sign(found.d) * sag).tolist(), strict=True))

    # The device.

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Emit a piece for each arc and each picture on it that reach the tile, and blend them."""
        pieces = [piece for reach in self._near(frame.box) for piece in self._pieces(reach, emitter, frame)]
        if not pieces:
            emitter.nothing()
            return
        for index, (floats, ints) in enumerate(pieces):
            emitter.add(_PIECE, floats, ints)
            if index:
                emitter.add(_BLEND, pushes=-1)

    def _pieces(self, reach: _Reach, emitter: Emitter, frame: Frame) -> list[tuple[list[float], list[int]]]:
        arc, m = self._arcs[reach.arc], self.margin
        # Everything is told from a place on the strip near the tile; the curve at that distance is an arc too.
        s, d = 0.5 * (reach.s0 + reach.s1), 0.5 * (reach.d0 + reach.d1)
        x, y, east, north = arc.at(s, d)
        ratio = 1 / (1 - arc.curvature * d)
        ramps: list[float] = []
        for joint in (reach.arc, reach.arc + 1):
            if joint in (0, len(self._arcs)):
                ramps += [float(joint == 0), 0.0, 0.0]
                continue
            jx, jy, je, jn = self._joint(joint)
            here = (frame.ox - jx) * je + (frame.oy - jy) * jn
            ramps += [here / self._hair + 0.5, je / self._hair, jn / self._hair]
        shape = [
            *ramps,
            x - frame.ox, y - frame.oy, east, north, arc.curvature * ratio, ratio, d,
            1 - self.width / m, 1 / m, 1 - s / m, 1 - (self.length - s) / m,
        ]  # fmt: skip
        slack, pieces = self._slack, []
        for index, span in enumerate(self._spans):
            last = index == len(self._spans) - 1
            if (index and reach.s1 + slack < span.start) or (not last and reach.s0 - slack > span.end):
                continue
            fades = [1.0, 0.0, 0.0, 0.0]
            if index:
                fades[:2] = [(s - span.start) / self.overlap, 1 / self.overlap]
            if not last:
                fades[2:] = [(s - self._spans[index + 1].start) / self.overlap, 1 / self.overlap]
            length = span.end - span.start
            # Rows are counted from d, to the right of which the raster's rows follow.
            floats, ints = self.pictures[span.picture].device(
                emitter, (s - span.start) / length, 0.5 - d / (2 * self.width), 1 / length, 1 / (2 * self.width)
            )
            pieces.append(([*shape, *fades, self.scale, self.rise, *floats[:4]], [CODES[self.fall_off], *ints[1:7]]))
        return pieces


def _smooth(t: Floats) -> tuple[Floats, Floats]:
    """Return 3 t^2 - 2 t^3 and its derivative, level outside [0, 1]."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3 - 2 * t), 6 * t * (1 - t)


@node(version=1)
def image_curve(
    *images: Elevation,
    points: Annotated[
        tuple[tuple[float, float], ...], Param("Points [x, y] that the curve goes through.", min_length=2, unit="m")
    ],
    width: Annotated[float, Param("Half the width of the strip.", gt=0, unit="m")],
    fit: Annotated[Fit, Param("repeat the rasters in turn, nearly undistorted, or stretch each once.")] = "repeat",
    overlap: Annotated[
        float, Param("Stretch in which a raster fades into the next, as a share of the shorter.", gt=0, le=0.5)
    ] = 0.25,
    margin: Annotated[
        float | None, Param("Where the weight falls to 0 at sides and ends; none: half of width.", gt=0, unit="m")
    ] = None,
    interpolation: Annotated[
        Interpolation, Param("bilinear, or bicubic: smooth (C1), but may overshoot the cells.")
    ] = "bicubic",
    scale: Annotated[float, Param("What heights are multiplied by.")] = 1.0,
    rise: Annotated[float, Param("What is added to the heights then.", unit="m")] = 0.0,
    fall_off: Annotated[FallOff, Param("How the weight falls over the margin.")] = "cubic",
) -> ElevationFunction:
    """Lay rasters along a curve: a winding canyon from pictures of straight ones.

    The columns of a raster run along the curve, its northern edge on the left.  The curve is smooth (G1, of circular
    arcs) and goes through all points.  Rasters follow one another and fade into the next over the overlap; with
    ``repeat`` they come round again as often as fills the curve with the least distortion, the last ends where the
    curve ends.

    Args:
        images: heights in metres, without voids; cells of any size: a raster fills the width, its length follows.
        points: of the curve.
        width: from the curve to either side; less than the least radius of its bends.
        fit: ``repeat`` or ``stretch``.
        overlap: of consecutive rasters.
        margin: of the fall-off of the weight; at most `width`.
        interpolation: between cells.
        scale: of heights.
        rise: added to heights.
        fall_off: of the weight.

    Raises:
        ValueError: no raster, one with voids, a curve that bends too sharply for its width, or a margin beyond that.

    Source: Génevaux et al. 2015, section 4.2, doi:10.1111/cgf.12530.
    """
    if not images:
        raise ValueError("no raster is linked; link at least one to lay along the curve")
    arcs = smooth_curve(np.array(points, np.float64).reshape(-1, 2))
    sharpest = max(arcs, key=lambda arc: abs(arc.curvature))
    if abs(sharpest.curvature) * width > SHARPEST:
        radius = 1 / abs(sharpest.curvature)
        raise ValueError(
            f"the curve bends with a radius of {radius:.4g} m at ({sharpest.x:.6g}, {sharpest.y:.6g}), too sharply for "
            f"a width of {width:g} m; smooth the line, or lower the width below {SHARPEST * radius:.4g} m"
        )
    margin = 0.5 * width if margin is None else margin
    if margin > width:
        raise ValueError(f"a margin of {margin:g} m is wider than the strip; at most {width:g} m are possible")
    pictures, natural = [], []
    for image in images:
        if np.isnan(image.data).any():
            raise ValueError("a raster along a curve must not have voids; link it through terrain.fill_voids")
        pictures.append(Picture(known(image.data, None)[0], None, interpolation))
        natural.append(2 * width * image.extent.width / image.extent.height)
    spans = _laid(natural, arcs[-1].end, overlap, fit)
    shared = overlap * min(span.end - span.start for span in spans)
    return ImageCurve(
        tuple(pictures), np.array(arcs, np.float64), np.array(spans, np.float64), width, margin, shared, scale, rise,
        fall_off,
    )  # fmt: skip


def _laid(natural: list[float], length: float, overlap: float, fit: Fit) -> list[Span]:
    """Return the spans of rasters along a curve, given their lengths when undistorted."""

    def total(count: int) -> float:
        lengths = [natural[index % len(natural)] for index in range(count)]
        return sum(lengths) - (count - 1) * overlap * min(lengths)

    count = len(natural)
    if fit == "repeat":
        if length / min(natural) > 1e5:
            raise ValueError(f"{length / min(natural):.3g} rasters would follow one another; widen the strip")
        count = 1
        # A factor f and 1 / f distort alike.
        while total(count + 1) * total(count) < length**2:
            count += 1
    factor = length / total(count)
    lengths = [factor * natural[index % len(natural)] for index in range(count)]
    shared, start, spans = overlap * min(lengths), 0.0, []
    for index, own in enumerate(lengths):
        spans.append(Span(index % len(natural), start, start + own))
        start += own - shared
    return spans
