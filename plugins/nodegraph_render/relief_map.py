"""Relief maps for reports: shaded relief with contours, frame, scale bar, legend and what it all means."""

from __future__ import annotations

from dataclasses import replace
from math import radians, sin
from typing import Annotated, Literal

import numpy as np

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_render.contour_lines import contour_lines
from nodegraph_render.map_contours import contour_entries, contour_width, draw_contours, draw_labels, step_of
from nodegraph_render.map_frame import Coordinates, north_and_scale
from nodegraph_render.map_legend import Entry, Legend
from nodegraph_render.map_sheet import (
    NO_DATA,
    brought_to,
    height_range,
    letters,
    map_shape,
    on_ground,
    opened,
    part_of,
    system_name,
)
from nodegraph_render.rounding import round_step
from nodegraph_render.sheet import Pixels, decimals_of, number
from nodegraph_terrain.colour import Colours, blend_shade, colour_relief
from nodegraph_terrain.forecasts import outline
from nodegraph_terrain.gradient import horn_gradient
from nodegraph_terrain.hillshade import hillshade
from nodegraph_terrain.polylines import Polylines
from nodegraph_terrain.raster import Elevation, Extent, Image, Raster, Shade

EXAGGERATIONS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 50.0, 100.0)

LIVELY = 0.35
"""Slope, of the steepest twentieth of a map, that shading brings out well."""

APART = 60
"""Pixels of a map for each level of contours: a small map has fewer of them."""


@node(version=1, locality=whole)
def relief_map(
    surface: Elevation,
    shade: Shade | None = None,
    image: Image | None = None,
    contours: Polylines | None = None,
    lines: Polylines | None = None,
    *,
    title: Annotated[str, Param("Written above the map.")] = "",
    credit: Annotated[str, Param("Written below the map: where the data come from, say.")] = "",
    size: Annotated[int, Param("Longer side of the map itself, pixels.", ge=200, le=8192)] = 1200,
    colours: Annotated[
        Colours,
        Param(
            'A matplotlib map or "hypsometric", a list of "#rrggbb" colours, or a list of [height, "#rrggbb"] stops.'
        ),
    ] = "hypsometric",
    minimum: Annotated[float | None, Param("Height of the first colour; none: the lowest.", unit="m")] = None,
    maximum: Annotated[float | None, Param("Height of the last colour; none: the highest.", unit="m")] = None,
    azimuth: Annotated[
        float, Param("Where the light stands, clockwise from north.", ge=-360, le=360, unit="deg")
    ] = 315.0,
    altitude: Annotated[float, Param("Height of the light above the horizon.", gt=0, lt=90, unit="deg")] = 45.0,
    mode: Annotated[Literal["single", "multidirectional"], Param("One light or four, as in terrain.hillshade.")] = (
        "multidirectional"
    ),
    exaggeration: Annotated[
        float | None, Param("Vertical exaggeration of the shading; none: 1, or more for gentle land.", gt=0, le=1000)
    ] = None,
    strength: Annotated[float, Param("How much the shading acts.", ge=0, le=2)] = 1.0,
    interval: Annotated[
        float | None, Param("Height between contours; none: a round one; 0: no contours.", ge=0, unit="m")
    ] = None,
    index: Annotated[int, Param("Every so many contours one is heavier, with its height; 0: none is.", ge=0)] = 5,
    coordinates: Annotated[
        Coordinates, Param("Along the frame: those of the surface's own system, longitude and latitude, or none.")
    ] = "own",
    line_name: Annotated[str, Param("What the linked lines are, for the legend.")] = "lines",
    line_colour: Annotated[str, Param("Colour of the linked lines, #rrggbb.")] = "#1f62a8",
    line_width: Annotated[float, Param("Width of the linked lines, in widths of a contour.", gt=0, le=50)] = 3.0,
    context: Context,
) -> Image:
    """Draw a map for a report: colours by height, shaded relief, contours, frame, scale bar, legend and arrow to north.

    The surface is brought to the pixels of the map first (the mean of the cells in a pixel, or a cubic spline where the
    cells are larger) and shaded, coloured and contoured there, so that a map of any size shows what can be seen at that
    size.  Level ground keeps the colour of the legend (see terrain.blend_shade).  Contours run with their heights
    in gaps where they are straight; index contours are heavier and carry the heights.  Below stand the system, the size
    of the cells, the range of heights, the light, the vertical exaggeration of the shading and the interval.

    A surface in degrees is drawn with its middle parallel in true length; reproject it for areas larger than a few
    degrees.  The arrow points to true north in the middle of the map.  The scale bar holds in the middle: where the
    projection changes lengths by more than 1 % (Web Mercator), it is drawn for the ground.

    Args:
        surface: elevation in metres, on a grid in metres or degrees; voids are grey.
        shade: shading to use instead of the map's own, over the same ground.
        image: picture to use instead of colours by height, over the same ground, such as an aerial photograph.
        contours: lines to use instead of the map's own contours, with the property ``level``, and ``index`` (bool) for
            the heavy ones, as render.contour_lines gives them.
        lines: lines to draw on top, such as rivers or roads.
        title: above the map.
        credit: below it.
        size: of the map; frame and legend are added around it.
        colours: as in terrain.colour_relief.
        minimum: height of the first colour; lower ground has it, too.
        maximum: height of the last colour; higher ground has it, too.
        azimuth: of the light.
        altitude: of the light.
        mode: of the shading.
        exaggeration: of the shading.
        strength: of the shading.
        interval: between contours.
        index: every so many contours one is heavier.
        coordinates: along the frame.
        line_name: for the legend; empty leaves the lines out of it.
        line_colour: of `lines`.
        line_width: of `lines`.
        context: the engine's.

    Returns:
        An opaque picture.  Its extent is that of the whole sheet, at the scale of the map: saved as GeoTIFF or with a
        world file, the map within lies where it belongs.

    Raises:
        ValueError: every cell is void, the linked rasters cover other ground, a system is missing, or a colour is
            unknown.

    References:
        E. Imhof (1982): Cartographic Relief Presentation. De Gruyter. doi:10.1515/9783110844016.
    """
    low, high = height_range(surface)
    em = letters(size)
    rows, cols = map_shape(surface.extent, size)
    display = brought_to(surface, rows, cols, part_of(context, 0.0, 0.3))
    lowest, highest = _colour_range(colours, minimum, maximum, low, high)
    _, scale = north_and_scale(surface.extent)
    metric = on_ground(display, scale)
    times = exaggeration if exaggeration is not None else _exaggeration(metric)
    step = _interval(interval, low, high, size)
    if contours is None:
        contours = _contours(display, step, index, part_of(context, 0.3, 0.4))
    else:
        step = step_of(contours)
    by_value = not isinstance(colours, str) and not isinstance(colours[0], str)
    first, last = (None, None) if by_value else (lowest, highest)

    def tint(raster: Raster, start: float = 0.9) -> Image:
        part = part_of(context, start, start + 0.1)
        return colour_relief(raster, colours=colours, minimum=first, maximum=last, context=part)

    tinted = tint(metric, 0.4) if image is None else _scaled(image, surface.extent, rows, cols)
    light = part_of(context, 0.5, 0.6)
    if shade is None:
        lit = hillshade(
            metric, azimuth=azimuth, altitude=altitude, z_factor=times, mode=mode, cast_shadows=False, context=light
        )
    else:
        _require_same_ground(surface.extent, shade.extent, "shade")
        lit = brought_to(shade, rows, cols, light)
    picture = _picture(tinted, lit, surface.extent, strength, sin(radians(altitude)), context)
    entries = contour_entries(contours, step, index)
    if lines is not None and line_name:
        entries.append(Entry(line_name, line_colour, line_width))
    voids = bool(np.isnan(display.data).any())
    legend = Legend(None if image is not None else (lowest, highest), entries, NO_DATA if voids else "", em)
    shading = (azimuth, altitude, mode, times) if shade is None else None
    notes = _notes(surface, low, high, shading, step, scale, credit)
    drawing = opened(surface.extent, (rows, cols), em, title, notes, legend, coordinates)
    sheet, frame = drawing.sheet, drawing.frame
    sheet.image(picture, frame.left, frame.top)
    labels = draw_contours(sheet, frame, contours)
    context.progress(0.8)
    if lines is not None:
        drawn = [frame.places(line) for line in frame.own(lines).lines()]
        sheet.lines(drawn, colour=_colour(line_colour), width=line_width * contour_width(em), clip=frame.box)
    draw_labels(sheet, labels, em)
    context.progress(0.9)
    return drawing.finish(tint, contour_width(em))


@relief_map.forecast
def _forecast(
    surface: Forecast,
    shade: Forecast | None,  # noqa: ARG001
    image: Forecast | None,  # noqa: ARG001
    contours: Forecast | None,  # noqa: ARG001
    lines: Forecast | None,  # noqa: ARG001
    *,
    size: int,
    **_: object,
) -> Forecast:
    known = outline(surface)
    rows, cols = map_shape(known.extent, size) if known is not None else (size, size)
    em = letters(size)
    pixels = int((rows + 14 * em) * (cols + 22 * em))
    return Forecast(3 * pixels, 60 * pixels + 2 * surface.bytes)


def _colour_range(
    colours: Colours, minimum: float | None, maximum: float | None, low: float, high: float
) -> tuple[float, float]:
    """Return the heights of the first and last colour."""
    if not colours:
        raise ValueError('colours are missing; give the name of a map, "#rrggbb" colours or [height, "#rrggbb"] stops')
    if not isinstance(colours, str) and not isinstance(colours[0], str):
        if minimum is not None or maximum is not None:
            raise ValueError("stops with heights fix the range themselves; leave out minimum and maximum")
        first, last = float(colours[0][0]), float(colours[-1][0])
        return (first, last) if first < last else (first - 1, first + 1)
    first, last = low if minimum is None else minimum, high if maximum is None else maximum
    if minimum is not None and maximum is not None and minimum >= maximum:
        raise ValueError(f"minimum {minimum:g} must be below maximum {maximum:g}")
    if first < last:
        return first, last
    # Level ground, or all of it beyond the one end that was given.
    return (last - 1, last) if maximum is not None else (first - 1, first + 1)


def _colour(text: str) -> str:
    from matplotlib.colors import is_color_like

    if not (text.startswith("#") and is_color_like(text)):
        raise ValueError(f"colour '{text}' must read '#rrggbb', such as '#1f62a8'")
    return text


def _exaggeration(metric: Elevation) -> float:
    """Return a round exaggeration that makes the steepest parts lively; 1 where they are."""
    steep = np.hypot(*horn_gradient(metric.data, slice(None), metric.cell_size))
    known = steep[~np.isnan(steep)]
    steepest = float(np.percentile(known, 95)) if len(known) else 0.0
    if steepest <= 0:
        return 1.0
    return next((times for times in EXAGGERATIONS if times * steepest >= LIVELY), EXAGGERATIONS[-1])


def _interval(interval: float | None, low: float, high: float, size: int) -> float:
    if interval is not None:
        return interval
    return round_step(high - low, min(20.0, size / APART)) if high > low else 0.0


def _contours(display: Elevation, step: float, index: int, context: Context) -> Polylines:
    if step == 0:
        return Polylines.of([], crs=display.extent.crs, unit=display.extent.unit)
    return contour_lines(display, interval=step, index=index, context=context)


def _picture(tinted: Image, lit: Shade, extent: Extent, strength: float, level: float, context: Context) -> Pixels:
    """Return the pixels of the map: colours under shading, what is transparent in grey."""
    # All of them lie on the same pixels now, whatever they say of the ground.
    tinted, lit = replace(tinted, extent=extent), replace(lit, extent=extent)
    shaded = blend_shade(
        tinted, lit, mode="multiply", strength=strength, level=level, context=part_of(context, 0.6, 0.7)
    ).data
    pixels = np.ascontiguousarray(shaded[:, :, :3])
    if shaded.shape[2] == 4:
        clear = shaded[:, :, 3] < 255
        paper = np.array([int(NO_DATA[i : i + 2], 16) for i in (1, 3, 5)])
        alpha = shaded[clear][:, 3:] / 255
        pixels[clear] = np.rint(shaded[clear][:, :3] * alpha + paper * (1 - alpha))
    return pixels


def _require_same_ground(a: Extent, b: Extent, name: str) -> None:
    offset = max(abs(a.west - b.west), abs(a.east - b.east)) / a.width
    offset = max(offset, max(abs(a.north - b.north), abs(a.south - b.south)) / a.height)
    if offset > 1e-3 or a.unit != b.unit or (a.crs and b.crs and a.crs != b.crs):
        raise ValueError(
            f"the {name} does not cover the same ground as the surface; reproject or crop one to the other"
        )


def _scaled(image: Image, extent: Extent, rows: int, cols: int) -> Image:
    """Return a picture of the same ground in other pixels, its colours weighed by its alpha."""
    _require_same_ground(extent, image.extent, "image")
    if image.shape == (rows, cols):
        return image
    codes = image.data.astype(np.float32)
    if codes.shape[2] == 4:
        codes[:, :, :3] *= codes[:, :, 3:] / 255
    planes = [Raster(np.ascontiguousarray(codes[:, :, channel]), image.extent) for channel in range(codes.shape[2])]
    scaled = np.stack([brought_to(plane, rows, cols, Context()).data for plane in planes], axis=-1)
    if codes.shape[2] == 4:
        with np.errstate(divide="ignore", invalid="ignore"):
            scaled[:, :, :3] = np.nan_to_num(scaled[:, :, :3] * 255 / scaled[:, :, 3:])
    return Image(np.rint(np.clip(scaled, 0, 255)).astype(np.uint8), image.extent)


def _notes(
    surface: Elevation, low: float, high: float, light: tuple[float, float, str, float] | None, step: float,
    scale: float, credit: str,
) -> list[str]:  # fmt: skip
    """Return what stands in small print below the map."""
    dx, dy = surface.cell_size
    if surface.extent.unit == "deg":
        cells = f"cells of {dx * 3600:.4g}″ × {dy * 3600:.4g}″"
    else:
        cells = f"cells of {dx:.4g} m" if abs(dx - dy) < 1e-3 * dx else f"cells of {dx:.4g} × {dy:.4g} m"
    digits = 0 if high - low >= 20 else 2
    notes = [system_name(surface.extent), cells, f"heights {number(low, digits)} to {number(high, digits)} m"]
    if light is not None:
        azimuth, altitude, mode, times = light
        sides = "four sides around " if mode == "multidirectional" else ""
        notes.append(f"light from {sides}{azimuth:g}°, {altitude:g}° high")
        notes.append(f"vertical exaggeration of the shading {times:g}×")
    if step:
        notes.append(f"contour interval {number(step, decimals_of(step))} m")
    if scale != 1:
        notes.append("scale bar for the middle of the map")
    return [*notes, credit] if credit else notes
