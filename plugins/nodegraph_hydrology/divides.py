"""Ridges of a surface: divides between the basins of streams, or the streams of the surface turned upside down."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_hydrology import topology
from nodegraph_hydrology.flow import Flow, Index, cell_areas, route
from nodegraph_hydrology.streams import THRESHOLD, link_basins, stream_cells, stream_network
from nodegraph_terrain.polylines import Polylines, Property
from nodegraph_terrain.raster import Elevation

Floats = npt.NDArray[np.float64]


@node(version=1, locality=whole)
def extract_ridges(
    surface: Elevation,
    *,
    method: Annotated[
        Literal["divides", "inverted"], Param("Borders between basins, or streams of the inverted surface.")
    ] = "divides",
    threshold: Annotated[float, THRESHOLD] = 1e6,
    shortest: Annotated[float, Param("Shorter ridges are left out.", ge=0, unit="m")] = 0.0,
    context: Context,
) -> Polylines:
    """Find the ridges of a surface.

    **divides**: the borders between the basins of the links of its streams (`basins` with ``links``), along the edges
    of cells.  Where one link flows into the other, the border only crosses the slope and is no ridge.  They part at
    junctions; each side of a ridge drains to another stream.

    **inverted**: the streams of the surface turned upside down, along the centres of cells.  Each ridge is a link, from
    a summit side or junction up to the next, with its Strahler order.  Unlike divides they may end on a slope.

    Depressions are filled, flow is D8; fill voids first, as they count as outside.

    Args:
        surface: elevation in metres.
        method: ``divides`` or ``inverted``.
        threshold: least drainage area of the streams, upright or inverted: the greater, the fewer ridges.
        shortest: ridges below this length are left out.
        context: the engine's.

    Returns:
        Lines with heights (m); properties ``length`` (m), and for ``inverted`` ``order``.  None where a single stream
        drains all.

    Raises:
        ValueError: as `extract_streams`.

    Source: Zhang et al. 2016, section V.A (watersheds of rivers are ridges), doi:10.1109/ACCESS.2016.2612700.
    """
    upright = surface if method == "divides" else surface.like(-surface.data)
    flow = route(upright, "fill", context)
    cells = stream_cells(flow, cell_areas(flow, "d8", context), threshold)
    context.progress(0.9, "ridges")
    if method == "divides":
        lines, orders = _divides(flow, cells, surface), None
    else:
        lines, orders = _links(flow, cells, surface)
    found = Polylines.of(lines, crs=surface.extent.crs, dimension=3)
    lengths = found.lengths()
    properties = [Property("length", lengths, "m")]
    if orders is not None:
        properties.append(Property("order", orders))
    result = Polylines(found.points, found.offsets, tuple(properties), found.crs)
    return result.take(lengths >= shortest)


@extract_ridges.forecast
def _forecast(surface: Forecast, **_: object) -> Forecast:
    return Forecast(8 * surface.bytes, 60 * surface.bytes)


def _links(flow: Flow, cells: Index, surface: Elevation) -> tuple[list[Floats], Index]:
    """Return the links of the network through cells, with the heights of the surface, and their orders."""
    network = stream_network(flow, cells, surface)
    down = network.downstream.astype(np.int64)
    points = np.column_stack([network.position, -flow.lattice.height[cells].astype(np.float64)])
    order = topology.strahler_order(down)
    lines, orders = [], []
    for members in link_members(down):
        below = down[members[-1]]
        path = np.append(members, below) if below >= 0 else members
        if len(path) > 1:
            lines.append(points[path])
            orders.append(int(order[members[0]]))
    return lines, np.array(orders, np.int64)


def link_members(down: npt.NDArray[Any]) -> list[Index]:
    """Return the nodes of every link, each from its upper end down."""
    heads = topology.link_heads(down)
    order = np.lexsort((-topology.hops(down), heads))
    starts = np.flatnonzero(np.diff(heads[order], prepend=-1))
    return np.split(order, starts[1:]) if len(order) else []


def _divides(flow: Flow, cells: Index, surface: Elevation) -> list[Floats]:
    """Return the borders between the basins of links that do not flow into each other, as lines along cell edges."""
    import shapely

    lattice = flow.lattice
    basin = lattice.inner(link_basins(flow, cells, surface))
    # The link that each link flows into, by the number of their first cells.
    below = np.full(len(flow.receiver), -1, np.int64)
    flat = np.full(len(flow.receiver), -1, np.int64)
    flat.reshape(lattice.shape[0] + 2, -1)[1:-1, 1:-1] = basin
    flowing = cells[flow.receiver[cells] >= 0]
    out = flat[flowing] != flat[flow.receiver[flowing]]
    below[flat[flowing[out]]] = flat[flow.receiver[flowing[out]]]
    legs = []
    for along in (0, 1):
        first = basin[:-1] if along == 0 else basin[:, :-1]
        second = basin[1:] if along == 0 else basin[:, 1:]
        apart = (first != second) & (first >= 0) & (second >= 0)
        apart &= (below[first] != second) & (below[second] != first)
        row, column = np.nonzero(apart)
        # Corners of cells: (row, column) is the upper left one of that cell.
        ends = (row + 1, column, row + 1, column + 1) if along == 0 else (row, column + 1, row + 1, column + 1)
        legs.append(np.stack(ends, axis=1))
    corners = np.concatenate(legs).astype(np.float64)
    if not len(corners):
        return []
    merged = shapely.line_merge(shapely.multilinestrings(shapely.linestrings(corners.reshape(-1, 2, 2))))
    parts = shapely.get_parts(merged)
    heights = _corner_heights(surface)
    dx, dy = lattice.cell
    lines = []
    for part in parts:
        row, column = shapely.get_coordinates(part).astype(np.int64).T
        east, north = surface.extent.west + column * dx, surface.extent.north - row * dy
        lines.append(np.stack([east, north, heights[row, column]], axis=1))
    return lines


def _corner_heights(surface: Elevation) -> Floats:
    """Return the mean height of the known cells around each corner, (rows + 1, columns + 1)."""
    padded = np.pad(surface.data.astype(np.float64), 1, constant_values=np.nan)
    around = np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]])
    known = ~np.isnan(around)
    count = known.sum(axis=0)
    total = np.where(known, around, 0).sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))
