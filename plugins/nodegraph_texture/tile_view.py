"""Which tiles a camera needs: those in its view, with texels that are no larger than a pixel.

A point at the depth z in front of an eye and at the distance d from it is seen on a plane f pixels away, where
f = h / (2 tan(a / 2)) for a picture h pixels high that spans the angle a.  A short line of length t there is at most
t f d / z^2 pixels long (the larger singular value of the projection's derivative, for a line towards the edge of the
picture; t f / z for one that faces it).  A tile is fine enough where this is 1 or less for the sides of its texels at
every point of its ground that can be in view, else its four children take its place: the largest footprint first, so
that where a budget ends the refinement the largest texels are as small as they can be.

Source: the screen-space error of Ulrich 2002, Rendering massive terrains using chunked level of detail control,
SIGGRAPH course notes, section 2.3, with texels in place of geometric errors.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_texture.texture_tiles import TextureTiles
from nodegraph_texture.tile_tree import Tile

Doubles = npt.NDArray[np.float64]
Point = tuple[float, float, float]

CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T
"""Which end of a box each of its eight corners has along each axis."""


@dataclass(frozen=True)
class View:
    """What a pinhole camera sees, with x east, y north, z up, m.

    Attributes:
        eye: where it stands.
        target: a point straight ahead; up in the picture is up, or north where it looks straight down or up.
        field_of_view: angle that the height of the picture spans, degrees.
        width, height: of the picture, pixels.
    """

    eye: Point
    target: Point
    field_of_view: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.eye, *self.target))):
            raise ValueError("eye and target of a view need finite coordinates")
        if self.eye == self.target:
            raise ValueError("eye and target of the view are the same point; move one of them")
        if not 0 < self.field_of_view < 180:
            raise ValueError(f"a field of view of {self.field_of_view:g} degrees is not possible; give 0 to 180")

    @cached_property
    def axes(self) -> Doubles:
        """Unit vectors to the right, up and forward in the picture, (3, 3)."""
        forward = np.subtract(self.target, self.eye).astype(np.float64)
        forward /= np.linalg.norm(forward)
        upright = math.hypot(forward[0], forward[1]) <= 1e-6
        right = np.cross(forward, (0.0, 1.0, 0.0) if upright else (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        return np.array([right, np.cross(right, forward), forward])

    @property
    def slopes(self) -> tuple[float, float]:
        """Half of the picture's width and height on a plane 1 m ahead, m."""
        half = math.tan(math.radians(self.field_of_view) / 2)
        return half * self.width / self.height, half

    @property
    def focal(self) -> float:
        """f, pixels."""
        return self.height / (2 * self.slopes[1])

    def footprints(self, low: Doubles, high: Doubles, texel: float) -> Doubles:
        """Return how many pixels a side of a texel has at most where boxes are in view, (n,); 0 where none of one is.

        Args:
            low, high: the least and the greatest corners of the boxes, (n, 3).
            texel: length of the side, m.
        """
        ends = np.stack([low, high], axis=1) - self.eye
        corners = ends[:, CORNERS, (0, 1, 2)]
        x, y, z = np.moveaxis(corners @ self.axes.T, -1, 0)
        wide, tall = self.slopes
        # A box is out of view if it is beyond one of the planes that bound it.
        sides = np.stack([z, wide * z - x, wide * z + x, tall * z - y, tall * z + y])
        hidden = (sides <= 0).all(axis=2).any(axis=0)
        corner = math.sqrt(1 + wide**2 + tall**2)  # d / z in the corner of the picture, the most in view
        nearest = np.linalg.norm(np.clip(0.0, ends[:, 0], ends[:, 1]), axis=1)
        ahead = z.min(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            oblique = np.where(ahead > 0, np.sqrt(1 + ((x**2 + y**2) / z**2).max(axis=1)), corner)
            # What is in view is no nearer along the axis than the depth.
            depth = np.maximum(ahead, nearest / corner)
            found = texel * self.focal * np.minimum(oblique, corner) / depth
        return np.where(hidden, 0.0, np.where(depth > 0, found, np.inf))


class Selection(NamedTuple):
    """Tiles that together cover all ground in view, without overlaps.

    Attributes:
        tiles: in order.
        footprints: bounds of the sides of their texels, pixels.
    """

    tiles: tuple[Tile, ...]
    footprints: tuple[float, ...]

    @property
    def largest(self) -> float:
        """The largest footprint, pixels; 0 where nothing is in view."""
        return max(self.footprints, default=0.0)


def needed(tiles: TextureTiles, view: View, most: int | None = None) -> Selection:
    """Return the tiles that a view needs.

    Args:
        tiles: the quadtree.
        view: from where it is seen.
        most: how many tiles there may be; none: as many as it takes.

    Raises:
        ValueError: not even the tiles of the coarsest level that are in view fit.

    Complexity: the number of tiles, times its logarithm.
    """
    waiting = in_view(tiles, view, tiles.tree.tiles(0))
    if most is not None and len(waiting) > most:
        raise ValueError(
            f"the view needs {len(waiting)} tiles of the coarsest level at least, and there is room for {most}; "
            "raise the budget, or take more levels"
        )
    heapq.heapify(waiting)
    done: list[tuple[Tile, float]] = []
    while waiting:
        negative, tile = heapq.heappop(waiting)
        wanted = tiles.tree.children(tile) if -negative > 1 else ()
        finer = in_view(tiles, view, wanted)
        total = len(done) + len(waiting) + len(finer)
        if wanted and (most is None or total <= most):
            for item in finer:
                heapq.heappush(waiting, item)
        else:
            done.append((tile, -negative))
    done.sort()
    return Selection(tuple([tile for tile, _ in done]), tuple([size for _, size in done]))


def in_view(tiles: TextureTiles, view: View, some: Iterable[Tile]) -> list[tuple[float, Tile]]:
    """Return those of some tiles of one level that have ground in view, each after minus its footprint in pixels."""
    known = [(tile, heights) for tile in some if (heights := tiles.heights(tile)) is not None]
    if not known:
        return []
    ground = tiles.extent
    low, high = np.empty((2, len(known), 3))
    for number, (tile, heights) in enumerate(known):
        box = tiles.tree.extent_of(tile)
        low[number] = max(box.west, ground.west), max(box.south, ground.south), heights[0]
        high[number] = min(box.east, ground.east), min(box.north, ground.north), heights[1]
    sizes = view.footprints(low, high, max(tiles.tree.cell_of(known[0][0].level)))
    return [(-size, tile) for (tile, _), size in zip(known, sizes.tolist(), strict=True) if size > 0]
