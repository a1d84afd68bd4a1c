"""Primitives that reach everywhere: a constant height and a plane, of weight 1."""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from nodegraph import port_type
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.function import EVERYWHERE, Bounds, Box, ElevationFunction, Points, Sample, product

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

_CONSTANT = Kernel("tree_constant", FOLDER / "basic.cl")
_PLANE = Kernel("tree_plane", FOLDER / "basic.cl")


@port_type
class Constant(ElevationFunction):
    """The same height everywhere: f = height (m), alpha = 1."""

    height: float

    @property
    def support(self) -> Box:
        """Everywhere."""
        return EVERYWHERE

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Return the height."""
        size = points.x.shape
        flat = np.zeros((2, *size)) if gradient else None
        return Sample(np.full(size, self.height), np.ones(size), flat, flat)

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:  # noqa: ARG002
        """Exact."""
        return Bounds(self.height, self.height, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0)

    def emit(self, emitter: Emitter, frame: Frame) -> None:  # noqa: ARG002
        """One number."""
        emitter.add(_CONSTANT, [self.height])


@port_type
class Plane(ElevationFunction):
    """A tilted plane: f = height + east x + north y, alpha = 1.

    Attributes:
        height: at the origin, m.
        east, north: slopes, m per m.
    """

    height: float
    east: float
    north: float

    @property
    def support(self) -> Box:
        """Everywhere."""
        return EVERYWHERE

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Return the plane."""
        size = points.x.shape
        height = self.height + self.east * points.x + self.north * points.y
        if not gradient:
            return Sample(height, np.ones(size))
        slope = np.empty((2, *size))
        slope[0], slope[1] = self.east, self.north
        return Sample(height, np.ones(size), slope, np.zeros((2, *size)))

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:  # noqa: ARG002
        """Exact: the extremes are at corners."""
        across = [product(self.east, x) for x in (box.west, box.east)]
        along = [product(self.north, y) for y in (box.south, box.north)]
        ends = (self.height + min(across) + min(along), self.height + max(across) + max(along))
        slope = hypot(self.east, self.north)
        return Bounds(*ends, 1.0, 1.0, slope, 0.0, slope, slope)

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Emit the plane relative to the frame's origin."""
        emitter.add(_PLANE, [self.height + self.east * frame.ox + self.north * frame.oy, self.east, self.north])
