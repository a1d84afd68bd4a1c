"""Warps: one to one, their Jacobians, what they leave in place, and that they agree on OpenCL at large offsets."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph_terrain.raster import Extent
from nodegraph_tree import operators
from nodegraph_tree.affine import placed
from nodegraph_tree.basic import Constant
from nodegraph_tree.bend import Bend, bend
from nodegraph_tree.disc import Disc, NoiseField, Relief
from nodegraph_tree.distort import Distort, distort
from nodegraph_tree.function import Box, ElevationFunction, Points
from nodegraph_tree.twist import Twist, twist
from nodegraph_tree.warp import Warp
from tests.nodegraph_tree.strategies import Bump, grid, on_device

GROUND = NoiseField(0.0, 0.0, 100.0, Relief("fbm", 80.0, 700.0, 4, seed=3))
AREA = Extent(-1500.0, -1500.0, 1500.0, 1500.0)

KINDS: list[Warp] = [
    Twist(GROUND, 100.0, -50.0, 900.0, 2.5),
    Bend(GROUND, -800.0, -100.0, 0.8, 0.6, 1500.0, (200.0, -150.0, 120.0), 700.0),
    Bend(GROUND, -800.0, 0.0, 1.0, 0.0, 1600.0, (300.0,), 600.0),
    Distort(GROUND, 60.0, 500.0, 2, 0.3, 9),
]


@pytest.fixture(scope="module")
def device() -> Any:
    from nodegraph.opencl import choose

    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


@pytest.mark.parametrize("warp", KINDS, ids=lambda item: type(item).__name__)
def test_the_jacobian_is_that_of_the_displacement(warp: Warp) -> None:
    points = grid(AREA, (37, 41))
    found, step = warp.shift(points.x, points.y, gradient=True), 1e-3
    for dx, dy, slopes in ((step, 0.0, (found.xx, found.yx)), (0.0, step, (found.xy, found.yy))):
        ahead, behind = warp.shift(points.x + dx, points.y + dy), warp.shift(points.x - dx, points.y - dy)
        for one, two, slope in zip(ahead[:2], behind[:2], slopes, strict=True):
            assert one is not None
            assert two is not None
            assert np.allclose((one - two) / (2 * step), slope, atol=1e-6)


@pytest.mark.parametrize("warp", KINDS, ids=lambda item: type(item).__name__)
def test_the_plane_is_not_folded_and_bounds_hold(warp: Warp) -> None:
    dice = np.random.default_rng(1)
    for _ in range(60):
        west, south = dice.uniform(-1500, 1400, 2)
        size = 10 ** dice.uniform(0, 3.3)
        box = Box(west, south, west + size, south + size)
        points = grid(Extent(*box), (12, 12))
        found, reach = warp.shift(points.x, points.y, gradient=True), warp.reach(box)
        assert np.hypot(found.x, found.y).max() <= reach.shift * (1 + 1e-9) + 1e-9
        jacobian = np.array([[1 + found.xx, found.xy], [found.yx, 1 + found.yy]]).transpose(2, 0, 1)
        assert np.linalg.det(jacobian).min() > 0
        x, y = points.x + found.x, points.y + found.y
        for carried, stretch in ((warp.carried(box, reach), reach.stretch), warp.closely(box)):
            assert np.linalg.norm(jacobian, 2, axis=(1, 2)).max() <= stretch * (1 + 1e-9)
            assert carried.west <= x.min() + 1e-6
            assert x.max() <= carried.east + 1e-6
            assert carried.south <= y.min() + 1e-6
            assert y.max() <= carried.north + 1e-6


def test_a_distortion_by_noise_is_bounded_where_it_is_asked() -> None:
    warp = Distort(GROUND, 60.0, 900.0, 2, 0.5, 4)
    sizes, stretches = [], []
    for x, y in np.random.default_rng(2).uniform(-1e4, 1e4, (20, 2)):
        inside, stretch = warp.closely(Box(x, y, x + 50.0, y + 50.0))
        sizes.append(max(inside.east - inside.west, inside.north - inside.south))
        stretches.append(stretch - 1)
    assert np.median(sizes) < 70
    assert np.median(stretches) < 0.7 * warp.lipschitz
    assert warp.closely(Box(*[-np.inf] * 2, *[np.inf] * 2)) == (Box(*[-np.inf] * 2, *[np.inf] * 2), 1 + warp.lipschitz)


def test_the_stretch_is_tight_somewhere() -> None:
    for warp in KINDS[:3]:
        points = grid(AREA, (200, 200))
        found = warp.shift(points.x, points.y, gradient=True)
        jacobian = np.array([[1 + found.xx, found.xy], [found.yx, 1 + found.yy]]).transpose(2, 0, 1)
        assert warp.reach(Box(-1500, -1500, 1500, 1500)).stretch < 2 * np.linalg.norm(jacobian, 2, axis=(1, 2)).max()


@pytest.mark.parametrize("warp", KINDS[:3], ids=lambda item: type(item).__name__)
def test_outside_its_reach_a_warp_changes_nothing_bit_for_bit(warp: Warp, device: Any) -> None:
    points = grid(AREA, (130, 130))
    moved = warp.shift(points.x, points.y)
    still = (moved.x == 0) & (moved.y == 0)
    assert 0.1 < still.mean() < 0.95
    before, after = GROUND.query(points, gradient=True), warp.query(points, gradient=True)
    assert np.array_equal(before.height[still], after.height[still])
    assert before.height_gradient is not None
    assert after.height_gradient is not None
    assert np.array_equal(before.height_gradient[:, still], after.height_gradient[:, still])
    first, second = (on_device(tree, AREA, (130, 130), device)[0] for tree in (GROUND, warp))
    assert np.abs(first - second)[still].max() < 2e-3


def test_an_identity_is_the_tree_itself() -> None:
    assert operators.warp(GROUND, amplitude=0.0) is GROUND
    assert operators.twist(GROUND, angle=0.0) is GROUND
    assert operators.bend(GROUND, offsets=(0.0, 0.0)) is GROUND
    points = grid(AREA, (20, 20))
    expected = GROUND.query(points, gradient=True)
    for warp in (
        Twist(GROUND, 0.0, 0.0, 500.0, 0.0),
        Distort(GROUND, 0.0, 100.0),
        Bend(GROUND, 0, 0, 1, 0, 9, (0.0,), 9),
    ):
        found = warp.query(points, gradient=True)
        for one, two in zip(expected, found, strict=True):
            assert one is not None
            assert two is not None
            assert np.array_equal(one, two)
        assert warp.bounds(Box(0, 0, 10, 10)) == GROUND.bounds(Box(0, 0, 10, 10))


def test_a_twist_turns_the_middle_and_keeps_distances_to_it() -> None:
    bump = Disc(100.0, 0.0, 50.0, 10.0, Relief())
    tree = twist(bump, centre=(0.0, 0.0), radius=1e6, angle=math.pi / 2)
    found = tree.query(Points(np.array([0.0, 100.0]), np.array([100.0, 0.0])))
    assert found.weight[0] == pytest.approx(1.0, abs=1e-6)
    assert found.weight[1] == 0


@given(st.lists(st.floats(-300, 300), min_size=1, max_size=6))
def test_a_bend_takes_the_axis_through_the_offsets(offsets: list[float]) -> None:
    tree = Bend(Constant(0.0), 100.0, 200.0, 0.6, 0.8, 2000.0, tuple(offsets), 1e5)
    count = len(offsets)
    s = 2000.0 / (count + 3) * (np.arange(count) + 2)
    # The inverse takes the bent point back to the axis: to within what the fall-off across loses.
    x, y = 100 + 0.6 * s - 0.8 * np.array(offsets), 200 + 0.8 * s + 0.6 * np.array(offsets)
    moved = tree.shift(x, y)
    across = 0.6 * (y + moved.y - 200) - 0.8 * (x + moved.x - 100)
    assert np.abs(across).max() < 0.05
    # sup |h| is what it says.
    s = np.linspace(0, 2000, 4001)
    dense = tree.shift(100 + 0.6 * s, 200 + 0.8 * s)
    greatest = np.hypot(dense.x, dense.y).max()
    assert greatest <= tree.farthest * (1 + 1e-9) + 1e-9
    assert tree.farthest <= greatest * (1 + 1e-4) + 1e-3


def test_what_would_fold_the_ground_is_refused() -> None:
    with pytest.raises(ValueError, match="may fold the ground; give an amplitude below"):
        operators.warp(GROUND, amplitude=400.0, wavelength=1000.0)
    with pytest.raises(ValueError, match="folds the ground; give a reach above"):
        operators.bend(GROUND, offsets=(700.0,), reach=1000.0)
    with pytest.raises(ValueError, match="two different points"):
        operators.bend(GROUND, start=(1.0, 1.0), end=(1.0, 1.0))
    with pytest.raises(ValueError, match="radius above 0"):
        twist(GROUND, centre=(0.0, 0.0), radius=0.0, angle=1.0)
    with pytest.raises(ValueError, match="radius above 0"):
        twist(GROUND, centre=(0.0, 0.0), radius=math.nan, angle=1.0)
    # What the messages advise is accepted.
    operators.warp(GROUND, amplitude=230.0, wavelength=1000.0)
    operators.bend(GROUND, offsets=(700.0,), reach=1203.0)


def far(tree: ElevationFunction, x: float, y: float) -> ElevationFunction:
    return placed(tree, position=(x, y))


@pytest.mark.parametrize("offset", [(0.0, 0.0), (1.9e5, -1.7e5)], ids=["here", "far"])
@pytest.mark.parametrize("cell", [1.0, 13.0])
def test_opencl_agrees_to_a_centimetre(device: Any, offset: tuple[float, float], cell: float) -> None:
    x, y = offset
    size = 130 * cell / 2
    extent = Extent(x - size, y - size, x + size, y + size)
    ground = NoiseField(x, y, 100.0, Relief("fbm", 80.0, 700.0, 4, seed=3))
    stacked = twist(
        bend(
            distort(ground, amplitude=60.0, wavelength=500.0, octaves=2, gain=0.3, seed=2),
            start=(x - 600, y), end=(x + 600, y + 300), offsets=(90.0, -70.0), reach=500.0,
        ),
        centre=(x + 50, y - 20), radius=700.0, angle=2.0,
    )  # fmt: skip
    for tree in (
        stacked,
        far(KINDS[0], x, y),
        far(KINDS[3], x, y),
        twist(Bump(x, y, 900.0, 50.0), centre=(x, y), radius=500.0, angle=1.0),
    ):
        height, weight = on_device(tree, extent, (130, 130), device)
        expected = tree.query(grid(extent, (130, 130)))
        assert np.abs(weight - expected.weight).max() < 1e-4
        sure = expected.weight > 0.501
        assert np.abs(height - expected.height)[sure].max() < 0.01
