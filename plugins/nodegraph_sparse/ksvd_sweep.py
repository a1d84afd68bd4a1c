"""Learning a dictionary by alternation: code all signals, then better each atom for those that use it.

What is lessened is the objective F = sum_i ||y_i - sum_j x_ij d_j||^2 over atoms d of norm 1 and codes x of at most s
atoms.  Neither half of a sweep raises it, but for rounding:

- Coding.  A pursuit is greedy and may find worse than what a signal had.  Each signal keeps the best of three codes:
  the one it had, its atoms with coefficients fitted anew, and what the pursuit found; then one atom is exchanged.  Or
  the codes are the pursuit's alone as long as F falls from sweep to sweep: then the atoms are made for pursuits.
- Atoms, one after another, each with coefficients of its users.  With E the rest of those users without the atom, row
  by row, ||E - x d'||^2 is ||E||^2 - ||E d||^2 at the best coefficients x = E d, so the best atom has the greatest
  ||E d||^2 = d' (E' E) d.  Whatever is proposed as the new atom is taken only if it has no less than the old one.

An atom that no signal uses does not count in F, so replacing it is free; the next coding may use it.

Sources: Aharon, Elad, Bruckstein 2006, K-SVD: an algorithm for designing overcomplete dictionaries for sparse
representation, IEEE Transactions on Signal Processing 54(11), doi:10.1109/TSP.2006.881199.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_sparse.ksvd_code import exchange, parts, refit, summed
from nodegraph_sparse.pursuit import Selection, pursue
from nodegraph_sparse.pursuit_rules import Floats, Indices

Better = Callable[["State", Context, float, float], Indices]
"""Goes through the atoms once, with progress from a number on by a share; returns the numbers of those unused."""

Propose = Callable[[int, Floats, Floats], Floats | None]
"""From the number of an atom, its users' rest without it, (m, K), and their coefficients, (m,), to a better atom."""

Coding = Literal["best", "pursuit"]

Replace = Callable[[Indices, Floats], Indices]
"""From the numbers of unused atoms and the squared residual of each signal; writes atoms, returns which it replaced."""


@dataclass
class State:
    """Signals, atoms, and the code of the ones by the others; changes in place.

    Attributes:
        signals: (n, K).  Only the first `counted` columns count; atoms are carried along in the others.
        counted: k.
        atoms: (N, K), norm 1 in the columns that count.
        indices: (n, s), -1 where none.
        coefficients: (n, s), 0 where none.
        rest: (n, K), the signals less their sums of atoms.
    """

    signals: Floats
    counted: int
    atoms: Floats
    indices: npt.NDArray[np.int32]
    coefficients: Floats
    rest: Floats

    @classmethod
    def start(cls, signals: Floats, counted: int, atoms: Floats, sparsity: int) -> State:
        """Begin with no atom used by any signal."""
        shape = len(signals), sparsity
        return cls(signals, counted, atoms, np.full(shape, -1, np.int32), np.zeros(shape), signals.copy())

    @property
    def residuals(self) -> Floats:
        """Return the squared norm of what is left of each signal, (n,)."""
        rest = self.rest[:, : self.counted]
        return np.asarray(np.einsum("ij,ij->i", rest, rest))

    def keep_rest(self) -> None:
        """Find out anew what is left, free of the rounding of many small steps."""
        for part in parts(len(self.signals), self.signals.shape[1]):
            sums = summed(self.atoms, self.indices[part], self.coefficients[part])
            self.rest[part] = self.signals[part] - sums


@dataclass(frozen=True, slots=True)
class Sweeps:
    """How the learning went, from the first coding on; one number more than there were iterations.

    Attributes:
        objective: F after each coding.
        replaced: unused atoms that were replaced in each iteration, 0 in the first place.
        kept: signals whose former atoms were better than what the pursuit found, likewise.
    """

    objective: Floats
    replaced: npt.NDArray[np.int32]
    kept: npt.NDArray[np.int32]


def learn(
    state: State,
    iterations: int,
    better: Better,
    replace: Replace,
    *,
    selection: Selection = "ols",
    coding: Coding = "best",
    tolerance: float = 0.0,
    context: Context,
) -> Sweeps:
    """Better atoms and code in place, and return how it went.

    Args:
        state: with its first atoms.
        iterations: sweeps over all atoms, each followed by a coding.
        better: the atoms, and the coefficients of their users.
        replace: atoms without users.
        selection: of the pursuit.
        coding: ``best``, or ``pursuit`` alone as long as F falls.
        tolerance: ends after s iterations in a row of which none lessens F by more than this share.
        context: for progress and cancelling.
    """
    code(state, 0, selection, np.inf if coding == "pursuit" else None, _quiet(context))
    history, still = [(float(state.residuals.sum()), 0, 0)], 0
    for iteration in range(iterations):
        unused = better(state, context, iteration / iterations, 1 / iterations)
        replaced = len(replace(unused, state.residuals)) if len(unused) else 0
        before = history[-1][0]
        kept = code(state, iteration + 1, selection, before if coding == "pursuit" else None, _quiet(context))
        objective = float(state.residuals.sum())
        history.append((objective, replaced, kept))
        # After s codings every place has had its exchange.
        still = still + 1 if before - objective <= tolerance * before and not replaced else 0
        if still == state.indices.shape[1]:
            break
    columns = np.array(history)
    return Sweeps(columns[:, 0], columns[:, 1].astype(np.int32), columns[:, 2].astype(np.int32))


def _quiet(context: Context) -> Context:
    """Return a context for parts of the work, which can be cancelled and have no progress of their own."""
    return Context(context.node, report=lambda _, message: context.progress(None, message))


def better_atoms(propose: Propose, state: State, context: Context, done: float, share: float) -> Indices:
    """Go through the atoms once; return the numbers of those without users.

    Args:
        propose: a better atom.
        state: whose atoms and coefficients change.
        context: for progress, from `done` on by a `share`.
        done: of the whole.
        share: of the whole.
    """
    counted = state.counted
    unused: list[int] = []
    for atom, rows, slots in users(state.indices, len(state.atoms)):
        context.progress(done + share * atom / len(state.atoms))
        if not len(rows):
            unused.append(atom)
            continue
        old, amounts = state.atoms[atom], state.coefficients[rows, slots]
        error = state.rest[rows] + amounts[:, None] * old
        best, least = fitted(error[:, :counted], old[:counted])
        new = propose(atom, error, amounts)
        if new is not None:
            amounts, gain = fitted(error[:, :counted], new[:counted])
            if gain >= least:
                best = amounts
                state.atoms[atom] = new
        state.coefficients[rows, slots] = best
        state.rest[rows] = error - best[:, None] * state.atoms[atom]
    return np.array(unused, np.intp)


def fitted(error: Floats, atom: Floats) -> tuple[Floats, float]:
    """Return the best coefficients of an atom, whose norm may be off 1 by rounding, and by how much they lessen E."""
    products, square = error @ atom, float(atom @ atom)
    return products / square, float(products @ products) / square


def users(indices: npt.NDArray[np.int32], count: int) -> Iterator[tuple[int, Indices, Indices]]:
    """Yield for each atom its number, the signals that use it, and in which place."""
    order = np.argsort(indices, axis=None, kind="stable")
    ends = np.searchsorted(indices.ravel()[order], np.arange(count + 1))
    for atom in range(count):
        rows, slots = np.divmod(order[ends[atom] : ends[atom + 1]], indices.shape[1])
        yield atom, rows, slots


def code(state: State, slot: int, selection: Selection, limit: float | None, context: Context) -> int:
    """Give each signal the best code of those that it had, refitted, and that a pursuit finds; then exchange an atom.

    Args:
        state: whose code changes.
        slot: the place whose atom is exchanged, modulo s.
        selection: of the pursuit.
        limit: where F is no more than this after the pursuit, its codes are taken as they are; none: never.
        context: for cancelling.

    Returns:
        How many signals keep their former atoms although the pursuit found others.
    """
    signals, atoms = state.signals[:, : state.counted], state.atoms[:, : state.counted]
    sparsity = state.indices.shape[1]
    residuals = state.residuals
    found = pursue(signals, atoms, sparsity, selection=selection, context=context)
    if limit is not None and found.residuals.sum() <= limit:
        state.indices, state.coefficients = found.indices, found.coefficients
        state.keep_rest()
        return 0
    others = (np.sort(found.indices, axis=1) != np.sort(state.indices, axis=1)).any(axis=1)
    refitted = state.indices, *refit(signals, atoms, state.indices)
    _take_better(state, residuals, *refitted)
    better = _take_better(state, residuals, found.indices, found.coefficients, found.residuals)
    context.progress()
    if sparsity > 1:
        exchanged = exchange(signals, atoms, state.indices, slot % sparsity)
        _take_better(state, residuals, exchanged, *refit(signals, atoms, exchanged))
    state.keep_rest()
    return int(np.count_nonzero(others & ~better))


def _take_better(
    state: State, residuals: Floats, indices: npt.NDArray[np.int32], coefficients: Floats, found: Floats
) -> npt.NDArray[np.bool_]:
    """Take the codes that leave less than the residuals so far, which change too; return which."""
    better: npt.NDArray[np.bool_] = found < residuals
    state.indices = np.where(better[:, None], indices, state.indices)
    state.coefficients = np.where(better[:, None], coefficients, state.coefficients)
    residuals[better] = found[better]
    return better
