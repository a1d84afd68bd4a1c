"""Contour primitives: outlines, sectors, bounds, OpenCL, and the ready lakes, mesas and craters."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import codec
from nodegraph_terrain.raster import Extent
from nodegraph_tree.basic import Plane
from nodegraph_tree.contour import Contour, contour
from nodegraph_tree.disc import disc
from nodegraph_tree.function import THRESHOLD, Points, numeric_gradient
from nodegraph_tree.landform import crater, lake, mesa
from nodegraph_tree.replace import replace

sys.path.insert(0, str(Path(__file__).parent))  # tests are no package
from strategies import CENTRE, Window, grid, on_device, windows

SLACK = 1 + 1e-6
X0, Y0 = CENTRE
EXTENT = Extent(X0 - 600, Y0 - 600, X0 + 600, Y0 + 600)


@pytest.fixture(scope="module")
def device() -> Any:
    from nodegraph.opencl import choose

    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


_SECTIONS = [
    ((0.0, 5.0),),
    ((0.0, 5.0), (0.5, 20.0), (1.0, -10.0)),
    ((0.0, 5.0), (0.3, 0.0), (0.9, 60.0), (1.3, 10.0)),
]
_CONTOURS: st.SearchStrategy[Contour] = st.builds(
    lambda **given: contour(**given),
    centre=st.tuples(st.floats(-300, 300), st.floats(-300, 300)).map(
        lambda p: (X0 + round(p[0], 2), Y0 + round(p[1], 2))
    ),
    radius=st.floats(20, 400) | st.lists(st.floats(100, 300), min_size=1, max_size=9).map(tuple),
    height=st.floats(-100, 500),
    direction=st.floats(-400, 400),
    sections=st.lists(st.sampled_from(_SECTIONS), min_size=1, max_size=4).map(tuple),
    shape=st.sampled_from(["smooth", "straight"]),
    core=st.sampled_from([0.0, 0.5, 1.0]),
    reach=st.sampled_from([1.2, 2.0]),
    fall_off=st.sampled_from(["wyvill", "cubic", "quintic", "plateau"]),
)


@settings(max_examples=80, deadline=None)
@given(_CONTOURS, windows())
def test_values_and_slopes_stay_within_bounds(tree: Contour, window: Window) -> None:
    sample = tree.query(window.points, gradient=True)
    bounds = tree.bounds(window.box)
    here, ground = sample.weight > 0, sample.weight >= THRESHOLD
    assert sample.height[here].min(initial=np.inf) >= bounds.low - 1e-6
    assert sample.height[here].max(initial=-np.inf) <= bounds.high + 1e-6
    assert sample.weight.max() <= bounds.weight_high + 1e-9
    assert sample.weight.min() >= bounds.weight_low - 1e-9
    assert sample.height_gradient is not None
    assert sample.weight_gradient is not None
    steep, turned = np.hypot(*sample.height_gradient), np.hypot(*sample.weight_gradient)
    assert steep[here].max(initial=0) <= bounds.support_slope * SLACK + 1e-9
    assert steep[ground].max(initial=0) <= bounds.slope * SLACK + 1e-9
    assert (sample.weight * steep).max() <= bounds.flux * SLACK + 1e-9
    assert turned.max() <= bounds.weight_slope * SLACK + 1e-9


@settings(max_examples=40, deadline=None)
@given(_CONTOURS, st.integers(0, 2**20))
def test_heights_have_no_steps_and_gradients_match(tree: Contour, seed: int) -> None:
    dice = np.random.default_rng(seed)
    box = tree.support
    x, y = dice.uniform(box.west, box.east, 2000), dice.uniform(box.south, box.north, 2000)
    y[:500] = tree.y  # across the direction where angles begin, more or less
    x[:200] = tree.x + dice.normal(0, 1e-3, 200)
    one, two = tree.query(Points(x, y), gradient=True), tree.query(Points(x + 1e-4, y - 1e-4))
    on = (one.weight > 0) & (two.weight > 0)
    bounds = tree.bounds(box)
    assert np.abs(one.height - two.height)[on].max(initial=0) <= 1.5e-4 * bounds.support_slope + 1e-8
    f, a = numeric_gradient(tree, Points(x, y), 1e-4)
    assert one.height_gradient is not None
    assert one.weight_gradient is not None
    far = np.hypot(x - tree.x, y - tree.y) > 1
    wrong = np.hypot(*(f - one.height_gradient)) > 1e-4 * (1 + bounds.support_slope)
    assert wrong[far & (one.weight > 1e-6)].mean() < 0.01
    assert (np.hypot(*(a - one.weight_gradient))[far] > 1e-5).mean() < 0.01


@settings(max_examples=15, deadline=None)
@given(_CONTOURS)
def test_the_device_agrees(device: Any, tree: Contour) -> None:
    height, weight = on_device(tree, EXTENT, (96, 96), device)
    sample = tree.query(grid(EXTENT, (96, 96)))
    np.testing.assert_allclose(weight, sample.weight, atol=2e-5)
    there = (sample.weight > THRESHOLD + 1e-4) & (weight >= THRESHOLD)
    np.testing.assert_allclose(height[there], sample.height[there], atol=0.005)


def test_storage_keeps_everything() -> None:
    tree = contour(centre=CENTRE, radius=(100.0, 150.0, 120.0), sections=tuple(_SECTIONS), direction=20.0)
    codec.seal(tree)
    assert codec.seal(codec.decode(codec.encode(tree))) == codec.seal(tree)


def test_a_contour_goes_through_its_points_and_sections_lie_at_their_angles() -> None:
    points = ((100, 0), (80, 90), (0, 120), (-90, 60), (-100, -50), (0, -80), (90, -70))
    for given_points in (points, points[::-1]):
        tree = contour(points=given_points, sections=(((0, 0), (1, 10)),), core=1.0, reach=1.4)
        x, y = np.array(points, float).T
        sample = tree.query(Points(x, y))
        np.testing.assert_allclose(sample.height, 10, atol=1e-9)
        np.testing.assert_allclose(sample.weight, 1)
    four = contour(
        radius=100.0, direction=30.0, angles=(0.0, 90.0), sections=(((0, 0), (1, 10)), ((0, 0), (1, 20))), height=5.0
    )
    angle = np.radians([30.0, 120.0, 75.0])
    np.testing.assert_allclose(four.query(Points(100 * np.cos(angle), 100 * np.sin(angle))).height, [15, 25, 20])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"radius": 0.0}, "greater than 0"),
        ({"radius": ()}, "greater than 0"),
        ({"core": 2.0}, "less than reach"),
        ({"points": ((1, 0), (0, 1))}, "three"),
        ({"points": ((1, 0), (0, 1), (float("nan"), 0))}, "three finite"),
        ({"points": ((10, 0), (20, 0), (15, 9))}, "go round once"),
        ({"points": ((10, 0), (0, 10), (0, 0), (0, -10))}, "through its centre"),
        ({"sections": ()}, "empty"),
        ({"sections": (((0, 0),), ((0, 1),))}, "same height at the centre"),
        ({"sections": (((-1, 0), (1, 0)),)}, "not be negative"),
        ({"angles": (0.0, 1.0)}, "as many"),
        ({"sections": (((0, 0),),) * 2, "angles": (9.0, 5.0)}, "rise"),
    ],
)
def test_what_makes_no_contour_is_refused(change: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        contour(**change)


def test_lakes_mesas_and_craters(device: Any) -> None:
    ground = Plane(100.0 - 0.01 * X0, 0.01, 0.0)
    water = lake(ground, centre=CENTRE, radius=150.0)
    low = mesa(centre=(X0 + 250, Y0 - 200), radius=120.0, height=95.0, rise=60.0)
    pits = [
        crater(ground, centre=(X0 - 250 + 90 * k, Y0 + 250), radius=80.0, seed=k, peak=0.3 * (k % 2)) for k in range(3)
    ]
    scene = replace(ground, [water, low, *pits])
    height, _ = on_device(scene, EXTENT, (160, 160), device)
    points = grid(EXTENT, (160, 160))
    np.testing.assert_allclose(height, scene.query(points).height, atol=0.01)
    assert isinstance(water, Contour)
    assert water.height < 100
    assert water.query(Points(np.array([X0]), np.array([Y0]))).height[0] == pytest.approx(water.height - 15)
    assert low.query(Points(np.array([X0 + 250.0]), np.array([Y0 - 200.0]))).height[0] == pytest.approx(155)
    bowl = crater(centre=(0.0, 0.0), radius=100.0, unevenness=0.0, depth=0.4, rim=0.08, height=0.0)
    sample = bowl.query(Points(np.array([0.0, 100.0, 200.0]), np.zeros(3)))
    np.testing.assert_allclose(sample.height, [-32, 8, 1], atol=0.1)
    with pytest.raises(ValueError, match="leaves its terrain"):
        lake(disc(centre=CENTRE, radius=100.0), centre=CENTRE)
