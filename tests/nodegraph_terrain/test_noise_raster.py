from __future__ import annotations

import inspect
import threading
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context, Forecast
from nodegraph.errors import Cancelled
from nodegraph_terrain.forecasts import Outline
from nodegraph_terrain.noise import KINDS, Noise
from nodegraph_terrain.noise_raster import centres, noise
from nodegraph_terrain.raster import Elevation, Extent, Mask

DEFAULTS = {
    name: item.default
    for name, item in inspect.signature(noise).parameters.items()
    if item.default is not inspect.Parameter.empty and name != "like"
}


def grid(shape: tuple[int, int], cell: float, west: float = 0.0, north: float = 0.0) -> Mask:
    rows, cols = shape
    extent = Extent(west, north - rows * cell, west + cols * cell, north)
    return Mask(np.zeros(shape, np.float32), extent)


def edges(extent: Extent) -> tuple[float, float, float, float]:
    return extent.west, extent.south, extent.east, extent.north


def on_device(device: Any, like: Any = None, **params: Any) -> np.ndarray:
    assert noise.twin is not None
    made = noise.twin.function(like, **{**DEFAULTS, **params}, context=Context(device=device))
    assert type(made) is Elevation
    return np.asarray(device.to_host(made.data))


def test_samples_the_centres_of_cells() -> None:
    made = noise(extent=(100, 200, 130, 220), cell_size=10, kind="ridged", octaves=3, wavelength=40, seed=9, offset=7)
    assert edges(made.extent) == (100, 200, 130, 220)
    ground = Noise("ridged", 3, 40.0, seed=9)
    expected = 7 + 500 * ground.value(np.array([105.0, 115, 125]), np.array([[215.0], [205]]))
    np.testing.assert_array_equal(made.data, expected.astype(np.float32))


def test_the_shape_of_the_result() -> None:
    assert noise().shape == (512, 512)
    grown = noise(extent=(0, 0, 95, 41), cell_size=10)
    assert (grown.shape, edges(grown.extent)) == ((5, 10), (0, -9, 100, 41))
    assert noise(extent=(0, 0, 0.3, 0.1), cell_size=0.1).shape == (1, 3)
    wide = noise(extent=(0, 0, 90, 20), rows=4, columns=3, crs="EPSG:32632")
    assert (wide.shape, wide.cell_size, wide.extent.crs) == ((4, 3), (30.0, 5.0), "EPSG:32632")
    like = grid((7, 9), 25.0, 5e5, 4e6)
    assert noise(like).extent is like.extent
    assert noise(like).shape == like.shape


@settings(max_examples=40)
@given(
    kind=st.sampled_from(KINDS),
    cell=st.sampled_from([0.1, 0.3, 1.0, 2.5, 30.0, 92.77]),
    west=st.integers(-(10**6), 10**6),
    north=st.integers(-(10**7), 10**7),
    start=st.tuples(st.integers(0, 30), st.integers(0, 30)),
    kappa=st.sampled_from([1.0, 0.45]),
)
def test_a_window_is_that_of_the_whole(
    kind: Any, cell: float, west: int, north: int, start: tuple[int, int], kappa: float
) -> None:
    params: dict[str, Any] = {"kind": kind, "wavelength": 20 * cell, "octaves": 3, "kappa": kappa}
    whole = grid((40, 45), cell, west + 0.3, north + 0.07)
    rows, cols = slice(start[0], start[0] + 7), slice(start[1], start[1] + 11)
    full, part = noise(whole, **params), noise(whole.window(rows, cols), **params)
    np.testing.assert_array_equal(full.data[rows, cols], part.data)
    # A window of a window, and one whose edges were written down.
    inner = whole.window(rows, cols).window(slice(1, 5), slice(2, 9))
    np.testing.assert_array_equal(part.data[1:5, 2:9], noise(inner, **params).data)


def test_voids_and_contents_of_the_grid_do_not_matter() -> None:
    like = grid((9, 9), 30.0)
    holey = like.like(np.full((9, 9), np.nan, np.float32))
    np.testing.assert_array_equal(noise(like).data, noise(holey).data)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("cell", "wavelength", "octaves"), [(30.0, 5000.0, 8), (1.0, 1e5, 12), (100.0, 250.0, 3), (100.0, 30.0, 1)]
)
def test_the_device_agrees(device: Any, kind: Any, cell: float, wavelength: float, octaves: int) -> None:
    params = {"kind": kind, "wavelength": wavelength, "octaves": octaves, "amplitude": 1.0, "seed": 2}
    for shape in ((300, 517), (1, 1), (17, 9)):
        like = grid(shape, cell, 412_345.6, 5_234_567.8)
        for kappa in (1.0, 0.7):
            given, expected = on_device(device, like, kappa=kappa, **params), noise(like, kappa=kappa, **params).data
            assert np.abs(given - expected).max() < 1e-5


def test_a_window_on_the_device(device: Any) -> None:
    whole = grid((150, 260), 0.1, 5e5, 4e6)
    params: dict[str, Any] = {"wavelength": 12.0, "octaves": 6, "amplitude": 1.0}
    full = on_device(device, whole, **params)
    for rows, cols in ((slice(3, 90), slice(5, 200)), (slice(149, 150), slice(0, 260))):
        part = on_device(device, whole.window(rows, cols), **params)
        assert np.abs(full[rows, cols] - part).max() < 1e-5


def test_the_device_without_a_grid(device: Any) -> None:
    params = {"extent": (0.0, 0.0, 640.0, 320.0), "cell_size": 10.0, "amplitude": 1.0}
    assert np.abs(on_device(device, **params) - noise(**params).data).max() < 1e-5


def test_float32_holds_a_centimetre_over_200_kilometres(device: Any) -> None:
    """Mountains of 4 km, corner cells of a grid of 200,000 x 200,000 cells of 1 m far from the origin."""
    params: dict[str, Any] = {"kind": "ridged", "wavelength": 2e4, "octaves": 12, "amplitude": 4000.0}
    for west, north in ((600_000.0, 5_200_000.0), (800_000.0 - 64, 5_000_000.0 + 64)):
        like = grid((64, 64), 1.0, west, north)
        assert np.abs(on_device(device, like, **params) - noise(like, **params).data).max() < 0.01


def test_cell_centres_are_the_same_in_every_window() -> None:
    whole = Outline(30, 40, Extent(499_999.7, 3_999_997.0, 500_003.7, 4_000_000.0))
    x, y = centres(whole)
    part = whole.window(slice(7, 20), slice(11, 33))
    np.testing.assert_array_equal(centres(part)[0], x[11:33])
    np.testing.assert_array_equal(centres(part)[1], y[7:20])
    more = centres(whole, 16)
    assert [len(ends) for ends in more] == [48, 32]
    np.testing.assert_array_equal(more[0][:40], x)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"rows": 4}, "both rows and columns"),
        ({"columns": 4}, "both rows and columns"),
        ({"extent": (0, 0, 0, 10)}, "east > west"),
        ({"extent": (0, 0, float("nan"), 10)}, "finite"),
        ({"extent": (0, 0, 1e9, 1e9), "cell_size": 0.1}, "cells"),
        ({"extent": (1e12, 0, 1e12 + 100, 100), "cell_size": 10, "wavelength": 10}, "2\\^31 cells"),
        ({"wavelength": float("nan")}, "wavelength"),
    ],
)
def test_what_makes_no_sense_is_refused(params: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        noise(**params)


def test_degrees_are_refused() -> None:
    like = Mask(np.zeros((2, 2), np.float32), Extent(8, 46, 9, 47, "EPSG:4326", "deg"))
    with pytest.raises(ValueError, match="degrees"):
        noise(like)


def test_the_forecast_is_right() -> None:
    made = noise.predict({}, DEFAULTS)
    assert made.bytes == 4 * 512 * 512
    assert (made.about.rows, made.about.cols, edges(made.about.extent)) == (512, 512, (0, 0, 10240, 10240))
    known = Outline(3, 4, Extent(0, 0, 4, 3))
    assert noise.predict({"like": [Forecast(99, about=known)]}, DEFAULTS).bytes == 48
    assert noise.predict({"like": [Forecast(99)]}, DEFAULTS).bytes == 99
    assert noise.predict({}, {**DEFAULTS, "rows": 3}).bytes == 0


@pytest.mark.parametrize("twin", [False, True])
def test_stops_within_a_second_when_cancelled(twin: bool, device: Any) -> None:
    stop = threading.Event()
    context = Context(cancelled=stop, device=device if twin else None)
    params: dict[str, Any] = {
        **DEFAULTS,
        "rows": 9000,
        "columns": 9000,
        "octaves": 24,
        "wavelength": 1e5,
        "lacunarity": 1.2,
    }
    timer = threading.Timer(0.5, stop.set)
    timer.start()
    started = time.perf_counter()
    with pytest.raises(Cancelled):
        noise.run({}, params, context, twin=twin)
    timer.join()
    assert time.perf_counter() - started < 1.5
