"""The rounds of a pursuit, for many signals in step: what does not depend on how atoms are searched.

With a_1 .. a_j the atoms chosen for a signal x, u_1 .. u_j their orthonormal basis by Gram and Schmidt,
L[i, k] = <a_i, u_k> and y[k] = <x, u_k>, the coefficients c solve L' c = y, and the squared residual falls by y[j]^2
with each atom.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from nodegraph_sparse.pursuit_rules import Floats, Indices, Rule

Rows = slice | Indices
ALL = slice(None)


class Search(Protocol):
    """Finds atoms for several signals, and keeps what is left of the signals."""

    def best(self) -> tuple[Indices, Floats]:
        """Return the atom of the greatest gain for each signal, the first of equals, and the gain; 0 where none."""
        ...

    def subtract(self, atoms: Indices) -> Floats:
        """Take away the projection on one atom for each signal; return its coefficient."""
        ...

    def append(self, atoms: Indices, rows: Rows = ALL) -> tuple[Floats, Floats, Floats]:
        """Add an atom to the basis of each of some signals, and take away the projection.

        Returns:
            <a, u> for the basis so far, padded with zeros; the distance of the atom from its span; y.
        """
        ...

    def reset(self, rows: Indices) -> None:
        """Forget the chosen atoms of some signals."""
        ...

    def keep(self, going: npt.NDArray[np.bool_]) -> None:
        """Drop the other signals."""
        ...


class _Fit:
    """The chosen atoms of several signals, and the triangular factors that give the coefficients."""

    def __init__(self, squares: Floats, sparsity: int) -> None:
        count = len(squares)
        self.squares = squares
        self.left = squares.copy()
        self.size = np.zeros(count, np.intp)
        self.atoms = np.full((count, sparsity), -1, np.intp)
        self.factor = np.tile(np.eye(sparsity), (count, 1, 1))
        self.products = np.zeros((count, sparsity))
        self.coefficients = np.zeros((count, sparsity))

    def keep(self, going: npt.NDArray[np.bool_]) -> None:
        for name, value in vars(self).items():
            setattr(self, name, value[going])

    def append(self, atoms: Indices, found: tuple[Floats, Floats, Floats], rows: Rows = ALL) -> None:
        along, distance, product = found
        which = np.arange(len(self.left))[rows]
        slot = self.size[which]
        self.atoms[which, slot] = atoms
        self.factor[which, slot, : along.shape[1]] = along
        self.factor[which, slot, slot] = distance
        self.products[which, slot] = product
        self.left[which] -= product**2
        self.size[which] += 1

    def solve(self, rows: Rows = ALL) -> Floats:
        """Return the coefficients by back substitution; 0 in the empty slots, whose part of the factor is 1."""
        factor, left = self.factor[rows], self.products[rows].copy()
        for slot in range(left.shape[1] - 1, -1, -1):
            left[:, slot] /= factor[:, slot, slot]
            left[:, :slot] -= left[:, slot, None] * factor[:, slot, :slot]
        return left

    def restart(self, rows: Indices, kept: npt.NDArray[np.bool_]) -> tuple[Indices, Floats]:
        """Empty some signals; return the atoms to add again, in order, and their coefficients so far."""
        order = np.argsort(~kept, axis=1, kind="stable")
        atoms = np.take_along_axis(np.where(kept, self.atoms[rows], -1), order, 1)
        coefficients = np.take_along_axis(np.where(kept, self.coefficients[rows], 0.0), order, 1)
        self.left[rows] = self.squares[rows]
        self.size[rows] = 0
        self.atoms[rows] = -1
        self.factor[rows] = np.eye(kept.shape[1])
        self.products[rows] = 0
        return atoms, coefficients


def follow(search: Search, squares: Floats, tolerance: Floats, rule: Rule) -> tuple[Indices, Floats]:
    """Return atoms and coefficients, (n, s) each.

    Args:
        search: finds the atoms; used up.
        squares: squared norms of the signals.
        tolerance: the squared residual at which each signal is good enough.
        rule: how atoms are chosen.
    """
    if not rule.refits:
        return _match(search, squares, tolerance, rule)
    indices = np.full((len(squares), rule.sparsity), -1, np.intp)
    coefficients = np.zeros(indices.shape)
    rows, fit = np.arange(len(squares)), _Fit(squares, rule.sparsity)

    def drop(going: npt.NDArray[np.bool_]) -> None:
        nonlocal rows
        if going.all():
            return
        done = rows[~going]
        indices[done] = fit.atoms[~going]
        coefficients[done] = fit.coefficients[~going] if rule.nonnegative else fit.solve(np.flatnonzero(~going))
        rows = rows[going]
        fit.keep(going)
        search.keep(going)

    for _ in range(rule.rounds):
        drop((fit.left > tolerance[rows]) & (fit.size < rule.sparsity))
        if not len(rows):
            break
        atoms, gain = search.best()
        drop(gain > 0)
        atoms = atoms[gain > 0]
        if not len(rows):
            break
        fit.append(atoms, search.append(atoms))
        if rule.nonnegative:
            _make_nonnegative(search, fit)
    drop(np.zeros(len(rows), bool))
    return indices, coefficients


def _make_nonnegative(search: Search, fit: _Fit) -> None:
    """Find coefficients by the inner loop of Lawson and Hanson: go towards the least squares until one falls to zero.

    The atom that does is given up, and the others are fitted anew.
    """
    rows = np.arange(len(fit.left))
    aim = fit.solve()
    while True:
        used = np.arange(aim.shape[1]) < fit.size[rows, None]
        falling = used & (aim <= 0)
        bad = falling.any(axis=1)
        fit.coefficients[rows[~bad]] = aim[~bad]
        if not bad.any():
            return
        rows, aim, falling, used = rows[bad], aim[bad], falling[bad], used[bad]
        now = fit.coefficients[rows]
        share = np.divide(now, now - aim, out=np.full(now.shape, np.inf), where=falling)
        first = share.min(axis=1, keepdims=True)
        fit.coefficients[rows] = now + first * (aim - now)
        atoms, now = fit.restart(rows, used & (share > first))
        search.reset(rows)
        fit.coefficients[rows] = now
        for slot in range(atoms.shape[1]):
            some = atoms[:, slot] >= 0
            if some.any():
                fit.append(atoms[some, slot], search.append(atoms[some, slot], rows[some]), rows[some])
        aim = fit.solve(rows)


def _match(search: Search, squares: Floats, tolerance: Floats, rule: Rule) -> tuple[Indices, Floats]:
    """Go through the rounds of matching pursuit: an atom that is chosen again adds to its coefficient."""
    indices = np.full((len(squares), rule.sparsity), -1, np.intp)
    coefficients = np.zeros(indices.shape)
    rows, left = np.arange(len(squares)), squares.copy()
    size = np.zeros(len(squares), np.intp)
    for _ in range(rule.rounds):
        going = left[rows] > tolerance[rows]
        search.keep(going)
        rows = rows[going]
        if not len(rows):
            break
        atoms, gain = search.best()
        going = gain > 0
        search.keep(going)
        rows, atoms = rows[going], atoms[going]
        if not len(rows):
            break
        step = search.subtract(atoms)
        again = indices[rows] == atoms[:, None]
        slot = np.where(again.any(axis=1), again.argmax(axis=1), size[rows])
        size[rows] = np.maximum(size[rows], slot + 1)
        indices[rows, slot] = atoms
        coefficients[rows, slot] += step
        left[rows] -= step**2
    return indices, coefficients
