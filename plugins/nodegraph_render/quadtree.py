"""A quadtree of bounds over a construction tree: how high, how steep and how present it is, from afar down to near.

Each node holds bounds over its box; leaves are small where the eye is near, for there a local bound of the slope is
what makes steps long.  A parent's bounds are its children's together, which is tighter than asking the tree for them.

Nodes are numbered from the root, 0; the four children of a node stand together in the order south-west, south-east,
north-west, north-east.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_tree.function import THRESHOLD, Bounds, Box, ElevationFunction

Doubles = npt.NDArray[np.float64]

MAX_LEVELS = 9
MAX_LEAVES = 6000

Fineness = Callable[[Box], float]
"""How large a leaf that lies over a box may be, m."""


class Quadtree(NamedTuple):
    """The nodes' arrays.

    Attributes:
        box: west, south, east, north of each node, (n, 4), m.
        top: no terrain is higher, (n,), m; -inf where there is none.
        slope: |grad f| on the terrain, (n,).
        weight_slope: |grad alpha|, (n,), 1/m.
        full: True where all of the box is terrain, (n,).
        child: number of the first child, (n,) int32; of leaf k it is -1 - k.
        leaves: the nodes that are leaves, (k,).
        detail: level of detail of each leaf, (k,).
        levels: how many levels there are.
    """

    box: Doubles
    top: Doubles
    slope: Doubles
    weight_slope: Doubles
    full: npt.NDArray[np.bool_]
    child: npt.NDArray[np.int32]
    leaves: npt.NDArray[np.int32]
    detail: Doubles
    levels: int


def build(
    function: ElevationFunction, region: Box, fineness: Fineness, detail: Callable[[Box], float], context: Context
) -> Quadtree:
    """Build the quadtree of a region, which must be bounded.

    The largest leaf, measured by what `fineness` allows it, is split first, until all are fine enough or there are
    `MAX_LEAVES`; what holds no terrain is not split.

    Args:
        function: the tree.
        region: the root's box.
        fineness: how large a leaf over a box may be.
        detail: level of detail of a leaf.
        context: for cancelling.
    """
    import heapq

    boxes, found, children, levels = [region], [function.bounds(region, detail(region))], [-1], [0]
    waiting: list[tuple[float, int]] = []

    def consider(index: int) -> None:
        box, bounds = boxes[index], found[index]
        excess = max(box.east - box.west, box.north - box.south) / fineness(box)
        if excess > 1 and levels[index] + 1 < MAX_LEVELS and _present(bounds):
            heapq.heappush(waiting, (-excess, index))

    consider(0)
    leaves = 1
    while waiting and leaves + 3 <= MAX_LEAVES:
        if leaves % 32 < 3:
            context.progress(None)
        _, index = heapq.heappop(waiting)
        children[index] = len(boxes)
        leaves += 3
        for box in _quarters(boxes[index]):
            boxes.append(box)
            found.append(function.bounds(box, detail(box)))
            children.append(-1)
            levels.append(levels[index] + 1)
            consider(len(boxes) - 1)
    top = np.array([bounds.high if _present(bounds) else -math.inf for bounds in found])
    slope = np.array([bounds.slope if _present(bounds) else 0.0 for bounds in found])
    weight_slope = np.array([bounds.weight_slope for bounds in found])
    full = np.array([bounds.weight_low >= THRESHOLD for bounds in found])
    child = np.array(children, np.int32)
    # Children come after their parents: from the last to the first, each parent takes its children's together.
    for index in np.flatnonzero(child > 0)[::-1]:
        four = slice(child[index], child[index] + 4)
        top[index] = min(top[index], top[four].max())
        slope[index] = min(slope[index], slope[four].max())
        weight_slope[index] = min(weight_slope[index], weight_slope[four].max())
        full[index] |= full[four].all()
    ends = np.flatnonzero(child < 0).astype(np.int32)
    child[ends] = -1 - np.arange(len(ends))
    details = np.array([detail(boxes[index]) for index in ends])
    return Quadtree(np.array(boxes), top, slope, weight_slope, full, child, ends, details, max(levels) + 1)


def _present(bounds: Bounds) -> bool:
    return not bounds.absent and bounds.weight_high >= THRESHOLD


def _quarters(box: Box) -> tuple[Box, Box, Box, Box]:
    x, y = (box.west + box.east) / 2, (box.south + box.north) / 2
    return (
        Box(box.west, box.south, x, y),
        Box(x, box.south, box.east, y),
        Box(box.west, y, x, box.north),
        Box(x, y, box.east, box.north),
    )
