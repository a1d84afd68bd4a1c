"""Rivers and ridges on the cells of a grid."""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_hydrology.features import Features
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_terrain.forecasts import Outline, check_cells, outline
from nodegraph_terrain.polylines import Polylines
from nodegraph_terrain.raster import Extent, Grid, Mask

Floats = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Edges = tuple[float, float, float, float]
Method = Literal["exact", "bresenham"]

HAIR = 1e-6
"""Share of a cell by which a point may lie beyond the grid and still count as on its edge."""

MOST_STEPS = 1 << 27
"""Cells that are passed, over which the lines are refused as a mistake."""


class Rasterized(NamedTuple):
    """What `rasterize_features` gives: elevations, and which of them are rivers."""

    features: Features
    rivers: Mask


@node(version=1, locality=whole)
def rasterize_features(
    network: RiverNetwork,
    ridges: Polylines | None = None,
    like: Grid | None = None,
    *,
    extent: Annotated[
        Edges | None, Param("Outer edges (west, south, east, north), without a raster to follow.", unit="m")
    ] = None,
    cell_size: Annotated[float, Param("Side of a cell, without a raster to follow.", gt=0, unit="m")] = 10.0,
    method: Annotated[
        Method, Param("exact: every cell that a line passes; bresenham: thin lines between the cells of its points.")
    ] = "exact",
    context: Context,
) -> Rasterized:
    """Write the elevations of rivers and ridges into the cells that they run through.

    **bresenham**, as in the paper: the ends of a segment move to the centres of their cells, and one cell per row
    or column between them is taken (Bresenham 1965), with heights linear in the number of steps (eq. 5).  Lines are
    thin: their cells touch at corners.

    **exact**: every cell that the segment itself runs through (Amanatides and Woo 1987), with its height halfway
    between where it enters and leaves.  Cells follow each other edge to edge, so nothing diffuses through a ridge.

    Rivers win over ridges.  Where several rivers share a cell the lowest wins, so that water arrives; of several ridges
    the highest.  The ends of a segment take part too: the cell of a node is never above the node.  What lies beyond the
    grid is left out.  Takes time in proportion to the cells passed.

    Args:
        network: rivers with elevations.
        ridges: lines with heights as third coordinate, as from `ridges`, or surveyed breaklines.
        like: any grid in metres: its extent, system and shape are taken, its contents ignored.
        extent: the rectangle to cover; it grows to the south and east to whole cells.  Without it that of rivers
            and ridges.
        cell_size: of square cells.
        method: see above.
        context: the engine's.

    Returns:
        features, NaN where nothing runs, and a mask of the rivers among them (1).

    Raises:
        ValueError: a node or point without height, lines in degrees or in another coordinate system, a grid in degrees
            or with too many cells, or nothing within it.

    Source: Zhang et al. 2016, section V.A, doi:10.1109/ACCESS.2016.2612700; J. E. Bresenham (1965): Algorithm for
    computer control of a digital plotter, doi:10.1147/sj.41.0025; J. Amanatides, A. Woo (1987): A fast voxel traversal
    algorithm for ray tracing, Eurographics, doi:10.2312/egtp.19871000.
    """
    _check(network, ridges)
    grid = _grid(network, ridges, like, extent, cell_size)
    lowest = np.full(grid.rows * grid.cols, np.inf)
    cell, height = _passed(_to_cells(_reaches(network), grid), grid, method)
    np.minimum.at(lowest, cell, height)
    context.progress(0.5, "rivers")
    highest = np.full(grid.rows * grid.cols, -np.inf)
    if ridges is not None and len(ridges):
        cell, height = _passed(_to_cells(_segments(ridges), grid), grid, method)
        np.maximum.at(highest, cell, height)
    wet = np.isfinite(lowest)
    values = np.where(wet, lowest, np.where(np.isfinite(highest), highest, np.nan))
    if np.isnan(values).all():
        raise ValueError("no river or ridge lies within the grid; choose an extent around them")
    shape = grid.rows, grid.cols
    return Rasterized(
        Features(values.reshape(shape).astype(np.float32), grid.extent),
        Mask(wet.reshape(shape).astype(np.float32), grid.extent),
    )


@rasterize_features.forecast
def _forecast(
    network: Forecast,  # noqa: ARG001
    ridges: Forecast | None = None,  # noqa: ARG001
    like: Forecast | None = None,
    *,
    extent: Edges | None,
    cell_size: float,
    **_: object,
) -> Forecast:
    grid = outline(like) if like else _covering(extent, cell_size, "") if extent else None
    return Forecast(0, known=False) if grid is None else grid.forecast(cell_bytes=8, peak_bytes=26)


def _check(network: RiverNetwork, ridges: Polylines | None) -> None:
    bad = ~np.isfinite(np.column_stack([network.position, network.elevation])).all(axis=1)
    if bad.any():
        raise ValueError(
            f"node {int(np.argmax(bad))} of the river network has no elevation or position; "
            "link it through hydrology.river_heights"
        )
    if ridges is None:
        return
    if ridges.unit != "m":
        raise ValueError("the ridges are in degrees; load them with a target_crs in metres")
    if ridges.crs and network.crs and ridges.crs != network.crs:
        raise ValueError("rivers and ridges have different coordinate systems; load both with one target_crs")
    if ridges.points.shape[1] < 3 or np.isnan(ridges.points[:, 2]).any():
        raise ValueError("a point of the ridges has no height; give lines with heights as third coordinate")


def _grid(
    network: RiverNetwork, ridges: Polylines | None, like: Grid | None, extent: Edges | None, cell_size: float
) -> Outline:
    crs = network.crs or (ridges.crs if ridges is not None else "")
    if like is not None:
        if like.extent.unit != "m":
            raise ValueError("the grid linked to like is in degrees; link it through terrain.reproject to get metres")
        if crs and like.extent.crs and crs != like.extent.crs:
            raise ValueError("the rivers have another coordinate system than the grid; reproject one to the other")
        return Outline(*like.shape, like.extent)
    if extent is None:
        points = np.concatenate([network.position, *([ridges.points[:, :2]] if ridges is not None else [])])
        if not len(points):
            raise ValueError("there is neither a river nor a ridge; link a network with nodes")
        west, south = points.min(axis=0).tolist()
        east, north = points.max(axis=0).tolist()
        extent = (west, south, max(east, west + cell_size), max(north, south + cell_size))
    return _covering(extent, cell_size, crs)


def _covering(extent: Edges, cell_size: float, crs: str) -> Outline:
    """Return the grid of whole cells from the north-western corner of an extent on."""
    west, south, east, north = map(float, extent)
    box = Extent(west, south, east, north, crs)
    # An edge within a millionth of a cell of another is that one.
    rows, columns = (max(1, math.ceil(side / cell_size - HAIR)) for side in (box.height, box.width))
    check_cells(rows, columns)
    return Outline(rows, columns, Extent(west, north - rows * cell_size, west + columns * cell_size, north, crs))


def _reaches(network: RiverNetwork) -> Floats:
    """Return the reaches as segments (n, 2, 3), and nodes without any as segments of no length."""
    points = np.column_stack([network.position, network.elevation])
    down = network.downstream
    return np.stack([points, points[np.where(down >= 0, down, np.arange(len(down)))]], axis=1)


def _segments(lines: Polylines) -> Floats:
    inner = np.ones(len(lines.points), np.bool_)
    inner[lines.offsets[1:] - 1] = False
    start = np.flatnonzero(inner)
    return np.stack([lines.points[start], lines.points[start + 1]], axis=1)


def _to_cells(segments: Floats, grid: Outline) -> Floats:
    """Return segments in cells, columns from the west and rows from the north, those near the grid only."""
    dx, dy = grid.cell_size
    edge = grid.extent
    ends = np.empty_like(segments)
    ends[..., 0] = (segments[..., 0] - edge.west) / dx
    ends[..., 1] = (edge.north - segments[..., 1]) / dy
    ends[..., 2] = segments[..., 2]
    for axis, count in ((0, grid.cols), (1, grid.rows)):
        side = ends[..., axis]
        side[np.abs(side) < HAIR] = 0
        side[np.abs(side - count) < HAIR] = count
        ends = ends[(side.max(axis=1) >= 0) & (side.min(axis=1) <= count)]
    return ends


def _passed(ends: Floats, grid: Outline, method: Method) -> tuple[Index, Floats]:
    """Return the numbers of the cells that segments pass, each as often as it is passed, and the heights there."""
    cells, height = (_exact if method == "exact" else _bresenham)(ends, grid)
    column, row = cells.T
    inside = (column >= 0) & (column < grid.cols) & (row >= 0) & (row < grid.rows)
    return (row * grid.cols + column)[inside], height[inside]


def _cells(points: Floats, grid: Outline) -> Index:
    """Return the cells (column, row) of points; those on the southern and eastern edge are in the last ones."""
    count = np.array([grid.cols, grid.rows])
    return np.where(np.abs(points - count) < HAIR, count - 1, np.floor(points).astype(np.int64))


def _steps(counts: Index) -> tuple[Index, Index]:
    """Return for each of `counts` steps of every segment the number of the segment and of the step."""
    if counts.sum() > MOST_STEPS:
        raise ValueError(f"the lines pass {counts.sum():.3g} cells, over {MOST_STEPS:,}; choose larger cells")
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner]


def _bresenham(ends: Floats, grid: Outline) -> tuple[Index, Floats]:
    cells = _cells(ends[..., :2], grid)
    reach = cells[:, 1] - cells[:, 0]
    longest = np.abs(reach).max(axis=1, initial=0)
    owner, step = _steps(longest + 1)
    size = np.maximum(longest, 1)[owner, None]
    # Rounded to the nearest, halves away from the start: integers only, as Bresenham's error term.
    moved = (2 * np.abs(reach[owner]) * step[:, None] + size) // (2 * size) * np.sign(reach[owner])
    share = step / size[:, 0]
    return cells[owner, 0] + moved, (1 - share) * ends[owner, 0, 2] + share * ends[owner, 1, 2]


def _exact(ends: Floats, grid: Outline) -> tuple[Index, Floats]:
    start, stop = ends[:, 0], ends[:, 1]
    reach = stop - start
    owners, places = [np.tile(np.arange(len(ends)), 2)], [np.repeat([0.0, 1.0], len(ends))]
    for axis in (0, 1):
        low, high = np.minimum(start[:, axis], stop[:, axis]), np.maximum(start[:, axis], stop[:, axis])
        first = np.floor(low).astype(np.int64) + 1
        # Grid lines strictly between both ends.
        owner, step = _steps(np.maximum(np.ceil(high).astype(np.int64) - first, 0))
        owners.append(owner)
        places.append((first[owner] + step - start[owner, axis]) / reach[owner, axis])
    owner, place = np.concatenate(owners), np.clip(np.concatenate(places), 0, 1)
    order = np.lexsort((place, owner))
    owner, place = owner[order], place[order]
    middle = np.flatnonzero(owner[1:] == owner[:-1])
    share = np.concatenate([(place[middle] + place[middle + 1]) / 2, places[0]])
    # The ends as well: nodes are in their cells with their own height.
    segment = np.concatenate([owner[middle], owners[0]])
    moving = np.concatenate([place[middle + 1] > place[middle], np.ones(2 * len(ends), np.bool_)])
    share, segment = share[moving, None], segment[moving]
    points = (1 - share) * start[segment] + share * stop[segment]
    return _cells(points[:, :2], grid), points[:, 2]
