from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from rasterio.warp import transform_bounds

from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_texture.load_image import load_band, load_image

UTM = "EPSG:32645"
GRID = Elevation(np.zeros((20, 30), np.float32), Extent(500000, 3100000, 500900, 3100600, UTM))
DICE = np.random.default_rng(1)
RGB = DICE.integers(1, 256, (3, 20, 30)).astype(np.uint8)


def picture(path: Path, data: np.ndarray = RGB, extent: Any = GRID.extent, **profile: Any) -> Path:
    count, rows, cols = data.shape
    place = Affine(extent.width / cols, 0, extent.west, 0, -extent.height / rows, extent.north)
    profile = {"transform": place, "crs": UTM} | profile
    colours = profile.pop("colours", None)
    with rasterio.open(
        path, "w", driver="GTiff", width=cols, height=rows, count=count, dtype=data.dtype.name, **profile
    ) as dataset:
        dataset.write(data)
        if colours:
            dataset.write_colormap(1, colours)
    return path


def test_on_its_own_grid_a_picture_is_what_it_was(tmp_path):
    for method in ("nearest", "bilinear", "average"):
        image = load_image(GRID, path=picture(tmp_path / "a.tif"), resampling=method)
        np.testing.assert_array_equal(np.moveaxis(image.data[..., :3], 2, 0), RGB)
        assert (image.data[..., 3] == 255).all()
        assert image.extent == GRID.extent


def test_a_gradient_in_degrees_lands_where_it_belongs(tmp_path):
    west, south, east, north = transform_bounds(UTM, "EPSG:4326", 499000, 3099000, 502000, 3102000)
    box = Extent(west, south, east, north, "EPSG:4326", "deg")
    x, y = np.meshgrid(np.linspace(west, east, 301), np.linspace(north, south, 301))
    x, y = x[:-1, :-1] + (east - west) / 600, y[:-1, :-1] - (north - south) / 600
    from nodegraph_terrain.georeference import parse_crs, transformed

    easting, _ = transformed(parse_crs("EPSG:4326"), parse_crs(UTM), x, y)
    ramp = np.clip((easting - 499000) / 3000 * 255, 0, 255).astype(np.float32)
    path = picture(tmp_path / "deg.tif", np.stack([ramp] * 3), box, crs="EPSG:4326")
    image = load_image(GRID, path=path, range=(0, 255))
    expected = (500000 + 15 + 30 * np.arange(30) - 499000) / 3000 * 255
    np.testing.assert_allclose(image.data[..., 0], np.broadcast_to(expected, (20, 30)), atol=1)


def test_coarser_cells_take_means(tmp_path):
    fine = picture(tmp_path / "fine.tif", np.kron(RGB, np.array([[0, 2], [1, 1]])).clip(0, 255).astype(np.uint8))
    image = load_image(GRID, path=fine, resampling="average")
    codes = np.stack([np.kron(band, np.array([[0, 2], [1, 1]])).clip(0, 255) for band in RGB]).astype(np.uint8)
    means = codes.reshape(3, 20, 2, 30, 2).mean(axis=(2, 4))
    np.testing.assert_allclose(np.moveaxis(image.data[..., :3], 2, 0), means, atol=1)


def test_outside_and_no_data_are_transparent(tmp_path):
    half = Extent(500450, 3100000, 501350, 3100600, UTM)
    image = load_image(GRID, path=picture(tmp_path / "half.tif", extent=half), resampling="nearest")
    assert not image.data[:, :15].any()
    np.testing.assert_array_equal(np.moveaxis(image.data[:, 15:, :3], 2, 0), RGB[:, :, :15])
    holed = RGB.copy()
    holed[:, 3, 4] = 0
    image = load_image(GRID, path=picture(tmp_path / "hole.tif", holed, nodata=0), resampling="nearest")
    assert (image.data[..., 3] == 0).sum() == 1
    assert image.data[3, 4, 3] == 0


def test_alpha_palette_grey_and_bands(tmp_path):
    alpha = np.full((1, 20, 30), 255, np.uint8)
    alpha[0, 0] = 0
    path = picture(tmp_path / "rgba.tif", np.concatenate([RGB, alpha]), photometric="RGB", alpha="yes")
    image = load_image(GRID, path=path, resampling="nearest")
    assert not image.data[0].any()
    np.testing.assert_array_equal(image.data[1:, :, 0], RGB[0, 1:])
    codes = DICE.integers(0, 3, (1, 20, 30)).astype(np.uint8)
    colours = {0: (10, 20, 30, 255), 1: (200, 0, 0, 255), 2: (0, 0, 250, 255)}
    image = load_image(GRID, path=picture(tmp_path / "p.tif", codes, colours=colours, photometric="palette"))
    np.testing.assert_array_equal(image.data, np.array([colours[k] for k in range(3)], np.uint8)[codes[0]])
    grey = load_image(GRID, path=picture(tmp_path / "g.tif", RGB[:1]), resampling="nearest")
    assert (grey.data[..., :3] == RGB[0][..., None]).all()
    turned = load_image(GRID, path=picture(tmp_path / "b.tif"), bands=(3, 2, 1), resampling="nearest")
    np.testing.assert_array_equal(turned.data[..., 0], RGB[2])


def test_sixteen_bits_need_a_range_and_bands_keep_their_numbers(tmp_path):
    data = (RGB.astype(np.uint16) * 40) + 7
    path = picture(tmp_path / "16.tif", data)
    with pytest.raises(ValueError, match="state range"):
        load_image(GRID, path=path)
    image = load_image(GRID, path=path, range=(7, 7 + 255 * 40), resampling="nearest")
    np.testing.assert_array_equal(np.moveaxis(image.data[..., :3], 2, 0), RGB)
    band = load_band(GRID, path=path, band=2, name="near_infrared", resampling="nearest")
    np.testing.assert_array_equal(band.data, data[1])
    assert band.name == "near_infrared"


def test_a_float_band_keeps_its_voids(tmp_path):
    data = DICE.random((1, 20, 30)).astype(np.float32)
    data[0, 5, 6] = np.nan
    band = load_band(GRID, path=picture(tmp_path / "f.tif", data, nodata=np.nan), name="rain", resampling="nearest")
    np.testing.assert_array_equal(band.data, data[0])


def test_plain_metres_on_both_sides(tmp_path):
    plain = Elevation(GRID.data, Extent(0, 0, 900, 600))
    path = picture(tmp_path / "plain.tif", extent=plain.extent, crs=None)
    np.testing.assert_array_equal(load_image(plain, path=path, resampling="nearest").data[..., 0], RGB[0])


def test_bad_input_is_one_sentence(tmp_path):
    far = picture(tmp_path / "far.tif", extent=Extent(600000, 3100000, 600900, 3100600))
    with pytest.raises(ValueError, match="do not overlap"):
        load_image(GRID, path=far)
    with pytest.raises(ValueError, match="no coordinate reference system, and the elevation has"):
        load_image(GRID, path=picture(tmp_path / "no.tif", crs=None))
    with pytest.raises(ValueError, match="the elevation has no coordinate reference system"):
        load_image(Elevation(GRID.data, Extent(0, 0, 900, 600)), path=picture(tmp_path / "a.tif"))
    with pytest.raises(ValueError, match="no band 7"):
        load_image(GRID, path=tmp_path / "a.tif", bands=(1, 2, 7))
    with pytest.raises(ValueError, match="holds no data"):
        load_image(GRID, path=picture(tmp_path / "e.tif", np.zeros_like(RGB), nodata=0))
    with pytest.raises(ValueError, match="must rise"):
        load_image(GRID, path=tmp_path / "a.tif", range=(5, 5))
    with pytest.raises(FileNotFoundError):
        load_image(GRID, path=tmp_path / "none.tif")
    (tmp_path / "text.tif").write_text("no raster")
    with pytest.raises(ValueError, match="cannot be read as a raster"):
        load_image(GRID, path=tmp_path / "text.tif")
    plain = picture(tmp_path / "nowhere.tif", crs=None, transform=Affine.identity())
    with pytest.raises(ValueError, match="does not say where it lies"):
        load_image(GRID, path=plain)
    image = load_image(GRID, path=plain, extent=(500000, 3100000, 500900, 3100600), crs=UTM, resampling="nearest")
    np.testing.assert_array_equal(image.data[..., 1], RGB[1])
