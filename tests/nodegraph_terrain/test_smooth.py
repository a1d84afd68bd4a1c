from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from nodegraph import Context
from nodegraph.errors import Cancelled
from nodegraph_terrain import smooth
from nodegraph_terrain.raster import Elevation, Extent, Mask
from nodegraph_terrain.smooth import gaussian_smooth

SHAPES = [(1, 1), (1, 7), (7, 1), (1, 100), (2, 3), (8, 8), (17, 33), (33, 17), (40, 130), (130, 40)]


def surface(data: np.ndarray, cell: float = 1.0, role: type = Elevation) -> Any:
    rows, cols = data.shape
    return role(np.asarray(data, np.float32), Extent(0, 0, cols * cell, rows * cell))


def noise(shape: tuple[int, int], voids: float = 0.0, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    data = rng.normal(3000, 300, shape).astype(np.float32)
    data[rng.random(shape) < voids] = np.nan
    return data


def brute_force(data: np.ndarray, sigma: float, truncate: float) -> np.ndarray:
    """Convolve cell by cell as the definition says: mirrored by numpy, no separation, voids without weight."""
    radius = int(truncate * sigma + 0.5)
    reach = np.arange(-radius, radius + 1)
    weights = np.exp(-(reach[:, None] ** 2 + reach[None] ** 2) / (2 * sigma**2)) if radius else np.ones((1, 1))
    wide = np.pad(data.astype(np.float64), radius, mode="symmetric")
    result = np.full(data.shape, np.nan)
    for (i, j), height in np.ndenumerate(data):
        if not np.isnan(height):
            window = wide[i : i + 2 * radius + 1, j : j + 2 * radius + 1]
            known = ~np.isnan(window)
            result[i, j] = (weights[known] * window[known]).sum() / weights[known].sum()
    return result


def on_device(node_input: Elevation, device: Any, **params: float) -> np.ndarray:
    assert gaussian_smooth.twin is not None
    given = node_input.like(device.from_host(node_input.data))
    result = gaussian_smooth.twin.function(given, **params, context=Context(device=device))
    assert type(result) is type(node_input)
    return device.to_host(result.data)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 3.3, 12.0])
def test_agrees_with_scipy(sigma: float) -> None:
    data = noise((60, 47))
    given = gaussian_smooth(surface(data, cell=30.0), sigma=30 * sigma).data
    expected = ndimage.gaussian_filter(data.astype(np.float64), sigma, mode="reflect")
    assert given.dtype == np.float32
    np.testing.assert_allclose(given, expected, atol=2e-3)


@given(
    rows=st.integers(1, 9),
    cols=st.integers(1, 9),
    sigma=st.floats(0.2, 3),
    truncate=st.floats(1, 4),
    voids=st.sampled_from([0.0, 0.3, 0.8]),
    seed=st.integers(0, 1000),
)
def test_is_the_normalised_convolution(
    rows: int, cols: int, sigma: float, truncate: float, voids: float, seed: int
) -> None:
    data = noise((rows, cols), voids, seed)
    given = gaussian_smooth(surface(data), sigma=sigma, truncate=truncate).data
    np.testing.assert_allclose(given, brute_force(data, sigma, truncate), rtol=1e-6, atol=2e-3)


@pytest.mark.parametrize("voids", [0.0, 0.2])
def test_both_ways_of_the_host_agree(voids: float, monkeypatch: pytest.MonkeyPatch) -> None:
    given = surface(noise((53, 71), voids))
    # A radius of several times the raster takes the fold onto the mirrored period too.
    for sigma in (3.0, 9.0, 60.0):
        monkeypatch.setattr(smooth, "DIRECT", 10**9)
        direct = gaussian_smooth(given, sigma=sigma).data
        monkeypatch.setattr(smooth, "DIRECT", 0)
        spectral = gaussian_smooth(given, sigma=sigma).data
        np.testing.assert_allclose(spectral, direct, rtol=1e-6, atol=1e-3)


def test_zero_changes_nothing_and_a_huge_sigma_gives_the_mean() -> None:
    given = surface(noise((20, 30)))
    assert gaussian_smooth(given, sigma=0.0) is given
    flat = gaussian_smooth(given, sigma=1e9).data
    np.testing.assert_allclose(flat, given.data.mean(dtype=np.float64), atol=2e-2)


def test_keeps_level_ground_ranges_roles_and_inputs() -> None:
    level = surface(np.full((40, 40), 4321.1), role=Mask)
    given = gaussian_smooth(level, sigma=2.0)
    assert type(given) is Mask
    assert given.extent is level.extent
    np.testing.assert_allclose(given.data, level.data, rtol=2e-7)
    rough = surface(noise((50, 50)))
    rough.data.flags.writeable = False
    smoothed = gaussian_smooth(rough, sigma=1.5).data
    assert rough.data.min() <= smoothed.min() <= smoothed.max() <= rough.data.max()


def test_an_all_void_raster_stays_void(device: Any) -> None:
    given = surface(np.full((9, 12), np.nan))
    assert np.isnan(gaussian_smooth(given, sigma=2.0).data).all()
    assert np.isnan(on_device(given, device, sigma=2.0, truncate=4.0)).all()


@pytest.mark.parametrize("extent", [Extent(0, 0, 1, 1, unit="deg"), Extent(0, 0, 10, 30)])
def test_refuses_degrees_and_oblong_cells(extent: Extent) -> None:
    with pytest.raises(ValueError, match=r"terrain\.reproject"):
        gaussian_smooth(Elevation(np.zeros((10, 10), np.float32), extent), sigma=1.0)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("sigma", [0.1, 0.6, 2.0, 7.3, 30.0])
@pytest.mark.parametrize("voids", [0.0, 0.3])
def test_the_twin_agrees(device: Any, shape: tuple[int, int], sigma: float, voids: float) -> None:
    given = surface(noise(shape, voids))
    host = gaussian_smooth(given, sigma=sigma).data
    twin = on_device(given, device, sigma=sigma, truncate=4.0)
    assert np.array_equal(np.isnan(host), np.isnan(twin))
    np.testing.assert_allclose(twin, host, atol=2e-3)


def test_the_twin_keeps_level_ground_exactly(device: Any) -> None:
    data = np.full((70, 90), 4321.1, np.float32)
    assert np.array_equal(on_device(surface(data), device, sigma=3.0, truncate=4.0), data)
    data[10:60, 20:70] = np.nan
    data[30, 40] = 4321.1
    twin = on_device(surface(data), device, sigma=3.0, truncate=4.0)
    assert np.array_equal(twin, data, equal_nan=True)


def test_the_twin_agrees_in_bands_and_beyond_its_widest_kernel(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for voids in (0.0, 0.1):
        given = surface(noise((75, 64), voids))
        monkeypatch.setattr(smooth, "TAPS", 10_000)
        banded = on_device(given, device, sigma=4.0, truncate=4.0)
        monkeypatch.undo()
        whole = on_device(given, device, sigma=4.0, truncate=4.0)
        np.testing.assert_allclose(banded, whole, atol=1e-3)
        host = gaussian_smooth(given, sigma=80.0).data
        np.testing.assert_allclose(on_device(given, device, sigma=80.0, truncate=4.0), host, atol=2e-3)


def test_the_twin_reads_windows_that_start_anywhere(device: Any) -> None:
    memory = np.zeros(40 * 50 + 3, np.float32)
    for shift in range(4):
        data = memory[shift : shift + 40 * 50].reshape(40, 50)
        data[...] = noise((40, 50), seed=shift)
        twin = on_device(surface(data), device, sigma=2.0, truncate=3.0)
        host = gaussian_smooth(surface(data), sigma=2.0, truncate=3.0).data
        np.testing.assert_allclose(twin, host, atol=2e-3)


@pytest.mark.parametrize("twin", [False, True])
def test_stops_within_a_second_when_cancelled(twin: bool, device: Any) -> None:
    stop = threading.Event()
    given = surface(noise((4000, 3000), 0.01))

    def smooth_for_ever() -> None:
        while True:
            if twin:
                assert gaussian_smooth.twin is not None
                context = Context(cancelled=stop, device=device)
                held = given.like(device.from_host(given.data))
                gaussian_smooth.twin.function(held, sigma=30.0, truncate=4.0, context=context)
            else:
                gaussian_smooth(given, sigma=10.0, context=Context(cancelled=stop))

    timer = threading.Timer(0.3, stop.set)
    started = time.monotonic()
    timer.start()
    with pytest.raises(Cancelled):
        smooth_for_ever()
    assert time.monotonic() - started < 1.3


def test_real_voids_stay_where_they_are(real_data: Any) -> None:
    raw = np.fromfile(real_data / "everest" / "N27E086.hgt", ">i2").reshape(1201, 1201)[300:700, 300:700]
    data = np.where(raw == -32768, np.nan, raw).astype(np.float32)
    assert np.isnan(data).any()
    smoothed = gaussian_smooth(surface(data, cell=90.0), sigma=180.0).data
    assert np.array_equal(np.isnan(smoothed), np.isnan(data))
    assert np.nanmin(data) <= np.nanmin(smoothed) <= np.nanmax(smoothed) <= np.nanmax(data)
