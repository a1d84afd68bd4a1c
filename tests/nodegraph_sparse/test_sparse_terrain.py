"""Sparse terrains: what they are, and what every part of a construction tree must keep."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context, codec
from nodegraph_sparse.dictionary import Dictionary, SampledDictionary, SparseCode
from nodegraph_sparse.noise_dictionary import dictionary_from_noise
from nodegraph_sparse.patch_grid import patch_grid
from nodegraph_sparse.patches import grid_patches
from nodegraph_sparse.sparse_function import SparseTerrain, faded
from nodegraph_sparse.sparse_terrain import sparse_terrain
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_tree.blend import blend
from nodegraph_tree.carve import Carve
from nodegraph_tree.disc import Disc, Relief
from nodegraph_tree.function import THRESHOLD, Box, ElevationFunction, Points, numeric_gradient
from nodegraph_tree.operators import twist
from tests.nodegraph_tree.strategies import CENTRE, DETAILS, Window, grid, on_device, operators, windows
from tests.nodegraph_tree.test_properties import creases, stay_within

CELL = 25.0
SCENE = 900.0
"""Side of the squares that random terrains cover, about."""


@pytest.fixture(scope="module")
def device() -> Any:
    from nodegraph.opencl import choose

    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


def built(dictionary: Dictionary, code: SparseCode, **params: Any) -> SparseTerrain:
    found = sparse_terrain(dictionary, code, context=Context(), **params)
    assert isinstance(found, SparseTerrain)
    return found


def hills(rows: int, cols: int, cell: float = CELL, west: float = 0.0, south: float = 0.0) -> Elevation:
    dice = np.random.default_rng(rows * 1000 + cols)
    heights = np.cumsum(np.cumsum(dice.normal(size=(rows, cols)), 0), 1)
    heights = 500 + 300 * heights / np.abs(heights).max() + dice.normal(size=heights.shape)
    return Elevation(heights.astype(np.float32), Extent(west, south, west + cols * cell, south + rows * cell))


def of_own_patches(surface: Elevation, half: int, metric: Any = "weighted") -> tuple[Dictionary, SparseCode]:
    """Return the patches of a terrain as atoms, and its code of one of them each."""
    cut = grid_patches(surface, half, metric, Context())
    count = len(cut.samples)
    norms = np.maximum(np.sqrt((cut.samples.astype(np.float64) ** 2).sum(axis=(1, 2))), 1e-9)
    atoms = (cut.samples / norms[:, None, None]).astype(np.float32)
    order = np.random.default_rng(1).permutation(count)
    assert cut.grid is not None
    indices = np.argsort(order).astype(np.int32)[:, None]
    code = SparseCode(cut.grid, indices, norms[:, None], cut.means, np.zeros(count), count, metric, 2 * half)
    return SampledDictionary(metric, np.zeros(count, np.int32), ("own",), atoms[order]), code


@st.composite
def sparse(draw: Callable[[Any], Any]) -> SparseTerrain:
    """Return random atoms on a random grid around the middle of the scenes of the tests of trees."""
    half = draw(st.sampled_from([1, 2, 3, 4, 5, 8, 12]))
    dice = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rows, cols = (int(draw(st.integers(1, 5)) * half - dice.integers(half)) for _ in range(2))
    cell = SCENE / (2.5 * half)
    west, south = CENTRE[0] - dice.random() * cols * cell, CENTRE[1] - dice.random() * rows * cell
    where = patch_grid(Extent(west, south, west + cols * cell, south + rows * cell), (rows, cols), half)
    count, terms, size = draw(st.integers(1, 6)), draw(st.integers(0, 3)), 2 * half * draw(st.sampled_from([1, 1, 2]))
    atoms = dice.normal(size=(count, size, size)) / size
    if draw(st.booleans()):
        atoms = np.cumsum(np.cumsum(atoms, axis=1), axis=2) / size
    indices = dice.integers(0, count, (where.count, terms)).astype(np.int32)
    used = dice.integers(0, terms + 1, where.count)[:, None] > np.arange(terms)
    factors = np.where(used, dice.normal(size=indices.shape) * 40 * half, 0.0)
    means = draw(st.sampled_from([0.0, 3000.0])) + dice.normal(size=where.count) * draw(st.sampled_from([0.0, 60.0]))
    code = SparseCode(where, np.where(used, indices, -1).astype(np.int32), factors, means, np.zeros(where.count), count)
    dictionary = SampledDictionary("weighted", np.zeros(count, np.int32), ("",), atoms.astype(np.float32))
    return built(
        dictionary, code, interpolation=draw(st.sampled_from(["bicubic", "bilinear"])),
        margin=draw(st.sampled_from([0.0, 0.3])) * min(rows, cols) * cell,
        fall_off=draw(st.sampled_from(["cubic", "wyvill", "plateau"])),
    )  # fmt: skip


TREES = st.one_of(sparse(), operators(sparse()))


@pytest.mark.parametrize(
    ("shape", "half"), [((64, 80), 8), ((50, 61), 5), ((33, 40), 16), ((17, 12), 1), ((41, 37), 2), ((45, 50), 3)]
)
@pytest.mark.parametrize("kind", ["bicubic", "bilinear"])
@pytest.mark.parametrize("metric", ["weighted", "plain"])
def test_own_patches_give_a_terrain_back(shape: tuple[int, int], half: int, kind: Any, metric: Any) -> None:
    surface = hills(*shape, west=200_000.0, south=-150_000.0)
    terrain = built(*of_own_patches(surface, half, metric), interpolation=kind)
    found = terrain.query(grid(surface.extent, surface.shape))
    assert (found.weight >= 1 - 1e-9).all()
    # Of float32 atoms: an ulp of the relief of a patch.
    assert np.abs(found.height - surface.data.ravel()).max() < 5e-7 * np.ptp(surface.data)


@pytest.mark.parametrize("half", [1, 2, 3, 8, 15])
@pytest.mark.parametrize("fall_off", ["cubic", "wyvill", "plateau"])
def test_a_terrain_reaches_its_edges(half: int, fall_off: Any) -> None:
    """Samples of any size cover the extent of the raster, corners and all; beyond half a cell there is nothing."""
    surface = hills(40, 33)
    extent, cell = surface.extent, surface.cell_size[0]
    terrain = built(*of_own_patches(surface, half), fall_off=fall_off)
    for finer in (2, 3, 7):
        shape = 40 * finer, 33 * finer
        found = terrain.query(grid(extent, shape))
        assert (found.weight == 1).all()
        # Nothing goes wild between the last centres and the edges: slopes go on there.
        steepest = np.abs(np.diff(surface.data.astype(np.float64), axis=1)).max()
        across = found.height.reshape(shape)[finer // 2 :: finer]
        assert np.abs(np.diff(across, axis=1)).max() * finer < 2 * steepest
    x, y = (
        item.ravel() for item in np.meshgrid(*(np.linspace(-cell, side + cell, 99) for side in (33 * cell, 40 * cell)))
    )
    weight = terrain.query(Points(x, y)).weight
    outside = np.maximum(np.maximum(-x, x - extent.east), np.maximum(-y, y - extent.north))
    assert (weight[outside <= 0] == 1).all()
    assert (weight[outside >= cell / 2] == 0).all()
    # A margin lies within.
    narrowed = built(*of_own_patches(surface, half), fall_off=fall_off, margin=2 * cell)
    assert narrowed.support == Box(*(extent.west, extent.south, extent.east, extent.north))
    assert (narrowed.query(Points(x, y)).weight[outside >= 0] == 0).all()
    assert (narrowed.query(Points(x, y)).weight[outside <= -2 * cell] == 1).all()


@pytest.mark.parametrize("half", [1, 3, 8])
def test_a_terrain_reaches_its_edges_on_a_device(half: int, device: Any) -> None:
    surface = hills(40, 33, west=200_000.0, south=-150_000.0)
    terrain = built(*of_own_patches(surface, half))
    height, weight = on_device(terrain, surface.extent, (280, 231), device)
    assert (weight >= 1 - 1e-4).all()
    found = terrain.query(grid(surface.extent, (280, 231)))
    assert np.abs(height - found.height).max() < 0.01


def test_own_patches_give_a_terrain_back_on_a_device(device: Any) -> None:
    surface = hills(150, 170, west=200_000.0, south=-150_000.0)
    terrain = built(*of_own_patches(surface, 8))
    height, _ = on_device(terrain, surface.extent, surface.shape, device)
    assert np.abs(height - surface.data.ravel()).max() < 0.005


def directly(terrain: SparseTerrain, x: float, y: float, detail: float) -> float:
    """Evaluate the printed sums over all patches, with Keys' kernel (1981) or a hat in place of pieces."""
    size, place = terrain.size, terrain.grid

    def kernel(t: np.ndarray) -> np.ndarray:
        t = np.abs(t)
        if terrain.interpolation == "bilinear":
            return np.asarray(np.maximum(1 - t, 0))
        far = -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2
        return np.asarray(np.where(t < 1, 1.5 * t**3 - 2.5 * t**2 + 1, np.where(t < 2, far, 0)))

    above = below = 0.0
    for (east, north), mean, numbers, factors in zip(
        place.centres, terrain.means, terrain.indices, terrain.coefficients, strict=True
    ):
        dx, dy = (x - east) / place.radius, (north - y) / place.radius
        alpha = max(1 - dx * dx - dy * dy, 0.0) ** 3
        lines = [kernel(0.5 * (d * size + size - 1) - np.arange(-2, size + 2)) for d in (dy, dx)]
        own = sum(f * (lines[0] @ terrain.atoms[k] @ lines[1]) for k, f in zip(numbers, factors, strict=True))
        above += alpha * (mean + (1 - (1 - detail**2) ** 3) * own)
        below += alpha
    return above / below


@given(sparse(), DETAILS, st.integers(0, 1000))
@settings(max_examples=40)
def test_a_sparse_terrain_is_the_sum_over_all_patches(terrain: SparseTerrain, detail: float, seed: int) -> None:
    dice, box, radius = np.random.default_rng(seed), terrain.grid.extent, terrain.grid.radius
    x, y = (low + dice.random(20) * (high - low) for low, high in ((box.west, box.east), (box.south, box.north)))
    # Half a radius around the outer centres, beyond which weights are held.
    east, south = terrain.grid.west + terrain.grid.cols * radius, terrain.grid.north - terrain.grid.rows * radius
    inside = (x < east - radius / 2) & (y > south + radius / 2)
    found = terrain.query(Points(x, y, detail))
    inside &= found.weight > 0
    for k in np.flatnonzero(inside):
        # A bilinear interpolant is level in a share of a cell.
        expected = directly(terrain, x[k], y[k], detail)
        room = 1e-8 if terrain.interpolation == "bicubic" else 0.02
        assert abs(found.height[k] - expected) < room * (1 + abs(expected))


@given(TREES, windows())
def test_values_and_slopes_stay_within_bounds(tree: ElevationFunction, window: Window) -> None:
    bounds = tree.bounds(window.box, float(window.points.detail))
    points, dice = window.points, np.random.default_rng(0)
    for reach in (0.05, 0.005, 0.0):
        sample = tree.query(points, gradient=True)
        stay_within(bounds, sample)
        assert sample.height_gradient is not None
        steep = np.where(sample.weight > 0, np.hypot(*sample.height_gradient), -1)
        best = np.concatenate([np.argsort(item)[-6:] for item in (steep, sample.height, -sample.height)]).repeat(8)
        points = points.moved(
            *(
                np.clip(axis[best] + dice.normal(0, reach * (high - low), best.size), low, high)
                for axis, low, high in zip(points[:2], window.box[:2], window.box[2:], strict=True)
            )
        )


@given(sparse(), st.integers(0, 1000), DETAILS)
@settings(max_examples=40)
def test_every_block_keeps_its_bounds(terrain: SparseTerrain, seed: int, detail: float) -> None:
    """Boxes of less than a sample and more, all over the terrain, each asked at many points."""
    dice, support = np.random.default_rng(seed), terrain.support
    for _ in range(6):
        side = terrain.grid.radius * 10 ** dice.uniform(-2, 0.5)
        west, south = (
            low + dice.random() * (high - low) - side / 2
            for low, high in ((support.west, support.east), (support.south, support.north))
        )
        box = Box(west, south, west + side, south + side)
        x, y = (
            item.ravel() for item in np.meshgrid(np.linspace(west, box.east, 30), np.linspace(south, box.north, 30))
        )
        stay_within(terrain.bounds(box, detail), terrain.query(Points(x, y, detail), gradient=True))


@given(TREES, windows())
def test_gradients_match_central_differences(tree: ElevationFunction, window: Window) -> None:
    points = window.points
    sample = tree.query(points, gradient=True)
    ground = sample.weight >= 0.05
    fine, coarse = numeric_gradient(tree, points, 0.002), numeric_gradient(tree, points, 0.004)
    exacts, kinks = (sample.height_gradient, sample.weight_gradient), creases(tree, points)
    for exact, near, far, kink in zip(exacts, fine, coarse, kinks, strict=True):
        assert exact is not None
        # Bilinear interpolation and operators have kinks.
        limit = 1 + np.abs(near).max(0)
        smooth = ground & (np.abs(near - far).max(0) < 2e-4 * limit) & (kink < 2e-3 * limit)
        assert smooth.sum() >= 0.7 * ground.sum() - 3
        wrong = np.abs(exact - near)[:, smooth] > 2e-3 * (1 + np.abs(near[:, smooth]))
        assert wrong.mean() < 0.01 if wrong.size else True


@given(sparse(), windows(), st.integers(2, 50))
@settings(max_examples=20)
def test_points_do_not_depend_on_their_neighbours(terrain: SparseTerrain, window: Window, step: int) -> None:
    points = window.points
    whole = terrain.query(points)
    part = terrain.query(points.taken(np.arange(len(points.x)) % step == 1))
    assert np.allclose(whole.height[1::step], part.height, rtol=1e-12, atol=1e-9)
    assert np.array_equal(whole.weight[1::step], part.weight)


@given(TREES, windows())
@settings(max_examples=30)
def test_storage_gives_an_equal_terrain(tree: ElevationFunction, window: Window) -> None:
    again = codec.decode(codec.encode(tree))
    assert codec.seal(again) == codec.seal(tree)
    for first, second in zip(tree.query(window.points), again.query(window.points), strict=True):
        assert first is second or (first is not None and second is not None and np.array_equal(first, second))


@given(TREES, st.sampled_from([1.0, 7.0, 40.0]), st.sampled_from([1.0, 0.4]), st.floats(-600, 600))
@settings(max_examples=30)
def test_opencl_agrees_with_numpy(
    device: Any, tree: ElevationFunction, cell: float, detail: float, away: float
) -> None:
    shape = (70, 90)
    west, south = CENTRE[0] + away, CENTRE[1] - away / 2
    extent = Extent(west, south, west + shape[1] * cell, south + shape[0] * cell)
    height, weight = on_device(tree, extent, shape, device, detail)
    sample = tree.query(grid(extent, shape, detail), gradient=True)
    assert sample.height_gradient is not None
    assert sample.weight_gradient is not None
    blurred = 2e-5 * np.hypot(*sample.weight_gradient) * cell
    assert (np.abs(weight - sample.weight) < 2e-4 * max(1.0, sample.weight.max()) + blurred).all()
    sure = sample.weight > THRESHOLD + 1e-3
    assert np.isnan(height[sample.weight < THRESHOLD - 1e-3]).all()
    limit = 0.01 + 2e-5 * np.hypot(*sample.height_gradient)[sure] * cell + 2e-6 * np.abs(sample.height[sure])
    assert (np.abs(height - sample.height)[sure] <= limit).all()


@given(sparse(), st.integers(0, 60), st.integers(0, 60))
@settings(max_examples=10)
def test_a_window_equals_that_window_of_a_larger_sample(
    device: Any, terrain: SparseTerrain, row: int, col: int
) -> None:
    cell, shape = 12.0, (130, 130)
    west, north = CENTRE[0] - 65 * cell, CENTRE[1] + 65 * cell
    extent = Extent(west, north - 130 * cell, west + 130 * cell, north)
    part = Extent(west + col * cell, north - (row + 66) * cell, west + (col + 50) * cell, north - row * cell)
    whole = [item.reshape(shape)[row : row + 66, col : col + 50] for item in on_device(terrain, extent, shape, device)]
    window = [item.reshape(66, 50) for item in on_device(terrain, part, (66, 50), device)]
    assert np.abs(whole[1] - window[1]).max() < 1e-4
    sure = whole[1] > THRESHOLD + 1e-3
    assert np.abs(whole[0] - window[0])[sure].max(initial=0) < 0.02


@given(sparse(), st.floats(0, 1))
@settings(max_examples=10)
def test_detail_may_differ_from_cell_to_cell(device: Any, terrain: SparseTerrain, start: float) -> None:
    shape = (66, 66)
    extent = Extent(CENTRE[0], CENTRE[1], CENTRE[0] + 660, CENTRE[1] + 660)
    detail = np.clip(start + np.linspace(-0.4, 0.4, 66 * 66), 0, 1).astype(np.float32)
    height, weight = on_device(terrain, extent, shape, device, detail.reshape(shape))
    sample = terrain.query(grid(extent, shape, detail.astype(np.float64)))
    sure = sample.weight > THRESHOLD + 1e-3
    assert np.abs(weight - sample.weight).max() < 1e-3
    assert np.abs(height - sample.height)[sure].max(initial=0) < 0.02


def test_many_points_are_evaluated_piece_by_piece() -> None:
    surface = hills(60, 60)
    terrain = built(*of_own_patches(surface, 6))
    points = grid(surface.extent, (200, 210))
    whole = terrain.query(points, gradient=True)
    for start in (0, 16_000, 40_000):
        part = terrain.query(Points(points.x[start : start + 999], points.y[start : start + 999]), gradient=True)
        for item, other in zip(whole, part, strict=True):
            assert item is not None
            assert other is not None
            assert np.allclose(item[..., start : start + 999], other, rtol=1e-12, atol=1e-9)


def test_bounds_are_near_what_is_reached() -> None:
    surface = hills(128, 128)
    smooth = replace(surface, data=np.sin(np.arange(128) / 9).astype(np.float32)[:, None] * surface.data / 5)
    terrain = built(*of_own_patches(smooth, 8))
    for cells in (16, 64):
        box = Box(CELL * 20, CELL * 30, CELL * (20 + cells), CELL * (30 + cells))
        points = grid(Extent(*box), (4 * cells, 4 * cells))
        found, bounds = terrain.query(points, gradient=True), terrain.bounds(box)
        assert found.height_gradient is not None
        assert bounds.slope < 1.3 * np.hypot(*found.height_gradient).max()
        assert bounds.high - bounds.low < 1.3 * np.ptp(found.height)


def test_only_what_is_used_is_stored() -> None:
    dictionary, code = of_own_patches(hills(40, 40), 4)
    few = np.full((code.grid.count, 3), -1, np.int32)
    few[:, 0] = np.arange(code.grid.count) % 3 * 7
    factors = np.where(few >= 0, 5.0, 0.0)
    terrain = built(dictionary, replace(code, indices=few, coefficients=factors))
    assert terrain.atoms.shape == (3, 12, 12)
    assert terrain.indices.shape == (code.grid.count, 1)
    assert np.array_equal(terrain.atoms[1, 2:-2, 2:-2], dictionary.atoms(np.array([7]))[0])


def test_a_code_without_atoms_blends_means(device: Any) -> None:
    dictionary, code = of_own_patches(hills(40, 40), 4)
    none = np.zeros((code.grid.count, 0))
    smooth = built(dictionary, replace(code, indices=none.astype(np.int32), coefficients=none))
    full = built(dictionary, code)
    points = grid(code.grid.extent, (40, 40))
    assert np.allclose(smooth.query(points).height, full.query(Points(points.x, points.y, 0.0)).height)
    height, _ = on_device(smooth, code.grid.extent, (40, 40), device)
    assert np.abs(height - smooth.query(points).height).max() < 0.005
    assert smooth.bounds(smooth.support).low >= code.means.min() - 1e-3
    assert np.isclose(faded(1.0), 1)


def test_detail_fades_the_atoms() -> None:
    terrain = built(*of_own_patches(hills(40, 40), 4))
    points = grid(terrain.grid.extent, (37, 41))
    none, half, full = (terrain.query(Points(points.x, points.y, k)).height for k in (0.0, 0.5, 1.0))
    assert np.allclose(half, none + (1 - 0.75**3) * (full - none))


def test_atoms_in_more_detail_keep_the_place_of_samples() -> None:
    """A plane is a plane at any resolution of its atoms."""
    extent = Extent(0.0, 0.0, 400.0, 300.0)
    where = patch_grid(extent, (30, 40), 5)
    for factor in (1, 2, 4):
        size = 10 * factor
        along = (2.0 * np.arange(size) + 1 - size) / size
        atom = np.tile(along, (size, 1)).astype(np.float32)[None]
        means = 3 + 0.2 * where.centres[:, 0]
        code = SparseCode(
            where, np.zeros((where.count, 1), np.int32), np.full((where.count, 1), 0.2 * where.radius), means,
            np.zeros(where.count), 1, size=10,
        )  # fmt: skip
        terrain = built(SampledDictionary("weighted", np.zeros(1, np.int32), ("",), atom), code)
        points = grid(extent, (61, 77))
        found = terrain.query(points, gradient=True)
        assert np.allclose(found.height, 3 + 0.2 * points.x, atol=1e-4)
        assert found.height_gradient is not None
        assert np.allclose(found.height_gradient[0], 0.2, atol=1e-5)
        assert np.isclose(terrain.bounds(Box(30, 30, 350, 250)).slope, 0.2, rtol=1e-2)


def test_functions_can_be_sampled_anew() -> None:
    noise = dictionary_from_noise(atoms=5, octaves=2, size=16, wavelength=4.0, variety=0.0, context=Context())
    where = patch_grid(Extent(0.0, 0.0, 640.0, 640.0), (64, 64), 8)
    dice = np.random.default_rng(0)
    code = SparseCode(
        where, dice.integers(0, 5, (where.count, 1)).astype(np.int32), dice.normal(size=(where.count, 1)) * 100,
        np.zeros(where.count), np.zeros(where.count), 5, size=16,
    )  # fmt: skip
    own, finer = built(noise, code), built(noise, code, size=64)
    assert (own.size, finer.size) == (16, 64)
    assert codec.seal(built(noise, code, factor=4)) == codec.seal(finer)
    points = grid(where.extent, (50, 50))
    first, second = own.query(points).height, finer.query(points).height
    assert 0 < np.abs(first - second).max() < 0.2 * np.ptp(first)


def test_it_takes_part_in_trees(device: Any) -> None:
    """Blended, carved and warped it is the same on a device."""
    surface = hills(80, 90)
    terrain = built(*of_own_patches(surface, 8), margin=200.0)
    hill = Disc(1000.0, 900.0, 500.0, 700.0, Relief("fbm", 60.0, 300.0, 4))
    tree = twist(Carve(blend([terrain, hill]), Disc(1300.0, 700.0, 300.0, 400.0, Relief())), centre=(900.0, 900.0),
                 radius=600.0, angle=60.0)  # fmt: skip
    height, _ = on_device(tree, surface.extent, (100, 110), device)
    found = tree.query(grid(surface.extent, (100, 110)))
    sure = found.weight > THRESHOLD + 1e-3
    assert sure.mean() > 0.7
    assert np.abs(height - found.height)[sure].max() < 0.02


def test_bounds_of_everything() -> None:
    terrain = built(*of_own_patches(hills(50, 40), 4))
    everywhere = terrain.bounds(Box(-np.inf, -np.inf, np.inf, np.inf))
    assert not np.isnan(everywhere).any()
    assert everywhere.weight_low == 0
    assert terrain.bounds(Box(-500.0, 0.0, -CELL / 2, 10.0)).absent
    assert terrain.bounds(Box(-CELL / 2, 0.0, -CELL / 2, 10.0)).absent
    assert terrain.bounds(Box(0.0, 0.0, 0.0, 10.0)).weight_low == 1


def refused(message: str, dictionary: Dictionary, code: SparseCode, **params: Any) -> None:
    with pytest.raises(ValueError, match=message):
        built(dictionary, code, **params)


def test_what_does_not_fit_is_refused() -> None:
    dictionary, code = of_own_patches(hills(40, 40), 4)
    count = code.atoms
    samples = dictionary.atoms(slice(None))

    def sampled(atoms: np.ndarray, metric: Any = "weighted") -> Dictionary:
        return SampledDictionary(metric, np.zeros(len(atoms), np.int32), ("",), atoms.astype(np.float32))

    refused(f"one of {count} atoms and the dictionary has 9", sampled(samples[:9]), code)
    refused("weighted metric and the dictionary in the plain one", sampled(samples, "plain"), code)
    refused("even size", sampled(samples[:, :7, :7]), code)
    refused("12 samples along a side do not fit a code of patches of 8", sampled(np.zeros((count, 12, 12))), code)
    refused("holds samples, 8 along a side", dictionary, code, size=16)
    refused("holds samples, 8 along a side", dictionary, code, factor=2)
    refused("stated twice; either 16 along a side or 2 times", dictionary, code, size=16, factor=2)
    refused("margin of 501 m leaves nothing", dictionary, code, margin=501.0)
    degrees = replace(code.grid, extent=replace(code.grid.extent, unit="deg"))
    refused("in degrees", dictionary, replace(code, grid=degrees))
    wide = replace(code.grid, extent=replace(code.grid.extent, east=1300.0))
    refused("radii beyond the outer centres", dictionary, replace(code, grid=wide))
    broken = samples.copy()
    broken[5, 3, 3] = np.nan
    refused("atom 5 has samples", sampled(broken), code)
    means = code.means.copy()
    means[3] = np.inf
    refused("mean of patch 3 is inf", dictionary, replace(code, means=means))
    factors = code.coefficients.copy()
    factors[2, 0] = np.nan
    refused("coefficient of patch 2 is nan", dictionary, replace(code, coefficients=factors))
