"""Equations 1 and 2: what must hold of coverage, colours and heights, whatever the layers."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.resample import resample
from nodegraph_texture.apply_layers import apply_layers
from nodegraph_texture.constraints import Hat, Sampled
from nodegraph_texture.evaluate import evaluate
from nodegraph_texture.layer import layer
from nodegraph_texture.layers import Roughness, SurfaceLayers
from nodegraph_texture.quantities import Other, Temperature
from nodegraph_texture.scene import scene_of
from nodegraph_tree.evaluate import normals, sample
from nodegraph_tree.from_elevation import from_elevation

BOX = Extent(500_000.0, 5_200_000.0, 500_900.0, 5_200_720.0, "EPSG:32632")


def hills(rows: int = 24, cols: int = 30, seed: int = 3) -> Elevation:
    from scipy.ndimage import gaussian_filter

    values = 1500 + 4000 * gaussian_filter(np.random.default_rng(seed).normal(size=(rows, cols)), 3)
    return Elevation(values.astype(np.float32), BOX)


GROUND = hills()
WARMTH = Temperature(np.linspace(-5, 15, 12, dtype=np.float32).reshape(3, 4), BOX)

ends = st.lists(st.floats(1200, 1900), min_size=4, max_size=4).map(sorted)
slopes = st.lists(st.floats(0, 50), min_size=4, max_size=4).map(sorted)


@st.composite
def hierarchies(draw, level: int = 0, prefix: str = "root") -> SurfaceLayers:
    constraints = []
    if draw(st.booleans()):
        a, b, c, d = draw(ends)
        constraints.append(Hat("altitude", (a, b), draw(st.sampled_from([(c, d), (inf, inf)]))))
    if draw(st.booleans()):
        a, b, c, d = draw(slopes)
        constraints.append(Hat("slope", draw(st.sampled_from([(a, b), (-inf, -inf)])), (c, d)))
    if draw(st.booleans()):
        samples = draw(st.lists(st.floats(0, 1), min_size=2, max_size=6))
        constraints.append(Sampled("temperature", -3.0, 11.0, np.array(samples, np.float32)))
    count = draw(st.integers(0, 2)) if level < 2 else 0
    kinds = st.sampled_from(["fbm", "billow", "ridged", "warped"])
    return SurfaceLayers(
        prefix,
        draw(st.tuples(*[st.floats(0, 1)] * 3)),
        tuple(constraints),
        Roughness(draw(kinds), draw(st.floats(20, 300)), 4, seed=draw(st.integers(0, 99))),
        draw(st.sampled_from([0.0, 1.0, -3.0])),
        draw(st.sampled_from([1.0, 0.4, 1.7])),
        Roughness(draw(kinds), draw(st.floats(20, 300)), 4),
        draw(st.sampled_from([0.0, 0.0, 12.0, -4.0])),
        variation=draw(st.sampled_from([0.0, 0.5])),
        children=tuple([draw(hierarchies(level + 1, f"{prefix}.{i}")) for i in range(count)]),
    )


@given(hierarchies())
@settings(max_examples=25, deadline=None)
def test_coverage_is_bounded_by_the_parents(layers):
    made = evaluate(scene_of(layers, GROUND, [WARMTH]), 15.0, 0, 0, 48, 60)
    assert made.coverage.min() >= 0
    assert made.coverage.max() <= 1
    for number, (_, parent, _) in enumerate(layers.walk()):
        if parent >= 0:
            assert (made.coverage[..., number] <= made.coverage[..., parent]).all()


@given(hierarchies(), st.sampled_from([7.5, 15.0, 90.0, (11.0, 13.0)]), st.data())
@settings(max_examples=20, deadline=None)
def test_a_window_is_that_part_of_the_whole_bit_for_bit(layers, cell, data):
    scene = scene_of(layers, GROUND, [WARMTH])
    wide, high = (cell, cell) if isinstance(cell, float) else cell
    rows, cols = int(720 / high), int(900 / wide)
    whole = evaluate(scene, cell, 0, 0, rows, cols)
    row, col = data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, cols - 1))
    down, across = data.draw(st.integers(1, rows - row)), data.draw(st.integers(1, cols - col))
    part = evaluate(scene, cell, row, col, down, across)
    for name, expected, found in zip(whole._fields, whole, part, strict=True):
        assert np.array_equal(found, expected[row : row + down, col : col + across], equal_nan=True), name


def test_a_window_larger_than_a_block_and_beyond_the_scene():
    layers = layer(layer(name="snow", colour="white", slope=(None, None, 10, 20), noise_scale=2.0), name="rock",
                   colour="#706050", roughness=5.0, relief_wavelength=40)  # fmt: skip
    scene = scene_of(layers, GROUND)
    whole = evaluate(scene, 2.5, 0, 0, 288, 360)
    part = evaluate(scene, 2.5, -20, 300, 330, 90)
    for expected, found in zip(whole, part, strict=True):
        assert np.array_equal(found[20:308, :60], expected[:, 300:])
    outside = np.ones((330, 90), bool)
    outside[20:308, :60] = False
    assert (part.colour[outside] == 0).all()
    assert np.isnan(part.height[outside]).all()
    assert (part.coverage[outside] == 0).all()


def test_one_full_layer_has_exactly_its_colour():
    for colour in ("#000000", "#ffffff", "#123456", "#fe01ab"):
        made = apply_layers(layer(name="all", colour=colour), GROUND, factor=2)
        codes = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert (made.image.data == [*codes, 255]).all()
    top = layer(layer(name="upper", colour="#c0ffee"), name="lower", colour="#000000")
    assert (apply_layers(top, GROUND, factor=1).image.data[..., :3] == [0xC0, 0xFF, 0xEE]).all()


def test_against_the_equations_written_out():
    from scipy.ndimage import map_coordinates

    high = layer(name="high", colour="#ffffff", altitude=(1400, 1500, None, None))
    warm = layer(name="warm", colour="#ff0000", constraints={"temperature": (0, 5, 8, 12)}, noise_bias=0.7)
    made = apply_layers(layer(warm, high, name="rock", colour="#202020"), GROUND, None, WARMTH, factor=3)
    expected = resample(GROUND, rows=72, columns=90)
    assert made.surface.data == pytest.approx(expected.data, abs=2e-4)
    y, x = np.meshgrid((np.arange(72) + 0.5) / 24 - 0.5, (np.arange(90) + 0.5) / 22.5 - 0.5, indexing="ij")
    degrees = map_coordinates(WARMTH.data, [y.clip(0, 2), x.clip(0, 3)], order=1)
    first = np.clip(0.7 * np.interp(degrees, [0, 5, 8, 12], [0, 1, 1, 0]), 0, 1)
    second = np.interp(expected.data, [1400, 1500], [0, 1])
    assert made.coverage.data[..., 1] == pytest.approx(first, abs=1e-5)
    assert made.coverage.data[..., 2] == pytest.approx(second, abs=1e-4)
    grey = np.full((72, 90, 3), 0x20 / 255)
    grey = (1 - first[..., None]) * grey + first[..., None] * [1, 0, 0]
    grey = (1 - second[..., None]) * grey + second[..., None]
    assert np.abs(made.image.data[..., :3] - 255 * grey).max() < 0.55


def test_the_slope_is_that_of_the_spline():
    dip = np.add.outer(np.arange(20.0) * -3, np.arange(20.0) * 4).astype(np.float32)
    plane = Elevation(dip, Extent(0, 0, 200, 200))
    angle = np.degrees(np.arctan(0.5))
    steep = layer(name="steep", colour="red", slope=(angle - 5, angle + 5, None, None))
    made = apply_layers(layer(steep, name="rock", colour="black"), plane)
    assert made.coverage.data[..., 1] == pytest.approx(0.5, abs=1e-4)
    up = np.array([-0.4, -0.3, 1]) / np.sqrt(1.25)
    assert made.normals.data == pytest.approx(np.broadcast_to(up, made.normals.data.shape), abs=1e-5)


def test_normals_are_those_of_the_displaced_ground():
    rough = layer(name="rock", colour="grey", roughness=10.0, relief_wavelength=120, relief_octaves=2)
    made = apply_layers(rough, GROUND, factor=10)
    plain = apply_layers(layer(name="rock", colour="grey"), GROUND, factor=10)
    bumps = made.surface.data - plain.surface.data
    assert 2 < np.abs(bumps).max() <= 10
    east = np.gradient(made.surface.data, 3.0, axis=1)[1:-1, 1:-1]
    north = -np.gradient(made.surface.data, 3.0, axis=0)[1:-1, 1:-1]
    normal = np.stack([-east, -north, np.ones_like(east)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    assert np.abs(made.normals.data[1:-1, 1:-1] - normal).max() < 0.01


def test_later_layers_see_the_displaced_heights_and_slopes():
    flat = Elevation(np.full((20, 20), 1000, np.float32), Extent(0, 0, 200, 200))
    rough = layer(name="rough", colour="grey", roughness=20.0, relief_kind="billow", relief_wavelength=40)
    high = layer(name="high", colour="white", altitude=(1004, 1005, None, None))
    steep = layer(name="steep", colour="red", slope=(10, 12, None, None))
    after = apply_layers(layer(rough, high, steep, name="base", colour="black"), flat)
    before = apply_layers(layer(high, steep, rough, name="base", colour="black"), flat)
    share = np.interp(after.surface.data, [1004, 1005], [0, 1])
    assert after.coverage.data[..., 2] == pytest.approx(share, abs=1e-3)
    up = after.normals.data[..., 2]
    tilt = np.degrees(np.arccos(up.clip(-1, 1)))
    assert after.coverage.data[..., 3] == pytest.approx(np.interp(tilt, [10, 12], [0, 1]), abs=5e-3)
    assert 0.05 < share.mean() < 0.95
    assert (before.coverage.data[..., 1:3] == 0).all()


def test_the_order_of_siblings_matters_only_where_they_overlap():
    low = layer(name="low", colour="red", altitude=(None, None, 1480, 1540), noise_scale=0.4)
    high = layer(name="high", colour="blue", altitude=(1460, 1500, None, None), noise_scale=0.4)
    one = apply_layers(layer(low, high, name="base", colour="black"), GROUND)
    other = apply_layers(layer(high, low, name="base", colour="black"), GROUND)
    assert np.array_equal(one.coverage.data[..., 1], other.coverage.data[..., 2])
    both = (one.coverage.data[..., 1:] > 0).all(axis=-1)
    differs = (one.image.data != other.image.data).any(axis=-1)
    assert both.any()
    assert differs.any()
    assert not (differs & ~both).any()


@given(st.floats(-1e-2, 1e-2), st.integers(0, 1000))
@settings(max_examples=15, deadline=None)
def test_coverage_is_continuous_in_the_heights(change, seed):
    layers = layer(layer(name="top", colour="white", altitude=(1400, 1450, 1600, 1700), slope=(5, 12, 25, 40),
                         noise_scale=1.0, seed=seed), name="base", colour="black")  # fmt: skip
    moved = Elevation(GROUND.data + np.float32(change), BOX)
    one, other = apply_layers(layers, GROUND, factor=2), apply_layers(layers, moved, factor=2)
    # 1/50 per m by the steepest side of the hat, times 2 for bias and noise, and the rounding of heights.
    assert np.abs(one.coverage.data - other.coverage.data).max() <= 2 / 50 * abs(change) + 2e-4


@given(st.floats(-2e-2, 2e-2), st.integers(0, 1000), st.booleans())
@settings(max_examples=15, deadline=None)
def test_coverage_is_continuous_in_a_quantity(change, seed, sampled):
    # Both rise by 1 in 2 K at the steepest.
    rule = Sampled("temperature", -3.0, 3.0, np.array([0, 1, 0.2, 0.9], np.float32)) if sampled else None
    hat = {} if sampled else {"constraints": {"temperature": [2, 4, 8, 10]}}
    top = layer(name="top", colour="white", noise_scale=1.0, seed=seed, **hat)
    base = layer(replace(top, constraints=(rule,)) if rule else top, name="base", colour="black")
    moved = Temperature(WARMTH.data + np.float32(change), BOX)
    one, other = (
        apply_layers(base, GROUND, None, quantities, factor=2).coverage.data for quantities in (WARMTH, moved)
    )
    assert one[..., 1].min() < 0.2
    assert one[..., 1].max() > 0.8
    assert np.abs(one - other).max() <= 2 / 2 * abs(change) + 2e-4


@pytest.mark.parametrize("wavelength", [30, 100, 300])
def test_a_coarse_level_is_nearer_to_the_means_of_a_fine_one_than_its_samples(wavelength):
    patches = layer(name="patches", colour="white", noise_scale=1.0, noise_bias=0.5, noise_wavelength=wavelength)
    scene = scene_of(layer(patches, name="base", colour="black"), GROUND)
    fine = evaluate(scene, 2.0, 0, 0, 360, 450).coverage[..., 1]
    coarse = evaluate(scene, 30.0, 0, 0, 24, 30).coverage[..., 1]
    means = fine.reshape(24, 15, 30, 15).mean(axis=(1, 3))
    aliased = fine[7::15, 7::15]
    assert np.sqrt(np.mean((coarse - means) ** 2)) < 0.8 * np.sqrt(np.mean((aliased - means) ** 2))


@pytest.mark.parametrize("kind", ["fbm", "billow", "ridged", "hybrid", "warped", "gradient"])
def test_what_fades_leaves_its_mean_behind(kind):
    from nodegraph_texture.detail import detail_of

    noise = Roughness(kind, 64.0, 6)
    x, y = np.random.default_rng(1).uniform(0, 6400, (2, 20000))
    full = detail_of(noise, 0.1).at(x, y)
    previous = 0.0
    for texel in (200.0, 31.0, 20.0, 9.0, 3.0, 1.3, 0.7):
        found = detail_of(noise, texel).at(x, y)
        assert found.mean() == pytest.approx(full.mean(), abs=0.015)
        spread = float(found.std())
        assert spread >= previous - 2e-3
        previous = spread
    # Continuous in the size of texels.
    for texel in (32.0, 16.0, 8.0, 4.0):
        near = [detail_of(noise, texel * factor).at(x, y) for factor in (0.999, 1.001)]
        assert np.abs(near[0] - near[1]).max() < 0.01


def test_octaves_finer_than_any_lattice_can_count_are_left_out():
    from nodegraph_texture.detail import detail_of

    made = detail_of(Roughness("fbm", 200.0, 24), 1.0)
    assert made.noise is not None
    assert made.noise.count == 8
    assert np.isfinite(made.at(np.array([5.2e6]), np.array([6e6]))).all()


def test_voids_are_transparent_and_their_neighbours_whole():
    heights = GROUND.data.copy()
    heights[5:9, 10:14] = np.nan
    layers = layer(layer(name="top", colour="white", slope=(0, 20, None, None)), name="base", colour="black",
                   roughness=4.0, relief_wavelength=50)  # fmt: skip
    made = apply_layers(layers, Elevation(heights, BOX), factor=3)
    void = np.zeros((72, 90), bool)
    void[15:27, 30:42] = True
    assert np.array_equal(np.isnan(made.surface.data), void)
    assert np.array_equal(np.isnan(made.normals.data).all(axis=-1), void)
    assert np.array_equal(made.image.data[..., 3] == 0, void)
    assert (made.coverage.data[void] == 0).all()
    assert np.isfinite(made.coverage.data).all()


def test_a_void_quantity_suits_nothing():
    wet = np.ones((24, 30), np.float32)
    wet[:, :10] = np.nan
    marsh = layer(name="marsh", colour="teal", constraints={"fields": (None, None, 5, 6)})
    made = apply_layers(layer(marsh, name="base", colour="black"), GROUND, None, Other(wet, BOX, "fields"), factor=1)
    assert (made.coverage.data[:, :10, 1] == 0).all()
    assert (made.coverage.data[:, 10:, 1] == 1).all()


def test_a_root_with_constraints_is_the_pictures_alpha():
    made = apply_layers(layer(name="snow", colour="white", altitude=(1400, 1600, None, None)), GROUND, factor=1)
    assert np.array_equal(made.image.data[..., 3], np.rint(255 * made.coverage.data[..., 0]))


def test_a_tree_is_textured_as_it_is_sampled():
    layers = layer(layer(name="top", colour="white", slope=(5, 20, None, None)), name="base", colour="black",
                   roughness=3.0, relief_wavelength=60)  # fmt: skip
    tree = from_elevation(GROUND)
    box = (500_100.0, 5_200_100.0, 500_700.0, 5_200_600.0)
    made = apply_layers(layers, None, tree, extent=box, cell_size=10, crs="EPSG:32632")
    assert made.surface.shape == (50, 60)
    assert made.surface.extent.crs == "EPSG:32632"
    assert (made.image.data[..., 3] == 255).all()
    scene = scene_of(layers, tree, (), made.surface.extent)
    part = evaluate(scene, 10.0, 11, 7, 20, 31)
    assert np.array_equal(part.height, made.surface.data[11:31, 7:38])
    assert np.array_equal(part.colour, made.image.data[11:31, 7:38])
    plain = apply_layers(layer(name="base", colour="black"), None, tree, extent=box, cell_size=10)
    assert np.array_equal(plain.surface.data, sample(tree, extent=box, cell_size=10).surface.data)
    assert plain.normals.data == pytest.approx(normals(tree, extent=box, cell_size=10).data, abs=1e-6)


def test_what_is_wrong_is_said():
    cold = layer(name="moss", colour="green", constraints={"temperature": (0, 5, None, None)})
    base = layer(cold, name="base", colour="black")
    with pytest.raises(ValueError, match="layer 'moss' depends on temperature, but no raster of it is linked"):
        apply_layers(base, GROUND)
    elsewhere = replace(WARMTH, extent=Extent(0, 0, 100, 100, "EPSG:32632"))
    with pytest.raises(ValueError, match=r"temperature \(0, 0, 100, 100\) does not overlap the surface"):
        apply_layers(base, GROUND, None, elsewhere)
    with pytest.raises(ValueError, match="temperature is in another system"):
        apply_layers(base, GROUND, None, replace(WARMTH, extent=replace(BOX, crs="EPSG:32633")))
    with pytest.raises(ValueError, match="two rasters are linked as 'temperature'"):
        apply_layers(base, GROUND, None, WARMTH, WARMTH)
    degrees = Extent(8, 46, 9, 47, "EPSG:4326", "deg")
    with pytest.raises(ValueError, match="in degrees"):
        apply_layers(base, GROUND, None, replace(WARMTH, extent=degrees))
    with pytest.raises(ValueError, match="in degrees"):
        apply_layers(base, replace(GROUND, extent=degrees), None, WARMTH)
    with pytest.raises(ValueError, match="every cell is void"):
        apply_layers(base, replace(GROUND, data=np.full((24, 30), np.nan, np.float32)), None, WARMTH)
    with pytest.raises(ValueError, match="infinite"):
        apply_layers(base, replace(GROUND, data=np.full((24, 30), np.inf, np.float32)), None, WARMTH)
    with pytest.raises(ValueError, match="no ground"):
        apply_layers(base)
    with pytest.raises(ValueError, match="given twice"):
        apply_layers(base, GROUND, from_elevation(GROUND), WARMTH)
    with pytest.raises(ValueError, match="give one of them"):
        apply_layers(base, GROUND, None, WARMTH, factor=2, cell_size=3)
    with pytest.raises(ValueError, match="larger than the ground"):
        apply_layers(base, GROUND, None, WARMTH, cell_size=5000)
    with pytest.raises(ValueError, match="choose larger cells"):
        apply_layers(base, GROUND, None, WARMTH, cell_size=1e-3)
    with pytest.raises(ValueError, match="no cells to divide"):
        apply_layers(base, None, from_elevation(GROUND), WARMTH, factor=2)


def test_layers_refuse_what_they_cannot_be():
    one, two = layer(name="a", colour="red"), layer(name="a", colour="blue")
    with pytest.raises(ValueError, match="two layers are called 'a'"):
        layer(one, two, name="base", colour="black")
    with pytest.raises(ValueError, match="two layers are called 'a'"):
        layer(layer(one, name="b", colour="red"), name="a", colour="black")
    with pytest.raises(ValueError, match="'reddish' is no colour"):
        layer(name="x", colour="reddish")
    with pytest.raises(ValueError, match="rising order"):
        layer(name="x", colour="red", altitude=(3, 2, 4, 5))
    with pytest.raises(ValueError, match="both ends"):
        layer(name="x", colour="red", altitude=(None, 2, 4, 5))
    with pytest.raises(ValueError, match="constrained twice"):
        layer(name="x", colour="red", slope=(0, 1, 2, 3), constraints={"slope": (0, 1, 2, 3)})
    with pytest.raises(ValueError, match="no name of a quantity"):
        layer(name="x", colour="red", constraints={"Snow cover": (0, 1, 2, 3)})
    with pytest.raises(ValueError, match="0 to 1"):
        layer(name="x", colour="red", constraints={"wetness": (0, 5, (0.5, 1.5))})
    with pytest.raises(ValueError, match="needs a name"):
        layer(name=" ", colour="red")
    with pytest.raises(ValueError, match="must lie in 0 to 1"):
        SurfaceLayers("x", (0.0, 1.2, 0.0))
    with pytest.raises(ValueError, match="finite"):
        SurfaceLayers("x", (0.0, 1.0, 0.0), scale=np.nan)


def test_a_partial_quantity_is_told(caplog):
    half = replace(WARMTH, extent=replace(BOX, east=500_450.0))
    cold = layer(name="moss", colour="green", constraints={"temperature": (None, None, 50, 60)})
    made = apply_layers(layer(cold, name="base", colour="black"), GROUND, None, half, factor=1)
    assert "50 % of the surface" in caplog.text
    assert (made.coverage.data[:, 15:, 1] == 0).all()
    assert (made.coverage.data[:, :15, 1] == 1).all()


def test_ground_that_samples_do_not_know_is_told(caplog):
    def painted(low, high):
        caplog.clear()
        top = layer(name="moss", colour="green", constraints={"temperature": (low, high, (0.2, 1.0))})
        apply_layers(layer(top, name="base", colour="black"), GROUND, None, WARMTH, factor=1)
        return caplog.text

    low, high = float(WARMTH.data.min()), float(WARMTH.data.max())
    assert painted(low, high) == ""
    assert painted(low + 0.2 * (high - low), high) == ""
    assert "100 % of the temperature lies beyond what layers know of it" in painted(high + 1, high + 2)
    caplog.clear()
    apply_layers(
        layer(name="base", colour="black", constraints={"altitude": (9000, 9500, (1.0, 0.0))}), GROUND, factor=1
    )
    assert "of the altitude lies beyond" in caplog.text
