"""Ridges between the rivers of a network."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node
from nodegraph_hydrology.crossings import Domain
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.topology import basins, hops, reach_lengths
from nodegraph_hydrology.watersheds import Sites, Watersheds, sites_of, watersheds
from nodegraph_terrain.noise import MOST, Noise
from nodegraph_terrain.polylines import Polylines, Property

Floats = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

MARGIN = 0.05
"""Distance from the outermost rivers to the border of the domain where no outline is given, over its longer side."""


@node(version=1)
def ridges(
    network: RiverNetwork,
    outline: Polylines | None = None,
    *,
    alpha: Annotated[float, Param("Rise of a ridge per distance from its rivers (eq. 4).", gt=0, le=10)] = 0.5,
    nearest: Annotated[int, Param("Points of rivers that a ridge overlooks (eq. 4).", ge=3, le=100)] = 3,
    spacing: Annotated[
        float | None, Param("Of points on rivers and ridges; none: the median reach.", gt=0, unit="m")
    ] = None,
    detour: Annotated[
        float, Param("Least way along a river between two points, over the straight one, for a ridge.", ge=1, le=100)
    ] = 1.57,
    roughness: Annotated[float, Param("Amplitude of noise over the rise of a ridge (eq. 5).", ge=0, le=1)] = 0.3,
    wavelength: Annotated[
        float | None, Param("Of the first octave; none: 24 times the spacing.", gt=0, unit="m")
    ] = None,
    octaves: Annotated[int, Param("Scales of noise; those finer than the spacing do little.", ge=1, le=MOST)] = 4,
    seed: Annotated[int, Param("Of the noise.", ge=0, le=0xFFFFFFFF)] = 0,
    context: Context,
) -> Polylines:
    """Find the ridges that part the rivers of a network, with heights.

    Ridges are edges of the Voronoi diagram of points on the rivers: the nodes, and points between so that none are
    further apart than `spacing`.  An edge is a ridge unless its two points follow each other on a river, or a river
    crosses it.  (The paper keeps what no river crosses; on a general network that disagrees with the adjacency of
    rivers on about a quarter of the edges.)  Where both points lie on one link, or on a link and the one that it flows
    into, the way along the river must be at least `detour` times the straight one: otherwise every bend has a spur on
    its inside.  1 keeps the spurs; pi/2, about the default, is a half circle.  Ridges are cut at the border of the
    domain, and the border closes them: it is a ridge too, open where a river leaves the domain.  No ridge meets a
    river.

    The height of a point q is, with p_i the `nearest` points of rivers and d the distance to the closest (eq. 4),

        z(q) = max_i z(p_i) + alpha d,

    linear between, plus fractal noise F (eq. 5).  Here F is `roughness` times the rise alpha d times a sum of
    gradient noise within -1 and 1, where the paper adds a noise of a fixed amplitude: a low ridge is rough in
    proportion, and none sinks below its rivers.

    Takes O(n log n) time for n points.

    Args:
        network: rivers with elevations.
        outline: closed lines around the domain (a line within a line is a hole); without it a box around all rivers,
            a twentieth of its longer side away from them, but right through outlets on their outermost side.
        alpha: tangent of the slope from river to ridge, about.
        nearest: k of eq. 4, 3 in the paper.
        spacing: smaller follows bends more closely.
        detour: see above.
        roughness: 0 is without noise, 1 may bring a ridge down to its rivers.
        wavelength: size of the largest ups and downs along a ridge.
        octaves: each half as long and half as high as the one before.
        seed: another one gives other ups and downs.
        context: the engine's.

    Returns:
        Lines from junction to junction with heights as third coordinate, and the property ``border``: whether they
        are part of the border of the domain.

    Raises:
        ValueError: nodes without elevation, no river of any length, or an outline that is no plain area in metres
            around the rivers.

    Source: Zhang et al. 2016, section V.A, doi:10.1109/ACCESS.2016.2612700; eq. 4 from J.-D. Genevaux et al. (2013):
    Terrain generation using procedural models based on hydrology, doi:10.1145/2461912.2461996.
    """
    length = _checked(network)
    spacing = spacing or float(np.median(length[length > 0]))
    sites = sites_of(network, spacing)
    context.progress(0.1, "points on rivers")
    domain = domain_of(network, outline)
    parts = watersheds(sites, domain, spacing, detour)
    context.progress(0.6, "watersheds")
    height, rise = _heights(parts, sites, alpha, nearest)
    count = len(parts.inner)
    points, segments, owner = _divided(parts, np.column_stack([parts.points, height, rise]), spacing)
    if roughness:
        noise = Noise("fbm", octaves, wavelength or 24 * spacing, seed=seed)
        points[:, 2] += roughness * points[:, 3] * noise.value(points[:, 0], points[:, 1])
    context.progress(0.8, "heights")
    inner, inner_sizes = _joined(segments[owner < count], len(points))
    border, border_sizes = _joined(segments[owner >= count], len(points))
    offsets = np.cumsum(np.concatenate([[0], inner_sizes, border_sizes]))
    flags = np.arange(len(offsets) - 1) >= len(inner_sizes)
    lines = points[np.concatenate([inner, border]), :3]
    return Polylines(lines, offsets, (Property("border", flags),), network.crs)


def _checked(network: RiverNetwork) -> Floats:
    """Return the lengths of the reaches of a network that can have ridges."""
    for values, what in ((network.position, "position"), (network.elevation, "elevation")):
        bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        if bad.any():
            raise ValueError(
                f"node {int(np.argmax(bad))} of the river network has no {what}; "
                "link it through hydrology.river_heights"
            )
    hops(network.downstream)  # refuses cycles
    length = reach_lengths(network.position, network.downstream)
    if not length.any():
        raise ValueError("the river network has no river of any length; give it nodes that lie apart")
    return length


def domain_of(network: RiverNetwork, outline: Polylines | None) -> Any:
    """Return the area that gets ridges, as a shapely polygon."""
    import shapely

    if outline is None:
        return shapely.box(*_box(network))
    if outline.unit != "m":
        raise ValueError("the outline is in degrees; load it with a target_crs in metres")
    if outline.crs and network.crs and outline.crs != network.crs:
        raise ValueError("rivers and outline have different coordinate systems; load both with one target_crs")
    if not len(outline) or not outline.closed.all():
        raise ValueError("the outline must be closed lines, each with its first point again as its last")
    domain = Domain([ring[:, :2] for ring in outline.lines()]).shape
    if not shapely.intersects_xy(domain, *network.position.T).any():
        raise ValueError("no node of the river network lies within the outline; draw it around the rivers")
    return domain


def _box(network: RiverNetwork) -> tuple[float, float, float, float]:
    low, high = network.position.min(axis=0), network.position.max(axis=0)
    margin = MARGIN * float((high - low).max())
    mouths = network.position[network.downstream < 0]
    west, south = np.where((mouths == low).any(axis=0), low, low - margin).tolist()
    east, north = np.where((mouths == high).any(axis=0), high, high + margin).tolist()
    # Rivers that all run along one side leave no room there.
    return west, south, east if east > west else west + margin, north if north > south else south + margin


def _heights(parts: Watersheds, sites: Sites, alpha: float, nearest: int) -> tuple[Floats, Floats]:
    """Return the height of every point by eq. 4, and how much of it is the rise above its rivers."""
    around = parts.nearest
    legs = parts.points - sites.position[around[:, 0]]
    if nearest > 3:
        from scipy.spatial import cKDTree

        count = min(nearest, len(sites.position))
        around = cKDTree(sites.position).query(parts.points, k=np.arange(1, count + 1))[1]
    rise = alpha * np.hypot(legs[:, 0], legs[:, 1])
    return np.asarray(sites.elevation[around].max(axis=1) + rise), np.asarray(rise)


def _divided(parts: Watersheds, points: Floats, spacing: float) -> tuple[Floats, Index, Index]:
    """Return points and segments, none longer than the spacing, and the number of the segment that each is part of."""
    segments = np.concatenate([parts.inner, parts.border])
    legs = parts.points[segments[:, 1]] - parts.points[segments[:, 0]]
    count = np.maximum(np.ceil(np.hypot(legs[:, 0], legs[:, 1]) / spacing - 1e-9), 1).astype(np.int64)
    owner = np.repeat(np.arange(len(segments)), count)
    step = np.arange(len(owner)) - (np.cumsum(count) - count)[owner]
    start = segments[owner, 0]
    fresh = np.flatnonzero(step > 0)
    share = (step / count[owner])[fresh, None]
    between = (1 - share) * points[start[fresh]] + share * points[segments[owner[fresh], 1]]
    start[fresh] = len(points) + np.arange(len(fresh))
    stop = np.append(start[1:], 0)
    last = step == count[owner] - 1
    stop[last] = segments[owner[last], 1]
    return np.concatenate([points, between]), np.stack([start, stop], axis=1), owner


def _joined(segments: Index, count: int) -> tuple[Index, Index]:
    """Join segments to lines from junction to junction; return the points of all lines, and how many each has.

    Every segment is two directed halves, and a half goes on with the one that leaves its end, where there is one other.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    number = len(segments)
    start, stop = np.concatenate([segments, segments[:, ::-1]]).T
    twin = np.roll(np.arange(2 * number), number)
    through = np.bincount(start, minlength=count) == 2
    graph = coo_array((np.ones(number), segments.T), shape=(count, count))
    parts, part = connected_components(graph, directed=False)
    # A ring without any junction begins at its first point.
    ring = np.bincount(part, through, parts) == np.bincount(part, minlength=parts)
    first = np.unique(part, return_index=True)[1]
    through[first[ring]] = False
    leaving = np.bincount(start, np.arange(2 * number), count).astype(np.int64)
    following = np.where(through[stop], leaving[stop] - twin, -1)
    left, last = hops(following), basins(following)
    begins = np.flatnonzero(~through[start])
    # Of the two directions of a line, the one that begins with the lower half.
    begins = begins[begins < twin[last[begins]]]
    rank = np.full(2 * number, -1, np.int64)
    rank[last[begins]] = np.arange(len(begins))
    chosen = np.flatnonzero(rank[last] >= 0)
    chosen = chosen[np.lexsort((-left[chosen], rank[last[chosen]]))]
    sizes = np.bincount(rank[last[chosen]], minlength=len(begins)) + 1
    ends = np.cumsum(sizes) - 1
    points = np.empty(int(sizes.sum()), np.int64)
    inner = np.ones(len(points), np.bool_)
    inner[ends] = False
    points[inner], points[ends] = start[chosen], stop[last[begins]]
    return points, sizes
