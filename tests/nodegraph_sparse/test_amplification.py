"""Amplification proved: real ground is reduced by 16, amplified after other ground, and compared with what it was.

The rivals know the same: bicubic interpolation, and that with fBm whose spectral slope and amplitude are fitted to the
example; the amplitude also scaled by how steep the coarse terrain is beside the coarse example.  Run with -s for the
whole table.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import wasserstein_distance

from nodegraph import Context, Graph
from nodegraph.cache import Cache
from nodegraph_hydrology.compare_networks import compare_networks
from nodegraph_hydrology.drainage import drainage_area
from nodegraph_hydrology.streams import extract_streams
from nodegraph_sparse.exemplar import exemplar_dictionary
from nodegraph_sparse.merge_dictionaries import merge_dictionaries
from nodegraph_sparse.multiresolution import multiresolution_dictionary
from nodegraph_sparse.omp import omp
from nodegraph_sparse.patches import patches
from nodegraph_sparse.sparse_terrain import sparse_terrain
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.resample import resample

GRAPH = Path(__file__).parents[2] / "graphs" / "sparse" / "amplify.json"
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
ALPS, ANDES, EVEREST = "alps_N46E008/N46E008.tif", "andes_S33W071/S33W071.tif", "everest/N28E086.hgt"
FACTOR = 16
CELL = 75
PLACES: dict[str, Any] = {
    "jacksboro": None,  # what the graph of the gallery holds out: the mountains south of its example
    "alps": ((ALPS, [832, 1344], [0, 512]), (ANDES, [0, 1456], [0, 1232])),
    "andes": ((ANDES, [400, 912], [300, 812]), (EVEREST, [192, 960], [0, 1024])),
    "everest": ((EVEREST, [192, 704], [0, 512]), (ANDES, [0, 1456], [0, 1232])),
}
"""Held-out ground and example: a file, and rows and columns of it in cells of 75 m."""
STREAM = 2e6
"""Least drainage area of a stream, m2: between one coarse cell and two."""


@dataclass(frozen=True)
class Proof:
    truth: Elevation
    coarse: Elevation
    example: Elevation
    amplified: Elevation
    between: Elevation


def held_out(place: str, cache: Cache, **params: Any) -> Proof:
    """Run the graph that a user runs, on that ground, up to the cells of the truth."""
    document = json.loads(GRAPH.read_bytes())
    nodes = document["nodes"]
    for record in nodes.values():
        if record["type"] == "graph":
            record["params"]["path"] = str(GRAPH.parent / record["params"]["path"])
    if PLACES[place]:
        for (file, rows, columns), part in zip(PLACES[place], ("measured", "exemplar"), strict=True):
            if not (DATA / file).exists():
                pytest.skip(f"real elevation data is not at {DATA}")
            nodes |= {
                f"{part}_dem": {"type": "terrain.load_elevation", "params": {"path": str(DATA / file)}},
                f"{part}_metric": {
                    "type": "terrain.reproject", "inputs": {"surface": f"{part}_dem"}, "params": {"cell_size": CELL}
                },
                f"{part}_filled": {"type": "terrain.fill_voids", "inputs": {"surface": f"{part}_metric"}},
                part: {
                    "type": "terrain.crop", "inputs": {"surface": f"{part}_filled"},
                    "params": {"rows": rows, "columns": columns},
                },
            }  # fmt: skip
        nodes["coarse"]["params"]["cell_size"] = FACTOR * CELL
        nodes["exemplar_320"]["params"]["cell_size"] = 4 * CELL
    wanted = ["measured", "coarse", "exemplar", "step2", "step1"]
    result = Graph.from_json(json.dumps(document)).run(wanted, set=params, cache=cache)
    return Proof(*(result[name] for name in wanted))


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Any:
    made = Cache(tmp_path_factory.mktemp("cache"))
    yield made
    made.close()


@pytest.fixture(scope="module", params=[pytest.param(place, marks=pytest.mark.slow) for place in PLACES])
def proof(request: pytest.FixtureRequest, cache: Cache) -> Proof:
    return held_out(request.param, cache)


@pytest.fixture(scope="module")
def table(proof: Proof, request: pytest.FixtureRequest) -> dict[str, dict[str, float]]:
    """Return what is measured of each way to refine the coarse terrain."""
    rivals = {
        "bicubic": [resample(proof.coarse, proof.truth)],
        "fBm": [with_noise(proof, seed) for seed in (1, 2, 3)],
        "fBm by relief": [with_noise(proof, seed, by_relief=True) for seed in (1, 2, 3)],
        "amplified": [proof.amplified],
    }
    found = {}
    print()
    for name, surfaces in rivals.items():
        rows = [measures(proof, surface) for surface in surfaces]
        found[name] = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
        print(f"{name:14}", "  ".join(f"{key} {value:.3f}" for key, value in found[name].items()))
    return found


def with_noise(proof: Proof, seed: int, *, by_relief: bool = False) -> Elevation:
    """Return bicubic interpolation and fBm: the example's spectral slope, and as high as what bicubic leaves there."""
    small = resample(proof.example, cell_size=proof.coarse.cell_size[0], method="area")
    example = proof.example.window(*(slice(0, FACTOR * side) for side in small.shape))
    lacks = example.data - resample(small, example).data
    rows, cols = proof.truth.shape
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols))
    frequency[0, 0] = np.inf
    white = np.fft.rfft2(np.random.default_rng(seed).normal(size=(rows, cols)))
    noise = proof.truth.like(np.fft.irfft2(white * frequency ** (spectral_slope(example) / 2), (rows, cols)))
    # Only what the coarse terrain does not say already.
    detail = noise.data - resample(resample(noise, proof.coarse, method="area"), noise).data
    amplitude = lacks.std() / detail.std()
    if by_relief:
        amplitude *= steepness(proof.coarse) / steepness(small)
    return proof.truth.like(resample(proof.coarse, proof.truth).data + amplitude * detail)


def slopes(surface: Elevation) -> np.ndarray:
    down, along = np.gradient(surface.data.astype(np.float64), surface.cell_size[0])
    return np.degrees(np.arctan(np.hypot(down, along)))


def steepness(surface: Elevation) -> float:
    """Return the root mean square slope."""
    return float(np.sqrt(np.mean(np.tan(np.radians(slopes(surface))) ** 2)))


def spectrum(surface: Elevation) -> tuple[np.ndarray, np.ndarray]:
    """Return the radially averaged power between wavelengths of two coarse cells and 2.5 fine ones."""
    rows, cols = surface.shape
    y, x = np.mgrid[:rows, :cols]
    plane = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    heights = surface.data.astype(np.float64).ravel()
    heights -= plane @ np.linalg.lstsq(plane, heights, rcond=None)[0]
    windowed = heights.reshape(rows, cols) * np.outer(np.hanning(rows), np.hanning(cols))
    power = np.abs(np.fft.rfft2(windowed)).ravel() ** 2 / x.size
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)).ravel()
    edges = np.geomspace(1 / (2 * FACTOR), 1 / 2.5, 17)
    ring = np.digitize(frequency, edges)
    means = np.array([power[ring == number].mean() for number in range(1, len(edges))])
    return np.sqrt(edges[1:] * edges[:-1]), means


def spectral_slope(surface: Elevation) -> float:
    return float(np.polyfit(*map(np.log, spectrum(surface)), 1)[0])


def drained(surface: Elevation) -> np.ndarray:
    """Return the logarithm of the greatest drainage area in each coarse cell: rivers, wherever in it they run."""
    area = drainage_area(surface).data
    rows, cols = (side // FACTOR for side in area.shape)
    return np.asarray(np.log10(area.reshape(rows, FACTOR, cols, FACTOR).max(axis=(1, 3))))


def measures(proof: Proof, surface: Elevation) -> dict[str, float]:
    truth, side = proof.truth, 4 * FACTOR
    steep = slopes(truth), slopes(surface)
    squares = [
        wasserstein_distance(*(part[top : top + side, left : left + side].ravel() for part in steep))
        for top in range(0, truth.shape[0] - side + 1, side)
        for left in range(0, truth.shape[1] - side + 1, side)
    ]
    power = np.log10(spectrum(truth)[1] / spectrum(surface)[1])
    rivers = extract_streams(truth, threshold=STREAM)
    near, far = (
        compare_networks(rivers, surface, threshold=STREAM, within=within, least_order=1).agreement
        for within in (3, FACTOR)
    )
    reduced = resample(surface, proof.coarse, method="area").data - proof.coarse.data
    return {
        "slopes": wasserstein_distance(steep[0].ravel(), steep[1].ravel()),
        "slopes by squares": float(np.mean(squares)),
        "spectrum": float(np.sqrt(np.mean(power**2))),
        "spectral slope": spectral_slope(surface) - spectral_slope(truth),
        "streams within 3 cells": 2 / (1 / near.followed + 1 / near.found),
        "streams within a coarse cell": 2 / (1 / far.followed + 1 / far.found),
        "stream length": far.stream_cells / far.designed_cells,
        "drainage area": float(np.sqrt(np.mean((drained(surface) - drained(truth)) ** 2))),
        "error, m": float(np.sqrt(np.mean((surface.data.astype(np.float64) - truth.data) ** 2))),
        "reduced again, %": float(100 * np.abs(reduced).max() / np.ptp(proof.coarse.data)),
    }


@pytest.mark.parametrize("rival", ["bicubic", "fBm"])
def test_slopes_and_spectrum_are_nearer_to_real_ground(table: Any, rival: str) -> None:
    for measure in ("slopes", "slopes by squares", "spectrum"):
        assert table["amplified"][measure] < table[rival][measure], measure
    assert abs(table["amplified"]["spectral slope"]) < 0.6 < 3 < abs(table["bicubic"]["spectral slope"])


def test_ground_is_rough_where_it_is_rough(table: Any) -> None:
    """Noise that knows how steep the land is on the whole can have its slopes, but has them everywhere."""
    assert table["amplified"]["slopes by squares"] < table["fBm by relief"]["slopes by squares"]


def test_water_runs_as_on_real_ground(table: Any) -> None:
    """To a coarse cell nearer than on bicubic ground, which has too few streams; to a few cells nearer than on noise.

    Within a few fine cells nothing that adds relief comes closer than bicubic interpolation, which keeps to the middle
    of valleys: what would say where in a coarse cell a river runs is not in the coarse terrain.
    """
    made = table["amplified"]
    assert made["streams within 3 cells"] > max(
        table[name]["streams within 3 cells"] for name in ("fBm", "fBm by relief")
    )
    assert made["streams within a coarse cell"] > table["bicubic"]["streams within a coarse cell"]
    assert made["drainage area"] < table["bicubic"]["drainage area"]
    assert abs(np.log(made["stream length"])) < abs(np.log(table["bicubic"]["stream length"]))


def test_reduced_again_it_is_the_coarse_terrain(proof: Proof, table: Any) -> None:
    assert table["amplified"]["reduced again, %"] < 2
    first = resample(proof.between, proof.coarse, method="area").data - proof.coarse.data
    assert np.abs(first).max() < 0.02 * np.ptp(proof.coarse.data)


def grid_shown(surface: Elevation, period: int) -> float:
    """Return how far slopes vary with the grid: amplitudes at its period and two harmonics over the mean slope.

    Along lines of cells slopes are averaged, so that what keeps to a grid adds up and what does not cancels.
    """
    steep = slopes(surface)
    worst = 0.0
    for axis in (0, 1):
        profile = steep.mean(axis=1 - axis)
        length = len(profile) // period * period
        waves = 2 * np.abs(np.fft.rfft(profile[:length] / profile[:length].mean())) / length
        base = length // period
        # What varies as much between the grid's own frequencies is ground.
        for harmonic in range(1, min(4, period // 2)):
            around = np.r_[
                waves[harmonic * base - base // 3 : harmonic * base],
                waves[harmonic * base + 1 : harmonic * base + base // 3 + 1],
            ]
            rest = np.sqrt(np.mean(around**2)) if len(around) else 0.0
            worst = max(worst, float(waves[harmonic * base] - rest))
    return worst


@pytest.mark.slow
@pytest.mark.parametrize(("radius", "atoms"), [(2, 20000), (4, 20000), (8, 4000), (16, 2000)])
@pytest.mark.parametrize("place", ["alps", "everest"])
def test_no_grid_of_patches_shows(cache: Cache, place: str, radius: int, atoms: int) -> None:
    """Neither that of the last step nor of the one before: what is added that faded out between discs is found out."""
    made = held_out(place, cache, R=radius, N=atoms)
    surface, smooth = made.amplified, resample(made.coarse, made.amplified)
    for period in (4 * radius, 16 * radius):
        if period > surface.shape[0] // 8:
            continue  # a few valleys of the ground are as regular as so few lines
        fades = np.sin(np.pi * (np.arange(surface.shape[0]) + 0.5) / period) ** 2
        seamed = surface.like(smooth.data + np.outer(fades, fades) * (surface.data - smooth.data))
        shown, seams = grid_shown(surface, period), grid_shown(seamed, period)
        print(f"{place}, R = {radius}, grid of {period} cells: {shown:.4f}, with seams {seams:.4f}")
        assert shown < min(0.05, 0.5 * seams)


def hills(cell: float) -> Elevation:
    dice = np.random.default_rng(4)
    heights = np.cumsum(np.cumsum(dice.normal(size=(64, 64)), 0), 1)
    return Elevation((40 * heights / np.abs(heights).max()).astype(np.float32), Extent(0, 0, 64 * cell, 64 * cell))


@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize(("height", "cell"), [(1.0, 10.0), (7.0, 10.0), (1.0, 2.0), (30.0, 40.0)])
def test_no_atom_is_steeper_than_its_exaggeration(height: float, cell: float, merged: bool) -> None:
    """A terrain after itself, higher and wider: what is beyond the limit is lowered to it, and nothing else."""
    example = hills(10.0)
    atoms: Any = exemplar_dictionary(example, cells=2, factor=4, stride=4)
    if merged:
        atoms = merge_dictionaries(exemplar_dictionary(hills(10.0), cells=2, factor=4, stride=8), atoms)
    high, low = multiresolution_dictionary(atoms)
    small = resample(example, factor=0.25, method="area")
    side = 4 * cell * small.shape[0]
    coarse = Elevation(height * small.data, Extent(0, 0, side, side))
    code = omp(patches(coarse, cells=2), low, sparsity=1, nonnegative=True)
    times = code.coefficients[:, 0] * high.exaggerations(code.indices[:, 0], cell)
    assert np.median(times) == pytest.approx(height * 10 / cell, rel=1e-3)
    free, held = (sparse_terrain(high, code, exaggeration=limit, context=Context()) for limit in (None, 3.0))
    assert np.max(held.coefficients[:, 0] * high.exaggerations(code.indices[:, 0], cell)) <= 3 * (1 + 1e-9)  # type: ignore[attr-defined]
    kept = times <= 3
    np.testing.assert_array_equal(held.coefficients[kept], free.coefficients[kept])  # type: ignore[attr-defined]


def test_atoms_of_unknown_heights_keep_theirs() -> None:
    high, low = multiresolution_dictionary(
        exemplar_dictionary(hills(10.0), cells=2, factor=4, stride=8).take(np.arange(9))
    )
    code = omp(patches(resample(hills(10.0), factor=0.25, method="area"), cells=2), low, sparsity=1)
    steep = replace(code, coefficients=1e3 * code.coefficients)
    made = sparse_terrain(high, steep, exaggeration=2.0)
    np.testing.assert_array_equal(made.coefficients, steep.coefficients)  # type: ignore[attr-defined]
