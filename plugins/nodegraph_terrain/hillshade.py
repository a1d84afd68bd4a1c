"""Hillshading: how much light the ground receives, from one or several directions, with cast shadows on demand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, halo, node
from nodegraph_terrain.blocks import EVERYTHING, GROUP, padded, row_blocks
from nodegraph_terrain.gradient import horn_gradient, require_projected
from nodegraph_terrain.raster import Elevation, Shade
from nodegraph_terrain.shadows import Disc, Ray, sunlit, trace

if TYPE_CHECKING:
    from nodegraph.opencl import Device

Floats = npt.NDArray[np.float32]
Mode = Literal["single", "multidirectional"]

KERNELS = Path(__file__).with_name("hillshade.cl")
WORK = 1 << 27
"""Cells times crossings that a device is given at a time, so that a cancel need not wait for more."""

STRIPE = 1024
"""Cells of a row that one work item looks through for extremes; as in the kernels."""

LEVEL = 1e-20
"""Squared gradient below which ground counts as level: it faces no direction, so every light weighs the same."""


@node(version=1, locality=halo(cells=lambda cast_shadows, **_: EVERYTHING if cast_shadows else 1))
def hillshade(
    surface: Elevation,
    *,
    azimuth: Annotated[
        float, Param("Where the light stands, clockwise from north; 315 is north-west.", ge=-360, le=360, unit="deg")
    ] = 315.0,
    altitude: Annotated[float, Param("Height of the light above the horizon.", ge=0, le=90, unit="deg")] = 45.0,
    z_factor: Annotated[float, Param("Vertical exaggeration.", gt=0, le=1e6)] = 1.0,
    mode: Annotated[Mode, Param("One light, or four whose weights follow the way the ground faces.")] = "single",
    cast_shadows: Annotated[bool, Param("Let the ground in front of the light throw shadows.")] = False,
    context: Context,
) -> Shade:
    """Shade a surface by the light it receives.

    With n the upward unit normal of the ground and l the unit vector to the light, ``single`` gives Lambert's
    max(0, n . l).  The gradient behind n is Horn's (see `slope`), multiplied by `z_factor`; level ground has the shade
    sin(altitude).

    ``multidirectional`` follows Mark (1992): lights at azimuth - 90, - 45, 0 and + 45 degrees (225, 270, 315 and 360
    for the default), each weighted by how obliquely it meets the slope,

        shade = 1/2 sum_k sin^2(aspect - azimuth_k) max(0, n . l_k),

    where the four weights always sum to 2.  It brings out relief that runs along the light and never turns a whole
    flank black.

    With `cast_shadows` each light is multiplied by the share of the sun's disc (0.533 degrees across) that stands above
    the horizon of the cell.  The horizon is followed along the ray to the light, at each grid line that it crosses,
    with heights linear between the two cells there, as far as any ground could hide the light.

    Args:
        surface: elevation in metres; cells may be rectangular.
        azimuth: where the light stands.
        altitude: height of the light.
        z_factor: heights are multiplied by it, for the gradient and for shadows.
        mode: ``single`` or ``multidirectional``.
        cast_shadows: follow shadows; the work then grows with the relief divided by tan(altitude).
        context: the engine's.

    Returns:
        0 (dark) to 1 (facing the light), of the same shape and extent; void cells stay void.

    Raises:
        ValueError: the raster is in degrees.

    References:
        B. K. P. Horn (1981): Hill shading and the reflectance map. Proc. IEEE 69(1). doi:10.1109/PROC.1981.11918.
        R. K. Mark (1992): A multidirectional, oblique-weighted, shaded-relief image of the Island of Hawaii. USGS
        Open-File Report 92-422. doi:10.3133/ofr92422.
    """
    cell = require_projected(surface)
    heights, (rows, cols) = surface.data, surface.shape
    started, low, high = 0.0, math.nan, math.nan
    if cast_shadows:
        started = 0.05
        for part in row_blocks(rows, cols, context, stop=started):
            low = float(np.fmin(low, np.fmin.reduce(heights[part], axis=None)))
            high = float(np.fmax(high, np.fmax.reduce(heights[part], axis=None)))
    lights = _lights(azimuth, altitude, mode, cell, (rows, cols), (high - low) * z_factor if cast_shadows else None)
    shade = np.empty_like(heights, order="C")
    for part in row_blocks(rows, cols, context, start=started):
        east, north = horn_gradient(heights, part, cell)
        east *= np.float32(z_factor)
        north *= np.float32(z_factor)
        squared = east * east + north * north
        scale = 1 / np.sqrt(1 + squared)
        total = np.zeros_like(east)
        for light in lights:
            # n . l, with n = (-east, -north, 1) * scale.
            lit = np.float32(light.up) - east * np.float32(light.east) - north * np.float32(light.north)
            np.maximum(lit, 0, out=lit)
            lit *= scale
            if mode == "multidirectional":
                across = east * np.float32(light.across[0]) - north * np.float32(light.across[1])
                with np.errstate(divide="ignore", invalid="ignore"):
                    weight = np.where(squared > LEVEL, across * across / squared, np.float32(0.5))
                lit *= weight * np.float32(0.5)
            if light.ray is not None and light.disc is not None:
                lit *= sunlit(heights, part, light.ray, light.disc, z_factor, high, context)
            total += lit
        np.minimum(total, 1, out=shade[part])
    return Shade(shade, surface.extent)


@hillshade.opencl(rtol=1e-4, atol=1e-4)
def _twin(
    surface: Elevation,
    *,
    azimuth: float,
    altitude: float,
    z_factor: float,
    mode: Mode,
    cast_shadows: bool,
    context: Context,
) -> Shade:
    device = context.device
    assert device is not None
    cell = require_projected(surface)
    # Typed as on the host; what it holds here are device arrays.
    heights: Any = surface.data
    rows, cols = surface.shape
    low, high = extremes(heights, device) if cast_shadows else (math.nan, math.nan)
    lights = _lights(azimuth, altitude, mode, cell, (rows, cols), (high - low) * z_factor if cast_shadows else None)
    shadows: list[Any] = []
    rays = [light.ray for light in lights if light.ray is not None]
    crossings = sum(map(len, rays))
    disc = lights[0].disc
    if disc is not None and crossings:
        distance = np.concatenate([ray.distance for ray in rays]).astype(np.float64)
        fraction = np.concatenate([ray.fraction for ray in rays])
        cells = np.concatenate([np.hstack([ray.near, ray.far]) for ray in rays])
        tangents = np.zeros((crossings, 4), np.float32)
        tangents[:, 0] = z_factor / distance * (1 - fraction)
        tangents[:, 1] = z_factor / distance * fraction
        tangents[:, 2] = distance * disc.low / z_factor
        per_disc = 1 / (disc.high - disc.low)
        shadows = [high, device.from_host(cells), device.from_host(tangents), disc.high, per_disc]
    table = np.zeros((len(lights), 8), np.float32)
    first = 0
    for row, light in zip(table, lights, strict=True):
        count = 0 if light.ray is None else len(light.ray)
        row[:7] = light.east, light.north, light.up, *light.across, first, first + count
        first += count
    shaded: Any = device.empty_like(heights)
    on_device = device.from_host(table)
    defines = {"SHADOWS": 1} if shadows else {}
    for part in row_blocks(rows, cols * (16 + crossings), context, cells=WORK):
        size = padded(GROUP, -(-cols // 8), part.stop - part.start)
        scalars = (len(lights), int(mode == "multidirectional"), rows, cols, part.start, part.stop, *cell)
        arguments = (heights, on_device, *scalars, z_factor, LEVEL, *shadows, shaded)
        device.run(KERNELS, "shade", size, *arguments, local_size=GROUP, defines=defines)
        if part.stop < rows:
            device.finish()
    return Shade(shaded, surface.extent)


def extremes(heights: Any, device: Device) -> tuple[float, float]:
    """Return the least and greatest height of a device array; NaN where all is void."""
    rows, cols = heights.shape
    stripes = -(-cols // STRIPE)
    lows, highs = device.empty((rows, stripes)), device.empty((rows, stripes))
    size = padded(GROUP, stripes, rows)
    device.run(KERNELS, "extremes", size, heights, rows, cols, lows, highs, local_size=GROUP)
    low, high = float(device.to_host(lows).min()), float(device.to_host(highs).max())
    return (low, high) if low <= high else (math.nan, math.nan)


@hillshade.forecast
def _forecast(surface: Forecast, **_: object) -> Forecast:
    return Forecast(surface.bytes, 32 << 20, surface.about)


@dataclass(frozen=True, slots=True)
class _Light:
    """One direction of light: its unit vector, the horizontal direction its weight is measured across, its shadows."""

    east: float
    north: float
    up: float
    across: tuple[float, float]
    ray: Ray | None = None
    disc: Disc | None = None


def _lights(
    azimuth: float,
    altitude: float,
    mode: Mode,
    cell: tuple[float, float],
    shape: tuple[int, int],
    relief: float | None,
) -> Sequence[_Light]:
    """Return the lights of a mode; with the `relief` in metres (greatest minus least height) they throw shadows."""
    turns = (0.0,) if mode == "single" else (-90.0, -45.0, 0.0, 45.0)
    disc = None if relief is None else Disc.at(altitude)
    lights = []
    level, up = math.cos(math.radians(altitude)), math.sin(math.radians(altitude))
    for turn in turns:
        direction = math.radians(azimuth + turn)
        sine, cosine = math.sin(direction), math.cos(direction)
        ray = None
        if disc is not None and relief is not None and relief > 0:
            ray = trace(azimuth + turn, cell, shape, disc.reach(relief))
        lights.append(_Light(level * sine, level * cosine, up, (cosine, sine), ray, disc))
    return lights
