"""One number for each ray of a traced picture, as a raster: for compositing, for measuring, for the curious."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Forecast, Param, node, whole
from nodegraph_render.shade import extent_of
from nodegraph_render.trace import Trace
from nodegraph_terrain.raster import Extent, Raster

Channel = Literal["depth", "elevation", "layer", "hit", "steps", "normal_east", "normal_north", "normal_up"]
NORMALS = ("normal_east", "normal_north", "normal_up")


@node(version=1, locality=whole)
def trace_channel(trace: Trace, *, channel: Annotated[Channel, Param("What to take of each ray.")] = "depth") -> Raster:
    """Take one number of each ray of a traced picture.

    - ``depth``: distance along the ray, m.
    - ``elevation``: height of the point that was hit, m.
    - ``layer``: number of the surface that was hit, in the order of the links from 0.
    - ``hit``: 1, or 0 in the sky.
    - ``steps``: how often the surfaces were asked along the ray.
    - ``normal_east``, ``normal_north``, ``normal_up``: the upward unit normal.

    `terrain.colour_relief` makes a picture of it, `terrain.statistics` tells its range, mean and histogram, and
    `terrain.save_elevation` writes it as it is.

    Args:
        trace: from `render.sphere_trace`.
        channel: see above.

    Returns:
        float32, a cell for each ray; void in the sky but for ``hit`` and ``steps``.  A camera that looks straight down
        on a map gives the map's extent, any other one metre for each ray.
    """
    return Raster(_channel(trace, channel).astype(np.float32), _extent(trace))


@trace_channel.forecast
def _forecast(trace: Forecast, **_: object) -> Forecast:
    return Forecast(trace.bytes // 5, 2 * trace.bytes)


def _channel(trace: Trace, channel: Channel) -> npt.NDArray[Any]:
    if channel == "hit":
        return trace.hit
    if channel == "steps":
        return trace.steps
    if channel == "layer":
        found = trace.layer
    elif channel == "depth":
        found = trace.depth
    elif channel == "elevation":
        found = trace.position[:, :, 2]
    else:
        found = trace.normal[:, :, NORMALS.index(channel)]
    return np.where(trace.hit, found, np.nan)


def _extent(trace: Trace) -> Extent:
    return extent_of(trace.camera, trace.surfaces, *trace.depth.shape)


def preview_trace(trace: Trace) -> bytes:
    """Draw the normals of a trace in a soft light, as a PNG."""
    from nodegraph_terrain.formats.png import png

    light = np.clip(trace.normal @ np.array([-0.5, 0.35, 0.8], np.float32), 0, 1)
    grey = np.where(trace.hit, 40 + 200 * light, 225).astype(np.uint8)
    return png(np.repeat(grey[:, :, None], 3, axis=2))
