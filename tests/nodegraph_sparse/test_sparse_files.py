"""Sparse terrains in files, and their statistics: exact, compact, and refused in one sentence where damaged."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph.codec import seal
from nodegraph_sparse.container import Precision, packed, unpacked
from nodegraph_sparse.dictionary import SampledDictionary, SparseCode
from nodegraph_sparse.dictionary_from_patches import dictionary_from_patches
from nodegraph_sparse.exemplar import exemplar_dictionary
from nodegraph_sparse.ksvd import ksvd
from nodegraph_sparse.load_sparse import load_sparse
from nodegraph_sparse.merge_dictionaries import merge_dictionaries
from nodegraph_sparse.metric import columns
from nodegraph_sparse.multiresolution import multiresolution_dictionary
from nodegraph_sparse.noise_dictionary import dictionary_from_noise
from nodegraph_sparse.omp import omp
from nodegraph_sparse.patch_grid import patch_grid
from nodegraph_sparse.patches import patches
from nodegraph_sparse.rate_distortion import rate_distortion
from nodegraph_sparse.rivals import fewer_cells, jpeg2000
from nodegraph_sparse.save_sparse import save_sparse
from nodegraph_sparse.save_statistics import save_statistics
from nodegraph_sparse.sparse_raster import blended, reliefs
from nodegraph_sparse.sparse_statistics import compared, sparse_statistics
from nodegraph_sparse.sparse_statistics_plot import preview_rate_distortion, preview_sparse_statistics
from nodegraph_sparse.sparse_terrain import sparse_terrain
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.sample_dem import sample_dem
from nodegraph_tree.function import Points


@pytest.fixture(scope="module")
def window():
    heights = sample_dem().data[100:164, 60:140]
    return Elevation(heights, Extent(500.0, 0.0, 500 + 80 * 90.0, 64 * 90.0, "EPSG:32616"))


@pytest.fixture(scope="module")
def found(window):
    return patches(window, radius=720.0)


@pytest.fixture(scope="module")
def learned(found):
    return ksvd(found, atoms=24, sparsity=4, iterations=3)


@pytest.fixture(scope="module")
def dictionaries(window, found, learned):
    exemplar = exemplar_dictionary(window, radius=720.0, stride=3, symmetries=True)
    noise = dictionary_from_noise(atoms=40, size=16)
    merged = merge_dictionaries(dictionary_from_patches(found), noise, exemplar)
    high, _ = multiresolution_dictionary(merged, factor=2)
    return {"sampled": learned.dictionary, "exemplar": exemplar, "noise": noise, "merged": merged, "high": high}


@pytest.mark.parametrize("kind", ["sampled", "exemplar", "noise", "merged", "high"])
def test_round_trips_are_exact(tmp_path, found, dictionaries, kind):
    dictionary = dictionaries[kind]
    code = SparseCode(
        found.grid, np.tile(np.array([[3, -1]], np.int32), (found.grid.count, 1)),
        np.tile([[2.5, 0.0]], (found.grid.count, 1)), found.means, np.ones(found.grid.count), dictionary.count,
    )  # fmt: skip
    if kind != "high":
        code = omp(found, dictionary, sparsity=3)
    saved = save_sparse(dictionary, code, name="folder/terrain.h5")
    assert saved.bytes == len(saved.file.content)
    assert saved.psnr == np.inf
    path = tmp_path / "terrain.h5"
    path.write_bytes(saved.file.content.tobytes())
    again = load_sparse(path=path)
    assert type(again.dictionary) is type(dictionary)
    assert seal(again.dictionary) == seal(dictionary)
    assert seal(again.code) == seal(code)
    assert (
        save_sparse(again.dictionary, again.code, name="folder/terrain.h5").file.content.tobytes() == path.read_bytes()
    )


@settings(max_examples=30, deadline=None)
@given(
    rows=st.integers(4, 20), cols=st.integers(4, 20), atoms=st.integers(1, 70_000), sparsity=st.integers(1, 5),
    seed=st.integers(0, 999),
)  # fmt: skip
def test_codes_of_any_kind_come_back(rows, cols, atoms, sparsity, seed):
    dice = np.random.default_rng(seed)
    grid = patch_grid(Extent(0.0, 0.0, 3.0 * cols, 3.0 * rows), (rows, cols), 2)
    used = np.sort(dice.random((grid.count, sparsity)) < 0.4, axis=1)
    indices = np.where(used, -1, dice.integers(0, atoms, used.shape)).astype(np.int32)
    coefficients = np.where(used, 0.0, dice.normal(size=used.shape))
    code = SparseCode(
        grid, indices, coefficients, dice.normal(size=grid.count), dice.random(grid.count), atoms, "plain"
    )
    dictionary = SampledDictionary("plain", np.zeros(atoms, np.int32), ("a", "b"), np.zeros((atoms, 2, 2), np.float32))
    again = unpacked(packed(dictionary, code), "file")
    assert seal(again[0]) == seal(dictionary)
    assert seal(again[1]) == seal(code)


def test_quantised_numbers_are_near_and_small(window, learned):
    exact = save_sparse(learned.dictionary, learned.code, window, name="a.h5")
    sizes, errors = [], []
    for bits in (12, 9, 6):
        saved = save_sparse(
            learned.dictionary, learned.code, window, name="a.h5", coefficient_bits=bits, mean_bits=bits, atom_bits=bits
        )
        dictionary, code = unpacked(saved.file.content.tobytes(), "a.h5")
        for name, before, after in (
            ("coefficients", learned.code.coefficients, code.coefficients),
            ("means", learned.code.means, code.means),
            ("samples", learned.dictionary.samples, dictionary.samples),
        ):
            step = np.ptp(before) / (2**bits - 1)
            assert np.abs(before - after).max() <= 0.5 * step * (1 + 1e-4), name
        np.testing.assert_array_equal(code.indices, learned.code.indices)
        sizes.append(saved.bytes)
        errors.append(saved.psnr)
        assert saved.psnr == pytest.approx(compared(blended(dictionary, code, Context()), window.data).psnr, rel=1e-9)
    assert exact.bytes > 2 * sizes[0]
    assert sizes[0] > sizes[1] > sizes[2]
    assert exact.psnr + 0.01 > errors[0] > errors[1] > errors[2]
    assert exact.psnr - errors[0] < 0.05
    own = save_sparse(learned.dictionary, learned.code, name="a.h5", coefficient_bits=12)
    assert own.psnr > errors[0] + 10


def test_residuals_of_quantised_coefficients_and_means(found, learned):
    _, code = unpacked(packed(learned.dictionary, learned.code, Precision(4, 6)), "a")
    for part, relief in reliefs(learned.dictionary, code):
        rest = found.samples[part] + (found.means - code.means)[part, None, None] - relief
        true = (columns(rest, "weighted") ** 2).sum(axis=1)
        np.testing.assert_allclose(code.residuals[part], true, rtol=2e-3)
    assert code.residuals.sum() > 1.1 * learned.code.residuals.sum()


def test_only_used_atoms(window, found):
    every = dictionary_from_patches(found)
    code = omp(found, every, sparsity=1)
    code = replace(code, indices=np.where(code.indices % 2 == 0, code.indices, -1).astype(np.int32))
    whole = save_sparse(every, code, name="a.h5")
    less = save_sparse(every, code, name="a.h5", used_only=True)
    assert less.bytes < 0.7 * whole.bytes
    dictionary, fewer = unpacked(less.file.content.tobytes(), "a.h5")
    assert dictionary.count == fewer.atoms == len(np.unique(code.indices)) - 1
    np.testing.assert_array_equal(blended(dictionary, fewer, Context()), blended(every, code, Context()))


# Damage.


@pytest.fixture
def saved(tmp_path, learned):
    path = tmp_path / "terrain.h5"
    path.write_bytes(packed(learned.dictionary, learned.code))
    return path


def test_damaged_files_are_refused_in_a_sentence(saved):
    whole = saved.read_bytes()
    for length in (0, 7, 100, len(whole) // 2, len(whole) - 1):
        saved.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"^'terrain.h5' is no complete HDF5 file"):
            load_sparse(path=saved)


def test_changed_bytes_are_found_or_harmless(saved, learned):
    whole = bytearray(saved.read_bytes())
    expected = seal(learned.dictionary), seal(learned.code)
    refused = harmless = 0
    for place in np.random.default_rng(1).integers(0, len(whole), 150).tolist():
        changed = whole.copy()
        changed[place] ^= 0x55
        saved.write_bytes(changed)
        try:
            found = load_sparse(path=saved)
        except ValueError as error:
            refused += str(error).startswith("'terrain.h5' ")
        else:
            harmless += (seal(found.dictionary), seal(found.code)) == expected
    assert refused + harmless == 150
    assert refused > 100


@pytest.mark.parametrize("lost", ["code", "dictionary", "code/indices", "code/means", "code/residuals",
                                  "dictionary/samples", "dictionary/sources"])  # fmt: skip
def test_missing_parts(saved, lost):
    with h5py.File(saved, "r+") as file:
        del file[lost]
    with pytest.raises(ValueError, match=r"^'terrain.h5' is damaged; save it again"):
        load_sparse(path=saved)


@pytest.mark.parametrize(
    ("where", "name", "value"),
    [
        ("code", "metric", np.bytes_("odd")),
        ("code", "shape", [3, 3, 4, 24, 16]),
        ("code", "shape", [8, 10, 2, 24, 16]),
        ("code", "shape", [8, 10, 4, 7, 16]),
        ("code", "shape", [8, 10]),
        ("code", "place", [1.0, 2.0, 0.0, 0.0, 1.0, 0.0, 0.0]),
        ("dictionary", "form", np.bytes_("odd")),
        ("dictionary", "names", 5),
        ("dictionary", "metric", np.bytes_("plain")),
    ],
)
def test_impossible_attributes(saved, where, name, value):
    with h5py.File(saved, "r+") as file:
        file[where].attrs[name] = value
    with pytest.raises(ValueError, match=r"^'terrain.h5' is damaged; save it again"):
        load_sparse(path=saved)


@pytest.mark.parametrize(("where", "value"), [("code/indices", 999), ("code/indices", -2), ("code/means", np.nan)])
def test_impossible_numbers(saved, where, value):
    with h5py.File(saved, "r+") as file:
        numbers = file[where][()].astype(np.int32 if isinstance(value, int) else np.float64)
        del file[where]
        numbers[3] = value
        file[where] = numbers
    with pytest.raises(ValueError, match=r"^'terrain.h5' is damaged; save it again"):
        load_sparse(path=saved)


def test_foreign_and_newer_files(tmp_path, saved):
    other = tmp_path / "other.h5"
    with h5py.File(other, "w") as file:
        file["data"] = np.zeros(3)
    with pytest.raises(ValueError, match=r"'other[.]h5' holds no sparse terrain"):
        load_sparse(path=other)
    other.write_text("name,value\n")
    with pytest.raises(ValueError, match=r"'other[.]h5' is no complete HDF5 file"):
        load_sparse(path=other)
    with h5py.File(saved, "r+") as file:
        file.attrs["format"] = "nodegraph-sparse/3"
    with pytest.raises(ValueError, match=r"'terrain[.]h5' is of version 3 and this program reads 2; update nodegraph"):
        load_sparse(path=saved)


def test_files_of_version_1_are_read():
    found = load_sparse(path=Path(__file__).with_name("contract.h5"))
    assert [type(part).__name__ for part in found.dictionary.parts] == [
        "SampledDictionary", "ExemplarDictionary", "NoiseDictionary"
    ]  # fmt: skip
    assert found.dictionary.names == ("terrain 1", "exemplar", "noise")
    assert found.dictionary.count == found.code.atoms
    norms = np.linalg.norm(columns(found.dictionary.atoms(slice(None)), "weighted"), axis=1)
    np.testing.assert_allclose(norms, 1, atol=1e-5)
    assert found.code.grid.extent.crs == "EPSG:32616"
    assert found.code.sparsity == 2
    # It does not say how large the cells of its map are.
    assert not found.dictionary.exaggerations(np.arange(found.code.atoms), 10.0).any()


def test_what_saving_refuses(learned, found):
    other = replace(learned.code, atoms=99)
    with pytest.raises(ValueError, match=r"the code is one of 99 atoms and the dictionary has 24"):
        save_sparse(learned.dictionary, other, name="a.h5")
    with pytest.raises(ValueError, match="of the plain metric and the dictionary of the weighted one"):
        save_sparse(learned.dictionary, replace(learned.code, metric="plain"), name="a.h5")
    with pytest.raises(ValueError, match=r"must end in [.]h5"):
        save_sparse(learned.dictionary, learned.code, name="a.png")

    class Elsewhere(SampledDictionary):
        """Of another plugin."""

    values = {item.name: getattr(learned.dictionary, item.name) for item in fields(SampledDictionary)}
    with pytest.raises(ValueError, match="Elsewhere has no form in files"):
        save_sparse(Elsewhere(**values), learned.code, name="a.h5")


def test_a_code_without_patches(learned, found):
    nowhere = ksvd(replace(found, grid=None), atoms=5, iterations=1)
    again = unpacked(packed(nowhere.dictionary, nowhere.code), "a")
    assert seal(again[1]) == seal(nowhere.code)
    with pytest.raises(ValueError, match=r"the code has no patches"):
        sparse_statistics(*again)


# Statistics.


def test_the_raster_is_that_of_the_function(window, learned):
    function = sparse_terrain(learned.dictionary, learned.code)
    rows, cols = window.shape
    x = window.extent.west + (np.arange(cols) + 0.5) * 90
    y = window.extent.north - (np.arange(rows) + 0.5) * 90
    heights = function.query(Points(np.tile(x, rows), np.repeat(y, cols), 1.0)).height.reshape(rows, cols)
    np.testing.assert_allclose(blended(learned.dictionary, learned.code, Context()), heights, atol=1e-6)


@pytest.mark.parametrize("half", [2, 3, 5, 8])
def test_own_patches_give_the_terrain_back(window, half):
    found = patches(window, radius=90.0 * half)
    every = dictionary_from_patches(found)
    code = omp(found, every, sparsity=1)
    terrain = blended(every, code, Context())
    assert np.abs(terrain - window.data).max() < 1e-3
    assert sparse_statistics(every, code, window).psnr > 120


def test_statistics_by_hand(window, found, learned):
    statistics = sparse_statistics(learned.dictionary, learned.code, window).statistics
    n = found.grid.count
    assert (statistics.samples, statistics.atoms, statistics.patches, statistics.sparsity) == (256, 24, n, 4)
    assert statistics.values == 256 * 24 + n * (2 * 4 + 2) + 1
    assert statistics.cells == 64 * 80
    assert statistics.ratio == statistics.values / (64 * 80)
    assert statistics.bytes == save_sparse(learned.dictionary, learned.code, name="a.h5").bytes
    apart = blended(learned.dictionary, learned.code, Context()) - window.data
    rmse = np.sqrt((apart**2).mean())
    assert statistics.rmse == pytest.approx(rmse)
    assert statistics.psnr == pytest.approx(20 * np.log10(np.ptp(window.data) / rmse))
    assert statistics.largest_error == pytest.approx(np.abs(apart).max())
    preview_sparse_statistics(statistics)
    unknown = sparse_statistics(learned.dictionary, learned.code).statistics
    assert np.isnan(unknown.psnr)
    assert json.loads(unknown.to_json())[0]["psnr"] is None
    preview_sparse_statistics(unknown)
    wrong = window.window(slice(0, 50), slice(0, 50))
    with pytest.raises(ValueError, match=r"the code makes 64 by 80 cells and the reference has 50 by 50"):
        sparse_statistics(learned.dictionary, learned.code, wrong)


def test_functions_count_as_their_parameters(window, found, dictionaries):
    for kind, expected in (("noise", 40 * 16), ("exemplar", 64 * 80 + 2 * dictionaries["exemplar"].count)):
        dictionary = dictionaries[kind]
        code = omp(found, dictionary, sparsity=1)
        assert sparse_statistics(dictionary, code).statistics.values == expected + 4 * found.grid.count + 1


def test_tables(window, tmp_path):
    table = rate_distortion(window, radius=720.0, atoms=(8, 16), sparsity=(1, 3), iterations=2)
    assert [(row.atoms, row.sparsity) for row in table.rows] == [(8, 1), (8, 3), (16, 1), (16, 3)]
    psnr = [row.psnr for row in table.rows]
    assert psnr[0] < psnr[1] < psnr[3]
    assert psnr[0] < psnr[2]
    assert (table.jpeg2000 > psnr).all()  # for storage alone it wins
    preview_rate_distortion(table)
    rows = list(csv.DictReader(io.StringIO(save_statistics(table, name="a.csv").content.tobytes().decode())))
    assert [float(row["psnr"]) for row in rows] == psnr
    single = sparse_statistics(*_any(window)).statistics
    both = json.loads(save_statistics(table, single, name="a.json").content.tobytes())
    assert len(both) == 5
    assert both[0]["psnr_jpeg2000"] == pytest.approx(table.jpeg2000[0])
    lines = save_statistics(single, table, name="a.csv").content.tobytes().decode().splitlines()
    assert all(line.count(",") == lines[0].count(",") for line in lines)
    with pytest.raises(ValueError, match=r"choose [.]csv or .json"):
        save_statistics(table, name="a.txt")
    with pytest.raises(ValueError, match=r"flat"):
        rate_distortion(window.like(np.zeros(window.shape, np.float32)), radius=720.0)


def test_a_learning_as_a_table(learned):
    rows = list(csv.DictReader(io.StringIO(save_statistics(learned.learning, name="a.csv").content.tobytes().decode())))
    assert [int(row["iteration"]) for row in rows] == [0, 1, 2, 3]
    assert [float(row["rmse"]) for row in rows] == learned.learning.rmse.tolist()


def _any(window):
    found = ksvd(patches(window, radius=720.0), atoms=4, iterations=0)
    return found.dictionary, found.code


def test_rivals_keep_to_their_bytes(window):
    before = {}
    for most in (700, 2000, 5000):
        for name, rival in (
            ("wavelets", jpeg2000(window.data, most, Context())),
            ("cells", fewer_cells(window.data, most)),
        ):
            size, heights = rival
            assert 0.9 * most <= size <= most
            psnr = compared(heights, window.data).psnr
            assert psnr > before.get(name, 20)
            before[name] = psnr
    assert jpeg2000(window.data, 20, Context()) is None
