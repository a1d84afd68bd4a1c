"""Patches and atoms as vectors for learning, and back; and where learning begins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_sparse.dictionary import Patches, SparseCode
from nodegraph_sparse.ksvd_sweep import State
from nodegraph_sparse.metric import Metric, mass
from nodegraph_sparse.patch_grid import PatchGrid
from nodegraph_sparse.pursuit_rules import DEPENDENT, Floats, Indices
from nodegraph_terrain.raster import Extent


@dataclass(frozen=True, slots=True)
class Layout:
    """Samples in another order: first those with mass, times its root, then the others as they are.

    Plain products of the first `counted` numbers are products in the metric; the others are carried along.
    """

    size: int
    order: Indices
    scale: Floats
    counted: int

    @classmethod
    def of(cls, size: int, metric: Metric) -> Layout:
        """Return the layout for patches of a size in a metric."""
        counts = mass(size, metric).ravel()
        order = np.argsort(counts <= 0, kind="stable")
        scale = np.sqrt(counts[order])
        return cls(size, order, np.where(scale > 0, scale, 1.0), int(np.count_nonzero(scale)))

    def vectors(self, samples: npt.NDArray[Any]) -> Floats:
        """Return squares of samples as vectors, (n, size^2)."""
        flat = samples.reshape(len(samples), -1)[:, self.order]
        return np.asarray(flat * self.scale)

    def samples(self, vectors: Floats) -> npt.NDArray[np.float32]:
        """Return vectors as squares of samples, (n, size, size)."""
        flat = np.empty(vectors.shape, np.float32)
        flat[:, self.order] = vectors / self.scale
        return flat.reshape(-1, self.size, self.size)


def seeds(signals: Floats, count: int, context: Context) -> Indices:
    """Return the numbers of signals to begin with: drawn in proportion to what those before leave of them, squared.

    The greedy seeding of k-means++ with lines instead of points: of 2 + log N draws the one is taken that leaves least.
    It finds signals that matter and differ, without falling for outliers as the farthest choice does.

    Args:
        signals: (n, k).
        count: of seeds; fewer are found where nothing is left.
        context: throws the dice.

    Source: Arthur, Vassilvitskii 2007, k-means++: the advantages of careful seeding, Proceedings of the 18th
    ACM-SIAM Symposium on Discrete Algorithms, pages 1027-1035.
    """
    squares = np.einsum("ij,ij->i", signals, signals)
    left = squares.copy()
    found: list[int] = []
    trials = 2 + int(np.log(count))
    while len(found) < count and left.max() > 0:
        context.progress()
        drawn = context.rng.choice(len(signals), trials, p=left / left.sum())
        after = np.minimum(left[:, None], squares[:, None] - (signals @ signals[drawn].T) ** 2 / squares[drawn])
        after[after <= DEPENDENT * squares[:, None]] = 0
        best = int(after.sum(axis=0).argmin())
        found.append(int(drawn[best]))
        left = after[:, best]
    return np.array(found, np.intp)


def worst(state: State, residuals: Floats, count: int) -> Indices:
    """Return the numbers of the worst-coded signals, the worst first; none of which only rounding is left."""
    squares = np.einsum("ij,ij->i", *[state.signals[:, : state.counted]] * 2)
    order: Indices = np.argsort(-residuals, kind="stable")[:count]
    kept: Indices = order[residuals[order] > DEPENDENT * squares[order]]
    return kept


def sparse_code(patches: Patches, state: State) -> SparseCode:
    """Return the code as a value, atoms of greater coefficients first; without patches where they lie on no grid."""
    grid = patches.grid
    if grid is None:
        (west, south), (east, north) = patches.centres.min(axis=0).tolist(), patches.centres.max(axis=0).tolist()
        r = patches.radius
        grid = PatchGrid(Extent(west - r, south - r, east + r, north + r), r, west, north, 0, 0)
    some = slice(0, grid.count)
    order = np.argsort(np.where(state.indices >= 0, -np.abs(state.coefficients), np.inf)[some], axis=1, kind="stable")
    return SparseCode(
        grid,
        np.take_along_axis(state.indices[some], order, 1).astype(np.int32),
        np.take_along_axis(state.coefficients[some], order, 1),
        patches.means[some],
        state.residuals[some],
        len(state.atoms),
        patches.metric,
        patches.size,
    )
