"""Texture atlases: the tiles that a view needs on one page, and a table of where they are."""

from __future__ import annotations

import json
from functools import partial
from math import ceil, isqrt
from pathlib import PurePosixPath
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, File, Forecast, OutputName, Param, node, port_type, whole
from nodegraph_terrain.raster import Extent, Image
from nodegraph_texture.texture_tiles import Pixels, TextureTiles, steady
from nodegraph_texture.tile_pixels import Content
from nodegraph_texture.tile_statistics import MIB, Budget, FieldOfView, Height, Width
from nodegraph_texture.tile_tree import Tile
from nodegraph_texture.tile_view import Point, Selection, View, needed

PAGE = 16384
"""Most pixels along a side of a page: what graphics processors take as one texture."""


@port_type
class AtlasTable:
    """Where the tiles of an atlas are, on its page and on the ground.

    Attributes:
        tiles: level, row and column of each, (n, 3) int32.
        places: column and row of its first own pixel, without the border, from the top left, (n, 2) int32.
        extents: west, south, east, north of what its own pixels cover, (n, 4) float64, m.
        footprints: bounds of the pixels of the picture along a texel, (n,) float64.
        size: own pixels along a side of a tile.
        border: further pixels around it.
        page: width and height of the page, pixels.
        crs: coordinate reference system of the extents; empty where none is known.
    """

    tiles: npt.NDArray[np.int32]
    places: npt.NDArray[np.int32]
    extents: npt.NDArray[np.float64]
    footprints: npt.NDArray[np.float64]
    size: int
    border: int
    page: tuple[int, int]
    crs: str = ""

    def record(self) -> dict[str, Any]:
        """Return the table as JSON data; ``uv`` are texture coordinates from the top left, 0 to 1."""
        wide, high = self.page
        entries = []
        for (level, row, col), (x, y), extent, footprint in zip(
            self.tiles.tolist(), self.places.tolist(), self.extents.tolist(), self.footprints.tolist(), strict=True
        ):
            uv = [x / wide, y / high, (x + self.size) / wide, (y + self.size) / high]
            place = {"level": level, "row": row, "col": col, "x": x, "y": y, "uv": uv, "extent": extent}
            entries.append({**place, "footprint": footprint if np.isfinite(footprint) else None})
        about = {"width": wide, "height": high, "tile_size": self.size, "border": self.border, "crs": self.crs}
        return {**about, "tiles": entries}


class Atlas(NamedTuple):
    """What `texture_atlas` gives."""

    image: Image
    table: AtlasTable


@node(version=1, locality=whole)
def texture_atlas(
    tiles: TextureTiles,
    *,
    eye: Annotated[Point, Param("Where the camera stands: x, y, z.", unit="m")],
    target: Annotated[Point, Param("A point straight ahead of it: x, y, z.", unit="m")],
    field_of_view: FieldOfView = 45.0,
    width: Width = 1920,
    height: Height = 1080,
    budget: Budget = 40.0,
    content: Annotated[
        Content, Param("What tiles hold: colour, normals, or heights in the Terrarium code.")
    ] = "colour",
    context: Context,
) -> Atlas:
    """Paint the tiles that a camera needs, as fine as it needs them, and put them on one page.

    A tile is fine enough where the sides of its texels span one pixel of the picture or less at every point of its
    ground that can be in view; else its quarters take its place.  What is out of view is left out; hidden ground is
    not.  Where the budget, or a page of 16384 pixels a side, ends the refinement, the largest texels are refined first,
    and a warning says how large they still are.

    Tiles stand in a grid, each with its border.  Bilinear filtering inside of a tile's rectangle reads at most half a
    texel beyond it: with a border of 1 or more it never reads a neighbour.  Alpha is straight, and 0 without ground.

    Each tile is remembered: as the camera moves, only what is new is painted.

    Args:
        tiles: of the texture.
        eye, target, field_of_view, width, height: the camera.
        budget: for the pixels of all tiles, 4 bytes each.  The paper's view took 40 MB.
        content: ``colour``; ``normals``, (n + 1) / 2 of east, north and up in red, green and blue; ``heights`` of the
            displaced ground, 256 red + green + blue / 256 - 32768 m, which are painted on the host on every device.
        context: the engine's.

    Returns:
        ``image``: the page; ``table``: where each tile is, for texture.save_atlas.

    Raises:
        ValueError: eye and target are one point, no ground is in view, or the budget holds too few tiles.

    Source: Wloka 2005, Improved batching via texture atlases, ShaderX3, Charles River Media, pp. 155-167.
    """
    return _atlas(tiles, View(eye, target, field_of_view, width, height), budget, content, context)


@texture_atlas.opencl(rtol=5e-3)
def _twin(
    tiles: TextureTiles,
    *,
    eye: Point,
    target: Point,
    field_of_view: float,
    width: int,
    height: int,
    budget: float,
    content: Content,
    context: Context,
) -> Atlas:
    from nodegraph.opencl import to_host

    return _atlas(to_host(tiles), View(eye, target, field_of_view, width, height), budget, content, context)


@texture_atlas.forecast
def _forecast(tiles: Forecast, *, budget: float, **_: object) -> Forecast:  # noqa: ARG001
    return Forecast(int(budget * MIB))


def _atlas(tiles: TextureTiles, view: View, budget: float, content: Content, context: Context) -> Atlas:
    room = min(int(budget * MIB) // tiles.tile_bytes, (PAGE // tiles.side) ** 2)
    found = needed(tiles, view, room)
    if not found.tiles:
        raise ValueError("the view shows no ground; turn the camera towards the terrain")
    finest = tiles.levels - 1
    coarse = [size for tile, size in zip(*found, strict=True) if size > 1 and tile.level < finest]
    if coarse:
        context.log.warning(
            "%d tiles are all that fit: texels are up to %.3g pixels large; raise the budget", room, max(coarse)
        )
    painted = []
    for number, tile in enumerate(found.tiles):
        done, message = number / len(found.tiles), f"tile {number + 1} of {len(found.tiles)}"
        context.progress(done, message)
        depends = tiles, tuple(tile), content
        paint = partial(tiles.pixels, tile, content, context=steady(context, done, message, content))
        painted.append(context.remembered(depends, paint))
    page, places = packed(painted)
    table = _table(tiles, found, places + np.int32(tiles.border), (page.shape[1], page.shape[0]))
    return Atlas(Image(page, Extent(0.0, 0.0, float(page.shape[1]), float(page.shape[0]))), table)


def packed(tiles: list[Pixels]) -> tuple[Pixels, npt.NDArray[np.int32]]:
    """Return squares of one size on a page that is as square as it can be, and their columns and rows, (n, 2)."""
    side, count = len(tiles[0]), len(tiles)
    cols = isqrt(count - 1) + 1
    rows = ceil(count / cols)
    page = np.zeros((rows * side, cols * side, tiles[0].shape[2]), np.uint8)
    order = np.arange(count)
    places = (np.stack([order % cols, order // cols], axis=-1) * side).astype(np.int32)
    for pixels, (x, y) in zip(tiles, places, strict=True):
        page[y : y + side, x : x + side] = pixels
    return page, places


def _table(tiles: TextureTiles, found: Selection, places: npt.NDArray[np.int32], page: tuple[int, int]) -> AtlasTable:
    def edges(tile: Tile) -> tuple[float, float, float, float]:
        box = tiles.tree.extent_of(tile)
        return box.west, box.south, box.east, box.north

    return AtlasTable(
        np.array(found.tiles, np.int32),
        places,
        np.array([edges(tile) for tile in found.tiles]),
        np.array(found.footprints),
        tiles.size,
        tiles.border,
        page,
        tiles.extent.crs,
    )


@node(version=1, locality=whole)
def save_atlas(
    image: Image,
    table: AtlasTable,
    *,
    name: Annotated[OutputName, Param("Page to write, .png; the table goes to <name>.json beside it.")],
) -> File:
    """Write a page of texture tiles and its table, for what draws with it.

    The table is JSON: ``width``, ``height``, ``tile_size`` and ``border`` in pixels, ``crs``, and for each of the
    ``tiles`` its ``level``, ``row`` and ``col``, ``x`` and ``y`` of its first own pixel from the top left, the same
    rectangle as ``uv`` [left, top, right, bottom] in 0 to 1, the ``extent`` [west, south, east, north] that it covers,
    m, and its ``footprint``, the pixels of the view along a texel at most (null: without bound).

    Raises:
        ValueError: the name does not end in .png, or the table is that of another page.
    """
    from nodegraph_terrain.formats.png import png

    path = PurePosixPath(name)
    if path.suffix.lower() != ".png":
        raise ValueError(f"'{name}' must end in .png, the one format of atlases")
    rows, cols = image.shape
    if table.page != (cols, rows):
        wide, high = table.page
        raise ValueError(
            f"the table is that of a page of {wide} x {high} pixels, not {cols} x {rows}; link both from one atlas"
        )
    text = json.dumps({"image": path.name, **table.record()}, indent=1) + "\n"
    return File.of(name, png(image.data), File.of(str(path.with_suffix(".json")), text.encode()))
