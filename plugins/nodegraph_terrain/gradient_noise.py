"""Gradient noise in the plane: smooth, zero at the points of a square lattice, the same everywhere and for ever.

    n(u, v) = sum over the four corners c of the cell of (u, v) of  w_c(u, v) g_c . ((u, v) - c),

with (u, v) in cells, g_c a vector of length sqrt(2) whose direction is a hash of the corner and the seed, and w_c the
product of the fades s or 1 - s along both axes, s(t) = 6 t^5 - 15 t^4 + 10 t^3 (Perlin 2002).  First and second
derivatives are continuous.

**Range.**  |n| <= `BOUND` = 1.  The weights are not negative and sum to 1, so by Jensen |n|^2 <= 2 sum w_c |p - c|^2,
which splits into A(u) + A(v) with A(t) = t^2 + s(t) (1 - 2 t).  A is symmetric about 1/2, and s(t) <= t below it, so
A(t) <= t - t^2 <= 1/4: |n|^2 <= 2 (1/4 + 1/4) = 1.  So it is at the centre of a cell when all four vectors point at it.

**Slope.**  |grad n| <= `LIPSCHITZ` = 2.927 per cell.  For a unit vector e the directional derivative is the sum over
the corners of g_c . (w_c e + (grad w_c . e)(p - c)), at most S(p, e) = sqrt(2) sum |w_c e + (grad w_c . e)(p - c)|.
Its greatest value is sqrt(137)/4 = 2.92617, at the centre and along an axis, where each of the four terms is
sqrt(274)/32; bisection over p and e in the tests certifies S < 2.927 everywhere.  Where the four vectors happen to lie
so, slopes come that close.

**Mean.**  0 over the seeds at each point: with each direction its opposite is equally likely.

**Directions.**  2^25: a quadrant from two bits of the hash and 2^23 angles in it, by two short polynomials instead of
sine and cosine or a table (angles true to 0.3 degrees, lengths to 1.2e-4, never above sqrt(2)).

**Hash.**  Integer arithmetic modulo 2^32 without a table, so without a period within +-2^31 cells; what lies beyond is
refused.  The column passes through two multiplications before the row is joined to it by an exclusive or, and both
through two more.  Another bit in column, row or seed turns each bit of the direction with a probability of 1/2 +- 0.03,
but for the last bits of the angle; the constants were chosen by that.

`noise.h` holds the same for OpenCL.

References:
    K. Perlin (1985): An image synthesizer. SIGGRAPH. doi:10.1145/325334.325247.
    K. Perlin (2002): Improving noise. ACM Trans. Graph. 21(3). doi:10.1145/566654.566636.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Cells = npt.NDArray[np.uint32]

BOUND = 1.0
"""Greatest |n|."""

LIPSCHITZ = 2.927
"""Greatest slope of n, per cell; sqrt(137)/4 rounded up by 0.03 %."""

CURVATURE = 13.07
"""Greatest second derivative of n along any line, per cell squared."""

FARTHEST = 2147483000.0
"""Greatest distance from the origin of the lattice, in cells."""

_COLUMN, _ROW = np.uint32(0x9E3779B1), np.uint32(0x85EBCA77)
_MIX, _FIRST, _SECOND = np.uint32(0xC2B2AE3D), np.uint32(0x29F3126B), np.uint32(0xD35A2D97)
_EVEN = (0.9998835921287537, -1.1854443550109863)
_ODD = (1.5423520803451538, -0.4840468168258667)


def columns(x: Cells, seed: int | Cells) -> Cells:
    """Return the part of the hash that depends on the column of a lattice point."""
    h = x * _COLUMN
    h ^= np.uint32(seed)
    h ^= h >> np.uint32(15)
    h *= _MIX
    return h


def rows(y: Cells, seed: int | Cells) -> Cells:
    """Return the part of the hash that depends on the row of a lattice point."""
    h = y * _ROW + np.uint32(seed)
    h ^= h >> np.uint32(11)
    return h


def directions(column: Cells, row: Cells) -> tuple[Floats, Floats]:
    """Return the vectors of length sqrt(2) at lattice points, evenly spread over the circle, from `columns` and `rows`.

    With t in [-1/2, 1/2), sqrt(2) (cos, sin)(pi/4 + pi/2 t) = (E - O, E + O), where E is even in t and O odd.
    """
    h = column ^ row
    h ^= h >> np.uint32(17)
    h *= _FIRST
    h ^= h >> np.uint32(15)
    down = h >> np.uint32(31) != 0
    h *= _SECOND
    t = (h & np.uint32(0x7FFFFF)) * 2.0**-23 - 0.5
    square = t * t
    even = _EVEN[1] * square + _EVEN[0]
    odd = (_ODD[1] * square + _ODD[0]) * t
    east, north = even - odd, even + odd
    east[h >> np.uint32(31) != 0] *= -1
    north[down] *= -1
    return east, north


def gradient_noise(u: Floats, v: Floats, seed: int | Cells, slopes: bool = False) -> tuple[Floats, Floats, Floats]:
    """Return the noise at (u, v), in cells, and its derivatives along u and v (empty unless `slopes`).

    Args:
        u, v: coordinates, arrays of one shape (not zero-dimensional), at most `FARTHEST` from 0.
        seed: 0 to 2^32 - 1, or an array of such that broadcasts; seeds that differ in one bit give unrelated noise.
        slopes: whether to give the derivatives.

    Raises:
        ValueError: a coordinate is NaN or too far from 0.
    """
    left, low = np.floor(u), np.floor(v)
    if u.size and not max(left.max(), -left.min(), low.max(), -low.min()) <= FARTHEST:
        raise ValueError("coordinates must be finite and within 2^31 cells of noise of the origin")
    x, y = u - left, v - low
    column, row = left.astype(np.int64).astype(np.uint32), low.astype(np.int64).astype(np.uint32)
    near, far = columns(column, seed), columns(column + np.uint32(1), seed)
    bottom, top = rows(row, seed), rows(row + np.uint32(1), seed)
    x1, y1 = x - 1, y - 1
    east00, north00 = directions(near, bottom)
    east10, north10 = directions(far, bottom)
    east01, north01 = directions(near, top)
    east11, north11 = directions(far, top)
    n00, n10 = east00 * x + north00 * y, east10 * x1 + north10 * y
    n01, n11 = east01 * x + north01 * y1, east11 * x1 + north11 * y1
    sx, sy = fade(x), fade(y)
    lower, upper = n00 + sx * (n10 - n00), n01 + sx * (n11 - n01)
    value = lower + sy * (upper - lower)
    if not slopes:
        return value, _NONE, _NONE
    a, b = east00 + sx * (east10 - east00), east01 + sx * (east11 - east01)
    c, d = n10 - n00, n11 - n01
    along_u = a + sy * (b - a) + fade_slope(x) * (c + sy * (d - c))
    a, b = north00 + sx * (north10 - north00), north01 + sx * (north11 - north01)
    along_v = a + sy * (b - a) + fade_slope(y) * (upper - lower)
    return value, along_u, along_v


def fade(t: Floats) -> Floats:
    """Return 6 t^5 - 15 t^4 + 10 t^3: from 0 to 1 with level first and second derivatives at both ends."""
    faded: Floats = t * t * t * (t * (t * 6 - 15) + 10)
    return faded


def fade_slope(t: Floats) -> Floats:
    """Return the derivative of `fade`, 30 t^2 (t - 1)^2, at most 15/8."""
    bump = t * (t - 1)
    slope: Floats = 30 * bump * bump
    return slope


def scrambled(*words: int) -> int:
    """Return a 32-bit hash of integers, to draw one seed from another.

    >>> scrambled(7, 0) != scrambled(7, 1)
    True
    """
    h = 0x243F6A88
    for word in words:
        h ^= word & 0xFFFFFFFF
        for shift, factor in ((16, 0x21F0AAAD), (15, 0xD35A2D97)):
            h = (h ^ h >> shift) * factor & 0xFFFFFFFF
        h ^= h >> 15
    return h


_NONE = np.empty(0)
