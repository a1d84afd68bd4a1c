"""Atom sheets and previews."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nodegraph_sparse.dictionary import SampledDictionary, SparseCode
from nodegraph_sparse.dictionary_from_patches import dictionary_from_patches
from nodegraph_sparse.draw_dictionary import GAP, LINE, RIM, draw_dictionary, usage_counts
from nodegraph_sparse.patches import patches
from nodegraph_sparse.previews import preview_code, preview_dictionary, preview_patches
from nodegraph_terrain.raster import Elevation, Extent

SURFACE = Elevation(
    np.random.default_rng(0).normal(size=(40, 48)).cumsum(axis=0).astype(np.float32), Extent(0.0, 0.0, 480.0, 400.0)
)
PATCHES = patches(SURFACE, radius=40.0)
ATOMS = dictionary_from_patches(PATCHES, choice="farthest", atoms=20)


def code(indices):
    count = PATCHES.grid.count
    indices = np.resize(np.asarray(indices, np.int32), (count, 1))
    return SparseCode(PATCHES.grid, indices, np.ones((count, 1)), PATCHES.means, np.ones(count), ATOMS.count)


def tile_at(image, number, tile, per_row, line=LINE):
    row, col = divmod(number, per_row)
    top, left = RIM + row * (tile + GAP + line), RIM + col * (tile + GAP)
    return image.data[top : top + tile, left : left + tile].astype(float)


def test_each_atom_has_its_place_and_light_comes_from_the_north_west():
    x = np.arange(16) - 7.5
    bump = np.exp(-(x[:, None] ** 2 + x**2) / 20)
    tilt = np.add.outer(x, np.zeros(16))
    dictionary = SampledDictionary(
        "weighted", np.zeros(2, np.int32), ("a",), np.stack([bump, tilt]).astype(np.float32)
    )  # fmt: skip
    image = draw_dictionary(dictionary, tile=64)
    hill = tile_at(image, 0, 64, 2).mean(axis=2)
    assert hill[16:30, 16:30].mean() > hill[34:48, 34:48].mean() + 40
    assert tile_at(image, 0, 64, 2)[0, 0].tolist() == [255, 255, 255]
    grey = tile_at(draw_dictionary(dictionary, tile=64, style="grey"), 1, 64, 2).mean(axis=2)
    assert (np.diff(grey[2:62, 32]) > 0).all()


def test_many_atoms_make_rows_and_the_rest_a_note():
    image = draw_dictionary(ATOMS, tile=30, width=200, most=12)
    per_row = (200 - 2 * RIM + GAP) // (30 + GAP)
    assert image.shape[0] == 2 * RIM + -(-12 // per_row) * (30 + GAP + LINE) + GAP + LINE
    assert image.extent.width == image.shape[1]
    assert (draw_dictionary(ATOMS, tile=30, width=200).shape[0]) > image.shape[0]
    with pytest.raises(ValueError, match=r"over 16,384; draw less"):
        draw_dictionary(replace(ATOMS, samples=ATOMS.samples[:1].repeat(200, 0), sources=np.zeros(200, np.int32)),
                        tile=512, width=200)  # fmt: skip


def test_usage_pales_what_is_not_used_and_orders():
    used = code([4, 4, 7])
    np.testing.assert_array_equal(np.flatnonzero(usage_counts(used)), [4, 7])
    image = draw_dictionary(ATOMS, used, order="usage", tile=40, numbers=False)
    per_row = 20
    first, third = tile_at(image, 0, 40, per_row, 0), tile_at(image, 2, 40, per_row, 0)
    np.testing.assert_array_equal(first, tile_at(draw_dictionary(ATOMS, tile=40, numbers=False), 4, 40, per_row, 0))
    assert first[8:32, 8:32].mean() < 200 < third[8:32, 8:32].mean()
    with pytest.raises(ValueError, match="only be drawn by usage with a code"):
        draw_dictionary(ATOMS, order="usage")
    with pytest.raises(ValueError, match="a dictionary of 20 atoms, and this one has 3"):
        draw_dictionary(ATOMS.take(np.arange(3)), used)


def test_unused_places_of_a_code_count_nothing():
    assert usage_counts(code([-1])).tolist() == [0] * 20


@pytest.mark.parametrize(
    ("preview", "value"),
    [
        (preview_patches, PATCHES),
        (preview_dictionary, ATOMS),
        (preview_code, code([3, 4])),
        (preview_code, replace(code([-1]), size=8)),
    ],
)
def test_previews_are_pictures_and_the_same_again(preview, value):
    first = preview(value)
    assert first.startswith(b"\x89PNG")
    assert first == preview(value)
