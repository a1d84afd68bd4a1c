from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from PIL import Image as Picture
from rasterio.crs import CRS
from rasterio.merge import merge
from rasterio.transform import Affine

from nodegraph.errors import sentence
from nodegraph.parameters import ParameterErrors
from nodegraph_terrain.load import load_elevation
from nodegraph_terrain.raster import Elevation


def from_origin(west: float, north: float, dx: float, dy: float) -> Affine:
    return Affine(dx, 0, west, 0, -dy, north)


HEIGHTS = np.arange(30, dtype=np.int16).reshape(5, 6) * 10 - 40


def geotiff(path: Path, data: np.ndarray = HEIGHTS, *, units: str = "", scale: float = 1.0, **profile: Any) -> Path:
    bands = data if data.ndim == 3 else data[None]
    profile = {"transform": from_origin(500000, 5100000, 30, 30), "crs": "EPSG:32632"} | profile
    count, rows, cols = bands.shape
    with rasterio.open(
        path, "w", driver="GTiff", width=cols, height=rows, count=count, dtype=bands.dtype.name, **profile
    ) as dataset:
        dataset.write(bands)
        if units:
            dataset.units = (units,) * count
        if scale != 1.0:
            dataset.scales, dataset.offsets = (scale,) * count, (100.0,) * count
    return path


def hgt(folder: Path, name: str, value: int) -> Path:
    path = folder / name
    np.full((1201, 1201), value, ">i2").tofile(path)
    return path


def test_a_geotiff_keeps_heights_place_and_voids(tmp_path: Path) -> None:
    dem = load_elevation(path=geotiff(tmp_path / "a.tif", nodata=-40))
    assert isinstance(dem, Elevation)
    assert np.isnan(dem.data[0, 0])
    np.testing.assert_array_equal(dem.data.ravel()[1:], HEIGHTS.ravel()[1:])
    assert (dem.extent.west, dem.extent.south, dem.extent.east, dem.extent.north) == (500000, 5099850, 500180, 5100000)
    assert (dem.extent.crs, dem.extent.unit) == ("EPSG:32632", "m")


def test_bands_scales_and_a_stated_void(tmp_path: Path) -> None:
    two = geotiff(tmp_path / "two.tif", np.stack([HEIGHTS, HEIGHTS * 2]))
    np.testing.assert_array_equal(load_elevation(path=two, band=2).data, HEIGHTS * 2)
    scaled = geotiff(tmp_path / "scaled.tif", scale=0.5)
    np.testing.assert_allclose(load_elevation(path=scaled).data, HEIGHTS * 0.5 + 100)
    void = load_elevation(path=two, nodata=-30)
    assert np.isnan(void.data[0, 1])
    assert np.isnan(void.data).sum() == 1


@pytest.mark.parametrize(
    ("unit", "factor"), [("ft", 0.3048), ("US survey foot", 1200 / 3937), ("metre", 1.0), ("cm", 0.01)]
)
def test_feet_become_metres(unit: str, factor: float, tmp_path: Path) -> None:
    dem = load_elevation(path=geotiff(tmp_path / "a.tif", units=unit))
    np.testing.assert_allclose(dem.data, HEIGHTS * factor, rtol=1e-6)
    stated = load_elevation(path=geotiff(tmp_path / "b.tif"), vertical_unit="ft")
    np.testing.assert_allclose(stated.data, HEIGHTS * 0.3048, rtol=1e-6)


def test_a_system_in_feet_becomes_metres_in_both_directions(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "ny.tif", crs="EPSG:2263+6360", transform=from_origin(984250, 200000, 100, 100))
    dem = load_elevation(path=path)
    foot = 1200 / 3937
    np.testing.assert_allclose(dem.data, HEIGHTS * foot, rtol=1e-6)
    assert dem.cell_size == pytest.approx((100 * foot, 100 * foot))
    assert dem.extent.unit == "m"
    crs = CRS.from_user_input(dem.extent.crs)
    assert crs.linear_units_factor[1] == 1.0
    assert dem.extent.west == pytest.approx(300000.0)  # the false easting: the central meridian


def test_rows_from_the_south_are_turned_over(tmp_path: Path) -> None:
    south_up = Affine(30, 0, 500000, 0, 30, 5099850)
    dem = load_elevation(path=geotiff(tmp_path / "a.tif", transform=south_up))
    np.testing.assert_array_equal(dem.data, HEIGHTS[::-1])
    assert dem.extent.north == 5100000


def test_a_raster_without_a_system_is_in_plain_metres(tmp_path: Path) -> None:
    dem = load_elevation(path=geotiff(tmp_path / "a.tif", crs=None))
    assert (dem.extent.crs, dem.extent.unit, dem.extent.west) == ("", "m", 500000)
    stated = load_elevation(path=tmp_path / "a.tif", crs="EPSG:32633")
    assert stated.extent.crs == "EPSG:32633"
    moved = load_elevation(path=tmp_path / "a.tif", extent=(8.0, 46.0, 8.006, 46.005), crs="EPSG:4326")
    assert (moved.extent.unit, moved.extent.west) == ("deg", 8.0)


def test_ascii_grids_with_and_without_prj(tmp_path: Path) -> None:
    path = tmp_path / "a.asc"
    path.write_text(
        "ncols 3\nnrows 2\nxllcorner 8\nyllcorner 46\ncellsize 0.01\nNODATA_value -9999\n1 2 3\n4 -9999 6\n"
    )
    with pytest.raises(ValueError, match=r"'a.asc' seems to be in degrees"):
        load_elevation(path=path)
    path.with_suffix(".prj").write_text(CRS.from_epsg(4326).to_wkt(version="WKT1_ESRI"))
    dem = load_elevation(path=path)
    np.testing.assert_array_equal(dem.data, [[1, 2, 3], [4, np.nan, 6]])
    assert (dem.extent.crs, dem.extent.unit) == ("EPSG:4326", "deg")


def test_the_name_of_an_hgt_tile_places_it(tmp_path: Path) -> None:
    dem = load_elevation(path=hgt(tmp_path, "S33W071.hgt", 1234))
    assert dem.extent.west == pytest.approx(-71 - 1 / 2400)
    assert dem.extent.north == pytest.approx(-32 + 1 / 2400)
    assert dem.data.min() == 1234
    with pytest.raises(ValueError, match=r"its name must give its south-west corner, such as N27E086"):
        load_elevation(path=hgt(tmp_path, "mountain.hgt", 1))


# Tiles.


def test_tiles_make_one_raster(tmp_path: Path) -> None:
    whole = np.arange(48, dtype=np.float32).reshape(6, 8)
    paths = []
    for row, col in ((0, 0), (0, 4), (3, 4)):
        place = from_origin(1000 + 30 * col, 9000 - 30 * row, 30, 30)
        paths.append(geotiff(tmp_path / f"{row}{col}.tif", whole[row : row + 3, col : col + 4], transform=place))
    dem = load_elevation(path=tuple(paths))
    expected = whole.copy()
    expected[3:, :4] = np.nan
    np.testing.assert_array_equal(dem.data, expected)
    assert (dem.extent.west, dem.extent.south, dem.extent.east, dem.extent.north) == (1000, 8820, 1240, 9000)


def test_earlier_tiles_go_first_and_later_ones_fill_their_voids(tmp_path: Path) -> None:
    first = geotiff(tmp_path / "1.tif", np.array([[1, -1]], np.int16), nodata=-1)
    second = geotiff(tmp_path / "2.tif", np.array([[7, 8]], np.int16))
    np.testing.assert_array_equal(load_elevation(path=(first, second)).data, [[1, 8]])


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ({"crs": "EPSG:32633"}, "different coordinate reference systems"),
        ({"transform": from_origin(500180, 5100000, 31, 31)}, "different cell sizes"),
        ({"transform": from_origin(500190, 5100000, 30, 30)}, "shifted by part of a cell"),
    ],
)
def test_tiles_that_do_not_fit_are_refused(other: dict[str, Any], expected: str, tmp_path: Path) -> None:
    paths = geotiff(tmp_path / "a.tif"), geotiff(tmp_path / "b.tif", **other)
    with pytest.raises(ValueError, match=f"'a.tif' and 'b.tif' .*{expected}"):
        load_elevation(path=paths)


# Codes, raw numbers and arrays.


def test_a_16_bit_png_needs_its_height_range(tmp_path: Path) -> None:
    codes = np.array([[0, 65535], [32768, 1]], np.uint16)
    path = tmp_path / "h.png"
    Picture.fromarray(codes).save(path)
    with pytest.raises(ValueError, match=r"'h.png' does not say its heights; state minimum and maximum"):
        load_elevation(path=path, cell_size=10.0)
    with pytest.raises(ValueError, match="give both"):
        load_elevation(path=path, cell_size=10.0, minimum=0.0)
    with pytest.raises(ValueError, match="has no georeference; state cell_size"):
        load_elevation(path=path, minimum=0.0, maximum=1.0)
    dem = load_elevation(path=path, cell_size=10.0, minimum=-100.0, maximum=900.0)
    np.testing.assert_allclose(dem.data, -100 + codes * (1000 / 65535), atol=1e-3)
    assert dem.cell_size == (10.0, 10.0)


def test_whole_numbers_of_other_formats_are_metres(tmp_path: Path) -> None:
    codes = np.array([[0, 4000]], np.uint16)
    path = geotiff(tmp_path / "a.tif", codes)
    np.testing.assert_array_equal(load_elevation(path=path).data, codes)
    np.testing.assert_array_equal(load_elevation(path=path, minimum=0.0, maximum=6553.5).data, [[0, 400]])


@pytest.mark.parametrize(("order", "sign"), [("little", "<"), ("big", ">")])
def test_raw_files(order: Any, sign: str, tmp_path: Path) -> None:
    (tmp_path / "a.r16").write_bytes(struct.pack(f"{sign}6H", 0, 1, 2, 3, 4, 65535))
    shape: dict[str, Any] = {"rows": 2, "columns": 3, "byte_order": order, "cell_size": 5.0}
    dem = load_elevation(path=tmp_path / "a.r16", minimum=0.0, maximum=65535.0, **shape)
    np.testing.assert_array_equal(dem.data, [[0, 1, 2], [3, 4, 65535]])
    (tmp_path / "a.r32").write_bytes(struct.pack(f"{sign}6f", 0, 1.5, 2, float("nan"), float("inf"), -9))
    dem = load_elevation(path=tmp_path / "a.r32", **shape)
    np.testing.assert_array_equal(dem.data, [[0, 1.5, 2], [np.nan, np.nan, -9]])
    assert (dem.extent.west, dem.extent.north) == (0, 10)


def test_arrays_of_any_real_type(tmp_path: Path) -> None:
    for dtype in ("i2", ">i4", "f8", "u1", "f2"):
        np.save(tmp_path / "a.npy", HEIGHTS.clip(0, 200).astype(dtype, order="F"))
        dem = load_elevation(path=tmp_path / "a.npy", cell_size=2.0)
        np.testing.assert_array_equal(dem.data, HEIGHTS.clip(0, 200))
    np.save(tmp_path / "a.npy", np.array([[1e300, 5.0]]))
    np.testing.assert_array_equal(load_elevation(path=tmp_path / "a.npy", cell_size=2.0).data, [[np.nan, 5]])


# Bad input: one sentence each.


def refused(path: object, **params: Any) -> str:
    with pytest.raises((ValueError, OSError)) as caught:
        load_elevation(path=path, **params)  # type: ignore[arg-type]
    message = sentence(caught.value)
    assert "\n" not in message
    assert "rasterio" not in message.lower()
    return message


def test_what_is_no_raster_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    missing = tmp_path / "none.tif"
    assert refused(missing) == f"No such file or directory: {missing}"
    assert "is a folder" in refused(tmp_path)
    assert "empty list" in refused(())
    for name in ("a.tif", "a.npy", "a.r16", "a.png", "a.hgt", "a.asc", "a.h5"):
        empty = tmp_path / name
        empty.write_bytes(b"")
        assert refused(empty) == f"'{name}' is empty; expected a raster of heights"
        empty.write_bytes(b"this is a letter to a friend")
        assert refused(empty)
    (tmp_path / "text.tif").write_text("hello\n")
    assert refused(tmp_path / "text.tif").startswith("'text.tif' is no raster that can be read; expected GeoTIFF")
    (tmp_path / "x.vrt").write_text('<VRTDataset rasterXSize="1" rasterYSize="1"></VRTDataset>')
    assert "only describes data kept in other files" in refused(tmp_path / "x.vrt")
    assert capfd.readouterr().err == ""


def test_files_that_are_cut_short_are_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(500, 100, (300, 300)).astype(np.float32)
    geotiff(tmp_path / "a.tif", noise, compress="deflate", tiled=True, blockxsize=128, blockysize=128)
    np.save(tmp_path / "a.npy", noise)
    Picture.fromarray(rng.integers(0, 65536, (300, 300)).astype(np.uint16)).save(tmp_path / "a.png")
    header = "ncols 300\nnrows 300\nxllcorner 0\nyllcorner 0\ncellsize 30\n"
    (tmp_path / "a.asc").write_text(header + "\n".join(" ".join(f"{v:.3f}" for v in row) for row in noise))
    noise.tofile(tmp_path / "a.r32")
    hgt(tmp_path, "N10E010.hgt", 5)
    params = {"a.png": {"minimum": 0.0, "maximum": 1.0, "cell_size": 1.0}, "a.npy": {"cell_size": 1.0}}
    params["a.r32"] = {"rows": 300, "columns": 300, "cell_size": 1.0}
    for path in sorted(tmp_path.iterdir()):
        more = params.get(path.name, {})
        assert load_elevation(path=path, **more).data.size  # type: ignore[arg-type]
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
        assert path.name in refused(path, **more)
    assert capfd.readouterr().err == ""


def test_rasters_without_usable_heights_are_refused(tmp_path: Path) -> None:
    rotated = geotiff(tmp_path / "r.tif", transform=from_origin(0, 0, 30, 30) @ Affine.rotation(20))
    assert refused(rotated).startswith("'r.tif' is rotated or skewed against its grid; make it north-up first")
    void = geotiff(tmp_path / "v.tif", np.full((3, 3), -1, np.int16), nodata=-1)
    assert refused(void) == "'v.tif' holds no heights: every cell is void"
    colours = geotiff(tmp_path / "c.tif", np.zeros((3, 4, 4), np.uint8))
    assert "is a colour picture" in refused(colours)
    assert refused(geotiff(tmp_path / "a.tif"), band=3) == "'a.tif' has 1 band; band 3 is not one of them"
    assert "minimum and maximum apply to unsigned integers only" in refused(
        tmp_path / "a.tif", minimum=0.0, maximum=1.0
    )
    kelvin = geotiff(tmp_path / "k.tif", units="K")
    assert refused(kelvin) == "'k.tif' has values in 'K', which is no length; state vertical_unit to read heights"
    assert load_elevation(path=kelvin, vertical_unit="m").data.max() == 250
    assert "'EPSG:1' is not known" in refused(tmp_path / "a.tif", crs="EPSG:1")
    np.save(tmp_path / "c.npy", np.zeros((2, 2), complex))
    assert "expected a two-dimensional array of real numbers" in refused(tmp_path / "c.npy")
    np.save(tmp_path / "o.npy", np.array([[None]], object), allow_pickle=True)
    assert "is no complete .npy file" in refused(tmp_path / "o.npy")
    np.save(tmp_path / "d.npy", np.zeros((2, 2, 2)))
    assert "shape (2, 2, 2)" in refused(tmp_path / "d.npy")


def test_raw_files_of_another_shape_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.r16"
    np.zeros(64, np.uint16).tofile(path)
    assert refused(path) == "'a.r16' does not say its shape; state rows and columns (its size fits 8 x 8)"
    message = refused(path, rows=9, columns=8)
    assert message == "'a.r16' has 128 bytes, but 9 x 8 cells of 2 bytes are 144; state the right rows and columns"
    assert "holds 16-bit codes; state minimum and maximum" in refused(path, rows=8, columns=8)
    assert "has no georeference" in refused(path, rows=8, columns=8, minimum=0.0, maximum=1.0)
    assert "by cell_size in degrees" in refused(
        path, rows=8, columns=8, minimum=0.0, maximum=1.0, cell_size=1.0, crs="EPSG:4326"
    )


def test_a_damaged_sidecar_is_refused_and_a_strangers_ignored(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", HEIGHTS)
    sidecar = tmp_path / "a.npy.json"
    sidecar.write_text('{"author": "someone"}')
    assert load_elevation(path=tmp_path / "a.npy", cell_size=1.0).shape == (5, 6)
    sidecar.write_text("{")
    assert "'a.npy.json' is not valid JSON" in refused(tmp_path / "a.npy")
    sidecar.write_text(json.dumps({"format": "nodegraph-heights/9"}))
    assert "has format 'nodegraph-heights/9', expected 'nodegraph-heights/1'" in refused(tmp_path / "a.npy")
    sidecar.write_text(json.dumps({"format": "nodegraph-heights/1", "rows": 5}))
    assert "'a.npy.json' is damaged" in refused(tmp_path / "a.npy")
    edges = {"west": 0, "south": 0, "east": 9, "north": 9, "crs": "", "unit": "m"}
    sidecar.write_text(
        json.dumps({"format": "nodegraph-heights/1", "rows": 9, "columns": 9, "dtype": "float32", "extent": edges})
    )
    assert "has 5 x 6 cells, but its sidecar 'a.npy.json' says 9 x 9" in refused(tmp_path / "a.npy")


def test_parameters_are_checked() -> None:
    with pytest.raises(ParameterErrors) as caught:
        load_elevation.parameters.check({"band": 0, "cell_size": 0, "byte_order": "middle"})
    assert {name for name, _ in caught.value.items} == {"path", "band", "cell_size", "byte_order"}
    one = load_elevation.parameters.check({"path": "a.tif"}).values["path"]
    many = load_elevation.parameters.check({"path": ["a.hgt", "b.hgt"]}).values["path"]
    assert one == Path("a.tif")
    assert many == (Path("a.hgt"), Path("b.hgt"))
    assert load_elevation.parameters.fields["path"].input_file is not None


# Forecasts read the header only.


def forecast(path: object, **params: Any) -> Any:
    given = {"path": [str(item) for item in path] if isinstance(path, tuple) else str(path)} | params
    return load_elevation.predict({}, load_elevation.parameters.check(given).values)


def test_the_forecast_comes_from_the_header(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif")
    dem, predicted = load_elevation(path=path), forecast(path)
    assert predicted.bytes == dem.data.nbytes
    assert (predicted.about.rows, predicted.about.cols, predicted.about.cell_size) == (5, 6, (30, 30))
    assert predicted.about.extent.crs == "EPSG:32632"
    assert forecast(tmp_path / "none.tif").bytes == 0


def test_a_raster_larger_than_memory_is_foreseen(tmp_path: Path) -> None:
    # A sparse file: 200,000 x 200,000 heights in a few megabytes.
    place = from_origin(0, 2e6, 10, 10)
    with rasterio.open(
        tmp_path / "huge.tif", "w", driver="GTiff", width=200000, height=200000, count=1, dtype="int16", tiled=True,
        blockxsize=4096, blockysize=4096, SPARSE_OK=True, BIGTIFF="YES", transform=place, crs="EPSG:32632",
    ):  # fmt: skip
        pass
    assert forecast(tmp_path / "huge.tif").bytes == 160_000_000_000
    with pytest.raises(ValueError, match="200,000 x 200,000 cells, over the limit"):
        load_elevation(path=tmp_path / "huge.tif")


# Measured terrain.


def test_usgs_dem(real_data: Path) -> None:
    dem = load_elevation(path=real_data / "sainte_helens" / "SainteHelens.dem")
    assert (dem.shape, dem.extent.crs, dem.cell_size) == ((468, 327), "EPSG:26710", (30.0, 30.0))
    assert np.isnan(dem.data).sum() == 4151
    assert np.nanmax(dem.data) == pytest.approx(2543)


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")  # rasterio.merge against affine 3
def test_four_tiles_of_everest_are_what_rasterio_merges(real_data: Path) -> None:
    paths = tuple(sorted((real_data / "everest").glob("*.hgt")))
    dem = load_elevation(path=paths)
    datasets = [rasterio.open(path) for path in paths]
    merged, transform = merge(datasets)
    for dataset in datasets:
        dataset.close()
    expected = np.where(merged[0] == -32768, np.nan, merged[0].astype(np.float32))
    np.testing.assert_array_equal(dem.data, expected)
    assert (dem.extent.west, dem.extent.north) == pytest.approx((transform.c, transform.f))
    predicted = forecast(paths)
    assert (predicted.bytes, predicted.about.rows, predicted.about.cols) == (dem.data.nbytes, 2401, 2401)
