from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_texture.quantities import Precipitation, Radiation, SnowCover, Temperature
from nodegraph_texture.snow_cover import positive_part, snow_cover
from nodegraph_texture.snow_slide import holding, slide

EXTENT = Extent(0, 0, 300, 200)
FLAT = Elevation(np.full((20, 30), 500, np.float32), EXTENT)


def even(kind, value: float):
    return kind(np.full((20, 30), value, np.float32), EXTENT)


def hills(seed: int = 0, relief: float = 1.0) -> Elevation:
    rng = np.random.default_rng(seed)
    i, j = np.indices((20, 30))
    return Elevation(
        (relief * (800 + 90 * np.sin(i / 3) * np.cos(j / 4)) + rng.random((20, 30))).astype(np.float32), EXTENT
    )


def test_a_balance_followed_day_by_day_with_drawn_weather() -> None:
    """An independent balance: what 2,000 draws of each day snow and could melt in the mean, day by day."""
    mean, swing, sigma, rain, factor = 1.0, 10.0, 4.0, 1200.0, 4.5
    rng = np.random.default_rng(1)
    season = mean + swing * np.cos(2 * np.pi * (np.arange(365) + 0.5) / 365)
    drawn = season[:, None] + sigma * rng.standard_normal((365, 2000))
    snow, melt = np.where(drawn < 1, rain / 365, 0).mean(axis=1), factor * np.maximum(drawn, 0).mean(axis=1)
    lying, covers = 0.0, []
    for day in range(3 * 365):
        lying = max(lying + snow[day % 365] - melt[day % 365], 0)
        if day >= 2 * 365:
            covers.append(np.tanh(1.26 * lying / 40))
    found = snow_cover(
        FLAT, even(Temperature, mean), even(Precipitation, rain), amplitude=swing, warmest_day=200.0, variability=sigma
    ).data[0, 0]
    assert found == pytest.approx(np.mean(covers), abs=0.015)
    for turn in (30, 120, 182, 250, 300):
        day = (200 + turn - 1) % 365.2422 + 1
        on = snow_cover(
            FLAT, even(Temperature, mean), even(Precipitation, rain), amplitude=swing, warmest_day=200.0, day=day
        ).data[0, 0]
        assert on == pytest.approx(covers[turn], abs=0.12)


@given(mean=st.floats(-30, 30), sigma=st.floats(0.1, 10))
def test_positive_degrees_are_the_integral(mean: float, sigma: float) -> None:
    t = np.linspace(mean - 9 * sigma, mean + 9 * sigma, 20001)
    density = np.exp(-(((t - mean) / sigma) ** 2) / 2) / (sigma * np.sqrt(2 * np.pi))
    wanted = np.trapezoid(np.maximum(t, 0) * density, t)
    assert float(positive_part(np.array(mean), sigma)) == pytest.approx(wanted, abs=1e-4 * max(sigma, 1))


def test_cold_is_covered_and_warmth_is_bare() -> None:
    params = {"amplitude": 8.0, "warmest_day": 200.0}
    temperatures = np.linspace(-25, 25, 30)
    warmth = Temperature(np.broadcast_to(temperatures, (20, 30)).astype(np.float32), EXTENT)
    found = snow_cover(FLAT, warmth, **params).data[3]
    assert found[0] > 0.99
    assert found[-1] < 0.01
    assert (np.diff(found) <= 1e-6).all()
    # In the south the year is turned.
    winter, summer = (
        snow_cover(FLAT, even(Temperature, 2), latitude=lat, amplitude=10.0, day=25.0).data[0, 0]
        for lat in (46.0, -46.0)
    )
    assert winter > 0.9
    assert summer < 0.01


def test_rain_feeds_it_and_sun_melts_it() -> None:
    params = {"amplitude": 10.0, "warmest_day": 200.0}
    warmth = even(Temperature, 3)
    little, much = (snow_cover(FLAT, warmth, even(Precipitation, r), **params).data[0, 0] for r in (300, 2500))
    assert little < much
    dim, bright = (snow_cover(FLAT, warmth, radiation=even(Radiation, r), **params).data[0, 0] for r in (50, 300))
    assert bright < dim
    # 1.8 + 0.0144 I is 4.5 at 187.5 W/m2.
    np.testing.assert_allclose(
        snow_cover(FLAT, warmth, radiation=even(Radiation, 187.5), **params).data,
        snow_cover(FLAT, warmth, **params).data,
        atol=1e-5,
    )
    assert (snow_cover(FLAT, warmth, yearly_precipitation=0, **params).data < 1e-3).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), relief=st.floats(0.1, 8), depth=st.floats(0, 8000))
def test_sliding_loses_no_snow_and_empties_only_what_is_too_steep(seed: int, relief: float, depth: float) -> None:
    surface = hills(seed, relief)
    rng = np.random.default_rng(seed)
    snow = (depth * rng.random((20, 30))).astype(np.float32)
    gradient = np.gradient(surface.data.astype(np.float64), 10)
    slope = np.degrees(np.arctan(np.hypot(*gradient))).astype(np.float32)
    found = slide(snow, surface.data, slope, 300.0, (10.0, 10.0), Context())
    assert found.sum(dtype=np.float64) == pytest.approx(snow.sum(dtype=np.float64), rel=1e-5)
    assert (found >= 0).all()
    assert (found >= np.minimum(snow, holding(slope, 300.0)) * (1 - 1e-6) - 1e-3).all()
    # What still holds too much has nowhere lower to go.
    i, j = np.nonzero(found > holding(slope, 300.0) + 0.1)
    for row, col in zip(i, j, strict=True):
        around = surface.data[max(0, row - 1) : row + 2, max(0, col - 1) : col + 2]
        assert surface.data[row, col] == around.min()


def test_snow_slides_off_a_wall_to_its_foot() -> None:
    rows, _ = np.indices((20, 30))
    heights = np.where(rows < 10, 1000.0 - 17.0 * rows, 830.0 - 0.5 * (rows - 10)).astype(np.float32)
    wall = Elevation(heights, EXTENT)
    params = {"amplitude": 10.0, "warmest_day": 200.0, "yearly_precipitation": 3000.0}
    with_it, without = (
        snow_cover(wall, even(Temperature, 0), sliding=sliding, **params).data[:, 15] for sliding in (True, False)
    )
    assert with_it[5] < without[5] - 0.05
    assert with_it[10:12].max() > without[10:12].max()
    dense = snow_cover(wall, even(Temperature, 0), density=500.0, **params).data[:, 15]
    assert with_it[5] < dense[5] <= without[5]
    # The shape of the snow that a slope of 45 degrees holds: 1.58 m.
    assert float(holding(np.array([45.0], np.float32), 300.0)[0]) / 300 == pytest.approx(1.58, abs=0.01)


def test_voids_and_what_is_refused() -> None:
    heights = FLAT.data.copy()
    heights[2:5, 3:6] = np.nan
    warmth = even(Temperature, 0).data.copy()
    warmth[10, 10] = np.nan
    surface = Elevation(heights, EXTENT)
    found = snow_cover(surface, Temperature(warmth, EXTENT), latitude=46.0)
    assert type(found) is SnowCover
    assert (np.isnan(found.data) == (np.isnan(heights) | np.isnan(warmth))).all()
    known = found.data[~np.isnan(found.data)]
    assert known.min() >= 0
    assert known.max() <= 1
    # Without a temperature it is the standard atmosphere's.
    standard = snow_cover(FLAT, latitude=46.0).data
    np.testing.assert_allclose(standard, snow_cover(FLAT, even(Temperature, 11.75), latitude=46.0).data, atol=1e-6)
    with pytest.raises(ValueError, match="precipitation is below 0"):
        snow_cover(FLAT, None, even(Precipitation, -1), latitude=46.0)
    with pytest.raises(ValueError, match="give the latitude"):
        snow_cover(FLAT)
    with pytest.raises(ValueError, match="do not match"):
        snow_cover(FLAT, Temperature(np.zeros((3, 4), np.float32), EXTENT), latitude=46.0)
    degrees = Elevation(np.zeros((4, 5), np.float32), Extent(8, 46, 9, 47, "EPSG:4326", "deg"))
    with pytest.raises(ValueError, match="degrees"):
        snow_cover(degrees)
