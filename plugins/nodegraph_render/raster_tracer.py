"""Following rays to elevation rasters, exactly: every hill that a ray meets stops it, however thin.

The surface is bilinear between the centres of cells and solid below, down to any depth: a ray that comes in through the
border of the raster, or of a void, below the surface hits a wall there.

``accelerated`` goes from block to block of a maximum pyramid, past all that the ray stays above, and solves the
quadratic equation of ray and bilinear quad in the others (Tevs, Ihrke, Seidel 2008, Maximum mipmaps for fast, accurate,
and scalable dynamic height field rendering, doi:10.1145/1342250.1342279).  ``plain`` is sphere tracing with one
Lipschitz bound for the whole surface (Hart 1996, doi:10.1007/s003710050084; Génevaux 2015, section 7.1,
doi:10.1111/cgf.12530): slower, and there to compare with.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nodegraph import Context
from nodegraph.opencl import to_host
from nodegraph_render.height_field import SHIFT, Floats, HeightField, height_field, slopes, steepest
from nodegraph_render.raster_reference import trace_on_host
from nodegraph_render.rays import SKY, Hits, Rays
from nodegraph_render.tracers import Method, Tracer
from nodegraph_terrain.raster import Elevation
from nodegraph_terrain.voids import fill_voids

if TYPE_CHECKING:
    from nodegraph.opencl import Device

KERNELS = Path(__file__).parent.joinpath("kernels/raster.cl")

EPSILON = 1e-3
"""By default, ``plain`` is at the ground where it is nearer than this share of a cell above it."""

BAND = 1 << 16
"""Rays that are followed between two looks whether the run was cancelled."""

GROUP = 256
"""Rays of a work group."""


def raster_tracer(
    surface: Elevation,
    device: Device | None,
    context: Context,
    *,
    method: Method = "accelerated",
    epsilon: float | None = None,
    smooth: bool = True,
) -> Tracer:
    """Prepare a raster, and return what follows rays to it.

    Preparing takes time linear in the cells and, with `smooth`, three times the memory of the raster.  A ray then
    visits about as many blocks as the logarithm of the raster's side, and more where it grazes the ground.

    On a device rays are float32: they hit within about 2^-23 of the distance they went, or of the side of the raster
    if that is longer (a centimetre at 80 km); coordinates as large as those of UTM cost nothing, as they are made
    relative to the raster in float64.  Without a device all is float64.

    Args:
        surface: heights, in metres on the ground too; void cells, and the quads of which they are corners, are no
            ground.
        device: what follows the rays; None: NumPy.
        context: for progress and cancelling, of this call and of those of the tracer.
        method: see the module.
        epsilon: ``plain`` counts it as a hit where the ray is less than this above the surface, m; by default a
            thousandth of a cell.
        smooth: make normals from Horn's gradient at the centres of cells, bilinear between them, so that quads do not
            show as facets; else those of the quads themselves.  The normal of a wall is horizontal.

    Returns:
        A tracer whose steps are blocks and quads visited (``accelerated``) or evaluations of the surface (``plain``).
        It raises `ValueError` for rays that are not finite, and `Cancelled`.

    Raises:
        ValueError: the raster is in degrees, has infinite heights or 2^30 cells, or `epsilon` is not above 0.
    """
    if epsilon is not None and not 0 < epsilon < np.inf:
        raise ValueError(f"epsilon is {epsilon:g} m and must be above 0")
    surface = to_host(surface)
    field = height_field(surface, context)
    gradient = slopes(field, context) if smooth else None
    march = None
    if method == "plain" and np.isfinite(field.top):
        if np.isnan(surface.data).any():
            # One bound for all holds across voids only where they are bridged.
            field = replace(field, heights=fill_voids(surface, context=context).data)
        bound = steepest(field.heights, field.cell, context) * (1 + 1e-6)
        march = bound, EPSILON * min(field.cell) if epsilon is None else epsilon
    if min(field.quads) < 1:
        return lambda rays: _nothing(_count(rays))
    if device is not None:
        return _on_device(field, gradient, march, device, context)

    def on_host(rays: Rays) -> Hits:
        hits: tuple[Any, ...] = _nothing(_count(rays))
        for part, band in _bands(rays):
            context.progress()
            found = trace_on_host(field, gradient, march, band)
            for whole, piece in zip(hits, found, strict=True):
                whole[part] = piece
        return Hits(*hits)

    return on_host


def _on_device(
    field: HeightField, gradient: Floats | None, march: tuple[float, float] | None, device: Device, context: Context
) -> Tracer:
    lanes = lanes_of(device)
    program = device.program(KERNELS, SHIFT=SHIFT, LANES=lanes, PLAIN=march is not None, SMOOTH=gradient is not None)
    heights, pyramid, levels = map(device.from_host, (field.heights, field.pyramid, field.levels))
    slope = None if gradient is None else device.from_host(gradient)
    ground = (heights, pyramid, levels, len(levels) - 1, *heights.shape, field.bottom, field.top, *field.cell, slope)

    def on_device(rays: Rays) -> Hits:
        count = _count(rays)
        out: list[Any] = [
            device.empty(count),
            device.empty((count, 3)),
            device.empty(count, np.int8),
            device.empty(count, np.int32),
        ]
        for part, band in _bands(rays):
            # While the device follows one band, this thread prepares the next.
            origin, direction = field.gridded(band.origin, band.direction)
            given: list[Any] = []
            for item in (origin, direction, np.reshape(band.reach, (-1, 1))):
                given += [device.from_host(item.astype(np.float32)), item.shape[1] if len(item) > 1 else 0]
            device.finish()
            context.progress()
            size = -(-(part.stop - part.start) // GROUP) * GROUP // lanes
            arguments = (*ground, *given, part.stop - part.start, part.start, *(march or (0.0, 0.0)), *out)
            device.run(program, "trace", size, *arguments, local_size=GROUP // lanes)
        device.finish()
        return Hits(*map(device.to_host, out))

    return on_device


def lanes_of(device: Device) -> int:
    """Return how many rays a work item follows at a time: a vector of them on a CPU, one elsewhere."""
    if device.info.kind != "cpu":
        return 1
    return 16 if device.context.devices[0].native_vector_width_float >= 16 else 8


def _count(rays: Rays) -> int:
    return int(np.broadcast_shapes(rays.origin.shape, rays.direction.shape, (1, 3))[0])


def _bands(rays: Rays) -> Iterator[tuple[slice, Rays]]:
    """Yield rays in bands, checked.  What all share, an origin, a direction or a reach, stays one."""
    reach = np.atleast_1d(np.asarray(rays.reach, np.float64))
    for first in range(0, count := _count(rays), BAND):
        part = slice(first, min(count, first + BAND))
        origin, direction, limit = (
            item[part] if len(item) > 1 else item for item in (rays.origin, rays.direction, reach)
        )
        # A sum is finite where all of it is.
        if not np.isfinite(origin.sum() + direction.sum()) or np.isnan(limit).any():
            raise ValueError(
                f"rays {part.start} to {part.stop - 1} have origins, directions or reaches that are no numbers"
            )
        yield part, Rays(origin, direction, limit)


def _nothing(count: int) -> Hits:
    return Hits(
        np.full(count, np.inf, np.float32),
        np.zeros((count, 3), np.float32),
        np.full(count, SKY, np.int8),
        np.zeros(count, np.int32),
    )
