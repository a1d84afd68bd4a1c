"""The atom sheet: a dictionary as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_sparse.dictionary import Dictionary, SparseCode
from nodegraph_sparse.metric import offsets
from nodegraph_terrain.raster import Extent, Image

Style = Literal["relief", "grey"]
Order = Literal["number", "spread", "usage"]
Pixels = npt.NDArray[np.uint8]

INK = "#222222"
COLOURS = ("#222222", "#b3411e", "#1f5fa8", "#2c7a3f", "#8a3d98", "#9a6b00", "#00767a", "#a8326b")
"""Of the numbers of the atoms of each source, over and over."""

RIM, GAP, LINE = 16, 10, 16
"""Around the sheet, between atoms, and of a line of text, px."""

LOWLAND_TO_SUMMIT = ("#4d7c57", "#a9b878", "#dcca94", "#b58f68", "#8d7263", "#f2efec")


@node(version=1, locality=whole)
def draw_dictionary(
    dictionary: Dictionary,
    code: SparseCode | None = None,
    *,
    style: Annotated[Style, Param("Shaded and coloured by height, or height as grey.")] = "relief",
    order: Annotated[Order, Param("The first ones, some from all over, or the most used first.")] = "number",
    most: Annotated[int, Param("Atoms that are drawn, at most.", ge=1, le=4096)] = 256,
    tile: Annotated[int, Param("Diameter of an atom.", ge=24, le=512, unit="pixels")] = 72,
    width: Annotated[int, Param("Of the sheet, at most.", ge=200, le=16384, unit="pixels")] = 1344,
    numbers: Annotated[bool, Param("Write the number of each atom below it.")] = True,
    context: Context,
) -> Image:
    """Draw the atoms of a dictionary side by side, as discs of relief.

    Each atom is stretched to its own range, as its heights have no unit.  Numbers run from 0, as sparse codes have
    them; those of several sources have a colour for each.  With a code linked, the number of patches that use an atom
    stands beside its number, and unused atoms are pale.

    Args:
        dictionary: of any kind; only the atoms that are drawn are made.
        code: made with this dictionary.
        style: ``relief`` is lit from the north-west.
        order: where not all are drawn ``number`` takes the first and ``spread`` every so many, which shows more of an
            exemplar, whose neighbours look alike.  ``usage`` needs a code.
        most: the rest is left out, and a note says so.
        tile: in pixels.
        width: as many atoms to a row as it holds.
        numbers: with the counts, if there is a code.
        context: the engine's.

    Returns:
        A picture whose extent counts pixels.

    Raises:
        ValueError: the code belongs to a dictionary of another number of atoms, the order is by usage without a code,
            or the sheet would be higher than 16,384 pixels.
    """
    usage = None if code is None else usage_counts(code)
    if usage is not None and len(usage) != dictionary.count:
        raise ValueError(
            f"the code uses a dictionary of {len(usage)} atoms, and this one has {dictionary.count}; link the one it "
            "was made with"
        )
    if order == "usage" and usage is None:
        raise ValueError("atoms can only be drawn by usage with a code; link one")
    which = np.arange(dictionary.count)
    if order == "usage" and usage is not None:
        which = np.argsort(-usage, kind="stable")
    if order == "spread" and len(which) > most:
        which = np.linspace(0, dictionary.count - 1, most).round().astype(np.int64)
    which = which[:most]
    context.progress(0.1)
    labels, faded = [], np.zeros(len(which), np.bool_)
    if numbers:
        labels = [f"{number}" if usage is None else f"{number}: {usage[number]:,}x" for number in which.tolist()]
    if usage is not None:
        faded = usage[which] == 0
    notes = _notes(dictionary, len(which), order, usage)
    high = _layout(len(which), tile, labels, width, notes)[2]
    if high > 16384:
        raise ValueError(
            f"the sheet would be {high:,} pixels high, over 16,384; draw less atoms, smaller ones or a wider sheet"
        )
    drawn = tiles(dictionary.atoms(which), tile, style, faded, context)
    pixels = sheet(drawn, labels, width, notes, dictionary.sources[which].tolist())
    return Image(pixels, Extent(0.0, 0.0, float(pixels.shape[1]), float(pixels.shape[0])))


@draw_dictionary.forecast
def _forecast(*_inputs: Forecast | None, most: int, tile: int, **_: object) -> Forecast:
    area = most * (tile + GAP) * (tile + GAP + LINE)
    return Forecast(3 * area, 40 * area)


def usage_counts(code: SparseCode) -> npt.NDArray[np.int64]:
    """Return how many patches use each atom, (atoms,)."""
    return np.bincount(code.indices[code.indices >= 0], minlength=code.atoms)


def tiles(atoms: npt.NDArray[Any], size: int, style: Style, faded: npt.NDArray[np.bool_], context: Context) -> Pixels:
    """Return a picture of each atom, (n, size, size, 3), a disc on white."""
    from scipy.ndimage import map_coordinates

    x = offsets(size)
    places = (x + 1) * atoms.shape[1] / 2 - 0.5
    where = np.meshgrid(places, places, indexing="ij")
    # A pixel at the rim of the disc counts by how much of it is inside.
    inside = np.clip((1 - np.hypot(x[:, None], x)) * size / 2 + 0.5, 0, 1)[..., None]
    made = np.empty((len(atoms), size, size, 3), np.uint8)
    for number, atom in enumerate(atoms):
        context.progress(0.9 * number / len(atoms))
        heights = map_coordinates(atom.astype(np.float64), where, order=3, mode="nearest")
        colours = _relief(heights, inside[..., 0] > 0, style)
        if faded[number]:
            colours = 255 - 0.3 * (255 - colours)
        made[number] = np.rint(255 + inside * (colours - 255))
    return made


def sheet(
    drawn: Pixels, labels: Sequence[str], width: int, notes: Sequence[tuple[str, str]], sources: Sequence[int] = ()
) -> Pixels:
    """Return tiles in rows with a label below each, and notes in their colours below all.

    Args:
        drawn: (n, size, size, 3).
        labels: one for each tile, or none.
        width: of the sheet at most, px.
        notes: (text, colour) in lines.
        sources: of the tiles, which give their labels' colours.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    count, size = drawn.shape[:2]
    letters = min(11.0, max(6.0, 1.55 * size / max(map(len, labels), default=1)))
    per_row, wide, high = _layout(count, size, labels, width, notes)
    across, down = size + GAP, size + GAP + (LINE if labels else 0)
    rows = -(-count // per_row)
    paper = np.full((high, wide, 3), 255, np.uint8)
    figure = Figure(figsize=(wide / 72, high / 72), dpi=72)
    canvas: Any = FigureCanvasAgg(figure)
    for number in range(count):
        row, col = divmod(number, per_row)
        left, top = RIM + col * across, RIM + row * down
        paper[top : top + size, left : left + size] = drawn[number]
        if labels:
            colour = COLOURS[sources[number] % len(COLOURS)] if len(sources) else INK
            at = ((left + size / 2) / wide, 1 - (top + size + 2) / high)
            figure.text(*at, labels[number], size=letters, family="DejaVu Sans", color=colour, ha="center", va="top")
    figure.figimage(paper, origin="upper")
    for line, (text, colour) in enumerate(notes):
        top = RIM + rows * down + GAP + LINE * line
        at = (RIM / wide, 1 - top / high)
        figure.text(*at, text, size=12, family="DejaVu Sans", color=colour, ha="left", va="top", parse_math=False)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _layout(
    count: int, size: int, labels: Sequence[str], width: int, notes: Sequence[tuple[str, str]]
) -> tuple[int, int, int]:
    """Return how many tiles stand in a row of a sheet, and its width and height, px."""
    across, down = size + GAP, size + GAP + (LINE if labels else 0)
    per_row = max(1, min(count, (width - 2 * RIM + GAP) // across))
    wide = max(2 * RIM + per_row * across - GAP, min(width, 2 * RIM + 7 * max(len(text) for text, _ in notes)))
    return per_row, wide, 2 * RIM + -(-count // per_row) * down + GAP + LINE * len(notes)


def _relief(heights: npt.NDArray[Any], inside: npt.NDArray[np.bool_], style: Style) -> npt.NDArray[np.float64]:
    """Return colours of heights that are stretched to their range within the disc."""
    from nodegraph_terrain.previews import ramp

    low, high = float(heights[inside].min()), float(heights[inside].max())
    level = (heights - low) / (high - low) if high > low else np.full(heights.shape, 0.5)
    if style == "grey":
        return ramp(level.astype(np.float32), ("#101010", "#f4f4f4"))[..., :3].astype(np.float64)
    south, east = (np.asarray(slope) for slope in np.gradient(level))
    # As steep as to fill the range of light, whatever the atom.
    steep = float(np.sqrt(np.mean(south[inside] ** 2 + east[inside] ** 2)))
    scale = 0.6 / steep if steep > 0 else 0.0
    lit = (scale * (east + south) + np.sqrt(2)) / (2 * np.sqrt(1 + scale**2 * (south**2 + east**2)))
    colours = ramp(level.astype(np.float32), LOWLAND_TO_SUMMIT)[..., :3].astype(np.float64)
    return np.asarray(np.clip(colours * (0.25 + 1.06 * np.clip(lit, 0, 1))[..., None], 0, 255))


def _notes(
    dictionary: Dictionary, drawn: int, order: Order, usage: npt.NDArray[np.int64] | None
) -> list[tuple[str, str]]:
    """Return what is written below the atoms: how many, how large, and where they come from."""
    which = {"number": "the first ", "spread": "", "usage": "the most used "}[order]
    some = f"{dictionary.count:,}" if drawn == dictionary.count else f"{which}{drawn:,} of {dictionary.count:,}"
    used = "" if usage is None else f", {int(np.count_nonzero(usage)):,} used"
    notes = [(f"{some} atoms of {dictionary.size} x {dictionary.size} samples{used}", INK)]
    if len(dictionary.names) > 1:
        counts = np.bincount(dictionary.sources, minlength=len(dictionary.names))
        notes += [
            (f"{name}: {counts[number]:,} atoms", COLOURS[number % len(COLOURS)])
            for number, name in enumerate(dictionary.names)
        ]
    return notes
