"""A map of rivers over the shaded ground."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.topology import strahler_order
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.hillshade import hillshade
from nodegraph_terrain.raster import Elevation, Extent, Image


@node(version=1, locality=whole)
def draw_network(
    network: RiverNetwork,
    surface: Elevation | None = None,
    *,
    size: Annotated[int, Param("Longer side of the map.", ge=100, le=16384, unit="pixels")] = 1200,
    width: Annotated[float, Param("Line of the highest order.", gt=0, le=100, unit="pixels")] = 5.0,
    lowest_order: Annotated[int, Param("Rivers below this Strahler order are left out.", ge=1)] = 1,
    legend: Annotated[bool, Param("Write the orders in a corner.")] = True,
    context: Context,
) -> Image:
    """Draw rivers over the shaded ground, wider and darker with their Strahler order.

    The map covers the surface, or the rivers and a rim of 3 % where there is none.  Lines join the nodes straight, and
    those of greater order lie on top.

    Args:
        network: rivers, in metres.
        surface: the ground below them; voids are white.
        size: the map keeps the proportions of the ground.
        width: the width of order w is in proportion to w to the power 1.5, at least 0.6 pixels.
        lowest_order: what to draw.
        legend: orders and their lines, in the lower left corner.
        context: the engine's.

    Returns:
        A picture with the extent of the map.

    Raises:
        ValueError: a surface in degrees, an empty network without a surface, or a cycle.
    """
    extent = _framed(network) if surface is None else surface.extent
    columns, rows = (
        max(1, round(size * side / max(extent.width, extent.height))) for side in (extent.width, extent.height)
    )
    order = strahler_order(network.downstream)
    context.progress(0.3, "shading")
    ground = np.ones((2, 2), np.float32) if surface is None else shaded(surface, context)
    legs, widths, colours, levels = [], [], [], []
    top = int(order.max(initial=1))
    for level in range(lowest_order, top + 1):
        nodes = np.flatnonzero((order == level) & (network.downstream >= 0))
        legs.append(np.stack([network.position[nodes], network.position[network.downstream[nodes]]], axis=1))
        widths.append(max(0.6, width * (level / top) ** 1.5))
        colours.append(_colour(level, top))
        levels.append(f"order {level}")
    context.progress(0.6, "rivers")
    pixels = painted(extent, (rows, columns), ground, legs, widths, colours, levels if legend else [])
    return Image(pixels, extent)


@draw_network.forecast
def _forecast(network: Forecast, surface: Forecast | None = None, *, size: int, **_: object) -> Forecast:
    return Forecast(3 * size * size, 16 * size * size + 30 * network.bytes + (6 * surface.bytes if surface else 0))


def shaded(surface: Elevation, context: Context) -> npt.NDArray[Any]:
    """Return light relief shading of a surface, 0 to 1, white at voids."""
    require_projected(surface)
    quiet = Context(context.node)
    shade = hillshade(surface, mode="multidirectional", context=quiet).data
    # Level ground, sin 45 deg, is light grey; flanks stand out on both sides of it.
    return np.where(np.isnan(shade), 1.0, np.clip(0.87 + 1.25 * (shade - 0.707), 0.25, 1)).astype(np.float32)


def painted(
    extent: Extent,
    shape: tuple[int, int],
    ground: npt.NDArray[Any],
    legs: list[npt.NDArray[Any]],
    widths: list[float],
    colours: list[str],
    names: list[str],
) -> npt.NDArray[np.uint8]:
    """Return a map of grey ground and layers of lines, (rows, columns, 3).

    Args:
        extent: what the map covers.
        shape: rows and columns of the picture.
        ground: grey, 0 to 1, over the whole extent.
        legs: of each layer (n, 2, 2) pairs of points, or (n, 2) points, which become dots.
        widths: of the lines or dots of each layer, pixels.
        colours: of each layer.
        names: of each layer, for the legend; none without legend.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    rows, columns = shape
    # In points of 1/72 inch, a pixel is a point.
    figure = Figure(figsize=(columns / 72, rows / 72), dpi=72)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    box = (extent.west, extent.east, extent.south, extent.north)
    axes.imshow(ground, cmap="gray", vmin=0, vmax=1, extent=box, interpolation="bilinear", aspect="auto")
    handles = []
    for layer, (places, line, colour) in enumerate(zip(legs, widths, colours, strict=True)):
        if places.ndim == 3:
            axes.add_collection(LineCollection(list(places), linewidths=line, colors=colour, capstyle="round"))
            handles.append(Line2D([], [], color=colour, linewidth=line))
        else:
            axes.scatter(
                places[:, 0], places[:, 1], s=line**2, color=colour, marker="s", linewidths=0, zorder=2 + layer
            )
            handles.append(Line2D([], [], color=colour, marker="s", linestyle="", markersize=8))
    axes.set_xlim(extent.west, extent.east)
    axes.set_ylim(extent.south, extent.north)
    if names:
        letters = max(7.0, min(rows, columns) / 70)
        axes.legend(handles[::-1], names[::-1], loc="lower left", fontsize=letters, framealpha=0.85, edgecolor="none")
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _colour(level: int, top: int) -> str:
    from matplotlib.colors import to_hex, to_rgb

    share = (level - 1) / max(top - 1, 1)
    pale, dark = np.array(to_rgb("#4a9bd6")), np.array(to_rgb("#0b2f66"))
    return str(to_hex(pale + (dark - pale) * share))


def _framed(network: RiverNetwork) -> Extent:
    if not len(network.position):
        raise ValueError("the river network is empty and there is no surface; give one of them to draw")
    west, south = network.position.min(axis=0).tolist()
    east, north = network.position.max(axis=0).tolist()
    rim = 0.03 * max(east - west, north - south, 1.0)
    return Extent(west - rim, south - rim, east + rim, north + rim, network.crs)
