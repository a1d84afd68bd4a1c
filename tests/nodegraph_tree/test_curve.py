"""Curve primitives: distances, continuation off the curve, bounds, OpenCL, and the ready rivers, roads and ridges."""

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
from nodegraph_tree.curve import Curve, curve
from nodegraph_tree.disc import disc, noise
from nodegraph_tree.function import THRESHOLD, Box, ElevationFunction, Points, numeric_gradient, walk
from nodegraph_tree.geometry import bezier_spans, catmull_rom_spans, trace
from nodegraph_tree.layout import divided, line_of
from nodegraph_tree.replace import replace
from nodegraph_tree.ridge import ridge
from nodegraph_tree.river import river
from nodegraph_tree.road import alignment, road

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


_PLACES = st.tuples(st.floats(-500, 500), st.floats(-500, 500), st.floats(-60, 120)).map(
    lambda p: (X0 + round(p[0], 2), Y0 + round(p[1], 2), round(p[2], 2))
)
_SECTIONS = [
    ((0.0, 0.0),),
    ((0.0, -4.0), (6.0, 0.0), (40.0, 6.0), (120.0, 30.0)),
    ((-120.0, 40.0), (-10.0, 0.0), (0.0, -4.0), (20.0, 5.0), (90.0, -20.0)),
]


@st.composite
def curves(draw: Any) -> Curve:
    kind = draw(st.sampled_from(["polyline", "catmull_rom", "catmull_rom", "quadratic", "cubic"]))
    count = draw(st.integers(1, 6)) if kind in ("polyline", "catmull_rom") else {"quadratic": 5, "cubic": 7}[kind]
    points = [draw(_PLACES) for _ in range(count)]
    if draw(st.booleans()):
        points = [point[:2] for point in points]
    if count > 1 and draw(st.booleans()):
        points[-1] = points[0]  # closed, or a point that is doubled
    radius = draw(st.sampled_from([40.0, 130.0, 300.0]))
    return curve(
        points=tuple(points),
        kind=kind,
        sections=tuple(draw(st.lists(st.sampled_from(_SECTIONS), min_size=1, max_size=3))),
        shape=draw(st.sampled_from(["smooth", "straight"])),
        width=draw(st.sampled_from([1.0, (0.5, 1.5)])),
        radius=draw(st.sampled_from([radius, (radius, 0.6 * radius, radius)])),
        core=draw(st.sampled_from([0.0, 0.4 * radius])),
        slope=draw(st.sampled_from([0.0, -0.03])),
        fall_off=draw(st.sampled_from(["wyvill", "cubic", "plateau"])),
    )


# Any curve.


@settings(max_examples=60, deadline=None)
@given(curves(), windows())
def test_values_and_slopes_stay_within_bounds(tree: Curve, window: Window) -> None:
    sample = tree.query(window.points, gradient=True)
    bounds = tree.bounds(window.box)
    assert np.isfinite(sample.height).all()
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
    near = tree.support
    outside = (window.points.x < near.west) | (window.points.x > near.east)
    assert not sample.weight[outside].any()


@settings(max_examples=40, deadline=None)
@given(curves(), st.integers(0, 2**20), st.sampled_from([1e-3, 0.1, 5.0]))
def test_heights_have_no_steps(tree: Curve, seed: int, step: float) -> None:
    # Near the curves and their medial axes: between two points nothing may rise faster than the bound of the slope.
    dice = np.random.default_rng(seed)
    box = tree.support
    x, y = dice.uniform(box.west, box.east, 3000), dice.uniform(box.south, box.north, 3000)
    turn = dice.uniform(0, 2 * np.pi, 3000)
    one, two = tree.query(Points(x, y)), tree.query(Points(x + step * np.cos(turn), y + step * np.sin(turn)))
    middle = tree.query(Points(x + 0.5 * step * np.cos(turn), y + 0.5 * step * np.sin(turn)))
    on = (one.weight > 0) & (two.weight > 0) & (middle.weight > 0)
    if step == 5.0:  # the way between them may leave the support
        on &= np.minimum(one.weight, two.weight) > tree.bounds(box).weight_slope * 5.0
    limit = tree.bounds(box).support_slope * step * SLACK + 1e-7
    assert np.abs(one.height - two.height)[on].max(initial=0) <= limit
    assert np.abs(one.weight - two.weight).max() <= tree.bounds(box).weight_slope * step * SLACK + 1e-9


@settings(max_examples=25, deadline=None)
@given(curves(), st.integers(0, 2**20))
def test_gradients_match_differences(tree: Curve, seed: int) -> None:
    dice = np.random.default_rng(seed)
    box = tree.support
    points = Points(dice.uniform(box.west, box.east, 800), dice.uniform(box.south, box.north, 800))
    sample = tree.query(points, gradient=True)
    assert sample.height_gradient is not None
    assert sample.weight_gradient is not None
    f, a = numeric_gradient(tree, points, 1e-4)
    inside = sample.weight > 1e-6
    scale = 1 + tree.bounds(box).support_slope
    wrong = np.hypot(*(f - sample.height_gradient))[inside] > 1e-4 * scale
    # Creases are lines: a sample hardly ever lies on one, to 0.1 mm.
    assert wrong.mean() < 0.01 if inside.any() else True
    assert (np.hypot(*(a - sample.weight_gradient)) > 1e-5).mean() < 0.01


@settings(max_examples=15, deadline=None)
@given(curves())
def test_the_device_agrees(device: Any, tree: Curve) -> None:
    height, weight = on_device(tree, EXTENT, (96, 96), device)
    sample = tree.query(grid(EXTENT, (96, 96)))
    np.testing.assert_allclose(weight, sample.weight, atol=5e-5)
    there = (sample.weight > THRESHOLD + 1e-4) & (weight >= THRESHOLD)
    room = 1e-3 * (1 + tree.bounds(tree.support).support_slope)
    np.testing.assert_allclose(height[there], sample.height[there], atol=min(room, 0.01))


@settings(max_examples=20, deadline=None)
@given(curves())
def test_storage_keeps_everything(tree: Curve) -> None:
    codec.seal(tree)
    again = codec.decode(codec.encode(tree))
    assert codec.seal(again) == codec.seal(tree)
    points = grid(EXTENT, (20, 20))
    assert np.array_equal(again.query(points).height, tree.query(points).height)


# What a curve is.


def test_beside_a_curve_it_is_the_section_at_the_nearest_point() -> None:
    tree = curve(points=((0, 0, 50), (400, 0, 30)), kind="polyline", sections=(((-50, 9), (0, 1), (50, 4)),), radius=60)
    x = np.array([100.0, 100.0, 350.0, 200.0])
    y = np.array([0.0, 50.0, -50.0, 61.0])
    sample = tree.query(Points(x, y))
    np.testing.assert_allclose(sample.height, [46.0, 49.0, 41.5, 0.0], atol=1e-9)
    assert sample.weight[0] == 1
    assert sample.weight[3] == 0


def test_splitting_a_straight_line_changes_nothing() -> None:
    whole = curve(points=((0, 0, 50), (400, 0, 30)), kind="polyline", sections=(_SECTIONS[2],), radius=100)
    x = np.linspace(0, 400, 41)
    parts = curve(points=tuple((p, 0, 50 - p / 20) for p in x), kind="polyline", sections=(_SECTIONS[2],), radius=100)
    points = grid(Extent(80, -60, 320, 60), (60, 120))  # beyond its ends a line goes on by its last arc
    np.testing.assert_allclose(parts.query(points).height, whole.query(points).height, atol=0.02)
    near = Points(points.x, 0.1 * points.y)
    np.testing.assert_allclose(parts.query(near).height, whole.query(near).height, atol=1e-9)


def test_sections_change_along_the_curve_and_width_and_radius_with_them() -> None:
    tree = curve(
        points=((0, 0), (1000, 0)), kind="polyline", sections=(((0, 0), (10, 5)), ((0, 10), (10, 15))),
        width=(1.0, 2.0), radius=(20.0, 40.0),
    )  # fmt: skip
    x, y = np.array([1.0, 250.0, 500.0, 750.0]), np.zeros(4)
    np.testing.assert_allclose(tree.query(Points(x, y)).height, x / 100, atol=1e-6)
    edge = 20 + 20 * x / 1000
    assert (tree.query(Points(x, edge - 0.1)).weight > 0).all()
    assert not tree.query(Points(x, edge + 0.1)).weight.any()


@pytest.mark.parametrize("kind", ["quadratic", "cubic", "catmull_rom"])
def test_smooth_curves_are_within_tolerance_and_keep_their_tangent(kind: str) -> None:
    nodes = np.array([[0, 0], [100, 200], [300, -50], [350, 300], [600, 100], [500, -200], [900, 0]], float)
    spans = catmull_rom_spans(nodes) if kind == "catmull_rom" else bezier_spans(nodes, 2 if kind == "quadratic" else 3)
    track = trace(spans, 0.01).track
    t = np.linspace(0, 1, 400)[:, None, None]
    p = spans.transpose(1, 0, 2)
    u = 1 - t
    exact = (u**3 * p[0] + 3 * u * t * (u * p[1] + t * p[2]) + t**3 * p[3]).reshape(-1, 2)
    line = curve(points=tuple(map(tuple, nodes)), kind=kind, radius=50.0)  # type: ignore[arg-type]
    bone = line.skeleton
    off = bone.project(exact[:, 0], exact[:, 1], np.arange(len(bone))).distance.min(axis=1)
    assert off.max() < 0.012
    chord = np.diff(track.nodes, axis=0)
    heading = np.arctan2(chord[:, 1], chord[:, 0])
    turn = np.angle(np.exp(1j * ((heading[1:] - track.bend[1:]) - (heading[:-1] + track.bend[:-1]))))
    joint = np.ones(len(turn), bool)
    if kind != "catmull_rom":  # chained curves may have corners
        joint[track.marks[1:-1] - 1] = False
    assert np.abs(turn[joint]).max() < 1e-6
    if kind == "catmull_rom":
        np.testing.assert_allclose(track.nodes[track.marks], nodes, atol=1e-9)


def test_a_division_of_a_line_leaves_its_shape() -> None:
    line = line_of([(0, 0, 1), (100, 50, 4), (200, -50, 2), (300, 0, 8)], "catmull_rom")
    finer = divided(line, np.array([3.0, 50.0, 51.0, 180.0]))
    assert len(finer.track.nodes) == len(line.track.nodes) + 4
    assert finer.track.along[-1] == pytest.approx(line.track.along[-1])
    np.testing.assert_allclose(finer.track.nodes[finer.track.marks], line.track.nodes[line.track.marks])
    at = np.linspace(0, line.track.along[-1], 50)
    heights = [np.interp(at, item.track.along, item.height) for item in (line, finer)]
    np.testing.assert_allclose(*heights, atol=0.1)


def test_odd_curves_work() -> None:
    single = curve(points=((5, 5, 7),), sections=(((0, 1), (10, 2)),), radius=20)
    sample = single.query(Points(np.array([5.0, 15.0, 26.0]), np.array([5.0, 5.0, 5.0])))
    np.testing.assert_allclose(sample.height, [8, 9, 0])
    np.testing.assert_allclose(sample.weight, [1, (1 - 0.25) ** 3, 0])
    repeated = curve(points=((0, 0), (0, 0), (50, 0), (50, 0), (90, 40)), radius=20)
    assert np.isfinite(repeated.query(grid(Extent(-50, -50, 150, 150), (40, 40))).height).all()
    points = [(np.cos(t) * 100, np.sin(2 * t) * 60, 10 * t) for t in np.linspace(0.2, 6.0, 40)]
    crossing = curve(points=tuple(points), radius=40.0, sections=(_SECTIONS[1],))
    x = np.linspace(-60, 60, 20001)
    sample = crossing.query(Points(x, np.zeros_like(x)))
    rise = (np.diff(sample.height) / np.diff(x))[(sample.weight[1:] > 0) & (sample.weight[:-1] > 0)]
    assert len(rise) > 5000
    assert np.abs(rise).max() <= crossing.bounds(crossing.support).support_slope


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"points": ()}, "at least one"),
        ({"points": ((0, 0), (1, 1, 1))}, "all be"),
        ({"points": ((0, 0), (float("nan"), 1))}, "finite"),
        ({"points": ((0, 0), (1, 1)), "kind": "cubic"}, "3 n \\+ 1"),
        ({"radius": 0.0}, "greater than 0"),
        ({"radius": (5.0, -1.0)}, "greater than 0"),
        ({"core": 100.0}, "less than radius"),
        ({"core": -1.0}, "negative"),
        ({"sections": ()}, "sections are empty"),
        ({"sections": (((1, 0), (0, 0)),)}, "rise"),
        ({"positions": (0.0, 0.5)}, "as many"),
        ({"sections": (_SECTIONS[0],) * 2, "positions": (0.5, 0.5)}, "rise within"),
        ({"width": ()}, "width"),
    ],
)
def test_what_makes_no_curve_is_refused(change: dict[str, Any], problem: str) -> None:
    given: dict[str, Any] = {"points": ((0.0, 0.0), (50.0, 10.0)), "radius": 50.0}
    with pytest.raises(ValueError, match=problem):
        curve(**{**given, **change})


@pytest.mark.slow
def test_a_million_points(device: Any) -> None:
    dice = np.random.default_rng(1)
    turn = np.cumsum(dice.normal(0, 0.02, 1_000_000))
    points = np.stack(
        [np.cumsum(np.cos(turn)), np.cumsum(np.sin(turn)), np.cumsum(dice.normal(0, 0.002, 1_000_000))], axis=1
    )
    tree = curve(points=points.tolist(), kind="polyline", radius=50.0, sections=(_SECTIONS[1],))  # type: ignore[arg-type]
    x, y = points[500_000, :2].tolist()
    extent = Extent(x - 100, y - 100, x + 100, y + 100)
    height, weight = on_device(tree, extent, (64, 64), device)
    sample = tree.query(grid(extent, (64, 64)))
    np.testing.assert_allclose(weight, sample.weight, atol=1e-5)
    there = ~np.isnan(height)
    np.testing.assert_allclose(height[there], sample.height[there], atol=0.005)
    assert 0 < tree.bounds(Box(x - 1, y - 1, x + 1, y + 1)).support_slope < 5


def test_windows_of_a_sample_are_equal(device: Any) -> None:
    tree = river(points=((X0 - 500, Y0 - 400), (X0, Y0 + 100), (X0 + 500, Y0)), width=20.0, radius=200.0)
    whole = on_device(tree, EXTENT, (240, 240), device)
    part = on_device(tree, Extent(X0 - 600, Y0 - 200, X0 + 200, Y0 + 600), (160, 160), device)
    for big, small in zip(whole, part, strict=True):
        inner, small = big.reshape(240, 240)[:160, :160], small.reshape(160, 160)
        both = ~np.isnan(inner) & ~np.isnan(small)
        np.testing.assert_allclose(inner[both], small[both], atol=1e-3)


# Ready profiles.

_MAIN = ((X0 - 100, Y0 + 550, 40), (X0, Y0 + 100, 30), (X0 - 200, Y0 - 200, 22), (X0, Y0 - 550, 10))
_SIDE = ((X0 - 500, Y0 + 400, 60), (X0 - 300, Y0 + 200, 45), (X0 - 30, Y0 + 90, 33))


@pytest.mark.parametrize("kind", ["stream", "river", "meander", "main_stem", "braided"])
def test_rivers_join_without_a_step(kind: Any, device: Any) -> None:
    tree = replace(
        Plane(60.0, 0.0, 0.0), [river(points=_MAIN, tributaries=(_SIDE,), kind=kind, width=16.0, radius=150.0, seed=5)]
    )
    assert any(isinstance(node, Curve) for node in walk(tree))
    # A fine net over the junction.
    extent = Extent(X0 - 60, Y0 + 40, X0 + 60, Y0 + 160)
    box = Box(extent.west, extent.south, extent.east, extent.north)
    f = tree.query(grid(extent, (300, 300))).height.reshape(300, 300)
    step = max(np.abs(np.diff(f, axis=axis)).max() for axis in (0, 1))
    assert step <= 0.4 * tree.bounds(box).slope * SLACK
    assert step < 1.0  # in fact: banks are this steep, junctions are not
    height, _ = on_device(tree, EXTENT, (128, 128), device)
    np.testing.assert_allclose(height, tree.query(grid(EXTENT, (128, 128))).height, atol=0.01)


def _crease(tree: ElevationFunction, x: float, y: float, radii: tuple[float, ...]) -> float:
    """Return the greatest jump of the gradient on circles: what is left of its greatest changes on ways 0.1 mm long."""
    found = []
    for radius in radii:
        turn = np.linspace(0, 2 * np.pi, 20001)
        points = Points(x + radius * np.cos(turn), y + radius * np.sin(turn))
        sample = tree.query(points, gradient=True)
        assert sample.height_gradient is not None
        on = np.minimum(sample.weight[1:], sample.weight[:-1]) > 0.02  # at the edge of the support nothing is seen
        change = np.where(on, np.hypot(*np.diff(sample.height_gradient, axis=1)), 0.0)
        for place in np.argsort(change)[-40:].tolist():
            fine = np.linspace(turn[place], turn[place + 1], 1 + int(2 * np.pi * radius / 20000 / 1e-4))
            near = tree.query(Points(x + radius * np.cos(fine), y + radius * np.sin(fine)), gradient=True)
            assert near.height_gradient is not None
            found.append(float(np.hypot(*np.diff(near.height_gradient, axis=1)).max()))
    return max(found)


def test_confluences_have_no_creases() -> None:
    # The valleys of three branches and the beds in them; the spurs of a ridge.
    water = river(
        points=((X0 - 1200, Y0 - 200, 300), (X0, Y0, 285), (X0 + 1200, Y0 + 100, 270)), width=(30.0, 60.0), depth=9.0,
        tributaries=(((X0 - 1000, Y0 + 900, 330), (X0 - 400, Y0 + 450, 300), (X0, Y0, 285)),), radius=300.0,
    )  # fmt: skip
    crest = ridge(
        points=((X0 - 1200, Y0, 500), (X0, Y0 + 60, 520), (X0 + 1200, Y0, 480)), radius=300.0, drop=150.0, crest=30.0,
        spurs=(((X0 + 300, Y0 + 900, 380), (X0 + 150, Y0 + 400, 450), (X0, Y0 + 60, 520)),),
    )  # fmt: skip
    for tree in (water, crest):
        smooth = _crease(tree, X0 + 800, Y0, (25.0, 80.0, 250.0))
        assert smooth < 1e-3
        # As smooth as far from it.  By the nearest point on one skeleton of all branches it would be 1.5 and 1.2.
        assert _crease(tree, X0, Y0, (25.0, 80.0, 160.0, 250.0)) < 5 * smooth + 1e-4


def test_heights_beside_short_arcs_are_those_of_the_nearest_point() -> None:
    # Arcs of centimetres between long ones.
    track = ((0, 0, 0), (200, 0, 30), *((200 + 0.02 * k, 0, 30 + 0.003 * k) for k in range(1, 40)), (400, 0, 60))
    tree = curve(points=track, kind="polyline", radius=30.0)
    x, y = (item.ravel() for item in np.meshgrid(np.linspace(180, 220, 401), np.linspace(-25, 25, 21)))
    sample = tree.query(Points(x, y), gradient=True)
    np.testing.assert_allclose(sample.height, 0.15 * x, atol=0.005)
    assert sample.height_gradient is not None
    assert np.abs(sample.height_gradient[0] - 0.15).max() < 0.01


def test_two_rivers_that_meet_blend_without_a_step() -> None:
    meet = (X0, Y0, 20.0)
    one = river(points=((X0 - 400, Y0 + 300, 40), (X0 - 200, Y0 + 100, 30), meet), width=16.0, radius=150.0)
    two = river(points=((X0 + 400, Y0 + 300, 50), (X0 + 200, Y0 + 150, 35), meet), width=16.0, radius=150.0)
    both = blend([one, two])
    for tree in (both, replace(Plane(40.0, 0.0, 0.0), [both])):
        steps = []
        for count in (200, 400):
            f = tree.query(grid(Extent(X0 - 10, Y0 - 10, X0 + 10, Y0 + 10), (count, count))).height.reshape(
                count, count
            )
            steps.append(max(np.abs(np.diff(f, axis=axis)).max() for axis in (0, 1)))
        assert steps[1] < 0.6 * steps[0]  # halving the cells halves the steps


def test_rivers_run_downhill_and_follow_a_terrain() -> None:
    hills = noise(height=300.0, amplitude=80.0, wavelength=700.0, octaves=4, seed=4, centre=CENTRE)
    tree = river(hills, points=tuple(point[:2] for point in _MAIN), width=(8.0, 24.0), radius=120.0)
    assert isinstance(tree, Curve)
    heights = tree.skeleton.height[:, :2]
    assert (np.diff(heights.ravel()) <= 1e-9).all()
    start = hills.query(Points(np.array([_MAIN[0][0]]), np.array([_MAIN[0][1]]))).height[0]
    assert heights[0, 0] == pytest.approx(start)
    rising = river(points=((0, 0, 10), (100, 0, 30), (200, 0, 5)), width=5.0, radius=40.0)
    assert isinstance(rising, Curve)
    assert rising.skeleton.height[:, :2].max() == 10
    with pytest.raises(ValueError, match="leaves its terrain"):
        river(disc(centre=CENTRE, radius=100.0), points=tuple(point[:2] for point in _MAIN))
    with pytest.raises(ValueError, match="one width"):
        river(points=_MAIN, kind="meander", width=(1.0, 2.0))
    with pytest.raises(ValueError, match="more than the width"):
        river(points=_MAIN, width=300.0)


def test_roads_are_level_across_and_bend_in_clothoids(device: Any) -> None:
    corners = ((X0 - 500, Y0 - 500), (X0, Y0 - 400), (X0 + 100, Y0 + 200), (X0 + 500, Y0 + 300))
    hills = noise(height=300.0, amplitude=40.0, wavelength=500.0, octaves=4, seed=4, centre=CENTRE)
    tree = road(hills, points=corners, width=8.0, shoulder=1.0, camber=0.02, radius=40.0, bend_radius=100.0)
    assert isinstance(tree, Curve)
    curvature = np.abs(tree.skeleton.frames.curvature)
    assert curvature.max() == pytest.approx(0.01, rel=0.02)
    assert np.abs(np.diff(curvature)).max() < 0.003
    x, y = X0 - 260.0, Y0 - 452.0
    across = Points(x - np.array([0.0, 3.0]) * 0.196, y + np.array([0.0, 3.0]) * 0.98)
    sample = tree.query(across)
    assert (sample.weight == 1).all()
    assert abs(sample.height[0] - sample.height[1]) < 0.1
    scene = replace(hills, [tree])
    height, _ = on_device(scene, EXTENT, (128, 128), device)
    np.testing.assert_allclose(height, scene.query(grid(EXTENT, (128, 128))).height, atol=0.01)
    with pytest.raises(ValueError, match="radius must be more"):
        road(points=corners, width=100.0)


@given(st.floats(-3.0, 3.0), st.floats(0, 1), st.floats(1, 500))
def test_alignments_keep_their_tangent_and_their_radius(turn: float, easing: float, radius: float) -> None:
    nodes = np.array([[0, 0], [200, 0], [200 + 150 * np.cos(turn), 150 * np.sin(turn)]])
    track = alignment(nodes, radius, easing)
    chord = np.diff(track.nodes, axis=0)
    size = np.hypot(*chord.T)
    heading = np.arctan2(chord[:, 1], chord[:, 0])
    joint = np.angle(np.exp(1j * ((heading[1:] - track.bend[1:]) - (heading[:-1] + track.bend[:-1]))))
    assert np.abs(joint[(size[1:] > 1e-6) & (size[:-1] > 1e-6)]).max(initial=0) < 1e-5
    # The curvature of an arc averages that of the clothoid under it.
    if abs(turn) > 0.05:
        tightest = 2 * np.abs(np.sin(track.bend[size > 1e-6])) / size[size > 1e-6]
        assert tightest.max() >= 0.9 / radius
    assert track.lengths.sum() <= 350 + 1e-6


def test_ridges_have_crests_flanks_and_spurs(device: Any) -> None:
    tree = ridge(
        points=((X0 - 400, Y0, 300), (X0 + 400, Y0, 300)), spurs=(((X0, Y0 + 400, 200), (X0, Y0 + 20, 250)),),
        kind="polyline", radius=200.0, drop=100.0, concavity=1.0, crest=10.0,
    )  # fmt: skip
    sample = tree.query(Points(np.array([X0 - 200.0] * 3), Y0 - np.array([0.0, 100.0, 199.9])))
    assert sample.height[0] == pytest.approx(300)
    assert sample.height[2] == pytest.approx(205, abs=2)
    assert sample.height[0] > sample.height[1] > sample.height[2]
    spur = tree.query(Points(np.array([X0, X0]), Y0 + np.array([0.0, 300.0])))
    assert spur.height[0] == pytest.approx(300, abs=1)
    rough = ridge(points=((X0 - 400, Y0), (X0 + 400, Y0)), roughness=30.0, radius=300.0, core=100.0)
    height, _ = on_device(rough, EXTENT, (128, 128), device)
    sample = rough.query(grid(EXTENT, (128, 128)), gradient=True)
    there = ~np.isnan(height)
    np.testing.assert_allclose(height[there], sample.height[there], atol=0.01)
    bounds = rough.bounds(rough.support)
    assert sample.height_gradient is not None
    assert np.hypot(*sample.height_gradient).max() <= bounds.support_slope
    assert bounds.low <= sample.height[sample.weight > 0].min()
    with pytest.raises(ValueError, match="less than radius"):
        ridge(points=((0, 0), (1, 1)), crest=900.0)
