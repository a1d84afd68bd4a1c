"""Cutting a part out of a grid."""

from __future__ import annotations

from math import ceil
from typing import Annotated, TypeVar

from nodegraph import Forecast, Param, node, whole
from nodegraph_terrain.forecasts import outline
from nodegraph_terrain.raster import Extent, Grid

T = TypeVar("T", bound=Grid)


@node(version=1, locality=whole)
def crop(
    surface: T,
    like: Grid | None = None,
    *,
    extent: Annotated[
        tuple[float, float, float, float] | None,
        Param("Edges (west, south, east, north) of the part to keep, in the units and system of the raster."),
    ] = None,
    rows: Annotated[
        tuple[int, int] | None, Param("First row to keep and the one after the last; negative ones count from the end.")
    ] = None,
    columns: Annotated[
        tuple[int, int] | None, Param("First column to keep and the one after the last; negative: from the end.")
    ] = None,
) -> T:
    """Keep a part of a raster, labels or an image, cut along cell edges.

    The part is the extent of the grid linked to `like`, or the stated `extent`, or a window of `rows` and `columns`
    counted from the north-west corner (``rows: [4, -4]`` cuts four rows off either side).  Of an extent the cells are
    kept whose centres lie in it; what lies beyond the raster is ignored.  Values do not change.

    Raises:
        ValueError: none or several of these are given, the part is empty, or `like` has another coordinate system.
    """
    window = rows is not None or columns is not None
    if (like is not None) + (extent is not None) + window != 1:
        raise ValueError("give one of: the input like, the parameter extent, or rows and columns")
    if like is not None and (like.extent.crs, like.extent.unit) != (surface.extent.crs, surface.extent.unit):
        raise ValueError("the grid linked to like has another coordinate system; reproject it first")
    bounds = like.extent if like is not None else _extent(extent, surface.extent)
    kept_rows, kept_columns = _window(surface.shape, surface.extent, bounds, rows, columns)
    part = surface.window(kept_rows, kept_columns)
    # A copy: a view would keep the whole raster in memory.
    return part if part.shape == surface.shape else part.like(part.data.copy())


@crop.forecast
def _forecast(
    surface: Forecast,
    like: Forecast | None,
    *,
    extent: tuple[float, float, float, float] | None,
    rows: tuple[int, int] | None,
    columns: tuple[int, int] | None,
) -> Forecast:
    known, other = outline(surface), outline(like) if like is not None else None
    if known is None:
        return surface
    try:
        bounds = other.extent if other is not None else _extent(extent, known.extent)
        kept_rows, kept_columns = _window((known.rows, known.cols), known.extent, bounds, rows, columns)
    except ValueError:
        return surface
    cell_bytes = max(1, surface.bytes // (known.rows * known.cols))
    return known.window(kept_rows, kept_columns).forecast(cell_bytes=cell_bytes)


def _extent(edges: tuple[float, float, float, float] | None, own: Extent) -> Extent | None:
    return None if edges is None else Extent(*edges, own.crs, own.unit)


def _window(
    shape: tuple[int, int],
    own: Extent,
    bounds: Extent | None,
    rows: tuple[int, int] | None,
    columns: tuple[int, int] | None,
) -> tuple[slice, slice]:
    """Return the ranges of rows and columns to keep, neither of them empty."""
    if bounds is None:
        row_range = slice(*rows).indices(shape[0])[:2] if rows else (0, shape[0])
        column_range = slice(*columns).indices(shape[1])[:2] if columns else (0, shape[1])
    else:
        dx, dy = own.width / shape[1], own.height / shape[0]
        row_range = _inside((own.north - bounds.north) / dy, (own.north - bounds.south) / dy, shape[0])
        column_range = _inside((bounds.west - own.west) / dx, (bounds.east - own.west) / dx, shape[1])
    if row_range[0] >= row_range[1] or column_range[0] >= column_range[1]:
        raise ValueError(
            f"nothing is left of the raster of {shape[0]} x {shape[1]} cells from {own.west:g}, {own.south:g} to "
            f"{own.east:g}, {own.north:g}; choose a part that meets it"
        )
    return slice(*row_range), slice(*column_range)


def _inside(start: float, stop: float, count: int) -> tuple[int, int]:
    """Return the range of cells whose centres lie between two positions, in cells from the first edge."""
    # An edge through a centre, up to rounding, keeps the cell at the start and leaves it at the stop.
    return max(0, ceil(start - 0.5 - 1e-6)), min(count, ceil(stop - 0.5 - 1e-6))
