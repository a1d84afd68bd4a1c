"""Placing the heights on contours: where a line runs straight, with a gap in it, clear of each other."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, degrees

import numpy as np
import numpy.typing as npt

from nodegraph_render.sheet import Box

Floats = npt.NDArray[np.float64]

STRAIGHT = 0.96
"""Least share of the arc below a label that its chord makes up."""


@dataclass(frozen=True)
class Label:
    """A label: the line it belongs to, the middle of its gap along that line, and where and how it is written.

    Attributes:
        line: number of the line.
        at, gap: middle and length of the gap, px along the line.
        x, y: where its middle lies, px.
        turn: degrees anticlockwise; never upside down.
    """

    line: int
    at: float
    gap: float
    x: float
    y: float
    turn: float


def place_labels(
    lines: list[Floats], widths: list[float], em: float, box: Box, *, spacing: float, clearance: float
) -> list[Label]:
    """Return labels for lines (in px, y down), the straightest places first.

    Args:
        lines: the lines; those too short for their label get none.
        widths: of each line's label, px.
        em: height of the letters, px.
        box: labels stay inside it.
        spacing: least distance between two labels of one line, px along it.
        clearance: least distance between the middles of any two labels beyond half their widths, px.
    """
    found = [item for index, line in enumerate(lines) for item in _candidates(index, line, widths[index], em, box)]
    found.sort(key=lambda item: (-item[0], item[1].line, item[1].at))
    chosen: list[Label] = []
    middles = np.zeros((len(found), 2))
    reaches, owners, along = np.zeros(len(found)), np.zeros(len(found), np.int64), np.zeros(len(found))
    for _, label in found:
        count = len(chosen)
        distance = np.hypot(middles[:count, 0] - label.x, middles[:count, 1] - label.y)
        close = distance < reaches[:count] + label.gap / 2 + clearance
        close |= (owners[:count] == label.line) & (np.abs(along[:count] - label.at) < spacing)
        if close.any():
            continue
        middles[count], reaches[count] = (label.x, label.y), label.gap / 2
        owners[count], along[count] = label.line, label.at
        chosen.append(label)
    return chosen


def _candidates(index: int, line: Floats, width: float, em: float, box: Box) -> list[tuple[float, Label]]:
    """Return (straightness, label) of places along one line."""
    if len(line) < 2:
        return []
    legs = np.hypot(*np.diff(line, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(legs)])
    gap = width + 0.7 * em
    if along[-1] < 3 * gap:
        return []
    # Half a gap from the ends, so that the line shows on both sides.
    at = np.arange(gap, along[-1] - gap, em)
    marks = [_at(line, along, at + share * gap) for share in (-0.5, -0.25, 0.0, 0.25, 0.5)]
    first, last = marks[0], marks[-1]
    chord = last - first
    length = np.hypot(*chord.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        # How far the arc strays from the chord between its ends: letters must not stand beside their line.
        aside = [np.abs(chord[:, 0] * (m - first)[:, 1] - chord[:, 1] * (m - first)[:, 0]) / length for m in marks[1:4]]
    bulge = np.max(aside, axis=0)
    middle = (first + last) / 2
    left, top, wide, high = box
    margin = gap / 2 + 0.5 * em
    inside = (middle[:, 0] > left + margin) & (middle[:, 0] < left + wide - margin)
    inside &= (middle[:, 1] > top + margin) & (middle[:, 1] < top + high - margin)
    good = inside & (length > STRAIGHT * gap) & (bulge < 0.35 * em)
    found = []
    for place in np.flatnonzero(good):
        turn = degrees(atan2(-chord[place, 1], chord[place, 0]))
        turn = turn - 180 if turn > 90 else turn + 180 if turn < -90 else turn
        straightness = float(np.round(length[place] / gap - bulge[place] / em / 4, 2))
        x, y = middle[place].tolist()
        found.append((straightness, Label(index, float(at[place]), gap, x, y, turn)))
    return found


def _at(line: Floats, along: Floats, where: Floats) -> Floats:
    return np.column_stack([np.interp(where, along, line[:, axis]) for axis in (0, 1)])


def with_gaps(line: Floats, gaps: list[tuple[float, float]]) -> list[Floats]:
    """Return the pieces of a line that are left outside of gaps, each (from, to) along the line.

    >>> [piece.tolist() for piece in with_gaps(np.array([[0.0, 0.0], [10.0, 0.0]]), [(4.0, 6.0)])]
    [[[0.0, 0.0], [4.0, 0.0]], [[6.0, 0.0], [10.0, 0.0]]]
    """
    if not gaps:
        return [line]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    gaps = sorted(gaps)
    starts, stops = [0.0, *(gap[1] for gap in gaps)], [*(gap[0] for gap in gaps), float(along[-1])]
    pieces = []
    for start, stop in zip(starts, stops, strict=True):
        if stop > start:
            ends = _at(line, along, np.array([start, stop]))
            pieces.append(np.vstack([ends[:1], line[(along > start) & (along < stop)], ends[1:]]))
    return pieces
