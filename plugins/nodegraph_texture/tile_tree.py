"""A quadtree of texture tiles: how tiles are numbered, where they lie, and how large their texels are.

Level 0 is the coarsest; each level has texels half as large as the one before, down to the finest.  Tiles of one level
have the same number of texels, so that a tile and its four children cover the same ground: the levels are the mip
levels of the texture.  Rows are counted from the north and columns from the west, at every level from the same corner.

Source: Dachsbacher, Bolch and Stamminger 2006: Procedural reproduction of terrain textures with geographic data,
Vision, Modeling and Visualization, section 4, https://inria.hal.science/inria-00606769.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import ceil
from typing import NamedTuple

from nodegraph_terrain.raster import Extent

LEVELS_MAX = 24
"""Levels that a quadtree may have: 2^23 tiles along a side."""


class Tile(NamedTuple):
    """A tile's place in the quadtree."""

    level: int
    row: int
    col: int

    @property
    def parent(self) -> Tile:
        """The tile of the level before that it is a quarter of."""
        return Tile(self.level - 1, self.row // 2, self.col // 2)

    @property
    def quarters(self) -> tuple[Tile, Tile, Tile, Tile]:
        """The four tiles of the next level, whether there is ground on them or not: rows first."""
        level, row, col = self.level + 1, 2 * self.row, 2 * self.col
        return (
            Tile(level, row, col),
            Tile(level, row, col + 1),
            Tile(level, row + 1, col),
            Tile(level, row + 1, col + 1),
        )


class TileTree(NamedTuple):
    """The shape of a quadtree.

    Attributes:
        extent: of the ground; texels are counted from its north-west corner.
        cell: width and height of a texel of the finest level, m.
        size: texels along a side of a tile.
        levels: how many there are.
    """

    extent: Extent
    cell: tuple[float, float]
    size: int
    levels: int

    def cell_of(self, level: int) -> tuple[float, float]:
        """Return width and height of a texel of a level, m; powers of two times the finest, without rounding."""
        times = 2.0 ** (self.levels - 1 - level)
        return self.cell[0] * times, self.cell[1] * times

    def shape(self, level: int) -> tuple[int, int]:
        """Return how many rows and columns of tiles a level has."""
        side = self.size << (self.levels - 1 - level)
        rows, cols = texels_across(self.extent, self.cell)
        return -(-rows // side), -(-cols // side)

    def tiles(self, level: int) -> Iterator[Tile]:
        """Yield the tiles of a level, row by row."""
        rows, cols = self.shape(level)
        return (Tile(level, row, col) for row in range(rows) for col in range(cols))

    def children(self, tile: Tile) -> tuple[Tile, ...]:
        """Return the tiles of the next level on the same ground: four, fewer at the edge, none below the finest."""
        if tile.level + 1 >= self.levels:
            return ()
        rows, cols = self.shape(tile.level + 1)
        return tuple([quarter for quarter in tile.quarters if quarter.row < rows and quarter.col < cols])

    def has(self, tile: Tile) -> bool:
        """Say whether there is such a tile."""
        if not 0 <= tile.level < self.levels:
            return False
        rows, cols = self.shape(tile.level)
        return 0 <= tile.row < rows and 0 <= tile.col < cols

    def extent_of(self, tile: Tile) -> Extent:
        """Return what a tile covers without its border; tiles at the edge may reach beyond the ground.

        A parent's edges are its children's to the last bit: an edge is a whole number times a texel, and texels of
        two levels differ by a power of two.
        """
        width, height = self.cell_of(tile.level)
        return replace(
            self.extent,
            west=self.extent.west + tile.col * self.size * width,
            east=self.extent.west + (tile.col + 1) * self.size * width,
            north=self.extent.north - tile.row * self.size * height,
            south=self.extent.north - (tile.row + 1) * self.size * height,
        )


def texels_across(extent: Extent, cell: tuple[float, float]) -> tuple[int, int]:
    """Return the rows and columns of texels that cover an extent; a rest of a millionth of one is rounding."""
    return ceil(extent.height / cell[1] - 1e-6), ceil(extent.width / cell[0] - 1e-6)


def levels_needed(extent: Extent, cell: tuple[float, float], size: int) -> int:
    """Return how many levels there are when the coarsest is one tile."""
    tiles = -(-max(texels_across(extent, cell)) // size)
    return 1 + (tiles - 1).bit_length()
