"""Topographic wetness: where water gathers and stays."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np

from nodegraph import Context, Param, halo, node
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.gradient import horn_gradient, require_projected
from nodegraph_terrain.raster import Elevation, Raster, require_same_grid
from nodegraph_texture.quantities import Wetness


@node(version=1, locality=halo(cells=1))
def wetness(
    surface: Elevation,
    area: Raster,
    *,
    least_slope: Annotated[
        float, Param("Flatter ground counts as this steep, rise per run; 0.001 is 1 m in 1 km.", gt=0, le=1)
    ] = 0.001,
    context: Context,
) -> Wetness:
    """Give the topographic wetness index of the ground.

    TWI = ln(a / max(tan slope, least_slope)), with a the specific drainage area: the area that drains through a cell
    per metre of contour, a cell being as wide as its area's root.  The slope is Horn's (see `terrain.slope`).  High
    values lie in valley floors and hollows, low ones on ridges and steep ground.

    Args:
        surface: elevation in metres; cells may be rectangular.
        area: drainage area in m2, as `hydrology.drainage_area` gives it; D-infinity gives smoother hillsides than D8.
        least_slope: without it level ground would be infinitely wet.
        context: the engine's.

    Returns:
        ln(m), as a rule 3 to 25, of the same shape and extent; void where either input is.

    Raises:
        ValueError: the surface is in degrees, the area lies on another grid, has another unit than m2, or is not
            positive somewhere.

    Reference: K. J. Beven, M. J. Kirkby (1979): A physically based, variable contributing area model of basin
    hydrology. Hydrological Sciences Bulletin 24(1). doi:10.1080/02626667909491834.
    """
    cell = require_projected(surface)
    require_same_grid(surface, area)
    if area.unit not in ("", "m2"):
        raise ValueError(
            f"the area is a {type(area).__name__} in {area.unit}; link a drainage area in m2, such as that of "
            "hydrology.drainage_area"
        )
    width = math.sqrt(cell[0] * cell[1])
    index = np.empty(surface.shape, np.float32)
    for part in row_blocks(*surface.shape, context):
        drained = area.data[part].astype(np.float64)
        wrong = (drained <= 0) | np.isinf(drained)
        if wrong.any():
            row, col = (int(place[0]) for place in np.nonzero(wrong))
            raise ValueError(
                f"the drainage area of row {part.start + row}, column {col} is {drained[row, col]:g} m2; it must be "
                "positive and finite"
            )
        east, north = horn_gradient(surface.data, part, cell)
        steepness = np.hypot(east, north)
        np.maximum(steepness, np.float32(least_slope), out=steepness)
        index[part] = np.log(drained / width) - np.log(steepness)
    return Wetness(index, surface.extent)
