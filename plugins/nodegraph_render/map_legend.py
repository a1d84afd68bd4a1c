"""The legend beside a map: the colours of the heights, and what the lines are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nodegraph_render.rounding import multiples, round_step
from nodegraph_render.sheet import FRAME, SOFT, Sheet, decimals_of, measure, number
from nodegraph_terrain.raster import Extent, Image, Raster

Tint = Callable[[Raster], Image]
"""What gives heights their colours."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A kind of line: what it is called, its colour, and its width in widths of a contour."""

    words: str
    colour: str
    width: float


@dataclass(frozen=True, slots=True)
class Legend:
    """What stands in the legend.

    Attributes:
        heights: what the first and last colour stand for, m; None without colours by height.
        entries: kinds of lines.
        no_data: colour of voids, empty where there are none.
        em: height of the letters, px.
        heading: what the colours stand for, with the unit.
        facts: what to write below, each (name, value).
    """

    heights: tuple[float, float] | None
    entries: Sequence[Entry]
    no_data: str
    em: float
    heading: str = "Elevation, m"
    facts: Sequence[tuple[str, str]] = ()

    @property
    def width(self) -> float:
        """Width that it takes, px."""
        size = 0.85 * self.em
        words = [entry.words for entry in self.entries] + (["no data"] if self.no_data else [])
        rows = max((3.2 * self.em + measure(text, size)[0] for text in words), default=0.0)
        bar = 0.0
        if self.heights is not None:
            ends = (measure(number(value, 1), size)[0] for value in self.heights)
            bar = max(measure(self.heading, size, bold=True)[0], 2.4 * self.em + max(ends))
        facts = max((measure(f"{name}  {value}", size)[0] + 1.5 * self.em for name, value in self.facts), default=0.0)
        return max(4 * self.em, rows, bar, facts)

    @property
    def least_height(self) -> float:
        """Height that it takes at least, px."""
        bar = 9.5 * self.em if self.heights is not None else 0.0
        return bar + self._below + 0.5 * self.em

    @property
    def _below(self) -> float:
        """Height of what stands below the colours, px."""
        return 1.6 * self.em * (len(self.entries) + bool(self.no_data)) + 1.45 * self.em * len(self.facts)

    def draw(
        self,
        sheet: Sheet,
        left: float,
        top: float,
        bottom: float,
        tint: Tint,
        contour: float,
    ) -> None:
        """Draw it between two heights, px; `tint` colours the map, `contour` is the width of one."""
        em, size = self.em, 0.85 * self.em
        if self.heights is not None:
            sheet.text(left, top, self.heading, size, bold=True)
            rest = self._below + 3.2 * em
            high = round(min(24 * em, max(6 * em, bottom - top - rest)))
            self._bar(sheet, left, top + 1.9 * em, high, tint)
            top += high + 3.2 * em
        for entry in self.entries:
            middle = top + 0.5 * em
            width = entry.width * contour
            sheet.lines([[(left, middle), (left + 2.4 * em, middle)]], colour=entry.colour, width=width)
            sheet.text(left + 3.2 * em, middle, entry.words, size, down="center")
            top += 1.6 * em
        if self.no_data:
            box = (left, top, 2.4 * em, em)
            sheet.box(box, face=self.no_data, edge=SOFT, width=max(1.0, em / 16))
            sheet.text(left + 3.2 * em, top + 0.5 * em, "no data", size, down="center")
            top += 1.6 * em
        right = left + self.width
        for name, value in self.facts:
            sheet.text(left, top, name, size, colour=SOFT)
            sheet.text(right, top, value, size, across="right")
            top += 1.45 * em

    def _bar(self, sheet: Sheet, left: float, top: float, high: int, tint: Tint) -> None:
        assert self.heights is not None
        em, size = self.em, 0.85 * self.em
        low, peak = self.heights
        wide = round(1.5 * em)
        heights = peak - (np.arange(high) + 0.5) / high * (peak - low)
        shown = Raster(heights[:, None].astype(np.float32), Extent(0.0, 0.0, 1.0, float(high)))
        pixels = tint(shown).data[:, :, :3]
        sheet.image(np.repeat(pixels, wide, axis=1), left, top)
        left, top = round(left), round(top)
        sheet.box((left, top, wide, high), edge=FRAME, width=max(1.0, em / 16))
        step = round_step(peak - low, max(3.5, high / (2.2 * em)))
        for value in multiples(low, peak, step).tolist():
            y = top + (peak - value) / (peak - low) * high
            sheet.lines([[(left + wide, y), (left + wide + 0.3 * em, y)]], colour=FRAME, width=max(1.0, em / 16))
            sheet.text(left + wide + 0.6 * em, y, number(value, decimals_of(step)), size, down="center")
