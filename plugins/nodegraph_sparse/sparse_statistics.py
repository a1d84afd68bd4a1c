"""Numbers that describe a sparse terrain: what it takes to store, and how near it is."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, node, port_type
from nodegraph_sparse.container import Precision, packed
from nodegraph_sparse.dictionary import Dictionary, SparseCode
from nodegraph_sparse.exemplar import ExemplarDictionary
from nodegraph_sparse.merge_dictionaries import MergedDictionary
from nodegraph_sparse.noise_dictionary import NoiseDictionary
from nodegraph_sparse.report import Report
from nodegraph_sparse.sparse_raster import blended
from nodegraph_terrain.raster import Elevation


@port_type
class SparseStatistics(Report):
    """What describes a sparse terrain.

    Attributes:
        samples: K, of an atom.
        atoms: N.
        used: atoms that patches use.
        patches: n.
        sparsity: s.
        mean_sparsity: atoms of a patch, on average.
        values: t(s, N) = N K + n (2 s + 2) + 1, numbers by the count of the paper.
        cells: t0, of the terrain.
        ratio: rho = t / t0.
        bytes: of the file of sparse.save_sparse.
        psnr: 20 log10((max - min) / RMSE), dB; NaN without a reference, infinite where nothing differs.
        rmse: m; NaN without a reference.
        largest_error: m; NaN without a reference.
    """

    samples: int
    atoms: int
    used: int
    patches: int
    sparsity: int
    mean_sparsity: float
    values: int
    cells: int
    ratio: float
    bytes: int
    psnr: float
    rmse: float
    largest_error: float

    def records(self) -> list[dict[str, Any]]:
        """Return one row."""
        row = {item.name: getattr(self, item.name) for item in fields(self)}
        return [{name: value if np.isfinite(value) else None for name, value in row.items()}]


class Error(NamedTuple):
    """How far a terrain is from another: PSNR in dB, RMSE and the largest error in metres."""

    psnr: float
    rmse: float
    largest: float


class Described(NamedTuple):
    """The outputs: all numbers, and those that matter most."""

    statistics: SparseStatistics
    psnr: float
    ratio: float
    bytes: int


@node(version=1)
def sparse_statistics(
    dictionary: Dictionary, code: SparseCode, reference: Elevation | None = None, *, context: Context
) -> Described:
    """Describe a sparse terrain: sizes, the count of stored values, bytes as stored, and the error.

    The paper counts values: K N for the atoms, and for each of n patches 2 s for coefficients and atoms, its mean and
    one more, so t(s, N) = K N + n (2 s + 2) + 1, against the t0 cells of the terrain.  Atoms that are functions count
    as their parameters (2 for each noise), those of a map as the cells of the map and two for the place of each.  It
    says little of bytes, as an index takes one byte and a height in a file two; so there are `bytes` too, of
    sparse.save_sparse without quantisation.

    Args:
        dictionary: of the code.
        code: the patches, at least one.
        reference: the terrain that was coded; none: no errors are given.
        context: the engine's.

    Returns:
        ``statistics`` and, from it, ``psnr`` (dB, NaN without a reference), ``ratio`` (rho) and ``bytes``.

    Raises:
        ValueError: the code has no patches or is not one of the dictionary; the reference has other cells than the
            patches, or voids.

    Complexity: O(n s K).

    Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum
    35(2), section 5.1, doi:10.1111/cgf.12821.
    """
    found = described(dictionary, code, reference, Precision(), context)
    return Described(found, found.psnr, found.ratio, found.bytes)


def described(
    dictionary: Dictionary, code: SparseCode, reference: Elevation | None, precision: Precision, context: Context
) -> SparseStatistics:
    """Return the statistics of a sparse terrain, with the bytes of a file of some precision."""
    if not code.grid.count:
        raise ValueError("the code has no patches; code those of a grid")
    size, grid, sparsity = dictionary.size, code.grid, code.sparsity
    cell = 2 * grid.radius / size
    cells = round(grid.extent.height / cell) * round(grid.extent.width / cell)
    count = values(dictionary) + grid.count * (2 * sparsity + 2) + 1
    stored = len(packed(dictionary, code, precision))
    error = Error(np.nan, np.nan, np.nan)
    if reference is not None:
        error = compared(blended(dictionary, code, context), reference.data)
    used = code.indices >= 0
    return SparseStatistics(
        samples=size**2,
        atoms=dictionary.count,
        used=len(np.unique(code.indices[used])),
        patches=grid.count,
        sparsity=sparsity,
        mean_sparsity=float(used.sum() / grid.count),
        values=count,
        cells=cells,
        ratio=count / cells,
        bytes=stored,
        psnr=error.psnr,
        rmse=error.rmse,
        largest_error=error.largest,
    )


def values(dictionary: Dictionary) -> int:
    """Return how many numbers the atoms of a dictionary are."""
    if isinstance(dictionary, NoiseDictionary):
        return 2 * dictionary.amplitudes.size
    if isinstance(dictionary, ExemplarDictionary):
        return dictionary.heights.size + 2 * dictionary.count
    if isinstance(dictionary, MergedDictionary):
        return sum(values(part) for part in dictionary.parts)
    return dictionary.count * dictionary.size**2


def compared(found: npt.NDArray[Any], reference: npt.NDArray[Any]) -> Error:
    """Return the error of a terrain.

    Raises:
        ValueError: the rasters do not match, or the reference has voids.
    """
    if found.shape != reference.shape:
        raise ValueError(
            f"the code makes {found.shape[0]} by {found.shape[1]} cells and the reference has {reference.shape[0]} by "
            f"{reference.shape[1]}; link the terrain that was coded"
        )
    unknown = int(np.count_nonzero(~np.isfinite(reference)))
    if unknown:
        raise ValueError(f"{unknown:,} cells of the reference have no height; fill them with terrain.fill_voids")
    apart = np.abs(found - reference.astype(np.float64))
    rmse = float(np.sqrt(np.mean(apart**2)))
    height = float(reference.max()) - float(reference.min())
    psnr = np.inf if rmse == 0 else 20 * float(np.log10(height / rmse)) if height > 0 else -np.inf
    return Error(psnr, rmse, float(apart.max()))
