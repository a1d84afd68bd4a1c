"""Folders of tiles for viewers of maps: {z}/{x}/{y} with the numbering of XYZ or TMS, and what describes them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from io import BytesIO
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, File, OutputName, Param, node, port_type, whole
from nodegraph.files import check_name
from nodegraph_texture.layer import colour_of
from nodegraph_texture.texture_tiles import Pixels, TextureTiles, steady
from nodegraph_texture.tile_grids import LocalGrid, MercatorGrid, TileGrid, on_background
from nodegraph_texture.tile_pixels import Content
from nodegraph_texture.tile_tree import Tile

Format = Literal["png", "jpg", "webp"]

TILES_MAX = 1 << 18
"""More tiles than this are refused as a mistake: 2^34 texels of 256 x 256 a tile."""

BLOCK = 4
"""Tiles along a side of a block, which is remembered as a whole."""

MIME = {"png": "image/png", "jpg": "image/jpeg", "webp": "image/webp"}


@port_type
class TileBlock:
    """The files of neighbouring tiles.

    Attributes:
        places: row and column of each, (n, 2) int64; tiles without ground are left out.
        files: their bytes, (length,) uint8 each.
    """

    places: npt.NDArray[np.int64]
    files: tuple[npt.NDArray[np.uint8], ...]


class Style(NamedTuple):
    """How tiles are written: see `save_tiles`."""

    content: Content
    format: Format
    quality: int
    background: tuple[float, float, float]


@node(version=1, locality=whole)
def save_tiles(
    tiles: TextureTiles,
    *,
    name: Annotated[OutputName, Param("Folder for the tiles.")] = "tiles",
    grid: Annotated[
        Literal["auto", "web_mercator", "local"],
        Param("Which tiles: of slippy maps, the quadtree's own; auto: of slippy maps if there is a crs."),
    ] = "auto",
    scheme: Annotated[Literal["xyz", "tms"], Param("Rows from the north (xyz) or from the south (tms).")] = "xyz",
    format: Annotated[Format, Param("png (exact), jpg (no transparency), or webp.")] = "png",
    content: Annotated[
        Content, Param("What tiles hold: colour, normals, or heights in the Terrarium code.")
    ] = "colour",
    levels: Annotated[
        tuple[int, int] | None, Param("First and last level or zoom; none: those that suit the texture.")
    ] = None,
    quality: Annotated[int, Param("Of jpg and webp colours.", ge=1, le=100)] = 85,
    background: Annotated[str, Param("Colour under what is transparent, for jpg.")] = "#ffffff",
    address: Annotated[str, Param("Where the folder will be served, for tiles.json, such as https://host/a/.")] = "",
    context: Context,
) -> File:
    """Write a texture as a folder of tiles, ``name/z/x/y.png``, for viewers of maps.

    - ``web_mercator``: the tiles of slippy maps (EPSG:3857), which all web maps show.  Texels are projected to the
      system of the ground one by one and painted there; nothing is resampled.  By default from the zoom at which one
      tile is as large as the ground to that whose texels on the ground come nearest to the finest of the texture; as
      texels are painted, any zoom is possible.  Noise is as fine as texels in the middle of the ground show.
    - ``local``: the tiles of the quadtree without their borders, level by level, in the system of the ground; column 0
      begins at its western edge and row 0 at its northern one.  For TMS, rows count from the south of level 0's tiles.

    Tiles without ground are not written.  ``name/tiles.json`` describes the rest: as TileJSON 3.0 for slippy maps, with
    ``encoding: terrarium`` for heights, and with corner and sides of texels for local tiles; TMS has
    ``name/tilemapresource.xml``, too.

    Tiles are remembered in blocks of 4 x 4: a run that was stopped goes on where it was, and files that are right
    already are left alone.  Memory is that of a tile's painting and of all files' bytes; for more than memory holds,
    save levels one by one.  Tiles are painted on the host, so that they are the same files everywhere.

    Args:
        tiles: of the texture; `tile_size` is that of the files, too.
        name, grid, scheme, content, levels, address: see above.
        format: heights are kept exactly, and so cannot be jpg; webp keeps heights and normals exactly.
        quality: see above.
        background: see above.
        context: the engine's.

    Raises:
        ValueError: the ground has no place on the map, a level does not exist, heights are to be jpg, or there are more
            than 262,144 tiles.

    Source: TileJSON 3.0.0, https://github.com/mapbox/tilejson-spec; OSGeo Tile Map Service Specification 1.0.0.
    """
    check_name(f"{name}/tiles.json")
    if content == "heights" and format == "jpg":
        raise ValueError("heights as jpg would lose their digits; write them as png or webp")
    chosen = grid if grid != "auto" else "web_mercator" if tiles.extent.crs else "local"
    found: TileGrid = MercatorGrid(tiles) if chosen == "web_mercator" else LocalGrid(tiles)
    first, last = _levels(found, levels)
    style = Style(content, format, quality, colour_of(background))
    total = sum(len(rows) * len(cols) for rows, cols in map(found.covering, range(first, last + 1)))
    if total > TILES_MAX:
        raise ValueError(f"there would be {total:,} tiles, over {TILES_MAX:,}; save fewer levels, or larger tiles")
    done, files = 0, []
    for block in _blocks(found, first, last):
        made = _block(found, block, style, context, done, total)
        done += len(block)
        rows = found.rows(block[0].level)
        for (row, col), content_of in zip(made.places.tolist(), made.files, strict=True):
            y = row if scheme == "xyz" else rows - 1 - row
            files.append(File(f"{name}/{block[0].level}/{col}/{y}.{format}", content_of))
    if not files:
        raise ValueError("no tile has any ground at these levels; take finer ones")
    if scheme == "tms":
        files.insert(0, File.of(f"{name}/tilemapresource.xml", _resource(found, tiles, style, first, last, name)))
    text = json.dumps(_metadata(found, tiles, style, (first, last), scheme, name, address), indent=1) + "\n"
    context.progress(1.0)
    return File.of(f"{name}/tiles.json", text.encode(), *files)


def _levels(grid: TileGrid, stated: tuple[int, int] | None) -> tuple[int, int]:
    first, last = stated or grid.usual
    if not 0 <= first <= last <= grid.deepest:
        raise ValueError(
            f"levels {first} to {last} do not exist; give the first and the last of 0 to {grid.deepest}, in this order"
        )
    return first, last


def _blocks(grid: TileGrid, first: int, last: int) -> Iterator[list[Tile]]:
    """Yield tiles of levels, block by block; blocks are aligned to multiples of their side."""
    for level in range(first, last + 1):
        rows, cols = grid.covering(level)
        for top in range(rows.start // BLOCK * BLOCK, rows.stop, BLOCK):
            for left in range(cols.start // BLOCK * BLOCK, cols.stop, BLOCK):
                yield [
                    Tile(level, row, col)
                    for row in range(max(top, rows.start), min(top + BLOCK, rows.stop))
                    for col in range(max(left, cols.start), min(left + BLOCK, cols.stop))
                ]


def _block(grid: TileGrid, block: list[Tile], style: Style, context: Context, done: int, total: int) -> TileBlock:
    """Return the files of a block, remembered or painted."""

    def painted() -> TileBlock:
        places, files = [], []
        for number, tile in enumerate(block, done):
            quiet = steady(context, number / total, f"tile {number + 1} of {total}", style.content)
            pixels = grid.pixels(tile, style.content, quiet)
            if pixels is not None:
                places.append((tile.row, tile.col))
                files.append(np.frombuffer(encoded(pixels, style), np.uint8))
        return TileBlock(np.array(places, np.int64).reshape(-1, 2), tuple(files))

    context.progress(done / total, f"tile {done + 1} of {total}")
    depends = grid.tiles, grid.name, tuple(map(tuple, block)), tuple(style)
    return context.remembered(depends, painted)


def encoded(pixels: Pixels, style: Style) -> bytes:
    """Return a tile, (rows, columns, 4) uint8, as the bytes of a picture; alpha is left out where all is opaque."""
    from PIL import Image as Picture

    from nodegraph_terrain.formats.png import png

    if style.format == "jpg":
        pixels = on_background(pixels, style.background)
    elif (pixels[..., 3] == 255).all():
        pixels = pixels[..., :3]
    if style.format == "png":
        return png(pixels)
    buffer = BytesIO()
    picture = Picture.fromarray(np.ascontiguousarray(pixels))
    if style.format == "jpg":
        picture.save(buffer, "JPEG", quality=style.quality, optimize=True)
    elif style.content == "colour":
        picture.save(buffer, "WEBP", quality=style.quality, method=4)
    else:
        picture.save(buffer, "WEBP", lossless=True, exact=True, method=4)
    return buffer.getvalue()


def _metadata(
    grid: TileGrid, tiles: TextureTiles, style: Style, levels: tuple[int, int], scheme: str, name: str, address: str
) -> dict[str, Any]:
    about: dict[str, Any] = {"tilejson": "3.0.0"} if grid.name == "web_mercator" else {"grid": grid.name}
    address += "/" if address and not address.endswith("/") else ""
    about |= {"name": name.rsplit("/", 1)[-1], "tiles": [f"{address}{{z}}/{{x}}/{{y}}.{style.format}"]}
    about |= {"scheme": scheme, "format": style.format, "tileSize": tiles.size, "content": style.content}
    if style.content == "heights":
        about["encoding"] = "terrarium"
    return about | grid.about(levels)


def _resource(grid: TileGrid, tiles: TextureTiles, style: Style, first: int, last: int, name: str) -> bytes:
    """Return the description of a TMS tile map as XML."""
    from xml.etree import ElementTree as Xml

    about = grid.tile_map()
    root = Xml.Element("TileMap", version="1.0.0", tilemapservice="http://tms.osgeo.org/1.0.0")
    Xml.SubElement(root, "Title").text = name.rsplit("/", 1)[-1]
    Xml.SubElement(root, "Abstract")
    Xml.SubElement(root, "SRS").text = about["srs"]
    west, south, east, north = map(repr, about["bounds"])
    Xml.SubElement(root, "BoundingBox", minx=west, miny=south, maxx=east, maxy=north)
    Xml.SubElement(root, "Origin", x=repr(about["origin"][0]), y=repr(about["origin"][1]))
    side = str(tiles.size)
    kind = {"mime-type": MIME[style.format], "extension": style.format}
    Xml.SubElement(root, "TileFormat", {"width": side, "height": side, **kind})
    sets = Xml.SubElement(root, "TileSets", profile=about["profile"])
    for level in range(first, last + 1):
        pixel = repr(about["cell"] / 2**level)
        Xml.SubElement(sets, "TileSet", {"href": str(level), "units-per-pixel": pixel, "order": str(level)})
    Xml.indent(root, " ")
    return bytes(Xml.tostring(root, "utf-8", xml_declaration=True))
