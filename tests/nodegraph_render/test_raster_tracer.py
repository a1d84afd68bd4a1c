"""Rays and rasters: nothing is missed, all ways of computing agree, and the odd cases come out right."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph.errors import Cancelled
from nodegraph.opencl import choose
from nodegraph_render import raster_tracer as module
from nodegraph_render.camera import Camera
from nodegraph_render.raster_tracer import raster_tracer
from nodegraph_render.rays import Hits, Rays
from nodegraph_terrain.gradient import horn_gradient
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.sample_dem import sample_dem

CELL = (10.0, 7.0)
WEST, NORTH = 650_000.0, 5_200_000.0
"""Corner of the raster, as far from the origin as coordinates of UTM are."""


def raster(heights: Any, cell: tuple[float, float] = CELL) -> Elevation:
    data = np.asarray(heights, np.float32)
    rows, cols = data.shape
    return Elevation(data, Extent(WEST, NORTH - rows * cell[1], WEST + cols * cell[0], NORTH))


def thin_ridges(seed: int, shape: tuple[int, int] = (40, 48), voids: float = 0.0) -> Elevation:
    """Hills with walls and spikes a single cell wide."""
    rng = np.random.default_rng(seed)
    rows, cols = np.indices(shape)
    data = 30 * np.sin(rows / 6 + seed) * np.cos(cols / 8) + rng.normal(0, 1, shape)
    data[rng.integers(shape[0])] += 60
    data[:, rng.integers(shape[1])] += 45
    along = np.arange(min(shape))
    data[along, along] += 50
    data[rng.random(shape) < 0.005] += 120
    data[rng.random(shape) < voids] = np.nan
    return raster(1500 + data)


def position(surface: Elevation, points: np.ndarray) -> np.ndarray:
    """Points as columns and rows, counted from the centre of the first cell, and heights."""
    dx, dy = surface.cell_size
    corner = (surface.extent.west + dx / 2, surface.extent.north - dy / 2, 0)
    return (points - corner) * (1 / dx, -1 / dy, 1)


def height_above(surface: Elevation, points: np.ndarray) -> np.ndarray:
    """How far points are above the ground; infinite where there is none."""
    (rows, cols), (x, y, z) = surface.shape, position(surface, points).T
    column, row = (np.clip(np.floor(value).astype(int), 0, n - 2) for value, n in ((x, cols), (y, rows)))
    u, v = x - column, y - row
    outside = (u < 0) | (u > 1) | (v < 0) | (v > 1)
    data = surface.data.astype(np.float64)
    north = data[row, column] * (1 - u) + data[row, column + 1] * u
    south = data[row + 1, column] * (1 - u) + data[row + 1, column + 1] * u
    ground = north * (1 - v) + south * v
    return np.where(outside | np.isnan(ground), np.inf, z - ground)


def height_nearby(surface: Elevation, points: np.ndarray) -> np.ndarray:
    """How far points are above the ground, or above that of a neighbour where they are on the border of a quad."""
    nudges = [np.array([x, y, 0]) for x in (-1e-3, 1e-3) for y in (-1e-3, 1e-3)]
    return np.min([height_above(surface, points + nudge) for nudge in nudges], axis=0)


def deepest(surface: Elevation, rays: Rays, depth: np.ndarray, per_cell: int = 16) -> np.ndarray:
    """How deep rays get into the ground before `depth`, looking `per_cell` times in each cell that they cross.

    Ground less than 1e-3 cells behind a wall does not count: float32 cannot tell it from the air in front.
    """
    # All ground that there is, and 60 m of what is solid below.
    low = np.array([0, 0, np.nanmin(surface.data) - 60])
    high = np.array([*np.array(surface.shape[::-1]) - 1, np.nanmax(surface.data)])
    scale = (1 / CELL[0], -1 / CELL[1], 1)
    origin, direction = position(surface, rays.origin), rays.direction * scale
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origin) / direction, (high - origin) / direction
    enter = np.fmax(np.fmin(a, b).max(axis=1), 0)
    leave = np.minimum(np.fmax(a, b).min(axis=1), depth)
    enter, leave = np.where(enter < leave, (enter, leave), 0.0)
    crossed = (leave - enter) * (np.abs(direction) @ (1, 1, 1 / CELL[1])) * per_cell
    worst = np.full(len(depth), -np.inf)
    for step in range(int(crossed.max()) + 1):
        live = np.flatnonzero((crossed > 0) & (step <= crossed))
        t = enter[live] + (leave - enter)[live] * np.minimum(step / np.maximum(crossed[live], 1), 1)
        points = rays.origin[live] + rays.direction[live] * t[:, None]
        deep = -height_above(surface, points)
        under = deep > 0
        aside = [points[under] + 1e-3 * CELL[1] * np.array([*way, 0]) for way in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        deep[under] = np.minimum(deep[under], np.min([-height_above(surface, point) for point in aside], axis=0))
        worst[live] = np.maximum(worst[live], deep)
    return worst


def mixed_rays(surface: Elevation, count: int, seed: int) -> Rays:
    """Rays from above, from the sides, from below, along the ground, along axes and straight up and down."""
    rng = np.random.default_rng(seed)
    box = surface.extent
    low, high = float(np.nanmin(surface.data)), float(np.nanmax(surface.data))

    def within(grow: float, bottom: float, top: float) -> np.ndarray:
        x = rng.uniform(box.west - grow * box.width, box.east + grow * box.width, count)
        y = rng.uniform(box.south - grow * box.height, box.north + grow * box.height, count)
        return np.stack([x, y, rng.uniform(bottom, top, count)], 1)

    kind = rng.integers(0, 5, count)
    origin = within(1, low - 50, high + 300)
    direction = within(0, low, high) - origin
    level = rng.normal(size=(count, 3)) * (1, 1, 0.02)
    inside = within(0, 0, 0)
    above = height_above(surface, inside)
    inside[:, 2] = np.where(np.isfinite(above), -above, low) + rng.exponential(3, count)
    origin[kind == 1], direction[kind == 1] = inside[kind == 1], level[kind == 1]
    # Through centres of cells, along rows, columns or the vertical.
    aligned = np.round(position(surface, within(0.3, low, high)))
    aligned *= (CELL[0], -CELL[1], 1)
    aligned += (box.west + CELL[0] / 2, box.north - CELL[1] / 2, 0.3)
    axes = np.concatenate([np.eye(3), -np.eye(3)])[rng.integers(0, 6, count)]
    origin[kind == 2], direction[kind == 2] = aligned[kind == 2], axes[kind == 2]
    diagonal = np.sign(rng.normal(size=(count, 3))) * (*CELL, 2)
    origin[kind == 3], direction[kind == 3] = aligned[kind == 3], diagonal[kind == 3]
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return Rays(origin, direction, np.where(rng.random(count) < 0.2, rng.uniform(0, 500, count), np.inf))


@pytest.fixture(scope="module")
def device() -> Any:
    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


@pytest.fixture(params=["host", "device"])
def any_device(request: pytest.FixtureRequest) -> Any:
    return None if request.param == "host" else request.getfixturevalue("device")


def follow(surface: Elevation, rays: Rays, device: Any = None, **options: Any) -> Hits:
    return raster_tracer(surface, device, Context(), **options)(rays)


def one(surface: Elevation, origin: Any, direction: Any, device: Any = None, **options: Any) -> tuple[float, Any, int]:
    """Depth, normal and layer of one ray, given in cells from the centre of the first cell and metres."""
    dx, dy = surface.cell_size
    start = np.array(origin) * (dx, -dy, 1) + (surface.extent.west + dx / 2, surface.extent.north - dy / 2, 0)
    unit = np.array(direction, float) / np.linalg.norm(direction)
    hits = follow(surface, Rays(start[None], unit[None]), device, **options)
    return float(hits.depth[0]), hits.normal[0], int(hits.layer[0])


def lifted(rays: Rays, by: float) -> Rays:
    return replace(rays, origin=rays.origin + np.array([0, 0, by]))


def assert_between(early: Hits, hits: Hits, late: Hits, tolerance: float, exempt: float = 0.0) -> None:
    """The ground is solid below: a ray that starts lower hits no later, and one that starts higher no earlier."""
    wrong = (hits.depth < early.depth - tolerance) | (hits.depth > late.depth + tolerance)
    assert wrong.mean() <= exempt, f"{wrong.sum()} of {len(wrong)}, first {np.flatnonzero(wrong)[:5]}"


def assert_nothing_missed(surface: Elevation, rays: Rays, hits: Hits, epsilon: float) -> None:
    end = np.minimum(hits.depth.astype(np.float64), rays.reach)
    assert (hits.depth[hits.layer == 0] <= np.broadcast_to(rays.reach, end.shape)[hits.layer == 0]).all()
    assert np.array_equal(hits.layer == 0, np.isfinite(hits.depth))
    # On a path up to `epsilon` below the surface a ray may be, but no deeper.
    steep = np.abs(rays.direction[:, 2]) + 30 * np.hypot(*rays.direction[:, :2].T)
    assert deepest(surface, rays, end - epsilon / steep).max() <= epsilon
    hit = (hits.layer == 0) & (hits.depth > 0)
    wall = hit & (hits.normal[:, 2] == 0)
    points = rays.at(np.where(hit, hits.depth, 0))
    on = hit & ~wall
    # float32 depth of a ray that may come from a kilometre away.
    assert np.abs(height_above(surface, points[on])).max() <= 30 * epsilon
    assert (height_nearby(surface, points[wall]) <= epsilon).all()
    lengths = np.linalg.norm(hits.normal, axis=1)
    np.testing.assert_allclose(lengths, np.isfinite(hits.depth), atol=1e-5)
    assert (hits.normal[:, 2] >= 0).all()


@pytest.mark.parametrize("voids", [0.0, 0.03])
def test_nothing_is_missed(any_device: Any, voids: float) -> None:
    surface = thin_ridges(3, voids=voids)
    rays = mixed_rays(surface, 4000, 1)
    assert_nothing_missed(surface, rays, follow(surface, rays, any_device), 1e-3 * CELL[1])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_nothing_is_missed_by_two_million_rays(device: Any, seed: int) -> None:
    surface = thin_ridges(seed, (30, 34), voids=0.01 * (seed % 3))
    for part in range(20):
        rays = mixed_rays(surface, 10_000, 100 * seed + part)
        assert_nothing_missed(surface, rays, follow(surface, rays, device), 1e-3 * CELL[1])


@pytest.mark.parametrize("voids", [0.0, 0.03])
@pytest.mark.parametrize("method", ["accelerated", "plain"])
def test_device_agrees_with_numpy(device: Any, voids: float, method: Any) -> None:
    surface = thin_ridges(5, voids=voids)
    rays = mixed_rays(surface, 8000, 2)
    near = 1e-3 * CELL[1]
    early, host, late = (follow(surface, lifted(rays, by), method=method) for by in (-near, 0, near))
    hits = follow(surface, rays, device, method=method)
    # Along a wall or past its edge, less than float32 tells decides.
    assert_between(early, hits, late, near, exempt=5e-4)
    same = np.isclose(hits.depth, host.depth, rtol=0, atol=near)
    assert same.mean() > 0.998
    normal = np.abs(hits.normal - host.normal).max(axis=1)
    assert (normal[same] < 2e-2).mean() > 0.995
    assert np.median(normal[same]) < 1e-5
    assert abs(hits.steps.mean() / host.steps.mean() - 1) < 0.01


def test_one_ray_or_many_in_a_vector(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    surface = thin_ridges(6, voids=0.02)
    rays = mixed_rays(surface, 5003, 3)
    results = []
    for lanes in (1, 8, 16):
        monkeypatch.setattr(module, "lanes_of", lambda device, lanes=lanes: lanes)
        results.append(follow(surface, rays, device))
    for other in results[1:]:
        np.testing.assert_allclose(other.depth, results[0].depth, rtol=1e-5, atol=1e-3)
        np.testing.assert_array_equal(other.steps, results[0].steps)
        np.testing.assert_allclose(other.normal, results[0].normal, atol=1e-3)


@pytest.mark.parametrize("voids", [0.0, 0.03])
def test_sphere_tracing_agrees(any_device: Any, voids: float) -> None:
    surface = thin_ridges(7, voids=voids)
    rays = mixed_rays(surface, 4000, 4)
    epsilon = 0.02
    exact = follow(surface, rays, any_device)
    marched = follow(surface, rays, any_device, method="plain", epsilon=epsilon)
    # It stops up to epsilon above the ground, and comes up to a tenth of that late to a wall of a void.
    early = follow(surface, lifted(rays, -1.01 * epsilon), any_device)
    assert_between(early, marched, exact, 0.3 * epsilon, exempt=5e-4)


def test_steps_are_at_most_half_of_those_of_sphere_tracing(any_device: Any) -> None:
    surface = raster(sample_dem().data[:200, :200], (74, 92))
    centre = (surface.extent.west + surface.extent.east) / 2, (surface.extent.south + surface.extent.north) / 2
    # Straight down sphere tracing needs six steps, and nine at most: of so few an odd one counts.
    for eye, worst in (
        ((*centre, 1500.0), 0.5),
        ((centre[0], surface.extent.south - 3000, 3000.0), 0.5),
        ((*centre, 20_000.0), 0.6),
    ):
        target = (centre[0] + 10, centre[1] + 2000, 400.0)
        rays = Camera(eye, target, field_of_view=30).rays(48, 64)
        fast, slow = (follow(surface, rays, any_device, method=name) for name in ("accelerated", "plain"))
        assert fast.steps.mean() <= slow.steps.mean() / 2
        assert np.percentile(fast.steps, 99) <= np.percentile(slow.steps, 99) * worst


def test_embree_agrees(any_device: Any) -> None:
    rtcore_scene = pytest.importorskip("embreex.rtcore_scene")
    from embreex.mesh_construction import TriangleMesh

    surface = thin_ridges(8, (40, 40))
    # Bilinear quads as 12 by 12 pairs of triangles, which are off by no more than a quarter of their twist.
    fine = 12
    rows = cols = 39 * fine + 1
    x, y = np.meshgrid(np.arange(cols) / fine, np.arange(rows) / fine)
    dx, dy = CELL
    flat = np.stack([x * dx, -y * dy, np.zeros_like(x)], -1).reshape(-1, 3)
    corner = np.array([WEST + dx / 2, NORTH - dy / 2, 0])
    flat[:, 2] = -height_above(surface, flat + corner)
    nw = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)).reshape(-1, 1)
    faces = np.concatenate([nw + np.array([0, cols, 1]), nw + np.array([1, cols, cols + 1])])
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, flat[faces].astype(np.float32))
    centre = (WEST + 20 * dx, NORTH - 20 * dy)
    rays = Camera((centre[0] - 260, centre[1] - 200, 1850.0), (*centre, 1500.0), field_of_view=50).rays(120, 160)
    origin = np.broadcast_to(rays.origin - corner, rays.direction.shape).astype(np.float32)
    found = scene.run(origin, rays.direction.astype(np.float32), output=True)
    depth = np.where(found["primID"] >= 0, found["tfar"], np.inf)
    data = surface.data.astype(np.float64)
    off = np.abs(np.diff(np.diff(data, axis=0), axis=1)).max() / 4 / fine**2 + 1e-3
    early, exact, late = (follow(surface, lifted(rays, by), any_device) for by in (-off, 0, off))
    # The mesh has no walls and no inside.
    seen = (exact.normal[:, 2] > 0) & (early.normal[:, 2] > 0) | (early.layer < 0)
    assert seen.mean() > 0.5
    assert (depth[seen] < np.inf).mean() > 0.3
    wrong = seen & ((depth < early.depth - 0.01) | (depth > late.depth + 0.01))
    assert not wrong.any()


@given(
    heights=st.lists(st.sampled_from([0.0, 1.0, 2.0, 5.0, np.nan]), min_size=12, max_size=12),
    shape=st.sampled_from([(3, 4), (4, 3), (2, 6), (6, 2)]),
    start=st.tuples(*[st.integers(-4, 12)] * 2, st.integers(-2, 14)),
    towards=st.tuples(*[st.integers(-3, 3)] * 3).filter(any),
)
def test_small_rasters_against_small_steps(heights: Any, shape: Any, start: Any, towards: Any) -> None:
    surface = raster(np.reshape(heights, shape))
    origin = np.array(start) / (2, 2, 2) * (CELL[0], -CELL[1], 1) + (WEST + CELL[0] / 2, NORTH - CELL[1] / 2, 0)
    direction = np.array(towards) * (CELL[0], -CELL[1], 1)
    rays = Rays(origin[None], (direction / np.linalg.norm(direction))[None])
    hits = follow(surface, rays)
    if np.isnan(surface.data).all():
        assert hits.layer[0] == -1
        return
    assert deepest(surface, rays, hits.depth.astype(np.float64) - 1e-3, 64)[0] <= 1e-6
    if hits.layer[0] == 0:
        assert height_nearby(surface, rays.at(hits.depth))[0] <= 2e-3


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (3, 4), (2, 2)])
def test_no_ground_is_no_hit(any_device: Any, shape: tuple[int, int]) -> None:
    surface = raster(np.full(shape, 3.0 if 1 in shape else np.nan))
    for method in ("accelerated", "plain"):
        for direction in ((0, 0, -1), (1, 0.1, -0.2), (0, 0, 1)):
            depth, normal, layer = one(surface, (0.2, 0.3, 10), direction, any_device, method=method)
            assert (depth, layer) == (np.inf, -1)
            assert not normal.any()


@given(
    level=st.floats(-100, 4000),
    shape=st.tuples(st.integers(2, 9), st.integers(2, 9)),
    x=st.floats(-3, 12),
    y=st.floats(-3, 12),
    direction=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, -0.05)),
)
def test_level_ground(level: float, shape: tuple[int, int], x: float, y: float, direction: Any) -> None:
    surface = raster(np.full(shape, level))
    level = float(surface.data[0, 0])
    unit = np.array(direction) / np.linalg.norm(direction)
    expected = 20 / -unit[2]
    at = np.array([x, y]) + expected * unit[:2] / (CELL[0], -CELL[1])
    beyond = np.minimum(at, np.array(shape[::-1]) - 1 - at).min()
    if abs(beyond) < 1e-6:
        return
    depth, normal, _ = one(surface, (x, y, level + 20), direction)
    if beyond > 0:
        assert depth == pytest.approx(expected, rel=1e-5)
        np.testing.assert_allclose(normal, (0, 0, 1), atol=1e-6)
    else:
        assert depth == np.inf or (depth > expected and normal[2] == 0)


def test_planes_have_their_normals(any_device: Any) -> None:
    rows, cols = np.indices((9, 11))
    surface = raster(100 + 4.0 * cols - 2.0 * rows)
    expected = np.array([-0.4, -2 / 7, 1])
    expected /= np.linalg.norm(expected)
    for smooth in (True, False):
        depth, normal, _ = one(surface, (5.3, 4.6, 1000), (0, 0, -1), any_device, smooth=smooth)
        assert depth == pytest.approx(1000 - (100 + 4 * 5.3 - 2 * 4.6), abs=1e-3)
        np.testing.assert_allclose(normal, expected, atol=1e-5)


def test_normals_of_facets_and_smooth_ones(any_device: Any) -> None:
    surface = thin_ridges(9)
    rng = np.random.default_rng(0)
    at = rng.uniform((1, 1), (46, 38), (300, 2))
    at[:50] = np.round(at[:50])
    points = np.column_stack([WEST + (at[:, 0] + 0.5) * CELL[0], NORTH - (at[:, 1] + 0.5) * CELL[1], np.full(300, 3e3)])
    rays = Rays(points, np.array([[0.0, 0.0, -1.0]]))
    facets = follow(surface, rays, any_device, smooth=False).normal[50:]
    step = 1e-3
    slope = [
        (height_above(surface, points - move) - height_above(surface, points + move)) / (2 * step)
        for move in (np.array([step, 0, 0]), np.array([0, step, 0]))
    ]
    expected = np.column_stack([-slope[0], -slope[1], np.ones(300)])[50:]
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    np.testing.assert_allclose(facets, expected, atol=5e-3)
    smooth = follow(surface, rays, any_device).normal[:50]
    east, north = horn_gradient(surface.data, slice(None), CELL)
    column, row = at[:50].astype(int).T
    horn = np.column_stack([-east[row, column], -north[row, column], np.ones(50)])
    horn /= np.linalg.norm(horn, axis=1)[:, None]
    np.testing.assert_allclose(smooth, horn, atol=2e-3)


@pytest.mark.parametrize("method", ["accelerated", "plain"])
@pytest.mark.parametrize(
    ("origin", "direction", "depth", "normal"),
    [
        ((-2, 2, 5), (1, 0, 0), 20, (-1, 0, 0)),
        ((8, 2, 5), (-1, 0, 0), 30, (1, 0, 0)),
        ((2, -1, 5), (0, -1, 0), 7, (0, 1, 0)),
        ((2, 8, 5), (0, 1, 0), 28, (0, -1, 0)),
        ((2, 2, 5), (1, 0, 0), 0, (0, 0, 1)),
        ((2, 2, 10), (0, 0, 1), 0, (0, 0, 1)),
        ((2, 2, -1000), (0, 0, 1), 0, (0, 0, 1)),
        ((2, 2, 11), (0, 0, 1), np.inf, (0, 0, 0)),
        ((2, 2, 11), (0, 0, -1), 1, (0, 0, 1)),
        ((5, 4, 12), (0, 0, -1), 2, (0, 0, 1)),
        ((2, 2, 11), (1, 0, 0), np.inf, (0, 0, 0)),
        ((-2, 2, -3000), (1, 0, 0), 20, (-1, 0, 0)),
        ((-2, 2, -3000), (0, 0, 1), np.inf, (0, 0, 0)),
        ((-2, 2, 3000), (0, 0, -1), np.inf, (0, 0, 0)),
        ((-2, 2, 5), (-1, 0, 0), np.inf, (0, 0, 0)),
    ],
)
def test_walls_and_insides(
    any_device: Any, method: Any, origin: Any, direction: Any, depth: float, normal: Any
) -> None:
    found = one(raster(np.full((5, 6), 10.0)), origin, direction, any_device, method=method)
    assert found[0] == pytest.approx(depth, abs=0.01)
    np.testing.assert_allclose(found[1], normal, atol=1e-6)


@pytest.mark.parametrize("method", ["accelerated", "plain"])
def test_voids_have_walls(any_device: Any, method: Any) -> None:
    data = np.full((9, 9), 10.0)
    data[4, 4] = np.nan
    # The quads around the void cell are no ground: a hole from 3 to 5 in both axes.
    surface = raster(data)
    for origin, direction, depth, normal in (
        ((4, 4, 5), (1, 0, 0), CELL[0], (-1, 0, 0)),
        ((4, 4, 5), (-1, 0, 0), CELL[0], (1, 0, 0)),
        ((4, 4, 5), (0, 1, 0), CELL[1], (0, -1, 0)),
        ((4.5, 4.2, -500), (0, -1, 0), 0.8 * CELL[1], (0, 1, 0)),
        ((4, 4, 20), (0, 0, -1), np.inf, (0, 0, 0)),
        ((4, 4, -5), (0, 0, 1), np.inf, (0, 0, 0)),
        ((3.5, 2, 18), (0, -CELL[1], -5), 3 * np.hypot(CELL[1], 5), (0, 1, 0)),
        ((2.5, 4, 5), (1, 0, 0), 0, (0, 0, 1)),
    ):
        found = one(surface, origin, direction, any_device, method=method)
        assert found[0] == pytest.approx(depth, abs=0.01)
        np.testing.assert_allclose(found[1], normal, atol=0.01)


def test_reach_ends_rays(any_device: Any) -> None:
    surface = thin_ridges(10)
    rays = replace(mixed_rays(surface, 2000, 5), reach=np.inf)
    free = follow(surface, rays, any_device)
    reach = np.random.default_rng(1).uniform(0, 600, 2000)
    held = follow(surface, replace(rays, reach=reach), any_device)
    clear = np.abs(free.depth - reach) > 1e-3
    expected = np.where(free.depth <= reach, free.depth, np.inf)
    np.testing.assert_allclose(held.depth[clear], expected[clear], rtol=1e-6)
    assert follow(surface, replace(rays, reach=0.0), any_device).depth[free.depth > 0].min() == np.inf


def test_shared_origins_and_directions(any_device: Any) -> None:
    surface = thin_ridges(11)
    rays = Camera((WEST, NORTH, 1700.0), (WEST + 200, NORTH - 150, 1500.0)).rays(20, 30)
    many = Rays(np.repeat(rays.origin, 600, axis=0), rays.direction, np.full(600, np.inf))
    for a, b in zip(follow(surface, rays, any_device), follow(surface, many, any_device), strict=True):
        np.testing.assert_array_equal(a, b)
    parallel = Camera((WEST, NORTH, 1700.0), (WEST + 200, NORTH - 150, 1500.0), field_of_view=0, span=300).rays(20, 30)
    many = Rays(parallel.origin, np.repeat(parallel.direction, 600, axis=0))
    for a, b in zip(follow(surface, parallel, any_device), follow(surface, many, any_device), strict=True):
        np.testing.assert_array_equal(a, b)
    none = follow(surface, Rays(np.zeros((0, 3)), np.array([[0.0, 0.0, 1.0]])), any_device)
    assert [item.shape for item in none] == [(0,), (0, 3), (0,), (0,)]


def test_large_coordinates_cost_nothing(device: Any) -> None:
    near = thin_ridges(12)
    box = near.extent
    far = Elevation(near.data, Extent(box.west + 2**22, box.south + 2**24, box.east + 2**22, box.north + 2**24))
    rays = mixed_rays(near, 5000, 6)
    moved = replace(rays, origin=rays.origin + np.array([2**22, 2**24, 0]))
    a, b = follow(near, rays, device), follow(far, moved, device)
    close = np.isclose(a.depth, b.depth, rtol=0, atol=0.01)
    assert close.mean() > 0.999


def test_more_rays_than_a_band(any_device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    surface = thin_ridges(13)
    rays = mixed_rays(surface, 2500, 7)
    whole = follow(surface, rays, any_device)
    monkeypatch.setattr(module, "BAND", 512)
    for a, b in zip(whole, follow(surface, rays, any_device), strict=True):
        np.testing.assert_array_equal(a, b)


def test_cancelling(any_device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "BAND", 256)
    cancelled, calls = threading.Event(), []

    def report(fraction: float | None, message: str) -> None:
        calls.append(fraction)
        if len(calls) == started + 3:
            cancelled.set()

    started = 10**9
    surface = thin_ridges(14)
    tracer = raster_tracer(surface, any_device, Context(cancelled=cancelled, report=report))
    started = len(calls)
    with pytest.raises(Cancelled):
        tracer(mixed_rays(surface, 4096, 8))
    assert len(calls) == started + 3


def test_refusals(any_device: Any) -> None:
    surface = thin_ridges(15)
    with pytest.raises(ValueError, match="in degrees"):
        raster_tracer(sample_dem(), any_device, Context())
    with pytest.raises(ValueError, match="epsilon is 0 m"):
        raster_tracer(surface, any_device, Context(), epsilon=0.0)
    broken = surface.data.copy()
    broken[3, 4] = np.inf
    with pytest.raises(ValueError, match="infinite heights"):
        raster_tracer(surface.like(broken), any_device, Context())
    for rays in (
        Rays(np.array([[np.nan, 0, 0]]), np.array([[0.0, 0.0, 1.0]])),
        Rays(np.zeros((1, 3)), np.array([[0.0, np.inf, 1.0]])),
        Rays(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.nan),
    ):
        with pytest.raises(ValueError, match="no numbers"):
            follow(surface, rays, any_device)


def test_kernel_file_is_named_where_fingerprints_look() -> None:
    assert Path(module.__file__).parent / "kernels" / "raster.cl" == module.KERNELS
    assert module.KERNELS.is_file()
