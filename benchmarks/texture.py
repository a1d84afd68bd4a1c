"""Texturing: painting with layers on a device beside NumPy.

`apply` paints 8 layers (with hats of altitude and slope, a measured function of temperature, noise of coverage, bumps
and tints) on ground of `size` / 8 cells a side, and prints how much longer NumPy takes than the device that `auto`
chooses.

`fit` learns from a made-up satellite image of 2400 x 2200 pixels in some 200,000 colours: its hue-saturation histogram,
classes by rectangles, and functions of altitude and slope from where these lie.  The paper reports 2.0 s for the first
and 0.7 s for the rest, on a Pentium 4 of 3.4 GHz.

`solar` sums up the sun of a year over mountains of `size` / 4 cells a side, with cast shadows from 32 directions, and
prints how much longer NumPy takes than the device.

`tiles` flies through the valley of a texture of 32,768 x 32,768 texels, a picture of 1280 x 720 pixels at a time, and
prints the bytes and seconds of the tiles that the first view needs and of those that are new in later ones, beside
those of the whole.  The paper's view took 40 MB for the same size.  Seconds of the whole are those of a part of 2048 x
2048 texels, times how often it fits.

    uv run --group bench python benchmarks/texture.py [apply] [fit] [solar] [tiles] [--size 4096] [--repeat 3]
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from nodegraph import Context
from nodegraph.opencl import choose, to_device, to_host
from nodegraph_terrain.noise_raster import noise
from nodegraph_terrain.raster import Elevation, Extent, Image
from nodegraph_texture.apply_opencl import evaluate_on_device
from nodegraph_texture.classify_surfaces import classify_surfaces
from nodegraph_texture.estimate_layers import estimate_layers
from nodegraph_texture.evaluate import evaluate
from nodegraph_texture.hue_saturation import Rectangle, colours_of, histogram_of
from nodegraph_texture.layer import layer
from nodegraph_texture.layers import SurfaceLayers
from nodegraph_texture.quantities import Temperature
from nodegraph_texture.scene import scene_of
from nodegraph_texture.solar_radiation import solar_radiation
from nodegraph_texture.texture_tiles import texture_tiles
from nodegraph_texture.tile_cache import TileCache
from nodegraph_texture.tile_tree import Tile
from nodegraph_texture.tile_view import View, needed


def eight_layers() -> SurfaceLayers:
    """Return rock with scree, soil, meadow, forest, clearings, marsh and snow."""
    clearings = layer(name="clearings", colour="#71804f", noise_scale=4.0, noise_bias=-0.9, variation=0.3)
    forest = layer(clearings, name="forest", colour="#3a4a33", altitude=(None, None, 1550, 1800), noise_bias=2.0,
                   noise_scale=3.0, roughness=8.0, relief_kind="billow", relief_wavelength=45,
                   variation=0.5)  # fmt: skip
    marsh = layer(name="marsh", colour="#4d5a3a", slope=(None, None, 4, 8), noise_scale=2.0, noise_bias=0.2)
    samples = tuple(np.linspace(0, 1, 256).tolist())
    meadow = layer(marsh, forest, name="meadow", colour="#868c5c", slope=(None, None, 32, 42), noise_scale=2.0,
                   noise_bias=1.6, constraints={"temperature": (-4.0, 4.0, samples)}, variation=0.35)  # fmt: skip
    soil = layer(meadow, name="soil", colour="#6d5d49", slope=(None, None, 38, 48), noise_scale=1.0, roughness=2.0)
    scree = layer(name="scree", colour="#a89f92", altitude=(1500, 2000, None, None), slope=(14, 22, 35, 41),
                  noise_scale=2.0, noise_bias=0.9, roughness=3.0, relief_wavelength=40, variation=0.3)  # fmt: skip
    snow = layer(name="snow", colour="#eef2f7", altitude=(2150, 2500, None, None), slope=(None, None, 37, 46),
                 noise_scale=1.6, noise_bias=1.4, roughness=-2.0, relief_wavelength=120)  # fmt: skip
    return layer(scree, soil, snow, name="rock", colour="#7d756c", roughness=18.0, relief_kind="ridged", variation=0.45)


def apply(size: int, repeat: int) -> None:
    """Print seconds of both paths, their ratio and how far the results are apart."""
    cells = size // 8
    edges = (0.0, 0.0, cells * 20.0, cells * 20.0)
    ground = noise(extent=edges, cell_size=20, kind="ridged", wavelength=4000, amplitude=2400, offset=500, octaves=7)
    warmth = Temperature((14 - 0.0065 * ground.data[::8, ::8]).astype(np.float32), ground.extent)
    scene = scene_of(eight_layers(), Elevation(ground.data, ground.extent), [warmth])
    window = 2.5, 0, 0, size, size
    device = choose("auto")
    if device is None:
        raise SystemExit("there is no OpenCL device to compare with")

    def on_device() -> Any:
        made = evaluate_on_device(scene, *window, device)
        device.finish()
        return made

    fast, found = seconds(on_device, repeat)
    slow, expected = seconds(lambda: evaluate(scene, *window), 1, warm=False)
    print(f"apply_layers, {len(scene.steps)} layers at {size} x {size} on {device.info.name}")
    print(f"  device {fast:8.2f} s   NumPy {slow:8.2f} s   {slow / fast:6.1f} times")
    apart = float(np.abs(device.to_host(found.coverage) - expected.coverage).max())
    codes = int(np.abs(device.to_host(found.colour).astype(np.int16) - expected.colour).max())
    shares = ", ".join(f"{n} {s:.0%}" for n, s in zip(scene.names, expected.coverage.mean(axis=(0, 1)), strict=True))
    print(f"  coverage differs by {apart:.1e}, colours by {codes} of 255; coverage: {shares}")


def fit(size: int, repeat: int) -> None:  # noqa: ARG001
    """Print seconds of the parts of fitting layers to an image of the paper's size."""
    extent = Extent(0.0, 0.0, 2400 * 30.0, 2200 * 30.0)
    ground = noise(extent=(0.0, 0.0, extent.east, extent.north), cell_size=30, kind="ridged", wavelength=16000,
                   amplitude=2400, octaves=7)  # fmt: skip
    dice = np.random.default_rng(1)
    surface = np.digitize(ground.data + 120 * dice.standard_normal(ground.shape, np.float32), (500, 1000, 1500))
    means = np.array([[40, 70, 30], [120, 130, 70], [150, 125, 95], [240, 243, 248]], np.float32)
    grain = 8 * dice.standard_normal((*ground.shape, 3), np.float32)
    image = Image(np.clip(means[surface] + grain, 0, 255).astype(np.uint8), extent)
    rectangles = (
        Rectangle("snow", value=(0.8, 1.0), saturation=(0.0, 0.2)),
        Rectangle("forest", hue=(80.0, 200.0)),
        Rectangle("meadow", hue=(50.0, 80.0)),
        Rectangle("rock", hue=(330.0, 50.0)),
    )
    counting, table = seconds(lambda: colours_of(image, Context()), repeat)
    histogram, _ = seconds(lambda: histogram_of(table, 8, 285, 256), repeat)
    classifying, found = seconds(lambda: classify_surfaces(image, method="rectangles", rectangles=rectangles), repeat)
    print(f"fit to an image of 2400 x 2200 pixels in {len(table.codes):,} colours")
    print(f"  histogram {counting + histogram:6.3f} s   classification {classifying:6.3f} s")
    for rule in ("printed", "conditional", "additive"):
        learn = partial(estimate_layers, found.labels, found.classes, ground, rule=rule)
        learning, _ = seconds(learn, repeat)
        total = counting + histogram + classifying + learning
        print(f"  {rule:12} constraint functions {learning:6.3f} s   together {total:6.3f} s")


def solar(size: int, repeat: int) -> None:
    """Print seconds of both paths of solar_radiation, their ratio and how far the results are apart."""
    side = size // 4
    ground = noise(extent=(0.0, 0.0, side * 30.0, side * 30.0), cell_size=30, kind="ridged", wavelength=8000,
                   amplitude=2400, octaves=7)  # fmt: skip
    device = choose("auto")
    if device is None:
        raise SystemExit("there is no OpenCL device to compare with")
    twin = solar_radiation.twin
    assert twin is not None
    there = to_device(ground, device)
    params: dict[str, Any] = {
        "latitude": 46.0, "first_day": 1, "last_day": 365, "step": 2.0, "transmittance": 0.75, "cast_shadows": True,
        "directions": 32, "diffuse_share": 0.0,
    }  # fmt: skip

    def on_device() -> Any:
        made = twin.function(there, **params, context=Context(device=device))
        device.finish()
        return made

    fast, found = seconds(on_device, repeat)
    slow, expected = seconds(lambda: solar_radiation(ground, latitude=46.0), 1, warm=False)
    print(f"solar_radiation, a year on {side} x {side} cells on {device.info.name}")
    print(f"  device {fast:8.2f} s   NumPy {slow:8.2f} s   {slow / fast:6.1f} times")
    apart = float(np.abs(to_host(found.radiation).data - expected.radiation.data).max())
    print(f"  they differ by {apart:.1e} W/m2 at most; mean {expected.radiation.data.mean():.1f} W/m2")


def tiles(_: int, __: int) -> None:
    """Print bytes and seconds of views of a texture of 32,768 texels a side, and of the whole."""
    side, part = 32768, 2048
    cells = side // 32
    edges = (0.0, 0.0, float(side), float(side))
    ground = noise(extent=edges, cell_size=32, kind="ridged", wavelength=8000, amplitude=2400, offset=500, octaves=7)
    warmth = Temperature((14 - 0.0065 * ground.data[::8, ::8]).astype(np.float32), ground.extent)
    device = choose("auto")
    context = Context(device=device)
    whole = texture_tiles(eight_layers(), Elevation(ground.data, ground.extent), None, warmth, factor=32)
    assert whole.tree.shape(whole.levels - 1) == (side // whole.size,) * 2
    cache = TileCache(64 << 20, whole.tile_bytes, lambda tile: whole.pixels(tile, "colour", context=context))
    highest = float(ground.data[cells // 8, cells // 2])
    print(f"texture_tiles, {side} x {side} texels, {len(whole.scene.steps)} layers, tiles of {whole.size} + 2 texels")
    cache.fetch([Tile(0, 0, 0)])  # compiles, and makes coarser versions of the ground
    for number in range(4):
        eye = (side / 2, side / 8 + 100.0 * number, highest + 1500)
        view = View(eye, (side / 2, side / 2, 500.0), 45.0, 1280, 720)
        started = time.perf_counter()
        found = needed(whole, view, cache.room)
        chosen = time.perf_counter()
        painted = cache.painted
        cache.fetch(found.tiles)
        ended = time.perf_counter()
        count = len(found.tiles)
        size = count * whole.tile_bytes / 1e6
        print(
            f"  view {number}: {count} tiles, {size:.1f} MB, chosen in {chosen - started:.3f} s, "
            f"{cache.painted - painted} painted in {ended - chosen:.2f} s; texels up to {found.largest:.2f} pixels"
        )
    cell = whole.cell
    if device is None:
        taken, _found = seconds(lambda: evaluate(whole.scene, cell, side // 2, side // 2, part, part), 1, warm=False)
    else:

        def on_device() -> None:
            evaluate_on_device(whole.scene, cell, side // 2, side // 2, part, part, device)
            device.finish()

        taken, _found = seconds(on_device, 1)
    print(
        f"  whole: {4 * side**2 / 1e6:,.0f} MB, {taken * (side / part) ** 2:,.0f} s ({taken:.2f} s for {part} x {part})"
    )


def seconds(work: Callable[[], Any], repeat: int, warm: bool = True) -> tuple[float, Any]:
    """Return the median time of some runs, after a first one that does not count, and a result."""
    if warm:
        work()
    times = []
    for _ in range(repeat):
        started = time.perf_counter()
        result = work()
        times.append(time.perf_counter() - started)
    return statistics.median(times), result


SECTIONS: dict[str, Callable[[int, int], None]] = {"apply": apply, "fit": fit, "solar": solar, "tiles": tiles}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", help=f"what to measure: {', '.join(SECTIONS)}; by default all")
    parser.add_argument("--size", type=int, default=4096, help="texels along a side")
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    for name in options.sections or SECTIONS:
        if name not in SECTIONS:
            parser.error(f"there is no section '{name}'; there are {', '.join(SECTIONS)}")
        SECTIONS[name](options.size, options.repeat)


if __name__ == "__main__":
    main()
