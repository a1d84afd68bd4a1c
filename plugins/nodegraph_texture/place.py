"""Where a raster lies on the Earth: its latitude, and which way true north is on its grid."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.raster import Extent, Raster

Floats = npt.NDArray[np.float64]

LATTICE = 17
"""Points along a side at which latitudes are asked of the system; between them they are interpolated."""


def centre_latitude(extent: Extent, stated: float | None) -> float:
    """Return the latitude that is stated, else that of the centre, degrees.

    Raises:
        ValueError: none is stated and the extent has no coordinate system.
    """
    if stated is not None:
        return stated
    x, y = (extent.west + extent.east) / 2, (extent.south + extent.north) / 2
    return float(_earth(extent, np.array([x]), np.array([y]))[1][0])


def latitudes(raster: Raster, stated: float | None) -> Floats:
    """Return the latitude of every cell, or the one that is stated, degrees, in an array that fits the cells.

    Raises:
        ValueError: none is stated and the raster has no coordinate system.
    """
    if stated is not None:
        return np.array([[stated]])
    extent, (rows, cols) = raster.extent, raster.shape
    x, y = np.linspace(extent.west, extent.east, LATTICE), np.linspace(extent.north, extent.south, LATTICE)
    grid = np.meshgrid(x, y)
    known = _earth(extent, grid[0].ravel(), grid[1].ravel())[1].reshape(LATTICE, LATTICE)
    return _between(_between(known, rows).T, cols).T


def true_north(extent: Extent) -> float:
    """Return the bearing of true north on the grid at its centre, degrees; 0 without a coordinate system.

    An azimuth from true north has this much added to be one from the grid's north (meridian convergence).
    """
    if not extent.crs or extent.unit == "deg":
        return 0.0
    from nodegraph_terrain.georeference import parse_crs, transformed

    x, y = np.array([(extent.west + extent.east) / 2]), np.array([(extent.south + extent.north) / 2])
    longitude, latitude = _earth(extent, x, y)
    step = 1e-3 if latitude[0] < 89 else -1e-3
    there = transformed(parse_crs("EPSG:4326"), parse_crs(extent.crs), longitude, latitude + step)
    return math.degrees(math.atan2(float(there[0][0] - x[0]) * step, float(there[1][0] - y[0]) * step))


def _earth(extent: Extent, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return longitudes and latitudes of points."""
    from nodegraph_terrain.georeference import parse_crs, transformed

    if not extent.crs:
        raise ValueError("the raster has no coordinate system that says where it lies; give the latitude")
    longitude, latitude = transformed(parse_crs(extent.crs), parse_crs("EPSG:4326"), x, y)
    if not np.isfinite(latitude).all():
        raise ValueError("a part of the raster lies nowhere on the Earth; give the latitude")
    return longitude, latitude


def _between(values: Floats, count: int) -> Floats:
    """Return values at the middles of `count` equal parts of the first axis, linear between equidistant ones."""
    place = (np.arange(count) + 0.5) / count * (len(values) - 1)
    first = np.minimum(place.astype(np.intp), len(values) - 2)
    share = (place - first)[:, None]
    return np.asarray(values[first] * (1 - share) + values[first + 1] * share)
