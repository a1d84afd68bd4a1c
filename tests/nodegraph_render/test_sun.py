"""The sun: where it stands by place and time, against published places."""

from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np
import pytest

from nodegraph_render.sun import _apparent, moment, position, sun
from nodegraph_terrain.georeference import parse_crs, transformed
from nodegraph_terrain.raster import Elevation, Extent


def apart(first: tuple[float, float], second: tuple[float, float]) -> float:
    """The angle between two (azimuth, altitude), degrees."""

    def unit(place: tuple[float, float]) -> np.ndarray:
        azimuth, altitude = np.radians(place)
        return np.array([np.cos(altitude) * np.sin(azimuth), np.cos(altitude) * np.cos(azimuth), np.sin(altitude)])

    return float(np.degrees(np.linalg.norm(unit(first) - unit(second))))


def test_the_worked_example_of_meeus():
    # Example 25.a: 1992 October 13, 0 h dynamical time; true ascension 198.38083, declination -7.78507 degrees.
    ascension, declination = _apparent(-0.072183436)
    # Here the nutation in ascension is taken off, as mean sidereal time goes with it.
    nutation = -0.00478 * np.sin(np.radians(264.65)) * np.cos(np.radians(23.44))
    assert (ascension + nutation) % 360 == pytest.approx(198.38083, abs=2e-4)
    assert declination == pytest.approx(-7.78507, abs=2e-5)


def test_the_worked_example_of_the_solar_position_algorithm():
    # Reda and Andreas 2004 (doi:10.1016/j.solener.2003.12.003), table A5.1: topocentric azimuth 194.34024 and
    # elevation without refraction 39.872046, at Golden, Colorado.
    found = position(moment("2003-10-17T12:30:30-07:00"), 39.742476, -105.1786, refraction=False)
    assert apart(found, (194.34024, 39.872046)) < 0.01


@pytest.mark.parametrize(
    ("time", "declination"),
    # Solstices and equinoxes to the minute (U.S. Naval Observatory), where the declination is known.
    [
        ("2000-03-20T07:35Z", 0.0),
        ("2000-06-21T01:48Z", 23.438),
        ("2024-03-20T03:06Z", 0.0),
        ("2024-12-21T09:21Z", -23.438),
        ("2024-06-20T20:51Z", 23.438),
        ("2024-09-22T12:44Z", 0.0),
    ],
)
def test_the_declination_at_solstices_and_equinoxes(time, declination):
    # At a pole the sun is as high as its declination.
    assert position(moment(time), 90.0, 0.0, refraction=False)[1] == pytest.approx(declination - 0.0024, abs=0.006)


def test_noon_moves_with_the_equation_of_time():
    # Extremes of the equation of time: -14 min 15 s about 11 February, +16 min 25 s about 3 November.
    for day, minutes in (("2023-02-11", -14.25), ("2023-11-03", 16.42)):
        noon = datetime.fromisoformat(f"{day}T12:00+00:00") - timedelta(minutes=minutes)
        before, after = (position(noon + timedelta(minutes=m), 45.0, 0.0)[0] for m in (-0.15, 0.15))
        assert before < 180 < after


def test_zones_are_the_same_moment():
    first, second = (
        position(moment(text), 46.0, 7.5) for text in ("2024-06-21T10:00:00Z", "2024-06-21T12:00:00+02:00")
    )
    assert first == second


def test_refraction_lifts_the_rising_sun():
    time = moment("2024-03-20T06:05:00Z")
    low, seen = (position(time, 0.0, 0.0, refraction=flag)[1] for flag in (False, True))
    assert abs(low) < 2
    assert 0.2 < seen - low < 0.6


def test_altitude_is_continuous_where_the_formula_of_refraction_changes():
    from nodegraph_render.sun import _raised

    for altitude in (85.0, 5.0, -0.575):
        assert _raised(altitude - 1e-9) == pytest.approx(_raised(altitude + 1e-9), abs=5e-3)


def test_the_place_of_a_raster_is_its_centre_and_north_its_own():
    degrees = Elevation(np.zeros((20, 20), np.float32), Extent(7.0, 46.0, 8.0, 47.0, "EPSG:4326", "deg"))
    time = "2024-06-21T15:30:00+02:00"
    found = sun(degrees, time=time)
    assert (found.azimuth, found.altitude) == pytest.approx(position(moment(time), 46.5, 7.5))
    # Central meridian 1.5 degrees east: true north is 1.5 sin 46.5 = 1.09 degrees east of grid north.
    x, y = transformed(parse_crs("EPSG:4326"), parse_crs("EPSG:32632"), np.array([7.5]), np.array([46.5]))
    extent = Extent(x[0] - 500, y[0] - 500, x[0] + 500, y[0] + 500, "EPSG:32632")
    turned = sun(Elevation(np.zeros((2, 2), np.float32), extent), time=time)
    assert turned.altitude == pytest.approx(found.altitude, abs=1e-6)
    assert turned.azimuth - found.azimuth == pytest.approx(1.5 * np.sin(np.radians(46.5)), abs=0.01)


def test_by_angles():
    assert (sun().azimuth, sun().altitude) == (315.0, 35.0)
    made = sun(azimuth=90.0, altitude=0.0, diameter=0.0)
    assert made.direction == pytest.approx((1, 0, 0), abs=1e-12)
    assert made.diameter == 0


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"time": "2024-06-21T12:00"}, "no zone"),
        ({"time": "noon"}, "no date"),
        ({"time": "1500-06-21T12:00Z"}, "1900 to 2100"),
        ({"time": "2024-06-21T12:00Z"}, "nothing says where"),
        ({"time": "2024-06-21T12:00Z", "latitude": 3.0}, "belong together"),
        ({"time": "2024-06-21T12:00Z", "azimuth": 3.0}, "leave out azimuth"),
        ({"latitude": 3.0, "longitude": 3.0}, "need a time"),
    ],
)
def test_what_says_nothing_of_the_sun_is_refused(params, message):
    with pytest.raises(ValueError, match=message):
        sun(**params)
