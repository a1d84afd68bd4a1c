"""Streams, ridges, basins and their statistics, on terrain whose rivers are known and against plain counts."""

from __future__ import annotations

import json
import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph_hydrology import topology as tp
from nodegraph_hydrology.compare_networks import compare_networks
from nodegraph_hydrology.divides import extract_ridges
from nodegraph_hydrology.drainage import DrainageArea, basins, drainage_area, stream_order
from nodegraph_hydrology.draw_network import draw_network
from nodegraph_hydrology.horton import measure, network_statistics
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.streams import extract_streams
from nodegraph_terrain.raster import Elevation, Extent

DICE = np.random.default_rng(3)


def rough(size=60, cell=30.0, seed=3):
    """Noise on a slope: many small basins."""
    dice = np.random.default_rng(seed)
    data = np.add.outer(np.arange(size) * 2.0, np.arange(size) * 0.7) + 6 * dice.random((size, size))
    return Elevation(data.astype(np.float32), Extent(1000, 2000, 1000 + size * cell, 2000 + size * cell, "EPSG:32632"))


def valley(rows=61, cols=41):
    """A V-shaped valley that falls to the south, its river in the middle column; cells 10 m."""
    y, x = np.mgrid[:rows, :cols]
    data = 500 - 1.0 * y + 5.0 * np.abs(x - cols // 2)
    return Elevation(data.astype(np.float32), Extent(0, 0, cols * 10, rows * 10))


def test_valley_has_one_river():
    surface = valley()
    network = extract_streams(surface, threshold=41 * 100 * 10)
    assert (network.position[:, 0] == 205).all()
    order = np.argsort(network.position[:, 1])
    assert (network.downstream[order][1:] == order[:-1]).all()
    assert network.downstream[order[0]] == -1
    assert (np.diff(network.elevation[order]) == 1).all()


@pytest.mark.parametrize("depressions", ["fill", "breach"])
@pytest.mark.parametrize("method", ["d8", "dinf"])
def test_streams_are_the_cells_of_enough_area(depressions, method):
    surface = rough()
    choice = {"depressions": depressions, "method": method}
    area = drainage_area(surface, **choice)
    network = extract_streams(surface, threshold=20_000, **choice)
    column = np.round((network.position[:, 0] - 1000) / 30 - 0.5).astype(int)
    row = np.round((surface.extent.north - network.position[:, 1]) / 30 - 0.5).astype(int)
    assert {*zip(row.tolist(), column.tolist(), strict=True)} >= {
        (int(i), int(j)) for i, j in np.argwhere(area.data >= 20_000)
    }
    if method == "d8":
        assert len(row) == (area.data >= 20_000).sum()
    flows = network.downstream >= 0
    assert (network.elevation[network.downstream[flows]] <= network.elevation[flows]).all()
    assert network.crs == "EPSG:32632"
    for kind, expected in (("strahler", tp.strahler_order), ("shreve", tp.shreve_magnitude)):
        orders = stream_order(surface, threshold=20_000, kind=kind, **choice).data
        assert (orders[row, column] == expected(network.downstream)).all()
        assert (orders >= 0).sum() == len(row)


def test_basins_are_the_outlets_and_links():
    surface = rough()
    area = drainage_area(surface).data
    labels = basins(surface).data
    sizes = np.bincount(labels.ravel())
    assert (np.diff(sizes) <= 0).all()
    assert sizes.sum() == labels.size
    assert sizes[0] * 900 == area.max()
    large = basins(surface, smallest=900 * float(sizes[1])).data
    assert set(np.unique(large)) <= {-1, 0, 1, 2}
    network = extract_streams(surface, threshold=20_000)
    links = basins(surface, unit="links", threshold=20_000).data
    assert links.max() + 1 == len(np.unique(tp.link_heads(network.downstream)))


def test_divides_part_links_that_do_not_join():
    """Three parallel valleys: two ridges between them, straight along the slope."""
    y, x = np.mgrid[:40, :60]
    data = 200 - 0.5 * y + 4 * np.abs((x % 20) - 9.5)
    ridges = extract_ridges(Elevation(data.astype(np.float32), Extent(0, 0, 600, 400)), threshold=100 * 40)
    places = [set(line[:, 0].tolist()) for line in ridges.lines()]
    assert any(200.0 in place for place in places)
    assert any(400.0 in place for place in places)
    assert ridges.points.shape[1] == 3
    length = ridges.get("length")
    assert length is not None
    np.testing.assert_allclose(length.values, ridges.lengths())


def test_inverted_ridges_run_along_the_crest():
    surface = valley()
    crest = surface.like(1000 - surface.data)
    ridges = extract_ridges(crest, method="inverted", threshold=41 * 100 * 10)
    assert (ridges.points[:, 0] == 205).all()
    row = np.round((610 - ridges.points[:, 1]) / 10 - 0.5).astype(int)
    assert (ridges.points[:, 2] == crest.data[row, 20]).all()
    assert len(extract_ridges(crest, method="inverted", threshold=41 * 100 * 10, shortest=1e4)) == 0


def test_without_streams_the_greatest_area_is_named():
    with pytest.raises(ValueError, match="greatest drainage area is"):
        extract_streams(valley(), threshold=1e12)


# Statistics.


def tree(order):
    """A perfect binary tree of unit vertical reaches: order Strahler, T_k = 0, R_B = 2."""
    down, place, front = [-1, 0], [(0.0, 0.0), (0.0, 1.0)], [1]
    for level in range(1, order):
        upper = []
        for node in front:
            for side in (-1, 1):
                down.append(node)
                place.append((place[node][0] + side * 2.0**-level, place[node][1] + 1))
                upper.append(len(down) - 1)
        front = upper
    return RiverNetwork(np.array(place), np.array(down, np.int32), np.zeros(len(down)))


def tokunaga(order, a, c):
    """A network with exactly a c^(k-1) side tributaries per stream, its reaches of length 1."""
    down, place = [-1], [(0.0, 0.0)]

    def stream(below, rank):
        here = below
        for k in range(rank - 1, 0, -1):
            for _ in range(round(a * c ** (k - 1))):
                here = add(here)
                stream(here, rank - k)
        here = add(here)
        if rank > 1:
            stream(here, rank - 1)
            stream(here, rank - 1)

    def add(below):
        down.append(below)
        place.append((place[below][0] + 1.0, DICE.normal()))
        return len(down) - 1

    stream(0, order)
    return RiverNetwork(np.array(place), np.array(down, np.int32), np.zeros(len(down)))


def test_binary_tree():
    numbers = measure(tree(6))
    assert numbers.counts.tolist() == [32, 16, 8, 4, 2, 1]
    assert numbers.bifurcation_ratio == pytest.approx(2)
    assert not numbers.branching.any()
    assert math.isnan(numbers.tokunaga_c)


@pytest.mark.parametrize(("a", "c"), [(1, 2), (2, 2), (1, 3)])
def test_tokunaga_networks_give_their_parameters(a, c):
    numbers = measure(tokunaga(5, a, c))
    np.testing.assert_allclose(numbers.branching, [a * c ** (k - 1) for k in range(1, 5)])
    assert numbers.tokunaga_a == pytest.approx(a)
    assert numbers.tokunaga_c == pytest.approx(c)
    ratio = ((2 + a + c) + math.sqrt((2 + a + c) ** 2 - 8 * c)) / 2
    # Tokunaga's R_B is the limit for many orders.
    assert numbers.counts[0] / numbers.counts[1] == pytest.approx(ratio, rel=0.05)
    json.loads(numbers.to_json())


@st.composite
def forests(draw):
    count = draw(st.integers(2, 80))
    dice = np.random.default_rng(draw(st.integers(0, 10**6)))
    down = [-1, 0] + [int(dice.integers(-1, i)) if dice.random() < 0.3 else i - 1 for i in range(2, count)]
    return RiverNetwork(dice.random((count, 2)) * 100, np.array(down, np.int32), np.zeros(count))


@given(forests())
def test_streams_and_tributaries_by_walking(network):
    down, order = network.downstream.tolist(), tp.strahler_order(network.downstream).tolist()
    donors = [[i for i, d in enumerate(down) if d == n] for n in range(len(down))]
    heads = [n for n in range(len(down)) if not any(order[i] == order[n] for i in donors[n])]
    counts = Counter(order[n] for n in heads)
    sides = Counter()
    lengths = Counter()
    for head in heads:
        node = head
        forming = sorted((order[i] for i in donors[head]), reverse=True)[2:]
        for rank in forming:
            sides[rank, order[head]] += 1
        while True:
            if down[node] >= 0:
                lengths[order[head]] += math.dist(network.position[node], network.position[down[node]])
            if down[node] < 0 or order[down[node]] != order[head]:
                break
            node = down[node]
            for i in donors[node]:
                if order[i] < order[head]:
                    sides[order[i], order[head]] += 1
    numbers = measure(network)
    top = max(order)
    assert numbers.counts.tolist() == [counts[w] for w in range(1, top + 1)]
    np.testing.assert_allclose(numbers.lengths, [lengths[w] / counts[w] for w in range(1, top + 1)])
    expected = [[sides[i, j] / counts[j] for j in range(1, top + 1)] for i in range(1, top + 1)]
    np.testing.assert_allclose(numbers.tributaries, expected)
    for k in range(1, top):
        total = sum(sides[j - k, j] for j in range(k + 1, top + 1))
        assert numbers.branching[k - 1] == pytest.approx(total / sum(counts[j] for j in range(k + 1, top + 1)))


def test_areas_come_from_the_raster():
    surface = rough()
    area = drainage_area(surface)
    network = extract_streams(surface, threshold=10_000)
    result = network_statistics(network, area)
    numbers = result.statistics
    assert numbers.measured
    outlets = network.downstream < 0
    column = np.floor((network.position[outlets, 0] - 1000) / 30).astype(int)
    row = np.floor((surface.extent.north - network.position[outlets, 1]) / 30).astype(int)
    assert numbers.area == pytest.approx(float(area.data[row, column].sum()), rel=1e-6)
    assert numbers.drainage_density == pytest.approx(numbers.length / numbers.area)
    assert 1 <= numbers.sinuosity < 1.5
    assert result.plot.shape == (800, 1200)
    with pytest.raises(ValueError, match="outside of the drainage areas"):
        network_statistics(network, DrainageArea(area.data, Extent(0, 0, 600, 600)))
    with pytest.raises(ValueError, match="no reaches"):
        measure(RiverNetwork(np.zeros((1, 2)), np.array([-1], np.int32), np.zeros(1)))


# Comparing and drawing.


def test_extracted_streams_agree_with_themselves():
    surface = rough()
    network = extract_streams(surface, threshold=20_000)
    result = compare_networks(network, surface, threshold=20_000, within=0, least_order=1)
    assert result.followed == result.found == 1
    assert result.agreement.stream_cells == result.agreement.designed_cells == len(network.position)
    red, _, blue = np.moveaxis(result.map.data[:400].astype(int), 2, 0)  # without the legend
    assert (blue - red > 60).any()
    assert not (red - blue > 60).any()


def test_a_river_beside_the_valley_is_not_found():
    surface, columns = valley(), np.array([205.0, 225.0, 245.0])
    y = np.linspace(595, 5, 60)
    found = []
    for x in columns:
        down = np.append(np.arange(1, 60), -1).astype(np.int32)
        river = RiverNetwork(np.stack([np.full(60, x), y], axis=1), down, np.zeros(60))
        result = compare_networks(river, surface, threshold=41_000, least_order=1)
        found.append((result.followed, result.found))
    assert found[0][0] == 1
    assert found[1][0] == 1  # two cells off
    assert found[2] == (0, 0)
    assert found[0][1] > 0.8  # the river begins below the designed source
    with pytest.raises(ValueError, match="order 2 or more"):
        compare_networks(river, surface, threshold=41_000)


def test_the_threshold_is_the_area_nearest_to_first_order_links():
    """A Y: each upper arm, straight down its own half of the ground, is nearest to half of it above the junction."""
    place = np.array([[100.0, 395.0], [300.0, 395.0], [200.0, 200.0], [200.0, 5.0]])
    river = RiverNetwork(place, np.array([2, 2, 3, -1], np.int32), np.zeros(4))
    ground = Elevation(np.add.outer(np.arange(80, 0, -1.0), np.abs(np.arange(80) - 40.0)), Extent(0, 0, 400, 400))
    used = compare_networks(river, ground, least_order=1).agreement.threshold
    y, x = np.mgrid[397.5:0:-5, 2.5:400:5]

    def distance(first, last):
        leg = last - first
        t = np.clip(((x - first[0]) * leg[0] + (y - first[1]) * leg[1]) / (leg @ leg), 0, 1)
        return np.hypot(x - first[0] - t * leg[0], y - first[1] - t * leg[1])

    arms = np.minimum(distance(place[0], place[2]), distance(place[1], place[2]))
    expected = (arms < distance(place[2], place[3])).sum() * 25 / 2
    assert used == pytest.approx(expected, rel=0.03)


def test_map_shows_the_river_where_it_runs():
    surface = valley()
    network = extract_streams(surface, threshold=41_000)
    picture = draw_network(network, surface, size=610, legend=False)
    assert picture.shape == (610, 410)
    colour = picture.data.astype(int)
    blue = colour[..., 2] - colour[..., 0] > 40
    rows, columns = np.nonzero(blue)
    assert len(rows) > 500
    assert abs(columns - 205).max() < 8
    with pytest.raises(ValueError, match="empty"):
        draw_network(RiverNetwork(np.zeros((0, 2)), np.zeros(0, np.int32), np.zeros(0)))


def test_cancel_stops_the_routing():
    from threading import Event

    stop = Event()
    stop.set()
    with pytest.raises(Exception, match="cancelled"):
        drainage_area(rough(), context=Context("area", cancelled=stop))
