"""Following rays to height fields with NumPy, in float64: what ``kernels/raster.cl`` must agree with.

All rays take their next step together; those that are done are dropped.  Positions are in cells, as height_field.py
says, heights and distances along the rays in metres.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_render.height_field import SHIFT, Doubles, Floats, HeightField
from nodegraph_render.rays import SKY, Hits, Rays

Array = npt.NDArray[Any]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

X_AXIS, Y_AXIS = 1, 2


class _Paths(NamedTuple):
    """Rays within the box of a height field, from where they enter it.

    Attributes:
        number: which rays they are.
        x, y, z: where they enter.
        dx, dy, dz: per metre.
        start, end: distance from the origin to there, and from there to where they end.
        axis: through which side they enter; 0 from above or where they begin inside.
    """

    number: Array
    x: Array
    y: Array
    z: Array
    dx: Array
    dy: Array
    dz: Array
    start: Array
    end: Array
    axis: Array

    def take(self, which: Bools | Ints) -> _Paths:
        """Return some of them."""
        return _Paths(*[item[which] for item in self])


class _Found(NamedTuple):
    """What paths hit.

    Attributes:
        t: distance from where they enter the box; infinite where they hit nothing.
        column, row: the quad.
        axis: the side by which they came into it.
        below: whether they were below the surface as they came.
        steps: that they took.
    """

    t: Array
    column: Array
    row: Array
    axis: Array
    below: Array
    steps: Array


class _Patch(NamedTuple):
    """f = base + east u + south v + twist u v, with u and v from 0 to 1 over a quad."""

    base: Doubles
    east: Doubles
    south: Doubles
    twist: Doubles

    @staticmethod
    def at(heights: Floats, column: Ints, row: Ints) -> _Patch:
        nw, ne, sw, se = (
            heights[row + down, column + right].astype(np.float64) for down, right in ((0, 0), (0, 1), (1, 0), (1, 1))
        )
        return _Patch(nw, ne - nw, sw - nw, se - sw - (ne - nw))

    def height(self, u: Doubles, v: Doubles) -> Doubles:
        return self.base + self.east * u + (self.south + self.twist * u) * v


def trace_on_host(field: HeightField, gradient: Floats | None, march: tuple[float, float] | None, rays: Rays) -> Hits:
    """Follow rays.

    Args:
        field: where to; without voids in its heights where `march` is given.
        gradient: towards east and north at the centres of cells, for smooth normals.
        march: the Lipschitz bound and epsilon of sphere tracing; None follows the pyramid.
        rays: one origin, direction and reach for all, or one each.
    """
    origin, direction, reach = np.broadcast_arrays(
        *field.gridded(rays.origin, rays.direction), np.reshape(rays.reach, (-1, 1))
    )
    hits = Hits(
        np.full(len(origin), np.inf, np.float32),
        np.zeros((len(origin), 3), np.float32),
        np.full(len(origin), SKY, np.int8),
        np.zeros(len(origin), np.int32),
    )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        paths = _entering(field, origin, direction, reach[:, 0])
        found = _follow(field, paths) if march is None else _march(field, paths, *march)
        hits.steps[paths.number] = found.steps
        hit = np.isfinite(found.t)
        paths, found = paths.take(hit), _Found(*[item[hit] for item in found])
        hits.depth[paths.number] = paths.start + found.t
        hits.layer[paths.number] = 0
        hits.normal[paths.number] = _normals(field, gradient, paths, found)
    return hits


def _entering(field: HeightField, origin: Doubles, direction: Doubles, reach: Doubles) -> _Paths:
    """Return the part of each ray within the box of a field, which is open below, where there is one."""
    start, end = np.zeros(len(origin)), np.minimum(reach, 1e30)
    side = np.zeros(len(origin), np.int64)
    rows, cols = field.quads
    for axis, last in ((X_AXIS, cols), (Y_AXIS, rows)):
        o, d = origin[:, axis - 1], direction[:, axis - 1]
        a, b = -o / d, (last - o) / d
        outside = (o < 0) | (o > last)
        enter = np.where(d == 0, np.where(outside, np.inf, 0), np.minimum(a, b))
        leave = np.where(d == 0, np.inf, np.maximum(a, b))
        side[enter > start] = axis
        start, end = np.maximum(enter, start), np.minimum(leave, end)
    z, dz = origin[:, 2], direction[:, 2]
    # Of a level ray the sign of 0 must not decide.
    level = np.where(dz == 0, np.where(z > field.top, -np.inf, np.inf), (field.top - z) / dz)
    down = dz < 0
    side[down & (level > start)] = 0
    start = np.where(down & (level > start), level, start)
    end = np.where(~down & (level < end), level, end)
    number = np.flatnonzero(start <= end)
    start, (x, y, z) = start[number], (origin[number] + start[number, None] * direction[number]).T
    dx, dy, dz = direction[number].T
    x, y = np.clip(x, 0, cols), np.clip(y, 0, rows)
    return _Paths(number, x, y, z, dx, dy, dz, start, end[number] - start, side[number])


def _first_root(a: Doubles, b: Doubles, c: Doubles, span: Doubles) -> Doubles:
    """Return the first root from 0 to `span` of c + b s + a s^2, where c > 0; infinite where there is none."""
    discriminant = b * b - 4 * a * c
    root = np.sqrt(np.maximum(discriminant, 0))
    # Neither form subtracts what is nearly equal.
    first = np.where(b < 0, 2 * c / (root - b), -0.5 * (b + root) / a)
    dips = (a > 0) & (b < 0) & (b + 2 * a * span > 0) & (discriminant >= 0)
    below = c + span * (b + a * span) <= 0
    return np.where(below | dips, np.minimum(first, span), np.inf)


def _leave(path: _Paths, column: Ints, row: Ints, size: Ints | int) -> tuple[Doubles, Doubles]:
    """Return where the paths leave blocks that begin at a column and row, through their sides across x and y."""
    x, y = np.where(path.dx < 0, column, column + size), np.where(path.dy < 0, row, row + size)
    return (
        np.where(path.dx == 0, np.inf, (x - path.x) / path.dx),
        np.where(path.dy == 0, np.inf, (y - path.y) / path.dy),
    )


def _follow(field: HeightField, path: _Paths) -> _Found:
    """Go from block to block of the pyramid; solve in the quads at its bottom."""
    rows, cols = field.quads
    coarsest = len(field.levels) - 1
    found = _none_found(path)
    index: Array = np.arange(len(path.x))
    column: Array = np.minimum(path.x.astype(np.int64), cols - 1)
    row: Array = np.minimum(path.y.astype(np.int64), rows - 1)
    # In a block twice as wide as the stretch in which the ray passes through all heights there is seldom nothing to
    # look at.
    sink = np.where(path.dz < 0, path.z - field.bottom, field.top - path.z) / np.abs(path.dz)
    stretch = sink * np.maximum(np.abs(path.dx), np.abs(path.dy))
    widest: Array = (2 * stretch[:, None] >= 1 << SHIFT * np.arange(1, coarsest + 1)).sum(axis=1)
    # A ray that begins inside the box may begin near the ground.
    level: Array = np.where(path.start > 0, widest, np.minimum(widest, 1))
    t: Array = np.zeros(len(index))
    axis = path.axis
    while len(index):
        found.steps[index] += 1
        shift = level * SHIFT
        size = 1 << shift
        block_x, block_y = column >> shift, row >> shift
        leave_x, leave_y = _leave(path, block_x << shift, block_y << shift, size)
        across = leave_x < leave_y
        leave = np.maximum(t, np.minimum(np.minimum(leave_x, leave_y), path.end))
        lowest = path.z + path.dz * np.where(path.dz < 0, leave, t)
        highest = field.pyramid[field.levels[level, 0] + block_y * field.levels[level, 1] + block_x]
        near = lowest <= highest
        test = np.flatnonzero(near & (level == 0))
        done = np.zeros(len(index), np.bool_)
        if len(test):
            some = path.take(test)
            patch = _Patch.at(field.heights, column[test], row[test])
            u, v = some.x + some.dx * t[test] - column[test], some.y + some.dy * t[test] - row[test]
            above = some.z + some.dz * t[test] - patch.height(u, v)
            rate = some.dz - (patch.east * some.dx + patch.south * some.dy)
            rate -= patch.twist * (u * some.dy + v * some.dx)
            below = above <= 0
            s = np.where(below, 0, _first_root(-patch.twist * some.dx * some.dy, rate, above, leave[test] - t[test]))
            hit = np.isfinite(s)
            done[test] = hit
            which = test[hit]
            values = (t[which] + s[hit], column[which], row[which], axis[which], below[hit])
            for whole, piece in zip(found[:5], values, strict=True):
                whole[index[which]] = piece
        # A skipped block is left through one of its sides, into a neighbour of the same size.
        skip = ~done & (~near | (level == 0))
        low_x, low_y = block_x << shift, block_y << shift
        next_x = np.clip((path.x + leave * path.dx).astype(np.int64), low_x, np.minimum(low_x + size, cols) - 1)
        next_y = np.clip((path.y + leave * path.dy).astype(np.int64), low_y, np.minimum(low_y + size, rows) - 1)
        next_x = np.where(across, np.where(path.dx < 0, low_x - 1, low_x + size), next_x)
        next_y = np.where(across, next_y, np.where(path.dy < 0, low_y - 1, low_y + size))
        done |= skip & ((leave >= path.end) | (next_x < 0) | (next_x >= cols) | (next_y < 0) | (next_y >= rows))
        rises = (next_x >> shift + SHIFT != block_x >> SHIFT) | (next_y >> shift + SHIFT != block_y >> SHIFT)
        t = np.where(skip, leave, t)
        column, row = np.where(skip, next_x, column), np.where(skip, next_y, row)
        axis = np.where(skip, np.where(across, X_AXIS, Y_AXIS), axis)
        # A block that is looked into is looked into from where the ray comes down to its top.
        under = (highest - path.z) / path.dz
        lower = ~done & ~skip & (path.dz < 0) & (under > t)
        t = np.where(lower, np.minimum(under, leave), t)
        inner_x = np.clip((path.x + t * path.dx).astype(np.int64), low_x, np.minimum(low_x + size, cols) - 1)
        inner_y = np.clip((path.y + t * path.dy).astype(np.int64), low_y, np.minimum(low_y + size, rows) - 1)
        column, row = np.where(lower, inner_x, column), np.where(lower, inner_y, row)
        axis = np.where(lower, 0, axis)
        rises &= level < np.where(highest > -np.inf, widest, coarsest)
        level = np.where(skip, level + rises, level - 1)
        if done.any():
            keep = ~done
            path = path.take(keep)
            index, column, row, level, widest, t, axis = [
                item[keep] for item in (index, column, row, level, widest, t, axis)
            ]
    return found


def _march(field: HeightField, path: _Paths, bound: float, epsilon: float) -> _Found:
    """Sphere tracing: nothing is hit within h / (|u_xy| bound - u_z) metres of a point h above the heights."""
    rows, cols = field.quads
    found = _none_found(path)
    index: Array = np.arange(len(path.x))
    t, axis = np.zeros(len(index)), path.axis
    while len(index):
        found.steps[index] += 1
        x, y = path.x + t * path.dx, path.y + t * path.dy
        column = np.clip(x.astype(np.int64), 0, cols - 1)
        row = np.clip(y.astype(np.int64), 0, rows - 1)
        patch = _Patch.at(field.heights, column, row)
        above = path.z + t * path.dz - patch.height(x - column, y - row)
        approach = bound * np.hypot(path.dx * field.cell[0], path.dy * field.cell[1]) - path.dz
        near = above < epsilon
        hit = near & field.ground[row, column]
        for whole, piece in zip(found[:5], (t, column, row, axis, above <= 0), strict=True):
            whole[index[hit]] = piece[hit]
        # Below the heights that bridge a void: on to the next quad, and into it for certain.
        leave_x, leave_y = _leave(path, column, row, 1)
        step = np.where(near, np.minimum(leave_x, leave_y), t + above / approach)
        axis = np.where(near, np.where(leave_x < leave_y, X_AXIS, Y_AXIS), 0)
        t = np.maximum(step, t + t * 2.4e-7 + np.where(near, 0.1 * epsilon, 0))
        keep = ~hit & (near | (approach > 0)) & (t <= path.end)
        path = path.take(keep)
        index, t, axis = index[keep], t[keep], axis[keep]
    return found


def _none_found(path: _Paths) -> _Found:
    count = len(path.x)
    none = np.zeros((4, count), np.int64)
    return _Found(np.full(count, np.inf), none[0], none[1], none[2], np.zeros(count, np.bool_), none[3])


def _normals(field: HeightField, gradient: Floats | None, path: _Paths, found: _Found) -> Doubles:
    column, row = found.column, found.row
    u = np.clip(path.x + path.dx * found.t - column, 0, 1)
    v = np.clip(path.y + path.dy * found.t - row, 0, 1)
    if gradient is None:
        patch = _Patch.at(field.heights, column, row)
        slope = np.stack(
            [(patch.east + patch.twist * v) / field.cell[0], -(patch.south + patch.twist * u) / field.cell[1]], 1
        )
    else:
        u, v = u[:, None], v[:, None]
        upper = (1 - u) * gradient[row, column] + u * gradient[row, column + 1]
        slope = (1 - v) * upper + v * ((1 - u) * gradient[row + 1, column] + u * gradient[row + 1, column + 1])
    normal = np.column_stack([-slope, np.ones(len(slope))])
    normal /= np.sqrt((normal * normal).sum(axis=1))[:, None]
    # Where the quad that the ray came from is no ground, it hit a wall.
    backward = np.stack([np.where(path.dx < 0, 1, -1), np.where(path.dy < 0, 1, -1)], 1)
    backward *= found.axis[:, None] == (X_AXIS, Y_AXIS)
    before = np.stack([column, row], 1) + backward
    inside = ((before >= 0) & (before < field.quads[::-1])).all(axis=1)
    ground = inside & field.ground[tuple(np.where(inside[:, None], before, 0).T[::-1])]
    wall = found.below & (found.axis > 0) & ~ground
    normal[wall] = np.column_stack([backward * (1, -1), np.zeros(len(backward))])[wall]
    return normal
