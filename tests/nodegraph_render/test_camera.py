"""Cameras: where they stand, what they show, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from nodegraph_render.camera import Camera, angle_of, camera, fitted
from nodegraph_terrain.raster import Elevation, Extent

BOX = (500_000.0, 4_000_000.0, 503_000.0, 4_001_000.0)
EXTENT = Extent(*BOX, "EPSG:32632")
Y, X = np.mgrid[0:20, 0:60].astype(np.float32)
GROUND = Elevation(500 + 10 * X + 3 * Y, EXTENT)
ASPECT = 16 / 9


def seen(view: Camera, points: np.ndarray, aspect: float) -> np.ndarray:
    """Where points are in the picture: -1 to 1 is inside, across and up; and how far ahead they are."""
    right, up, forward = view.axes
    apart = points - np.array(view.eye)
    ahead = apart @ forward
    half = np.tan(np.radians(view.field_of_view) / 2) * ahead if view.field_of_view else view.span / 2
    return np.stack([apart @ right / half / aspect, apart @ up / half, ahead], axis=1)


def corners(box, low, high):
    west, south, east, north = box
    return np.array([(x, y, z) for x in (west, east) for y in (south, north) for z in (low, high)])


@settings(max_examples=60, deadline=None)
@given(
    azimuth=st.floats(-360, 360),
    pitch=st.floats(-90, 90),
    roll=st.floats(-180, 180),
    angle=st.sampled_from([0.0, 3.0, 45.0, 120.0]),
    aspect=st.floats(0.3, 4),
    margin=st.sampled_from([0.0, 0.01, 0.2]),
    high=st.floats(500, 9000),
)
@example(azimuth=9.0, pitch=0.0, roll=0.0, angle=120.0, aspect=4.0, margin=0.0, high=500.0)  # from a corner of the box
def test_a_fitted_camera_shows_the_whole_box_and_touches_the_frame(azimuth, pitch, roll, angle, aspect, margin, high):
    view = fitted(BOX, 500.0, high, azimuth, pitch, roll, angle, aspect, margin)
    found = seen(view, corners(BOX, 500.0, high), aspect)
    assert (found[:, 2] > 0).all()
    widest = np.abs(found[:, :2]).max()
    assert widest == pytest.approx(1 - 2 * margin, abs=1e-6)
    # It looks where it should.
    heading, down = np.radians([azimuth, pitch])
    towards = [np.cos(down) * np.sin(heading), np.cos(down) * np.cos(heading), -np.sin(down)]
    assert view.axes[2] == pytest.approx(np.array(towards), abs=1e-6)


@pytest.mark.parametrize("orthographic", [False, True])
def test_the_box_comes_from_the_linked_elevation(orthographic):
    view = camera(GROUND, azimuth=30.0, pitch=40.0, orthographic=orthographic)
    found = seen(view, corners(BOX, float(GROUND.data.min()), float(GROUND.data.max())), ASPECT)
    assert 0.98 <= np.abs(found[:, :2]).max() <= 1
    stated = camera(
        extent=BOX,
        low=float(GROUND.data.min()),
        high=float(GROUND.data.max()),
        azimuth=30.0,
        pitch=40.0,
        orthographic=orthographic,
    )
    assert (stated.eye, stated.target, stated.span) == (view.eye, view.target, view.span)


def test_straight_down_north_is_up():
    view = camera(GROUND, pitch=90.0, orthographic=True)
    right, up, forward = view.axes
    assert right == pytest.approx([1, 0, 0], abs=1e-9)
    assert up == pytest.approx([0, 1, 0], abs=1e-9)
    assert forward == pytest.approx([0, 0, -1], abs=1e-9)
    placed = camera(eye=(0, 0, 100), target=(0, 0, 0))
    assert placed.axes[1] == pytest.approx([0, 1, 0])


@pytest.mark.parametrize(
    ("length", "angle"),
    # Vertical angles of view of a 36 mm x 24 mm frame, as makers of lenses state them.
    [(14, 81.2), (24, 53.1), (35, 37.8), (50, 27.0), (85, 16.1), (200, 6.9)],
)
def test_focal_lengths_are_those_of_35_mm_film(length, angle):
    assert angle_of(length) == pytest.approx(angle, abs=0.06)
    view = camera(eye=(0, 0, 0), target=(0, 1, 0), focal_length=float(length))
    assert view.field_of_view == pytest.approx(angle, abs=0.06)


def test_roll_turns_the_camera_clockwise():
    level = camera(eye=(0, 0, 0), target=(0, 10, -3))
    rolled = camera(eye=(0, 0, 0), target=(0, 10, -3), roll=90.0)
    assert rolled.axes[1] == pytest.approx(level.axes[0])
    assert camera(GROUND, roll=90.0).axes[1] == pytest.approx(camera(GROUND).axes[0])


@settings(max_examples=30, deadline=None)
@given(rows=st.integers(1, 40), first=st.integers(0, 39), count=st.integers(1, 40), flat=st.booleans())
def test_a_band_has_the_rays_of_its_rows(rows, first, count, flat):
    first, last = min(first, rows - 1), min(first + count, rows)
    last = max(last, first + 1)
    view = Camera((1, 2, 30), (40, 50, 3), field_of_view=0.0 if flat else 70.0, span=90.0, rise=0.3)
    whole, band = view.rays(rows, 7, first, last), view.band(rows, first, last).rays(last - first, 7)
    assert band.direction == pytest.approx(whole.direction, abs=1e-9)
    assert band.origin == pytest.approx(whole.origin, abs=1e-9)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"eye": (1, 2, 3), "target": (1, 2, 3)}, "same point"),
        ({"eye": (1, 2, 3)}, "eye and target"),
        ({}, "nothing to fit"),
        ({"extent": (0, 0, 1, 1), "low": 0.0}, "nothing to fit"),
        ({"extent": (1, 0, 0, 1), "low": 0.0, "high": 1.0}, "east > west"),
        ({"extent": (0, 0, 1, 1), "low": 2.0, "high": 1.0}, "above the highest"),
        ({"eye": (1, 2, 3), "target": (1, 2, 4), "low": 3.0}, "not fitted"),
        ({"eye": (1, 2, 3), "target": (1, 2, 4), "orthographic": True}, "needs a span"),
        ({"eye": (1, 2, 3), "target": (1, 2, 4), "span": 3.0, "focal_length": 50.0}, "no field of view"),
        ({"extent": (0, 0, 1, 1), "low": 0.0, "high": 1.0, "span": 3.0}, "finds its own span"),
        ({"field_of_view": 30.0, "focal_length": 50.0}, "one of them"),
        ({"eye": (1, 2, float("nan")), "target": (1, 2, 4)}, "finite"),
    ],
)
def test_what_makes_no_camera_is_refused(params, message):
    with pytest.raises(ValueError, match=message):
        camera(**params)


def test_a_camera_under_the_linked_ground_is_refused():
    x, y = 501_500.0, 4_000_500.0
    with pytest.raises(ValueError, match=r"under the ground, 8\d\d\.?\d* m high"):
        camera(GROUND, eye=(x, y, 600.0), target=(x, y + 100, 600.0))
    assert camera(GROUND, eye=(x, y, 900.0), target=(x, y + 100, 600.0)).eye[2] == 900
    assert camera(GROUND, eye=(0.0, 0.0, -5.0), target=(x, y, 0.0)).eye[2] == -5  # there is no ground


def test_rasters_that_cannot_be_fitted_are_refused():
    with pytest.raises(ValueError, match="void everywhere"):
        camera(Elevation(np.full((2, 2), np.nan, np.float32), EXTENT))
    with pytest.raises(ValueError, match="degrees"):
        camera(Elevation(np.zeros((2, 2), np.float32), Extent(7, 46, 8, 47, "EPSG:4326", "deg")))
