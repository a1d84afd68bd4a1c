"""Painted tiles that are kept for the next picture, within a budget of bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any

import numpy.typing as npt

from nodegraph_texture.tile_tree import Tile

Pixels = npt.NDArray[Any]


class TileCache:
    """Tiles of one size by least recent use: what has not been asked for the longest goes first.

    Attributes:
        room: how many tiles the budget holds.
        hits, painted, evicted: how many tiles were there, were painted, and had to go.
    """

    def __init__(self, budget: int, tile_bytes: int, paint: Callable[[Tile], Pixels]) -> None:
        """Make an empty one.

        Args:
            budget: bytes that all tiles together may have.
            tile_bytes: bytes of one.
            paint: makes a tile.

        Raises:
            ValueError: not one tile fits.
        """
        self.room = budget // tile_bytes
        if self.room < 1:
            raise ValueError(f"a budget of {budget:,} bytes holds no tile of {tile_bytes:,}; raise it, or take smaller")
        self.hits = self.painted = self.evicted = 0
        self._bytes = tile_bytes
        self._paint = paint
        self._kept: OrderedDict[Tile, Pixels] = OrderedDict()

    @property
    def bytes(self) -> int:
        """Bytes of what is kept."""
        return len(self._kept) * self._bytes

    @property
    def kept(self) -> tuple[Tile, ...]:
        """The tiles that are kept, the one that goes first before the others."""
        return tuple(self._kept)

    def fetch(self, tiles: Iterable[Tile]) -> dict[Tile, Pixels]:
        """Return the tiles of a picture; those that are missing are painted.

        Tiles that are kept are marked as used before the first is painted, so that none of this picture goes for
        another of it.

        Raises:
            ValueError: the budget does not hold all of them at once.
        """
        wanted = list(dict.fromkeys(tiles))
        if len(wanted) > self.room:
            raise ValueError(f"{len(wanted)} tiles at once are over the budget, which holds {self.room}")
        present = [tile for tile in wanted if tile in self._kept]
        self.hits += len(present)
        for tile in present:
            self._kept.move_to_end(tile)
        for tile in wanted:
            if tile not in self._kept:
                if len(self._kept) == self.room:
                    self._kept.popitem(last=False)
                    self.evicted += 1
                self._kept[tile] = self._paint(tile)
                self.painted += 1
        return {tile: self._kept[tile] for tile in wanted}
