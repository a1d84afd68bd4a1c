"""How good sparse terrains are: the parts ``quality`` and ``inverse`` of ``sparse.py``.

Beside the sample of matplotlib stand SRTM tiles from ``../shared/data``, where that is: a 512 x 512 piece of the Alps
(46 N, 8 E), one of the Andes (33 S, 71 W), and the four tiles around Everest in one, 2401 x 2401.  Their cells stay
as they are, 3" and counted as 1 m, so that nothing is smoothed; voids are filled by a membrane.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nodegraph import Context
from nodegraph_sparse.container import Precision, packed, unpacked
from nodegraph_sparse.dictionary import Dictionary, Patches, SparseCode
from nodegraph_sparse.ksvd import ksvd
from nodegraph_sparse.metric import Metric
from nodegraph_sparse.noise_dictionary import dictionary_from_noise
from nodegraph_sparse.omp import omp
from nodegraph_sparse.patches import patches
from nodegraph_sparse.rivals import fewer_cells, jpeg2000
from nodegraph_sparse.save_sparse import only_used
from nodegraph_sparse.sparse_raster import blended
from nodegraph_sparse.sparse_statistics import compared, described
from nodegraph_terrain.load import load_elevation
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.sample_dem import sample_dem
from nodegraph_terrain.voids import fill_voids

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
TILES = {
    "Alps": (("alps_N46E008/N46E008.tif",), (slice(602, 1114), slice(86, 598))),
    "Andes": (("andes_S33W071/S33W071.tif",), (slice(400, 912), slice(300, 812))),
    "Everest": (tuple(f"everest/N{north}E{east}.hgt" for north in (28, 27) for east in ("086", "087")), None),
}

LEARNED_FROM = 20_000
"""Patches at most; of a larger terrain as many at random places."""

FILE = Precision(10, 14, 8)
"""Bits of coefficients, means and samples of atoms."""

TABLE_1 = {
    "Alps": ("Alpes, 512 x 512", ((1, 14.9, 23.7), (2, 20.0, 26.4), (8, 50.9, 31.1))),
    "Everest": ("Italy, 3600 x 3600; JPEG 2000 at 4.9 %: 20 dB", ((1, 4.9, 31.7), (2, 9.7, 34.2), (8, 38.0, 39.2))),
}
"""Guérin 2016, table 1 and section 5.1, N = 128: s, rho in % and PSNR in dB, of its terrains most like ours."""


def grounds(names: tuple[str, ...], part: bool = True) -> Iterator[tuple[str, Elevation]]:
    """Yield terrains in square cells of 1 m, or say which are not there; without `part` whole tiles."""
    yield "Jacksboro", in_cells(sample_dem().data)
    for name in names:
        files, piece = TILES[name]
        paths = tuple(DATA / file for file in files)
        if not all(path.exists() for path in paths):
            print(f"\n(no data of {name}: {paths[0]} is not there)")
            continue
        whole = load_elevation(path=paths)
        heights = fill_voids(whole).data
        yield name, in_cells(heights[piece] if piece and part else heights)


def in_cells(heights: np.ndarray) -> Elevation:
    return Elevation(np.ascontiguousarray(heights, np.float32), Extent(0.0, 0.0, *map(float, heights.shape[::-1])))


def reduced(surface: Elevation, factor: int) -> Elevation:
    """Return the means of factor by factor cells."""
    rows, cols = (side // factor for side in surface.shape)
    cut = surface.data[: rows * factor, : cols * factor].astype(np.float64)
    return in_cells(cut.reshape(rows, factor, cols, factor).mean(axis=(1, 3)))


def psnr(surface: Elevation, dictionary: Dictionary, code: SparseCode) -> float:
    return compared(blended(dictionary, code, Context()), surface.data).psnr


def learned(surface: Elevation, half: int, sparsity: int, metric: Metric) -> tuple[Dictionary, SparseCode]:
    """Return 128 atoms learned by 10 iterations, and the code of the whole terrain."""
    every = patches(surface, cells=half, metric=metric)
    if every.samples.shape[0] <= LEARNED_FROM:
        found = ksvd(every, atoms=128, sparsity=sparsity, iterations=10)
        return found.dictionary, found.code
    some = patches(surface, cells=half, metric=metric, count=LEARNED_FROM)
    dictionary = ksvd(some, atoms=128, sparsity=sparsity, iterations=10, coding="pursuit").dictionary
    return dictionary, omp(every, dictionary, sparsity=sparsity)


def quality(repeat: int, slow: bool) -> None:  # noqa: ARG001
    """PSNR, values and bytes of learned terrain, beside JPEG 2000 and fewer cells in the bytes of the file."""
    print("\nquality, N = 128, 10 iterations; PSNR in dB; rho = t(s, N) / t0, t = K N + n (2 s + 2) + 1")
    print("  `file`: 10, 14 and 8 bits a coefficient, mean and sample; `JPEG 2000` and `fewer cells`: in its bytes")
    for name, surface in grounds(("Alps", "Everest")):
        rows, cols = surface.shape
        high = float(np.ptp(surface.data))
        metres = 20 * np.log10(high * 12**0.5)
        print(f"\n  {name}, {rows:,} x {cols:,} cells, {high:,.0f} m high in whole metres, which is {metres:.1f} dB")
        print(
            "     K       n  s  weighted  plain   t(s, N)     rho  file: bytes bits/cell   PSNR  JPEG 2000  fewer cells"
        )
        for half in (4, 5, 8) if rows * cols < 1 << 20 or slow else (5,):
            for sparsity in (1, 2, 8):
                dictionary, code = learned(surface, half, sparsity, "weighted")
                plain = psnr(surface, *learned(surface, half, sparsity, "plain"))
                full = described(dictionary, code, surface, Precision(), Context())
                kept = unpacked(packed(*only_used(dictionary, code), FILE), "file")
                file = described(*kept, surface, FILE, Context())
                others = jpeg2000(surface.data, file.bytes, Context()), fewer_cells(surface.data, file.bytes)
                wavelets, cubic = (np.nan if item is None else compared(item[1], surface.data).psnr for item in others)
                print(
                    f"  {full.samples:4} {full.patches:7,}  {sparsity}  {full.psnr:8.2f} {plain:6.2f} {full.values:9,} "
                    f"{full.ratio:7.1%}  {file.bytes:12,} {8 * file.bytes / surface.data.size:10.2f} {file.psnr:6.2f} "
                    f"{wavelets:10.2f} {cubic:12.2f}",
                    flush=True,
                )
        if name in TABLE_1:
            title, table = TABLE_1[name]
            rows_of_it = "; ".join(f"s = {s}: rho {ratio} %, {value} dB" for s, ratio, value in table)
            print(f"  Guérin 2016, table 1, {title}: {rows_of_it}")


def inverse(repeat: int, slow: bool) -> None:  # noqa: ARG001
    """PSNR of terrain as functions: three sums of eight noises, one noise of Perlin's, and the means of discs alone."""
    print(
        "\ninverse, R = 5 cells (K = 100), N = 1,024, s = 1; PSNR in dB; cells as measured, and means of 4 x 4 and more"
    )
    print("  means: no functions at all; sums of eight noises, each half or 0.35 times as high as the one before:")
    print("  (m)ultifractal ridged, (r)idged, (P)erlin; one noise of Perlin's alone, on a lattice of 0.41 to 16 R")
    print("  figure 8 of Guérin 2016: ridged multifractal 24.9, Perlin 20.0; how many noises and how fine is not said")
    sums = [("m", "ridged_multifractal"), ("r", "ridged"), ("P", "perlin")]
    columns: list[tuple[str, dict[str, Any]]] = [
        (f"{short} {gain:g}", {"kind": kind, "gain": gain}) for gain in (0.5, 0.35) for short, kind in sums
    ]
    columns += [
        (f"{wide:g} R", {"kind": "perlin", "octaves": 1, "variety": 0.0, "wavelength": wide})
        for wide in (0.41, 0.5, 1.0, 2.0, 4.0, 16.0)
    ]
    title = "".join(f"{name:>7}" for name in ("means", *(name for name, _ in columns)))
    for name, surface in grounds(("Alps", "Andes", "Everest"), part=False):
        print(f"\n  {name:32}{title}")
        for factor in (1, 4, 10):
            cells = reduced(surface, factor)
            if max(cells.shape) > 601 and not slow:
                cells = in_cells(cells.data[-512:, :512])
            for metric, upright in (("plain", False), ("plain", True), ("weighted", False)):
                every = patches(cells, cells=5, metric=metric)
                found = [alone(cells, every)]
                for _, params in columns:
                    functions = dictionary_from_noise(every, **params)
                    found.append(psnr(cells, functions, omp(every, functions, sparsity=1, nonnegative=upright)))
                what = f"{cells.shape[0]} x {cells.shape[1]}, {factor:2}: {metric}{', x >= 0' if upright else ''}"
                print(f"    {what:30}" + "".join(f"{value:7.2f}" for value in found), flush=True)


def alone(surface: Elevation, every: Patches) -> float:
    """Return the PSNR of the means of patches without any atoms."""
    functions = dictionary_from_noise(every, atoms=1)
    code = omp(every, functions, sparsity=1)
    return psnr(surface, functions, replace(code, coefficients=np.zeros_like(code.coefficients)))
