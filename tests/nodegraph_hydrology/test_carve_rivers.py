"""Carved rivers lie in their beds, and the ground beside them falls towards them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph_hydrology.carve_rivers import carve_rivers
from nodegraph_hydrology.drainage import basins
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.rasterize_features import rasterize_features
from nodegraph_terrain.raster import Elevation, Extent

EXTENT = Extent(0.0, 0.0, 400.0, 300.0, "EPSG:32632")
RIVER = RiverNetwork(
    np.array([[200.0, 0.0], [200.0, 120.0], [90.0, 250.0], [320.0, 260.0]]),
    np.array([-1, 0, 1, 1], np.int32),
    np.array([10.0, 20.0, 60.0, 70.0]),
    "EPSG:32632",
)


def ground(seed=0, rough=80.0):
    return Elevation((rough * np.random.default_rng(seed).random((30, 40))).astype(np.float32), EXTENT)


def nearest_beds(surface, i, j):
    """Return the distance to the nearest bed, m, and the heights of all beds that are as near."""
    beds = rasterize_features(RIVER, like=surface).features.data
    wet = np.argwhere(~np.isnan(beds))
    away = np.hypot(*(wet - [i, j]).T) * 10
    return away.min(), beds[tuple(wet[away <= away.min() * (1 + 1e-9)].T)]


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 99),
    st.tuples(st.integers(0, 29), st.integers(0, 39)),
    st.floats(0, 0.3),
    st.one_of(st.none(), st.floats(0.31, 3)),
    st.one_of(st.none(), st.floats(5, 200)),
)
def test_agrees_with_a_plain_search(seed, cell, flattest, steepest, reach):
    surface = ground(seed)
    made = carve_rivers(surface, RIVER, flattest=flattest, steepest=steepest, reach=reach)
    assert made.extent == EXTENT
    before, after = float(surface.data[cell]), float(made.data[cell])
    away, beds = nearest_beds(surface, *cell)
    if away == 0:
        assert after == beds[0]
    elif reach is not None and away >= reach:
        assert after == before
    else:
        top = np.inf if steepest is None else steepest
        # Where several beds are equally near, any may count.
        wanted = [min(max(before, bed + flattest * away), bed + top * away) for bed in beds.tolist()]
        share = 1 if reach is None else (1 - (away / reach) ** 2) ** 2
        assert min(abs(after - before - share * (value - before)) for value in wanted) < 1e-3


def test_water_finds_the_river_under_rough_ground():
    rows = np.arange(30)[::-1, None] * 2.0
    surface = Elevation((ground(3, 15).data + rows + 40).astype(np.float32), EXTENT)
    beds = ~np.isnan(rasterize_features(RIVER, like=surface).features.data)

    def arriving(terrain):
        """Share of the beds whose water leaves at the river's mouth."""
        basin = basins(terrain).data
        return (basin[beds] == basin[29, 20]).mean()

    assert arriving(carve_rivers(surface, RIVER)) == 1
    assert arriving(surface) < 0.5


def test_carving_twice_is_carving_once():
    once = carve_rivers(ground(), RIVER)
    np.testing.assert_array_equal(carve_rivers(once, RIVER).data, once.data)


def test_voids_stay_void():
    surface = ground()
    data = surface.data.copy()
    data[5:9, 18:23] = np.nan
    made = carve_rivers(Elevation(data, EXTENT), RIVER)
    np.testing.assert_array_equal(np.isnan(made.data), np.isnan(data))


@pytest.mark.parametrize(
    ("network", "params", "match"),
    [
        (RiverNetwork(RIVER.position, RIVER.downstream, np.full(4, np.nan)), {}, "river_heights"),
        (RIVER, {"steepest": 0.02}, "greater than flattest"),
        (RiverNetwork(RIVER.position + 9000, RIVER.downstream, RIVER.elevation), {}, "within the grid"),
        (RiverNetwork(RIVER.position, RIVER.downstream, RIVER.elevation, "EPSG:32633"), {}, "coordinate system"),
    ],
)
def test_bad_input_is_refused(network, params, match):
    with pytest.raises(ValueError, match=match):
        carve_rivers(ground(), network, **params)
