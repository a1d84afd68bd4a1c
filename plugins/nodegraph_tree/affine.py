"""Affine transforms of a tree: moved, turned, scaled, sheared; and its heights scaled and shifted (section 5.4)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import cos, hypot, isfinite, radians, sin
from typing import TYPE_CHECKING

import numpy as np

from nodegraph import port_type
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.function import ABSENT, EVERYWHERE, Bounds, Box, ElevationFunction, Points, Sample, product

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

Matrix = tuple[float, float, float, float]

_ENTER, _LEAVE = Kernel("tree_enter", FOLDER / "basic.cl"), Kernel("tree_leave", FOLDER / "basic.cl")


@port_type
class Affine(ElevationFunction):
    """A tree under an affine transform: f(p) = scale f_A(M p + shift) + rise, alpha(p) = alpha_A(M p + shift).

    Build it with `affine`, which fuses consecutive ones.

    Attributes:
        operand: A.
        matrix: (a, b, c, d) of M = [[a, b], [c, d]], which carries the plane to the coordinates of A (the inverse of
        how
            A is moved).
        shift: (e, f), m.
        scale: of the heights.
        rise: added to the heights, m.
    """

    operand: ElevationFunction
    matrix: Matrix
    shift: tuple[float, float]
    scale: float = 1.0
    rise: float = 0.0

    @property
    def parts(self) -> Sequence[ElevationFunction]:
        """The one operand."""
        return (self.operand,)

    @cached_property
    def support(self) -> Box:
        """A box around the moved support of the operand."""
        inner = self.operand.support
        if inner.empty or inner == EVERYWHERE or not all(map(isfinite, inner)):
            return inner if inner.empty else EVERYWHERE
        a, b, c, d = self.matrix
        area = a * d - b * c
        corners = [
            (x - self.shift[0], y - self.shift[1]) for x in (inner.west, inner.east) for y in (inner.south, inner.north)
        ]
        xs = [(d * x - b * y) / area for x, y in corners]
        ys = [(a * y - c * x) / area for x, y in corners]
        return Box(min(xs), min(ys), max(xs), max(ys))

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Ask the operand at the carried points; gradients are multiplied by M transposed."""
        a, b, c, d = self.matrix
        x = a * points.x + b * points.y + self.shift[0]
        y = c * points.x + d * points.y + self.shift[1]
        sample = self.operand.query(points.moved(x, y), gradient=gradient)
        height = self.scale * sample.height + self.rise
        if sample.height_gradient is None or sample.weight_gradient is None:
            return Sample(height, sample.weight)
        (fx, fy), (ax, ay) = sample.height_gradient, sample.weight_gradient
        slope = self.scale * np.stack([a * fx + c * fy, b * fx + d * fy])
        return Sample(height, sample.weight, slope, np.stack([a * ax + c * ay, b * ax + d * ay]))

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound the operand in the carried box; slopes grow by the largest singular value of M."""
        inner = self.operand.bounds(_carried(box, self.matrix, self.shift), detail)
        if inner.absent:
            return ABSENT
        stretch = largest_singular_value(self.matrix)
        ends = (product(self.scale, inner.low) + self.rise, product(self.scale, inner.high) + self.rise)
        return Bounds(
            min(ends),
            max(ends),
            inner.weight_low,
            inner.weight_high,
            product(abs(self.scale) * stretch, inner.slope),
            stretch * inner.weight_slope,
            product(abs(self.scale) * stretch, inner.flux),
            product(abs(self.scale) * stretch, inner.support_slope),
        )

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Change coordinates around the operand."""
        emitter.enter(_ENTER, self.matrix)
        self.operand.emit(emitter, frame.carried(self.matrix, self.shift))
        emitter.leave(_LEAVE, [self.scale, self.rise])


def affine(
    operand: ElevationFunction, matrix: Matrix, shift: tuple[float, float], scale: float = 1.0, rise: float = 0.0
) -> ElevationFunction:
    """Return a tree under p -> matrix . p + shift, fused with a transform that it already has.

    Raises:
        ValueError: the matrix is singular or a number is not finite.
    """
    a, b, c, d = matrix
    if not all(map(isfinite, (*matrix, *shift, scale, rise))) or abs(a * d - b * c) < 1e-12 * max(
        1e-30, hypot(*matrix) ** 2
    ):
        raise ValueError("the transform is singular or not finite; scales must not be 0")
    if isinstance(operand, Affine):
        e, f, g, h = operand.matrix
        matrix = (e * a + f * c, e * b + f * d, g * a + h * c, g * b + h * d)
        shift = (e * shift[0] + f * shift[1] + operand.shift[0], g * shift[0] + h * shift[1] + operand.shift[1])
        scale, rise = scale * operand.scale, scale * operand.rise + rise
        operand = operand.operand
    return Affine(operand, matrix, shift, scale, rise)


def placed(
    operand: ElevationFunction,
    *,
    position: tuple[float, float] = (0.0, 0.0),
    rotation: float = 0.0,
    size: tuple[float, float] = (1.0, 1.0),
    scale: float = 1.0,
    rise: float = 0.0,
) -> ElevationFunction:
    """Return a tree scaled by `size` along its axes, turned counter-clockwise by `rotation` degrees, moved to
    `position`.

    Raises:
        ValueError: a size is 0.
    """
    if 0.0 in size:
        raise ValueError("a size of 0 leaves nothing; give sizes other than 0")
    co, si = cos(radians(rotation)), sin(radians(rotation))
    matrix = (co / size[0], si / size[0], -si / size[1], co / size[1])
    x, y = position
    return affine(operand, matrix, (-(matrix[0] * x + matrix[1] * y), -(matrix[2] * x + matrix[3] * y)), scale, rise)


def largest_singular_value(matrix: Matrix) -> float:
    """Return the most that a matrix lengthens a vector."""
    a, b, c, d = matrix
    return 0.5 * (hypot(a + d, b - c) + hypot(a - d, b + c))


def _carried(box: Box, matrix: Matrix, shift: tuple[float, float]) -> Box:
    if not all(map(isfinite, box)):
        return EVERYWHERE
    a, b, c, d = matrix
    corners = [(x, y) for x in (box.west, box.east) for y in (box.south, box.north)]
    xs = [a * x + b * y + shift[0] for x, y in corners]
    ys = [c * x + d * y + shift[1] for x, y in corners]
    return Box(min(xs), min(ys), max(xs), max(ys))
