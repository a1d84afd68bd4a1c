"""Splat maps and pictures of layers."""

from __future__ import annotations

import json
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image as Picture

from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_texture.apply_layers import apply_layers
from nodegraph_texture.coverage import Coverage, coverage, rounded_shares, save_splat, visible
from nodegraph_texture.draw_layers import draw_layers
from nodegraph_texture.layer import layer
from nodegraph_texture.previews import preview_coverage, preview_layers

BOX = Extent(0, 0, 300, 200)


def painted(void: bool = False):
    heights = np.add.outer(np.zeros(20), np.linspace(0, 1000, 30)).astype(np.float32)
    if void:
        heights[3:6, 4:9] = np.nan
    tops = [
        layer(name=f"belt {i}", colour=f"#{40 * i:02x}8040", altitude=(150 * i, 150 * i + 90, None, None))
        for i in range(5)
    ]
    return apply_layers(layer(*tops, name="base", colour="black"), Elevation(heights, BOX), factor=1)


def test_visible_weights_make_the_picture():
    made = painted()
    weights = visible(made.coverage.data)
    assert weights.sum(axis=-1) == pytest.approx(1, abs=1e-5)
    assert np.abs(weights @ np.array(made.coverage.colours) * 255 - made.image.data[..., :3]).max() < 0.51
    for number, name in enumerate(made.coverage.names):
        assert np.array_equal(coverage(made.coverage, name=name).data, made.coverage.data[..., number])
        shown = coverage(made.coverage, name=name, amount="visible").data
        assert shown == pytest.approx(weights[..., number], abs=1e-6)


@given(arrays(np.float32, (5, 7), elements=st.floats(0, 1, width=32)))
@settings(max_examples=60, deadline=None)
def test_rounded_shares_add_up_and_are_near(weights):
    found = rounded_shares(weights)
    total = weights.sum(axis=-1, dtype=np.float64)
    assert np.array_equal(found.sum(axis=-1), np.where(total > 0, 255, 0))
    exact = 255 * weights / np.where(total > 0, total, 1)[:, None]
    assert np.abs(found - exact).max() < 1


def test_pages_hold_four_layers_each():
    made = painted(void=True)
    file = save_splat(made.coverage, name="maps/splat.png")
    assert [item.name for item in file.all()] == ["maps/splat.png", "maps/splat_2.png", "maps/splat.json"]
    pages = [np.asarray(Picture.open(BytesIO(bytes(item.content)))) for item in file.all()[:2]]
    table = json.loads(bytes(file.sidecars[-1].content))["layers"]
    assert [item["layer"] for item in table] == list(made.coverage.names)
    assert table[4]["page"] == "maps/splat_2.png"
    assert table[5]["channel"] == "G"
    total = sum(page.astype(int).sum(axis=-1) for page in pages)
    assert np.array_equal(total, np.where(np.isnan(made.surface.data), 0, 255))
    assert (pages[1][..., 2:] == 0).all()


def test_what_is_wrong_is_said():
    made = painted()
    with pytest.raises(ValueError, match="there is no layer 'belt 9'"):
        coverage(made.coverage, name="belt 9")
    with pytest.raises(ValueError, match=r"must end in \.png"):
        save_splat(made.coverage, name="splat.tga")
    with pytest.raises(ValueError, match="as many names"):
        Coverage(made.coverage.data, BOX, ("a",), ((0.0, 0.0, 0.0),))


def many(count: int):
    return layer(*[layer(name=f"$layer_{i}$", colour="teal") for i in range(count)], name="base", colour="black")


def test_pictures_show_every_layer():
    measured = layer(name="measured", colour="#aa3311", constraints={"wetness": (0, 12, (0.0, 0.3, 1.0, 0.2))})
    stepped = layer(measured, name="stepped", colour="#4477aa", altitude=(100, 100, 400, 400), slope=(None,) * 4)
    drawn = draw_layers(layer(stepped, name="a name far too long to be shown whole", colour="tan", roughness=3.0,
                              noise_scale=-2.0, variation=0.5), width=900, title="$ x")  # fmt: skip
    assert drawn.shape[1] == 900
    for colour in ("#aa3311", "#4477aa"):
        code = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert (drawn.data == code).all(axis=-1).sum() > 800
    assert draw_layers(many(12), width=400).shape[0] > draw_layers(many(3), width=400).shape[0]
    with pytest.raises(ValueError, match="pixels high"):
        draw_layers(many(300), width=1000)
    for picture in (preview_layers(many(2)), preview_coverage(painted(void=True).coverage)):
        assert np.asarray(Picture.open(BytesIO(picture)).convert("L"), float).std() > 5
