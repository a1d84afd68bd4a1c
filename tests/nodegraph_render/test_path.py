"""Paths of cameras: smooth, even, closed, and clear of the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph_render.camera_path import CameraPath
from nodegraph_render.path import KeyFrame, path
from nodegraph_render.sampling import bilinear
from nodegraph_render.turntable import turntable
from nodegraph_terrain.raster import Elevation, Extent

KEYS = [
    KeyFrame(2.0, (0, 0, 100), (100, 0, 0)),
    KeyFrame(3.0, (100, 0, 120), (200, 50, 0), 30.0),
    KeyFrame(6.0, (150, 200, 80), (300, 300, 0), 60.0),
    KeyFrame(7.0, (20, 120, 90), (100, 100, 0)),
]
LOOP = [*KEYS, replace(KEYS[0], time=9.0)]
EXTENT = Extent(-500.0, -500.0, 500.0, 500.0)
Y, X = np.mgrid[0:50, 0:50].astype(np.float32)
HILLS = Elevation(60 + 90 * np.sin(X / 3) * np.cos(Y / 4), EXTENT)


def eyes(course: CameraPath, count: int = 4001) -> np.ndarray:
    return course.at(np.linspace(0, course.duration, count))[:, :3]


@pytest.mark.parametrize("curve", ["smooth", "monotone"])
def test_a_path_passes_its_key_frames_at_their_times(curve):
    course = path(keys=KEYS, curve=curve)
    assert course.duration == 5
    for key in KEYS:
        view = course.camera(key.time - 2.0)
        assert view.eye == pytest.approx(key.eye)
        assert view.target == pytest.approx(key.target)
        assert view.field_of_view == pytest.approx(key.field_of_view)


@pytest.mark.parametrize("curve", ["smooth", "monotone"])
@pytest.mark.parametrize("options", [{}, {"constant_speed": True}, {"ease": 0.3}, {"ground": HILLS}])
@pytest.mark.parametrize("closed", [False, True])
def test_paths_are_c1(curve, options, closed):
    given = dict(options)
    ground = given.pop("ground", None)
    if curve == "monotone" and given.get("constant_speed"):
        pytest.skip("it stops where a coordinate turns in each")
    course = path(ground, keys=LOOP if closed else KEYS, curve=curve, closed=closed, **given)
    step = 1e-6
    inner = course.time[1:-1]
    for values in (course.at, course.velocity):
        assert values(inner - step) == pytest.approx(values(inner + step), abs=0.02)
    # The velocity is that of the places.
    middle = (course.time[1:] + course.time[:-1]) / 2
    measured = (course.at(middle + 1e-4) - course.at(middle - 1e-4)) / 2e-4
    assert measured == pytest.approx(course.velocity(middle), abs=1e-3 * np.abs(course.rates).max())
    if closed:
        assert course.at(0.0) == pytest.approx(course.at(course.duration))
        assert course.velocity(0.0) == pytest.approx(course.velocity(course.duration), abs=1e-6)


def test_monotone_paths_stay_between_their_key_frames():
    zs = [100.0, 100.0, 20.0, 20.0, 80.0]
    keys = [KeyFrame(float(n), (50.0 * n, 0, z), (50.0 * n, 90, 0)) for n, z in enumerate(zs)]
    level = eyes(path(keys=keys, curve="monotone"))[:, 2]
    assert level.min() == pytest.approx(20)
    assert level.max() == pytest.approx(100)
    assert eyes(path(keys=keys))[:, 2].min() < 19  # what it is there for


@settings(max_examples=20, deadline=None)
@given(
    st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9), st.integers(1, 9)), min_size=3, max_size=7, unique=True),
    st.booleans(),
)
def test_a_constant_speed_is_constant(places, closed):
    keys = [KeyFrame(float(n) ** 2, (100 * x, 100 * y, 100 * z), (5000, 0, 0)) for n, (x, y, z) in enumerate(places)]
    if closed:
        keys.append(replace(keys[0], time=50.0))
    try:
        course = path(keys=keys, closed=closed, constant_speed=True)
    except ValueError as error:
        assert "turn back" in str(error)  # noqa: PT017
        return
    way = np.linalg.norm(np.diff(eyes(course, 2001), axis=0), axis=1)
    knots = np.linalg.norm(course.rates[:, :3], axis=1)
    assert np.ptp(knots) <= 1e-6 * knots.mean()
    # Chords are shorter than arcs in sharp bends.
    assert np.percentile(way, 5) >= 0.98 * np.median(way)
    assert way.max() <= 1.02 * np.median(way)
    between = np.linalg.norm(course.velocity(np.linspace(0, course.duration, 20_001))[:, :3], axis=1)
    assert between == pytest.approx(np.full(20_001, knots.mean()), rel=1e-3)


def test_easing_starts_and_ends_at_rest_and_takes_the_same_time():
    plain, eased = path(keys=KEYS, constant_speed=True), path(keys=KEYS, constant_speed=True, ease=0.25)
    assert eased.duration == plain.duration
    assert eyes(eased)[[0, -1]] == pytest.approx(eyes(plain)[[0, -1]])
    assert np.abs(eased.velocity(np.array([0.0, 5.0]))).max() < 1e-9
    speed = np.linalg.norm(eased.velocity(np.linspace(0, 5, 401))[:, :3], axis=1)
    even = np.linalg.norm(plain.velocity(2.5)[:3])
    assert speed[100:300] == pytest.approx(np.full(200, even / 0.75), rel=2e-3)
    assert (np.diff(speed[:100]) > 0).all()


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("speed", [False, True])
def test_a_path_keeps_clear_of_the_ground(closed, speed):
    keys = [replace(key, eye=(key.eye[0] * 2, key.eye[1] * 2, key.eye[2])) for key in (LOOP if closed else KEYS)]
    free = path(keys=keys, closed=closed, constant_speed=speed)
    clear = path(HILLS, keys=keys, closed=closed, constant_speed=speed, clearance=25.0)

    def least(course: CameraPath) -> float:
        x, y, z = eyes(course, 20_001).T
        return float((z - bilinear(HILLS, x, y)).min())

    assert least(free) < 0
    assert least(clear) >= 25 - 1e-6
    # Only up, and no further than needed.
    raised = eyes(clear)[:, 2] - eyes(free)[:, 2]
    assert raised.min() >= -0.05
    assert raised.max() <= 25 - least(free) + 0.05
    assert eyes(clear)[:, :2] == pytest.approx(eyes(free)[:, :2], abs=0.01)


def test_beside_the_ground_nothing_is_raised():
    keys = [KeyFrame(0, (9000, 0, 5), (0, 0, 0)), KeyFrame(1, (9000, 99, 5), (0, 0, 0))]
    assert eyes(path(HILLS, keys=keys))[:, 2] == pytest.approx(5)


@pytest.mark.parametrize(
    ("keys", "options", "message"),
    [
        (KEYS[:1], {}, "two key frames"),
        ([KEYS[0], KEYS[0]], {}, "times increase"),
        ([KEYS[0], replace(KEYS[1], target=KEYS[1].eye)], {}, "eye and target"),
        ([KEYS[0], replace(KEYS[1], field_of_view=200.0)], {}, "field of view"),
        ([KEYS[0], replace(KEYS[1], time=float("nan"))], {}, "finite"),
        ([KEYS[0], replace(KEYS[1], eye=KEYS[0].eye)], {"constant_speed": True}, "one eye"),
        ([KEYS[0], KEYS[1], replace(KEYS[0], time=9)], {"constant_speed": True}, "turn back"),
        (KEYS, {"closed": True}, "repeats the first"),
        ([KeyFrame(0, (0, 0, 0), (10, 0, 0)), KeyFrame(2, (10, 0, 0), (0, 0, 0))], {}, "meets its target at 1"),
    ],
)
def test_what_makes_no_path_is_refused(keys, options, message):
    with pytest.raises(ValueError, match=message):
        path(keys=keys, **options)


@pytest.mark.parametrize(("turns", "closed"), [(1.0, True), (-2.0, True), (0.4, False)])
def test_a_turntable_goes_round_its_target(turns, closed):
    course = turntable(target=(10, 20, 30), distance=200.0, pitch=25.0, azimuth=90.0, turns=turns, duration=8.0)
    assert course.closed == closed
    apart = eyes(course) - np.array([10, 20, 30])
    assert np.linalg.norm(apart, axis=1) == pytest.approx(np.full(4001, 200.0), rel=1e-6)
    assert apart[:, 2] == pytest.approx(np.full(4001, 200 * np.sin(np.radians(25))))
    assert course.camera(0.0).axes[2][:2] == pytest.approx([np.cos(np.radians(25)), 0], abs=1e-9)
    heading = np.unwrap(np.arctan2(-apart[:, 0], -apart[:, 1]))
    assert heading[-1] - heading[0] == pytest.approx(2 * np.pi * turns)
    assert np.linalg.norm(course.velocity(np.linspace(0, 8, 99))[:, :3], axis=1) == pytest.approx(
        np.full(99, 200 * np.cos(np.radians(25)) * 2 * np.pi * abs(turns) / 8), rel=1e-4
    )


def test_a_turntable_shows_all_of_the_raster_all_the_way_round():
    course = turntable(HILLS, pitch=20.0, aspect=1.5)
    low, high = float(HILLS.data.min()), float(HILLS.data.max())
    corners = np.array([(x, y, z) for x in (-500, 500) for y in (-500, 500) for z in (low, high)])
    widest = []
    for time in np.linspace(0, course.duration, 90):
        view = course.camera(float(time))
        right, up, forward = view.axes
        apart = corners - np.array(view.eye)
        half = view.half_height * (apart @ forward)
        widest.append(max(np.abs(apart @ right / half / 1.5).max(), np.abs(apart @ up / half).max()))
    assert 0.96 <= max(widest) <= 1


def test_turntables_without_anything_to_go_round_are_refused():
    for options in ({}, {"target": (0, 0, 0)}, {"distance": 3.0}):
        with pytest.raises(ValueError, match="go around"):
            turntable(**options)
    with pytest.raises(ValueError, match="0 turns"):
        turntable(HILLS, turns=0.0)
