"""The value on the wire: `SurfaceClasses`, what the numbers of labels stand for."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_texture.colour_table import Colours, hue_saturation_value

SHADES = 8
"""Colours of a class that are kept."""


@port_type
class SurfaceClasses:
    """Surfaces that were told apart in an image; class i has the number i in labels.

    Attributes:
        names: of the classes.
        counts: (n,) int64, cells of each.
        colours: (n, 3) float32, their mean colours, sRGB, 0 to 1.
        shades: (n, 8, 3) float32, means of the eighths of each class, from dark to bright.
    """

    names: tuple[str, ...]
    counts: npt.NDArray[Any]
    colours: npt.NDArray[Any]
    shades: npt.NDArray[Any]

    def __post_init__(self) -> None:
        count = len(self.names)
        if count < 1 or len(set(self.names)) < count:
            raise ValueError("surface classes need one name each, and all different")
        shapes = (self.counts.shape, self.colours.shape, self.shades.shape[:1] + self.shades.shape[2:])
        if shapes != ((count,), (count, 3), (count, 3)):
            raise ValueError(f"{count} classes need as many counts, colours and rows of shades, not {shapes}")


def classes_of(names: tuple[str, ...], tables: list[Colours]) -> SurfaceClasses:
    """Return classes from the colours of the cells of each; a class without cells is black."""
    shades = np.zeros((len(tables), SHADES, 3), np.float32)
    colours = np.zeros((len(tables), 3), np.float32)
    for number, table in enumerate(tables):
        if not len(table.codes):
            continue
        rgb = table.rgb
        # Luma of Rec. 709 in sixteen bits, which sort fast.
        order = np.argsort(rgb.astype(np.uint16) @ np.array([54, 183, 18], np.uint16), kind="stable")
        weight = table.counts[order].astype(np.float64)
        below = np.concatenate([[0.0], np.cumsum(weight)])
        ends = np.linspace(0, below[-1], SHADES + 1)
        for channel in range(3):
            # The eighths cut through colours: a colour counts in each with the share of its cells that falls there.
            sums = np.concatenate([[0.0], np.cumsum(weight * rgb[order, channel])])
            colours[number, channel] = sums[-1] / below[-1] / 255
            shades[number, :, channel] = np.diff(np.interp(ends, below, sums)) / (below[-1] / SHADES) / 255
    counts = np.array([table.counts.sum() for table in tables], np.int64)
    return SurfaceClasses(names, counts, np.clip(colours, 0, 1), np.clip(shades, 0, 1))


def colour_names(colours: npt.NDArray[Any]) -> tuple[str, ...]:
    """Return a plain word for each of (n, 3) sRGB colours, 0 to 1; numbered where it is not the first of that word.

    >>> colour_names(np.array([[1, 1, 1], [0.3, 0.4, 0.2], [0.35, 0.45, 0.2]]))
    ('white', 'green', 'green 2')
    """
    hue, saturation, value = hue_saturation_value(np.rint(np.asarray(colours) * 255).astype(np.uint8))
    names: list[str] = []
    for h, s, v in zip(hue, saturation, value, strict=True):
        if v < 0.15:
            word = "black"
        elif s < 0.12:
            word = "white" if v > 0.85 else "light grey" if v > 0.6 else "grey" if v > 0.3 else "dark grey"
        else:
            words = (
                (48, "brown"),
                (70, "yellow"),
                (170, "green"),
                (200, "cyan"),
                (260, "blue"),
                (330, "purple"),
                (361, "brown"),
            )
            word = next(word for end, word in words if h < end)
        same = sum(name.rsplit(" ", 1)[0] == word or name == word for name in names)
        names.append(f"{word} {same + 1}" if same else word)
    return tuple(names)


def preview_classes(classes: SurfaceClasses) -> bytes:
    """Show each class by name, share and colour, with the range of its shades."""
    from io import BytesIO

    from matplotlib.figure import Figure

    count = len(classes.names)
    figure = Figure(figsize=(7, 0.5 + 0.5 * count), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    total = max(1, int(classes.counts.sum()))
    for row, name in enumerate(classes.names):
        axes.imshow(classes.colours[row][None, None], extent=(0, 1.6, row - 0.4, row + 0.4), aspect="auto")
        axes.imshow(classes.shades[row][None], extent=(1.7, 4, row - 0.4, row + 0.4), aspect="auto")
        text = f"{name.replace('$', chr(92) + '$')}   {classes.counts[row] / total:.1%}"
        axes.text(4.15, row, text, va="center", fontsize=11)
    axes.set_xlim(0, 7)
    axes.set_ylim(count - 0.5, -0.5)
    axes.set_axis_off()
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
