"""Sphere tracing the construction trees of the gallery: with local bounds beside one bound for all of a scene.

All of one run, on the device that `auto` chooses.  Each scene of `graphs/tree` is looked at from the south, from above
its highest point.  `prepare` is the quadtree of bounds and the programs of its leaves, `frame` the rays of one picture
with their normals; calls are evaluations of f, four for the normal of each hit among them.

    uv run python benchmarks/sphere_tracing.py [--rows 270] [--graphs graphs/tree]

Table 1 of Génevaux 2015 (doi:10.1111/cgf.12530) has 36 to 561 ms and 50 to 79 million calls of f for a frame of its
scenes, 1920 x 1080, on a GTX 670.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from nodegraph import Context, Graph
from nodegraph.cache import Cache
from nodegraph.opencl import choose
from nodegraph_render.camera import Camera
from nodegraph_render.outlook import outlook
from nodegraph_render.tracers import Method
from nodegraph_render.tree_tracer import tree_tracer
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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1080)
    parser.add_argument("--graphs", type=Path, default=Path(__file__).resolve().parents[1] / "graphs/tree")
    options = parser.parse_args()
    device = choose("auto")
    if device is None:
        print("no OpenCL device; install pyopencl[pocl]", file=sys.stderr)
        return 2
    rows, cols = options.rows, options.rows * 16 // 9
    print(f"{device.info}, pictures of {cols} x {rows}\n")
    print(f"{'scene':18}{'method':>13}{'prepare s':>11}{'frame s':>9}{'steps':>8}{'p99':>7}{'Mcalls':>9}{'ratio':>8}")
    for name, function, box in scenes(options.graphs):
        camera, steps = view(function, box), {}
        rays = camera.rays(rows, cols)
        for method in METHODS:
            started = time.perf_counter()
            tree = outlook(function, camera, tuple(box), None, Context(), rows)
            tracer = tree_tracer(function, tree, camera.eye, device, Context(), method=method)
            prepared = time.perf_counter()
            tracer(camera.rays(9, 16))  # compiles
            ready = time.perf_counter()
            hits = tracer(rays)
            ended = time.perf_counter()
            steps[method] = hits.steps.mean()
            calls = (hits.steps.sum() + 4 * np.sum(hits.layer == 0)) / 1e6
            ratio = f"{steps['accelerated'] / steps['plain']:8.2f}" if method == "plain" else ""
            print(
                f"{name:18}{method:>13}{prepared - started:11.2f}{ended - ready:9.2f}{steps[method]:8.1f}"
                f"{np.percentile(hits.steps, 99):7.0f}{calls:9.1f}{ratio}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
