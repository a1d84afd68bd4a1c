"""Sphere tracing the construction trees of the gallery: with local bounds beside one bound for all of a scene.

All of one run, on the device that `auto` chooses.  Each scene of `graphs/tree` is looked at from the south, from above
its highest point.  `bounds` is the time for the quadtree, `programs` for those of its leaves, `frame` for the rays of
one picture with their normals, and `cpu` what the processor did of that (other work may share it); calls are
evaluations of f, four for the normal of each hit among them.

With `--every k` one in k of the groups of eight neighbouring rays that a work item follows is traced, spread evenly by
chance, and with `--plain-every k`, which is 64 by default, of plain; seconds and calls are k times what was measured.
Means and percentiles are those of the rays that were followed; `ratio` is that of mean steps on the same rays, beside
that of the 99th percentiles.

    uv run python benchmarks/sphere_tracing.py [--rows 1080] [--every 1] [--plain-every 64] [--graphs graphs/tree]

Table 1 of Génevaux 2015 (doi:10.1111/cgf.12530) has 36 to 561 ms and 50 to 79 million calls of f for a frame of its
scenes, 1920 x 1080, on a GTX 670.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from nodegraph import Context, Graph
from nodegraph.cache import Cache
from nodegraph.opencl import Device, choose
from nodegraph_render.camera import Camera
from nodegraph_render.outlook import outlook
from nodegraph_render.tracers import Method
from nodegraph_render.tree_tracer import LANES, tree_tracer
from nodegraph_tree.function import Box, ElevationFunction

METHODS: tuple[Method, Method] = ("accelerated", "plain")


def scenes(folder: Path) -> Iterator[tuple[str, ElevationFunction, Box]]:
    """Yield name, lowest surface and extent of the scene of each graph that samples one."""
    for path in sorted(folder.glob("*.json")):
        nodes = json.loads(path.read_text())["nodes"].values()
        sampled = next((node for node in nodes if node["type"] in ("tree.sample", "tree.sample_layer")), None)
        if sampled is None:
            continue
        source = sampled["inputs"].get("function") or sampled["inputs"]["layers"]
        found = Graph.load(path).run([source], cache=Cache(None))[source]
        function = found if isinstance(found, ElevationFunction) else found.functions[0]
        yield path.stem, function, Box(*sampled["params"]["extent"])


def view(function: ElevationFunction, box: Box) -> Camera:
    """Return a camera south of a scene."""
    bounds, side = function.bounds(box), box.east - box.west
    x, y = (box.west + box.east) / 2, (box.south + box.north) / 2
    eye = (x - 0.1 * side, box.south - 0.35 * side, bounds.high + 0.22 * side)
    return Camera(eye, (x, y - 0.05 * side, bounds.low))


def sampled(count: int, every: int) -> np.ndarray:
    """Return the numbers of one in `every` of so many rays, in groups; those of a larger `every` are among them."""
    groups = np.random.default_rng(0).permutation(-(-count // LANES))
    chosen = np.sort(groups[: max(1, len(groups) // every)])
    numbers = (chosen[:, None] * LANES + np.arange(LANES)).ravel()
    return numbers[numbers < count]


def measure(
    name: str, function: ElevationFunction, box: Box, device: Device, rows: int, every: dict[Method, int]
) -> None:
    """Print the figures of a scene."""
    camera, cols = view(function, box), rows * 16 // 9
    rays = camera.rays(rows, cols)
    known = np.zeros(len(rays), np.int32)
    for method in METHODS:
        started = time.perf_counter()
        tree = outlook(function, camera, tuple(box), None, Context(), rows)
        bounded = time.perf_counter()
        tracer = tree_tracer(function, tree, camera.eye, device, Context(), method=method)
        prepared = time.perf_counter()
        tracer(camera.rays(9, 16))  # compiles
        numbers = sampled(len(rays), every[method])
        fewer = replace(rays, direction=rays.direction[numbers])
        ready, busy = time.perf_counter(), time.process_time()
        hits = tracer(fewer)
        seconds, work = time.perf_counter() - ready, time.process_time() - busy
        times = len(rays) / len(hits.steps)
        calls = (hits.steps.sum() + 4 * np.sum(hits.layer == 0)) / 1e6 * times
        ratio = ""
        if method == "accelerated":
            known[numbers] = hits.steps
        else:
            few, many = ((item.mean(), np.percentile(item, 99)) for item in (known[numbers], hits.steps))
            ratio = f"{few[0] / many[0]:8.2f}{few[1] / many[1]:8.2f}"
        print(
            f"{name:18}{method:>13}{bounded - started:10.2f}{prepared - bounded:10.2f}"
            f"{seconds * times:9.2f}{work * times:9.2f}"
            f"{hits.steps.mean():8.1f}{np.percentile(hits.steps, 99):7.0f}{calls:9.1f}{ratio}",
            flush=True,
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1080)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--plain-every", type=int, default=64)
    parser.add_argument("--scene", default="", help="only this one")
    parser.add_argument("--graphs", type=Path, default=Path(__file__).resolve().parents[1] / "graphs/tree")
    options = parser.parse_args()
    device = choose("auto")
    if device is None:
        print("no OpenCL device; install pyopencl[pocl]", file=sys.stderr)
        return 2
    rows = options.rows
    every: dict[Method, int] = {"accelerated": options.every, "plain": max(options.every, options.plain_every)}
    print(
        f"{device.info}, pictures of {rows * 16 // 9} x {rows}, 1 ray of "
        f"{every['accelerated']}, of plain {every['plain']}\n"
    )
    print(
        f"{'scene':18}{'method':>13}{'bounds s':>10}{'programs':>10}{'frame s':>9}{'cpu s':>9}"
        f"{'steps':>8}{'p99':>7}{'Mcalls':>9}"
        f"{'ratio':>8}{'of p99':>8}"
    )
    for name, function, box in scenes(options.graphs):
        if options.scene in ("", name):
            measure(name, function, box, device, rows, every)
    return 0


if __name__ == "__main__":
    sys.exit(main())
