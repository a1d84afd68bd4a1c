from __future__ import annotations

import json
import math
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image as Picture

from nodegraph.codec import decode, encode, seal
from nodegraph_render.compare import compare
from nodegraph_render.differences import preview_differences
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.reproject import reproject
from nodegraph_terrain.resample import resample
from nodegraph_terrain.sample_dem import sample_dem
from nodegraph_terrain.slope import slope

DICE = np.random.default_rng(3)
ROWS, COLS, CELL = 23, 31, 20.0
EXTENT = Extent(5e5, 4e6, 5e5 + COLS * CELL, 4e6 + ROWS * CELL, "EPSG:32616")
Y, X = np.mgrid[0:ROWS, 0:COLS]
HILLS = Elevation(np.round(300 + 80 * np.sin(X / 5) * np.cos(Y / 4), 1).astype(np.float32), EXTENT)
SMALL = {"size": 200}

FEW = settings(max_examples=8)
"""Each example draws a map."""


def quarters(low: int, high: int) -> st.SearchStrategy[np.ndarray]:
    """Heights that float32 holds exactly, and their differences and squares too."""
    shape = st.tuples(st.integers(1, 7), st.integers(1, 7))
    return shape.flatmap(
        lambda shape: arrays(np.float32, shape, elements=st.integers(4 * low, 4 * high).map(lambda n: n / 4))
    )


def raster(data: np.ndarray) -> Elevation:
    rows, cols = data.shape
    return Elevation(data, Extent(0, 0, cols * CELL, rows * CELL))


@FEW
@given(data=quarters(0, 500), shift=st.integers(-400, 400).map(lambda n: n / 4))
def test_a_shift_is_exactly_its_own_rmse(data: np.ndarray, shift: float) -> None:
    found = compare(raster(data), raster(data + np.float32(shift)), within=50.0, **SMALL)
    numbers = found.statistics
    assert found.rmse == numbers.rmse == numbers.mean_absolute == numbers.largest == abs(shift)
    assert numbers.bias == numbers.lowest == numbers.highest == shift
    assert numbers.standard_deviation == 0
    assert numbers.slope_rmse == pytest.approx(0, abs=1e-4)
    assert numbers.share_within == (abs(shift) <= 50)
    assert (found.difference.data == shift).all()
    span = float(np.ptp(data))
    if shift and span:
        assert found.psnr == pytest.approx(20 * math.log10(span / abs(shift)))
        assert numbers.correlation == pytest.approx(1)
    elif shift:
        assert found.psnr == -math.inf
        assert math.isnan(numbers.correlation)


@FEW
@given(data=quarters(0, 500))
def test_equal_surfaces_have_an_infinite_psnr_that_json_can_say(data: np.ndarray) -> None:
    found = compare(raster(data), raster(data), **SMALL)
    assert (found.rmse, found.psnr) == (0, math.inf)
    text = found.statistics.to_json()
    numbers = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert numbers["psnr"] is None
    assert numbers["equal"] is True
    assert numbers["count"] == data.size
    again = decode(encode(found.statistics))
    assert seal(again) == seal(found.statistics)
    assert again.psnr == math.inf


@FEW
@given(seed=st.integers(0, 1 << 32), holes=st.integers(0, 40))
def test_the_numbers_agree_with_their_definitions(seed: int, holes: int) -> None:
    dice = np.random.default_rng(seed)
    a, b = (HILLS.data + dice.normal(0, 9, HILLS.shape).astype(np.float32) for _ in range(2))
    for data in (a, b):
        data.ravel()[dice.integers(0, data.size, holes)] = np.nan
    numbers = compare(raster(a), raster(b), within=5.0, **SMALL).statistics
    known = ~np.isnan(a) & ~np.isnan(b)
    x, y = a[known].astype(np.float64), b[known].astype(np.float64)
    d = y - x
    assert numbers.count == known.sum()
    assert numbers.void_count == (~known).sum()
    expected = {
        "rmse": np.sqrt(np.mean(d**2)),
        "mean_absolute": np.mean(np.abs(d)),
        "bias": np.mean(d),
        "standard_deviation": np.std(d),
        "lowest": d.min(),
        "highest": d.max(),
        "le90": np.quantile(np.abs(d), 0.9),
        "psnr": 20 * np.log10(np.ptp(x) / np.sqrt(np.mean(d**2))),
        "share_within": np.mean(np.abs(d) <= 5),
        "correlation": np.corrcoef(x, y)[0, 1],
    }
    for name, value in expected.items():
        assert getattr(numbers, name) == pytest.approx(value, rel=1e-9), name
    assert numbers.histogram.counts.sum() == numbers.count
    slopes = [slope(raster(np.where(known, data, np.float32(np.nan)))).data.astype(np.float64) for data in (a, b)]
    assert numbers.slope_rmse == pytest.approx(np.sqrt(np.nanmean((slopes[1] - slopes[0]) ** 2)), rel=1e-4)


def test_differences_are_void_where_one_is() -> None:
    hole = np.array(HILLS.data)
    hole[3:5, 6:9] = np.nan
    found = compare(HILLS, HILLS.like(hole), **SMALL)
    np.testing.assert_array_equal(np.isnan(found.difference.data), np.isnan(hole))
    assert found.statistics.void_count == 6
    assert found.statistics.slope_rmse == 0
    assert found.difference.extent == HILLS.extent


def test_other_grids_are_refused_with_a_way_out() -> None:
    coarse = resample(HILLS, cell_size=40.0)
    with pytest.raises(ValueError, match=r"shape .* do not match; .* or set resample to bring the surface"):
        compare(HILLS, coarse)
    elsewhere = Elevation(HILLS.data, Extent(0, 0, COLS * CELL, ROWS * CELL, "EPSG:32616"))
    with pytest.raises(ValueError, match=r"different extents or systems; .* or set resample"):
        compare(HILLS, elsewhere)
    with pytest.raises(ValueError, match="no cell is known in both"):
        compare(HILLS, elsewhere, resample=True)
    with pytest.raises(ValueError, match="one of the surfaces has no coordinate reference system"):
        compare(HILLS, raster(HILLS.data), resample=True)


def test_a_plane_is_a_plane_on_any_grid() -> None:
    def plane(cell: float, offset: float) -> Elevation:
        rows, cols = round(400 / cell), round(600 / cell)
        x, y = (np.arange(cols) + 0.5) * cell, (np.arange(rows)[::-1] + 0.5) * cell
        data = (100 + 0.2 * (x + offset) + 0.1 * y[:, None]).astype(np.float32)
        return Elevation(data, Extent(5e5 + offset, 4e6, 5e5 + offset + cols * cell, 4e6 + rows * cell, "EPSG:32616"))

    reference = plane(20.0, 0.0)
    for cell in (2.0, 7.0, 20.0, 40.0):
        found = compare(reference, plane(cell, 13.0), resample=True, **SMALL)
        d = found.difference.data[3:-3, 4:-4]
        assert not np.isnan(d).any()
        # Linear between centres: exact, but for the curve of means of unequal cells.
        assert np.abs(d).max() < 0.02 * cell
        assert np.isnan(found.difference.data[:, 0]).all()


def test_other_systems_are_sampled_where_they_lie() -> None:
    degrees = sample_dem()
    metres = reproject(degrees, cell_size=90.0)
    found = compare(metres, degrees, resample=True, **SMALL)
    assert found.statistics.void_count == 0
    # Cubic against linear interpolation of the same heights.
    assert found.statistics.rmse < 3
    assert abs(found.statistics.bias) < 0.05
    assert found.statistics.correlation > 0.999
    shifted = compare(metres, Elevation(np.roll(degrees.data, 3, axis=1), degrees.extent), resample=True, **SMALL)
    assert shifted.statistics.rmse > 20


@pytest.mark.parametrize("surface", [HILLS, Elevation(HILLS.data, Extent(-84, 36, -83.99, 36.01, "EPSG:4326", "deg"))])
def test_red_is_higher_and_blue_is_lower(surface: Elevation) -> None:
    data = np.array(surface.data)
    data[:, : COLS // 2] += 5
    data[:, COLS // 2 :] -= 5
    found = compare(surface.like(np.full_like(data, 300)), surface.like(np.where(X < COLS // 2, 305, 295)), **SMALL)
    picture = found.map.data.astype(int)
    red = (picture[..., 0] > 110) & (picture[..., 2] < 80) & (picture[..., 1] < 80)
    blue = (picture[..., 2] > 110) & (picture[..., 0] < 60)
    assert np.argwhere(red)[:, 1].mean() < 120
    assert red.mean() > 0.08
    assert blue.mean() > 0.08
    # The colours of the legend lie on the right of both.
    columns = np.flatnonzero(red.sum(axis=0) > 50), np.flatnonzero(blue.sum(axis=0) > 50)
    assert columns[0].min() < columns[1].min()


def test_the_picture_is_the_same_every_time_and_knows_its_place() -> None:
    noisy = HILLS.like(HILLS.data + DICE.normal(0, 1, HILLS.shape).astype(np.float32))
    first, second = (compare(HILLS, noisy, title="Noise", **SMALL) for _ in range(2))
    assert list(map(seal, first)) == list(map(seal, second))
    extent = first.map.extent
    assert extent.crs == HILLS.extent.crs
    assert extent.west < HILLS.extent.west < HILLS.extent.east < extent.east
    assert extent.south < HILLS.extent.south < HILLS.extent.north < extent.north


def test_infinite_heights_are_refused() -> None:
    data = np.array(HILLS.data)
    data[0, 0] = np.inf
    with pytest.raises(ValueError, match="infinite heights"):
        compare(HILLS, HILLS.like(data))


@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_the_numbers_have_a_preview(shift: float) -> None:
    numbers = compare(HILLS, HILLS.like(HILLS.data + np.float32(shift)), **SMALL).statistics
    picture = preview_differences(numbers)
    assert picture == preview_differences(numbers)
    assert np.asarray(Picture.open(BytesIO(picture)).convert("L")).std() > 5
    rows = dict(numbers.rows())
    assert rows["RMSE"] == f"{shift:.3f} m"
    assert rows["PSNR"].startswith("∞" if shift == 0 else "3")
