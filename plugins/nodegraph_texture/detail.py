"""Noise at a level of detail: what of a sum of octaves a texel can show.

An octave whose lattice has cells of 2 texels or more counts whole, one of 1 texel or less not at all: it would only
alias, for gradient noise is strongest at waves of one and a half to two cells.  Between, its weight rises by the filter
of `nodegraph_terrain.noise`, over the logarithm.  So a coarse texture is a smooth version of a fine one, and continuous
in the size of texels.

What fades leaves its mean behind: that of ``billow``, ``ridged`` and ``hybrid`` is not 0, and without it far ground
would have other coverage than near ground.
"""

from __future__ import annotations

from functools import lru_cache
from math import log2
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.noise import Kind, Noise
from nodegraph_texture.layers import Roughness

GONE = 1.0
"""Texels to a cell of an octave's lattice, at which it is left out; twice as many show it whole."""

KAPPA = 0.5
"""Level of detail at which intervals are made to give each octave its weight."""

PLACES = 1 << 14
"""Points by which means are taken: true to 0.003 of the range."""

SIDE = 64.0
"""Side of the square that they lie in, in cells of the first octave."""


class Detail(NamedTuple):
    """The noise ``offset + factor noise(x, y)`` at the level of detail `kappa`; without noise, the offset alone."""

    noise: Noise | None
    kappa: float = 1.0
    factor: float = 1.0
    offset: float = 0.0

    def at(self, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
        """Return the values at points."""
        if self.noise is None:
            return np.full(np.broadcast_shapes(x.shape, y.shape), self.offset, np.float32)
        found = self.noise.value(x, y, kappa=None if self.kappa == 1 else self.kappa)
        return np.asarray(self.factor * found + self.offset, np.float32)


def detail_of(roughness: Roughness, texel: float) -> Detail:
    """Return what texels of some side, m, can show of a noise."""
    return _detail(
        roughness.kind, roughness.wavelength, roughness.octaves, roughness.gain, roughness.seed, float(texel)
    )


@lru_cache(maxsize=1024)
def _detail(kind: Kind, wavelength: float, octaves: int, gain: float, seed: int, texel: float) -> Detail:
    whole = Noise(kind, octaves, wavelength, gain=gain, seed=seed)
    scales = np.array([log2(wavelength / (GONE * texel)) - octave for octave in range(whole.count)])
    shown = np.clip(scales, 0.0, 1.0)
    if shown.min() == 1:
        return Detail(whole)
    mean = _mean(kind, octaves, gain)
    count = int(np.count_nonzero(shown))
    if not count:
        return Detail(None, offset=mean)
    # Octaves that are gone are left out, not weighed by 0: their lattices may be too fine to count cells on.  Two stay,
    # as they displace a warped noise.
    count = max(count, min(2, whole.count))
    intervals = tuple([_interval(float(share)) for share in shown[:count]])
    part = Noise(kind, count, wavelength, gain=gain, seed=seed, intervals=intervals)
    factor = float(whole.amplitudes[:count].sum())
    return Detail(part, KAPPA, factor, mean - factor * _mean(kind, count, gain, intervals))


def _interval(share: float) -> tuple[float, float]:
    """Return (k-, k+) such that t = (1/2 - k-) / (k+ - k-) is `share` where it is below 1, and at least 1 there."""
    if share >= 1:
        return 0.0, KAPPA
    return (0.0, KAPPA / share) if share > KAPPA else ((KAPPA - share) / (1 - share), 1.0)


@lru_cache(maxsize=1024)
def _mean(kind: Kind, octaves: int, gain: float, intervals: tuple[tuple[float, float], ...] = ()) -> float:
    """Return the mean of a noise over the plane, 0 for those that are symmetric, else by a lattice of many points."""
    if kind not in ("billow", "ridged", "hybrid"):
        return 0.0
    # Irrational steps (the plastic number's) spread points evenly over the cells of all octaves.
    place = np.arange(PLACES)
    x, y = (np.mod(place * step, 1.0) * SIDE for step in (0.7548776662466927, 0.5698402909980532))
    noise = Noise(kind, octaves, 1.0, gain=gain, intervals=intervals)
    return float(noise.value(x, y, kappa=KAPPA if intervals else None).mean())
