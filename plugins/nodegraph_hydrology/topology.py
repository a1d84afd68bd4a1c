"""What follows from the topology of a river network: orders, links, distances, basins.

Every node stands for the *reach* from it down to the node that it flows to, so an order at a node is that of the reach
which leaves it; an outlet has the order of what arrives.  All functions take the array `downstream` (-1: outlet), work
on whole arrays and take O(n log n) time: paths are summed by pointer doubling, trees level by level of their links.

References:
    A. N. Strahler (1957): Quantitative analysis of watershed geomorphology. doi:10.1029/TR038i006p00913.
    R. L. Shreve (1966): Statistical law of stream numbers. J. Geology 74. doi:10.1086/627137.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Index = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Downstream = npt.NDArray[Any]


def inflows(downstream: Downstream) -> Index:
    """Return how many reaches arrive at each node: 0 at a source, 2 and more at a confluence."""
    down = np.asarray(downstream)
    return np.bincount(down[down >= 0], minlength=len(down))


def hops(downstream: Downstream) -> Index:
    """Return the number of reaches from each node down to its outlet.

    Raises:
        ValueError: water of some node never arrives, because the network has a cycle.
    """
    return path_sums(downstream, (np.asarray(downstream) >= 0).astype(np.int64))


def path_sums(downstream: Downstream, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return for each node the sum of `values` over it and all nodes below it, by pointer doubling.

    Raises:
        ValueError: the network has a cycle.
    """
    total, jump = values.copy(), np.asarray(downstream).astype(np.int64)
    for _ in range(max(len(jump), 1).bit_length() + 1):
        going = np.flatnonzero(jump >= 0)
        if not len(going):
            return total
        target = jump[going]
        total[going] += total[target]
        jump[going] = jump[target]
    raise ValueError(f"the river network has a cycle: node {int(np.flatnonzero(jump >= 0)[0])} never reaches an outlet")


def upstream_order(downstream: Downstream) -> Index:
    """Return the nodes in an order in which each comes after the one it flows to: outlets first."""
    return np.argsort(hops(downstream), kind="stable")


def basins(downstream: Downstream) -> Index:
    """Return the outlet that each node drains to, as the number of that node."""
    hops(downstream)  # refuses cycles
    return _followed(np.asarray(downstream).astype(np.int64))


def reach_lengths(position: npt.NDArray[Any], downstream: Downstream) -> Floats:
    """Return the length of the reach from each node to the next, m; 0 at an outlet."""
    down = np.asarray(downstream)
    legs = position - position[np.where(down >= 0, down, np.arange(len(down)))]
    return np.asarray(np.hypot(legs[:, 0], legs[:, 1]))


def distance_to_outlet(position: npt.NDArray[Any], downstream: Downstream) -> Floats:
    """Return the distance from each node to its outlet along the river, m."""
    return np.asarray(path_sums(downstream, reach_lengths(position, downstream)), np.float64)


def link_heads(downstream: Downstream) -> Index:
    """Return the link that each node belongs to, as the number of the node at its upper end.

    A link is the run of reaches from a source or confluence down to the next confluence or outlet.  An outlet belongs
    to the link that arrives; one where several arrive, or none, is a link of its own without length.
    """
    down = np.asarray(downstream).astype(np.int64)
    hops(down)  # refuses cycles
    above = np.full(len(down), -1, np.int64)
    flowing = np.flatnonzero(down >= 0)
    above[down[flowing]] = flowing
    above[inflows(down) != 1] = -1
    return _followed(above)


def strahler_order(downstream: Downstream) -> Index:
    """Return the Strahler order: 1 at sources, one more than the greatest where that arrives at least twice."""
    heads, levels, below = _link_levels(downstream)
    order = np.ones(len(heads), np.int64)
    best, twice = np.zeros(len(heads), np.int64), np.zeros(len(heads), np.bool_)
    for level in reversed(levels):
        known = best[level] > 0
        order[level] = np.where(known, best[level] + twice[level], 1)
        flowing = level[below[level] >= 0]
        np.maximum.at(best, below[flowing], order[flowing])
        top = flowing[order[flowing] == best[below[flowing]]]
        target, count = np.unique(below[top], return_counts=True)
        twice[target] = count > 1
    return order[heads]


def shreve_magnitude(downstream: Downstream) -> Index:
    """Return the Shreve magnitude: the number of sources that drain through each node."""
    sources = (inflows(downstream) == 0).astype(np.int64)
    return np.asarray(upstream_sums(downstream, sources), np.int64)


def upstream_sums(downstream: Downstream, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return for each node the sum of `values` over it and all nodes that drain through it, level by level."""
    down = np.asarray(downstream)
    total = values.copy()
    for level in reversed(_levels(hops(down))[1:]):
        np.add.at(total, down[level], total[level])
    return total


def is_exterior(downstream: Downstream) -> npt.NDArray[np.bool_]:
    """Return which nodes belong to an exterior link: one that begins at a source; the others are interior."""
    return np.asarray((inflows(downstream) == 0)[link_heads(downstream)])


def _link_levels(downstream: Downstream) -> tuple[Index, list[Index], Index]:
    """Return the head of every node's link, the links by their hops over links, and the link below each (or -1)."""
    down = np.asarray(downstream).astype(np.int64)
    heads = link_heads(down)
    # The last node of a link is the one that flows into another link, or an outlet.
    last = np.flatnonzero((down < 0) | (heads[down] != heads))
    below = np.full(len(down), -1, np.int64)
    below[heads[last]] = np.where(down[last] >= 0, heads[down[last]], -1)
    links = np.flatnonzero(heads == np.arange(len(down)))
    return heads, [links[level] for level in _levels(hops(below)[links])], below


def _levels(depth: Index) -> list[Index]:
    order = np.argsort(depth, kind="stable")
    return np.split(order, np.cumsum(np.bincount(depth))[:-1]) if len(depth) else []


def _followed(jump: Index) -> Index:
    """Return where each node ends when it follows `jump` (-1: it stays), which has no cycles."""
    end = np.where(jump >= 0, jump, np.arange(len(jump)))
    while True:
        further = end[end]
        if np.array_equal(further, end):
            return end
        end = further
