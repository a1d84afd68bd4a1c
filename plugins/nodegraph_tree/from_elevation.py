"""A raster as a primitive, on the ground that it covers: the bridge from grids to construction trees (section 4.2)."""

from __future__ import annotations

from functools import cached_property
from math import hypot
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from nodegraph import Param, node, port_type
from nodegraph_terrain.raster import Elevation, Mask
from nodegraph_tree.border import Border
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.falloff import FallOff
from nodegraph_tree.function import ABSENT, Bounds, Box, ElevationFunction, Points, Sample, empty_sample
from nodegraph_tree.images import Picture, masked
from nodegraph_tree.pixels import Pyramid, known

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

Interpolation = Literal["bilinear", "bicubic"]

_GRID = Kernel("tree_image_grid", FOLDER / "image.cl")


@port_type
class ImageGrid(ElevationFunction):
    """A raster, north up: f(p) = scale * picture(p) + rise, alpha(p) = mask(p) * border(p).

    Attributes:
        picture: the raster and its mask.
        west, south, east, north: outer edges, m.
        margin: over which the weight falls to 0 at the edges, m.
        scale, rise: of the heights, and m.
        fall_off: how the weight falls.
    """

    picture: Picture
    west: float
    south: float
    east: float
    north: float
    margin: float
    scale: float = 1.0
    rise: float = 0.0
    fall_off: FallOff = "cubic"

    @property
    def support(self) -> Box:
        """The extent of the raster."""
        return Box(self.west, self.south, self.east, self.north)

    @cached_property
    def _border(self) -> Border:
        edges = ((1.0, 0.0, self.west), (-1.0, 0.0, -self.east), (0.0, 1.0, self.south), (0.0, -1.0, -self.north))
        return Border(edges, self.margin, self.fall_off)

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Return the interpolated raster, asked only inside its extent."""
        whole = self._border.query(points.x, points.y)
        inside = whole.weight > 0
        found = empty_sample(points, gradient=gradient)
        if not inside.any():
            return found
        wide, high = self.east - self.west, self.north - self.south
        look = self.picture.look((points.x[inside] - self.west) / wide, (self.north - points.y[inside]) / high)
        zero = np.zeros(look.height.value.shape)
        weighed = masked(
            type(whole)(*(item[inside] for item in whole)), look.mask, (zero + 1 / wide, zero), (zero, zero - 1 / high)
        )
        height, weight = found.height.copy(), found.weight.copy()
        height[inside] = self.scale * look.height.value + self.rise
        weight[inside] = weighed.weight
        if not gradient:
            return Sample(height, weight)
        slope, fade = np.zeros((2, *points.x.shape)), np.zeros((2, *points.x.shape))
        slope[:, inside] = self.scale * look.height.along / wide, -self.scale * look.height.down / high
        fade[:, inside] = weighed.east, weighed.north
        return Sample(height, weight, slope, fade)

    @cached_property
    def _pyramids(self) -> tuple[Pyramid, Pyramid | None]:
        """Of heights and mask, with slopes in metres."""
        found: list[Pyramid] = []
        for pixels in (self.picture.pixels, self.picture.weights):
            if pixels is None:
                return found[0], None
            dx, dy = (self.east - self.west) / pixels.cols, (self.north - self.south) / pixels.rows
            cells = pixels.cells()
            found.append(Pyramid(cells.low, cells.high, np.hypot(cells.along / dx, cells.down / dy)))
        return found[0], found[1]

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:  # noqa: ARG002
        """Bound the cells that the box touches, and the weight by mask and border.

        |grad (m b)| <= m |grad b| + b |grad m|.
        """
        part = box.intersection(self.support)
        if part.empty:
            return ABSENT
        around = self._border.bounds(part)
        heights, mask = self._pyramids
        found = heights.over(*self._cells(part, self.picture.pixels.cols, self.picture.pixels.rows))
        found = self.picture.narrowed(
            found,
            (0.5 * (part.west + part.east) - self.west) / (self.east - self.west),
            (self.north - 0.5 * (part.south + part.north)) / (self.north - self.south),
            0.5 * hypot(part.east - part.west, part.north - part.south),
        )
        low, high, fade = around
        if mask is not None and self.picture.weights is not None:
            own = mask.over(*self._cells(part, self.picture.weights.cols, self.picture.weights.rows))
            fade = own.high * around.slope + around.high * own.slope
            low, high = max(low * own.low, 0.0), high * own.high
        if high <= 0:
            return ABSENT
        ends = (self.scale * found.low + self.rise, self.scale * found.high + self.rise)
        slope = abs(self.scale) * found.slope
        return Bounds(min(ends), max(ends), low, high, slope, fade, high * slope, slope)

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Emit where the tile's origin lies on the raster."""
        edges = self._border.device(frame)
        if edges is None:
            emitter.nothing()
            return
        wide, high = self.east - self.west, self.north - self.south
        floats, ints = self.picture.device(
            emitter, (frame.ox - self.west) / wide, (self.north - frame.oy) / high, 1 / wide, 1 / high
        )
        emitter.add(_GRID, [self.scale, self.rise, *floats, *edges[0]], [*ints, *edges[1]])

    def _cells(self, box: Box, cols: int, rows: int) -> tuple[float, float, float, float]:
        across, down = cols / (self.east - self.west), rows / (self.north - self.south)
        return (
            (box.west - self.west) * across - 0.5,
            (box.east - self.west) * across - 0.5,
            (self.north - box.north) * down - 0.5,
            (self.north - box.south) * down - 0.5,
        )


@node(version=1)
def from_elevation(
    surface: Elevation,
    mask: Mask | None = None,
    *,
    interpolation: Annotated[
        Interpolation, Param("bilinear, or bicubic: smooth (C1), but may overshoot the cells.")
    ] = "bilinear",
    margin: Annotated[
        float, Param("Where the weight falls to 0 at edges and voids; 0: as narrow as can be.", ge=0, unit="m")
    ] = 0.0,
    scale: Annotated[float, Param("What heights are multiplied by.")] = 1.0,
    rise: Annotated[float, Param("What is added to the heights then.", unit="m")] = 0.0,
    fall_off: Annotated[FallOff, Param("How the weight falls over the margin.")] = "cubic",
) -> ElevationFunction:
    """Make a primitive of a raster, where it lies.

    f interpolates between the centres of the cells, through all of them: ``bilinear`` (C0) or
    ``bicubic`` (Catmull-Rom, C1); beyond the outer centres they go on in a
    straight line.  alpha is 1 inside and falls to 0 at the edges and towards voids, times `mask` where
    one is linked (smoothed by a cubic B-spline).  Without a margin the weight falls over half a cell at the edges and
    a cell at voids: sampling at the raster's own cell centres then returns it, voids included.

    Args:
        surface: in metres.
        mask: weight, 0 to 1, over the same extent; of any shape if there are no voids.
        interpolation: between cells.
        margin: at least half a cell; at most half the narrower side.
        scale: of heights.
        rise: added to heights.
        fall_off: of the weight over the margin.

    Raises:
        ValueError: the raster is in degrees, void everywhere, or infinite; the mask covers another extent; the margin
            is wider than half the raster.

    Source: Génevaux et al. 2015, section 4.2, doi:10.1111/cgf.12530.
    """
    extent = surface.extent
    if extent.unit != "m":
        raise ValueError("the raster is in degrees; link it through terrain.reproject to get metres")
    if mask is not None:
        require_same_extent(surface, mask)
    dx, dy = surface.cell_size
    if margin > 0.5 * min(extent.width, extent.height):
        raise ValueError(
            f"a margin of {margin:g} m leaves nothing of a raster {extent.width:g} m by {extent.height:g} m; "
            f"{0.5 * min(extent.width, extent.height):g} m are possible"
        )
    cells = margin / hypot(dx, dy) * 2**0.5
    void = bool(np.isnan(surface.data).any())
    heights, weights = known(surface.data, None if mask is None else mask.data, cells)
    # Where voids have sharp edges the mask passes through its values, so that known cells next to one stay terrain.
    smooth = void and mask is None and cells < 2
    picture = Picture(heights, weights, interpolation, "smooth" if smooth else "spline")
    return ImageGrid(
        picture, extent.west, extent.south, extent.east, extent.north, max(margin, 0.5 * min(dx, dy)), scale, rise,
        fall_off,
    )  # fmt: skip


def require_same_extent(surface: Elevation, mask: Mask) -> None:
    """Raise `ValueError` unless a mask covers the ground that an elevation covers, within a thousandth of a cell."""
    a, b = surface.extent, mask.extent
    dx, dy = surface.cell_size
    apart = max(abs(a.west - b.west) / dx, abs(a.east - b.east) / dx)
    apart = max(apart, abs(a.south - b.south) / dy, abs(a.north - b.north) / dy)
    if apart > 1e-3:
        raise ValueError("the mask covers another extent than the elevation; crop or reproject one to the other")
