from __future__ import annotations

from math import asinh, atan, atanh, cos, cosh, pi, radians, sin, sinh, sqrt, tan
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph_terrain import reproject as module
from nodegraph_terrain.forecasts import Outline
from nodegraph_terrain.raster import Elevation, Extent, Mask
from nodegraph_terrain.reproject import largest_rectangle, reproject
from nodegraph_terrain.sample_dem import sample_dem

TENNESSEE = Extent(-84.4, 36.4, -84.1, 36.7, "EPSG:4326", "deg")


def utm(lon: float, lat: float, zone: int) -> tuple[float, float]:
    """Project WGS 84 degrees to northern UTM metres by the Krueger series, good to a millimetre here."""
    flattening = 1 / 298.257223563
    n = flattening / (2 - flattening)
    radius = 6378137 / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    alpha = (n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240)
    phi, lam = radians(lat), radians(lon - (6 * zone - 183))
    e = 2 * sqrt(n) / (1 + n)
    t = sinh(atanh(sin(phi)) - e * atanh(e * sin(phi)))
    xi, eta = atan(t / cos(lam)), atanh(sin(lam) / sqrt(1 + t * t))
    east = eta + sum(a * cos(2 * j * xi) * sinh(2 * j * eta) for j, a in enumerate(alpha, 1))
    north = xi + sum(a * sin(2 * j * xi) * cosh(2 * j * eta) for j, a in enumerate(alpha, 1))
    return 500000 + 0.9996 * radius * east, 0.9996 * radius * north


def test_the_reference_projection_itself() -> None:
    # Published: the CN Tower, 43 deg 38' 33.24" N 79 deg 23' 13.7" W, is 630084 m E, 4833438 m N in zone 17.
    assert utm(-79.38713889, 43.64256667, 17) == pytest.approx((630084, 4833438), abs=1.5)
    assert asinh(tan(radians(45))) == pytest.approx(atanh(sin(pi / 4)))


@pytest.mark.parametrize("resampling", ["bilinear", "cubic"])
def test_every_centre_is_where_the_projection_puts_it(resampling: Any) -> None:
    # Rasters of longitude and latitude, in arc-seconds from the middle, tell where each new cell was taken.
    size = 360
    step = 0.3 / size
    lon = (np.arange(size) + 0.5) * step - 0.15
    lat = 0.15 - (np.arange(size) + 0.5) * step
    places = []
    for values in (np.broadcast_to(lon, (size, size)), np.broadcast_to(lat[:, None], (size, size))):
        raster = Elevation((values * 3600).astype(np.float32), TENNESSEE)
        places.append(reproject(raster, cell_size=100.0, resampling=resampling))
    extent, (rows, cols) = places[0].extent, places[0].shape
    assert extent.crs == "EPSG:32616"
    for row in range(4, rows - 4, 37):
        for col in range(4, cols - 4, 41):
            east, north = (float(place.data[row, col]) / 3600 for place in places)
            found = utm(-84.25 + east, 36.55 + north, 16)
            centre = extent.west + (col + 0.5) * 100, extent.north - (row + 0.5) * 100
            assert found == pytest.approx(centre, abs=0.01)


def test_the_sample_dem_in_metres() -> None:
    dem = sample_dem()
    result = reproject(dem, cell_size=80.0)
    assert isinstance(result, Elevation)
    assert result.cell_size == pytest.approx((80, 80), rel=1e-12)
    assert result.extent.unit == "m"
    assert not np.isnan(result.data).any()
    assert result.data.mean() == pytest.approx(dem.data.mean(), rel=0.01)
    for edge in (result.extent.west, result.extent.north):
        assert edge % 80 == 0
    # Little is lost: the grid turns by 1.6 degrees.
    untrimmed = reproject(dem, cell_size=80.0, trim=False)
    assert np.isnan(untrimmed.data).any()
    assert result.data.size > 0.9 * (~np.isnan(untrimmed.data)).sum()
    top = round((untrimmed.extent.north - result.extent.north) / 80)
    left = round((result.extent.west - untrimmed.extent.west) / 80)
    rows, cols = result.shape
    np.testing.assert_array_equal(untrimmed.data[top : top + rows, left : left + cols], result.data)


def test_by_default_cells_keep_their_ground_area() -> None:
    result = reproject(sample_dem())
    # 3" by 3" at 36.6 N is 74.4 m by 92.7 m.
    assert result.cell_size == pytest.approx((83.0, 83.0))


def test_voids_stay_and_trimming_ignores_them() -> None:
    dem = sample_dem()
    data = dem.data.copy()
    data[100:140, 200:260] = np.nan
    holed = reproject(dem.like(data), cell_size=80.0)
    full = reproject(dem, cell_size=80.0)
    assert (holed.shape, holed.extent.west) == (full.shape, full.extent.west)
    missing = np.isnan(holed.data)
    assert missing.sum() == pytest.approx(40 * 60 * 74.4 * 92.7 / 80**2, rel=0.02)
    far = ~np.isnan(reproject(dem.like(data), cell_size=80.0, resampling="nearest").data)
    assert np.mean(holed.data[far & ~missing] == full.data[far & ~missing]) > 0.97


def test_blocks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    dem = sample_dem()
    for resampling in ("cubic", "bilinear", "nearest"):
        whole = reproject(dem, cell_size=150.0, resampling=resampling)  # type: ignore[arg-type]
        with monkeypatch.context() as patch:
            patch.setattr(module, "_BLOCK", 5000)
            np.testing.assert_array_equal(
                reproject(dem, cell_size=150.0, resampling=resampling).data,  # type: ignore[arg-type]
                whole.data,
            )


def test_neighbouring_tiles_share_one_grid() -> None:
    dem = sample_dem()
    left, right = dem.window(slice(None), slice(0, 200)), dem.window(slice(None), slice(200, None))
    a, b = (reproject(part, cell_size=90.0, crs="EPSG:32616") for part in (left, right))
    assert (b.extent.west - a.extent.west) / 90 == pytest.approx(round((b.extent.west - a.extent.west) / 90))


@pytest.mark.parametrize(
    ("extent", "expected"),
    [
        (Extent(8, 46, 8.1, 46.1, "EPSG:4326", "deg"), "EPSG:32632"),
        (Extent(-71, -33, -70.9, -32.9, "EPSG:4326", "deg"), "EPSG:32719"),
        (Extent(10, 86, 10.2, 86.1, "EPSG:4326", "deg"), "EPSG:32661"),
        (Extent(10, -86.1, 10.2, -86, "EPSG:4326", "deg"), "EPSG:32761"),
        (Extent(557805, 5107965, 558805, 5108965, "EPSG:26710"), "EPSG:26710"),
        (Extent(900000, 5800000, 901000, 5801000, "EPSG:3857"), "EPSG:32632"),
    ],
)
def test_auto_chooses_a_system_in_metres(extent: Extent, expected: str) -> None:
    raster = Elevation(np.full((20, 20), 5, np.float32), extent)
    result = reproject(raster)
    assert result.extent.crs == expected
    np.testing.assert_allclose(result.data, 5)


def test_metres_to_metres_is_a_change_of_cells() -> None:
    raster = Elevation(np.arange(400, dtype=np.float32).reshape(20, 20), Extent(0, 0, 600, 600, "EPSG:32632"))
    np.testing.assert_allclose(reproject(raster, cell_size=30.0).data, raster.data, atol=1e-6)
    assert reproject(raster, cell_size=60.0).data[0, 0] == pytest.approx(10.5)


def test_roles_keep_their_range() -> None:
    data = np.zeros((60, 60), np.float32)
    data[:, 30:] = 1
    result = reproject(Mask(data, TENNESSEE), cell_size=150.0)
    assert type(result) is Mask
    assert (result.data.min(), result.data.max()) == (0, 1)


def test_bad_calls_are_refused() -> None:
    raster = Elevation(np.zeros((20, 20), np.float32), TENNESSEE)
    for crs in ("EPSG:999999", "nonsense", ""):
        with pytest.raises(ValueError, match="is not known; give one such as EPSG"):
            reproject(raster, crs=crs)
    for crs in ("EPSG:4326", "EPSG:2263"):
        with pytest.raises(ValueError, match="is not in metres"):
            reproject(raster, crs=crs)
    with pytest.raises(ValueError, match="no coordinate reference system"):
        reproject(Elevation(np.zeros((2, 2), np.float32), Extent(0, 0, 1, 1)))
    with pytest.raises(ValueError, match="leaves no cell inside"):
        reproject(raster, cell_size=1e6)
    with pytest.raises(ValueError, match="choose larger cells"):
        reproject(raster, cell_size=0.01)
    with pytest.raises(ValueError, match=r"lies outside of what|reaches beyond what"):
        reproject(raster, crs="+proj=ortho +lat_0=-36 +lon_0=96 +units=m")


def test_the_forecast_is_near() -> None:
    dem = sample_dem()
    for params in ({"cell_size": 40.0}, {}):
        checked = reproject.parameters.check(params).values
        predicted = reproject.predict({"surface": [Outline(*dem.shape, dem.extent).forecast()]}, checked)
        result = reproject(dem, **params)
        assert predicted.bytes == pytest.approx(result.data.nbytes, rel=0.1)
        assert predicted.about.cell_size == pytest.approx(result.cell_size)


@settings(max_examples=80, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=9))
def test_the_largest_rectangle_is_the_largest(runs: list[tuple[int, int]]) -> None:
    inside = np.zeros((len(runs), 9), bool)
    for row, (a, b) in enumerate(runs):
        inside[row, min(a, b) : max(a, b)] = True
    rows, cols = largest_rectangle(inside)
    assert inside[rows, cols].all()
    best = max(
        (bottom - top) * (right - left)
        for top in range(len(runs))
        for bottom in range(top, len(runs) + 1)
        for left in range(9)
        for right in range(left, 10)
        if inside[top:bottom, left:right].all()
    )
    assert inside[rows, cols].size == best
