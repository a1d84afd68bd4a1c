"""Shading: from what each ray of a picture hits to the picture."""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

import numpy as np

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_render import pixels
from nodegraph_render.atmosphere import Air
from nodegraph_render.camera import Camera
from nodegraph_render.lighting import Scene
from nodegraph_render.material import Water
from nodegraph_render.rays import Singles
from nodegraph_render.sky import Sky
from nodegraph_render.sun import Sun
from nodegraph_render.surface import Surface
from nodegraph_render.tone import BALANCE, Curve, automatic, encoded, metered, toned
from nodegraph_render.trace import Trace
from nodegraph_render.tracers import Tracer, nearest, surface_tracer
from nodegraph_render.twin import same_on_device
from nodegraph_render.visibility import sky_shares, sun_shares
from nodegraph_terrain.raster import Extent, Image

Metering = Literal["picture", "sun"]

BRIGHTEST = 30.0
"""Exposed light beyond which a sample counts no more in the mean of its pixel; 1 is white."""


Visibility = Annotated[
    float, Param("How far one sees through the air at sea level; haze hides what is farther.", ge=1, le=280, unit="km")
]
Exposure = Annotated[float, Param("Stops brighter than the automatic exposure.", ge=-20, le=20)]
Meters = Annotated[
    Metering, Param("Automatic exposure from what the picture shows, or from the sun alone: the same in each frame.")
]
Tones = Annotated[Curve, Param("How light beyond white is kept: as film does, gently, or not at all.")]
SkyRays = Annotated[int, Param("Rays into the sky from each pixel; 0: none stands in its way.", ge=0, le=256)]


class Style(NamedTuple):
    """How a picture is lit and developed; see `shade`."""

    visibility: float = 80.0
    exposure: float = 0.0
    metering: Metering = "picture"
    curve: Curve = "filmic"
    sky_rays: int = 8


class Lit(NamedTuple):
    """A picture in linear light.

    Attributes:
        light: radiance of each pixel, (rows, cols, 3) float32, in parts of the sun's irradiance above the air per
            steradian.
        land: share of each pixel that is not sky, (rows, cols) float32.
        sky: the light on the ground.
    """

    light: Singles
    land: Singles
    sky: Sky


@node(version=1, locality=whole)
def shade(
    trace: Trace,
    sun: Sun | None = None,
    *,
    visibility: Visibility = 80.0,
    exposure: Exposure = 0.0,
    metering: Meters = "picture",
    curve: Tones = "filmic",
    sky_rays: SkyRays = 8,
    context: Context,
) -> Image:
    """Light a traced picture: sun with soft shadows, sky, haze and water.

    - The sun's disc throws shadows by traced rays, soft by its width: one ray from each sample, and 16 where the edge
      of a shadow is near.  `sky_rays` rays from each pixel, other ones from each of 4 by 4 and gathered again, find how
      much of the sky each point sees.
    - The sky is that of a clear day by single and multiple scattering (Hillaire 2020) with the haze that `visibility`
      implies; it lights the ground by its nine first harmonics, stands behind it, and is mirrored by water.
    - In front of what is far the same air takes light away (Beer and Lambert) and adds what it scatters.  It is left
      out for an orthographic camera, which stands nowhere.
    - Ground diffuses by Lambert's law, L = albedo / pi (E_sun n.l + E_sky); see `ground`, `imagery` and `water`.
    - Pixels are means over their samples (`supersampling` of the trace) in linear light.  Automatic exposure, a tone
      curve (`nodegraph_render.tone`), and sRGB with dithering follow.

    Below the horizon the sun leaves twilight, then a night in which little more than the horizon shows.

    Args:
        trace: what `sphere_trace` gives.
        sun: where light comes from; by default in the north-west, 35 degrees high.
        visibility: at sea level, where contrast falls to 2 %; 280 km is air without any haze.
        exposure: each stop doubles the light.
        metering: ``picture`` goes part of the way to where woods, snow and skies against the sun look best, by 0.6
            stops up and 1.2 down at most; see `nodegraph_render.tone.metered`.
        curve: ``filmic``, ``reinhard`` or ``linear``.
        sky_rays: see above; they are most of the work.
        context: the engine's.

    Returns:
        sRGB colours, uint8.  A camera that looks straight down on a map, north up and orthographic, gives the map's
        extent; any other, one metre for each pixel.

    Raises:
        ValueError: the sun's angles are not finite.

    References:
        S. Hillaire (2020): A scalable and production ready sky and atmosphere rendering technique. Computer Graphics
        Forum 39(4). doi:10.1111/cgf.14050.
        R. Ramamoorthi, P. Hanrahan (2001): An efficient representation for irradiance environment maps. SIGGRAPH.
        doi:10.1145/383259.383317.
    """
    tracers = [
        surface_tracer(surface, trace.camera, trace.settings, context.device, context) for surface in trace.surfaces
    ]
    lit = lit_picture(trace, tracers, sun or Sun(), 1000 * visibility, sky_rays, context)
    stops = exposed(lit, metering) * 2**exposure
    developed = lit.light * (stops * BALANCE).astype(np.float32)
    high, wide = lit.light.shape[:2]
    return Image(encoded(toned(developed, curve)), extent_of(trace.camera, trace.surfaces, high, wide))


def exposed(lit: Lit, metering: Metering) -> float:
    """Return the automatic exposure of a picture."""
    return automatic(lit.sky) if metering == "sun" else metered(lit.light, lit.land, lit.sky)


same_on_device(shade, rtol=0, atol=2)


@shade.forecast
def _forecast(trace: Forecast, *_: Forecast | None, **__: object) -> Forecast:
    # A trace has 21 bytes a sample; the shares take 4, the pixels 16 at most.
    return Forecast(trace.bytes // 7, trace.bytes, trace.about)


def lit_picture(
    trace: Trace,
    tracers: list[Tracer],
    sun: Sun,
    visibility: float,
    sky_rays: int,
    context: Context,
    heights: tuple[float, float] | None = None,
) -> Lit:
    """Return the light of each pixel of a trace.

    Args:
        trace: what rays hit.
        tracers: one for each of its surfaces.
        sun: where light comes from.
        visibility: m.
        sky_rays: rays into the sky from each pixel.
        context: for progress and cancelling, and for the device to compute on, or None.
        heights: at which the sky is taken, if not those of this trace; see `light_heights`.

    Raises:
        ValueError: the sun's angles are not finite.
    """
    if not all(map(math.isfinite, (sun.azimuth, sun.altitude, sun.diameter))):
        raise ValueError("the sun's azimuth, altitude and diameter must be finite numbers")
    air = Air.of_visibility(visibility)
    beyond, level = heights or light_heights(trace)
    context.progress(0.0)
    seen, light = Sky.over(beyond, sun, air), Sky.over(level, sun, air)
    dry = [number for number, surface in enumerate(trace.surfaces) if not isinstance(surface.material, Water)]
    bed = nearest([tracers[number] for number in dry]) if 0 < len(dry) < len(tracers) else None
    scene = Scene(trace.surfaces, nearest(tracers), bed, tuple(dry), sun, light)
    sunny = sun_shares(trace, scene, context)
    open_ = sky_shares(trace, scene, sky_rays, context)
    frame = pixels.Frame(trace, scene, seen, sunny, open_, BRIGHTEST / automatic(light))
    device = context.device
    picture = pixels.on_host(frame, context) if device is None else pixels.on_device(frame, device, context)
    (high, wide), k = trace.depth.shape, trace.supersampling
    land = trace.hit.reshape(high // k, k, wide // k, k).mean(axis=(1, 3), dtype=np.float32)
    return Lit(picture, land, light)


def light_heights(trace: Trace) -> tuple[float, float]:
    """Return the heights at which the sky is taken: of the eye for what stands behind, of the ground for its light."""
    eye = trace.camera.eye[2]
    found = [pixels.spots(trace, slice(row, row + 1))[2].position[:, 2] for row in _some(trace.depth.shape[0])]
    heights = np.concatenate(found)
    level = float(np.median(heights)) if len(heights) else eye
    return (eye if trace.camera.field_of_view else level), level


def _some(count: int) -> list[int]:
    return sorted({count * part // 16 for part in range(16)})


def extent_of(camera: Camera, surfaces: tuple[Surface, ...], rows: int, cols: int) -> Extent:
    """Return what a picture covers: the map below a camera that looks straight down, else its pixels."""
    if _is_map(camera):
        half, x, y = camera.span / 2, camera.eye[0], camera.eye[1] + camera.rise * camera.span
        across = half * cols / rows
        systems = {surface.raster.extent.crs for surface in surfaces if surface.raster is not None}
        crs = systems.pop() if len(systems) == 1 else ""
        return Extent(x - across, y - half, x + across, y + half, crs)
    return Extent(0.0, 0.0, cols, rows)


def _is_map(camera: Camera) -> bool:
    return camera.field_of_view == 0 and bool(np.allclose(camera.axes[1:], [(0, 1, 0), (0, 0, -1)], atol=1e-9))
