"""Where the samples of a tile are, for the programs of `nodegraph_tree.device`.

A tile has TILE x TILE samples, and 32 blocks of some of them: as many as an integer has bits, so that an integer is a
set of blocks.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_tree.function import Box, Floats

TILE = 64
"""Samples along the side of a tile."""
BLOCK = (8, 16)
"""Columns and rows of a block; the first one starts at the north-west corner, the others follow row by row."""
ALL = -1
"""The set of all blocks of a tile."""
_BLOCK_X = np.tile(np.arange(TILE // BLOCK[0]) + 0.5, TILE // BLOCK[1])
_BLOCK_Y = -np.repeat(np.arange(TILE // BLOCK[1]) + 0.5, TILE // BLOCK[0])


class Frame(NamedTuple):
    """The samples of a tile in the coordinates of a node: position = (ox, oy) + linear . offset in the tile, float64.

    Attributes:
        box: around the samples; what does not reach it need not be emitted.
        ox, oy, linear: see above.
        block: width and height of a block of the tile, m; None where it is not known where the blocks are.
    """

    box: Box
    ox: float
    oy: float
    linear: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)
    block: tuple[float, float] | None = None

    def carried(self, matrix: tuple[float, float, float, float], shift: tuple[float, float]) -> Frame:
        """Return the frame in the coordinates q = matrix . p + shift."""
        a, b, c, d = matrix
        e, f, g, h = self.linear
        corners = [(x, y) for x in (self.box.west, self.box.east) for y in (self.box.south, self.box.north)]
        xs = [a * x + b * y + shift[0] for x, y in corners]
        ys = [c * x + d * y + shift[1] for x, y in corners]
        return Frame(
            Box(min(xs), min(ys), max(xs), max(ys)),
            a * self.ox + b * self.oy + shift[0],
            c * self.ox + d * self.oy + shift[1],
            (a * e + b * g, a * f + b * h, c * e + d * g, c * f + d * h),
            self.block,
        )

    def blocks_in(self, boxes: Floats) -> npt.NDArray[np.int32]:
        """Return for each box, (n, 4) like `Box`, the set of the tile's blocks that it meets: a bit for each.

        What meets none, and yet the frame's box, is near the tile: whoever asks there asks for all blocks.
        """
        if self.block is None:
            return np.full(len(boxes), ALL, np.int32)
        west, south, east, north = _block_boxes(self.ox, self.oy, self.linear, self.block)
        meets = boxes[:, :1] <= east
        meets &= boxes[:, 1:2] <= north
        meets &= boxes[:, 2:3] >= west
        meets &= boxes[:, 3:] >= south
        blocks = np.packbits(meets, axis=1, bitorder="little").view("<i4").ravel()
        return np.where(blocks == 0, np.int32(ALL), blocks)


@lru_cache(maxsize=1)  # the parts of a tree that share a frame follow each other
def _block_boxes(
    ox: float, oy: float, linear: tuple[float, float, float, float], block: tuple[float, float]
) -> tuple[Floats, Floats, Floats, Floats]:
    a, b, c, d = linear
    wide, high = block
    x, y = ox + a * wide * _BLOCK_X + b * high * _BLOCK_Y, oy + c * wide * _BLOCK_X + d * high * _BLOCK_Y
    half_x, half_y = 0.5 * (abs(a) * wide + abs(b) * high), 0.5 * (abs(c) * wide + abs(d) * high)
    return x - half_x, y - half_y, x + half_x, y + half_y


class Tile(NamedTuple):
    """What one program is for.

    Attributes:
        frame: where the samples are.
        detail: their level of detail, one or one for each, (rows, cols).
        shape, step: rows and columns of the samples and what is between them along x and y, m: only what has no OpenCL
            reads them.
    """

    frame: Frame
    detail: Floats | float = 1.0
    shape: tuple[int, int] = (0, 0)
    step: tuple[float, float] = (0.0, 0.0)
