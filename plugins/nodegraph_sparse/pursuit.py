"""Sparse coding: signals as sums of few atoms, found one atom at a time by greedy pursuit.

Every round chooses an atom for each signal by its gain, then finds the coefficients:

    ``ols``  orthogonal least squares: the atom which leaves the least residual once all coefficients are found anew
             (the argmin of the paper): greatest <r, d>^2 / |d - P d|^2, P the projection on the chosen atoms;
             coefficients by least squares.
    ``omp``  orthogonal matching pursuit: greatest <r, d>^2; coefficients by least squares.
    ``mp``   matching pursuit: greatest <r, d>^2; only the coefficient of that atom changes, and an atom may be chosen
             again.

Gains are of atoms scaled to norm 1, whatever their own norm.  A preference multiplies them.

Non-negative pursuit takes only atoms whose product with the residual is positive, and finds coefficients by
non-negative least squares on the chosen atoms (Lawson, Hanson): an atom whose coefficient falls to zero is given up
and makes room for another.  At the end no coefficient is negative and none could change to lessen the residual.

All is float64.  Up to `GRAM` atoms, rounds need no signal but its products with the atoms and those of the atoms with
each other (Batch-OMP, by a progressive Cholesky factor): BLAS makes the products, and NumPy or an OpenCL kernel goes
through the rounds, O(n N (K + s^2)).  More atoms are searched in blocks and never held at once: see `pursuit_blocks`.

Sources: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, section 4.3,
doi:10.1111/cgf.12821; Chen, Billings, Luo 1989, Orthogonal least squares methods, doi:10.1080/00207178908953472;
Mallat, Zhang 1993, Matching pursuits with time-frequency dictionaries, doi:10.1109/78.258082; Rubinstein, Zibulevsky,
Elad 2008, Efficient implementation of the K-SVD algorithm using Batch Orthogonal Matching Pursuit, Technion
CS-2008-08; Nguyen et al. 2019, Non-negative orthogonal greedy algorithms, doi:10.1109/TSP.2019.2943225.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_sparse import pursuit_opencl
from nodegraph_sparse.atoms import ArrayAtoms, Atoms, DictionaryAtoms, norms, scaled
from nodegraph_sparse.dictionary import Dictionary
from nodegraph_sparse.metric import columns, mass
from nodegraph_sparse.pursuit_blocks import BlockSearch
from nodegraph_sparse.pursuit_gram import GramSearch
from nodegraph_sparse.pursuit_host import follow
from nodegraph_sparse.pursuit_rules import EXACT, Floats, Indices, Preference, Pursuit, Rule, Selection

if TYPE_CHECKING:
    from nodegraph.opencl import Device

Rounds = Callable[[Floats, Floats, Floats, Preference | None], tuple[npt.NDArray[Any], Floats, Floats]]
"""From signals, their squared norms, tolerances and preference to atoms, coefficients and squared residuals."""

__all__ = ["GRAM", "Pursuit", "Selection", "pursue", "pursue_samples"]

GRAM = 8192
"""Up to how many atoms their products with each other are held: 512 MB."""

CORRELATIONS = 1 << 22
"""Products of signals and atoms that are held at a time: 32 MB."""

IN_STEP = 1 << 19
"""Numbers per signal and atom that NumPy works on at a time: about what a processor's cache holds."""

STATE = 1 << 24
"""Numbers that a search by blocks keeps of signals, at a time: 128 MB."""


def pursue(
    signals: npt.NDArray[Any],
    atoms: npt.NDArray[Any],
    sparsity: int,
    *,
    selection: Selection = "ols",
    tolerance: float | npt.NDArray[Any] = 0.0,
    nonnegative: bool = False,
    weights: npt.NDArray[Any] | None = None,
    sources: npt.NDArray[Any] | None = None,
    device: Device | None = None,
    context: Context | None = None,
) -> Pursuit:
    """Return each signal as a sum of at most `sparsity` atoms.

    A pursuit ends early where the residual is good enough or nothing but rounding is left: for a zero signal, for one
    that is found to seven digits, and when the atoms span no more.  An atom in the span of the chosen ones, such as the
    second of two equal ones, is never chosen with `ols` and `omp`; nor is a zero atom.  Of equal atoms, and of others
    whose gains do not differ by rounding, the first is chosen.

    Args:
        signals: (n, k), finite.
        atoms: (N, k), finite; of any norm.
        sparsity: s, the most atoms of a signal; the number of rounds for `mp`.
        selection: how atoms are chosen and coefficients found; see the module.
        tolerance: the squared residual that is good enough, of all signals or of each (n,).
        nonnegative: allow no negative coefficients.
        weights: (n, sources), 0 to 1: what multiplies the gains of the atoms of each source; 0 forbids them.
        sources: (N,), the source of each atom; needed with `weights`.
        device: goes through the rounds, if it has float64 and `atoms` are at most `GRAM`; none: NumPy.
        context: for progress and cancelling.

    Raises:
        ValueError: the shapes do not match, or numbers are out of range or not finite.
    """
    if signals.ndim != 2 or atoms.ndim != 2 or signals.shape[1] != atoms.shape[1]:
        raise ValueError(f"signals and atoms of shapes {signals.shape} and {atoms.shape} must be rows of equal length")
    rule, limit, preference = _checked(
        len(signals), len(atoms), sparsity, selection, tolerance, nonnegative, weights, sources
    )
    context = context or Context()
    given = _Signals(len(signals), signals.shape[1], lambda part: np.ascontiguousarray(signals[part], np.float64))
    if len(atoms) > GRAM:
        return _by_blocks(given, ArrayAtoms(atoms), rule, limit, preference, context)
    return _by_gram(given, np.asarray(atoms, np.float64), rule, limit, preference, device, context)


def pursue_samples(
    samples: npt.NDArray[Any],
    dictionary: Dictionary,
    sparsity: int,
    *,
    selection: Selection = "ols",
    tolerance: float | npt.NDArray[Any] = 0.0,
    nonnegative: bool = False,
    weights: npt.NDArray[Any] | None = None,
    device: Device | None = None,
    context: Context | None = None,
) -> Pursuit:
    """Return patches as sums of atoms of a dictionary, in its metric, in bounded memory.

    Args:
        samples: (n, size, size) of the size of the atoms.
        dictionary: whose atoms; held at once only up to `GRAM` of them.
        weights: (n, sources) for the sources of the dictionary.
        sparsity, selection, tolerance, nonnegative, device, context: as of `pursue`.

    Raises:
        ValueError: as of `pursue`.
    """
    metric = dictionary.metric
    length = int(np.count_nonzero(mass(dictionary.size, metric)))
    signals = _Signals(len(samples), length, lambda part: columns(samples[part], metric))
    rule, limit, preference = _checked(
        len(samples), dictionary.count, sparsity, selection, tolerance, nonnegative, weights, dictionary.sources
    )
    context = context or Context()
    if dictionary.count > GRAM:
        return _by_blocks(signals, DictionaryAtoms(dictionary), rule, limit, preference, context)
    atoms = columns(dictionary.atoms(slice(0, dictionary.count)), metric)
    return _by_gram(signals, atoms, rule, limit, preference, device, context)


@dataclass(frozen=True, slots=True)
class _Signals:
    """Signals that are made float64 vectors a part at a time."""

    count: int
    length: int
    read: Callable[[slice], Floats]


def _checked(
    count: int,
    atoms: int,
    sparsity: int,
    selection: Selection,
    tolerance: float | npt.NDArray[Any],
    nonnegative: bool,
    weights: npt.NDArray[Any] | None,
    sources: npt.NDArray[Any] | None,
) -> tuple[Rule, Floats, Preference | None]:
    if sparsity < 1:
        raise ValueError(f"sparsity is {sparsity} and must be 1 or more")
    if selection not in ("ols", "omp", "mp"):
        raise ValueError(f"selection is '{selection}' and must be 'ols', 'omp' or 'mp'")
    limit = np.asarray(tolerance, np.float64)
    if limit.shape not in ((), (count,)) or not (limit >= 0).all():
        raise ValueError(f"the tolerance must be a number of 0 or more, or one for each of {count} signals")
    rule = Rule(sparsity, selection, nonnegative)
    limit = np.ascontiguousarray(np.broadcast_to(limit, count))
    if weights is None:
        return rule, limit, None
    if sources is None or sources.shape != (atoms,):
        raise ValueError(f"weights need the source of each of {atoms} atoms")
    wanted = np.ascontiguousarray(weights, np.float64)
    if (
        wanted.ndim != 2
        or len(wanted) != count
        or (atoms and not 0 <= sources.min() <= sources.max() < wanted.shape[1])
    ):
        raise ValueError(f"weights of shape {wanted.shape} do not fit {count} signals and the sources of the atoms")
    if not ((wanted >= 0) & (wanted <= 1)).all():
        raise ValueError("weights must be between 0 and 1")
    return rule, limit, Preference(wanted, np.ascontiguousarray(sources, np.int32))


def _squares(what: str, rows: Floats, first: int = 0) -> Floats:
    found = np.einsum("ij,ij->i", rows, rows)
    if not np.isfinite(found).all():
        raise ValueError(f"{what} {first + int(np.argmin(np.isfinite(found)))} is not finite or too large")
    return np.asarray(found)


def _empty(signals: _Signals, rule: Rule) -> Pursuit:
    shape = signals.count, rule.sparsity
    return Pursuit(np.full(shape, -1, np.int32), np.zeros(shape), np.zeros(signals.count))


def _by_gram(
    signals: _Signals,
    atoms: Floats,
    rule: Rule,
    tolerance: Floats,
    preference: Preference | None,
    device: Device | None,
    context: Context,
) -> Pursuit:
    if not len(atoms):
        atoms, preference = np.zeros((1, signals.length)), None  # a zero atom is never chosen
    lengths = np.sqrt(_squares("atom", atoms))
    unit = scaled(atoms, lengths)
    first = _first_of_equals(unit, None if preference is None else preference.sources)
    if len(first) < len(unit):
        unit, lengths = unit[first], lengths[first]
        preference = None if preference is None else Preference(preference.weights, preference.sources[first])
    pursuit = _empty(signals, rule)
    if device is not None and pursuit_opencl.can_pursue(device):
        rounds: Rounds = pursuit_opencl.rounds_on(device, unit, rule)
    else:
        rounds = _rounds_on_host(unit, rule, context)
    for part in _parts(signals.count, CORRELATIONS // max(len(unit), signals.length)):
        context.progress(part.start / signals.count)
        vectors = signals.read(part)
        squares = _squares("signal", vectors, part.start)
        limit = np.maximum(tolerance[part], EXACT * squares)
        wanted = None if preference is None else preference.part(part)
        chosen, coefficients, pursuit.residuals[part] = rounds(vectors, squares, limit, wanted)
        used = chosen >= 0
        pursuit.indices[part] = np.where(used, first[chosen], -1)
        pursuit.coefficients[part] = np.divide(coefficients, lengths[chosen], out=np.zeros(chosen.shape), where=used)
    return pursuit


def _rounds_on_host(unit: Floats, rule: Rule, context: Context) -> Rounds:
    gram = unit @ unit.T

    def rounds(
        signals: Floats, squares: Floats, tolerance: Floats, preference: Preference | None
    ) -> tuple[Indices, Floats, Floats]:
        correlations = signals @ unit.T
        indices, coefficients = (
            np.empty((len(signals), rule.sparsity), np.intp),
            np.empty((len(signals), rule.sparsity)),
        )
        per_signal = len(unit) * (rule.sparsity + 3)
        for part in _parts(len(signals), IN_STEP // per_signal):
            context.progress()
            wanted = None if preference is None else preference.part(part)
            search = GramSearch(gram, correlations[part], squares[part], rule, wanted)
            indices[part], coefficients[part] = follow(search, squares[part], tolerance[part], rule)
        return indices, coefficients, _residuals(signals, ArrayAtoms(unit), indices, coefficients)

    return rounds


def _by_blocks(
    signals: _Signals, atoms: Atoms, rule: Rule, tolerance: Floats, preference: Preference | None, context: Context
) -> Pursuit:
    pursuit = _empty(signals, rule)
    for part in _parts(signals.count, STATE // (max(1, signals.length) * (rule.sparsity + 3))):
        context.progress(part.start / signals.count)
        vectors = signals.read(part)
        squares = _squares("signal", vectors, part.start)
        limit = np.maximum(tolerance[part], EXACT * squares)
        wanted = None if preference is None else preference.part(part)
        search = BlockSearch(atoms, vectors, squares, rule, wanted, context)
        indices, coefficients = follow(search, squares, limit, rule)
        used = indices >= 0
        different, where = np.unique(indices[used], return_inverse=True)
        coefficients[used] /= norms(atoms.take(different))[where]
        pursuit.indices[part], pursuit.coefficients[part] = indices, coefficients
        pursuit.residuals[part] = _residuals(vectors, atoms, indices, coefficients)
    return pursuit


def _residuals(signals: Floats, atoms: Atoms, indices: Indices, coefficients: Floats) -> Floats:
    """Return what the sums of atoms really leave, free of what cancels in the rounds."""
    squares = np.empty(len(signals))
    for part in _parts(len(signals), CORRELATIONS // (4 * max(1, indices.shape[1] * signals.shape[1]))):
        # No atom counts as one of no amount.
        chosen = atoms.take(np.maximum(indices[part], 0).ravel()).reshape(*indices[part].shape, signals.shape[1])
        rest = signals[part] - np.matmul(coefficients[part, None], chosen)[:, 0]
        squares[part] = np.einsum("ij,ij->i", rest, rest)
    return squares


def _parts(count: int, most: int) -> Iterator[slice]:
    step = max(1, most)
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))


def _first_of_equals(unit: Floats, sources: npt.NDArray[Any] | None) -> Indices:
    """Return the numbers of atoms, in order, without those that equal an earlier one of the same source.

    Equal atoms have equal gains but for rounding: left in, chance would decide between them.
    """
    seen: dict[tuple[bytes, int], int] = {}
    for number, row in enumerate(unit + 0.0):  # -0 becomes 0
        seen.setdefault((row.tobytes(), 0 if sources is None else int(sources[number])), number)
    return np.fromiter(seen.values(), np.intp, len(seen))
