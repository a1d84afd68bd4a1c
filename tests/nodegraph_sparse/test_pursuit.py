"""Pursuits against direct evaluation of their definitions, scikit-learn and SciPy; and each way against the others."""

from __future__ import annotations

import tracemalloc
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph.opencl import choose
from nodegraph_sparse import pursuit
from nodegraph_sparse.atoms import ArrayAtoms
from nodegraph_sparse.dictionary import Dictionary, SampledDictionary
from nodegraph_sparse.metric import columns
from nodegraph_sparse.pursuit import Pursuit, pursue, pursue_samples

SELECTIONS = ["ols", "omp", "mp"]
WAYS = ["numpy", "blocks", "opencl", "opencl groups"]


@pytest.fixture(params=WAYS)
def code(request, monkeypatch):
    """A pursuit on NumPy by Gram products, by blocks of a few atoms, or on OpenCL: as on a CPU, and as on a GPU."""
    if "opencl" in request.param:
        device = choose("auto")
        if device is None:
            pytest.skip("no OpenCL device")
        if "groups" in request.param:
            monkeypatch.setattr("nodegraph_sparse.pursuit_opencl.work_group", lambda _: (1, 8))
        return lambda *args, **options: pursue(*args, device=device, **options)
    if request.param == "blocks":
        monkeypatch.setattr(pursuit, "GRAM", 0)
        monkeypatch.setattr("nodegraph_sparse.atoms.BLOCK", 100)
        monkeypatch.setattr("nodegraph_sparse.pursuit_blocks.TILE", (7, 3))
    return pursue


def problem(count=20, atoms=30, length=12, seed=0, unit=False):
    dice = np.random.default_rng(seed)
    signals, dictionary = dice.normal(size=(count, length)), dice.normal(size=(atoms, length))
    if unit:
        dictionary /= np.linalg.norm(dictionary, axis=1)[:, None]
    return signals, dictionary


def dense(found: Pursuit, atoms: int) -> np.ndarray:
    """Return the coefficients of all atoms, (n, N)."""
    made = np.zeros((len(found.indices), atoms + 1))
    for slot in range(found.indices.shape[1]):
        np.add.at(made, (np.arange(len(made)), found.indices[:, slot]), found.coefficients[:, slot])
    return made[:, :-1]


def check(found: Pursuit, signals, atoms) -> None:
    """Hold what every pursuit promises."""
    used = found.indices >= 0
    assert (np.diff(used.astype(int), axis=1) <= 0).all(), "empty slots are last"
    assert (found.coefficients[~used] == 0).all()
    rest = signals - dense(found, len(atoms)) @ atoms
    np.testing.assert_allclose(
        found.residuals, (rest**2).sum(axis=1), rtol=1e-9, atol=1e-20 + 1e-13 * np.max(signals**2, initial=0)
    )
    for row in found.indices:
        kept = row[row >= 0]
        assert len(set(kept)) == len(kept)


def best_subset_step(signal, atoms, chosen):
    """Evaluate the paper's argmin: the least residual over all atoms and all coefficients."""
    left = np.full(len(atoms), np.inf)
    for k in range(len(atoms)):
        if k not in chosen:
            subset = atoms[[*chosen, k]].T
            left[k] = ((signal - subset @ np.linalg.lstsq(subset, signal, rcond=None)[0]) ** 2).sum()
    return int(left.argmin())


@pytest.mark.parametrize("seed", range(3))
def test_ols_is_the_argmin_over_atoms_and_coefficients(code, seed):
    signals, atoms = problem(seed=seed)
    found = code(signals, atoms, 5)
    for signal, indices, coefficients in zip(signals, found.indices, found.coefficients, strict=True):
        chosen = []
        for _ in range(5):
            chosen.append(best_subset_step(signal, atoms, chosen))
        assert indices.tolist() == chosen
        expected = np.linalg.lstsq(atoms[chosen].T, signal, rcond=None)[0]
        np.testing.assert_allclose(coefficients, expected, rtol=1e-9, atol=1e-11)
    check(found, signals, atoms)


@pytest.mark.parametrize("sparsity", [1, 4, 12])
def test_omp_equals_scikit_learn(code, sparsity):
    from sklearn.linear_model import orthogonal_mp

    signals, atoms = problem(40, 50, 12, seed=4, unit=True)
    found = code(signals, atoms, sparsity, selection="omp")
    expected = orthogonal_mp(atoms.T, signals.T, n_nonzero_coefs=sparsity).T
    np.testing.assert_allclose(dense(found, 50), expected, atol=1e-8)
    assert ((dense(found, 50) != 0) == (expected != 0)).all()
    check(found, signals, atoms)


def test_omp_with_an_error_target_equals_scikit_learn(code):
    from sklearn.linear_model import orthogonal_mp

    signals, atoms = problem(40, 50, 12, seed=5, unit=True)
    found = code(signals, atoms, 12, selection="omp", tolerance=1.5)
    np.testing.assert_allclose(dense(found, 50), orthogonal_mp(atoms.T, signals.T, tol=1.5).T, atol=1e-8)
    assert (found.residuals <= 1.5).all()
    assert len(set((found.indices >= 0).sum(axis=1))) > 1


def test_matching_pursuit_takes_one_projection_at_a_time(code):
    signals, atoms = problem(seed=6, unit=True)
    found = code(signals, atoms, 25, selection="mp")
    rest, expected = signals.copy(), np.zeros((len(signals), len(atoms)))
    for _ in range(25):
        products = rest @ atoms.T
        k = np.abs(products).argmax(axis=1)
        step = products[np.arange(len(k)), k]
        expected[np.arange(len(k)), k] += step
        rest -= step[:, None] * atoms[k]
    np.testing.assert_allclose(dense(found, len(atoms)), expected, atol=1e-12)
    assert ((found.indices >= 0).sum(axis=1) < 25).any(), "atoms repeat"
    check(found, signals, atoms)


@pytest.mark.parametrize("selection", ["ols", "omp"])
def test_nonnegative_coefficients_meet_the_conditions_of_karush_kuhn_and_tucker(code, selection):
    signals, atoms = problem(60, 15, 12, seed=7)
    found = code(signals, atoms, 6, selection=selection, nonnegative=True)
    check(found, signals, atoms)
    used = found.indices >= 0
    assert (found.coefficients[used] > 0).all()
    slope = (signals - dense(found, 15) @ atoms) @ atoms.T
    assert np.abs(slope[np.nonzero(used)[0], found.indices[used]]).max() < 1e-10, "flat where positive"
    # Who stopped before s atoms has none left that would lessen the residual.
    early = ~used.all(axis=1)
    assert 0 < early.sum() < 60
    assert slope[early].max() < 1e-9


def test_a_nonnegative_pursuit_with_room_ends_at_the_nonnegative_least_squares(code):
    from scipy.optimize import nnls

    signals, atoms = problem(30, 9, 12, seed=8)
    found = code(signals, atoms, 9, nonnegative=True)
    expected = np.array([nnls(atoms.T, signal)[0] for signal in signals])
    np.testing.assert_allclose(dense(found, 9), expected, atol=1e-10)


def test_nonnegative_pursuits_give_atoms_up(code):
    # Towards (1, 1) the atom between the axes comes first, and is not wanted once the axes are there.
    atoms = np.array([[1.0, 1.0, 0.9], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    signal = np.array([[1.0, 1.0, -0.2]])
    assert code(signal, atoms, 1, nonnegative=True).indices[0].tolist() == [0]
    found = code(signal, atoms, 3, nonnegative=True)
    assert sorted(found.indices[0].tolist()) == [-1, 1, 2]
    np.testing.assert_allclose(found.residuals, 0.04, rtol=1e-12)


def test_nonnegative_matching_pursuit_only_adds(code):
    signals, atoms = problem(seed=9)
    found = code(signals, atoms, 10, selection="mp", nonnegative=True)
    check(found, signals, atoms)
    assert found.coefficients.min() >= 0


@pytest.mark.parametrize("nonnegative", [False, True])
@pytest.mark.parametrize("selection", SELECTIONS)
def test_every_way_gives_the_same(code, selection, nonnegative):
    signals, atoms = problem(90, 45, 16, seed=10)
    dice = np.random.default_rng(11)
    options = {
        "selection": selection,
        "nonnegative": nonnegative,
        "tolerance": dice.uniform(0, 4, 90),
        "weights": np.where(dice.random((90, 3)) < 0.2, 0, dice.random((90, 3))),
        "sources": dice.integers(0, 3, 45),
    }
    expected, found = pursue(signals, atoms, 6, **options), code(signals, atoms, 6, **options)
    assert (found.indices == expected.indices).all()
    np.testing.assert_allclose(found.coefficients, expected.coefficients, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found.residuals, expected.residuals, rtol=1e-9)
    check(found, signals, atoms)


def test_float32_inputs_are_coded_in_float64(code):
    signals, atoms = (item.astype(np.float32) for item in problem(seed=12))
    found, expected = code(signals, atoms, 4), pursue(signals.astype(float), atoms.astype(float), 4)
    assert (found.indices == expected.indices).all()
    np.testing.assert_allclose(found.coefficients, expected.coefficients, rtol=1e-10)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 9), st.integers(1, 6), st.sampled_from(SELECTIONS), st.booleans())
def test_the_residual_never_grows_with_the_sparsity(seed, atoms, length, selection, nonnegative):
    dice = np.random.default_rng(seed)
    # Small whole numbers make ties, zeros, duplicates and dependent atoms common.
    signals = dice.integers(-2, 3, (6, length)).astype(float)
    dictionary = dice.integers(-1, 2, (atoms, length)).astype(float)
    squares = (signals**2).sum(axis=1)
    before = squares
    for sparsity in range(1, 10):
        found = pursue(signals, dictionary, sparsity, selection=selection, nonnegative=nonnegative)
        check(found, signals, dictionary)
        assert (found.residuals <= before + 1e-13 * squares).all()
        before = found.residuals
    if selection != "mp" and not nonnegative:
        rank = np.linalg.matrix_rank(dictionary)
        assert ((found.indices >= 0).sum(axis=1) <= rank).all()
        best = signals - (np.linalg.pinv(dictionary.T) @ signals.T).T @ dictionary
        np.testing.assert_allclose(found.residuals, (best**2).sum(axis=1), atol=1e-12)


@pytest.mark.parametrize("selection", SELECTIONS)
def test_zero_signals_zero_atoms_and_none(code, selection):
    signals, atoms = problem(4, 6, 5)
    signals[1] = 0
    atoms[[0, 3]] = 0
    found = code(signals, atoms, 8, selection=selection)
    assert (found.indices[1] == -1).all()
    assert found.residuals[1] == 0
    assert not np.isin(found.indices, [0, 3]).any()
    check(found, signals, atoms)
    nothing = code(signals, np.zeros((3, 5)), 2, selection=selection)
    assert (nothing.indices == -1).all()
    np.testing.assert_allclose(nothing.residuals, (signals**2).sum(axis=1))
    assert code(signals[:0], atoms, 2, selection=selection).indices.shape == (0, 2)
    assert (code(signals, atoms[:0], 2, selection=selection).indices == -1).all()
    single = code(signals, atoms[1:2], 3, selection=selection)
    np.testing.assert_allclose(single.coefficients[:, 0], signals @ atoms[1] / (atoms[1] @ atoms[1]), rtol=1e-12)


@pytest.mark.parametrize("selection", SELECTIONS)
def test_of_equal_atoms_the_first_is_chosen(code, selection):
    signals, atoms = problem(30, 12, 7, seed=13)
    doubled = np.concatenate([atoms, atoms])[np.random.default_rng(14).permutation(24)]
    found = code(signals, doubled, 7, selection=selection)
    first = [int(np.flatnonzero((doubled == atom).all(axis=1))[0]) for atom in doubled]
    used = found.indices[found.indices >= 0]
    assert (np.array(first)[used] == used).all()
    check(found, signals, doubled)


def test_signals_that_are_atoms_are_found_exactly(code):
    _, atoms = problem(1, 40, 12, seed=15)
    found = code(-3 * atoms, atoms, 4)
    assert found.indices[:, 0].tolist() == list(range(40))
    assert (found.indices[:, 1:] == -1).all()
    np.testing.assert_allclose(found.coefficients[:, 0], -3, rtol=1e-14)
    assert found.residuals.max() < 1e-25


def test_the_norm_of_atoms_only_scales_coefficients(code):
    signals, atoms = problem(seed=16)
    scale = np.random.default_rng(17).uniform(0.01, 100, len(atoms))
    for selection in SELECTIONS:
        plain, scaled = (code(signals, item, 4, selection=selection) for item in (atoms, atoms * scale[:, None]))
        assert (plain.indices == scaled.indices).all()
        np.testing.assert_allclose(scaled.coefficients * scale[plain.indices], plain.coefficients, rtol=1e-9)


def test_weights_forbid_and_prefer_sources(code):
    signals, atoms = problem(60, 40, 12, seed=18)
    sources = np.arange(40) % 2
    weights = np.ones((60, 2))
    weights[:20, 0] = weights[20:40, 1] = 0
    weights[40:50] = 0
    weights[50:, 0] = 0.2
    found = code(signals, atoms, 3, weights=weights, sources=sources)
    assert (sources[found.indices[:20]] == 1).all()
    assert (sources[found.indices[20:40]] == 0).all()
    assert (found.indices[40:50] == -1).all()
    usual = code(signals[50:], atoms, 3)
    assert (sources[found.indices[50:]] == 0).mean() < (sources[usual.indices] == 0).mean()
    even = code(signals, atoms, 3, weights=np.full((60, 2), 0.5), sources=sources)
    assert (even.indices == code(signals, atoms, 3).indices).all()


def test_batches_do_not_show(monkeypatch):
    signals, atoms = problem(50, 20, 9, seed=19)
    expected = [pursue(signals, atoms, 4, nonnegative=flag) for flag in (False, True)]
    monkeypatch.setattr(pursuit, "CORRELATIONS", 150)
    monkeypatch.setattr(pursuit, "IN_STEP", 300)
    monkeypatch.setattr(pursuit, "STATE", 200)
    for gram in (20, 0):
        monkeypatch.setattr(pursuit, "GRAM", gram)
        for flag in (False, True):
            found = pursue(signals, atoms, 4, nonnegative=flag)
            assert (found.indices == expected[flag].indices).all()
            np.testing.assert_allclose(found.coefficients, expected[flag].coefficients, rtol=1e-9)


@dataclass(frozen=True)
class Functions(Dictionary):
    """Atoms that are made when they are asked for: nobody could hold them all."""

    def atoms(self, which):
        numbers = np.arange(self.count)[which]
        y, x = np.mgrid[-1:1:12j, -1:1:12j]
        phase = numbers[:, None, None] * 0.618
        return np.sin((3 + numbers[:, None, None] % 7) * (x * np.cos(phase) + y * np.sin(phase)) + phase).astype(
            np.float32
        )

    @property
    def size(self):
        return 12


def test_dictionaries_are_searched_without_being_held():
    functions = Functions("weighted", np.zeros(60_000, np.int32), ("waves",))
    chosen = np.array([5, 59_999, 31_234])
    patches = 4 * functions.atoms(chosen)
    tracemalloc.start()
    found = pursue_samples(patches, functions, 1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (found.residuals <= 1e-12 * (columns(patches, "weighted") ** 2).sum(axis=1)).all()
    assert peak < 250e6 < 60_000 * 144 * 8 * 4, "all atoms in float64, and their products with blocks, are more"


def test_a_dictionary_is_coded_as_its_vectors(monkeypatch):
    dice = np.random.default_rng(20)
    samples, atoms = dice.normal(size=(25, 8, 8)).astype(np.float32), dice.normal(size=(33, 8, 8)).astype(np.float32)
    dictionary = SampledDictionary("weighted", np.arange(33) % 2, ("a", "b"), atoms)
    weights = dice.random((25, 2))
    expected = pursue(
        columns(samples, "weighted"), columns(atoms, "weighted"), 4, weights=weights, sources=np.arange(33) % 2
    )
    for gram in (8192, 0):
        monkeypatch.setattr(pursuit, "GRAM", gram)
        found = pursue_samples(samples, dictionary, 4, weights=weights)
        assert (found.indices == expected.indices).all()
        np.testing.assert_allclose(found.coefficients, expected.coefficients, rtol=1e-9)


def test_array_atoms_come_in_blocks(monkeypatch):
    monkeypatch.setattr("nodegraph_sparse.atoms.BLOCK", 30)
    rows = np.random.default_rng(21).normal(size=(17, 5))
    blocks = list(ArrayAtoms(rows).blocks())
    assert [start for start, _ in blocks] == [0, 6, 12]
    np.testing.assert_array_equal(np.concatenate([block for _, block in blocks]), rows)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sparsity": 0}, "sparsity is 0 and must be 1 or more"),
        ({"selection": "best"}, "selection is 'best' and must be"),
        ({"tolerance": -1.0}, "tolerance must be a number of 0 or more"),
        ({"tolerance": np.zeros(3)}, "one for each of 20 signals"),
        ({"weights": np.ones((20, 2))}, "need the source of each of 30 atoms"),
        ({"weights": np.ones((4, 2)), "sources": np.zeros(30, int)}, "do not fit 20 signals"),
        ({"weights": np.ones((20, 1)), "sources": np.ones(30, int)}, "and the sources of the atoms"),
        ({"weights": np.full((20, 1), 1.5), "sources": np.zeros(30, int)}, "between 0 and 1"),
    ],
)
def test_wrong_options_are_refused(change, message):
    signals, atoms = problem()
    with pytest.raises(ValueError, match=message):
        pursue(signals, atoms, **{"sparsity": 2, **change})


def test_numbers_that_are_none_are_refused(code):
    signals, atoms = problem()
    with pytest.raises(ValueError, match="rows of equal length"):
        code(signals, atoms[:, :5], 2)
    spoiled = signals.copy()
    spoiled[7, 3] = np.nan
    with pytest.raises(ValueError, match="signal 7 is not finite"):
        code(spoiled, atoms, 2)
    spoiled = atoms.copy()
    spoiled[4, 0] = np.inf
    with pytest.raises(ValueError, match="atom 4 is not finite"):
        code(signals, spoiled, 2)
