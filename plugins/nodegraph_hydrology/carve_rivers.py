"""Ground that lets its rivers run: beds at their height, banks no steeper and no flatter than is asked."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.rasterize_features import rasterize_features
from nodegraph_terrain.raster import Elevation, require_metres


@node(version=1, locality=whole)
def carve_rivers(
    surface: Elevation,
    network: RiverNetwork,
    *,
    flattest: Annotated[float, Param("Least slope from the ground down to the nearest river.", ge=0, le=10)] = 0.02,
    steepest: Annotated[
        float | None, Param("Greatest slope from a river up its banks; none: any.", gt=0, le=100)
    ] = 1.0,
    reach: Annotated[
        float | None, Param("Distance from a river at which changes have faded; none: they do not.", gt=0, unit="m")
    ] = None,
    context: Context,
) -> Elevation:
    """Cut rivers into a surface, or dam them up to their heights, and make the ground beside them fall towards them.

    Smoothing, noise or a blended piece of other ground bury rivers and divert them.  With b the height of the bed in
    the nearest cell that a river passes and d the distance from its centre, the surface z moves towards

        min(max(z, b + flattest d), b + steepest d)

    by the share (1 - d^2 / reach^2)^2 of the way (all of it without `reach`, none beyond), so that no step is left
    there, and the bed itself takes the height of the river.  A bed is every cell that the river
    passes, so beds hang together edge to edge; they fall as the rivers do, and where several share a cell the
    lowest wins.  Water on the ground may still gather in hollows; without `reach` none lies below the nearest bed.

    Args:
        surface: ground in metres, of square cells; voids stay void.
        network: rivers with elevations.
        flattest: 0 only keeps the ground from lying below its river.
        steepest: greater than `flattest`; a small one widens valleys, none leaves slots one cell wide.
        reach: farther ground stays as it is.
        context: the engine's.

    Raises:
        ValueError: rivers without elevations or beyond the surface, other coordinate systems or units, or `steepest`
            not above `flattest`.

    Takes time in proportion to the cells.
    """
    from scipy import ndimage

    cell = require_metres(surface)
    if steepest is not None and steepest <= flattest:
        raise ValueError(f"steepest ({steepest:g}) must be greater than flattest ({flattest:g})")
    beds = rasterize_features(network, like=surface, context=context).features.data
    context.progress(0.4, "beds")
    away, (row, column) = ndimage.distance_transform_edt(np.isnan(beds), sampling=cell, return_indices=True)
    bed = beds[row, column]
    away = away.astype(np.float32)
    context.progress(0.8, "banks")
    carved = np.maximum(surface.data, bed + np.float32(flattest) * away)
    if steepest is not None:
        carved = np.minimum(carved, bed + np.float32(steepest) * away)
    if reach is not None:
        share = np.maximum(1 - (away / np.float32(reach)) ** 2, 0) ** 2
        carved = surface.data + share * (carved - surface.data)
    # To the last digit: what falls strictly downstream stays so.
    carved = np.where(away == 0, bed, carved)
    return Elevation(np.where(np.isnan(surface.data), surface.data, carved), surface.extent)


@carve_rivers.forecast
def _forecast(surface: Forecast, network: Forecast, **_: object) -> Forecast:  # noqa: ARG001
    return Forecast(surface.bytes, 12 * surface.bytes, surface.about)
