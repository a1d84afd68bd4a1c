"""Folders of tiles: numbered as published, painted where they lie, written once."""

from __future__ import annotations

import json
import math
from functools import cache
from io import BytesIO
from xml.etree import ElementTree as Xml

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as Picture

from nodegraph import Context, Graph
from nodegraph.cache import Cache
from nodegraph.errors import Cancelled, RunError
from nodegraph_terrain.georeference import parse_crs, transformed
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_texture import tile_mercator as mercator
from nodegraph_texture.apply_layers import apply_layers
from nodegraph_texture.evaluate import evaluate
from nodegraph_texture.export_tiles import save_tiles
from nodegraph_texture.layer import layer
from nodegraph_texture.texture_tiles import TextureTiles, texture_tiles
from nodegraph_texture.tile_grids import MercatorGrid
from nodegraph_texture.tile_tree import Tile
from nodegraph_texture.tile_warp import Warped, paint_warped

# East of the Lake of Zug, 960 m x 720 m, 8.6 degrees east and 47.2 degrees north.
BOX = Extent(470_000.0, 5_227_000.0, 470_960.0, 5_227_720.0, "EPSG:32632")
ROWS, COLS = np.indices((24, 32))
HILLS = (900 + 120 * np.sin(ROWS / 4) * np.cos(COLS / 5)).astype(np.float32)
HILLS[10:13, 5:9] = np.nan
GRASS = layer(name="grass", colour="green", slope=(None, None, 15, 30), noise_scale=1.0)
ROCK = layer(GRASS, name="rock", colour="#706050", roughness=3.0, relief_wavelength=150, variation=0.5)


@cache
def tiled(crs: str = BOX.crs, **params) -> TextureTiles:
    box = Extent(BOX.west, BOX.south, BOX.east, BOX.north, crs)
    given = {"cell_size": 10, "tile_size": 32, **params}
    return texture_tiles(ROCK, Elevation(HILLS, box), **given, context=Context())


def written(tiles: TextureTiles, **params) -> dict[str, bytes]:
    file = save_tiles(tiles, **params, context=Context())
    found = {item.name: item.content.tobytes() for item in file.all()}
    assert len(found) == len(file.all())
    return found


def picture(content: bytes) -> np.ndarray:
    return np.asarray(Picture.open(BytesIO(content)).convert("RGBA"))


# Web Mercator.


def slippy(longitude: float, latitude: float, zoom: int) -> tuple[int, int]:
    """Return column and row by the formula of the OpenStreetMap wiki, Slippy map tilenames."""
    count = 2.0**zoom
    x = int((longitude + 180.0) / 360.0 * count)
    y = int((1.0 - math.asinh(math.tan(math.radians(latitude))) / math.pi) / 2.0 * count)
    return x, y


def corner(x: float, y: float, zoom: int) -> tuple[float, float]:
    """Return longitude and latitude of the north-western corner of a tile, by the formula of the same page."""
    longitude = x / 2.0**zoom * 360.0 - 180.0
    return longitude, math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * y / 2.0**zoom))))


@given(st.floats(-179.9, 179.9), st.floats(-84.9, 84.9), st.integers(0, 24))
def test_tiles_are_numbered_by_the_published_formula(longitude, latitude, zoom):
    x, y = transformed(parse_crs("EPSG:4326"), parse_crs("EPSG:3857"), np.array([longitude]), np.array([latitude]))
    eps = 1e-6
    spot = mercator.Footprint(x[0] - eps, y[0] - eps, x[0] + eps, y[0] + eps, (0.0, 0.0, 0.0, 0.0))
    rows, cols = mercator.covering(spot, zoom)
    col, row = slippy(longitude, latitude, zoom)
    assert row in rows
    assert col in cols
    assert len(rows) <= 2
    assert len(cols) <= 2


def test_texels_lie_where_the_published_formula_says():
    grid = MercatorGrid(tiled())
    zoom, row, col = 15, 11_505, 17_168
    source, target = parse_crs("EPSG:3857"), parse_crs("EPSG:4326")
    texels = mercator.texels_of(target, source, -1e8, zoom, row, col, 32, 1, grid.found.shrink)
    for i, j in ((0, 0), (5, 30), (33, 33)):
        longitude, latitude = corner(col + (j - 0.5) / 32, row + (i - 0.5) / 32, zoom)
        assert texels.x[i, j] == pytest.approx(longitude, abs=1e-9)
        assert texels.y[i, j] == pytest.approx(latitude, abs=1e-9)


def test_a_tile_shows_the_ground_that_lies_there():
    tiles = tiled(cell_size=4)
    files = written(tiles, content="heights", levels=(15, 15))
    whole = apply_layers(ROCK, tiles.ground, cell_size=2.0, context=Context())
    checked = 0
    for name, content in files.items():
        if not name.endswith(".png"):
            continue
        _, zoom, col, row = name.removesuffix(".png").split("/")
        r, g, b, alpha = np.moveaxis(picture(content).astype(np.float64), -1, 0)
        heights = 256 * r + g + b / 256 - 32768
        for i, j in np.argwhere(alpha > 0)[::23]:
            place = corner(int(col) + (j + 0.5) / 32, int(row) + (i + 0.5) / 32, int(zoom))
            (x,), (y,) = transformed(
                parse_crs("EPSG:4326"), parse_crs(BOX.crs), np.array([place[0]]), np.array([place[1]])
            )
            at = whole.surface.data[min(359, int((BOX.north - y) / 2)), min(479, int((x - BOX.west) / 2))]
            if not np.isnan(at):  # the raster's texel beside it may be void
                assert heights[i, j] == pytest.approx(at, abs=4.0)
                checked += 1
    assert checked > 30


def test_tiles_of_two_sizes_have_the_same_texels_bit_for_bit():
    small, large = MercatorGrid(tiled(tile_size=16)), MercatorGrid(tiled(tile_size=32))
    rows, cols = large.covering(15)
    for content in ("colour", "normals", "heights"):
        whole = large.pixels(Tile(15, rows[0], cols[0]), content, Context())
        assert 0 < (whole[..., 3] > 0).sum() < whole[..., 3].size
        for i in (0, 1):
            for j in (0, 1):
                part = small.pixels(Tile(16, 2 * rows[0] + i, 2 * cols[0] + j), content, Context())
                own = whole[16 * i : 16 * i + 16, 16 * j : 16 * j + 16]
                if part is None:
                    assert not own[..., 3].any()
                else:
                    np.testing.assert_array_equal(part, own)


def test_warped_texels_that_are_not_warped_are_those_of_the_raster():
    scene = tiled().scene
    expected = evaluate(scene, 10.0, 4, 6, 40, 50)
    assert scene.displaces
    reach = max(1, scene.reach)
    x = BOX.west + (np.arange(6 - reach, 56 + reach) + 0.5) * 10
    y = BOX.north - (np.arange(4 - reach, 44 + reach) + 0.5) * 10
    found = paint_warped(scene, Warped(*np.meshgrid(x, y), (10.0, 10.0)))
    np.testing.assert_array_equal(np.isnan(found.height), np.isnan(expected.height))
    assert np.nanmax(np.abs(found.height - expected.height)) < 1e-3
    assert np.nanmax(np.abs(found.normals - expected.normals)) < 1e-4
    assert np.abs(found.colour.astype(int) - expected.colour).max() <= 1


def test_texels_on_a_turned_grid_see_the_same_ground():
    # Columns run north and rows run east: the transposed picture, upside down.
    scene = tiled().scene
    expected = evaluate(scene, 10.0, 4, 6, 40, 50)
    reach = max(1, scene.reach)
    x = BOX.west + (np.arange(6 - reach, 56 + reach) + 0.5) * 10
    y = BOX.north - (np.arange(4 - reach, 44 + reach) + 0.5) * 10
    y2, x2 = np.meshgrid(y[::-1], x)
    found = paint_warped(scene, Warped(x2, y2, (10.0, 10.0)))
    assert np.nanmax(np.abs(found.height - expected.height[::-1].T)) < 1e-3
    back = np.swapaxes(found.normals, 0, 1)[::-1]
    # Along columns is north, against rows is west.
    assert np.nanmax(np.abs(back[..., 0] - expected.normals[..., 1])) < 1e-4
    assert np.nanmax(np.abs(back[..., 1] + expected.normals[..., 0])) < 1e-4


def test_a_folder_of_slippy_tiles_says_what_it_holds():
    tiles = tiled()
    files = written(tiles, name="out/zug", address="https://example.org/zug")
    about = json.loads(files.pop("out/zug/tiles.json"))
    assert about["tilejson"] == "3.0.0"
    assert about["tiles"] == ["https://example.org/zug/{z}/{x}/{y}.png"]
    assert (about["scheme"], about["name"]) == ("xyz", "zug")
    west, south, east, north = about["bounds"]
    assert (west, south, east, north) == pytest.approx((8.604, 47.195, 8.617, 47.202), abs=2e-3)
    assert west < about["center"][0] < east
    assert south < about["center"][1] < north
    # 10 m of ground at 47.2 degrees: 2 pi 6378137 cos(47.2) / 32 / 10 = 2^16.38.
    assert about["maxzoom"] == 16
    assert about["minzoom"] == 14
    zooms = {int(name.split("/")[2]) for name in files}
    assert zooms == set(range(14, 17))
    for name, content in files.items():
        _, _, zoom, x, y = name.removesuffix(".png").split("/")
        assert picture(content).shape == (32, 32, 4)
        assert picture(content)[..., 3].any()
        first, last = slippy(west, north, int(zoom)), slippy(east, south, int(zoom))
        assert first[0] <= int(x) <= last[0]
        assert first[1] <= int(y) <= last[1]


def test_tms_counts_rows_from_the_south():
    tiles = tiled()
    xyz, tms = written(tiles), written(tiles, scheme="tms")
    assert json.loads(tms["tiles/tiles.json"])["scheme"] == "tms"
    resource = Xml.fromstring(tms.pop("tiles/tilemapresource.xml"))
    assert resource.find("SRS").text == "EPSG:3857"
    assert resource.find("TileSets").get("profile") == "global-mercator"
    sets = resource.findall("TileSets/TileSet")
    assert [int(item.get("href")) for item in sets] == [14, 15, 16]
    assert float(sets[0].get("units-per-pixel")) == pytest.approx(156543.03392804097 * 256 / 32 / 2**14)
    assert len(xyz) == len(tms)
    for name, content in xyz.items():
        if name.endswith(".png"):
            folder, zoom, x, y = name.removesuffix(".png").split("/")
            assert tms[f"{folder}/{zoom}/{x}/{2 ** int(zoom) - 1 - int(y)}.png"] == content


# Local tiles.


def test_local_tiles_are_the_quadtrees_own():
    tiles = tiled("", border=3)
    files = written(tiles)
    about = json.loads(files.pop("tiles/tiles.json"))
    assert about["grid"] == "local"
    assert about["origin"] == [BOX.west, BOX.north]
    assert [entry["cell"][0] for entry in about["levels"]] == [40.0, 20.0, 10.0]
    assert len(files) == 1 + 2 * 2 + 3 * 3
    for name, content in files.items():
        _, level, col, row = map(str, name.removesuffix(".png").split("/"))
        expected = tiles.pixels(Tile(int(level), int(row), int(col)), "colour", 0)
        np.testing.assert_array_equal(picture(content), expected)


def test_local_tms_has_one_southern_edge_for_all_levels():
    tiles = tiled("", levels=2)  # level 0 has 2 x 2 tiles
    xyz, tms = written(tiles), written(tiles, scheme="tms")
    for name, content in xyz.items():
        if name.endswith(".png"):
            folder, level, x, y = name.removesuffix(".png").split("/")
            assert tms[f"{folder}/{level}/{x}/{2 * 2 ** int(level) - 1 - int(y)}.png"] == content
    resource = Xml.fromstring(tms["tiles/tilemapresource.xml"])
    origin = resource.find("Origin")
    assert (float(origin.get("x")), float(origin.get("y"))) == (BOX.west, BOX.north - 2 * 32 * 20)


def test_tiles_without_ground_are_not_written():
    values = HILLS.copy()
    values[:, 16:] = np.nan
    box = Extent(0.0, 0.0, 960.0, 720.0)
    files = written(texture_tiles(ROCK, Elevation(values, box), cell_size=10, tile_size=16, context=Context()))
    columns = {int(name.split("/")[2]) for name in files if name.startswith("tiles/3/")}
    assert columns == {0, 1, 2}


@pytest.mark.parametrize("content", ["colour", "heights", "normals"])
def test_formats_keep_what_they_promise(content):
    tiles = tiled("")
    level = {"levels": (1, 1), "content": content}
    png = {name[:-4]: picture(data) for name, data in written(tiles, **level).items() if name.endswith("png")}
    webp = {name[:-5]: picture(data) for name, data in written(tiles, **level, format="webp").items() if "webp" in name}
    assert png.keys() == webp.keys()
    for name, pixels in png.items():
        if content == "colour":
            known = pixels[..., 3] > 0
            assert np.abs(pixels[known].astype(int) - webp[name][known]).mean() < 8
        else:
            np.testing.assert_array_equal(webp[name], pixels)


def test_jpg_lays_tiles_on_a_background():
    files = written(tiled(""), format="jpg", background="#ff0000", quality=95, levels=(0, 0))
    found = picture(files["tiles/0/0/0.jpg"])
    assert tuple(map(int, found[-1, -1])) == pytest.approx((254, 0, 0, 255), abs=3)
    alpha = tiled("").pixels(Tile(0, 0, 0), "colour", 0)[..., 3]
    assert alpha[-1, -1] == 0


# Many of them.


def test_tiles_are_remembered_in_blocks_and_shared_between_numberings():
    kept: dict[object, object] = {}

    def remember(what, compute):
        key = what[1:]
        if key not in kept:
            kept[key] = compute()
        return kept[key]

    tiles = tiled("", tile_size=8)
    first = save_tiles(tiles, context=Context(remember=remember))
    count = len(kept)
    assert count == 1 + 1 + 1 + 2 * 2 + 3 * 3  # 4 x 4 tiles each
    again = save_tiles(tiles, name="other", scheme="tms", context=Context(remember=remember))
    assert len(kept) == count
    assert len(again.all()) == len(first.all()) + 1


def test_a_run_that_was_stopped_goes_on_and_leaves_right_files_alone(tmp_path):
    from nodegraph_texture import export_tiles

    nodes = {
        "dem": {"type": "terrain.sample_dem"},
        "metric": {"type": "terrain.reproject", "inputs": {"surface": "dem"}, "params": {"cell_size": 400}},
        "rock": {"type": "texture.layer", "params": {"name": "rock", "colour": "#706050", "variation": 0.5}},
        "tiles": {
            "type": "texture.texture_tiles",
            "inputs": {"layers": "rock", "surface": "metric"},
            "params": {"cell_size": 200, "tile_size": 16},
        },
        "saved": {"type": "texture.save_tiles", "inputs": {"tiles": "tiles"}},
    }
    graph = Graph.from_json(json.dumps({"format": "nodegraph/1", "nodes": nodes}))
    cache, out = Cache(tmp_path / "cache"), tmp_path / "out"
    encoded, calls = export_tiles.encoded, []

    def breaks(pixels, style):
        calls.append(1)
        if len(calls) == 50:
            raise OSError("interrupted")
        return encoded(pixels, style)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export_tiles, "encoded", breaks)
        with pytest.raises(RunError, match="interrupted"):
            graph.run(cache=cache, out=out)
        assert not list(out.rglob("*.png"))
        calls[:] = [1] * 50
        result = graph.run(cache=cache, out=out)
    assert result.nodes["saved"].status == "computed"
    total = len(result.files_written) - 1
    # Blocks that were whole are not painted again; of the one that was not, 16 tiles at most.
    painted = len(calls) - 50
    assert total - 49 <= painted <= total - 49 + 16 < total
    some = sorted(out.rglob("*.png"))
    some[3].unlink()
    some[5].write_bytes(b"damaged")
    again = graph.run(cache=cache, out=out)
    assert {run.status for run in again.nodes.values()} == {"cached"}
    assert sorted(again.files_written) == sorted([some[3], some[5]])
    cache.close()


def test_a_save_reports_progress_and_can_be_cancelled():
    from threading import Event

    seen, stop = [], Event()

    def report(fraction, message):
        seen.append((fraction, message))
        if fraction > 0.5:
            stop.set()

    with pytest.raises(Cancelled):
        save_tiles(tiled("", tile_size=8), context=Context(cancelled=stop, report=report))
    fractions = [fraction for fraction, _ in seen]
    assert fractions == sorted(fractions)
    assert any(message == "tile 3 of 152" for _, message in seen)


def test_what_cannot_be_saved_is_refused():
    def refused(message: str, tiles: TextureTiles | None = None, **params) -> None:
        with pytest.raises(ValueError, match=message):
            save_tiles(tiles or tiled(), **params, context=Context())

    refused("heights as jpg", content="heights", format="jpg")
    refused("no coordinate reference system", tiled(""), grid="web_mercator")
    refused("levels 0 to 3 do not exist; give the first and the last of 0 to 2", tiled(""), levels=(0, 3))
    refused("levels 5 to 4 do not exist", levels=(5, 4))
    refused("is no colour", background="reddish")
    refused("over 262,144; save fewer levels", levels=(30, 30))
    refused(r"'\.\./a/tiles.json' is no file name inside the output folder", name="../a")
    pole = Elevation(HILLS, Extent(1.9e6, 1.9e6, 2.1e6, 2.1e6, "EPSG:32661"))
    refused("has no place on the Web Mercator map",
            texture_tiles(ROCK, pole, cell_size=1e4, context=Context()))  # fmt: skip
