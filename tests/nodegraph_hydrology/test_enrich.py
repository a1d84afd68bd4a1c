"""Features grow by MDI and MD: what is given stays, what is linear stays linear, rivers stay lowest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import maximum_filter, minimum_filter

from nodegraph_hydrology.enrich import enrich
from nodegraph_terrain.raster import Elevation, Extent, Mask


def on(data, cell=10.0):
    data = np.asarray(data, np.float32)
    return Elevation(data, Extent(0, 0, cell * data.shape[1], cell * data.shape[0]))


def scattered(rows, columns, share, seed):
    dice = np.random.default_rng(seed)
    data = np.where(dice.random((rows, columns)) < share, dice.uniform(0, 500, (rows, columns)), np.nan)
    data[rows // 2, columns // 2] = 100
    return on(data)


@given(st.integers(1, 40), st.integers(1, 40), st.floats(0, 0.4), st.integers(0, 999), st.integers(0, 6))
def test_given_features_stay_and_others_only_join(rows, columns, share, seed, rounds):
    features = scattered(rows, columns, share, seed)
    rivers = Mask((features.data < 250).astype(np.float32), features.extent)
    for mask in (None, rivers):
        done = enrich(features, mask, rounds=rounds, seed=seed, roughness=0.3)
        known = ~np.isnan(features.data)
        np.testing.assert_array_equal(done.data[known], features.data[known])
        fewer = enrich(features, mask, rounds=max(rounds - 1, 0), seed=seed, roughness=0.3)
        assert (~np.isnan(done.data) >= ~np.isnan(fewer.data)).all()
        np.testing.assert_array_equal(done.data, enrich(features, mask, rounds=rounds, seed=seed, roughness=0.3).data)


@given(st.integers(2, 40), st.integers(2, 40), st.integers(0, 999), st.integers(1, 5))
def test_without_roughness_values_lie_between_those_given(rows, columns, seed, rounds):
    features = scattered(rows, columns, 0.1, seed)
    done = enrich(features, rounds=rounds, roughness=0).data
    low, high = np.nanmin(features.data), np.nanmax(features.data)
    grown = done[~np.isnan(done)]
    assert grown.min() >= low - 1e-3
    assert grown.max() <= high + 1e-3


def test_one_round_is_the_paper_s_scheme():
    """By hand: a corner takes what is known at the midpoints and the centres of its squares."""
    data = np.full((7, 7), np.nan)
    data[3, 3] = 50.0
    done = enrich(on(data), rounds=1, roughness=0).data
    expected = np.full((7, 7), np.nan)
    expected[2:5, 2:5] = 50
    np.testing.assert_array_equal(done, expected)
    data[3, 4] = 80.0
    done = enrich(on(data), rounds=1, roughness=0).data
    near, far = 1.0, 1 / np.sqrt(2)
    assert done[2, 4] == pytest.approx((near * 80 + far * 50) / (near + far), rel=1e-6)
    assert done[2, 3] == pytest.approx((near * 50 + far * 80) / (near + far), rel=1e-6)
    assert done[2, 5] == 80
    assert np.isnan(done[:, 6]).all()


def test_a_square_is_filled_by_midpoints():
    data = np.full((9, 9), np.nan)
    data[::8, ::8] = [[0, 8], [16, 24]]
    done = enrich(on(data), rounds=4, roughness=0).data
    rows, columns = np.mgrid[:9, :9]
    known = ~np.isnan(done)
    # Corners alone have nothing within a square of 2 cells; what MD fills of a plane is the plane.
    inside = known & (rows > 1) & (rows < 7) & (columns > 1) & (columns < 7)
    assert inside.sum() >= 9
    assert abs(done[4, 4] - 12) < 1e-4


def test_limit_stops_the_rounds():
    features = scattered(64, 64, 0.01, 1)
    for rounds, limit in ((0, 14.0), (1, 15.0), (2, 30.0), (3, 57.0)):
        limited = enrich(features, rounds=9, limit=limit, seed=3)
        np.testing.assert_array_equal(limited.data, enrich(features, rounds=rounds, seed=3).data)


def test_rivers_stay_lowest_and_ridges_highest():
    data = np.full((40, 40), np.nan)
    data[10] = np.linspace(50, 90, 40)
    data[30] = np.linspace(150, 190, 40)
    features = on(data)
    rivers = np.zeros((40, 40), np.float32)
    rivers[10] = 1
    done = enrich(features, Mask(rivers, features.extent), rounds=2, roughness=0.5, seed=5).data
    beds = np.where(rivers > 0, data, -np.inf)
    beside = (maximum_filter(beds, 3) > -np.inf) & (rivers == 0) & ~np.isnan(done)
    assert beside.sum() > 40
    assert (done[beside] >= maximum_filter(beds, 3)[beside] - 1e-4).all()
    crest = np.where(np.arange(40)[:, None] == 30, data, np.inf)
    below = (minimum_filter(crest, 3) < np.inf) & (np.arange(40)[:, None] != 30) & ~np.isnan(done)
    # Downwards on average, of neighbours along the crest.
    assert np.mean(done[below] - maximum_filter(np.where(np.isinf(crest), -np.inf, crest), 3)[below]) < -1
    # Neither way where nothing is said of rivers: one seed's mean has a standard deviation of 1.1, that of 12 of 0.3.
    moved = [enrich(features, rounds=1, roughness=0.5, seed=seed).data[9][1:-1] - data[10][1:-1] for seed in range(12)]
    assert abs(np.mean(moved)) < 0.9
    assert 0.5 < np.std(np.mean(moved, axis=1)) < 2


def test_displacement_grows_with_roughness_and_distance():
    features = on(np.where(np.indices((129, 129)).sum(axis=0) % 2 == 0, 100.0, np.nan))
    for cell in (10.0, 30.0):
        spread = enrich(on(features.data, cell), rounds=1, roughness=0.1, seed=2).data[np.isnan(features.data)]
        assert spread.std() == pytest.approx(0.1 * cell, rel=0.05)
        assert spread.mean() == pytest.approx(100, abs=0.05 * cell)


@pytest.mark.parametrize(
    ("features", "rivers", "match"),
    [
        (on(np.full((4, 4), np.nan)), None, "all void"),
        (on([[1, np.inf]]), None, "infinite"),
        (Elevation(np.ones((2, 2)), Extent(0, 0, 1, 1, unit="deg")), None, "degrees"),
        (Elevation(np.ones((2, 2)), Extent(0, 0, 1, 2)), None, "square"),
        (on(np.ones((2, 2))), Mask(np.zeros((3, 3)), Extent(0, 0, 20, 20)), "shape"),
        (on(np.ones((2, 2))), Mask(np.full((2, 2), np.nan), Extent(0, 0, 20, 20)), "voids"),
    ],
)
def test_bad_input_is_refused(features, rivers, match):
    with pytest.raises(ValueError, match=match):
        enrich(features, rivers)
