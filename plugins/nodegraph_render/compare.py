"""Comparing two surfaces: where they differ, and by how much."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_render.differences import Differences, differences
from nodegraph_render.map_frame import ground
from nodegraph_render.map_legend import Legend
from nodegraph_render.map_sheet import NO_DATA, brought_to, letters, map_shape, on_ground, opened, part_of, system_name
from nodegraph_render.rounding import round_step
from nodegraph_render.sampling import bilinear
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.colour import blend_shade, colour_relief
from nodegraph_terrain.hillshade import hillshade
from nodegraph_terrain.raster import Elevation, Image, Raster, require_same_grid
from nodegraph_terrain.resample import resample as to_cells

COLOURS = ("#08468b", "#3d8ac4", "#a3cde3", "#f7f7f7", "#f6b394", "#d35f4b", "#8e1023")
"""Blue where the surface lies below the reference, white where they agree, red where it lies above."""


class Comparison(NamedTuple):
    """What `compare` gives."""

    map: Image
    difference: Elevation
    statistics: Differences
    rmse: float
    psnr: float


@node(version=1, locality=whole)
def compare(
    reference: Elevation,
    surface: Elevation,
    *,
    resample: Annotated[bool, Param("Bring the surface to the grid of the reference where they differ.")] = False,
    within: Annotated[float, Param("Tolerance that the share of good cells is counted for.", ge=0, unit="m")] = 1.0,
    limit: Annotated[
        float | None, Param("Difference with the last colours; none: a round one beyond 98 % of them.", gt=0, unit="m")
    ] = None,
    title: Annotated[str, Param("Written above the map.")] = "",
    size: Annotated[int, Param("Longer side of the map itself, pixels.", ge=200, le=8192)] = 900,
    context: Context,
) -> Comparison:
    """Compare a surface with a reference: d = surface - reference.

    The numbers are sums in float64 over the cells that both know; the others are counted.

        RMSE = sqrt(mean d^2),    PSNR = 20 log10((max - min of the reference) / RMSE) dB,

    with the extremes of the reference over the same cells.  Equal surfaces have a PSNR of infinity; against a level
    reference one that differs has minus infinity.  Slopes are those of terrain.slope, on the ground for a grid in
    degrees.

    On the map white is no difference, red where the surface lies higher, blue where it lies lower, to the same limit on
    both sides; what lies beyond has the last colour.  Faint shading of the reference shows where that is.

    With `resample` the surface is taken at the centres of the reference, in its coordinate system: bilinear between
    its own centres, after taking means where its cells are finer; cells outside of it are void.

    Args:
        reference: elevation in metres.
        surface: elevation in metres, on the same grid unless `resample` is set.
        resample: bring it to that grid.
        within: a tolerance, m.
        limit: difference with the last colours.
        title: above the map.
        size: of the map; legend and numbers are added beside it.
        context: the engine's.

    Returns:
        ``map``: the picture; ``difference``: d as a raster, m; ``statistics``: all the numbers; ``rmse``, m; and
        ``psnr``, dB.

    Raises:
        ValueError: the grids differ, or no cell is known in both.
    """
    if resample:
        surface = _matched(surface, reference, part_of(context, 0.0, 0.2))
    else:
        _require_same_grid(reference, surface)
    difference = np.empty(reference.shape, np.float32)
    for part in row_blocks(*reference.shape, context, start=0.2, stop=0.3):
        difference[part] = surface.data[part].astype(np.float64) - reference.data[part]
    statistics = differences(reference, surface, within, part_of(context, 0.3, 0.6))
    raster = Elevation(difference, reference.extent)
    picture = _map(raster, reference, statistics, limit, title, size, part_of(context, 0.6, 1.0))
    return Comparison(picture, raster, statistics, statistics.rmse, statistics.psnr)


@compare.forecast
def _forecast(reference: Forecast, surface: Forecast, *, size: int, **_: object) -> Forecast:
    pixels = (size + 300) * (size + 500)
    return Forecast(reference.bytes + 3 * pixels, 60 * pixels + 3 * reference.bytes + 2 * surface.bytes)


def _require_same_grid(reference: Elevation, surface: Elevation) -> None:
    try:
        require_same_grid(reference, surface)
    except ValueError as error:
        raise ValueError(f"{error}, or set resample to bring the surface to the grid of the reference") from None


def _matched(surface: Elevation, reference: Elevation, context: Context) -> Elevation:
    """Return the surface at the centres of the reference."""
    ours, theirs = reference.extent, surface.extent
    if (ours.unit, ours.crs) != (theirs.unit, theirs.crs) and not (ours.crs and theirs.crs):
        raise ValueError("one of the surfaces has no coordinate reference system; state it where it is loaded (crs)")
    surface = _coarsened(surface, reference, context)
    (rows, cols), extent = reference.shape, reference.extent
    across = extent.west + (np.arange(cols) + 0.5) * (extent.width / cols)
    heights = np.empty((rows, cols), np.float32)
    for part in row_blocks(rows, cols, context, start=0.3):
        down = extent.north - (np.arange(part.start, part.stop) + 0.5) * (extent.height / rows)
        x, y = np.meshgrid(across, down)
        if surface.extent.crs != extent.crs:
            from nodegraph_terrain.georeference import parse_crs, transformed

            x, y = transformed(parse_crs(extent.crs), parse_crs(surface.extent.crs), x, y)
        heights[part] = bilinear(surface, x, y)
    return Elevation(heights, extent)


def _coarsened(surface: Elevation, reference: Elevation, context: Context) -> Elevation:
    """Return a surface of much finer cells than the reference in cells of about its size, by means."""
    sides = [
        [side / count for side, count in zip(ground(grid.extent), grid.shape[::-1], strict=True)]
        for grid in (reference, surface)
    ]
    cols, rows = (
        max(1, round(count / max(1.0, wide / fine)))
        for count, wide, fine in zip(surface.shape[::-1], *sides, strict=True)
    )
    if rows > surface.shape[0] / 1.5 and cols > surface.shape[1] / 1.5:
        return surface
    return to_cells(surface, cell_size=None, rows=rows, columns=cols, method="area", context=part_of(context, 0.0, 0.3))


def _map(
    difference: Elevation, reference: Elevation, numbers: Differences, limit: float | None, title: str, size: int,
    context: Context,
) -> Image:  # fmt: skip
    em = letters(size)
    rows, cols = map_shape(difference.extent, size)
    edge = limit if limit is not None else _limit(difference)
    shown = _shown(difference, rows, cols, part_of(context, 0.0, 0.2))
    ground_shown = brought_to(reference, rows, cols, part_of(context, 0.2, 0.4))

    def tint(raster: Raster, start: float = 0.9) -> Image:
        part = part_of(context, start, start + 0.1)
        return colour_relief(raster, colours=COLOURS, minimum=-edge, maximum=edge, context=part)

    light = part_of(context, 0.5, 0.7)
    lit = hillshade(
        on_ground(ground_shown, 1.0), azimuth=315.0, altitude=45.0, z_factor=1.0, mode="multidirectional",
        cast_shadows=False, context=light,
    )  # fmt: skip
    lit = type(lit)(lit.data, difference.extent)
    tinted = blend_shade(
        tint(shown, 0.4), lit, mode="multiply", strength=0.45, level=math.sqrt(0.5), context=light
    ).data
    paper = np.array([int(NO_DATA[i : i + 2], 16) for i in (1, 3, 5)], np.uint8)
    picture = np.where(tinted[:, :, 3:] > 0, tinted[:, :, :3], paper)
    legend = Legend((-edge, edge), (), NO_DATA if numbers.void_count else "", em, "Difference, m", numbers.rows())
    beyond = float((np.abs(difference.data) > edge).sum()) / numbers.count
    notes = ["red: higher than the reference", "blue: lower", system_name(difference.extent)]
    if beyond > 0:
        notes.append(f"{100 * beyond:.2g} % of the cells lie beyond the last colours")
    drawing = opened(difference.extent, (rows, cols), em, title, notes, legend, "own")
    drawing.sheet.image(picture, drawing.frame.left, drawing.frame.top)
    context.progress(0.8)
    return drawing.finish(tint)


def _shown(difference: Elevation, rows: int, cols: int, context: Context) -> Elevation:
    """Return the differences in the pixels of the map: means where those are larger, else each cell as it is."""
    if difference.shape[0] > rows or difference.shape[1] > cols:
        return brought_to(difference, rows, cols, context)
    picks = [
        ((np.arange(new) + 0.5) * old / new).astype(np.int64)
        for new, old in zip((rows, cols), difference.shape, strict=True)
    ]
    return Elevation(difference.data[picks[0]][:, picks[1]], difference.extent)


def _limit(difference: Elevation) -> float:
    """Return a round difference that 98 % of the cells do not exceed."""
    known = np.abs(difference.data[~np.isnan(difference.data)])
    usual = float(np.percentile(known, 98)) or float(known.max())
    return round_step(usual, 1) if usual > 0 else 1.0
