"""Pictures in one step: traced and shaded band by band, so that any size needs memory for the picture alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nodegraph import Context, Forecast, node, whole
from nodegraph_render.camera import Camera
from nodegraph_render.shade import (
    Exposure,
    Meters,
    SkyRays,
    Style,
    Tones,
    Visibility,
    exposed,
    extent_of,
    light_heights,
    lit_picture,
)
from nodegraph_render.sun import Sun
from nodegraph_render.surface import Surface
from nodegraph_render.tone import BALANCE, encoded, toned
from nodegraph_render.trace import (
    Floor,
    Height,
    Looked,
    Range,
    Share,
    Supersampling,
    Width,
    check_above_ground,
    traced,
)
from nodegraph_render.tracers import Settings, Tracer, nearest, surface_tracer
from nodegraph_render.twin import same_on_device
from nodegraph_terrain.raster import Image

BAND = 1 << 22
"""Samples that are traced and shaded at a time, about."""
BYTES = 80
"""Bytes that each of them takes."""
HALO = 4
"""Rows of pixels beyond a band that its light and shade depend on; rays are spread over blocks of as many."""
METERED = 1 << 16
"""Samples of the small picture by which one of several bands is exposed."""


@node(version=1, locality=whole)
def picture(
    camera: Camera,
    sun: Sun | None = None,
    *surfaces: Surface,
    width: Width = 1920,
    height: Height = 1080,
    supersampling: Supersampling = 2,
    visibility: Visibility = 80.0,
    exposure: Exposure = 0.0,
    metering: Meters = "picture",
    curve: Tones = "filmic",
    sky_rays: SkyRays = 8,
    epsilon: Floor = 0.01,
    share: Share = 1e-4,
    extent: Looked = None,
    view_range: Range = None,
    context: Context,
) -> Image:
    """Render a picture: `sphere_trace` and `shade` in one, in bands of rows.

    A trace of a picture takes 21 bytes a sample; here they live for a band of some four million samples, and a picture
    of a gigapixel takes 3 GB.  A picture of one band is what the two nodes give.  One of several is exposed by a small
    picture of the same view, of 65,536 samples; bands overlap by as much as light and shade look around, so that no
    seam shows.

    Args:
        camera: from where.
        sun: where light comes from; by default in the north-west, 35 degrees high.
        surfaces: what is looked at: ground, water, and so on.
        width, height, supersampling, epsilon, share, extent, view_range: as of `sphere_trace`.
        visibility, exposure, metering, curve, sky_rays: as of `shade`.
        context: the engine's.

    Returns:
        sRGB colours, uint8, with the extent that `shade` states.

    Raises:
        ValueError: the camera is under the ground, there is no surface, or no terrain lies in the extent.
    """
    settings = Settings("accelerated", epsilon, share, extent, view_range, height * supersampling)
    style = Style(visibility, exposure, metering, curve, sky_rays)
    return render_picture(camera, sun or Sun(), surfaces, (height, width), supersampling, settings, style, context)


same_on_device(picture, rtol=0, atol=2)


@picture.forecast
def _forecast(*_: Forecast | None, width: int, height: int, supersampling: int, **__: object) -> Forecast:
    return Forecast(3 * width * height, band_bytes(height, width, supersampling))


def band_bytes(rows: int, cols: int, supersampling: int) -> int:
    """Return the bytes that rendering a picture takes beside itself."""
    taken = min(rows, _band_rows(cols, supersampling) + 2 * HALO)
    return BYTES * taken * cols * supersampling**2


def render_picture(
    camera: Camera,
    sun: Sun,
    surfaces: tuple[Surface, ...],
    size: tuple[int, int],
    supersampling: int,
    settings: Settings,
    style: Style,
    context: Context,
    prepared: Sequence[Tracer | None] = (),
) -> Image:
    """Return a picture of (rows, cols) pixels; see `picture`.

    Args:
        camera, sun, surfaces: the scene, on the host.
        size, supersampling, settings, style: of the picture.
        context: for progress and cancelling, and for the device to compute on, or None.
        prepared: tracers of the surfaces that have one already; those of rasters suit any camera.
    """
    if not surfaces:
        raise ValueError("there is nothing to look at; link an elevation raster or a construction tree")
    tracers = [
        known or surface_tracer(surface, camera, settings, context.device, context)
        for surface, known in zip(surfaces, prepared or [None] * len(surfaces), strict=True)
    ]
    check_above_ground(camera, surfaces, nearest(tracers))
    scene = _Scene(camera, sun, surfaces, tracers, supersampling, settings, style)
    rows, cols = size
    step = _band_rows(cols, supersampling)
    stops, heights, begun = None, None, 0.0
    if rows > step + 2 * HALO:
        begun = 0.02
        small = math.sqrt(METERED / (rows * cols))
        low, narrow = max(1, round(rows * small)), max(1, round(cols * small))
        heights, stops = _metered(scene, (low, narrow), within(context, 0.0, begun))
    else:
        step = rows
    colours = np.empty((rows, cols, 3), np.uint8)
    for first in range(0, rows, step):
        last = min(first + step, rows)
        above, below = min(HALO, first), min(HALO, rows - last)
        part = within(context, begun + (1 - begun) * first / rows, begun + (1 - begun) * last / rows)
        view = camera.band(rows, first - above, last + below) if step < rows else camera
        light, exposure, _ = _lit(scene, view, (last + below - first + above, cols), heights, stops, part)
        light = light[above : above + last - first] * (exposure * BALANCE).astype(np.float32)
        colours[first:last] = encoded(toned(light, style.curve), first)
    return Image(colours, extent_of(camera, surfaces, rows, cols))


def within(context: Context, start: float, stop: float) -> Context:
    """Return a context whose progress is a part, from `start` to `stop`, of that of another."""
    done = start

    def report(fraction: float | None, message: str) -> None:
        nonlocal done
        done = done if fraction is None else start + (stop - start) * fraction
        context.progress(done, message)

    return Context(context.node, device=context.device, report=report)


class _Scene(NamedTuple):
    camera: Camera
    sun: Sun
    surfaces: tuple[Surface, ...]
    tracers: list[Tracer]
    supersampling: int
    settings: Settings
    style: Style


def _lit(
    scene: _Scene,
    camera: Camera,
    size: tuple[int, int],
    heights: tuple[float, float] | None,
    stops: float | None,
    context: Context,
) -> tuple[np.ndarray, float, tuple[float, float]]:
    """Return the light of a view of the scene, its exposure, and the heights at which its sky was taken."""
    style = scene.style
    tracer, ahead = nearest(scene.tracers), within(context, 0.0, 0.3)
    trace = traced(camera, scene.surfaces, size, scene.supersampling, scene.settings, tracer, ahead)
    heights = heights or light_heights(trace)
    lit = lit_picture(
        trace,
        scene.tracers,
        scene.sun,
        1000 * style.visibility,
        style.sky_rays,
        within(context, 0.3, 1.0),
        heights,
    )
    if stops is None:
        stops = exposed(lit, style.metering) * 2**style.exposure
    return lit.light, stops, heights


def _metered(scene: _Scene, size: tuple[int, int], context: Context) -> tuple[tuple[float, float], float]:
    """Return the heights and the exposure of a small picture of the whole view."""
    _, stops, heights = _lit(scene._replace(supersampling=1), scene.camera, size, None, None, context)
    return heights, stops


def _band_rows(cols: int, supersampling: int) -> int:
    return max(2, BAND // (HALO * cols * supersampling**2)) * HALO
