"""Every node of sparse keeps the contract; a node without an example here fails."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nodegraph.testing import Example, parametrize_with_checks
from nodegraph_sparse.dictionary import SparseCode
from nodegraph_sparse.dictionary_from_patches import dictionary_from_patches
from nodegraph_sparse.exemplar import exemplar_dictionary
from nodegraph_sparse.merge_dictionaries import merge_dictionaries
from nodegraph_sparse.noise_dictionary import dictionary_from_noise
from nodegraph_sparse.patches import patches
from nodegraph_sparse.sparse_statistics import sparse_statistics
from nodegraph_terrain.raster import Elevation, Extent, Mask

GROUND = Elevation(
    (300 + 90 * np.random.default_rng(1).random((24, 28))).astype(np.float32), Extent(0.0, 0.0, 280.0, 240.0)
)
PATCHES = patches(GROUND, radius=40.0)
TURNED = patches(GROUND, radius=40.0, count=9, rotations="quarter")
CHOSEN = dictionary_from_patches(PATCHES, choice="farthest", atoms=8)
EXEMPLAR = exemplar_dictionary(GROUND, radius=40.0)
NOISE = dictionary_from_noise(atoms=5, size=8, octaves=3)
EVERY_KIND = merge_dictionaries(CHOSEN, EXEMPLAR, NOISE)
CODE = SparseCode(
    PATCHES.grid,
    np.where(np.arange(PATCHES.grid.count)[:, None] % 3 > [0, 1], [[2, 5]], -1).astype(np.int32),
    np.random.default_rng(2).random((PATCHES.grid.count, 2)),
    PATCHES.means,
    np.ones(PATCHES.grid.count),
    CHOSEN.count,
)
STATISTICS = sparse_statistics(CHOSEN, CODE, GROUND).statistics
SAVED = str(Path(__file__).with_name("contract.h5"))
STYLES = [Mask(np.random.default_rng(3 + i).random((5, 6), np.float32), GROUND.extent) for i in range(3)]


def cases(*params: dict[str, Any], **inputs: Any) -> list[Example]:
    return [Example(inputs, item) for item in params]


EXAMPLES: dict[str, list[Example]] = {
    "sparse.constrained_ksvd": [
        *cases(
            {"atoms": 6, "sparsity": 1, "iterations": 2},
            {"atoms": 6, "iterations": 1, "choice": "farthest", "selection": "omp", "tolerance": 0.1, "seed": 1},
            patches=PATCHES,
        ),
        *cases({"atoms": 4, "iterations": 1, "choice": "random"}, patches=PATCHES, candidates=EVERY_KIND),
        *cases({"atoms": 4, "iterations": 1}, patches=TURNED),
    ],
    "sparse.dictionary_from_noise": [
        *cases(
            {"atoms": 5, "size": 8, "octaves": 3},
            {"atoms": 3, "kind": "ridged", "size": 12, "metric": "plain", "seed": 3, "name": "crests"},
            {"atoms": 3, "kind": "perlin", "wavelength": 2, "gain": 0.6, "lacunarity": 1.9, "variety": 0.5},
        ),
        *cases({"atoms": 5}, patches=PATCHES),
    ],
    "sparse.dictionary_from_patches": [
        *cases({}, {"choice": "random", "atoms": 4}, patches=[PATCHES]),
        *cases(
            {"choice": "farthest", "atoms": 6, "names": ["hills"]},
            {"choice": "farthest", "atoms": 6, "seed": 5},
            patches=[PATCHES, TURNED],
        ),
    ],
    "sparse.draw_dictionary": [
        *cases({}, {"style": "grey", "most": 5, "numbers": False, "width": 300, "tile": 40}, dictionary=CHOSEN),
        *cases({"most": 12, "order": "spread"}, dictionary=EVERY_KIND),
        *cases({"order": "usage"}, dictionary=CHOSEN, code=CODE),
    ],
    "sparse.exemplar_dictionary": cases(
        {"radius": 40},
        {"radius": 20, "stride": 3, "symmetries": True, "metric": "plain", "name": "hills"},
        {"cells": 2, "factor": 3, "atoms": 7, "stride": 1, "relief": 20, "symmetries": True, "seed": 4},
        surface=GROUND,
    ),
    "sparse.ksvd": [
        *cases(
            {"atoms": 6, "sparsity": 1, "iterations": 2},
            {"atoms": 6, "iterations": 1, "choice": "farthest", "update": "approximate", "selection": "omp", "seed": 1},
            {"atoms": 6, "iterations": 1, "choice": "random", "tolerance": 0.1, "name": "hills"},
            patches=PATCHES,
        ),
        *cases({"iterations": 1}, patches=PATCHES, initial=CHOSEN),
        *cases({"atoms": 4, "iterations": 1}, patches=TURNED),
    ],
    "sparse.load_sparse": cases({"path": SAVED}),
    "sparse.merge_dictionaries": cases({}, dictionaries=[CHOSEN, EXEMPLAR, NOISE]),
    "sparse.multiresolution_dictionary": [
        *cases({"factor": 2}, {"factor": 4, "smoothing": 0.5, "least": 0.1}, dictionary=EVERY_KIND),
        *cases({"factor": 2}, dictionary=EXEMPLAR),
    ],
    "sparse.omp": [
        *cases(
            {"sparsity": 4},
            {"sparsity": 4, "error": 15, "selection": "omp"},
            {"sparsity": 3, "selection": "mp", "nonnegative": True},
            patches=PATCHES,
            dictionary=CHOSEN,
        ),
        *cases(
            {"sparsity": 3, "nonnegative": True, "weights": {"noise": 0.5}},
            patches=PATCHES,
            dictionary=EVERY_KIND,
            style=STYLES,
        ),
    ],
    "sparse.rate_distortion": cases(
        {"radius": 40, "atoms": [4, 6], "sparsity": [1, 2], "iterations": 1},
        {
            "radius": 30,
            "atoms": [5],
            "sparsity": [2],
            "iterations": 0,
            "metric": "plain",
            "coefficient_bits": None,
            "mean_bits": None,
            "atom_bits": None,
            "seed": 1,
        },
        surface=GROUND,
    ),
    "sparse.save_sparse": [
        *cases(
            {"name": "hills.h5"},
            {"name": "hills.h5", "coefficient_bits": 9, "mean_bits": 12, "atom_bits": 8, "used_only": True},
            dictionary=CHOSEN,
            code=CODE,
        ),
        *cases({"name": "hills.h5", "mean_bits": 10}, dictionary=CHOSEN, code=CODE, reference=GROUND),
    ],
    "sparse.save_statistics": cases({"name": "table.csv"}, {"name": "table.json"}, statistics=[STATISTICS, STATISTICS]),
    "sparse.sparse_statistics": [
        *cases({}, dictionary=CHOSEN, code=CODE),
        *cases({}, dictionary=CHOSEN, code=CODE, reference=GROUND),
    ],
    "sparse.patches": cases(
        {"radius": 40},
        {"radius": 30, "metric": "plain"},
        {"radius": 40, "count": 7, "rotations": "any", "mirror": True, "seed": 2},
        surface=GROUND,
    ),
    "sparse.sparse_terrain": [
        *cases(
            {},
            {"interpolation": "bilinear", "margin": 60, "fall_off": "wyvill"},
            dictionary=CHOSEN,
            code=CODE,
        ),
        *cases(
            {"size": 16},
            {"factor": 3},
            dictionary=NOISE,
            code=replace(CODE, atoms=NOISE.count, indices=CODE.indices % 5),
        ),
    ],
}


@parametrize_with_checks("sparse", EXAMPLES)
def test_contract(check):
    check()
