"""Discs and noise: gradients, bounds, level of detail, OpenCL, storage, and the nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import codec
from nodegraph_terrain.raster import Extent
from nodegraph_tree.blend import blend
from nodegraph_tree.disc import Disc, NoiseField, Relief, disc, noise
from nodegraph_tree.falloff import STEEPEST, FallOff
from nodegraph_tree.function import Box, ElevationFunction, Points, numeric_gradient
from tests.nodegraph_tree.strategies import CENTRE, Window, grid, on_device, windows

KINDS = ("none", "gradient", "fbm", "billow", "ridged", "hybrid", "warped")
X, Y = CENTRE

_RELIEFS = st.builds(
    Relief,
    kind=st.sampled_from(KINDS),
    amplitude=st.floats(-500, 500),
    wavelength=st.floats(50, 4000),
    octaves=st.integers(1, 8),
    gain=st.floats(0.2, 0.8),
    seed=st.integers(0, 2**32 - 1),
)
_FALLS = st.sampled_from(sorted(STEEPEST))
_DISCS = st.builds(
    Disc,
    st.floats(X - 800, X + 800),
    st.floats(Y - 800, Y + 800),
    st.floats(1, 3000),
    st.floats(-500, 3000),
    _RELIEFS,
    _FALLS,
)
_GROUND = st.one_of(_DISCS, st.builds(NoiseField, st.just(X), st.just(Y), st.floats(-500, 3000), _RELIEFS))


@pytest.fixture(scope="module")
def device() -> Any:
    from nodegraph.opencl import choose

    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


@given(_GROUND, windows())
@settings(max_examples=40)
def test_samples_stay_within_the_bounds(ground: ElevationFunction, window: Window) -> None:
    sample, bounds = ground.query(window.points, gradient=True), ground.bounds(window.box, float(window.points.detail))
    here = sample.weight > 0
    if bounds.absent:
        assert not here.any()
        return
    assert sample.height_gradient is not None
    assert sample.weight_gradient is not None
    assert sample.height[here].min(initial=np.inf) >= bounds.low - 1e-6
    assert sample.height[here].max(initial=-np.inf) <= bounds.high + 1e-6
    assert sample.weight.min() >= bounds.weight_low - 1e-12
    assert sample.weight.max() <= bounds.weight_high + 1e-12
    assert np.hypot(*sample.height_gradient)[here].max(initial=0) <= bounds.slope * (1 + 1e-9)
    assert np.hypot(*sample.weight_gradient).max() <= bounds.weight_slope * (1 + 1e-9) + 1e-15


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_are_tight_where_the_box_is_small(kind: str) -> None:
    ground = noise(kind=kind, amplitude=300.0, wavelength=500.0, octaves=5, seed=3)
    dice = np.random.default_rng(1)
    for size in (1.0, 10.0):
        x, y = X + dice.uniform(0, 2000), Y + dice.uniform(0, 2000)
        bounds = ground.bounds(Box(x, y, x + size, y + size))
        assert bounds.high - bounds.low <= 2**0.5 * size * bounds.slope + 1e-9
        assert bounds.high - bounds.low < 60 * size


@given(_GROUND, st.sampled_from([1.0, 0.3, 0.77]), st.integers(0, 999))
@settings(max_examples=30)
def test_gradients_match_central_differences(ground: ElevationFunction, detail: float, seed: int) -> None:
    dice = np.random.default_rng(seed)
    points = Points(dice.uniform(X - 1000, X + 1000, 150), dice.uniform(Y - 1000, Y + 1000, 150), detail)
    sample = ground.query(points, gradient=True)
    inside = sample.weight > 1e-6
    fine, coarse = numeric_gradient(ground, points, 0.004), numeric_gradient(ground, points, 0.008)
    for exact, near, far in zip((sample.height_gradient, sample.weight_gradient), fine, coarse, strict=True):
        assert exact is not None
        # At the ridges of billow and ridged noise differences depend on the step.
        smooth = inside & (np.abs(near - far).max(0) < 1e-3 * (1 + np.abs(near).max(0)))
        assert smooth.sum() >= 0.7 * inside.sum() - 3
        if smooth.any():
            assert (np.abs(exact - near) < 4e-3 * (1 + np.abs(near)))[:, smooth].mean() > 0.99


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("detail", [1.0, 0.4])
def test_opencl_gives_the_same_200_km_away(kind: str, detail: float, device: Any) -> None:
    parts = [
        Disc(x, y, 900.0, 50.0, Relief(kind, 400.0, 700.0, seed=5), fall)
        for x, y, fall in ((2e5 - 300, 2e5, "wyvill"), (2e5 + 400, 2e5 + 100, "quintic"), (2e5, 2e5 - 500, "plateau"))
    ]
    tree = blend([NoiseField(1e5, 1e5, 0.0, Relief(kind, 300.0, 2000.0, seed=9)), *parts])
    extent, shape = Extent(2e5 - 1000, 2e5 - 1000, 2e5 + 1000, 2e5 + 1000), (150, 170)
    height, weight = on_device(tree, extent, shape, device, detail)
    exact = tree.query(grid(extent, shape, detail))
    assert np.abs(height - exact.height).max() < 0.01
    assert np.abs(weight - exact.weight).max() < 1e-5


def test_a_window_equals_the_same_window_of_a_larger_sample(device: Any) -> None:
    tree = disc(centre=(2e5, 1e5), radius=2000.0, style="mountains", fall_off="plateau")
    whole, _ = on_device(tree, Extent(2e5 - 300, 1e5 - 300, 2e5 + 300, 1e5 + 300), (300, 300), device)
    part, _ = on_device(tree, Extent(2e5 - 146, 1e5 - 180, 2e5 + 4, 1e5 + 20), (100, 75), device)
    assert np.abs(whole.reshape(300, 300)[140:240, 77:152] - part.reshape(100, 75)).max() < 0.01


def test_detail_runs_from_level_to_all(device: Any) -> None:
    tree = noise(kind="fbm", amplitude=100.0, wavelength=400.0, octaves=6, centre=CENTRE)
    extent, shape = Extent(X, Y, X + 300, Y + 300), (64, 64)
    detail = np.linspace(0, 1, 64)[None, :].repeat(64, 0)
    points = grid(extent, shape, detail.ravel())
    exact = tree.query(points).height.reshape(shape)
    assert np.abs(exact[:, 0]).max() == 0
    assert np.array_equal(exact[:, -1], tree.query(grid(extent, shape)).height.reshape(shape)[:, -1])
    found, _ = on_device(tree, extent, shape, device, detail)
    assert np.abs(found.reshape(shape) - exact).max() < 1e-2
    rough = [tree.bounds(tree.support, kappa).slope for kappa in (0.0, 0.2, 0.5, 1.0)]
    assert rough[0] == 0
    assert rough == sorted(rough)


def test_outside_its_circle_a_disc_changes_nothing(device: Any) -> None:
    base = noise(amplitude=80.0, wavelength=300.0, centre=CENTRE)
    both = blend([base, disc(centre=CENTRE, radius=200.0, style="mountains", height=500.0)])
    extent, shape = Extent(X - 400, Y - 400, X + 400, Y + 400), (128, 128)
    points = grid(extent, shape)
    far = np.hypot(points.x - X, points.y - Y) >= 200.01
    for one, other in zip(on_device(base, extent, shape, device), on_device(both, extent, shape, device), strict=True):
        assert np.array_equal(one[far], other[far])
    exact, more = base.query(points), both.query(points)
    assert np.array_equal(exact.height[far], more.height[far])
    assert np.array_equal(exact.weight[far], more.weight[far])


@given(_GROUND)
@settings(max_examples=10)
def test_storing_changes_nothing(ground: ElevationFunction) -> None:
    again = codec.decode(codec.encode(ground))
    assert codec.seal(again) == codec.seal(ground)
    points = Points(np.linspace(X - 500, X + 500, 20), np.linspace(Y, Y + 300, 20))
    assert np.array_equal(again.query(points).height, ground.query(points).height)


def test_the_styles() -> None:
    points = Points(*(np.random.default_rng(0).uniform(-300, 300, (2, 500))))
    plain, hills, mountains = (
        disc(radius=1000.0, height=20.0, style=style).query(points).height  # type: ignore[arg-type]
        for style in ("plain", "hills", "mountains")
    )
    assert (plain == 20).all()
    assert 3 < hills.std() < mountains.std()
    high = disc(radius=1000.0, style="plain", kind="fbm", amplitude=10.0).query(points).height
    assert 0 < np.abs(high).max() <= 10


@pytest.mark.parametrize("fall", sorted(STEEPEST))
def test_the_weight_is_1_at_the_centre_and_0_at_the_rim(fall: FallOff) -> None:
    found = disc(radius=10.0, fall_off=fall).query(Points(np.array([0.0, 10.0, 9.999999]), np.zeros(3)), gradient=True)
    assert found.weight[0] == 1
    assert found.weight[1] == 0
    assert found.weight_gradient is not None
    assert not found.weight_gradient[:, :2].any()
    assert np.abs(found.weight_gradient).max() < 1e-6


def test_wrong_intervals_are_refused_at_once() -> None:
    with pytest.raises(ValueError, match="intervals do not fit"):
        disc(style="hills", intervals=((0.0, 1.0),))
    with pytest.raises(ValueError, match="must rise"):
        noise(octaves=1, intervals=((0.5, 0.2),))
