"""Pictures of values for people: what a preview shows of each grid type."""

from __future__ import annotations

from math import cos, radians

import numpy as np
import numpy.typing as npt

from nodegraph import Preview
from nodegraph_terrain.polylines import Polylines
from nodegraph_terrain.raster import Elevation, Grid, Image, Labels, Mask, Normals, Raster, Shade, Slope
from nodegraph_terrain.statistics import Histogram

LONG_SIDE = 1024
"""Most pixels along a side of a preview."""

Pixels = npt.NDArray[np.uint8]

_RELIEF = ("#3f6f4a", "#6f9a5c", "#b7c07c", "#d9c58c", "#b98f63", "#94755f", "#b9b0aa", "#ffffff")
_STEEPNESS = ("#ffffff", "#fff3b0", "#fec44f", "#ec7014", "#993404", "#3d1602")
_PLAIN = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")
_GREY = ("#000000", "#ffffff")


def preview_elevation(surface: Elevation) -> bytes:
    """Show heights as colours from lowland green to summit white, shaded from the north-west."""
    values = shrink(surface)
    colours = ramp(stretch(values, 0.5, 99.5), _RELIEF).astype(np.float64)
    colours[..., :3] *= (0.35 + 0.75 * _shade(values, _pixel_metres(surface, values.shape)))[..., None]
    return _png(np.clip(colours, 0, 255).astype(np.uint8))


def preview_raster(raster: Raster) -> bytes:
    """Show any values from their 1st to their 99th percentile, dark blue to yellow."""
    return _png(ramp(stretch(shrink(raster), 1, 99), _PLAIN))


def preview_unit(raster: Raster) -> bytes:
    """Show 0 to 1 as black to white."""
    return _png(ramp(shrink(raster), _GREY))


def preview_slope(slope: Slope) -> bytes:
    """Show 0 to 60 degrees as white through orange to brown."""
    return _png(ramp(shrink(slope) / np.float32(60), _STEEPNESS))


def preview_labels(labels: Labels) -> bytes:
    """Show every class in a colour of its own; none is transparent."""
    rows, cols = _size(labels)
    picked = labels.data[_middles(labels.shape[0], rows)][:, _middles(labels.shape[1], cols)].astype(np.int64)
    # Hues a golden angle apart: neighbouring numbers never look alike.
    hue = np.mod(picked * 0.618033988749895, 1.0)
    distance = np.abs(np.mod(hue[..., None] * 6 - np.array([0, 2, 4]) + 3, 6) - 3)
    colours = 70 + 170 * np.clip(2 - distance, 0, 1)
    alpha = np.where(picked < 0, 0, 255)
    return _png(np.concatenate([colours, alpha[..., None]], axis=-1).astype(np.uint8))


def preview_normals(normals: Normals) -> bytes:
    """Show east, north and up as red, green and blue, -1 to 1 as black to full."""
    rows, cols = _size(normals)
    picked = normals.data[_middles(normals.shape[0], rows)][:, _middles(normals.shape[1], cols)]
    missing = np.isnan(picked).any(axis=2)
    pixels = np.empty((*missing.shape, 4), np.uint8)
    pixels[..., :3] = np.rint(np.clip(np.nan_to_num(picked) * 127.5 + 127.5, 0, 255))
    pixels[..., 3] = np.where(missing, 0, 255)
    return _png(pixels)


def preview_histogram(histogram: Histogram) -> bytes:
    """Show the counts as bars over the edges, with the unit."""
    from io import BytesIO

    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    axes.stairs(histogram.counts, histogram.edges, fill=True, color="#3b6f8f")
    axes.set_ylabel("cells")
    axes.set_xlabel(histogram.unit)
    axes.spines[["top", "right"]].set_visible(False)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def preview_polylines(lines: Polylines) -> bytes:
    """Show the lines over their coordinates, coloured by their first property that is a number."""
    from io import BytesIO

    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 8), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    drawn = LineCollection([points[:, :2] for points in lines.lines()], linewidths=0.9, colors="#2b6ca3")
    for item in lines.properties:
        if isinstance(item.values, np.ndarray) and item.values.dtype.kind == "f" and np.isfinite(item.values).any():
            drawn.set(array=item.values, cmap="viridis", color=None)
            unit = f", {item.unit}" if item.unit else ""
            figure.colorbar(drawn, ax=axes, label=(item.name + unit).replace("$", r"\$"), shrink=0.6)
            break
    axes.add_collection(drawn)
    axes.autoscale_view()
    degrees = lines.unit == "deg"
    middle = 0.0 if lines.bounds is None else (lines.bounds[1] + lines.bounds[3]) / 2
    axes.set_aspect(1 / max(cos(radians(middle)), 0.05) if degrees else 1)
    axes.set_xlabel("longitude, deg" if degrees else "x, m")
    axes.set_ylabel("latitude, deg" if degrees else "y, m")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.locator_params(nbins=5)
    axes.spines[["top", "right"]].set_visible(False)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def preview_image(image: Image) -> bytes:
    """Show the picture, made smaller where it is large."""
    rows, cols = _size(image)
    if (rows, cols) == image.shape:
        return _png(image.data)
    data = image.data.astype(np.float32)
    if image.data.shape[2] == 4:
        data[..., :3] *= data[..., 3:] / 255
    means = np.stack([_means(data[..., channel], rows, cols) for channel in range(data.shape[2])], axis=-1)
    if means.shape[2] == 4:
        with np.errstate(divide="ignore", invalid="ignore"):
            means[..., :3] = np.nan_to_num(means[..., :3] * 255 / means[..., 3:])
    return _png(np.clip(np.rint(means), 0, 255).astype(np.uint8))


PREVIEWS: tuple[Preview, ...] = (
    Preview(Elevation, preview_elevation),
    Preview(Slope, preview_slope),
    Preview(Mask, preview_unit),
    Preview(Shade, preview_unit),
    Preview(Raster, preview_raster),
    Preview(Labels, preview_labels),
    Preview(Image, preview_image),
    Preview(Normals, preview_normals),
    Preview(Histogram, preview_histogram),
    Preview(Polylines, preview_polylines),
)
"""How the grid types are drawn; a type without an entry takes that of its nearest base."""


# Making it smaller.


def _ground_cell(grid: Grid) -> tuple[float, float]:
    """Return width and height of a cell on the ground, in metres."""
    dx, dy = grid.cell_size
    if grid.extent.unit == "deg":
        degree = 6_371_000 * radians(1)
        middle = radians((grid.extent.south + grid.extent.north) / 2)
        return dx * degree * max(cos(middle), 0.05), dy * degree
    return dx, dy


def _size(grid: Grid) -> tuple[int, int]:
    """Return the picture's shape: true proportions on the ground, no finer than the cells, long side bounded."""
    dx, dy = _ground_cell(grid)
    rows, cols = grid.shape
    side = max(dx, dy, rows * dy / LONG_SIDE, cols * dx / LONG_SIDE)
    return min(rows, max(1, round(rows * dy / side))), min(cols, max(1, round(cols * dx / side)))


def _pixel_metres(grid: Grid, shape: tuple[int, ...]) -> tuple[float, float]:
    dx, dy = _ground_cell(grid)
    return dx * grid.shape[1] / shape[1], dy * grid.shape[0] / shape[0]


def _middles(count: int, new: int) -> npt.NDArray[np.int64]:
    return ((np.arange(new) + 0.5) * count / new).astype(np.int64)


def shrink(raster: Raster) -> npt.NDArray[np.float32]:
    """Return the means of the known cells in every pixel of a preview, NaN where there are none."""
    return _means(raster.data, *_size(raster))


def _means(values: npt.NDArray[np.float32], rows: int, cols: int) -> npt.NDArray[np.float32]:
    if values.shape == (rows, cols):
        return np.array(values, np.float32)
    known = ~np.isnan(values)
    tops, lefts = (np.arange(new) * old // new for new, old in zip((rows, cols), values.shape, strict=True))
    total = np.add.reduceat(np.add.reduceat(np.where(known, values, 0), tops, axis=0, dtype=np.float64), lefts, axis=1)
    count = np.add.reduceat(np.add.reduceat(known, tops, axis=0, dtype=np.int64), lefts, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (total / count).astype(np.float32)


# Colouring it.


def stretch(values: npt.NDArray[np.float32], low: float, high: float) -> npt.NDArray[np.float32]:
    """Return the values with two percentiles of them at 0 and 1; a constant becomes one half."""
    known = values[~np.isnan(values)]
    if not len(known):
        return values
    first, last = (float(value) for value in np.percentile(known, [low, high]))
    if last <= first:
        return np.where(np.isnan(values), values, np.float32(0.5))
    return (values - np.float32(first)) / np.float32(last - first)


def ramp(values: npt.NDArray[np.float32], colours: tuple[str, ...]) -> Pixels:
    """Return (rows, columns, 4) pixels: 0 to 1 runs through the colours, NaN is transparent."""
    stops = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours], np.float64)
    missing = np.isnan(values)
    place = np.clip(np.where(missing, 0, values), 0, 1) * (len(stops) - 1)
    pixels = np.empty((*values.shape, 4), np.uint8)
    for channel in range(3):
        pixels[..., channel] = np.rint(np.interp(place, np.arange(len(stops)), stops[:, channel]))
    pixels[..., 3] = np.where(missing, 0, 255)
    return pixels


def _shade(values: npt.NDArray[np.float32], pixel: tuple[float, float]) -> npt.NDArray[np.float64]:
    """Return Lambert shading, 0 to 1, with the light in the north-west at 45 degrees; flat ground has 0.71."""
    if min(values.shape) < 2:
        return np.full(values.shape, 0.71)
    south, east = (np.nan_to_num(slope) for slope in np.gradient(values.astype(np.float64), pixel[1], pixel[0]))
    # A preview of gentle land should not be blank: relief is exaggerated until its slopes are visible.
    steep = float(np.percentile(np.hypot(south, east), 95))
    scale = max(1.0, 0.4 / steep) if steep > 0 else 1.0
    south, east = south * scale, east * scale
    # The surface normal is (-dz/dx, -dz/dy, 1), with x to the east and y to the north; the light (-1, 1, sqrt 2) / 2.
    lit = (east + south + np.sqrt(2)) / (2 * np.sqrt(1 + south**2 + east**2))
    return np.asarray(np.clip(lit, 0, 1))


def _png(pixels: Pixels) -> bytes:
    from nodegraph_terrain.formats.png import png

    return png(pixels)
