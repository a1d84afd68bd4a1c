from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph.opencl import choose, to_device, to_host
from nodegraph_hydrology import poisson
from nodegraph_hydrology.placement import Similarity, place
from nodegraph_hydrology.poisson_blend import poisson_blend
from nodegraph_terrain import multigrid
from nodegraph_terrain.load import load_elevation
from nodegraph_terrain.multigrid import System
from nodegraph_terrain.raster import Elevation, Extent, Mask
from nodegraph_terrain.reproject import reproject
from nodegraph_terrain.voids import fill_voids

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
DEFAULTS = {name: item.default for name, item in poisson_blend.parameters.fields.items()}


def raster(data: Any, west: float = 0.0, south: float = 0.0, cell: float = 10.0, kind: Any = Elevation) -> Any:
    array = np.asarray(data, np.float32)
    return kind(array, Extent(west, south, west + array.shape[1] * cell, south + array.shape[0] * cell))


def rough(rows: int, cols: int, seed: int = 0, height: float = 800.0) -> np.ndarray:
    """Return ground rough on every scale."""
    dice = np.random.default_rng(seed)
    y, x = np.mgrid[0:rows, 0:cols]
    waves = [
        (2.0**-octave) * np.sin(2.0**octave * (x * a + y * b) / 25 + c)
        for octave in range(5)
        for a, b, c in dice.normal(size=(3, 3))
    ]
    return (height + 100 * np.sum(waves, axis=0)).astype(np.float32)


BASE = raster(rough(60, 80))
WHOLE = BASE.window(slice(12, 47), slice(20, 66))
BLOCK = Elevation(WHOLE.data.copy(), WHOLE.extent)
OTHER = raster(rough(35, 46, 9, 2500.0), BLOCK.extent.west, BLOCK.extent.south)
ROUND = raster(np.hypot(*(np.indices((35, 46)) - np.array([17, 23])[:, None, None])) < 15, *(200.0, 130.0), kind=Mask)


@given(st.integers(3, 30), st.integers(3, 30), st.floats(0.2, 5), st.integers(0, 2**32 - 1), st.booleans())
def test_sine_transform_solves_the_equation(rows: int, cols: int, ratio: float, seed: int, sourceless: bool) -> None:
    dice = np.random.default_rng(seed)
    values, source = dice.normal(size=(2, rows, cols))
    if sourceless:
        source[:] = 0
    across, down = ratio, 1 / ratio
    made = poisson.solve_rectangle(values, None if sourceless else source, across, down)
    laplacian = poisson.divergence(across * np.diff(made, axis=1), down * np.diff(made, axis=0))
    np.testing.assert_allclose(laplacian[1:-1, 1:-1], source[1:-1, 1:-1], atol=1e-8)
    for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        np.testing.assert_array_equal(made[edge], values[edge])


@pytest.mark.parametrize("shape", [(257, 257), (131, 300), (5, 700)])
def test_float32_is_enough_without_a_source(shape: tuple[int, int]) -> None:
    """What the node promises: an error of 1e-6 of the largest shift."""
    values = np.random.default_rng(5).normal(size=shape).cumsum(axis=0).cumsum(axis=1)
    values /= np.abs(values).max()
    exact = poisson.solve_rectangle(values, None, 0.8, 1.25)
    made = poisson.solve_rectangle(values.astype(np.float32), None, 0.8, 1.25)
    assert made.dtype == np.float32
    assert np.abs(made - exact).max() < 1e-6


def test_multigrid_and_sine_transform_agree() -> None:
    dice = np.random.default_rng(1)
    values, source = dice.normal(size=(2, 50, 71))
    free = np.zeros((50, 71), bool)
    free[1:-1, 1:-1] = True
    exact = poisson.solve_rectangle(values, source, 0.8, 1.25)
    made = multigrid.solve(System(np.where(free, 0, values), free, 0.8, 1.25, source), 1e-9, Context())
    np.testing.assert_allclose(made, exact, atol=1e-6)


def test_div_grad_is_the_five_point_laplacian() -> None:
    data = np.random.default_rng(2).normal(size=(9, 11))
    laplacian = poisson.divergence(np.diff(data, axis=1), np.diff(data, axis=0))[1:-1, 1:-1]
    expected = data[1:-1, 2:] + data[1:-1, :-2] + data[2:, 1:-1] + data[:-2, 1:-1] - 4 * data[1:-1, 1:-1]
    np.testing.assert_allclose(laplacian, expected, atol=1e-12)


@pytest.mark.parametrize("mask", [None, ROUND])
@pytest.mark.parametrize("params", [{}, {"mixed": True}, {"feather": 60.0}, {"mixed": True, "feather": 60.0}])
def test_a_block_cloned_onto_itself_comes_back(mask: Mask | None, params: dict[str, Any]) -> None:
    made = poisson_blend(BASE, BLOCK, mask, **params)
    np.testing.assert_allclose(made.data, BASE.data, rtol=1e-5)
    # At another altitude it is the same block.
    lifted = BLOCK.like(BLOCK.data + np.float32(1500))
    np.testing.assert_allclose(poisson_blend(BASE, lifted, mask, **params).data, BASE.data, rtol=1e-5)


@pytest.mark.parametrize("mask", [None, ROUND])
def test_inside_has_the_patchs_laplacian_and_outside_the_bases_heights(mask: Mask | None) -> None:
    made = poisson_blend(BASE, OTHER, mask, relief=1.5).data.astype(np.float64)
    inside = np.zeros(BASE.shape, bool)
    inside[13:46, 21:65] = True if mask is None else mask.data[1:-1, 1:-1] > 0.5
    np.testing.assert_array_equal(made[~inside], BASE.data[~inside])
    patch = np.zeros(BASE.shape)
    patch[12:47, 20:66] = 1.5 * OTHER.data.astype(np.float64)
    both = [poisson.divergence(np.diff(item, axis=1), np.diff(item, axis=0))[inside] for item in (made, patch)]
    np.testing.assert_allclose(both[0], both[1], atol=2e-2)


def steepest(made: np.ndarray, changed: np.ndarray) -> tuple[float, float]:
    """Return the greatest step between a changed cell and one beside the patch, and between two changed ones."""
    seam, inside = 0.0, 0.0
    for data, mark in ((made, changed), (made.T, changed.T)):
        step = np.abs(np.diff(data.astype(np.float64), axis=0))
        seam = max(seam, float(step[mark[:-1] ^ mark[1:]].max()))
        inside = max(inside, float(step[mark[:-1] & mark[1:]].max()))
    return seam, inside


FLAT = raster(np.add.outer(np.arange(60.0), 2 * np.arange(80.0)))


@pytest.mark.parametrize("base", [FLAT, BASE])
@pytest.mark.parametrize("mask", [None, ROUND])
def test_the_seam_is_no_steeper_than_the_inside(base: Elevation, mask: Mask | None) -> None:
    """With a feather; without, the greatest gradient of the harmonic shift lies on the seam, as it always does."""
    feathered, plain = (poisson_blend(base, OTHER, mask, feather=feather).data for feather in (150.0, 0.0))
    seam, inside = steepest(feathered, feathered != base.data)
    assert seam <= inside
    pasted = base.data.copy()
    region = plain != base.data
    placed = np.zeros(base.shape, np.float32)
    placed[12:47, 20:66] = OTHER.data
    pasted[region] = placed[region]
    assert steepest(plain, region)[0] < 0.05 * steepest(pasted, region)[0]


def test_a_feather_gives_the_bases_gradient_at_the_seam() -> None:
    flat = raster(np.zeros((60, 80)))
    steps = []
    for feather in (0.0, 120.0):
        made = poisson_blend(flat, OTHER, feather=feather).data
        steps.append(float(np.abs(made[13, 21:65] - made[12, 21:65]).mean()))
    assert steps[1] < 0.25 * steps[0]


def test_mixed_gradients_keep_the_bases_relief_under_a_flat_patch() -> None:
    level = BLOCK.like(np.full(BLOCK.shape, np.float32(100)))
    np.testing.assert_allclose(poisson_blend(BASE, level, mixed=True).data, BASE.data, rtol=1e-5)
    assert np.abs(poisson_blend(BASE, level).data - BASE.data).max() > 10


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_quarter_turns_are_exact(turns: int) -> None:
    turned = raster(np.rot90(BLOCK.data, -turns).copy())
    centre = ((BLOCK.extent.west + BLOCK.extent.east) / 2, (BLOCK.extent.south + BLOCK.extent.north) / 2)
    made = poisson_blend(BASE, turned, position=centre, rotation=90.0 * turns)
    np.testing.assert_allclose(made.data, BASE.data, rtol=1e-5)


@given(st.integers(-3, 4), st.integers(-25, 70), st.integers(-25, 90), st.integers(0, 999))
def test_on_the_grid_cells_are_copied_in_any_quarter_turn(turns: int, top: int, left: int, seed: int) -> None:
    dice = np.random.default_rng(seed)
    data, share = dice.normal(900, 50, (21, 30)).astype(np.float32), dice.random((21, 30))
    data[dice.random(data.shape) < 0.1] = np.nan
    turned = np.rot90(data, turns)
    expected, wanted = np.full((160, 180), np.nan), np.zeros((160, 180), bool)
    part = np.s_[50 + top : 50 + top + turned.shape[0], 50 + left : 50 + left + turned.shape[1]]
    expected[part], wanted[part] = turned, np.rot90(share >= 0.5, turns)
    centre = (10 * (left + turned.shape[1] / 2), 600 - 10 * (top + turned.shape[0] / 2))
    found = place(BASE, raster(data), raster(share, kind=Mask), Similarity(centre, 90.0 * turns, 1.0), Context())
    expected, wanted = expected[50:110, 50:130], wanted[50:110, 50:130]
    if found is None:
        assert np.isnan(expected).all()
        return
    known = ~np.isnan(expected)
    assert known.sum() == found.known.sum()
    known = known[found.rows, found.cols]
    np.testing.assert_array_equal(found.known, known)
    np.testing.assert_array_equal(found.heights[known], expected[found.rows, found.cols][known])
    np.testing.assert_array_equal(found.wanted[known], wanted[found.rows, found.cols][known])


@given(
    st.floats(-180, 180),
    st.floats(0.5, 2.0),
    st.tuples(st.floats(100, 700), st.floats(100, 500)),
    st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
)
def test_a_placed_plane_is_the_turned_and_scaled_plane(
    rotation: float, size: float, centre: tuple[float, float], slope: tuple[float, float]
) -> None:
    rows, cols = 30, 44
    x = 10 * (np.arange(cols) - (cols - 1) / 2)
    y = -10 * (np.arange(rows) - (rows - 1) / 2)
    patch = raster(slope[0] * x[None, :] + slope[1] * y[:, None])
    placed = place(BASE, patch, None, Similarity(centre, rotation, size), Context())
    assert placed is not None
    east = BASE.extent.west + 10 * (np.arange(placed.cols.start, placed.cols.stop) + 0.5) - centre[0]
    north = BASE.extent.north - 10 * (np.arange(placed.rows.start, placed.rows.stop) + 0.5) - centre[1]
    angle = np.radians(rotation)
    u = (np.cos(angle) * east[None, :] + np.sin(angle) * north[:, None]) / size
    v = (np.cos(angle) * north[:, None] - np.sin(angle) * east[None, :]) / size
    expected = slope[0] * u + slope[1] * v
    np.testing.assert_allclose(placed.heights[placed.known], expected[placed.known], atol=1e-3)
    reach = (np.abs(u) < 10 * (cols - 1) / 2 - 20) & (np.abs(v) < 10 * (rows - 1) / 2 - 20)
    assert placed.known[reach].all()


def test_fine_patches_are_averaged() -> None:
    stripes = np.zeros((240, 320), np.float32)
    stripes[:, ::2] = 100
    patch = raster(stripes, 0, 0, 2.5)
    placed = place(BASE, patch, None, Similarity((400, 300), 0.0, 1.0), Context())
    assert placed is not None
    np.testing.assert_allclose(placed.heights[5:-5, 5:-5], 50, atol=1)


def test_a_patch_beyond_the_edge_is_clipped() -> None:
    made = poisson_blend(BASE, OTHER, position=(0.0, 0.0))
    changed = np.nonzero(made.data != BASE.data)
    assert changed[0].max() == 59
    assert changed[1].min() == 0
    assert np.isfinite(made.data).all()
    far = poisson_blend(BASE, OTHER, position=(0.0, 0.0), rotation=20.0, size=0.7)
    assert np.isfinite(far.data).all()


def test_voids_stay_out_of_it() -> None:
    holed = OTHER.data.copy()
    holed[10:14, 10:20] = np.nan
    made = poisson_blend(BASE, OTHER.like(holed))
    np.testing.assert_array_equal(made.data[22:26, 30:40], BASE.data[22:26, 30:40])
    assert np.isfinite(made.data).all()
    ground = BASE.data.copy()
    ground[20:30, 40:50] = ground[0:20, 30:33] = np.nan
    made = poisson_blend(BASE.like(ground), OTHER)
    np.testing.assert_array_equal(np.isnan(made.data), np.isnan(ground))
    # A void does not hold the patch: along it the patch keeps its own gradient.
    assert np.abs(np.diff(made.data[30, 41:49]) - np.diff(OTHER.data[18, 21:29])).max() < 20


def test_cells_that_nothing_holds_stay() -> None:
    ground = np.full((30, 30), np.nan, np.float32)
    ground[10:20, 10:20] = 5
    ground[0:4, 0:4] = 7
    with pytest.raises(ValueError, match="covers all"):
        poisson_blend(raster(ground), raster(rough(30, 30)))
    ground[20:, 20:] = ground[19, 19] = 3
    made = poisson_blend(raster(ground), raster(rough(25, 25), 0, 50))
    np.testing.assert_array_equal(made.data[0:4, 0:4], 7)


@pytest.mark.parametrize(
    ("base", "patch", "params", "words"),
    [
        (BASE, raster(rough(80, 100), -100, -100), {}, "covers all"),
        (BASE, OTHER, {"position": (9000.0, 0.0)}, "covers no cell"),
        (BASE, raster(np.ones((2, 2)), 100, 100), {}, "covers no cell"),
        (BASE, Elevation(OTHER.data, Extent(8, 46, 8.1, 46.1, "EPSG:4326", "deg")), {}, "reproject"),
        (
            Elevation(BASE.data, Extent(8, 46, 8.8, 46.6, "", "deg")),
            Elevation(OTHER.data, Extent(8.2, 46.1, 8.4, 46.3, "", "deg")),
            {"rotation": 10.0},
            "degrees",
        ),
        (
            Elevation(BASE.data, Extent(0, 0, 800, 600, "EPSG:32632")),
            Elevation(OTHER.data, Extent(200, 130, 660, 480, "EPSG:32633")),
            {},
            "different systems",
        ),
    ],
)
def test_what_cannot_be_is_refused(base: Elevation, patch: Elevation, params: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        poisson_blend(base, patch, **params)


def test_a_mask_on_another_grid_is_refused() -> None:
    with pytest.raises(ValueError, match="do not match"):
        poisson_blend(BASE, OTHER, raster(np.ones((5, 5)), kind=Mask))


def test_tiles_in_degrees_blend() -> None:
    base = Elevation(BASE.data, Extent(8, 46, 8.8, 46.6, "EPSG:4326", "deg"))
    inner = base.window(slice(12, 47), slice(20, 66))
    np.testing.assert_allclose(poisson_blend(base, inner).data, BASE.data, rtol=1e-5)


def test_the_device_agrees() -> None:
    device = choose("auto")
    if device is None:
        pytest.skip("there is no OpenCL device here")
    inputs = {
        "base": [to_device(BASE, device)],
        "patch": [to_device(OTHER, device)],
        "mask": [to_device(ROUND, device)],
    }
    params = {**DEFAULTS, "mixed": True, "relief": 0.7}
    outputs = poisson_blend.run(inputs, params, Context(device=device), twin=True)
    made = to_host(next(iter(outputs.values())) if isinstance(outputs, dict) else outputs[0]).data
    np.testing.assert_allclose(made, poisson_blend(BASE, OTHER, ROUND, mixed=True, relief=0.7).data, atol=2e-3)


def test_a_piece_of_the_alps_joins_a_valley() -> None:
    if not DATA.is_dir():
        pytest.skip(f"real elevation data is not at {DATA}")
    alps = load_elevation(path=DATA / "alps_N46E008" / "N46E008.tif").window(slice(700, 900), slice(300, 520))
    piece = fill_voids(reproject(Elevation(alps.data.copy(), alps.extent), cell_size=80.0))
    y, x = np.mgrid[0:300, 0:320] / 300
    valley = raster(600 + 1500 * np.abs(x - 0.5 - 0.1 * np.sin(5 * y)) ** 1.3 + 300 * y, cell=80.0)
    made = poisson_blend(valley, piece, position=(12_800.0, 12_000.0), rotation=25.0, size=0.8, feather=1500.0)
    changed = made.data != valley.data
    assert changed.sum() > 10_000
    seam, inside = steepest(made.data, changed)
    assert seam < 0.2 * inside
    plain = poisson_blend(valley, piece, position=(12_800.0, 12_000.0), rotation=25.0, size=0.8)
    seam, inside = steepest(plain.data, plain.data != valley.data)
    assert seam <= inside
    assert np.ptp(made.data[changed]) > 1000
