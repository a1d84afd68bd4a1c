"""Polylines: lines through points, such as rivers, roads, ridges and contours, with what is known of each."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from nodegraph import port_type

EARTH = 6_371_008.8
"""Mean radius of the Earth, m (IUGG)."""

Values = npt.NDArray[Any] | tuple[str, ...]


@port_type
class Property:
    """One thing that is known of every line, such as its level, width or name.

    Attributes:
        name: what it is called.
        values: one per line: (m,) bool, int64 or float64 (NaN where unknown), or a tuple of texts.
        unit: unit of numbers, empty where they have none.
    """

    name: str
    values: Values
    unit: str = ""

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("a property of lines needs a name")
        if not isinstance(self.values, np.ndarray):
            return
        wanted = {"b": np.bool_, "i": np.int64, "u": np.int64, "f": np.float64}.get(self.values.dtype.kind)
        if wanted is None or self.values.ndim != 1:
            raise ValueError(
                f"property '{self.name}' holds {self.values.dtype} of shape {self.values.shape}; "
                "give one bool, number or text per line"
            )
        if self.values.dtype != wanted:
            object.__setattr__(self, "values", self.values.astype(wanted))

    def take(self, lines: npt.NDArray[np.int64]) -> Self:
        """Return the property of the lines with these numbers, in that order."""
        if isinstance(self.values, tuple):
            return replace(self, values=tuple([self.values[line] for line in lines]))
        return replace(self, values=self.values[lines])


@port_type
class Polylines:
    """Lines through points in one coordinate system, each with its properties.

    Line i goes through ``points[offsets[i]:offsets[i + 1]]``.  A closed line repeats its first point as its last.

    Attributes:
        points: (n, 2) or (n, 3) float64: x (east), y (north) in `unit`, height in m (NaN where it is not known).
        offsets: (m + 1,) int64, from 0 to n: where each line starts; every line has at least two points.
        properties: what is known of each line; no two have the same name.
        crs: coordinate reference system as ``EPSG:n`` or WKT; empty where none is known.
        unit: ``m`` for projected (or unreferenced) coordinates, ``deg`` for geographic ones (x is the longitude).
    """

    points: npt.NDArray[np.float64]
    offsets: npt.NDArray[np.int64]
    properties: tuple[Property, ...] = ()
    crs: str = ""
    unit: str = "m"

    def __post_init__(self) -> None:
        if self.unit not in ("m", "deg"):
            raise ValueError(f"unit '{self.unit}' of polylines must be 'm' or 'deg'")
        if isinstance(self.points, np.ndarray) and isinstance(self.offsets, np.ndarray):
            _check(self.points, self.offsets)
        for name, wanted in (("points", np.float64), ("offsets", np.int64)):
            array = getattr(self, name)
            if array.dtype != wanted:
                object.__setattr__(self, name, array.astype(wanted))
        names = [item.name for item in self.properties]
        if len(set(names)) < len(names):
            raise ValueError(f"two properties of lines have one name; those given are {', '.join(names)}")
        for item in self.properties:
            if len(item.values) != len(self):
                raise ValueError(
                    f"property '{item.name}' has {len(item.values)} values for {len(self)} lines; give one per line"
                )

    @classmethod
    def of(
        cls,
        lines: Iterable[npt.ArrayLike],
        properties: Sequence[Property] = (),
        crs: str = "",
        unit: str = "m",
        *,
        dimension: int = 2,
    ) -> Self:
        """Make polylines from the points of each line; `dimension` is that of the points where there is no line."""
        parts = [np.asarray(line, np.float64) for line in lines]
        offsets = np.cumsum([0, *map(len, parts)], dtype=np.int64)
        points = np.concatenate(parts) if parts else np.zeros((0, dimension))
        return cls(points, offsets, tuple(properties), crs, unit)

    def __len__(self) -> int:
        """Return the number of lines."""
        return int(self.offsets.shape[0]) - 1

    def lines(self) -> Iterator[npt.NDArray[np.float64]]:
        """Yield the points of each line, sharing memory."""
        for start, stop in pairwise(self.offsets.tolist()):
            yield self.points[start:stop]

    @property
    def closed(self) -> npt.NDArray[np.bool_]:
        """Which lines are closed, (m,): at least four points, the last of them the first again."""
        first, last = self.points[self.offsets[:-1]], self.points[self.offsets[1:] - 1]
        same = ((first == last) | (np.isnan(first) & np.isnan(last))).all(axis=1)
        return np.asarray(same & (np.diff(self.offsets) >= 4))

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        """The box around all lines, (west, south, east, north); None without any line."""
        if not len(self):
            return None
        west, south = self.points[:, :2].min(axis=0).tolist()
        east, north = self.points[:, :2].max(axis=0).tolist()
        return west, south, east, north

    def lengths(self) -> npt.NDArray[np.float64]:
        """Return the length of every line along the ground plan, (m,) metres.

        Degrees are measured along great circles of a sphere, which is right to half a percent.
        """
        steps = np.diff(self.points[:, :2], axis=0)
        if self.unit == "deg":
            steps, latitude = np.radians(steps), np.radians(self.points[:, 1])
            chord = np.sin(steps[:, 1] / 2) ** 2
            chord += np.cos(latitude[:-1]) * np.cos(latitude[1:]) * np.sin(steps[:, 0] / 2) ** 2
            legs = 2 * EARTH * np.arcsin(np.sqrt(np.minimum(chord, 1)))
        else:
            legs = np.hypot(steps[:, 0], steps[:, 1])
        # Leg i ends in point i + 1; the leg between two lines counts for neither.
        legs = np.concatenate([[0.0], legs])
        starts = self.offsets[:-1]
        legs[starts] = 0
        return np.add.reduceat(legs, starts) if len(self) else np.zeros(0)

    def get(self, name: str) -> Property | None:
        """Return the property of that name, or None."""
        return next((item for item in self.properties if item.name == name), None)

    def take(self, lines: npt.ArrayLike) -> Self:
        """Return the lines with these numbers in that order, or those where a mask (m,) is true."""
        chosen = np.asarray(lines)
        chosen = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen.astype(np.int64)
        counts = np.diff(self.offsets)[chosen]
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        picked = np.arange(offsets[-1]) + np.repeat(self.offsets[chosen] - offsets[:-1], counts)
        properties = tuple(item.take(chosen) for item in self.properties)
        return replace(self, points=self.points[picked], offsets=offsets, properties=properties)


def reprojected(lines: Polylines, crs: str, *, cut: bool = False) -> Polylines:
    """Return the lines in another coordinate system; their heights stay as they are.

    Args:
        lines: in a system.
        crs: the other one, in degrees or any unit of length.
        cut: leave out points that have no place in it, and go on with a new line behind them.

    Raises:
        ValueError: the lines have no system, `crs` is unknown or neither in degrees nor a length, or (without `cut`)
            some points have no place in it.
    """
    from nodegraph_terrain.georeference import horizontal, parse_crs, system_of, transformed

    if not lines.crs:
        raise ValueError("the lines have no coordinate reference system; state one where they are loaded (crs)")
    target, _ = horizontal(parse_crs(crs))
    text, unit, factor = system_of(target)
    if not text:
        raise ValueError(f"crs '{crs}' is a local system; give one that is tied to the Earth, such as EPSG:32632")
    if text == lines.crs:
        return lines
    x, y = transformed(parse_crs(lines.crs), target, lines.points[:, 0], lines.points[:, 1])
    inside = np.isfinite(x) & np.isfinite(y)
    if not inside.all():
        if not cut:
            where = ", ".join(f"{value:g}" for value in lines.points[np.argmin(inside), :2])
            raise ValueError(f"the point ({where}) lies outside of what {text[:60]} can show; choose another crs")
        lines, kept = _cut(lines, inside)
        x, y = x[kept], y[kept]
    points = np.column_stack([x * factor, y * factor, lines.points[:, 2:]])
    return replace(lines, points=points, crs=text, unit=unit)


def _cut(lines: Polylines, inside: npt.NDArray[np.bool_]) -> tuple[Polylines, npt.NDArray[np.int64]]:
    """Return the stretches of lines whose points are `inside`, of two points at least, and which points they are."""
    owner = np.repeat(np.arange(len(lines)), np.diff(lines.offsets))
    kept = np.flatnonzero(inside)
    begins = np.ones(len(kept), np.bool_)
    begins[1:] = (np.diff(kept) > 1) | (np.diff(owner[kept]) > 0)
    sizes = np.bincount(np.cumsum(begins) - 1, minlength=int(begins.sum()))
    long = sizes > 1
    kept = kept[np.repeat(long, sizes)]
    offsets = np.concatenate([[0], np.cumsum(sizes[long])]).astype(np.int64)
    properties = tuple(item.take(owner[kept[offsets[:-1]]]) for item in lines.properties)
    return replace(lines, points=lines.points[kept], offsets=offsets, properties=properties), kept


def _check(points: npt.NDArray[Any], offsets: npt.NDArray[Any]) -> None:
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"points of shape {points.shape} must be (n, 2) or (n, 3)")
    if offsets.ndim != 1 or len(offsets) < 1 or offsets[0] != 0 or offsets[-1] != len(points):
        raise ValueError(f"offsets of polylines must go from 0 to the {len(points)} points")
    short = np.flatnonzero(np.diff(offsets) < 2)
    if len(short):
        count = int(np.diff(offsets)[short[0]])
        raise ValueError(f"line {int(short[0])} has {max(count, 0)} points; a line needs two at least")
    bad = ~np.isfinite(points[:, :2]).all(axis=1)
    if points.shape[1] == 3:
        bad |= np.isinf(points[:, 2])
    if bad.any():
        line = int(np.searchsorted(offsets, np.flatnonzero(bad)[0], side="right")) - 1
        raise ValueError(f"line {line} has a point that is not finite; leave it out")
