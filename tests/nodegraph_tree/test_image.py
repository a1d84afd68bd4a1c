"""Rasters as primitives: interpolation, quadrangles, curves, and rasters where they lie."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from nodegraph import codec
from nodegraph_terrain.raster import Elevation, Extent, Mask
from nodegraph_terrain.sample_dem import sample_dem
from nodegraph_tree.arcs import smooth_curve
from nodegraph_tree.basic import Constant
from nodegraph_tree.blend import blend
from nodegraph_tree.from_elevation import from_elevation
from nodegraph_tree.function import THRESHOLD, Box, ElevationFunction, Points, numeric_gradient
from nodegraph_tree.image_curve import ImageCurve, image_curve
from nodegraph_tree.image_quad import ImageQuad, image_quad
from nodegraph_tree.pixels import Kind, Pixels, Pyramid
from tests.nodegraph_tree.strategies import CENTRE, grid, on_device

X, Y = CENTRE
INTERPOLATIONS = ("bilinear", "bicubic")
SETTINGS = settings(max_examples=25)


@pytest.fixture(scope="module")
def device() -> Any:
    from nodegraph.opencl import choose

    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


def _jacksboro(west: float = X, south: float = Y, cell: float = 30.0) -> Elevation:
    data = sample_dem().data
    rows, cols = data.shape
    return Elevation(data, Extent(west, south, west + cols * cell, south + rows * cell))


# Interpolation.


@st.composite
def _rasters(draw: Any, low: float = -100, high: float = 100) -> Any:
    """Return rasters of 1 to 12 cells a side: noise, spikes, checkers, steps."""
    rows, cols = draw(st.integers(1, 12)), draw(st.integers(1, 12))
    dice = np.random.default_rng(draw(st.integers(0, 9999)))
    style = draw(st.sampled_from(["noise", "spike", "checker", "step"]))
    data = np.zeros((rows, cols))
    if style == "noise":
        data = dice.random((rows, cols))
    elif style == "spike":
        data[dice.integers(rows), dice.integers(cols)] = 1
    elif style == "checker":
        data = (np.add.outer(np.arange(rows), np.arange(cols)) % 2).astype(float)
    else:
        data[:, cols // 2 :] = 1
    return (low + (high - low) * data).astype(np.float32)


@given(_rasters(), st.sampled_from(["bilinear", "bicubic", "spline", "smooth"]), st.integers(0, 999))
def test_pixels_and_slopes_stay_within_the_bounds_of_their_cells(data: Any, kind: Kind, seed: int) -> None:
    pixels = Pixels(data, kind)
    rows, cols = data.shape
    cells = pixels.cells()
    dice = np.random.default_rng(seed)
    c, r = dice.uniform(-0.5, cols - 0.5, 2000), dice.uniform(-0.5, rows - 0.5, 2000)
    found = pixels.at(c, r)
    at = (np.floor(r).astype(int) + 1, np.floor(c).astype(int) + 1)
    for value, most in ((found.along, cells.along[at]), (found.down, cells.down[at])):
        assert (np.abs(value) <= most * (1 + 1e-12) + 1e-9).all()
    assert (found.value >= cells.low[at] - 1e-9).all()
    assert (found.value <= cells.high[at] + 1e-9).all()
    pyramid = Pyramid(cells.low, cells.high, np.hypot(cells.along, cells.down))
    c0, c1 = np.sort(dice.uniform(-0.5, cols - 0.5, 2))
    r0, r1 = np.sort(dice.uniform(-0.5, rows - 0.5, 2))
    block = pyramid.over(c0, c1, r0, r1)
    inside = (c >= c0) & (c <= c1) & (r >= r0) & (r <= r1)
    assert found.value[inside].min(initial=np.inf) >= block.low - 1e-9
    assert found.value[inside].max(initial=-np.inf) <= block.high + 1e-9
    assert np.hypot(found.along, found.down)[inside].max(initial=0) <= block.slope + 1e-9


@given(_rasters(), st.sampled_from(["bilinear", "bicubic", "smooth"]))
def test_interpolation_goes_through_all_values_and_is_smooth(data: Any, kind: Kind) -> None:
    pixels = Pixels(data, kind)
    rows, cols = data.shape
    c, r = np.meshgrid(np.arange(cols, dtype=float), np.arange(rows, dtype=float))
    assert np.abs(pixels.at(c.ravel(), r.ravel()).value - data.ravel()).max() < 1e-9
    step = 1e-7
    left, right = (pixels.at(np.clip(c.ravel() + e, -0.5, cols - 0.5), r.ravel()) for e in (-step, step))
    assert np.abs(left.value - right.value).max() < 1e-3
    if kind != "bilinear" and cols > 2:
        inner = (c.ravel() > 0) & (c.ravel() < cols - 1)
        assert np.abs(left.along - right.along)[inner].max(initial=0) < 1e-3


def test_a_plane_stays_a_plane_up_to_the_edge() -> None:
    data = np.add.outer(3.0 * np.arange(5), 2.0 * np.arange(7)).astype(np.float32)
    dice = np.random.default_rng(0)
    c, r = dice.uniform(-0.5, 6.5, 500), dice.uniform(-0.5, 4.5, 500)
    assert np.abs(Pixels(data, "bicubic").at(c, r).value - (2 * c + 3 * r)).max() < 1e-9
    assert np.abs(Pixels(data, "bilinear").at(c, r).value - (2 * c + 3 * r)).max() < 2e-4


def test_bicubic_overshoots_and_its_bound_knows() -> None:
    step = np.zeros((4, 8), np.float32)
    step[:, 4:] = 1
    cells = Pixels(step, "bicubic").cells()
    assert cells.high.max() > 1.05
    assert cells.along.max() == pytest.approx(1.25)  # attained half-way
    assert Pixels(step, "bicubic").at(np.array([3.5]), np.array([2.0])).along[0] == pytest.approx(1.25)


# Properties of all three.


def _check_bounds(tree: ElevationFunction, box: Box, seed: int, count: int = 600) -> None:
    dice = np.random.default_rng(seed)
    points = Points(dice.uniform(box.west, box.east, count), dice.uniform(box.south, box.north, count))
    sample, bounds = tree.query(points, gradient=True), tree.bounds(box)
    here, ground = sample.weight > 0, sample.weight >= THRESHOLD
    if bounds.absent:
        assert not here.any()
        return
    assert sample.height_gradient is not None
    assert sample.weight_gradient is not None
    slope, fade = np.hypot(*sample.height_gradient), np.hypot(*sample.weight_gradient)
    room = 1e-6 * max(1.0, np.abs(sample.height).max())
    assert np.isfinite(sample.height).all()
    assert sample.height[here].min(initial=np.inf) >= bounds.low - room
    assert sample.height[here].max(initial=-np.inf) <= bounds.high + room
    assert sample.weight.min() >= bounds.weight_low - 1e-9
    assert sample.weight.max() <= bounds.weight_high + 1e-9
    assert fade.max() <= bounds.weight_slope * (1 + 1e-6) + 1e-12
    assert slope[ground].max(initial=0) <= bounds.slope * (1 + 1e-6) + 1e-9
    assert slope[here].max(initial=0) <= bounds.support_slope * (1 + 1e-6) + 1e-9
    assert (sample.weight * slope).max() <= bounds.flux * (1 + 1e-6) + 1e-9


def _check_gradients(tree: ElevationFunction, points: Points) -> None:
    sample = tree.query(points, gradient=True)
    # Steps far below the cells, of which some are centimetres wide.
    step = min(1e-3, 1e-6 * (tree.support.east - tree.support.west))
    fine, coarse = numeric_gradient(tree, points, step), numeric_gradient(tree, points, 2 * step)
    inside = sample.weight > 1e-3
    for exact, near, far in zip((sample.height_gradient, sample.weight_gradient), fine, coarse, strict=True):
        assert exact is not None
        smooth = inside & (np.abs(near - far).max(0) < 1e-3 * (1 + np.abs(near).max(0)))
        assert smooth.sum() > 0.9 * inside.sum() - 3
        assert (np.abs(exact - near) <= 3e-3 * (1 + np.abs(near)))[:, smooth].mean() > 0.995 if smooth.any() else True


def _boxes(size: float = 2500.0) -> Any:
    def box(x: float, y: float, wide: float, high: float) -> Box:
        return Box(X + x, Y + y, X + x + 10**wide, Y + y + 10**high)

    place = st.floats(-500, size)
    return st.builds(box, place, place, st.floats(-1, 3.5), st.floats(-1, 3.5))


_MASKS = st.one_of(st.none(), _rasters(0, 1))
_PLACES = st.floats(-0.3, 0.3)


def _on(data: Any, kind: type = Elevation) -> Any:
    return kind(data, Extent(0, 0, 100, 100))


@st.composite
def _quads(draw: Any) -> ImageQuad:
    square = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], float)
    moved = (square + np.array([draw(_PLACES) for _ in range(8)]).reshape(4, 2)) * draw(st.floats(5, 2000))
    turn = draw(st.floats(0, 6.3))
    turned = moved @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    if draw(st.booleans()):
        turned = turned[::-1]
    corners = tuple((X + 700 + x, Y + 700 + y) for x, y in turned.tolist())
    mask = draw(_MASKS)
    try:
        found = image_quad(
            _on(draw(_rasters())), None if mask is None else _on(mask, Mask), corners=corners,
            interpolation=draw(st.sampled_from(INTERPOLATIONS)), scale=draw(st.sampled_from([1.0, -2.0])), rise=7.0,
        )  # fmt: skip
    except ValueError:
        assume(False)
    assert isinstance(found, ImageQuad)
    return found


@st.composite
def _grids(draw: Any) -> ElevationFunction:
    data, mask = draw(_rasters()), draw(_MASKS)
    x, y, wide, high = (draw(st.floats(1, 1500)) for _ in range(4))
    extent = Extent(X + x, Y + y, X + x + wide, Y + y + high)
    if draw(st.booleans()) and data.size > 2:
        data[0, 0] = np.nan
        mask = None
    return from_elevation(
        Elevation(data, extent), None if mask is None else Mask(mask, extent), scale=draw(st.sampled_from([1.0, -2.0])),
        interpolation=draw(st.sampled_from(INTERPOLATIONS)), margin=draw(st.floats(0, 0.499)) * min(wide, high),
    )  # fmt: skip


@st.composite
def _curves(draw: Any) -> ElevationFunction:
    step, turn = draw(st.floats(200, 600)), 0.0
    points = [(X, Y + 800.0)]
    for _ in range(draw(st.integers(1, 6))):
        points.append((points[-1][0] + step * np.cos(turn), points[-1][1] + step * np.sin(turn)))
        turn += draw(st.floats(-1.2, 1.2))
    try:
        return image_curve(
            *[_on(draw(_rasters())) for _ in range(draw(st.integers(1, 3)))], points=tuple(points),
            width=draw(st.floats(20, 200)), fit=draw(st.sampled_from(["repeat", "stretch"])),
            interpolation=draw(st.sampled_from(INTERPOLATIONS)), overlap=draw(st.floats(0.05, 0.5)),
        )  # fmt: skip
    except ValueError:
        assume(False)
        raise


@given(st.one_of(_quads(), _grids(), _curves()), _boxes(), st.integers(0, 999))
@settings(max_examples=120)
def test_samples_stay_within_the_bounds(tree: ElevationFunction, box: Box, seed: int) -> None:
    _check_bounds(tree, box, seed)
    _check_bounds(tree, tree.support.grown(10.0), seed)


@given(st.one_of(_quads(), _grids(), _curves()), st.integers(0, 999))
@SETTINGS
def test_gradients_match_central_differences(tree: ElevationFunction, seed: int) -> None:
    box, dice = tree.support, np.random.default_rng(seed)
    _check_gradients(tree, Points(dice.uniform(box.west, box.east, 300), dice.uniform(box.south, box.north, 300)))


@given(st.one_of(_quads(), _grids(), _curves()))
@SETTINGS
def test_opencl_gives_the_same(device: Any, tree: ElevationFunction) -> None:
    box, shape = tree.support, (70, 75)
    grown = box.grown(0.1 * max(box.east - box.west, box.north - box.south))
    extent = Extent(grown.west, grown.south, grown.east, grown.north)
    height, weight = on_device(tree, extent, shape, device)
    exact = tree.query(grid(extent, shape))
    there = (exact.weight >= THRESHOLD) & (weight >= THRESHOLD)
    assert np.abs(weight - exact.weight).max() < 1e-4
    # Heights turn by up to 200 m within a cell of the raster, some of which are centimetres wide here.
    steep = tree.bounds(box).slope
    assert (
        np.abs(height - exact.height)[there].max(initial=0) < 0.01 + 1e-5 * steep * (extent.width + extent.height) / 70
    )


@given(st.one_of(_quads(), _grids(), _curves()))
@settings(max_examples=10)
def test_outside_its_support_a_raster_changes_nothing(device: Any, tree: ElevationFunction) -> None:
    both, shape = blend([Constant(17.3), tree]), (64, 64)
    extent = Extent(X - 1500, Y - 1500, X + 3500, Y + 3500)
    points = grid(extent, shape)
    outside = tree.query(points).weight == 0
    found = both.query(points)
    assert (found.height[outside] == 17.3).all()
    assert (found.weight[outside] == 1).all()
    height, weight = on_device(both, extent, shape, device)
    box = tree.support
    far = (
        (points.x < box.west - 1) | (points.x > box.east + 1) | (points.y < box.south - 1) | (points.y > box.north + 1)
    )
    assert (height[far] == np.float32(17.3)).all()
    assert (weight[far] == 1).all()


@given(st.one_of(_quads(), _grids(), _curves()))
@settings(max_examples=10)
def test_storing_changes_nothing(tree: ElevationFunction) -> None:
    again = codec.decode(codec.encode(tree))
    assert codec.seal(again) == codec.seal(tree)
    box = tree.support
    points = Points(np.linspace(box.west, box.east, 50), np.linspace(box.south, box.north, 50))
    assert np.array_equal(again.query(points).height, tree.query(points).height)


# A raster where it lies.


def test_a_raster_sampled_at_its_own_centres_is_itself(device: Any) -> None:
    for west, cell in ((0.0, 1.0), (1e5, 74.0), (1.9e5 + 0.3, 92.31)):
        surface = _jacksboro(west, west, cell)
        for data in (surface.data, _with_voids(surface.data)):
            tree = from_elevation(surface.like(data))
            height, weight = on_device(tree, surface.extent, surface.shape, device)
            height[weight < THRESHOLD] = np.nan
            assert np.array_equal(height.astype(np.float32), data.ravel(), equal_nan=True)
            found = tree.query(grid(surface.extent, surface.shape))
            exact = np.where(found.weight >= THRESHOLD, found.height, np.nan)
            assert np.array_equal(exact.astype(np.float32), data.ravel(), equal_nan=True)


def _with_voids(data: Any) -> Any:
    voids = data.copy()
    voids[100:120, 50:80] = np.nan
    voids[5, 5] = voids[0, 0] = np.nan
    voids[60:64, 70] = np.nan
    return voids


def test_the_weight_falls_to_0_over_the_margin() -> None:
    surface = _jacksboro()
    tree = from_elevation(surface, margin=900.0)
    x = X + np.array([-1.0, 0.0, 450.0, 900.0, 4000.0])
    weight = tree.query(Points(x, np.full(5, Y + 5000.0))).weight
    assert weight.tolist() == pytest.approx([0, 0, 0.5, 1, 1])


def test_bounds_of_a_real_raster_are_tight() -> None:
    tree = from_elevation(_jacksboro(), interpolation="bicubic")
    dice = np.random.default_rng(0)
    for size, heights, slopes in ((5.0, 3.0, 3.0), (300.0, 1.8, 1.8), (3000.0, 1.15, 1.4)):
        ratios = []
        for _ in range(20):
            x, y = X + dice.uniform(500, 8000), Y + dice.uniform(500, 6500)
            box = Box(x, y, x + size, y + size)
            found = tree.query(Points(*dice.uniform((x, y), (x + size, y + size), (4000, 2)).T), gradient=True)
            bounds = tree.bounds(box)
            assert found.height_gradient is not None
            ratios.append(
                (
                    (bounds.high - bounds.low) / np.ptp(found.height),
                    bounds.slope / np.hypot(*found.height_gradient).max(),
                )
            )
        assert np.median(ratios, axis=0)[0] < heights
        assert np.median(ratios, axis=0)[1] < slopes


# Quadrangles.


def test_places_on_a_quadrangle_come_back() -> None:
    shapes = [
        ((0, 1), (1, 1), (1, 0), (0, 0)),
        ((0, 1), (1, 1 + 1e-13), (1, 0), (0, 0)),
        ((0, 1), (1, 1 + 1e-7), (1 + 1e-9, 0), (0, 0)),
        ((0.1, 1.2), (2, 0.9), (1.1, 0), (0, 0)),
        ((0, 0), (1, 0), (1.1, 0.9), (0.2, 1.2)),
        ((0.3, 1), (0.7, 1), (1, 0), (0, 0)),
    ]
    for shape in shapes:
        corners = tuple((X + 1000 * x, Y + 1000 * y) for x, y in shape)
        tree = image_quad(_on(np.zeros((2, 2), np.float32)), corners=corners)
        assert isinstance(tree, ImageQuad)
        u, v = np.random.default_rng(0).uniform(0, 1, (2, 1000))
        weights = [(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v]
        x, y = (sum(w * corner[axis] for w, corner in zip(weights, corners, strict=True)) for axis in (0, 1))
        found = tree.place(np.asarray(x), np.asarray(y))
        assert np.abs(found[0] - u).max() < 1e-9
        assert np.abs(found[1] - v).max() < 1e-9


def test_a_rectangle_maps_as_the_raster_lies(device: Any) -> None:
    surface = _jacksboro(1e5, 1.9e5, 20.0)
    e = surface.extent
    corners = ((e.west, e.north), (e.east, e.north), (e.east, e.south), (e.west, e.south))
    tree = image_quad(surface, corners=corners, interpolation="bilinear", margin=100.0)
    height, weight = on_device(tree, e, surface.shape, device)
    there = weight >= THRESHOLD
    assert there.mean() > 0.95
    assert np.abs(height - surface.data.ravel())[there].max() < 0.01
    # Mirrored: the other way round.
    mirrored = image_quad(surface, corners=(corners[1], corners[0], corners[3], corners[2]), interpolation="bilinear")
    flipped, weight = on_device(mirrored, e, surface.shape, device)
    there = weight >= THRESHOLD
    assert np.abs(flipped - surface.data[:, ::-1].ravel())[there].max() < 0.01


def test_a_large_quadrangle_at_200_km_is_exact_to_a_centimetre(device: Any) -> None:
    tree = image_quad(
        _jacksboro(), corners=((1.0e5, 1.9e5), (1.6e5, 2.0e5), (2.0e5, 1.2e5), (1.2e5, 1.0e5)), interpolation="bicubic"
    )
    for place in ((1.5e5, 1.5e5), (1.2e5, 1.85e5), (1.8e5, 1.25e5)):
        extent, shape = Extent(place[0], place[1], place[0] + 128, place[1] + 128), (128, 128)
        height, _ = on_device(tree, extent, shape, device)
        assert np.abs(height - tree.query(grid(extent, shape)).height).max() < 0.01


def test_windows_of_a_quadrangle_agree(device: Any) -> None:
    tree = image_quad(_jacksboro(), corners=((X, Y + 900), (X + 800, Y + 1000), (X + 1100, Y), (X + 100, Y + 100)))
    whole, _ = on_device(tree, Extent(X + 200, Y + 200, X + 600, Y + 600), (200, 200), device)
    part, _ = on_device(tree, Extent(X + 260, Y + 222, X + 402, Y + 378), (78, 71), device)
    assert np.abs(whole.reshape(200, 200)[111:189, 30:101] - part.reshape(78, 71)).max() < 0.01


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        (((0.0, 1.0), (1.0, 1.0), (0.3, 0.5), (0.0, 0.0)), "concave"),
        (((0.0, 1.0), (1.0, 0.0), (1.0, 1.0), (0.0, 0.0)), "crosses itself"),
        (((0.0, 1.0), (1.0, 1.0), (2.0, 1.0), (0.0, 0.0)), "on a line"),
        (((0.0, 1.0), (0.0, 1.0), (1.0, 0.0), (0.0, 0.0)), "on a line"),
        (((0.0, 0.0),) * 4, "degenerate"),
        (((0.0, float("nan")), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)), "finite"),
    ],
)
def test_bad_quadrangles_are_refused(corners: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        image_quad(_jacksboro(), corners=corners)


def test_bad_rasters_are_refused() -> None:
    void = np.full((3, 3), np.nan, np.float32)
    with pytest.raises(ValueError, match="void everywhere"):
        from_elevation(_on(void))
    with pytest.raises(ValueError, match="infinite"):
        from_elevation(_on(np.full((3, 3), np.inf, np.float32)))
    with pytest.raises(ValueError, match="degrees"):
        from_elevation(sample_dem())
    with pytest.raises(ValueError, match="margin of 60 m"):
        from_elevation(_on(np.zeros((3, 3), np.float32)), margin=60.0)
    with pytest.raises(ValueError, match="another extent"):
        from_elevation(_on(np.zeros((3, 3), np.float32)), Mask(np.zeros((3, 3), np.float32), Extent(0, 0, 1, 1)))
    some = np.zeros((3, 3), np.float32)
    some[1, 1] = np.nan
    with pytest.raises(ValueError, match="own shape"):
        from_elevation(_on(some), _on(np.ones((5, 5), np.float32), Mask))
    with pytest.raises(ValueError, match="voids"):
        image_curve(_on(some), points=((0.0, 0.0), (100.0, 0.0)), width=10.0)


# Curves.

_WINDING = tuple((X + x, Y + y) for x, y in ((0, 0), (500, 300), (900, 900), (1400, 800), (1700, 200), (2400, 300)))


def test_the_curve_passes_through_its_points_without_a_corner() -> None:
    arcs = smooth_curve(np.array(_WINDING))
    ends = np.array([arc.at(arc.end) for arc in arcs])
    starts = np.array([(arc.x, arc.y, arc.east, arc.north) for arc in arcs])
    assert np.abs(ends[:-1] - starts[1:]).max() < 1e-6
    for point in _WINDING[1:]:
        assert np.hypot(*(ends[:, :2] - point).T).min() < 1e-6
    turn = np.linspace(0, 5, 12)
    circle = smooth_curve(1000 * np.column_stack([np.cos(turn), np.sin(turn)]))
    assert np.allclose([arc.curvature for arc in circle], 1e-3, rtol=1e-6)
    assert circle[-1].end == pytest.approx(5000, rel=1e-9)
    straight = smooth_curve(np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 0.0), (30.0, 0.0)]))
    assert [arc.curvature for arc in straight] == [0.0] * len(straight)
    assert straight[-1].end == pytest.approx(30)


def test_pictures_and_arcs_join_without_a_step() -> None:
    dice = np.random.default_rng(2)
    rasters = [_on((500 * dice.random((16, 24))).astype(np.float32)) for _ in range(3)]
    tree = image_curve(*rasters, points=_WINDING, width=150.0)
    assert isinstance(tree, ImageCurve)
    assert len(tree.spans) > 6
    limit = tree.bounds(tree.support).slope
    places, step = np.arange(0.0, tree.length - 0.06, 0.05), 0.06
    for d in (-140.0, -60.0, 0.0, 60.0, 140.0):
        line = np.array([_at(tree, s, d) for s in places])
        found = tree.query(Points(line[:, 0], line[:, 1]))
        inside = (places > 80) & (places < tree.length - 80)
        assert np.ptp(found.weight[inside]) < 1e-6
        assert np.abs(np.diff(found.height))[inside[1:]].max() < limit * step * 2


def _at(tree: ImageCurve, s: float, d: float) -> tuple[float, float]:
    arcs = tree._arcs
    arc = arcs[min(int(np.searchsorted([a.end for a in arcs], s)), len(arcs) - 1)]
    return arc.at(s, d)[:2]


def test_the_hair_between_arcs_keeps_to_the_bounds() -> None:
    dice = np.random.default_rng(2)
    tree = image_curve(_on((500 * dice.random((16, 24))).astype(np.float32)), points=_WINDING, width=180.0)
    assert isinstance(tree, ImageCurve)
    for index in range(1, len(tree._arcs)):
        arc = tree._arcs[index]
        for d in (-170.0, -90.0, 0.0, 90.0, 170.0):
            x, y, east, north = arc.at(arc.start, d)
            q = dice.uniform(-0.6, 0.6, 50) * tree._hair
            around = Box(*(float(v) for v in (x, y, x, y))).grown(tree._hair)
            bounds, sample = tree.bounds(around), tree.query(Points(x + q * east, y + q * north), gradient=True)
            assert sample.height_gradient is not None
            assert sample.weight_gradient is not None
            assert np.hypot(*sample.height_gradient).max() <= bounds.slope * (1 + 1e-9)
            assert np.hypot(*sample.weight_gradient).max() <= bounds.weight_slope * (1 + 1e-9) + 1e-12
            single = tree.query(Points(x + q[:1] * east, y + q[:1] * north))
            assert single.weight[0] == pytest.approx(sample.weight[0], abs=1e-12)


def test_a_curve_at_200_km_is_exact_to_a_centimetre(device: Any) -> None:
    points = tuple((1.9e5 + 10 * (x - X), 1.9e5 + 10 * (y - Y)) for x, y in _WINDING)
    tree = image_curve(_jacksboro(), points=points, width=1500.0)
    for place in (points[1], points[3]):
        extent, shape = Extent(place[0] - 128, place[1] - 128, place[0] + 128, place[1] + 128), (256, 256)
        height, weight = on_device(tree, extent, shape, device)
        exact = tree.query(grid(extent, shape))
        assert np.abs(weight - exact.weight).max() < 1e-5
        assert np.abs(height - exact.height).max() < 0.01


def test_a_curve_that_meets_itself_blends() -> None:
    loop = ((0.0, 0.0), (1000.0, 0.0), (1500.0, 500.0), (1000.0, 1000.0), (500.0, 500.0), (500.0, -800.0))
    tree = image_curve(
        _on(np.random.default_rng(0).random((9, 9)).astype(np.float32)), points=tuple((X + x, Y + y) for x, y in loop),
        width=120.0,
    )  # fmt: skip
    found = tree.query(grid(Extent(X - 200, Y - 1000, X + 1800, Y + 1200), (300, 300)))
    assert found.weight.max() > 1.5
    for size in (30.0, 300.0):
        _check_bounds(tree, Box(X + 500 - size, Y - size, X + 500 + size, Y + size), 1, 3000)


@pytest.mark.parametrize(
    ("points", "width", "message"),
    [
        (((0.0, 0.0), (0.0, 0.0)), 10.0, "two distinct"),
        (((0.0, 0.0), (100.0, 0.0), (0.0, 0.0)), 10.0, "doubles back"),
        (((0.0, 0.0), (100.0, 0.0), (100.0, 100.0)), 90.0, "too sharply for a width"),
        (((0.0, 0.0), (float("nan"), 0.0)), 10.0, "finite"),
        (tuple((float(x), 0.0) for x in range(20_001)), 10.0, "simplify"),
    ],
)
def test_bad_curves_are_refused(points: Any, width: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        image_curve(_jacksboro(), points=points, width=width)


def test_rasters_repeat_or_stretch() -> None:
    flat = _on(np.zeros((4, 4), np.float32))
    line = ((0.0, 0.0), (2000.0, 0.0))
    repeated = image_curve(flat, points=line, width=100.0, overlap=0.2)
    stretched = image_curve(flat, flat, points=line, width=100.0, fit="stretch", overlap=0.2)
    assert isinstance(repeated, ImageCurve)
    assert isinstance(stretched, ImageCurve)
    assert len(repeated.spans) in (12, 13)
    assert len(stretched.spans) == 2
    for tree in (repeated, stretched):
        assert tree.spans[-1, 2] == pytest.approx(2000)
        assert (tree.spans[:-1, 2] - tree.spans[1:, 1]).tolist() == pytest.approx(
            [tree.overlap] * (len(tree.spans) - 1)
        )
