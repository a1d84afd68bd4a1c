"""Rivers for the ground that a network leaves without any."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.ridges import domain_of
from nodegraph_hydrology.topology import hops, reach_lengths
from nodegraph_hydrology.watersheds import sites_of
from nodegraph_terrain.polylines import Polylines

Floats = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

JITTER = 0.45
"""Greatest displacement of a point from its place on the lattice, over the spacing: none come to lie on another."""

LONGEST = 2.5
"""Longest new reach before it bends, over the spacing: longer edges run along the border of all points only."""

ROOM = 0.75
"""Least distance of a new point to a river, over the spacing."""

BEND = (0.2, 0.8)
"""How far the midpoint of a new reach moves, over the way to a centroid beside it."""

MOST = 1_000_000
"""Most new points."""


@node(version=1)
def headwaters(
    network: RiverNetwork,
    outline: Polylines | None = None,
    *,
    spacing: Annotated[
        float | None,
        Param("Between new rivers; none: the area of the domain over the length of rivers.", gt=0, unit="m"),
    ] = None,
    variety: Annotated[float, Param("Of what a way costs per length: 1 to 1 + variety.", ge=0, le=100)] = 2.0,
    seed: Annotated[int, Param("Another number grows other rivers.", ge=0)] = 0,  # noqa: ARG001
    context: Context,
) -> RiverNetwork:
    """Grow rivers into the ground that no river of a network drains.

    Networks that grow from lines leave land bare, beyond the tips of their branches most of all.  There the rain would
    find its own ways, and no ridge would part them: streams that nobody designed, on facets as wide as the gap.

    Points are strewn over the domain (a triangular lattice, jittered) wherever no river is nearer than 3/4 of the
    spacing, and half of it away from the border.  They and points on the rivers are triangulated (Delaunay); edges that
    cross a river, leave the domain, or are longer than 2.5 spacings are dropped.  A shortest-path tree from all rivers
    then says which way each point drains; every edge costs its length times a random number of 1 to 1 + `variety`,
    which makes the ways wind and join.  Points that no way leads to are left out.  At last every new reach bends: its
    midpoint moves by a random part of the way to the centroid of one of the two triangles beside it.

    No two rivers cross: no two edges do, and the parts of a triangle between its centroid and its sides, in which
    they bend, do not overlap.

    Rivers get nodes where new ones join, at most `spacing` apart; besides, they stay as they are.  Elevations of new
    nodes are unknown (NaN): link the result through `river_heights`.  Takes O(n log n) time for n nodes and points.

    Args:
        network: rivers; elevations do not matter, and do not stay.
        outline: closed lines around the domain, see `ridges`; without it a box around the rivers.
        spacing: distance between new rivers that run side by side, about.
        variety: 0 gives straight ways, 2 winding ones.
        seed: of jitter and costs.
        context: the engine's.

    Raises:
        ValueError: a network without rivers of any length, an outline that is no plain area in metres around the
            rivers, or over a million points.

    References:
        I. Rodriguez-Iturbe, A. Rinaldo (1997): Fractal River Basins, Cambridge University Press, section 1.3 (random
        spanning trees as models of drainage).
    """
    import shapely

    if not np.isfinite(network.position).all():
        raise ValueError("a node of the river network has a position that is not finite; give it coordinates in metres")
    hops(network.downstream)  # refuses cycles
    length = float(reach_lengths(network.position, network.downstream).sum())
    if length <= 0:
        raise ValueError("the river network has no river of any length; give it nodes that lie apart")
    domain = domain_of(network, outline)
    apart = spacing or float(domain.area) / length
    lattice = _lattice(domain, apart, context)
    sites = sites_of(RiverNetwork(network.position, network.downstream, np.zeros(len(network.position))), apart)
    rivers = shapely.linestrings(sites.position[sites.pieces])
    fresh = _bare(lattice, rivers, apart)
    context.progress(0.3, "points")
    points = np.concatenate([sites.position, fresh])
    downstream = np.full(len(points), -1, np.int64)
    downstream[sites.pieces[:, 0]] = sites.pieces[:, 1]
    old = len(sites.position)
    if len(fresh):
        triangles = _triangles(points)
        edges = _edges(triangles, old)
        legs = points[edges[:, 0]] - points[edges[:, 1]]
        edges = _free(edges[np.hypot(legs[:, 0], legs[:, 1]) <= LONGEST * apart], points, rivers, domain)
        context.progress(0.6, "ways")
        downstream[old:] = _ways(points, edges, old, variety, context.rng)[old:]
        joined = np.flatnonzero(downstream[old:] >= 0) + old
        reach = np.stack([joined, downstream[joined]], axis=1)
        middle = _bent(points, triangles, reach, rivers, domain, context.rng)
        downstream[joined] = len(points) + np.arange(len(joined))
        points, downstream = np.concatenate([points, middle]), np.concatenate([downstream, reach[:, 1]])
    kept = np.ones(len(points), np.bool_)
    kept[old : old + len(fresh)] = downstream[old : old + len(fresh)] >= 0
    number = np.append(np.cumsum(kept) - 1, -1)
    return RiverNetwork(
        points[kept], number[downstream[kept]].astype(np.int32), np.full(int(kept.sum()), np.nan), network.crs
    )


def _lattice(domain: Any, apart: float, context: Context) -> Floats:
    """Return jittered points of a triangular lattice, inside of a domain by half their distance."""
    import shapely

    west, south, east, north = domain.bounds
    rise = apart * 0.75**0.5
    columns, rows = int((east - west) / apart) + 2, int((north - south) / rise) + 2
    if columns * rows > MOST:
        raise ValueError(f"the domain would get {columns * rows:.3g} points, over {MOST:,}; take a larger spacing")
    row, column = np.divmod(np.arange(columns * rows), columns)
    lattice = np.stack([west + (column + 0.5 * (row % 2)) * apart, south + row * rise], axis=1)
    turn, far = context.rng.random((2, len(lattice)))
    angle, reach = 2 * np.pi * turn, JITTER * apart * np.sqrt(far)
    lattice += np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    inner = domain.buffer(-apart / 2)
    return np.asarray(lattice[shapely.contains_xy(inner, lattice[:, 0], lattice[:, 1])])


def _bare(points: Floats, rivers: npt.NDArray[Any], apart: float) -> Floats:
    """Return the points that no river comes near."""
    import shapely

    near = shapely.STRtree(rivers).query(shapely.points(points), predicate="dwithin", distance=ROOM * apart)[0]
    return np.delete(points, near, axis=0)


def _triangles(points: Floats) -> Index:
    from scipy.spatial import Delaunay

    return np.asarray(Delaunay(points - points.mean(axis=0)).simplices, np.int64)


def _sides(triangles: Index) -> Index:
    """Return the sides (3 t, 2) of triangles, lower number first: those opposite the first corners, the second ..."""
    return np.sort(np.concatenate([triangles[:, [1, 2]], triangles[:, [2, 0]], triangles[:, [0, 1]]]), axis=1)


def _edges(triangles: Index, old: int) -> Index:
    """Return the edges (k, 2) that have a new point at one end or both."""
    edges = np.unique(_sides(triangles), axis=0)
    return np.asarray(edges[edges[:, 1] >= old])


def _free(edges: Index, points: Floats, rivers: npt.NDArray[Any], domain: Any) -> Index:
    """Return the edges that cross no river and stay in the domain."""
    import shapely

    lines = shapely.linestrings(points[edges])
    return np.asarray(edges[~_crossing(lines, rivers) & shapely.covers(domain, lines)])


def _crossing(lines: npt.NDArray[Any], rivers: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    import shapely

    blocked = np.zeros(len(lines), np.bool_)
    blocked[shapely.STRtree(rivers).query(lines, predicate="crosses")[0]] = True
    return blocked


def _bent(
    points: Floats, triangles: Index, reach: Index, rivers: npt.NDArray[Any], domain: Any, rng: np.random.Generator
) -> Floats:
    """Return the displaced midpoints of edges; the plain ones where a bend would meet a river or the border."""
    import shapely

    count = len(points)
    sides = _sides(triangles)
    key = sides[:, 0] * count + sides[:, 1]
    # Of the two triangles beside an edge, the first in a random order.
    order = np.lexsort((rng.random(len(key)), key))
    low, high = reach.min(axis=1), reach.max(axis=1)
    chosen = order[np.searchsorted(key[order], low * count + high)] % len(triangles)
    ends = points[reach]
    middle = ends.mean(axis=1)
    share = rng.uniform(*BEND, len(middle))[:, None]
    moved = (1 - share) * middle + share * points[triangles[chosen]].mean(axis=1)
    lines = shapely.linestrings(np.stack([ends[:, 0], moved, ends[:, 1]], axis=1))
    blocked = _crossing(lines, rivers) | ~shapely.covers(domain, lines)
    return np.asarray(np.where(blocked[:, None], middle, moved))


def _ways(points: Floats, edges: Index, old: int, variety: float, rng: np.random.Generator) -> Index:
    """Return the point that each one drains to on its cheapest way to any of the `old` first; -1 for these."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    legs = points[edges[:, 0]] - points[edges[:, 1]]
    cost = np.hypot(legs[:, 0], legs[:, 1]) * (1 + variety * rng.random(len(edges)))
    graph = coo_array((cost, edges.T), shape=(len(points), len(points))).tocsr()
    _, before, _ = dijkstra(graph, directed=False, indices=np.arange(old), min_only=True, return_predecessors=True)
    return np.where(before >= 0, before, -1)
