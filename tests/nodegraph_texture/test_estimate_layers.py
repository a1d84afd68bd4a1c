from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import cohen_kappa_score
from sklearn.metrics import confusion_matrix as reference_matrix

from nodegraph_terrain.raster import Elevation, Extent, Labels, Raster
from nodegraph_texture.agreement import cohens_kappa, confusion_matrix, overall_agreement, visible_shares
from nodegraph_texture.apply_layers import apply_layers
from nodegraph_texture.colour_table import colour_codes, colour_table
from nodegraph_texture.constraint_fit import area_bias, conditional_functions, printed_function
from nodegraph_texture.coverage import visible
from nodegraph_texture.estimate_layers import estimate_layers
from nodegraph_texture.evaluate import evaluate
from nodegraph_texture.layers import SurfaceLayers
from nodegraph_texture.quantities import Other, Temperature
from nodegraph_texture.scene import scene_of
from nodegraph_texture.spline_slope import spline_slope
from nodegraph_texture.surface_classes import SurfaceClasses, classes_of

BOX = Extent(0, 0, 2400, 1800)
ROWS, COLS = np.indices((60, 80))
HEIGHT = 1000 + 600 * np.sin(ROWS / 9) * np.cos(COLS / 11) + 200 * np.cos(COLS / 5)
GROUND = Elevation(HEIGHT.astype(np.float32), BOX)
WARMTH = Temperature((15 - 0.0065 * HEIGHT + 3 * np.sin(COLS / 7)).astype(np.float32), BOX)
SLOPE = spline_slope(GROUND)


def classes(count: int = 3) -> SurfaceClasses:
    dice = np.random.default_rng(0)
    tables = [
        colour_table(colour_codes(dice.integers(60 * i, 60 * i + 50, (9, 9, 3)).astype(np.uint8))) for i in range(count)
    ]
    return classes_of(tuple(f"class {i}" for i in range(count)), tables)


def reproduced(layers: SurfaceLayers, *quantities: Raster) -> np.ndarray:
    names = ["class 0", "class 1", "class 2"]
    found = evaluate(scene_of(layers, GROUND, quantities), GROUND.cell_size, 0, 0, *GROUND.shape)
    shares = np.zeros((*GROUND.shape, 3))
    for number, (layer, _, _) in enumerate(layers.walk()):
        shares[..., names.index(layer.name.split(" / ")[0])] += visible(found.coverage)[..., number]
    return shares.argmax(axis=-1)


def truth(noise: float = 0.0) -> Labels:
    labels = np.where(HEIGHT > 1250, 1, 0)
    labels[(SLOPE > 26) & (HEIGHT < 1100)] = 2
    dice = np.random.default_rng(1)
    return Labels(np.where(dice.random(labels.shape) < noise, dice.integers(0, 3, labels.shape), labels), BOX)


@given(st.lists(st.integers(0, 50), min_size=2, max_size=40).filter(any))
def test_a_printed_function_has_mean_one_half_where_that_can_be(counts):
    function, reached = printed_function(np.array(counts))
    assert 0 <= function.min() <= function.max() <= 1
    filled = sum(count > 0 for count in counts)
    assert reached == (2 * filled >= len(counts))
    assert function.mean() == pytest.approx(0.5 if reached else filled / len(counts))
    order = np.argsort(counts, kind="stable")
    assert (np.diff(function[order]) >= 0).all()


@given(st.lists(st.floats(0, 1, width=32), min_size=1, max_size=60), st.floats(0, 1))
def test_the_bias_gives_a_class_its_area(score, share):
    values = np.array(score)
    bias = area_bias(values, share)
    most = (values > 0).mean()
    assert np.minimum(bias * values, 1).mean() == pytest.approx(min(share, most), abs=1e-9)


def test_conditional_functions_are_counts_over_the_terrains_own():
    own, every = np.array([[0, 3000, 9000, 0]]), np.array([[1000, 10000, 10000, 0]])
    function = conditional_functions(own, every, 0)[0]
    np.testing.assert_allclose(function[:3], [0, 1 / 3, 1], atol=0.02)
    # What was never seen is as likely as on average.
    assert function[3] == pytest.approx((12 / 21) / 0.9, abs=0.01)


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=2, max_size=50))
def test_agreement_is_that_of_scikit_learn(pairs):
    a, b = np.array(pairs).T
    matrix = confusion_matrix(np.append(a, -1), np.append(b, 2), 4)
    np.testing.assert_array_equal(matrix, reference_matrix(a, b, labels=range(4)))
    assert overall_agreement(matrix) == pytest.approx((a == b).mean())
    if len(set(a) | set(b)) > 1:
        assert cohens_kappa(matrix) == pytest.approx(cohen_kappa_score(a, b))


@given(st.lists(st.floats(0, 1), min_size=1, max_size=5))
def test_shares_add_up(covers):
    shares = visible_shares([np.array(cover) for cover in covers])
    assert sum(shares) == pytest.approx(1)
    assert shares[-1] == covers[-1]


def test_slopes_are_those_of_the_texture():
    flat = SurfaceLayers("a", (0.5, 0.5, 0.5))
    for ground in (GROUND, Elevation((3 * ROWS - 2 * COLS + 7.0).astype(np.float32), BOX)):
        normals = evaluate(scene_of(flat, ground, ()), ground.cell_size, 0, 0, 60, 80).normals
        expected = np.degrees(np.arccos(np.clip(normals[..., 2].astype(float), -1, 1)))
        np.testing.assert_allclose(spline_slope(ground)[12:-12, 12:-12], expected[12:-12, 12:-12], atol=0.05)
    np.testing.assert_allclose(spline_slope(ground), np.degrees(np.arctan(np.hypot(0.1, 2 / 30))), atol=1e-3)
    holed = GROUND.data.copy()
    holed[20:24, 30:33] = np.nan
    assert (np.isnan(spline_slope(GROUND.like(holed))) == np.isnan(holed)).all()


@pytest.mark.parametrize("rule", ["additive", "conditional", "printed"])
def test_layers_give_the_surfaces_back(rule):
    labels = truth()
    sizes = np.bincount(labels.data.ravel()) / labels.data.size
    found = estimate_layers(labels, classes(), GROUND, rule=rule, noise=0, variants=0)
    again = reproduced(found.layers)
    assert (again == labels.data).mean() == pytest.approx(found.agreement, abs=0.01)
    assert found.agreement > sizes.max() + 0.2
    assert found.layers.name == f"class {sizes.argmax()}"
    assert len(found.layers.children) == 2
    if rule == "additive":
        # The surfaces follow from altitude and slope, and this rule can say so.
        assert found.agreement > 0.97
        area = np.bincount(again.ravel()) / again.size
        np.testing.assert_allclose(area, sizes, atol=0.03)


def test_the_printed_rule_says_where_it_cannot_be_kept():
    assert estimate_layers(truth(), classes(), GROUND, rule="printed").unreached > 0


def test_what_two_quantities_have_in_common_counts_once():
    labels = truth(0.3)
    copies = [Other(GROUND.data + 1.0 * k, BOX, f"copy_{k}") for k in range(4)]
    alone = estimate_layers(labels, classes(), GROUND, noise=0, variants=0, smoothing=0.05)
    many = estimate_layers(labels, classes(), GROUND, *copies, noise=0, variants=0, smoothing=0.05)
    first, second = ([e.layers.children, q] for e, q in ((alone, ()), (many, copies)))
    a = evaluate(scene_of(alone.layers, GROUND, first[1]), GROUND.cell_size, 0, 0, 60, 80).coverage
    b = evaluate(scene_of(many.layers, GROUND, second[1]), GROUND.cell_size, 0, 0, 60, 80).coverage
    if [c.name for c in first[0]] == [c.name for c in second[0]]:
        assert np.abs(a - b).mean() < 0.05
    assert many.agreement == pytest.approx(alone.agreement, abs=0.02)


def test_a_quantity_that_decides_is_used():
    labels = Labels(np.where(WARMTH.data < 7, 1, 0).astype(np.int32), BOX)
    without = estimate_layers(labels, classes(2), GROUND)
    within = estimate_layers(labels, classes(2), GROUND, WARMTH)
    assert within.agreement > 0.98 > without.agreement
    names = {item.quantity for item in within.layers.children[-1].constraints}
    assert names == {"altitude", "slope", "temperature"}
    alone = estimate_layers(labels, classes(2), GROUND, WARMTH, without=("altitude", "slope"))
    assert alone.agreement > 0.98
    assert {item.quantity for item in alone.layers.children[-1].constraints} == {"temperature"}
    with pytest.raises(ValueError, match="nothing for layers to depend on"):
        estimate_layers(labels, classes(2), GROUND, without=("altitude", "slope"))


def test_the_search_for_an_order_never_loses():
    labels = truth(0.4)
    size = estimate_layers(labels, classes(), GROUND, WARMTH, order="size")
    search = estimate_layers(labels, classes(), GROUND, WARMTH, order="search")
    assert search.agreement >= size.agreement


def test_variants_have_shades_of_their_class_and_dice_of_their_own():
    some = classes()
    found = estimate_layers(truth(), some, GROUND, variants=3, seed=4).layers
    for layer in (found, *[child for child in found.children if " / " not in child.name]):
        number = some.names.index(layer.name)
        own = [child for child in layer.children if " / " in child.name]
        assert len(own) == 3
        low, high = some.shades[number].min(axis=0) - 1e-4, some.shades[number].max(axis=0) + 1e-4
        assert all((low <= child.colour).all() and (child.colour <= high).all() for child in own)
        assert len({child.noise.seed for child in own}) == 3
    assert (
        found.children[0].noise != estimate_layers(truth(), some, GROUND, variants=3, seed=5).layers.children[0].noise
    )
    image = apply_layers(found, GROUND, factor=1).image.data
    assert len(np.unique(image.reshape(-1, 4), axis=0)) > 200


def test_unlabelled_and_void_cells_do_not_count():
    labels = truth()
    holed = GROUND.data.copy()
    holed[:6] = np.nan
    part = labels.data.copy()
    part[:, :10] = -1
    wrong = np.where((ROWS < 6) | (COLS < 10), 1, labels.data)
    first = estimate_layers(
        Labels(np.where((ROWS < 6) | (COLS < 10), -1, labels.data), BOX), classes(), GROUND.like(holed)
    )
    second = estimate_layers(Labels(np.where(COLS < 10, -1, wrong), BOX), classes(), GROUND.like(holed))
    assert first.agreement == second.agreement


def test_bad_input_is_one_sentence():
    labels = truth()
    with pytest.raises(ValueError, match="only one class"):
        estimate_layers(Labels(np.zeros((60, 80), np.int32), BOX), classes(), GROUND)
    with pytest.raises(ValueError, match="no class at all"):
        estimate_layers(Labels(np.full((60, 80), -1, np.int32), BOX), classes(), GROUND)
    with pytest.raises(ValueError, match="but there are 2 classes"):
        estimate_layers(labels, classes(2), GROUND)
    with pytest.raises(ValueError, match="two rasters are called 'temperature'"):
        estimate_layers(labels, classes(), GROUND, WARMTH, WARMTH)
    with pytest.raises(ValueError, match="no cell has a class, a height"):
        estimate_layers(labels, classes(), GROUND, Temperature(np.full((60, 80), np.nan, np.float32), BOX))
    with pytest.raises(ValueError, match="infinite"):
        estimate_layers(labels, classes(), GROUND, Temperature(np.full((60, 80), np.inf, np.float32), BOX))
    with pytest.raises(ValueError, match="different extents"):
        estimate_layers(labels, classes(), Elevation(GROUND.data, Extent(0, 0, 2400, 1801)))
