"""Web Mercator tiles: the numbering of slippy maps, and where their texels lie.

The square of the sphere's Mercator projection (EPSG:3857), 2 pi 6378137 m wide, is one tile at zoom 0, and each zoom
quarters the tiles of the one before.  Columns run east from 180 degrees west, rows south from 85.0511 degrees north.

Source: OGC Two Dimensional Tile Matrix Set 2.0 (17-083r4), WebMercatorQuad; OpenStreetMap wiki, Slippy map tilenames.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from nodegraph_terrain.georeference import bounds_in, parse_crs, transformed
from nodegraph_terrain.raster import Extent
from nodegraph_texture.tile_warp import Warped

WORLD = 2 * math.pi * 6378137.0
"""Side of the map, m."""

ZOOM_MAX = 30
"""Deepest zoom: texels of a quarter of a millimetre."""


class Footprint(NamedTuple):
    """Where some ground lies on the map.

    Attributes:
        west, south, east, north: box around it, m of the map.
        degrees: the same in longitude and latitude, WGS 84.
    """

    west: float
    south: float
    east: float
    north: float
    degrees: tuple[float, float, float, float]

    @property
    def shrink(self) -> float:
        """Metres on the ground to a metre of the map, in the middle: the cosine of its latitude."""
        return math.cos(math.radians((self.degrees[1] + self.degrees[3]) / 2))


def footprint_of(extent: Extent) -> Footprint:
    """Return where an extent lies on the map.

    Raises:
        ValueError: it has no coordinate system, or a part of it has no place there.
    """
    if not extent.crs:
        raise ValueError(
            "the ground has no coordinate reference system, so it has no place on the Web Mercator map; state its crs, "
            "or save local tiles (grid local)"
        )
    box, degrees = (bounds_in(extent, parse_crs(code)) for code in ("EPSG:3857", "EPSG:4326"))
    if box is None or degrees is None or max(map(abs, box)) > WORLD / 2 * (1 + 1e-9):
        raise ValueError(
            "a part of the ground has no place on the Web Mercator map, which ends at 85 degrees north and south and "
            "180 degrees east; save local tiles (grid local)"
        )
    return Footprint(*box, degrees)


def resolution(zoom: int, size: int) -> float:
    """Return the side of a texel of tiles of some size, m of the map."""
    return math.ldexp(WORLD / size, -zoom)


def zooms(found: Footprint, texel: float, size: int) -> tuple[int, int]:
    """Return the deepest zoom with tiles that are larger than the ground, and that whose texels come nearest to some.

    Args:
        found: the ground.
        texel: side of texels, m on the ground.
        size: texels along a side of a tile.
    """
    side = max(found.east - found.west, found.north - found.south)
    last = min(ZOOM_MAX, max(0, round(math.log2(WORLD * found.shrink / (size * texel)))))
    return min(last, max(0, math.floor(math.log2(WORLD / side)))), last


def covering(found: Footprint, zoom: int) -> tuple[range, range]:
    """Return the rows and columns of the tiles that a box meets."""
    side, count = math.ldexp(WORLD, -zoom), 1 << zoom

    def between(low: float, high: float) -> range:
        first, last = (math.floor((WORLD / 2 + edge) / side) for edge in (low, high))
        return range(max(0, min(first, count - 1)), max(0, min(last, count - 1)) + 1)

    return between(-found.north, -found.south), between(found.west, found.east)


def texels_of(
    target: Any, source: Any, outside: float, zoom: int, row: int, col: int, size: int, rim: int, shrink: float
) -> Warped:
    """Return the texels of a tile in the system of the ground.

    Args:
        target: the system of the ground, and
        source: that of the map, as of `parse_crs`.
        outside: a coordinate where there is no ground, for texels without a place, m.
        zoom, row, col: the tile.
        size: texels along a side, and
        rim: further ones around it.
        shrink: metres on the ground to a metre of the map.
    """
    side = resolution(zoom, size)
    rows = np.arange(row * size - rim, (row + 1) * size + rim) + 0.5
    cols = np.arange(col * size - rim, (col + 1) * size + rim) + 0.5
    x, y = transformed(source, target, *np.meshgrid(cols * side - WORLD / 2, WORLD / 2 - rows * side))
    lost = ~(np.isfinite(x) & np.isfinite(y))
    x[lost] = y[lost] = outside
    return Warped(x, y, (side * shrink, side * shrink))
