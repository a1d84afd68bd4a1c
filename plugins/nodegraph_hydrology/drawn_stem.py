"""The main stems of river networks: drawn lines, bent a little, that cross neither themselves nor each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph_hydrology.crossings import GAP, Domain, Segments, crossings

Floats = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Stems:
    """Lines as curves over their length.

    Attributes:
        points: of all lines, one after the other.
        offsets: (m + 1,) where each line begins.
        along: the distance of each point from the begin of its line, m.
    """

    points: Floats
    offsets: Index
    along: Floats

    @classmethod
    def of(cls, lines: list[Floats]) -> Stems:
        """Return lines with their lengths."""
        offsets = np.cumsum([0, *map(len, lines)]).astype(np.int64)
        along = [np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))]) for line in lines]
        return cls(np.concatenate(lines), offsets, np.concatenate(along))

    @property
    def lengths(self) -> Floats:
        """The length of each line, m."""
        return self.along[self.offsets[1:] - 1]

    @property
    def owner(self) -> Index:
        """The line of each point."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))

    def at(self, line: Index, distance: Floats) -> Floats:
        """Return the points of lines at distances from their begins."""
        # One search for all lines: each is moved beyond the end of the one before it.
        shift = 2 * np.arange(len(self.offsets) - 1) * max(float(self.lengths.max()), 1.0)
        keys = self.along + shift[self.owner]
        place = np.searchsorted(keys, distance + shift[line], side="right") - 1
        place = np.clip(place, self.offsets[line], self.offsets[line + 1] - 2)
        leg = self.along[place + 1] - self.along[place]
        share = np.clip((distance - self.along[place]) / leg, 0, 1)
        return np.asarray(self.points[place] + share[:, None] * (self.points[place + 1] - self.points[place]))

    def segments(self) -> Segments:
        """Return the segments of all lines."""
        inside = np.flatnonzero(np.diff(self.owner) == 0)
        return Segments(self.points[inside], self.points[inside + 1])


def shortened(lines: list[Floats], domain: Domain, warn: Callable[[str], Any]) -> list[Floats]:
    """Return the lines, each cut short before it meets itself or an earlier one, or leaves the domain.

    Raises:
        ValueError: a line begins outside of the domain, has no length, or begins on an earlier one.
    """
    import shapely

    kept: list[Floats] = []
    for number, line in enumerate(lines):
        steps = np.hypot(*np.diff(line, axis=0).T)
        line = line[np.concatenate([[True], steps > 0])]
        if len(line) < 2:
            raise ValueError(f"line {number} has no length; give it two different points")
        if domain.shape is not None and not shapely.intersects_xy(domain.shape, *line[0]):
            where = ", ".join(f"{value:g}" for value in line[0])
            raise ValueError(f"line {number} begins at ({where}), outside of the outline; its estuary must lie inside")
        steps = np.hypot(*np.diff(line, axis=0).T)
        reach = _free_length(line, kept, domain)
        if reach < steps.sum():
            if reach < 0.01 * steps.sum():
                raise ValueError(
                    f"line {number} begins on another line or at once leaves the outline; move its estuary"
                )
            warn(f"line {number} is cut to {reach:g} m of {steps.sum():g} m, where it meets a line or the outline")
            line = _cut(line, reach)
        kept.append(line)
    return kept


def curved(lines: list[Floats], spacing: Floats, sinuosity: float, domain: Domain, rng: np.random.Generator) -> Stems:
    """Return the lines as smooth curves through their points, bent by midpoint displacement down to a spacing.

    A curve that meets itself, another one or the border is drawn with half of the bends, then a quarter, and at last as
    the straight lines that were given.
    """
    dice = [int(value) for value in rng.integers(2**63, size=len(lines))]
    share = np.ones(len(lines))
    while True:
        stems = Stems.of(
            [
                _bent(line, float(step), sinuosity * float(part), float(part), np.random.default_rng(seed))
                for line, step, part, seed in zip(lines, spacing, share, dice, strict=True)
            ]
        )
        segments = stems.segments()
        owner = stems.owner[np.flatnonzero(np.diff(stems.owner) == 0)]
        wrong = np.zeros(len(lines), np.bool_)
        wrong[owner[crossings(segments).ravel()]] = True
        wrong[owner[~domain.holds(segments)]] = True
        wrong &= share > 0
        if not wrong.any():
            return stems
        share[wrong] = np.where(share[wrong] > 0.2, share[wrong] / 2, 0.0)


def _bent(line: Floats, spacing: float, sinuosity: float, smooth: float, rng: np.random.Generator) -> Floats:
    if smooth and len(line) > 2:
        line = _spline(line, smooth)
    while True:
        legs = np.diff(line, axis=0)
        length = np.hypot(*legs.T)
        if length.max() <= spacing or len(line) > 100_000:
            return line
        split = length > spacing
        middle = (line[:-1] + line[1:]) / 2
        middle += (sinuosity * rng.uniform(-1, 1, len(legs)))[:, None] * np.stack([-legs[:, 1], legs[:, 0]], axis=1)
        order = np.concatenate([np.arange(len(line)), np.flatnonzero(split) + 0.5])
        line = np.concatenate([line, middle[split]])[np.argsort(order, kind="stable")]


def _spline(line: Floats, smooth: float) -> Floats:
    """Return a Catmull-Rom curve through the points; `smooth` 1 is round, 0 straight."""
    padded = np.concatenate([2 * line[:1] - line[1:2], line, 2 * line[-1:] - line[-2:-1]])
    length = np.hypot(*np.diff(padded, axis=0).T)
    # Tangents weigh the shorter leg more, and are no longer than it: no loops beside short legs.
    unit = np.diff(padded, axis=0) / length[:, None]
    weight = length[1:, None] / (length[:-1] + length[1:])[:, None]
    tangent = smooth * (weight * unit[:-1] + (1 - weight) * unit[1:])
    leg = length[1:-1]
    t = np.linspace(0, 1, 9)[1:, None, None]
    hermite = (2 * t**3 - 3 * t**2 + 1) * line[:-1] + (3 * t**2 - 2 * t**3) * line[1:]
    hermite += leg[:, None] * ((t**3 - 2 * t**2 + t) * tangent[:-1] + (t**3 - t**2) * tangent[1:])
    return np.concatenate([line[:1], hermite.transpose(1, 0, 2).reshape(-1, 2)])


def _free_length(line: Floats, kept: list[Floats], domain: Domain) -> float:
    """Return how far a line can be followed before it meets itself, one of `kept` or the border."""
    own = Segments(line[:-1], line[1:])
    segments = _from_its_base(line)
    for other in reversed(kept):
        segments = _from_its_base(other).joined(segments)
    before = len(segments) - len(own)
    hits = crossings(segments, before) - before
    outside = np.flatnonzero(~domain.holds(own))
    late = hits.max(axis=1)
    stop = int(min(late.min(initial=len(own)), outside.min(initial=len(own))))
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    if stop == len(own):
        return float(along[-1])
    # Where on the segment it happens: by halving, then a step back.
    low, high = 0.0, 1.0
    leg = line[stop + 1] - line[stop]
    start = segments.base[before + stop]
    against = segments.take(np.arange(before + stop))
    for _ in range(30):
        part = (low + high) / 2
        end = (line[stop] + part * leg)[None]
        probe = Segments(start[None], end)
        free = domain.holds(Segments(line[stop][None], end))[0] and not len(
            crossings(against.joined(probe), len(against))
        )
        low, high = (part, high) if free else (low, part)
    reach = float(along[stop] + low * (along[stop + 1] - along[stop]))
    return reach - min(0.03 * float(along[-1]), 0.25 * reach)


def _from_its_base(line: Floats) -> Segments:
    """Return the segments of a line, begun so early that the gap at a base leaves nothing of it untested."""
    base = line[:-1].copy()
    base[0] -= 2 * GAP * (line[1] - line[0])
    return Segments(base, line[1:])


def _cut(line: Floats, reach: float) -> Floats:
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    last = int(np.searchsorted(along, reach, side="left")) - 1
    share = (reach - along[last]) / (along[last + 1] - along[last])
    return np.concatenate([line[: last + 1], (line[last] + share * (line[last + 1] - line[last]))[None]])
