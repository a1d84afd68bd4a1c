"""Terrain meshes: greedy insertion beside pydelatin, the adaptive mesh beside the plain one, all of one run.

Times and triangle counts at equal stated errors, on the sample elevation model (Jacksboro fault) and, where
``../shared/data`` exists, on 1024 x 1024 cells of an SRTM tile of the Alps.  The stated error is a share of the range
of heights; every mesh is held against all samples.

    uv run --group bench python benchmarks/mesh.py [--repeat 3]
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from nodegraph import Context
from nodegraph.opencl import choose
from nodegraph_render.mesh_adaptive import mesh_adaptive
from nodegraph_render.mesh_grid import mesh_grid
from nodegraph_render.mesh_tin import mesh_tin
from nodegraph_terrain.load import load_elevation
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.sample_dem import sample_dem
from nodegraph_terrain.voids import fill_voids

ALPS = Path(__file__).resolve().parents[2] / "shared" / "data" / "alps_N46E008" / "N46E008.tif"
SHARES = (0.05, 0.02, 0.01)
CELL = 90.0


def timed(work: Callable[[], Any], repeat: int) -> tuple[Any, float]:
    """Return the result and the median time, s, after one call that does not count."""
    result, times = work(), []
    for _ in range(repeat):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return result, statistics.median(times)


def in_metres(heights: np.ndarray) -> Elevation:
    rows, cols = heights.shape
    return Elevation(np.ascontiguousarray(heights), Extent(0, 0, cols * CELL, rows * CELL))


def surfaces() -> dict[str, Elevation]:
    found = {"Jacksboro": in_metres(sample_dem().data)}
    if ALPS.is_file():
        tile = load_elevation(path=ALPS)
        known = np.where(tile.data < -1000, np.float32(np.nan), tile.data)
        found["Alps"] = in_metres(fill_voids(tile.like(known)).data[:1024, :1024])
    return found


def triangles_of_delatin(surface: Elevation, error: float) -> np.ndarray:
    from pydelatin import Delatin

    return Delatin(surface.data, max_error=error).triangles


def distance(mesh: Any, surface: Elevation) -> float:
    """Return the greatest vertical distance of all samples, by matplotlib's interpolation."""
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    rows, cols = surface.shape
    x, y = mesh.vertices[:, 0] / CELL - 0.5, mesh.vertices[:, 1] / CELL - 0.5
    plane = LinearTriInterpolator(Triangulation(np.rint(x), np.rint(y), mesh.triangles), mesh.vertices[:, 2])
    i, j = np.mgrid[0:rows, 0:cols]
    return float(np.abs(plane(j.ravel(), (rows - 1 - i).ravel()) - surface.data.ravel()).max())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    if find_spec("pydelatin") is None:
        print("pydelatin is missing; install the dependency group bench", file=sys.stderr)
        return 2
    device = choose("auto")
    print(f"medians of {options.repeat}; device: {device.info if device else 'none'}\n")
    print(
        f"{'surface':10}{'cells':>9}{'error':>8}{'m':>6} | {'delatin':>8}{'s':>7} | {'tin':>8}{'ratio':>7}{'s':>7}"
        f"{'ratio':>7}{'dev s':>7}{'ratio':>7} | {'adaptive':>9}{'of grid':>9}{'s':>7}{'dev s':>7}"
    )
    for name, surface in surfaces().items():
        plain = len(mesh_grid(surface).triangles)
        for share in SHARES:
            error = share * float(np.ptp(surface.data))
            theirs, their_time = timed(partial(triangles_of_delatin, surface, error), options.repeat)
            tin, host = timed(partial(mesh_tin, surface, error=error), options.repeat)
            adaptive, host_adaptive = timed(partial(mesh_adaptive, surface, error=error), options.repeat)
            fast = fast_adaptive = float("nan")
            if device is not None:
                # The functions themselves, with a device: what a run calls, less handing over the raster.
                given = {"error": error, "context": Context(device=device)}
                _, fast = timed(partial(mesh_tin, surface, **given), options.repeat)
                _, fast_adaptive = timed(partial(mesh_adaptive, surface, **given), options.repeat)
            for mesh in (tin, adaptive):
                assert distance(mesh, surface) <= error * (1 + 1e-6)
            print(
                f"{name:10}{surface.data.size:9}{share:8.0%}{error:6.0f} | {len(theirs):8}{their_time:7.3f} |"
                f" {len(tin.triangles):8}{len(tin.triangles) / len(theirs):7.3f}{host:7.3f}{host / their_time:7.1f}"
                f"{fast:7.3f}{fast / their_time:7.1f} | {len(adaptive.triangles):9}"
                f"{len(adaptive.triangles) / plain:9.1%}{host_adaptive:7.3f}{fast_adaptive:7.3f}"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
