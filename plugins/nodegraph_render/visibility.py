"""How much of the sun and of the sky each sample of a trace sees."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_render.lighting import Scene
from nodegraph_render.occlusion import Facets, sky_share, smoothed, sun_share, turns
from nodegraph_render.pixels import Halves, bands, spots
from nodegraph_render.trace import Trace

EDGE = 16
"""Rays to the sun from each sample near the edge of a shadow."""

ALONE = 16
"""Rays into the sky from a sample that no neighbour helps."""

NEAR = 5
"""Side of the window, in samples, in which light and shadow must meet for an edge."""


def sun_shares(trace: Trace, scene: Scene, context: Context) -> Halves:
    """Return the share of the sun that each sample sees; 0 in the sky.

    One ray each, aimed at another part of the disc by each of 4 by 4 neighbours.  Where these disagree, the edge of a
    shadow is near, and many rays follow.
    """
    from scipy import ndimage

    high, wide = trace.depth.shape
    share, facing = np.zeros((high, wide), np.float16), np.zeros((high, wide), np.bool_)
    if not scene.sky.sun.any():
        return share
    towards = scene.sky.direction.astype(np.float32)
    for part in bands(trace, context, 0.0, 0.1):
        _, hit, found = spots(trace, part)
        facing[part] = hit.reshape(-1, wide) & (trace.normal[part] @ towards > 0)
        share[part][hit.reshape(-1, wide)] = sun_share(scene.tracer, found, scene.sun, _turns(part, wide)[hit], 1)
    if scene.sun.diameter > 0:
        lit, dark = share > 0, share == 0
        for part in bands(trace, context, 0.1, 0.25):
            around = slice(max(0, part.start - NEAR // 2), part.stop + NEAR // 2)
            near = [ndimage.maximum_filter(flags[around] & facing[around], NEAR) for flags in (lit, dark)]
            own = slice(part.start - around.start, part.stop - around.start)
            edge = near[0][own] & near[1][own] & facing[part]
            if edge.any():
                _, hit, found = spots(trace, part)
                on = edge.ravel()
                many = sun_share(scene.tracer, found.taken(on[hit]), scene.sun, _turns(part, wide)[on], EDGE)
                share[part][edge] = many
    return share


def sky_shares(trace: Trace, scene: Scene, rays: int, context: Context) -> Halves:
    """Return the share of the sky that each sample sees; 1 in the sky, and everywhere for 0 rays.

    Followed from one sample of each pixel and smoothed; samples on another surface than that one get rays of their own.
    """
    (high, wide), k = trace.depth.shape, trace.supersampling
    share = np.ones((high, wide), np.float16)
    if rays == 0 or not trace.hit.any():
        return share
    rows, cols = high // k, wide // k
    eye = np.array(trace.camera.eye)
    facets = Facets(
        position=np.zeros((rows, cols, 3), np.float32),
        normal=np.zeros((rows, cols, 3), np.float32),
        footprint=np.zeros((rows, cols), np.float32),
        hit=np.ascontiguousarray(trace.hit[k // 2 :: k, k // 2 :: k]),
    )
    values = np.ones((rows, cols), np.float32)
    for part in bands(trace, context, 0.25, 0.4):
        _, hit, found = spots(trace, part)
        chosen = np.zeros((part.stop - part.start, wide), np.bool_)
        chosen[k // 2 :: k, k // 2 :: k] = True
        own = found.taken(chosen.ravel()[hit])
        i, j = np.nonzero(facets.hit[part.start // k : part.stop // k])
        i += part.start // k
        facets.position[i, j], facets.normal[i, j] = own.position - eye, own.normal
        facets.footprint[i, j] = own.footprint * np.float32(k)
        values[i, j] = sky_share(scene.tracer, own, turns(i, j), rays)
    values = smoothed(values, facets, context)
    for part in bands(trace, context, 0.4, 0.6):
        _, hit, found = spots(trace, part)
        i, j = np.nonzero(hit.reshape(-1, wide))
        i += part.start
        pixel = i // k, j // k
        result = values[pixel]
        if k > 1:
            apart = (found.position - eye).astype(np.float32) - facets.position[pixel]
            alone = ~(facets.hit[pixel] & facets.same(apart, found.normal, pixel))
            if alone.any():
                turn = turns(i[alone], j[alone])
                result[alone] = sky_share(scene.tracer, found.taken(alone), turn, ALONE)
        share[i, j] = result
    return share


def _turns(part: slice, wide: int) -> npt.NDArray[np.intp]:
    """Return the turns of the samples of some rows."""
    return turns(np.arange(part.start, part.stop)[:, None], np.arange(wide)[None, :]).ravel()
