"""Dictionaries whose atoms are functions: sums of noise that can be sampled at any resolution."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, port_type
from nodegraph_sparse.dictionary import Dictionary, Patches
from nodegraph_sparse.metric import Metric, offsets
from nodegraph_sparse.windows import blocks, moments
from nodegraph_terrain.gradient_noise import scrambled
from nodegraph_terrain.noise_sums import Lattice, billow, fbm, ridged

NoiseKind = Literal["ridged", "perlin", "ridged_multifractal"]
Floats = npt.NDArray[np.float64]

FEEDBACK = 2.0
"""Of the ridged multifractal: how much height lets the next octave in, as Musgrave has it."""

POINTS = 1 << 15
"""Points that are made at a time, so that temporaries stay in a core's cache."""

MOST = 12
"""Greatest number of octaves."""


@port_type
class NoiseDictionary(Dictionary):
    """A dictionary whose atoms are functions over the unit disc: atom j is (g_j - mean_j) scale_j.

    g_j is a sum of gradient noise n_jo, one per octave o, with a seed, an offset and a rotation of its own:

    - ``perlin``: sum_o a_jo n_jo;
    - ``ridged``: -sum_o a_jo |n_jo|, sharp crests;
    - ``ridged_multifractal``: sum_o a_jo (1 - |n_jo|)^2 w_jo, rough where it is high (`nodegraph_terrain.noise_sums`).

    Sampled with `size` samples over the diameter, an octave counts fully up to one lattice cell in four samples and
    nothing beyond one in two, where it would alias: at a higher resolution a function shows more of itself.

    Attributes:
        kind: which sum.
        amplitudes: a, (N, octaves) float64: with the frequencies, the K = 2 x octaves coefficients of an atom.
        frequencies: (N, octaves) float64, lattice cells per radius.
        seeds: (N,) int64, below 2^32.
        means: (N,) float64, of g.
        scales: (N,) float64.
        side: samples along a side of an atom.
    """

    kind: NoiseKind
    amplitudes: npt.NDArray[Any]
    frequencies: npt.NDArray[Any]
    seeds: npt.NDArray[Any]
    means: npt.NDArray[Any]
    scales: npt.NDArray[Any]
    side: int

    computes: ClassVar[bool] = True

    @property
    def size(self) -> int:
        """Samples along a side of an atom."""
        return self.side

    def atoms(self, which: slice | npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Sample some of the functions."""
        chosen = np.arange(self.count)[which]
        samples = np.empty((len(chosen), self.side, self.side), np.float32)
        step = max(1, POINTS // self.side**2)
        for start in range(0, len(chosen), step):
            some = chosen[start : start + step]
            values = self._values(some) - self.means[some][:, None, None]
            samples[start : start + step] = values * self.scales[some][:, None, None]
        return samples

    def take(self, which: npt.NDArray[Any]) -> NoiseDictionary:
        """Return the dictionary of some of the functions."""
        return replace(
            self, sources=self.sources[which], amplitudes=self.amplitudes[which],
            frequencies=self.frequencies[which], seeds=self.seeds[which], means=self.means[which],
            scales=self.scales[which],
        )  # fmt: skip

    def resampled(self, size: int) -> NoiseDictionary:
        """Return the same functions with `size` samples a side, and the same heights in metres per coefficient.

        Their norms grow with the samples: about 1 times size / self.size.
        """
        return replace(self, side=size)

    def fitted(self, size: int, metric: Metric) -> NoiseDictionary:
        """Return the same shapes as atoms for patches of `size` samples a side: mean 0 and norm 1 there."""
        bare = replace(
            self, metric=metric, side=size, means=np.zeros(self.count), scales=np.ones(self.count)
        )  # fmt: skip
        means, norms = np.empty(self.count), np.empty(self.count)
        for part in blocks(self.count, size):
            means[part], norms[part] = moments(bare.atoms(part), metric)
        return replace(bare, means=means, scales=1 / norms)

    def _values(self, some: npt.NDArray[Any]) -> Floats:
        """Return g of some atoms, (b, size, size)."""
        away = offsets(self.side)
        x, y = np.broadcast_arrays(away, -away[:, None], np.empty((len(some), self.side, self.side)))[:2]
        lattices, filters = self._lattices(some)
        if self.kind == "perlin":
            return fbm(lattices, x, y, filters, False).value
        if self.kind == "ridged":
            return -billow(lattices, x, y, filters, False).value
        return ridged(lattices, x, y, filters, False, FEEDBACK).value

    def _lattices(self, some: npt.NDArray[Any]) -> tuple[list[Lattice], Floats]:
        """Return the octaves of some atoms as lattices of one number per atom, and how much each counts."""
        words: Any = self.seeds[some].astype(np.uint64)
        lattices, filters = [], []
        for octave in range(self.amplitudes.shape[1]):
            seed: Any = scrambled(words, octave)
            first, second, third = (scrambled(seed, number) * 2.0**-32 for number in (1, 2, 3))
            frequency = self.frequencies[some, octave]
            cosine, sine = frequency * np.cos(2 * np.pi * third), frequency * np.sin(2 * np.pi * third)
            numbers: Any = (self.amplitudes[some, octave], frequency, cosine, -sine, sine, cosine, first, second)
            shaped = [number[:, None, None] for number in (seed.astype(np.uint32), *numbers)]
            lattices.append(Lattice._make([*shaped, octave]))
            # Lattice cells per sample: from 1/4 to 1/2 an octave fades.
            fade = np.clip(4 * frequency * 2 / self.side - 1, 0, 1)
            filters.append(1 - fade**2 * (3 - 2 * fade))
        return lattices, np.array(filters)[:, :, None, None]


@node(version=1)
def dictionary_from_noise(
    patches: Patches | None = None,
    *,
    kind: Annotated[NoiseKind, Param("Which sum of noise an atom is.")] = "ridged_multifractal",
    atoms: Annotated[int, Param("N.", ge=1, le=1_000_000)] = 1024,
    octaves: Annotated[int, Param("Noises of an atom; K is twice as many.", ge=1, le=MOST)] = 8,
    size: Annotated[
        int | None, Param("Samples along a side of an atom; none: those of the patches, or 16.", ge=2, le=512)
    ] = None,
    metric: Annotated[
        Metric | None, Param("In which atoms are normalised; none: that of the patches, or weighted.")
    ] = None,
    wavelength: Annotated[float, Param("Of the first noise, in radii of the disc.", ge=0.1, le=100)] = 4.0,
    lacunarity: Annotated[float, Param("Frequency of a noise over that of the one before.", ge=1, le=16)] = 2.0,
    gain: Annotated[float, Param("Amplitude of a noise over that of the one before.", ge=0, le=2)] = 0.5,
    variety: Annotated[float, Param("How far both wander from that, in octaves up and down.", ge=0, le=4)] = 1.0,
    name: Annotated[str, Param("Among the sources of a dictionary.", min_length=1)] = "noise",
    seed: Annotated[int, Param("Another one gives other functions.", ge=0)] = 0,  # noqa: ARG001
    context: Context,
) -> NoiseDictionary:
    """Make a dictionary of functions: each atom a sum of noise with amplitudes and frequencies of its own.

    Noise o = 0, 1, ... of an atom has the amplitude gain^o 2^v and the frequency lacunarity^o 2^v / (wavelength R), v
    drawn evenly from -variety to variety for each; seed, offset and rotation are random.  An atom is K = 2 x octaves
    numbers and a seed, whatever its resolution.

    Atoms are normalised at `size` samples a side, the resolution at which terrain is coded by them: that of the patches
    where these are linked, so that it follows their radius.  The same functions can then be sampled at any other
    (`NoiseDictionary.resampled`): a coefficient stands for the same heights in metres there, finer noises show where
    there are samples for them, and norms are about size' / size instead of 1.

    Which kind is closest depends on the ground and on the disc.  At s = 1 the paper has 24.9 dB on mountains for
    ``ridged_multifractal`` and 20.0 dB for Perlin noise.  Here, at 10 samples a side, ``perlin`` is ahead by 0.1 to
    0.8 dB where a disc holds part of a slope (35 to 48 dB; three mountain ranges and hills), ``ridged_multifractal`` by
    0.3 to 0.4 dB where it holds several ridges and the gain is 0.35 (24 to 27 dB; Alps and hills).  As far behind as in
    the paper is only a single fine noise, ``perlin`` of 1 octave and a wavelength of 0.4: 0.7 dB above the means.

    Args:
        patches: what is to be coded; only their size and metric are asked for.
        kind: ``perlin`` (smooth hills), ``ridged`` (sharp crests) or ``ridged_multifractal`` (sharp crests, smooth
            valleys).
        atoms: N.
        octaves: noises per atom; those finer than two samples do not show at `size`.
        size: 2 R / cell of the patches to be coded.
        metric: ``weighted`` by the blend or ``plain``; that of the patches to be coded.
        wavelength: cell of the first noise's lattice.
        lacunarity: ratio of frequencies.
        gain: ratio of amplitudes; 0.5 at a lacunarity of 2 is equally rough at all scales.  Less is smoother, mostly
            closer to the terrains above (0.35: by up to 0.7 dB), and draws better at a higher resolution.
        variety: 0 gives all atoms one spectrum.
        name: of the one source.
        seed: of all atoms.  Those of a smaller number of atoms are the first of a greater one.
        context: the engine's.

    Raises:
        ValueError: all noises are finer than the samples can show, or of no amplitude: a smaller frequency (greater
            wavelength) or a larger size is needed.

    Complexity: O(N octaves size^2).

    Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum
    35(2), sections 4.1 and 5.2, doi:10.1111/cgf.12821.
    """
    if size is None:
        size = 16 if patches is None else patches.size
    if metric is None:
        metric = "weighted" if patches is None else patches.metric
    seeds = context.rng.integers(0, 1 << 32, atoms)
    # From the seeds, so that an atom is the same however many there are.
    words: Any = seeds.astype(np.uint64)
    drawn = np.array(
        [[scrambled(words, octave, part) for octave in range(octaves)] for part in (7, 8)], np.float64
    )  # fmt: skip
    wander = 2 ** (variety * (2 * drawn * 2.0**-32 - 1)).transpose(0, 2, 1)
    steps = np.arange(octaves)
    amplitudes, frequencies = gain**steps * wander[0], lacunarity**steps / wavelength * wander[1]
    context.progress(0.1)
    whole = NoiseDictionary(
        metric, np.zeros(atoms, np.int32), (name,), kind, amplitudes, frequencies, seeds, np.zeros(atoms),
        np.ones(atoms), size,
    )  # fmt: skip
    if not np.all((amplitudes * (frequencies < size / 4)).max(axis=1) > 0):
        raise ValueError(
            f"there are atoms all of whose noises are finer than {size} samples a side can show; choose a greater "
            f"wavelength than {wavelength:g} radii, or a larger size"
        )
    return whole.fitted(size, metric)


@dictionary_from_noise.forecast
def _forecast(patches: Forecast | None = None, *, atoms: int, octaves: int, **_: object) -> Forecast:  # noqa: ARG001
    return Forecast(atoms * (28 + 16 * octaves), 64 << 20)
