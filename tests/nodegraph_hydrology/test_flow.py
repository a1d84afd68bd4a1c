"""Flow routing, against a priority flood and walks over one cell at a time."""

from __future__ import annotations

import heapq
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph_hydrology.dinf import parts
from nodegraph_hydrology.flow import STEPS, accumulated, cell_areas, route
from nodegraph_terrain.raster import Elevation, Extent

CELLS = ((1.0, 1.0), (30.0, 20.0))


@st.composite
def surfaces(draw, void=True):
    """Small rasters with few heights, so that flats and depressions abound, or with many; some cells void."""
    rows, cols = draw(st.integers(1, 12)), draw(st.integers(1, 12))
    dice = np.random.default_rng(draw(st.integers(0, 10**6)))
    levels = draw(st.sampled_from([1, 2, 4, 12, 0]))
    data = dice.integers(0, levels, (rows, cols)) if levels else dice.normal(0, 100, (rows, cols))
    data = data.astype(np.float32)
    if void and draw(st.booleans()):
        data[dice.random((rows, cols)) < 0.15] = np.nan
        data[0, 0] = 1
    dx, dy = draw(st.sampled_from(CELLS))
    return Elevation(data, Extent(0, 0, cols * dx, rows * dy))


def neighbours(shape, i, j):
    for di, dj in STEPS:
        if 0 <= i + di < shape[0] and 0 <= j + dj < shape[1]:
            yield i + di, j + dj


def flooded(data):
    """The least surface that drains, by Barnes' priority flood."""
    filled = data.copy()
    done = np.isnan(data)
    heap = []
    for i, j in np.argwhere(~np.isnan(data)).tolist():
        around = list(neighbours(data.shape, i, j))
        if len(around) < 8 or any(np.isnan(data[n]) for n in around):
            heapq.heappush(heap, (float(data[i, j]), i, j))
            done[i, j] = True
    while heap:
        height, i, j = heapq.heappop(heap)
        for n in neighbours(data.shape, i, j):
            if not done[n]:
                done[n] = True
                filled[n] = max(filled[n], height)
                heapq.heappush(heap, (float(filled[n]), *n))
    return filled


def passes(flow, surface):
    """The greatest height on the way from each cell to its outlet, over the surface as given."""
    top = flow.lattice.height.copy()
    for cell in flow.order():
        if flow.receiver[cell] >= 0:
            top[cell] = max(top[cell], top[flow.receiver[cell]])
    return flow.lattice.inner(top)


@given(surfaces())
def test_filling_is_the_least_that_drains(surface):
    flow = route(surface, "fill", Context())
    np.testing.assert_array_equal(flow.lattice.inner(flow.height), flooded(surface.data))


@given(surfaces(), st.sampled_from(["fill", "breach"]))
def test_every_cell_drains_and_never_up(surface, depressions):
    flow = route(surface, depressions, Context())
    lattice = flow.lattice
    known = np.flatnonzero(lattice.known)
    assert sorted(flow.order().tolist()) == known.tolist()  # a cell of a cycle would be missing
    assert lattice.known[flow.receiver[flow.receiver >= 0]].all()
    assert (flow.receiver[~lattice.known] == -1).all()
    flowing = np.flatnonzero(flow.receiver >= 0)
    assert np.isin(flow.receiver[flowing] - flowing, lattice.offsets).all()
    assert (flow.height[flow.receiver[flowing]] <= flow.height[flowing]).all()
    assert lattice.edge[known[flow.receiver[known] < 0]].all()
    lower = np.zeros(len(lattice.height), bool)
    for offset in lattice.offsets:
        lower[known] |= flow.height[known + offset] < flow.height[known]
    if depressions == "fill":
        assert (flow.receiver[lower] >= 0).all()


@given(surfaces())
def test_breaches_take_the_lowest_pass_and_cut_only(surface):
    flow = route(surface, "breach", Context())
    np.testing.assert_array_equal(passes(flow, surface), flooded(surface.data))
    assert (flow.height[flow.lattice.known] <= flow.lattice.height[flow.lattice.known]).all()
    # Cut no deeper than the lowest that drains through.
    lowest = flow.lattice.height.copy()
    for cell in flow.order()[::-1]:
        if flow.receiver[cell] >= 0:
            lowest[flow.receiver[cell]] = min(lowest[flow.receiver[cell]], lowest[cell])
    np.testing.assert_array_equal(lowest, flow.height)


@given(surfaces())
def test_steepest_descent(surface):
    flow = route(surface, "fill", Context())
    height = flow.lattice.inner(flow.height).astype(np.float64)
    width, (dx, dy) = surface.shape[1] + 2, flow.lattice.cell
    for i, j in np.argwhere(~np.isnan(height)).tolist():
        falls = {n: (height[i, j] - height[n]) / math.hypot((n[1] - j) * dx, (n[0] - i) * dy)
                 for n in neighbours(height.shape, i, j) if not np.isnan(height[n])}  # fmt: skip
        best = max(falls.values(), default=0)
        if best > 0:
            row, col = divmod(int(flow.receiver[(i + 1) * width + j + 1]), width)
            assert falls[row - 1, col - 1] == best


@given(surfaces(), st.sampled_from(["fill", "breach"]), st.sampled_from(["d8", "dinf"]))
def test_water_is_conserved(surface, depressions, method):
    flow = route(surface, depressions, Context())
    area = cell_areas(flow, method, Context())
    cell = flow.lattice.cell[0] * flow.lattice.cell[1]
    outlets = flow.lattice.known & (flow.receiver < 0)
    assert area[outlets].sum() == pytest.approx(cell * flow.lattice.known.sum(), rel=1e-9)
    assert (area[flow.lattice.known] >= cell * (1 - 1e-9)).all()
    assert (area[~flow.lattice.known] == 0).all()


@given(surfaces())
def test_d8_areas_by_walking(surface):
    flow = route(surface, "fill", Context())
    count = np.zeros(len(flow.receiver))
    for start in np.flatnonzero(flow.lattice.known).tolist():
        cell = start
        while cell >= 0:
            count[cell] += 1
            cell = int(flow.receiver[cell])
    np.testing.assert_array_equal(accumulated(flow, flow.lattice.known * 1.0, "d8"), count)


@given(surfaces(), st.sampled_from(["fill", "breach"]))
def test_dinf_shares(surface, depressions):
    flow = route(surface, depressions, Context())
    source, target, share = parts(flow)
    flows = flow.receiver >= 0
    total = np.bincount(source, share, minlength=len(flows))
    np.testing.assert_allclose(total, flows, atol=1e-12)
    assert (np.bincount(source, minlength=len(flows)) <= 2).all()
    free = ~flow.forced[source]
    assert (flow.height[target] < flow.height[source])[free].all()
    # The sums, one cell at a time from high to low.
    area = flow.lattice.known * 1.0
    rank = np.empty(len(flows))
    rank[flow.order()] = np.arange(len(flow.order()))
    for k in np.lexsort((-rank[source], -flow.height[source])):
        area[target[k]] += area[source[k]] * share[k]
    np.testing.assert_allclose(accumulated(flow, flow.lattice.known * 1.0, "dinf"), area, rtol=1e-9)


@pytest.mark.parametrize("degrees", [0, 10, 45, 63, 90, 200, 271.5, 350])
def test_dinf_follows_a_plane(degrees):
    """Tarboton's direction on a plane is exact: the mean of the two targets, weighted by angle, is its direction."""
    angle = math.radians(degrees)
    y, x = np.mgrid[10:-11:-1, -10:11]
    surface = Elevation((-(x * math.cos(angle) + y * math.sin(angle))).astype(np.float32) + 100, Extent(0, 0, 21, 21))
    flow = route(surface, "fill", Context())
    middle = 11 * 23 + 11
    source, target, share = parts(flow)
    here = source == middle
    turned = []
    for cell in target[here]:
        di, dj = divmod(int(cell - middle) + 11 * 23 + 11, 23)
        turned.append(math.atan2(11 - di, dj - 11))
    unit = [math.remainder(a - angle, 2 * math.pi) for a in turned]
    assert np.dot(unit, share[here]) == pytest.approx(0, abs=1e-4)


def test_flats_drain_without_parallel_lines():
    """A level floor between walls with one gap: flow converges towards the gap, away from the walls."""
    data = np.full((41, 61), 50, np.float32)
    data[1:-1, 1:-1] = 10
    data[20, -1] = 5
    flow = route(Elevation(data, Extent(0, 0, 61, 41)), "fill", Context())
    area = flow.lattice.inner(accumulated(flow, flow.lattice.known * 1.0, "d8"))
    assert area[20, -1] > 39 * 59
    # Halfway, nearly all water of the left half runs in the middle rows, not side by side in all of them.
    column = area[1:-1, 40]
    assert np.sort(column)[::-1][:5].sum() > 0.75 * column.sum()


def test_large_flat_and_long_path_finish():
    spiral = np.full((101, 101), 100, np.float32)
    spiral[::4, :] = 0
    for k in range(0, 97, 4):
        spiral[k : k + 5, 100 if (k // 4) % 2 == 0 else 0] = 0
    flow = route(Elevation(spiral, Extent(0, 0, 101, 101)), "breach", Context())
    assert len(flow.order()) == 101 * 101


@pytest.mark.parametrize(
    ("data", "extent", "message"),
    [
        ([[np.nan, np.nan]], Extent(0, 0, 2, 1), "void"),
        ([[1, np.inf]], Extent(0, 0, 2, 1), "infinite"),
        ([[1, 2]], Extent(0, 0, 2, 1, "EPSG:4326", "deg"), "reproject"),
    ],
)
def test_bad_surfaces_are_refused(data, extent, message):
    with pytest.raises(ValueError, match=message):
        route(Elevation(np.array(data, np.float32), extent), "fill", Context())


@settings(max_examples=20)
@given(surfaces(void=False))
def test_filling_twice_changes_nothing(surface):
    once = route(surface, "fill", Context())
    again = route(surface.like(once.lattice.inner(once.height).copy()), "fill", Context())
    np.testing.assert_array_equal(again.height, once.height)
    np.testing.assert_array_equal(again.receiver, once.receiver)
