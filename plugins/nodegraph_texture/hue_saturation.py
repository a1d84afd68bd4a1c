"""The histogram of hue and saturation, in which surfaces show as clusters."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, port_type, whole
from nodegraph_terrain.raster import Extent, Image
from nodegraph_texture.colour_table import (
    Colours,
    Flags,
    Floats,
    colour_codes,
    colour_table,
    hue_saturation_value,
    is_grey,
    used_pixels,
)

GREY_THRESHOLD = Param("Channels that differ by no more than this make a colour grey.", ge=0, le=255, unit="codes")
GREY_HUE = Param(
    "Hue that grey colours get: one which the image has nowhere, such as purple.", ge=0, lt=360, unit="deg"
)


@dataclass(frozen=True)
class Rectangle:
    """A surface that a person marks in the hue-saturation histogram.

    Attributes:
        name: of the surface.
        hue: from and to, degrees; from the greater to the smaller it runs through 0, such as [350, 20].
        saturation: from and to, 0 to 1.
        value: likewise: brightness, which tells snow from dark rock.
    """

    name: str
    hue: tuple[float, float] = (0.0, 360.0)
    saturation: tuple[float, float] = (0.0, 1.0)
    value: tuple[float, float] = (0.0, 1.0)

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "strict": True}

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise ValueError("a rectangle needs a name")
        if not all(isfinite(end) and 0 <= end <= 360 for end in self.hue):
            raise ValueError(f"hue of rectangle '{self.name}' must lie in 0 to 360 degrees, not {self.hue}")
        for key, (low, high) in {"saturation": self.saturation, "value": self.value}.items():
            if not 0 <= low <= high <= 1:
                raise ValueError(f"{key} of rectangle '{self.name}' must rise within 0 to 1, not {[low, high]}")

    def holds(self, hue: Floats, saturation: Floats, value: Floats) -> Flags:
        """Return which colours lie inside, the edges included."""
        start, end = self.hue
        inside = (hue >= start) & (hue <= end) if start <= end else (hue >= start) | (hue <= end)
        for amount, (low, high) in ((saturation, self.saturation), (value, self.value)):
            inside &= (amount >= np.float32(low)) & (amount <= np.float32(high))
        return np.asarray(inside)


@port_type
class HueSaturationHistogram:
    """How many pixels have which hue and saturation.

    Attributes:
        counts: (saturation bins, hue bins) int64; the bins share 0 to 1 and 0 to 360 degrees evenly, and full
            saturation belongs to the last.
        grey_threshold, grey_hue: how grey pixels were counted.
    """

    counts: npt.NDArray[np.int64]
    grey_threshold: float
    grey_hue: float

    def __post_init__(self) -> None:
        if self.counts.ndim != 2 or 0 in self.counts.shape:
            raise ValueError(f"counts of shape {self.counts.shape} must have saturation and hue as axes")


class Counted(NamedTuple):
    """What `hue_saturation_histogram` gives."""

    histogram: HueSaturationHistogram
    plot: Image


@node(version=1, locality=whole)
def hue_saturation_histogram(
    image: Image,
    *,
    grey_threshold: Annotated[float, GREY_THRESHOLD] = 8,
    grey_hue: Annotated[float, GREY_HUE] = 285,
    bins: Annotated[int, Param("Bins of hue, and of saturation.", ge=2, le=2048)] = 256,
    rectangles: Annotated[tuple[Rectangle, ...], Param("Surfaces to outline in the plot.")] = (),
    context: Context,
) -> Counted:
    """Count the pixels of an image by hue and saturation.

    Surfaces form clusters in this plane, whatever their shading.  Hue and saturation are those of the HSV hexcone of
    sRGB codes.  The hue of nearly grey pixels is an accident of rounding: they get a hue of their own, where they form
    a column by themselves.  Pixels of less than half alpha do not count.

    Args:
        image: sRGB picture.
        grey_threshold: largest difference of channels of a grey pixel, 0 to 255.
        grey_hue: hue of grey pixels, degrees; purple by default.
        bins: along both axes.
        rectangles: as of texture.classify_surfaces, drawn into the plot.
        context: the engine's.

    Returns:
        ``histogram``: the counts; ``plot``: their density on a logarithmic scale, in the colours they stand for.

    Raises:
        ValueError: the image is transparent all over.

    Source: Dachsbacher, Bolch and Stamminger 2006, section 5.2.1 and figure 7,
    https://inria.hal.science/inria-00606769.  Time is that of sorting the pixels' colours.
    """
    histogram = histogram_of(colours_of(image, context), grey_threshold, grey_hue, bins)
    context.progress(0.7)
    pixels = density_plot(histogram, rectangles)
    return Counted(histogram, Image(pixels, Extent(0.0, 0.0, float(pixels.shape[1]), float(pixels.shape[0]))))


@hue_saturation_histogram.forecast
def _forecast(image: Forecast, *, bins: int, **_: object) -> Forecast:
    return Forecast(8 * bins * bins + (4 << 20), 8 * image.bytes + (64 << 20))


def colours_of(image: Image, context: Context) -> Colours:
    """Return the colours of what an image shows.

    Raises:
        ValueError: it shows nothing.
    """
    codes, used = colour_codes(image.data), used_pixels(image.data)
    context.progress(0.2)
    table = colour_table(codes if used is None else codes[used])
    if not len(table.codes):
        raise ValueError("the image is transparent all over; give one that shows the ground")
    context.progress(0.5)
    return table


def histogram_of(table: Colours, grey_threshold: float, grey_hue: float, bins: int) -> HueSaturationHistogram:
    """Return the histogram of some colours."""
    hue, saturation, _ = greyed(table.rgb, grey_threshold, grey_hue)
    column = (hue * np.float32(bins / 360)).astype(np.intp) % bins
    row = np.minimum((saturation * np.float32(bins)).astype(np.intp), bins - 1)
    counts = np.bincount(row * bins + column, table.counts, bins * bins)
    return HueSaturationHistogram(counts.astype(np.int64).reshape(bins, bins), grey_threshold, grey_hue)


def greyed(rgb: npt.NDArray[np.uint8], grey_threshold: float, grey_hue: float) -> tuple[Floats, Floats, Floats]:
    """Return hue, saturation and value of colours, with the hue of grey ones as given."""
    hue, saturation, value = hue_saturation_value(rgb)
    hue[is_grey(rgb, grey_threshold)] = grey_hue
    return hue, saturation, value


def density_plot(histogram: HueSaturationHistogram, rectangles: tuple[Rectangle, ...] = ()) -> npt.NDArray[np.uint8]:
    """Return a picture of a histogram, (rows, columns, 3) uint8: brighter where more pixels are."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import hsv_to_rgb
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

    counts = histogram.counts
    rows, columns = counts.shape
    density = np.log1p(counts) / np.log1p(max(1, counts.max()))
    hue, saturation = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    column = int(histogram.grey_hue / 360 * columns) % columns
    saturation[:, column] = 0  # grey is shown as grey
    brightness = np.where(counts > 0, 0.25 + 0.75 * density, 0.0)
    colours = hsv_to_rgb(np.stack([hue, 0.25 + 0.75 * saturation * (saturation > 0), brightness], axis=-1))
    colours[:, column] = brightness[:, column, None]
    figure = Figure(figsize=(9, 5.4), dpi=110, layout="constrained", facecolor="white")
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.imshow(colours, origin="lower", extent=(0, 360, 0, 1), aspect="auto", interpolation="nearest")
    axes.set_xticks(range(0, 361, 60))
    axes.xaxis.set_major_formatter("{x:g}°")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlabel(f"hue (grey at {histogram.grey_hue:g}°)")
    axes.set_ylabel("saturation")
    for rectangle in rectangles:
        _outline(axes, rectangle)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _outline(axes: Any, rectangle: Rectangle) -> None:
    from matplotlib.patches import Rectangle as Patch

    (start, end), (low, high) = rectangle.hue, rectangle.saturation
    for left, right in [(start, end)] if start <= end else [(start, 360.0), (0.0, end)]:
        axes.add_patch(Patch((left, low), right - left, high - low, fill=False, edgecolor="white", lw=1.4))
    text = rectangle.name.replace("$", r"\$")
    axes.text(start + 2, high - 0.015, text, color="white", va="top", fontsize=10, clip_on=True)


def preview_hue_saturation(histogram: HueSaturationHistogram) -> bytes:
    """Show the density of pixels over hue and saturation, in the colours they stand for."""
    from nodegraph_terrain.formats.png import png

    return png(density_plot(histogram))
