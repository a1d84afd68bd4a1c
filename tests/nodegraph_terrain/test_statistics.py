from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph import codec
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.statistics import Histogram, statistics


def raster(data: Any) -> Elevation:
    data = np.atleast_2d(np.asarray(data, np.float32))
    return Elevation(data, Extent(0, 0, data.shape[1], data.shape[0]))


@given(
    values=st.lists(st.floats(-1e4, 1e4, width=32) | st.just(float("nan")), min_size=1, max_size=60),
    bins=st.integers(1, 40),
)
def test_agrees_with_numpy(values: list[float], bins: int) -> None:
    data = np.array(values, np.float32)
    known = data[~np.isnan(data)].astype(np.float64)
    if len(known) == 0:
        with pytest.raises(ValueError, match="every cell of the raster is void"):
            statistics(raster(data), bins=bins)
        return
    found = statistics(raster(data), bins=bins)
    assert (found.minimum, found.maximum) == (known.min(), known.max())
    assert found.mean == pytest.approx(known.mean(), rel=1e-9, abs=1e-9)
    assert found.standard_deviation == pytest.approx(known.std(), rel=1e-6, abs=1e-6)
    assert found.void_count == len(data) - len(known)
    assert found.void_fraction == pytest.approx(1 - len(known) / len(data))
    counts, edges = np.histogram(known, bins)
    assert found.histogram.counts.sum() == len(known)
    assert np.array_equal(found.histogram.counts, counts)
    np.testing.assert_allclose(found.histogram.edges, edges, rtol=1e-12, atol=1e-300)


def test_high_above_zero_no_digits_are_lost_and_blocks_join() -> None:
    rng = np.random.default_rng(0)
    data = (8000 + rng.normal(0, 0.25, (1500, 700))).astype(np.float32)
    data[rng.random(data.shape) < 0.1] = np.nan
    found = statistics(raster(data))
    known = data[~np.isnan(data)].astype(np.float64)
    assert found.mean == pytest.approx(known.mean(), rel=1e-12)
    assert found.standard_deviation == pytest.approx(known.std(), rel=1e-9)
    assert found.histogram.counts.sum() == known.size
    assert found.histogram.unit == "m"


def test_one_value() -> None:
    found = statistics(raster(np.full((3, 3), 7.0)), bins=2)
    assert found[:4] == (7.0, 7.0, 7.0, 0.0)
    assert found.histogram.edges.tolist() == [6.5, 7.0, 7.5]
    assert found.histogram.counts.tolist() == [0, 9]


def test_infinities_are_refused() -> None:
    with pytest.raises(ValueError, match="clamp it first"):
        statistics(raster([1, np.inf]))


def test_histograms_travel_and_hold_together() -> None:
    histogram = statistics(raster([1, 2, 3])).histogram
    digest = codec.seal(histogram)
    assert codec.seal(codec.decode(codec.encode(histogram))) == digest
    with pytest.raises(ValueError, match="one edge more"):
        Histogram(np.zeros(3), np.zeros(3, np.int64))
