"""A sheet to draw figures on, in pixels from its upper left corner, through matplotlib's Agg renderer.

Nothing here touches the global state of matplotlib: every font, colour and width is stated, so that the same calls give
the same pixels under any configuration.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from math import cos, radians, sin
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from matplotlib.artist import Artist

Pixels = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]
Box = tuple[float, float, float, float]
"""Left, top, width, height, px."""

PAPER = "#ffffff"
INK = "#222222"
SOFT = "#666666"
FRAME = "#333333"

DPI = 72
"""A point is a pixel."""

SIDE_MAX = 16_384
"""Most pixels along a side of a sheet."""

DIGITS = 0.364
"""Half the height of digits, in sizes of the font."""

RUN = 4096
"""Points that a line is drawn in one go: Agg gives up on paths with too many."""


@dataclass
class Sheet:
    """A picture in the making; what is drawn later lies on top."""

    width: int
    height: int
    paper: str = PAPER
    _figure: Any = field(init=False, repr=False)
    _canvas: Any = field(init=False, repr=False)
    _count: int = field(init=False, default=0, repr=False)

    def __post_init__(self) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        if max(self.width, self.height) > SIDE_MAX:
            raise ValueError(
                f"the picture would have {self.width:,} x {self.height:,} pixels, over {SIDE_MAX:,}; make it smaller"
            )
        size = self.width / DPI, self.height / DPI
        self._figure = Figure(figsize=size, dpi=DPI, facecolor=self.paper, edgecolor="none", linewidth=0)
        self._canvas = FigureCanvasAgg(self._figure)

    def image(self, pixels: Pixels, left: float, top: float) -> None:
        """Lay pixels, (rows, cols, 3 or 4), on the sheet as they are."""
        down = self.height - round(top) - pixels.shape[0]
        self._add(_laid(pixels, round(left), down))

    def box(self, box: Box, *, face: str = "none", edge: str = "none", width: float = 1.0, alpha: float = 1.0) -> None:
        """Draw a rectangle."""
        from matplotlib.patches import Rectangle

        left, top, wide, high = box
        patch = Rectangle(
            (left, self.height - top - high), wide, high, facecolor=face, edgecolor=edge, linewidth=width, alpha=alpha,
            transform=self._pixels(), joinstyle="miter", antialiased=True,
        )  # fmt: skip
        self._add(patch)

    def area(
        self, corners: npt.ArrayLike, *, face: str, edge: str = "none", width: float = 1.0, clip: Box | None = None,
        alpha: float = 1.0,
    ) -> None:  # fmt: skip
        """Fill a polygon, (n, 2)."""
        from matplotlib.patches import Polygon

        patch = Polygon(
            self._upward(np.asarray(corners, np.float64)), closed=True, facecolor=face, edgecolor=edge, alpha=alpha,
            linewidth=width, transform=self._pixels(), joinstyle="round", antialiased=True,
        )  # fmt: skip
        self._add(patch, clip)

    def lines(
        self, lines: Iterable[npt.ArrayLike], *, colour: str | Sequence[str], width: float, clip: Box | None = None,
        alpha: float = 1.0, dashes: Sequence[float] | None = None,
    ) -> None:  # fmt: skip
        """Draw lines, each (n, 2); `dashes` gives lengths on and off, px."""
        from matplotlib.collections import LineCollection

        runs = [run for line in lines for run in _runs(self._upward(np.asarray(line, np.float64)))]
        drawn = LineCollection(
            runs, colors=colour, linewidths=width, alpha=alpha, transform=self._pixels(), capstyle="butt",
            joinstyle="round", antialiaseds=True, linestyles=(0, tuple(dashes)) if dashes else "solid",
        )  # fmt: skip
        self._add(drawn, clip)

    def text(
        self, x: float, y: float, words: str, size: float, *, colour: str = INK, bold: bool = False, turn: float = 0.0,
        across: Literal["left", "center", "right"] = "left",
        down: Literal["top", "center", "baseline", "bottom"] = "top",
        halo: str = "", halo_width: float = 0.0, alpha: float = 1.0,
    ) -> None:  # fmt: skip
        """Write words at a place, turned anticlockwise by `turn` degrees, as they stand: nothing in them is markup.

        ``center`` is the middle of the digits, so that words with and without descenders stand on one line.
        """
        from matplotlib.patheffects import withStroke
        from matplotlib.text import Text

        if down == "center":
            x, y, down = x + DIGITS * size * sin(radians(turn)), y + DIGITS * size * cos(radians(turn)), "baseline"
        effects = [withStroke(linewidth=halo_width, foreground=halo)] if halo else []
        written = Text(
            x, self.height - y, words, color=colour, ha=across, va=down, rotation=turn, rotation_mode="anchor",
            transform=self._pixels(), usetex=False, parse_math=False, fontproperties=_font(size, bold=bold),
            path_effects=effects, alpha=alpha, antialiased=True, linespacing=1.3,
        )  # fmt: skip
        self._add(written)

    def pixels(self) -> Pixels:
        """Return the finished picture, (rows, cols, 3)."""
        self._canvas.draw()
        return np.ascontiguousarray(np.asarray(self._canvas.buffer_rgba())[:, :, :3])

    def _upward(self, points: Floats) -> Floats:
        return np.column_stack([points[:, 0], self.height - points[:, 1]])

    @staticmethod
    def _pixels() -> Any:
        from matplotlib.transforms import IdentityTransform

        return IdentityTransform()

    def _add(self, artist: Artist, clip: Box | None = None) -> None:
        from matplotlib.transforms import Bbox

        self._count += 1
        artist.set_zorder(self._count)
        self._figure.add_artist(artist, clip=False)
        if clip is not None:
            left, top, wide, high = clip
            artist.set_clip_box(Bbox.from_bounds(left, self.height - top - high, wide, high))
            artist.set_clip_on(True)


def measure(words: str, size: float, *, bold: bool = False) -> tuple[float, float]:
    """Return width and height in pixels of a line of words.

    >>> wide, high = measure("1 000 m", 20)
    >>> 70 < wide < 100, 14 < high < 22
    (True, True)
    """
    from matplotlib.backends.backend_agg import RendererAgg

    # Asked of the renderer itself: at small sizes hinting makes words a good deal wider than their outlines.
    renderer: Any = RendererAgg(1, 1, DPI)  # type: ignore[no-untyped-call]
    wide, high, _ = renderer.get_text_width_height_descent(words, _font(size, bold=bold), False)
    return float(wide), float(high)


def wrapped(words: str, size: float, width: float, *, bold: bool = False) -> list[str]:
    """Return the lines that words take within a width; one word is never broken.

    >>> wrapped("one two three", 10, 45)
    ['one two', 'three']
    """
    found: list[str] = []
    for word in words.split(" "):
        longer = f"{found[-1]} {word}" if found else word
        if found and measure(longer, size, bold=bold)[0] <= width:
            found[-1] = longer
        else:
            found.append(word)
    return found


def number(value: float, decimals: int = 0) -> str:
    r"""Return a number as figures show it: thin spaces between thousands, a true minus.

    >>> number(-1234567.0), number(0.25, 2)
    ('−1\u2009234\u2009567', '0.25')
    """
    text = f"{value:,.{decimals}f}"
    text = text.removeprefix("-") if not any(digit in text for digit in "123456789") else text
    # Four digits stand together.
    return (text.replace(",", "" if abs(value) < 9999.5 else "\u2009")).replace("-", "−")


def decimals_of(step: float) -> int:
    """Return how many decimals the multiples of a round step need.

    >>> decimals_of(50.0), decimals_of(0.5), decimals_of(0.02), decimals_of(2.5)
    (0, 1, 2, 1)
    """
    text = f"{step:.9f}".rstrip("0")
    return len(text.partition(".")[2])


def _laid(pixels: Pixels, left: int, down: int) -> Artist:
    """Return an artist that copies pixels as they are; `Figure.figimage` would resample them."""
    from matplotlib.artist import Artist

    opaque = np.full((*pixels.shape[:2], 4 - pixels.shape[2]), 255, np.uint8)
    shown = np.concatenate([pixels, opaque], axis=2)[::-1]

    class Laid(Artist):
        def draw(self, renderer: Any) -> None:
            renderer.draw_image(renderer.new_gc(), left, down, shown)

    return Laid()


def _font(size: float, *, bold: bool) -> Any:
    from matplotlib.font_manager import FontProperties

    weight = "bold" if bold else "normal"
    # The family that comes with matplotlib: the same letters everywhere.
    return FontProperties(family="DejaVu Sans", size=size, weight=weight, style="normal", stretch="normal")


def _runs(line: Floats) -> list[Floats]:
    """Return a line in runs of at most `RUN` points that join, without points an eighth of a pixel apart."""
    coarse = np.round(line * 8)
    kept = np.ones(len(line), np.bool_)
    kept[1:-1] = (coarse[1:-1] != coarse[:-2]).any(axis=1)
    line = line[kept]
    return [line[start : start + RUN] for start in range(0, max(1, len(line) - 1), RUN - 1)]
