"""Bounds of the sums of `noise`, of value and slope: everywhere, and in a box.

**In a box.**  The box is cut into equal patches.  In each patch a quantity q is known by an interval of its values, its
value at the centre c, and a ball B(g, s) that holds grad q(p) for all p of the patch (`Patches`).  Gradients add up as
vectors, so that octaves that rise in different directions cancel, as they do in the sum itself.

- *An octave.*  With the half diagonal r of the patch in cells, L = `LIPSCHITZ`, H = `CURVATURE`: grad n is in
  B(grad n(c), H r) and in B(0, L), so in the smallest ball around what these share (`_shared`); |n - n(c)| is at most
  min(|grad n(c)| r + H r^2 / 2, L r), for a patch is convex.  Octaves whose cells are small against the patches are not
  looked at: [-1, 1] and B(0, L).
- *|q|*: B(g, s), B(-g, s), or B(0, |g| + s) where q may have either sign.
- *Products* of a in [a_m - d, a_m + d], grad a in B(g, s), with b >= 0 in [b_m - e, b_m + e], grad b in B(h, t):
  grad ab = b grad a + a grad b is in B(b_m g + a_m h, e |g| + sup b s + d |h| + sup |a| t).
- *min(1, q)* is level where q >= 1, and elsewhere as steep as q can be while it is below 1 (`steepest_below`).
- At last |q - q(c)| <= (|g| + s) r, which is nearer than the sum of what the octaves are off by (`anchored`).

`fbm` and `billow` sum such octaves.  The multifractals carry the state of the feedback along: `hybrid` its weight w,
`ridged` the root y of it, which is tamer: with d_i = 1 - |n_i|, s_i = (d_i y_i)^2 and y_(i+1) = min(1, sqrt(F) d_i
y_i), where d is as steep as n, and slopes grow from octave to octave by sqrt(F), not by F.  `warped` sums fbm in
patches around the displaced centres, as much larger as the displacement can differ from that of the centre, and turns
its gradients by (I + D grad q)^T.

**Everywhere** (`slope_everywhere`), with the filters b_i:

- fbm, billow: sum a_i b_i f_i L (a rotation keeps lengths, a frequency multiplies slopes).
- ridged: lambda(s_i) <= 2 (f_i L + lambda(y_i)), and lambda(y_(i+1)) <= sqrt(F) max(f_i L + c lambda(y_i), c f_i L +
  lambda(y_i)), c = min(1, 1/sqrt(F)): where d y <= c, |grad(d y)| <= f L y + d lambda(y), which is convex along
  d y = c, hence greatest at its ends.  A filter mixes squares, y^2 = (1 - b) y_0^2 + b y_1^2, so that, by Cauchy,
  |grad y|^2 <= (1 - b) |grad y_0|^2 + b |grad y_1|^2.
- hybrid: with v = (n + o)/(1 + o), in the same way lambda(s_i) <= l + lambda(w_i) with l = f_i L/(1 + o), and
  lambda(w_(i+1)) <= G max(l + c lambda(w_i), c l + lambda(w_i)) with G = F (1 + o), c = min(1, 1/G).
- warped: lambda(fbm) (1 + sqrt(2) D lambda(q)), from |I + D grad q| <= 1 + D sqrt(lambda(q_x)^2 + lambda(q_y)^2).

What is not looked at in a box goes on from the state of each patch in the same way, with its sup in place of 1.

**How tight.**  The greatest slope that a search finds, over the bound, for 8 octaves in boxes of so many wavelengths
(median of 40 boxes; in brackets over `slope_everywhere`):

========  ===========  ===========  ===========  ===========
kind      0.02         0.1          1            10
========  ===========  ===========  ===========  ===========
gradient  90 % (39 %)  93 % (48 %)  75 % (71 %)  93 % (93 %)
fbm       60 % (24 %)  51 % (35 %)  46 % (46 %)  50 % (50 %)
billow    60 % (31 %)  52 % (40 %)  47 % (47 %)  49 % (49 %)
ridged    44 % (12 %)  28 % (17 %)  22 % (22 %)  23 % (23 %)
hybrid    51 % (2 %)   20 % (3 %)   4 % (4 %)    4 % (4 %)
warped    52 % (10 %)  41 % (14 %)  26 % (23 %)  26 % (26 %)
========  ===========  ===========  ===========  ===========

The finest octaves are what is left: where cells are smaller than patches nothing keeps their steepest places apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.gradient_noise import CURVATURE, FARTHEST, LIPSCHITZ, gradient_noise
from nodegraph_terrain.noise_sums import OFFSET, Lattice
from nodegraph_terrain.patches import Patches, anchored, cut, folded, product, square, steepest, steepest_below

Floats = npt.NDArray[np.float64]

FINEST = 0.2
"""Half diagonal of a patch, in cells, up to which an octave is looked at; beyond, L bounds it almost as well."""

MOST_PATCHES = 12
"""Patches along a side, at most."""

FLATTEST = 0.01
"""Half diagonal of a patch, in cells of the finest octave, that is small enough: H times this is 0.13."""

ROUNDING = 1e-14
"""What rounding may do to a place, over its coordinates, to a value, and to a slope, over the highest frequency: some
units in the last place."""

# Everywhere.


def slope_everywhere(kind: str, lattices: Sequence[Lattice], warps: int, feedback: float, b: Floats) -> float:
    """Return the greatest slope per metre that a sum can have, with its octaves weighted by b_i.

    Args:
        kind: of the sum, as in `Noise`.
        lattices: of the sum, then those of the two components of the displacement.
        warps: how many lattices each component has.
        feedback: F.
        b: for each octave; the slope never falls when one rises.
    """
    octaves, moving = lattices[: len(b)], lattices[len(b) : len(b) + warps]
    if kind in ("ridged", "hybrid"):
        return float(_unseen(kind == "ridged", octaves, _rate(kind, feedback), b, np.ones(1), np.zeros(1))[2, 0])
    slope, shift = (sum(_factor(item, b) * LIPSCHITZ * item.frequency for item in group) for group in (octaves, moving))
    return slope * (1 + math.sqrt(2) * shift)


def _factor(lattice: Lattice, b: Floats) -> float:
    return lattice.amplitude * float(b[lattice.octave])


def _rate(kind: str, feedback: float) -> float:
    """Return what the product of signal and state is multiplied by for the next state."""
    return math.sqrt(feedback) if kind == "ridged" else feedback * (1 + OFFSET)


def _unseen(ridged: bool, lattices: Sequence[Lattice], rate: float, b: Floats, state: Floats, steep: Floats) -> Floats:
    """Return least and greatest value and slope that octaves of a multifractal can add, of which nothing is known.

    Args:
        ridged: whether s_i is the square of signal and state, or just their product.
        lattices: of the octaves.
        rate: of `_rate`.
        b: the filters.
        state, steep: bounds of the state before these octaves and of its slope.
    """
    limit = 1 / max(rate, 1e-150)
    added = np.zeros((3, *state.shape))
    for lattice in lattices:
        factor, mix = _factor(lattice, b), float(b[lattice.octave])
        own = LIPSCHITZ * lattice.frequency * (1 if ridged else 1 / (1 + OFFSET))
        along = state * own + steep
        if ridged:
            added[1] += factor * state * state
            added[2] += factor * 2 * state * along
        else:
            added[0] -= factor * (1 - OFFSET) / (1 + OFFSET) * state
            added[1] += factor * state
            added[2] += factor * along
        share = np.minimum(1.0, limit / np.maximum(state, 1e-150))
        risen = rate * np.maximum(share * state * own + steep, state * own + share * steep)
        risen, after = np.maximum(risen, steep), np.maximum(np.minimum(rate * state, 1.0), state)
        if ridged:
            state, steep = (np.sqrt(x * x + mix * (y * y - x * x)) for x, y in ((state, after), (steep, risen)))
        else:
            state, steep = (x + mix * (y - x) for x, y in ((state, after), (steep, risen)))
    return added


# In a box.


def bounds_in(
    kind: str,
    lattices: Sequence[Lattice],
    warps: int,
    feedback: float,
    b: Floats,
    box: tuple[float, float, float, float],
) -> tuple[float, float, float] | None:
    """Return least and greatest value and the greatest slope of a sum in a box; None where that says nothing new.

    Args:
        kind, lattices, warps, feedback, b: as for `slope_everywhere`.
        box: west, south, east, north, m.
    """
    octaves = [lattice for lattice in lattices[: len(b)] if b[lattice.octave] > 0]
    west, south, east, north = box
    if not octaves or not math.isfinite(east - west + north - south):
        return None
    x, y, radius = _patches(box, octaves[-1].frequency)
    if octaves[0].frequency * radius > FINEST:
        return None
    if kind in ("ridged", "hybrid"):
        found = _multifractal(kind == "ridged", octaves, _rate(kind, feedback), b, x, y, radius)
    elif kind == "warped":
        found = _warped(octaves, lattices[len(b) : len(b) + warps], lattices[len(b) + warps :], b, x, y, radius)
    else:
        found = _sum(octaves, b, x, y, radius, billow=kind == "billow")
    slope = float(steepest(found).max()) * (1 + 1e-12) + ROUNDING * octaves[-1].frequency
    return float(found[0].min()) - ROUNDING, float(found[1].max()) + ROUNDING, slope


def _patches(box: tuple[float, float, float, float], finest: float) -> tuple[Floats, Floats, float]:
    """Return the centres of patches that cover a box, and the half diagonal of one, m."""
    west, south, east, north = box
    width, height = east - west, north - south
    side = max(math.sqrt(2) * FLATTEST / finest, math.sqrt(width * height) / MOST_PATCHES)
    side = max(side, width / MOST_PATCHES**2, height / MOST_PATCHES**2)
    columns, rows = max(1, round(width / side)), max(1, round(height / side))
    x = west + width / columns * (np.arange(columns) + 0.5)
    y = south + height / rows * (np.arange(rows) + 0.5)
    radius = 0.5 * math.hypot(width / columns, height / rows) * (1 + 1e-12)
    radius += ROUNDING * max(map(abs, box))
    return np.tile(x, rows), np.repeat(y, columns), radius


def _coarse(lattices: Sequence[Lattice], x: Floats, y: Floats, radius: Floats | float) -> Sequence[Lattice]:
    """Return those octaves, the first ones, whose cells are large enough against patches around points."""
    # What is too far away is for `sample` to refuse.
    widest, farthest = float(np.max(radius)), 2 * float(np.abs(x).max() + np.abs(y).max())
    highest = min(FINEST / max(widest, 1e-300), FARTHEST / max(farthest, 1e-300))
    return [lattice for lattice in lattices if lattice.frequency <= highest]


def _octaves(lattices: Sequence[Lattice], x: Floats, y: Floats, radius: Floats | float) -> Patches:
    """Return n_i of those octaves that are coarse enough in patches around points, (6, octaves, points)."""
    coarse = _coarse(lattices, x, y, radius)
    if not coarse:
        return np.zeros((6, 0, len(x)))
    frames = np.array([(item.xx, item.xy, item.yx, item.yy, item.u0, item.v0, item.frequency) for item in coarse])
    xx, xy, yx, yy, u0, v0, frequency = frames.T[:, :, None]
    seeds = np.array([item.seed for item in coarse], np.uint32)[:, None]
    u, v = x * xx + y * xy + u0, x * yx + y * yy + v0
    half = frequency * radius
    value, along_u, along_v = gradient_noise(u, v, seeds, True)
    steep = np.hypot(along_u, along_v)
    reach = half * np.minimum(steep + 0.5 * CURVATURE * half, LIPSCHITZ)
    pulled, spread = _shared(steep, CURVATURE * half)
    along_u *= pulled
    along_v *= pulled
    return np.stack(
        [
            np.maximum(value - reach, -1),
            np.minimum(value + reach, 1),
            value,
            along_u * xx + along_v * yx,
            along_u * xy + along_v * yy,
            spread * frequency,
        ]
    )


def _sum(
    lattices: Sequence[Lattice], b: Floats, x: Floats, y: Floats, radius: Floats | float, *, billow: bool = False
) -> Patches:
    """Return sum a_i b_i n_i, or that of abs(n_i)."""
    octaves = _octaves(lattices, x, y, radius)
    factors = np.array([_factor(item, b) for item in lattices])
    seen = octaves.shape[1]
    found = anchored(factors[:seen] @ (folded(octaves) if billow else octaves), radius)
    unseen = float(factors[seen:].sum())
    found[0] -= 0.0 if billow else unseen
    found[1] += unseen
    found[5] += LIPSCHITZ * float(factors[seen:] @ [item.frequency for item in lattices[seen:]])
    return found


def _multifractal(
    ridged: bool, lattices: Sequence[Lattice], rate: float, b: Floats, x: Floats, y: Floats, radius: float
) -> Patches:
    """Return sum a_i b_i s_i, carrying the state from octave to octave."""
    signals = _octaves(lattices, x, y, radius)
    if ridged:
        signals = folded(signals)
        signals[:5] *= -1
        signals[:3] = 1 + signals[[1, 0, 2]]
    else:
        signals[:3] += OFFSET
        signals /= 1 + OFFSET
    seen = signals.shape[1]
    total, state = np.zeros((2, 6, len(x)))
    state[:3] = 1
    for index, lattice in enumerate(lattices[:seen]):
        signal, mix = signals[:, index], float(b[lattice.octave])
        made = product(signal, state)
        total += _factor(lattice, b) * (square(made) if ridged else made)
        after = cut(made, steepest_below(signal, state, rate), rate)
        if mix == 1:
            state = after
        elif not ridged:
            state = (1 - mix) * state + mix * after
        else:
            before, after = (np.stack([*item[:3], steepest(item)]) for item in (state, after))
            state = np.zeros_like(state)
            state[[0, 1, 2, 5]] = np.sqrt((1 - mix) * before**2 + mix * after**2)
    total = anchored(total, radius)
    total[[0, 1, 5]] += _unseen(ridged, lattices[seen:], rate, b, state[1], steepest(state))
    return total


def _shared(length: Floats, spread: Floats) -> tuple[Floats, Floats]:
    """Return the smallest ball around what B(g, spread) and B(0, L) share, |g| = length, as a factor of g and a radius.

    The spheres meet at x = (|g|^2 + L^2 - spread^2) / 2|g| along g, in a circle of radius sqrt(L^2 - x^2).  Where that
    plane lies between the centres the circle is the widest that they share; else the smaller ball lies at least half
    within the other.
    """
    limit = LIPSCHITZ * LIPSCHITZ
    length = np.maximum(length, 1e-300)
    plane = (length * length + limit - spread * spread) / (2 * length)
    inner = np.minimum(np.maximum(plane, 0.0), length)
    across = np.sqrt(np.maximum(limit - inner * inner, 0.0))
    return inner / length, np.where(plane >= length, spread, across)


def _warped(
    octaves: Sequence[Lattice],
    across: Sequence[Lattice],
    along: Sequence[Lattice],
    b: Floats,
    x: Floats,
    y: Floats,
    radius: float,
) -> Patches:
    """Return fbm in patches that are displaced by fbm: grad f = (I + D grad q)^T grad fbm."""
    q, r = (_sum(lattices, b, x, y, radius) for lattices in (across, along))
    # A patch's centre goes to (px, py), but for the octaves of q that are not looked at.
    px, py = x + q[2], y + r[2]
    away = radius + np.hypot(*(np.maximum(item[1] - item[2], item[2] - item[0]) for item in (q, r)))
    inner = _sum(octaves, b, px, py, away)
    (qx, qy, q_spread), (rx, ry, r_spread) = q[3:], r[3:]
    # The greatest singular value of I + D grad q at the centres of the balls.
    stretch = 0.5 * (np.hypot(2 + qx + ry, qy - rx) + np.hypot(qx - ry, qy + rx))
    found = inner.copy()
    found[3] += inner[3] * qx + inner[4] * rx
    found[4] += inner[3] * qy + inner[4] * ry
    found[5] = stretch * inner[5] + steepest(inner) * np.hypot(q_spread, r_spread)
    known = all(len(_coarse(part, x, y, radius)) == len(part) for part in (across, along))
    known = known and len(_coarse(octaves, px, py, away)) == len(octaves)
    return anchored(found, radius) if known else found
