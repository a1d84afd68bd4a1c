from __future__ import annotations

import colorsys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from nodegraph import Context
from nodegraph_terrain.raster import Elevation, Extent, Image, Mask, Raster
from nodegraph_texture.classify_surfaces import classify_surfaces
from nodegraph_texture.colour_table import colour_codes, colour_table, hue_saturation_value, looked_up
from nodegraph_texture.hue_saturation import Rectangle, colours_of, histogram_of, hue_saturation_histogram
from nodegraph_texture.surface_classes import classes_of

BOX = Extent(0, 0, 600, 400)
MEANS = np.array([[40, 90, 30], [150, 120, 90], [245, 247, 250], [20, 40, 90]])
TRUTH = np.random.default_rng(2).choice(4, (40, 60), p=[0.4, 0.3, 0.2, 0.1])
PIXELS = np.clip(MEANS[TRUTH] + np.random.default_rng(3).normal(0, 4, (40, 60, 3)), 0, 255).astype(np.uint8)
IMAGE = Image(PIXELS, BOX)
RECTANGLES = (
    Rectangle("snow", value=(0.85, 1.0)),
    Rectangle("water", hue=(190, 280)),
    Rectangle("forest", hue=(70, 190)),
    Rectangle("rock", hue=(340, 70)),
)
GROUND = Elevation(np.linspace(0, 3900, 40, dtype=np.float32)[:, None] + np.zeros((40, 60), np.float32), BOX)


@given(arrays.arrays(np.uint8, (7, 5, 3)))
def test_colour_space_and_tables_are_those_of_the_standard_library(pixels):
    parts = hue_saturation_value(pixels)
    for place in np.ndindex(7, 5):
        hue, saturation, value = colorsys.rgb_to_hsv(*(pixels[place] / 255))
        assert abs((parts[0][place] - 360 * hue + 180) % 360 - 180) < 1e-3
        assert parts[1][place] == pytest.approx(saturation, abs=1e-6)
        assert parts[2][place] == pytest.approx(value, abs=1e-6)
    codes = colour_codes(pixels)
    table = colour_table(codes)
    different, counts = np.unique(pixels.reshape(-1, 3), axis=0, return_counts=True)
    np.testing.assert_array_equal(table.rgb, different)
    np.testing.assert_array_equal(table.counts, counts)
    np.testing.assert_array_equal(looked_up(codes, table, table.codes.astype(np.int32)), codes)


@given(arrays.arrays(np.uint8, (6, 4, 3)), st.integers(2, 40), st.integers(0, 60))
def test_the_histogram_holds_every_pixel_once(pixels, bins, threshold):
    counts = histogram_of(colours_of(Image(pixels, BOX), Context()), threshold, 285, bins).counts
    assert counts.sum() == 24
    grey = (pixels.max(axis=2).astype(int) - pixels.min(axis=2) <= threshold).sum()
    assert counts[:, int(285 / 360 * bins)].sum() >= grey


def test_histogram_bins_and_transparency():
    pixels = np.zeros((1, 3, 4), np.uint8)
    pixels[0, :] = [[0, 0, 200, 255], [0, 0, 200, 255], [0, 255, 0, 0]]
    counts = hue_saturation_histogram(Image(pixels, BOX), bins=36).histogram.counts
    assert counts[35, 24] == 2
    assert counts.sum() == 2
    pixels[..., 3] = 0
    with pytest.raises(ValueError, match="transparent"):
        hue_saturation_histogram(Image(pixels, BOX))


def test_rectangles_wrap_and_the_first_counts():
    found = classify_surfaces(IMAGE, method="rectangles", rectangles=RECTANGLES)
    assert found.classes.names == ("snow", "water", "forest", "rock")
    np.testing.assert_array_equal(found.labels.data, np.array([2, 3, 0, 1])[TRUTH])
    for number, own in enumerate((2, 3, 0, 1)):
        cells = PIXELS[own == TRUTH] / 255
        assert found.classes.counts[number] == len(cells)
        np.testing.assert_allclose(found.classes.colours[number], cells.mean(axis=0), atol=1e-5)
        np.testing.assert_allclose(found.classes.shades[number].mean(axis=0), cells.mean(axis=0), atol=1e-5)
    water = (Rectangle("water", hue=(190, 280), saturation=(0.5, 1.0)),)
    none = classify_surfaces(IMAGE, method="rectangles", rectangles=water)
    assert (none.labels.data == -1).sum() == (TRUTH != 3).sum()


def test_shades_run_from_dark_to_bright():
    grey = np.arange(64, dtype=np.uint8)[:, None].repeat(3, axis=1)[None]
    shades = classes_of(("all",), [colour_table(colour_codes(grey))]).shades[0, :, 0]
    np.testing.assert_allclose(shades, (3.5 + 8 * np.arange(8)) / 255, atol=1e-6)


@pytest.mark.parametrize("method", ["k_means", "gaussian_mixture", "som"])
def test_automatic_methods_find_four_surfaces(method):
    found = classify_surfaces(IMAGE, method=method, classes=4)
    assert list(found.classes.counts) == sorted(found.classes.counts, reverse=True)
    right = sum(np.bincount(found.labels.data[own == TRUTH]).max() for own in range(4))
    assert right / TRUTH.size > 0.99
    again = classify_surfaces(IMAGE, method=method, classes=4)
    np.testing.assert_array_equal(found.labels.data, again.labels.data)


def test_learning_from_rectangles_reaches_beyond_them():
    seeds = (
        Rectangle("snow", value=(0.9, 1.0)),
        Rectangle("water", hue=(215, 225)),
        Rectangle("forest", hue=(105, 115)),
        Rectangle("rock", hue=(28, 32)),
    )
    few = classify_surfaces(IMAGE, method="rectangles", rectangles=seeds)
    found = classify_surfaces(IMAGE, method="lvq", rectangles=seeds)
    assert (few.labels.data == -1).mean() > 0.3
    assert (found.labels.data == np.array([2, 3, 0, 1])[TRUTH]).mean() > 0.99


def test_infrared_tells_what_colours_do_not():
    flat = np.full((40, 60, 3), 120, np.uint8)
    flat[::2, ::2] += 3
    band = Raster((TRUTH > 1).astype(np.float32) + np.random.default_rng(1).normal(0, 0.01, TRUTH.shape), BOX)
    found = classify_surfaces(Image(flat, BOX), None, band, classes=2, brightness=0)
    agree = (found.labels.data == (TRUTH > 1)).mean()
    assert max(agree, 1 - agree) > 0.99
    holed = band.data.copy()
    holed[3, 4] = np.nan
    assert classify_surfaces(IMAGE, None, Raster(holed, BOX)).labels.data[3, 4] == -1


def test_snow_in_valleys_and_bright_in_shortwave_is_cloud():
    found = classify_surfaces(IMAGE, GROUND, method="rectangles", rectangles=RECTANGLES, snow_altitude=2000)
    low = GROUND.data < 2000
    assert (found.labels.data[low & (TRUTH == 2)] == -1).all()
    assert (found.labels.data[~low & (TRUTH == 2)] == 0).all()
    assert found.classes.counts[0] == (~low & (TRUTH == 2)).sum()
    band = Raster(np.where(GROUND.data > 3000, 1.0, 0.0).astype(np.float32), BOX)
    bright = classify_surfaces(IMAGE, None, None, band, method="rectangles", rectangles=RECTANGLES, cloud_shortwave=0.5)
    assert (bright.labels.data[(GROUND.data > 3000) & (TRUTH == 2)] == -1).all()
    whitest = classify_surfaces(IMAGE, GROUND, classes=4, snow_altitude=2000)
    assert (whitest.labels.data[low & (TRUTH == 2)] == -1).mean() > 0.99


def test_fields_are_left_out():
    mask = Mask((GROUND.data < 1000).astype(np.float32), BOX)
    found = classify_surfaces(IMAGE, None, None, None, mask, classes=4)
    assert ((found.labels.data == -1) == (mask.data > 0)).all()
    assert found.classes.counts.sum() == (mask.data == 0).sum()


def test_bad_input_is_one_sentence():
    two = Image(np.where(np.arange(60)[None, :, None] < 30, 10, 200).repeat(40, 0).repeat(3, 2).astype(np.uint8), BOX)
    with pytest.raises(ValueError, match="2 colours, fewer than 5 classes"):
        classify_surfaces(two, classes=5)
    with pytest.raises(ValueError, match="needs rectangles"):
        classify_surfaces(IMAGE, method="lvq")
    with pytest.raises(ValueError, match="no cell lies in any rectangle"):
        classify_surfaces(IMAGE, method="rectangles", rectangles=(Rectangle("x", (300, 301), (0.99, 1)),))
    with pytest.raises(ValueError, match="needs the elevation"):
        classify_surfaces(IMAGE, snow_altitude=100)
    with pytest.raises(ValueError, match="needs shortwave"):
        classify_surfaces(IMAGE, cloud_shortwave=1)
    with pytest.raises(ValueError, match="all of the image is cloud"):
        classify_surfaces(
            IMAGE, GROUND, method="rectangles", rectangles=(Rectangle("snow"),), snow_altitude=9000
        )  # fmt: skip
    with pytest.raises(ValueError, match="no cell is left"):
        classify_surfaces(IMAGE, None, None, None, Mask(np.ones((40, 60), np.float32), BOX))
    with pytest.raises(ValueError, match="there is no class 'ice'"):
        classify_surfaces(IMAGE, GROUND, snow="ice", snow_altitude=100)
    with pytest.raises(ValueError, match="different extents"):
        classify_surfaces(IMAGE, Elevation(GROUND.data, Extent(0, 0, 600, 401)))
    with pytest.raises(ValueError, match="must rise"):
        Rectangle("x", saturation=(0.5, 0.2))
    with pytest.raises(ValueError, match="0 to 360"):
        Rectangle("x", hue=(-20, 20))
