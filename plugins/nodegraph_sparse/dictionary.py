"""The values on the wires: `Patches` of a terrain, a `Dictionary` of atoms, and the `SparseCode` of one by the other.

Atoms are shapes over the unit disc, of no size in metres: a code says how large its discs are, so the atoms of one
terrain can describe another at any scale.

Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum 35(2),
section 4.1, doi:10.1111/cgf.12821.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_sparse.metric import Metric
from nodegraph_sparse.patch_grid import PatchGrid

BLOCK = 1 << 22
"""Samples of atoms that are made at a time where a dictionary does not hold them."""


@port_type
class Patches:
    """Pieces of a terrain over discs, each less its mean.

    Attributes:
        samples: (n, size, size) float32, m, row 0 north; mean 0 in the metric.
        means: z, (n,) float64, m.
        centres: (n, 2) float64, m: east, north.
        radius: R, m.
        metric: in which the means are means, and in which errors count.
        grid: where the patches lie if they cover a terrain in order; none for those of random places or turned.
    """

    samples: npt.NDArray[Any]
    means: npt.NDArray[Any]
    centres: npt.NDArray[Any]
    radius: float
    metric: Metric = "weighted"
    grid: PatchGrid | None = None

    def __post_init__(self) -> None:
        count = len(self.samples)
        if self.samples.ndim != 3 or self.samples.shape[1] != self.samples.shape[2] or count == 0:
            raise ValueError(f"patches of shape {self.samples.shape} must be one or more squares of samples")
        if self.means.shape != (count,) or self.centres.shape != (count, 2):
            raise ValueError("patches need as many means and centres as squares of samples")
        if self.grid is not None and self.grid.count != count:
            raise ValueError(f"{count} patches do not fit a grid of {self.grid.count}")

    @property
    def size(self) -> int:
        """Samples along a side."""
        return int(self.samples.shape[1])


@port_type
class Dictionary:
    """Atoms d_j over the unit disc: mean 0 and norm 1 in the metric.  Subclasses say where they come from.

    Attributes:
        metric: in which the atoms are normalised.
        sources: (N,) int32, which terrain each atom comes from, from 0.
        names: of the sources.
    """

    metric: Metric
    sources: npt.NDArray[Any]
    names: tuple[str, ...]

    @property
    def count(self) -> int:
        """N, the number of atoms."""
        return len(self.sources)

    @property
    def size(self) -> int:
        """Samples along a side of an atom."""
        raise NotImplementedError

    def atoms(self, which: slice | npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return some atoms, (b, size, size) float32, dimensionless, row 0 north."""
        raise NotImplementedError

    def exaggerations(self, which: npt.NDArray[Any], cell: float) -> npt.NDArray[Any]:  # noqa: ARG002
        """Return how many times as steep as measured some atoms stand for a coefficient of 1; 0 where it is unknown.

        Args:
            which: numbers of atoms, in any shape.
            cell: from a sample to the next where they stand, m.
        """
        return np.zeros(which.shape)

    def take(self, which: npt.NDArray[Any]) -> Dictionary:
        """Return the dictionary of some atoms, by number and in that order: still a map's or functions, if it was."""
        raise NotImplementedError

    def blocks(self) -> Iterator[tuple[int, npt.NDArray[Any]]]:
        """Yield (number of the first, atoms) over all atoms, of `BLOCK` samples at most: bounded memory."""
        step = max(1, BLOCK // self.size**2)
        for start in range(0, self.count, step):
            yield start, self.atoms(slice(start, min(start + step, self.count)))


@port_type
class SampledDictionary(Dictionary):
    """A dictionary that holds the samples of its atoms.

    Attributes:
        samples: (N, size, size) float32.
    """

    samples: npt.NDArray[Any]

    @property
    def size(self) -> int:
        """Samples along a side of an atom."""
        return int(self.samples.shape[1])

    def atoms(self, which: slice | npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return some of the samples."""
        return np.asarray(self.samples[which], np.float32)

    def take(self, which: npt.NDArray[Any]) -> SampledDictionary:
        """Return the dictionary of some atoms."""
        return replace(self, samples=self.samples[which], sources=self.sources[which])


@port_type
class SparseCode:
    """Patches as sums of few atoms: patch i is z_i + sum_j x_ij d_(k_ij).

    Attributes:
        grid: where the patches lie.
        indices: k, (n, s) int32, numbers of atoms; -1 where fewer than s are used, always last.
        coefficients: x, (n, s) float64, m times the square root of samples; 0 where none.
        means: z, (n,) float64, m.
        residuals: (n,) float64, what is left of each patch: squared norm in the metric, m^2 samples.
        atoms: N of the dictionary.
        metric: in which the code was made.
        size: samples along a side of the patches that were coded, where it is known.
    """

    grid: PatchGrid
    indices: npt.NDArray[Any]
    coefficients: npt.NDArray[Any]
    means: npt.NDArray[Any]
    residuals: npt.NDArray[Any]
    atoms: int
    metric: Metric = "weighted"
    size: int | None = None

    def __post_init__(self) -> None:
        count = self.grid.count
        if self.indices.shape != self.coefficients.shape or self.indices.ndim != 2:
            raise ValueError("a sparse code needs an index for every coefficient")
        if not len(self.indices) == len(self.means) == len(self.residuals) == count:
            raise ValueError(f"a sparse code of {len(self.indices)} patches does not fit a grid of {count}")
        if self.indices.size and int(np.max(self.indices)) >= self.atoms:
            raise ValueError(f"a sparse code uses atom {int(np.max(self.indices))} of {self.atoms}")

    @property
    def sparsity(self) -> int:
        """s, the greatest number of atoms of a patch."""
        return int(self.indices.shape[1])
