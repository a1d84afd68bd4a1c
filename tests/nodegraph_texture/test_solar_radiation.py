from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph.opencl import choose, to_device
from nodegraph_terrain.hillshade import hillshade
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_texture.horizon import whole_horizon
from nodegraph_texture.quantities import Irradiation, Radiation
from nodegraph_texture.solar_radiation import solar_radiation
from nodegraph_texture.sun_path import SOLAR_CONSTANT, days_between, declination_and_distance, sun_path


def ground(heights: np.ndarray, cell: float = 10.0) -> Elevation:
    rows, cols = heights.shape
    return Elevation(heights.astype(np.float32), Extent(0, 0, cols * cell, rows * cell))


def plane(east: float, north: float, height: float = 0.0) -> Elevation:
    rows, cols = np.indices((7, 9))
    return ground(height + 10 * (east * (cols - 4) - north * (rows - 3)))


def orbit(day: int) -> tuple[float, float]:
    """Declination and inverse squared distance at noon of a day of 2000, from the elements of the orbit (Meeus)."""
    anomaly = math.radians(357.529 + 0.98560028 * (day - 1))
    true = anomaly + math.radians(1.9146 * math.sin(anomaly) + 0.02 * math.sin(2 * anomaly))
    distance = (1 - 0.01671**2) / (1 + 0.01671 * math.cos(true))
    return math.asin(math.sin(math.radians(23.439)) * math.sin(true + math.radians(282.94))), 1 / distance**2


def spencer(day: float) -> tuple[float, float]:
    declination, distance = declination_and_distance(np.array(float(day)))
    return float(declination), float(distance)


def daily(latitude: float, day: float) -> float:
    """The mean of a day on level ground without air, in closed form (Iqbal 1983), W/m2."""
    phi, (delta, distance) = math.radians(latitude), spencer(day)
    cosine = -math.tan(phi) * math.tan(delta)
    half = 0.0 if cosine >= 1 else math.pi if cosine <= -1 else math.acos(cosine)
    lit = half * math.sin(phi) * math.sin(delta) + math.cos(phi) * math.cos(delta) * math.sin(half)
    return SOLAR_CONSTANT * distance / math.pi * lit


def tilted(latitude: float, day: int, east: float, north: float) -> float:
    """The mean of a day on a plane without air, by quadrature over the hour angle, W/m2."""
    phi = math.radians(latitude)
    delta, distance = spencer(day)
    hour = (np.arange(100000) + 0.5) / 100000 * 2 * np.pi - np.pi
    up = math.sin(phi) * math.sin(delta) + math.cos(phi) * math.cos(delta) * np.cos(hour)
    x = -math.cos(delta) * np.sin(hour)
    y = math.cos(phi) * math.sin(delta) - math.sin(phi) * math.cos(delta) * np.cos(hour)
    facing = (up - east * x - north * y) / math.sqrt(1 + east * east + north * north)
    return float(SOLAR_CONSTANT * distance * np.mean(np.where(up > 0, np.maximum(facing, 0), 0)))


def of(surface: Elevation, **params) -> float:
    found = solar_radiation(surface, **{"transmittance": 1.0, **params}).radiation
    return float(found.data[surface.shape[0] // 2, surface.shape[1] // 2])


@pytest.mark.parametrize("latitude", [0.0, 23.0, 36.4, 46.0, 60.0, 66.0, 80.0, 90.0, -33.0, -75.0])
@pytest.mark.parametrize("day", [1, 60, 110, 172, 230, 300, 355])
def test_a_day_on_level_ground_is_the_closed_formula(latitude: float, day: int) -> None:
    expected = daily(latitude, day)
    assert of(plane(0, 0), latitude=latitude, first_day=day, last_day=day) == pytest.approx(
        expected, rel=1e-3, abs=1e-3
    )


def test_the_sun_is_where_its_orbit_has_it() -> None:
    for day in range(1, 366, 7):
        # Leap years move a date by up to three quarters of a day, and the sun by 0.3 degrees.
        assert math.degrees(spencer(day)[0]) == pytest.approx(math.degrees(orbit(day)[0]), abs=0.3)
        assert spencer(day)[1] == pytest.approx(orbit(day)[1], abs=1e-3)


def test_the_year_and_polar_nights() -> None:
    surface = plane(0, 0)
    expected = np.mean([daily(46, day) for day in range(1, 366)])
    assert of(surface, latitude=46) == pytest.approx(expected, rel=2e-3)
    night = solar_radiation(surface, latitude=75, first_day=340, last_day=10)
    assert (night.radiation.data == 0).all()
    assert (night.irradiation.data == 0).all()
    # On the pole the sun circles at the height of its declination.
    delta, distance = spencer(172)
    expected = SOLAR_CONSTANT * distance * math.sin(delta)
    assert of(surface, latitude=90, first_day=172, last_day=172) == pytest.approx(expected, rel=2e-3)


@settings(max_examples=40, deadline=None)
@given(
    latitude=st.floats(-85, 85),
    day=st.integers(1, 365),
    steepness=st.floats(0, 1.5),
    facing=st.floats(0, 2 * math.pi),
    shadows=st.booleans(),
)
def test_tilted_planes(latitude: float, day: int, steepness: float, facing: float, shadows: bool) -> None:
    east, north = steepness * math.sin(facing), steepness * math.cos(facing)
    found = of(plane(east, north), latitude=latitude, first_day=day, last_day=day, cast_shadows=shadows)
    assert found == pytest.approx(tilted(latitude, day, east, north), abs=3.0, rel=0.01)


def test_a_south_face_gets_more_in_the_north_by_the_factor_of_tilted_planes() -> None:
    for latitude, day in ((46.0, 80), (36.0, 355), (60.0, 120)):
        # The ground rises northwards: it faces south.
        south, north = (of(plane(0, rise), latitude=latitude, first_day=day, last_day=day) for rise in (0.5, -0.5))
        expected = tilted(latitude, day, 0, 0.5) / tilted(latitude, day, 0, -0.5)
        assert south / north == pytest.approx(expected, rel=0.01)
        assert expected > 1.2
    south, north = (of(plane(0, rise), latitude=-46, first_day=80, last_day=80) for rise in (0.5, -0.5))
    assert south < north


def test_at_an_equinox_a_plane_gets_what_level_ground_does_where_it_is_level() -> None:
    # Facing south by its slope, a plane has the day of level ground so much farther south, while the sun is up.
    lat, slope = 50.0, 20.0
    tilt = of(plane(0, math.tan(math.radians(slope))), latitude=lat, first_day=80, last_day=80)
    assert tilt == pytest.approx(of(plane(0, 0), latitude=lat - slope, first_day=80, last_day=80), rel=0.005)


def test_energy_is_power_times_time() -> None:
    rng = np.random.default_rng(1)
    surface = ground(100 * rng.random((12, 15)))
    for first, last in ((1, 365), (172, 172), (355, 20)):
        found = solar_radiation(surface, latitude=46, first_day=first, last_day=last)
        days = len(days_between(first, last))
        assert type(found.radiation) is Radiation
        assert type(found.irradiation) is Irradiation
        np.testing.assert_allclose(found.irradiation.data, found.radiation.data * 24 * days / 1000, rtol=1e-5)
    assert len(days_between(355, 20)) == 31
    assert len(days_between(1, 365)) == 365


def test_parts_of_a_year_add_up() -> None:
    surface = plane(0.3, 0.2)
    whole = solar_radiation(surface, latitude=46).irradiation.data
    parts = [
        solar_radiation(surface, latitude=46, first_day=a, last_day=b).irradiation.data
        for a, b in ((1, 100), (101, 365))
    ]
    np.testing.assert_allclose(whole, parts[0] + parts[1], rtol=1e-5)


def test_air_dims_by_its_mass_and_less_on_mountains() -> None:
    # At the equator at noon of an equinox the mass is 1: a day's mean lies below the transmittance, above its cube.
    clear, dimmed = (of(plane(0, 0), latitude=0, first_day=80, last_day=80, transmittance=t) for t in (1.0, 0.7))
    assert 0.7**2 * clear < dimmed < 0.7 * clear
    high = of(plane(0, 0, 4000), latitude=0, first_day=80, last_day=80, transmittance=0.7)
    path = sun_path(0, 80, 80, 1)
    mass = 1 / (np.sin(np.radians(path.altitude)) + 0.50572 * (path.altitude + 6.07995) ** -1.6364)
    share = (1 - 2.25577e-5 * 4000) ** 5.25588
    expected = (path.energy * np.sin(np.radians(path.altitude)) * 0.7 ** (mass * share)).sum() / 24
    assert high == pytest.approx(expected, rel=2e-3)
    assert dimmed < high < clear


def test_cast_shadows_are_those_of_rays_followed_sun_by_sun() -> None:
    """`terrain.hillshade` follows one ray to each sun; a day's suns summed up must give the same as the horizons."""
    rows, cols = np.indices((48, 60))
    surface = ground(300 * np.exp(-((rows - 30) ** 2 + (cols - 25) ** 2) / 60) + 250 * (cols > 52) + 2 * rows, 30.0)
    first = 330
    found = solar_radiation(
        surface, latitude=46, first_day=first, last_day=first, transmittance=1, directions=180, step=1
    ).radiation.data
    path = sun_path(46, first, first, 12)
    traced = np.zeros(surface.shape)
    for azimuth, altitude, energy in zip(path.azimuth, path.altitude, path.energy, strict=True):
        traced += energy * hillshade(surface, azimuth=azimuth, altitude=altitude, cast_shadows=True).data
    traced /= 24
    open_sky = solar_radiation(
        surface, latitude=46, first_day=first, last_day=first, transmittance=1, cast_shadows=False
    )
    shadowed = open_sky.radiation.data - traced
    assert (shadowed > 20).mean() > 0.1
    # Twelve minutes between suns move the ends of shadows by up to three degrees.
    assert np.abs(found - traced).mean() < 0.01 * traced.mean()
    assert np.quantile(np.abs(found - traced), 0.99) < 0.05 * traced.mean()
    assert found.mean() == pytest.approx(traced.mean(), rel=0.005)


def test_a_horizon_is_the_angle_to_the_highest_ground() -> None:
    heights = np.zeros((40, 200), np.float32)
    heights[:, 150] = 500
    found = whole_horizon(heights, 90.0, (10.0, 10.0), Context())
    distance = 10.0 * (150 - np.arange(200))
    near = (distance > 0) & (distance <= 640)
    np.testing.assert_allclose(found[:, near], np.broadcast_to(500 / distance[near], (40, near.sum())), rtol=1e-5)
    far = distance > 640
    # Coarser looks come at most one step, a thirty-second of the way, too close.
    assert (found[:, far] / (500 / distance[far]) >= 1 - 1 / 32).all()
    assert (found[:, far] / (500 / distance[far]) <= 1 + 1 / 16).all()
    assert (found[:, 151:] == 0).all()


def test_horizons_of_rough_ground_are_those_of_every_crossing(monkeypatch) -> None:
    from nodegraph_texture import horizon as module

    rng = np.random.default_rng(2)
    heights = np.cumsum(np.cumsum(rng.normal(0, 1, (150, 220)), axis=0), axis=1).astype(np.float32)
    heights[20:30, 40:60] = np.nan
    for azimuth in (0.0, 37.0, 200.0, 315.0):
        quick = np.degrees(np.arctan(whole_horizon(heights, azimuth, (20.0, 30.0), Context())))
        with monkeypatch.context() as patch:
            patch.setattr(module, "NEAR", 1 << 20)
            exact = np.degrees(np.arctan(whole_horizon(heights, azimuth, (20.0, 30.0), Context())))
        assert np.abs(quick - exact).mean() < 0.3
        assert np.median(np.abs(quick - exact)) < 0.01


def test_an_even_sky_on_planes_and_in_a_pit() -> None:
    # A plane sees (1 + cos slope) / 2 of it (Liu and Jordan 1963).
    share, slope = 0.2, math.radians(40)
    params = {"latitude": 46.0, "first_day": 172, "last_day": 172, "directions": 64}
    level, tilt = plane(0, 0), plane(0, math.tan(slope))
    beam = of(level, **params)
    assert of(level, diffuse_share=share, **params) == pytest.approx(beam / (1 - share), rel=2e-3)
    added = of(tilt, diffuse_share=share, **params) - of(tilt, **params)
    assert added == pytest.approx(beam * share / (1 - share) * (1 + math.cos(slope)) / 2, rel=5e-3)


def test_meridian_convergence_turns_the_sun() -> None:
    # West of a zone's middle in the north, true north lies east of the grid's: 1.4 degrees or so here.
    from nodegraph_terrain.place import centre_of, true_north
    from nodegraph_texture.place import centre_latitude

    extent = Extent(300000.0, 5100000.0, 300090.0, 5100070.0, "EPSG:32632")
    bearing = true_north(extent)
    assert bearing == pytest.approx(math.degrees(math.tan(math.radians(2.59)) * math.sin(math.radians(46.0))), abs=0.05)
    assert centre_latitude(extent, None) == pytest.approx(46.02, abs=0.02)
    assert centre_of(extent) == pytest.approx((6.41, 46.02), abs=0.02)


def test_voids_stay_void_and_hide_nothing() -> None:
    heights = np.zeros((9, 9))
    heights[2:4, 3:6] = np.nan
    found = solar_radiation(ground(heights), latitude=46).radiation.data
    assert (np.isnan(found) == np.isnan(heights)).all()
    np.testing.assert_allclose(found[~np.isnan(heights)], found[0, 0], rtol=1e-5)
    assert np.isnan(solar_radiation(ground(np.full((4, 5), np.nan)), latitude=46).irradiation.data).all()


PARAMS = {"latitude": 46.0, "first_day": 300, "last_day": 60, "step": 10.0, "transmittance": 0.75, "cast_shadows": True,
          "directions": 16, "diffuse_share": 0.0}  # fmt: skip


def on_device(surface: Elevation, **params: Any) -> tuple[np.ndarray, np.ndarray]:
    device = choose("auto")
    if device is None:
        pytest.skip("no OpenCL device")
    assert solar_radiation.twin is not None
    given = to_device(surface, device)
    found = solar_radiation.twin.function(given, **{**PARAMS, **params}, context=Context(device=device))
    return device.to_host(found.radiation.data), device.to_host(found.irradiation.data)


def rough(rows: int, cols: int, voids: float = 0.0) -> Elevation:
    rng = np.random.default_rng(rows)
    heights = 400 + np.cumsum(np.cumsum(rng.normal(0, 1, (rows, cols)), axis=0), axis=1)
    heights[rng.random((rows, cols)) < voids] = np.nan
    return ground(heights, 30.0)


@pytest.mark.parametrize("shape", [(150, 171), (5, 300), (40, 3), (1, 1), (1, 9)])
@pytest.mark.parametrize("params", [{}, {"diffuse_share": 0.2}, {"cast_shadows": False, "first_day": 172}])
def test_the_twin_agrees(shape: tuple[int, int], params: dict[str, Any]) -> None:
    surface = rough(*shape, voids=0.02 if min(shape) > 4 else 0.0)
    host = solar_radiation(surface, **{**PARAMS, **params})
    for found, expected in zip(on_device(surface, **params), host, strict=True):
        assert np.array_equal(np.isnan(found), np.isnan(expected.data))
        np.testing.assert_allclose(found, expected.data, rtol=2e-4, atol=2e-3)


def test_the_twin_in_bands_in_a_polar_night_and_on_voids_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    surface = rough(60, 80)
    whole = on_device(surface)
    monkeypatch.setattr("nodegraph_texture.solar_opencl.WORK", 1 << 18)
    for found, expected in zip(on_device(surface), whole, strict=True):
        assert np.array_equal(found, expected)
    for share in (0.0, 0.1):
        night = on_device(surface, latitude=85.0, first_day=340, last_day=10, diffuse_share=share)
        assert (night[0] == 0).all()
        assert np.isnan(on_device(ground(np.full((6, 9), np.nan)), diffuse_share=share)[0]).all()
    with pytest.raises(ValueError, match="infinite"):
        on_device(ground(np.full((4, 5), np.inf)))


def test_bad_input() -> None:
    degrees = Elevation(np.zeros((4, 5), np.float32), Extent(8, 46, 9, 47, "EPSG:4326", "deg"))
    with pytest.raises(ValueError, match=r"degrees; link it through terrain\.reproject"):
        solar_radiation(degrees)
    with pytest.raises(ValueError, match="give the latitude"):
        solar_radiation(plane(0, 0))
    with pytest.raises(ValueError, match="infinite"):
        solar_radiation(ground(np.full((4, 5), np.inf)), latitude=3)
