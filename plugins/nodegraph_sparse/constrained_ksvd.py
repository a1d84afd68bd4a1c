"""Constrained K-SVD: a small dictionary chosen from a great one."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node
from nodegraph_sparse.dictionary import Dictionary, Patches
from nodegraph_sparse.dictionary_from_patches import dictionary_from_patches, farthest
from nodegraph_sparse.ksvd import (
    ATOMS,
    CODING,
    ITERATIONS,
    SELECTION,
    SPARSITY,
    TOLERANCE,
    Choice,
    Greedy,
    Learned,
    require_match,
)
from nodegraph_sparse.ksvd_code import Codes, refit, summed, whitening
from nodegraph_sparse.ksvd_sweep import Coding, State, learn, users
from nodegraph_sparse.ksvd_vectors import seeds, sparse_code, worst
from nodegraph_sparse.learning import learning
from nodegraph_sparse.metric import columns, mass
from nodegraph_sparse.pursuit_rules import DEPENDENT, Floats, Indices

Singles = npt.NDArray[np.float32]

SHORTLIST = 32
"""Candidates whose gain is found with all coefficients fitted anew."""

BLOCK = 1 << 22
"""Products with candidates that are made at a time: 16 MB."""


@node(version=1, title="Constrained K-SVD")
def constrained_ksvd(
    patches: Patches,
    candidates: Dictionary | None = None,
    *,
    atoms: Annotated[int, ATOMS] = 128,
    sparsity: Annotated[int, SPARSITY] = 2,
    iterations: Annotated[int, ITERATIONS] = 20,
    choice: Annotated[Choice, Param("Which candidates the atoms are at first.")] = "residual",
    selection: Annotated[Greedy, SELECTION] = "ols",
    coding: Annotated[Coding, CODING] = "best",
    tolerance: Annotated[float, TOLERANCE] = 0.0,
    seed: Annotated[int, Param("Another one begins with other candidates.", ge=0)] = 0,  # noqa: ARG001
    context: Context,
) -> Learned:
    """Choose the atoms that describe patches best from a set of candidates, and the sums (problem 2).

    As ``sparse.ksvd``, but atoms are members of the set: the patches themselves, a whole map, or functions.  So an atom
    keeps what belongs to it: the finer map around it, or the noise at any resolution.  The dictionary is of the kind of
    the candidates (those of a map, or noise, stay so), and goes into multiresolution_dictionary as they do.

    A better atom for the patches that use one, whose rest without it is E: at the best coefficients x = E f a candidate
    f of norm 1 leaves ||E||^2 - ||E f||^2, so the best has the greatest f' (E' E) f.  All candidates are compared by
    one product of matrices, with E' E or with E, whichever is smaller; E is what the other atoms of each patch leave by
    themselves.  As their coefficients then change too, the gain is greater still, sum_i <e_i, f>^2 / |f - P_i f|^2 with
    P_i the projection on the others: by it the best of the first 32 is found.  Candidates that are atoms already are
    passed over: the same atom twice is of no use.  The error never rises, as of ``sparse.ksvd``.

    An atom that no patch uses is replaced by the candidate that is nearest to the worst-coded patch, up to scale.

    Args:
        patches: to be described; of a grid, or of random places.
        candidates: of the same size and metric; none: all patches that are not flat.
        atoms: N.
        sparsity: s.
        iterations: fewer are made where nothing changes any more.
        choice: ``residual`` (candidates nearest to patches drawn in proportion to the square of what those before leave
            of them), ``random`` or ``farthest`` in shape.
        selection: ``ols`` or ``omp``.
        coding: ``best``, or ``pursuit`` for a dictionary that is to code other terrain.
        tolerance: 0 goes on as long as the error falls.
        seed: of the choice.
        context: the engine's.

    Returns:
        ``dictionary``: the chosen candidates; ``code``: of the patches by them, without patches if those lie on no
        grid; ``learning``: the error of each iteration.

    Raises:
        ValueError: there are less candidates than atoms, they do not match the patches, or the patches are all flat.

    Complexity: O(N M k min(k, n s / N) + n N (k + s^2)) an iteration for M candidates of k samples, of which 4 M k
    bytes are held.

    Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum
    35(2), section 4.4, doi:10.1111/cgf.12821.
    """
    if candidates is None:
        candidates = dictionary_from_patches(patches, context=context)
    require_match(patches, candidates, "set of candidates")
    if atoms > candidates.count:
        raise ValueError(
            f"{atoms} atoms cannot be chosen from {candidates.count} candidates; ask for at most that many"
        )
    signals = columns(patches.samples, patches.metric)
    every = _vectors(candidates)
    chosen = _first(signals, every, atoms, choice, context)
    taken = np.zeros(candidates.count, np.bool_)
    taken[chosen] = True

    def atom(number: int) -> Floats:
        return np.asarray(columns(candidates.atoms(np.array([number])), candidates.metric)[0])

    state = State.start(signals, signals.shape[1], np.stack([atom(number) for number in chosen.tolist()]), sparsity)

    def change(place: int, candidate: int) -> None:
        taken[chosen[place]] = False
        taken[candidate] = True
        chosen[place] = candidate
        state.atoms[place] = atom(candidate)

    def better(state: State, context: Context, done: float, share: float) -> Indices:
        unused: list[int] = []
        gram = state.atoms @ state.atoms.T
        for place, rows, slots in users(state.indices, atoms):
            context.progress(done + share * place / atoms)
            if not len(rows):
                unused.append(place)
                continue
            part, indices = state.signals[rows], state.indices[rows]
            others = indices.copy()
            others[np.arange(len(rows)), slots] = -1
            error = part - summed(state.atoms, others, refit(part, state.atoms, others)[0])
            scores = explained(every, error)
            scores[taken] = -1
            first = np.argsort(-scores, kind="stable")[:SHORTLIST]
            first = np.append(chosen[place], first[scores[first] > 0])
            near = columns(candidates.atoms(first), candidates.metric)
            best = int(gains(error, near, state.atoms, whitening(gram, others), others).argmax())
            if best == 0:
                continue
            before = chosen[place]
            change(place, int(first[best]))
            coefficients, residuals = refit(part, state.atoms, indices)
            rest = state.rest[rows]
            if residuals.sum() >= np.einsum("ij,ij->", rest, rest):  # to rounding
                change(place, int(before))
                continue
            gram[place] = gram[:, place] = state.atoms @ state.atoms[place]
            state.coefficients[rows] = coefficients
            state.rest[rows] = part - summed(state.atoms, indices, coefficients)
        return np.array(unused, np.intp)

    def replace(unused: Indices, residuals: Floats) -> Indices:
        which = worst(state, residuals, len(unused))
        for place, signal in zip(unused.tolist(), which.tolist(), strict=False):
            near = np.abs(every @ signals[signal].astype(np.float32))
            near[taken] = -1
            best = int(near.argmax())
            if near[best] >= 0:
                change(place, best)
        return unused[: len(which)]

    sweeps = learn(
        state, iterations, better, replace, selection=selection, coding=coding, tolerance=tolerance, context=context
    )
    return Learned(candidates.take(chosen), sparse_code(patches, state), learning(patches, atoms, sparsity, sweeps))


@constrained_ksvd.forecast
def _forecast(patches: Forecast, candidates: Forecast | None = None, *, atoms: int, **_: object) -> Forecast:
    every = patches if candidates is None else candidates
    return Forecast(4 * atoms * 256 + patches.bytes // 8, 6 * patches.bytes + 2 * every.bytes + (64 << 20), known=False)


def explained(candidates: Singles, error: Floats) -> Singles:
    """Return ||E f||^2 = f' (E' E) f for each candidate f: one product of matrices, in blocks.

    Args:
        candidates: (M, k).
        error: E, (m, k).
    """
    count, length = candidates.shape
    direct = len(error) <= length
    factor = (error.T if direct else error.T @ error).astype(np.float32)
    scores = np.empty(count, np.float32)
    step = max(1, BLOCK // factor.shape[1])
    for start in range(0, count, step):
        some = candidates[start : start + step]
        products = some @ factor
        scores[start : start + step] = np.einsum("ij,ij->i", products, products if direct else some)
    return scores


def gains(error: Floats, candidates: Floats, atoms: Floats, bases: Floats, others: Codes) -> Floats:
    """Return by how much each candidate lessens the error of its users, with all their coefficients fitted anew, (c,).

    Args:
        error: (m, k), what the other atoms of each user leave.
        candidates: (c, k).
        atoms: (N, k).
        bases: (m, s, s), the `whitening` of the others.
        others: (m, s), -1 where none.
    """
    products = (atoms @ candidates.T)[others] * (others >= 0)[:, :, None]
    along = bases @ products
    apart = np.einsum("ij,ij->i", candidates, candidates) - np.einsum("ijk,ijk->ik", along, along)
    squares = (error @ candidates.T) ** 2
    return np.asarray(np.where(apart > DEPENDENT, squares / np.maximum(apart, DEPENDENT), 0.0).sum(axis=0))


def _vectors(dictionary: Dictionary) -> Singles:
    """Return all atoms in float32, (N, k)."""
    length = int(np.count_nonzero(mass(dictionary.size, dictionary.metric)))
    found = np.empty((dictionary.count, length), np.float32)
    for start, samples in dictionary.blocks():
        found[start : start + len(samples)] = columns(samples, dictionary.metric, np.float32)
    return found


def _first(signals: Floats, every: Singles, count: int, choice: Choice, context: Context) -> npt.NDArray[np.int64]:
    if choice == "random":
        return np.sort(context.rng.choice(len(every), count, replace=False))
    if choice == "farthest":
        return farthest(every, count, int(context.rng.integers(len(every))), context)
    taken = np.zeros(len(every), np.bool_)
    found = []
    for signal in seeds(signals, count, context).tolist():
        near: Any = np.abs(every @ signals[signal].astype(np.float32))
        near[taken] = -1
        found.append(int(near.argmax()))
        taken[found[-1]] = True
    # Where few patches describe all others any candidates will do for the rest.
    rest = np.flatnonzero(~taken)[: count - len(found)]
    return np.concatenate([np.array(found, np.int64), rest])
