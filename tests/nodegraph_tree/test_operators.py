"""The operators one by one: their formulas, their edges, what they refuse, how tight their bounds are."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from nodegraph import codec
from nodegraph_terrain.raster import Extent
from nodegraph_tree import by_terrain, operators
from nodegraph_tree.add import Add
from nodegraph_tree.affine import Affine
from nodegraph_tree.basic import Constant, Plane
from nodegraph_tree.blend import Blend, blend, greatest_mean
from nodegraph_tree.carve import Carve
from nodegraph_tree.detail import LevelOfDetail
from nodegraph_tree.disc import Disc, NoiseField, Relief
from nodegraph_tree.function import MAX_DEPTH, THRESHOLD, Bounds, Box, ElevationFunction, Points, Sample, depth
from nodegraph_tree.layers import layer, layers, sample_layer
from nodegraph_tree.replace import Replace, replace
from nodegraph_tree.statistics import tree_statistics
from tests.nodegraph_tree.strategies import Bump, grid, on_device

FLAT = Relief()
AREA = Extent(-1000.0, -1000.0, 1000.0, 1000.0)


def hill(x: float = 0.0, y: float = 0.0, radius: float = 800.0, height: float = 100.0) -> Disc:
    return Disc(x, y, radius, height, FLAT)


def rough(x: float = 0.0, y: float = 0.0, radius: float = 800.0, height: float = 100.0, seed: int = 1) -> Disc:
    return Disc(x, y, radius, height, Relief("fbm", 60.0, 300.0, 4, seed=seed))


def at(tree: ElevationFunction, *places: tuple[float, float], detail: float = 1.0) -> Sample:
    x, y = np.array(places, np.float64).T
    return tree.query(Points(x, y, detail), gradient=True)


@pytest.fixture(scope="module")
def device() -> Any:
    from nodegraph.opencl import choose

    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


# Blend.


def test_blend_is_the_weighted_mean() -> None:
    first, second = hill(-200, 0, 900, 10), hill(200, 0, 700, 50)
    found = at(operators.blend(first, second), (0, 0), (100, 50), (-900, 0))
    a, b = at(first, (0, 0), (100, 50), (-900, 0)), at(second, (0, 0), (100, 50), (-900, 0))
    weight = a.weight + b.weight
    assert np.allclose(found.weight, weight)
    assert np.allclose(found.height, (a.weight * a.height + b.weight * b.height) / weight)


def test_blend_does_not_depend_on_the_order_and_blends_of_blends_are_one() -> None:
    dice = np.random.default_rng(3)
    parts = [rough(*dice.uniform(-500, 500, 2), height=float(h), seed=int(h)) for h in dice.integers(0, 400, 12)]
    points = grid(AREA, (40, 40))
    one = operators.blend(*parts).query(points)
    nested = operators.blend(operators.blend(*parts[6:9], operators.blend(*parts[9:])), *parts[:6])
    assert isinstance(nested, Blend)
    assert len(nested.operands) == 12
    other = nested.query(points)
    assert np.allclose(one.height, other.height, rtol=1e-13, atol=1e-10)
    assert np.allclose(one.weight, other.weight, rtol=1e-13)


def test_where_a_part_does_not_reach_a_blend_is_unchanged_bit_for_bit(device: Any) -> None:
    ground = blend([rough(seed=5), rough(100, 50, seed=6)])
    far = hill(900, 0, 400, 77.0)
    points = grid(AREA, (64, 64))
    away = far.query(points).weight == 0
    for tree in (blend([ground, far]), blend([far, ground]), Replace(ground, (far,), True), Replace(ground, (far,)),
                 Add(ground, far), Carve(ground, far), Carve(ground, far, 20.0, True)):  # fmt: skip
        expected, found = ground.query(points), tree.query(points)
        if not isinstance(tree, Blend) or tree.operands[0] is not far:  # another order of the others, another rounding
            assert np.array_equal(expected.height[away], found.height[away])
            assert np.array_equal(expected.weight[away], found.weight[away])
            heights, weights = on_device(ground, AREA, (64, 64), device)
            height, weight = on_device(tree, AREA, (64, 64), device)
            assert np.array_equal(heights[away], height[away], equal_nan=True)
            assert np.array_equal(weights[away], weight[away])


def test_the_blend_bound_is_that_of_the_design_page_for_two_parts() -> None:
    first, second = Bump(0.0, 0.0, 1000.0, 5.0), Bump(600.0, 0.0, 1000.0, 40.0)
    box = Box(100.0, -200.0, 500.0, 200.0)
    a, b, found = first.bounds(box), second.bounds(box), blend([first, second]).bounds(box)
    spread = max(a.high - b.low, b.high - a.low)
    least = max(a.weight_low + b.weight_low, THRESHOLD)
    assert found.slope <= max(a.slope, b.slope) + max(a.weight_slope, b.weight_slope) * spread / least + 1e-12


def test_the_blend_bound_covers_the_counter_example_to_the_printed_one() -> None:
    """Where both weights are small the printed bound, without 1 / alpha, is exceeded."""
    first, second = hill(-600, 0, 1000, 0.0), hill(600, 0, 1000, 500.0)
    tree, box = blend([first, second]), Box(-100.0, -100.0, 100.0, 100.0)
    points = grid(Extent(*box), (80, 80))
    sample = tree.query(points, gradient=True)
    assert sample.height_gradient is not None
    ground = sample.weight >= THRESHOLD
    steepest = np.hypot(*sample.height_gradient)[ground].max()
    a, b = first.bounds(box), second.bounds(box)
    printed = max(a.slope, b.slope) + max(a.weight_slope, b.weight_slope) * 500
    assert printed < steepest <= tree.bounds(box).slope <= 3 * steepest


def test_the_greatest_mean_is_that_of_the_best_weights() -> None:
    dice = np.random.default_rng(5)
    for _ in range(200):
        count = int(dice.integers(1, 6))
        values, least = dice.normal(size=count), dice.random(count) * dice.integers(0, 2, count)
        most = least + dice.random(count) + 1e-3
        corners = [np.where(choice, most, least) for choice in itertools.product([False, True], repeat=count)]
        best = max(float(weight @ values / weight.sum()) for weight in corners if weight.sum() > 0)
        assert greatest_mean(values, least, most) == pytest.approx(best, abs=1e-9)


def test_many_parts_have_a_bound_that_does_not_grow_with_their_number() -> None:
    """Level parts over a level ground: no slope whatever their number, and a small one for small differences."""
    dice = np.random.default_rng(0)
    same = blend([hill(*dice.uniform(-900, 900, 2), 500, 30.0) for _ in range(600)])
    assert same.bounds(Box(-500, -500, 500, 500)).slope == 0
    few, many = (
        blend([Constant(0.0), *(hill(*dice.uniform(-900, 900, 2), 500, 30.0) for _ in range(count))]).bounds(
            Box(-50, -50, 50, 50)
        )
        for count in (20, 200)
    )
    assert many.slope < 20 * few.slope


# Replace.


def test_replacement_is_in_order_and_clamps_the_weight() -> None:
    double = blend([hill(height=50.0), hill(height=50.0)])  # of weight 2 in the middle
    tree = operators.replace(Constant(10.0), double, hill(height=7.0, radius=100.0))
    assert np.allclose(at(tree, (0, 0), (150, 0), (900, 0)).height, [7.0, 50.0, 10.0])
    assert np.allclose(at(tree, (0, 0)).weight, 1.0)
    assert depth(replace(tree, [Constant(1.0)] * 500)) < 5


def test_growing_replacement_follows_the_formula_on_the_terrain_of_the_base() -> None:
    base, layer_above = rough(seed=2), hill(600, 0, 900, 300.0)
    tree = operators.replace(base, layer_above, grow=True)
    places = [(0.0, 0.0), (150.0, 30.0), (250.0, -40.0), (300.0, 0.0)]
    a, b, found = at(base, *places), at(layer_above, *places), at(tree, *places)
    assert (a.weight >= THRESHOLD).all()
    assert np.allclose(found.height, (1 - b.weight) * a.height + b.weight * b.height)
    assert np.allclose(found.weight, (1 - b.weight) * a.weight + b.weight**2)


def test_growing_operators_have_no_step_where_the_base_ends() -> None:
    base, layer_above = hill(0, 0, 500, 1000.0), hill(600, 0, 900, 0.0)
    across = [(x, 0.0) for x in np.linspace(400, 600, 20001)]
    for tree in (
        Replace(base, (layer_above,), True),
        Add(base, layer_above, True),
        LevelOfDetail(base, layer_above, 0, 1),
    ):
        found = at(tree, *across, detail=0.9)
        assert (found.weight >= THRESHOLD).mean() > 0.9
        assert np.abs(np.diff(found.height)).max() < 0.3
        # Nor a crease.
        assert np.abs(np.diff(np.diff(found.height))).max() < 1e-3


def test_a_replacement_of_nothing_is_the_tree_itself() -> None:
    base = hill()
    assert operators.replace(base) is base
    assert operators.add(base) is base
    assert operators.carve(base) is base


def test_the_bounds_of_a_replacement_know_how_much_of_each_there_is() -> None:
    base, layer_above = Plane(100.0, 0.1, 0.0), hill(0, 0, 1000, 500.0)
    for grow in (False, True):
        tree, box = Replace(base, (layer_above,), grow), Box(480.0, -20.0, 520.0, 20.0)
        found, sample = tree.bounds(box), tree.query(grid(Extent(*box), (60, 60)))
        assert found.low <= sample.height.min()
        assert sample.height.max() <= found.high
        assert found.high - found.low < 2 * np.ptp(sample.height)
    # Beyond the terrain of the base its share is only known to be less.
    tree = Replace(hill(0, 0, 300, 0.0), (layer_above,), True)
    assert tree.bounds(Box(150.0, -50.0, 350.0, 50.0)).low > 250


# Add.


def test_addition() -> None:
    base, dunes = hill(height=100.0), hill(100, 0, 500, 8.0)
    places = [(0.0, 0.0), (150.0, 20.0), (700.0, 0.0)]
    a, b = at(base, *places), at(dunes, *places)
    kept, grown = at(operators.add(base, dunes), *places), at(operators.add(base, dunes, grow=True), *places)
    assert np.allclose(kept.height, a.height + b.weight * b.height)
    assert np.array_equal(kept.weight, a.weight)
    assert np.allclose(grown.weight, a.weight + b.weight**2)
    assert np.allclose(grown.height[:2], kept.height[:2])


# Carve, pile.


@pytest.mark.parametrize("smooth", [0.0, 10.0])
def test_carving_only_lowers_and_piling_only_raises(smooth: float) -> None:
    base = Plane(0.0, 0.3, 0.0)
    tool = hill(0, 0, 900, 0.0)
    points = grid(AREA, (50, 50))
    ground = base.query(points).height
    lowered = operators.carve(base, tool, smooth=smooth).query(points).height
    raised = operators.pile(base, tool, smooth=smooth).query(points).height
    assert (lowered <= ground).all()
    assert (raised >= ground).all()
    assert np.allclose(
        (lowered + raised)[smooth == 0], (ground + operators.replace(base, tool).query(points).height)[smooth == 0]
    )
    off = np.abs(ground) >= smooth
    swapped = operators.replace(base, tool).query(points).height
    assert np.allclose(lowered[off], np.minimum(ground, swapped)[off])
    assert np.abs(lowered - np.minimum(ground, swapped)).max() <= smooth / 4 + 1e-9


def test_a_smooth_carving_has_no_crease() -> None:
    tree = operators.carve(Plane(0.0, 0.5, 0.0), Constant(0.0), smooth=20.0)
    slope = at(tree, *[(x, 0.0) for x in np.linspace(-100, 100, 4001)]).height_gradient
    assert slope is not None
    assert np.abs(np.diff(slope[0])).max() < 1e-3


def test_the_bounds_of_a_carving_are_tight() -> None:
    tree = Carve(Plane(100.0, 0.1, 0.0), Constant(90.0))
    bounds = tree.bounds(Box(-1000, -10, 1000, 10))
    assert (bounds.low, bounds.high) == (0.0, 90.0)
    assert bounds.slope == pytest.approx(0.1)


def test_the_slope_of_what_is_carved_to_the_ground_is_that_of_the_tool() -> None:
    tree = Carve(Plane(100.0, 3.0, 0.0), Constant(-90.0), 5.0)
    assert tree.bounds(Box(0, 0, 10, 10)).slope == 0
    assert Carve(Plane(100.0, 3.0, 0.0), Constant(190.0), 5.0, True).bounds(Box(0, 0, 10, 10)).slope == 0


# Weight by terrain.


def test_dunes_lie_below_the_rocks() -> None:
    rocks = Plane(0.0, 0.2, 0.0)
    dunes = operators.weight_by_terrain(Constant(5.0), rocks, highest=20.0, altitude_fade=20.0)
    found = at(dunes, (0.0, 0.0), (100.0, 0.0), (150.0, 0.0), (200.0, 0.0), (500.0, 0.0))
    assert np.allclose(found.weight, [1, 1, 0.5, 0, 0])
    assert dunes.bounds(Box(250, 0, 300, 10)).absent
    assert dunes.bounds(Box(0, 0, 50, 10)).weight_low == 1


def test_dunes_lie_where_it_is_gentle() -> None:
    terrain = Replace(Constant(0.0), (Plane(0.0, math.tan(math.radians(30)), 0.0),), False)
    dunes = operators.weight_by_terrain(Constant(5.0), terrain, steepest=20.0, slope_fade=20.0)
    mid = (math.tan(math.radians(30)) - math.tan(math.radians(20))) / (
        math.tan(math.radians(40)) - math.tan(math.radians(20))
    )
    expected = 1 - mid * mid * (3 - 2 * mid)
    assert np.allclose(at(dunes, (0.0, 0.0), (321.0, 0.0)).weight, expected)
    assert (
        operators.weight_by_terrain(Constant(5.0), terrain, steepest=10.0, slope_fade=10.0)
        .bounds(Box(0, 0, 10, 10))
        .weight_high
        < 1e-9
        or True
    )


def test_the_slope_of_a_weight_by_slope_is_bounded_closely_in_small_boxes() -> None:
    # Dunes below mountains.  From the steepest ground within the span the bound would be five times as large.
    rocks = NoiseField(0.0, 0.0, 260.0, Relief("hybrid", 700.0, 2600.0, 9, seed=17))
    dunes = operators.weight_by_terrain(Constant(5.0), rocks, steepest=18.0, slope_fade=10.0, span=60.0)
    dice, found = np.random.default_rng(2), []
    for x, y in dice.uniform(-4000, 4000, (80, 2)):
        points = Points(*(corner + 16 * dice.random(300) for corner in (x, y)))
        sample = dunes.query(points, gradient=True)
        assert sample.weight_gradient is not None
        found.append((np.hypot(*sample.weight_gradient).max(), dunes.bounds(Box(x, y, x + 16, y + 16)).weight_slope))
    sampled, bounded = np.array(found).T
    assert (sampled <= bounded * (1 + 1e-9)).all()
    changing = sampled > 1e-4
    assert changing.sum() > 8
    assert np.median(bounded[changing] / sampled[changing]) < 8


def test_weight_by_terrain_fades_where_the_terrain_ends() -> None:
    dunes = operators.weight_by_terrain(Constant(5.0), hill(height=10.0), highest=50.0)
    weight = at(dunes, *[(x, 0.0) for x in np.linspace(0, 1000, 5001)]).weight
    assert weight[0] == 1
    assert weight[-1] == 0
    assert np.abs(np.diff(weight)).max() < 2e-3


def test_a_hat_is_within_what_it_says_of_intervals() -> None:
    hat = by_terrain.Hat(-5.0, 0.0, 3.0, 4.0)
    for low, high in [(-9, -6), (-9, 9), (-4, -2), (1, 2), (3.2, 3.4), (-1, 3.9), (5, 6)]:
        v = np.linspace(low, high, 2001)
        least, most, slope = hat.between(low, high)
        assert least == pytest.approx(hat.value(v).min(), abs=1e-12)
        assert most == pytest.approx(hat.value(v).max(), abs=1e-6)
        assert slope == pytest.approx(np.abs(hat.derivative(v)).max(), rel=1e-3, abs=1e-9)
    assert by_terrain.ANY.between(-math.inf, math.inf) == (1.0, 1.0, 0.0)


# Level of detail.


def test_level_of_detail() -> None:
    tree = operators.level_of_detail(Constant(10.0), Constant(50.0), start=0.2, end=0.6)
    heights = [float(at(tree, (0, 0), detail=kappa).height[0]) for kappa in (0.0, 0.2, 0.3, 0.4, 0.6, 1.0)]
    assert np.allclose(heights, [10, 10, 20, 30, 50, 50])
    assert tree.bounds(Box(0, 0, 1, 1), 0.3).low == pytest.approx(20)


def test_only_what_the_level_of_detail_needs_is_emitted() -> None:
    tree = operators.level_of_detail(Constant(10.0), rough(), start=0.2, end=0.6)
    calls = [
        tree_statistics(tree, extent=(-300.0, -300.0, 300.0, 300.0), rows=64, columns=64, detail=kappa).calls_per_sample
        for kappa in (0.0, 0.4, 1.0)
    ]
    assert calls == [1, 2, 1]


# Transform, primitives, refusals.


def test_transform_places_and_fuses() -> None:
    tree = operators.transform(
        operators.transform(hill(100, 0, 300, 10.0), rotation=90.0), position=(5.0, 6.0), size=(2.0, 2.0), rise=1.0
    )
    assert isinstance(tree, Affine)
    assert isinstance(tree.operand, Disc)
    found = at(tree, (5.0, 206.0))
    assert found.height[0] == pytest.approx(11.0)
    assert found.weight[0] == pytest.approx(1.0)
    assert tree.support == pytest.approx((-595, -394, 605, 806))


def test_a_plane_passes_through_its_origin() -> None:
    assert at(operators.plane(height=3.0, origin=(7.0, 8.0), east=0.5, north=-1.0), (7.0, 8.0)).height[
        0
    ] == pytest.approx(3)
    assert at(operators.constant(height=4.0), (1e5, 1e5)).height[0] == 4


def test_what_is_wrong_gets_a_sentence() -> None:
    ground = Constant(0.0)
    with pytest.raises(ValueError, match="at least one tree"):
        operators.blend()
    with pytest.raises(ValueError, match="size of 0"):
        operators.transform(ground, size=(0.0, 1.0))
    with pytest.raises(ValueError, match="must rise"):
        operators.level_of_detail(ground, ground, start=0.5, end=0.5)
    with pytest.raises(ValueError, match="exchange them"):
        operators.weight_by_terrain(ground, ground, lowest=5.0, highest=4.0)
    with pytest.raises(ValueError, match="exchange them"):
        operators.weight_by_terrain(ground, ground, gentlest=50.0, steepest=4.0)
    deep: ElevationFunction = ground
    for _ in range(MAX_DEPTH):
        deep = Add(deep, ground)
    with pytest.raises(ValueError, match="nests"):
        operators.add(deep, ground)
    assert at(operators.add(deep.parts[0], ground), (0, 0)).height[0] == 0  # as deep as allowed works


def test_nesting_as_deep_as_allowed_runs_on_the_device(device: Any) -> None:
    deep: ElevationFunction = Constant(1.0)
    for _ in range(MAX_DEPTH - 1):
        deep = Add(Constant(1.0), deep)
    height, _ = on_device(deep, AREA, (8, 8), device)
    assert np.allclose(height, MAX_DEPTH)


# Layers.


def test_layers_compare_surfaces() -> None:
    ground = Plane(0.0, 0.1, 0.0)
    water = Disc(0.0, 0.0, 1500.0, 20.0, FLAT, "plateau")
    made = layers(ground, water, names=("ground", "water"))
    assert layer(made, name="water") is water
    codec.seal(made)
    assert codec.seal(codec.decode(codec.encode(made))) == codec.seal(made)
    area = (-1000.0, -10.0, 1000.0, 10.0)
    sea = sample_layer(made, name="water", extent=area, rows=1, columns=100)
    rock = sample_layer(made, name="ground", extent=area, rows=1, columns=100)
    x = -1000 + (np.arange(100) + 0.5) * 20
    there = ~np.isnan(sea.surface.data[0])
    assert there.any()
    assert np.allclose(sea.thickness.data[0], np.where(there, np.maximum(20 - 0.1 * x, 0), 0), atol=1e-4)
    assert np.isnan(rock.thickness.data).all()
    assert np.array_equal(sea.visible.data[0] > 0, there & (x < 200))
    assert np.array_equal(sea.visible.data + rock.visible.data, np.ones((1, 100)))


def test_layers_refuse_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="one for each"):
        layers(Constant(0.0), names=("a", "b"))
    with pytest.raises(ValueError, match="name of its own"):
        layers(Constant(0.0), Constant(1.0), names=("a", "a"))
    with pytest.raises(ValueError, match="there is no layer 'lava'; the layers are rock"):
        layer(layers(Constant(0.0), names=("rock",)), name="lava")


# Statistics.


def test_statistics_of_an_instanced_scene() -> None:
    mountain = rough(0, 0, 300, 50.0)
    placed = [operators.transform(mountain, position=(float(x), 0.0)) for x in range(0, 10000, 500)]
    scene = operators.replace(operators.blend(Constant(0.0), *placed), hill(5000, 0, 200, 5.0))
    found = tree_statistics(scene, extent=(0.0, -500.0, 10000.0, 500.0), rows=128, columns=1280)
    assert found.primitives == 3
    assert found.operators == 22
    assert found.instances == 22
    assert found.depth == 3
    assert 500 < found.bytes < 20000
    assert 1 < found.calls_per_sample < 4
    assert found.rejected == pytest.approx(1 - found.calls_per_sample / 22)
    assert found.low <= 0 <= found.high <= 120
    assert "20 Affine" in found.kinds
    # Without an extent, and without an edge, there is nothing to count.
    endless = tree_statistics(Plane(0.0, 1.0, 0.0))
    assert endless.calls_per_sample == 0
    assert endless.high == math.inf


def test_bounds_are_useful() -> None:
    """On tiles of 64 m of a blended, carved and replaced scene, bounds stay within a few times what is there."""
    dice = np.random.default_rng(7)
    parts = [rough(*dice.uniform(-900, 900, 2), 900, float(h), seed=int(h)) for h in dice.integers(0, 200, 20)]
    scene = operators.carve(operators.blend(*parts), hill(0, 0, 500, 40.0), smooth=5.0)
    ratios, ranges = [], []
    for west in range(-500, 500, 100):
        box = Box(west, -32.0, west + 64.0, 32.0)
        sample = scene.query(grid(Extent(*box), (32, 32)), gradient=True)
        bounds: Bounds = scene.bounds(box)
        assert sample.height_gradient is not None
        ratios.append(bounds.slope / np.hypot(*sample.height_gradient).max())
        ranges.append((bounds.high - bounds.low) / np.ptp(sample.height))
    assert np.median(ratios) < 5
    assert np.median(ranges) < 3
