"""A sheet of maps: geographic quantities over the relief, each with its legend."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np

from nodegraph import Context, Param, node, whole
from nodegraph_terrain.colour import HYPSOMETRIC
from nodegraph_terrain.hillshade import hillshade
from nodegraph_terrain.raster import Elevation, Extent, Image, Raster, Slope, require_same_grid
from nodegraph_texture.quantities import (
    Irradiation,
    Other,
    Precipitation,
    Radiation,
    SnowCover,
    Temperature,
    Wetness,
    quantity_name,
)

COLOURS: dict[type[Raster], str] = {
    Slope: "YlOrBr",
    Temperature: "RdYlBu_r",
    Precipitation: "YlGnBu",
    Radiation: "inferno",
    Irradiation: "inferno",
    Wetness: "BrBG",
    SnowCover: "Blues_r",
}
"""Colour maps by role, as readers know them; heights have layer tints, and others viridis."""

SHADE = 0.35
"""How much the relief darkens the colours."""

PANEL = 900
"""Cells along a side that are drawn at most: a panel has fewer pixels."""


@node(version=1, locality=whole)
def draw_quantities(
    surface: Elevation,
    *quantities: Raster,
    title: Annotated[str, Param("Written above the maps.")] = "",
    columns: Annotated[int | None, Param("Maps side by side; none: as many as make a square.", ge=1, le=8)] = None,
    width: Annotated[int, Param("Of a map, pixels.", ge=160, le=2000)] = 560,
    context: Context,
) -> Image:
    """Draw maps of quantities over the relief, each with its name, unit and a legend.

    Colours run from the first to the last percentile of a quantity's values (from 0 to 1 for shares), so that a few
    extremes leave the rest its contrast; the legend's ends are pointed where values lie beyond.

    Args:
        surface: whose relief is shown; elevation in metres.
        *quantities: on the same grid, one at least.
        title: may be empty.
        columns: of the sheet.
        width: of each map; the height follows from the ground.
        context: the engine's.

    Returns:
        An opaque picture in pixels, without a place on the Earth.  Voids are grey.

    Raises:
        ValueError: no quantities, one on another grid, or the surface is in degrees.
    """
    from io import BytesIO

    from matplotlib.figure import Figure
    from PIL import Image as Picture

    if not quantities:
        raise ValueError("there is nothing to draw; link quantities, such as texture.temperature")
    require_same_grid(surface, *quantities)
    shade = hillshade(surface, mode="multidirectional", context=Context()).data
    across = columns or math.ceil(math.sqrt(len(quantities)))
    down = math.ceil(len(quantities) / across)
    inches = width / 100
    tall = inches * surface.extent.height / surface.extent.width
    head = 0.4 if title else 0.0
    size = across * (inches + 0.95) + 0.1, down * (tall + 0.45) + head
    figure = Figure(figsize=size, dpi=100, facecolor="white")
    if title:
        figure.text(0.12 / size[0], 1 - 0.2 / size[1], title, fontsize=15, weight="bold", va="top")
    for number, quantity in enumerate(quantities):
        context.progress(number / len(quantities))
        row, col = divmod(number, across)
        left, bottom = 0.1 + col * (inches + 0.95), size[1] - head - (row + 1) * (tall + 0.45) + 0.1
        axes = figure.add_axes((left / size[0], bottom / size[1], inches / size[0], tall / size[1]))
        legend = figure.add_axes(((left + inches + 0.08) / size[0], bottom / size[1], 0.13 / size[0], tall / size[1]))
        _draw(figure, axes, legend, quantity, shade)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    pixels = np.asarray(Picture.open(buffer).convert("RGB"))
    return Image(pixels, Extent(0.0, 0.0, float(pixels.shape[1]), float(pixels.shape[0])))


def _draw(figure: Any, axes: Any, legend: Any, quantity: Raster, shade: Any) -> None:
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize

    step = max(1, -(-max(quantity.shape) // PANEL))
    values, light = quantity.data[::step, ::step], shade[::step, ::step]
    known = values[np.isfinite(values)]
    low, high = (float(v) for v in np.percentile(known, [1, 99])) if known.size else (0.0, 1.0)
    if quantity.bounds is not None and quantity.unit == "1":
        low, high = quantity.bounds
    if high <= low:
        low, high = low - 0.5, high + 0.5
    colours: Colormap = colormaps[COLOURS.get(type(quantity), "viridis")]
    if isinstance(quantity, Elevation):
        colours = LinearSegmentedColormap.from_list("hypsometric", HYPSOMETRIC)
    pixels = colours(Normalize(low, high, clip=True)(np.nan_to_num(values)))[..., :3]
    relief = np.clip(1 + SHADE * (np.nan_to_num(light, nan=0.7) / 0.7071 - 1) * 2, 0.25, 1.25)
    pixels = np.clip(pixels * relief[..., None], 0, 1)
    pixels[~np.isfinite(values)] = 0.6
    axes.imshow(pixels, extent=(0, 1, 0, 1), aspect="auto", interpolation="bilinear")
    axes.set(xticks=[], yticks=[])
    name = quantity_name(quantity).replace("_", " ") if not isinstance(quantity, Other) else quantity.name
    unit = f", {quantity.unit}" if quantity.unit not in ("", "1") else ""
    axes.set_title((name + unit).replace("$", r"\$"), loc="left", fontsize=11)
    below, above = (
        bool(known.size and test) for test in (known.min(initial=low) < low, known.max(initial=high) > high)
    )
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]
    bar = figure.colorbar(ScalarMappable(Normalize(low, high), colours), cax=legend, extend=extend)
    bar.ax.tick_params(labelsize=9)
    bar.outline.set_linewidth(0.5)
