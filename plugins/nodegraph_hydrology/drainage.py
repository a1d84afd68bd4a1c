"""Rasters of drainage: how much ground drains through each cell, its stream order, its basin."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np

from nodegraph import Context, Forecast, Param, node, port_type, whole
from nodegraph_hydrology import topology
from nodegraph_hydrology.flow import Depressions, Floats, Flow, Method, cell_areas, route
from nodegraph_hydrology.streams import DEPRESSIONS, METHOD, THRESHOLD, link_basins, stream_cells, stream_network
from nodegraph_terrain.raster import Elevation, Labels, Raster


@port_type
class DrainageArea(Raster):
    """Area whose water runs through a cell, the cell itself included, m2."""

    unit = "m2"


@node(version=1, locality=whole)
def drainage_area(
    surface: Elevation,
    *,
    depressions: Annotated[Depressions, DEPRESSIONS] = "fill",
    method: Annotated[Method, METHOD] = "d8",
    context: Context,
) -> DrainageArea:
    """Find the area that drains through every cell of a surface.

    ``d8``: each cell flows to the neighbour of steepest descent (O'Callaghan and Mark 1984).  ``dinf``: in the
    direction of steepest descent over eight triangular facets, shared by the two neighbours beside it (Tarboton 1997).

    Depressions are filled to their lowest pass, by the least surface that drains, or breached: a channel is cut from
    the bottom over that pass.  Flats drain away from higher and towards lower ground (Barnes et al. 2014).  Water that
    reaches the border of the raster or a void leaves; fill voids with `terrain.fill_voids` where it should run on.

    Args:
        surface: elevation in metres; cells may be rectangular.
        depressions: ``fill`` or ``breach``.
        method: ``d8`` or ``dinf``.
        context: the engine's.

    Returns:
        Square metres, at least the area of a cell; void cells stay void.  The areas of all outlets sum to that of all
        known cells.

    Raises:
        ValueError: a surface in degrees, all void or with infinite heights.

    Takes time n log n in the cells, and one array operation per cell of the longest river.

    References: doi:10.1016/S0734-189X(84)80011-0, doi:10.1029/96WR03137, doi:10.1016/j.cageo.2013.01.009,
    doi:10.5194/esurf-7-549-2019.
    """
    flow = route(surface, depressions, context)
    return DrainageArea(_raster(flow, cell_areas(flow, method, context)), surface.extent)


@node(version=1, locality=whole)
def stream_order(
    surface: Elevation,
    *,
    threshold: Annotated[float, THRESHOLD] = 1e6,
    kind: Annotated[
        Literal["strahler", "shreve"], Param("Order by joining equals, or the number of sources above.")
    ] = "strahler",
    depressions: Annotated[Depressions, DEPRESSIONS] = "fill",
    method: Annotated[Method, METHOD] = "d8",
    context: Context,
) -> Labels:
    """Find the order of the stream in every cell that has one.

    Streams are those of `extract_streams`.  Strahler's order is 1 at sources and rises by one where two of the same
    order join; Shreve's magnitude is the number of sources above.

    Args:
        surface: elevation in metres.
        threshold: least area that makes a stream.
        kind: ``strahler`` or ``shreve``.
        depressions: see `drainage_area`.
        method: see `drainage_area`.
        context: the engine's.

    Returns:
        The order, 1 and more; -1 where there is no stream.

    Raises:
        ValueError: as `extract_streams`.

    References: A. N. Strahler (1957), doi:10.1029/TR038i006p00913; R. L. Shreve (1966), doi:10.1086/627137.
    """
    flow = route(surface, depressions, context)
    cells = stream_cells(flow, cell_areas(flow, method, context), threshold)
    down = stream_network(flow, cells, surface).downstream
    order = topology.strahler_order(down) if kind == "strahler" else topology.shreve_magnitude(down)
    result = np.full(len(flow.receiver), -1, np.int32)
    result[cells] = order
    return Labels(np.ascontiguousarray(flow.lattice.inner(result)), surface.extent)


@node(version=1, locality=whole)
def basins(
    surface: Elevation,
    *,
    unit: Annotated[
        Literal["outlets", "links"], Param("Basins of all outlets, or of the links of streams.")
    ] = "outlets",
    threshold: Annotated[float, THRESHOLD] = 1e6,
    smallest: Annotated[float, Param("Basins below this area are left out.", ge=0, unit="m2")] = 0.0,
    depressions: Annotated[Depressions, DEPRESSIONS] = "fill",
    method: Annotated[Method, METHOD] = "d8",
    context: Context,
) -> Labels:
    """Divide a surface into the basins of its outlets, or of the links of its streams.

    With ``outlets`` a basin is all ground that drains (by D8) to one place on the border or at a void; `threshold` and
    `method` have no say.  With ``links`` it is what drains to one link of a stream, between confluences, without the
    basins above; ground that reaches no stream has none.

    Args:
        surface: elevation in metres.
        unit: ``outlets`` or ``links``.
        threshold: least area that makes a stream.
        smallest: basins of less area are left out.
        depressions: see `drainage_area`.
        method: of the area that `threshold` is compared with, see `drainage_area`.
        context: the engine's.

    Returns:
        Numbers from 0, the largest basin first; -1 where there is none.

    Raises:
        ValueError: as `extract_streams`.
    """
    flow = route(surface, depressions, context)
    if unit == "outlets":
        owner = np.where(flow.lattice.known, flow.spread(np.arange(len(flow.receiver))), -1)
    else:
        owner = link_basins(flow, stream_cells(flow, cell_areas(flow, method, context), threshold), surface)
    known = np.flatnonzero(owner >= 0)
    _, basin, count = np.unique(owner[known], return_inverse=True, return_counts=True)
    rank = np.empty(len(count), np.int64)
    rank[np.argsort(-count, kind="stable")] = np.arange(len(count))
    rank[count * flow.lattice.cell[0] * flow.lattice.cell[1] < smallest] = -1
    result = np.full(len(owner), -1, np.int32)
    result[known] = rank[basin]
    return Labels(np.ascontiguousarray(flow.lattice.inner(result)), surface.extent)


def _raster(flow: Flow, values: Floats) -> Any:
    inner = flow.lattice.inner(np.where(flow.lattice.known, values, np.nan))
    return inner.astype(np.float32)


@drainage_area.forecast
@stream_order.forecast
@basins.forecast
def _forecast(surface: Forecast, **_: object) -> Forecast:
    # Some twenty values of eight bytes per cell at the peak; the triangular system of D-infinity included.
    return Forecast(surface.bytes, 60 * surface.bytes, surface.about)
