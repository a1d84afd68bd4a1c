"""Plots of profiles: height over distance, with what is ground filled and water lying on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node, whole
from nodegraph_render.map_sheet import note_lines, small_print
from nodegraph_render.rounding import multiples, round_step
from nodegraph_render.sheet import FRAME, INK, SOFT, Box, Sheet, decimals_of, measure, number, wrapped
from nodegraph_terrain.raster import Extent, Image
from nodegraph_tree.evaluate import Profile

Floats = npt.NDArray[np.float64]
Style = Literal["ground", "water", "line"]

GROUND, GROUND_EDGE = "#cdb794", "#5d4630"
WATER, WATER_EDGE = "#9cc3e2", "#2c6aa6"
LINES = ("#b2332e", "#3f7f4f", "#7a4fa0", "#c77a12", "#2f7f8c")
GRID = "#e3e3e3"


@node(version=1, locality=whole)
def profile_plot(
    *profiles: Profile,
    title: Annotated[str, Param("Written above the plot.")] = "",
    names: Annotated[tuple[str, ...], Param("What each profile is called, for the legend.")] = (),
    styles: Annotated[
        tuple[Style, ...], Param("How each is drawn; none: the first as ground, the others as lines.")
    ] = (),
    width: Annotated[int, Param("Width of the picture, pixels.", ge=300, le=8192)] = 1200,
    height: Annotated[int, Param("Height of the picture, pixels.", ge=200, le=8192)] = 480,
    exaggeration: Annotated[
        float | None, Param("Vertical exaggeration; none: what fills the plot.", gt=0, le=1e6)
    ] = None,
    context: Context,
) -> Image:
    """Plot profiles: height over distance, with the ground filled and water lying on it.

    ``ground`` is filled down to the axis; ``water`` is filled down to the first ground where it lies higher, and is a
    line where there is none; ``line`` is drawn as it is.  Void stretches stay empty.  Below stand the vertical
    exaggeration (a metre of height over a metre of distance on paper), the length and the heights.

    Args:
        profiles: from tree.query, render.profile; at least one, drawn in order.
        title: above the plot.
        names: for the legend, one per profile; none leaves it out.
        styles: one per profile.
        width: of the picture.
        height: of the picture.
        exaggeration: with it, the heights shown follow from it, around those of the profiles.
        context: the engine's.

    Returns:
        An opaque picture; its extent counts pixels.

    Raises:
        ValueError: no profile is linked, one has no length, none has a height, names or styles do not match, or the
            heights do not fit the picture at the stated exaggeration.
    """
    chosen = _styles(profiles, names, styles)
    em = max(11.0, width / 75)
    left, right = min(float(item.distance[0]) for item in profiles), max(float(item.distance[-1]) for item in profiles)
    known = np.concatenate([item.height[np.isfinite(item.height)] for item in profiles])
    low, high = float(known.min()), float(known.max())
    sheet = Sheet(width, height)
    titles = wrapped(title, 1.5 * em, width - 6.7 * em, bold=True) if title else []
    top = (1.2 + 2.1 * len(titles) + (1.9 if names else 0.3)) * em
    left_margin, size = 5.2 * em, small_print(em)
    digits = 0 if high - low >= 20 else 2
    notes = [f"heights {number(low, digits)} to {number(high, digits)} m"]
    # The exaggeration follows from the height that is left; its figures take no more room than these.
    lines = len(note_lines(["vertical exaggeration 0000×", "length 00.00 km", *notes], size, width - left_margin - em))
    box = left_margin, top, width - left_margin - 1.5 * em, height - top - (4.5 + 1.15 * lines) * em
    if box[2] < 4 * em or box[3] < 3 * em:
        raise ValueError(f"{width} x {height} pixels leave no room for a plot; make the picture larger")
    bottom, peak = _heights(low, high, box, right - left, exaggeration, height)
    axes = _Axes(box, (left, right), (bottom, peak), em)
    for row, words in enumerate(titles):
        sheet.text(left_margin, (0.9 + 2.1 * row) * em, words, 1.5 * em, bold=True)
    axes.draw_grid(sheet)
    context.progress(0.3)
    base = next((item for item, style in zip(profiles, chosen, strict=True) if style == "ground"), None)
    colours = _colours(chosen)
    drawn = list(zip(profiles, chosen, colours, strict=True))
    for item, style, _ in drawn:
        _fill(sheet, axes, item, style, base)
    for item, style, colour in drawn:
        _outline(sheet, axes, item, style, colour, base)
    axes.draw_frame(sheet)
    if names:
        _draw_legend(sheet, axes, names, chosen, colours)
    times = (box[3] / (peak - bottom)) / (box[2] / (right - left))
    notes = [f"vertical exaggeration {_figures(times)}×", f"length {axes.distance_text(right - left)}", *notes]
    for row, words in enumerate(note_lines(notes, size, width - left_margin - em)):
        sheet.text(box[0], box[1] + box[3] + (4.0 + 1.15 * row) * em, words, size, colour=SOFT)
    context.progress(0.8)
    return Image(sheet.pixels(), Extent(0.0, 0.0, float(width), float(height)))


def _styles(profiles: Sequence[Profile], names: Sequence[str], styles: Sequence[Style]) -> list[Style]:
    """Return how each profile is drawn, after a look at all of them."""
    if not profiles:
        raise ValueError("no profile is linked; link tree.query with a spacing, or render.profile")
    for what, given in (("names", names), ("styles", styles)):
        if given and len(given) != len(profiles):
            raise ValueError(f"{len(given)} {what} are given for {len(profiles)} profiles; give one for each")
    for index, item in enumerate(profiles):
        if len(item.distance) < 2 or not item.distance[-1] > item.distance[0]:
            raise ValueError(f"profile {index} has no length; sample it along a line, with a spacing")
        if np.isinf(item.height).any():
            raise ValueError(f"profile {index} holds infinite heights")
    if not any(np.isfinite(item.height).any() for item in profiles):
        raise ValueError("no profile has a height: they lie outside of the terrain")
    rest: list[Style] = ["line"] * (len(profiles) - 1)
    return list(styles) or ["ground", *rest]


def _colours(styles: Sequence[Style]) -> list[str]:
    """Return the colour of each profile's line."""
    found, lines = [], 0
    for style in styles:
        found.append({"ground": GROUND_EDGE, "water": WATER_EDGE}.get(style, LINES[lines % len(LINES)]))
        lines += style == "line"
    return found


def _heights(
    low: float, high: float, box: Box, length: float, exaggeration: float | None, picture: int
) -> tuple[float, float]:
    """Return the heights at the lower and upper edge of the plot."""
    span = high - low
    if exaggeration is None:
        span = span or 1.0
        return low - 0.12 * span, high + 0.12 * span
    shown = length * box[3] / (box[2] * exaggeration)
    if shown < 1.05 * span:
        most = length * box[3] / (box[2] * 1.05 * span)
        tall = picture + round(1.05 * span * exaggeration * box[2] / length - box[3]) + 1
        raise ValueError(
            f"a vertical exaggeration of {exaggeration:g} does not fit; take {most:.3g} at most, or make the picture "
            f"{tall} pixels high"
        )
    middle = (low + high) / 2
    return middle - shown / 2, middle + shown / 2


@dataclass(frozen=True)
class _Axes:
    """Where the plot lies (px), the distances and heights at its edges (m), the height of the letters (px)."""

    box: Box
    distances: tuple[float, float]
    heights: tuple[float, float]
    em: float

    def places(self, distance: Floats, height: Floats) -> Floats:
        """Return points of the plot in pixels of the sheet, (n, 2)."""
        (left, top, wide, tall), (near, far), (low, high) = self.box, self.distances, self.heights
        x = left + (distance - near) / (far - near) * wide
        return np.column_stack([x, top + (high - height) / (high - low) * tall])

    def distance_text(self, value: float) -> str:
        """Return a distance in words."""
        return f"{value / 1000:.4g} km" if self._in_kilometres else f"{value:.4g} m"

    @property
    def _in_kilometres(self) -> bool:
        return self.distances[1] - self.distances[0] >= 3000

    def _marks(self) -> tuple[list[tuple[float, str]], list[tuple[float, str]]]:
        """Return (place, px; words) along the distance and along the height."""
        (left, top, wide, tall), (near, far), (low, high) = self.box, self.distances, self.heights
        unit = 1000.0 if self._in_kilometres else 1.0
        step = round_step((far - near) / unit, max(2.0, wide / (6 * self.em)))
        across = multiples(near / unit, far / unit, step)
        rise = round_step(high - low, max(2.5, tall / (2.8 * self.em)))
        up = multiples(low, high, rise)
        x = left + (across * unit - near) / (far - near) * wide
        y = top + (high - up) / (high - low) * tall
        words = [number(value, decimals_of(step)) for value in across.tolist()]
        heights = [number(value, decimals_of(rise)) for value in up.tolist()]
        return list(zip(x.tolist(), words, strict=True)), list(zip(y.tolist(), heights, strict=True))

    def draw_grid(self, sheet: Sheet) -> None:
        """Draw faint lines at round heights."""
        left, _, wide, _ = self.box
        lines = [[(left, y), (left + wide, y)] for y, _ in self._marks()[1]]
        sheet.lines(lines, colour=GRID, width=max(1.0, self.em / 16))

    def draw_frame(self, sheet: Sheet) -> None:
        """Draw both axes with round numbers and what they mean."""
        (left, top, wide, tall), em, size = self.box, self.em, 0.85 * self.em
        bottom, width = top + tall, max(1.0, self.em / 14)
        across, up = self._marks()
        sheet.lines([[(left, top), (left, bottom), (left + wide, bottom)]], colour=FRAME, width=width)
        for x, words in across:
            sheet.lines([[(x, bottom), (x, bottom + 0.4 * em)]], colour=FRAME, width=width)
            sheet.text(x, bottom + 0.65 * em, words, size, across="center")
        for y, words in up:
            sheet.lines([[(left - 0.4 * em, y), (left, y)]], colour=FRAME, width=width)
            sheet.text(left - 0.65 * em, y, words, size, across="right", down="center")
        unit = "km" if self._in_kilometres else "m"
        sheet.text(left + wide / 2, bottom + 2.0 * em, f"Distance, {unit}", size, across="center")
        sheet.text(1.6 * em, top + tall / 2, "Elevation, m", size, turn=90, across="center", down="baseline")


def _fill(sheet: Sheet, axes: _Axes, item: Profile, style: Style, base: Profile | None) -> None:
    """Fill the ground down to the axis, and water down to the ground."""
    foot = axes.box[1] + axes.box[3]
    if style == "ground":
        for run in _known(item):
            line = axes.places(item.distance[run], item.height[run])
            corners = np.vstack([line, [(line[-1, 0], foot), (line[0, 0], foot)]])
            sheet.area(corners, face=GROUND, clip=axes.box)
    elif style == "water" and base is not None:
        for surface, bed in _above(item, base):
            corners = np.vstack([axes.places(*surface.T), axes.places(*bed.T)[::-1]])
            sheet.area(corners, face=WATER, clip=axes.box)


def _outline(sheet: Sheet, axes: _Axes, item: Profile, style: Style, colour: str, base: Profile | None) -> None:
    """Draw the line of a profile; that of water only where it lies on the ground."""
    if style == "water" and base is not None:
        lines = [axes.places(*surface.T) for surface, _ in _above(item, base)]
    else:
        lines = [axes.places(item.distance[run], item.height[run]) for run in _known(item)]
    sheet.lines(lines, colour=colour, width=axes.em / 8, clip=axes.box)


def _known(item: Profile) -> list[slice]:
    """Return the stretches of a profile with heights, of two samples at least."""
    return [run for run in _runs(np.isfinite(item.height)) if run.stop - run.start > 1]


def _runs(flags: npt.NDArray[np.bool_]) -> list[slice]:
    """Return where true stretches begin and end.

    >>> _runs(np.array([True, False, True, True]))
    [slice(0, 1, None), slice(2, 4, None)]
    """
    changes = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8))).tolist()
    return [slice(start, stop) for start, stop in zip(changes[::2], changes[1::2], strict=True)]


def _above(water: Profile, ground: Profile) -> list[tuple[Floats, Floats]]:
    """Return (surface, bed) of each stretch of water above the ground, both (n, 2): distance and height.

    Shores lie where both lines cross.
    """
    distance = np.union1d(water.distance, ground.distance)
    top, bed = (_along(item, distance) for item in (water, ground))
    depth = top - bed
    # A sample where the sign changes: the shore.
    crossing = np.flatnonzero(depth[:-1] * depth[1:] < 0)
    share = depth[crossing] / (depth[crossing] - depth[crossing + 1])
    shores = distance[crossing] + share * (distance[crossing + 1] - distance[crossing])
    heights = top[crossing] + share * (top[crossing + 1] - top[crossing])
    distance = np.concatenate([distance, shores])
    top, bed = np.concatenate([top, heights]), np.concatenate([bed, heights])
    order = np.argsort(distance, kind="stable")
    distance, top, bed = distance[order], top[order], bed[order]
    wet = [run for run in _runs(top >= bed) if run.stop - run.start > 1 and (top[run] > bed[run]).any()]
    return [(np.column_stack([distance[run], top[run]]), np.column_stack([distance[run], bed[run]])) for run in wet]


def _along(item: Profile, distance: Floats) -> Floats:
    """Return the heights of a profile at distances, linear between samples; NaN where one of them is void."""
    return np.interp(distance, item.distance, item.height, left=np.nan, right=np.nan)


def _draw_legend(
    sheet: Sheet, axes: _Axes, names: Sequence[str], styles: Sequence[Style], colours: Sequence[str]
) -> None:
    """Draw what each profile is called, in a row above the plot."""
    em, size = axes.em, 0.85 * axes.em
    x, y = axes.box[0], axes.box[1] - 1.3 * em
    for name, style, colour in zip(names, styles, colours, strict=True):
        fill = {"ground": GROUND, "water": WATER}.get(style)
        if fill:
            sheet.box((x, y, 1.8 * em, em), face=fill)
        line = y + (0.0 if fill else 0.5 * em)
        sheet.lines([[(x, line), (x + 1.8 * em, line)]], colour=colour, width=em / 7)
        sheet.text(x + 2.4 * em, y + 0.5 * em, name, size, down="center", colour=INK)
        x += 4.4 * em + measure(name, size)[0]


def _figures(value: float) -> str:
    """Return a ratio to three figures, without powers of ten."""
    return number(float(f"{value:.3g}"), 0 if value >= 99.95 else 1 if value >= 9.995 else 2 if value >= 0.1 else 4)
