"""Sparse coding beside its peers, in the same run.

``omp``: orthogonal least squares (SPAMS calls it omp) of 20,000 signals in float64 by s = 8 of N atoms, K samples each,
on NumPy and on OpenCL, beside SPAMS; and orthogonal matching pursuit beside scikit-learn (with ``--slow``: 20 s).
``complete``: the best atom of a dictionary of 120,000 which is made anew, block by block, whenever it is searched.

``ksvd``: learning with equal N, s and iterations beside SPAMS (and scikit-learn, with ``--slow``).

``amplify``: 32 x 32 cells to 8,192 x 8,192 in four steps of 4, in tiles, with 256 learned atoms and (with ``--slow``)
with 120,000 windows of the example: table 2 of Guérin 2016, doi:10.1111/cgf.12821, whose times are of another machine.

``quality``: PSNR, values and bytes of learned terrain, beside JPEG 2000, fewer cells and table 1 of the paper.

``inverse``: PSNR of terrain as functions, by the kind of noise.

    uv run --group bench python benchmarks/sparse.py [--part omp] [--repeat 5] [--slow]

Runs alternate; figures are of the fastest one.  Beside the clock's stands the processors' time, which says more on a
machine that does other work too.
"""

from __future__ import annotations

import argparse
import resource
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from sparse_quality import inverse, quality

from nodegraph import Context
from nodegraph.opencl import choose, to_host
from nodegraph_sparse.constrained_ksvd import constrained_ksvd
from nodegraph_sparse.dictionary import Dictionary
from nodegraph_sparse.exemplar import exemplar_dictionary
from nodegraph_sparse.ksvd import ksvd
from nodegraph_sparse.metric import columns, mass
from nodegraph_sparse.multiresolution import MultiresolutionDictionary, multiresolution_dictionary
from nodegraph_sparse.omp import omp as sparse_omp
from nodegraph_sparse.patches import patches
from nodegraph_sparse.pursuit import Pursuit, pursue, pursue_samples
from nodegraph_sparse.sparse_terrain import sparse_terrain
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.reproject import reproject
from nodegraph_terrain.resample import resample
from nodegraph_terrain.sample_dem import sample_dem
from nodegraph_tree.device import sample_on_device
from nodegraph_tree.evaluate import sample

SIGNALS = 20_000
SPARSITY = 8


def measured(runs: dict[str, Callable[[], Any]], repeat: int) -> tuple[dict[str, tuple[float, float]], dict[str, Any]]:
    """Return the least seconds of several alternating runs, by the clock and of the processors, and what each gave."""
    least = dict.fromkeys(runs, (np.inf, np.inf))
    made: dict[str, Any] = {}
    for turn in range(repeat):
        for name, run in runs.items():
            if turn > 0 and least[name][0] > 10:
                continue  # what takes long is measured once
            clock, busy = time.perf_counter(), time.process_time()
            made[name] = run()
            taken = time.perf_counter() - clock, time.process_time() - busy
            least[name] = min(least[name][0], taken[0]), min(least[name][1], taken[1])
    return least, made


def report(least: dict[str, tuple[float, float]], reference: str) -> None:
    for name, (clock, busy) in least.items():
        ratios = " ".join(f"{value / own:6.2f}" for value, own in zip(least[reference], (clock, busy), strict=True))
        print(f"  {name:22} {clock:8.3f} s   processors {busy:8.3f} s   {reference} takes {ratios} times that")


def dense(found: Pursuit, atoms: int) -> np.ndarray:
    made = np.zeros((len(found.indices), atoms + 1))
    np.put_along_axis(made, found.indices.astype(np.intp), found.coefficients, 1)
    return made[:, :-1]


def omp(repeat: int, slow: bool) -> None:
    device = choose("auto")
    try:
        import spams
    except ImportError:
        spams = None
        print("(SPAMS is not installed)")
    for length, count in ((256, 1024), (64, 128)):
        dice = np.random.default_rng(length)
        atoms, signals = dice.normal(size=(count, length)), dice.normal(size=(SIGNALS, length))
        atoms /= np.linalg.norm(atoms, axis=1)[:, None]
        runs: dict[str, Callable[[], Any]] = {"NumPy": lambda s=signals, a=atoms: pursue(s, a, SPARSITY)}
        if device is not None:
            runs["OpenCL"] = lambda s=signals, a=atoms: pursue(s, a, SPARSITY, device=device)
        if spams is not None:
            # Its matrices hold signals as columns, in Fortran order.
            runs["SPAMS"] = lambda s=signals, a=atoms: spams.omp(s.T, a.T, L=SPARSITY, return_reg_path=False)
        runs["product of matrices"] = lambda s=signals, a=atoms: s @ a.T
        if slow:
            from sklearn.linear_model import orthogonal_mp_gram

            runs["omp, NumPy"] = lambda s=signals, a=atoms: pursue(s, a, SPARSITY, selection="omp")
            runs["omp, scikit-learn"] = lambda s=signals, a=atoms: orthogonal_mp_gram(
                a @ a.T, a @ s.T, n_nonzero_coefs=SPARSITY
            )
        for run in runs.values():
            if run is not runs.get("omp, scikit-learn"):
                run()  # compiles, starts threads
        least, made = measured(runs, repeat)
        print(f"\nomp, n = {SIGNALS}, K = {length}, N = {count}, s = {SPARSITY}")
        report(least, "SPAMS" if spams is not None else "NumPy")
        for name in ("OpenCL", "SPAMS"):
            if name in made:
                other = dense(made[name], count) if name == "OpenCL" else made[name].toarray().T
                apart = np.abs(dense(made["NumPy"], count) - other).max()
                print(f"  greatest difference of a coefficient, NumPy and {name}: {apart:.1e}")


@dataclass(frozen=True)
class Windows(Dictionary):
    """All windows of a map, each less its mean and of norm 1: made when they are asked for."""

    heights: np.ndarray

    @property
    def size(self) -> int:
        return 16

    def atoms(self, which: Any) -> np.ndarray:
        views = np.lib.stride_tricks.sliding_window_view(self.heights, (16, 16))
        rows, cols = np.divmod(np.arange(self.count)[which], views.shape[1])
        cut = views[rows, cols]
        cut = cut - cut.mean(axis=(1, 2), keepdims=True)
        return np.asarray(cut / np.sqrt((cut**2).sum(axis=(1, 2), keepdims=True)), np.float32)


def complete(repeat: int, slow: bool) -> None:
    side, count = 362, 120_000
    dice = np.random.default_rng(3)
    spectrum = 1 / np.maximum(np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)), 1 / side) ** 2
    heights = np.fft.irfft2(spectrum * np.fft.rfft2(dice.normal(size=(side, side))), (side, side)).astype(np.float32)
    dictionary = Windows("weighted", np.zeros(count, np.int32), ("map",), heights)
    signals = 20_000 if slow else 2_000
    samples = dictionary.atoms(dice.integers(0, count, signals)) + dice.normal(0, 0.01, (signals, 16, 16))
    least, made = measured({"search by blocks": lambda: pursue_samples(samples, dictionary, 1)}, min(repeat, 2))
    tracemalloc.start()
    pursue_samples(samples[:500], dictionary, 1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    clock, busy = least["search by blocks"]
    print(f"\ncomplete dictionary, n = {signals}, K = 256, N = {count}, s = 1")
    print(f"  search by blocks: {clock:.2f} s, processors {busy:.2f} s; peak of memory {peak / 2**20:.0f} MiB")
    rate = 2 * signals * count * 208 / clock / 1e9
    print(f"  {rate:.0f} GFLOP/s; mean share of the norm left {np.sqrt(made['search by blocks'].residuals).mean():.3f}")


def learning(repeat: int, slow: bool) -> None:
    """K-SVD beside SPAMS and, with ``--slow``, scikit-learn: from the same atoms, with as many iterations."""
    iterations = 20 if slow else 10
    print(f"\nksvd, terrain.sample_dem as it is, weighted metric, N = 128, {iterations} iterations from the same atoms")
    print("  root mean square error of the patches, m; in brackets that of ols with the dictionary alone")
    heights = sample_dem().data
    ground = Elevation(heights, Extent(0.0, 0.0, float(heights.shape[1]), float(heights.shape[0])))
    for half in (4, 8):
        found = patches(ground, radius=float(half))
        signals = columns(found.samples, "weighted")
        samples = len(signals) * float(mass(2 * half, "weighted").sum())
        first = ksvd(found, atoms=128, sparsity=1, iterations=0).dictionary
        start = columns(first.atoms(slice(None)), "weighted")
        for sparsity in (1, 2, 8):
            runs = peers(signals, start, sparsity, iterations, slow)
            ways = {
                "exact": {},
                "approximate": {"update": "approximate"},
                "coding pursuit": {"coding": "pursuit"},
            }
            for name, way in ways.items():
                options = {"sparsity": sparsity, "iterations": iterations, **way}
                runs[f"ksvd, {name}"] = lambda f=found, d=first, o=options: ksvd(f, d, **o)
            least, made = measured(runs, min(repeat, 1))
            print(f"\n  K = {(2 * half) ** 2}, n = {len(signals)}, s = {sparsity}")
            for name, result in made.items():
                own = name.startswith("ksvd")
                atoms = columns(result.dictionary.atoms(slice(None)), "weighted") if own else result
                alone = np.sqrt(pursue(signals, atoms, sparsity).residuals.sum() / samples)
                error = f"{result.learning.rmse[-1]:7.3f} m ({alone:.3f})" if own else f"{alone:7.3f} m"
                clock, busy = least[name]
                print(f"    {name:24} {error:20} {clock:7.2f} s, processors {busy:7.2f} s")


def peers(
    signals: np.ndarray, start: np.ndarray, sparsity: int, iterations: int, slow: bool
) -> dict[str, Callable[[], np.ndarray]]:
    """Return what else learns a dictionary of sums of at most s atoms; each gives atoms of norm 1."""
    runs: dict[str, Callable[[], np.ndarray]] = {}
    try:
        import spams
    except ImportError:
        print("(SPAMS is not installed)")
    else:
        given = {"mode": 3, "lambda1": sparsity, "iter": iterations, "numThreads": -1, "verbose": False}
        columns_first, atoms_first = np.asfortranarray(signals.T), np.asfortranarray(start.T)
        for name, batch in (("SPAMS, batch", True), ("SPAMS, online", False)):
            # An iteration sees all signals: as many as one of K-SVD.
            more = {"batch": batch, "batchsize": len(signals)}
            runs[name] = lambda m=more: unit(spams.trainDL(columns_first, D=atoms_first, **given, **m).T)
    if slow:
        from sklearn.decomposition import DictionaryLearning

        learner = DictionaryLearning(
            len(start), max_iter=iterations, fit_algorithm="lars", transform_algorithm="omp", dict_init=start,
            transform_n_nonzero_coefs=sparsity, alpha=float(np.abs(signals @ start.T).max() / 20), random_state=0,
        )  # fmt: skip
        runs["scikit-learn (l1)"] = lambda: unit(learner.fit(signals).components_)
    return runs


def unit(atoms: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(atoms, axis=1)
    return np.asarray(atoms[norms > 0] / norms[norms > 0, None])


def amplify(repeat: int, slow: bool) -> None:  # noqa: ARG001
    dice = np.random.default_rng(2)
    relief = gaussian_filter(dice.normal(size=(32, 32)), 2.0)
    start = (600 + 400 * relief / np.abs(relief).max()).astype(np.float32)
    ground = reproject(sample_dem(), cell_size=80.0)
    cells, factor, steps = 4, 4, 4

    def learned() -> MultiresolutionDictionary:
        pieces = patches(ground, cells=cells * factor)
        windows = exemplar_dictionary(ground, cells=cells, factor=factor, stride=4, relief=15.0)
        chosen = constrained_ksvd(pieces, windows, atoms=256, sparsity=1, iterations=10)
        return multiresolution_dictionary(chosen.dictionary, factor=factor)

    def complete() -> MultiresolutionDictionary:
        options: Any = {"atoms": 120_000, "stride": 2, "symmetries": True, "relief": 15.0}
        windows = exemplar_dictionary(ground, cells=cells, factor=factor, **options)
        return multiresolution_dictionary(windows, factor=factor)

    cases = [("learned", learned, "27 s and 30 s")]
    cases += [("complete", complete, "84 s")] if slow else []
    print(f"\namplify, {start.shape} by {steps} steps of {factor}, R = {cells} cells, s = 1")
    for name, make, paper in cases:
        least, made = measured({"dictionary": make}, 1)
        atoms = made["dictionary"]
        surface = Elevation(start, Extent(0.0, 0.0, 40960.0, 40960.0))
        clock, busy = time.perf_counter(), time.process_time()
        for _ in range(steps):
            surface = by_tiles(surface, atoms, cells, factor)
        taken = time.perf_counter() - clock, time.process_time() - busy
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        side = surface.shape[0] // len(start)
        reduced = surface.data.reshape(32, side, 32, side).mean(axis=(1, 3), dtype=np.float64)
        away = np.abs(reduced - start).max() / np.ptp(start)
        print(f"  {name}, N = {atoms.low.count:,}: {surface.shape[0]:,} x {surface.shape[1]:,} cells")
        print(f"    amplification {taken[0]:6.1f} s, processors {taken[1]:6.1f} s   (paper: {paper} of learning)")
        print(f"    dictionary    {least['dictionary'][0]:6.1f} s, processors {least['dictionary'][1]:6.1f} s")
        print(f"    peak of memory so far {peak:.2f} GiB; reduced again, {away:.2%} of the range away at most")


def by_tiles(
    coarse: Elevation, atoms: MultiresolutionDictionary, cells: int, factor: int, tile: int = 512
) -> Elevation:
    """Return a terrain amplified as graphs/sparse/rebuild.json does, window by window."""
    rows, cols = coarse.shape
    fine = np.empty((factor * rows, factor * cols), np.float32)
    beyond = 4 * cells
    for top in range(0, rows, tile):
        for left in range(0, cols, tile):
            # Windows begin on multiples of R, so that their discs are those of the whole terrain.
            north, west = max(0, top - beyond), max(0, left - beyond)
            window = coarse.window(slice(north, top + tile + beyond), slice(west, left + tile + beyond))
            made = rebuilt(window, atoms, cells, factor)
            down, right = factor * (top - north), factor * (left - west)
            high, wide = (factor * min(tile, side - at) for side, at in ((rows, top), (cols, left)))
            place = slice(factor * top, factor * top + high), slice(factor * left, factor * left + wide)
            fine[place] = made.data[down : down + high, right : right + wide]
    return Elevation(fine, coarse.extent)


def rebuilt(coarse: Elevation, atoms: MultiresolutionDictionary, cells: int, factor: int) -> Elevation:
    code = sparse_omp(patches(coarse, cells=cells), atoms.low, sparsity=1, nonnegative=True)
    function = sparse_terrain(atoms.high, code, contrast=1.2, exaggeration=2.0)
    shape = factor * coarse.shape[0], factor * coarse.shape[1]
    device = choose("auto")
    if device is None:
        surface = sample(function, extent=astuple(coarse.extent)[:4], rows=shape[0], columns=shape[1]).surface
    else:
        heights, _ = sample_on_device(function, coarse.extent, shape, device, Context(), heaviest=1.0)
        surface = Elevation(to_host(heights), coarse.extent)
    for _ in range(2):
        rest = coarse.like(coarse.data - resample(surface, coarse, method="area").data)
        surface = surface.like(surface.data + resample(rest, surface).data)
    return surface


PARTS: dict[str, Callable[[int, bool], None]] = {
    "omp": omp, "complete": complete, "ksvd": learning, "amplify": amplify, "quality": quality,
    "inverse": inverse,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=[*PARTS, "all"], default="all")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--slow", action="store_true", help="also what takes more than ten seconds")
    chosen = parser.parse_args()
    device = choose("auto")
    print(f"OpenCL: {device.info if device else 'no device'}")
    for name, part in PARTS.items():
        if chosen.part in (name, "all"):
            part(chosen.repeat, chosen.slow)


if __name__ == "__main__":
    main()
