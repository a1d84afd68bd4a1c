"""River heights fall strictly downstream, straight or by the slope-area law."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay, QhullError

from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.river_heights import river_heights
from nodegraph_hydrology.topology import distance_to_outlet, reach_lengths


def network(position, down):
    return RiverNetwork(np.array(position, np.float64), np.array(down, np.int32), np.full(len(down), np.nan))


@st.composite
def networks(draw):
    count = draw(st.integers(2, 50))
    down = [-1, 0] + [draw(st.integers(-1, i - 1)) for i in range(2, count)]
    dice = np.random.default_rng(draw(st.integers(0, 999)))
    # Whole numbers: some nodes lie on one spot.
    position = dice.integers(0, draw(st.integers(2, 1000)), (count, 2)).astype(np.float64)
    position[1] = position[0] + 7
    return network(position, down)


@given(networks(), st.sampled_from(["proportional", "concave"]), st.floats(0, 1.5), st.floats(1, 9000))
def test_strictly_downhill_and_as_high_as_asked(rivers, mode, concavity, relief):
    done = river_heights(rivers, mode=mode, concavity=concavity, relief=relief, outlet_elevation=100)
    flows = rivers.downstream >= 0
    assert (done.elevation[flows] > done.elevation[rivers.downstream[flows]]).all()
    assert (done.elevation[~flows] == 100).all()
    assert done.elevation.max() == pytest.approx(100 + relief)


@settings(max_examples=40, deadline=None)
@given(networks(), st.sampled_from(["proportional", "concave"]), st.floats(1e-3, 2), st.floats(0.01, 1))
def test_no_river_towers_over_one_beside_it(rivers, mode, steepest, least):
    free = river_heights(rivers, mode=mode, relief=500)
    done = river_heights(rivers, mode=mode, relief=500, steepest=steepest, least_fall=least)
    down, flows = rivers.downstream, rivers.downstream >= 0
    assert (done.elevation <= free.elevation + 1e-9).all()
    fall, was = (z.elevation[flows] - z.elevation[down[flows]] for z in (done, free))
    assert (fall >= least * was - 1e-9).all()
    assert (fall > 0).all()
    np.testing.assert_allclose(done.elevation, plainly_lowered(rivers, free.elevation, steepest, least), atol=1e-6)


def plainly_lowered(rivers, heights, steepest, least):
    """Lower nodes one by one until every bound is kept (Bellman and Ford); where both cannot be, the fall is."""
    one, two = delaunay_edges(rivers.position)
    gap = steepest * np.hypot(*(rivers.position[one] - rivers.position[two]).T)
    gap = np.maximum(gap, least * (heights[two] - heights[one]))
    upper = np.flatnonzero(rivers.downstream >= 0)
    lower = rivers.downstream[upper]
    made = heights.copy()
    for _ in range(len(made) + 1):
        np.minimum.at(made, two, made[one] + gap)
        np.minimum.at(made, lower, made[upper] - least * (heights[upper] - heights[lower]))
    return made


def delaunay_edges(position):
    try:
        corners = Delaunay(position - position.mean(axis=0)).simplices
    except QhullError:
        return np.zeros((2, 0), np.int64)
    pairs = np.concatenate([corners[:, [i, j]] for i in range(3) for j in range(3) if i != j])
    return np.unique(pairs, axis=0).T


def test_a_slope_that_is_kept_changes_nothing():
    rivers = network([[0, 0], [300, 0], [300, 900], [900, 50]], [-1, 0, 1, 1])
    free = river_heights(rivers, relief=10)
    np.testing.assert_allclose(river_heights(rivers, relief=10, steepest=1).elevation, free.elevation)


def test_the_source_of_a_long_river_comes_down_to_one_beside_it():
    # A river that winds up to a stone's throw from the mouth of another.
    winding = [[0, 0], [0, 4000], [3000, 4000], [3000, 100]]
    rivers = network([*winding, [3050, 0], [3060, 60]], [-1, 0, 1, 2, -1, 4])
    free = river_heights(rivers, relief=1000)
    done = river_heights(rivers, relief=1000, steepest=0.2)
    assert free.elevation[3] == 1000
    # A tenth of its own fall it keeps.
    assert done.elevation[3] >= 100
    assert done.elevation[3] < 0.2 * free.elevation[3]


@given(networks())
def test_proportional_to_the_distance(rivers):
    far = distance_to_outlet(rivers.position, rivers.downstream)
    done = river_heights(rivers, relief=500)
    np.testing.assert_allclose(done.elevation, 500 * far / far.max(), atol=0.1)


def test_slope_area_law_is_recovered():
    x = np.arange(0, 50_001, 100.0)
    rivers = network(np.stack([x, 0 * x], axis=1), np.arange(-1, len(x) - 1))
    done = river_heights(rivers, mode="concave", concavity=0.5, steepness=30, hillslope=400)
    slope = np.diff(done.elevation) / 100
    area = 400 * ((len(x) - 1 - np.arange(len(slope))) * 100 - 50 + 400)
    np.testing.assert_allclose(slope, 30 * area**-0.5, rtol=1e-9)
    assert (np.diff(slope) > 0).all()
    assert done.elevation[-1] != pytest.approx(1000)


def test_no_concavity_is_proportional():
    rivers = network([[0, 0], [300, 0], [300, 900], [900, 50]], [-1, 0, 1, 1])
    straight = river_heights(rivers, mode="concave", concavity=0)
    np.testing.assert_allclose(straight.elevation, river_heights(rivers).elevation, rtol=1e-12)
    assert reach_lengths(rivers.position, rivers.downstream)[0] == 0


@pytest.mark.parametrize(
    ("position", "down", "match"),
    [
        ([[0, 0], [1, 1]], [1, 0], "cycle"),
        ([[0, 0], [np.nan, 1]], [-1, 0], "not finite"),
        ([[5, 5], [5, 5]], [-1, 0], "no river"),
        (np.zeros((0, 2)), [], "no river"),
    ],
)
def test_bad_networks_are_refused(position, down, match):
    with pytest.raises(ValueError, match=match):
        river_heights(network(position, down))


def test_heights_without_measure_are_refused():
    with pytest.raises(ValueError, match="smaller steepness"):
        river_heights(network([[0, 0], [1e6, 0]], [-1, 0]), mode="concave", concavity=0, steepness=1)
