"""Sums of gradient noise, of many scales each: what rough ground is made of.

A `Noise` says which sum with which parameters.  It gives values and exact gradients at points on the host, in float64;
bounds of the value and of the slope; and the tables from which `noise.h` gives the same in OpenCL.  With n_i the
`gradient_noise` of octave i, of frequency f_i = lacunarity^i / wavelength, and a_i proportional to gain^i:

==========  ======================================================================  ==================
``kind``    value                                                                   range
==========  ======================================================================  ==================
gradient    n_0                                                                     [-1, 1], mean 0
fbm         sum a_i n_i                                                             [-1, 1], mean 0
billow      sum a_i abs(n_i)                                                        [0, 1]
ridged      sum a_i s_i,  s_i = (1 - abs(n_i))^2 w_i,  w_(i+1) = min(1, F s_i)      [0, 1]
hybrid      sum a_i s_i,  s_i = (n_i + o)/(1 + o) w_i, w_(i+1) = clamp(F (1+o) s_i) [-0.176, 1], o = 0.7
warped      fbm at p + D (q_x, q_y)(p), each q an fbm of two octaves at most        [-1, 1], mean 0
==========  ======================================================================  ==================

where sum a_i = 1, w_0 = 1, F is the `feedback` and D = warp * wavelength.  `ridged` and `hybrid` are Musgrave's
multifractals: rough where they are high.  His hybrid multiplies the weight by gain^i too and lets it fall below 0; here
`gain` alone makes the spectrum, and basins are smooth.  `billow` is Perlin's turbulence.

Every octave has a seed, an offset and a rotation of its own (by the golden section of a right angle), so that neither
the zeros nor the axes of the lattices coincide; two seeds give unrelated noise.

**Level of detail.**  Octave i counts by b_i in [0, 1]: its amplitude is multiplied by b_i, and what it does to later
octaves fades with it, w_(i+1) = (1 - b_i) w_i + b_i min(1, F s_i).  With `kappa` in [0, 1], b_i = 1 - (1 - t^2)^3 where
t runs from 0 to 1 over the octave's interval [k_i-, k_i+]; by default these split [0, 1] evenly, coarse octaves first,
so kappa = 0 is level ground and kappa = 1 all detail.  Gradients are those at a fixed kappa.

**Bounds.**  `Noise.bounds` and `Noise.lipschitz` hold everywhere and `Noise.bounds_in` in a box, where it knows the
octaves that are not much finer than the box; `noise_bounds` says how and proves it.  Value bounds and slope bounds
never fall when a b_i rises: those of the greatest kappa hold for every smaller one.

References:
    K. Perlin (1985): An image synthesizer. SIGGRAPH. doi:10.1145/325334.325247.
    F. K. Musgrave, C. E. Kolb, R. S. Mace (1989): The synthesis and rendering of eroded fractal terrains. SIGGRAPH.
    doi:10.1145/74333.74337.
    F. K. Musgrave in D. S. Ebert et al. (2003): Texturing and Modeling: A Procedural Approach. 3rd ed., chapter 16.
    J.-D. Genevaux et al. (2015): Terrain modelling from feature primitives. Computer Graphics Forum 34(6).
    doi:10.1111/cgf.12530.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.gradient_noise import FARTHEST, scrambled
from nodegraph_terrain.noise_bounds import bounds_in, slope_everywhere
from nodegraph_terrain.noise_sums import OFFSET, Lattice, Sample, billow, cells_of, fbm, hybrid, ridged, warped

Kind = Literal["gradient", "fbm", "billow", "ridged", "hybrid", "warped"]
Floats = npt.NDArray[np.float64]
Words = npt.NDArray[np.uint32]

KINDS: tuple[Kind, ...] = get_args(Kind)
CODES: dict[Kind, int] = {"gradient": 0, "fbm": 0, "billow": 1, "ridged": 2, "hybrid": 3, "warped": 4}
"""The kinds as `noise.h` numbers them."""

MOST = 24
"""Greatest number of octaves."""

WARPS = 2
"""Octaves of the displacement of `warped`, at most."""

BLOCK = 1 << 14
"""Points that the host makes at a time, so that temporaries stay in a core's cache."""

RECORD = 8
"""32-bit words of a record of `Noise.table`."""

_TURN = (math.sqrt(5) - 1) / 2 * math.pi / 2


@dataclass(frozen=True)
class Noise:
    """A sum of octaves of gradient noise; see the module for what each kind is.

    Attributes:
        kind: ``gradient``, ``fbm``, ``billow``, ``ridged``, ``hybrid`` or ``warped``.
        octaves: how many scales, 1 to 24; ``gradient`` has one.
        wavelength: cell of the first octave's lattice, m, greater than 0.
        lacunarity: frequency of an octave over that of the one before, 1 to 16.
        gain: amplitude of an octave over that of the one before, 0 to 2.  0.5 at a lacunarity of 2 makes ground that
            looks equally rough at all scales; Musgrave's H is -log(gain)/log(lacunarity).
        seed: 0 to 2^32 - 1.
        feedback: how much height lets the next octave in, for ``ridged`` and ``hybrid``; 0 to 16.
        warp: displacement of ``warped`` in wavelengths, 0 to 4.
        intervals: (k-, k+) of each octave on the axis of kappa, 0 <= k- < k+ <= 1; empty for the even split.

    Raises:
        ValueError: a parameter is out of range or NaN.

    >>> noise = Noise("fbm", octaves=2, wavelength=100.0)
    >>> noise.bounds(), round(noise.lipschitz(), 4)
    ((-1.0, 1.0), 0.039)
    >>> noise.sample([10.0, 20.0], [5.0, 5.0]).value.shape
    (2,)
    """

    kind: Kind = "fbm"
    octaves: int = 8
    wavelength: float = 1000.0
    lacunarity: float = 2.0
    gain: float = 0.5
    seed: int = 0
    feedback: float = 2.0
    warp: float = 0.3
    intervals: tuple[tuple[float, float], ...] = ()
    lattices: tuple[Lattice, ...] = field(init=False, repr=False, compare=False)
    """The lattices that are summed, then those of the two components of the displacement."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"noise kind '{self.kind}' must be one of {', '.join(KINDS)}")
        _within("octaves", self.octaves, 1, MOST)
        _within("wavelength", self.wavelength, 1e-9, 1e15)
        _within("lacunarity", self.lacunarity, 1, 16)
        _within("gain", self.gain, 0, 2)
        _within("seed", self.seed, 0, 0xFFFFFFFF)
        _within("feedback", self.feedback, 0, 16)
        _within("warp", self.warp, 0, 4)
        if self.intervals and len(self.intervals) != self.count:
            raise ValueError(f"{len(self.intervals)} intervals do not fit {self.count} octaves; give one for each")
        for low, high in self.intervals:
            if not 0 <= low < high <= 1:
                raise ValueError(f"interval ({low}, {high}) must rise within 0 to 1")
        object.__setattr__(self, "lattices", self._lattices())

    @property
    def count(self) -> int:
        """How many octaves there are: 1 for ``gradient``."""
        return 1 if self.kind == "gradient" else self.octaves

    @property
    def warps(self) -> int:
        """Octaves of each component of the displacement; 0 unless ``warped``."""
        return min(WARPS, self.octaves) if self.kind == "warped" else 0

    @property
    def amplitudes(self) -> Floats:
        """a_i, which sum to 1."""
        return _amplitudes(self.gain, self.count)

    # Points.

    def sample(
        self,
        x: npt.ArrayLike,
        y: npt.ArrayLike,
        *,
        kappa: npt.ArrayLike | None = None,
        weights: npt.ArrayLike | None = None,
    ) -> Sample:
        """Return values and gradients at points.

        Args:
            x, y: coordinates towards east and north, m; arrays or numbers that broadcast, such as a row of x against a
                column of y.
            kappa: level of detail in [0, 1], a number or one for each point; all octaves by default.
            weights: b_i instead, of shape (octaves,) or (octaves, *shape of the points).

        Raises:
            ValueError: a coordinate is NaN or farther than 2^31 cells of the finest octave, or kappa or weights are not
                in [0, 1].
        """
        return self._sample(x, y, kappa, weights, True)

    def value(
        self,
        x: npt.ArrayLike,
        y: npt.ArrayLike,
        *,
        kappa: npt.ArrayLike | None = None,
        weights: npt.ArrayLike | None = None,
    ) -> Floats:
        """Return the values that `sample` gives, in less time."""
        return self._sample(x, y, kappa, weights, False).value

    # What holds everywhere.

    def weights(self, kappa: npt.ArrayLike) -> Floats:
        """Return b_i at levels of detail, of shape (octaves, *shape of kappa); each rises with kappa from 0 to 1.

        >>> Noise(octaves=2, wavelength=1.0).weights(0.25).tolist()
        [0.578125, 0.0]

        Raises:
            ValueError: kappa is not in [0, 1].
        """
        levels = np.asarray(kappa, np.float64)
        if levels.size and not (levels.min() >= 0 and levels.max() <= 1):
            raise ValueError("the level of detail kappa must be in [0, 1]")
        weights = np.empty((self.count, *levels.shape))
        for octave, (low, high) in enumerate(self._intervals()):
            t = np.clip((levels - low) * (1 / (high - low)), 0, 1)
            weights[octave] = 1 - (1 - t * t) ** 3
        return weights

    def bounds(self, weights: npt.ArrayLike | None = None) -> tuple[float, float]:
        """Return least and greatest values that the sum can have, with octaves weighted by b_i where given."""
        reach = float(np.dot(self.amplitudes, self._scalars(weights)))
        if self.kind in ("ridged", "billow"):
            return 0.0, reach
        return (-reach * (1 - OFFSET) / (1 + OFFSET) if self.kind == "hybrid" else -reach), reach

    def lipschitz(self, weights: npt.ArrayLike | None = None) -> float:
        """Return the greatest slope per metre that the sum can have, with octaves weighted by b_i where given."""
        if weights is None:
            return self._steepest
        return slope_everywhere(self.kind, self.lattices, self.warps, self.feedback, self._scalars(weights))

    @cached_property
    def _steepest(self) -> float:
        return slope_everywhere(self.kind, self.lattices, self.warps, self.feedback, np.ones(self.count))

    def bounds_in(
        self, west: float, south: float, east: float, north: float, weights: npt.ArrayLike | None = None
    ) -> tuple[float, float, float]:
        """Return least and greatest value and the greatest slope per metre in a box, which may be infinite.

        Tight where the box is small against a wavelength, and those of `bounds` and `lipschitz` where it is large.

        >>> noise = Noise("fbm", octaves=2, wavelength=100.0)
        >>> low, high, slope = noise.bounds_in(0.0, 0.0, 5.0, 5.0)
        >>> high - low < 0.1 and slope < 0.5 * noise.lipschitz()
        True
        """
        filters = None if weights is None else tuple(self._scalars(weights).tolist())
        return _bounds_in(self, (west, south, east, north), filters)

    # What `noise.h` reads.

    def table(self) -> Words:
        """Return the parameters for OpenCL: a ``NoiseSum`` and a ``NoiseOctave`` for each lattice, 8 words each.

        Flat, so that tables can be put one after the other in a buffer.
        """
        words = np.zeros((1 + len(self.lattices), RECORD), np.uint32)
        floats = words.view(np.float32)
        words[0, :3] = CODES[self.kind], self.count, self.warps
        floats[0, 3] = self.feedback
        intervals = self._intervals()
        for row, lattice in enumerate(self.lattices, 1):
            low, high = intervals[lattice.octave]
            words[row, 1] = lattice.seed
            floats[row, 0] = lattice.amplitude
            numbers = np.array([lattice.xx, lattice.yx])
            # Of 12 bits, so that the kernel's products with such are exact, and the rest.
            first = (numbers.astype(np.float32).view(np.uint32) & np.uint32(0xFFFFF000)).view(np.float32)
            floats[row, 2:] = *first, *(numbers - first), low, 1 / (high - low)
        return words.ravel()

    def origins(self, x: npt.ArrayLike, y: npt.ArrayLike) -> Words:
        """Return where points lie on the lattices: a ``NoiseOrigin`` (4 words) for each point and lattice.

        Kernels see offsets in metres from such an origin, in float32: take the corner or the centre of a tile.

        Args:
            x, y: coordinates of the origins, m, of one shape or numbers.

        Returns:
            int32 cell and float32 fraction of a cell, both along u and v, as words of shape (*shape, lattices, 4).

        Raises:
            ValueError: a coordinate is NaN or too far away.
        """
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        words = np.empty((*x.shape, len(self.lattices), 4), np.uint32)
        for index, lattice in enumerate(self.lattices):
            for axis, cells in enumerate(cells_of(lattice, x, y)):
                base = np.floor(cells)
                if base.size and not max(base.max(), -base.min()) <= FARTHEST:
                    raise ValueError("coordinates must be finite and within 2^31 cells of noise of the origin")
                words[..., index, axis] = base.astype(np.int64).astype(np.uint32)
                words[..., index, 2 + axis] = (cells - base).astype(np.float32).view(np.uint32)
        return words

    @cached_property
    def frames(self) -> Floats:
        """The lattices as numbers: (lattices, 6) of xx, xy, yx, yy, u0, v0."""
        return np.array([(item.xx, item.xy, item.yx, item.yy, item.u0, item.v0) for item in self.lattices])

    # How.

    def _lattices(self) -> tuple[Lattice, ...]:
        groups = [(0, self.amplitudes)]
        groups += [
            (part, self.warp * self.wavelength * _amplitudes(self.gain, self.warps))
            for part in (1, 2)
            if self.kind == "warped"
        ]
        lattices = []
        for part, amplitudes in groups:
            for octave, amplitude in enumerate(amplitudes):
                frequency = self.lacunarity**octave / self.wavelength
                # The components of a displacement turn on their own, too.
                turn = (1 + octave + 29 * part) * _TURN
                cosine, sine = frequency * math.cos(turn), frequency * math.sin(turn)
                seed = scrambled(self.seed, octave, part)
                offsets = scrambled(seed, 1) * 2.0**-32, scrambled(seed, 2) * 2.0**-32
                lattices.append(
                    Lattice(seed, float(amplitude), frequency, cosine, -sine, sine, cosine, *offsets, octave)
                )
        return tuple(lattices)

    def _intervals(self) -> tuple[tuple[float, float], ...]:
        return self.intervals or tuple([(i / self.count, (i + 1) / self.count) for i in range(self.count)])

    def _scalars(self, weights: npt.ArrayLike | None) -> Floats:
        if weights is None:
            return np.ones(self.count)
        filters = np.asarray(weights, np.float64)
        if filters.shape != (self.count,):
            raise ValueError(f"weights of shape {filters.shape} must be one number for each of {self.count} octaves")
        return _checked(filters)

    def _sample(
        self,
        x: npt.ArrayLike,
        y: npt.ArrayLike,
        kappa: npt.ArrayLike | None,
        weights: npt.ArrayLike | None,
        slopes: bool,
    ) -> Sample:
        if kappa is not None and weights is not None:
            raise ValueError("give kappa or weights, not both")
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        levels = None if kappa is None else np.asarray(kappa, np.float64)
        shape = np.broadcast_shapes(x.shape, y.shape, () if levels is None else levels.shape)
        filters = None
        if weights is not None:
            filters = _checked(np.asarray(weights, np.float64))
            if filters.shape not in ((self.count,), (self.count, *shape)):
                raise ValueError(f"weights of shape {filters.shape} must be ({self.count},) or with {shape} after it")
        elif levels is not None and levels.ndim == 0:
            filters, levels = self.weights(levels), None
        # Blocks of at least one dimension.
        wide = shape or (1,)
        x, y = np.broadcast_to(x, wide), np.broadcast_to(y, wide)
        levels = None if levels is None else np.broadcast_to(levels, wide)
        made = Sample(np.empty(wide), *(np.empty(wide if slopes else (0,)) for _ in range(2)))
        for part in _parts(wide):
            b: Floats | None
            if levels is not None:
                b = self.weights(levels[part])
            else:
                b = filters if filters is None or filters.ndim == 1 else filters[(slice(None), *part)]
            for whole, piece in zip(made, self._block(x[part], y[part], b, slopes), strict=True):
                if whole.size:
                    whole[part] = piece
        return Sample(*(array.reshape(shape) if array.size or slopes else array for array in made))

    def _block(self, x: Floats, y: Floats, b: Floats | None, slopes: bool) -> Sample:
        lattices = self.lattices[: self.count]
        if self.kind == "billow":
            return billow(lattices, x, y, b, slopes)
        if self.kind == "ridged":
            return ridged(lattices, x, y, b, slopes, self.feedback)
        if self.kind == "hybrid":
            return hybrid(lattices, x, y, b, slopes, self.feedback)
        if self.kind == "warped":
            middle = self.count + self.warps
            q = self.lattices[self.count : middle], self.lattices[middle:]
            return warped(lattices, *q, x, y, b, slopes)
        return fbm(lattices, x, y, b, slopes)


def origins_of(noises: Sequence[Noise], x: Floats, y: Floats, which: npt.NDArray[np.int64] | None = None) -> Words:
    """Return `Noise.origins` of many points, each for a noise of its own, one after the other: flat words.

    Far faster than asking one by one, where there are many.  Raises `ValueError` as that does.

    Args:
        noises: of each point, or those that `which` counts.
        x, y: the points, m.
        which: the place in `noises` of each point's noise.
    """
    which = np.arange(len(noises)) if which is None else which
    sizes = np.array([len(noise.frames) for noise in noises])
    frames, starts, counts = np.concatenate([noise.frames for noise in noises]), np.cumsum(sizes) - sizes, sizes[which]
    ends = np.cumsum(counts)
    words = np.empty((ends[-1], 4), np.uint32)
    step = BLOCK // MOST
    for first in range(0, len(which), step):
        some = slice(first, first + step)
        count, end = counts[some], ends[some]
        part = slice(end[0] - count[0], end[-1])
        frame = frames[np.repeat(starts[which[some]] - (end - count), count) + np.arange(part.start, part.stop)]
        px, py = np.repeat(x[some], count), np.repeat(y[some], count)
        for axis in range(2):
            cells = px * frame[:, 2 * axis] + py * frame[:, 2 * axis + 1] + frame[:, 4 + axis]
            base = np.floor(cells)
            if not max(base.max(), -base.min()) <= FARTHEST:
                raise ValueError("coordinates must be finite and within 2^31 cells of noise of the origin")
            words[part, axis] = base.astype(np.int64).astype(np.uint32)
            words[part, 2 + axis] = (cells - base).astype(np.float32).view(np.uint32)
    return words.ravel()


@lru_cache(maxsize=256)
def _bounds_in(
    noise: Noise, box: tuple[float, float, float, float], weights: tuple[float, ...] | None
) -> tuple[float, float, float]:
    """See `Noise.bounds_in`; remembered, for a tree may hold a noise at several places and ask each about a box."""
    (low, high), slope = noise.bounds(weights), noise.lipschitz(weights)
    filters = np.ones(noise.count) if weights is None else np.array(weights)
    found = bounds_in(noise.kind, noise.lattices, noise.warps, noise.feedback, filters, box)
    return (low, high, slope) if found is None else (max(low, found[0]), min(high, found[1]), min(slope, found[2]))


def _amplitudes(gain: float, count: int) -> Floats:
    amplitudes = np.array([gain**octave for octave in range(count)], np.float64)
    scaled: Floats = amplitudes / amplitudes.sum()
    return scaled


def _parts(shape: tuple[int, ...]) -> Iterator[tuple[slice, ...]]:
    """Yield index ranges that cover an array of a shape, of about `BLOCK` points each."""
    if not shape:
        yield ()
        return
    rest = math.prod(shape[1:])
    step = max(1, BLOCK // max(1, rest))
    for first in range(0, shape[0], step):
        for others in _parts(shape[1:]) if rest > BLOCK else [(slice(None),) * (len(shape) - 1)]:
            yield (slice(first, first + step), *others)


def _checked(weights: Floats) -> Floats:
    if weights.size and not (weights.min() >= 0 and weights.max() <= 1):
        raise ValueError("the weights of octaves must be in [0, 1]")
    return weights


def _within(name: str, number: float, low: float, high: float) -> None:
    if not low <= number <= high:
        raise ValueError(f"{name} = {number} must be from {low:g} to {high:g}")
