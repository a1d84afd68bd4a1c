"""Many instances of one tree: placed by hand, or scattered with a density (sections 4 and 5.4).

**Poisson-disc points.**  Candidates are drawn with a chance proportional to the density and taken in order; one is kept
unless it is nearer to a kept one than the smaller of their two radii, r = spacing / sqrt(density / greatest density).
As both candidates and 1 / r^2 follow the density, each meets a bounded number of others: drawing n points takes
O(n log n).  Draws are repeated until one adds less than one in a hundred; then some nine tenths of the room are taken.
With a uniform density this is dart throwing (Cook 1986), and kept points lie at least `spacing` apart.

References:
    R. L. Cook (1986): Stochastic sampling in computer graphics. ACM TOG 5(1). doi:10.1145/7529.8927.
    R. Bridson (2007): Fast Poisson disk sampling in arbitrary dimensions. SIGGRAPH. doi:10.1145/1278780.1278807.
"""

from __future__ import annotations

from math import ceil, isfinite, log
from typing import Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node
from nodegraph_terrain.raster import Extent, Mask
from nodegraph_tree.affine import placed
from nodegraph_tree.blend import blend
from nodegraph_tree.function import ElevationFunction, Floats

Edges = tuple[float, float, float, float]
Range = tuple[float, float]

MOST = 1_000_000
"""Most instances of one node."""

LEAST = 5
"""Draws at least: where there are few points, one that adds none may be chance."""

DARTS = (3, 12)
"""Candidates of the first draw, and of later ones, for each point that there is room for."""


@node(version=1)
def instances(
    function: ElevationFunction,
    *,
    positions: Annotated[
        tuple[tuple[float, float], ...], Param("Where the origin of each goes (x, y).", min_length=1, unit="m")
    ],
    rotations: Annotated[
        tuple[float, ...], Param("Counter-clockwise, one for each or one for all.", min_length=1, unit="deg")
    ] = (0.0,),
    scales: Annotated[tuple[float, ...], Param("Of the ground plan, one for each or one for all.", min_length=1)] = (
        1.0,
    ),
    vertical_scales: Annotated[
        tuple[float, ...], Param("Of the heights, one for each or one for all.", min_length=1)
    ] = (1.0,),
    rises: Annotated[
        tuple[float, ...], Param("Added to the heights, one for each or one for all.", min_length=1, unit="m")
    ] = (0.0,),
) -> ElevationFunction:
    """Place a tree many times and blend the instances.

    Instance k is the tree scaled, turned and moved to position k; heights are scaled and raised.  The tree itself is
    stored once, however many instances there are.

    Args:
        function: the tree, around the origin.
        positions: of the instances.
        rotations: of the instances.
        scales: of the instances; not 0.
        vertical_scales: of the heights.
        rises: of the heights.

    Raises:
        ValueError: lists of different lengths, or a scale of 0.

    Source: Génevaux et al. 2015, section 5.4, doi:10.1111/cgf.12530.
    """
    count = len(positions)
    lists = {"rotations": rotations, "scales": scales, "vertical_scales": vertical_scales, "rises": rises}
    for name, values in lists.items():
        if len(values) not in (1, count):
            raise ValueError(f"{len(values)} {name} do not fit {count} positions; give one for each, or one for all")
    turn, wide, high, rise = (np.broadcast_to(values, count).tolist() for values in lists.values())
    return _blended(function, np.array(positions, np.float64), turn, wide, high, rise)


@node(version=1)
def scatter(
    function: ElevationFunction,
    density: Mask | None = None,
    *,
    spacing: Annotated[
        float, Param("Least distance between instances, where the density is greatest.", gt=0, unit="m")
    ] = 1000.0,
    extent: Annotated[
        Edges | None, Param("Where (west, south, east, north); none: that of the density.", unit="m")
    ] = None,
    rotation: Annotated[Range, Param("Least and greatest turn, counter-clockwise.", unit="deg")] = (0.0, 360.0),
    scale: Annotated[Range, Param("Least and greatest scale of the ground plan.")] = (0.8, 1.25),
    vertical_scale: Annotated[Range, Param("Least and greatest scale of the heights.")] = (0.8, 1.25),
    rise: Annotated[Range, Param("Least and greatest height added.", unit="m")] = (0.0, 0.0),
    sparsest: Annotated[
        float, Param("Density below which there is nothing, as a share of the greatest.", ge=0.0001, le=1)
    ] = 0.02,
    seed: Annotated[int, Param("Another number gives another scattering.", ge=0)] = 0,  # noqa: ARG001
    context: Context,
) -> ElevationFunction:
    """Scatter instances of a tree over an area and blend them.

    Their positions are Poisson-disc points: random, but never closer than `spacing` where the density is greatest, and
    spacing / sqrt(density / greatest density) elsewhere.  Each is turned and scaled by chance; scales are drawn evenly
    in their logarithm.  The tree itself is stored once.

    Args:
        function: the tree, around the origin.
        density: relative number of instances per area, bilinear between centres of cells, void is 0; everywhere the
            same without.
        spacing: least distance.
        extent: where positions lie; instances reach beyond it.
        rotation: range of turns.
        scale: range of scales, above 0.
        vertical_scale: range of vertical scales.
        rise: range of what is added to the heights.
        sparsest: cuts off thin densities, whose few instances stand far apart.
        seed: of the scattering.
        context: the engine's.

    Raises:
        ValueError: neither density nor extent, a density of 0 everywhere or in degrees, a range that falls, a scale not
            above 0, or over a million instances.

    Source: Génevaux et al. 2015, section 5.4, doi:10.1111/cgf.12530; see the module for the points.
    """
    for name, (low, high) in {
        "rotation": rotation,
        "scale": scale,
        "vertical_scale": vertical_scale,
        "rise": rise,
    }.items():
        if low > high:
            raise ValueError(f"the range of {name} falls from {low:g} to {high:g}; give the lesser number first")
    if scale[0] <= 0 or vertical_scale[0] <= 0:
        raise ValueError("scales must be greater than 0")
    if extent is None and density is None:
        raise ValueError("where to scatter is missing; link a density or give extent (west, south, east, north)")
    if density is not None and density.extent.unit != "m":
        raise ValueError("the density is in degrees; link it through terrain.reproject to get metres")
    if extent is not None:
        area = Extent(*extent)
    else:
        assert density is not None
        area = density.extent
    points = poisson_discs(area, spacing, context, density=density, sparsest=sparsest)
    if not len(points):
        raise ValueError("the density leaves no room for an instance; raise it, lower the spacing or change the extent")
    rng = context.rng
    count = len(points)
    turn = rng.uniform(*rotation, count)
    wide = np.exp(rng.uniform(log(scale[0]), log(scale[1]), count))
    high_scale = np.exp(rng.uniform(log(vertical_scale[0]), log(vertical_scale[1]), count))
    raised = rng.uniform(*rise, count)
    return _blended(function, points, turn.tolist(), wide.tolist(), high_scale.tolist(), raised.tolist())


def _blended(
    function: ElevationFunction,
    positions: Floats,
    turn: list[float],
    wide: list[float],
    high: list[float],
    rise: list[float],
) -> ElevationFunction:
    # A blend holds its parts in one list: neighbours in space should be neighbours in it.
    order = np.lexsort((positions[:, 0], np.floor(positions[:, 1] / max(np.ptp(positions[:, 1]) / 64, 1e-9))))
    points = positions.tolist()
    return blend(
        [
            placed(
                function,
                position=(points[k][0], points[k][1]),
                rotation=turn[k],
                size=(wide[k], wide[k]),
                scale=high[k],
                rise=rise[k],
            )
            for k in order.tolist()
        ]
    )


def poisson_discs(
    area: Extent, spacing: float, context: Context, *, density: Mask | None = None, sparsest: float = 0.02
) -> Floats:
    """Return Poisson-disc points, (n, 2) m, see the module.

    Args:
        area: where.
        spacing: least distance where the density is greatest, m.
        context: for chance and for cancelling.
        density: relative number of points per area; uniform without.
        sparsest: share of the greatest density below which there are none.

    Raises:
        ValueError: over a million points, or a density that is 0 in the whole area.
    """
    from scipy.spatial import cKDTree

    chance = _Chance(area, density, sparsest)
    # Randomly thrown discs of diameter s jam at a coverage of 0.547: 0.70 points per s^2.
    room = 0.7 * area.width * area.height * chance.mean / spacing**2
    if room > MOST:
        raise ValueError(f"{room:.3g} instances are more than {MOST:,}; widen the spacing or narrow the extent")
    rng = context.rng
    kept, radii = np.empty((0, 2)), np.empty(0)
    for draw in range(60):
        context.progress(draw / 60)
        count = ceil(max(room, 4) * DARTS[draw > 0] / chance.mean)
        darts = np.column_stack([rng.uniform(area.west, area.east, count), rng.uniform(area.south, area.north, count)])
        share = chance.at(darts[:, 0], darts[:, 1])
        darts, share = _among(rng.uniform(0, 1, count) < share, darts, share)
        radius = spacing / np.sqrt(share)
        if len(kept):
            tree = cKDTree(kept)
            # Nearest first, which rules out most of them.
            near, index = tree.query(darts)
            free = near >= np.minimum(radius, radii[index])
            darts, radius = darts[free], radius[free]
            hits = tree.query_ball_point(darts, radius)
            dart, other = _pairs(hits)
            close = np.hypot(*(darts[dart] - kept[other]).T) < np.minimum(radius[dart], radii[other])
            free = np.ones(len(darts), bool)
            free[dart[close]] = False
            darts, radius = darts[free], radius[free]
        if len(darts):
            first, second = _pairs(cKDTree(darts).query_ball_point(darts, radius))
            near = np.hypot(*(darts[first] - darts[second]).T)
            close = (near < np.minimum(radius[first], radius[second])) & (first != second)
            taken = _greedy(len(darts), first[close], second[close])
            added = int(taken.sum())
            kept, radii = np.concatenate([kept, darts[taken]]), np.concatenate([radii, radius[taken]])
        else:
            added = 0
        if draw >= LEAST - 1 and added <= 0.01 * len(kept):
            break
    return kept


def _among(where: npt.NDArray[np.bool_], points: Floats, share: Floats) -> tuple[Floats, Floats]:
    return points[where], share[where]


def _pairs(hits: npt.NDArray[np.object_]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the lists of neighbours of `query_ball_point` as pairs of indices."""
    counts = np.fromiter((len(item) for item in hits), np.int64, len(hits))
    second = np.fromiter((index for item in hits for index in item), np.int64, int(counts.sum()))
    return np.repeat(np.arange(len(hits)), counts), second


def _greedy(count: int, first: npt.NDArray[np.int64], second: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Return who is kept if candidates are taken in order, each unless an earlier kept one conflicts with it.

    Args:
        count: of candidates.
        first, second: conflicts, in either direction.

    O(conflicts) a round; a round decides all whose earlier conflicts are decided, a few dozen for random orders.
    """
    later, earlier = np.maximum(first, second), np.minimum(first, second)
    kept, open_ = np.zeros(count, bool), np.ones(count, bool)
    while open_.any():
        blocked, waiting = np.zeros(count, bool), np.zeros(count, bool)
        blocked[later[kept[earlier]]] = True
        waiting[later[open_[earlier]]] = True
        kept |= open_ & ~blocked & ~waiting
        open_ &= ~blocked & ~kept
        some = open_[later]
        later, earlier = later[some], earlier[some]
    return kept


class _Chance:
    """The density at points, as a share of the greatest in the area."""

    def __init__(self, area: Extent, density: Mask | None, sparsest: float) -> None:
        self._sparsest, self._density = sparsest, density
        self.mean, self._most = 1.0, 1.0
        if density is None:
            return
        values = np.nan_to_num(density.data.astype(np.float64), nan=0.0)
        if values.min() < 0 or not isfinite(values.max()):
            raise ValueError("the density holds negative or infinite numbers; densities are 0 to 1")
        self._values = np.pad(values, 1, mode="edge")
        # At centres of cells and on the edges of the area: bilinear values are greatest there.
        x, y = np.meshgrid(np.linspace(area.west, area.east, 257), np.linspace(area.south, area.north, 257))
        self._most = 1.0
        inside = self._raw(x.ravel(), y.ravel())
        cells = self._raw(*self._centres(area))
        self._most = max(float(inside.max()), float(cells.max(initial=0.0)))
        if self._most == 0:
            raise ValueError("the density is 0 in the whole extent; link one that covers it")
        share = self.at(x.ravel(), y.ravel())
        self.mean = max(float(share.mean()), 1e-4)

    def at(self, x: Floats, y: Floats) -> Floats:
        """Return the share, 0 where it is below the least."""
        if self._density is None:
            return np.ones(x.shape)
        share = np.minimum(self._raw(x, y) / self._most, 1.0)
        return np.where(share >= self._sparsest, share, 0.0)

    def _centres(self, area: Extent) -> tuple[Floats, Floats]:
        assert self._density is not None
        (rows, cols), (dx, dy), extent = self._density.shape, self._density.cell_size, self._density.extent
        x, y = extent.west + (np.arange(cols) + 0.5) * dx, extent.north - (np.arange(rows) + 0.5) * dy
        x, y = x[(x >= area.west) & (x <= area.east)], y[(y >= area.south) & (y <= area.north)]
        xs, ys = np.meshgrid(x, y)
        return xs.ravel(), ys.ravel()

    def _raw(self, x: Floats, y: Floats) -> Floats:
        assert self._density is not None
        (rows, cols), (dx, dy), extent = self._density.shape, self._density.cell_size, self._density.extent
        inside = (x >= extent.west) & (x <= extent.east) & (y >= extent.south) & (y <= extent.north)
        c = np.clip((x - extent.west) / dx, 0, cols) + 0.5
        r = np.clip((extent.north - y) / dy, 0, rows) + 0.5
        column, row = np.minimum(c.astype(np.int64), cols), np.minimum(r.astype(np.int64), rows)
        u, v = c - column, r - row
        upper = self._values[row, column] * (1 - u) + self._values[row, column + 1] * u
        lower = self._values[row + 1, column] * (1 - u) + self._values[row + 1, column + 1] * u
        return np.where(inside, upper * (1 - v) + lower * v, 0.0)
