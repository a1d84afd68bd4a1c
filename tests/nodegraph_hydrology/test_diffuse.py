from __future__ import annotations

from threading import Event
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph.errors import Cancelled
from nodegraph.opencl import choose, to_device, to_host
from nodegraph_hydrology.diffuse import diffuse
from nodegraph_terrain import multigrid, multigrid_opencl
from nodegraph_terrain.multigrid import COARSEST, DAMPING, System
from nodegraph_terrain.raster import Elevation, Extent, Raster

DEFAULTS = {name: item.default for name, item in diffuse.parameters.fields.items()}


@pytest.fixture(scope="module")
def device() -> Any:
    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


def raster(data: Any, kind: Any = Elevation, dx: float = 10.0, dy: float = 10.0) -> Any:
    array = np.asarray(data, np.float32)
    return kind(array, Extent(0, 0, array.shape[1] * dx, array.shape[0] * dy))


def on_device(features: Elevation, diffusivity: Raster | None, device: Any, **params: Any) -> np.ndarray:
    """Return what the twin makes."""
    inputs = {"features": [to_device(features, device)], "diffusivity": []}
    if diffusivity is not None:
        inputs["diffusivity"] = [to_device(diffusivity, device)]
    outputs = diffuse.run(inputs, {**DEFAULTS, **params}, Context(device=device), twin=True)
    return to_host(next(iter(outputs.values())) if isinstance(outputs, dict) else outputs[0]).data


def scattered(rows: int, cols: int, seed: int = 0, count: int = 50) -> np.ndarray:
    """Return `count` points of random height."""
    dice = np.random.default_rng(seed)
    data = np.full((rows, cols), np.nan, np.float32)
    data.flat[dice.choice(rows * cols, count, replace=False)] = dice.uniform(200, 1800, count)
    return data


def skeleton(rows: int, cols: int, seed: int = 0) -> np.ndarray:
    """Return winding lines of rising height, as rivers and ridges are."""
    dice = np.random.default_rng(seed)
    data = np.full((rows, cols), np.nan, np.float32)
    for _ in range(max(4, rows // 10)):
        steps = max(rows, cols) // 3
        heading = dice.uniform(0, 2 * np.pi) + np.cumsum(dice.normal(0, 0.2, steps))
        y = (dice.uniform(0, rows) + np.cumsum(np.sin(heading))).astype(int)
        x = (dice.uniform(0, cols) + np.cumsum(np.cos(heading))).astype(int)
        inside = (y >= 0) & (y < rows) & (x >= 0) & (x < cols)
        data[y[inside], x[inside]] = (dice.uniform(200, 1500) + np.cumsum(dice.normal(0, 3, steps)))[inside]
    return data


def thin_walls(rows: int, cols: int) -> np.ndarray:
    """Return closed lines one cell wide, of very different heights side by side."""
    data = np.full((rows, cols), np.nan, np.float32)
    for number, col in enumerate(range(3, cols, 7)):
        data[:, col] = 1000.0 * (number % 2)
        if col + 1 < cols:
            data[rows // 2, col + 1 :] = 300.0 + number
    return data


def direct(features: np.ndarray, k: np.ndarray | None = None, across: float = 1.0, down: float = 1.0) -> np.ndarray:
    """Return the solution by a sparse factorization, built cell by cell from the definition."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    rows, cols = features.shape
    k = np.ones(features.shape) if k is None else k.astype(np.float64)
    free = np.isnan(features)
    number = np.full(features.shape, -1)
    number[free] = np.arange(free.sum())
    y, x = np.nonzero(free)
    diagonal, right = np.zeros(len(y)), np.zeros(len(y))
    entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for dy, dx, weight in ((0, 1, across), (0, -1, across), (1, 0, down), (-1, 0, down)):
        inside = (y + dy >= 0) & (y + dy < rows) & (x + dx >= 0) & (x + dx < cols)
        i = np.flatnonzero(inside)
        there = (y[i] + dy, x[i] + dx)
        a, b = k[y[i], x[i]], k[there]
        w = weight * np.divide(2 * a * b, a + b, out=np.zeros_like(a), where=a + b > 0)
        np.add.at(diagonal, i, w)
        given = ~free[there]
        np.add.at(right, i[given], w[given] * features[there][given].astype(np.float64))
        entries.append((i[~given], number[there][~given], -w[~given]))
    every = np.arange(len(y))
    own, other, values = (np.concatenate(parts) for parts in zip(*entries, (every, every, diagonal), strict=True))
    matrix = sparse.csc_array((values, (own, other)), shape=(len(y), len(y)))
    made = features.astype(np.float64)
    made[free] = spsolve(matrix, right, permc_spec="MMD_AT_PLUS_A")
    return made


MAPS = {
    "scattered": scattered,
    "skeleton": skeleton,
    "thin_walls": thin_walls,
    "one_point": lambda rows, cols: scattered(rows, cols, 3, 1),
    "two_points": lambda rows, cols: scattered(rows, cols, 4, 2),
}


@pytest.mark.parametrize("kind", MAPS)
@pytest.mark.parametrize("shape", [(64, 64), (65, 64), (61, 97), (17, 200), (256, 240)])
def test_multigrid_is_within_1e4_of_a_direct_solution_on_host_and_device(
    kind: str, shape: tuple[int, int], device: Any
) -> None:
    features = raster(MAPS[kind](*shape))
    exact = direct(features.data)
    scale = max(float(np.nanmax(features.data) - np.nanmin(features.data)), 1.0)
    for heights in (diffuse(features, tolerance=1e-4).data, on_device(features, None, device, tolerance=1e-4)):
        assert np.abs(heights - exact).max() <= 1e-4 * scale
    # What is asked for is what is got, down to float32.
    assert np.abs(diffuse(features, tolerance=1e-6).data - exact).max() <= 2e-6 * scale + 1e-4


@pytest.mark.parametrize("shape", [(90, 111), (128, 64)])
@pytest.mark.parametrize("cell", [(10.0, 10.0), (10.0, 25.0)])
def test_diffusivity_and_rectangular_cells_agree_with_a_direct_solution(
    shape: tuple[int, int], cell: tuple[float, float], device: Any
) -> None:
    dice = np.random.default_rng(5)
    k = np.exp(dice.normal(0, 2, shape)).astype(np.float32)
    k[shape[0] // 3] = 1e-4 * k.max()
    features = raster(scattered(*shape), Elevation, *cell)
    diffusivity = raster(k, Raster, *cell)
    exact = direct(features.data, k, cell[1] / cell[0], cell[0] / cell[1])
    for heights in (diffuse(features, diffusivity).data, on_device(features, diffusivity, device)):
        assert np.abs(heights - exact).max() <= 1e-4 * 1600


def test_walls_let_nothing_through_and_cells_behind_them_take_the_mean(caplog: pytest.LogCaptureFixture) -> None:
    k = np.ones((40, 50), np.float32)
    k[:, 21] = 0
    k[10, 30:40] = k[20, 30:40] = k[10:21, 30] = k[10:21, 40] = 0
    data = np.full(k.shape, np.nan, np.float32)
    data[3, 3], data[30, 45], data[5, 5] = 100, 700, 100
    heights = diffuse(raster(data), raster(k, Raster)).data
    np.testing.assert_allclose(heights[:, :21], 100, atol=1e-2)
    outside = np.ones_like(k, bool)
    outside[:, :22] = outside[10:21, 30:41] = False
    np.testing.assert_allclose(heights[outside], 700, atol=1e-2)
    np.testing.assert_allclose(heights[11:20, 31:40], 300, atol=1e-3)
    assert "no feature reaches" in caplog.text


def test_openings_one_cell_wide_agree_with_a_direct_solution(device: Any) -> None:
    k = np.ones((81, 90), np.float32)
    for col, door in ((13, 7), (30, 70), (31, 20), (62, 41), (77, 40)):
        k[:, col] = 1e-12
        k[door, col] = 1
    features = raster(scattered(81, 90, 2, 6))
    exact = direct(features.data, k)
    for heights in (
        diffuse(features, raster(k, Raster)).data,
        on_device(features, raster(k, Raster), device),
    ):
        assert np.abs(heights - exact).max() <= 1e-4 * 1600


@settings(max_examples=40)
@given(st.integers(1, 40), st.integers(1, 40), st.floats(0.01, 1), st.integers(0, 2**32 - 1))
def test_result_keeps_features_has_no_new_extremes_and_is_harmonic(
    rows: int, cols: int, share: float, seed: int
) -> None:
    dice = np.random.default_rng(seed)
    data = np.where(dice.random((rows, cols)) < share, dice.uniform(-50, 4000, (rows, cols)), np.nan)
    data.flat[seed % data.size] = 1234.5
    features = raster(data)
    heights = diffuse(features, tolerance=1e-6).data
    given_ = ~np.isnan(features.data)
    np.testing.assert_array_equal(heights[given_], features.data[given_])
    assert heights.min() >= np.nanmin(features.data)
    assert heights.max() <= np.nanmax(features.data)
    padded = np.pad(heights.astype(np.float64), 1, mode="edge")
    mean = (padded[1:-1, 2:] + padded[1:-1, :-2] + padded[2:, 1:-1] + padded[:-2, 1:-1]) / 4
    assert np.abs(mean - heights)[~given_].max(initial=0) < 0.02


def test_the_number_of_cycles_depends_neither_on_size_nor_on_features(device: Any) -> None:
    for make in (scattered, skeleton):
        for size in (63, 128, 300, 512):
            data = make(size, size)
            free = np.isnan(data)
            system = System(np.where(free, np.float32(0), data - 1000), free)
            assert multigrid.iterate(multigrid_opencl.DeviceGrid(device, system), 1e-6, 1600.0, Context()) <= 16


def test_a_cycle_is_symmetric_and_positive() -> None:
    """Conjugate gradients need it."""
    assert 0 < DAMPING < 1
    dice = np.random.default_rng(1)
    free = dice.random((45, 38)) < 0.9
    assert free.size > 2 * COARSEST
    across, down = np.exp(dice.normal(size=(45, 37))), np.exp(dice.normal(size=(44, 38)))
    grid = multigrid.HostGrid(System(np.zeros(free.shape), free, across, down))
    made = []
    vectors = [dice.normal(size=free.shape) * free for _ in range(2)]
    for vector in vectors:
        grid.r[...] = vector
        assert grid.precondition()[0] > 0
        made.append(grid.z.copy())
    assert np.vdot(vectors[0], made[1]) == pytest.approx(np.vdot(vectors[1], made[0]), rel=1e-10)


def test_jacobi_is_the_papers_iteration(device: Any) -> None:
    features = raster(scattered(20, 31, count=9))
    given_ = ~np.isnan(features.data)
    heights = np.where(given_, features.data, np.nanmean(features.data)).astype(np.float64)
    for _ in range(37):
        padded = np.pad(heights, 1)
        inside = np.pad(np.ones_like(heights), 1)
        sums = [array[1:-1, 2:] + array[1:-1, :-2] + array[2:, 1:-1] + array[:-2, 1:-1] for array in (padded, inside)]
        heights = np.where(given_, heights, sums[0] / sums[1])
    for made in (
        diffuse(features, method="jacobi", iterations=37).data,
        on_device(features, None, device, method="jacobi", iterations=37),
    ):
        np.testing.assert_allclose(made, heights, atol=2e-2)


def test_jacobi_falls_short_where_features_are_sparse_and_sor_does_not(device: Any) -> None:
    features = raster(scattered(128, 128, count=5))
    exact = direct(features.data)
    errors = {
        method: float(np.abs(on_device(features, None, device, method=method, iterations=1000) - exact).max())
        for method in ("jacobi", "sor")
    }
    assert errors["jacobi"] > 50
    assert errors["sor"] < 0.5
    k = raster(np.random.default_rng(0).uniform(0.1, 1, (128, 128)), Raster)
    by_host = diffuse(features, k, method="sor", iterations=50, relaxation=1.5).data
    np.testing.assert_allclose(
        by_host, on_device(features, k, device, method="sor", iterations=50, relaxation=1.5), atol=2e-2
    )


def test_a_fixed_border_holds_the_edge_where_no_feature_does() -> None:
    data = np.full((30, 40), np.nan, np.float32)
    data[0, 5], data[15, 20] = 80, 500
    heights = diffuse(raster(data), border="fixed", border_elevation=20.0).data
    edge = np.concatenate([heights[0], heights[-1], heights[:, 0], heights[:, -1]])
    assert heights[0, 5] == 80
    assert (edge == 20).sum() == edge.size - 1
    data[0], data[-1], data[:, 0], data[:, -1] = 20, 20, 20, 20
    data[0, 5] = 80
    np.testing.assert_allclose(heights, direct(data), atol=1e-2)


def test_a_full_map_comes_back_and_one_value_spreads() -> None:
    full = raster(np.arange(12).reshape(3, 4))
    np.testing.assert_array_equal(diffuse(full).data, full.data)
    lone = np.full((33, 50), np.nan)
    lone[7, 9] = 2345.25
    np.testing.assert_array_equal(diffuse(raster(lone)).data, np.float32(2345.25))


@pytest.mark.parametrize(
    ("data", "k", "words"),
    [
        (np.full((4, 5), np.nan), None, "all void"),
        (np.where(np.eye(4, 5) > 0, np.inf, np.nan), None, "infinite"),
        (np.eye(4, 5), np.full((4, 5), -1.0), "not negative"),
        (np.eye(4, 5), np.full((4, 5), np.nan), "voids"),
        (np.eye(4, 5), np.full((4, 5), np.inf), "finite"),
        (np.eye(4, 5), np.ones((5, 5)), "do not match"),
    ],
)
def test_bad_data_is_refused(data: np.ndarray, k: np.ndarray | None, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        diffuse(raster(data), None if k is None else raster(k, Raster))


@pytest.mark.parametrize("method", ["multigrid", "jacobi", "sor"])
def test_a_cancelled_run_stops(method: Any) -> None:
    cancelled = Event()
    cancelled.set()
    with pytest.raises(Cancelled):
        diffuse(raster(scattered(40, 40)), method=method, context=Context("fill", cancelled=cancelled))


LARGE = [("scattered", (1000, 1023)), ("skeleton", (1000, 1023)), ("thin_walls", (2048, 2048))]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "shape"), LARGE)
def test_large_rasters_are_within_1e4_of_a_direct_solution(kind: str, shape: tuple[int, int], device: Any) -> None:
    features = raster(MAPS[kind](*shape))
    exact = direct(features.data)
    scale = float(np.nanmax(features.data) - np.nanmin(features.data))
    for heights in (diffuse(features, tolerance=1e-4).data, on_device(features, None, device, tolerance=1e-4)):
        assert np.abs(heights - exact).max() <= 1e-4 * scale


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["scattered", "skeleton"])
def test_2048_squared_agrees_with_float64(kind: str, device: Any) -> None:
    """SuperLU cannot factorize four million cells (more entries than its 32-bit indices count)."""
    features = raster(MAPS[kind](2048, 2048))
    free = np.isnan(features.data)
    values = np.where(free, 1000.0, features.data.astype(np.float64))
    exact = multigrid.solve(System(values, free), 1e-10, Context())
    padded = np.pad(exact, 1, mode="edge")
    mean = (padded[1:-1, 2:] + padded[1:-1, :-2] + padded[2:, 1:-1] + padded[:-2, 1:-1]) / 4
    assert np.abs(mean - exact)[free].max() < 1e-8 * np.ptp(exact)
    for heights in (diffuse(features, tolerance=1e-4).data, on_device(features, None, device, tolerance=1e-4)):
        assert np.abs(heights - exact).max() <= 1e-4 * np.ptp(exact)
