"""Eight octaves of fractal noise on a grid, beside libraries written in C and C++, in the same run.

nodegraph runs the node `terrain.noise` on NumPy and on OpenCL (with PoCL on the processor).  pyfastnoiselite is one
thread of portable C; pyfastnoisesimd is SIMD C++ on all cores, and joins in where its build succeeds.  All sum 8
octaves of gradient noise at a gain of 0.5 and a lacunarity of 2; ours turns each octave and keeps to 1e-5 anywhere.

    uv run --group bench python benchmarks/noise.py [--size 2048] [--repeat 7]

Runs alternate; figures are of the fastest one.  Ratios are to pyfastnoiselite: above 1 is faster.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from nodegraph import Context
from nodegraph.opencl import choose
from nodegraph_terrain.noise import KINDS
from nodegraph_terrain.noise_raster import noise

OCTAVES, CELL, WAVELENGTH = 8, 10.0, 5000.0


def ours_on_numpy(size: int, kind: str = "fbm") -> Callable[[], object]:
    extent = (0.0, 0.0, size * CELL, size * CELL)
    return lambda: noise(extent=extent, cell_size=CELL, kind=kind, octaves=OCTAVES, wavelength=WAVELENGTH)


def ours_on_opencl(size: int, kind: str = "fbm") -> Callable[[], object] | None:
    device = choose("auto")
    if device is None or noise.twin is None:
        return None
    context = Context(device=device)
    params = {name: item.default for name, item in noise.parameters.fields.items()}
    params |= {"extent": (0.0, 0.0, size * CELL, size * CELL), "cell_size": CELL, "kind": kind}
    params |= {"octaves": OCTAVES, "wavelength": WAVELENGTH}

    def run() -> None:
        noise.run({}, params, context, twin=True)
        device.finish()

    return run


def fastnoiselite(size: int) -> Callable[[], object] | None:
    try:
        from pyfastnoiselite.pyfastnoiselite import FastNoiseLite, FractalType, NoiseType
    except ImportError:
        return None
    maker = FastNoiseLite(seed=1)
    maker.noise_type = NoiseType.NoiseType_Perlin
    maker.fractal_type = FractalType.FractalType_FBm
    maker.fractal_octaves = OCTAVES
    maker.frequency = CELL / WAVELENGTH
    points = np.indices((size, size)).reshape(2, -1)[::-1].astype(np.float32).copy()
    return lambda: maker.gen_from_coords(points)


def fastnoisesimd(size: int) -> Callable[[], object] | None:
    try:
        import pyfastnoisesimd
    except ImportError:
        return None
    # Its last release asks for a name that NumPy 2 has dropped.
    vars(np).setdefault("product", np.prod)
    maker = pyfastnoisesimd.Noise(seed=1)
    maker.noiseType = pyfastnoisesimd.NoiseType.PerlinFractal
    maker.fractal.fractalType = pyfastnoisesimd.FractalType.FBM
    maker.fractal.octaves = OCTAVES
    maker.frequency = CELL / WAVELENGTH
    return lambda: maker.genAsGrid([1, size, size])


def fastest(runs: dict[str, Callable[[], object] | None], repeat: int) -> dict[str, float]:
    """Return seconds of the fastest of several alternating runs; what is not installed is left out."""
    present = {name: run for name, run in runs.items() if run is not None}
    seconds = dict.fromkeys(present, float("inf"))
    for run in present.values():
        run()
    for turn in range(repeat):
        for name, run in present.items():
            if turn > 1 and seconds[name] > 1:
                continue  # what takes long is measured twice
            start = time.perf_counter()
            run()
            seconds[name] = min(seconds[name], time.perf_counter() - start)
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=2048)
    parser.add_argument("--repeat", type=int, default=7)
    chosen = parser.parse_args()
    size = chosen.size
    device = choose("auto")
    print(f"{OCTAVES} octaves at {size} x {size}; OpenCL: {device.info if device else 'no device'}\n")
    seconds = fastest(
        {
            "pyfastnoiselite": fastnoiselite(size),
            "pyfastnoisesimd": fastnoisesimd(size),
            "nodegraph, NumPy": ours_on_numpy(size),
            "nodegraph, OpenCL": ours_on_opencl(size),
        },
        chosen.repeat,
    )
    base = seconds.get("pyfastnoiselite")
    for name, time_ in seconds.items():
        ratio = f"{base / time_:6.1f} x pyfastnoiselite" if base else ""
        print(f"{name:20} {size * size / time_ / 1e6:8.1f} Msamples/s  {ratio}")
    print("\nEach kind on OpenCL")
    for kind, time_ in fastest({kind: ours_on_opencl(size, kind) for kind in KINDS}, chosen.repeat).items():
        print(f"{kind:20} {size * size / time_ / 1e6:8.1f} Msamples/s")


if __name__ == "__main__":
    main()
