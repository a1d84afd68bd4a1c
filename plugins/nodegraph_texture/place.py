"""The latitude of a raster: one that is stated, or that of where it lies."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.place import on_earth
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
    return float(_latitude(extent, np.array([x]), np.array([y]))[0])


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
    known = _latitude(extent, grid[0].ravel(), grid[1].ravel()).reshape(LATTICE, LATTICE)
    return _between(_between(known, rows).T, cols).T


def _latitude(extent: Extent, x: Floats, y: Floats) -> Floats:
    """Return the latitude of points."""
    if not extent.crs:
        raise ValueError("the raster has no coordinate system that says where it lies; give the latitude")
    latitude = on_earth(extent, x, y)[1]
    if not np.isfinite(latitude).all():
        raise ValueError("a part of the raster lies nowhere on the Earth; give the latitude")
    return latitude


def _between(values: Floats, count: int) -> Floats:
    """Return values at the middles of `count` equal parts of the first axis, linear between equidistant ones."""
    place = (np.arange(count) + 0.5) / count * (len(values) - 1)
    first = np.minimum(place.astype(np.intp), len(values) - 2)
    share = (place - first)[:, None]
    return np.asarray(values[first] * (1 - share) + values[first + 1] * share)
