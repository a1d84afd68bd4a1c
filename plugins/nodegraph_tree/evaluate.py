"""Sampling a construction tree: rasters of height, weight and normals, and profiles along a line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, port_type, whole
from nodegraph_terrain.forecasts import Outline, check_cells
from nodegraph_terrain.raster import Elevation, Extent, Grid, Mask, Normals, Raster
from nodegraph_tree.falloff import fall_off
from nodegraph_tree.function import THRESHOLD, ElevationFunction, Floats, Points, Sample

BLOCK = 128
"""Samples along the side of a block that NumPy evaluates at once: small enough to leave out most primitives."""

Edges = tuple[float, float, float, float]

# What every node that samples a grid asks for.
Area = Annotated[Edges | None, Param("Outer edges (west, south, east, north); none: that of `like`.", unit="m")]
CellSize = Annotated[float | None, Param("Side of a cell; none: from rows and columns.", gt=0, unit="m")]
Rows = Annotated[int | None, Param("Number of rows, with columns in place of a cell size.", ge=1)]
Columns = Annotated[int | None, Param("Number of columns.", ge=1)]
System = Annotated[str, Param("Coordinate reference system that the metres are in, such as EPSG:32616.")]
Detail = Annotated[float, Param("Level of detail kappa; 1 is all of it.", ge=0, le=1)]


class Sampled(NamedTuple):
    """What `sample` gives: the terrain, void outside its domain, and how much each cell belongs to it."""

    surface: Elevation
    weight: Mask


@port_type
class Profile:
    """A tree along a line.

    Attributes:
        distance: along the line from its first point, (n,) m.
        x, y: where, (n,) m.
        height: f, (n,) m; NaN outside the terrain.
        weight: alpha, (n,).
    """

    distance: npt.NDArray[np.float64]
    x: npt.NDArray[np.float64]
    y: npt.NDArray[np.float64]
    height: npt.NDArray[np.float64]
    weight: npt.NDArray[np.float64]


@node(version=1, locality=whole)
def sample(
    function: ElevationFunction,
    like: Grid | None = None,
    detail_map: Raster | None = None,
    *,
    extent: Area = None,
    cell_size: CellSize = None,
    rows: Rows = None,
    columns: Columns = None,
    crs: System = "",
    detail: Detail = 1.0,
    viewpoint: Annotated[
        tuple[float, float] | None, Param("Where one looks from (x, y): detail falls with the distance.", unit="m")
    ] = None,
    view_range: Annotated[
        float, Param("Distance from the viewpoint at which no detail is left.", gt=0, unit="m")
    ] = 1e4,
    context: Context,
) -> Sampled:
    """Sample a construction tree at the cell centres of a grid.

    The terrain exists where alpha >= 1/2; elsewhere a sample is void (NaN).  The level of detail at a cell is `detail`,
    times the value of `detail_map` there if it is linked, times 1 - 3 t^2 + 2 t^3 of t = distance to the viewpoint over
    `view_range` if one is given (section 6).  A window of a scene gives the same samples as that window of a larger
    one.

    Args:
        function: the tree.
        like: a grid to take extent, shape and system from.
        detail_map: level of detail, 0 to 1, on the grid that is sampled.
        extent: outer edges of the outer cells.
        cell_size: the extent is grown to the east and south to whole cells.
        rows: of the grid.
        columns: of the grid.
        crs: noted on the result, never changes it.
        detail: the whole scene's.
        viewpoint: for detail that falls with distance.
        view_range: likewise.
        context: the engine's.

    Returns:
        ``surface``: height, m; ``weight``: alpha held at 1.

    Raises:
        ValueError: the grid is not given, or given twice.
    """
    grid, shape = grid_of(like, extent, cell_size, rows, columns, crs)
    found = sample_grid(
        function, grid, shape, context, _details(grid, shape, detail_map, detail, viewpoint, view_range)
    )
    height, weight = (np.empty(shape, np.float32) for _ in range(2))
    for place, part in found:
        height[place] = np.where(part.weight >= THRESHOLD, part.height, np.nan)
        weight[place] = np.minimum(part.weight, 1)
    return Sampled(Elevation(height, grid), Mask(weight, grid))


@sample.opencl(rtol=1e-4, atol=0.02)
def _twin(
    function: ElevationFunction,
    like: Grid | None = None,
    detail_map: Raster | None = None,
    *,
    extent: Edges | None,
    cell_size: float | None,
    rows: int | None,
    columns: int | None,
    crs: str,
    detail: float,
    viewpoint: tuple[float, float] | None,
    view_range: float,
    context: Context,
) -> Sampled:
    from nodegraph.opencl import to_host
    from nodegraph_tree.device import sample_on_device

    device = context.device
    assert device is not None
    grid, shape = grid_of(like, extent, cell_size, rows, columns, crs)
    details = _details(grid, shape, to_host(detail_map), detail, viewpoint, view_range)
    height, weight = sample_on_device(to_host(function), grid, shape, device, context, details, heaviest=1.0)
    return Sampled(Elevation(height, grid), Mask(weight, grid))


@sample.forecast
def _forecast(
    function: Forecast,  # noqa: ARG001
    like: Forecast | None,
    detail_map: Forecast | None,  # noqa: ARG001
    *,
    extent: Edges | None,
    cell_size: float | None,
    rows: int | None,
    columns: int | None,
    **_: object,
) -> Forecast:
    if like is not None and isinstance(like.about, Outline):
        outline = like.about
    else:
        grid, (high, wide) = grid_of(None, extent, cell_size, rows, columns, "")
        outline = Outline(high, wide, grid)
    size = 4 * outline.rows * outline.cols
    return Forecast(2 * size, 0, outline)


@node(version=1, locality=whole)
def normals(
    function: ElevationFunction,
    like: Grid | None = None,
    *,
    extent: Area = None,
    cell_size: CellSize = None,
    rows: Rows = None,
    columns: Columns = None,
    crs: System = "",
    detail: Detail = 1.0,
    context: Context,
) -> Normals:
    """Sample the upward unit normals of a construction tree, n = (-df/dx, -df/dy, 1) / |...|, from its exact gradient.

    Returns:
        (rows, columns, 3) float32: east, north, up; NaN outside the terrain.

    Raises:
        ValueError: the grid is not given, or given twice.
    """
    grid, shape = grid_of(like, extent, cell_size, rows, columns, crs)
    found = np.empty((*shape, 3), np.float32)
    for place, part in sample_grid(function, grid, shape, context, detail, gradient=True):
        assert part.height_gradient is not None
        east, north = part.height_gradient
        length = np.sqrt(1 + east**2 + north**2)
        upward = np.stack([-east / length, -north / length, 1 / length], axis=-1)
        upward[part.weight < THRESHOLD] = np.nan
        found[place] = upward
    return Normals(found, grid)


@node(version=1)
def query(
    function: ElevationFunction,
    *,
    points: Annotated[
        tuple[tuple[float, float], ...], Param("Corners [x, y] of a line, or single points.", min_length=1, unit="m")
    ],
    spacing: Annotated[
        float | None, Param("Distance between samples along the line; none: at the points only.", gt=0, unit="m")
    ] = None,
    detail: Detail = 1.0,
    context: Context,
) -> Profile:
    """Ask a construction tree at points, or along a line: a profile.

    Args:
        function: the tree.
        points: where; along the line the last point is always a sample.
        spacing: with it, samples stand at equal distances along the line through the points.
        detail: level of detail.
        context: the engine's.
    """
    corners = np.array(points, np.float64)
    legs = np.hypot(*np.diff(corners, axis=0).T) if len(corners) > 1 else np.zeros(0)
    along = np.concatenate([[0.0], np.cumsum(legs)])
    distance = along
    if spacing is not None and along[-1] > 0:
        if along[-1] / spacing > 1e8:
            raise ValueError(f"{along[-1]:g} m in steps of {spacing:g} m are too many samples; widen the spacing")
        distance = np.append(np.arange(0.0, along[-1], spacing), along[-1])
    x, y = (np.interp(distance, along, corners[:, axis]) if along[-1] > 0 else corners[:, axis] for axis in (0, 1))
    found = function.query(Points(x, y, detail))
    context.progress(1.0)
    height = np.where(found.weight >= THRESHOLD, found.height, np.nan)
    return Profile(distance, x, y, height, found.weight)


def grid_of(
    like: Grid | None,
    extent: Edges | None,
    cell_size: float | None,
    rows: int | None,
    columns: int | None,
    crs: str,
) -> tuple[Extent, tuple[int, int]]:
    """Return extent and shape of the grid that is asked for.

    Raises:
        ValueError: it is not given, given twice, in degrees, or too large.
    """
    if like is not None:
        if extent or cell_size or rows or columns:
            raise ValueError(
                "the grid is given twice; either link `like` or give extent with cell_size or rows and columns"
            )
        if like.extent.unit != "m":
            raise ValueError("the grid is in degrees; link it through terrain.reproject to get metres")
        return like.extent, like.shape
    if extent is None:
        raise ValueError("where to sample is missing; link `like` or give extent (west, south, east, north)")
    area = Extent(*extent, crs=crs)
    if cell_size is not None and rows is None and columns is None:
        wide, high = (max(1, round(side / cell_size)) for side in (area.width, area.height))
        check_cells(high, wide)
        return replace(area, east=area.west + wide * cell_size, south=area.north - high * cell_size), (high, wide)
    if cell_size is None and rows is not None and columns is not None:
        check_cells(rows, columns)
        return area, (rows, columns)
    raise ValueError("how finely to sample is missing; give cell_size, or rows and columns")


def sample_grid(
    root: ElevationFunction,
    extent: Extent,
    shape: tuple[int, int],
    context: Context,
    detail: Floats | float = 1.0,
    *,
    gradient: bool = False,
) -> Iterator[tuple[tuple[slice, slice], Any]]:
    """Yield (place, sample) for blocks of a grid, with NumPy; the arrays of a sample have the block's shape."""
    rows, cols = shape
    dx, dy = extent.width / cols, extent.height / rows
    for top in range(0, rows, BLOCK):
        context.progress(top / rows)
        for left in range(0, cols, BLOCK):
            place = (slice(top, min(top + BLOCK, rows)), slice(left, min(left + BLOCK, cols)))
            x = extent.west + (np.arange(place[1].start, place[1].stop) + 0.5) * dx
            y = extent.north - (np.arange(place[0].start, place[0].stop) + 0.5) * dy
            size = (len(y), len(x))
            here = detail if isinstance(detail, (int, float)) else detail[place].ravel()
            points = Points(np.broadcast_to(x, size).ravel(), np.broadcast_to(y[:, None], size).ravel(), here)
            found = root.query(points, gradient=gradient)
            yield place, _reshaped(found, size)


def _reshaped(sample: Sample, size: tuple[int, int]) -> Sample:
    slopes = [None if item is None else item.reshape(2, *size) for item in sample[2:]]
    return Sample(sample.height.reshape(size), sample.weight.reshape(size), slopes[0], slopes[1])


def _details(
    extent: Extent,
    shape: tuple[int, int],
    detail_map: Raster | None,
    detail: float,
    viewpoint: tuple[float, float] | None,
    view_range: float,
) -> Floats | float:
    if detail_map is None and viewpoint is None:
        return detail
    found = np.full(shape, detail)
    if detail_map is not None:
        if detail_map.shape != shape:
            raise ValueError(
                f"the detail map has shape {detail_map.shape}, the grid {shape}; resample one to the other"
            )
        found *= np.clip(np.nan_to_num(detail_map.data), 0, 1)
    if viewpoint is not None:
        x = extent.west + (np.arange(shape[1]) + 0.5) * extent.width / shape[1]
        y = extent.north - (np.arange(shape[0]) + 0.5) * extent.height / shape[0]
        distance = np.hypot(x - viewpoint[0], (y - viewpoint[1])[:, None])
        found *= fall_off("cubic", distance / view_range)
    return found
