"""Flats: ways out of level ground that lead away from higher and towards lower ground, without parallel lines.

Reference: R. Barnes, C. Lehman, D. Mulla (2014): An efficient assignment of drainage direction over flat surfaces in
raster digital elevation models. Computers & Geosciences 62. doi:10.1016/j.cageo.2013.01.009.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_hydrology.flow import Flags, Index, Lattice

FAR = np.iinfo(np.int64).max // 4


def resolve(
    lattice: Lattice, height: npt.NDArray[np.float32], receiver: Index, context: Context, *, sinks: bool = False
) -> Flags:
    """Give the cells of flats a receiver, in place; return which cells those are.

    A cell without a lower neighbour belongs to a flat, unless water leaves there.  Two distances are counted in rings
    of cells: from the places where the flat drains (a cell of the same height that flows) and from its higher rim.  The
    sum of twice the first and the reversed second falls towards the drain and away from the rim, and has no other
    bottom: each cell goes where it falls most steeply.

    Args:
        lattice: the cells.
        height: their heights.
        receiver: -1 where there is none yet.
        context: for cancellation.
        sinks: flats that drain nowhere drain to their cell farthest from the rim, which keeps -1; without it they keep
            -1 everywhere.
    """
    from scipy import ndimage

    level = lattice.known & (receiver < 0) & ~lattice.edge
    cells = np.flatnonzero(level)
    if not len(cells):
        return level
    here = height[cells]
    drains, below_rim = np.zeros(len(cells), np.bool_), np.zeros(len(cells), np.bool_)
    for offset in lattice.offsets:
        there = height[cells + offset]
        drains |= (there == here) & ~level[cells + offset]
        below_rim |= there > here
    rim = _rings(cells[below_rim], level, lattice, context)
    # No two flats of different height touch: the higher one would flow to the lower.
    flats, count = ndimage.label(lattice.inner(level), structure=np.ones((3, 3)))
    flat = np.pad(flats, 1).ravel()[cells]
    highest = np.zeros(count + 1, np.int64)
    np.maximum.at(highest, flat, rim[cells])
    seeds = cells[drains]
    bottoms = np.zeros(0, np.int64)
    if sinks:
        closed = np.ones(count + 1, np.bool_)
        closed[flat[drains]] = False
        # The first cell of the greatest distance from the rim in each flat without a drain.
        deepest = np.flatnonzero(closed[flat] & (rim[cells] == highest[flat]))
        bottoms = cells[deepest[np.unique(flat[deepest], return_index=True)[1]]]
        seeds = np.concatenate([seeds, bottoms])
    drain = _rings(seeds, level, lattice, context)
    reached = drain[cells] > 0
    rise = np.zeros(len(height), np.int64)
    rise[cells] = np.where(reached, 2 * drain[cells] + highest[flat] - rim[cells], FAR)
    rise[bottoms] = 0
    best, choice = np.zeros(len(cells)), np.full(len(cells), -1, np.int64)
    for k in (0, 2, 4, 6, 1, 3, 5, 7):
        near = cells + lattice.offsets[k]
        fall = np.where(height[near] == here, rise[cells] - rise[near], 0) / lattice.distances[k]
        better = reached & (fall > best)
        best[better] = fall[better]
        choice[better] = near[better]
    receiver[cells] = choice
    return level


def _rings(seeds: Index, open_cells: Flags, lattice: Lattice, context: Context) -> Index:
    """Return how many rings each open cell lies from the seeds (1: a seed), 0 where none leads there."""
    ring = np.zeros(len(open_cells), np.int64)
    free = open_cells.copy()
    stamp = np.zeros(len(open_cells), np.int64)
    offsets = np.array(lattice.offsets)
    front, number = seeds, 0
    while len(front):
        number += 1
        if number % 64 == 0:
            context.progress(None, "flats")
        ring[front] = number
        free[front] = False
        near = (front[:, None] + offsets).ravel()
        near = near[free[near]]
        # Each cell once: the last to sign it keeps it.
        stamp[near] = np.arange(len(near))
        front = near[stamp[near] == np.arange(len(near))]
    return ring
