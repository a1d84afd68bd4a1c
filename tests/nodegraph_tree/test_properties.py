"""What must hold for any tree: gradients, bounds, supports, windows, instances, OpenCL, storage."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import codec
from nodegraph_terrain.raster import Extent
from nodegraph_tree.basic import Constant
from nodegraph_tree.blend import blend
from nodegraph_tree.by_terrain import ByTerrain, by_terrain
from nodegraph_tree.carve import Carve
from nodegraph_tree.disc import Disc, NoiseField, Relief
from nodegraph_tree.function import THRESHOLD, Bounds, Box, ElevationFunction, Points, Sample, numeric_gradient, walk
from tests.nodegraph_tree.strategies import CENTRE, Window, grid, on_device, trees, windows

SLACK = 1 + 1e-6


@pytest.fixture(scope="module")
def device() -> Any:
    from nodegraph.opencl import choose

    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


def test_rounding_on_level_ground_is_within_the_bounds() -> None:
    # Raised to one height where the ground below has little weight: it comes out an ulp apart from place to place.
    level = Carve(
        Disc(CENTRE[0] - 300.0, CENTRE[1], 400.0, 65.3, Relief("fbm", 20.0, 300.0, 3)), Constant(577.38), 0.0, True
    )
    tree = by_terrain(Constant(0.0), level, gentlest=5.0, slope_fade=5.0, span=5.0)
    box = Box(CENTRE[0] - 50, CENTRE[1] - 50, CENTRE[0] + 50, CENTRE[1] + 50)
    x, y = (
        axis.ravel() for axis in np.meshgrid(np.linspace(box.west, box.east, 90), np.linspace(box.south, box.north, 90))
    )
    assert 0 < tree.query(Points(x, y)).weight.max() <= tree.bounds(box).weight_high


@given(trees(), windows())
def test_values_and_slopes_stay_within_bounds(tree: ElevationFunction, window: Window) -> None:
    bounds = tree.bounds(window.box, float(window.points.detail))
    points, dice = window.points, np.random.default_rng(0)
    for reach in (0.05, 0.005, 0.0):
        sample = tree.query(points, gradient=True)
        stay_within(bounds, sample)
        # Go on around what comes nearest to a bound.
        steep, turned = (np.hypot(*item) for item in (sample.height_gradient, sample.weight_gradient))
        ground = np.where(sample.weight >= THRESHOLD, steep, -1)
        ends = (ground, steep * sample.weight, turned, sample.height, -sample.height, sample.weight, -sample.weight)
        best = np.concatenate([np.argsort(item)[-3:] for item in ends]).repeat(8)
        points = points.moved(
            *(
                np.clip(axis[best] + dice.normal(0, reach * (high - low), best.size), low, high)
                for axis, low, high in zip(points[:2], window.box[:2], window.box[2:], strict=True)
            )
        )


@given(
    st.builds(
        by_terrain,
        st.sampled_from([Constant(40.0), Disc(CENTRE[0], CENTRE[1], 900.0, 10.0, Relief("fbm", 30.0, 300.0, 4))]),
        trees(3),
        lowest=st.sampled_from([None, None, 50.0]),
        highest=st.sampled_from([None, 300.0]),
        altitude_fade=st.floats(20, 300),
        gentlest=st.sampled_from([None, 0.0, 10.0]),
        steepest=st.sampled_from([12.0, 20.0, 35.0]),
        slope_fade=st.sampled_from([3.0, 10.0]),
        span=st.sampled_from([5.0, 40.0, 60.0]),
    ),
    windows(150),
    st.floats(0.05, 4.5),
)
def test_weights_by_slope_stay_within_bounds(tree: ElevationFunction, window: Window, side: float) -> None:
    # Boxes of a size to the span, within which A is asked where the slope's four points are from.
    assert isinstance(tree, ByTerrain)
    (west, south, east, north), points = window.box, window.points
    side *= tree.span
    box = Box(west, south, west + side, south + side)
    x, y = west + side * (points.x - west) / (east - west), south + side * (points.y - south) / (north - south)
    x, y = np.clip(x, box.west, box.east), np.clip(y, box.south, box.north)
    stay_within(tree.bounds(box, float(points.detail)), tree.query(points.moved(x, y), gradient=True))


def stay_within(bounds: Bounds, sample: Sample) -> None:
    assert np.isfinite(sample.height).all()
    assert (sample.weight >= 0).all()
    here, ground = sample.weight > 0, sample.weight >= THRESHOLD
    room = 1e-6 * max(1.0, np.abs(sample.height).max())
    assert sample.height[here].min(initial=np.inf) >= bounds.low - room
    assert sample.height[here].max(initial=-np.inf) <= bounds.high + room
    assert sample.weight.max() <= bounds.weight_high * SLACK + 1e-9
    assert sample.weight.min() >= bounds.weight_low / SLACK - 1e-9
    steep, turned = (np.hypot(*item) for item in (sample.height_gradient, sample.weight_gradient))
    assert turned[here].max(initial=0) <= bounds.weight_slope * SLACK + 1e-9
    assert steep[ground].max(initial=0) <= bounds.slope * SLACK + 1e-9
    assert (sample.weight * steep)[here].max(initial=0) <= bounds.flux * SLACK + 1e-9
    assert steep[here].max(initial=0) <= bounds.support_slope * SLACK + 1e-9


@given(trees(), windows())
def test_gradients_match_central_differences(tree: ElevationFunction, window: Window) -> None:
    points = window.points
    sample = tree.query(points, gradient=True)
    ground = sample.weight >= 0.05
    assert sample.height_gradient is not None
    assert sample.weight_gradient is not None
    fine, coarse = numeric_gradient(tree, points, 0.01), numeric_gradient(tree, points, 0.02)
    exacts, kinks = (sample.height_gradient, sample.weight_gradient), creases(tree, points)
    for exact, near, far, kink in zip(exacts, fine, coarse, kinks, strict=True):
        # Kinks (the ridges of noise, the edge of a carving) show as differences that depend on the step, or, right
        # through a point, as one-sided ones that differ.
        limit = 1 + np.abs(near).max(0)
        smooth = ground & (np.abs(near - far).max(0) < 2e-4 * limit) & (kink < 2e-3 * limit)
        assert smooth.sum() >= 0.7 * ground.sum() - 3
        wrong = np.abs(exact - near)[:, smooth]
        # Second differences bound what the step hides; two kinks at once may hide from them, hence the few.
        limit = 2e-3 * (1 + np.abs(near[:, smooth]))
        assert (wrong > limit).mean() < 0.01 if wrong.size else True


def creases(tree: ElevationFunction, points: Points, step: float = 1e-3) -> list[np.ndarray]:
    """Return how much the slopes of f and alpha on either side of each point differ, along x or y."""
    here, found = tree.query(points), []
    for dx, dy in ((step, 0.0), (0.0, step)):
        ahead, behind = (tree.query(points.moved(points.x + side * dx, points.y + side * dy)) for side in (1, -1))
        found.append([np.abs(ahead[k] - 2 * here[k] + behind[k]) / step for k in range(2)])
    return [np.maximum(*pair) for pair in zip(*found, strict=True)]


@given(trees(), windows())
def test_the_weight_is_0_outside_the_support(tree: ElevationFunction, window: Window) -> None:
    points, box = window.points, tree.support
    sample = tree.query(points)
    inside = (points.x >= box.west) & (points.x <= box.east) & (points.y >= box.south) & (points.y <= box.north)
    assert sample.weight[~inside].max(initial=0) < 1e-9


@given(trees(), windows())
def test_a_query_does_not_depend_on_its_neighbours(tree: ElevationFunction, window: Window) -> None:
    points = window.points
    whole, part = tree.query(points), tree.query(points.taken(np.arange(len(points.x)) % 3 == 1))
    assert np.allclose(whole.height[1::3], part.height, rtol=1e-12, atol=1e-9)
    assert np.allclose(whole.weight[1::3], part.weight, rtol=1e-12, atol=1e-12)


@given(trees(), windows())
def test_storage_gives_an_equal_tree(tree: ElevationFunction, window: Window) -> None:
    codec.seal(tree)
    again = codec.decode(codec.encode(tree))
    assert codec.seal(again) == codec.seal(tree)
    for first, second in zip(tree.query(window.points), again.query(window.points), strict=True):
        assert (first is None and second is None) or np.array_equal(first, second)


@given(trees(4))
def test_an_instance_equals_a_copy(tree: ElevationFunction) -> None:
    from nodegraph_tree.affine import placed

    copy = codec.decode(codec.encode(tree))
    assert copy is not tree
    same, apart = (
        blend([placed(one, position=(0.0, 0.0), size=(1.0, 1.0)), placed(two, position=(300.0, -200.0), rotation=0.1)])
        for one, two in ((tree, tree), (tree, copy))
    )
    assert len(list(walk(same))) < len(list(walk(apart)))
    assert codec.seal(same) == codec.seal(apart)
    points = grid(Extent(CENTRE[0] - 2e3, CENTRE[1] - 2e3, CENTRE[0] + 2e3, CENTRE[1] + 2e3), (16, 16))
    assert np.array_equal(same.query(points).height, apart.query(points).height)


@given(trees(), st.sampled_from([1.0, 7.0, 40.0]), st.sampled_from([1.0, 0.4]), st.floats(-1000, 1000))
@settings(max_examples=25)
def test_opencl_agrees_with_numpy(
    device: Any, tree: ElevationFunction, cell: float, detail: float, away: float
) -> None:
    shape = (70, 90)
    west, south = CENTRE[0] + away, CENTRE[1] - away / 2
    extent = Extent(west, south, west + shape[1] * cell, south + shape[0] * cell)
    height, weight = on_device(tree, extent, shape, device, detail)
    sample = tree.query(grid(extent, shape, detail), gradient=True)
    assert np.abs(weight - sample.weight).max() < 2e-4 * max(1.0, sample.weight.max())
    sure = sample.weight > THRESHOLD + 1e-3
    assert np.isnan(height[sample.weight < THRESHOLD - 1e-3]).all()
    assert sample.height_gradient is not None
    # Where the ground is steep, a coordinate that is off by a hundredth of a millimetre shows.
    steep = np.hypot(*sample.height_gradient)[sure]
    wrong = np.abs(height - sample.height)[sure]
    limit = 0.01 + 2e-5 * steep * cell + 2e-6 * np.abs(sample.height[sure])
    assert (wrong <= limit).all(), (wrong / limit).max()


@pytest.mark.parametrize("kind", ["gradient", "fbm", "billow", "ridged", "hybrid", "warped"])
@pytest.mark.parametrize("cell", [1.0, 40.0])
def test_slopes_of_rough_ground_keep_their_digits(device: Any, kind: Any, cell: float) -> None:
    # A difference of heights over 10 m and a fade over 10 degrees make 1 from a metre: a tile may span 200 forms of the
    # finest octave, and the heights in it must be true to a tenth of a millimetre.
    ground = NoiseField(CENTRE[0] - 300.0, CENTRE[1] + 700.0, 150.0, Relief(kind, 300.0, 200.0, 5, seed=9))
    tree = by_terrain(Constant(0.0), ground, gentlest=5.0, steepest=20.0, slope_fade=10.0, span=5.0)
    extent = Extent(CENTRE[0], CENTRE[1], CENTRE[0] + 130 * cell, CENTRE[1] + 128 * cell)
    _, weight = on_device(tree, extent, (128, 130), device)
    assert np.abs(weight - tree.query(grid(extent, (128, 130))).weight).max() < 2e-4


@given(trees(4), st.integers(0, 60), st.integers(0, 60))
@settings(max_examples=10)
def test_a_window_equals_that_window_of_a_larger_sample(
    device: Any, tree: ElevationFunction, row: int, col: int
) -> None:
    cell, shape = 20.0, (130, 130)
    extent = Extent(CENTRE[0] - 1300, CENTRE[1] - 1300, CENTRE[0] + 1300, CENTRE[1] + 1300)
    part = Extent(
        extent.west + col * cell,
        extent.north - (row + 66) * cell,
        extent.west + (col + 50) * cell,
        extent.north - row * cell,
    )
    whole = [item.reshape(shape)[row : row + 66, col : col + 50] for item in on_device(tree, extent, shape, device)]
    window = [item.reshape(66, 50) for item in on_device(tree, part, (66, 50), device)]
    assert np.abs(whole[1] - window[1]).max() < 4e-4 * max(1.0, whole[1].max())
    sure = whole[1] > THRESHOLD + 1e-3
    assert np.abs(whole[0] - window[0])[sure].max(initial=0) < 0.05


@given(trees(4), st.floats(0, 1))
@settings(max_examples=10)
def test_detail_may_differ_from_cell_to_cell(device: Any, tree: ElevationFunction, start: float) -> None:
    shape = (66, 66)
    extent = Extent(CENTRE[0], CENTRE[1], CENTRE[0] + 660, CENTRE[1] + 660)
    detail = np.clip(start + np.linspace(-0.4, 0.4, 66 * 66), 0, 1)
    height, weight = on_device(tree, extent, shape, device, detail.reshape(shape).astype(np.float32))
    sample = tree.query(grid(extent, shape, detail.astype(np.float32).astype(np.float64)))
    assert np.abs(weight - sample.weight).max() < 1e-3 * max(1.0, sample.weight.max())
    sure = sample.weight > THRESHOLD + 2e-3
    assert np.abs(height - sample.height)[sure].max(initial=0) < 0.05


def test_bounds_of_everything() -> None:
    """Boxes may be infinite."""
    everywhere = Box(-np.inf, -np.inf, np.inf, np.inf)

    @given(trees())
    @settings(max_examples=30)
    def check(tree: ElevationFunction) -> None:
        bounds = tree.bounds(everywhere)
        assert not np.isnan(bounds).any()
        sample = tree.query(Points(np.array([CENTRE[0]]), np.array([CENTRE[1]])), gradient=True)
        if sample.weight[0] > 0:
            assert bounds.low - 1e-6 <= sample.height[0] <= bounds.high + 1e-6
            assert sample.weight[0] <= bounds.weight_high * SLACK

    check()
