"""Rivers grown from lines: a forest that drains, inside its outline, where no two links meet but at their nodes."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nodegraph_hydrology.crossings import Segments, crossings
from nodegraph_hydrology.river_network import river_network
from nodegraph_hydrology.sketch_line import lines_from_mask, sketch_line
from nodegraph_hydrology.topology import basins, inflows, link_heads, strahler_order
from nodegraph_terrain.polylines import Polylines
from nodegraph_terrain.raster import Extent, Mask

STEM = sketch_line(points=((5000.0, 0.0), (5300.0, 2500.0), (4800.0, 5000.0), (5000.0, 9800.0)))


def ring(*corners):
    return Polylines.of([np.array([*corners, corners[0]], np.float64)])


BOX = ring((0, 0), (10000, 0), (10000, 10000), (0, 10000))


def legs(network):
    heads = np.flatnonzero(network.downstream >= 0)
    return heads, network.downstream[heads]


def wrong_contacts(network):
    """Pairs of reaches that have more in common than the node at which they join, by GEOS."""
    heads, ends = legs(network)
    lines = shapely.linestrings(np.stack([network.position[heads], network.position[ends]], axis=1))
    one, two = shapely.STRtree(lines).query(lines, predicate="intersects")
    one, two = one[one < two], two[one < two]
    common = np.full(len(one), -1)
    for first in (heads[one], ends[one]):
        for second in (heads[two], ends[two]):
            common = np.where(first == second, first, common)
    shared = common >= 0
    meet = shapely.intersection(lines[one[shared]], lines[two[shared]])
    plain = shapely.equals(meet, shapely.points(network.position[common[shared]]))
    return int((~shared).sum() + (~plain).sum())


def check(network, lines, outline=None):
    assert np.isfinite(network.position).all()
    root = basins(network.downstream)
    assert (network.downstream[root] == -1).all()
    # One estuary per line, where the line begins.
    starts = lines.points[lines.offsets[:-1], :2]
    outlets = network.position[network.downstream < 0]
    assert sorted(map(tuple, outlets.tolist())) == sorted(map(tuple, starts.tolist()))
    assert inflows(network.downstream).max() <= 2
    assert wrong_contacts(network) == 0
    if outline is not None:
        area = shapely.Polygon(next(iter(outline.lines())))
        heads, ends = legs(network)
        paths = shapely.linestrings(np.stack([network.position[heads], network.position[ends]], axis=1))
        assert shapely.covers(area, paths).all()


@st.composite
def drawn(draw):
    """Random lines that begin inside of a square."""
    count = draw(st.integers(1, 4))
    dice = np.random.default_rng(draw(st.integers(0, 10_000)))
    return Polylines.of([dice.uniform(500, 9500, (dice.integers(2, 6), 2)) for _ in range(count)])


@given(drawn(), st.integers(2, 5), st.integers(0, 99), st.booleans(), st.sampled_from([0.0, 0.15, 0.3]))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_any_lines_give_a_forest_without_crossings(lines, generator, seed, bounded, sinuosity):
    outline = BOX if bounded else None
    options = {"generator": generator, "max_depth": 4 if generator < 4 else 3, "seed": seed, "sinuosity": sinuosity}
    try:
        network = river_network(lines, outline, **options)
    except ValueError as error:
        if "begins on another line" not in str(error):
            raise
        return
    check(network, lines, outline)
    again = river_network(lines, outline, **options)
    assert network.position.tobytes() == again.position.tobytes()
    assert network.downstream.tobytes() == again.downstream.tobytes()


@pytest.mark.parametrize("seed", [pytest.param(k, marks=[] if k < 2 else pytest.mark.slow) for k in range(50)])
def test_ten_thousand_links_never_cross(seed):
    generator, depth = ((2, 7), (3, 6), (4, 5))[seed % 3]
    network = river_network(STEM, BOX, generator=generator, depth=depth, seed=seed)
    assert len(np.unique(link_heads(network.downstream))) >= 10_000
    check(network, STEM, BOX)


def test_networks_of_several_lines_keep_apart():
    lines = sketch_line(
        points=(
            ((0.0, 2000.0), (9000.0, 2400.0)),
            ((0.0, 2300.0), (9000.0, 3600.0)),
            ((9999.0, 9000.0), (3000.0, 7000.0)),
        )
    )
    network = river_network(lines, BOX, depth=5, generator=3)
    check(network, lines, BOX)
    assert len(np.unique(basins(network.downstream))) == 3


def test_stem_follows_the_drawn_line():
    network = river_network(STEM, BOX, depth=4, sinuosity=0.0)
    for point in STEM.points:
        assert np.hypot(*(network.position - point).T).min() < 1e-6
    straight = river_network(sketch_line(points=((5000.0, 0.0), (5000.0, 9000.0))), depth=4, sinuosity=0.0, bends=0)
    order = strahler_order(straight.downstream)
    on_line = np.abs(straight.position[:, 0] - 5000) < 1e-6
    assert on_line[order == order.max()].all()
    assert straight.position[on_line, 1].max() == pytest.approx(9000)


def test_depth_follows_the_length():
    lines = sketch_line(points=(((0.0, 0.0), (9000.0, 0.0)), ((0.0, 9000.0), (3000.0, 9000.0))))
    network = river_network(lines, BOX, max_depth=6, bends=0)
    orders = strahler_order(network.downstream)
    long, short = (orders[np.flatnonzero(network.downstream < 0)]).tolist()
    assert (long, short) == (round(0.9 * 6) + 1, round(0.3 * 6) + 1)


def test_a_roomy_network_is_the_one_of_the_rules():
    """Where nothing is in the way the number of links is that of the L-system."""
    network = river_network(STEM, depth=3, bends=0, seed=1)
    assert len(np.unique(link_heads(network.downstream))) == 85


def test_own_rules():
    network = river_network(STEM, rules=("G -> F[-G][+G]", "F -> FF"), depth=4, seed=2)
    check(network, STEM)
    assert strahler_order(network.downstream).max() == 5
    for rule in ("G -> [-G]F", "G -> F[-GG]", "G(s) -> F", "A -> F", "G -> F[G]", "G -> F-F", "G -> F[-F[-G]]"):
        with pytest.raises(ValueError, match="no river"):
            river_network(STEM, rules=(rule,))


def test_lines_that_meet_are_cut_and_said_so(caplog):
    lines = sketch_line(points=(((0.0, 5000.0), (9000.0, 5000.0)), ((5000.0, 100.0), (5000.0, 9000.0))))
    network = river_network(lines, BOX, depth=3)
    assert "line 1 is cut to" in caplog.text
    check(network, lines, BOX)


def test_holes_are_left_free():
    lake = ring((6000, 3000), (9000, 3000), (9000, 7000), (6000, 7000))
    outline = Polylines.of([*BOX.lines(), *lake.lines()])
    network = river_network(STEM, outline, depth=6)
    heads, ends = legs(network)
    paths = shapely.linestrings(np.stack([network.position[heads], network.position[ends]], axis=1))
    assert not shapely.crosses(shapely.Polygon(next(iter(lake.lines()))), paths).any()
    assert (network.position[:, 0] > 6000).any()


@pytest.mark.parametrize(
    ("lines", "outline", "options", "match"),
    [
        (Polylines.of([]), None, {}, "no line"),
        (replace(STEM, unit="deg"), None, {}, "in degrees"),
        (STEM, STEM, {}, "closed"),
        (STEM, ring((0, 0), (9, 9), (9, 0), (0, 9)), {}, "crossing itself"),
        (STEM, ring((0, 0), (9, 0), (9, 9), (0, 9)), {}, "outside of the outline"),
        (STEM, None, {"depth": 16, "generator": 5}, "links would grow"),
        (Polylines.of([[[1, 1], [1, 1]]]), None, {}, "no length"),
        (Polylines.of([[[0, 0], [9, 9]], [[0, 0], [9, 0]]]), None, {}, "begins on another line"),
        (replace(STEM, crs="EPSG:32632"), replace(BOX, crs="EPSG:32633"), {}, "different coordinate"),
    ],
)
def test_bad_calls_are_refused(lines, outline, options, match):
    with pytest.raises(ValueError, match=match):
        river_network(lines, outline, **options)


@given(st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_the_crossing_test_agrees_with_geos(seed):
    dice = np.random.default_rng(seed)
    base = dice.uniform(0, 10, (40, 2))
    segments = Segments(base, base + dice.normal(0, 1.5, (40, 2)))
    lines = shapely.linestrings(np.stack([segments.base, segments.tip], axis=1))
    want = {(i, j) for i in range(40) for j in range(i) if shapely.intersects(lines[i], lines[j])}
    got = {(max(pair), min(pair)) for pair in crossings(segments).tolist()}
    assert got == want
    late = {(max(pair), min(pair)) for pair in crossings(segments, 30).tolist()}
    assert late == {pair for pair in want if pair[0] >= 30}


@pytest.mark.slow
def test_twelve_thousand_nodes_in_half_a_second():
    river_network(STEM, BOX, depth=2)
    best = np.inf
    for seed in range(3):
        begin = time.perf_counter()
        network = river_network(STEM, BOX, generator=3, depth=5, seed=seed, bends=1)
        best = min(best, time.perf_counter() - begin)
        assert len(network.position) > 11_000
    assert best < 0.5


# Sketches.


def test_sketches():
    assert len(sketch_line(points=((0.0, 0.0), (5.0, 5.0)))) == 1
    assert len(STEM) == 1
    two = sketch_line(points=(((0.0, 0.0), (5.0, 5.0)), ((1.0, 0.0), (9.0, 5.0), (9.0, 9.0))), crs="EPSG:32632")
    assert (len(two), two.crs, two.offsets.tolist()) == (2, "EPSG:32632", [0, 2, 5])
    for bad in (((0.0, 0.0),), ((1.0, 1.0), (1.0, 1.0)), (((0.0, 0.0), (5.0, 5.0)), ((1.0, 1.0),))):
        with pytest.raises(ValueError, match="fewer than two"):
            sketch_line(points=bad)


def painted(shape, *strokes, radius=2):
    """A mask with strokes between points (column, row), and the extent of one metre per cell."""
    row, column = np.indices(shape)
    data = np.zeros(shape, np.float32)
    for stroke in strokes:
        gap = shapely.distance(shapely.LineString(stroke), shapely.points(column, row))
        data[gap <= radius] = 1
    return Mask(data, Extent(0.0, 0.0, float(shape[1]), float(shape[0])))


def test_lines_are_found_in_a_mask():
    mask = painted((80, 100), [(5, 40), (60, 40), (90, 10)], [(30, 70), (60, 41)], [(20, 8), (45, 8)])
    lines = lines_from_mask(mask, shortest=8.0)
    assert len(lines) == 3
    main = max(lines.lines(), key=len)
    assert lines.lengths().max() == pytest.approx(55 + np.hypot(30, 30), rel=0.06)
    drawn = shapely.union_all(
        [shapely.LineString(s) for s in ([(5, 40), (60, 40), (90, 10)], [(30, 70), (60, 41)], [(20, 8), (45, 8)])]
    )
    for line in lines.lines():
        cells = np.stack([line[:, 0] - 0.5, 80 - line[:, 1] - 0.5], axis=1)
        assert shapely.distance(drawn, shapely.points(cells)).max() < 2.5
    assert main[0, 0] < 10 or main[0, 0] > 85
    river_network(lines, depth=2)


def test_a_closed_stroke_is_a_closed_line():
    angles = np.linspace(0, 2 * np.pi, 60)
    mask = painted((90, 90), np.stack([45 + 30 * np.cos(angles), 45 + 30 * np.sin(angles)], axis=1))
    lines = lines_from_mask(mask)
    assert lines.closed.tolist() == [True]
    assert lines.lengths()[0] == pytest.approx(2 * np.pi * 30, rel=0.06)


def test_masks_without_lines_are_refused():
    with pytest.raises(ValueError, match="no stroke"):
        lines_from_mask(Mask(np.zeros((9, 9), np.float32), Extent(0.0, 0.0, 9.0, 9.0)))
    with pytest.raises(ValueError, match="degrees"):
        lines_from_mask(replace(painted((9, 9), [(1, 1), (8, 8)]), extent=Extent(0.0, 0.0, 9.0, 9.0, unit="deg")))
