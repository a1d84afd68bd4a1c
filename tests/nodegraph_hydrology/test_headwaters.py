"""Headwaters drain all ground: rivers stay, new ones join them, none cross, none leave the domain."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph_hydrology.headwaters import headwaters
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.river_network import river_network
from nodegraph_hydrology.topology import hops, reach_lengths
from nodegraph_terrain.polylines import Polylines

STEMS = Polylines.of(
    [np.array([[3000.0, 0.0], [3300.0, 2500.0], [2800.0, 5500.0]]), np.array([[7000.0, 0.0], [7300.0, 4000.0]])]
)
BOX = np.array([[0.0, 0.0], [10000.0, 0.0], [10000.0, 10000.0], [0.0, 10000.0], [0.0, 0.0]])
LAKE = np.array([[4000.0, 7000.0], [6000.0, 7000.0], [5000.0, 8500.0], [4000.0, 7000.0]])
NOTCHED = np.array([[0, 0], [10000, 0], [10000, 10000], [5600, 10000], [5300, 6000], [4700, 10000], [0, 10000], [0, 0]])
DOMAINS = {
    "box": Polylines.of([BOX]),
    "lake": Polylines.of([BOX, LAKE]),
    "notch": Polylines.of([NOTCHED.astype(np.float64)]),
}


def area_of(name):
    shape = shapely.Polygon()
    for ring in DOMAINS[name].lines():
        shape = shape.symmetric_difference(shapely.Polygon(ring[:, :2]))
    return shape


def reaches(network):
    flows = np.flatnonzero(network.downstream >= 0)
    ends = np.stack([network.position[flows], network.position[network.downstream[flows]]], axis=1)
    return flows, shapely.linestrings(ends)


def meetings(network):
    """Pairs of reaches that share more than a node where one arrives at the other."""
    flows, lines = reaches(network)
    down = network.downstream
    one, two = shapely.STRtree(lines).query(lines, predicate="intersects")
    a, b = flows[one], flows[two]
    joined = (down[a] == b) | (down[b] == a) | (down[a] == down[b]) | (a == b)
    return int((~joined).sum())


@settings(max_examples=12, deadline=None)
@given(st.sampled_from(list(DOMAINS)), st.integers(0, 99), st.floats(150, 900), st.floats(0, 8))
def test_no_river_crosses_another_or_the_outline(name, seed, spacing, variety):
    rivers = river_network(STEMS, DOMAINS[name], depth=2, seed=seed)
    grown = headwaters(rivers, DOMAINS[name], spacing=spacing, variety=variety, seed=seed)
    assert len(grown.position) > len(rivers.position)
    hops(grown.downstream)
    assert meetings(grown) == meetings(rivers) == 0
    assert shapely.covers(area_of(name).buffer(1e-6), reaches(grown)[1]).all()
    # The given rivers stay where they were, and outlets are theirs alone.
    spots = shapely.line_interpolate_point(reaches(rivers)[1], 0.37, normalized=True)
    away = shapely.STRtree(reaches(grown)[1]).query_nearest(spots, return_distance=True, all_matches=False)[1]
    assert away.max() < 1e-6
    assert (grown.downstream < 0).sum() == (rivers.downstream < 0).sum()
    assert np.isnan(grown.elevation).all()


@pytest.mark.parametrize("spacing", [300, 600])
def test_no_ground_is_far_from_a_river(spacing):
    rivers = river_network(STEMS, DOMAINS["box"], depth=2)
    grown = headwaters(rivers, DOMAINS["box"], spacing=spacing)
    x, y = np.meshgrid(np.linspace(0, 10000, 60), np.linspace(0, 10000, 60))
    points = shapely.points(x.ravel(), y.ravel())
    before, after = (
        shapely.STRtree(reaches(network)[1]).query_nearest(points, return_distance=True, all_matches=False)[1].max()
        for network in (rivers, grown)
    )
    assert after < 2 * spacing < before


def test_default_spacing_is_the_ground_per_length():
    rivers = river_network(STEMS, DOMAINS["box"], depth=3)
    spacing = 1e8 / reach_lengths(rivers.position, rivers.downstream).sum()
    implied, given_ = headwaters(rivers, DOMAINS["box"]), headwaters(rivers, DOMAINS["box"], spacing=spacing)
    np.testing.assert_array_equal(implied.position, given_.position)
    np.testing.assert_array_equal(implied.downstream, given_.downstream)


def test_seed_and_crs():
    rivers = river_network(Polylines.of(list(STEMS.lines()), crs="EPSG:32632"), depth=2)
    one, two = headwaters(rivers, seed=1), headwaters(rivers, seed=2)
    assert one.crs == "EPSG:32632"
    assert one.position.shape != two.position.shape or not np.array_equal(one.position, two.position)


def test_no_room_leaves_the_rivers():
    rivers = river_network(STEMS, DOMAINS["box"], depth=2)
    grown = headwaters(rivers, DOMAINS["box"], spacing=30000)
    assert reach_lengths(grown.position, grown.downstream).sum() == pytest.approx(
        reach_lengths(rivers.position, rivers.downstream).sum()
    )


def test_a_single_straight_river():
    line = RiverNetwork(np.array([[0.0, 0.0], [0.0, 1000.0]]), np.array([-1, 0], np.int32), np.full(2, np.nan))
    grown = headwaters(line, spacing=120)
    assert meetings(grown) == 0
    assert (grown.downstream < 0).sum() == 1


@pytest.mark.parametrize(
    ("position", "down", "params", "match"),
    [
        ([[0, 0], [np.nan, 1]], [-1, 0], {}, "not finite"),
        ([[5, 5], [5, 5]], [-1, 0], {}, "no river"),
        ([[0, 0], [1, 1]], [1, 0], {}, "cycle"),
        ([[0, 0], [0, 1e6]], [-1, 0], {"spacing": 1}, "larger spacing"),
    ],
)
def test_bad_input_is_refused(position, down, params, match):
    network = RiverNetwork(np.array(position, np.float64), np.array(down, np.int32), np.full(len(down), np.nan))
    with pytest.raises(ValueError, match=match):
        headwaters(network, **params, context=Context())
