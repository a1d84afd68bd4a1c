"""Atoms as vectors of norm 1, all of them or block by block, from arrays or from dictionaries."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from nodegraph_sparse.dictionary import Dictionary
from nodegraph_sparse.metric import columns
from nodegraph_sparse.pursuit_rules import Floats, Indices

Singles = npt.NDArray[np.float32]

BLOCK = 1 << 22
"""Numbers of atoms in a block."""


class Atoms(Protocol):
    """Atoms d_j as vectors; `count` of them."""

    @property
    def count(self) -> int:
        """N."""
        ...

    def take(self, which: Indices) -> Floats:
        """Return some atoms as they are, (m, k)."""
        ...

    def blocks(self) -> Iterator[tuple[int, npt.NDArray[Any]]]:
        """Yield (number of the first, atoms as they are) over all atoms, in float32 or float64."""
        ...


class ArrayAtoms:
    """The rows of an array."""

    def __init__(self, rows: npt.NDArray[Any]) -> None:
        self._rows = rows

    @property
    def count(self) -> int:
        """N."""
        return len(self._rows)

    def take(self, which: Indices) -> Floats:
        """Return some rows."""
        return np.asarray(self._rows[which], np.float64)

    def blocks(self) -> Iterator[tuple[int, npt.NDArray[Any]]]:
        """Yield all rows, in blocks."""
        step = max(1, BLOCK // max(1, self._rows.shape[1]))
        for start in range(0, self.count, step):
            yield start, self._rows[start : start + step]


class DictionaryAtoms:
    """The atoms of a dictionary as vectors whose products are those of its metric; never all at once."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary

    @property
    def count(self) -> int:
        """N."""
        return self._dictionary.count

    def take(self, which: Indices) -> Floats:
        """Return some atoms."""
        return columns(self._dictionary.atoms(which), self._dictionary.metric)

    def blocks(self) -> Iterator[tuple[int, npt.NDArray[Any]]]:
        """Yield all atoms in float32, in the blocks of the dictionary."""
        for start, samples in self._dictionary.blocks():
            yield start, columns(samples, self._dictionary.metric, np.float32)


def norms(rows: npt.NDArray[Any]) -> Floats:
    """Return the norm of each row."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", rows, rows, dtype=np.float64)))


def scaled(rows: npt.NDArray[Any], by: Floats) -> npt.NDArray[Any]:
    """Return rows divided by their norms, in their precision; zero rows stay."""
    return np.asarray(rows / np.where(by > 0, by, 1.0)[:, None].astype(rows.dtype))
