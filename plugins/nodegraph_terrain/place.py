"""Where a raster lies on the Earth, and which way true north is on its grid."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.georeference import parse_crs, transformed
from nodegraph_terrain.raster import Extent

Floats = npt.NDArray[np.float64]

STEP = 1e-3
"""How far north one looks for true north, degrees."""


def on_earth(extent: Extent, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return longitudes and latitudes (WGS 84, degrees) of points of an extent with a coordinate system.

    Infinite for points that lie nowhere on the Earth.
    """
    return transformed(parse_crs(extent.crs), parse_crs("EPSG:4326"), x, y)


def centre_of(extent: Extent) -> tuple[float, float]:
    """Return longitude and latitude of the centre of an extent with a coordinate system, degrees; as `on_earth`."""
    longitude, latitude = on_earth(extent, *_middle(extent))
    return float(longitude[0]), float(latitude[0])


def true_north(extent: Extent) -> float:
    """Return the bearing of true north on the grid at its centre, degrees; 0 without a coordinate system.

    An azimuth from true north has this much added to be one from the grid's north (meridian convergence).
    """
    if not extent.crs or extent.unit == "deg":
        return 0.0
    x, y = _middle(extent)
    longitude, latitude = on_earth(extent, x, y)
    step = STEP if latitude[0] < 89 else -STEP
    there = transformed(parse_crs("EPSG:4326"), parse_crs(extent.crs), longitude, latitude + step)
    return math.degrees(math.atan2(float(there[0][0] - x[0]) * step, float(there[1][0] - y[0]) * step))


def _middle(extent: Extent) -> tuple[Floats, Floats]:
    return np.array([(extent.west + extent.east) / 2]), np.array([(extent.south + extent.north) / 2])
