"""What follows rays to surfaces: one kind for rasters, one for construction trees, and the nearest hit of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from nodegraph import Context, port_type
from nodegraph_render.camera import Camera
from nodegraph_render.rays import SKY, Hits, Rays
from nodegraph_render.surface import Surface

if TYPE_CHECKING:
    from nodegraph.opencl import Device

Method = Literal["accelerated", "plain"]


class Tracer(Protocol):
    """Follows rays to the first point of what it stands for.

    A surface and all below it is solid: a ray that begins inside hits at depth 0.
    """

    def __call__(self, rays: Rays) -> Hits:
        """Return what the rays hit first; `Hits.layer` is the number of the surface, 0 for the only one."""
        ...


@port_type
class Settings:
    """How rays are followed.

    Attributes:
        method: ``accelerated`` uses bounds of small parts of the terrain, ``plain`` those of the whole.
        epsilon: m above a construction tree at which a ray has hit it, beside the eye.
        share: what is added to that for each metre of distance.
        extent: west, south, east, north of what is looked at of construction trees, m; else their support.
        view_range: distance at which no detail is left, m; else all detail is everywhere.
        lines: how many lines of rays the picture has: bounds are as fine as that many repay.
    """

    method: Method = "accelerated"
    epsilon: float = 0.01
    share: float = 1e-4
    extent: tuple[float, float, float, float] | None = None
    view_range: float | None = None
    lines: int = 1080


def scene_tracer(
    surfaces: Sequence[Surface], camera: Camera, settings: Settings, device: Device | None, context: Context
) -> Tracer:
    """Return what follows rays to the nearest of several surfaces.

    Args:
        surfaces: the layers of the scene; where two are equally near the later one counts.
        camera: bounds are finer where it looks; rays may come from anywhere.
        settings: see there.
        device: where to compute, or None.
        context: for progress and cancelling.

    Raises:
        ValueError: there is nothing to look at, or the extent is empty.
    """
    if not surfaces:
        raise ValueError("there is nothing to look at; link an elevation raster or a construction tree")
    return nearest([surface_tracer(surface, camera, settings, device, context) for surface in surfaces])


def nearest(tracers: Sequence[Tracer]) -> Tracer:
    """Return what follows rays to the nearest of several; layers are their numbers, and of equals the later counts."""

    def trace(rays: Rays) -> Hits:
        best = tracers[0](rays)
        for number, tracer in enumerate(tracers[1:], 1):
            found = tracer(rays.within(np.minimum(rays.reach, best.depth)))
            nearer = (found.layer != SKY) & (found.depth <= best.depth)
            best = Hits(
                np.where(nearer, found.depth, best.depth),
                np.where(nearer[:, None], found.normal, best.normal),
                np.where(nearer, np.int8(number), best.layer),
                best.steps + found.steps,
            )
        return best

    return trace


def surface_tracer(
    surface: Surface, camera: Camera, settings: Settings, device: Device | None, context: Context
) -> Tracer:
    """Return what follows rays to one surface; arguments as for `scene_tracer`."""
    if surface.raster is not None:
        from nodegraph_render.raster_tracer import raster_tracer

        return raster_tracer(surface.raster, device, context, method=settings.method, epsilon=settings.epsilon)
    from nodegraph_render.outlook import outlook
    from nodegraph_render.tree_tracer import Epsilon, tree_tracer

    assert surface.function is not None
    tree = outlook(surface.function, camera, settings.extent, settings.view_range, context, settings.lines)
    epsilon = Epsilon(settings.epsilon, settings.share)
    return tree_tracer(surface.function, tree, camera.eye, device, context, method=settings.method, epsilon=epsilon)
