"""The value on the wire: `RiverNetwork`, rivers as a forest in which every node flows to one other."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph import port_type


@port_type
class RiverNetwork:
    """Rivers: nodes joined by straight segments, each node to the one it flows to.

    A node without another upstream is a source, one with several is a confluence, one that flows nowhere is an
    outlet (estuary).  A *link* is the run of nodes between two of these.  Orders, distances and basins follow from the
    topology (`nodegraph_hydrology.topology`).

    Attributes:
        position: (n, 2) float64, m: east, north.
        downstream: (n,) int32, the node that each flows to; -1 for an outlet.
        elevation: (n,) float64, m; NaN where it is not known.
        crs: coordinate system, empty if unknown.
    """

    position: npt.NDArray[Any]
    downstream: npt.NDArray[Any]
    elevation: npt.NDArray[Any]
    crs: str = ""

    def __post_init__(self) -> None:
        count = len(self.position)
        if self.position.shape != (count, 2) or self.downstream.shape != (count,) or self.elevation.shape != (count,):
            raise ValueError("a river network needs as many downstream nodes and elevations as positions")
        if count and (int(np.min(self.downstream)) < -1 or int(np.max(self.downstream)) >= count):
            raise ValueError("a river network has a node that flows to none of its nodes")
