"""Texture atlases: tiles side by side, each whole, and a table by which each is found."""

from __future__ import annotations

import json
import logging
from functools import cache
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as Picture

from nodegraph import Context
from nodegraph_terrain.raster import Elevation, Extent, Image
from nodegraph_texture.atlas import packed, save_atlas, texture_atlas
from nodegraph_texture.layer import layer
from nodegraph_texture.texture_tiles import TextureTiles, texture_tiles
from nodegraph_texture.tile_pixels import pixels_of
from nodegraph_texture.tile_tree import Tile
from nodegraph_texture.tile_view import View, needed

BOX = Extent(1000.0, 2000.0, 1640.0, 2480.0)
ROWS, COLS = np.indices((24, 32))
GROUND = Elevation((300 + 40 * np.sin(ROWS / 4) * np.cos(COLS / 5)).astype(np.float32), BOX)
ROCK = layer(
    layer(name="grass", colour="green", altitude=(None, None, 290, 320), noise_scale=1.0, noise_octaves=2),
    name="rock", colour="#706050", roughness=3.0, relief_octaves=2, variation=0.5, variation_octaves=2,
)  # fmt: skip
VIEW = {"eye": (1300.0, 1900.0, 420.0), "target": (1320.0, 2200.0, 300.0), "width": 160, "height": 100}


@cache
def tiled(**params) -> TextureTiles:
    return texture_tiles(
        ROCK, GROUND, **{"cell_size": 0.625, "tile_size": 16, "border": 2, **params}, context=Context()
    )


@given(st.integers(1, 200), st.integers(1, 9))
def test_packed_squares_stand_apart_and_keep_what_they_hold(count, side):
    squares = [np.full((side, side, 4), number % 255 + 1, np.uint8) for number in range(count)]
    page, places = packed(squares)
    owners = np.zeros(page.shape[:2], int)
    for number, (x, y) in enumerate(places):
        np.testing.assert_array_equal(page[y : y + side, x : x + side], squares[number])
        owners[y : y + side, x : x + side] += 1
    assert owners.max() == 1
    assert owners.sum() == count * side**2
    assert not page[owners == 0].any()
    rows, cols = page.shape[0] // side, page.shape[1] // side
    assert 0 <= cols - rows <= 1
    assert 0 <= rows * cols - count < cols


@pytest.mark.parametrize("content", ["colour", "normals", "heights"])
def test_an_atlas_holds_the_tiles_that_the_view_needs(content):
    tiles = tiled()
    atlas = texture_atlas(tiles, **VIEW, content=content, context=Context())
    table = atlas.table
    expected = needed(tiles, View(VIEW["eye"], VIEW["target"], 45.0, 160, 100)).tiles
    assert [tuple(row) for row in table.tiles.tolist()] == list(expected)
    assert len(expected) > 10
    assert len({tile.level for tile in expected}) > 1
    for (x, y), tile, extent in list(zip(table.places, expected, table.extents, strict=True))[::4]:
        rim = slice(y - 2, y + 18), slice(x - 2, x + 18)
        np.testing.assert_array_equal(atlas.image.data[rim], pixels_of(tiles.paint(tile), content))
        box = tiles.tree.extent_of(tile)
        assert tuple(extent) == (box.west, box.south, box.east, box.north)


def test_bilinear_filtering_within_a_tile_never_reads_a_neighbour():
    tiles = tiled(border=1)
    atlas = texture_atlas(tiles, **VIEW, context=Context())
    table, page = atlas.table, atlas.image.data[..., :3].astype(np.float64)
    rng = np.random.default_rng(0)
    for (x, y), (level, row, col) in zip(table.places[::5], table.tiles[::5].tolist(), strict=True):
        u, v = rng.uniform(0, 16, (2, 200))
        u[:4], v[:4] = (0, 16, 0, 16), (0, 0, 16, 16)
        whole = tiles.paint(Tile(level, row, col), border=4).colour[..., :3].astype(np.float64)
        np.testing.assert_allclose(bilinear(page, x + u, y + v), bilinear(whole, 4 + u, 4 + v), atol=1e-9)


def bilinear(picture, x, y):
    """Filter as graphics processors do: pixels have their values in their middles."""
    left, top = np.floor(x - 0.5).astype(int), np.floor(y - 0.5).astype(int)
    s, t = (x - 0.5 - left)[:, None], (y - 0.5 - top)[:, None]
    rows, cols = np.clip([top, top + 1], 0, len(picture) - 1), np.clip([left, left + 1], 0, picture.shape[1] - 1)
    upper = picture[rows[0], cols[0]] * (1 - s) + picture[rows[0], cols[1]] * s
    lower = picture[rows[1], cols[0]] * (1 - s) + picture[rows[1], cols[1]] * s
    return upper * (1 - t) + lower * t


def test_neighbours_in_the_world_agree_where_they_meet():
    tiles = tiled(border=1)
    atlas = texture_atlas(tiles, **VIEW, context=Context())
    places = dict(zip(map(tuple, atlas.table.tiles.tolist()), atlas.table.places.tolist(), strict=True))
    page, met = atlas.image.data.astype(np.float64), 0
    for (level, row, col), (x, y) in places.items():
        if (level, row, col + 1) in places:
            met += 1
            right, down = places[level, row, col + 1], np.arange(17.0)
            np.testing.assert_allclose(
                bilinear(page, np.full(17, x + 16.0), y + down),
                bilinear(page, np.full(17, float(right[0])), right[1] + down), atol=1e-9,
            )  # fmt: skip
    assert met > 5


def test_a_budget_bounds_the_page_and_says_what_is_missing(caplog):
    tiles = tiled()
    small = 9 * tiles.tile_bytes / 2**20
    with caplog.at_level(logging.WARNING):
        atlas = texture_atlas(tiles, **VIEW, budget=small, context=Context())
    assert len(atlas.table.tiles) <= 9
    assert atlas.image.data.nbytes <= 9 * tiles.tile_bytes
    (record,) = caplog.records
    assert "9 tiles are all that fit: texels are up to" in record.getMessage()
    caplog.clear()
    texture_atlas(tiles, **VIEW, context=Context())
    assert not caplog.records


def test_a_camera_that_moves_paints_only_what_is_new():
    kept, painted = {}, []

    def remember(what, compute):
        key = what[1:]
        if key not in kept:
            painted.append(key)
            kept[key] = compute()
        return kept[key]

    tiles = tiled()
    first = texture_atlas(tiles, **VIEW, context=Context(remember=remember))
    assert len(painted) == len(first.table.tiles)
    second = texture_atlas(tiles, **{**VIEW, "eye": (1310.0, 1910.0, 415.0)}, context=Context(remember=remember))
    before = set(map(tuple, first.table.tiles.tolist()))
    new = [row for row in map(tuple, second.table.tiles.tolist()) if row not in before]
    assert 0 < len(new) < 0.5 * len(second.table.tiles)
    assert [key[0] for key in painted[len(first.table.tiles) :]] == new


def test_an_atlas_is_written_with_its_table():
    tiles = tiled()
    atlas = texture_atlas(tiles, **VIEW, context=Context())
    file = save_atlas(*atlas, name="view/page.png")
    np.testing.assert_array_equal(np.asarray(Picture.open(BytesIO(file.content.tobytes()))), atlas.image.data)
    (sidecar,) = file.sidecars
    assert sidecar.name == "view/page.json"
    record = json.loads(sidecar.content.tobytes())
    assert record["image"] == "page.png"
    assert (record["height"], record["width"]) == atlas.image.shape
    assert (record["tile_size"], record["border"]) == (16, 2)
    for entry, (x, y) in zip(record["tiles"], atlas.table.places.tolist(), strict=True):
        assert (entry["x"], entry["y"]) == (x, y)
        u = np.multiply(entry["uv"], [record["width"], record["height"]] * 2)
        np.testing.assert_allclose(u, [x, y, x + 16, y + 16], atol=1e-9)
        assert 0 < entry["footprint"] <= 1


def test_what_cannot_be_an_atlas_is_refused():
    tiles = tiled()
    away = {**VIEW, "target": (1300.0, 1000.0, 420.0)}
    with pytest.raises(ValueError, match="the view shows no ground"):
        texture_atlas(tiles, **away, context=Context())
    with pytest.raises(ValueError, match="same point"):
        texture_atlas(tiles, **{**VIEW, "target": VIEW["eye"]}, context=Context())
    with pytest.raises(ValueError, match="room for 0; raise the budget"):
        texture_atlas(tiles, **VIEW, budget=1e-3, context=Context())
    atlas = texture_atlas(tiles, **VIEW, context=Context())
    with pytest.raises(ValueError, match=r"must end in \.png"):
        save_atlas(*atlas, name="page.jpg")
    with pytest.raises(ValueError, match="that of a page of"):
        save_atlas(Image(atlas.image.data[1:], BOX), atlas.table, name="page.png")
