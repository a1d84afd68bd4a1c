r"""Sphere tracing construction trees: rays never pass through a terrain whose slope is bounded.

Along a ray o + t u the height above the terrain, h(t) = o_z + t u_z - f(o_xy + t u_xy), falls at most by

    rate = |u_xy| lambda - u_z

a metre where lambda bounds |grad f|.  From a point with h > 0 the ray may therefore go on by h / rate metres, or as far
as lambda holds where the rate is not positive (Génevaux et al. 2015, section 7.2; the printed formula takes the
absolute value of the rate and stops short in the second case).

**Accelerated.**  The paper asks the tree for lambda on a segment whose length doubles with every step.  Here bounds
are kept in a quadtree (`quadtree`): each node of it around the point offers a step - to where the ray leaves its box
or h / rate with its own lambda - and the longest is taken: near the ground a small box with its small lambda wins, high
above it a large one.  Boxes that the ray passes above are skipped without asking for f.

Bounds are rarely attained, so a ray dares more (after Keinert et al., Enhanced sphere tracing, 2014): from the point
it reaches, h' / (|u_xy| lambda + u_z) metres behind are free as well, and where these meet the h / rate metres that
were free before, nothing was missed.  Else it goes back and takes the safe step.  How far to dare follows from how fast
the ground came nearer on the last step.

**Plain.**  The same with one box, the whole region, and its one global lambda, and no daring: what sphere tracing was.

**Domain.**  The terrain exists where alpha >= T = 1/2 and is solid below its surface.  Where it does not exist the ray
goes on by (T - alpha) / (|u_xy| lambda_alpha), and inside by no more than (alpha - T) / (|u_xy| lambda_alpha), unless
the whole box is terrain, but by epsilon(t) at least: neither gaps nor walls wider than that are stepped over.

A point counts as hit when h < epsilon(t) = floor + share t.  So that rounding cannot hold them, rays go epsilon / 8
further than needed where they cross from box to box, and epsilon / 64 at least everywhere: a blade of ground may be
passed that is thinner than that, and so, where slopes are below 128, by less than epsilon.

Sources: Hart, Sphere tracing, The Visual Computer 12 (1996), doi:10.1007/s003710050084; Génevaux et al., section 7,
doi:10.1111/cgf.12530.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from nodegraph import Context
from nodegraph_render.quadtree import Doubles, Quadtree
from nodegraph_render.rays import SKY, Hits, Rays
from nodegraph_render.tracers import Tracer
from nodegraph_tree.device import BLOCK, TILE, Frame, Tile, tile_programs
from nodegraph_tree.function import THRESHOLD, Box, ElevationFunction, Points

if TYPE_CHECKING:
    from nodegraph.opencl import Device

Method = Literal["accelerated", "plain"]

KERNEL = Path(__file__).with_name("kernels") / "tree_trace.cl"
BOLD, FAST = 0.9, 1e30
"""What part of the distance to dare, and a fall so fast that nothing is dared; as in the kernel."""
MARGIN = 0.01
"""How far beyond a leaf its program holds, in parts of its smaller side: normals look that far."""
LANES, GROUP = 8, 4
"""Rays of a work item, and work items of a group: what they keep must fit the stack of a CPU's thread."""
BAND = 1 << 16
"""Rays a launch follows, so that a cancel need not wait for more."""


class Epsilon(NamedTuple):
    """How near to the ground a ray counts as having hit it: floor + share t, m, at a distance of t metres."""

    floor: float = 0.01
    share: float = 1e-4

    def at(self, depth: Doubles) -> Doubles:
        """Return epsilon at some distances."""
        return self.floor + self.share * depth

    def beyond(self, depth: Doubles) -> Doubles:
        """Return how much further rays go where they cross a border."""
        return 0.125 * self.at(depth) + 4e-7 * depth

    def creep(self, depth: Doubles) -> Doubles:
        """Return how far rays go at least, however steep the ground may be."""
        return self.at(depth) / 64 + 4e-7 * depth


EPSILON = Epsilon()


def tree_tracer(
    function: ElevationFunction,
    tree: Quadtree,
    origin: tuple[float, float, float],
    device: Device | None,
    context: Context,
    *,
    method: Method = "accelerated",
    epsilon: Epsilon = EPSILON,
) -> Tracer:
    """Return what follows rays to a construction tree.

    Args:
        function: the construction tree.
        tree: its bounds.
        origin: a point near the eye, m; float32 is finest there.
        device: where to compute; a tree that is not all on OpenCL is computed with NumPy.
        context: for progress and cancelling.
        method: see above.
        epsilon: see above.
    """
    if device is not None and function.on_device:
        return _on_device(function, tree, origin, device, context, method, epsilon)
    return _on_host(function, tree, context, method, epsilon)


def _on_device(
    function: ElevationFunction,
    tree: Quadtree,
    origin: tuple[float, float, float],
    device: Device,
    context: Context,
    method: Method,
    epsilon: Epsilon,
) -> Tracer:
    programs = tile_programs(function, _leaf_tiles(tree, context))
    program, buffers = programs.compiled(device, KERNEL), programs.buffers(device)
    west, south, east, north = tree.box.T
    boxes = np.stack([west - origin[0], south - origin[1], east - west, north - south], axis=1)
    slack = 1e-3 + 1e-6 * np.abs(np.nan_to_num(tree.top))  # the device rounds to float32
    limits = np.stack([tree.top - origin[2] + slack, tree.slope, tree.weight_slope, tree.full], axis=1)
    bounds = [device.from_host(array.astype(np.float32)) for array in (boxes, limits)]
    bounds += [device.from_host(tree.child), device.from_host(tree.detail.astype(np.float32))]
    levels = tree.levels if method == "accelerated" else 1

    def trace(rays: Rays) -> Hits:
        count = len(rays)
        near = (rays.origin - np.asarray(origin)).astype(np.float32)
        reach = np.broadcast_to(np.asarray(rays.reach, np.float32), count)
        inputs: list[Any] = []
        for array in (near, rays.direction.astype(np.float32)):
            inputs += [device.from_host(np.ascontiguousarray(array)), 3 if len(array) == count else 0]
        inputs.append(device.from_host(np.ascontiguousarray(reach)))
        depth, normal = device.empty(count), device.zeros((count, 3))
        steps = device.empty(count, np.int32)
        for first in range(0, count, BAND):
            part = min(BAND, count - first)
            context.progress(first / count)
            device.run(
                program, "trace", GROUP * -(-part // (LANES * GROUP)), *buffers, *bounds, levels, THRESHOLD, *inputs,
                first, part, origin[2], epsilon.floor, epsilon.share, MARGIN, depth, normal, steps, local_size=GROUP,
            )  # fmt: skip
            device.finish()
        far = device.to_host(depth)
        layer = np.where(np.isfinite(far), 0, SKY).astype(np.int8)
        return Hits(far, device.to_host(normal), layer, device.to_host(steps))

    return trace


def _leaf_tiles(tree: Quadtree, context: Context) -> Iterator[Tile]:
    """Yield what the program of each leaf is for; its frame begins in the north-west corner."""
    columns, rows = TILE // BLOCK[0], TILE // BLOCK[1]
    for number, (node, detail) in enumerate(zip(tree.leaves, tree.detail, strict=True)):
        if number % 64 == 0:
            context.progress(None)
        box = Box(*tree.box[node].tolist())
        wide, high = box.east - box.west, box.north - box.south
        around = box.grown(MARGIN * min(wide, high))
        yield Tile(Frame(around, box.west, box.north, block=(wide / columns, high / rows)), detail=float(detail))


# The reference: the same walk in float64 NumPy, all rays at once.


def _on_host(function: ElevationFunction, tree: Quadtree, context: Context, method: Method, epsilon: Epsilon) -> Tracer:
    levels = tree.levels if method == "accelerated" else 1

    def trace(rays: Rays) -> Hits:
        count = len(rays)
        depth, steps = np.full(count, np.inf, np.float32), np.zeros(count, np.int32)
        normal = np.zeros((count, 3), np.float32)
        for first in range(0, count, BAND):
            context.progress(first / count)
            part = slice(first, min(first + BAND, count))
            walk = _Walk(
                np.broadcast_to(rays.origin, (count, 3))[part],
                np.broadcast_to(rays.direction, (count, 3))[part],
                np.broadcast_to(np.asarray(rays.reach, np.float64), count)[part],
                function, tree, levels, epsilon,
            )  # fmt: skip
            depth[part], normal[part], steps[part] = walk.run(context)
        return Hits(depth, normal, np.where(np.isfinite(depth), 0, SKY).astype(np.int8), steps)

    return trace


class _Walk:
    """Some rays on their way: arrays by ray, and `active`, the numbers of those that go on."""

    def __init__(
        self,
        origin: Doubles,
        direction: Doubles,
        reach: Doubles,
        function: ElevationFunction,
        tree: Quadtree,
        levels: int,
        epsilon: Epsilon,
    ) -> None:
        # A ray that leaves everything behind is infinitely far on, beyond any end.
        self.o, self.u, self.end = origin, direction, np.minimum(reach, np.finfo(np.float64).max)
        self.level = np.hypot(direction[:, 0], direction[:, 1])
        self.function, self.tree, self.levels, self.epsilon = function, tree, levels, epsilon
        count, self.bold = len(origin), levels > 1
        self.t, self.outside = np.zeros(count), np.zeros(count, bool)
        # The last point that stands, the height above the ground there, how far is safe from there, the slope that
        # bounds a step longer than that (negative: it is not), and how fast the ground came nearer lately.
        self.past, self.gap, self.safe = np.zeros(count), np.zeros(count), np.zeros(count)
        self.slope, self.fall = np.full(count, -1.0), np.full(count, np.inf)
        self.active = np.flatnonzero(self._clip())

    def run(self, context: Context) -> tuple[Doubles, Doubles, Any]:
        """Follow the rays to their ends; return depths, normals and steps."""
        count = len(self.o)
        depth, normal, steps = np.full(count, np.inf), np.zeros((count, 3)), np.zeros(count, np.int32)
        while len(self.active):
            context.progress(None)
            nodes = self._seek()
            if not len(self.active):
                break
            where = self.active
            steps[where] += 1
            point = self._at(where)
            points = Points(point[:, 0], point[:, 1], self.tree.detail[-1 - self.tree.child[nodes]])
            sample = self.function.query(points)
            gap, there = point[:, 2] - sample.height, sample.weight >= THRESHOLD
            stands = self._stands(where, gap)
            self._go_back(where[~stands])
            limit = self.epsilon.at(self.t[where])
            hit = stands & there & (gap < limit)
            if hit.any():
                depth[where[hit]] = self.t[where[hit]]
                wall = self.outside[where[hit]] & (gap[hit] < -limit[hit])
                normal[where[hit]] = self._normals(points.taken(hit), wall, where[hit])
            go = stands & ~hit
            self._stride(where[go], gap[go], sample.weight[go])
            self.active = where[~hit]
        return depth, normal, steps

    def _stands(self, where: Any, gap: Doubles) -> Any:
        """Say where nothing can lie between the last point and this one, though the step was longer than was safe."""
        back = self.slope[where] * self.level[where] + self.u[where, 2]
        apart = self.t[where] - self.past[where] - self.safe[where]
        return (self.slope[where] < 0) | ((gap >= 0) & (gap >= apart * back))

    def _go_back(self, where: Any) -> None:
        self.t[where] = self.past[where] + self.safe[where]
        self.slope[where], self.fall[where] = -1.0, np.inf

    def _at(self, where: Any) -> Doubles:
        return np.asarray(self.o[where] + self.t[where, None] * self.u[where])

    def _clip(self) -> Any:
        near, there = np.zeros(len(self.o)), np.ones(len(self.o), bool)
        for axis in (0, 1):
            low, high = self.tree.box[0][axis], self.tree.box[0][axis + 2]
            o, u = self.o[:, axis], self.u[:, axis]
            with np.errstate(divide="ignore", invalid="ignore"):
                a, b = (low - o) / u, (high - o) / u
            level = u == 0
            there &= ~level | ((o >= low) & (o <= high))
            near = np.where(level, near, np.maximum(near, np.minimum(a, b)))
            self.end = np.where(level, self.end, np.minimum(self.end, np.maximum(a, b)))
        self.outside, self.t = near > 0, near
        return there & (near <= self.end)

    def _leaving(self, where: Any, nodes: Any) -> Doubles:
        out = np.full(len(where), np.inf)
        for axis in (0, 1):
            o, u = self.o[where, axis], self.u[where, axis]
            edge = np.where(u > 0, self.tree.box[nodes, axis + 2], self.tree.box[nodes, axis])
            with np.errstate(divide="ignore", invalid="ignore"):
                out = np.where(u == 0, out, np.minimum(out, (edge - o) / u))
        return out

    def _child(self, nodes: Any, point: Doubles) -> Any:
        box = self.tree.box[nodes]
        middle = (box[:, :2] + box[:, 2:]) / 2
        right, upper = point[:, 0] >= middle[:, 0], point[:, 1] >= middle[:, 1]
        return self.tree.child[nodes] + right + 2 * upper

    def _seek(self) -> Any:
        """Take each active ray to where the terrain must be asked; return the leaves' nodes of those that remain."""
        tree, found = self.tree, np.full(len(self.o), -1)
        seeking = self.active
        while len(seeking):
            seeking = seeking[self.t[seeking] <= self.end[seeking]]
            point = self._at(seeking)
            rays, nodes, again = np.arange(len(seeking)), np.zeros(len(seeking), int), []
            for level in range(tree.levels):
                if level < self.levels:
                    above = point[rays, 2] > tree.top[nodes]
                    if above.any():
                        again.append(self._skip(seeking[rays[above]], nodes[above]))
                        rays, nodes = rays[~above], nodes[~above]
                leaf = tree.child[nodes] < 0
                found[seeking[rays[leaf]]] = nodes[leaf]
                rays, nodes = rays[~leaf], nodes[~leaf]
                nodes = self._child(nodes, point[rays])
            seeking = np.concatenate(again) if again else np.zeros(0, int)
        self.active = self.active[found[self.active] >= 0]
        return found[self.active]

    def _skip(self, where: Any, nodes: Any) -> Any:
        """Take rays that are above all terrain of a node to where they sink to its top or leave it."""
        top, down = self.tree.top[nodes], self.u[where, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            sinks = np.where(down < 0, (top - self.o[where, 2]) / down, np.inf)
        beyond = self.epsilon.beyond(self.t[where])
        self.outside[where] |= np.isneginf(top)
        following = np.minimum(self._leaving(where, nodes), sinks) + beyond
        self.t[where] = np.maximum(following, self.t[where] + beyond)
        return where

    def _stride(self, where: Any, gap: Doubles, weight: Doubles) -> None:
        """Let rays go on from points where the terrain has height `gap` below them."""
        tree, full = self.tree, weight >= THRESHOLD
        with np.errstate(divide="ignore", invalid="ignore"):
            fall = np.maximum((self.gap[where] - gap) / (self.t[where] - self.past[where]), 0)
        fall[self.outside[where] | ~full | np.isinf(self.fall[where])] = FAST
        self.fall[where], self.outside[where] = fall, ~full
        point, least = self._at(where), self.epsilon.beyond(self.t[where])
        best, nodes, rays = self.epsilon.creep(self.t[where]), np.zeros(len(where), int), np.arange(len(where))
        bold, slope = np.zeros(len(where)), np.full(len(where), -1.0)
        wide = self.epsilon.at(self.t[where])
        for _ in range(self.levels):
            here = where[rays]
            rise = tree.weight_slope[nodes] * self.level[here]
            rate = tree.slope[nodes] * self.level[here] - self.u[here, 2]
            a, there = weight[rays], weight[rays] >= THRESHOLD
            with np.errstate(divide="ignore", invalid="ignore"):
                border = np.where(rise > 0, np.maximum(np.abs(a - THRESHOLD) / rise, wide[rays]), np.inf)
                ground = np.where(rate > 0, gap[rays] / rate, np.inf)
            room = self._leaving(here, nodes) - self.t[here]
            step = room + least[rays]
            if self.bold:
                back = np.maximum(tree.slope[nodes] * self.level[here] + self.u[here, 2], 0)
                with np.errstate(invalid="ignore"):
                    far = np.minimum(room, BOLD * (ground * back + gap[rays]) / (back + fall[rays]))
                dare = there & tree.full[nodes] & (rate > 0) & (far > ground) & (far > bold[rays])
                bold[rays[dare]], slope[rays[dare]] = far[dare], tree.slope[nodes[dare]]
            step = np.where(there, np.minimum(step, ground), step)
            step = np.where(there & tree.full[nodes], step, np.minimum(step, border))
            best[rays] = np.maximum(best[rays], step)
            inner = tree.child[nodes] >= 0
            rays, nodes = rays[inner], nodes[inner]
            nodes = self._child(nodes, point[rays])
        self.past[where], self.gap[where], self.safe[where] = self.t[where], gap, best
        self.slope[where] = np.where(bold > best, slope, -1.0)
        self.t[where] += np.maximum(best, bold)

    def _normals(self, points: Points, wall: Any, where: Any) -> Doubles:
        sample = self.function.query(points, gradient=True)
        assert sample.height_gradient is not None
        assert sample.weight_gradient is not None
        up = np.vstack([-sample.height_gradient, np.ones(len(points.x))])
        side = np.vstack([-sample.weight_gradient, np.zeros(len(points.x))])
        cut = ~np.any(side, axis=0)  # the border of the region, not of the terrain
        side[:2, cut] = -self.u[where[cut], :2].T
        normal = np.where(wall, side, up)
        length = np.sqrt(np.sum(normal**2, axis=0))
        return np.asarray((normal / np.where(length > 0, length, 1)).T)
