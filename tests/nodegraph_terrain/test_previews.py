from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
from PIL import Image as Picture

from nodegraph_terrain.previews import (
    PREVIEWS,
    preview_elevation,
    preview_histogram,
    preview_image,
    preview_labels,
    preview_unit,
)
from nodegraph_terrain.raster import GRIDS, Elevation, Extent, Grid, Image, Labels, Mask, Raster, Shade, Slope
from nodegraph_terrain.sample_dem import sample_dem
from nodegraph_terrain.statistics import Histogram


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Picture.open(BytesIO(png)))


def test_the_sample_dem_is_drawn_in_true_proportions_and_upright() -> None:
    picture = pixels(preview_elevation(sample_dem()))
    rows, cols = picture.shape[:2]
    # 31.9 km high, 30.0 km wide.
    assert rows / cols == pytest.approx(31.9 / 30.0, rel=0.01)
    # High ground, in the south-west, is drawn whiter than the valley in the south-east.
    blue = picture[rows // 2 :, :, 2].astype(float)
    assert blue[:, : cols // 2].mean() > blue[:, cols // 2 :].mean() + 20
    assert (picture[..., 3] == 255).all()


def test_light_comes_from_the_north_west() -> None:
    y, x = np.mgrid[0:64, 0:64] - 31.5
    hill = Elevation((100 * np.exp(-(x**2 + y**2) / 200)).astype(np.float32), Extent(0, 0, 640, 640))
    brightness = pixels(preview_elevation(hill))[..., :3].sum(axis=2)
    assert brightness[22, 22] > brightness[41, 41] + 100


def test_voids_are_transparent_and_leave_no_dark_rim() -> None:
    data = np.full((50, 50), 500, np.float32)
    data[:25] = 100
    data[10:20, 10:20] = np.nan
    picture = pixels(preview_elevation(Elevation(data, Extent(0, 0, 500, 500))))
    np.testing.assert_array_equal(picture[..., 3] == 0, np.isnan(data))
    np.testing.assert_array_equal(picture[9, 15], picture[2, 40])


@pytest.mark.parametrize("shape", [(3000, 1000), (1, 1), (1, 5000), (700, 2500)])
@pytest.mark.parametrize("role", [Raster, Elevation, Mask, Slope, Shade])
def test_the_long_side_is_bounded(role: type[Raster], shape: tuple[int, int]) -> None:
    grid = role(np.random.default_rng(0).random(shape, np.float32), Extent(0, 0, shape[1], shape[0]))
    render = next(item.render for item in PREVIEWS if item.type is role)
    rows, cols = pixels(render(grid)).shape[:2]
    assert max(rows, cols) <= 1024
    assert rows <= shape[0]
    assert cols <= shape[1]


def test_every_type_and_awkward_values() -> None:
    extent = Extent(0, 0, 8, 8)
    for role in GRIDS[1:6]:
        render = next(item.render for base in role.__mro__ for item in PREVIEWS if item.type is base)
        for data in (np.full((8, 8), np.nan), np.zeros((8, 8)), np.full((8, 8), 1e30)):
            assert pixels(render(role(data.astype(np.float32), extent))).shape == (8, 8, 4)
    drawn = {item.type for item in PREVIEWS}
    assert all(any(base in drawn for base in role.__mro__) for role in GRIDS if role is not Grid)


def test_masks_are_grey() -> None:
    mask = Mask(np.array([[0, 0.5, 1, np.nan]], np.float32), Extent(0, 0, 4, 1))
    picture = pixels(preview_unit(mask))
    assert picture[0, :, 0].tolist()[:3] == [0, 128, 255]
    assert picture[0, :, 3].tolist() == [255, 255, 255, 0]


def test_labels_have_colours_of_their_own() -> None:
    labels = Labels(np.arange(-1, 11, dtype=np.int32)[None], Extent(0, 0, 12, 1))
    picture = pixels(preview_labels(labels))
    assert picture[0, 0, 3] == 0
    colours = picture[0, 1:, :3].astype(int)
    distance = np.abs(colours[:, None] - colours[None]).sum(axis=2)
    assert distance[~np.eye(11, dtype=bool)].min() > 30


def test_images_stay_as_they_are_or_are_averaged() -> None:
    rng = np.random.default_rng(1)
    image = Image(rng.integers(0, 256, (20, 30, 3), np.uint8), Extent(0, 0, 30, 20))
    np.testing.assert_array_equal(pixels(preview_image(image)), image.data)
    large = Image(np.full((2048, 2048, 4), [10, 20, 30, 128], np.uint8), Extent(0, 0, 1, 1))
    small = pixels(preview_image(large))
    assert small.shape == (1024, 1024, 4)
    assert np.abs(small.astype(int) - [10, 20, 30, 128]).max() <= 1


def test_a_histogram_is_drawn_as_bars_of_its_counts() -> None:
    def ink(counts: list[int]) -> float:
        histogram = Histogram(np.array([0.0, 10.0, 20.0]), np.array(counts, np.int64), "m")
        picture = pixels(preview_histogram(histogram))[..., :3].astype(int)
        return float((np.abs(picture - (0x3B, 0x6F, 0x8F)).sum(axis=2) < 12).mean())

    full, half = ink([4, 4]), ink([4, 0])
    assert full > 0.4
    assert half == pytest.approx(full / 2, rel=0.05)
