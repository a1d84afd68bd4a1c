"""What a view or a flight takes of texture tiles: counted without painting any."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node, port_type, whole
from nodegraph_texture.texture_tiles import TextureTiles
from nodegraph_texture.tile_cache import TileCache
from nodegraph_texture.tile_tree import texels_across
from nodegraph_texture.tile_view import Point, View, needed

MIB = 1 << 20

FieldOfView = Annotated[float, Param("Angle that the height of the picture spans.", ge=0.01, le=170, unit="deg")]
Width = Annotated[int, Param("Width of the picture.", ge=1, le=65536, unit="px")]
Height = Annotated[int, Param("Height of the picture.", ge=1, le=65536, unit="px")]
Budget = Annotated[float, Param("Most that tiles may take at once.", gt=0, le=1 << 20, unit="MiB")]


@port_type
class TileCounts:
    """What each view of a flight takes, all (views,).

    Attributes:
        needed, hits, painted, evicted: numbers of tiles that are in view, that the view before has left, that are
            painted, and that go for these; int64.
        footprint: pixels along the side of the largest texel in view, at most.
    """

    needed: npt.NDArray[np.int64]
    hits: npt.NDArray[np.int64]
    painted: npt.NDArray[np.int64]
    evicted: npt.NDArray[np.int64]
    footprint: npt.NDArray[np.float64]


class TileStatistics(NamedTuple):
    """What `tile_statistics` gives."""

    most_tiles: int
    most_bytes: int
    whole_bytes: int
    painted: int
    evicted: int
    hit_share: float
    largest_footprint: float
    views: TileCounts


@node(version=1, locality=whole)
def tile_statistics(
    tiles: TextureTiles,
    *,
    views: Annotated[
        tuple[tuple[Point, Point], ...],
        Param("Eyes and targets of a camera, [[[x, y, z], [x, y, z]], ...], in the order of the flight.", min_length=1),
    ],
    field_of_view: FieldOfView = 45.0,
    width: Width = 1920,
    height: Height = 1080,
    budget: Budget = 40.0,
    context: Context,
) -> TileStatistics:
    """Count the tiles that a flight needs, and what a cache of some budget paints and drops on the way.

    Tiles are chosen as texture.texture_atlas does it.  Those of one view that are still in the cache at the next are
    not painted again; where there is no room, those that were not needed for the longest time go first.

    Args:
        tiles: of the texture.
        views: from where it is seen.
        field_of_view, width, height, budget: as of texture.texture_atlas.
        context: the engine's.

    Returns:
        ``most_tiles`` and ``most_bytes`` of one view; ``whole_bytes`` of the finest level as one picture; ``painted``,
        ``evicted`` of the whole flight; ``hit_share``, 0 to 1, of all tiles asked for that were there;
        ``largest_footprint``, pixels: above 1 where the finest level or the budget is not enough; ``views``.

    Raises:
        ValueError: an eye is its target, or the budget holds too few tiles.
    """
    cache = TileCache(int(budget * MIB), tiles.tile_bytes, lambda _: np.empty(0, np.uint8))
    counts = np.zeros((len(views), 4), np.int64)
    footprints = np.zeros(len(views))
    for number, (eye, target) in enumerate(views):
        context.progress(number / len(views))
        found = needed(tiles, View(eye, target, field_of_view, width, height), cache.room)
        before = cache.hits, cache.painted, cache.evicted
        cache.fetch(found.tiles)
        counts[number] = len(found.tiles), *np.subtract((cache.hits, cache.painted, cache.evicted), before)
        footprints[number] = found.largest
    in_view, hits, painted, evicted = (counts[:, column].copy() for column in range(4))
    down, across = texels_across(tiles.extent, tiles.cell)
    most = int(counts[:, 0].max())
    asked = cache.hits + cache.painted
    return TileStatistics(
        most,
        most * tiles.tile_bytes,
        4 * down * across,
        cache.painted,
        cache.evicted,
        cache.hits / asked if asked else 0.0,
        float(footprints.max()),
        TileCounts(in_view, hits, painted, evicted, footprints),
    )
