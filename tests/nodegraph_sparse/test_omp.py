"""The node that codes patches: what it checks, how error targets and styles act, and exactness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nodegraph_sparse.dictionary import SampledDictionary
from nodegraph_sparse.dictionary_from_patches import dictionary_from_patches
from nodegraph_sparse.merge_dictionaries import merge_dictionaries
from nodegraph_sparse.metric import mass
from nodegraph_sparse.omp import omp
from nodegraph_sparse.patches import patches
from nodegraph_terrain.raster import Elevation, Extent, Mask

EXTENT = Extent(1000.0, 2000.0, 1480.0, 2400.0)
ROUGH = np.random.default_rng(1).normal(size=(40, 48)).cumsum(axis=0).cumsum(axis=1)
GROUND = Elevation(ROUGH.astype(np.float32), EXTENT)
PATCHES = patches(GROUND, radius=40.0)
OWN = dictionary_from_patches(PATCHES)
FEW = dictionary_from_patches(PATCHES, choice="random", atoms=12)
OTHER = dictionary_from_patches(
    patches(replace(GROUND, data=GROUND.data[::-1, ::-1].copy()), radius=40.0), names=["other"]
)
TWO = merge_dictionaries(FEW, OTHER)


def squares(samples):
    return (samples.astype(float) ** 2 * mass(8, "weighted")).sum(axis=(1, 2))


def sources_of(code):
    return np.where(code.indices >= 0, TWO.sources[code.indices], -1)


def rebuilt(code, dictionary):
    samples = np.zeros((code.grid.count, 8, 8))
    for slot in range(code.sparsity):
        used = code.indices[:, slot] >= 0
        atoms = dictionary.atoms(np.maximum(code.indices[:, slot], 0))
        samples += (used * code.coefficients[:, slot])[:, None, None] * atoms
    return samples


@pytest.mark.parametrize("metric", ["weighted", "plain"])
def test_own_patches_are_found_exactly(metric):
    cut = patches(GROUND, radius=40.0, metric=metric)
    own = dictionary_from_patches(cut)
    code = omp(cut, own, sparsity=1)
    np.testing.assert_allclose(rebuilt(code, own), cut.samples, atol=1e-6 * np.abs(cut.samples).max())
    assert code.atoms == own.count
    assert code.metric == metric
    assert code.grid is cut.grid
    np.testing.assert_array_equal(code.means, cut.means)


def test_residuals_are_what_the_sums_leave():
    code = omp(PATCHES, FEW, sparsity=3)
    np.testing.assert_allclose(code.residuals, squares(PATCHES.samples - rebuilt(code, FEW)), rtol=1e-6, atol=1e-6)


def test_an_error_target_is_met_with_as_few_atoms():
    code = omp(PATCHES, FEW, sparsity=12, error=3.0)
    used = (code.indices >= 0).sum(axis=1)
    weight = mass(8, "weighted").sum()
    assert used.min() < used.max()
    assert (np.sqrt(code.residuals[used < 11] / weight) <= 3.0).all()
    for sparsity in range(1, used.max()):
        longer = used > sparsity
        less = omp(PATCHES, FEW, sparsity=sparsity)
        assert (np.sqrt(less.residuals[longer] / weight) > 3.0).all()


def test_nonnegative_codes_have_no_negative_coefficient():
    assert omp(PATCHES, FEW, sparsity=4).coefficients.min() < 0
    code = omp(PATCHES, FEW, sparsity=4, nonnegative=True)
    assert code.coefficients.min() >= 0
    assert (code.residuals <= squares(PATCHES.samples) * (1 + 1e-12)).all()


def test_masks_say_where_each_source_is_used():
    west = np.zeros((10, 12), np.float32)
    west[:, :6] = 1
    code = omp(PATCHES, TWO, Mask(west, EXTENT), Mask(1 - west, EXTENT), sparsity=2)
    east = PATCHES.centres[:, 0]
    of = sources_of(code)
    middle = 1000 + 240
    assert (of[east < middle - 20] <= 0).all()
    assert np.isin(of[east > middle + 20], [-1, 1]).all()
    plain = sources_of(omp(PATCHES, TWO, sparsity=2))
    assert (plain[east < middle - 20] == 1).any()


def test_weights_by_name():
    only = omp(PATCHES, TWO, sparsity=2, weights={"other": 0.0})
    assert (sources_of(only) <= 0).all()
    alone = omp(PATCHES, FEW, sparsity=2)
    np.testing.assert_array_equal(only.indices, alone.indices)
    nothing = omp(PATCHES, TWO, weights=dict.fromkeys(TWO.names, 0.0))
    assert (nothing.indices == -1).all()


def test_what_does_not_match_is_refused():
    with pytest.raises(ValueError, match="lie at random places"):
        omp(patches(GROUND, radius=40.0, count=5), FEW)
    with pytest.raises(
        ValueError, match=r"patches of 12 by 12 samples do not match atoms of 8 by 8.*radius of 4 cells"
    ):
        omp(patches(GROUND, radius=60.0), FEW)
    with pytest.raises(ValueError, match="the plain metric and the atoms of the weighted one"):
        omp(patches(GROUND, radius=40.0, metric="plain"), FEW)
    with pytest.raises(ValueError, match="has no source 'othr'; did you mean 'other'"):
        omp(PATCHES, TWO, weights={"othr": 0.5})
    with pytest.raises(ValueError, match="weight of 'other' is 2 and must be between 0 and 1"):
        omp(PATCHES, TWO, weights={"other": 2.0})
    full = Mask(np.ones((4, 5), np.float32), EXTENT)
    with pytest.raises(ValueError, match="1 style masks for the 2 sources"):
        omp(PATCHES, TWO, full)
    with pytest.raises(ValueError, match="'other' does not cover the terrain"):
        omp(PATCHES, TWO, full, full.window(slice(0, 2), slice(0, 5)))
    with pytest.raises(ValueError, match="has voids"):
        omp(PATCHES, TWO, full, full.like(np.full((4, 5), np.nan, np.float32)))
    elsewhere = Mask(full.data, replace(EXTENT, unit="deg"))
    with pytest.raises(ValueError, match="another coordinate system"):
        omp(PATCHES, TWO, full, elsewhere)


def test_a_spoiled_patch_is_named():
    samples = PATCHES.samples.copy()
    samples[5, 4, 4] = np.nan
    with pytest.raises(ValueError, match="signal 5 is not finite"):
        omp(replace(PATCHES, samples=samples), FEW)


def test_one_atom_is_enough_for_a_dictionary():
    one = SampledDictionary("weighted", np.zeros(1, np.int32), ("one",), OWN.atoms(np.array([7])))
    code = omp(PATCHES, one, sparsity=3)
    assert (code.indices[:, 1:] == -1).all()
    assert code.residuals[7] < 1e-9 * squares(PATCHES.samples[7:8])[0]
