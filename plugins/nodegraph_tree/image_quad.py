"""A raster stretched over a convex quadrangle (section 4.2).

The place of (u, v), u from the raster's west to its east and v from its north to its south, is bilinear in the corners,

    p = a + u e + v f + u v g,   e = b - a,  f = d - a,  g = a - b + c - d,

for the corners a, b, c, d of its north-west, north-east, south-east and south-west.  With h = p - a and x the cross
product, v solves k0 + k1 v + k2 v^2 = 0 with k0 = h x e, k1 = e x f + h x g, k2 = g x f.  Its derivative at the
solution is the determinant J(u, v) of (dp/du, dp/dv), of one sign s all over a convex quadrangle, so the root is

    v = -2 s k0 / (s k1 + sqrt(k1^2 - 4 k0 k2)),

whose denominator is 2 |J(u, 0)|: never near 0, also where the quadrangle is a parallelogram (k2 = 0) or nearly one.

**What a box can hold.**  A line of constant u or v is straight on the ground, so over the convex part of a box inside
the quadrangle u and v are extreme at its corners.  A gradient grows by at most the largest singular value of the
inverse Jacobian, sigma_max(J) / |det J|; over a cell sigma_max is convex and det linear along u and v, so that both are
extreme at the cell's corners.  This is done for each cell of the raster, once.
"""

from __future__ import annotations

from functools import cached_property
from math import hypot, isfinite
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from nodegraph import Param, node, port_type
from nodegraph_terrain.raster import Elevation, Mask
from nodegraph_tree.border import Border, Weighed
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.falloff import FallOff
from nodegraph_tree.from_elevation import Interpolation
from nodegraph_tree.function import ABSENT, Bounds, Box, ElevationFunction, Floats, Points, Sample, empty_sample
from nodegraph_tree.images import Picture, masked
from nodegraph_tree.pixels import Pixels, Pyramid, known

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

Corner = tuple[float, float]

_QUAD = Kernel("tree_image_quad", FOLDER / "image.cl")

SLIMMEST = 1e-4
"""Least J at a corner over the square of the longest side or diagonal: slimmer is refused."""


@port_type
class ImageQuad(ElevationFunction):
    """A raster on a quadrangle: f(p) = scale * picture(u, v) + rise, alpha(p) = mask(u, v) * border(p).

    Attributes:
        picture: the raster and its mask.
        corners: where its north-west, north-east, south-east and south-west corners lie, m; convex, in either sense
            (one
            of them mirrors the raster).
        margin: over which the weight falls to 0 at the sides, m.
        scale, rise: of the heights, and m.
        fall_off: how the weight falls.
    """

    picture: Picture
    corners: tuple[Corner, Corner, Corner, Corner]
    margin: float
    scale: float = 1.0
    rise: float = 0.0
    fall_off: FallOff = "cubic"

    @cached_property
    def support(self) -> Box:
        """Around the corners."""
        xs, ys = zip(*self.corners, strict=True)
        return Box(min(xs), min(ys), max(xs), max(ys))

    @cached_property
    def _border(self) -> Border:
        return Border.around(self.corners, self.margin, self.fall_off)

    @cached_property
    def _sides(self) -> tuple[Corner, Corner, Corner]:
        (ax, ay), (bx, by), (cx, cy), (dx, dy) = self.corners
        return (bx - ax, by - ay), (dx - ax, dy - ay), (ax - bx + cx - dx, ay - by + cy - dy)

    @cached_property
    def _sense(self) -> float:
        (ex, ey), (fx, fy), _ = self._sides
        return 1.0 if ex * fy - ey * fx > 0 else -1.0

    def place(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return (u, v) of points; those outside the quadrangle get some place in the unit square."""
        (ex, ey), (fx, fy), (gx, gy) = self._sides
        hx, hy = x - self.corners[0][0], y - self.corners[0][1]
        s = self._sense
        k0, k1 = s * (hx * ey - hy * ex), s * (ex * fy - ey * fx + hx * gy - hy * gx)
        k2 = s * (gx * fy - gy * fx)
        root = np.sqrt(np.maximum(k1 * k1 - 4 * k0 * k2, 0.0))
        v = np.clip(-2 * k0 / np.maximum(k1 + root, 1e-300), 0.0, 1.0)
        wx, wy = ex + v * gx, ey + v * gy
        u = ((hx - v * fx) * wx + (hy - v * fy) * wy) / (wx * wx + wy * wy)
        return np.clip(u, 0.0, 1.0), v

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Return the raster at the places of the points; gradients by the inverse of the Jacobian."""
        whole = self._border.query(points.x, points.y)
        inside = whole.weight > 0
        found = empty_sample(points, gradient=gradient)
        if not inside.any():
            return found
        u, v = self.place(points.x[inside], points.y[inside])
        (ex, ey), (fx, fy), (gx, gy) = self._sides
        ux, uy, vx, vy = ex + v * gx, ey + v * gy, fx + u * gx, fy + u * gy
        area = ux * vy - uy * vx
        east, north = (vy / area, -uy / area), (-vx / area, ux / area)
        look = self.picture.look(u, v)
        weighed = masked(Weighed(*(item[inside] for item in whole)), look.mask, east, north)
        height, weight = found.height.copy(), found.weight.copy()
        height[inside] = self.scale * look.height.value + self.rise
        weight[inside] = weighed.weight
        if not gradient:
            return Sample(height, weight)
        slope, fade = np.zeros((2, *points.x.shape)), np.zeros((2, *points.x.shape))
        along, down = self.scale * look.height.along, self.scale * look.height.down
        slope[:, inside] = along * east[0] + down * east[1], along * north[0] + down * north[1]
        fade[:, inside] = weighed.east, weighed.north
        return Sample(height, weight, slope, fade)

    @cached_property
    def _pyramids(self) -> tuple[Pyramid, Pyramid | None]:
        """Of heights and mask, with slopes on the ground: see the module."""
        heights = self._on_ground(self.picture.pixels)
        return heights, None if self.picture.weights is None else self._on_ground(self.picture.weights)

    def _on_ground(self, pixels: Pixels) -> Pyramid:
        cells = pixels.cells()
        (ex, ey), (fx, fy), (gx, gy) = self._sides
        # Edges of the cells between centres, cut to the raster.
        u = (np.clip(np.arange(-1, pixels.cols + 1.0), -0.5, pixels.cols - 0.5) + 0.5) / pixels.cols
        v = (np.clip(np.arange(-1, pixels.rows + 1.0), -0.5, pixels.rows - 0.5) + 0.5)[:, None] / pixels.rows
        ux, uy = (ex + v * gx) / pixels.cols, (ey + v * gy) / pixels.cols
        vx, vy = (fx + u * gx) / pixels.rows, (fy + u * gy) / pixels.rows
        area = np.abs(ux * vy - uy * vx)
        # Derivatives are weighed as metres along sides of the mean length, so that oblong cells do not count as
        # stretch.
        wide = np.sqrt(np.mean(ux**2 + uy**2))
        high = np.sqrt(np.mean(vx**2 + vy**2))
        p, q, r, t = ux / wide, vx / high, uy / wide, vy / high
        largest = 0.5 * (np.hypot(p + t, q - r) + np.hypot(p - t, q + r))
        stretch = _corners(largest, np.maximum) * (wide * high) / _corners(area, np.minimum)
        return Pyramid(cells.low, cells.high, np.hypot(cells.along / wide, cells.down / high) * stretch)

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:  # noqa: ARG002
        """Bound the cells in the part of the box on the quadrangle, and the weight by mask and border."""
        part = _cut(box.intersection(self.support), self._border.edges)
        if not part:
            return ABSENT
        corners = np.array(part)
        u, v = self.place(corners[:, 0], corners[:, 1])
        xs, ys = corners.T
        around = self._border.bounds(Box(float(xs.min()), float(ys.min()), float(xs.max()), float(ys.max())))
        heights, mask = self._pyramids
        found = heights.over(*_cells(u, v, self.picture.pixels))
        middle = corners.mean(axis=0, keepdims=True)
        mu, mv = self.place(middle[:, 0], middle[:, 1])
        found = self.picture.narrowed(found, float(mu[0]), float(mv[0]), float(np.hypot(*(corners - middle).T).max()))
        low, high, fade = around
        if mask is not None and self.picture.weights is not None:
            own = mask.over(*_cells(u, v, self.picture.weights))
            fade = own.high * around.slope + around.high * own.slope
            low, high = max(low * own.low, 0.0), high * own.high
        if high <= 0:
            return ABSENT
        if not self._holds(box):
            low = 0.0
        ends = (self.scale * found.low + self.rise, self.scale * found.high + self.rise)
        slope = abs(self.scale) * found.slope
        return Bounds(min(ends), max(ends), low, high, slope, fade, high * slope, slope)

    def _holds(self, box: Box) -> bool:
        return all(map(isfinite, box)) and all(
            east * x + north * y >= offset
            for east, north, offset in self._border.edges
            for x in (box.west, box.east)
            for y in (box.south, box.north)
        )

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Emit the map around the place of the tile's middle: there all that the device computes is small."""
        edges = self._border.device(frame)
        if edges is None:
            emitter.nothing()
            return
        middle = frame.box.intersection(self.support)
        u, v = (
            float(item[0])
            for item in self.place(
                np.array([0.5 * (middle.west + middle.east)]), np.array([0.5 * (middle.south + middle.north)])
            )
        )
        rows, cols = self.picture.shape
        (ex, ey), (fx, fy), (gx, gy) = self._sides
        ax, ay = self.corners[0]
        here = (ax + u * ex + v * fx + u * v * gx - frame.ox, ay + u * ey + v * fy + u * v * gy - frame.oy)
        floats, ints = self.picture.device(emitter, u, v, 1 / cols, 1 / rows)
        geometry = [
            *here,
            (ex + v * gx) / cols, (ey + v * gy) / cols,
            (fx + u * gx) / rows, (fy + u * gy) / rows,
            gx / (cols * rows), gy / (cols * rows),
            self._sense, -v * rows, (1 - v) * rows,
        ]  # fmt: skip
        emitter.add(_QUAD, [*geometry, self.scale, self.rise, *floats, *edges[0]], [*ints, *edges[1]])


def _cells(u: Floats, v: Floats, pixels: Pixels) -> tuple[float, float, float, float]:
    return (
        float(u.min()) * pixels.cols - 0.5,
        float(u.max()) * pixels.cols - 0.5,
        float(v.min()) * pixels.rows - 0.5,
        float(v.max()) * pixels.rows - 0.5,
    )


def _corners(grid: Floats, join: Any) -> Floats:
    return np.asarray(join(join(grid[:-1, :-1], grid[1:, :-1]), join(grid[:-1, 1:], grid[1:, 1:])))


def _cut(box: Box, edges: tuple[tuple[float, float, float], ...]) -> list[Corner]:
    """Return the corners of the part of a box that lies inside all edges (Sutherland and Hodgman 1974)."""
    if box.empty:
        return []
    polygon = [(box.west, box.south), (box.east, box.south), (box.east, box.north), (box.west, box.north)]
    for east, north, offset in edges:
        inside = [east * x + north * y - offset for x, y in polygon]
        kept: list[Corner] = []
        for index, here in enumerate(inside):
            before, last = inside[index - 1], polygon[index - 1]
            point = polygon[index]
            if (here >= 0) != (before >= 0):
                t = before / (before - here)
                kept.append((last[0] + t * (point[0] - last[0]), last[1] + t * (point[1] - last[1])))
            if here >= 0:
                kept.append(point)
        polygon = kept
        if not polygon:
            return []
    return polygon


def check_corners(corners: tuple[Corner, ...]) -> None:
    """Raise `ValueError` unless four corners are a convex quadrangle that is not too slim to map onto."""
    if not all(isfinite(value) for corner in corners for value in corner):
        raise ValueError("the corners must be finite numbers of metres")
    turns = []
    for index, (x, y) in enumerate(corners):
        (px, py), (nx, ny) = corners[index - 1], corners[(index + 1) % 4]
        turns.append((x - px) * (ny - y) - (y - py) * (nx - x))
    longest = max(hypot(ax - bx, ay - by) for ax, ay in corners for bx, by in corners)
    if longest == 0 or min(map(abs, turns)) < SLIMMEST * longest**2:
        raise ValueError("the quadrangle is degenerate: three of its corners lie on a line; move them apart")
    if min(turns) < 0 < max(turns):
        raise ValueError(
            "the quadrangle is concave or crosses itself; give convex corners in order: north-west, north-east, "
            "south-east, south-west of the raster"
        )


@node(version=1)
def image_quad(
    surface: Elevation,
    mask: Mask | None = None,
    *,
    corners: Annotated[
        tuple[Corner, Corner, Corner, Corner],
        Param("Where the raster's north-west, north-east, south-east and south-west corners go.", unit="m"),
    ],
    interpolation: Annotated[
        Interpolation, Param("bilinear, or bicubic: smooth (C1), but may overshoot the cells.")
    ] = "bicubic",
    margin: Annotated[
        float | None, Param("Where the weight falls to 0 at the sides; none: a fifth of the shortest.", gt=0, unit="m")
    ] = None,
    scale: Annotated[float, Param("What heights are multiplied by.")] = 1.0,
    rise: Annotated[float, Param("What is added to the heights then.", unit="m")] = 0.0,
    fall_off: Annotated[FallOff, Param("How the weight falls over the margin.")] = "cubic",
) -> ElevationFunction:
    """Stretch a raster over a convex quadrangle: real ground, or ground drawn by hand, as a primitive.

    The raster's outer edges go to the sides of the quadrangle, and what lies between is bilinear; its own georeference
    does not matter.  Heights are interpolated between centres, through all cells: ``bilinear`` (C0) or ``bicubic``
    (Catmull-Rom, C1); beyond the outer centres they go on in a straight line.  alpha is C1: the product over the sides
    of g(1 - distance / margin), times `mask` (smoothed by a cubic B-spline) where one is linked, and 0 at voids.

    Args:
        surface: heights in metres.
        mask: weight, 0 to 1, over the same square; of any shape if there are no voids.
        corners: in order around the quadrangle; the other way round mirrors the raster.
        interpolation: between cells.
        margin: width of the fall-off along the sides.
        scale: of heights.
        rise: added to heights.
        fall_off: g.

    Raises:
        ValueError: the quadrangle is concave, crosses itself or is degenerate; the raster is void everywhere.

    Source: Génevaux et al. 2015, section 4.2, doi:10.1111/cgf.12530.
    """
    check_corners(corners)
    shortest = min(
        hypot(ax - bx, ay - by) for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True)
    )
    heights, weights = known(surface.data, None if mask is None else mask.data)
    picture = Picture(heights, weights, interpolation, "spline")
    return ImageQuad(picture, corners, margin or 0.2 * shortest, scale, rise, fall_off)
