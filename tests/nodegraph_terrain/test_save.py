from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image as Picture

from nodegraph import File
from nodegraph.codec import seal
from nodegraph_terrain.load import load_elevation
from nodegraph_terrain.raster import Elevation, Extent, Image, Raster, Slope
from nodegraph_terrain.sample_dem import sample_dem
from nodegraph_terrain.save import save_elevation, save_image

EXACT = ("tif", "r32", "npy", "asc", "h5")
CODED = ("png", "r16")
EXTENTS = st.sampled_from(
    [
        (None, "m"), ("EPSG:32632", "m"), ("EPSG:4326", "deg"), ("EPSG:26710", "m"), ("EPSG:2056", "m"),
        ("EPSG:4269", "deg"),
    ]
)  # fmt: skip


def write(file: File, folder: Path) -> Path:
    for item in file.all():
        target = folder / item.name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(item.content.tobytes())
    return folder / file.name


@st.composite
def elevations(draw: st.DrawFn) -> Elevation:
    heights = st.one_of(
        st.floats(-11000, 9000, width=32), st.integers(-400, 8848).map(float), st.just(float("nan")), st.just(-9999.0)
    )
    data = draw(arrays(np.float32, st.tuples(st.integers(1, 7), st.integers(1, 7)), elements=heights))
    crs, unit = draw(EXTENTS)
    if unit == "deg":
        west, north = draw(st.floats(-100, 100)), draw(st.floats(-60, 60))
        cell = draw(st.sampled_from([1 / 1200, 1 / 3600, 0.5]))
    else:
        west, north = draw(st.floats(1e5, 9e5)), draw(st.floats(1e6, 8e6))
        cell = draw(st.sampled_from([0.5, 30.0, 92.3]))
    tall = draw(st.sampled_from([1.0, 1.0, 1.25]))
    rows, cols = data.shape
    if np.isnan(data).all():
        data[0, 0] = 12.5
    return Elevation(data, Extent(west, north - rows * cell * tall, west + cols * cell, north, crs or "", unit))


def same_place(a: Extent, b: Extent, cell: float) -> None:
    assert (a.crs, a.unit) == (b.crs, b.unit)
    for edge in ("west", "south", "east", "north"):
        assert getattr(a, edge) == pytest.approx(getattr(b, edge), abs=1e-6 * cell)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(surface=elevations())
@pytest.mark.parametrize("suffix", EXACT)
def test_float_formats_come_back_exactly(suffix: str, surface: Elevation, tmp_path: Path) -> None:
    path = write(save_elevation(surface, name=f"a.{suffix}"), tmp_path)
    again = load_elevation(path=path)
    np.testing.assert_array_equal(again.data, surface.data)
    same_place(again.extent, surface.extent, surface.cell_size[0])
    for file in tmp_path.iterdir():
        file.unlink()


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(surface=elevations())
@pytest.mark.parametrize("suffix", CODED)
def test_16_bit_formats_come_back_within_half_a_step(suffix: str, surface: Elevation, tmp_path: Path) -> None:
    path = write(save_elevation(surface, name=f"a.{suffix}"), tmp_path)
    again = load_elevation(path=path)
    missing = np.isnan(surface.data)
    np.testing.assert_array_equal(np.isnan(again.data), missing)
    known = surface.data[~missing].astype(np.float64)
    half = (known.max() - known.min()) / 65534 / 2
    assert np.abs(again.data[~missing] - known).max() <= half * (1 + 1e-6) + 1e-3
    same_place(again.extent, surface.extent, surface.cell_size[0])
    for file in tmp_path.iterdir():
        file.unlink()


@pytest.mark.parametrize("suffix", EXACT + CODED)
def test_the_same_raster_gives_the_same_bytes(suffix: str) -> None:
    dem = sample_dem()
    first, second = (save_elevation(dem, name=f"a/b.{suffix}") for _ in range(2))
    assert seal(first) == seal(second)
    assert first.name == f"a/b.{suffix}"


def test_the_geotiff_says_what_it_is(tmp_path: Path) -> None:
    dem = sample_dem()
    path = write(save_elevation(dem, name="dem.tif"), tmp_path)
    with rasterio.open(path) as dataset:
        assert dataset.crs.to_epsg() == 4326
        assert np.isnan(dataset.nodata)
        assert dataset.dtypes == ("float32",)
        assert dataset.units == ("m",)
        assert dataset.xy(0, 0) == pytest.approx((dem.extent.west + 1 / 2400, dem.extent.north - 1 / 2400), abs=1e-9)
        assert dataset.profile["tiled"]


def test_the_sidecar_gives_the_height_range(tmp_path: Path) -> None:
    path = write(save_elevation(sample_dem(), name="h.png"), tmp_path)
    record = json.loads((tmp_path / "h.png.json").read_text())
    assert (record["minimum"], record["maximum"], record["void_code"]) == (236, 1076, None)
    assert record["extent"]["crs"] == "EPSG:4326"
    picture = Picture.open(path)
    assert picture.mode.startswith("I")
    assert picture.getextrema() == (0, 65535)


def test_a_stated_range_makes_tiles_alike(tmp_path: Path) -> None:
    dem = sample_dem()
    path = write(save_elevation(dem, name="h.r16", minimum=0.0, maximum=65535.0), tmp_path)
    np.testing.assert_array_equal(np.fromfile(path, "<u2").reshape(dem.shape), dem.data)
    with pytest.raises(ValueError, match="heights from 236 to 1076 do not fit the range 300 to 1076"):
        save_elevation(dem, name="h.r16", minimum=300.0)


def test_a_constant_raster_keeps_its_height(tmp_path: Path) -> None:
    flat = Elevation(np.full((3, 3), 1234.5, np.float32), Extent(0, 0, 3, 3))
    for suffix in CODED:
        path = write(save_elevation(flat, name=f"flat.{suffix}"), tmp_path)
        np.testing.assert_array_equal(load_elevation(path=path).data, flat.data)


def test_whole_numbers_first_do_not_make_an_ascii_grid_whole(tmp_path: Path) -> None:
    data = np.full((300, 300), 7, np.float32)
    data[-1, -1] = 7.25
    path = write(save_elevation(Elevation(data, Extent(0, 0, 300, 300)), name="a.asc"), tmp_path)
    np.testing.assert_array_equal(load_elevation(path=path).data, data)


def test_other_rasters_keep_their_unit(tmp_path: Path) -> None:
    steep = Slope(np.full((2, 2), 30, np.float32), Extent(0, 0, 2, 2))
    path = write(save_elevation(steep, name="s.h5"), tmp_path)
    with pytest.raises(ValueError, match=r"'s.h5' has values in 'deg', which is no length"):
        load_elevation(path=path)


def test_a_view_is_saved_as_it_looks(tmp_path: Path) -> None:
    dem = sample_dem()
    part = dem.window(slice(10, 50), slice(20, 80))
    part.data.flags.writeable = False
    for suffix in EXACT:
        path = write(save_elevation(part, name=f"p.{suffix}"), tmp_path)
        np.testing.assert_array_equal(load_elevation(path=path).data, part.data)


def test_bad_calls_are_refused() -> None:
    flat = Raster(np.zeros((2, 2), np.float32), Extent(0, 0, 2, 2))
    with pytest.raises(ValueError, match=r"ends in '.jpg'; choose one of .tif"):
        save_elevation(flat, name="a.jpg")
    with pytest.raises(ValueError, match=r"for .png and .r16 only"):
        save_elevation(flat, name="a.tif", minimum=0.0)
    with pytest.raises(ValueError, match="every cell is void"):
        save_elevation(flat.like(np.full((2, 2), np.nan, np.float32)), name="a.png")
    with pytest.raises(ValueError, match="infinite"):
        save_elevation(flat.like(np.full((2, 2), np.inf, np.float32)), name="a.png")
    lost = Raster(flat.data, Extent(0, 0, 2, 2, "", "deg"))
    for suffix in ("tif", "asc"):
        with pytest.raises(ValueError, match="in degrees without a coordinate system"):
            save_elevation(lost, name=f"a.{suffix}")
    with pytest.raises(ValueError, match=r"without '..'"):
        save_elevation(flat, name="../a.tif")
    with pytest.raises(ValueError, match=r"choose .png or .tif"):
        save_image(Image(np.zeros((2, 2, 3), np.uint8), flat.extent), name="a.gif")


IMAGE = Image(
    np.random.default_rng(1).integers(0, 256, (30, 40, 4), np.uint8), Extent(5000, 7000, 5400, 7300, "EPSG:32632")
)


@pytest.mark.parametrize("channels", [3, 4])
def test_a_png_keeps_every_pixel(channels: int) -> None:
    image = IMAGE.like(IMAGE.data[..., :channels])
    file = save_image(image, name="a.png")
    assert file.sidecars == ()
    picture = Picture.open(BytesIO(file.content.tobytes()))
    assert picture.info["srgb"] == 0
    np.testing.assert_array_equal(np.asarray(picture), image.data)
    assert seal(file) == seal(save_image(image, name="a.png"))


def test_a_world_file_places_a_png(tmp_path: Path) -> None:
    path = write(save_image(IMAGE, name="a.png", world_file=True), tmp_path)
    assert sorted(item.name for item in tmp_path.iterdir()) == ["a.pgw", "a.png", "a.prj"]
    with rasterio.open(path) as dataset:
        assert tuple(dataset.bounds) == (5000, 7000, 5400, 7300)


@pytest.mark.parametrize("channels", [3, 4])
def test_a_geotiff_image_keeps_pixels_and_place(channels: int, tmp_path: Path) -> None:
    image = IMAGE.like(IMAGE.data[..., :channels])
    file = save_image(image, name="a.tif")
    assert seal(file) == seal(save_image(image, name="a.tif"))
    with rasterio.open(write(file, tmp_path)) as dataset:
        np.testing.assert_array_equal(np.moveaxis(dataset.read(), 0, 2), image.data)
        assert dataset.crs.to_epsg() == 32632
        assert tuple(dataset.bounds) == (5000, 7000, 5400, 7300)
        names: list[Any] = [item.name for item in dataset.colorinterp]
        assert names == ["red", "green", "blue", "alpha"][:channels]
