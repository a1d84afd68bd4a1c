from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph_terrain.colour import HYPSOMETRIC, blend_shade, colour_relief
from nodegraph_terrain.raster import Elevation, Extent, Image, Raster, Shade

MODES = ("multiply", "overlay", "soft_light")


def raster(data: Any, role: type = Elevation) -> Any:
    data = np.atleast_2d(np.asarray(data, np.float32))
    return role(data, Extent(0, 0, data.shape[1], data.shape[0]))


def picture(data: Any) -> Image:
    data = np.asarray(data, np.uint8)
    return Image(data, Extent(0, 0, data.shape[1], data.shape[0]))


def rgb(text: str) -> list[int]:
    return [int(text[k : k + 2], 16) for k in (1, 3, 5)]


@pytest.mark.parametrize("name", ["viridis", "terrain", "gist_earth_r", "tab10"])
def test_named_maps_are_those_of_matplotlib(name: str) -> None:
    data = np.linspace(-3, 12, 301).reshape(7, 43)
    given = colour_relief(raster(data), colours=name, minimum=0.0, maximum=10.0)
    share = data.astype(np.float32).astype(np.float64) / 10.0
    expected = matplotlib.colormaps[name](np.clip(share, 0, 1), bytes=True)
    np.testing.assert_array_equal(given.data, expected)


def test_stops_have_exactly_their_colours() -> None:
    stops = ((-5.0, "#123456"), (0.0, "#ff0000"), (300.0, "#00ff80"), (301.5, "#FFFFFF"))
    given = colour_relief(raster([value for value, _ in stops]), colours=stops).data
    assert given[0, :, :3].tolist() == [rgb(text) for _, text in stops]
    assert (given[..., 3] == 255).all()
    between = colour_relief(raster([150.0, -100.0, 999.0]), colours=stops).data[0, :, :3].tolist()
    assert between == [[128, 128, 64], rgb("#123456"), rgb("#ffffff")]


def test_lists_are_spread_evenly_over_the_range() -> None:
    given = colour_relief(raster([10, 15, 20]), colours=("#000000", "#c86432", "#ffffff")).data[0, :, :3]
    assert given[0].tolist() == [0, 0, 0]
    assert given[2].tolist() == [255, 255, 255]
    assert np.abs(given[1].astype(int) - [200, 100, 50]).max() <= 1
    default = colour_relief(raster([0, 1])).data[0, :, :3].tolist()
    assert default == [rgb(HYPSOMETRIC[0]), rgb(HYPSOMETRIC[-1])]
    assert colour_relief(raster([0, 1]), colours="hypsometric_r").data[0, :, :3].tolist() == default[::-1]
    assert colour_relief(raster([7]), colours=("#102030",)).data.tolist() == [[[16, 32, 48, 255]]]


def test_voids_are_transparent() -> None:
    for colours in ("viridis", ("#ffffff", "#000000"), ((0.0, "#ffffff"), (1.0, "#000000"))):
        given = colour_relief(raster([[0, np.nan], [1, 1]]), colours=colours).data
        assert given[0, 1].tolist() == [0, 0, 0, 0]
        assert given[..., 3].ravel().tolist() == [255, 0, 255, 255]
        assert not colour_relief(raster(np.full((3, 4), np.nan)), colours=colours).data.any()


def test_ranges_that_leave_nothing_between_have_the_colour_of_the_end() -> None:
    ends = {"colours": ("#000000", "#ffffff")}
    assert colour_relief(raster([5, 5]), **ends).data[0, 0, 0] == 0
    assert colour_relief(raster([5, 6]), minimum=7.0, **ends).data[0, :, 0].tolist() == [0, 0]
    assert colour_relief(raster([5, 6]), maximum=4.0, **ends).data[0, :, 0].tolist() == [255, 255]
    assert colour_relief(raster([5, 6]), maximum=5.0, **ends).data[0, :, 0].tolist() == [255, 255]


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"colours": "virdis"}, "did you mean 'viridis'"),
        ({"colours": ("#12345",)}, "'#12345' must read '#rrggbb'"),
        ({"colours": ()}, "colours are missing"),
        ({"colours": ((1.0, "#000000"), (1.0, "#ffffff"))}, "must rise"),
        ({"colours": ((1.0, "#000000"), (2.0, "#ffffff")), "minimum": 0.0}, "leave out minimum"),
        ({"minimum": 2.0, "maximum": 2.0}, "must be below maximum"),
    ],
)
def test_what_is_wrong_is_said(params: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        colour_relief(raster([0, 1]), **params)


@pytest.mark.parametrize(
    "colours", ["terrain", ["#000000", "#ffffff"], [[0, "#000000"], [12.5, "#ffffff"]], [[1, "#000000"]]]
)
def test_graph_files_may_give_any_form(colours: Any) -> None:
    values = colour_relief.parameters.check({"colours": colours}).values
    assert isinstance(colour_relief(raster([0, 1, 2]), **values), Image)


COLOURS = np.random.default_rng(0).integers(0, 256, (16, 16, 3))


@pytest.mark.parametrize("mode", MODES)
def test_level_ground_keeps_its_colour(mode: str) -> None:
    level = raster(np.full((16, 16), 0.7071), Shade)
    given = blend_shade(picture(COLOURS), level, mode=mode).data
    assert np.abs(given.astype(int) - COLOURS).max() <= (0 if mode == "multiply" else 1)
    assert blend_shade(picture(COLOURS), raster(np.zeros((16, 16)), Shade), mode=mode, strength=0.0).data is not None


@pytest.mark.parametrize("mode", MODES)
def test_more_light_is_never_darker(mode: str) -> None:
    for colour in ([180, 140, 90], [20, 60, 30], [250, 250, 245], [0, 0, 0], [255, 255, 255], [90, 0, 200]):
        light = np.linspace(0, 1, 101)
        given = blend_shade(picture(np.tile(colour, (1, 101, 1))), raster(light, Shade), mode=mode).data[0].astype(int)
        luminance = given @ np.array([0.2126, 0.7152, 0.0722])
        assert (np.diff(luminance) >= -1).all()
        if mode == "multiply":
            assert given[0].tolist() == [0, 0, 0]


def test_multiply_by_hand() -> None:
    given = blend_shade(picture([[[200, 100, 50]] * 3]), raster([0.35355, 0.7071, 1.0], Shade)).data[0]
    assert given[0].tolist() == [100, 50, 25]
    assert given[1].tolist() == [200, 100, 50]
    # Half way to white.
    assert np.abs(given[2] - [227.5, 177.5, 152.5]).max() <= 0.5


@pytest.mark.parametrize("mode", MODES)
def test_greys_stay_grey_alpha_stays_and_void_shade_leaves_the_picture(mode: str) -> None:
    grey = np.repeat(np.arange(0, 256, 5, dtype=np.uint8)[None, :, None], 4, axis=2)
    light = np.full(grey.shape[:2], 0.4)
    light[0, 7] = np.nan
    given = blend_shade(picture(grey), raster(light, Shade), mode=mode).data
    assert np.ptp(given[..., :3].astype(int), axis=2).max() <= 1
    assert np.array_equal(given[..., 3], grey[..., 3])
    assert np.array_equal(given[0, 7], grey[0, 7])


@given(mode=st.sampled_from(MODES), strength=st.floats(0, 2), level=st.floats(0.01, 0.99), shade=st.floats(0, 1))
def test_any_setting_gives_a_picture(mode: Any, strength: float, level: float, shade: float) -> None:
    light = raster(np.full((16, 16), shade), Shade)
    given = blend_shade(picture(COLOURS), light, mode=mode, strength=strength, level=level)
    assert given.data.dtype == np.uint8


def test_other_grids_are_refused() -> None:
    with pytest.raises(ValueError, match="do not match"):
        blend_shade(picture(COLOURS), raster(np.zeros((3, 3)), Shade))


def test_colour_relief_takes_any_raster() -> None:
    assert colour_relief(raster([0, 1], Raster)).shape == (1, 2)
