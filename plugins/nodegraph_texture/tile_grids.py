"""The tiles of a map: which there are, how to paint them, and how viewers are told where they lie.

Tiles are told by level, row and column; rows are counted from the north.  Both kinds of grid answer the same questions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from nodegraph import Context
from nodegraph_terrain.georeference import parse_crs
from nodegraph_texture import tile_mercator as mercator
from nodegraph_texture.texture_tiles import Pixels, TextureTiles
from nodegraph_texture.tile_pixels import Content, pixels_of
from nodegraph_texture.tile_tree import Tile
from nodegraph_texture.tile_warp import paint_warped, rim


@dataclass(frozen=True)
class LocalGrid:
    """The quadtree's own tiles, in the system of the ground, from its north-west corner.

    Attributes:
        tiles: the texture.
    """

    name: ClassVar[str] = "local"

    tiles: TextureTiles

    @property
    def usual(self) -> tuple[int, int]:
        """All levels."""
        return 0, self.deepest

    @property
    def deepest(self) -> int:
        """The finest level."""
        return self.tiles.levels - 1

    def covering(self, level: int) -> tuple[range, range]:
        """Return all rows and columns."""
        rows, cols = self.tiles.tree.shape(level)
        return range(rows), range(cols)

    def rows(self, level: int) -> int:
        """Return how many rows TMS counts: those of level 0 times 2^level, so that levels have one southern edge."""
        return self.tiles.tree.shape(0)[0] << level

    def pixels(self, tile: Tile, content: Content, context: Context) -> Pixels | None:
        """Return a tile of the texture, (rows, columns, 4) uint8; None where it has no ground."""
        if self.tiles.heights(tile) is None:
            return None
        found = self.tiles.pixels(tile, content, 0, context)
        return found if found[..., 3].any() else None

    def about(self, levels: tuple[int, int]) -> dict[str, Any]:
        """Return what metadata say of the place of some levels: corner and sides of texels."""
        tree, box = self.tiles.tree, self.tiles.extent
        table = [
            {"level": level, "cell": list(tree.cell_of(level)), "shape": list(tree.shape(level))}
            for level in range(levels[0], levels[1] + 1)
        ]
        return {
            "crs": box.crs,
            "origin": [box.west, box.north],
            "extent": [box.west, box.south, box.east, box.north],
            "levels": table,
        }

    def tile_map(self) -> Mapping[str, Any]:
        """Return profile, system, bounds, origin and metres to a pixel of level 0, in the system of the ground."""
        box, cell = self.tiles.extent, self.tiles.tree.cell_of(0)
        south = box.north - self.rows(0) * self.tiles.size * cell[1]
        bounds = (box.west, box.south, box.east, box.north)
        return {"profile": "local", "srs": box.crs, "bounds": bounds, "origin": (box.west, south), "cell": cell[0]}


@dataclass(frozen=True)
class MercatorGrid:
    """The tiles of slippy maps (EPSG:3857); texels are painted where they lie.

    Attributes:
        tiles: the texture.
    """

    name: ClassVar[str] = "web_mercator"

    tiles: TextureTiles

    @cached_property
    def found(self) -> mercator.Footprint:
        """Where the ground lies on the map."""
        return mercator.footprint_of(self.tiles.extent)

    @cached_property
    def _systems(self) -> tuple[Any, Any]:
        return parse_crs(self.tiles.extent.crs), parse_crs("EPSG:3857")

    @property
    def usual(self) -> tuple[int, int]:
        """From the zoom whose tiles are as large as the ground to that whose texels are nearest to the finest."""
        return mercator.zooms(self.found, max(self.tiles.cell), self.tiles.size)

    @property
    def deepest(self) -> int:
        """The deepest zoom: texels are painted, so that any is possible."""
        return mercator.ZOOM_MAX

    def covering(self, level: int) -> tuple[range, range]:
        """Return the rows and columns around the ground."""
        return mercator.covering(self.found, level)

    def rows(self, level: int) -> int:
        """Return how many rows TMS counts: 2^level."""
        return 1 << level

    def pixels(self, tile: Tile, content: Content, context: Context) -> Pixels | None:
        """Return a tile painted at the places of its texels, (rows, columns, 4) uint8; None where it has no ground."""
        context.progress()
        box, scene = self.tiles.extent, self.tiles.scene
        outside = min(box.west, box.south) - 1e8
        texels = mercator.texels_of(*self._systems, outside, *tile, self.tiles.size, rim(scene), self.found.shrink)
        inside = (texels.x >= box.west) & (texels.x <= box.east) & (texels.y >= box.south) & (texels.y <= box.north)
        if not inside.any():
            return None
        found = pixels_of(paint_warped(scene, texels), content)
        return found if found[..., 3].any() else None

    def about(self, levels: tuple[int, int]) -> dict[str, Any]:
        """Return what metadata say of the place of some zooms: the fields of TileJSON."""
        west, south, east, north = self.found.degrees
        return {
            "minzoom": levels[0],
            "maxzoom": levels[1],
            "bounds": [west, south, east, north],
            "center": [(west + east) / 2, (south + north) / 2, levels[0]],
        }

    def tile_map(self) -> Mapping[str, Any]:
        """Return profile, system, bounds, origin and metres to a pixel of zoom 0, on the map."""
        half, box = mercator.WORLD / 2, self.found
        return {
            "profile": "global-mercator",
            "srs": "EPSG:3857",
            "bounds": (box.west, box.south, box.east, box.north),
            "origin": (-half, -half),
            "cell": mercator.resolution(0, self.tiles.size),
        }


TileGrid = LocalGrid | MercatorGrid


def on_background(pixels: Pixels, background: tuple[float, float, float]) -> Pixels:
    """Return pixels laid over a colour, (rows, columns, 3)."""
    alpha = pixels[..., 3:].astype(np.float32) / 255
    under = np.asarray(background, np.float32) * 255
    return np.rint(alpha * pixels[..., :3] + (1 - alpha) * under).astype(np.uint8)
