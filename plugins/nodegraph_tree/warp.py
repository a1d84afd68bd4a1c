"""Warps: a tree seen through a distortion of the plane (section 5.4).

A warp omega moves the points of the plane; the tree f o omega^-1, alpha o omega^-1 follows it.  Evaluation needs the
inverse only, so that is what is stored, as a displacement: omega^-1(p) = p + d(p).  Each kind has an analytic Jacobian
J = I + grad d, grad f = J^T (grad f_A o omega^-1).

=========  =======================================================================  =========================
kind       d(p)                                                                     one to one
=========  =======================================================================  =========================
Twist      a turn about a centre, by an angle that falls off with the distance     always
Bend       a shift across an axis, by a spline along it, falling off beside it     sup |shift| max |g'| < reach
Distort    two gradient noises                                                     sup |grad d| < 1
=========  =======================================================================  =========================

A displacement with a Lipschitz constant below 1 makes p + d(p) one to one and onto (Banach).  Where d is 0 the tree is
unchanged, bit for bit.

**Bounds.**  In a box where |d| <= m and the largest singular value of J is at most sigma, the tree is bounded by that
of the operand in the box grown by m, or in the box of half size sigma * half diagonal around the image of the centre;
slopes and fluxes times sigma.  `Distort` bounds both components of d in the box, each from below and above, and moves
the edges of the box by that.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, isfinite
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from nodegraph import port_type
from nodegraph_tree.device import FOLDER, Frame, Kernel, Pending
from nodegraph_tree.function import ABSENT, Bounds, Box, ElevationFunction, Floats, Points, Sample, product

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter

_LEAVE = Kernel("tree_leave", FOLDER / "basic.cl")


Instruction = tuple[Kernel, list[float] | Pending, list[int]]


class Shift(NamedTuple):
    """A displacement at points: d, (n,) m each, and its derivatives if asked for, (n,) each: xy is that of d_x by y."""

    x: Floats
    y: Floats
    xx: Floats | None = None
    xy: Floats | None = None
    yx: Floats | None = None
    yy: Floats | None = None


class Reach(NamedTuple):
    """What a warp does in a box: the greatest displacement, m, and the largest singular value of J."""

    shift: float
    stretch: float


STILL = Reach(0.0, 1.0)
"""Nothing moves."""


@port_type
class Warp(ElevationFunction):
    """A tree under a warp; the kinds are subclasses.

    Attributes:
        operand: the tree.
    """

    operand: ElevationFunction

    @property
    def parts(self) -> Sequence[ElevationFunction]:
        """The one operand."""
        return (self.operand,)

    def shift(self, x: Floats, y: Floats, *, gradient: bool = False) -> Shift:
        """Return the displacement d of omega^-1 at points."""
        raise NotImplementedError

    def reach(self, box: Box) -> Reach:
        """Bound displacement and stretch in a box."""
        raise NotImplementedError

    def instruction(self, emitter: Emitter, frame: Frame, to: tuple[float, float]) -> Instruction:
        """Return what enters the coordinates p + d(p) - `to`, for the samples of a frame."""
        raise NotImplementedError

    @property
    def support(self) -> Box:
        """Around what can be displaced into the support of the operand."""
        inner = self.operand.support
        return inner if inner.empty else inner.grown(self.reach(inner.grown(self.farthest)).shift)

    @property
    def farthest(self) -> float:
        """The greatest displacement anywhere, m."""
        raise NotImplementedError

    def carried(self, box: Box, reach: Reach) -> Box:
        """Return a box around the image of a box under omega^-1."""
        grown = box.grown(reach.shift)
        if not all(map(isfinite, box)):
            return grown
        x, y = (box.west + box.east) / 2, (box.south + box.north) / 2
        moved = self.shift(np.array([x]), np.array([y]))
        half = reach.stretch * hypot(box.east - box.west, box.north - box.south) / 2
        x, y = x + float(moved.x[0]), y + float(moved.y[0])
        return grown.intersection(Box(x - half, y - half, x + half, y + half))

    def closely(self, box: Box) -> tuple[Box, float]:
        """Return a box around the image of a box, and the stretch in it, as tight as bounds deserve."""
        reach = self.reach(box)
        return box if reach == STILL else self.carried(box, reach), reach.stretch

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Ask the operand at the displaced points; gradients are multiplied by the transposed Jacobian."""
        moved = self.shift(points.x, points.y, gradient=gradient)
        sample = self.operand.query(points.moved(points.x + moved.x, points.y + moved.y), gradient=gradient)
        if sample.height_gradient is None or sample.weight_gradient is None:
            return sample
        slopes = []
        for east, north in (sample.height_gradient, sample.weight_gradient):
            slopes.append(
                np.stack([east + (moved.xx * east + moved.yx * north), north + (moved.xy * east + moved.yy * north)])
            )
        return Sample(sample.height, sample.weight, *slopes)

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound the operand in the carried box; slopes grow by the largest singular value of the Jacobian."""
        inside, stretch = self.closely(box)
        inner = self.operand.bounds(inside, detail)
        if inner.absent:
            return ABSENT
        return inner._replace(
            slope=product(stretch, inner.slope),
            weight_slope=product(stretch, inner.weight_slope),
            flux=product(stretch, inner.flux),
            support_slope=product(stretch, inner.support_slope),
        )

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Change coordinates around the operand; nothing to do where the tile is not displaced.

        The operand's frame begins where the tile's middle goes, so that its offsets stay small.
        """
        reach = self.reach(frame.box)
        if reach == STILL:
            self.operand.emit(emitter, frame)
            return
        if not self.operand.on_device:
            emitter.from_host(self, frame)  # the samples are no longer those of an affine frame
            return
        box = self.carried(frame.box, reach)
        if not box.meets(self.operand.support):
            emitter.nothing()
            return
        x, y = (frame.box.west + frame.box.east) / 2, (frame.box.south + frame.box.north) / 2
        middle = self.shift(np.array([x]), np.array([y]))
        to = (float(middle.x[0]), float(middle.y[0]))
        emitter.enter(*self.instruction(emitter, frame, to))
        self.operand.emit(emitter, Frame(box, frame.ox + to[0], frame.oy + to[1]))
        emitter.leave(_LEAVE, [1.0, 0.0])
