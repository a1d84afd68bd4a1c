"""River heights fall strictly downstream, straight or by the slope-area law."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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
