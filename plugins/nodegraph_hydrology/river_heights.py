"""Elevations of a river network: every node strictly above the one that it flows to."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Param, node
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.topology import hops, path_sums, reach_lengths, upstream_sums

Floats = npt.NDArray[np.float64]

LEAST = 1e-6
"""Least fall of a reach over the mean fall of all; keeps points on one spot apart."""


@node(version=1)
def river_heights(
    network: RiverNetwork,
    *,
    mode: Annotated[
        Literal["proportional", "concave"], Param("Straight profiles, or ones that steepen towards the sources.")
    ] = "proportional",
    relief: Annotated[float, Param("Height of the highest node above its outlet.", gt=0, le=1e5, unit="m")] = 1000.0,
    outlet_elevation: Annotated[float, Param("Elevation of the outlets.", ge=-1e5, le=1e5, unit="m")] = 0.0,
    concavity: Annotated[float, Param("theta of the slope-area law.", ge=0, le=2)] = 0.45,
    steepness: Annotated[
        float | None, Param("k_s of the slope-area law, m^(2 theta); none: what gives the relief.", gt=0)
    ] = None,
    hillslope: Annotated[
        float | None, Param("Area drained per length of river; none: hull over length.", gt=0, unit="m")
    ] = None,
    steepest: Annotated[
        float | None,
        Param("Greatest slope from a river to one beside it, across their divide; none: any.", gt=0, le=100),
    ] = None,
    least_fall: Annotated[
        float, Param("Share of its own fall that a river keeps where `steepest` lowers it.", gt=0, le=1)
    ] = 0.1,
) -> RiverNetwork:
    """Give every node of a river network an elevation.

    **proportional**: z = z_outlet + relief * d / d_max with d the distance to the outlet along the river, as printed.

    **concave**: the slope of a reach is S = k_s A^-theta (Flint 1974), with A the area that drains through its middle:
    the length of river above times `hillslope`, and hillslope^2 at a source.  theta is 0.4 to 0.6 in most steady
    rivers.  Given k_s, the relief follows; without it, k_s is what makes the relief.

    **steepest**: a long tributary may rise far above another river that passes its source at a stone's throw, and the
    divide between them would be a cliff.  With a greatest slope s the profiles are lowered to the highest ones that
    keep, for every two nodes p, q that are neighbours in the Delaunay triangulation, and for every reach,

        z(p) - z(q) <= s |p - q|,        fall >= f * fall without this rule, f = `least_fall`.

    Where both cannot be (a river that coils back beside itself) the fall is kept.  The highest heights under such
    bounds on differences are distances in a graph; h = z - f z_0 makes all its edges positive, so one run of
    Dijkstra's algorithm gives them.  The relief is then at most the one that is asked for.

    Every reach falls: one without length (points on one spot) by a millionth of the mean fall.  Several outlets lie on
    one elevation; the relief is that of the farthest or highest node of all.  Takes O(n log n) time, and for "concave"
    one array operation per reach of the longest path.

    Args:
        network: rivers.
        mode: of the profile.
        relief: ignored where the steepness is given.
        outlet_elevation: of all outlets.
        concavity: theta, 0 gives straight profiles.
        steepness: k_s.
        hillslope: 1 / drainage density; without it the area of the convex hull of all nodes over the length of rivers.
        steepest: s.
        least_fall: f.

    Raises:
        ValueError: a network without reaches or with a cycle, positions that are not finite, or heights beyond 100 km.

    Source: Zhang et al. 2016, section IV.C, doi:10.1109/ACCESS.2016.2612700; J. J. Flint (1974): Stream gradient as a
    function of order, magnitude, and discharge, doi:10.1029/WR010i005p00969.
    """
    down = network.downstream
    flows = down >= 0
    if not np.isfinite(network.position).all():
        raise ValueError("a node of the river network has a position that is not finite; give it coordinates in metres")
    hops(down)  # refuses cycles
    length = reach_lengths(network.position, down)
    if not length.any():
        raise ValueError("the river network has no river of any length; give it nodes that lie apart")
    if mode == "proportional":
        fall = length
    else:
        width = _hillslope(network.position, float(length.sum())) if hillslope is None else hillslope
        area = width * (upstream_sums(down, length) - length / 2 + width)
        fall = (steepness or 1.0) * area**-concavity * length
    fall = np.where(flows, np.maximum(fall, LEAST * float(fall[flows].mean())), 0.0)
    rise = path_sums(down, fall)
    if mode == "proportional" or steepness is None:
        rise *= relief / rise.max()
    if rise.max() > 1e5:
        raise ValueError(f"the highest node would lie {rise.max():.3g} m above its outlet; take a smaller steepness")
    if steepest is not None:
        rise = _lowered(network, rise, steepest, least_fall)
    return replace(network, elevation=outlet_elevation + rise)


def _lowered(network: RiverNetwork, rise: Floats, steepest: float, least_fall: float) -> Floats:
    """Return the greatest heights, none above `rise`, with no more than a slope between neighbours."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import dijkstra

    count, down = len(rise), network.downstream
    one, two = _neighbours(network.position)
    legs = network.position[one] - network.position[two]
    # h = z - f z_0: a reach asks that h does not rise downstream, and all edges have weights of 0 and more.
    kept = least_fall * rise
    across = np.maximum(steepest * np.hypot(legs[:, 0], legs[:, 1]) + kept[one] - kept[two], 0.0)
    flows = np.flatnonzero(down >= 0)
    start = np.concatenate([np.full(count, count), one, flows])
    stop = np.concatenate([np.arange(count), two, down[flows]])
    weight = np.concatenate([rise - kept, across, np.zeros(len(flows))])
    # Of several edges from one node to another the least counts, and SciPy takes stored zeros for edges.
    order = np.lexsort((weight, stop, start))
    first = np.ones(len(order), np.bool_)
    first[1:] = (np.diff(start[order]) != 0) | (np.diff(stop[order]) != 0)
    order = order[first]
    graph = coo_array((weight[order], (start[order], stop[order])), shape=(count + 1, count + 1)).tocsr()
    return np.asarray(dijkstra(graph, indices=count)[:count] + kept)


def _neighbours(position: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the edges of the Delaunay triangulation in both directions; points on one line have none."""
    from scipy.spatial import Delaunay, QhullError

    try:
        starts, ends = Delaunay(position - position.mean(axis=0)).vertex_neighbor_vertices
    except QhullError:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.repeat(np.arange(len(position)), np.diff(starts)), ends


def _hillslope(position: npt.NDArray[Any], length: float) -> float:
    """Return the area of the convex hull of all nodes over the length; a straight river drains half its length."""
    import shapely

    area = float(shapely.MultiPoint(position).convex_hull.area)
    return area / length if area > 1e-6 * length**2 else length / 2
