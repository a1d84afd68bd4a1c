"""The OpenCL twin of apply_layers: as the reference, and windows as the whole, bit for bit."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest

from nodegraph.opencl import choose
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_texture.apply_opencl import evaluate_on_device
from nodegraph_texture.constraints import Constraint, Hat, Sampled
from nodegraph_texture.evaluate import evaluate
from nodegraph_texture.layer import layer
from nodegraph_texture.layers import SurfaceLayers
from nodegraph_texture.quantities import Temperature, Wetness
from nodegraph_texture.scene import scene_of
from nodegraph_tree.from_elevation import from_elevation

DEVICE = choose("auto")
pytestmark = pytest.mark.skipif(DEVICE is None, reason="no OpenCL device")

BOX = Extent(500_000.0, 5_200_000.0, 500_900.0, 5_200_720.0)


def ground(void: bool = False) -> Elevation:
    from scipy.ndimage import gaussian_filter

    values = 1500 + 2500 * gaussian_filter(np.random.default_rng(3).normal(size=(24, 30)), 3)
    if void:
        values[4:7, 11:20] = np.nan
    return Elevation(values.astype(np.float32), BOX)


WARMTH = Temperature(np.linspace(-5, 15, 12, dtype=np.float32).reshape(3, 4), BOX)
DAMP = np.random.default_rng(4).random((9, 11)).astype(np.float32) * 8
DAMP[3, 4] = np.nan
WET = Wetness(DAMP, Extent(499_950.0, 5_199_900.0, 500_800.0, 5_200_800.0))


def all_of_it() -> SurfaceLayers:
    """Layers of every kind of noise, with hats, samples, steps and bumps on bumps."""
    snow = layer(name="snow", colour="#ffffff", altitude=(1500, 1700, None, None), slope=(None, None, 35, 50),
                 noise_scale=1.0, noise_bias=1.2, noise_kind="warped", roughness=-1.5)  # fmt: skip
    grass = layer(name="grass", colour="#60803a", slope=(None, None, 20, 35), noise_scale=0.6, noise_kind="ridged",
                  constraints={"temperature": (-5.0, 10.0, (0.0, 0.8, 1.0, 0.3))}, roughness=2.0,
                  relief_wavelength=60, variation=0.3)  # fmt: skip
    marsh = layer(name="marsh", colour="#405030", constraints={"wetness": (4, 4, None, None)}, noise_kind="gradient",
                  noise_scale=-0.5)  # fmt: skip
    scree = layer(grass, marsh, name="scree", colour="#888070", slope=(None, None, 30, 42), noise_scale=1.0,
                  noise_kind="billow", roughness=8.0, relief_wavelength=90, relief_kind="hybrid")  # fmt: skip
    return layer(scree, snow, name="rock", colour="#6b625a", variation=0.3, roughness=15.0, relief_kind="billow",
                 relief_wavelength=120)  # fmt: skip


def on_host(texture):
    return [DEVICE.to_host(plane) for plane in texture]


@pytest.mark.parametrize("cell", [1.5, 7.5, 30.0, 100.0, (11.0, 13.0)])
def test_it_equals_the_reference(cell):
    scene = scene_of(all_of_it(), ground(void=True), [WARMTH, WET])
    assert scene.reach == 4
    window = (cell, -3, 5, 75, 67)
    expected, found = evaluate(scene, *window), on_host(evaluate_on_device(scene, *window, DEVICE))
    colour, height, normals, coverage = found
    # A code of a colour may be rounded the other way; heights of 2000 m have steps of 1e-4 m.
    assert np.abs(colour.astype(int) - expected.colour).max() <= 1
    assert (colour != expected.colour).mean() < 1e-3
    assert np.array_equal(np.isnan(height), np.isnan(expected.height))
    assert np.nanmax(np.abs(height - expected.height)) < 2e-3
    assert np.nanmax(np.abs(normals - expected.normals)) < 5e-4
    assert np.abs(coverage - expected.coverage).max() < 5e-4


@pytest.mark.parametrize("cell", [2.5, 10.0, 40.0])
def test_a_window_is_that_part_of_the_whole_bit_for_bit(cell, monkeypatch):
    scene = scene_of(all_of_it(), ground(void=True), [WARMTH, WET])
    rows, cols = int(720 / cell), int(900 / cell)
    whole = on_host(evaluate_on_device(scene, cell, 0, 0, rows, cols, DEVICE))
    monkeypatch.setattr("nodegraph_texture.apply_opencl.STRIP", 700)
    for row, col, down, across in [
        (0, 0, 5, 7),
        (rows // 3, cols // 4, rows // 2, cols // 2),
        (rows - 1, cols - 1, 1, 1),
    ]:
        part = on_host(evaluate_on_device(scene, cell, row, col, down, across, DEVICE))
        for expected, found in zip(whole, part, strict=True):
            assert np.array_equal(found, expected[row : row + down, col : col + across], equal_nan=True)


def test_editing_layers_compiles_nothing():
    first = scene_of(layer(name="rock", colour="grey", roughness=5.0), ground())
    evaluate_on_device(first, 30.0, 0, 0, 24, 30, DEVICE)
    builds = DEVICE.builds
    evaluate_on_device(scene_of(all_of_it(), ground(), [WARMTH, WET]), 30.0, 0, 0, 24, 30, DEVICE)
    assert DEVICE.builds == builds


def test_hats_that_never_rise_or_fall():
    for rise, fall in [((-inf, -inf), (inf, inf)), ((inf, inf), (inf, inf)), ((-inf, -inf), (-inf, -inf)),
                       ((1500.0, 1500.0), (1500.0, 1500.0)), ((0.0, 1e-30), (1e9, 1e9))]:  # fmt: skip
        top = SurfaceLayers("top", (1.0, 1.0, 1.0), (Hat("altitude", rise, fall),))
        scene = scene_of(SurfaceLayers("base", (0.0, 0.0, 0.0), children=(top,)), ground())
        expected = evaluate(scene, 30.0, 0, 0, 24, 30)
        found = on_host(evaluate_on_device(scene, 30.0, 0, 0, 24, 30, DEVICE))
        assert np.array_equal(found[3], expected.coverage)


def test_samples_at_and_beyond_their_ends():
    samples = Sampled("temperature", -2.0, 6.0, np.array([0.25, 1, 0, 0.5], np.float32))
    top = SurfaceLayers("top", (1.0, 1.0, 1.0), (samples,))
    scene = scene_of(SurfaceLayers("base", (0.0, 0.0, 0.0), children=(top,)), ground(), [WARMTH])
    expected, found = (
        evaluate(scene, 9.0, 0, 0, 80, 100),
        on_host(evaluate_on_device(scene, 9.0, 0, 0, 80, 100, DEVICE)),
    )
    assert found[3] == pytest.approx(expected.coverage, abs=1e-6)
    assert {0.25, 0.5} <= set(np.unique(expected.coverage[..., 1]).tolist())


def test_a_tree_is_the_ground():
    scene = scene_of(all_of_it(), from_elevation(ground()), [WARMTH, WET], BOX)
    expected, found = (
        evaluate(scene, 15.0, 0, 0, 48, 60),
        on_host(evaluate_on_device(scene, 15.0, 0, 0, 48, 60, DEVICE)),
    )
    assert np.array_equal(np.isnan(found[1]), np.isnan(expected.height))
    assert np.abs(found[3] - expected.coverage).max() < 5e-4


def test_a_constraint_of_another_kind_is_refused():
    class Wave(Constraint):
        def at(self, values):
            return np.abs(np.sin(values))

    scene = scene_of(SurfaceLayers("base", (0.0, 0.0, 0.0), (Wave("altitude"),)), ground())
    assert evaluate(scene, 30.0, 0, 0, 24, 30).coverage.max() > 0.5
    with pytest.raises(TypeError, match="Wave has no OpenCL form"):
        evaluate_on_device(scene, 30.0, 0, 0, 24, 30, DEVICE)
