"""Rays never pass through a construction tree, however it is followed and wherever it is computed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph_render.camera import Camera
from nodegraph_render.outlook import outlook
from nodegraph_render.quadtree import build
from nodegraph_render.rays import SKY, Hits, Rays
from nodegraph_render.tracers import Method
from nodegraph_render.tree_tracer import EPSILON, Epsilon, tree_tracer
from nodegraph_tree.basic import Constant, Plane
from nodegraph_tree.blend import blend
from nodegraph_tree.carve import Carve
from nodegraph_tree.curve import curve
from nodegraph_tree.disc import Disc, Relief
from nodegraph_tree.function import THRESHOLD, Box, ElevationFunction, Points
from nodegraph_tree.landform import crater, mesa
from nodegraph_tree.replace import Replace
from nodegraph_tree.ridge import ridge
from nodegraph_tree.twist import twist
from tests.nodegraph_tree.strategies import CENTRE, trees

SQUARE = (CENTRE[0] - 800, CENTRE[1] - 800, CENTRE[0] + 800, CENTRE[1] + 800)


@pytest.fixture(scope="module")
def device() -> Any:
    from nodegraph.opencl import choose

    found = choose("auto")
    assert found is not None
    return found


def follow(
    function: ElevationFunction,
    rays: Rays,
    device: Any = None,
    method: Method = "accelerated",
    camera: Camera | None = None,
    extent: Any = None,
    epsilon: Epsilon = EPSILON,
    leaf: float = 220.0,
) -> Hits:
    camera = camera or Camera((CENTRE[0] - 1500.0, CENTRE[1] - 1200.0, 1500.0), (*CENTRE, 0.0))
    if extent is None:
        tree = outlook(function, camera, None, None, Context())
    else:  # by default few large boxes, which are quickly bounded
        region = function.support.intersection(Box(*extent))
        tree = build(function, region, lambda _: leaf, lambda _: 1.0, Context())
    return tree_tracer(function, tree, camera.eye, device, Context(), method=method, epsilon=epsilon)(rays)


def within(rays: Rays, until: npt.NDArray[Any], extent: Any, top: float) -> tuple[Any, Any]:
    """Return from where to where, m, rays are over an extent and not above all terrain; less than nothing elsewhere."""
    west, south, east, north = extent
    low, high = np.array([west, south, -np.inf]), np.array([east, north, top])
    origin, direction = rays.origin, rays.direction
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (low - origin) / direction, (high - origin) / direction
    level, outside = direction == 0, (origin < low) | (origin > high)
    enter = np.where(level, np.where(outside, np.inf, -np.inf), np.minimum(first, second))
    leave = np.where(level, np.inf, np.maximum(first, second))
    return np.maximum(enter.max(axis=1), 0), np.minimum(leave.min(axis=1), until)


def deepest(
    function: ElevationFunction, rays: Rays, until: npt.NDArray[Any], points: int, extent: Any
) -> npt.NDArray[np.float64]:
    """Return how deep below the terrain each ray comes before `until`, m: the reference, marching in small steps.

    All points are spent where there may be terrain, at even distances from a random first one.  A ray may be epsilon
    metres inside a wall, at the border of the extent for example.
    """
    start, end = within(rays, until - EPSILON.at(until), extent, function.bounds(Box(*extent)).high)
    worst = np.full(len(rays), -np.inf)
    live = np.flatnonzero(start < end)
    origin, direction = (np.broadcast_to(item, (len(rays), 3))[live] for item in (rays.origin, rays.direction))
    step = (end - start)[live] / points
    first = start[live] + step * np.random.default_rng(len(rays)).random(len(live))
    for number in range(points):
        x, y, z = (origin + direction * (first + number * step)[:, None]).T
        found = function.query(Points(x, y))
        below = np.where(found.weight >= THRESHOLD, found.height - z, -np.inf)
        worst[live] = np.maximum(worst[live], below)
    return worst


def bundle(seed: int, count: int, top: float = 900.0, side: float = 700.0) -> Rays:
    """Rays from around and above a scene to points in it, grazing ones and vertical ones among them."""
    dice = np.random.default_rng(seed)
    around, far = dice.uniform(0, 2 * math.pi, count), dice.uniform(side, 2.5 * side, count)
    origin = np.stack([CENTRE[0] + far * np.cos(around), CENTRE[1] + far * np.sin(around)], 1)
    origin = np.column_stack([origin, dice.uniform(-200, top + 300, count)])
    target = np.column_stack([dice.uniform(-side, side, (count, 2)) + CENTRE, dice.uniform(-200, top, count)])
    grazing = dice.random(count) < 0.4
    target[grazing, 2] = origin[grazing, 2] + dice.uniform(-0.02, 0.02, grazing.sum()) * far[grazing]
    direction = target - origin
    upright = dice.random(count) < 0.05
    direction[upright] = [0, 0, -1]
    return Rays(origin, direction / np.linalg.norm(direction, axis=1)[:, None])


def check_nothing_is_passed(tree: ElevationFunction, seed: int) -> None:
    rays = bundle(seed, 60).within(4000.0)
    hits = follow(tree, rays, extent=SQUARE)
    until = np.where(hits.layer == SKY, 4000.0, hits.depth.astype(np.float64))
    deep = deepest(tree, rays, until, 200, SQUARE)
    # A ray that begins in the ground hits at once.
    assert np.all(deep[until > 0] <= EPSILON.at(until[until > 0]) + 0.01)


def check_what_is_hit_is_there(tree: ElevationFunction, seed: int) -> None:
    rays = bundle(seed, 60)
    hits = follow(tree, rays, extent=SQUARE)
    hit = (hits.layer != SKY) & (hits.depth > 0)
    # A little further on the ray, rounding cannot hide the ground.
    depth = hits.depth.astype(np.float64)[hit]
    limit = EPSILON.at(depth)
    origin, direction = (np.broadcast_to(item, (60, 3))[hit] for item in (rays.origin, rays.direction))
    place = origin + direction * depth[:, None]
    found = tree.query(Points(place[:, 0], place[:, 1]))
    near_edge = found.weight < THRESHOLD + 1e-3
    assert np.all((place[:, 2] - found.height <= 1.01 * limit + 1e-3) | near_edge)


def check_opencl_sees_the_same(device: Any, tree: ElevationFunction, seed: int) -> None:
    rays = bundle(seed, 64)
    host, there = follow(tree, rays, extent=SQUARE), follow(tree, rays, device, extent=SQUARE)
    same = host.layer == there.layer
    assert same.mean() >= 0.95  # a ray that grazes a crest within epsilon may go either way
    hit = same & (host.layer != SKY)
    off = np.abs(host.depth[hit] - there.depth[hit])
    assert not len(off) or np.quantile(off, 0.9, method="lower") <= 0.5


# Random trees, each with OpenCL programs and bounds of its own: most of the time goes into making those.


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(tree=trees(), seed=st.integers(0, 99))
def test_rays_stop_before_any_random_tree(tree: ElevationFunction, seed: int) -> None:
    check_nothing_is_passed(tree, seed)


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(tree=trees(), seed=st.integers(0, 99))
def test_what_is_hit_is_there(tree: ElevationFunction, seed: int) -> None:
    check_what_is_hit_is_there(tree, seed)


@pytest.mark.slow
@settings(max_examples=5, deadline=None)
@given(tree=trees(4), seed=st.integers(0, 99))
def test_opencl_sees_what_numpy_sees(device: Any, tree: ElevationFunction, seed: int) -> None:
    check_opencl_sees_the_same(device, tree, seed)


FLAT = Relief("none")
NOISY = Relief("ridged", 60.0, 300.0, 5, seed=3)
X, Y = CENTRE


def line(*points: tuple[float, float, float]) -> tuple[tuple[float, ...], ...]:
    return tuple([(X + x, Y + y, z) for x, y, z in points])


def scenes() -> dict[str, ElevationFunction]:
    ground = Plane(50.0 - 0.05 * X, 0.05, 0.0)
    wall = ridge(points=line((-600, -300, 300), (0, 80, 420), (600, -100, 250)), radius=25.0, drop=200.0, crest=0.5)
    hill = Disc(X + 100, Y - 50, 600.0, 200.0, NOISY)
    return {
        "plane": ground,
        "thin ridge": Replace(ground, (wall,)),
        "ridged hill": blend([Constant(0.0), hill]),
        "hill alone": Disc(X, Y, 500.0, 100.0, NOISY),
        "islands": blend([Disc(X - 300, Y, 200.0, 80.0, FLAT), Disc(X + 350, Y + 100, 150.0, 160.0, FLAT)]),
        "trench": Carve(ground, curve(points=line((-700, 0, -40), (700, 60, -60)), radius=40.0)),
        "crater": Replace(ground, (crater(centre=(X, Y), radius=400.0, height=20.0),)),
        "mesa": Replace(ground, (mesa(centre=(X + 50, Y), radius=300.0, height=400.0),)),
        "twisted ridge": twist(Replace(ground, (wall,)), centre=(X, Y), radius=500.0, angle=90.0),  # radians
        "needle": Replace(ground, (Disc(X + 20, Y + 30, 6.0, 500.0, FLAT),)),
    }


@pytest.mark.parametrize("name", ["thin ridge", "hill alone", "islands", "trench", "crater", "needle"])
def test_both_machines_see_what_there_is(device: Any, name: str) -> None:
    for seed in (1, 2):
        check_nothing_is_passed(scenes()[name], seed)
        check_what_is_hit_is_there(scenes()[name], seed)
    check_opencl_sees_the_same(device, scenes()[name], 3)


@pytest.mark.parametrize("name", scenes())
def test_accelerated_and_plain_see_the_same_in_fewer_steps(device: Any, name: str) -> None:
    function = scenes()[name]
    camera = Camera((X - 1200.0, Y - 1100.0, 700.0), (X, Y, 80.0))
    rays = camera.rays(36, 64)
    fast, slow = (follow(function, rays, device, method, camera, SQUARE) for method in ("accelerated", "plain"))
    assert np.mean(fast.layer == slow.layer) >= 0.998
    hit = (fast.layer != SKY) & (slow.layer != SKY)
    assert hit.any()
    # Both stop below epsilon; along a ray that grazes the ground that may be some metres apart.
    assert np.quantile(np.abs(fast.depth[hit] - slow.depth[hit]), 0.95) <= 1.0
    assert fast.steps.sum() <= slow.steps.sum()


def missed(function: ElevationFunction, rays: Rays, device: Any, points: int, leaf: float = 220.0) -> tuple[int, float]:
    """Return how many rays came to harm, and the worst depth beyond epsilon."""
    hits = follow(function, rays, device, extent=SQUARE, leaf=leaf)
    until = np.where(hits.layer == SKY, np.float64(4000.0), hits.depth)
    deep = deepest(function, rays, until, points, SQUARE) - EPSILON.at(until)
    deep[until == 0] = -np.inf
    return int((deep > 0.02).sum()), float(deep.max())


@pytest.mark.parametrize("name", scenes())
def test_nothing_is_missed(device: Any, name: str) -> None:
    rays = bundle(1, 1000, 500.0).within(4000.0)
    assert missed(scenes()[name], rays, device, 150)[0] == 0


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", scenes())
def test_nothing_is_missed_by_two_million_rays(device: Any, name: str) -> None:
    # Fourteen turns wind the ridge so tightly that rays take thousands of steps through large boxes.
    leaf = 27.5 if name == "twisted ridge" else 220.0
    for part in range(4):
        rays = bundle(100 + part, 50_000, 500.0).within(4000.0)
        assert missed(scenes()[name], rays, device, 160, leaf)[0] == 0


def test_a_needle_is_seen_from_afar(device: Any) -> None:
    function = scenes()["needle"]
    eye = np.array([[X - 700.0, Y - 20.0, 300.0]])
    direction = np.array([[X + 20.0, Y + 30.0, 300.0]]) - eye
    rays = Rays(eye, direction / np.linalg.norm(direction))
    for machine in (None, device):
        hits = follow(function, rays, machine, extent=SQUARE)
        assert hits.depth[0] == pytest.approx(np.linalg.norm(direction), abs=6.1)


def test_walls_where_the_terrain_ends(device: Any) -> None:
    function = Disc(X, Y, 500.0, 100.0, FLAT)
    low = Rays(np.array([[X - 900.0, Y, 20.0]]), np.array([[1.0, 0.0, 0.0]]))
    over = Rays(np.array([[X - 900.0, Y, 120.0]]), np.array([[1.0, 0.0, 0.0]]))
    edge = 500.0 * math.sqrt(1 - 0.5 ** (1 / 3))  # where Wyvill's fall-off is 1/2
    for machine in (None, device):
        hits = follow(function, low, machine)
        assert hits.depth[0] == pytest.approx(900 - edge, abs=0.2)
        assert hits.normal[0] == pytest.approx([-1, 0, 0], abs=1e-3)
        assert follow(function, over, machine).layer[0] == SKY


def test_rays_that_begin_in_the_ground_hit_at_once(device: Any) -> None:
    rays = Rays(np.array([[X, Y, 10.0]]), np.array([[0.0, 0.0, 1.0]]))
    for machine in (None, device):
        hits = follow(Constant(50.0), rays, machine, extent=SQUARE)
        assert hits.depth[0] == 0


def test_reach_ends_a_ray(device: Any) -> None:
    rays = Rays(np.array([[X, Y, 150.0]]), np.array([[0.0, 0.0, -1.0]]))
    for machine in (None, device):
        assert follow(Constant(50.0), rays.within(99.0), machine, extent=SQUARE).layer[0] == SKY
        hits = follow(Constant(50.0), rays.within(101.0), machine, extent=SQUARE)
        assert hits.depth[0] == pytest.approx(100.0, abs=0.05)
        assert hits.normal[0] == pytest.approx([0, 0, 1], abs=1e-5)


def test_a_ray_straight_up_ends(device: Any) -> None:
    rays = Rays(np.array([[X, Y, 60.0], [X, Y, 900.0]]), np.array([[0.0, 0.0, 1.0]]))
    for machine in (None, device):
        assert (follow(Constant(50.0), rays, machine).layer == SKY).all()
        assert (follow(Disc(X, Y, 500.0, 50.0, FLAT), rays, machine).layer == SKY).all()


def test_many_parallel_rays_from_one_direction(device: Any) -> None:
    camera = Camera((X, Y, 5000.0), (X, Y, 0.0), up=(0, 1, 0), field_of_view=0.0, span=600.0)
    rays = camera.rays(40, 60)
    slope = Plane(10.0 - 0.5 * X, 0.5, 0.0)
    for machine in (None, device):
        hits = follow(slope, rays, machine, camera=camera, extent=SQUARE)
        height = 5000.0 - hits.depth.reshape(40, 60)
        x = X + (np.arange(60) - 29.5) * 15
        assert np.abs(height - (10.0 - 0.5 * X + 0.5 * x)).max() < 1.1  # epsilon there
        assert hits.normal[0] == pytest.approx(np.array([-0.5, 0, 1]) / math.sqrt(1.25), abs=1e-3)


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_upright_rays_over_endless_ground_end(device: Any, up: float) -> None:
    rays = Rays(np.array([[X, Y, 150.0]]), np.array([[0.0, 0.0, up]]))
    for machine in (None, device):
        assert (follow(Constant(50.0), rays, machine, extent=SQUARE).layer[0] == SKY) == (up > 0)


def test_a_trace_is_drawn() -> None:
    from nodegraph_render.material import Ground
    from nodegraph_render.surface import Surface
    from nodegraph_render.trace import sphere_trace
    from nodegraph_render.trace_channel import preview_trace

    camera = Camera((X - 1200.0, Y - 1100.0, 700.0), (X, Y, 80.0))
    seen = sphere_trace(camera, Surface(scenes()["mesa"], None, Ground()), width=24, height=16, extent=SQUARE)
    assert preview_trace(seen)[:4] == b"\x89PNG"
