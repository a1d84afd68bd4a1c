"""Dictionaries: normalised, as lazy as they claim, and high and low atoms that belong together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph_sparse.dictionary import Dictionary, Patches, SampledDictionary
from nodegraph_sparse.dictionary_from_patches import dictionary_from_patches, farthest
from nodegraph_sparse.exemplar import ExemplarDictionary, exemplar_dictionary
from nodegraph_sparse.merge_dictionaries import MergedDictionary, merge_dictionaries
from nodegraph_sparse.metric import columns, mass, means
from nodegraph_sparse.multiresolution import multiresolution_dictionary, reduced
from nodegraph_sparse.noise_dictionary import NoiseDictionary, dictionary_from_noise
from nodegraph_sparse.patches import patches
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.reproject import reproject
from nodegraph_terrain.sample_dem import sample_dem

KINDS = ("perlin", "ridged", "ridged_multifractal")


@pytest.fixture(scope="module")
def mountains():
    return reproject(sample_dem(), cell_size=90.0)


@pytest.fixture(scope="module")
def window(mountains):
    return mountains.window(slice(100, 180), slice(60, 150))


@pytest.fixture(scope="module")
def every_kind(window):
    """A dictionary of each kind, of 16 x 16 samples."""
    sampled = dictionary_from_patches(patches(window, radius=720.0))
    exemplar = exemplar_dictionary(window, radius=720.0, stride=3, symmetries=True)
    noise = dictionary_from_noise(atoms=40, size=16)
    merged = merge_dictionaries(sampled, noise, exemplar)
    return {"sampled": sampled, "exemplar": exemplar, "noise": noise, "merged": merged}


@pytest.mark.parametrize("kind", ["sampled", "exemplar", "noise", "merged"])
def test_atoms_are_normalised_and_the_same_however_they_are_asked_for(every_kind, kind):
    dictionary: Dictionary = every_kind[kind]
    atoms = dictionary.atoms(slice(None))
    assert atoms.shape == (dictionary.count, 16, 16)
    assert atoms.dtype == np.float32
    assert np.abs(means(atoms, "weighted")).max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(columns(atoms, "weighted"), axis=1), 1, atol=1e-6)
    which = np.random.default_rng(0).permutation(dictionary.count)[:57]
    np.testing.assert_array_equal(dictionary.atoms(which), atoms[which])
    np.testing.assert_array_equal(np.concatenate([some for _, some in dictionary.blocks()]), atoms)
    taken = dictionary.take(which)
    np.testing.assert_array_equal(taken.atoms(slice(None)), atoms[which])
    np.testing.assert_array_equal(taken.sources, dictionary.sources[which])
    again = taken.take(np.array([5, 1, 5]))
    np.testing.assert_array_equal(again.atoms(slice(None)), atoms[which[[5, 1, 5]]])


# Of patches.


def test_a_dictionary_of_all_patches_gives_the_terrain_back(window):
    found = patches(window, radius=450.0)
    dictionary = dictionary_from_patches(found, names=("Jacksboro",))
    vectors, atoms = columns(found.samples, "weighted"), columns(dictionary.samples, "weighted")
    coefficients = np.linalg.norm(vectors, axis=1)
    assert dictionary.count == len(vectors)
    np.testing.assert_allclose(atoms * coefficients[:, None], vectors, atol=1e-4)
    assert dictionary.names == ("Jacksboro",)


def test_flat_patches_are_left_out_and_sources_follow(window):
    level = window.data.copy()
    level[:, 40:] = 300
    half_flat = patches(window.like(level), radius=450.0)
    whole = patches(window, radius=450.0)
    dictionary = dictionary_from_patches(whole, half_flat, names=("rough",))
    assert dictionary.names == ("rough", "terrain 2")
    counts = np.bincount(dictionary.sources)
    assert counts[0] == len(whole.samples)
    relief = np.abs(half_flat.samples).max(axis=(1, 2)) > 1e-3
    assert 0.3 * len(whole.samples) < counts[1] == np.count_nonzero(relief) < 0.7 * len(whole.samples)


@settings(max_examples=25)
@given(st.integers(2, 25), st.integers(1, 25), st.integers(0, 1000))
def test_farthest_choice_equals_brute_force(count, chosen, seed):
    chosen = min(chosen, count)
    dice = np.random.default_rng(seed)
    vectors = dice.normal(size=(count, 5))
    vectors /= np.linalg.norm(vectors, axis=1)[:, None]
    order = farthest(vectors, chosen, int(dice.integers(count)), Context())
    assert len(set(order.tolist())) == chosen
    for step in range(1, chosen):
        rest = [number for number in range(count) if number not in order[:step]]
        apart = [min(min(np.linalg.norm(vectors[a] - sign * vectors[b]) for sign in (1, -1)) for b in order[:step])
                 for a in rest]  # fmt: skip
        best = rest[int(np.argmax(apart))]
        assert order[step] == best or np.isclose(apart[rest.index(order[step])], max(apart), atol=1e-7)


def test_choices(window):
    found = patches(window, radius=450.0)
    every = dictionary_from_patches(found).samples
    for choice in ("random", "farthest"):
        some = dictionary_from_patches(found, choice=choice, atoms=20, seed=1).samples
        assert all((every == atom).all(axis=(1, 2)).any() for atom in some)
        fewer = dictionary_from_patches(found, choice=choice, atoms=12, seed=1).samples
        if choice == "farthest":
            np.testing.assert_array_equal(fewer, some[:12])
        assert not np.array_equal(some, dictionary_from_patches(found, choice=choice, atoms=20, seed=2).samples)


def test_what_dictionaries_of_patches_refuse(window):
    found = patches(window, radius=450.0)
    with pytest.raises(ValueError, match="no patches"):
        dictionary_from_patches()
    with pytest.raises(ValueError, match=r"input 2 has plain patches of 10 samples"):
        dictionary_from_patches(found, patches(window, radius=450.0, metric="plain"))
    with pytest.raises(ValueError, match=r"input 2 has weighted patches of 8 samples"):
        dictionary_from_patches(found, patches(window, radius=360.0))
    with pytest.raises(ValueError, match=rf"from {len(found.samples)} patches"):
        dictionary_from_patches(found, choice="random", atoms=10_000)
    with pytest.raises(ValueError, match="'terrain 2' is there twice"):
        dictionary_from_patches(found, found, names=("terrain 2",))
    with pytest.raises(ValueError, match="2 names do not fit 1"):
        dictionary_from_patches(found, names=("a", "b"))
    flat = Patches(np.zeros((2, 4, 4), np.float32), np.zeros(2), np.zeros((2, 2)), 2.0)
    with pytest.raises(ValueError, match="all patches are flat"):
        dictionary_from_patches(flat)


# Exemplars.


@pytest.mark.parametrize("stride", [1, 4, 5])
def test_an_exemplar_holds_the_windows_of_its_map(window, stride):
    part = window.window(slice(0, 30), slice(0, 33))
    lazy = exemplar_dictionary(part, radius=540.0, stride=stride, name="map")
    rows, cols = (range(0, side - 11, stride) for side in part.shape)
    samples = np.array([part.data[r : r + 12, c : c + 12] for r in rows for c in cols], np.float64)
    samples -= means(samples, "weighted")[:, None, None]
    samples /= np.sqrt((mass(12, "weighted") * samples**2).sum(axis=(1, 2)))[:, None, None]
    np.testing.assert_allclose(lazy.atoms(slice(None)), samples, atol=1e-6)
    assert lazy.names == ("map",)


def test_symmetries_of_an_exemplar_are_those_of_the_square(window):
    plain = exemplar_dictionary(window, radius=540.0, stride=7).atoms(slice(None))
    every = exemplar_dictionary(window, radius=540.0, stride=7, symmetries=True).atoms(slice(None))
    assert len(every) == 8 * len(plain)
    np.testing.assert_array_equal(every[: len(plain)], plain)
    expected = [np.rot90(base, k, axes=(1, 2)) for base in (plain, plain[:, :, ::-1]) for k in range(4)]
    np.testing.assert_array_equal(every, np.concatenate(expected))


def test_an_exemplar_leaves_flat_windows_out_and_refuses_a_flat_map(window):
    level = window.data.copy()
    level[:, 30:] = 300
    found = exemplar_dictionary(window.like(level), radius=540.0)
    assert found.corners[:, 1].max() < 30
    with pytest.raises(ValueError, match="the terrain is flat"):
        exemplar_dictionary(window.like(np.full_like(level, 7)), radius=540.0)
    with pytest.raises(ValueError, match="whole number"):
        exemplar_dictionary(window, radius=500.0)


def test_a_radius_in_cells_fits_terrain_of_any_cell_size(window):
    stated = exemplar_dictionary(window, radius=720.0, stride=5)
    for cells, factor in ((8, 1), (2, 4)):
        same = exemplar_dictionary(window, cells=cells, factor=factor, stride=5)
        np.testing.assert_array_equal(same.atoms(slice(None)), stated.atoms(slice(None)))
    assert patches(window, cells=8).radius == patches(window, radius=720.0).radius == 720
    for ask in (exemplar_dictionary, patches):
        with pytest.raises(ValueError, match="state the radius"):
            ask(window)
        with pytest.raises(ValueError, match="state the radius"):
            ask(window, radius=720.0, cells=8)


def test_windows_of_little_relief_are_left_out(window):
    every = exemplar_dictionary(window, cells=6, stride=5)
    rough = 1 / every.scales / np.sqrt(mass(12, "weighted").sum())
    least = float(np.median(rough))
    some = exemplar_dictionary(window, cells=6, stride=5, relief=least)
    np.testing.assert_array_equal(some.corners, every.corners[rough >= least])
    assert 0 < some.count < every.count
    with pytest.raises(ValueError, match=f"the greatest is {rough.max():.4g} m"):
        exemplar_dictionary(window, cells=6, stride=5, relief=2 * float(rough.max()))


def test_some_atoms_of_an_exemplar_are_drawn_among_all(window):
    every = exemplar_dictionary(window, cells=6, stride=7, symmetries=True)
    some = exemplar_dictionary(window, cells=6, stride=7, symmetries=True, atoms=50)
    assert some.count == 50
    places = [
        {(*corner, turn) for corner, turn in zip(item.corners.tolist(), item.turns.tolist(), strict=True)}
        for item in (some, every)
    ]
    assert len(places[0]) == 50
    assert places[0] < places[1]
    assert exemplar_dictionary(window, cells=6, stride=7, symmetries=True, atoms=10**6).count == every.count


def test_few_atoms_of_an_exemplar_let_the_map_go(window):
    found = exemplar_dictionary(window, radius=540.0, stride=1)
    assert isinstance(found.take(np.arange(5)), SampledDictionary)
    assert isinstance(found.take(np.arange(4000)), ExemplarDictionary)


# Noise.


@pytest.mark.parametrize("kind", KINDS)
def test_noise_at_another_resolution_is_the_same_function(kind):
    found = dictionary_from_noise(kind=kind, atoms=60, size=32, octaves=3, gain=0.4, variety=0.5)
    fine = found.resampled(128).atoms(slice(None))
    small = reduced(fine, 4)
    difference = small - means(small, "weighted")[:, None, None] - found.atoms(slice(None))
    # Three octaves do not reach the resolution, so that only where creases fall between samples is there a difference.
    assert np.linalg.norm(columns(difference, "weighted"), axis=1).max() < 0.03
    np.testing.assert_allclose(np.linalg.norm(columns(fine, "weighted"), axis=1), 4, rtol=0.03)


@pytest.mark.parametrize("kind", KINDS)
def test_finer_noises_show_where_there_are_samples_for_them(kind):
    found = dictionary_from_noise(kind=kind, atoms=8, size=16)
    detail = []
    for size in (16, 32, 128):
        atoms = found.resampled(size).atoms(slice(None))
        coarse = np.kron(reduced(atoms, size // 8), np.ones((size // 8, size // 8)))
        detail.append(np.sqrt(np.mean((atoms - coarse) ** 2)))
    assert detail[0] < detail[1] < detail[2]


def test_ridged_noise_is_minus_the_sum_of_folds():
    """Against a direct evaluation, one atom and octave at a time."""
    from nodegraph_terrain.gradient_noise import gradient_noise, scrambled

    found = dictionary_from_noise(kind="ridged", atoms=3, octaves=3, size=16, variety=0.5)
    x = (2 * np.arange(16) - 15) / 16
    east, north = np.meshgrid(x, -x)
    for number, atom in enumerate(found.atoms(slice(None))):
        total = np.zeros((16, 16))
        for octave in range(3):
            seed = scrambled(int(found.seeds[number]), octave)
            u0, v0, turn = (scrambled(seed, word) / 2**32 for word in (1, 2, 3))
            f, angle = found.frequencies[number, octave], 2 * np.pi * turn
            assert f < 4  # not faded at all
            u = f * (np.cos(angle) * east - np.sin(angle) * north) + u0
            v = f * (np.sin(angle) * east + np.cos(angle) * north) + v0
            fade = np.clip(f / 2 - 1, 0, 1)
            total -= (
                (1 - fade**2 * (3 - 2 * fade))
                * found.amplitudes[number, octave]
                * np.abs(gradient_noise(u, v, seed)[0])
            )
        total -= means(total[None], "weighted")
        np.testing.assert_allclose(atom, total / np.linalg.norm(columns(total[None], "weighted")), atol=1e-6)


def test_noise_atoms_follow_from_seed_and_number():
    few, many = dictionary_from_noise(atoms=5, seed=3), dictionary_from_noise(atoms=9, seed=3)
    np.testing.assert_array_equal(few.atoms(slice(None)), many.atoms(slice(0, 5)))
    other = dictionary_from_noise(atoms=5, seed=4)
    assert np.abs(few.atoms(slice(None)) - other.atoms(slice(None))).max() > 0.01
    shapes = columns(dictionary_from_noise(atoms=50).atoms(slice(None)), "weighted")
    assert np.abs(shapes @ shapes.T - np.eye(50)).max() < 0.999
    with pytest.raises(ValueError, match="greater wavelength"):
        dictionary_from_noise(size=4, wavelength=0.2)


# Merged.


def test_merging_renumbers_sources_and_keeps_atoms(every_kind):
    merged = merge_dictionaries(every_kind["sampled"], every_kind["noise"], every_kind["merged"])
    assert merged.names == (
        "terrain 1", "noise", "terrain 1 (2)", "noise (2)", "exemplar",
    )  # fmt: skip
    parts = [every_kind[kind] for kind in ("sampled", "noise", "merged")]
    np.testing.assert_array_equal(
        merged.atoms(slice(None)), np.concatenate([part.atoms(slice(None)) for part in parts])
    )
    counts = np.bincount(merged.sources)
    assert counts.tolist() == [
        parts[0].count, 40, parts[0].count, 40, every_kind["exemplar"].count,
    ]  # fmt: skip
    few = merged.take(np.arange(3))
    assert isinstance(few, MergedDictionary)
    assert len(few.parts) == 1


def test_merged_noise_is_sampled_to_fit(window):
    noise = dictionary_from_noise(atoms=6, size=32)
    terrain = dictionary_from_patches(patches(window, radius=720.0, metric="plain"))
    merged = merge_dictionaries(noise, terrain)
    assert merged.size == 16
    assert merged.metric == "plain"
    atoms = merged.atoms(slice(0, 6))
    np.testing.assert_allclose(np.linalg.norm(columns(atoms, "plain"), axis=1), 1, atol=1e-6)
    assert np.abs(means(atoms, "plain")).max() < 1e-6
    with pytest.raises(ValueError, match=r"dictionary 2 has weighted atoms of 10 samples"):
        merge_dictionaries(terrain, dictionary_from_patches(patches(window, radius=450.0)))
    with pytest.raises(ValueError, match="no dictionaries"):
        merge_dictionaries()


# High and low.


@pytest.mark.parametrize("kind", ["sampled", "exemplar", "noise", "merged"])
@pytest.mark.parametrize("factor", [2, 4])
def test_reducing_high_atoms_gives_the_low_ones(every_kind, kind, factor):
    dictionary = every_kind[kind]
    high, low = multiresolution_dictionary(dictionary, factor=factor)
    assert high.count == low.count <= dictionary.count
    assert (high.size, low.size) == (16, 16 // factor)
    np.testing.assert_array_equal(high.sources, low.sources)
    atoms, small = high.atoms(slice(None)), low.atoms(slice(None))
    np.testing.assert_allclose(reduced(atoms, factor), small, atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(columns(small, "weighted"), axis=1), 1, atol=1e-5)
    assert np.abs(means(small, "weighted")).max() < 1e-5
    # The high ones are the atoms of the dictionary, scaled and shifted.
    flat = atoms - means(atoms, "weighted")[:, None, None]
    flat /= np.linalg.norm(columns(flat, "weighted"), axis=1)[:, None, None]
    original = dictionary.atoms(slice(None))
    if high.count == dictionary.count:
        np.testing.assert_allclose(flat, original, atol=2e-5)
    assert type(high) is type(dictionary)


@pytest.mark.parametrize(("stride", "step"), [(4, 1), (8, 1), (3, 4), (6, 4)])
@pytest.mark.parametrize("smoothing", [0.0, 0.7])
def test_cutting_and_reducing_commute(window, stride, step, smoothing):
    """An exemplar's low atoms are windows of a reduced map, whatever the stride."""
    found = exemplar_dictionary(window, radius=720.0, stride=stride, symmetries=True)
    high, low = multiresolution_dictionary(found, smoothing=smoothing)
    assert isinstance(low, ExemplarDictionary)
    assert low.step == step
    assert low.heights.size <= window.data.size / (16 if step == 1 else 1)
    if smoothing == 0:
        np.testing.assert_allclose(reduced(high.atoms(slice(None)), 4), low.atoms(slice(None)), atol=1e-5)
        return
    from scipy.ndimage import gaussian_filter

    smoothed = ExemplarDictionary(
        "weighted", high.sources, high.names, gaussian_filter(window.data.astype(np.float64), 4 * smoothing),
        high.corners, high.turns, high.means, high.scales, 16,
    )  # fmt: skip
    np.testing.assert_allclose(reduced(smoothed.atoms(slice(None)), 4), low.atoms(slice(None)), atol=1e-5)


def test_reducing_twice_is_reducing_once(window):
    found = exemplar_dictionary(window, radius=720.0, stride=3)
    once, half = multiresolution_dictionary(found, factor=4).low, multiresolution_dictionary(found, factor=2).low
    twice = multiresolution_dictionary(half, factor=2).low
    np.testing.assert_allclose(twice.atoms(slice(None)), once.atoms(slice(None)), atol=1e-5)


def test_high_noise_stays_functions(every_kind):
    high, _ = multiresolution_dictionary(every_kind["noise"], factor=2)
    assert isinstance(high, NoiseDictionary)
    fine = high.resampled(32).atoms(slice(None))
    back = reduced(fine, 2) - high.atoms(slice(None))
    assert np.sqrt(np.mean(back**2)) < 0.5 * np.sqrt(np.mean(fine**2))


def test_atoms_without_relief_at_the_low_resolution_are_left_out(every_kind):
    checks = np.kron(np.ones((8, 8)), [[1, -1], [-1, 1]])
    slope = np.add.outer(np.zeros(16), np.arange(16) - 7.5)
    samples = np.stack([slope, checks, slope + 40 * checks, checks + 1e-3 * slope]).astype(np.float32)
    samples -= means(samples, "weighted")[:, None, None]
    samples /= np.linalg.norm(columns(samples, "weighted"), axis=1)[:, None, None]
    dictionary = SampledDictionary("weighted", np.arange(4, dtype=np.int32), ("a", "b", "c", "d"), samples)
    high, low = multiresolution_dictionary(dictionary, factor=2)
    assert high.sources.tolist() == low.sources.tolist() == [0, 2]
    merged = merge_dictionaries(dictionary, every_kind["sampled"]).take(np.array([9, 1, 2, 8, 3, 0]))
    high, low = multiresolution_dictionary(merged, factor=2)
    np.testing.assert_array_equal(high.sources, merged.sources[[0, 2, 3, 5]])
    np.testing.assert_allclose(reduced(high.atoms(slice(None)), 2), low.atoms(slice(None)), atol=2e-5)
    with pytest.raises(ValueError, match="no atom keeps"):
        multiresolution_dictionary(dictionary.take(np.array([1])), factor=2)
    with pytest.raises(ValueError, match=r"multiple of 3 cells, such as 9 instead of 8"):
        multiresolution_dictionary(dictionary, factor=3)


def test_a_complete_dictionary_of_thousands_stays_a_map(mountains):
    """120,000 atoms of 32 x 32 would be 492 MB of samples."""
    found = exemplar_dictionary(mountains, radius=1440.0, stride=2)
    held = sum(array.nbytes for array in vars(found).values() if isinstance(array, np.ndarray))
    assert found.count > 20_000
    assert held < 0.02 * found.count * 32**2 * 4
    assert all(len(some) * 32**2 <= 1 << 22 for _, some in found.blocks())


def test_an_exemplar_on_extremes():
    """A single window, and heights far above their relief."""
    heights = 8000 + 0.01 * np.random.default_rng(0).random((8, 8))
    one = exemplar_dictionary(Elevation(heights.astype(np.float32), Extent(0.0, 0.0, 8.0, 8.0)), radius=4.0)
    atoms = one.atoms(slice(None))
    assert one.count == 1
    np.testing.assert_allclose(np.linalg.norm(columns(atoms, "weighted")), 1, atol=1e-6)
    assert np.abs(means(atoms, "weighted")).max() < 1e-6
