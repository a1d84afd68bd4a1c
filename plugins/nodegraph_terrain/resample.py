"""Resampling to another grid in the same coordinate system."""

from __future__ import annotations

from math import floor
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.forecasts import Outline, check_cells, outline
from nodegraph_terrain.interpolation import REACH, spline_coefficients, without_voids
from nodegraph_terrain.raster import Extent, Grid, Raster

T = TypeVar("T", bound=Raster)
Method = Literal["bilinear", "cubic", "lanczos", "area"]


@node(version=1, locality=whole)
def resample(
    surface: T,
    like: Grid | None = None,
    *,
    cell_size: Annotated[float | None, Param("Side of the new cells, in the unit of the extent.", gt=0)] = None,
    rows: Annotated[int | None, Param("New number of rows, instead of a cell size.", ge=1)] = None,
    columns: Annotated[int | None, Param("New number of columns, instead of a cell size.", ge=1)] = None,
    factor: Annotated[
        float | None, Param("Rows and columns for one of before, instead: 4 is finer, 0.25 coarser.", gt=0)
    ] = None,
    method: Annotated[
        Method, Param("bilinear, cubic (B-spline) or lanczos for finer cells; area or lanczos for coarser ones.")
    ] = "cubic",
    context: Context,
) -> T:
    """Resample a raster to other cells over the same ground, in the same coordinate system.

    With `rows` and `columns` the extent stays as it is, and so it does with `like`, which has the same extent and as
    many rows and columns as are wanted.  With `cell_size` the new cells are squares of exactly that side, laid from the
    north-west corner, and with `factor` cells 1 / `factor` times as wide and high as before; what is left at the
    eastern and southern edge, less than a cell, is cut off.

    Values belong to cell centres.  Each method weighs the cells around a new centre along either axis, with weights
    that add up to one:

    - ``bilinear``: linear between the two nearest centres; constant beyond the outer ones.
    - ``cubic``: the interpolating cubic B-spline through all values (twice continuously differentiable), extended past
      the edge by point reflection, so that a plane stays a plane up to the edge.
    - ``lanczos``: sinc(x) sinc(x / 3) for |x| < 3, stretched with the cells where they become coarser; sharp, may
      overshoot.  Away from the edges the two middle weights are corrected so that a plane stays a plane; the plain
      ones let it ripple by up to 2 % of a cell's rise.
    - ``area``: the exact mean over the ground that the new cell covers; the mean of the raster is conserved.

    ``bilinear`` and ``cubic`` take values at points: for coarser cells ``area`` and ``lanczos`` avoid aliasing.  A new
    cell is void (NaN) where less than half of the weight falls on known cells, and else uses the known ones only.
    Masks, shades and slopes are clamped to the range of their role.

    Raises:
        ValueError: the new cells are not stated, stated twice or larger than the raster, or `like` covers another
            extent.

    References: Unser 1999, Splines: a perfect fit for signal and image processing, doi:10.1109/79.799930.
    Duchon 1979, Lanczos filtering in one and two dimensions, doi:10.1175/1520-0450(1979)018<1016:LFIOAT>2.0.CO;2.
    """
    grid = None if like is None else Outline(*like.shape, like.extent)
    new = _target(Outline(*surface.shape, surface.extent), grid, cell_size, rows, columns, factor)
    check_cells(new.rows, new.cols)
    # Where the new extent ends, in cells of the old grid.
    span_y = surface.shape[0] * new.extent.height / surface.extent.height
    span_x = surface.shape[1] * new.extent.width / surface.extent.width
    down = weights(surface.shape[0], new.rows, span_y, method)
    across = weights(surface.shape[1], new.cols, span_x, method)
    missing = np.isnan(surface.data)
    voids = bool(missing.any())
    values = without_voids(surface.data, missing) if voids and method == "cubic" else surface.data
    if method == "cubic":
        values = spline_coefficients(values)
    elif voids:
        values = np.where(missing, np.float32(0), values)
    share_down, share_across = (
        (
            weights(surface.shape[0], new.rows, span_y, "bilinear"),
            weights(surface.shape[1], new.cols, span_x, "bilinear"),
        )
        if method == "cubic"
        else (down, across)
    )
    result = np.empty((new.rows, new.cols), np.float32)
    # A block of new rows also passes over the old rows it needs, so both count for its size.
    ratio = max(1.0, surface.shape[0] / new.rows)
    for part in row_blocks(new.rows, int(max(new.cols, surface.shape[1]) * ratio), context, cells=1 << 21):
        block = _apply(down, across, values, part)
        if voids:
            share = _apply(share_down, share_across, ~missing, part)
            with np.errstate(divide="ignore", invalid="ignore"):
                if method != "cubic":
                    block /= share
            block[share < 0.5 - 1e-9] = np.nan
        result[part] = surface.bounded(block)
    return type(surface)(result, new.extent)


@resample.forecast
def _forecast(
    surface: Forecast,
    like: Forecast | None,
    *,
    cell_size: float | None,
    rows: int | None,
    columns: int | None,
    factor: float | None,
    **_: object,
) -> Forecast:
    known, grid = outline(surface), None if like is None else outline(like)
    if known is None or (like is not None and grid is None):
        return Forecast(surface.bytes, surface.bytes, None)
    try:
        new = _target(known, grid, cell_size, rows, columns, factor)
    except ValueError:
        return Forecast(0)
    predicted = new.forecast()
    return Forecast(predicted.bytes, known.rows * known.cols * 13 + (64 << 20), new)


def _target(
    old: Outline,
    like: Outline | None,
    cell_size: float | None,
    rows: int | None,
    columns: int | None,
    factor: float | None,
) -> Outline:
    """Return the new grid that the input or the parameters state."""
    extent = old.extent
    ways = [like is not None, cell_size is not None, rows is not None or columns is not None, factor is not None]
    if sum(ways) > 1:
        raise ValueError(
            "a grid to resample to, cell_size, factor, and rows and columns state the same thing; give one of them"
        )
    if like is not None:
        _require_same_ground(old, like)
        return Outline(like.rows, like.cols, extent)
    if rows is not None and columns is not None:
        return Outline(rows, columns, extent)
    if cell_size is not None:
        wide = high = cell_size
    elif factor is not None:
        wide, high = extent.width / old.cols / factor, extent.height / old.rows / factor
    else:
        raise ValueError("state either cell_size, factor, or rows and columns; or link the grid to resample to")
    # A remainder of a millionth of a cell is rounding, not ground.
    rows, columns = floor(extent.height / high + 1e-6), floor(extent.width / wide + 1e-6)
    if rows < 1 or columns < 1:
        unit = extent.unit
        raise ValueError(
            f"cells of {wide:g} x {high:g} {unit} are larger than the raster of {extent.width:g} x {extent.height:g} "
            f"{unit}; give smaller ones"
        )
    east, south = extent.west + columns * wide, extent.north - rows * high
    if factor is not None:  # nothing is cut off where only rounding is left
        east = extent.east if extent.east - east < 1e-6 * wide else east
        south = extent.south if south - extent.south < 1e-6 * high else south
    return Outline(rows, columns, Extent(extent.west, south, east, extent.north, extent.crs, extent.unit))


def _require_same_ground(old: Outline, like: Outline) -> None:
    """Raise `ValueError` unless both cover the same extent, within a thousandth of the smaller cells."""
    a, b = old.extent, like.extent
    dx, dy = a.width / max(old.cols, like.cols), a.height / max(old.rows, like.rows)
    apart = max(abs(a.west - b.west) / dx, abs(a.east - b.east) / dx)
    apart = max(apart, abs(a.south - b.south) / dy, abs(a.north - b.north) / dy)
    if apart > 1e-3 or a.unit != b.unit or (a.crs and b.crs and a.crs != b.crs):
        raise ValueError(
            "the grid to resample to covers another extent than the surface, or in another system; crop or reproject "
            "one to the other"
        )


def weights(old: int, new: int, span: float, method: Method) -> Any:
    """Return the (new, old) sparse matrix that resamples one axis.

    Args:
        old: number of cells.
        new: number of new cells.
        span: length that the new cells cover together from the start of the axis, in old cells.
        method: see `resample`; the columns of ``cubic`` are spline coefficients, extended by `REACH` at both ends.
    """
    from scipy import sparse

    scale = span / new
    if method == "area":
        edges = np.minimum(np.arange(new + 1) * scale, old)
        first = np.minimum(np.floor(edges[:-1]).astype(np.int64), old - 1)
        taps = int(np.ceil(scale)) + 1
        index = first[:, None] + np.arange(taps)
        overlap = np.minimum(index + 1, edges[1:, None]) - np.maximum(index, edges[:-1, None])
        weight = np.where(index < old, np.maximum(overlap, 0.0), 0.0)
    else:
        centre = (np.arange(new) + 0.5) * scale - 0.5
        if method == "bilinear":
            centre = np.clip(centre, 0, old - 1)
            index = np.floor(centre).astype(np.int64)[:, None] + np.arange(2)
            weight = np.maximum(1 - np.abs(centre[:, None] - index), 0.0)
        elif method == "cubic":
            index = np.floor(centre).astype(np.int64)[:, None] + np.arange(-1, 3)
            weight = _b_spline(np.abs(centre[:, None] - index))
            index, old = index + REACH, old + 2 * REACH
        else:
            stretch = max(1.0, scale)
            reach = int(np.ceil(3 * stretch))
            index = np.floor(centre).astype(np.int64)[:, None] + np.arange(-reach, reach + 2)
            distance = (centre[:, None] - index) / stretch
            weight = np.where(np.abs(distance) < 3, np.sinc(distance) * np.sinc(distance / 3), 0.0)
        weight = np.where((index >= 0) & (index < old), weight, 0.0)
    weight = weight / weight.sum(axis=1, keepdims=True)
    if method == "lanczos":
        _keep_planes(weight, index, centre, old)
    kept = weight != 0
    starts = np.concatenate([[0], np.cumsum(kept.sum(axis=1))])
    return sparse.csr_array((weight[kept], index[kept], starts), shape=(new, old))


def _keep_planes(weight: npt.NDArray[Any], index: npt.NDArray[np.int64], centre: npt.NDArray[Any], old: int) -> None:
    """Move weight between the two middle cells until the weighted mean of positions is the centre, in place.

    Kernels that are cut off at an edge stay as they are.
    """
    # Column `reach` of the table of cells is the one at or before the centre.
    reach = (index.shape[1] - 2) // 2
    whole_kernel = (index[:, reach] - reach + 1 >= 0) & (index[:, reach] + reach < old)
    drift = np.where(whole_kernel, np.sum(weight * (index - centre[:, None]), axis=1), 0.0)
    weight[:, reach] += drift
    weight[:, reach + 1] -= drift


def _b_spline(distance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the centred cubic B-spline at absolute distances."""
    near = 2 / 3 - distance**2 + distance**3 / 2
    return np.where(distance < 1, near, np.maximum(2 - distance, 0) ** 3 / 6)


def _apply(down: Any, across: Any, values: npt.NDArray[Any], part: slice) -> npt.NDArray[np.float64]:
    """Return some rows of ``down @ values @ across.T`` in double precision, reading only the rows that they need."""
    rows = down[part]
    first, last = int(rows.indices.min()), int(rows.indices.max()) + 1
    columns = rows[:, first:last] @ values[first:last].astype(np.float64)
    return np.asarray((across @ columns.T).T)
