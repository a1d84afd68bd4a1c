"""Moving pictures: a flight along a path, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np

from nodegraph import Context, Forecast, Param, node, port_type, whole
from nodegraph_render.camera_path import CameraPath, Length
from nodegraph_render.picture import band_bytes, render_picture, within
from nodegraph_render.rays import Doubles
from nodegraph_render.sampling import bilinear
from nodegraph_render.shade import Exposure, Metering, SkyRays, Style, Tones, Visibility
from nodegraph_render.sun import Sun
from nodegraph_render.surface import Surface
from nodegraph_render.trace import Floor, Height, Looked, Range, Share, Supersampling, Width
from nodegraph_render.tracers import Settings, Tracer, surface_tracer
from nodegraph_render.twin import same_on_device
from nodegraph_terrain.raster import Image

FRAMES_MAX = 100_000
"""More frames than this are refused as a mistake: 55 minutes at 30 a second."""


@port_type
class Film:
    """A moving picture.

    Attributes:
        frames: the pictures, all of one size.
        frame_rate: of them each second.
        closed: the first may follow the last.
    """

    frames: tuple[Image, ...]
    frame_rate: float
    closed: bool = False

    def __post_init__(self) -> None:
        if not self.frames:
            raise ValueError("a film has one frame or more")
        if len({frame.data.shape for frame in self.frames}) > 1:
            raise ValueError("the frames of a film are all of one size")


@node(version=1, locality=whole)
def flight(
    path: CameraPath,
    sun: Sun | None = None,
    *surfaces: Surface,
    width: Width = 1280,
    height: Height = 720,
    frame_rate: Annotated[float, Param("Frames each second.", gt=0, le=240, unit="1/s")] = 30.0,
    duration: Annotated[
        float | None, Param("Fly along the path in this time; none: in its own.", gt=0, le=1e5, unit="s")
    ] = None,
    supersampling: Supersampling = 2,
    visibility: Visibility = 80.0,
    exposure: Exposure = 0.0,
    metering: Annotated[
        Metering, Param("One automatic exposure from the sun, or each frame's from what it shows.")
    ] = "sun",
    curve: Tones = "filmic",
    sky_rays: SkyRays = 8,
    epsilon: Floor = 0.01,
    share: Share = 1e-4,
    extent: Looked = None,
    view_range: Range = None,
    context: Context,
) -> Film:
    """Render a flight along a path, or a turntable: a picture for each frame, as `picture` makes them.

    Frames are at 0, 1 / `frame_rate`, ... seconds up to the end of the path; that of a closed one is left out, as it is
    the beginning again.  Each is remembered as soon as it is done: a flight that was cancelled or interrupted goes on
    with the first frame that is missing, and one that is only longer, or shown faster, shares those it has in common.

    Args:
        path: of the camera; see `path` and `turntable`.
        sun: where light comes from; by default in the north-west, 35 degrees high.
        surfaces: what is looked at.
        width, height, supersampling, epsilon, share, extent, view_range: as of `sphere_trace`.
        frame_rate, duration: see above.
        visibility, exposure, metering, curve, sky_rays: as of `shade`.
        context: the engine's.

    Returns:
        All frames, 3 bytes a pixel; `save_film` makes files of them.

    Raises:
        ValueError: the camera comes under the ground, there is no surface, no terrain lies in the extent, or there
            would be over 100,000 frames.
    """
    settings = Settings("accelerated", epsilon, share, extent, view_range, height * supersampling)
    style = Style(visibility, exposure, metering, curve, sky_rays)
    work = _Work(path, sun or Sun(), surfaces, (height, width), supersampling, settings, style, context)
    return _film(work, frame_rate, duration)


# The frames stay on the host, which writes them: a film is too large for a device.
same_on_device(flight, rtol=0, atol=2, back=False)


@flight.forecast
def _forecast(
    path: Forecast,
    *_: Forecast | None,
    width: int,
    height: int,
    frame_rate: float,
    duration: float | None,
    supersampling: int,
    **__: object,
) -> Forecast:
    peak, frame = band_bytes(height, width, supersampling), 3 * width * height
    if not isinstance(path.about, Length):
        return Forecast(frame, peak, known=False)
    count = frame_count(duration or path.about.seconds, path.about.closed, frame_rate)
    return Forecast(frame * count, peak)


def frame_count(seconds: float, closed: bool, frame_rate: float) -> int:
    """Return how many frames a path has."""
    return max(1, round(seconds * frame_rate) + (not closed))


@dataclass(frozen=True)
class _Work:
    """What the frames of a flight have in common."""

    path: CameraPath
    sun: Sun
    surfaces: tuple[Surface, ...]
    size: tuple[int, int]
    supersampling: int
    settings: Settings
    style: Style
    context: Context

    @cached_property
    def prepared(self) -> list[Tracer | None]:
        """Tracers of the rasters, which suit every frame; made for the first that has to be rendered."""
        camera, silent = self.path.camera(0.0), within(self.context, 0.0, 0.0)
        return [
            None if surface.raster is None else surface_tracer(surface, camera, self.settings, silent.device, silent)
            for surface in self.surfaces
        ]

    def frame(self, time: float, context: Context) -> Image:
        """Return the picture at a time of the path, remembered or rendered."""
        camera = self.path.camera(time)
        depends = camera, self.sun, self.surfaces, self.size, self.supersampling, self.settings, tuple(self.style)

        def render() -> Image:
            return render_picture(camera, *depends[1:6], self.style, context, self.prepared)

        try:
            return self.context.remembered(depends, render)
        except ValueError as error:
            raise ValueError(f"at {time:g} s of the path: {error}") from error


def _film(work: _Work, frame_rate: float, duration: float | None) -> Film:
    path, context = work.path, work.context
    count = frame_count(duration or path.duration, path.closed, frame_rate)
    if count > FRAMES_MAX:
        raise ValueError(f"the flight would have {count:,} frames, over {FRAMES_MAX:,}; take a lower frame rate")
    faster = path.duration / duration if duration else 1.0
    times = np.minimum(np.arange(count) / frame_rate * faster, path.duration)
    _check_above(work, times)
    frames = []
    for number, time in enumerate(times):
        context.progress(number / count, f"frame {number + 1} of {count}")
        frames.append(work.frame(float(time), within(context, number / count, (number + 1) / count)))
    return Film(tuple(frames), frame_rate, path.closed)


def _check_above(work: _Work, times: Doubles) -> None:
    """Raise `ValueError` where an eye is under a raster, before the first frame and not at the last."""
    eyes = work.path.at(times)[:, :3]
    for surface in work.surfaces:
        if surface.raster is not None:
            below = bilinear(surface.raster, eyes[:, 0], eyes[:, 1]) - eyes[:, 2]
            if (below > 0).any():
                first = int(np.argmax(below > 0))
                raise ValueError(
                    f"at {times[first]:g} s of the path the camera is {below[first]:g} m under the "
                    f"{surface.material.name}; raise its eye, or link the elevation to the path"
                )
