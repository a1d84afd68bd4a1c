"""Atoms searched block by block, for dictionaries too large to hold or to multiply with themselves.

Tiles of products <r, d> are made in float32 by BLAS, with a bound of their rounding; what might be the best atom by
that bound is decided in float64 from the atoms themselves.  For an inner product of k terms the bound is
(4 sqrt(k) + 2) 2^-24 |r| (Higham, Mary 2019, A new approach to probabilistic rounding error analysis,
doi:10.1137/18M1226312, at lambda = 4; two more for the rounding of r and d).

``omp`` and ``mp``, and the first round of ``ols``, take one product per atom and signal.  Round j of ``ols`` takes j:
the distance of an atom from the span of the chosen ones is 1 - sum_i <d, u_i>^2, which is not kept.  O(s n N K), or
O(s^2 n N K / 2) for ``ols``; memory for a block of atoms, a tile, and (s + 2) K numbers per signal.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_sparse.atoms import Atoms, Singles, norms, scaled
from nodegraph_sparse.pursuit_host import ALL, Rows
from nodegraph_sparse.pursuit_rules import DEPENDENT, NOISE, Floats, Indices, Preference, Rule

TILE = 4096, 1024
"""Signals and atoms whose products are made at a time: 16 MB, as BLAS takes long to wake its threads for less."""

PAIRS = 1 << 21
"""Numbers of atoms that are looked at closely at a time."""


class BlockSearch:
    """Searches atoms block by block; see `pursuit_host.Search`."""

    def __init__(
        self,
        atoms: Atoms,
        signals: Floats,
        squares: Floats,
        rule: Rule,
        preference: Preference | None,
        context: Context,
    ) -> None:
        """Take some signals.

        Args:
            atoms: where to search.
            signals: (m, k).
            squares: (m,), their squared norms.
            rule: how to choose.
            preference: for these signals.
            context: for cancelling.
        """
        self._atoms = atoms
        self._rule = rule
        self._context = context
        self._signals = signals
        self._floor = NOISE * np.sqrt(squares)
        self._weights = None if preference is None else preference.weights
        self._sources = None if preference is None else preference.sources
        self._residuals = signals.copy()
        count, length = signals.shape
        self._basis = np.zeros((count, rule.sparsity if rule.refits else 0, length))
        self._size = np.zeros(count, np.intp)

    def best(self) -> tuple[Indices, Floats]:
        """Return the atom of the greatest gain for each signal, and the gain."""
        count, length = self._residuals.shape
        best, gains = np.full(count, -1, np.intp), np.zeros(count)
        used = int(self._size.max(initial=0)) if self._rule.selection == "ols" else 0
        left = norms(self._residuals)
        residuals = scaled(self._residuals, left).astype(np.float32)
        basis = np.ascontiguousarray(self._basis[:, :used].transpose(1, 0, 2), np.float32)
        rounding = (4 * length**0.5 + 2) * 2.0**-24
        rows, cols = TILE
        # Fresh memory for every tile would take longer than its products.
        room = np.empty(rows * cols, np.float32)
        for start, block in self._atoms.blocks():
            lengths = norms(block)
            if not np.isfinite(lengths).all():
                raise ValueError(f"atom {start + int(np.argmin(np.isfinite(lengths)))} is not finite or too large")
            unit = scaled(block, lengths).astype(np.float32, copy=False)
            for first in range(start, start + len(unit), cols):
                tile = unit[first - start : first - start + cols].T
                for at in range(0, count, rows):
                    self._context.progress()
                    part = slice(at, min(at + rows, count))
                    upper, slack = self._upper_bounds(
                        part, first, residuals[part], basis[:, part], tile, rounding, room
                    )
                    self._decide(part, first, upper, slack, left[part], best, gains)
        return best, gains

    def _upper_bounds(
        self,
        part: slice,
        first: int,
        residuals: Singles,
        basis: Singles,
        tile: Singles,
        rounding: float,
        room: Singles,
    ) -> tuple[Singles, float]:
        """Return what the roots of the gains do not exceed, as shares of the residuals' norms: a tile plus a slack."""
        shape = len(residuals), tile.shape[1]
        upper = np.matmul(residuals, tile, out=room[: shape[0] * shape[1]].reshape(shape))
        if not self._rule.nonnegative:
            np.abs(upper, out=upper)
        if not len(basis) and self._weights is None:
            return upper, rounding
        upper += np.float32(rounding)
        if len(basis):
            apart = np.ones_like(upper)
            for vectors in basis:
                products = vectors @ tile
                products *= products
                apart -= products
            apart -= np.float32(2 * rounding * len(basis) ** 0.5 + (rounding**2 + 2.0**-23) * len(basis))
            upper /= np.sqrt(np.maximum(apart, np.float32(DEPENDENT), out=apart), out=apart)
        if self._weights is not None and self._sources is not None:
            sources = self._sources[first : first + tile.shape[1]]
            upper *= np.sqrt(self._weights[part]).astype(np.float32)[:, sources]
        # What the operations since the products were rounded by.
        upper *= np.float32(1 + 2.0**-20)
        return upper, 0.0

    def _decide(
        self, part: slice, first: int, upper: Singles, slack: float, left: Floats, best: Indices, gains: Floats
    ) -> None:
        """Find out which atoms of a tile are better than the best so far: the most promising ones first."""
        which = np.arange(part.start, part.stop)
        promise = upper.argmax(axis=1)
        most = np.take_along_axis(upper, promise[:, None], 1)[:, 0]
        rows = np.flatnonzero(most * left >= np.sqrt(gains[part]) - slack * left)
        rows = rows[most[rows] + slack > 0]
        if not len(rows):
            return
        self._improve(which[rows], first + promise[rows], best, gains)
        needed = np.sqrt(gains[which[rows]]) / left[rows] * (1 - 2.0**-22) - slack
        close = upper[rows] >= needed.astype(np.float32)[:, None]
        close[np.arange(len(rows)), promise[rows]] = False
        pairs = np.nonzero(close)
        step = max(1, PAIRS // self._signals.shape[1])
        for start in range(0, len(pairs[0]), step):
            some = slice(start, start + step)
            self._improve(which[rows[pairs[0][some]]], first + pairs[1][some], best, gains)

    def _improve(self, rows: Indices, atoms: Indices, best: Indices, gains: Floats) -> None:
        """Take pairs of a signal and an atom, in float64, where the gain is greater; of equals the first atom."""
        gain = self._gains(rows, atoms)
        # The greatest gain of a signal comes last, and among equals the first atom.
        order = np.lexsort((-atoms, gain, rows))
        last = order[np.flatnonzero(np.append(np.diff(rows[order]) != 0, True))]
        rows, atoms, gain = rows[last], atoms[last], gain[last]
        better = (gain > gains[rows]) | ((gain == gains[rows]) & (gain > 0) & (atoms < best[rows]))
        best[rows[better]] = atoms[better]
        gains[rows[better]] = gain[better]

    def _gains(self, rows: Indices, atoms: Indices) -> Floats:
        unit = self._take(atoms)
        products = np.einsum("ij,ij->i", self._residuals[rows], unit)
        if self._rule.nonnegative:
            products = np.maximum(products, 0)
        gain = np.where(np.abs(products) > self._floor[rows], products**2, 0.0)
        if self._rule.refits:
            used = int(self._size.max(initial=0))
            along = np.matmul(self._basis[rows, :used], unit[:, :, None])[:, :, 0]
            apart = 1 - np.einsum("ij,ij->i", along, along)
            gain[apart <= DEPENDENT] = 0
            if self._rule.selection == "ols":
                gain /= np.maximum(apart, DEPENDENT)
        if self._weights is not None and self._sources is not None:
            gain *= self._weights[rows, self._sources[atoms]]
        return np.asarray(gain)

    def _take(self, atoms: Indices) -> Floats:
        different, where = np.unique(atoms, return_inverse=True)
        found = self._atoms.take(different)
        return scaled(found, norms(found))[where]

    def subtract(self, atoms: Indices) -> Floats:
        """Take away the projection on one atom for each signal."""
        unit = self._take(atoms)
        step = np.einsum("ij,ij->i", self._residuals, unit)
        self._residuals -= step[:, None] * unit
        return np.asarray(step)

    def append(self, atoms: Indices, rows: Rows = ALL) -> tuple[Floats, Floats, Floats]:
        """Add an atom to the basis of each of some signals."""
        which = np.arange(len(self._size))[rows]
        basis = self._basis[rows, : int(self._size[which].max())]
        rest = self._take(atoms)
        along = np.zeros(basis.shape[:2])
        for _ in range(2):  # once leaves what rounding made of an atom close to the span
            more = np.matmul(basis, rest[:, :, None])[:, :, 0]
            rest -= np.matmul(more[:, None], basis)[:, 0]
            along += more
        distance = norms(rest)
        rest /= distance[:, None]
        y = np.einsum("ij,ij->i", self._residuals[rows], rest)
        self._residuals[rows] -= y[:, None] * rest
        self._basis[which, self._size[which]] = rest
        self._size[which] += 1
        return along, distance, np.asarray(y)

    def reset(self, rows: Indices) -> None:
        """Forget the chosen atoms of some signals."""
        self._residuals[rows] = self._signals[rows]
        self._basis[rows] = 0
        self._size[rows] = 0

    def keep(self, going: npt.NDArray[np.bool_]) -> None:
        """Drop the other signals."""
        if going.all():
            return
        for name in ("_signals", "_floor", "_residuals", "_basis", "_size", "_weights"):
            value = getattr(self, name)
            setattr(self, name, None if value is None else value[going])
