"""What a sparse code says, at the samples of its patches: no interpolation, whole rasters quickly."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_sparse.dictionary import BLOCK, Dictionary, SparseCode
from nodegraph_sparse.metric import fall_off
from nodegraph_sparse.pursuit_rules import Floats

HELD = 1 << 26
"""Samples of atoms that are made once; beyond, those of a few rows of patches at a time."""


def reliefs(dictionary: Dictionary, code: SparseCode) -> Iterator[tuple[slice, Floats]]:
    """Yield sum_j x_ij d_(k_ij) for whole rows of patches at a time: (numbers, (b, size, size) float64)."""
    size, grid = dictionary.size, code.grid
    every = np.unique(code.indices[code.indices >= 0])
    atoms = dictionary.atoms(every) if len(every) * size**2 <= HELD else None
    rows = max(1, BLOCK // (max(1, grid.cols) * size**2))
    for row in range(0, grid.rows, rows):
        part = slice(row * grid.cols, min(row + rows, grid.rows) * grid.cols)
        indices = code.indices[part]
        used = every if atoms is not None else np.unique(indices[indices >= 0])
        held = dictionary.atoms(used) if atoms is None else atoms
        found = np.zeros((len(indices), size, size))
        for index, coefficient in zip(indices.T, code.coefficients[part].T, strict=True):
            some = np.flatnonzero(index >= 0)
            chosen = held[np.searchsorted(used, index[some])]
            found[some] += coefficient[some, None, None] * chosen
        yield part, found


def blended(dictionary: Dictionary, code: SparseCode, context: Context) -> npt.NDArray[np.float64]:
    """Return the terrain that a code makes, sum alpha_i F_i / sum alpha_i, in cells of `size` to the diameter.

    What sparse_terrain gives at the centres of these cells, to rounding.

    Args:
        dictionary: that of the code, or its high counterpart.
        code: with at least one patch.
        context: for progress.
    """
    size, grid = dictionary.size, code.grid
    half = size // 2
    alpha = fall_off(size)
    quarters = alpha.reshape(2, half, 2, half)
    total = np.zeros((grid.rows + 1, half, grid.cols + 1, half))
    weight = np.zeros(total.shape)
    for part, relief in reliefs(dictionary, code):
        context.progress(part.start / grid.count)
        relief += code.means[part, None, None]
        relief *= alpha
        top, bottom = part.start // grid.cols, part.stop // grid.cols
        pieces = relief.reshape(bottom - top, grid.cols, 2, half, 2, half)
        for down in (0, 1):
            for right in (0, 1):
                place = slice(top + down, bottom + down), slice(None), slice(right, right + grid.cols)
                total[place] += pieces[:, :, down, :, right].transpose(0, 2, 1, 3)
                weight[place] += quarters[down, :, None, right]
    cell = 2 * grid.radius / size
    # The first centre is a corner of cells; what lies before it is half a patch.
    north = half - round((grid.extent.north - grid.north) / cell)
    west = half - round((grid.west - grid.extent.west) / cell)
    rows, cols = round(grid.extent.height / cell), round(grid.extent.width / cell)
    flat = (total.shape[0] * half, total.shape[2] * half)
    within = slice(north, north + rows), slice(west, west + cols)
    return np.asarray(total.reshape(flat)[within] / weight.reshape(flat)[within])
