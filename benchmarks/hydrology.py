"""Solvers of the hydrology nodes beside their peers, in the same run.

`hydrology.diffuse` on 50 scattered points and on a skeleton of winding lines, to 1e-4 of the range, on NumPy and on
OpenCL, beside pyamg (Ruge-Stuben hierarchy and conjugate gradients, assembly included) and beside the paper's 5,500
Jacobi steps on the same device; twice the side; and `hydrology.poisson_blend`'s rectangle beside SciPy's transforms.
Errors are to the same node at a tolerance of 1e-6.

    uv run --group bench python benchmarks/hydrology.py [--size 1024] [--repeat 3]

Runs alternate; figures are of the fastest one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from nodegraph import Context
from nodegraph.opencl import choose, to_device, to_host
from nodegraph_hydrology import poisson
from nodegraph_hydrology.diffuse import diffuse
from nodegraph_terrain.raster import Elevation, Extent

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
    from scipy.fft import dstn, idstn

    dice = np.random.default_rng(3)
    values, source = dice.normal(size=(2, size + 2, size + 2))
    runs = {
        "rectangle": lambda: poisson.solve_rectangle(values, source, 1.0, 1.0),
        "SciPy's two transforms alone": lambda: idstn(dstn(source[1:-1, 1:-1], type=1), type=1),
    }
    seconds, _ = fastest(runs, max(5, repeat))
    print(f"\nPoisson, {size} x {size}")
    for name, taken in seconds.items():
        print(f"  {name:28} {taken:8.3f} s")


PARTS: dict[str, Callable[[int, int], None]] = {"diffuse": diffusion, "poisson": rectangle}


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
