"""Solvers of the hydrology nodes beside their peers, in the same run.

`hydrology.diffuse` on 50 scattered points and on a skeleton of winding lines, to 1e-4 of the range, on NumPy and on
OpenCL, beside pyamg (Ruge-Stuben hierarchy and conjugate gradients, assembly included) and beside the paper's 5,500
Jacobi steps on the same device; twice the side; and `hydrology.poisson_blend`'s rectangle beside SciPy's transforms,
at sizes that suit an FFT and at some that do not; `hydrology.ridges` of the paper's number of nodes; and the whole
way from drawn lines to terrain (graphs/hydrology/*.json) beside what the paper reports of it.
Errors are to the same node at a tolerance of 1e-6.

    uv run --group bench python benchmarks/hydrology.py [--size 1024] [--repeat 3]

Runs alternate; figures are of the fastest one.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nodegraph import Context, Graph
from nodegraph.cache import Cache
from nodegraph.opencl import choose, to_device, to_host
from nodegraph_hydrology import poisson
from nodegraph_hydrology.diffuse import diffuse
from nodegraph_hydrology.poisson_blend import poisson_blend
from nodegraph_hydrology.ridges import ridges
from nodegraph_hydrology.river_heights import river_heights
from nodegraph_hydrology.river_network import river_network
from nodegraph_hydrology.topology import reach_lengths
from nodegraph_hydrology.watersheds import sites_of
from nodegraph_terrain.polylines import Polylines
from nodegraph_terrain.raster import Elevation, Extent

GRAPHS = Path(__file__).parents[1] / "graphs" / "hydrology"
TOLERANCE = 1e-4
PYAMG_TOLERANCE = 1e-5
"""Of its residual: the loosest power of ten that keeps the error below `TOLERANCE`."""


def scattered(size: int) -> np.ndarray:
    dice = np.random.default_rng(1)
    data = np.full((size, size), np.nan, np.float32)
    data.flat[dice.choice(size * size, 50, replace=False)] = dice.uniform(0, 1000, 50)
    return data


def skeleton(size: int) -> np.ndarray:
    dice = np.random.default_rng(2)
    data = np.full((size, size), np.nan, np.float32)
    for _ in range(60):
        heading = dice.uniform(0, 2 * np.pi) + np.cumsum(dice.normal(0, 0.15, size // 3))
        y = (dice.uniform(0, size) + np.cumsum(np.sin(heading))).astype(int)
        x = (dice.uniform(0, size) + np.cumsum(np.cos(heading))).astype(int)
        inside = (y >= 0) & (y < size) & (x >= 0) & (x < size)
        data[y[inside], x[inside]] = (dice.uniform(0, 1000) + np.cumsum(dice.normal(0, 2, len(x))))[inside]
    return data


def raster(data: np.ndarray) -> Elevation:
    return Elevation(data, Extent(0, 0, 10.0 * data.shape[1], 10.0 * data.shape[0]))


def on_opencl(data: np.ndarray, **params: Any) -> np.ndarray:
    device = choose("auto")
    assert device is not None
    defaults = {name: item.default for name, item in diffuse.parameters.fields.items()}
    inputs = {"features": [to_device(raster(data), device)], "diffusivity": []}
    outputs = diffuse.run(inputs, {**defaults, **params}, Context(device=device), twin=True)
    value: Any = next(iter(outputs.values())) if isinstance(outputs, dict) else outputs[0]
    return np.asarray(to_host(value).data)


def by_pyamg(data: np.ndarray) -> np.ndarray:
    """Assemble the five-point matrix of the free cells and solve it."""
    import pyamg
    from scipy import sparse

    free = np.isnan(data)
    number = np.full(data.shape, -1, np.int32)
    number[free] = np.arange(free.sum(), dtype=np.int32)
    count = int(free.sum())
    diagonal, right = np.zeros(data.shape), np.zeros(data.shape)
    rows, cols = [], []
    for first, last in (((slice(None), slice(-1)), (slice(None), slice(1, None))), ((slice(-1),), (slice(1, None),))):
        for own, other in ((first, last), (last, first)):
            diagonal[own] += 1
            right[own] += np.where(free[other], 0, data[other])
            both = free[own] & free[other]
            rows.append(number[own][both])
            cols.append(number[other][both])
    own, other = np.concatenate(rows), np.concatenate(cols)
    matrix = sparse.csr_array((np.full(len(own), -1.0), (own, other)), shape=(count, count))
    matrix = sparse.csr_matrix(matrix + sparse.diags_array(diagonal[free]))
    made = data.astype(np.float64)
    solver = pyamg.ruge_stuben_solver(matrix)
    made[free] = solver.solve(right[free], tol=PYAMG_TOLERANCE, accel="cg")
    return made


def fastest(runs: dict[str, Callable[[], Any]], repeat: int) -> tuple[dict[str, float], dict[str, Any]]:
    """Return seconds of the fastest of several alternating runs, and what each gave."""
    seconds, made = dict.fromkeys(runs, float("inf")), {}
    for turn in range(repeat):
        for name, run in runs.items():
            if turn > 1 and seconds[name] > 2:
                continue  # what takes long is measured twice
            start = time.perf_counter()
            made[name] = run()
            seconds[name] = min(seconds[name], time.perf_counter() - start)
    return seconds, made


def diffusion(size: int, repeat: int) -> None:
    has_device = choose("auto") is not None
    for make in (scattered, skeleton):
        data = make(size)
        runs: dict[str, Callable[[], Any]] = {
            "NumPy": lambda data=data: diffuse(raster(data), tolerance=TOLERANCE).data
        }
        if has_device:
            runs["OpenCL"] = partial(on_opencl, data, tolerance=TOLERANCE)
            runs["OpenCL, twice the side"] = partial(on_opencl, make(2 * size), tolerance=TOLERANCE)
            runs["OpenCL, 5,500 Jacobi steps"] = partial(on_opencl, data, method="jacobi", iterations=5500)
            on_opencl(data)  # compiles
        try:
            import pyamg  # noqa: F401

            runs["pyamg"] = partial(by_pyamg, data)
        except ImportError:
            print("(pyamg is not installed)")
        seconds, made = fastest(runs, repeat)
        exact = diffuse(raster(data), tolerance=1e-6).data.astype(np.float64)
        scale = float(np.nanmax(data) - np.nanmin(data))
        print(f"\ndiffuse, {make.__name__}, {size} x {size}")
        for name, taken in seconds.items():
            line = f"  {name:28} {taken:8.3f} s   {taken / seconds.get('OpenCL', seconds['NumPy']):6.1f} x OpenCL"
            if made[name].shape == exact.shape:
                line += f"   largest error {np.abs(made[name] - exact).max() / scale:.1e} of the range"
            print(line)


def rectangle(size: int, repeat: int) -> None:
    """A transform of n values costs an FFT of 2 (n + 1): of 1023 the powers of two, of 1024 one with a prime of 41."""
    dice = np.random.default_rng(3)
    for count in (size - 1, size, size + 1):
        values, source = dice.normal(size=(2, count + 2, count + 2)).astype(np.float32)
        base = raster(np.add.outer(*dice.normal(0, 30, (2, 3 * count // 2)).cumsum(axis=1)))
        patch = Elevation(values, Extent(100, 100, 100 + 10 * (count + 2), 100 + 10 * (count + 2)))
        runs = {
            "SciPy's two transforms, float32": partial(transforms, source[1:-1, 1:-1]),
            "given edges, float32": partial(poisson.solve_rectangle, values, None, 1.0, 1.0),
            "the node poisson_blend": partial(poisson_blend, base, patch),
            "SciPy's two transforms, float64": partial(transforms, source[1:-1, 1:-1].astype(np.float64)),
            "with a source, float64": partial(poisson.solve_rectangle, values.astype(np.float64), source, 1.0, 1.0),
        }
        seconds, _ = fastest(runs, max(9, repeat))
        print(f"\nPoisson, {count} x {count} free cells")
        for name, taken in seconds.items():
            bound = seconds["SciPy's two transforms, " + ("float64" if "float64" in name else "float32")]
            print(f"  {name:32} {taken:8.4f} s   {taken / bound:5.2f} x SciPy")


def transforms(field: np.ndarray) -> np.ndarray:
    from scipy.fft import dstn, idstn

    return np.asarray(idstn(dstn(field, type=1, workers=-1), type=1, workers=-1, overwrite_x=True))


def dividing(size: int, repeat: int) -> None:  # noqa: ARG001
    """Ridges of a network of the paper's size (12,267 nodes), as it is and with points between nodes."""
    from scipy.spatial import Voronoi

    stem = Polylines.of([np.array([[5000.0, 0.0], [5300.0, 2500.0], [4800.0, 5000.0], [5000.0, 9500.0]])])
    box = Polylines.of([10_000.0 * np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])])
    network = river_heights(river_network(stem, box, generator=3, depth=5, seed=1))
    length = reach_lengths(network.position, network.downstream)
    for spacing in (float(length.max()), None):
        sites = sites_of(network, spacing or float(np.median(length[length > 0])))
        runs: dict[str, Callable[[], Any]] = {
            "ridges": partial(ridges, network, box, spacing=spacing),
            "SciPy's Voronoi diagram alone": partial(Voronoi, sites.position),
        }
        seconds, _ = fastest(runs, max(7, repeat))
        print(f"\nridges of {len(network.downstream):,} nodes, {len(sites.position):,} sites")
        for name, taken in seconds.items():
            print(f"  {name:32} {taken:8.3f} s")


PAPER = {"network": 0.003875, "ridges": 0.820, "enrich": 0.0586, "diffuse": 323.5, "smooth": 0.9276}
"""Seconds at 1024 x 1024 (GD1024): Table 3 on a Core i7-4710MQ, and section VIII's 5,500 steps on a Core i5-2410M."""


def pipeline(size: int, repeat: int) -> None:
    """The terrain of two graphs, nothing remembered, without the check and the pictures."""
    total = sum(PAPER.values())
    print(f"\nlines to terrain, {size} x {size} (the paper: {total:.1f} s at 1024 x 1024)")
    for name in ("terrain_from_rivers", "terrain_as_printed"):
        graph = Graph.load(GRAPHS / f"{name}.json")
        best, steps = float("inf"), ""
        for _ in range(repeat):
            with tempfile.TemporaryDirectory() as folder:
                cache = Cache(folder)
                start = time.perf_counter()
                result = graph.run(["terrain"], set={"cell_size": 10_000 / size}, cache=cache)
                taken = time.perf_counter() - start
                cache.close()
            if taken < best:
                best = taken
                steps = ", ".join(f"{node.id} {node.seconds:.2f}" for node in result.nodes.values())
        compared = f", {total / best:.0f} x faster than the paper on its CPU" if size == 1024 else ""
        print(f"  {name:28} {best:8.3f} s{compared}\n    {steps}")


PARTS: dict[str, Callable[[int, int], None]] = {
    "diffuse": diffusion,
    "poisson": rectangle,
    "ridges": dividing,
    "pipeline": pipeline,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--part", choices=[*PARTS, "all"], default="all")
    chosen = parser.parse_args()
    device = choose("auto")
    print(f"OpenCL: {device.info if device else 'no device'}")
    for name, part in PARTS.items():
        if chosen.part in (name, "all"):
            part(chosen.size, chosen.repeat)


if __name__ == "__main__":
    main()
