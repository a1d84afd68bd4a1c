"""Streams of a surface: where enough ground drains through a cell."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_hydrology import topology
from nodegraph_hydrology.flow import Depressions, Floats, Flow, Index, Method, cell_areas, followed, route
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_terrain.raster import Elevation

DEPRESSIONS = Param("Fill depressions to their lowest pass, or breach them by a channel.")
METHOD = Param("Flow to one neighbour, or shared by two beside the steepest descent.")
THRESHOLD = Param("Least drainage area of a stream.", gt=0, unit="m2")


@node(version=1, locality=whole)
def extract_streams(
    surface: Elevation,
    *,
    threshold: Annotated[float, THRESHOLD] = 1e6,
    depressions: Annotated[Depressions, DEPRESSIONS] = "fill",
    method: Annotated[Method, METHOD] = "d8",
    context: Context,
) -> RiverNetwork:
    """Find the streams of a surface: the cells that at least a threshold of area drains through.

    Each stream cell flows to its D8 receiver.  With ``dinf`` the area is that of D-infinity, which forms no parallel
    streams on planes; where it falls below the threshold again downstream, the stream still goes on to its outlet.

    Args:
        surface: elevation in metres; fill its voids first, as water leaves where it reaches one.
        threshold: 1e6 m2 is about what makes a first-order stream on a map 1 : 50 000.
        depressions: see `drainage_area`.
        method: of the drainage area, see `drainage_area`.
        context: the engine's.

    Returns:
        Nodes at the centres of cells, and their elevation after filling or breaching: it never rises downstream and
        stays level through filled ground.  A stream ends beside the border or a void.

    Raises:
        ValueError: a surface in degrees, all void or with infinite heights, or a threshold that no cell reaches.
    """
    flow = route(surface, depressions, context)
    return stream_network(flow, stream_cells(flow, cell_areas(flow, method, context), threshold), surface)


@extract_streams.forecast
def _forecast(surface: Forecast, **_: object) -> Forecast:
    return Forecast(surface.bytes, 60 * surface.bytes)


def stream_cells(flow: Flow, area: Floats, threshold: float) -> Index:
    """Return the cells with at least that drainage area, and all below them, by number.

    Raises:
        ValueError: there is none.
    """
    begun = area >= threshold
    if not begun.any():
        raise ValueError(
            f"no cell drains {threshold:g} m2 or more; take a smaller threshold, the greatest drainage area is "
            f"{area.max():g} m2"
        )
    return np.flatnonzero(flow.gathered(begun, np.logical_or))


def stream_network(flow: Flow, cells: Index, surface: Elevation) -> RiverNetwork:
    """Return the network through stream cells, which hold all cells below them."""
    number = np.full(len(flow.receiver) + 1, -1, np.int32)
    number[cells] = np.arange(len(cells))
    # The entry behind the last, which -1 points at, is that of outlets.
    down = number[flow.receiver[cells]]
    position = flow.lattice.positions(cells, surface)
    return RiverNetwork(position, down, flow.height[cells].astype(np.float64), surface.extent.crs)


def link_basins(flow: Flow, cells: Index, surface: Elevation) -> Index:
    """Return for every cell the first cell of the link of streams that it drains to; -1 where it reaches none."""
    head = topology.link_heads(stream_network(flow, cells, surface).downstream)
    numbers = np.arange(len(flow.receiver))
    jump = np.where(flow.receiver >= 0, flow.receiver, numbers)
    jump[cells] = cells
    link = np.full(len(jump), -1, np.int64)
    link[cells] = cells[head]
    return np.where(flow.lattice.known, link[followed(jump)], -1)
