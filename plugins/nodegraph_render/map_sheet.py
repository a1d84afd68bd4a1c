"""Sheets with a map on them: what maps for reports have in common."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite
from typing import TypeVar

import numpy as np

from nodegraph import Context
from nodegraph_render.map_frame import (
    Coordinates,
    Frame,
    draw_frame,
    draw_north_arrow,
    draw_scale_bar,
    ground,
    north_and_scale,
)
from nodegraph_render.map_legend import Legend, Tint
from nodegraph_render.sheet import INK, SOFT, Sheet, measure, wrapped
from nodegraph_terrain.raster import Elevation, Extent, Image, Raster
from nodegraph_terrain.resample import resample

T = TypeVar("T", bound=Raster)

NO_DATA = "#e6e6e6"


@dataclass(frozen=True)
class MapSheet:
    """A sheet on which a map is being drawn.

    Attributes:
        sheet: to draw on.
        frame: where the map lies.
        legend: beside it.
        notes: the lines of small print below it.
        coordinates: those along the frame.
    """

    sheet: Sheet
    frame: Frame
    legend: Legend
    notes: list[str]
    coordinates: Coordinates

    def finish(self, tint: Tint, contour: float = 1.0) -> Image:
        """Draw what stands around the map and return the picture, with the extent of the whole sheet.

        Args:
            tint: gives the heights of the legend their colours.
            contour: width of a contour, px.
        """
        sheet, frame, em = self.sheet, self.frame, self.frame.em
        draw_frame(sheet, frame, self.coordinates)
        bearing, scale = north_and_scale(frame.extent)
        left = frame.right + round(2 * em)
        draw_north_arrow(sheet, left + 2 * em, frame.top - 0.3 * em, em, bearing)
        self.legend.draw(sheet, left, frame.top + 5.8 * em, frame.bottom, tint, contour)
        below = frame.bottom + _tick_height(self.coordinates) * em
        draw_scale_bar(sheet, frame, frame.left, below, scale)
        for position, words in enumerate(self.notes):
            sheet.text(frame.left, below + (2.9 + 1.15 * position) * em, words, small_print(em), colour=SOFT)
        extent = frame.extent
        dx, dy = extent.width / frame.width, extent.height / frame.height
        west, north = extent.west - frame.left * dx, extent.north + frame.top * dy
        east, south = west + sheet.width * dx, north - sheet.height * dy
        return Image(sheet.pixels(), replace(extent, west=west, south=south, east=east, north=north))


def opened(
    extent: Extent,
    shape: tuple[int, int],
    em: float,
    title: str,
    notes: list[str],
    legend: Legend,
    coordinates: Coordinates,
) -> MapSheet:
    """Lay out a sheet for a map of `shape` (rows, cols of pixels): title, map, legend, scale bar, small print."""
    rows, cols = shape
    left = round((3.0 if coordinates != "none" else 1.5) * em)
    width = round(left + cols + 2 * em + legend.width + 1.5 * em)
    print_width = width - left - 1.5 * em
    titles = wrapped(title, 1.6 * em, print_width, bold=True) if title else []
    top = round((1.2 + 2.2 * len(titles) + 0.4 * bool(titles)) * em)
    lines = note_lines(notes, small_print(em), print_width)
    below = (_tick_height(coordinates) + 2.9 + 1.15 * len(lines) + 0.8) * em
    # Under a map that is lower than its legend, scale bar and print follow the map; the sheet ends below both.
    beside = 6.8 * em + legend.least_height
    sheet = Sheet(width, top + round(max(beside, rows + below)))
    for position, words in enumerate(titles):
        sheet.text(left, (1.0 + 2.2 * position) * em, words, 1.6 * em, bold=True, colour=INK)
    return MapSheet(sheet, Frame(left, top, cols, rows, extent, em), legend, lines, coordinates)


def letters(size: int) -> float:
    """Return the height of the letters for a map of that many pixels: legible at any size."""
    return max(11.0, size / 75)


def map_shape(extent: Extent, size: int) -> tuple[int, int]:
    """Return rows and columns of pixels, square on the ground, whose longer side is `size`; never under eight."""
    wide, high = ground(extent)
    return max(8, round(size * min(1.0, high / wide))), max(8, round(size * min(1.0, wide / high)))


def part_of(context: Context, start: float, stop: float) -> Context:
    """Return a context for a part of the work, whose progress from 0 to 1 is that from `start` to `stop`."""
    return Context(
        context.node,
        report=lambda done, message: context.progress(None if done is None else start + (stop - start) * done, message),
    )


def brought_to(raster: T, rows: int, cols: int, context: Context) -> T:
    """Return a raster over the same ground in other cells: means where they are larger, else a cubic spline."""
    if raster.shape == (rows, cols):
        return raster
    shrinks = raster.shape[0] > 1.5 * rows or raster.shape[1] > 1.5 * cols
    return resample(raster, rows=rows, columns=cols, method="area" if shrinks else "cubic", context=context)


def height_range(surface: Elevation) -> tuple[float, float]:
    """Return the lowest and highest height.  Raises `ValueError` where all is void, or some is infinite."""
    low, high = float(np.fmin.reduce(surface.data, axis=None)), float(np.fmax.reduce(surface.data, axis=None))
    if low != low:
        raise ValueError("every cell of the surface is void; there is nothing to draw")
    if not (isfinite(low) and isfinite(high)):
        raise ValueError("the surface holds infinite heights; link it through terrain.clamp first")
    return low, high


def on_ground(surface: Elevation, scale: float) -> Elevation:
    """Return the surface on a grid in metres of the ground, `scale` of them per metre of the map, without a system."""
    wide, high = ground(surface.extent)
    return Elevation(surface.data, Extent(0.0, 0.0, wide * scale, high * scale))


def system_name(extent: Extent) -> str:
    """Return the coordinate reference system of an extent in words, with its code."""
    if not extent.crs:
        return "no coordinate reference system"
    from nodegraph_terrain.georeference import parse_crs

    wkt = str(parse_crs(extent.crs).to_wkt())
    name = wkt.partition('["')[2].partition('"')[0]
    return f"{name} ({extent.crs})" if extent.crs.startswith("EPSG:") else name


def small_print(em: float) -> float:
    """Return the height of the letters of small print, px."""
    return max(9.0, 0.72 * em)


def _tick_height(coordinates: Coordinates) -> float:
    """Return the room that ticks and their coordinates take below a map, in heights of a letter."""
    return 2.4 if coordinates != "none" else 0.8


def note_lines(notes: list[str], size: float, width: float) -> list[str]:
    """Return notes in lines that break between them; one that is too long for a line has its own."""
    lines: list[str] = []
    for note in notes:
        joined = f"{lines[-1]}  ·  {note}" if lines else note
        if lines and measure(joined, size)[0] <= width:
            lines[-1] = joined
        else:
            lines += wrapped(note, size, width)
    return lines
