"""Does a terrain obey the rivers that it was made from: designed rivers against those that its water finds."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, port_type, whole
from nodegraph_hydrology.draw_network import painted, shaded
from nodegraph_hydrology.flow import Depressions, Flow, Index, Lattice, Method, cell_areas, route
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.streams import DEPRESSIONS, METHOD, stream_cells
from nodegraph_hydrology.topology import is_exterior, link_heads, strahler_order
from nodegraph_terrain.raster import Elevation, Image

Flags = npt.NDArray[np.bool_]


@port_type
class Agreement:
    """How far the streams of a terrain follow designed rivers.

    Attributes:
        threshold: least drainage area of the streams, m2.
        within: distance that still agrees, cells.
        least_order: Strahler order from which designed rivers must be found.
        stream_cells: cells of extracted streams that count.
        designed_cells: cells of designed rivers of at least `least_order`.
        followed: share of stream cells within the distance of a designed river of any order.
        found: share of those designed cells within the distance of a stream.
    """

    threshold: float
    within: float
    least_order: int
    stream_cells: int
    designed_cells: int
    followed: float
    found: float

    def to_json(self) -> str:
        """Return the numbers as JSON."""
        return json.dumps({item.name: getattr(self, item.name) for item in fields(self)}, allow_nan=False)


class Compared(NamedTuple):
    """What `compare_networks` gives."""

    followed: float
    found: float
    agreement: Agreement
    map: Image


@node(version=1, locality=whole)
def compare_networks(
    designed: RiverNetwork,
    terrain: Elevation,
    *,
    threshold: Annotated[
        float | None,
        Param("Least drainage area of a stream; none: that of designed first-order links.", gt=0, unit="m2"),
    ] = None,
    within: Annotated[float, Param("Distance that still agrees.", ge=0, le=1000, unit="cells")] = 2.0,
    least_order: Annotated[int, Param("Designed rivers from this Strahler order on must be found.", ge=1)] = 2,
    inside: Annotated[bool, Param("Count only streams inside the convex hull of the designed rivers.")] = False,
    depressions: Annotated[Depressions, DEPRESSIONS] = "fill",
    method: Annotated[Method, METHOD] = "d8",
    context: Context,
) -> Compared:
    """Compare the streams that are extracted from a terrain with the rivers that it was designed from.

    Designed rivers are drawn into the cells of the terrain, which are visited at half-cell steps; distances are from
    centre to centre.

    Without `threshold`, streams begin at the mean area that is nearest to an exterior link of the designed rivers (one
    that begins at a source): the drainage area of first-order links, if each drains what lies nearest to it.

    Args:
        designed: rivers.
        terrain: elevation in metres.
        threshold: least drainage area.
        within: distance in cells (of the smaller side where they are not square).
        least_order: which designed rivers `found` counts.
        inside: leave streams beyond the hull of the design out of `followed`.
        depressions: see `drainage_area`.
        method: see `drainage_area`.
        context: the engine's.

    Returns:
        ``followed``: share of stream cells near a designed river; ``found``: share of designed cells near a stream;
        ``agreement``: these and what they rest on; ``map``: streams blue where they follow, red where they do not,
        designed rivers that are not found orange, with their shares.

    Raises:
        ValueError: no designed river of that order lies on the terrain, or no cell drains as much as `threshold`.
    """
    import shapely
    from scipy import ndimage

    flow = route(terrain, depressions, context)
    lattice = flow.lattice
    order = strahler_order(designed.downstream)
    cell, leg = drawn_cells(designed, terrain, lattice)
    if not len(cell):
        raise ValueError("no designed river lies on the terrain; give both in the same coordinates")
    wanted = _raster(lattice, cell[order[leg] >= least_order])
    if not wanted.any():
        raise ValueError(
            f"no designed river of order {least_order} or more lies on the terrain; the highest there is "
            f"{int(order[leg].max())}"
        )
    sampling = (lattice.cell[1] / min(lattice.cell), lattice.cell[0] / min(lattice.cell))
    to_design, nearest = ndimage.distance_transform_edt(~_raster(lattice, cell), sampling=sampling, return_indices=True)
    least = _first_order_area(designed, lattice, cell, leg, nearest) if threshold is None else threshold
    area = cell_areas(flow, method, context)
    streams = _raster(lattice, stream_cells(flow, area, least))
    context.progress(0.9, "map")
    to_stream = ndimage.distance_transform_edt(~streams, sampling=sampling)
    if inside:
        hull = shapely.MultiPoint(designed.position).convex_hull
        places = lattice.positions(_numbers(streams), terrain)
        streams[streams] = shapely.covers(hull, shapely.points(places))
        if not streams.any():
            raise ValueError("no stream lies inside the hull of the designed rivers; take a smaller threshold")
    followed, found = streams & (to_design <= within), wanted & (to_stream <= within)
    agreement = Agreement(
        threshold=float(least),
        within=within,
        least_order=least_order,
        stream_cells=int(streams.sum()),
        designed_cells=int(wanted.sum()),
        followed=float(followed.sum() / streams.sum()),
        found=float(found.sum() / wanted.sum()),
    )
    layers = [streams & followed, wanted & ~found, streams & ~followed]
    names = [
        f"streams that follow the design: {agreement.followed:.1%}",
        f"designed, not found: {1 - agreement.found:.1%}",
        f"streams elsewhere: {1 - agreement.followed:.1%}",
    ]
    picture = _map(terrain, flow, layers, names, context)
    return Compared(agreement.followed, agreement.found, agreement, picture)


@compare_networks.forecast
def _forecast(designed: Forecast, terrain: Forecast, **_: object) -> Forecast:
    return Forecast(terrain.bytes, 60 * terrain.bytes + 8 * designed.bytes)


def drawn_cells(designed: RiverNetwork, terrain: Elevation, lattice: Lattice) -> tuple[Index, Index]:
    """Return the known cells that reaches run through and the upper node of the reach, each pair once.

    An outlet has the cell that it lies in.
    """
    down = designed.downstream
    first, last = designed.position, designed.position[np.where(down >= 0, down, np.arange(len(down)))]
    extent, (dx, dy) = terrain.extent, lattice.cell
    steps = np.ceil(np.abs((last - first) / (dx, dy)).max(axis=1, initial=0) * 2).astype(np.int64) + 1
    leg = np.repeat(np.arange(len(down)), steps + 1)
    along = np.arange(len(leg)) - np.repeat(np.cumsum(steps + 1) - steps - 1, steps + 1)
    place = first[leg] + (last - first)[leg] * (along / steps[leg])[:, None]
    column = np.floor((place[:, 0] - extent.west) / dx).astype(np.int64)
    row = np.floor((extent.north - place[:, 1]) / dy).astype(np.int64)
    rows, columns = lattice.shape
    within = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    cell = (row[within] + 1) * (columns + 2) + column[within] + 1
    pair = np.unique(np.stack([cell, leg[within]], axis=1), axis=0)
    pair = pair[lattice.known[pair[:, 0]]]
    return pair[:, 0], pair[:, 1]


def _first_order_area(designed: RiverNetwork, lattice: Lattice, cell: Index, leg: Index, nearest: Any) -> float:
    """Return the mean area that is nearest to an exterior link, over those that lie on the terrain."""
    down = designed.downstream
    # A cell that several reaches share goes to one of them.
    drawn = np.zeros(len(lattice.height), np.int64)
    drawn[cell] = leg
    owner = lattice.inner(drawn)[nearest[0], nearest[1]]
    outer = is_exterior(down)
    ground = lattice.inner(lattice.known)
    links = len(np.unique(link_heads(down)[leg[outer[leg]]]))
    return float((outer[owner] & ground).sum() * lattice.cell[0] * lattice.cell[1] / links)


def _raster(lattice: Lattice, cells: Index) -> Flags:
    flags = np.zeros(len(lattice.height), np.bool_)
    flags[cells] = True
    return np.asarray(lattice.inner(flags)).copy()


def _numbers(flags: Flags) -> Index:
    return np.flatnonzero(np.pad(flags, 1))


def _map(terrain: Elevation, flow: Flow, layers: list[Flags], names: list[str], context: Context) -> Image:
    rows, columns = terrain.shape
    side = max(rows, columns)
    scale = max(1.0, 800 / side) if side < 1600 else 1600 / side
    shape = max(1, round(rows * scale)), max(1, round(columns * scale))
    places = [flow.lattice.positions(_numbers(layer), terrain) for layer in layers]
    size = max(1.2, scale)
    pixels = painted(
        terrain.extent,
        shape,
        shaded(terrain, context),
        places,
        [size] * 3,
        ["#1f5fae", "#f08a1d", "#c8102e"],
        names,
    )
    return Image(pixels, terrain.extent)
