"""Dictionaries whose atoms are patches of terrains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node
from nodegraph_sparse.dictionary import Patches, SampledDictionary
from nodegraph_sparse.metric import columns
from nodegraph_sparse.windows import blocks, moments, shaped

Choice = Literal["all", "random", "farthest"]


@node(version=1)
def dictionary_from_patches(
    *patches: Patches,
    choice: Annotated[Choice, Param("Which patches become atoms.")] = "all",
    atoms: Annotated[int, Param("N of a random or farthest choice.", ge=1)] = 256,
    names: Annotated[tuple[str, ...], Param("Of the inputs, in order; those not named are numbered.")] = (),
    seed: Annotated[int, Param("Another one makes another random choice, or starts farthest elsewhere.", ge=0)] = 0,  # noqa: ARG001
    context: Context,
) -> SampledDictionary:
    """Make patches the atoms of a dictionary.

    An atom is a patch divided by its norm in the metric.  Flat patches, of a norm below 1e-6 of the greatest, are left
    out.

    - ``all``: every patch; with one atom per patch the terrain they come from is given back exactly.
    - ``random``: `atoms` of them, drawn evenly without repetition, in their order.
    - ``farthest``: greedily the patch whose shape is farthest from all chosen before, up to its sign, beginning with
      a random one: the least of max_j |<p, d_j>|.  Varied atoms, rare landforms before common ones; the first N' of N
      atoms are the choice of N'.

    Args:
        patches: of one or more terrains, of one size and metric; the atoms of each are a source of their own.
        choice: ``all``, ``random`` or ``farthest``.
        atoms: N; ``all`` takes no notice of it.
        names: of the sources.
        seed: of the choice.
        context: the engine's.

    Returns:
        N normalised atoms, with the number of the input as source.

    Raises:
        ValueError: no input, inputs of different sizes or metrics, flat ones only, more atoms than there are patches,
            or more names than inputs or one twice.

    Complexity: O(n K), and O(n N K) for ``farthest``.

    Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum
    35(2), sections 4.1 and 4.3, doi:10.1111/cgf.12821.  The farthest-point choice: Gonzalez 1985, Clustering to
    minimize the maximum intercluster distance, Theoretical Computer Science 38, doi:10.1016/0304-3975(85)90224-5.
    """
    if not patches:
        raise ValueError("there are no patches to make a dictionary from; link one input or more")
    first = patches[0]
    for number, other in enumerate(patches[1:], 2):
        if (other.size, other.metric) != (first.size, first.metric):
            raise ValueError(
                f"input {number} has {other.metric} patches of {other.size} samples a side, input 1 {first.metric} ones"
                f" of {first.size}; give all the same metric and the same radius in cells"
            )
    named = source_names(names, len(patches))
    sources = np.repeat(np.arange(len(patches), dtype=np.int32), [len(one.samples) for one in patches])
    norm = np.concatenate([_norms(one) for one in patches])
    levels = np.concatenate([one.means for one in patches])
    chosen = np.flatnonzero(shaped(norm, levels, first.size, first.metric))
    if not len(chosen):
        raise ValueError("all patches are flat; a dictionary needs some relief")
    if choice != "all" and atoms > len(chosen):
        raise ValueError(
            f"{atoms} atoms cannot be chosen from {len(chosen)} patches that are not flat; ask for at most that many"
        )
    if choice == "random":
        chosen = chosen[np.sort(context.rng.choice(len(chosen), atoms, replace=False))]
    samples = _picked(patches, chosen, norm)
    if choice == "farthest":
        vectors = columns(samples, first.metric, np.float32)
        order = farthest(vectors, atoms, int(context.rng.integers(len(chosen))), context)
        chosen, samples = chosen[order], samples[order]
    return SampledDictionary(first.metric, sources[chosen], named, samples)


def farthest(vectors: npt.NDArray[Any], count: int, start: int, context: Context) -> npt.NDArray[np.int64]:
    """Return the numbers of `count` vectors of norm 1, each as far as can be from those before it up to sign.

    Args:
        vectors: (n, k), n >= count.
        count: how many to choose.
        start: the first.
        context: for progress.
    """
    chosen = np.empty(count, np.int64)
    nearest = np.full(len(vectors), -1.0, vectors.dtype)
    for step in range(count):
        if step % 16 == 0:
            context.progress(step / count)
        chosen[step] = start
        np.maximum(nearest, np.abs(vectors @ vectors[start]), out=nearest)
        nearest[start] = np.inf
        start = int(np.argmin(nearest))
    return chosen


def source_names(names: Sequence[str], count: int) -> tuple[str, ...]:
    """Return a name for each of `count` sources: those given, then ``terrain 2`` and so on.

    >>> source_names(["Alps"], 2)
    ('Alps', 'terrain 2')

    Raises:
        ValueError: there are more names than sources, or one twice.
    """
    if len(names) > count:
        raise ValueError(f"{len(names)} names do not fit {count} inputs; give one for each at most")
    named = (*names, *(f"terrain {number}" for number in range(len(names) + 1, count + 1)))
    twice = [name for name in named if named.count(name) > 1]
    if twice:
        raise ValueError(f"the name '{twice[0]}' is there twice; sources need different ones")
    return named


def _norms(one: Patches) -> npt.NDArray[np.float64]:
    norms = np.empty(len(one.samples))
    for part in blocks(len(norms), one.size):
        norms[part] = moments(one.samples[part], one.metric)[1]
    return norms


def _picked(
    patches: Sequence[Patches], which: npt.NDArray[Any], norm: npt.NDArray[np.float64]
) -> npt.NDArray[np.float32]:
    """Return patches by their number over all inputs, which rises, each divided by its norm."""
    size = patches[0].size
    samples = np.empty((len(which), size, size), np.float32)
    ends = np.cumsum([0, *(len(one.samples) for one in patches)])
    cuts = np.searchsorted(which, ends)
    for one, end, low, high in zip(patches, ends[:-1], cuts[:-1], cuts[1:], strict=True):
        for part in blocks(int(high - low), size):
            inside = slice(low + part.start, low + part.stop)
            samples[inside] = one.samples[which[inside] - end] / norm[which[inside], None, None]
    return samples
