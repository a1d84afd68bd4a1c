"""From samples to pixels, in bands: with NumPy, or with OpenCL where the materials allow."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

import nodegraph_terrain
from nodegraph import Context
from nodegraph_render import atmosphere, materials, sky
from nodegraph_render.camera import Camera
from nodegraph_render.lighting import SHADED, Scene, leaving
from nodegraph_render.material import Ground, Material, Plain
from nodegraph_render.materials import KINDS, RELIEF, SPREAD, Spots
from nodegraph_render.rays import SKY, Rays, Singles
from nodegraph_render.sky import Sky
from nodegraph_render.trace import Trace

if TYPE_CHECKING:
    from nodegraph.opencl import Device

Halves = npt.NDArray[np.float16]

KERNELS = Path(__file__).with_name("kernels") / "shade.cl"
INCLUDE = (Path(nodegraph_terrain.__file__).parent,)
DEFINES: dict[str, Any] = {
    "KIND_TABLE": ", ".join(f"(float4)({', '.join(f'{value!r}f' for value in kind)})" for kind in KINDS),
    "MOLECULES_HEIGHT": atmosphere.RAYLEIGH_HEIGHT,
    "HAZE_HEIGHT": atmosphere.HAZE_HEIGHT,
    "ALBEDO": atmosphere.ALBEDO,
    "ASYMMETRY": atmosphere.ASYMMETRY,
    "LEVEL_SPACING": sky.SPACING,
}

LOOK = np.dtype(
    [
        *((name, "f4", 3) for name in ("right", "up", "forward")),
        *((name, "f4") for name in ("half_height", "rise", "eye", "footprint", "limit")),
        *((name, "f4", 3) for name in ("sun", "sunlight", "hidden")),
        ("harmonics", "f4", 27),
        ("disc", "f4", 3),
        *((name, "f4") for name in ("chord", "dip")),
        *((name, "f4", 3) for name in ("molecules", "haze")),
        *((name, "i4") for name in ("orthographic", "rows", "cols", "k", "sky_rows", "sky_cols", "levels")),
    ]
)
"""As in the kernels."""

MATERIAL = np.dtype(
    [
        ("kind", "i4"),
        *((name, "f4") for name in ("snow_line", "tree_line", "rock_slope", "variation", "relief", "size", "octaves")),
        ("colour", "f4", 4),
    ]
)
"""As in the kernels."""

BAND = 1 << 18
"""Samples that are shaded at a time."""


class Frame(NamedTuple):
    """A picture to be shaded.

    Attributes:
        trace: what its rays hit.
        scene: the lit surfaces.
        sky: as seen from the camera.
        sunny, open: shares of the sun and of the sky that each sample sees, of the trace's shape.
        limit: radiance beyond which a sample counts no more, so that edges of the sun and of its glint are smooth, too.
    """

    trace: Trace
    scene: Scene
    sky: Sky
    sunny: Halves
    open: Halves
    limit: float


def footprint(camera: Camera, rows: int, depth: Singles) -> Singles:
    """Return how much one of `rows` rows of samples spans at some depths, m across."""
    if camera.field_of_view:
        return depth * np.float32(2 * math.tan(math.radians(camera.field_of_view) / 2) / rows)
    return np.full(depth.shape, camera.span / rows, np.float32)


def spots(trace: Trace, part: slice) -> tuple[Rays, npt.NDArray[np.bool_], Spots]:
    """Return the rays of some rows of samples, which of them hit anything, and where."""
    high, wide = trace.depth.shape
    rays = trace.camera.rays(high, wide, part.start, part.stop)
    depth = trace.depth[part].ravel()
    hit = trace.layer[part].ravel() != SKY
    origin = np.broadcast_to(rays.origin, (len(hit), 3))[hit]
    direction = np.broadcast_to(rays.direction, (len(hit), 3))[hit]
    position = origin + direction * depth[hit].astype(np.float64)[:, None]
    normal = trace.normal[part].reshape(-1, 3)[hit]
    return rays, hit, Spots(position, normal, footprint(trace.camera, high, depth[hit]))


def bands(trace: Trace, context: Context, start: float, stop: float) -> Iterator[slice]:
    """Yield ranges of rows of samples, of whole pixels, reporting progress from `start` to `stop`."""
    (high, wide), k = trace.depth.shape, trace.supersampling
    step = max(1, BAND // (wide * k)) * k
    for first in range(0, high, step):
        context.progress(start + (stop - start) * first / high)
        yield slice(first, min(high, first + step))


def on_host(frame: Frame, context: Context) -> Singles:
    """Return the light of the pixels, (rows, cols, 3), with NumPy."""
    trace, k = frame.trace, frame.trace.supersampling
    high, wide = trace.depth.shape
    picture = np.zeros((high // k, wide // k, 3), np.float32)
    for part in bands(trace, context, 0.6, 1.0):
        rays, hit, found = spots(trace, part)
        direction = np.broadcast_to(rays.direction, (len(hit), 3))
        light = np.zeros((len(hit), 3), np.float32)
        light[~hit] = frame.sky.radiance(direction[~hit])
        own = _leaving(frame, part, hit, hit, found, direction)
        if trace.camera.field_of_view:
            start = np.full(len(own), trace.camera.eye[2])
            depth, cosine = trace.depth[part].ravel()[hit], direction[hit] @ frame.sky.direction
            through, added = frame.sky.air_light(cosine, start, found.position[:, 2], depth)
            own = (own * through + added).astype(np.float32)
        light[hit] = own
        samples = np.minimum(light, np.float32(frame.limit)).reshape(-1, k, wide // k, k, 3)
        picture[part.start // k : part.stop // k] = samples.mean(axis=(1, 3))
    return picture


def on_device(frame: Frame, device: Device, context: Context) -> Singles:
    """Return what `on_host` does, with OpenCL; water and imagery still leave their light to NumPy."""
    trace, k = frame.trace, frame.trace.supersampling
    high, wide = trace.depth.shape
    table = _materials([surface.material for surface in trace.surfaces])
    given = np.flatnonzero(table["kind"] == 2)
    program = device.program(KERNELS, include=INCLUDE, **DEFINES)
    look, made = _words(device, _look(frame)), _words(device, table)
    colours, lit = (device.from_host(array) for array in (frame.sky.table, frame.sky.lit))
    noises = {
        number: _noises(device, surface.material, trace.camera)
        for number, surface in enumerate(trace.surfaces)
        if isinstance(surface.material, Ground)
    }
    picture = np.zeros((high // k, wide // k, 3), np.float32)
    for part in bands(trace, context, 0.6, 1.0):
        rows = part.stop - part.start
        depth, normal, layer = (device.from_host(array[part]) for array in (trace.depth, trace.normal, trace.layer))
        shares = [device.from_host(array[part].astype(np.float32)) for array in (frame.sunny, frame.open)]
        fields = device.empty((4, rows, wide) if noises else (1, 1, 1))
        for number, noise in noises.items():
            size = (-(-wide // 8), rows)
            arguments = (number, depth, layer, *noise, part.start, part.stop, fields)
            device.run(program, "patches", size, look, made, *arguments)
        light = np.zeros((rows * wide if len(given) else 1, 3), np.float32)
        chosen = np.isin(trace.layer[part].ravel(), given)
        if chosen.any():
            rays, hit, found = spots(trace, part)
            direction = np.broadcast_to(rays.direction, (len(hit), 3))
            light[chosen] = _leaving(frame, part, chosen, hit, found, direction)
        done = device.empty((rows // k, wide // k, 3))
        arguments = (
            depth,
            normal,
            layer,
            *shares,
            fields,
            device.from_host(light),
            colours,
            lit,
            part.start,
            part.stop,
        )
        device.run(program, "pixels", (wide // k, rows // k), look, made, *arguments, done)
        picture[part.start // k : part.stop // k] = device.to_host(done)
    return picture


def _leaving(
    frame: Frame, part: slice, chosen: npt.NDArray[np.bool_], hit: npt.NDArray[np.bool_], found: Spots, direction: Any
) -> Singles:
    """Return the light that leaves the chosen ones of a band's samples, all of which hit something."""
    among = chosen[hit]
    shares = [array[part].ravel()[chosen].astype(np.float32) for array in (frame.sunny, frame.open)]
    layer = frame.trace.layer[part].ravel()[chosen]
    return leaving(frame.scene, found.taken(among), layer, direction[chosen], *shares)


def _words(device: Device, records: npt.NDArray[Any]) -> Any:
    """Return records on a device, as an array of vectors to it."""
    return device.from_host(np.ascontiguousarray(records).view(np.uint8))


def _look(frame: Frame) -> npt.NDArray[Any]:
    trace, scene, seen = frame.trace, frame.scene, frame.sky
    camera, (high, wide) = trace.camera, trace.depth.shape
    half = camera.half_height
    look = np.zeros(1, LOOK)
    look["right"], look["up"], look["forward"] = camera.axes
    values: dict[str, Any] = {
        "half_height": half,
        "rise": camera.rise,
        "eye": camera.eye[2],
        "footprint": 2 * half / high,
        "limit": frame.limit,
        "sun": seen.direction,
        "sunlight": scene.sky.sun,
        "hidden": math.pi * SHADED * scene.sky.bounce,
        "harmonics": scene.sky.harmonics.ravel(),
        "disc": seen.disc,
        "chord": seen.chord,
        "dip": math.acos(atmosphere.EARTH / (atmosphere.EARTH + seen.height)),
        "molecules": seen.air.molecules,
        "haze": seen.air.haze,
        "orthographic": int(not camera.field_of_view),
        "rows": high,
        "cols": wide,
        "k": trace.supersampling,
        "sky_rows": sky.ROWS,
        "sky_cols": sky.COLS,
        "levels": sky.LEVELS,
    }
    for name, value in values.items():
        look[name] = value
    return look


def _materials(made: list[Material]) -> npt.NDArray[Any]:
    table = np.zeros(len(made), MATERIAL)
    for row, material in zip(table, made, strict=True):
        row["kind"] = 2
        if isinstance(material, Ground):
            row["kind"] = 0
            for name in ("snow_line", "tree_line", "rock_slope", "variation", "relief"):
                row[name] = getattr(material, name)
            row["size"], row["octaves"] = material.patches, materials.noises(material)[0].count
        elif isinstance(material, Plain):
            row["kind"] = 1
            row["colour"][:3] = material.colour
    return table


def _noises(device: Device, material: Ground, camera: Camera) -> tuple[Any, ...]:
    """Return the arguments of the kernel of patches: tables and origins of two fields, and factors."""
    first, second = materials.noises(material)
    words = [
        device.from_host(array)
        for noise in (first, second)
        for array in (noise.table(), noise.origins(camera.eye[0], camera.eye[1]).ravel())
    ]
    return (*words, SPREAD, RELIEF / materials.steepness(first))
