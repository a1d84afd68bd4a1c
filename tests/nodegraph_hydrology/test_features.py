"""Rivers and ridges on a grid: the elevations that plain walks along every segment give, rivers first."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph_hydrology.features import Features
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.rasterize_features import rasterize_features
from nodegraph_hydrology.ridges import ridges
from nodegraph_hydrology.river_heights import river_heights
from nodegraph_hydrology.river_network import river_network
from nodegraph_terrain.polylines import Polylines
from nodegraph_terrain.raster import Elevation, Extent

SIZE = 20
EXTENT = (0.0, 0.0, 20.0, 20.0)


def bresenham(x0, y0, x1, y1):
    """The textbook's algorithm, with an error term, in one octant after mirroring."""
    dx, dy = x1 - x0, y1 - y0
    steep = abs(dy) > abs(dx)
    long, short = (abs(dy), abs(dx)) if steep else (abs(dx), abs(dy))
    error, cells, side = 2 * short - long, [], 0
    for step in range(long + 1):
        a, b = step * int(np.sign(dy if steep else dx)), side * int(np.sign(dx if steep else dy))
        cells.append((x0 + b, y0 + a) if steep else (x0 + a, y0 + b))
        if error >= 0:
            side, error = side + 1, error - 2 * long
        error += 2 * short
    return cells


@st.composite
def scenes(draw):
    """A forest of rivers and ridges that also leave the grid."""
    dice = np.random.default_rng(draw(st.integers(0, 10**6)))
    count = draw(st.integers(1, 12))
    down = np.array([-1, *(int(dice.integers(-1, i)) for i in range(1, count))], np.int32)
    network = RiverNetwork(dice.uniform(-4, 24, (count, 2)), down, dice.uniform(0, 100, count))
    network.position[0] = dice.uniform(0, 20, 2)
    lines = [dice.uniform([-4, -4, 100], [24, 24, 200], (draw(st.integers(2, 5)), 3)) for _ in range(2)]
    return network, Polylines.of(lines)


def segments(network, lines):
    points = np.column_stack([network.position, network.elevation])
    wet = [(points[i], points[d if d >= 0 else i]) for i, d in enumerate(network.downstream)]
    return wet, [pair for line in lines.lines() for pair in pairwise(line)]


@given(scenes())
def test_bresenham_takes_the_cells_of_the_textbook(scene):
    network, lines = scene
    wet, dry = segments(network, lines)
    expected = np.full((SIZE, SIZE), np.nan)
    for group, better in ((dry, np.fmax), (wet, np.fmin)):
        layer = np.full((SIZE, SIZE), np.nan)
        for one, two in group:
            ends = [int(np.floor(v)) for p in (one, two) for v in (p[0], 20 - p[1])]
            cells = bresenham(*ends)
            for (x, y), share in zip(cells, np.linspace(0, 1, len(cells)), strict=True):
                if 0 <= x < SIZE and 0 <= y < SIZE:
                    layer[y, x] = better(layer[y, x], (1 - share) * one[2] + share * two[2])
        expected = np.where(np.isnan(layer), expected, layer)
    found = rasterize_features(network, lines, extent=EXTENT, cell_size=1, method="bresenham")
    np.testing.assert_allclose(found.features.data, expected, rtol=1e-5)
    assert isinstance(found.features, Features)


@settings(deadline=None)
@given(scenes())
def test_exact_takes_every_cell_that_is_passed(scene):
    """Against GEOS: the cells with a length of a segment in them, at the height of the middle of that piece."""
    network, lines = scene
    corner = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1).reshape(-1, 2)
    boxes = shapely.box(corner[:, 0], 19 - corner[:, 1], corner[:, 0] + 1, 20 - corner[:, 1])
    expected = np.full(SIZE * SIZE, np.nan)
    wet, dry = segments(network, lines)
    for group, better in ((dry, np.fmax), (wet, np.fmin)):
        layer = np.full(SIZE * SIZE, np.nan)
        for one, two in group:
            length = np.hypot(*(two - one)[:2])
            for end in (one, two):
                x, y = int(np.floor(end[0])), int(np.floor(20 - end[1]))
                if 0 <= x < SIZE and 0 <= y < SIZE:
                    layer[y * SIZE + x] = better(layer[y * SIZE + x], end[2])
            if length == 0:
                continue
            parts = shapely.intersection(boxes, shapely.LineString([one[:2], two[:2]]))
            for cell in np.flatnonzero(shapely.length(parts) > 1e-9):
                middle = shapely.get_coordinates(parts[cell]).mean(axis=0)
                share = np.hypot(*(middle - one[:2])) / length
                layer[cell] = better(layer[cell], (1 - share) * one[2] + share * two[2])
        expected = np.where(np.isnan(layer), expected, layer)
    found = rasterize_features(network, lines, extent=EXTENT, cell_size=1)
    np.testing.assert_allclose(found.features.data.ravel(), expected, rtol=1e-5)


def test_cells_of_a_line_follow_each_other_edge_to_edge():
    network = RiverNetwork(np.array([[0.5, 0.5], [19.3, 12.2]]), np.array([-1, 0], np.int32), np.array([0.0, 10.0]))
    exact = rasterize_features(network, extent=EXTENT, cell_size=1).rivers.data
    thin = rasterize_features(network, extent=EXTENT, cell_size=1, method="bresenham").rivers.data
    assert exact.sum() == 1 + 19 + 12
    assert thin.sum() == 19 + 1


@pytest.mark.parametrize("method", ["exact", "bresenham"])
def test_rivers_keep_their_elevation_over_ridges(method):
    line = Polylines.of([np.array([[5000.0, 0.0], [5300.0, 5000.0], [4800.0, 9000.0]])])
    outline = Polylines.of([np.array([[0, 0], [10000, 0], [10000, 10000], [0, 10000], [0, 0.0]])])
    network = river_heights(river_network(line, outline, depth=4))
    crests = ridges(network, outline)
    both = rasterize_features(network, crests, cell_size=50, method=method)
    assert both.features.shape == (200, 200)
    wet = both.rivers.data == 1
    alone = rasterize_features(network, like=both.features, method=method)
    np.testing.assert_array_equal(both.features.data[wet], alone.features.data[wet])
    assert np.isnan(alone.features.data[~wet]).all()
    # The cell of a node is never above it; ridges are present, the border too.
    column, row = np.floor(np.abs(network.position - [0, 10000]) / 50).astype(int).clip(0, 199).T
    assert (both.features.data[row, column] <= network.elevation.astype(np.float32)).all()
    assert np.isfinite(both.features.data[0]).all()
    # In the south the border is open at the estuary.
    assert np.isnan(both.features.data[-1]).sum() < 10
    assert wet[-1, 100]
    assert np.isfinite(both.features.data[:, [0, -1]]).all()
    assert 0.02 < np.isfinite(both.features.data[~wet]).mean() < 0.6


def test_a_river_falls_from_cell_to_cell():
    line = Polylines.of([np.array([[5000.0, 0.0], [5300.0, 5000.0], [4800.0, 9000.0]])])
    network = river_heights(river_network(line, depth=3))
    found = rasterize_features(network, cell_size=10)
    z = np.pad(found.features.data, 1, constant_values=np.inf)
    z = np.where(np.isnan(z), np.inf, z)
    around = [np.roll(z, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    pits = np.isfinite(z) & (np.minimum.reduce(around) >= z)
    assert pits.sum() == 1


def test_a_grid_to_follow():
    network = RiverNetwork(np.array([[2.0, 3.0], [8.0, 3.0]]), np.array([-1, 0], np.int32), np.array([1.0, 2.0]))
    like = Elevation(np.zeros((4, 5), np.float32), Extent(0, 0, 10, 10, "EPSG:32632"))
    found = rasterize_features(network, like=like).features
    assert found.extent == like.extent
    np.testing.assert_allclose(found.data[2, 1:], [1.0, 1.5, 1.833, 2.0][0:4], atol=0.4)
    assert np.isnan(np.delete(found.data, 2, axis=0)).all()


NODES = np.array([[0.0, 0.0], [10.0, 5.0]])
DOWN = np.array([-1, 0], np.int32)
GOOD = RiverNetwork(NODES, DOWN, np.array([0.0, 1.0]), "EPSG:32632")


@pytest.mark.parametrize(
    ("inputs", "params", "match"),
    [
        ((RiverNetwork(NODES, DOWN, np.array([0.0, np.nan])),), {}, "node 1 .*river_heights"),
        ((GOOD, Polylines.of([NODES])), {}, "has no height"),
        ((GOOD, Polylines.of([np.array([[0.0, 0, 1], [1, 1, np.nan]])])), {}, "has no height"),
        ((GOOD, Polylines.of([np.ones((2, 3))], unit="deg")), {}, "degrees"),
        ((GOOD, Polylines.of([np.ones((2, 3))], crs="EPSG:32633")), {}, "different coordinate systems"),
        ((GOOD, None, Elevation(np.zeros((2, 2)), Extent(0, 0, 1, 1, unit="deg"))), {}, "degrees"),
        ((GOOD, None, Elevation(np.zeros((2, 2)), Extent(0, 0, 1, 1, "EPSG:32633"))), {}, "another coordinate"),
        ((GOOD,), {"extent": (50, 50, 90, 90)}, "no river or ridge"),
        ((GOOD,), {"cell_size": 1e-9}, "larger cells"),
        ((RiverNetwork(np.zeros((0, 2)), np.zeros(0, np.int32), np.zeros(0)),), {}, "neither"),
    ],
)
def test_bad_input_is_refused(inputs, params, match):
    with pytest.raises(ValueError, match=match):
        rasterize_features(*inputs, **params)
