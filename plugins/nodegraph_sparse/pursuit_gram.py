"""Atoms found through their products with the signals and with each other (Batch-OMP).

A round needs, for every atom d, its product c with the residual and its squared distance e from the span of the chosen
atoms.  With q = <d, u> for the newest vector u of the orthonormal basis, c falls by q y and e by q^2.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph_sparse.pursuit_host import ALL, Rows
from nodegraph_sparse.pursuit_rules import DEPENDENT, NOISE, Floats, Indices, Preference, Rule


class GramSearch:
    """Searches all atoms at once; see `pursuit_host.Search`."""

    def __init__(
        self, gram: Floats, correlations: Floats, squares: Floats, rule: Rule, preference: Preference | None
    ) -> None:
        """Take the products of some signals.

        Args:
            gram: (N, N) products of atoms of norm 1, or 0.
            correlations: (m, N) products with the signals.
            squares: (m,) squared norms of the signals.
            rule: how to choose.
            preference: for these signals.
        """
        count, atoms = correlations.shape
        self._gram = gram
        self._rule = rule
        self._distances = np.where(gram.diagonal() > DEPENDENT, gram.diagonal(), np.inf)
        self._first = correlations
        self._floor = NOISE**2 * squares
        self._wanted = None if preference is None else preference.weights[:, preference.sources]
        self._correlations = correlations.copy()
        self._apart = np.tile(self._distances, (count, 1))
        self._basis = np.zeros((count, rule.sparsity if rule.refits else 0, atoms))
        self._size = np.zeros(count, np.intp)

    def best(self) -> tuple[Indices, Floats]:
        """Return the atom of the greatest gain for each signal, and the gain."""
        c = self._correlations
        if self._rule.nonnegative:
            c = np.maximum(c, 0)
        gain = c * c
        gain *= gain > self._floor[:, None]
        if self._rule.selection == "ols":
            gain /= self._apart
        else:
            gain *= self._apart < np.inf
        if self._wanted is not None:
            gain *= self._wanted
        atoms = gain.argmax(axis=1)
        return atoms, gain[np.arange(len(atoms)), atoms]

    def subtract(self, atoms: Indices) -> Floats:
        """Take away the projection on one atom for each signal."""
        step = self._correlations[np.arange(len(atoms)), atoms]
        self._correlations -= step[:, None] * self._gram[atoms]
        return step

    def append(self, atoms: Indices, rows: Rows = ALL) -> tuple[Floats, Floats, Floats]:
        """Add an atom to the basis of each of some signals."""
        which = np.arange(len(self._size))[rows]
        used = int(self._size[which].max())
        basis = self._basis[rows, :used]
        along = np.take_along_axis(basis, atoms[:, None, None], 2)[:, :, 0]
        distance = np.sqrt(self._apart[which, atoms])
        products = self._gram[atoms]
        if used:
            products -= np.matmul(along[:, None], basis)[:, 0]
        products /= distance[:, None]
        y = self._correlations[which, atoms] / distance
        self._correlations[rows] -= y[:, None] * products
        apart = self._apart[rows] - products**2
        apart[apart <= DEPENDENT] = np.inf
        apart[np.arange(len(atoms)), atoms] = np.inf
        self._apart[rows] = apart
        self._basis[which, self._size[which]] = products
        self._size[which] += 1
        return along, distance, y

    def reset(self, rows: Indices) -> None:
        """Forget the chosen atoms of some signals."""
        self._correlations[rows] = self._first[rows]
        self._apart[rows] = self._distances
        self._basis[rows] = 0
        self._size[rows] = 0

    def keep(self, going: npt.NDArray[np.bool_]) -> None:
        """Drop the other signals."""
        if going.all():
            return
        for name in ("_first", "_floor", "_correlations", "_apart", "_basis", "_size", "_wanted"):
            value = getattr(self, name)
            setattr(self, name, None if value is None else value[going])
