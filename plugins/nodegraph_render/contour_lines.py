"""Contour lines of a surface."""

from __future__ import annotations

from math import ceil, floor, isfinite
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node
from nodegraph_render.rounding import round_step
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.forecasts import check_cells
from nodegraph_terrain.interpolation import REACH, spline_coefficients, without_voids
from nodegraph_terrain.polylines import Polylines, Property
from nodegraph_terrain.raster import Elevation

Floats = npt.NDArray[np.float64]

LEVELS_MAX = 10_000
"""More levels than this are refused as a mistake."""

LEVELS_WANTED = 16
"""About how many levels an interval is chosen for."""


@node(version=1)
def contour_lines(
    surface: Elevation,
    *,
    interval: Annotated[
        float | None,
        Param("Height from each level to the next; none: a round one for 16 levels.", gt=0, unit="m"),
    ] = None,
    base: Annotated[float, Param("A level that the others are counted from.", unit="m")] = 0.0,
    levels: Annotated[tuple[float, ...], Param("The levels themselves, instead of an interval.", unit="m")] = (),
    index: Annotated[int, Param("Every so many levels one is an index contour; 0: none is.", ge=0)] = 5,
    smooth: Annotated[
        int,
        Param("Contour a cubic spline on cells so many times finer; 1: the heights as they are.", ge=1, le=16),
    ] = 1,
    heights: Annotated[bool, Param("Give every point its level as a third coordinate.")] = False,
    context: Context,
) -> Polylines:
    """Draw lines of equal height.

    Between the centres of neighbouring cells heights are linear, and every point of a line lies where they reach its
    level exactly: on the straight between two centres, at the share (level - z0) / (z1 - z0).  The lines of a level
    separate what lies above it from what lies at or below it; in a saddle the mean of the four cells decides.  Lines of
    different levels never meet.

    They run with the higher ground on their left, so that a closed line goes anticlockwise around a summit and
    clockwise around a hollow.  They end at the centres of the outer cells, and where a square of four centres has a
    void.

    Cells of coarse rasters show as corners in the lines.  With `smooth` above 1 the interpolating bicubic B-spline of
    the heights is evaluated on a lattice that many times finer, through all the centres, and contoured: smooth lines
    that still pass where the raster says and never cross.

    Levels are base + k interval from the lowest height to below the highest, or those of `levels` in that range.  Index
    contours are those of k divisible by `index`; of stated levels, each `index`-th from the first.

    Args:
        surface: elevation in metres, on a grid in metres or degrees.
        interval: height from level to level.
        base: a level to count from.
        levels: the levels, in any order; the interval then does not matter.
        index: every so many levels one is an index contour.
        smooth: 1, or the refinement of the spline.
        heights: whether the points have a third coordinate.
        context: the engine's.

    Returns:
        Lines in the system of the surface, by rising level, with the properties ``level`` (m) and ``index`` (bool).
        Flat ground has none.

    Raises:
        ValueError: every cell is void, some are infinite, levels repeat, or there would be over 10,000 of them.

    O(cells) for each level.  Reference: contourpy, generator ``serial``, https://contourpy.readthedocs.io/.
    """
    low, high = _range(surface.data)
    chosen, is_index = _levels(low, high, interval, base, levels, index)
    lines, counts = [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    at, marked = [np.zeros(0)], [np.zeros(0, np.bool_)]
    if len(chosen) and min(surface.shape) > 1:
        generator = _generator(surface, smooth, context)
        for position, (level, mark) in enumerate(zip(chosen.tolist(), is_index.tolist(), strict=True)):
            context.progress(0.2 + 0.8 * position / len(chosen))
            (points,), (offsets,) = generator.lines(level)
            if points is None:
                continue
            kept, sizes = _without_repeats(points, offsets)
            lines.append(kept)
            counts.append(sizes)
            at.append(np.full(len(sizes), level))
            marked.append(np.full(len(sizes), mark))
    places, sizes, level_of = np.concatenate(lines), np.concatenate(counts), np.concatenate(at)
    extent, (dx, dy) = surface.extent, surface.cell_size
    # From cells of the lattice, counted from the south-western centre, to coordinates.
    columns = [extent.west + (places[:, 0] / smooth + 0.5) * dx, extent.south + (places[:, 1] / smooth + 0.5) * dy]
    if heights:
        columns.append(np.repeat(level_of, sizes))
    properties = Property("level", level_of, "m"), Property("index", np.concatenate(marked))
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    return Polylines(np.column_stack(columns), offsets, properties, extent.crs, extent.unit)


@contour_lines.forecast
def _forecast(surface: Forecast, *, smooth: int, **_: object) -> Forecast:
    # The lattice in double precision with its coordinates, and a guess at the lines: there is no telling.
    return Forecast(surface.bytes, 9 * surface.bytes * smooth**2)


def _range(data: npt.NDArray[np.float32]) -> tuple[float, float]:
    low, high = float(np.fmin.reduce(data, axis=None)), float(np.fmax.reduce(data, axis=None))
    if low != low:
        raise ValueError("every cell of the surface is void; there is nothing to contour")
    if not (isfinite(low) and isfinite(high)):
        raise ValueError("the surface holds infinite heights; link it through terrain.clamp first")
    return low, high


def _levels(
    low: float, high: float, interval: float | None, base: float, levels: tuple[float, ...], index: int
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return the levels from `low` up to, but without, `high`, rising, and which of them are index contours."""
    if levels:
        rising: Floats = np.unique(np.array(levels, np.float64))
        if len(rising) < len(levels):
            raise ValueError("a level is given twice; give each of them once")
        number = np.arange(len(rising))
    else:
        step = interval if interval is not None else round_step(high - low, LEVELS_WANTED) if high > low else 1.0
        first, last = ceil((low - base) / step), floor((high - base) / step)
        if last - first >= LEVELS_MAX:
            raise ValueError(
                f"an interval of {step:g} m gives {last - first + 1:,} levels from {low:g} to {high:g} m; widen it"
            )
        number = np.arange(first, last + 1)
        rising = base + number.astype(np.float64) * step
    inside = (rising >= low) & (rising < high)
    return rising[inside], (number % index == 0 if index else np.zeros(len(number), np.bool_))[inside]


def _generator(surface: Elevation, smooth: int, context: Context) -> Any:
    """Return contourpy's generator for the lattice of centres, or a finer one, rows from south to north."""
    from contourpy import contour_generator

    heights = surface.data if smooth == 1 else _refined(surface.data, smooth, context)
    lattice = heights[::-1].astype(np.float64)
    return contour_generator(
        z=np.ma.masked_invalid(lattice, copy=False), name="serial", corner_mask=False, line_type="ChunkCombinedOffset"
    )


def _refined(heights: npt.NDArray[np.float32], times: int, context: Context) -> Floats:
    """Return the interpolating spline at the centres and between them; void where one of the centres around is."""
    from scipy import ndimage

    rows, cols = ((side - 1) * times + 1 for side in heights.shape)
    check_cells(rows, cols)
    missing = np.isnan(heights)
    voids = bool(missing.any())
    coefficients = spline_coefficients(without_voids(heights, missing) if voids else heights)
    fine = np.empty((rows, cols))
    for part in row_blocks(rows, cols, context, stop=0.2):
        places = np.meshgrid(np.arange(part.start, part.stop) / times, np.arange(cols) / times, indexing="ij")
        shifted = [place + REACH for place in places]
        fine[part] = ndimage.map_coordinates(coefficients, shifted, order=3, mode="nearest", prefilter=False)
        if voids:
            share = ndimage.map_coordinates(missing.astype(np.float32), places, order=1, mode="nearest")
            fine[part][share > 0] = np.nan
    # Rounding must not draw a speck around a centre whose height is a level.
    fine[::times, ::times] = heights
    return fine


def _without_repeats(points: npt.NDArray[Any], offsets: npt.NDArray[Any]) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return lines without points that repeat the one before, and the count of each; without those that are a point.

    They come about where a level passes through a centre exactly.
    """
    bounds = offsets.astype(np.int64)
    starts, sizes = bounds[:-1], bounds[1:] - bounds[:-1]
    kept = np.ones(len(points), np.bool_)
    kept[1:] = (points[1:] != points[:-1]).any(axis=1)
    kept[starts] = True
    counts = np.add.reduceat(kept, starts, dtype=np.int64)
    kept &= np.repeat(counts > 1, sizes)
    return points[kept], counts[counts > 1]
