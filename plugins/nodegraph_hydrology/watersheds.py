"""Watersheds of a river network: the edges of the Voronoi diagram of its points that part one river from another.

The diagram is the dual of the Delaunay triangulation of *sites*: the nodes of the network, and points in between where
reaches are long.  Four ghost sites far away enclose the rest: within the domain they own nothing, and every Voronoi
vertex there is the centre of a triangle of three true sites, which are the three nearest.

An edge is a watershed unless its two sites follow each other on a river, or a river crosses it.  A reach whose
diametral circle holds no other site (a Gabriel edge) can be crossed by the edge between its own ends only, so the exact
test is needed for the few other reaches.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.topology import distance_to_outlet, link_heads, reach_lengths

Floats = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

MOST_SITES = 5_000_000
"""More sites than this are refused as a mistake."""

FAR = 8.0
"""Distance of the ghost sites from the middle, over the size of domain and rivers."""

CONTACT = 1e-9
"""Distance below which things touch, over the size of the domain or of the rivers."""


@dataclass(frozen=True)
class Sites:
    """Points on rivers, no two on one spot.

    Attributes:
        position: (n, 2) m.
        elevation: (n,) m; of several nodes on one spot the highest.
        pieces: (k, 2) the sites at both ends of each piece of river, downstream.
        link: (n,) the link of the network that each lies on, as the number of the node at its head.
        below: (n,) the link that this one flows into, -1 at an outlet.
        distance: (n,) m, to the outlet along the river.
    """

    position: Floats
    elevation: Floats
    pieces: Index
    link: Index
    below: Index
    distance: Floats


@dataclass(frozen=True)
class Watersheds:
    """Segments between points, with what the heights of the points follow from.

    Attributes:
        points: (n, 2) m.
        nearest: (n, 3) the three sites nearest to each point; where there are fewer, the last is repeated.
        inner: (k, 2) points at both ends of every watershed edge.
        border: (m, 2) the same of the outline of the domain, without the stretches where rivers leave it.
    """

    points: Floats
    nearest: Index
    inner: Index
    border: Index


def sites_of(network: RiverNetwork, spacing: float) -> Sites:
    """Return the nodes of a network, and points on its reaches so that no two neighbours are over `spacing` apart."""
    down = network.downstream.astype(np.int64)
    flows = np.flatnonzero(down >= 0)
    wanted = np.maximum(np.ceil(reach_lengths(network.position, down)[flows] / spacing - 1e-9), 1)
    if len(down) + wanted.sum() > MOST_SITES:
        raise ValueError(f"the rivers would get {wanted.sum():.3g} points, over {MOST_SITES:,}; take a larger spacing")
    count = wanted.astype(np.int64)
    owner = np.repeat(np.arange(len(flows)), count)
    step = np.arange(len(owner)) - (np.cumsum(count) - count)[owner]
    # Point number `step` of a reach is its node at first, then a new one.
    number = np.where(step == 0, flows[owner], 0)
    fresh = np.flatnonzero(step > 0)
    number[fresh] = len(down) + np.arange(len(fresh))
    following = np.append(number[1:], 0)
    last = step == count[owner] - 1
    following[last] = down[flows[owner[last]]]
    share = (step / count[owner])[fresh]
    upper, lower = flows[owner[fresh]], down[flows[owner[fresh]]]
    x, y = ((1 - share) * values[upper] + share * values[lower] for values in network.position.T)
    z = (1 - share) * network.elevation[upper] + share * network.elevation[lower]
    position = np.concatenate([network.position, np.stack([x, y], axis=1)])
    # Where rivers cross, points of both may differ by rounding alone; a triangulation would drop one of them.
    low, high = position.min(axis=0), position.max(axis=0)
    grain = CONTACT * float(np.hypot(*(high - low)))
    column, row = np.rint((position - low) / grain).T
    _, kept, place = np.unique(column + 1j * row, return_index=True, return_inverse=True)
    elevation = np.full(len(kept), -np.inf)
    np.maximum.at(elevation, place, np.concatenate([network.elevation, z]))
    pieces = np.stack([place[number], place[following]], axis=1)
    pieces = pieces[pieces[:, 0] != pieces[:, 1]]
    source = np.concatenate([np.arange(len(down)), upper])[kept]
    far = distance_to_outlet(network.position, down)
    distance = np.concatenate([far, (1 - share) * far[upper] + share * far[lower]])[kept]
    link = link_heads(down)
    ends = np.flatnonzero((down >= 0) & (link[down] != link))
    below = np.full(len(down), -1, np.int64)
    below[link[ends]] = link[down[ends]]
    return Sites(position[kept], elevation, pieces, link[source], below[link[source]], distance)


def watersheds(sites: Sites, domain: Any, spacing: float, detour: float) -> Watersheds:
    """Return the watersheds of rivers within a domain, a shapely polygon, and its border as a closing one.

    Takes O(n log n) time for n sites.
    """
    import shapely

    centre, corners, edge, between, suspects = _voronoi(sites, domain.bounds)
    edge, between = _welded(centre, edge, between, sites.elevation[corners.T].max(axis=0))
    rivers = shapely.linestrings(sites.position[sites.pieces])
    inside = shapely.contains_xy(domain, centre[:, 0], centre[:, 1])
    # A domain that bulges inwards may be left in between.
    whole = inside[edge[:, 0]] & inside[edge[:, 1]]
    if domain.area < (1 - 1e-12) * domain.convex_hull.area:
        lines = shapely.linestrings(centre[edge])
        whole &= ~shapely.intersects(domain.boundary, lines)
    kept = _parting(sites, between, detour)
    clear = edge[kept & whole]
    cut, at, hits = _clipped(centre, edge[kept & ~whole], domain)
    line, border = _border(domain, hits, rivers, spacing)
    points = np.concatenate([centre, at, line])
    inner = _uncrossed(np.concatenate([clear, cut]), points, rivers[suspects], domain)
    new = points[len(centre) :]
    nearest = np.concatenate([corners, _nearest(sites, new)])
    return _compact(points, nearest, inner, border + len(centre) + len(at))


def _voronoi(sites: Sites, bounds: tuple[float, ...]) -> tuple[Floats, Index, Index, Index, Flags]:
    """Return the Voronoi diagram of sites, by the Delaunay triangulation.

    Returns:
        centres (t, 2) of triangles, their corners (t, 3), the two centres at the ends of each edge, the two sites
        beside it, and which pieces of river are no Gabriel edges.
    """
    from scipy.spatial import Delaunay

    points = sites.position
    low = np.minimum(points.min(axis=0), bounds[:2])
    high = np.maximum(points.max(axis=0), bounds[2:])
    middle, size = (low + high) / 2, float(np.hypot(*(high - low)))
    ghosts = FAR * np.array([[1.0, 0.3], [-0.3, 1.0], [-1.0, -0.3], [0.3, -1.0]])
    count = len(points)
    # About the origin: Qhull and the circles then lose no digits to the coordinates' size.
    local = np.concatenate([(points - middle) / size, ghosts])
    mesh = Delaunay(local)
    corners = mesh.simplices.astype(np.int64)
    centre = _circumcentres(*local[corners.T])
    # Edge k of triangle t is opposite its corner k; each is taken from the triangle of higher number.
    triangle, opposite = np.nonzero(mesh.neighbors < np.arange(len(corners))[:, None])
    other = mesh.neighbors[triangle, opposite].astype(np.int64)
    real = other >= 0
    triangle, opposite, other = triangle[real], opposite[real], other[real]
    one = corners[triangle, (opposite + 1) % 3]
    two = corners[triangle, (opposite + 2) % 3]
    far = corners[other]
    apex = (corners[triangle, opposite], far[:, 0] + far[:, 1] + far[:, 2] - one - two)
    acute = np.ones(len(one), np.bool_)
    for tip in apex:
        u, v = local[one] - local[tip], local[two] - local[tip]
        # Right angles are left to the exact test: on a lattice they are frequent.
        acute &= _dot(u, v) > CONTACT * (_dot(u, u) + _dot(v, v))
    keys = np.sort(_keys(one[acute], two[acute], count + 4))
    suspects = ~_among(_keys(sites.pieces[:, 0], sites.pieces[:, 1], count + 4), keys)
    true = (one < count) & (two < count)
    edge = np.stack([triangle, other], axis=1)[true]
    corners = np.minimum(corners, count - 1)
    return middle + size * centre, corners, edge, np.stack([one, two], axis=1)[true], suspects


def _welded(centre: Floats, edge: Index, between: Index, height: Floats) -> tuple[Index, Index]:
    """Join the centres of triangles that lie on one circle, as on a lattice, to the one that is highest."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    legs = centre[edge[:, 0]] - centre[edge[:, 1]]
    size = np.maximum(*np.abs(centre).T)
    tiny = np.hypot(legs[:, 0], legs[:, 1]) <= CONTACT * size[edge[:, 0]]
    if not tiny.any():
        return edge, between
    one, two = edge[tiny].T
    graph = coo_array((np.ones(len(one)), (one, two)), shape=(len(centre), len(centre)))
    parts, part = connected_components(graph, directed=False)
    # The last to be written stays.
    order = np.argsort(height, kind="stable")
    chosen = np.empty(parts, np.int64)
    chosen[part[order]] = order
    return chosen[part[edge[~tiny]]], between[~tiny]


def _circumcentres(a: Floats, b: Floats, c: Floats) -> Floats:
    ab, ac = b - a, c - a
    across = 2 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    # Slivers on the rim of collinear points have their centre far away; it only has to be outside.
    across = np.where(np.abs(across) < 1e-14, np.copysign(1e-14, across), across)
    p, q = _dot(ab, ab), _dot(ac, ac)
    x = (ac[:, 1] * p - ab[:, 1] * q) / across
    y = (ab[:, 0] * q - ac[:, 0] * p) / across
    return np.asarray(a + np.stack([x, y], axis=1))


def _dot(u: Floats, v: Floats) -> Floats:
    return np.asarray(np.einsum("ij,ij->i", u, v))


def _keys(one: Index, two: Index, count: int) -> Index:
    """Return a number for every pair of numbers below `count`, the same for both orders."""
    return np.asarray(np.minimum(one, two) * count + np.maximum(one, two))


def _among(wanted: Index, ordered: Index) -> Flags:
    if not len(ordered):
        return np.zeros(len(wanted), np.bool_)
    place = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
    return np.asarray(ordered[place] == wanted)


def _parting(sites: Sites, between: Index, detour: float) -> Flags:
    """Return which edges part sites that do not follow each other on a river, nor lie in one gentle bend of it."""
    count = len(sites.position)
    one, two = between.T
    parting = ~_among(_keys(one, two, count), np.sort(_keys(sites.pieces[:, 0], sites.pieces[:, 1], count)))
    link, below = sites.link, sites.below
    along = (link[one] == link[two]) | (link[one] == below[two]) | (link[two] == below[one])
    legs = sites.position[one] - sites.position[two]
    way = np.abs(sites.distance[one] - sites.distance[two])
    bend = along & (way < detour * np.hypot(legs[:, 0], legs[:, 1])) & (detour > 1)
    return np.asarray(parting & ~bend)


def _uncrossed(segments: Index, points: Floats, rivers: npt.NDArray[Any], domain: Any) -> Index:
    """Return the segments that have a length and touch none of these pieces of river."""
    import shapely

    segments = segments[~_same(points, segments)]
    lines = shapely.linestrings(points[segments])
    keep = np.ones(len(segments), np.bool_)
    west, south, east, north = domain.bounds
    contact = CONTACT * float(np.hypot(east - west, north - south))
    keep[shapely.STRtree(rivers).query(lines, predicate="dwithin", distance=contact)[0]] = False
    return segments[keep]


def _same(points: Floats, segments: Index) -> Flags:
    """Return which segments begin and end on one spot."""
    x, y = (points[segments[:, 0]] == points[segments[:, 1]]).T
    return np.asarray(x & y)


def _clipped(centre: Floats, edge: Index, domain: Any) -> tuple[Index, Floats, Floats]:
    """Return the parts of edges within a domain, the points that they have beyond `centre`, and those on the border."""
    import shapely

    boxes = np.concatenate([centre[edge].min(axis=1), centre[edge].max(axis=1)], axis=1)
    west, south, east, north = domain.bounds
    near = (boxes[:, 0] <= east) & (boxes[:, 1] <= north) & (boxes[:, 2] >= west) & (boxes[:, 3] >= south)
    edge = edge[near]
    cut = shapely.intersection(shapely.linestrings(centre[edge]), domain)
    parts, owner = shapely.get_parts(cut, return_index=True)
    long = (shapely.get_type_id(parts) == 1) & (shapely.length(parts) > 0)
    ends = shapely.get_coordinates(parts[long]).reshape(-1, 2, 2)
    owner = owner[long]
    number = np.full(ends.shape[:2], -1, np.int64)
    for side in (0, 1):
        own = edge[owner, side]
        same = (ends == centre[own][:, None]).all(axis=2)
        number = np.where(same, own[:, None], number)
    fresh = number < 0
    at = ends[fresh]
    number[fresh] = len(centre) + np.arange(len(at))
    return number, at, at


def _border(domain: Any, hits: Floats, rivers: npt.NDArray[Any], spacing: float) -> tuple[Floats, Index]:
    """Return points along the outline, the ends of watersheds among them, and the segments that no river touches."""
    import shapely

    points, segments = [], []
    count = 0
    rings = shapely.get_parts(shapely.get_rings(domain))
    where = shapely.points(hits)
    home = np.argmin([shapely.distance(ring, where) for ring in rings], axis=0) if len(hits) else np.zeros(0, np.int64)
    for number, ring in enumerate(rings):
        corners = shapely.get_coordinates(ring)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
        own = hits[home == number]
        pieces = max(int(np.ceil(along[-1] / spacing)), 1)
        regular = along[-1] * np.arange(pieces) / pieces
        place = np.concatenate([along[:-1], shapely.line_locate_point(ring, shapely.points(own)), regular])
        spots = np.concatenate(
            [corners[:-1], own, shapely.get_coordinates(shapely.line_interpolate_point(ring, regular))]
        )
        order = np.argsort(place, kind="stable")
        # A regular point right beside another is not needed.
        needless = order >= len(corners) - 1 + len(own)
        gap = np.minimum(np.diff(place[order], prepend=-np.inf), np.diff(place[order], append=np.inf))
        order = order[~(needless & (gap < spacing / 1000))]
        spots = spots[order]
        points.append(spots)
        run = count + np.arange(len(spots))
        segments.append(np.stack([run, np.roll(run, -1)], axis=1))
        count += len(spots)
    border, ends = np.concatenate(points), np.concatenate(segments)
    ends = ends[~_same(border, ends)]
    tree = shapely.STRtree(shapely.linestrings(border[ends]))
    size = float(np.hypot(*np.ptp(border, axis=0)))
    touched = tree.query(rivers, predicate="dwithin", distance=CONTACT * size)[1]
    return border, np.delete(ends, touched, axis=0)


def _nearest(sites: Sites, points: Floats) -> Index:
    from scipy.spatial import cKDTree

    count = len(sites.position)
    found = cKDTree(sites.position).query(points, k=[1, 2, 3])[1]
    return np.asarray(np.where(found < count, found, found[:, :1]), np.int64)


def _compact(points: Floats, nearest: Index, inner: Index, border: Index) -> Watersheds:
    """Leave out the points that no segment uses."""
    used = np.zeros(len(points), np.bool_)
    used[inner] = used[border] = True
    number = np.cumsum(used) - 1
    return Watersheds(points[used], nearest[used], number[inner], number[border])
