"""What a pursuit is told and what it gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Selection = Literal["ols", "omp", "mp"]

DEPENDENT = 1e-10
"""An atom of norm 1 whose squared distance from the span of the chosen ones is no more than this adds nothing."""

NOISE = 1e-13
"""A product of a residual with an atom of norm 1 that is no more than this share of the signal's norm is rounding."""

EXACT = 1e-14
"""A squared residual of no more than this share of the signal's is none: terrain is float32, and of less the rounds,
which take it off the signal's squared norm, know no digit."""


@dataclass(frozen=True, slots=True)
class Pursuit:
    """Signals as sums of atoms, in the order in which atoms were chosen.

    Attributes:
        indices: (n, s) int32, numbers of atoms; -1 where fewer than s were of use, always last.
        coefficients: (n, s) float64, of the atoms as they were given; 0 where none.
        residuals: (n,) float64, squared norms of what is left.
    """

    indices: npt.NDArray[np.int32]
    coefficients: Floats
    residuals: Floats


@dataclass(frozen=True, slots=True)
class Preference:
    """How much atoms are wanted.

    Attributes:
        weights: (n, sources), 0 to 1: what multiplies the gain of the atoms of each source, for each signal.
        sources: (N,) int32, the source of each atom.
    """

    weights: Floats
    sources: npt.NDArray[np.int32]

    def part(self, signals: slice) -> Preference:
        """Return the preference for some of the signals."""
        return Preference(self.weights[signals], self.sources)


@dataclass(frozen=True, slots=True)
class Rule:
    """How atoms are chosen and their coefficients found: see `pursuit`."""

    sparsity: int
    selection: Selection
    nonnegative: bool

    @property
    def refits(self) -> bool:
        """Say whether all coefficients are found anew in each round."""
        return self.selection != "mp"

    @property
    def rounds(self) -> int:
        """How many choices are made at most: atoms that were given up are replaced."""
        return self.sparsity * (4 if self.nonnegative and self.refits else 1)
