"""Growing scattered elevations into the cells around them, by midpoint displacement and its inverse."""

from __future__ import annotations

from math import hypot
from typing import Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_hydrology.features import Features
from nodegraph_terrain.raster import Elevation, Mask, require_metres, require_same_grid

Floats = npt.NDArray[np.float64]

ONE_SIDED = 0.5
"""Length of the mean direction to what is known, over which it lies on one side: 0.8 beside a straight edge."""


@node(version=1, locality=whole)
def enrich(
    features: Elevation,
    rivers: Mask | None = None,
    *,
    rounds: Annotated[int, Param("Squares have sides of 2 cells in the first, and double with each.", ge=0, le=16)] = 3,
    limit: Annotated[
        float | None,
        Param("L: greatest distance that is interpolated over; none: only the rounds count.", gt=0, unit="m"),
    ] = None,
    roughness: Annotated[float, Param("Standard deviation of displacements over the distance.", ge=0, le=10)] = 0.08,
    seed: Annotated[int, Param("Another number gives other displacements.", ge=0)] = 0,  # noqa: ARG001
    context: Context,
) -> Features:
    """Grow scattered elevations into the cells around them, so that valleys and ridges are not all edges.

    Round k works on the lattice of every 2^(k-1)-th cell, in squares of twice that side:

    - **MDI** (midpoint displacement inverse): a free corner of squares takes the mean of what is known at their centres
      and midpoints of edges, weighted by 1 / distance.  Squares may lie in any of four places, so even and odd cells
      are alike.  After the first round what is known must not lie on one side only: by then the mean of one side
      would make terraces with the outlines of squares.
    - **MD** (midpoint displacement): from that level down to single cells, a free centre takes the mean of its square's
      four corners, a free midpoint of an edge that of both its ends.

    Every new value is displaced by `roughness` times the distance d times a normal number.  With the mask of `rivers`,
    what grows from rivers alone is displaced upwards only and what grows from ridges alone downwards only, and no new
    cell beside a river lies below it: rivers stay where water runs.  Rounds end where d, the diagonal, exceeds `limit`.
    Given elevations do not change.  Takes time in proportion to the cells in every round.

    Args:
        features: elevations where they are known, NaN in free cells, in metres and of square cells.
        rivers: 1 at the features that are rivers, as from `rasterize_features`.
        rounds: how often MDI and MD take turns; features grow by about 2^rounds cells.
        limit: L of the paper.
        roughness: 0 is smooth.
        seed: of the displacements.
        context: the engine's.

    Raises:
        ValueError: there is no feature at all, one is infinite, cells are no squares in metres, or the mask is void
            somewhere or on another grid.

    Source: Zhang et al. 2016, section V.B, doi:10.1109/ACCESS.2016.2612700; F. Belhadj, P. Audibert (2005): Modeling
    landscapes with ridges and rivers: bottom up approach, doi:10.1145/1101389.1101479.
    """
    cell = require_metres(features)
    known = ~np.isnan(features.data)
    if not known.any():
        raise ValueError("the features are all void (NaN); at least one cell must have an elevation")
    if np.isinf(features.data).any():
        raise ValueError("a feature has an infinite elevation; features must be finite, or NaN where free")
    height = features.data.astype(np.float64)
    # What a value grew from: -1 rivers, 1 ridges, between for both; 0 where nobody tells.
    kind = np.zeros(features.shape)
    if rivers is not None:
        require_same_grid(features, rivers)
        if np.isnan(rivers.data).any():
            raise ValueError("the mask of rivers has voids (NaN); give 0 where there is no river")
        kind = 1 - 2 * np.clip(rivers.data.astype(np.float64), 0, 1)
    ground = _Ground(height, kind, cell, roughness, context.rng)
    for turn in range(rounds):
        half = 1 << turn
        context.progress(turn / rounds, f"squares of {2 * half} cells")
        if half >= max(features.shape) or (limit is not None and hypot(half, half) * cell > limit):
            break
        ground.inverse(half)
        for level in range(turn, -1, -1):
            ground.displace(1 << level)
    if rivers is not None:
        _raise_banks(height, known, rivers)
    return Features(np.where(known, features.data, height.astype(np.float32)), features.extent)


@enrich.forecast
def _forecast(features: Forecast, rivers: Forecast | None = None, **_: object) -> Forecast:  # noqa: ARG001
    return Forecast(features.bytes, 12 * features.bytes, features.about)


class _Ground:
    """Elevations being grown, in place."""

    def __init__(self, height: Floats, kind: Floats, cell: float, roughness: float, rng: np.random.Generator) -> None:
        self.height, self.kind = height, kind
        self.cell, self.roughness, self.rng = cell, roughness, rng

    def inverse(self, half: int) -> None:
        """Give the free corners of squares with sides of 2 * `half` what is known at centres and midpoints (MDI).

        The squares lie in all four places on the lattice: how features grow is then the same on even and odd cells.
        """
        ring = [(i, j) for i in (-half, 0, half) for j in (-half, 0, half) if (i, j) != (0, 0)]
        self._grow(0, 0, half, ring, least=1, between=half > 1)

    def displace(self, half: int) -> None:
        """Give the free centres and midpoints of squares with sides of 2 * `half` what their corners hold (MD)."""
        self._grow(half, half, 2 * half, [(i, j) for i in (-half, half) for j in (-half, half)], least=4)
        self._grow(0, half, 2 * half, [(0, -half), (0, half)], least=2)
        self._grow(half, 0, 2 * half, [(-half, 0), (half, 0)], least=2)

    def _grow(
        self, row: int, column: int, pitch: int, offsets: list[tuple[int, int]], least: int, *, between: bool = False
    ) -> None:
        """Fill the free cells of the lattice of every `pitch`-th cell from (row, column) on.

        They take the mean of the known among their neighbours at `offsets`, if `least` of these are known, and if
        these do not all lie on one side where only values `between` are wanted.
        """
        places = np.argwhere(self._wanting(row, column, pitch, offsets, least))
        if not len(places):
            return
        i, j = (places * pitch + [row, column]).T
        total, share, leaning, weight = np.zeros((4, len(i)))
        side = np.zeros((2, len(i)))
        rows, columns = self.height.shape
        for down, right in offsets:
            r, c = i + down, j + right
            inside = np.flatnonzero((r >= 0) & (r < rows) & (c >= 0) & (c < columns))
            value = self.height[r[inside], c[inside]]
            there = ~np.isnan(value)
            inside, value = inside[there], value[there]
            near = 1 / hypot(down, right)
            total[inside] += near * value
            leaning[inside] += near * self.kind[r[inside], c[inside]]
            weight[inside] += near
            share[inside] += 1
            side[:, inside] += near * np.array([[down], [right]])
        done = share >= least
        if between:
            done &= np.hypot(*side) <= ONE_SIDED * share
        i, j, weight = i[done], j[done], weight[done]
        mean, kind = total[done] / weight, leaning[done] / weight
        # The harmonic mean of the distances.
        distance = self.cell * share[done] / weight
        normal = self.rng.standard_normal(len(i))
        one_sided = (1 - np.abs(kind)) * normal - kind * np.abs(normal)
        self.height[i, j] = mean + self.roughness * distance * one_sided
        self.kind[i, j] = kind

    def _wanting(
        self, row: int, column: int, pitch: int, offsets: list[tuple[int, int]], least: int
    ) -> npt.NDArray[np.bool_]:
        """Return which cells of the lattice are free with `least` known neighbours: few, and quick to find."""
        known = ~np.isnan(self.height)
        free = ~known[row::pitch, column::pitch]
        count = np.zeros(free.shape, np.uint8)
        for down, right in offsets:
            (own_rows, rows), (own_columns, columns) = (
                _overlap(start + step, pitch, own, size)
                for start, step, own, size in zip((row, column), (down, right), free.shape, known.shape, strict=True)
            )
            count[own_rows, own_columns] += known[rows, columns]
        return np.asarray(free & (count >= least))


def _overlap(start: int, pitch: int, count: int, size: int) -> tuple[slice, slice]:
    """Return which of `count` places from `start` on, every `pitch`-th, lie in 0 to `size`, and these places."""
    first = max(0, -(start // pitch))
    last = max(first, min(count, -((start - size) // pitch)))
    return slice(first, last), slice(start + first * pitch, start + last * pitch, pitch)


def _raise_banks(height: Floats, known: npt.NDArray[np.bool_], rivers: Mask) -> None:
    """Raise what was grown beside a river to the river at least, in place."""
    from scipy.ndimage import maximum_filter

    beds = np.where(known & (rivers.data > 0), height, -np.inf)
    banks = maximum_filter(beds, size=3, mode="constant", cval=-np.inf)
    np.copyto(height, np.maximum(height, banks), where=~known & ~np.isnan(height))
