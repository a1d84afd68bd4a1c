"""Sampling construction trees: OpenCL beside vectorised NumPy, pruned beside unpruned, many primitives beside few.

All of one run, on the device that `auto` chooses.  The scenes have as many primitives and operators as those of Table 1
of Génevaux 2015 (doi:10.1111/cgf.12530), whose times on a GTX 670 stand beside ours: they are for meshes of 5 to 80
million calls of f, not for one picture, so compare the rates.  A call is one primitive at one sample.

    uv run --group bench python benchmarks/tree.py [--size 1024] [--repeat 3]
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from nodegraph import Context, port_type
from nodegraph.opencl import Device, choose, to_host
from nodegraph_terrain.raster import Extent
from nodegraph_tree.affine import Affine
from nodegraph_tree.blend import blend
from nodegraph_tree.carve import Carve
from nodegraph_tree.device import Emitter, Fill, Frame, Kernel, sample_on_device
from nodegraph_tree.disc import Disc, NoiseField, Relief
from nodegraph_tree.evaluate import sample_grid
from nodegraph_tree.function import EVERYWHERE, ElevationFunction
from nodegraph_tree.replace import replace
from nodegraph_tree.statistics import tree_statistics

TABLE_1 = {
    "figure 1": (2000.0, 70, 9, 5, 14),
    "figure 3": (1000.0, 20, 3, 5, 6),
    "figure 19": (200_000.0, 15, 3, 20, 25),
    "figure 20": (2000.0, 78, 10, 20, 80),
    "figure 21": (100_000.0, 50, 25, 80, 600),
    "figure 22": (600.0, 148, 9, 80, 560),
}
"""Scene: side (m), primitives, operators, and the paper's calls of f (millions) and time (ms) for a regular mesh."""


def scene(
    side: float, primitives: int, operators: int, *, cover: float = 10.0, seed: int = 0, disc: type[Disc] = Disc
) -> ElevationFunction:
    """Return discs of noise that cover a square `cover` times, joined by operators of several kinds."""
    dice = np.random.default_rng(seed)
    radius = float(np.sqrt(cover * side * side / primitives / np.pi))
    leaves: list[ElevationFunction] = []
    for number in range(primitives - 1):
        x, y = dice.uniform(0, side, 2).tolist()
        relief = Relief("ridged" if number % 3 == 0 else "fbm", 0.05 * radius, radius, seed=number)
        size, height = radius * float(dice.uniform(0.7, 1.3)), float(dice.uniform(0, 0.1 * radius))
        leaves.append(disc(x, y, size, height, relief))
    ground: ElevationFunction = NoiseField(0.0, 0.0, 0.0, Relief("fbm", 0.02 * side, side / 3, seed=seed))
    parts = np.array_split(np.arange(len(leaves)), max(1, operators // 2))
    for number, part in enumerate(parts):
        group = blend([leaves[index] for index in part])
        ground = Carve(ground, group) if number % 3 == 2 else replace(ground, [group])
    return ground


def median_seconds(work: Callable[[], object], repeat: int) -> float:
    return medians([work], repeat)[0]


def medians(works: Sequence[Callable[[], object]], repeat: int) -> list[float]:
    """Return the median seconds of each, in turns, so that what else the machine does meets all of them alike."""
    times: list[list[float]] = [[] for _ in works]
    for number in range(repeat + 1):
        for work, found in zip(works, times, strict=True):
            started = time.perf_counter()
            work()
            if number:  # the first time it may compile
                found.append(time.perf_counter() - started)
    return [statistics.median(found) for found in times]


def on_device(root: ElevationFunction, extent: Extent, size: int, device: Device) -> Callable[[], object]:
    return lambda: to_host(sample_on_device(root, extent, (size, size), device, Context())[0])


def on_host(root: ElevationFunction, extent: Extent, size: int) -> Callable[[], object]:
    return lambda: [part.height for _, part in sample_grid(root, extent, (size, size), Context())]


UNPRUNED = {
    "every f": "every primitive's f and weight at every sample: what a tree costs without any bounds",
    "own support": "every primitive is asked at every sample, but leaves f out where its own weight is 0: no hierarchy",
}


class Unpruned(Affine):
    """A tree of which every tile gets the whole program (an identity transform that hides where the tile is)."""

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        self.operand.emit(emitter, frame._replace(box=EVERYWHERE, block=None))


@port_type
class EagerDisc(Disc):
    """A disc whose noise is computed wherever it is asked."""

    @property
    def single(self) -> tuple[Kernel, Fill]:
        return Kernel("tree_disc_eager", Path(__file__).with_name("tree_unpruned.cl")), super().single[1]


def discs(count: int, side: float, cover: float) -> list[ElevationFunction]:
    dice = np.random.default_rng(3)
    radius = float(np.sqrt(cover * side * side / count / np.pi))
    relief = Relief("fbm", 0.05 * radius, radius)
    return [Disc(float(x), float(y), radius, 0.0, relief) for x, y in dice.uniform(0, side, (count, 2))]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    device = choose("auto")
    if device is None:
        print("no OpenCL device; install pyopencl[pocl]", file=sys.stderr)
        return 2
    size, samples = options.size, options.size**2 / 1e6
    print(f"{device.info}, {size} x {size} samples, medians of {options.repeat}\n")
    print(
        f"{'scene':12}{'primitives':>11}{'operators':>11}{'bytes':>9}{'ms':>9}"
        f"{'Msamples/s':>12}{'Mcalls':>10}{'Mcalls/s':>10}{'paper Mcalls/s':>16}"
    )
    for name, (side, primitives, operators, million, milliseconds) in TABLE_1.items():
        root, extent = scene(side, primitives, operators), Extent(0, 0, side, side)
        seconds = median_seconds(on_device(root, extent, size, device), options.repeat)
        known = tree_statistics(root, extent=(0, 0, side, side), rows=size, columns=size)
        asked = known.calls_per_sample * samples
        print(
            f"{name:12}{known.primitives:11}{known.operators:11}{known.bytes:9}{seconds * 1e3:9.0f}"
            f"{samples / seconds:12.2f}{asked:10.1f}{asked / seconds:10.0f}{1e3 * million / milliseconds:16.0f}"
        )

    side, primitives, operators, _, _ = TABLE_1["figure 22"]
    root, extent = scene(side, primitives, operators), Extent(0, 0, side, side)
    fast = median_seconds(on_device(root, extent, size, device), options.repeat)
    slow = median_seconds(on_host(root, extent, size), 1)
    print(f"\n148 primitives: OpenCL {fast * 1e3:.0f} ms, NumPy {slow * 1e3:.0f} ms: {slow / fast:.1f} times")

    works = [on_device(scene(side, primitives, operators, cover=2.0), extent, size, device)]
    for disc in (EagerDisc, Disc):
        whole = Unpruned(scene(side, primitives, operators, cover=2.0, disc=disc), (1.0, 0.0, 0.0, 1.0), (0.0, 0.0))
        works.append(on_device(whole, extent, size, device))
    pruned, *unpruned = medians(works, options.repeat)
    print(f"148 primitives that overlap twice: pruned {pruned * 1e3:.0f} ms, of which unpruned takes")
    for (name, what), full in zip(UNPRUNED.items(), unpruned, strict=True):
        print(f"  {name:12}{full * 1e3:6.0f} ms, {full / pruned:5.1f} times: {what}")
    # The ground and, with an overlap of 2, two discs a sample.
    ground = NoiseField(0.0, 0.0, 0.0, Relief("fbm", 0.02 * side, side / 3))
    bare = 3 * median_seconds(on_device(ground, extent, size, device), options.repeat)
    print(f"  three noises everywhere, which nothing can spare, take {bare * 1e3:.0f} ms")

    extent = Extent(0, 0, 1000, 1000)
    few = median_seconds(on_device(blend(discs(100, 1000.0, 4.0)), extent, size, device), options.repeat)
    many = median_seconds(on_device(blend(discs(10_000, 1000.0, 4.0)), extent, size, device), options.repeat)
    print(f"equal overlap: 100 discs {few * 1e3:.0f} ms, 10,000 discs {many * 1e3:.0f} ms: {many / few:.1f} times")
    return 0


if __name__ == "__main__":
    sys.exit(main())
