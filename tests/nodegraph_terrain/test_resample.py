from __future__ import annotations

from dataclasses import astuple
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image as Picture
from scipy import ndimage

from nodegraph_terrain.forecasts import Outline
from nodegraph_terrain.raster import Elevation, Extent, Mask
from nodegraph_terrain.resample import resample

METHODS: tuple[Any, ...] = ("bilinear", "cubic", "lanczos", "area")
RNG = np.random.default_rng(11)
ROUGH = RNG.normal(500, 100, (37, 53)).astype(np.float32)


def surface(data: object, cell: float = 10.0) -> Elevation:
    array = np.asarray(data, np.float32)
    return Elevation(array, Extent(500, 1000, 500 + array.shape[1] * cell, 1000 + array.shape[0] * cell, "EPSG:32632"))


def centres(raster: Elevation) -> tuple[np.ndarray, np.ndarray]:
    dx, dy = raster.cell_size
    rows, cols = raster.shape
    x = raster.extent.west + (np.arange(cols) + 0.5) * dx
    y = raster.extent.north - (np.arange(rows) + 0.5) * dy
    return np.meshgrid(x, y)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("cell", [2.3, 10.0, 31.0])
def test_a_constant_stays_constant(method: Any, cell: float) -> None:
    result = resample(surface(np.full((20, 30), 1234.5)), cell_size=cell, method=method)
    np.testing.assert_allclose(result.data, 1234.5, rtol=1e-6)


@pytest.mark.parametrize(
    ("method", "cell", "margin"),
    [
        ("bilinear", 3.0, 2), ("bilinear", 25.0, 0),
        ("cubic", 3.0, 0), ("cubic", 10.0, 0), ("cubic", 25.0, 0),
        ("lanczos", 3.0, 12), ("lanczos", 10.0, 0), ("lanczos", 25.0, 3),
        ("area", 10.0, 0), ("area", 20.0, 0), ("area", 50.0, 0),
    ],
)  # fmt: skip
def test_a_plane_stays_a_plane(method: Any, cell: float, margin: int) -> None:
    source = surface(np.zeros((40, 60)))
    x, y = centres(source)
    result = resample(source.like((3 * x - 2 * y).astype(np.float32)), cell_size=cell, method=method)
    x, y = centres(result)
    inner = (slice(margin, -margin or None),) * 2
    np.testing.assert_allclose(result.data[inner], (3 * x - 2 * y)[inner], atol=1e-3)


@pytest.mark.parametrize("shape", [(7, 9), (37, 53), (20, 53), (100, 17), (64, 64)])
def test_area_conserves_the_mean(shape: tuple[int, int]) -> None:
    result = resample(surface(ROUGH), rows=shape[0], columns=shape[1], method="area")
    assert result.shape == shape
    assert result.data.astype(float).mean() == pytest.approx(ROUGH.astype(float).mean(), rel=1e-7)


def test_area_is_the_overlap_weighted_mean() -> None:
    result = resample(surface(ROUGH), rows=5, columns=8, method="area").data
    fine = np.repeat(np.repeat(ROUGH.astype(np.float64), 5, axis=0), 8, axis=1)
    np.testing.assert_allclose(result, fine.reshape(5, 37, 8, 53).mean(axis=(1, 3)), rtol=1e-6)


@pytest.mark.parametrize("shape", [(80, 111), (37, 53), (41, 60)])
def test_bilinear_agrees_with_pillow(shape: tuple[int, int]) -> None:
    result = resample(surface(ROUGH), rows=shape[0], columns=shape[1], method="bilinear")
    expected = np.asarray(Picture.fromarray(ROUGH).resize(shape[::-1], Picture.Resampling.BILINEAR))
    np.testing.assert_allclose(result.data, expected, atol=2e-3)


@pytest.mark.parametrize("shape", [(80, 111), (37, 53), (12, 19)])
def test_lanczos_is_pillows_up_to_the_correction_of_planes(shape: tuple[int, int]) -> None:
    result = resample(surface(ROUGH), rows=shape[0], columns=shape[1], method="lanczos").data
    expected = np.asarray(Picture.fromarray(ROUGH).resize(shape[::-1], Picture.Resampling.LANCZOS))
    # The correction is at most 2 % of the difference of neighbours, along either axis.
    steepest = max(np.abs(np.diff(ROUGH, axis=axis)).max() for axis in (0, 1))
    assert np.abs(result - expected).max() < 2 * 0.02 * steepest


def test_lanczos_by_hand() -> None:
    line = RNG.normal(0, 1, 30).astype(np.float32)
    result = resample(surface(line[None]), rows=1, columns=75, method="lanczos").data[0]
    for column in range(20, 55):
        centre = (column + 0.5) * 30 / 75 - 0.5
        taps = np.arange(int(np.floor(centre)) - 2, int(np.floor(centre)) + 4)
        kernel = np.sinc(centre - taps) * np.sinc((centre - taps) / 3)
        kernel /= kernel.sum()
        drift = float(kernel @ taps) - centre
        kernel[2] += drift
        kernel[3] -= drift
        assert result[column] == pytest.approx(float(kernel @ line[taps]), abs=1e-5)


def test_cubic_is_the_interpolating_spline() -> None:
    source = surface(ROUGH)
    result = resample(source, rows=91, columns=150)
    y = (np.arange(91) + 0.5) * 37 / 91 - 0.5
    x = (np.arange(150) + 0.5) * 53 / 150 - 0.5
    expected = ndimage.map_coordinates(ROUGH.astype(np.float64), np.meshgrid(y, x, indexing="ij"), order=3)
    # Both splines forget how they treat the edge within a few cells.
    np.testing.assert_allclose(result.data[30:-30, 40:-40], expected[30:-30, 40:-40], atol=1e-2)
    np.testing.assert_allclose(resample(source, rows=37, columns=53).data, ROUGH, atol=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_the_georeference_is_kept(method: Any) -> None:
    source = surface(ROUGH)
    by_shape = resample(source, rows=11, columns=200, method=method)
    assert by_shape.extent is source.extent
    by_cell = resample(source, cell_size=7.0, method=method)
    assert by_cell.shape == (52, 75)
    assert by_cell.cell_size == pytest.approx((7, 7), rel=1e-12)
    assert (by_cell.extent.west, by_cell.extent.north) == (source.extent.west, source.extent.north)
    assert by_cell.extent.crs == "EPSG:32632"
    assert isinstance(by_cell, Elevation)


@pytest.mark.parametrize("method", METHODS)
def test_voids_stay_where_they_are(method: Any) -> None:
    data = np.full((40, 40), 700.0, np.float32)
    data[10:20, 15:30] = np.nan
    result = resample(surface(data), rows=80, columns=80, method=method)
    known = ~np.isnan(result.data)
    np.testing.assert_allclose(result.data[known], 700, rtol=1e-6)
    expected = np.repeat(np.repeat(np.isnan(data), 2, axis=0), 2, axis=1)
    # The border of a void may move by less than a new cell.
    assert not (expected & known)[22:38, 32:58].any()
    grown = ndimage.binary_dilation(expected, iterations=1)
    assert known[~grown].all()


@settings(max_examples=30, deadline=None)
@given(
    arrays(np.float32, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.floats(-100, 100, width=32)),
    st.integers(1, 20),
    st.integers(1, 20),
    st.sampled_from(("bilinear", "area")),
)
def test_means_make_no_new_extremes(data: np.ndarray, rows: int, columns: int, method: Any) -> None:
    result = resample(surface(data), rows=rows, columns=columns, method=method).data
    assert result.shape == (rows, columns)
    assert result.min() >= data.min() - 1e-4
    assert result.max() <= data.max() + 1e-4


def test_roles_keep_their_range() -> None:
    step = np.zeros((16, 16), np.float32)
    step[:, 8:] = 1
    mask = Mask(step, Extent(0, 0, 16, 16))
    for method in METHODS:
        result = resample(mask, cell_size=0.3, method=method)
        assert type(result) is Mask
        assert result.data.min() >= 0
        assert result.data.max() <= 1


def test_all_void_stays_all_void() -> None:
    for method in METHODS:
        assert np.isnan(resample(surface(np.full((4, 5), np.nan)), rows=3, columns=9, method=method).data).all()


def test_bad_calls_are_refused() -> None:
    source = surface(ROUGH)
    for params in ({}, {"rows": 4}, {"columns": 4}):
        with pytest.raises(ValueError, match="state either"):
            resample(source, **params)
    with pytest.raises(ValueError, match="give one of them"):
        resample(source, rows=4, cell_size=3.0)
    with pytest.raises(ValueError, match="larger than the raster of 530 x 370 m"):
        resample(source, cell_size=1e6)
    with pytest.raises(ValueError, match="larger than the raster of 530 x 370 m"):
        resample(source, factor=0.01)
    with pytest.raises(ValueError, match="give one of them"):
        resample(source, source, factor=2.0)
    with pytest.raises(ValueError, match="covers another extent"):
        resample(source, surface(ROUGH, cell=11.0))
    with pytest.raises(ValueError, match="choose larger cells"):
        resample(source, cell_size=1e-4)


def test_a_grid_like_another_and_a_factor_state_what_rows_and_columns_do() -> None:
    source = surface(ROUGH)
    finer = resample(source, rows=4 * 37, columns=4 * 53)
    for same in (resample(source, finer), resample(source, factor=4.0)):
        assert astuple(same.extent) == astuple(finer.extent)
        np.testing.assert_array_equal(same.data, finer.data)
    back = resample(finer, source, method="area")
    assert astuple(back.extent) == astuple(source.extent)
    np.testing.assert_allclose(back.data, finer.data.reshape(37, 4, 53, 4).mean(axis=(1, 3)), rtol=1e-6)
    third = resample(source, factor=1 / 3)
    assert third.shape == (12, 17)
    np.testing.assert_allclose(third.cell_size, 30)


def test_the_forecast_is_right() -> None:
    source = surface(ROUGH)
    params = resample.parameters.check({"cell_size": 7.0}).values
    predicted = resample.predict({"surface": [Outline(*source.shape, source.extent).forecast()]}, params)
    result = resample(source, cell_size=7.0)
    assert predicted.bytes == result.data.nbytes
    assert (predicted.about.rows, predicted.about.cols) == result.shape
