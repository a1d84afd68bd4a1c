"""How steep the ground is, and which way it faces."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from nodegraph import Context, Param, halo, node
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.gradient import horn_gradient, require_projected
from nodegraph_terrain.raster import Elevation, Raster, Slope


@node(version=1, locality=halo(cells=1))
def slope(
    surface: Elevation,
    *,
    z_factor: Annotated[float, Param("Vertical exaggeration.", gt=0)] = 1.0,
    context: Context,
) -> Slope:
    """Give the steepness of the ground in degrees.

    slope = atan(z_factor |grad z|), with the gradient by Horn's (1981) 3 x 3 weights: exact on planes, and less
    shaken by noise than plain differences.  On the outer rows and columns, and beside voids, a missing neighbour
    counts as the point reflection of its opposite through the cell, which gives one-sided differences and keeps
    planes exact.  Void cells stay void.

    Args:
        surface: elevation in metres; cells may be rectangular.
        z_factor: heights are multiplied by it.
        context: the engine's.

    Returns:
        Degrees from the horizontal, 0 to 90, of the same shape and extent.

    Raises:
        ValueError: the raster is in degrees.

    References:
        B. K. P. Horn (1981): Hill shading and the reflectance map. Proc. IEEE 69(1). doi:10.1109/PROC.1981.11918.
    """
    cell = require_projected(surface)
    steepness = np.empty_like(surface.data, order="C")
    for part in row_blocks(*surface.shape, context):
        east, north = horn_gradient(surface.data, part, cell)
        tangent = np.hypot(east, north, out=east)
        tangent *= np.float32(z_factor)
        np.degrees(np.arctan(tangent, out=tangent), out=steepness[part])
    return Slope(steepness, surface.extent)


@node(version=1, locality=halo(cells=1))
def aspect(surface: Elevation, *, context: Context) -> Raster:
    """Give the compass direction that the ground faces, downhill, in degrees.

    aspect = atan2(-dz/dx, -dz/dy) clockwise from north: 0 faces north, 90 east, 180 south, 270 west.  The gradient is
    that of `slope`.  Level ground faces nowhere: it is void, as void cells are.

    Args:
        surface: elevation in metres; cells may be rectangular.
        context: the engine's.

    Returns:
        Degrees, 0 <= aspect < 360, of the same shape and extent.

    Raises:
        ValueError: the raster is in degrees.

    References:
        B. K. P. Horn (1981): Hill shading and the reflectance map. Proc. IEEE 69(1). doi:10.1109/PROC.1981.11918.
    """
    cell = require_projected(surface)
    facing = np.empty_like(surface.data, order="C")
    for part in row_blocks(*surface.shape, context):
        east, north = horn_gradient(surface.data, part, cell)
        level = (east == 0) & (north == 0)
        angle = np.degrees(np.arctan2(-east, -north))
        angle[angle < 0] += np.float32(360)
        # An angle a rounding below 0 has become 360, and -0.0 prints badly.
        angle[angle >= 360] = 0
        angle[level] = np.nan
        facing[part] = angle + np.float32(0)
    return Raster(facing, surface.extent)
