"""Contours on a map: thin and heavy lines, their heights, and what the legend says of them."""

from __future__ import annotations

from math import isfinite

import numpy as np
import numpy.typing as npt

from nodegraph_render.contour_labels import Label, place_labels, with_gaps
from nodegraph_render.map_frame import Frame
from nodegraph_render.map_legend import Entry
from nodegraph_render.sheet import Sheet, decimals_of, measure, number
from nodegraph_terrain.polylines import Polylines

Floats = npt.NDArray[np.float64]

CONTOUR = "#4a3524"
WORDS = "#2e2014"
HALO = "#f3eee2"
HEAVY = 2.2
"""Width of an index contour, in widths of the others."""


def contour_width(em: float) -> float:
    """Return the width of a contour beside letters of that height, px."""
    return em / 18


def draw_contours(sheet: Sheet, frame: Frame, contours: Polylines) -> list[tuple[Label, str]]:
    """Draw thin and heavy contours with gaps in the heavy ones, or in all where none is; return what goes there."""
    contours = frame.own(contours)
    drawn = [frame.places(line) for line in contours.lines()]
    heavy, levels = _is_index(contours), _levels(contours)
    em, size = frame.em, _label_size(frame.em)
    known = levels[np.isfinite(levels)]
    digits = decimals_of(float(np.gcd.reduce(np.rint(known * 1000).astype(np.int64))) / 1000) if len(known) else 0
    words = [number(level, digits) if isfinite(level) else "" for level in levels.tolist()]
    labelled = (heavy if heavy.any() else np.ones(len(heavy), np.bool_)) & np.isfinite(levels)
    chosen = np.flatnonzero(labelled).tolist()
    widths = [measure(words[line], size)[0] for line in chosen]
    labels = place_labels(
        [drawn[line] for line in chosen], widths, size, frame.box, spacing=28 * em, clearance=3.5 * em
    )
    gaps: dict[int, list[tuple[float, float]]] = {}
    for label in labels:
        gaps.setdefault(chosen[label.line], []).append((label.at - label.gap / 2, label.at + label.gap / 2))
    for is_heavy, width, alpha in ((False, 1.0, 0.6), (True, HEAVY, 0.75)):
        numbers = np.flatnonzero(heavy == is_heavy).tolist()
        pieces = [piece for line in numbers for piece in with_gaps(drawn[line], gaps.get(line, []))]
        sheet.lines(pieces, colour=CONTOUR, width=width * contour_width(em), alpha=alpha, clip=frame.box)
    return [(label, words[chosen[label.line]]) for label in labels]


def draw_labels(sheet: Sheet, labels: list[tuple[Label, str]], em: float) -> None:
    """Write the heights into their gaps."""
    size = _label_size(em)
    for label, words in labels:
        sheet.text(
            label.x, label.y, words, size, turn=label.turn, across="center", down="center", colour=WORDS, halo=HALO,
            halo_width=size / 5,
        )  # fmt: skip


def step_of(contours: Polylines) -> float:
    """Return the interval between the levels of contours, 0 where they have no common one."""
    levels = _levels(contours)
    steps = np.unique(np.round(np.diff(np.unique(levels[np.isfinite(levels)])), 6))
    return float(steps[0]) if len(steps) and np.allclose(steps / steps[0], np.round(steps / steps[0])) else 0.0


def contour_entries(contours: Polylines, step: float, index: int) -> list[Entry]:
    """Return what the legend says of contours `step` apart, every `index`-th of them heavy."""
    if not len(contours):
        return []
    heavy, levels = _is_index(contours), _levels(contours)
    every = f", every {number(step, decimals_of(step))} m" if step else ""
    entries = [Entry(f"contour{every}", CONTOUR, 1.0)]
    if heavy.any():
        wide = np.diff(np.unique(levels[heavy]))
        apart = float(wide.min()) if len(wide) else step * index
        every = f"every {number(apart, decimals_of(apart))} m" if step and apart else "index contour"
        entries.append(Entry(every, CONTOUR, HEAVY))
    return entries


def _levels(contours: Polylines) -> Floats:
    level = contours.get("level")
    if level is None or isinstance(level.values, tuple):
        return np.full(len(contours), np.nan)
    return level.values.astype(np.float64)


def _is_index(contours: Polylines) -> npt.NDArray[np.bool_]:
    marked = contours.get("index")
    if marked is None or isinstance(marked.values, tuple):
        return np.zeros(len(contours), np.bool_)
    return marked.values.astype(np.bool_)


def _label_size(em: float) -> float:
    return max(9.0, 0.68 * em)
