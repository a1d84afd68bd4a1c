"""Several dictionaries as one: atoms of several terrains, or of terrain and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from nodegraph import node, port_type
from nodegraph_sparse.dictionary import Dictionary
from nodegraph_sparse.noise_dictionary import NoiseDictionary


@port_type
class MergedDictionary(Dictionary):
    """The atoms of several dictionaries, each kept as it is.

    Attributes:
        parts: the dictionaries, whose own sources and names do not count here.
        order: (N,) int64, number of each atom among those of all parts one after the other.
    """

    parts: tuple[Dictionary, ...]
    order: npt.NDArray[Any]

    computes: ClassVar[bool] = True

    @property
    def size(self) -> int:
        """Samples along a side of an atom."""
        return self.parts[0].size

    def atoms(self, which: slice | npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return some atoms of the parts."""
        chosen = self.order[which]
        samples = np.empty((len(chosen), self.size, self.size), np.float32)
        for part, start in zip(self.parts, self._starts(), strict=True):
            inside = np.flatnonzero((chosen >= start) & (chosen < start + part.count))
            if len(inside):
                samples[inside] = part.atoms(chosen[inside] - start)
        return samples

    def exaggerations(self, which: npt.NDArray[Any], cell: float) -> npt.NDArray[Any]:
        """Return those of the parts."""
        chosen = self.order[which]
        found = np.zeros(chosen.shape)
        for part, start in zip(self.parts, self._starts(), strict=True):
            inside = (chosen >= start) & (chosen < start + part.count)
            found[inside] = part.exaggerations(chosen[inside] - start, cell)
        return found

    def take(self, which: npt.NDArray[Any]) -> MergedDictionary:
        """Return the dictionary of some atoms; what no atom is of is left out."""
        chosen = self.order[which]
        order = np.empty(len(chosen), np.int64)
        parts, count = [], 0
        for part, start in zip(self.parts, self._starts(), strict=True):
            inside = np.flatnonzero((chosen >= start) & (chosen < start + part.count))
            if len(inside):
                order[inside] = count + np.arange(len(inside))
                parts.append(part.take(chosen[inside] - start))
                count += len(inside)
        return replace(self, sources=self.sources[which], parts=tuple(parts), order=order)

    def _starts(self) -> list[int]:
        return [0, *np.cumsum([part.count for part in self.parts])[:-1].tolist()]


@node(version=1)
def merge_dictionaries(*dictionaries: Dictionary) -> MergedDictionary:
    """Put the atoms of several dictionaries into one: several terrains, or terrain and noise.

    Atoms follow one another in the order of the inputs and are kept as they are: an exemplar's stay a map, noise stays
    functions.  So the merged highs and the merged lows of several multi-resolution dictionaries belong together.
    Sources are renumbered in the same order, and a name that is there already gets a number: ``Alps``, ``Alps (2)``.

    Args:
        dictionaries: of one metric and size.  Noise is sampled as the others are: as the first input that is not noise,
            or else the first.

    Raises:
        ValueError: no input, or inputs of different metrics or sizes.

    Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum
    35(2), section 6 (control), doi:10.1111/cgf.12821.
    """
    if not dictionaries:
        raise ValueError("there are no dictionaries to merge; link one input or more")
    lead = next((one for one in dictionaries if not isinstance(one, NoiseDictionary)), dictionaries[0])
    parts = []
    for number, one in enumerate(dictionaries, 1):
        if isinstance(one, NoiseDictionary) and (one.size, one.metric) != (lead.size, lead.metric):
            one = one.fitted(lead.size, lead.metric)
        if (one.size, one.metric) != (lead.size, lead.metric):
            raise ValueError(
                f"dictionary {number} has {one.metric} atoms of {one.size} samples a side, the first {lead.metric} ones"
                f" of {lead.size}; give all the same metric and the same radius in cells"
            )
        parts.append(one)
    return merged(parts)


def merged(parts: Sequence[Dictionary]) -> MergedDictionary:
    """Return dictionaries of one metric and size as one, sources renumbered."""
    firsts = np.cumsum([0, *(len(part.names) for part in parts)])
    sources = np.concatenate([part.sources + first for part, first in zip(parts, firsts[:-1], strict=True)])
    names: list[str] = []
    for name in (name for part in parts for name in part.names):
        again = 2
        unique = name
        while unique in names:
            unique, again = f"{name} ({again})", again + 1
        names.append(unique)
    return MergedDictionary(
        parts[0].metric, sources.astype(np.int32), tuple(names), tuple(parts), np.arange(len(sources))
    )
