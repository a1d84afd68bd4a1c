"""The sums of `noise`, one function each: values and exact gradients of blocks of points, in float64.

All take the lattices of the octaves, points (x, y) in metres of one shape, and the filters b_i: None for 1, or an array
whose first axis is the octaves, with one number for each or one for each point.  Unless `slopes`, gradients are empty.
The equations stand in `noise`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.gradient_noise import gradient_noise

Floats = npt.NDArray[np.float64]
Filter = Floats | np.float64

OFFSET = 0.7
"""What `hybrid` adds to each octave, as Musgrave does."""


class Sample(NamedTuple):
    """Values and their derivatives per metre towards east (x) and north (y), of one shape."""

    value: Floats
    east: Floats
    north: Floats


class Lattice(NamedTuple):
    """The lattice of one octave: at (x, y) in metres the cells are ((xx, xy), (yx, yy)) (x, y) + (u0, v0)."""

    seed: int
    amplitude: float
    frequency: float
    xx: float
    xy: float
    yx: float
    yy: float
    u0: float
    v0: float
    octave: int


Lattices = Sequence[Lattice]


def cells_of(lattice: Lattice, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return where points lie on a lattice, in cells."""
    return x * lattice.xx + y * lattice.xy + lattice.u0, x * lattice.yx + y * lattice.yy + lattice.v0


def fbm(lattices: Lattices, x: Floats, y: Floats, b: Floats | None, slopes: bool) -> Sample:
    """Return fractional Brownian motion, sum a_i b_i n_i."""
    value, east, north = _zeros(x, slopes)
    for n, factor, _ in _octaves(lattices, x, y, b, slopes):
        value += factor * n.value
        if slopes:
            east += factor * n.east
            north += factor * n.north
    return Sample(value, east, north)


def billow(lattices: Lattices, x: Floats, y: Floats, b: Floats | None, slopes: bool) -> Sample:
    """Return Perlin's turbulence, sum a_i b_i |n_i|; the gradient is 0 in the creases, where n_i is 0."""
    value, east, north = _zeros(x, slopes)
    for n, factor, _ in _octaves(lattices, x, y, b, slopes):
        value += factor * np.abs(n.value)
        if slopes:
            signed = factor * np.sign(n.value)
            east += signed * n.east
            north += signed * n.north
    return Sample(value, east, north)


def ridged(lattices: Lattices, x: Floats, y: Floats, b: Floats | None, slopes: bool, feedback: float) -> Sample:
    """Return the ridged multifractal: sum a_i b_i s_i, s_i = (1 - |n_i|)^2 w_i; on a crest the gradient is 0."""
    total, weight = _zeros(x, slopes), _zeros(x, slopes)
    weight.value[...] = 1
    for n, factor, mix in _octaves(lattices, x, y, b, slopes):
        depth = 1 - np.abs(n.value)
        rate = -2 * depth * np.sign(n.value) if slopes else depth
        _add(total, weight, n, depth * depth, rate, feedback, factor, mix)
    return total


def hybrid(lattices: Lattices, x: Floats, y: Floats, b: Floats | None, slopes: bool, feedback: float) -> Sample:
    """Return the hybrid multifractal: sum a_i b_i s_i, s_i = (n_i + o)/(1 + o) w_i."""
    total, weight = _zeros(x, slopes), _zeros(x, slopes)
    weight.value[...] = 1
    rate = 1 / (1 + OFFSET)
    for n, factor, mix in _octaves(lattices, x, y, b, slopes):
        _add(total, weight, n, (n.value + OFFSET) * rate, rate, feedback * (1 + OFFSET), factor, mix)
    return total


def warped(
    lattices: Lattices, across: Lattices, along: Lattices, x: Floats, y: Floats, b: Floats | None, slopes: bool
) -> Sample:
    """Return fbm at points displaced by fbm: `across` and `along` have amplitudes in metres towards east and north."""
    q, r = fbm(across, x, y, b, slopes), fbm(along, x, y, b, slopes)
    inner = fbm(lattices, x + q.value, y + r.value, b, slopes)
    if not slopes:
        return inner
    east = inner.east * (1 + q.east) + inner.north * r.east
    north = inner.east * q.north + inner.north * (1 + r.north)
    return Sample(inner.value, east, north)


def _add(
    total: Sample,
    weight: Sample,
    n: Sample,
    signal: Floats,
    rate: Floats | float,
    feedback: float,
    factor: Filter | float,
    mix: Filter | None,
) -> None:
    """Add an octave to a multifractal, and turn its weight w_i into that of the next.

    With s = w signal the sum grows by factor s, and w goes to clamp(feedback s, 0, 1) or as far there as `mix` says.
    `rate` is d signal / d n.
    """
    weighted = weight.value * signal
    after = feedback * weighted
    if weight.east.size:
        free = (after > 0) & (after < 1)
        for sums, weights, along in ((total.east, weight.east, n.east), (total.north, weight.north, n.north)):
            slope = weights * signal + weight.value * (rate * along)
            sums += factor * slope
            slope = np.where(free, feedback * slope, 0.0)
            weights[...] = slope if mix is None else (1 - mix) * weights + mix * slope
    total.value[...] += factor * weighted
    np.clip(after, 0, 1, out=after)
    weight.value[...] = after if mix is None else (1 - mix) * weight.value + mix * after


def _octaves(
    lattices: Lattices, x: Floats, y: Floats, b: Floats | None, slopes: bool
) -> Iterator[tuple[Sample, Filter | float, Filter | None]]:
    """Yield n_i with its derivatives, a_i b_i and b_i (None for 1) of the octaves that are not filtered out."""
    for lattice in lattices:
        mix = None if b is None else b[lattice.octave]
        if mix is not None and not np.any(mix):
            continue
        n, east, north = gradient_noise(*cells_of(lattice, x, y), lattice.seed, slopes)
        if slopes:
            along_u, along_v = east, north
            east = along_u * lattice.xx + along_v * lattice.yx
            north = along_u * lattice.xy + along_v * lattice.yy
        yield Sample(n, east, north), lattice.amplitude if mix is None else lattice.amplitude * mix, mix


def _zeros(x: Floats, slopes: bool) -> Sample:
    return Sample(np.zeros(x.shape), *(np.zeros(x.shape if slopes else (0,)) for _ in range(2)))
