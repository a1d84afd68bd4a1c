from __future__ import annotations

import math
import threading
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph.errors import Cancelled
from nodegraph_terrain import hillshade as module
from nodegraph_terrain.hillshade import hillshade
from nodegraph_terrain.raster import Elevation, Extent, Shade
from nodegraph_terrain.sample_dem import sample_dem

DEFAULTS: dict[str, Any] = {
    "azimuth": 315.0,
    "altitude": 45.0,
    "z_factor": 1.0,
    "mode": "single",
    "cast_shadows": False,
}


def ground(data: np.ndarray, cell: tuple[float, float] = (1.0, 1.0)) -> Elevation:
    rows, cols = data.shape
    return Elevation(np.asarray(data, np.float32), Extent(0, 0, cols * cell[0], rows * cell[1]))


def plane(shape: tuple[int, int], east: float, north: float) -> np.ndarray:
    rows, cols = np.indices(shape)
    return 1000 + east * cols - north * rows


def hills(shape: tuple[int, int], voids: float = 0.0, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows, cols = np.indices(shape)
    data = 40 * np.sin(rows / 5 + seed) * np.cos(cols / 7) + rng.normal(0, 3, shape)
    data[rng.random(shape) < voids] = np.nan
    return data.astype(np.float32)


def on_device(surface: Elevation, device: Any, **params: Any) -> np.ndarray:
    assert hillshade.twin is not None
    given = surface.like(device.from_host(surface.data))
    result = hillshade.twin.function(given, **{**DEFAULTS, **params}, context=Context(device=device))
    assert type(result) is Shade
    return device.to_host(result.data)


def towards(azimuth: float, altitude: float) -> np.ndarray:
    turn, height = math.radians(azimuth), math.radians(altitude)
    return np.array([math.sin(turn) * math.cos(height), math.cos(turn) * math.cos(height), math.sin(height)])


@given(
    east=st.floats(-2, 2),
    north=st.floats(-2, 2),
    azimuth=st.floats(0, 360),
    altitude=st.floats(0, 90),
    z_factor=st.floats(0.1, 5),
)
def test_planes_by_lambert(east: float, north: float, azimuth: float, altitude: float, z_factor: float) -> None:
    normal = np.array([-z_factor * east, -z_factor * north, 1])
    expected = max(0.0, normal @ towards(azimuth, altitude) / np.linalg.norm(normal))
    given = hillshade(ground(plane((5, 6), east, north)), azimuth=azimuth, altitude=altitude, z_factor=z_factor)
    assert type(given) is Shade
    np.testing.assert_allclose(given.data, expected, atol=2e-3)


@given(east=st.floats(-2, 2), north=st.floats(-2, 2), altitude=st.floats(0, 90))
def test_several_lights_by_mark(east: float, north: float, altitude: float) -> None:
    normal = np.array([-east, -north, 1]) / math.hypot(east, north, 1)
    expected = 0.0
    for azimuth in (225, 270, 315, 360):
        facing = math.atan2(-east, -north)
        weight = math.sin(facing - math.radians(azimuth)) ** 2 if math.hypot(east, north) > 1e-3 else 0.5
        expected += 0.5 * weight * max(0.0, normal @ towards(azimuth, altitude))
    given = hillshade(ground(plane((4, 4), east, north)), altitude=altitude, mode="multidirectional").data
    # Where the ground is nearly level its direction is noise, and all lights give nearly the same.
    np.testing.assert_allclose(given, expected, atol=2e-3 if math.hypot(east, north) > 1e-2 else 2e-2)


def test_level_ground_and_voids() -> None:
    data = np.full((6, 6), 10.0)
    data[2, 3] = np.nan
    for mode in ("single", "multidirectional"):
        for cast in (False, True):
            given = hillshade(ground(data), altitude=30.0, mode=mode, cast_shadows=cast).data
            assert np.isnan(given[2, 3])
            assert np.isnan(given).sum() == 1
            np.testing.assert_allclose(given[~np.isnan(data)], 0.5, atol=1e-6)


@pytest.mark.parametrize("azimuth", [0, 90, 180, 270])
@pytest.mark.parametrize("altitude", [20.0, 45.0])
def test_the_shadow_of_a_wall_is_as_long_as_its_height_says(azimuth: int, altitude: float) -> None:
    cell, wall = 2.0, 25.0
    data = np.zeros((61, 61))
    # The light comes from `azimuth`; the shadow falls the other way.
    line = {0: (20, slice(None)), 180: (40, slice(None)), 90: (slice(None), 40), 270: (slice(None), 20)}[azimuth]
    data[line] = wall
    given = hillshade(ground(data, (cell, cell)), azimuth=azimuth, altitude=altitude, cast_shadows=True).data
    profile = {0: given[21:, 30], 180: given[:40, 30][::-1], 90: given[30, :40][::-1], 270: given[30, 21:]}[azimuth]
    distance = cell * np.arange(1, len(profile) + 1)
    shadow = wall / math.tan(math.radians(altitude))
    blur = 2 * shadow * math.radians(0.2665) / math.sin(math.radians(altitude)) / math.cos(math.radians(altitude))
    assert (profile[distance < shadow - blur] == 0).all()
    np.testing.assert_allclose(profile[distance > shadow + blur], math.sin(math.radians(altitude)), atol=1e-5)


def test_the_shadow_of_a_needle_points_away_from_the_light() -> None:
    data = np.zeros((41, 41))
    data[20, 20] = 30.0
    given = hillshade(ground(data), azimuth=315.0, altitude=45.0, cast_shadows=True).data
    assert given[30, 30] == 0
    for i, j in ((10, 10), (10, 30), (30, 10), (38, 25)):
        assert given[i, j] == pytest.approx(math.sin(math.pi / 4), abs=1e-5)


def horizon_by_hand(data: np.ndarray, i: int, j: int, azimuth: float, cell: tuple[float, float]) -> float:
    """Tangent of the horizon from one cell: heights where the ray crosses each grid line, one after the other."""
    east, north = math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))
    rows, cols = data.shape
    highest = -math.inf
    for direction, step, own, other in ((-north, cell[1], 0, 1), (east, cell[0], 1, 0)):
        if abs(direction) < 1e-12:
            continue
        for k in range(1, max(rows, cols)):
            away = k * step / abs(direction)
            place = [i - away * north / cell[1], j + away * east / cell[0]]
            place[own] = round(place[own])
            low = math.floor(place[other] + 1e-6)
            share = place[other] - low if place[other] - low > 1e-6 else 0.0
            ends = []
            for at in (low, low + 1) if share else (low,):
                spot = [0, 0]
                spot[own], spot[other] = int(place[own]), at
                inside = 0 <= spot[0] < rows and 0 <= spot[1] < cols
                ends.append(float(data[spot[0], spot[1]]) if inside else math.nan)
            height = ends[0] if not share else ends[0] * (1 - share) + ends[1] * share
            if not math.isnan(height):
                highest = max(highest, (height - float(data[i, j])) / away)
    return highest


@pytest.mark.parametrize("azimuth", [0.0, 45.0, 90.0, 133.0, 200.0, 315.0, 351.0])
@pytest.mark.parametrize("voids", [0.0, 0.1])
def test_shadows_agree_with_a_walk_along_the_ray(azimuth: float, voids: float) -> None:
    cell, altitude, z_factor = (3.0, 4.0), 25.0, 1.5
    data = hills((19, 26), voids, seed=3)
    surface = ground(data, cell)
    params = {"azimuth": azimuth, "altitude": altitude, "z_factor": z_factor}
    plain = hillshade(surface, **params).data
    given = hillshade(surface, **params, cast_shadows=True).data
    low, high = (math.tan(math.radians(altitude + side * 0.2665)) for side in (-1, 1))
    for (i, j), height in np.ndenumerate(data):
        if math.isnan(height):
            assert math.isnan(given[i, j])
            continue
        horizon = z_factor * horizon_by_hand(data, i, j, azimuth, cell)
        share = min(max((high - horizon) / (high - low), 0.0), 1.0)
        assert given[i, j] == pytest.approx(share * plain[i, j], abs=2e-3)


@pytest.mark.parametrize("altitude", [0.0, 0.2, 90.0, 89.8])
@pytest.mark.parametrize("mode", ["single", "multidirectional"])
def test_extreme_lights_give_finite_shades(altitude: float, mode: str, device: Any) -> None:
    surface = ground(hills((30, 21)))
    host = hillshade(surface, altitude=altitude, mode=mode, cast_shadows=True).data
    assert ((host >= 0) & (host <= 1)).all()
    np.testing.assert_allclose(
        on_device(surface, device, altitude=altitude, mode=mode, cast_shadows=True), host, atol=1e-4
    )


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 2), (17, 33), (33, 17), (8, 8), (40, 70)])
@pytest.mark.parametrize("mode", ["single", "multidirectional"])
@pytest.mark.parametrize("cast_shadows", [False, True])
@pytest.mark.parametrize("voids", [0.0, 0.25])
def test_the_twin_agrees(device: Any, shape: tuple[int, int], mode: str, cast_shadows: bool, voids: float) -> None:
    surface = ground(hills(shape, voids), (2.0, 3.0))
    params = {"azimuth": 293.0, "altitude": 22.0, "z_factor": 1.3, "mode": mode, "cast_shadows": cast_shadows}
    host, twin = hillshade(surface, **params).data, on_device(surface, device, **params)
    assert np.array_equal(np.isnan(host), np.isnan(twin))
    np.testing.assert_allclose(twin, host, atol=1e-4)


def test_the_twin_agrees_in_bands_and_on_voids_alone(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    surface = ground(hills((50, 40)))
    whole = on_device(surface, device, cast_shadows=True)
    monkeypatch.setattr(module, "WORK", 50_000)
    assert np.array_equal(on_device(surface, device, cast_shadows=True), whole)
    nothing = ground(np.full((5, 9), np.nan))
    for params in ({}, {"cast_shadows": True}, {"mode": "multidirectional"}):
        assert np.isnan(hillshade(nothing, **params).data).all()
        assert np.isnan(on_device(nothing, device, **params)).all()


def test_long_shadows_stop_within_a_second_when_cancelled() -> None:
    stop = threading.Event()
    surface = ground(20 * hills((1500, 1500)))
    timer = threading.Timer(0.3, stop.set)
    started = time.monotonic()
    timer.start()
    with pytest.raises(Cancelled):
        hillshade(surface, altitude=1.0, cast_shadows=True, context=Context(cancelled=stop))
    assert time.monotonic() - started < 1.3


def test_north_west_faces_of_real_ridges_are_lit() -> None:
    # Cells of 3 arc-seconds at 36.6 degrees north.
    surface = ground(sample_dem().data, (74.4, 92.6))
    given = hillshade(surface, z_factor=2.0).data
    east = np.gradient(surface.data, 74.4, axis=1)
    north = -np.gradient(surface.data, 92.6, axis=0)
    towards_light = east - north > 0.15  # rises away from the light, so it faces north-west
    away = east - north < -0.15
    assert given[towards_light].mean() > given[away].mean() + 0.3


def test_refuses_degrees() -> None:
    with pytest.raises(ValueError, match=r"terrain\.reproject"):
        hillshade(sample_dem())
