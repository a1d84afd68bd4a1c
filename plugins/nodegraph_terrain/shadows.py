"""Cast shadows: how high the horizon stands towards the light, and how much of the sun's disc it hides."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nodegraph import Context

Floats = npt.NDArray[np.float32]

SUN_RADIUS = 0.2665
"""Half the apparent diameter of the sun, degrees."""

SNAP = 1e-6
"""A ray that passes a cell's centre closer than this share of a cell goes through it."""


@dataclass(frozen=True, slots=True)
class Ray:
    """Where the ray from a cell's centre towards a light crosses grid lines, nearest first; the same for every cell.

    At crossing k the height is (1 - fraction) z(cell + near) + fraction z(cell + far), at `distance` metres.

    Attributes:
        near, far: (n, 2) int32, offsets in rows and columns.
        fraction: (n,) float32, 0 to 1.
        distance: (n,) float32, metres on the ground.
    """

    near: npt.NDArray[np.int32]
    far: npt.NDArray[np.int32]
    fraction: Floats
    distance: Floats

    def __len__(self) -> int:
        return len(self.distance)


def trace(azimuth: float, cell: tuple[float, float], shape: tuple[int, int], reach: float) -> Ray:
    """Return the crossings of a ray with the lines through the cell centres, as far as `reach` metres or the raster.

    Args:
        azimuth: where the light stands, degrees clockwise from north.
        cell: (width, height) of a cell, m.
        shape: (rows, cols) of the raster: a ray leaves it after that many lines at most.
        reach: metres to follow the ray, may be infinite.
    """
    # One metre along the ray, in rows (southwards) and columns.
    step = np.array([-math.cos(math.radians(azimuth)) / cell[1], math.sin(math.radians(azimuth)) / cell[0]])
    step[np.abs(step) * max(cell) < 1e-12] = 0.0
    near, far, fraction, distance = [], [], [], []
    # The ray leaves the raster where it has crossed all lines of either family.
    leave = min((shape[axis] - 1) / abs(step[axis]) for axis in (0, 1) if step[axis] != 0)
    limit = min(reach, leave * (1 + 1e-9))
    for axis in (0, 1):
        if step[axis] == 0:
            continue
        count = int(min(limit * abs(step[axis]) * (1 + 1e-9), shape[axis] - 1))
        lines = np.arange(1, count + 1)
        along = lines / abs(step[axis])
        position = along * step[1 - axis]
        first = np.floor(position)
        share = position - first
        first[share > 1 - SNAP] += 1
        share[(share > 1 - SNAP) | (share < SNAP)] = 0.0
        # Where a ray meets a cell's centre both families cross: the rows' crossing stands for both.
        keep = share > 0 if axis == 1 and step[0] != 0 else np.ones(count, bool)
        offsets = np.empty((count, 2), np.int32)
        offsets[:, axis] = lines * int(np.sign(step[axis]))
        offsets[:, 1 - axis] = first
        beyond = offsets.copy()
        beyond[:, 1 - axis] += share > 0
        near.append(offsets[keep])
        far.append(beyond[keep])
        fraction.append(share[keep])
        distance.append(along[keep])
    order = np.argsort(np.concatenate(distance), kind="stable")
    return Ray(
        np.concatenate(near)[order],
        np.concatenate(far)[order],
        np.concatenate(fraction)[order].astype(np.float32),
        np.concatenate(distance)[order].astype(np.float32),
    )


@dataclass(frozen=True, slots=True)
class Disc:
    """The sun's disc as tangents of height angles: a horizon below `low` hides nothing of it, one above `high` all."""

    low: float
    high: float

    @classmethod
    def at(cls, altitude: float) -> Disc | None:
        """Return the disc at an altitude in degrees, or None where it stands in the zenith and nothing hides it."""
        if altitude + SUN_RADIUS >= 89.9:
            return None
        return cls(math.tan(math.radians(altitude - SUN_RADIUS)), math.tan(math.radians(altitude + SUN_RADIUS)))

    def reach(self, relief: float) -> float:
        """Return how far, in metres, heights `relief` metres above a cell may hide a part of the disc from it."""
        return relief / self.low if self.low > 0 else math.inf


def sunlit(heights: Floats, rows: slice, ray: Ray, disc: Disc, z_factor: float, top: float, context: Context) -> Floats:
    """Return which share of the sun's disc stands above the horizon of each cell, for some rows of a surface.

    The tangent of the horizon's height angle is the largest (z(p) - z(cell)) z_factor / distance over the points p
    where the ray to the sun crosses grid lines, with z linear between the two cells beside p.  The share falls
    linearly, in tangents, from 1 where the horizon touches the disc's lower rim to 0 at its upper rim.  A point
    beside a void or outside the raster hides nothing.

    Args:
        heights: the whole surface, (rows, cols) float32, m, NaN where void.
        rows: the rows to return.
        ray: crossings towards the sun.
        disc: where the sun stands.
        z_factor: heights are multiplied by it.
        top: greatest height of the surface, m.
        context: for cancellation.

    Returns:
        0 to 1, float32, of the shape of ``heights[rows]``; 1 where the cell is void.
    """
    first, last, _ = rows.indices(heights.shape[0])
    cols = heights.shape[1]
    here = heights[first:last]
    horizon = np.full(here.shape, -np.inf, np.float32)
    lowest = float(np.fmin.reduce(here, axis=None))
    nearer, farther = np.empty((2, *here.shape), np.float32)
    for k in range(len(ray)):
        if not float(ray.distance[k]) * disc.low <= (top - lowest) * z_factor:
            break
        if k % 64 == 63:
            context.progress(None)
        offsets = np.stack([ray.near[k], ray.far[k]])
        r0, r1 = max(first, -int(offsets[:, 0].min())), min(last, heights.shape[0] - int(offsets[:, 0].max()))
        c0, c1 = max(0, -int(offsets[:, 1].min())), min(cols, cols - int(offsets[:, 1].max()))
        if r0 >= r1 or c0 >= c1:
            continue
        centre = heights[r0:r1, c0:c1]
        a, b = nearer[: r1 - r0, : c1 - c0], farther[: r1 - r0, : c1 - c0]
        (i, j), (m, n) = offsets
        scale = z_factor / float(ray.distance[k])
        fraction = float(ray.fraction[k])
        np.subtract(heights[r0 + i : r1 + i, c0 + j : c1 + j], centre, out=a)
        a *= np.float32(scale * (1 - fraction))
        if fraction > 0:
            np.subtract(heights[r0 + m : r1 + m, c0 + n : c1 + n], centre, out=b)
            b *= np.float32(scale * fraction)
            a += b
        target = horizon[r0 - first : r1 - first, c0:c1]
        np.fmax(target, a, out=target)
    np.subtract(np.float32(disc.high), horizon, out=horizon)
    horizon *= np.float32(1 / (disc.high - disc.low))
    return np.clip(horizon, 0, 1, out=horizon)
