"""Which of many boxes meet a given one: two levels of a packed R-tree.

Boxes are sorted into strips by their centres' x and within each by y, and every `GROUP` neighbours get a box around
them (sort-tile-recursive packing: Leutenegger, Lopez and Edgington 1997, STR: a simple and efficient algorithm for
R-tree packing, doi:10.1109/ICDE.1997.582015).  A question costs O(n / GROUP + what it finds), a few microseconds for
10,000 boxes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from nodegraph_tree.function import Box, Floats

GROUP = 64
_FAR = 1e300


class BoxIndex:
    """Boxes, by their numbers in a sequence; edges may be infinite."""

    def __init__(self, boxes: Sequence[Box]) -> None:
        self.boxes: Floats = np.array(boxes, np.float64).reshape(-1, 4)
        count = len(boxes)
        west, south, east, north = np.clip(self.boxes.T, -_FAR, _FAR)
        rank = np.empty(count, np.int64)
        rank[np.argsort(west + east, kind="stable")] = np.arange(count)
        groups = -(-count // GROUP)
        strips = max(1, round(groups**0.5))
        order = np.lexsort((south + north, rank * strips // max(count, 1)))
        self._numbers: npt.NDArray[np.int64] = np.pad(order, (0, groups * GROUP - count)).reshape(groups, GROUP)
        # What fills the last group up is NaN and meets nothing.
        edges = np.full((groups * GROUP, 4), np.nan)
        edges[:count] = self.boxes[order]
        self._edges = np.moveaxis(edges.reshape(groups, GROUP, 4), 2, 0).copy()
        lows, highs = np.fmin.reduce(self._edges[:2], axis=2), np.fmax.reduce(self._edges[2:], axis=2)
        self._around: Floats = np.concatenate([lows, highs])

    def meeting(self, box: Box) -> npt.NDArray[np.int64]:
        """Return the numbers of the boxes that have a point in common with a box, in order."""
        if len(self._numbers) == 1:
            return np.flatnonzero(_meet(self.boxes.T, box))
        groups = np.flatnonzero(_meet(self._around, box))
        found: npt.NDArray[np.int64] = self._numbers[groups][_meet(self._edges[:, groups], box)]
        found.sort()
        return found


def _meet(edges: Floats, box: Box) -> npt.NDArray[np.bool_]:
    west, south, east, north = edges
    hits: npt.NDArray[np.bool_] = west <= box.east
    hits &= east >= box.west
    hits &= south <= box.north
    hits &= north >= box.south
    return hits
