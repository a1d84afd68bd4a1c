"""Ridges part rivers: they stay in the domain, meet no river, lie above it, and are what a plain search finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Voronoi, cKDTree

from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.ridges import ridges
from nodegraph_hydrology.river_heights import river_heights
from nodegraph_hydrology.river_network import river_network
from nodegraph_hydrology.watersheds import sites_of
from nodegraph_terrain.polylines import Polylines

STEM = Polylines.of([np.array([[5000.0, 0.0], [5300.0, 2500.0], [4800.0, 5000.0], [5000.0, 9500.0]])])
CORNERS = np.array([[0.0, 0.0], [10000.0, 0.0], [10000.0, 10000.0], [0.0, 10000.0], [0.0, 0.0]])
BOX = Polylines.of([CORNERS])
# A notch in the north, and a lake.
NOTCHED = Polylines.of(
    [
        np.array(
            [[0, 0], [10000, 0], [10000, 10000], [5600, 10000], [5300, 6000], [4700, 10000], [0, 10000], [0, 0.0]]
        ),
        np.array([[7000, 4000], [8000, 4000], [8000, 5000], [7000, 5000], [7000, 4000.0]]),
    ]
)


def grown(depth=4, seed=0, outline=BOX, lines=STEM):
    return river_heights(river_network(lines, outline, depth=depth, seed=seed))


def reaches(network):
    flows = network.downstream >= 0
    ends = network.position[network.downstream[flows]]
    lines = shapely.linestrings(np.stack([network.position[flows], ends], axis=1))
    # A reach between two nodes on one spot is no line.
    return lines[shapely.length(lines) > 0]


def plans(lines):
    return np.array([shapely.LineString(line[:, :2]) for line in lines.lines()])


def check(network, lines, domain, spacing=None):
    assert lines.points.shape[1] == 3
    assert np.isfinite(lines.points).all()
    plan = plans(lines)
    assert not len(shapely.STRtree(reaches(network)).query(plan, predicate="intersects")[0])
    assert shapely.covers(domain.buffer(1e-6 * np.sqrt(domain.area)), plan).all()
    sites = sites_of(network, spacing or float(np.median(shapely.length(reaches(network)))))
    # Above the nearest river, at every point of every line.
    _, near = cKDTree(sites.position).query(lines.points[:, :2])
    assert (lines.points[:, 2] >= sites.elevation[near]).all()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1.0, 1.57]), st.sampled_from([BOX, NOTCHED]))
def test_within_the_domain_above_and_beside_the_rivers(seed, detour, outline):
    lines = STEM if outline is BOX else Polylines.of([np.array([[3000.0, 0.0], [3300.0, 3000.0], [2000.0, 7000.0]])])
    network = grown(3, seed, outline, lines)
    found = ridges(network, outline, detour=detour, roughness=1.0, seed=seed)
    shapes = [shapely.Polygon(ring) for ring in outline.lines()]
    check(network, found, shapes[0].difference(shapes[1]) if len(shapes) > 1 else shapes[0])


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 30), st.integers(0, 10**6), st.sampled_from([3, 5]))
def test_any_forest_of_rivers(count, seed, nearest):
    """Rivers that cross each other and lie on a lattice: the worst for a triangulation."""
    dice = np.random.default_rng(seed)
    down = np.array([-1, 0, *(int(dice.integers(-1, i)) for i in range(2, count))], np.int32)
    position = dice.integers(0, 6, (count, 2)).astype(np.float64) * 100
    position[1] = position[0] + 50
    network = river_heights(RiverNetwork(position, down, np.zeros(count)))
    found = ridges(network, nearest=nearest, spacing=60)
    west, south = position.min(axis=0) - 500
    east, north = position.max(axis=0) + 500
    check(network, found, shapely.box(west, south, east, north), 60)


def test_edges_are_those_of_a_plain_voronoi_diagram():
    """Without noise and spurs kept: scipy's Voronoi edges, tested one by one, inside of the domain."""
    network = grown(3)
    spacing = float(np.median(shapely.length(reaches(network))))
    found = ridges(network, BOX, detour=1.0, roughness=0.0)
    sites = sites_of(network, spacing)
    diagram = Voronoi(sites.position)
    linked = {frozenset(pair) for pair in sites.pieces.tolist()}
    rivers = shapely.union_all(reaches(network))
    domain = shapely.Polygon(CORNERS)
    expected = []
    for pair, ends in zip(diagram.ridge_points.tolist(), diagram.ridge_vertices, strict=True):
        if -1 in ends or frozenset(pair) in linked:
            continue
        edge = shapely.LineString(diagram.vertices[ends])
        if edge.length > 1e-6 and edge.within(domain) and not edge.intersects(rivers):
            expected.append(edge)
    inner = shapely.union_all(plans(found.take(~found.get("border").values)))
    # What reaches beyond the box is cut there, and has no twin in the list.
    assert shapely.area(inner.buffer(1)) > 0
    within = shapely.buffer(inner, 1e-3)
    assert all(shapely.covers(within, expected))
    rest = inner.difference(shapely.union_all(expected).buffer(1e-3))
    assert all(part.touches(domain.boundary) or part.distance(domain.boundary) < 1e-6 for part in rest.geoms)


def test_heights_follow_equation_4():
    network = grown(3)
    found = ridges(network, BOX, alpha=0.25, roughness=0.0, detour=1.0)
    sites = sites_of(network, float(np.median(shapely.length(reaches(network)))))
    tips = found.points[np.r_[found.offsets[:-1], found.offsets[1:] - 1]]
    distance, near = cKDTree(sites.position).query(tips[:, :2], k=3)
    expected = sites.elevation[near].max(axis=1) + 0.25 * distance[:, 0]
    # On the rim four sites may be equally near.
    assert np.mean(np.abs(tips[:, 2] - expected) < 1e-6) > 0.99
    more = ridges(network, BOX, alpha=0.25, roughness=0.0, detour=1.0, nearest=8)
    assert (more.points[:, 2] >= found.points[:, 2] - 1e-6).all()


def test_two_parallel_rivers_have_one_ridge_halfway():
    x = np.linspace(0, 1000, 11)
    position = np.concatenate([np.stack([x, 0 * x], axis=1), np.stack([x, 0 * x + 200], axis=1)])
    down = np.r_[np.arange(-1, 10), -1, np.arange(11, 21)].astype(np.int32)
    network = RiverNetwork(position, down, np.tile(0.1 * x, 2))
    outline = Polylines.of([np.array([[-50, -100], [1050, -100], [1050, 300], [-50, 300], [-50, -100.0]])])
    found = ridges(network, outline, alpha=0.5, roughness=0.0)
    inner = found.take(~found.get("border").values)
    assert len(inner) == 1
    np.testing.assert_allclose(inner.points[:, 1], 100, atol=1e-9)
    assert np.ptp(inner.points[:, 0]) == pytest.approx(1100)
    # Nothing leaves the domain, so the border is one ring.
    border = found.take(found.get("border").values)
    assert border.closed.tolist() == [True]
    assert border.lengths() == pytest.approx(2 * (1100 + 400))


def test_border_opens_where_a_river_leaves():
    network = grown(3)
    found = ridges(network, BOX)
    border = shapely.union_all(plans(found.take(found.get("border").values)))
    mouth = shapely.Point(network.position[network.downstream < 0][0])
    assert border.distance(mouth) > 0
    assert border.length < 40000
    # Without an outline the box goes through the outlet, which lies southernmost.
    free = ridges(network)
    border = shapely.union_all(plans(free.take(free.get("border").values)))
    assert border.bounds[1] == pytest.approx(network.position[:, 1].min())
    assert border.bounds[3] > network.position[:, 1].max()
    assert border.distance(mouth) > 0


def test_lines_end_at_junctions_only_and_share_no_segment():
    found = ridges(grown(4), BOX)
    inner = found.take(~found.get("border").values)
    keys = inner.points[:, 0] + 1j * inner.points[:, 1]
    ends = np.r_[inner.offsets[:-1], inner.offsets[1:] - 1]
    middle = np.setdiff1d(np.arange(len(keys)), ends)
    assert len(np.unique(keys[middle])) == len(middle)
    assert not np.isin(keys[middle], keys[ends]).any()
    spots, count = np.unique(keys[ends], return_counts=True)
    # Two ends in one spot are a ring, or would have been joined.
    ring = keys[inner.offsets[:-1]] == keys[inner.offsets[1:] - 1]
    assert set(spots[count == 2]) <= set(keys[inner.offsets[:-1]][ring])


def test_fewer_spurs_with_a_detour():
    network = grown(4)
    with_spurs, without = ridges(network, BOX, detour=1.0), ridges(network, BOX)
    assert without.lengths().sum() < with_spurs.lengths().sum()
    covers = shapely.union_all(plans(with_spurs)).buffer(1e-6)
    assert covers.covers(shapely.union_all(plans(without)))


def test_seed_changes_heights_only():
    network = grown(3)
    one, same, other = (ridges(network, BOX, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.points, same.points)
    np.testing.assert_array_equal(one.points[:, :2], other.points[:, :2])
    assert (one.points[:, 2] != other.points[:, 2]).any()


@pytest.mark.parametrize(
    ("change", "outline", "match"),
    [
        ({"elevation": np.array([0.0, np.nan])}, None, "node 1 .* no elevation"),
        ({"position": np.zeros((2, 2))}, None, "no river of any length"),
        ({"downstream": np.array([1, 0], np.int32)}, None, "cycle"),
        ({}, Polylines.of([CORNERS + 5e4]), "within the outline"),
        ({}, Polylines.of([CORNERS[:-1]]), "closed"),
        ({}, Polylines.of([CORNERS / 1e3], unit="deg"), "degrees"),
        ({}, Polylines.of([CORNERS], crs="EPSG:32633"), "different coordinate systems"),
    ],
)
def test_bad_input_is_refused(change, outline, match):
    network = RiverNetwork(
        np.array([[0.0, 0.0], [100.0, 50.0]]), np.array([-1, 0], np.int32), np.array([0.0, 9.0]), "EPSG:32632"
    )
    with pytest.raises(ValueError, match=match):
        ridges(replace(network, **change), outline)


def test_too_fine_a_spacing_is_refused():
    with pytest.raises(ValueError, match="larger spacing"):
        ridges(grown(2), BOX, spacing=1e-4)
