"""Temperature, precipitation and wetness: laws, stations, and rain over mountains."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from nodegraph_hydrology.drainage import DrainageArea, drainage_area
from nodegraph_terrain.raster import Elevation, Extent, Labels, Raster, Slope
from nodegraph_texture.orographic import linear_precipitation, moist_air, padded, wind_vector
from nodegraph_texture.precipitation import precipitation
from nodegraph_texture.stations import fit
from nodegraph_texture.temperature import temperature
from nodegraph_texture.wetness import wetness

DEGREES = Elevation(np.full((4, 5), 100, np.float32), Extent(8, 46, 9, 47, "EPSG:4326", "deg"))


def hills(rows: int = 20, cols: int = 30, cell: float = 100.0) -> Elevation:
    i, j = np.indices((rows, cols))
    heights = 1000 + 600 * np.sin(i / 4) * np.cos(j / 6)
    heights[3:5, 7:9] = np.nan
    return Elevation(heights.astype(np.float32), Extent(0, 0, cols * cell, rows * cell))


def stations(surface: Elevation, value, count: int = 12, seed: int = 0) -> list[tuple[float, float, float, float]]:
    """Stations in the middles of cells whose values follow a law of (x, y, z)."""
    rng = np.random.default_rng(seed)
    known = np.argwhere(~np.isnan(surface.data))
    found = []
    for row, col in known[rng.choice(len(known), count, replace=False)]:
        x = surface.extent.west + (col + 0.5) * surface.cell_size[0]
        y = surface.extent.north - (row + 0.5) * surface.cell_size[1]
        z = float(surface.data[row, col])
        found.append((float(x), float(y), z, float(value(x, y, z))))
    return found


def middles(surface: Elevation) -> tuple[np.ndarray, np.ndarray]:
    rows, cols = surface.shape
    dx, dy = surface.cell_size
    return surface.extent.west + (np.arange(cols) + 0.5) * dx, (surface.extent.north - (np.arange(rows) + 0.5) * dy)[
        :, None
    ]


# Temperature.


def test_the_standard_atmosphere() -> None:
    surface = hills()
    np.testing.assert_allclose(temperature(surface).data, 15 - 0.0065 * surface.data, rtol=1e-6)
    # Without stations degrees will do.
    np.testing.assert_allclose(temperature(DEGREES).data, 14.35, rtol=1e-6)


def test_the_zonal_mean_is_that_of_the_earth() -> None:
    """Warren and Schneider (1979) list the means of zones of 10 degrees, from 0-10 N on."""
    flat = Elevation(np.zeros((180, 2), np.float32), Extent(0, -90, 2, 90, "EPSG:4326", "deg"))
    found = temperature(flat, sea_level=None).data[:, 0]
    listed = np.array([26.4, 26.1, 22.9, 16.2, 8.8, 2.2, -5.1, -12.3, -16.9])
    edges = np.sin(np.radians(np.arange(0, 91, 10)))
    share = np.diff(edges)
    # A zone's part of the integral of the second polynomial of Legendre, (x^3 - x) / 2 at its edges.
    second = np.diff((edges**3 - edges) / 2)
    terms = float(listed @ share), float(5 * listed @ second)
    assert terms == pytest.approx((15.0, -27.3), abs=0.05)
    north = found[:90][::-1].reshape(9, 10).mean(axis=1)
    assert np.abs(north - listed)[:8].max() < 3
    assert abs(north[8] - listed[8]) < 5.1
    assert np.average(north, weights=share) == pytest.approx(float(listed @ share), abs=0.1)
    np.testing.assert_allclose(found, found[::-1])


def test_the_seasons() -> None:
    flat = Elevation(np.zeros((2, 2), np.float32), Extent(0, 0, 10, 10))
    days = np.arange(1, 366, 5.0)
    north, south = (
        np.array([temperature(flat, day=float(d), latitude=lat).data[0, 0] for d in days]) for lat in (50.0, -50.0)
    )
    assert days[north.argmax()] == pytest.approx(200, abs=5)
    assert abs(days[south.argmax()] - 17.4) <= 5
    assert np.ptp(north) == pytest.approx(2 * 15.5 * math.sin(math.radians(50)), rel=0.01)
    assert north.mean() == pytest.approx(15, abs=0.1)
    assert temperature(flat, day=200.0, amplitude=8.0, warmest_day=200.0).data[0, 0] == pytest.approx(23)
    with pytest.raises(ValueError, match="give the latitude"):
        temperature(flat, day=10.0)


@settings(max_examples=25, deadline=None)
@given(lapse=st.floats(-12, 12), level=st.floats(-30, 30), seed=st.integers(0, 99))
def test_stations_give_back_the_law_they_follow(lapse: float, level: float, seed: int) -> None:
    surface = hills()
    found = temperature(surface, stations=tuple(stations(surface, lambda x, y, z: level - lapse * z / 1000, 6, seed)))
    np.testing.assert_allclose(found.data, level - lapse * surface.data / 1000, atol=1e-3)


def test_regression_is_least_squares_and_residuals_meet_the_stations() -> None:
    surface = hills()
    rng = np.random.default_rng(3)
    measured = stations(surface, lambda x, y, z: 12 - 0.006 * z + rng.normal(0, 1), 15)
    z, value = np.array(measured)[:, 2], np.array(measured)[:, 3]
    slope, level = np.polyfit(z, value, 1)
    plain = temperature(surface, stations=tuple(measured), residuals=False).data
    np.testing.assert_allclose(plain, level + slope * surface.data, atol=1e-4)
    met = temperature(surface, stations=tuple(measured)).data
    for x, y, _, wanted in measured:
        col, row = int(x / 100), int((2000 - y) / 100)
        assert met[row, col] == pytest.approx(wanted, abs=1e-3)
    assert np.nanmax(np.abs(met - plain)) <= np.abs(value - level - slope * z).max() + 1e-3


def test_zones_have_laws_of_their_own_and_fade() -> None:
    surface = hills()
    zones = Labels(np.repeat([[0] * 14 + [4] * 14 + [-1] * 2], 20, axis=0).astype(np.int32), surface.extent)
    law = {0: (10, 0.005), 4: (20, 0.008)}
    measured = stations(
        surface, lambda x, y, z: law[0][0] - law[0][1] * z if x < 1400 else law[4][0] - law[4][1] * z, 20
    )
    found = temperature(surface, zones, stations=tuple(measured), residuals=False).data
    for zone, (level, lapse) in law.items():
        inside = zones.data == zone
        np.testing.assert_allclose(found[inside], (level - lapse * surface.data)[inside], atol=1e-3)
    assert (np.isnan(found) == (np.isnan(surface.data) | (zones.data < 0))).all()
    faded = temperature(surface, zones, stations=tuple(measured), residuals=False, transition=300.0).data
    low, high = (
        np.minimum(10 - 0.005 * surface.data, 20 - 0.008 * surface.data),
        np.maximum(10 - 0.005 * surface.data, 20 - 0.008 * surface.data),
    )
    known = ~np.isnan(faded)
    assert ((faded >= low - 1e-3) & (faded <= high + 1e-3))[known].all()
    step, soft = (np.nanmean(np.abs(np.diff(data, axis=1))[:, 13]) for data in (found, faded))
    assert soft < 0.5 * step


def test_stations_from_a_table(tmp_path) -> None:
    surface = hills()
    rows = stations(surface, lambda x, y, z: 9 - 0.004 * z, 5)
    for separator in (",", ";"):
        path = tmp_path / "stations.csv"
        path.write_text(
            "\n".join(["east,north,altitude,t".replace(",", separator)] + [separator.join(map(str, r)) for r in rows])
        )
        np.testing.assert_allclose(temperature(surface, table=path).data, 9 - 0.004 * surface.data, atol=1e-3)
    path.write_text("east,north,altitude,t\n1,2,3,4\n1,2,x,4\n")
    with pytest.raises(ValueError, match=r"row 3 of 'stations\.csv' is no station"):
        temperature(surface, table=path)
    path.write_text("east,north,altitude,t\n")
    with pytest.raises(ValueError, match="holds no stations"):
        temperature(surface, table=path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="no text in UTF-8"):
        temperature(surface, table=path)


def test_stations_that_do_not_suffice() -> None:
    surface = hills()
    zones = Labels(np.repeat([[0] * 15 + [1] * 15], 20, axis=0).astype(np.int32), surface.extent)
    three = ((100.0, 100.0, 300.0, 1.0), (200.0, 900.0, 500.0, 2.0), (2900.0, 100.0, 500.0, 2.0))
    with pytest.raises(ValueError, match=r"1 station of zone 1 cannot say .* give 2 at least"):
        temperature(surface, zones, stations=three)
    with pytest.raises(ValueError, match="different altitudes"):
        temperature(surface, stations=((0.0, 0.0, 300.0, 1.0), (9.0, 9.0, 300.0, 2.0)))
    along = tuple((float(k), float(2 * k), float(k * k), 5.0) for k in range(5))
    with pytest.raises(ValueError, match="not along one line"):
        precipitation(surface, stations=along, trend="altitude_and_place")
    with pytest.raises(ValueError, match="unlink the zones"):
        temperature(surface, zones)
    with pytest.raises(ValueError, match="degrees"):
        temperature(DEGREES, stations=three)
    with pytest.raises(ValueError, match="do not match"):
        temperature(surface, Labels(np.zeros((3, 3), np.int32), surface.extent), stations=three)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), shift=st.floats(-1e6, 6e6))
def test_the_regression_is_that_of_the_normal_equations(seed: int, shift: float) -> None:
    rng = np.random.default_rng(seed)
    table = np.column_stack([rng.random((9, 2)) * 1e5 + shift, rng.random(9) * 3000, rng.random(9) * 1000])
    found = fit([tuple(row) for row in table.tolist()], "altitude_and_place")
    design = np.column_stack([np.ones(9), table[:, 2], table[:, :2] - table[:, :2].mean(axis=0)])
    wanted = np.linalg.lstsq(design, table[:, 3], rcond=None)[0]
    assume(np.linalg.cond(design / np.abs(design).max(axis=0)) < 1e4)
    np.testing.assert_allclose([found.altitude, found.east, found.north], wanted[1:], rtol=1e-6, atol=1e-9)


# Precipitation.


def test_gradients_of_altitude_and_place() -> None:
    surface = hills()
    x, y = middles(surface)
    found = precipitation(surface, base=900, altitude_gradient=60, east_gradient=25, north_gradient=-40).data
    wanted = 900 + 0.6 * surface.data + 25 * (x - 1500) / 1000 - 40 * (y - 1000) / 1000
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    measured = stations(surface, lambda x, y, z: 300 + 0.5 * z + 0.02 * x - 0.03 * y, 9)
    found = precipitation(surface, stations=tuple(measured), trend="altitude_and_place").data
    np.testing.assert_allclose(found, 300 + 0.5 * surface.data + 0.02 * x - 0.03 * y, rtol=1e-4)


@settings(max_examples=15, deadline=None)
@given(direction=st.floats(0, 360), base=st.floats(0, 500), hours=st.floats(0, 5000))
def test_it_is_never_negative_and_voids_stay_void(direction: float, base: float, hours: float) -> None:
    surface = hills()
    for params in (
        {"method": "linear", "rain_hours": hours},
        {"method": "upslope", "smoothing": 150.0},
        {"altitude_gradient": -200.0, "east_gradient": 500.0},
    ):
        found = precipitation(surface, base=base, wind_direction=direction, **params).data
        assert (np.isnan(found) == np.isnan(surface.data)).all()
        assert np.nanmin(found) >= 0


def ridge(
    cols: int = 512, rows: int = 8, cell: float = 500.0, width: float = 8000.0, height: float = 800.0
) -> np.ndarray:
    x = (np.arange(cols) - cols // 2) * cell
    return np.broadcast_to(height * np.exp(-((x / width) ** 2)), (rows, cols)).copy()


def test_the_linear_theory_by_quadrature_of_its_integral() -> None:
    """A Gaussian ridge across the wind: the inverse Fourier integral summed up directly, wave by wave."""
    height, width, cell = 800.0, 8000.0, 500.0
    air, speed, tau = moist_air(7, 5.0), 12.0, (900.0, 1100.0)
    found = linear_precipitation(ridge(4096, 4), (cell, cell), (speed, 0.0), air, *tau)[0]
    k = np.linspace(-8 / width, 8 / width, 80001)
    k = k[np.abs(k) > 1e-15]
    sigma = speed * k
    squared = air.stability**2 / speed**2 - k**2
    m = np.where(squared > 0, np.sign(sigma) * np.sqrt(np.abs(squared)), 1j * np.sqrt(np.abs(squared)))
    transform = height * width * np.sqrt(np.pi) * np.exp(-((k * width / 2) ** 2))
    spectrum = air.sensitivity * 1j * sigma * transform
    spectrum /= (1 - 1j * m * air.scale_height) * (1 + 1j * sigma * tau[0]) * (1 + 1j * sigma * tau[1])
    for column in range(2048 - 80, 2048 + 120, 20):
        x = (column - 2048) * cell
        wanted = float(np.real(np.trapezoid(spectrum * np.exp(1j * k * x), k)) / (2 * np.pi))
        assert found[column] == pytest.approx(wanted, abs=2e-3 * np.abs(found).max())
    # Rain falls on the windward side and over the crest; the lee is dry.
    assert found[2048 - 16] > 0 > found[2048 + 60]


def test_without_depth_and_delay_it_is_the_upslope_model() -> None:
    rows, cols = np.indices((64, 96))
    heights = 400 * np.cos(2 * np.pi * (3 * cols / 96 + 2 * rows / 64))
    air = moist_air(7, 5.0)
    shallow = type(air)(air.sensitivity, 0.0, air.stability)
    wind = wind_vector(240, 9.0)
    found = linear_precipitation(heights, (200.0, 300.0), wind, shallow, 0.0, 0.0)
    phase = -400 * np.sin(2 * np.pi * (3 * cols / 96 + 2 * rows / 64)) * 2 * np.pi
    rise = wind[0] * phase * 3 / (96 * 200) - wind[1] * phase * 2 / (64 * 300)
    np.testing.assert_allclose(found, air.sensitivity * rise, atol=1e-9)


def test_the_linear_theory_keeps_the_mean_and_turns_with_the_wind() -> None:
    rng = np.random.default_rng(4)
    # Odd numbers of cells: on even ones the shortest wave runs either way.
    heights = np.cumsum(rng.normal(0, 5, (49, 65)), axis=1)
    air = moist_air(10, 5.0)
    found = linear_precipitation(heights, (500.0, 500.0), wind_vector(250, 10), air, 1000, 800)
    assert abs(found.mean()) < 1e-12 * np.abs(found).max() * found.size
    # A turned world rains as before, turned.
    turned = linear_precipitation(np.rot90(heights, -1), (500.0, 500.0), wind_vector(340, 10), air, 1000, 800)
    np.testing.assert_allclose(turned, np.rot90(found, -1), atol=1e-12)
    # Twice the hills, twice the rain.
    np.testing.assert_allclose(
        linear_precipitation(2 * heights, (500.0, 500.0), wind_vector(250, 10), air, 1000, 800), 2 * found, atol=1e-12
    )


def test_padding_keeps_rain_from_coming_in_on_the_other_side() -> None:
    cell, air = (500.0, 500.0), moist_air(7, 5.0)
    small = ridge(160, 40)
    wide = ridge(2048, 40)
    params = (wind_vector(270, 12), air, 1000.0, 1000.0)
    around, inside = padded(small.astype(np.float32), cell, 80000)
    assert np.abs(around[inside] - small).max() < 1e-3
    # Nothing jumps where the surface meets itself.
    assert np.abs(around[:, 0] - around[:, -1]).max() < 5
    assert np.abs(around[0] - around[-1]).max() < 5
    wanted = linear_precipitation(wide, cell, *params)[20, 1024 - 80 : 1024 + 80]
    # As wide as the ridge runs north and south, the middle row is the same as of an endless one.
    tall, rows = padded(ridge(160, 400).astype(np.float32), cell, 80000)
    found = linear_precipitation(tall, cell, *params)[rows][200]
    assert np.abs(found - wanted).max() < 0.05 * np.abs(wanted).max()


def test_moist_air_of_the_paper() -> None:
    air = moist_air(7, 5.0)
    # Their usual values are 2.5 km, 0.005 1/s and 0.004 to 0.02 kg/m3.
    assert air.scale_height == pytest.approx(2900, rel=0.01)
    assert air.stability == pytest.approx(0.0047, rel=0.02)
    assert air.sensitivity == pytest.approx(0.0087, rel=0.02)
    assert moist_air(7, 5.6).stability < 0.0015
    with pytest.raises(ValueError, match="not stable"):
        moist_air(25, 8.0)


def test_the_lee_is_dry_by_either_method() -> None:
    surface = Elevation(ridge(200, 60, 250.0, 6000.0, 1500.0).astype(np.float32), Extent(0, 0, 50000, 15000))
    for method in ("upslope", "linear"):
        west, east = (
            precipitation(
                surface, base=800, altitude_gradient=0, rain_hours=500, method=method, wind_direction=side
            ).data[30]
            for side in (270.0, 90.0)
        )
        assert west[80] > 850
        assert west[130] < 750
        np.testing.assert_allclose(west[20:180], east[::-1][19:179], rtol=0.02, atol=2)


def test_refused() -> None:
    with pytest.raises(ValueError, match="degrees"):
        precipitation(DEGREES)
    with pytest.raises(ValueError, match="not stable"):
        precipitation(hills(), method="linear", air_temperature=25, air_lapse_rate=9.0)
    with pytest.raises(ValueError, match="infinite"):
        precipitation(Elevation(np.full((3, 3), np.inf, np.float32), Extent(0, 0, 3, 3)))


# Wetness.


def test_wetness_of_a_plane_is_the_formula() -> None:
    rows, _ = np.indices((30, 12))
    surface = Elevation((1000 - 3.0 * rows).astype(np.float32), Extent(0, 0, 120, 300))
    area = drainage_area(surface)
    assert type(area) is DrainageArea
    found = wetness(surface, area).data
    # Row k drains k + 1 cells of 100 m2 over 10 m of contour; the slope is 0.3.
    wanted = np.log((np.arange(30) + 1) * 100 / 10 / 0.3)
    np.testing.assert_allclose(found[:, 6], wanted, rtol=1e-4)


def test_wetness_of_level_ground_is_bounded() -> None:
    surface = Elevation(np.zeros((6, 8), np.float32), Extent(0, 0, 80, 60))
    area = Raster(np.full((6, 8), 500, np.float32), surface.extent)
    np.testing.assert_allclose(wetness(surface, area, least_slope=0.01).data, math.log(500 / 10 / 0.01), rtol=1e-6)


def test_wetness_refuses() -> None:
    surface = Elevation(np.zeros((6, 8), np.float32), Extent(0, 0, 80, 60))
    with pytest.raises(ValueError, match="Slope in deg; link a drainage area in m2"):
        wetness(surface, Slope(np.ones((6, 8), np.float32), surface.extent))
    data = np.ones((6, 8), np.float32)
    data[2, 3] = 0
    with pytest.raises(ValueError, match="row 2, column 3 is 0 m2"):
        wetness(surface, Raster(data, surface.extent))
    with pytest.raises(ValueError, match="degrees"):
        wetness(DEGREES, Raster(np.ones((4, 5), np.float32), DEGREES.extent))
    with pytest.raises(ValueError, match="do not match"):
        wetness(surface, Raster(np.ones((5, 8), np.float32), surface.extent))


# The sheet of maps.


def test_a_sheet_shows_every_quantity_and_its_voids() -> None:
    from nodegraph_texture.draw_quantities import draw_quantities

    surface = hills()
    warm, rain = temperature(surface), precipitation(surface)
    sheet = draw_quantities(surface, warm, rain, title="Climate", width=300)
    one = draw_quantities(surface, warm, columns=1, width=300)
    assert sheet.shape[1] > 2 * 300
    assert one.shape[1] > 300
    inside = sheet.data[70:200, 20:300].reshape(-1, 3)
    # Warm is red and cold is blue, and voids are grey.
    assert (inside[:, 0] > inside[:, 2].astype(int) + 60).mean() > 0.1
    assert (inside[:, 2] > inside[:, 0].astype(int) + 30).mean() > 0.1
    assert (inside == 153).all(axis=1).any()
    with pytest.raises(ValueError, match="nothing to draw"):
        draw_quantities(surface)
