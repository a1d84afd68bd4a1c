"""What rasters as primitives share: heights and a weight mask, in cells, and how the device reads both."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_tree.border import Weighed
from nodegraph_tree.falloff import Floats
from nodegraph_tree.pixels import Kind, Pixels, Range, Value

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter


class Look(NamedTuple):
    """An image at positions: height and mask with their derivatives per unit of u and v, each (n,)."""

    height: Value
    mask: Value | None


@port_type
class Picture:
    """An elevation raster over the unit square, u from its west to its east, v from its north to its south.

    Attributes:
        heights: (rows, cols) float32, finite.
        mask: 0 to 1 float32 of any shape over the same square, or None for 1.
        kind: how heights are interpolated, ``bilinear`` or ``bicubic``.
        mask_kind: how the mask is, ``spline`` or ``smooth``: C1, as weights must be.
    """

    heights: npt.NDArray[np.float32]
    mask: npt.NDArray[np.float32] | None = None
    kind: Kind = "bilinear"
    mask_kind: Kind = "spline"

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the heights."""
        return int(self.heights.shape[0]), int(self.heights.shape[1])

    @cached_property
    def pixels(self) -> Pixels:
        """The heights as a function of cells."""
        return Pixels(self.heights, self.kind)

    @cached_property
    def weights(self) -> Pixels | None:
        """The mask as a function of cells."""
        return None if self.mask is None else Pixels(self.mask, self.mask_kind)

    def look(self, u: Floats, v: Floats) -> Look:
        """Return height and mask at places of the unit square."""
        return Look(_look(self.pixels, u, v), None if self.weights is None else _look(self.weights, u, v))

    def narrowed(self, found: Range, u: float, v: float, reach: float) -> Range:
        """Return the range over a convex piece of ground, cut to what the slope allows around a place in it.

        Args:
            found: over the cells that the piece touches, with the slope on the ground.
            u, v: the place.
            reach: the greatest distance from it to a point of the piece, m.
        """
        far = found.slope * reach
        if far >= found.high - found.low:
            return found
        middle = float(_look(self.pixels, np.array([u]), np.array([v])).value[0])
        return Range(max(found.low, middle - far), min(found.high, middle + far), found.slope)

    def device(self, emitter: Emitter, u: float, v: float, wide: float, high: float) -> tuple[list[float], list[int]]:
        """Return the parameters of heights and mask for ``push_image`` and its like in ``kernels/image.cl``.

        Args:
            emitter: of the sampling.
            u, v: place from which the kernel counts.
            wide, high: u and v per unit that it counts in.
        """
        floats: list[float] = []
        ints = [int(self.weights is not None)]
        for layer in (self.pixels, self.weights or self.pixels):
            places = layer.device(
                emitter, u * layer.cols - 0.5, v * layer.rows - 0.5, wide * layer.cols, high * layer.rows
            )
            floats += places[0]
            ints += places[1]
        return floats, ints


def _look(pixels: Pixels, u: Floats, v: Floats) -> Value:
    found = pixels.at(u * pixels.cols - 0.5, v * pixels.rows - 0.5)
    return Value(found.value, found.along * pixels.cols, found.down * pixels.rows)


def masked(border: Weighed, mask: Value | None, east: tuple[Floats, Floats], north: tuple[Floats, Floats]) -> Weighed:
    """Return the product of a border's weight and a mask; `east` and `north` are the derivatives of (u, v)."""
    if mask is None:
        return border
    mx = mask.along * east[0] + mask.down * east[1]
    my = mask.along * north[0] + mask.down * north[1]
    return Weighed(
        border.weight * mask.value,
        border.east * mask.value + border.weight * mx,
        border.north * mask.value + border.weight * my,
    )
