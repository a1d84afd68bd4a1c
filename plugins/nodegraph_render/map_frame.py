"""What stands around a map: the frame with its coordinates, the scale bar and the arrow to the north."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, degrees, radians, sin
from typing import Literal

import numpy as np
import numpy.typing as npt

from nodegraph_render.rounding import multiples, round_below, round_step
from nodegraph_render.sheet import FRAME, INK, PAPER, Box, Sheet, decimals_of, measure, number
from nodegraph_terrain.polylines import EARTH, Polylines, reprojected
from nodegraph_terrain.raster import Extent

Coordinates = Literal["own", "lonlat", "none"]
Floats = npt.NDArray[np.float64]

_SIXTIETHS = (1, 2, 5, 10, 20, 30)
ANGLES = (*(part / units for units in (3600, 60, 1) for part in _SIXTIETHS), 45.0, 90.0)
"""Round angles, degrees: seconds, minutes and degrees."""


@dataclass(frozen=True)
class Frame:
    """Where the map lies on the sheet, and the ground it shows.

    Attributes:
        left, top, width, height: of the map itself, px.
        extent: what it shows.
        em: height of the letters beside it, px.
    """

    left: int
    top: int
    width: int
    height: int
    extent: Extent
    em: float

    @property
    def box(self) -> Box:
        """Left, top, width and height, px."""
        return self.left, self.top, self.width, self.height

    @property
    def right(self) -> int:
        """Its right edge, px."""
        return self.left + self.width

    @property
    def bottom(self) -> int:
        """Its lower edge, px."""
        return self.top + self.height

    def places(self, points: Floats) -> Floats:
        """Return points (n, 2 or 3), in coordinates of the extent, in pixels of the sheet, (n, 2)."""
        extent = self.extent
        x = self.left + (points[:, 0] - extent.west) * (self.width / extent.width)
        y = self.top + (extent.north - points[:, 1]) * (self.height / extent.height)
        return np.column_stack([x, y])

    def own(self, lines: Polylines) -> Polylines:
        """Return the lines that come near the map, in its system.

        Raises:
            ValueError: one has degrees and the other metres, and no system says how they belong together.
        """
        if lines.crs and self.extent.crs and lines.crs != self.extent.crs:
            from nodegraph_terrain.georeference import bounds_in, parse_crs

            box = bounds_in(self.extent, parse_crs(lines.crs))
            lines = reprojected(lines if box is None else _near(lines, box), self.extent.crs, cut=True)
        if lines.unit != self.extent.unit:
            raise ValueError(
                f"the lines are in '{lines.unit}', the surface in '{self.extent.unit}'; give both a coordinate system"
            )
        extent = self.extent
        return _near(lines, (extent.west, extent.south, extent.east, extent.north))


def _near(lines: Polylines, box: Box) -> Polylines:
    """Return the lines whose own boxes touch a box (west, south, east, north)."""
    if not len(lines):
        return lines
    starts, plan = lines.offsets[:-1], lines.points[:, :2]
    low, high = np.minimum.reduceat(plan, starts), np.maximum.reduceat(plan, starts)
    west, south, east, north = box
    return lines.take(((low <= (east, north)) & (high >= (west, south))).all(axis=1))


def ground(extent: Extent) -> tuple[float, float]:
    """Return width and height of an extent on the ground through its middle, m."""
    if extent.unit == "m":
        return extent.width, extent.height
    degree = EARTH * radians(1)
    middle = radians((extent.south + extent.north) / 2)
    return extent.width * degree * max(cos(middle), 1e-3), extent.height * degree


def lonlat(extent: Extent, x: Floats, y: Floats) -> tuple[Floats, Floats] | None:
    """Return longitude and latitude of points, or None where the system is not known or they have none."""
    if not extent.crs:
        return None
    from nodegraph_terrain.georeference import parse_crs, transformed

    found = transformed(parse_crs(extent.crs), parse_crs("EPSG:4326"), x, y)
    return found if np.isfinite(found).all() else None


def north_and_scale(extent: Extent) -> tuple[float, float]:
    """Return the direction of true north in the middle, degrees clockwise from up, and ground metres per map metre.

    The scale is 1 where the projection keeps lengths to one percent, as those for surveys do.
    """
    if extent.unit == "deg" or not extent.crs:
        return 0.0, 1.0
    x, y = (extent.west + extent.east) / 2, (extent.south + extent.north) / 2
    step = extent.height / 100
    middle = lonlat(extent, np.array([x, x]), np.array([y - step, y + step]))
    if middle is None:
        return 0.0, 1.0
    (west, east), (south, north) = (np.radians(part) for part in middle)
    # The bearing of the map's up at the middle (great circle): true north lies that much to the other side.
    turn = east - west
    bearing = atan2(sin(turn) * cos(north), cos(south) * sin(north) - sin(south) * cos(north) * cos(turn))
    chord = sin((north - south) / 2) ** 2 + cos(south) * cos(north) * sin(turn / 2) ** 2
    scale = 2 * EARTH * np.arcsin(np.sqrt(chord)) / (2 * step)
    return -degrees(bearing), float(scale) if abs(scale - 1) > 0.01 else 1.0


def draw_frame(sheet: Sheet, frame: Frame, coordinates: Coordinates) -> None:
    """Draw the frame of a map, with ticks on all sides and coordinates below and on the left."""
    if coordinates != "none":
        for side in ("bottom", "left"):
            for place, words in _ticks(frame, coordinates, side):
                _tick(sheet, frame, side, place, words)
    sheet.box(frame.box, edge=FRAME, width=max(1.0, frame.em / 12))


def _tick(sheet: Sheet, frame: Frame, side: str, place: float, words: str) -> None:
    em, size = frame.em, 0.85 * frame.em
    length, width = 0.45 * em, max(1.0, em / 16)
    # Words near a corner move along the side rather than over the edge of the sheet.
    room = measure(words, size)[0] / 2 - 0.5 * em
    if side == "bottom":
        sheet.lines([[(place, frame.bottom), (place, frame.bottom + length)]], colour=FRAME, width=width)
        place = min(max(place, frame.left + room), frame.right - room)
        sheet.text(place, frame.bottom + 0.65 * em, words, size, across="center", down="top")
    else:
        sheet.lines([[(frame.left - length, place), (frame.left, place)]], colour=FRAME, width=width)
        place = min(max(place, frame.top + room), frame.bottom - room)
        sheet.text(frame.left - 0.75 * em, place, words, size, turn=90, across="center", down="bottom")


def _ticks(frame: Frame, coordinates: Coordinates, side: str) -> list[tuple[float, str]]:
    """Return (place along the side, px; words) of each tick."""
    extent, level = frame.extent, side == "bottom"
    length = frame.width if level else frame.height
    count = max(1.0, length / (10 * frame.em))
    along = np.linspace(0, 1, 257)
    start = frame.left if level else frame.bottom
    signed = length if level else -length
    if coordinates == "own" and extent.unit == "m":
        low, high = (extent.west, extent.east) if level else (extent.south, extent.north)
        step = round_step(high - low, count)
        suffix = (" E" if level else " N") if extent.crs else " m"
        values = multiples(low, high, step)
        texts = [number(value, decimals_of(step)) + suffix for value in values.tolist()]
        values = (values - low) / (high - low)
    else:
        angles = _angles_along(extent, along, level=level)
        if angles is None:
            raise ValueError(
                "the surface has no longitudes and latitudes to write along its frame; choose coordinates own"
            )
        if not (np.all(np.diff(angles) > 0) or np.all(np.diff(angles) < 0)):
            return []  # around a pole they neither rise nor fall along an edge
        low, high = sorted((float(angles[0]), float(angles[-1])))
        step = next((angle for angle in ANGLES if angle >= (high - low) / count), 90.0)
        marks = multiples(low, high, step) if high - low >= 1 / 3600 else np.zeros(0)
        texts = [_angle(mark, step, "EW" if level else "NS") for mark in marks.tolist()]
        order = slice(None) if angles[0] < angles[-1] else slice(None, None, -1)
        values = np.interp(marks, angles[order], along[order])
    return [(start + signed * value, words) for value, words in zip(values.tolist(), texts, strict=True)]


def _angles_along(extent: Extent, along: Floats, *, level: bool) -> Floats | None:
    """Return the longitudes along the southern edge or the latitudes along the western one."""
    x = extent.west + along * extent.width if level else np.full(len(along), extent.west)
    y = np.full(len(along), extent.south) if level else extent.south + along * extent.height
    if extent.unit == "deg":
        return x if level else y
    found = lonlat(extent, x, y)
    if found is None:
        return None
    # Longitudes count on across 180 degrees.
    return np.degrees(np.unwrap(np.radians(found[0]))) if level else found[1]


def _angle(value: float, step: float, letters: str) -> str:
    """Return an angle in degrees, minutes and seconds, as far as multiples of `step` need them."""
    if letters == "EW":
        value = (value + 180) % 360 - 180
    seconds = round(abs(value) * 3600)
    letter = "" if seconds == 0 or (letters == "EW" and seconds == 648_000) else letters[value < 0]
    text = f"{seconds // 3600}°"
    if step < 1:
        text += f"{seconds // 60 % 60:02d}′"
    if step < 1 / 60:
        text += f"{seconds % 60:02d}″"
    return text + letter


def draw_scale_bar(sheet: Sheet, frame: Frame, left: float, top: float, scale: float) -> None:
    """Draw a bar of a round length, in black and white parts, for a map of `scale` ground metres per map metre."""
    em, size = frame.em, 0.85 * frame.em
    per_pixel = ground(frame.extent)[0] * scale / frame.width
    length = round_below(per_pixel * min(20 * em, 0.45 * max(frame.width, 12 * em)))
    unit, factor = ("km", 1000.0) if length >= 1000 else ("m", 1.0) if length >= 1 else ("cm", 0.01)
    parts = 5 if f"{length:e}"[0] == "5" else 2
    wide, high = length / per_pixel, 0.4 * em
    for part in range(parts):
        box = (left + wide * part / parts, top + 1.35 * em, wide / parts, high)
        sheet.box(box, face=INK if part % 2 == 0 else PAPER, edge=INK, width=max(1.0, em / 16))
    value = length / factor
    shown = (0, 1, 2) if parts == 2 and wide > 8 * em else (0, parts)
    for part in shown:
        words = number(value * part / parts, 0 if part in (0, parts) else decimals_of(value / 2))
        x, y = left + wide * part / parts, top + 0.95 * em
        sheet.text(x, y, words, size, across="center" if part else "left", down="baseline")
    half = measure(number(value), size)[0] / 2
    sheet.text(left + wide + half, top + 0.95 * em, f" {unit}", size, down="baseline")


def draw_north_arrow(sheet: Sheet, x: float, top: float, em: float, bearing: float) -> None:
    """Draw an arrow in the middle of a square of five `em`, pointing `bearing` degrees clockwise from up."""
    turn = radians(bearing)
    middle = np.array([x, top + 2.5 * em])

    def placed(points: list[tuple[float, float]]) -> Floats:
        across, up = (np.array(part) for part in zip(*points, strict=True))
        return middle + em * np.column_stack([across * cos(turn) + up * sin(turn), across * sin(turn) - up * cos(turn)])

    tip, tail, notch = (0.0, 1.2), -1.6, (0.0, -0.95)
    width = max(1.0, em / 14)
    sheet.area(placed([tip, (-0.75, tail), notch]), face=INK, edge=INK, width=width)
    sheet.area(placed([tip, (0.75, tail), notch]), face=PAPER, edge=INK, width=width)
    letter = placed([(0.0, 1.85)])[0]
    sheet.text(letter[0], letter[1], "N", 1.15 * em, bold=True, across="center", down="center")
