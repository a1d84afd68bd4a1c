from __future__ import annotations

import numpy as np
import pytest

from nodegraph_terrain.forecasts import Outline
from nodegraph_terrain.sample_dem import sample_dem


def test_it_is_the_jacksboro_tile_with_row_0_north() -> None:
    dem = sample_dem()
    assert dem.shape == (344, 403)
    assert dem.data.dtype == np.float32
    assert (dem.data[0, 0], dem.data[-1, -1]) == (483, 272)
    assert (dem.data.min(), dem.data.max()) == (236, 1076)
    assert dem.extent.crs == "EPSG:4326"
    assert dem.extent.unit == "deg"
    assert dem.cell_size == pytest.approx((1 / 1200, 1 / 1200), rel=1e-6)
    assert dem.extent.north == pytest.approx(36.73291667, abs=1e-7)
    # The high ridge (Cross Mountain, 36.26 N 84.21 W) lies in the south-west; the valley floor in the south-east.
    rows, cols = dem.shape
    assert dem.data[rows // 2 :, : cols // 2].mean() > dem.data[rows // 2 :, cols // 2 :].mean() + 150


def test_the_forecast_tells_shape_and_extent() -> None:
    dem, predicted = sample_dem(), sample_dem.predict({}, {})
    assert predicted.bytes == dem.data.nbytes
    assert isinstance(predicted.about, Outline)
    assert (predicted.about.rows, predicted.about.cols) == dem.shape
    assert predicted.about.extent.east == pytest.approx(dem.extent.east, abs=1e-9)
    assert predicted.about.extent.north == pytest.approx(dem.extent.north, abs=1e-9)
