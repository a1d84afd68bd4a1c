"""What stands in the way of light: shares of the sun's disc and of the sky that points of a scene see, by tracing rays.

Rays are spread by an additive recurrence with the plastic number (M. Roberts 2018, The unreasonable effectiveness of
quasirandom sequences): any run of consecutive members covers the square evenly.  Sixteen neighbouring samples, 4 by 4,
take consecutive runs (interleaved sampling, Keller and Heidrich 2001, doi:10.1007/978-3-7091-6242-2_25), so what one of
them misses another sees, and a mean over 4 by 4 is free of noise on smooth ground.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_render.materials import Spots
from nodegraph_render.rays import Doubles, Rays, Singles
from nodegraph_render.sun import Sun
from nodegraph_render.tracers import Tracer

Flags = npt.NDArray[np.bool_]
Integers = npt.NDArray[Any]

ORDER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])
"""Turns of samples in a block of 4 by 4, neighbours far apart."""


def turns(rows: Integers, cols: Integers) -> Integers:
    """Return the turns of samples, 0 to 15, by row and column."""
    found: Integers = ORDER[rows % 4, cols % 4]
    return found


def spread(index: Integers) -> tuple[Doubles, Doubles]:
    """Return members of the recurrence in the unit square."""
    return (0.5 + 0.7548776662466927 * index) % 1, (0.5 + 0.5698402909980532 * index) % 1


def lifted(spots: Spots) -> Doubles:
    """Return the points from which rays leave, clear of the surface by more than a tracer's tolerance.

    A fifth of a footprint: too little to be seen.
    """
    return spots.position + (0.03 + 0.2 * spots.footprint)[:, None] * spots.normal


def frame(normal: npt.NDArray[np.floating]) -> tuple[Doubles, Doubles]:
    """Return two unit vectors across unit vectors, (n, 3) each (Duff et al. 2017, JCGT 6(1))."""
    x, y, z = (normal[:, axis].astype(np.float64) for axis in range(3))
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return first, np.stack([b, sign + y * y * a, -y], axis=1)


def sun_share(tracer: Tracer, spots: Spots, sun: Sun, turn: Integers, rays: int) -> Singles:
    """Return the share of `rays` towards the sun's disc that nothing stops, (n,), run number `turn` of them."""
    towards = np.array(sun.direction)
    share = np.zeros(len(turn), np.float32)
    start = lifted(spots)
    facing = spots.normal @ towards.astype(np.float32) > 0
    right, up = frame(towards[None])
    width = math.tan(math.radians(sun.diameter / 2))
    for ray in range(rays):
        across, around = spread(turn[facing] * rays + ray)
        radius, angle = width * np.sqrt(across), 2 * math.pi * around
        aim = towards + (radius * np.cos(angle))[:, None] * right + (radius * np.sin(angle))[:, None] * up
        share[facing] += free(tracer, start[facing], aim / np.linalg.norm(aim, axis=1)[:, None])
    return share / np.float32(rays)


def sky_share(tracer: Tracer, spots: Spots, turn: Integers, rays: int) -> Singles:
    """Return the share of the sky's light that reaches spots, (n,): that of `rays`, run number `turn` of them.

    Rays crowd around the normal by the cosine of the angle to it, as light counts.  Those that would go below the
    horizon see ground anyway and count as free; who uses the share knows what light comes from there.
    """
    start, normal = lifted(spots), spots.normal.astype(np.float64)
    right, up = frame(normal)
    blocked = np.zeros(len(turn), np.float32)
    for ray in range(rays):
        across, around = spread(turn * rays + ray)
        radius, angle = np.sqrt(across), 2 * math.pi * around
        aim = (radius * np.cos(angle))[:, None] * right + (radius * np.sin(angle))[:, None] * up
        aim += np.sqrt(1 - across)[:, None] * normal
        rising = aim[:, 2] > 0
        blocked[rising] += ~free(tracer, start[rising], aim[rising])
    return 1 - blocked / np.float32(rays)


def free(tracer: Tracer, start: Doubles, direction: Doubles) -> Flags:
    """Say which rays hit nothing."""
    if len(start) == 0:
        return np.zeros(0, np.bool_)
    return np.isinf(tracer(Rays(start, direction)).depth)


class Facets(NamedTuple):
    """Where samples of a picture lie: relative positions and normals, (rows, cols, 3), footprints and whether they hit
    anything, (rows, cols).
    """

    position: Singles
    normal: Singles
    footprint: Singles
    hit: Flags

    def same(self, apart: Singles, normal: Singles, where: Any) -> Flags:
        """Say whether what lies `apart` (m) from facets and has those normals belongs to the same surface.

        It may be off their tangent plane by two footprints, and turned away by 37 degrees.
        """
        off = np.abs((apart * self.normal[where]).sum(axis=-1))
        turned = (normal * self.normal[where]).sum(axis=-1)
        found: Flags = (turned > 0.8) & (off <= 2 * self.footprint[where])
        return found


def smoothed(values: Singles, facets: Facets, context: Context) -> Singles:
    """Return means over 4 by 4 neighbours that lie on the same surface.

    First along columns, then along rows, with weights 1/2 1 1 1 1/2, so that each of 4 turns counts the same.
    """
    for axis in (0, 1):
        total, count = np.zeros_like(values), np.full_like(values, 1e-9)
        for shift in range(-2, 3):
            weight = np.float32(0.5 if abs(shift) == 2 else 1.0)
            for here, there in _shifted(shift, axis, values.shape):
                context.progress(None)
                apart = facets.position[there] - facets.position[here]
                same = facets.hit[there] & facets.same(apart, facets.normal[there], here)
                total[here] += weight * same * values[there]
                count[here] += weight * same
        values = total / count
    return values


def _shifted(
    shift: int, axis: int, shape: tuple[int, ...]
) -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Yield windows of samples and of their neighbours `shift` further on, in parts that a core's cache holds."""
    side = shape[axis]
    first, last = max(0, -shift), min(side, side - shift)
    if first >= last:
        return
    own, other = slice(first, last), slice(first + shift, last + shift)
    if axis == 1:
        for row in range(0, shape[0], 64):
            yield (slice(row, row + 64), own), (slice(row, row + 64), other)
    else:
        for row in range(first, last, 64):
            end = min(last, row + 64)
            yield (slice(row, end), slice(None)), (slice(row + shift, end + shift), slice(None))
