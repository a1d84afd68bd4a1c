"""K-SVD: a dictionary that is learned from patches."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal, NamedTuple

import numpy as np

from nodegraph import Context, Forecast, Param, node
from nodegraph_sparse.dictionary import Dictionary, Patches, SampledDictionary, SparseCode
from nodegraph_sparse.dictionary_from_patches import dictionary_from_patches
from nodegraph_sparse.ksvd_atoms import combined, exact
from nodegraph_sparse.ksvd_sweep import Coding, State, better_atoms, learn
from nodegraph_sparse.ksvd_vectors import Layout, seeds, sparse_code, worst
from nodegraph_sparse.learning import Learning, learning
from nodegraph_sparse.pursuit_rules import Floats, Indices

Choice = Literal["residual", "random", "farthest"]
Update = Literal["exact", "approximate"]
Greedy = Literal["ols", "omp"]

ATOMS = Param("N.", ge=1)
SPARSITY = Param("s: the most atoms of a patch.", ge=1)
ITERATIONS = Param("Sweeps over all atoms; 0 only chooses and codes.", ge=0)
SELECTION = Param("How the pursuit chooses atoms: see sparse.omp.")
CODING = Param("Of patches: the best code known, or what the pursuit finds, as other terrain will be coded.")
TOLERANCE = Param("Ends after s iterations none of which lessens the error by more than this share.", ge=0, lt=1)


class Learned(NamedTuple):
    """The outputs.

    Attributes:
        dictionary: the atoms.
        code: of the patches by them; without patches if those lie on no grid.
        learning: the error of each iteration.
    """

    dictionary: Dictionary
    code: SparseCode
    learning: Learning


@node(version=1, title="K-SVD")
def ksvd(
    patches: Patches,
    initial: Dictionary | None = None,
    *,
    atoms: Annotated[int, ATOMS] = 128,
    sparsity: Annotated[int, SPARSITY] = 2,
    iterations: Annotated[int, ITERATIONS] = 20,
    choice: Annotated[Choice, Param("Which patches the atoms are at first, if none are linked.")] = "residual",
    update: Annotated[Update, Param("Of an atom: the singular vector, or one power step towards it.")] = "exact",
    selection: Annotated[Greedy, SELECTION] = "ols",
    coding: Annotated[Coding, CODING] = "best",
    tolerance: Annotated[float, TOLERANCE] = 0.0,
    name: Annotated[str, Param("Of the atoms, among the sources of a dictionary.", min_length=1)] = "learned",
    seed: Annotated[int, Param("Another one begins with other patches.", ge=0)] = 0,  # noqa: ARG001
    context: Context,
) -> Learned:
    """Learn the atoms that describe patches best as sums of s of them, and the sums (problem 1).

        min over d, x of  F = sum_i ||p_i - sum_j x_ij d_j||^2,  ||d_j|| = 1, at most s of x_i other than 0

    in the metric of the patches, by alternation.  An iteration betters the atoms one after another, each together with
    its coefficients, then codes all patches anew:

    - ``exact``: with E the rest of the patches that use the atom, without it, the new atom is the first right singular
      vector of E.
    - ``approximate``: E' x with the coefficients x so far, one power step: nearly as good, and quicker where patches
      are large.
    - Coding never makes a patch worse.  A pursuit is greedy and often does: each patch keeps the best of the code it
      had, its atoms with coefficients fitted anew, and the pursuit's; then one of its atoms, in turn, gives way to the
      best one beside the others.  So F never rises, and the ``code`` is better than what sparse.omp finds with the same
      dictionary: by half a decibel at s = 2 and 1.5 to 2 at s = 8.  With the coding ``pursuit`` codes are what the
      pursuit finds as long as F falls: the code is not as good, the dictionary is better for terrain to be coded later.
    - An atom that no patch uses is replaced by the worst-coded patch.

    Beyond the disc samples have no mass.  There an atom is the same sum of patches that it is inside.

    The first atoms are patches: drawn by ``residual`` (in proportion to the square of what those before leave of a
    patch, as k-means++ seeds), ``random``, or the ``farthest`` in shape; or those of `initial`, as many as there are.

    Args:
        patches: to learn from; of a grid, or of random places.
        initial: where to begin, of the same size and metric.
        atoms: N; `initial` has its own.
        sparsity: s.
        iterations: fewer are made where nothing changes any more.
        choice: ``residual``, ``random`` or ``farthest``.
        update: ``exact`` or ``approximate``.
        selection: ``ols`` or ``omp``.
        coding: ``best``, or ``pursuit`` for a dictionary that is to code other terrain.
        tolerance: 0 goes on as long as F falls.
        name: of the one source.
        seed: of the choice.
        context: the engine's.

    Returns:
        ``dictionary``, ``code`` and ``learning``.

    Raises:
        ValueError: there are less patches with relief than atoms, or `initial` does not match the patches.

    Complexity: O(n N (k + s^2) + n s k^2) an iteration, k samples of a disc; 24 bytes for each sample of a patch.

    Sources: Aharon, Elad, Bruckstein 2006, K-SVD, IEEE Transactions on Signal Processing 54(11),
    doi:10.1109/TSP.2006.881199; Rubinstein, Zibulevsky, Elad 2008, Efficient implementation of the K-SVD algorithm,
    Technion CS-2008-08 (the power step); Guérin et al. 2016, Sparse representation of terrains for procedural modeling,
    section 4.4, doi:10.1111/cgf.12821.
    """
    layout = Layout.of(patches.size, patches.metric)
    signals = layout.vectors(patches.samples)
    counted = layout.counted
    state = State.start(signals, counted, _first(patches, initial, layout, signals, atoms, choice, context), sparsity)

    def propose(_: int, error: Floats, amounts: Floats) -> Floats | None:
        return exact(error, counted) if update == "exact" else combined(error, amounts, counted)

    def replace(unused: Indices, residuals: Floats) -> Indices:
        which = worst(state, residuals, len(unused))
        unused = unused[: len(which)]
        state.atoms[unused] = _normed(signals[which], counted)
        return unused

    sweeps = learn(
        state, iterations, partial(better_atoms, propose), replace, selection=selection, coding=coding,
        tolerance=tolerance, context=context,
    )  # fmt: skip
    sources = np.zeros(len(state.atoms), np.int32)
    dictionary = SampledDictionary(patches.metric, sources, (name,), layout.samples(state.atoms))
    return Learned(dictionary, sparse_code(patches, state), learning(patches, len(sources), sparsity, sweeps))


@ksvd.forecast
def _forecast(patches: Forecast, initial: Forecast | None = None, *, atoms: int, **_: object) -> Forecast:  # noqa: ARG001
    return Forecast(4 * atoms * 256 + patches.bytes // 8, 6 * patches.bytes + (128 << 20), known=False)


def _first(
    patches: Patches,
    initial: Dictionary | None,
    layout: Layout,
    signals: Floats,
    atoms: int,
    choice: Choice,
    context: Context,
) -> Floats:
    if initial is not None:
        require_match(patches, initial, "initial dictionary")
        given = layout.vectors(initial.atoms(slice(0, initial.count)))
        if not (np.linalg.norm(given[:, : layout.counted], axis=1) > 0).all():
            raise ValueError("the initial dictionary has an atom without relief, which nothing can be coded by")
        return _normed(given, layout.counted)
    if choice != "residual":
        found = dictionary_from_patches(patches, choice=choice, atoms=atoms, context=context)
        return _normed(layout.vectors(found.samples), layout.counted)
    chosen = seeds(signals[:, : layout.counted], atoms, context)
    if len(chosen) < atoms:
        raise ValueError(
            f"{atoms} atoms cannot be learned from patches of which {len(chosen)} describe all others; "
            "dictionary_from_patches gives those without learning"
        )
    return _normed(signals[chosen], layout.counted)


def _normed(vectors: Floats, counted: int) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors[:, :counted], axis=1)[:, None])


def require_match(patches: Patches, dictionary: Dictionary, what: str) -> None:
    """Raise `ValueError` unless patches and atoms are of one size and metric."""
    if (dictionary.size, dictionary.metric) != (patches.size, patches.metric):
        raise ValueError(
            f"the {what} has {dictionary.metric} atoms of {dictionary.size} samples a side and the patches are "
            f"{patches.metric} ones of {patches.size}; make both alike"
        )
