"""Tracing a scene from a camera: which surface each pixel sees, and where."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, port_type
from nodegraph_render.camera import Camera
from nodegraph_render.rays import SKY, Rays
from nodegraph_render.surface import Surface
from nodegraph_render.tracers import Method, Settings, Tracer, scene_tracer
from nodegraph_render.twin import same_on_device

Edges = tuple[float, float, float, float]

BAND = 1 << 19
"""Rays that are made at a time."""
BYTES = 4 + 12 + 1 + 4
"""Bytes of a ray in a trace."""

Width = Annotated[int, Param("Width of the picture.", ge=1, le=100_000, unit="pixels")]
Height = Annotated[int, Param("Height of the picture.", ge=1, le=100_000, unit="pixels")]
Supersampling = Annotated[int, Param("Rays along each side of a pixel; their mean smooths edges.", ge=1, le=8)]
How = Annotated[Method, Param("Bounds of small parts of a tree, or of all of it (to compare).")]
Floor = Annotated[
    float, Param("Height above a construction tree at which a ray has hit it, beside the eye.", gt=0, le=1e3, unit="m")
]
Share = Annotated[float, Param("What is added to epsilon for each metre of distance.", ge=0, le=0.1)]
Looked = Annotated[
    Edges | None, Param("West, south, east, north of what is shown of construction trees; else all.", unit="m")
]
Range = Annotated[
    float | None,
    Param("Distance at which construction trees have no detail left; else all everywhere.", gt=0, unit="m"),
]


@port_type
class Trace:
    """What each ray of a picture hits, with k x k rays for each pixel.

    Attributes:
        camera: from where.
        surfaces: the layers of the scene.
        supersampling: k.
        depth: distance along the ray, m, (k rows, k cols) float32; infinite where it meets the sky.
        normal: upward unit normal, (k rows, k cols, 3) float32; zero in the sky.
        layer: index into `surfaces`, (k rows, k cols) int8; -1 for the sky.
        steps: evaluations of the surfaces along the ray, (k rows, k cols) int32.
        settings: how rays were followed, so that those of the shading meet the same ground.
    """

    camera: Camera
    surfaces: tuple[Surface, ...]
    supersampling: int
    depth: npt.NDArray[Any]
    normal: npt.NDArray[Any]
    layer: npt.NDArray[Any]
    steps: npt.NDArray[Any]
    settings: Settings = Settings()

    @property
    def hit(self) -> npt.NDArray[np.bool_]:
        """True where a ray hits a surface."""
        return np.asarray(self.layer != SKY)

    @property
    def position(self) -> npt.NDArray[np.float64]:
        """Where the rays hit, (k rows, k cols, 3) float64, m; infinite in the sky."""
        rows, cols = self.depth.shape
        rays = self.camera.rays(rows, cols)
        with np.errstate(invalid="ignore"):
            return np.asarray(rays.at(self.depth.reshape(-1))).reshape(rows, cols, 3)


@node(version=1)
def sphere_trace(
    camera: Camera,
    *surfaces: Surface,
    width: Width = 1920,
    height: Height = 1080,
    supersampling: Supersampling = 1,
    method: How = "accelerated",
    epsilon: Floor = 0.01,
    share: Share = 1e-4,
    extent: Looked = None,
    view_range: Range = None,
    context: Context,
) -> Trace:
    """Follow a ray through each pixel of a picture to the first surface it meets, missing none.

    Construction trees are sphere-traced: from a point h metres above the terrain a ray goes on by h / rate metres,
    where rate = |u_xy| lambda - u_z and lambda bounds the slope of the terrain around it, and has hit where h is below
    epsilon(t) = `epsilon` + `share` t.  ``accelerated`` takes lambda from a quadtree of local bounds and skips what the
    ray passes above; ``plain`` takes one for all.  Rasters are intersected exactly, patch by patch (bilinear between
    the centres of their cells).  Terrain is solid: at its border, and around voids, a ray meets a wall.

    Args:
        camera: from where.
        surfaces: what is looked at: ground, water, and so on.
        width, height: of the picture.
        supersampling: k, for k x k rays in a pixel.
        method: ``accelerated`` or ``plain``.
        epsilon, share: see above; the defaults are a seventh of a pixel of a 1080-line picture.
        extent: what is shown of construction trees.
        view_range: for detail that falls with distance.
        context: the engine's.

    Returns:
        depth, normal, layer and number of steps of each ray; all sky where no terrain is in view.

    Raises:
        ValueError: the camera is under the ground, there is no surface, or no terrain lies in the extent.

    Source: Génevaux et al. 2015, section 7, doi:10.1111/cgf.12530, with the corrections in `tree_tracer`.
    """
    settings = Settings(method, epsilon, share, extent, view_range, height * supersampling)
    tracer = scene_tracer(surfaces, camera, settings, context.device, context)
    check_above_ground(camera, surfaces, tracer)
    return traced(camera, surfaces, (height, width), supersampling, settings, tracer, context)


same_on_device(sphere_trace, rtol=2e-3, atol=0.05, back=False)


@sphere_trace.forecast
def _forecast(*_: Forecast, width: int, height: int, supersampling: int, **__: object) -> Forecast:
    return Forecast(BYTES * width * height * supersampling**2, 200 * BAND)


def traced(
    camera: Camera,
    surfaces: tuple[Surface, ...],
    size: tuple[int, int],
    supersampling: int,
    settings: Settings,
    tracer: Tracer,
    context: Context,
) -> Trace:
    """Return what the rays of a picture of `size` (rows, cols) hit, by the tracer of its surfaces."""
    rows, cols = size[0] * supersampling, size[1] * supersampling
    depth, normal = np.empty((rows, cols), np.float32), np.empty((rows, cols, 3), np.float32)
    layer, steps = np.empty((rows, cols), np.int8), np.empty((rows, cols), np.int32)
    band = max(1, BAND // cols)
    for first in range(0, rows, band):
        context.progress(first / rows)
        last = min(first + band, rows)
        hits = tracer(camera.rays(rows, cols, first, last))
        part = slice(first * cols, last * cols)
        depth.reshape(-1)[part], normal.reshape(-1, 3)[part] = hits.depth, hits.normal
        layer.reshape(-1)[part], steps.reshape(-1)[part] = hits.layer, hits.steps
    return Trace(camera, surfaces, supersampling, depth, normal, layer, steps, settings)


def check_above_ground(camera: Camera, surfaces: tuple[Surface, ...], tracer: Tracer) -> None:
    """Raise `ValueError` when a camera stands in the ground."""
    up = Rays(np.array([camera.eye], np.float64), np.array([[0.0, 0.0, 1.0]]))
    hit = tracer(up)
    if hit.layer[0] != SKY and hit.depth[0] == 0:
        name = surfaces[int(hit.layer[0])].material.name
        x, y, z = camera.eye
        raise ValueError(f"the camera at ({x:g}, {y:g}, {z:g}) is under the {name}; raise its eye")
