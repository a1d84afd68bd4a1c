"""Unions: the expected lowest of trees, its rounding, gradients, bounds and OpenCL."""

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
from nodegraph_tree.blend import blend
from nodegraph_tree.disc import Disc, Relief
from nodegraph_tree.function import EVERYWHERE, THRESHOLD, ElevationFunction, Points, box_around, numeric_gradient
from nodegraph_tree.replace import replace
from nodegraph_tree.union import Union, union

sys.path.insert(0, str(Path(__file__).parent))  # tests are no package
from strategies import CENTRE, PRIMITIVES, Window, grid, on_device, windows

X0, Y0 = CENTRE
EXTENT = Extent(X0 - 800, Y0 - 800, X0 + 800, Y0 + 800)
SLACK = 1 + 1e-6


@pytest.fixture(scope="module")
def device() -> Any:
    from nodegraph.opencl import choose

    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


def _disc(x: float, y: float, radius: float, height: float) -> Disc:
    return Disc(X0 + x, Y0 + y, radius, height, Relief("fbm", 40.0, 300.0, 2, seed=3), "cubic")


FOUR = [_disc(-100, 0, 500, 20), _disc(150, 80, 400, 35), _disc(0, -200, 600, 5), _disc(50, 250, 350, 60)]


def _unions() -> st.SearchStrategy[ElevationFunction]:
    sizes = st.tuples(st.sampled_from([0.01, 3.0, 40.0]), st.sampled_from([0.0, 20.0, 200.0]))
    return st.builds(
        lambda parts, size, upward: union(parts, near=size[0], far=size[0] + size[1], upward=upward),
        st.lists(st.one_of(PRIMITIVES), min_size=2, max_size=4),
        sizes,
        st.booleans(),
    )


@pytest.mark.parametrize("upward", [False, True])
def test_it_is_the_expected_lowest_of_those_that_are_there(upward: bool) -> None:
    points = grid(EXTENT, (41, 43))
    pair = [FOUR[0], FOUR[3]]
    parts = [part.query(points) for part in pair]
    found = union(pair, near=1e-9, far=1e-9, upward=upward).query(points)
    # Independently: every set of trees with its probability.
    total, height = np.zeros(len(points.x)), np.zeros(len(points.x))
    for there in ((True, False), (False, True), (True, True)):
        chance = np.prod([p.weight if t else 1 - p.weight for p, t in zip(parts, there, strict=True)], axis=0)
        heights = np.stack([p.height for p, t in zip(parts, there, strict=True) if t])
        total += chance
        height += chance * (heights.max(axis=0) if upward else heights.min(axis=0))
    np.testing.assert_allclose(found.weight, total, atol=1e-12)
    on = total > 1e-9
    np.testing.assert_allclose(found.height[on], height[on] / total[on], atol=1e-6)


def test_of_many_it_is_the_lowest_where_all_are_in_full_and_the_weight_that_of_any() -> None:
    points = grid(EXTENT, (41, 43))
    planes = [Plane(h - e * X0 - n * Y0, e, n) for h, e, n in ((5, 0.1, 0), (9, -0.05, 0.02), (0, 0, 0.2), (7, 0, 0))]
    lowest = np.min([part.query(points).height for part in planes], axis=0)
    found = union(planes, near=1e-9, far=1.0).query(points)
    np.testing.assert_allclose(found.height, lowest, atol=1e-6)
    none = np.prod([1 - part.query(points).weight for part in FOUR], axis=0)
    for order in ([0, 1, 2, 3], [3, 1, 0, 2]):
        found = union([FOUR[k] for k in order], near=2.0, far=20.0).query(points)
        np.testing.assert_allclose(found.weight, 1 - none, atol=1e-12)
        parts = np.array([part.query(points).height for part in FOUR])
        on = found.weight > 0
        there = np.array([part.query(points).weight > 0 for part in FOUR])
        assert (found.height >= np.where(there, parts, np.inf).min(axis=0) - 3 * 20.0 / 4 - 1e-9)[on].all()
        assert (found.height <= np.where(there, parts, -np.inf).max(axis=0) + 1e-9)[on].all()


def test_alone_it_changes_nothing_bit_for_bit() -> None:
    points = grid(EXTENT, (80, 80))
    parts = [part.query(points, gradient=True) for part in FOUR]
    found = union(FOUR, near=2.0, far=9.0).query(points, gradient=True)
    there = np.array([part.weight > 0 for part in parts])
    assert (there.sum(axis=0) == 1).sum() > 50
    for part, mine in zip(parts, there, strict=True):
        only = mine & (there.sum(axis=0) == 1)
        for a, b in zip(found, part, strict=True):
            assert a is not None
            assert b is not None
            assert np.array_equal(a[..., only], b[..., only])
    assert not found.weight[~there.any(axis=0)].any()
    assert union(FOUR[:1], near=1.0, far=1.0) is FOUR[0]


def test_weights_above_one_count_as_one(device: Any) -> None:
    ground = Plane(3.0, 0.0, 0.0)
    tree = union([blend([ground, ground]), FOUR[0]], near=1.0, far=2.0)
    sample = tree.query(grid(EXTENT, (20, 20)))
    assert (sample.weight == 1).all()
    bounds = tree.bounds(EVERYWHERE)
    assert bounds.weight_low == bounds.weight_high == 1
    height, weight = on_device(tree, EXTENT, (20, 20), device)
    assert (weight == 1).all()
    np.testing.assert_allclose(height, sample.height, atol=1e-3)


def test_where_both_are_there_it_is_their_smooth_minimum() -> None:
    one, two = Plane(10.0 - 0.1 * X0, 0.1, 0.0), Plane(10.0 + 0.1 * X0, -0.1, 0.0)
    x = X0 + np.linspace(-100, 100, 2001)
    points = Points(x, np.full(len(x), Y0))
    f, g = one.query(points).height, two.query(points).height
    for upward, sign in ((False, 1), (True, -1)):
        h = union([one, two], near=4.0, far=50.0, upward=upward).query(points).height
        assert np.abs(h - sign * np.minimum(sign * f, sign * g)).max() == pytest.approx(4.0 / 4)
        apart = np.abs(f - g) >= 4.0
        np.testing.assert_allclose(h[apart], sign * np.minimum(sign * f, sign * g)[apart], atol=1e-9)
        # The slope turns from 0.1 to -0.1 evenly over the 40 m in which they differ by less than 4 m.
        assert np.abs(np.diff(h, 2)).max() / 0.1**2 == pytest.approx(0.2 / 40, rel=1e-3)


def test_two_may_be_exchanged() -> None:
    points = grid(EXTENT, (60, 60))
    one, two = FOUR[0], FOUR[3]
    a, b = (union(pair, near=2.0, far=30.0).query(points) for pair in ([one, two], [two, one]))
    np.testing.assert_allclose(a.weight, b.weight, atol=1e-12)
    np.testing.assert_allclose(a.height, b.height, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(_unions(), windows())
def test_values_and_slopes_stay_within_bounds(tree: ElevationFunction, window: Window) -> None:
    sample = tree.query(window.points, gradient=True)
    detail = window.points.detail
    assert isinstance(detail, float)
    bounds = tree.bounds(window.box, detail)
    here, ground = sample.weight > 0, sample.weight >= THRESHOLD
    room = 1e-6 * (1 + np.abs(sample.height).max())
    assert sample.height[here].min(initial=np.inf) >= bounds.low - room
    assert sample.height[here].max(initial=-np.inf) <= bounds.high + room
    assert sample.weight.max() <= bounds.weight_high + 1e-9
    assert sample.weight.min() >= bounds.weight_low - 1e-9
    assert sample.height_gradient is not None
    assert sample.weight_gradient is not None
    steep, turned = np.hypot(*sample.height_gradient), np.hypot(*sample.weight_gradient)
    assert steep[ground].max(initial=0) <= bounds.slope * SLACK + 1e-6
    assert steep[here].max(initial=0) <= bounds.support_slope * SLACK + 1e-6
    assert (sample.weight * steep).max() <= bounds.flux * SLACK + 1e-6
    assert turned.max() <= bounds.weight_slope * SLACK + 1e-9


@settings(max_examples=25, deadline=None)
@given(st.booleans(), st.sampled_from([0.05, 6.0]), st.sampled_from([6.0, 90.0]), st.integers(0, 2**20))
def test_gradients_match_differences(upward: bool, near: float, far: float, seed: int) -> None:
    dice = np.random.default_rng(seed)
    tree = union(FOUR, near=near, far=far, upward=upward)
    points = Points(dice.uniform(X0 - 600, X0 + 600, 400), dice.uniform(Y0 - 600, Y0 + 600, 400))
    sample = tree.query(points, gradient=True)
    height, weight = numeric_gradient(tree, points, 1e-3)
    assert sample.height_gradient is not None
    solid = sample.weight > 1e-3
    # Coordinates of 150 km are 3e-11 m apart: differences over 2 mm are good to about 1e-7 / alpha.
    assert np.abs(height - sample.height_gradient)[:, solid].max() < 1e-3
    assert np.abs(weight - sample.weight_gradient).max() < 1e-5


def test_the_slope_is_bounded_closely() -> None:
    tree = union(FOUR[:2], near=5.0, far=40.0)
    for x in range(-300, 301, 100):
        window = grid(Extent(X0 + x, Y0, X0 + x + 10, Y0 + 10), (10, 10))
        slope = tree.query(window, gradient=True).height_gradient
        assert slope is not None
        assert tree.bounds(box_around(window)).slope < 3 * max(np.hypot(*slope).max(), 0.1)


@pytest.mark.parametrize("upward", [False, True])
def test_the_device_agrees(upward: bool, device: Any) -> None:
    for tree in (
        union(FOUR, near=0.5, far=30.0, upward=upward),
        replace(Plane(10.0, 0.0, 0.0), [union(FOUR, near=2.0, far=9.0, upward=upward)]),
    ):
        height, weight = on_device(tree, EXTENT, (150, 150), device)
        sample = tree.query(grid(EXTENT, (150, 150)))
        np.testing.assert_allclose(weight, sample.weight, atol=1e-5)
        there = ~np.isnan(height)
        assert there.sum() > 4000
        np.testing.assert_allclose(height[there], sample.height[there], atol=0.005)


def test_storage_keeps_it() -> None:
    tree = union(FOUR, near=0.5, far=30.0, upward=True)
    codec.seal(tree)
    again = codec.decode(codec.encode(tree))
    assert isinstance(again, Union)
    assert codec.seal(again) == codec.seal(tree)
    assert again.parts[0].query(grid(EXTENT, (5, 5))).height.shape == (25,)
