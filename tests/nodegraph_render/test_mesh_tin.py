"""Greedy insertion: Delaunay, frugal, within its budget, the same on a device."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph_render.delaunay import Delaunay
from nodegraph_render.mesh_tin import mesh_tin
from nodegraph_render.triangle_scan import Scan, owned_edges, spans
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.sample_dem import sample_dem

sys.path.insert(0, str(Path(__file__).parent))  # tests are no package
from meshes import check_surface, raster


def jacksboro() -> Elevation:
    return raster(sample_dem().data)


def in_circle(a, b, c, p) -> int:
    """Positive where p is inside the circle through a, b, c (counter-clockwise), in Python's whole numbers."""
    rows = [(q[0] - p[0], q[1] - p[1]) for q in (a, b, c)]
    (ax, ay), (bx, by), (cx, cy) = rows
    return (
        (ax * ax + ay * ay) * (bx * cy - by * cx)
        - (bx * bx + by * by) * (ax * cy - ay * cx)
        + (cx * cx + cy * cy) * (ax * by - ay * bx)
    )


@settings(max_examples=50)
@given(cols=st.integers(2, 14), rows=st.integers(2, 14), data=st.data())
def test_every_circle_is_empty_and_every_point_a_vertex(cols, rows, data):
    wanted = set(data.draw(st.lists(st.tuples(st.integers(0, cols - 1), st.integers(0, rows - 1)), max_size=40)))
    corners = set(itertools.product((0, cols - 1), (0, rows - 1)))
    left = wanted - corners
    mesh = Delaunay(cols, rows)
    while left:
        alive = np.flatnonzero(mesh.alive())
        x, y = mesh.corners(alive)
        runs = spans(x, y, owned_edges(x, y, (rows, cols)))
        given_to: dict[int, tuple[int, int]] = {}
        for triangle, row, first, last in zip(*(part.tolist() for part in runs), strict=True):
            for column in range(first, last + 1):
                if (column, row) in left:
                    given_to[triangle] = (column, row)
        assert given_to, "a sample that no triangle owns"
        points = np.array(list(given_to.values()))
        mesh.insert(alive[list(given_to)], points[:, 0], points[:, 1])
        left -= set(given_to.values())
    x, y = mesh.corners(mesh.alive())
    triangles = [[(int(i), int(j)) for i, j in zip(*pair, strict=True)] for pair in zip(x, y, strict=True)]
    points_left = wanted | corners
    assert {point for triangle in triangles for point in triangle} == points_left
    area = 0
    for a, b, c in triangles:
        twice = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        assert twice > 0
        area += twice
        assert all(in_circle(a, b, c, p) <= 0 for p in points_left)
    assert area == 2 * (cols - 1) * (rows - 1)


@given(st.lists(st.tuples(st.integers(0, 20), st.integers(0, 20)), min_size=3, max_size=3, unique=True))
def test_spans_hold_the_samples_inside(points):
    (ax, ay), (bx, by), (cx, cy) = points
    twice = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if twice < 0:
        (bx, by), (cx, cy) = (cx, cy), (bx, by)
    x, y = np.array([[ax, bx, cx]]), np.array([[ay, by, cy]])
    found = {
        (column, row)
        for _, row, first, last in zip(*(part.tolist() for part in spans(x, y)), strict=True)
        for column in range(first, last + 1)
    }
    if twice:
        cycle = [(ax, ay), (bx, by), (cx, cy), (ax, ay)]
        expected = {
            (i, j)
            for i in range(21)
            for j in range(21)
            if all((q[0] - p[0]) * (j - p[1]) >= (q[1] - p[1]) * (i - p[0]) for p, q in itertools.pairwise(cycle))
        }
        assert found == expected


def test_no_more_triangles_than_the_best_greedy_library():
    pydelatin = pytest.importorskip("pydelatin")
    surface = jacksboro()
    for share in (0.02, 0.05, 0.1):
        error = share * float(np.ptp(surface.data))
        theirs = len(pydelatin.Delatin(surface.data, max_error=error).triangles)
        assert len(mesh_tin(surface, error=error).triangles) <= 1.2 * theirs


@pytest.mark.parametrize("budget", [2, 3, 50, 501, 5000])
def test_a_budget_is_kept_and_what_is_left_is_told(budget, caplog):
    surface = jacksboro()
    mesh = mesh_tin(surface, error=None, max_triangles=budget)
    assert budget * (0.85 if budget > 500 else 0.3) < len(mesh.triangles) <= budget
    assert not caplog.records
    tight = mesh_tin(surface, error=1.0, max_triangles=budget)
    assert tight.error > 1.0
    assert f"{len(tight.triangles)} triangles leave an error" in caplog.text
    if budget <= 501:
        check_surface(mesh, surface, mesh.error)


def test_a_larger_budget_leaves_a_smaller_error():
    surface = jacksboro()
    errors = [mesh_tin(surface, error=None, max_triangles=budget).error for budget in (100, 1000, 10_000)]
    assert errors == sorted(errors, reverse=True)
    assert errors[2] < errors[0] / 3


def test_an_error_that_is_met_needs_no_budget():
    surface = jacksboro()
    free = mesh_tin(surface, error=60.0)
    bound = mesh_tin(surface, error=60.0, max_triangles=len(free.triangles) + 10)
    assert len(bound.triangles) <= len(free.triangles) + 10
    assert bound.error <= 60.0


def test_a_budget_buys_about_the_least_error():
    pydelatin = pytest.importorskip("pydelatin")
    surface = jacksboro()
    mesh = mesh_tin(surface, error=None, max_triangles=5000)
    theirs = pydelatin.Delatin(surface.data, max_error=mesh.error)
    assert len(theirs.triangles) > 5000 / 1.2


def test_voids_that_do_not_fit_the_budget_are_refused():
    heights = np.zeros((40, 40), np.float32)
    heights[5:30, 5:30:2] = np.nan
    with pytest.raises(ValueError, match="too small for the rims"):
        mesh_tin(raster(heights), error=1.0, max_triangles=20)


def test_something_must_be_stated():
    with pytest.raises(ValueError, match="state an error"):
        mesh_tin(jacksboro(), error=None)


def test_a_raster_that_is_too_long_is_refused():
    with pytest.raises(ValueError, match="28,000"):
        mesh_tin(Elevation(np.zeros((2, 28_001), np.float32), Extent(0, 0, 28_001, 2)))


def test_a_device_measures_the_same_to_the_last_bit():
    from nodegraph.opencl import choose

    device = choose("auto")
    if device is None:
        pytest.skip("there is no OpenCL device here")
    dice = np.random.default_rng(3)
    heights = dice.normal(0, 50, (90, 70)).astype(np.float32)
    heights[20:30, 10:15] = np.nan
    least = np.where(dice.random(heights.shape) < 0.02, np.float32(40), np.float32(0))
    host, other = Scan(heights, Context()), Scan(heights, Context(device=device))
    corners = dice.integers(0, (70, 90), (400, 3, 2))
    x, y = corners[..., 0].copy(), corners[..., 1].copy()
    turned = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) < (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    x[turned], y[turned] = x[turned][:, ::-1], y[turned][:, ::-1]
    kept = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) != (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    x, y = x[kept], y[kept]
    for options in (
        {"least": least},
        {"least": least, "inclusive": owned_edges(x, y, heights.shape)},
        {"least": least, "stride": dice.integers(1, 6, len(x))},
    ):
        ours, theirs = host.worst(x, y, **options), other.worst(x, y, **options)
        assert np.array_equal(ours.error, theirs.error)
        assert np.array_equal(ours.cell, theirs.cell)
