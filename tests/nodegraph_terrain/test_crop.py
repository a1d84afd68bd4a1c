from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph_terrain.crop import crop
from nodegraph_terrain.forecasts import Outline
from nodegraph_terrain.load import load_elevation
from nodegraph_terrain.raster import Elevation, Extent, Image, Labels, require_same_grid

DEM = Elevation(np.arange(600, dtype=np.float32).reshape(20, 30), Extent(1000, 5000, 1300, 5200, "EPSG:32632"))


def test_a_window_counts_from_the_north_west_corner() -> None:
    part = crop(DEM, rows=(2, -3), columns=(5, 10))
    np.testing.assert_array_equal(part.data, DEM.data[2:-3, 5:10])
    assert part.extent == pytest_extent(1050, 5030, 1100, 5180)
    assert isinstance(part, Elevation)


def pytest_extent(west: float, south: float, east: float, north: float) -> object:
    """Return something equal to an extent with these edges (extents compare by identity)."""

    class Same:
        def __eq__(self, other: object) -> bool:
            assert isinstance(other, Extent)
            return (other.west, other.south, other.east, other.north) == pytest.approx((west, south, east, north))

    return Same()


def test_an_extent_keeps_the_cells_whose_centres_it_holds() -> None:
    part = crop(DEM, extent=(1014.0, 5006.0, 1096.0, 5194.9))
    assert part.extent == pytest_extent(1010, 5010, 1100, 5190)
    np.testing.assert_array_equal(part.data, DEM.data[1:19, 1:10])


def test_what_lies_beyond_the_raster_is_ignored() -> None:
    assert crop(DEM, extent=(0, 0, 9999, 9999)).shape == DEM.shape


def test_like_takes_the_extent_of_another_grid() -> None:
    other = Labels(np.zeros((4, 3), np.int32), Extent(1100, 5100, 1130, 5140, "EPSG:32632"))
    part = crop(DEM, other)
    require_same_grid(part, Elevation(np.zeros((4, 3), np.float32), other.extent))


def test_images_and_labels_too() -> None:
    image = Image(np.zeros((20, 30, 3), np.uint8), DEM.extent)
    assert crop(image, rows=(0, 5)).data.shape == (5, 30, 3)
    assert type(crop(Labels(np.zeros((20, 30), np.int32), DEM.extent), columns=(1, 2))) is Labels


@given(st.integers(0, 19), st.integers(1, 20), st.integers(0, 29), st.integers(1, 30))
def test_window_and_extent_agree(top: int, bottom: int, left: int, right: int) -> None:
    if top >= bottom or left >= right:
        with pytest.raises(ValueError, match="nothing is left"):
            crop(DEM, rows=(top, bottom), columns=(left, right))
        return
    window = crop(DEM, rows=(top, bottom), columns=(left, right))
    edges = window.extent
    again = crop(DEM, extent=(edges.west, edges.south, edges.east, edges.north))
    np.testing.assert_array_equal(window.data, again.data)
    require_same_grid(window, again)


def test_bad_calls_are_refused() -> None:
    with pytest.raises(ValueError, match="give one of"):
        crop(DEM)
    with pytest.raises(ValueError, match="give one of"):
        crop(DEM, rows=(0, 1), extent=(0, 0, 1, 1))
    with pytest.raises(ValueError, match="nothing is left"):
        crop(DEM, extent=(0, 0, 1, 1))
    with pytest.raises(ValueError, match="east > west"):
        crop(DEM, extent=(10, 0, 1, 1))
    with pytest.raises(ValueError, match="another coordinate system"):
        crop(DEM, Labels(np.zeros((4, 3), np.int32), Extent(1100, 5100, 1130, 5140, "EPSG:32633")))


def test_the_forecast_is_right() -> None:
    about = Outline(*DEM.shape, DEM.extent).forecast()
    params = crop.parameters.check({"rows": [2, -3], "columns": [5, 10]}).values
    predicted = crop.predict({"surface": [about]}, params)
    assert (predicted.bytes, predicted.about.rows, predicted.about.cols) == (15 * 5 * 4, 15, 5)
    assert predicted.about.cell_size == pytest.approx((10, 10))


def test_the_void_border_of_a_real_dem_comes_off(real_data: Path) -> None:
    dem = load_elevation(path=real_data / "sainte_helens" / "SainteHelens.dem")
    assert np.isnan(dem.data).any()
    part = crop(dem, rows=(4, -4), columns=(5, -5))
    assert not np.isnan(part.data).any()
    assert part.cell_size == (30.0, 30.0)
