"""Texture tiles: a texture too large to be painted as a whole, as a quadtree whose tiles are painted on demand."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node, port_type, whole
from nodegraph_terrain.raster import Elevation, Extent, Raster
from nodegraph_texture.apply_layers import Edges, prepared
from nodegraph_texture.evaluate import Texture, evaluate
from nodegraph_texture.layers import SurfaceLayers
from nodegraph_texture.quantities import quantity_name
from nodegraph_texture.scene import Scene, scene_of
from nodegraph_texture.tile_heights import Range, height_range
from nodegraph_texture.tile_pixels import Content, pixels_of
from nodegraph_texture.tile_tree import LEVELS_MAX, Tile, TileTree, levels_needed
from nodegraph_tree.function import ElevationFunction

Pixels = npt.NDArray[np.uint8]


@port_type
class TextureTiles:
    """A texture as a quadtree of tiles: all that is needed to paint any of them; see `texture_tiles`.

    Attributes:
        layers: what is painted.
        ground: on what: a raster in metres, or a construction tree.
        quantities: what constraints ask for.
        extent: of the ground.
        cell: width and height of a texel of the finest level, m.
        size: texels along a side of a tile, without its border.
        border: texels around it that belong to its neighbours.
        levels: how many there are; 0 is the coarsest.
    """

    computes: ClassVar[bool] = True

    layers: SurfaceLayers
    ground: Elevation | ElevationFunction
    quantities: tuple[Raster, ...]
    extent: Extent
    cell: tuple[float, float]
    size: int
    border: int
    levels: int

    @cached_property
    def tree(self) -> TileTree:
        """The shape of the quadtree."""
        return TileTree(self.extent, self.cell, self.size, self.levels)

    @cached_property
    def scene(self) -> Scene:
        """Ground, quantities and layers, ready to be painted."""
        return scene_of(self.layers, self.ground, self.quantities, self.extent)

    @cached_property
    def _heights(self) -> dict[Tile, Range | None]:
        return {}

    @property
    def side(self) -> int:
        """Texels along a side of a tile with its border."""
        return self.size + 2 * self.border

    @property
    def tile_bytes(self) -> int:
        """Bytes of the pixels of a tile with its border."""
        return 4 * self.side**2

    def heights(self, tile: Tile) -> Range | None:
        """Return bounds of the heights of a tile's ground at its finest, m; None where there certainly is none."""
        if tile not in self._heights:
            self._heights[tile] = height_range(self.scene, self.tree.extent_of(tile))
        return self._heights[tile]

    def paint(self, tile: Tile, border: int | None = None, context: Context | None = None) -> Texture:
        """Paint a tile as that part of its level painted as a whole, bit for bit.

        Args:
            tile: which.
            border: texels around it; none: as stated.
            context: the engine's; a device that it has paints, and the arrays then are the device's.
        """
        rim = self.border if border is None else border
        side = self.size + 2 * rim
        window = tile.row * self.size - rim, tile.col * self.size - rim, side, side
        cell = self.tree.cell_of(tile.level)
        if context is not None and context.device is not None:
            from nodegraph_texture.apply_opencl import evaluate_on_device

            return evaluate_on_device(self.scene, cell, *window, context.device, context)
        return evaluate(self.scene, cell, *window, context)

    def pixels(self, tile: Tile, content: Content, border: int | None = None, context: Context | None = None) -> Pixels:
        """Return a painted tile on the host, (rows, columns, 4) uint8; see `tile_pixels.pixels_of`."""
        from nodegraph.opencl import to_host

        arrays: tuple[Any, ...] = self.paint(tile, border, context)
        return pixels_of(Texture(*map(to_host, arrays)), content)


def steady(context: Context, done: float, message: str, content: Content) -> Context:
    """Return a context for painting one of many tiles: it can be cancelled, and progress stays at `done`.

    It has the device only where rounding does no harm: the bytes of a height are far apart for two that are near.
    """
    device = None if content == "heights" else context.device
    return Context(context.node, device=device, report=lambda *_: context.progress(done, message))


@node(version=1, locality=whole)
def texture_tiles(
    layers: SurfaceLayers,
    surface: Elevation | None = None,
    function: ElevationFunction | None = None,
    *quantities: Raster,
    factor: Annotated[
        int | None, Param("Finest texels along a side of a cell; none: 4, or by cell_size.", ge=1, le=1 << 16)
    ] = None,
    cell_size: Annotated[
        float | None, Param("Side of a texel of the finest level, in place of a factor.", gt=0, unit="m")
    ] = None,
    extent: Annotated[
        Edges | None, Param("Outer edges (west, south, east, north) for a tree; none: its own.", unit="m")
    ] = None,
    crs: Annotated[str, Param("Coordinate reference system of a tree, such as EPSG:32616.")] = "",
    tile_size: Annotated[int, Param("Texels along a side of a tile, without its border.", ge=4, le=8192)] = 256,
    border: Annotated[int, Param("Texels around a tile that its neighbours have, too.", ge=0, le=64)] = 1,
    levels: Annotated[
        int | None, Param("Levels of the quadtree; none: until one tile covers all.", ge=1, le=LEVELS_MAX)
    ] = None,
    context: Context,
) -> TextureTiles:
    """Divide a texture of any size into a quadtree of tiles that are painted when they are asked for.

    Nothing is painted here: the value says how.  texture.texture_atlas paints the tiles that a camera needs, at the
    resolution it needs them, texture.save_tiles those of a map, and texture.tile_statistics counts
    what a flight takes.

    The finest level is the texture that texture.apply_layers paints with the same parameters; each coarser one has
    texels twice as large, and is the texture that apply_layers paints with these: a tile is that part of it, bit for
    bit, on one device.  A tile and its four children cover the same ground exactly, so that levels serve as the mip
    levels of the texture.  They are not means of finer ones: constraints are evaluated anew, with noise only as fine
    as texels can show.  Tiles at the eastern and southern edge reach beyond the ground, where they are transparent.

    A border of 1 texel is what bilinear filtering reads around a tile; 2 serve bicubic filtering or one mip level of
    the tile itself, 2^k serve k.

    Args:
        layers, surface, function, quantities: as of texture.apply_layers.
        factor, cell_size, extent, crs: the same, of the finest level.
        tile_size, border, levels: see above.
        context: the engine's.

    Raises:
        ValueError: as of texture.apply_layers; or more levels are needed than a quadtree can have.

    Source: Dachsbacher, Bolch and Stamminger 2006: Procedural reproduction of terrain textures with geographic data,
    Vision, Modeling and Visualization, section 4, https://inria.hal.science/inria-00606769.
    """
    scene, grid = prepared(layers, surface, function, quantities, factor, cell_size, extent, crs, context)
    ground = surface if surface is not None else function
    assert ground is not None
    used = tuple([raster for raster in quantities if quantity_name(raster) in scene.quantities])
    needed = levels_needed(scene.extent, grid.cell_size, tile_size)
    if needed > LEVELS_MAX:
        raise ValueError(
            f"texels of {min(grid.cell_size):g} m need {needed} levels until one tile covers all, over {LEVELS_MAX}; "
            "take larger texels or tiles"
        )
    return TextureTiles(layers, ground, used, scene.extent, grid.cell_size, tile_size, border, levels or needed)
