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
) -> RiverNetwork:
    """Give every node of a river network an elevation.

    **proportional**: z = z_outlet + relief * d / d_max with d the distance to the outlet along the river, as printed.

    **concave**: the slope of a reach is S = k_s A^-theta (Flint 1974), with A the area that drains through its middle:
    the length of river above times `hillslope`, and hillslope^2 at a source.  theta is 0.4 to 0.6 in most steady
    rivers.  Given k_s, the relief follows; without it, k_s is what makes the relief.

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
    return replace(network, elevation=outlet_elevation + rise)


def _hillslope(position: npt.NDArray[Any], length: float) -> float:
    """Return the area of the convex hull of all nodes over the length; a straight river drains half its length."""
    import shapely

    area = float(shapely.MultiPoint(position).convex_hull.area)
    return area / length if area > 1e-6 * length**2 else length / 2
