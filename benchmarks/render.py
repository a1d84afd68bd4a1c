"""Following rays to rasters: beside Embree and Open3D, and with local bounds beside sphere tracing with one.

All of one run, on the device that `auto` chooses.  The peers get the raster as triangles, two to a quad, and build
their hierarchy; we build a pyramid and the gradient for smooth normals.  Times of a picture are from rays in float64 to
hits with depth and normal, here, and from prepared float32 rays, for the peers.  `times` is how much longer a peer
takes for the rays, `built` for building and rays.

    uv run --group bench [--with open3d] python benchmarks/render.py [--size 1024] [--rows 1080] [--repeat 3]

The Alps are read from `../shared/data`, where that is; the sample of matplotlib always is.
"""

from __future__ import annotations

import argparse
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nodegraph import Context
from nodegraph.opencl import Device, choose
from nodegraph_render.camera import Camera
from nodegraph_render.raster_tracer import raster_tracer
from nodegraph_render.rays import Rays
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.resample import resample
from nodegraph_terrain.sample_dem import sample_dem
from nodegraph_terrain.voids import fill_voids

ALPS = Path(__file__).resolve().parents[2] / "shared/data/alps_N46E008/N46E008.tif"


def rasters(size: int) -> Iterator[tuple[str, Elevation]]:
    """Yield terrains of `size` x `size` cells: the Jacksboro fault, finer than measured, and a part of the Alps."""
    dem = sample_dem()
    rows, cols = dem.shape
    metres = Elevation(dem.data, Extent(0, 0, cols * 74.0, rows * 92.0))
    yield "Jacksboro", resample(metres, rows=size, columns=size)
    if ALPS.is_file():
        import rasterio

        with rasterio.open(ALPS) as file:
            heights = file.read(1, masked=True).astype(np.float32).filled(np.nan)[:size, :size]
        rows, cols = heights.shape
        yield "Alps", fill_voids(Elevation(heights, Extent(0, 0, cols * 63.9, rows * 92.1)))


def cameras(surface: Elevation) -> Iterator[tuple[str, Camera]]:
    """Yield views: from beyond the border over all of it, from a low flight, and standing on the ground."""
    box, top = surface.extent, float(np.nanmax(surface.data))
    rows, cols = surface.shape
    x, y, ground = (box.west + box.east) / 2, (box.south + box.north) / 2, float(surface.data[rows // 2, cols // 2])
    yield "over", Camera((x, box.south - 0.1 * box.height, top + 0.25 * box.height), (x, y, ground), field_of_view=40)
    yield "flight", Camera((x, y, ground + 600), (x + 1000, y + 8000, ground))
    yield "ground", Camera((x, y, ground + 20), (x + 1000, y + 8000, ground + 100))


def seconds(work: Callable[[], Any], repeat: int) -> tuple[float, Any]:
    """Return the median time of some runs after a first one, and a result."""
    result = work()
    times = []
    for _ in range(repeat):
        started = time.perf_counter()
        result = work()
        times.append(time.perf_counter() - started)
    return statistics.median(times), result


def triangles(surface: Elevation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return corners and triangles of a raster, two to a quad, and the point that the corners are relative to."""
    (rows, cols), (dx, dy) = surface.shape, surface.cell_size
    corner = np.array([surface.extent.west + dx / 2, surface.extent.north - dy / 2, 0])
    x, y = np.meshgrid(np.arange(cols) * dx, np.arange(rows) * -dy)
    points = np.stack([x, y, surface.data], -1, dtype=np.float32).reshape(-1, 3)
    northwest = (np.arange(rows - 1, dtype=np.int32)[:, None] * cols + np.arange(cols - 1, dtype=np.int32)).ravel()
    corners = [northwest, northwest + cols, northwest + 1, northwest + 1, northwest + cols, northwest + cols + 1]
    return points, np.stack(corners, 1).reshape(-1, 3), corner


def single(rays: Rays, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    origin = np.array(np.broadcast_to(rays.origin - corner, rays.direction.shape), np.float32)
    return origin, rays.direction.astype(np.float32)


Caster = Callable[[Rays], Callable[[], Any]]


def in_embree(surface: Elevation) -> tuple[float, Caster]:
    """Build a raster's triangles in Embree; return how long that took, and what casts rays."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    started = time.perf_counter()
    points, corners, corner = triangles(surface)
    scene = EmbreeScene()
    mesh = TriangleMesh(scene, points, corners)
    # The hierarchy is built when rays are first cast.
    scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))
    built = time.perf_counter() - started

    def cast(rays: Rays) -> Callable[[], Any]:
        origin, direction = single(rays, corner)
        assert mesh is not None
        return lambda: scene.run(origin, direction, query="DISTANCE")

    return built, cast


def in_open3d(surface: Elevation) -> tuple[float, Caster]:
    """The same in Open3D, which gives normals as well."""
    import open3d

    started = time.perf_counter()
    points, corners, corner = triangles(surface)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(points, corners.astype(np.uint32))
    scene.cast_rays(np.array([[0, 0, 0, 0, 0, 1]], np.float32))
    built = time.perf_counter() - started

    def cast(rays: Rays) -> Callable[[], Any]:
        both = np.hstack(single(rays, corner))
        return lambda: scene.cast_rays(both)

    return built, cast


PEERS = {"embreex": in_embree, "open3d": in_open3d}


def compare(surface: Elevation, name: str, device: Device, rows: int, cols: int, repeat: int) -> None:
    """Print the figures of a raster."""
    prepare, fast = seconds(lambda: raster_tracer(surface, device, Context()), repeat)
    slow = raster_tracer(surface, device, Context(), method="plain")
    print(f"\n{name}, {surface.shape[0]} x {surface.shape[1]} cells: prepared in {prepare:.3f} s", end="")
    peers = {}
    for peer, build in PEERS.items():
        if importlib.util.find_spec(peer):
            peers[peer] = build(surface)
            print(f"; {peer} builds in {peers[peer][0]:.3f} s", end="")
        else:
            print(f"; {peer} is not installed", end="")
    titles = "".join([f"{f'{peer} s':>11}{'times':>7}{'built':>7}" for peer in peers])
    print(
        f"\n{'view':8}{'hits':>6}{'s':>8}{titles}{'steps':>8}{'p99':>6}{'plain':>8}{'p99':>6}{'ratio':>7}{'plain s':>9}"
    )
    for view, camera in cameras(surface):
        rays = camera.rays(rows, cols)
        taken, hits = seconds(lambda rays=rays: fast(rays), repeat)
        marched, plain = seconds(lambda rays=rays: slow(rays), 1)
        line = f"{view:8}{(hits.layer == 0).mean():6.0%}{taken:8.3f}"
        for built, cast in peers.values():
            other, _ = seconds(cast(rays), repeat)
            line += f"{other:11.3f}{other / taken:7.1f}{(built + other) / (prepare + taken):7.1f}"
        few, many = float(hits.steps.mean()), float(plain.steps.mean())
        line += f"{few:8.1f}{np.percentile(hits.steps, 99):6.0f}{many:8.1f}{np.percentile(plain.steps, 99):6.0f}"
        print(f"{line}{few / many:7.2f}{marched:9.3f}", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--rows", type=int, default=1080)
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    device = choose("auto")
    if device is None:
        print("no OpenCL device; install pyopencl[pocl]", file=sys.stderr)
        return 2
    cols = options.rows * 16 // 9
    print(f"{device.info}, pictures of {cols} x {options.rows}, medians of {options.repeat}")
    for name, surface in rasters(options.size):
        compare(surface, name, device, options.rows, cols, options.repeat)
    return 0


if __name__ == "__main__":
    sys.exit(main())
