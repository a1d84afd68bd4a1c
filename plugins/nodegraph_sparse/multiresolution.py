"""Multi-resolution dictionaries: each atom at a high and at a low resolution."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node
from nodegraph_sparse.dictionary import Dictionary, SampledDictionary
from nodegraph_sparse.exemplar import ExemplarDictionary, reduced_map, window_moments
from nodegraph_sparse.merge_dictionaries import MergedDictionary
from nodegraph_sparse.metric import Metric, mass
from nodegraph_sparse.noise_dictionary import NoiseDictionary
from nodegraph_sparse.windows import blocks, moments

Samples = npt.NDArray[Any]
Kept = npt.NDArray[np.bool_]


class MultiresolutionDictionary(NamedTuple):
    """The outputs: atoms of the same numbers belong together.

    Attributes:
        high: atoms at the resolution of the input, divided by the norm of their low ones.
        low: atoms of norm 1, for coding.
    """

    high: Dictionary
    low: Dictionary


@node(version=1)
def multiresolution_dictionary(
    dictionary: Dictionary,
    *,
    factor: Annotated[int, Param("Samples of a high atom to one of its low atom, along a side.", ge=2, le=64)] = 4,
    smoothing: Annotated[float, Param("Gaussian before the reduction, in samples of the low atom.", ge=0, le=8)] = 0.0,
    least: Annotated[float, Param("Least part of an atom's relief that the low one must keep.", gt=0, lt=1)] = 0.01,
    context: Context,
) -> MultiresolutionDictionary:
    """Make the low-resolution counterpart of each atom, so that terrain coded by the low can be built of the high.

    A low atom l_j is the high one smoothed, reduced to the means of `factor` by `factor` samples, less its mean and
    divided by its norm n_j in the metric.  The high atom h_j is divided by n_j too, and shifted by a constant, so that
    reducing h_j gives l_j: a patch coded as sum x_j l_j and rebuilt as sum x_j h_j is the same patch with detail.
    Without the division the relief would depend on how rough an atom is.

    Atoms with nearly no relief at the low resolution are left out on both sides: those whose low root mean square is
    below `least` of the high one.  They would bring 1 / `least` metres of detail for a metre of coarse relief.

    The kinds of dictionaries stay what they are.  High and low of an exemplar are maps with positions; with smoothing
    its windows see what surrounds them, while sampled atoms are mirrored at their border.  High noise stays functions.
    Both sides of a merged dictionary are merged.

    Args:
        dictionary: atoms of a multiple of 2 `factor` samples a side: a radius of a multiple of `factor` cells.
        factor: 4 at a time and repeated keeps more of the coarse terrain than 16 at once.
        smoothing: standard deviation.  The mean of cells alone (0) is right for coarse terrain made like that; painted
            sketches are smoother.
        least: relative to the root mean square of the high atom in the metric.
        context: the engine's.

    Returns:
        ``high`` (norms greater than 1) and ``low`` (mean 0 and norm 1), atom by atom.

    Raises:
        ValueError: the size of the atoms does not fit the factor, or no atom keeps relief.

    Complexity: O(N K).

    Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum
    35(2), sections 4.1 and 5.3, doi:10.1111/cgf.12821.
    """
    size = dictionary.size
    if size % (2 * factor):
        nearest = max(1, round(size / (2 * factor))) * factor
        raise ValueError(
            f"atoms of {size} samples a side cannot be reduced by {factor} to an even number of samples; choose a "
            f"radius of a multiple of {factor} cells, such as {nearest} instead of {size // 2}"
        )
    high, low, kept = _reduced(dictionary, factor, smoothing, least, context)
    if not kept.any():
        raise ValueError(
            f"no atom keeps {least:g} of its relief when reduced by {factor}; choose a smaller factor or a larger "
            "radius"
        )
    return MultiresolutionDictionary(high, low)


def _reduced(
    dictionary: Dictionary, factor: int, smoothing: float, least: float, context: Context
) -> tuple[Dictionary, Dictionary, Kept]:
    """Return high and low atoms, and which atoms of the dictionary they are."""
    if isinstance(dictionary, MergedDictionary):
        return _of_parts(dictionary, factor, smoothing, least, context)
    if isinstance(dictionary, ExemplarDictionary):
        return _of_exemplar(dictionary, factor, smoothing, least, context)
    return _of_samples(dictionary, factor, smoothing, least, context)


def _of_samples(
    dictionary: Dictionary, factor: int, smoothing: float, least: float, context: Context
) -> tuple[Dictionary, SampledDictionary, Kept]:
    metric, count, side = dictionary.metric, dictionary.count, dictionary.size // factor
    low = np.empty((count, side, side), np.float32)
    levels, norms, before = np.empty(count), np.empty(count), np.empty(count)
    for start, atoms in dictionary.blocks():
        context.progress(start / count)
        part = slice(start, start + len(atoms))
        small = reduced(atoms, factor, smoothing)
        levels[part], norms[part] = moments(small, metric)
        before[part] = moments(atoms, metric)[1]
        with np.errstate(divide="ignore", invalid="ignore"):  # those of no relief go
            low[part] = (small - levels[part, None, None]) / norms[part, None, None]
    kept = _keeps(norms, before, side, dictionary.size, metric, least)
    chosen = np.flatnonzero(kept)
    low_atoms = SampledDictionary(metric, dictionary.sources[chosen], dictionary.names, low[chosen])
    levels, norms = levels[chosen], norms[chosen]
    if isinstance(dictionary, NoiseDictionary):
        some = dictionary.take(chosen)
        high: Dictionary = replace(some, means=some.means + levels / some.scales, scales=some.scales / norms)
        return high, low_atoms, kept
    samples = np.empty((len(chosen), dictionary.size, dictionary.size), np.float32)
    for part in blocks(len(chosen), dictionary.size):
        shifted = dictionary.atoms(chosen[part]) - levels[part, None, None]
        samples[part] = shifted / norms[part, None, None]
    return replace(low_atoms, samples=samples), low_atoms, kept


def _of_exemplar(
    dictionary: ExemplarDictionary, factor: int, smoothing: float, least: float, context: Context
) -> tuple[Dictionary, Dictionary, Kept]:
    metric, side = dictionary.metric, dictionary.side // factor
    heights, corners, step = reduced_map(dictionary, factor, smoothing)
    levels, norms = window_moments(heights, corners, side, step, metric, context)
    before = window_moments(dictionary.heights, dictionary.corners, dictionary.side, dictionary.step, metric, context)
    kept = _keeps(norms, before[1], side, dictionary.side, metric, least)
    high = replace(
        dictionary, sources=dictionary.sources[kept], corners=dictionary.corners[kept], turns=dictionary.turns[kept],
        means=levels[kept], scales=1 / norms[kept],
    )  # fmt: skip
    cell = dictionary.cell * dictionary.step * factor / step
    return high, replace(high, heights=heights, corners=corners[kept], side=side, step=step, cell=cell), kept


def _of_parts(
    dictionary: MergedDictionary, factor: int, smoothing: float, least: float, context: Context
) -> tuple[Dictionary, Dictionary, Kept]:
    results = [_reduced(part, factor, smoothing, least, context) for part in dictionary.parts]
    stays = np.concatenate([kept for _, _, kept in results])
    kept = stays[dictionary.order]
    order = (np.cumsum(stays) - 1)[dictionary.order[kept]]
    sources = dictionary.sources[kept]
    high, low = (
        replace(dictionary, sources=sources, order=order, parts=tuple(parts))
        for parts in ([one for one, _, _ in results], [one for _, one, _ in results])
    )
    return high, low, kept


def reduced(samples: Samples, factor: int, smoothing: float = 0.0) -> npt.NDArray[np.float64]:
    """Return atoms smoothed and reduced to means of factor by factor samples."""
    values = samples.astype(np.float64)
    if smoothing > 0:
        from scipy.ndimage import gaussian_filter

        values = gaussian_filter(values, smoothing * factor, axes=(1, 2), mode="reflect")
    side = samples.shape[1] // factor
    return np.asarray(values.reshape(len(values), side, factor, side, factor).mean(axis=(2, 4)))


def _keeps(low: Samples, high: Samples, side: int, size: int, metric: Metric, least: float) -> Kept:
    """Say which atoms keep relief, from the norms of both: a norm is a root mean square times that of all mass."""
    scale = np.sqrt(mass(size, metric).sum() / mass(side, metric).sum())
    kept: Kept = (low * scale > least * high) & (low > 0)
    return kept
