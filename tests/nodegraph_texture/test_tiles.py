"""Texture tiles: every tile is that part of the whole, and a camera gets what it needs within its budget."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph.errors import Cancelled
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_texture.apply_layers import apply_layers
from nodegraph_texture.evaluate import evaluate
from nodegraph_texture.layer import layer
from nodegraph_texture.quantities import Temperature
from nodegraph_texture.texture_tiles import TextureTiles, texture_tiles
from nodegraph_texture.tile_cache import TileCache
from nodegraph_texture.tile_pixels import pixels_of
from nodegraph_texture.tile_statistics import tile_statistics
from nodegraph_texture.tile_tree import Tile, TileTree, levels_needed
from nodegraph_texture.tile_view import View, in_view, needed
from nodegraph_tree.from_elevation import from_elevation

BOX = Extent(500_000.3, 5_200_000.1, 500_900.3, 5_200_720.1, "EPSG:32632")
SNOW = layer(name="snow", colour="#ffffff", altitude=(1500, 1520, None, None), slope=(None, None, 40, 50),
             constraints={"temperature": (None, None, 4.0, 9.0)}, noise_scale=1.0, roughness=-3.0)  # fmt: skip
ROCK = layer(SNOW, name="rock", colour="#706050", roughness=6.0, relief_wavelength=90, variation=0.5)


def hills(rows: int = 24, cols: int = 30) -> Elevation:
    from scipy.ndimage import gaussian_filter

    values = 1500 + 300 * gaussian_filter(np.random.default_rng(3).normal(size=(rows, cols)), 2)
    values[3:6, 4:9] = np.nan
    return Elevation(values.astype(np.float32), BOX)


GROUND = hills()
WARMTH = Temperature(np.linspace(-5, 15, 12, dtype=np.float32).reshape(3, 4), BOX)


@cache
def tiled(**params) -> TextureTiles:
    given = {"tile_size": 16, "border": 2, **params}
    return texture_tiles(ROCK, GROUND, None, WARMTH, **given, context=Context())


# The quadtree.


def test_every_tile_of_every_level_is_that_part_of_the_whole_bit_for_bit():
    tiles = tiled(factor=2)
    assert tiles.levels == 3
    assert tiles.tree.shape(0) == (1, 1)
    for level in range(tiles.levels):
        rows, cols = tiles.tree.shape(level)
        high, wide = (16 * count for count in (rows, cols))
        whole = evaluate(tiles.scene, tiles.tree.cell_of(level), -2, -2, high + 4, wide + 4)
        for tile in tiles.tree.tiles(level):
            part = tiles.paint(tile)
            window = slice(16 * tile.row, 16 * tile.row + 20), slice(16 * tile.col, 16 * tile.col + 20)
            for own, all_of in zip(part, whole, strict=True):
                np.testing.assert_array_equal(own, all_of[window])


@pytest.mark.parametrize("how", [{"factor": 2}, {"cell_size": 14.7}])
def test_the_finest_level_is_what_apply_layers_paints(how):
    tiles = tiled(**how)
    whole = apply_layers(ROCK, GROUND, None, WARMTH, **how, context=Context())
    rows, cols = whole.image.shape
    last = tiles.levels - 1
    shape = tiles.tree.shape(last)
    made = np.zeros((16 * shape[0], 16 * shape[1], 4), np.uint8)
    for tile in tiles.tree.tiles(last):
        made[16 * tile.row : 16 * tile.row + 16, 16 * tile.col : 16 * tile.col + 16] = tiles.pixels(tile, "colour", 0)
    np.testing.assert_array_equal(made[:rows, :cols], whole.image.data)
    assert 0 <= 16 * shape[0] - rows <= 16  # what apply_layers leaves out, less than a texel, has tiles, too
    assert 0 <= 16 * shape[1] - cols <= 16


def test_a_coarser_level_is_what_apply_layers_paints_with_larger_texels():
    tiles = tiled(cell_size=15.0)
    level = tiles.levels - 2
    whole = apply_layers(ROCK, GROUND, None, WARMTH, cell_size=30.0, context=Context()).image.data
    for tile in tiles.tree.tiles(level):
        part = whole[16 * tile.row : 16 * tile.row + 16, 16 * tile.col : 16 * tile.col + 16]
        own = tiles.pixels(tile, "colour", 0)[: part.shape[0], : part.shape[1]]
        np.testing.assert_array_equal(own, part)


def test_tiles_of_a_construction_tree_are_parts_of_the_whole():
    tree = from_elevation(Elevation(np.nan_to_num(GROUND.data, nan=1500.0), BOX))
    box = (500_100.0, 5_200_100.0, 500_800.0, 5_200_600.0)
    layers = layer(name="rock", colour="#706050", altitude=(1400, 1600, None, None), roughness=6.0)
    tiles = texture_tiles(layers, None, tree, cell_size=25, extent=box, tile_size=8, context=Context())
    whole = apply_layers(layers, None, tree, cell_size=25, extent=box, context=Context())
    assert whole.image.shape == (20, 28)
    found = tiles.paint(Tile(tiles.levels - 1, 1, 2), border=0)
    np.testing.assert_array_equal(found.height, whole.surface.data[8:16, 16:24])
    assert tiles.heights(Tile(0, 0, 0))[0] <= np.nanmin(whole.surface.data)
    assert tiles.heights(Tile(0, 0, 0))[1] >= np.nanmax(whole.surface.data)


def test_a_device_paints_tiles_as_parts_of_its_whole():
    from nodegraph.opencl import choose
    from nodegraph_texture.apply_opencl import evaluate_on_device

    device = choose("auto")
    if device is None:
        pytest.skip("no OpenCL device")
    tiles, context = tiled(factor=2), Context(device=choose("auto"))
    for level in (1, 2):
        rows, cols = tiles.tree.shape(level)
        whole = evaluate_on_device(tiles.scene, tiles.tree.cell_of(level), -2, -2, 16 * rows + 4, 16 * cols + 4, device)
        colours, heights = device.to_host(whole.colour), device.to_host(whole.height)
        for tile in tiles.tree.tiles(level):
            window = slice(16 * tile.row, 16 * tile.row + 20), slice(16 * tile.col, 16 * tile.col + 20)
            part = tiles.paint(tile, context=context)
            np.testing.assert_array_equal(device.to_host(part.colour), colours[window])
            np.testing.assert_array_equal(device.to_host(part.height), heights[window])


@given(
    st.floats(-1e7, 1e7), st.floats(-1e7, 1e7), st.floats(0.01, 100), st.floats(0.01, 100),
    st.integers(1, 3000), st.integers(1, 3000), st.integers(4, 300),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_a_parents_extent_is_exactly_its_childrens_together(west, north, width, height, rows, cols, size):
    east, south = west + cols * width, north - rows * height
    assume(east > west and south < north)
    cell = (east - west) / cols, (north - south) / rows
    extent = Extent(west, south, east, north)
    tree = TileTree(extent, cell, size, levels_needed(extent, cell, size))
    assert tree.shape(0) == (1, 1)
    for level in range(tree.levels):
        count = tree.shape(level)
        tile = Tile(level, count[0] - 1, count[1] // 2)
        own = tree.extent_of(tile)
        boxes = [tree.extent_of(child) for child in tile.quarters]
        if level + 1 < tree.levels:
            assert min(box.west for box in boxes) == own.west
            assert max(box.east for box in boxes) == own.east
            assert min(box.south for box in boxes) == own.south
            assert max(box.north for box in boxes) == own.north
            assert boxes[0].east == boxes[1].west == boxes[2].east
            assert boxes[0].south == boxes[2].north == boxes[3].north
            children = tree.children(tile)
            assert 1 <= len(children) <= 4
            assert all(tree.has(child) and child.parent == tile for child in children)
        # A tile of a level is the child of one of the level before, and reaches ground.
        assert level == 0 or tree.has(tile.parent)
        assert own.south < extent.north
        assert tree.extent_of(Tile(level, count[0] - 1, count[1] - 1)).east >= east - 1e-5 * cell[0] * 2**tree.levels


def test_heights_of_a_tile_bound_its_displaced_ground():
    tiles = tiled(factor=2)
    last = tiles.levels - 1
    for level in range(tiles.levels):
        for tile in tiles.tree.tiles(level):
            down = last - level
            below = [fine for fine in tiles.tree.tiles(last) if (fine.row >> down, fine.col >> down) == tile[1:]]
            found = np.concatenate([tiles.paint(fine, 0).height for fine in below])
            low, high = tiles.heights(tile)
            assert low <= np.nanmin(found)
            assert high >= np.nanmax(found)
            if level == 0:
                assert high - low < 1.5 * (np.nanmax(found) - np.nanmin(found)) + 2 * 9  # bumps of 6 and 3 m


def test_a_tile_without_ground_has_no_heights():
    values = hills().data.copy()
    values[:, 15:] = np.nan
    tiles = texture_tiles(ROCK, Elevation(values, BOX), None, WARMTH, factor=2, tile_size=16, context=Context())
    last = tiles.levels - 1
    assert tiles.heights(Tile(last, 0, 3)) is None
    assert tiles.heights(Tile(last, 0, 1)) is not None
    assert not tiles.pixels(Tile(last, 0, 3), "colour", 0).any()


# Pixels.


def test_normals_and_heights_come_back_from_pixels():
    made = tiled(factor=2).paint(Tile(2, 0, 0))
    void = np.isnan(made.height)
    assert 0 < void.sum() < void.size
    normals = pixels_of(made, "normals")
    np.testing.assert_array_equal(normals[..., 3] == 0, void)
    back = normals[..., :3][~void] / 127.5 - 1
    assert np.abs(back - made.normals[~void]).max() <= 1 / 255 + 1e-6
    r, g, b, alpha = np.moveaxis(pixels_of(made, "heights").astype(np.float64), -1, 0)
    np.testing.assert_array_equal(alpha == 0, void)
    assert np.abs((256 * r + g + b / 256 - 32768)[~void] - made.height[~void]).max() <= 1 / 512
    assert (256 * r + g + b / 256 - 32768)[void].tolist() == [0] * int(void.sum())


def test_heights_without_a_code_are_refused():
    made = tiled(factor=2).paint(Tile(2, 0, 0))
    with pytest.raises(ValueError, match="do not fit the code of tiles"):
        pixels_of(made._replace(height=made.height * 100), "heights")


# What a view needs.


def view(eye, target, field_of_view=45.0, width=320, height=240) -> View:
    return View(eye, target, field_of_view, width, height)


eyes = st.tuples(st.floats(499_500, 501_500), st.floats(5_199_500, 5_201_300), st.floats(1400, 2600))
targets = st.tuples(st.floats(500_000, 500_900), st.floats(5_200_000, 5_200_720), st.floats(1400, 1600))


@given(eyes, targets, st.floats(10, 110), st.randoms(use_true_random=False))
@settings(max_examples=60, deadline=None)
def test_all_ground_in_view_has_one_tile_whose_texels_are_no_larger_than_a_pixel(eye, target, angle, dice):
    assume(math.dist(eye, target) > 1)
    tiles = tiled(cell_size=1.0)
    seen = view(eye, target, angle)
    found = needed(tiles, seen)
    boxes = [(tile, tiles.tree.extent_of(tile)) for tile in found.tiles]
    right, up, forward = seen.axes
    wide, tall = seen.slopes
    heights = GROUND.data
    for _ in range(60):
        # A point of the ground: the middle of a cell, where the spline has the cell's height.
        row, col = dice.randrange(24), dice.randrange(30)
        if math.isnan(heights[row, col]):
            continue
        p = np.array([BOX.west + (col + 0.5) * 30, BOX.north - (row + 0.5) * 30, heights[row, col]])
        x, y, z = ((p - seen.eye) @ axis for axis in (right, up, forward))
        if not (z > 1e-3 and abs(x) < wide * z and abs(y) < tall * z):
            continue
        holding = [tile for tile, box in boxes if box.west <= p[0] < box.east and box.south < p[1] <= box.north]
        assert len(holding) == 1, "ground in view is in exactly one tile"
        (tile,) = holding
        if tile.level == tiles.levels - 1:
            continue
        texel = tiles.tree.cell_of(tile.level)[0]
        for turn in np.linspace(0, np.pi, 9):
            step = texel * np.array([np.cos(turn), np.sin(turn), 0.0])
            a, b, c = (step @ axis for axis in (right, up, forward))
            # The derivative of the projection (x / z, y / z) along the step.
            length = seen.focal * math.hypot(a / z - x * c / z**2, b / z - y * c / z**2)
            assert length <= 1 + 1e-9


def test_tiles_are_no_finer_than_needed():
    tiles = tiled(cell_size=0.1)
    seen = view((500_450.0, 5_199_900.0, 1900.0), (500_450.0, 5_200_300.0, 1500.0))
    found = needed(tiles, seen)
    assert len({tile.level for tile in found.tiles}) > 1
    for tile in found.tiles:
        ((negative, _),) = in_view(tiles, seen, [tile.parent])
        assert -negative > 1


def test_from_straight_above_tiles_are_those_of_the_map_scale():
    # 1000 m up, f = 240 / (2 tan 22.5 deg) = 289.7 pixels: a metre is at most 0.3 / cos of the corner pixels.
    tiles = tiled(cell_size=0.5)
    found = needed(tiles, view((500_450.0, 5_200_360.0, 2500.0), (500_450.0, 5_200_360.0, 0.0)))
    cells = {tiles.tree.cell_of(tile.level)[0] for tile in found.tiles}
    assert cells == {2.0}  # 4 m would be 1.1 pixels and more


def test_a_camera_that_looks_away_needs_nothing():
    assert needed(tiled(cell_size=1.0), view((500_450.0, 5_199_000.0, 1500.0), (500_450.0, 5_198_000.0, 1500.0))) == (
        (),
        (),
    )


@given(st.integers(1, 60))
@settings(max_examples=25, deadline=None)
def test_a_selection_stays_within_its_room_and_refines_the_largest_first(most):
    tiles = tiled(cell_size=0.5)
    seen = view((500_450.0, 5_199_900.0, 1700.0), (500_450.0, 5_200_300.0, 1500.0))
    found, best = needed(tiles, seen, most), needed(tiles, seen)
    assert len(found.tiles) <= most
    assert len(best.tiles) > 60
    assert found.largest >= best.largest
    if most > 4:
        fewer = needed(tiles, seen, most - 4)
        assert found.largest <= fewer.largest


def test_views_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="same point"):
        view((1.0, 2.0, 3.0), (1.0, 2.0, 3.0))
    with pytest.raises(ValueError, match="finite"):
        view((math.nan, 2.0, 3.0), (1.0, 2.0, 3.0))
    with pytest.raises(ValueError, match="field of view of 180"):
        view((0.0, 2.0, 3.0), (1.0, 2.0, 3.0), 180.0)
    tiles = tiled(cell_size=0.5, levels=2)
    with pytest.raises(ValueError, match="tiles of the coarsest level at least, and there is room for 3"):
        needed(tiles, view((500_450.0, 5_199_500.0, 2200.0), (500_450.0, 5_200_300.0, 1500.0)), 3)


# The cache.


@given(st.lists(st.lists(st.integers(0, 12), max_size=4, unique=True), max_size=30), st.integers(4, 9))
@settings(deadline=None)
def test_the_cache_is_least_recently_used_within_its_budget(pictures, room):
    painted: list[Tile] = []
    peak = 0

    def paint(tile: Tile):
        nonlocal peak
        # The one that is being painted needs its place, too.
        peak = max(peak, kept.bytes + 100)
        painted.append(tile)
        return np.full(100, tile.col, np.uint8)

    kept = TileCache(100 * room + 99, 100, paint)
    model: list[Tile] = []  # the least recently used first
    for picture in pictures:
        tiles = [Tile(0, 0, number) for number in picture]
        new = [tile for tile in tiles if tile not in model]
        model = [tile for tile in model if tile not in tiles] + [tile for tile in tiles if tile in model] + new
        model = model[-room:]
        before = len(painted)
        got = kept.fetch(tiles)
        assert painted[before:] == new
        assert kept.kept == tuple(model)
        assert [int(got[tile][0]) for tile in tiles] == picture
        assert kept.bytes <= 100 * room + 99
    assert peak <= 100 * room + 99
    assert kept.painted == len(painted)
    assert kept.hits == sum(map(len, pictures)) - len(painted)
    assert kept.evicted == len(painted) - len(kept.kept)


def test_a_budget_that_is_too_small_is_refused():
    with pytest.raises(ValueError, match="holds no tile"):
        TileCache(99, 100, lambda _: np.zeros(1))
    with pytest.raises(ValueError, match="3 tiles at once are over the budget, which holds 2"):
        TileCache(200, 100, lambda _: np.zeros(1)).fetch([Tile(0, 0, col) for col in range(3)])


def flight(count: int) -> list[tuple[tuple[float, float, float], tuple[float, float, float]]]:
    return [
        ((499_900.0 + 20 * i, 5_200_100.0, 1700.0), (500_300.0 + 20 * i, 5_200_500.0, 1500.0)) for i in range(count)
    ]


def test_a_flight_paints_only_what_is_new():
    tiles = tiled(cell_size=4.0)
    painted: list[Tile] = []

    def paint(tile: Tile):
        painted.append(tile)
        return tiles.pixels(tile, "colour")

    kept = TileCache(1000 * tiles.tile_bytes, tiles.tile_bytes, paint)
    seen: set[Tile] = set()
    news = []
    for eye, target in flight(6):
        found = needed(tiles, view(eye, target)).tiles
        before = len(painted)
        pixels = kept.fetch(found)
        assert set(painted[before:]) == set(found) - seen
        news.append((len(painted) - before, len(found)))
        seen |= set(found)
        for tile in found[::7]:
            np.testing.assert_array_equal(pixels[tile], tiles.pixels(tile, "colour"))
    assert len(painted) == len(set(painted)) == len(seen)
    assert news[0][0] == news[0][1]
    assert all(new < 0.5 * total for new, total in news[1:])


def test_statistics_of_a_flight_count_what_a_cache_does():
    tiles = tiled(cell_size=2.0)
    own = {"width": 320, "height": 240, "context": Context()}
    wide = tile_statistics(tiles, views=tuple(flight(6)), budget=40.0, **own)
    distinct = {tile for eye, target in flight(6) for tile in needed(tiles, view(eye, target)).tiles}
    assert wide.painted == len(distinct)
    assert wide.evicted == 0
    assert wide.most_tiles == wide.views.needed.max()
    assert wide.most_bytes == wide.most_tiles * 4 * 20**2
    assert wide.whole_bytes == 4 * 450 * 360
    np.testing.assert_array_equal(wide.views.hits + wide.views.painted, wide.views.needed)
    assert wide.hit_share == pytest.approx(wide.views.hits.sum() / wide.views.needed.sum())
    tight = tile_statistics(tiles, views=tuple(flight(6)), budget=30 * 4 * 20**2 / 2**20, **own)
    assert tight.most_tiles <= 30
    assert tight.evicted > 0
    assert (tight.views.footprint > wide.views.footprint).any()


def test_a_flight_can_be_cancelled():
    from threading import Event

    stop = Event()
    stop.set()
    with pytest.raises(Cancelled):
        tile_statistics(tiled(cell_size=2.0), views=tuple(flight(3)), context=Context(cancelled=stop))


def test_what_cannot_be_tiled_is_refused():
    with pytest.raises(ValueError, match="no ground to paint"):
        texture_tiles(ROCK, context=Context())
    with pytest.raises(ValueError, match="need 26 levels until one tile covers all"):
        tiled(cell_size=1.2e-5, tile_size=4)
