"""Depressions: filled to their lowest pass, or breached by a channel through it.

Cells that descend to one bottom are its basin.  Of all places where two basins touch, the lowest is their pass; the
minimum spanning tree of basins and passes, seen from the outside, holds for every basin the way out over the lowest
possible pass.  So the filled surface is the least one that drains:

    filled(c) = max(z(c), highest pass on the way out of the basin of c),

the same that a priority flood gives cell by cell.  A breach follows the same way: from the bottom of each basin back up
the path of descent to the pass and over it, every cell cut down to the lowest that drains through it.

References:
    G. Cordonnier, B. Bovy, J. Braun (2019): A versatile, linear complexity algorithm for flow routing in topographies
    with depressions. Earth Surf. Dynam. 7. doi:10.5194/esurf-7-549-2019.
    R. Barnes, C. Lehman, D. Mulla (2014): Priority-flood. doi:10.1016/j.cageo.2013.04.024.
    J. B. Lindsay (2016): Efficient hybrid breaching-filling sink removal methods for flow path enforcement in digital
    elevation models. doi:10.1002/hyp.10648.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_hydrology.flats import resolve
from nodegraph_hydrology.flow import Flow, Index, Lattice, followed, steepest


def filled(lattice: Lattice, context: Context) -> Flow:
    """Return the flow over the surface with its depressions filled."""
    receiver = steepest(lattice, lattice.height)
    context.progress(0.2, "depressions")
    ways = _ways_out(lattice, receiver)
    height = np.maximum(lattice.height, ways.level[ways.basin])
    context.progress(0.6, "flats")
    receiver = steepest(lattice, height)
    flats = resolve(lattice, height, receiver, context)
    context.progress(0.8)
    return Flow(lattice, height, receiver, flats)


def breached(lattice: Lattice, context: Context) -> Flow:
    """Return the flow over the surface with a channel out of every depression."""
    receiver = steepest(lattice, lattice.height)
    context.progress(0.15, "flats")
    forced = resolve(lattice, lattice.height, receiver, context, sinks=True)
    context.progress(0.3, "depressions")
    ways = _ways_out(lattice, receiver)
    bottoms = np.flatnonzero(lattice.known & (receiver < 0) & ~lattice.edge)
    context.progress(0.6, "breaches")
    cell, target = ways.leaves, ways.enters
    while len(cell):
        onward = receiver[cell]
        receiver[cell] = target
        forced[cell] = True
        going = onward >= 0
        cell, target = onward[going], cell[going]
    flow = Flow(lattice, lattice.height, receiver, forced)
    # Only what lies below a bottom is cut.
    height = lattice.height.copy()
    if len(bottoms):
        lowest = flow.gathered(np.where(lattice.known, height, np.inf), np.minimum)
        height[lattice.known] = lowest[lattice.known]
    context.progress(0.8)
    return Flow(lattice, height, receiver, forced | (height < lattice.height))


@dataclass(frozen=True)
class _Ways:
    """The way out of every basin; basin 0 is the outside with all that drains there without help.

    Attributes:
        basin: (n,) basin of each cell; 0 for voids.
        level: (m,) highest pass on the way out, -inf for basin 0.
        leaves, enters: (m - 1,) the two cells of the first pass: in the basin and in the next one.
    """

    basin: Index
    level: npt.NDArray[np.float32]
    leaves: Index
    enters: Index


def _ways_out(lattice: Lattice, receiver: Index) -> _Ways:
    """Return the ways over the lowest passes out of the basins of all cells that descend to one bottom."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    height = lattice.height
    cells = np.arange(len(receiver))
    bottoms = np.flatnonzero(lattice.known & (receiver < 0) & ~lattice.edge)
    number = np.zeros(len(receiver), np.int64)
    number[bottoms] = np.arange(1, len(bottoms) + 1)
    basin = number[followed(np.where(receiver >= 0, receiver, cells))]
    count = len(bottoms) + 1
    nothing = np.zeros(0, np.int64)
    if count == 1:
        return _Ways(basin, np.full(1, -np.inf, np.float32), nothing, nothing)
    # Neighbouring cells of two basins, each pair once: half of the neighbours.
    pairs = []
    for offset in lattice.offsets[:4]:
        first = np.flatnonzero(lattice.known)
        second = first + offset
        first, second = first[lattice.known[second]], second[lattice.known[second]]
        apart = basin[first] != basin[second]
        pairs.append(np.stack([first[apart], second[apart]]))
    one, two = np.concatenate(pairs, axis=1)
    # An edge cell may lie in the basin of an inner bottom: over it the water leaves.
    rim = np.flatnonzero(lattice.edge & (basin > 0))
    one, two = np.concatenate([one, rim]), np.concatenate([two, np.full(len(rim), -1)])
    a, b = basin[one], np.where(two >= 0, basin[two], 0)
    passes = np.where(two >= 0, np.maximum(height[one], height[two]), height[one])
    order = np.argsort(passes, kind="stable")
    pair = (np.minimum(a, b) * count + np.maximum(a, b))[order]
    # Of each pair of basins the lowest pass; its rank among all is its weight, so no two weigh the same.
    lowest, rank = np.unique(pair, return_index=True)
    graph = csr_array(((rank + 1).astype(np.float64), np.divmod(lowest, count)), shape=(count, count))
    tree = minimum_spanning_tree(graph)
    _, parent = breadth_first_order(tree, 0, directed=False)
    edges = tree.tocoo()
    chosen = order[edges.data.astype(np.int64) - 1]
    # The basin of each tree edge that lies farther from the outside, and its cell of the pass.
    child = np.where(parent[edges.row] == edges.col, edges.row, edges.col).astype(np.int64)
    inward = a[chosen] == child
    leaves, enters = np.where(inward, one[chosen], two[chosen]), np.where(inward, two[chosen], one[chosen])
    level = np.full(count, -np.inf, np.float32)
    level[child] = passes[chosen]
    jump = np.where(parent >= 0, parent, 0).astype(np.int64)
    while jump.any():
        level = np.maximum(level, level[jump])
        jump = jump[jump]
    return _Ways(basin, level, leaves, enters)
