"""Rasters: values on a north-up grid of cells, with a role, a unit and a georeference.

Row 0 is the northern row.  `extent` gives the outer edges of the outer cells, so a raster of shape (rows, cols) has
cells of ``(east - west) / cols`` by ``(north - south) / rows``.  A void (no value known) is NaN.
"""

from __future__ import annotations

from dataclasses import replace
from math import cos, isfinite, radians
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from nodegraph import port_type


@port_type
class Extent:
    """The rectangle a raster covers, edge to edge.

    Attributes:
        west, south, east, north: outer edges of the outer cells, in `unit`; east > west, north > south.
        crs: coordinate reference system as ``EPSG:n`` or WKT; empty where none is known.
        unit: ``m`` for projected (or unreferenced) coordinates, ``deg`` for geographic ones.
    """

    west: float
    south: float
    east: float
    north: float
    crs: str = ""
    unit: str = "m"

    def __post_init__(self) -> None:
        edges = (self.west, self.south, self.east, self.north)
        if not all(isfinite(edge) for edge in edges) or self.east <= self.west or self.north <= self.south:
            raise ValueError(f"extent {edges} must be finite with east > west and north > south")
        if self.unit not in ("m", "deg"):
            raise ValueError(f"extent unit '{self.unit}' must be 'm' or 'deg'")

    @property
    def width(self) -> float:
        """East minus west, in `unit`."""
        return self.east - self.west

    @property
    def height(self) -> float:
        """North minus south, in `unit`."""
        return self.north - self.south


@port_type
class Grid:
    """Anything on a north-up grid: the base of rasters, labels and images.

    Attributes:
        data: the cells, first axis south-going rows, second axis east-going columns.
        extent: what the grid covers.
    """

    data: npt.NDArray[Any]
    extent: Extent

    dtype: ClassVar[np.dtype[Any]] = np.dtype(np.float32)
    unit: ClassVar[str] = ""
    axes: ClassVar[int] = 2

    def __post_init__(self) -> None:
        if isinstance(self.data, np.ndarray) and self.data.dtype != self.dtype:
            object.__setattr__(self, "data", self.data.astype(self.dtype))
        if len(self.data.shape) != self.axes or 0 in self.data.shape:
            raise ValueError(
                f"{type(self).__name__} data of shape {self.data.shape} must have {self.axes} non-empty axes"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return int(self.data.shape[0]), int(self.data.shape[1])

    @property
    def cell_size(self) -> tuple[float, float]:
        """(width, height) of a cell, in the unit of the extent."""
        return self.extent.width / self.shape[1], self.extent.height / self.shape[0]

    def like(self, data: npt.NDArray[Any]) -> Self:
        """Return the same kind of grid with other cells of the same shape."""
        return replace(self, data=data)

    def window(self, rows: slice, cols: slice) -> Self:
        """Return the part given by row and column ranges (step 1), with its own extent; shares memory."""
        r0, r1, _ = rows.indices(self.shape[0])
        c0, c1, _ = cols.indices(self.shape[1])
        dx, dy = self.cell_size
        extent = replace(
            self.extent,
            west=self.extent.west + c0 * dx,
            east=self.extent.west + c1 * dx,
            north=self.extent.north - r0 * dy,
            south=self.extent.north - r1 * dy,
        )
        return replace(self, data=self.data[r0:r1, c0:c1], extent=extent)


@port_type
class Raster(Grid):
    """One float32 value per cell, of no particular role.  NaN is a void."""

    bounds: ClassVar[tuple[float, float] | None] = None

    def bounded(self, data: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return `data` clamped to the values that this role can have; what interpolates with overshoot calls it."""
        return data if self.bounds is None else np.clip(data, *self.bounds)


@port_type
class Elevation(Raster):
    """Height of the ground above sea level, m."""

    unit: ClassVar[str] = "m"


@port_type
class Mask(Raster):
    """How much a cell belongs, 0 to 1."""

    unit: ClassVar[str] = "1"
    bounds: ClassVar[tuple[float, float] | None] = (0.0, 1.0)


@port_type
class Slope(Raster):
    """Steepness of the ground, degrees from the horizontal, 0 to 90."""

    unit: ClassVar[str] = "deg"
    bounds: ClassVar[tuple[float, float] | None] = (0.0, 90.0)


@port_type
class Shade(Raster):
    """Illumination of the ground, 0 (dark) to 1 (facing the light)."""

    unit: ClassVar[str] = "1"
    bounds: ClassVar[tuple[float, float] | None] = (0.0, 1.0)


@port_type
class Labels(Grid):
    """A class number per cell, int32; negative is none."""

    dtype: ClassVar[np.dtype[Any]] = np.dtype(np.int32)


@port_type
class Image(Grid):
    """A colour picture, (rows, columns, 3 or 4) uint8 sRGB with optional straight alpha."""

    dtype: ClassVar[np.dtype[Any]] = np.dtype(np.uint8)
    axes: ClassVar[int] = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.data.shape[2] not in (3, 4):
            raise ValueError(f"image data of shape {self.data.shape} must have 3 or 4 channels")


@port_type
class Normals(Grid):
    """Upward unit normals of the ground, (rows, columns, 3) float32: east, north, up; NaN is a void."""

    axes: ClassVar[int] = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.data.shape[2] != 3:
            raise ValueError(f"normals of shape {self.data.shape} must have 3 components")


GRIDS: tuple[type[Grid], ...] = (Grid, Raster, Elevation, Mask, Slope, Shade, Labels, Image, Normals)
"""Every grid type of this plugin."""


def ground_cell(grid: Grid) -> tuple[float, float]:
    """Return the sides of a cell in ground proportions: in degrees, the width shrinks with the middle latitude."""
    dx, dy = grid.cell_size
    if grid.extent.unit == "deg":
        middle = (grid.extent.south + grid.extent.north) / 2
        dx *= max(cos(radians(middle)), 1e-3)
    return dx, dy


def require_metres(grid: Grid) -> float:
    """Return the side of a cell in metres, the mean of width and height.

    Raises:
        ValueError: the grid is in degrees, or its cells are not square within 1 %.
    """
    if grid.extent.unit != "m":
        raise ValueError("the raster is in degrees; link it through terrain.reproject to get metres")
    dx, dy = grid.cell_size
    if abs(dx - dy) > 0.01 * max(dx, dy):
        raise ValueError(
            f"the cells are {dx:g} m by {dy:g} m; link the raster through terrain.reproject to make them square"
        )
    return (dx + dy) / 2


def require_same_grid(first: Grid, *others: Grid) -> None:
    """Raise `ValueError` unless all grids have the same shape and, within a thousandth of a cell, the same extent."""
    for other in others:
        if first.shape != other.shape:
            raise ValueError(
                f"rasters of shape {first.shape} and {other.shape} do not match; resample one to the other"
            )
        dx, dy = first.cell_size
        a, b = first.extent, other.extent
        offset = max(
            abs(a.west - b.west) / dx,
            abs(a.east - b.east) / dx,
            abs(a.north - b.north) / dy,
            abs(a.south - b.south) / dy,
        )
        if offset > 1e-3 or (a.crs and b.crs and a.crs != b.crs):
            raise ValueError("the rasters cover different extents or systems; reproject or crop one to the other")
