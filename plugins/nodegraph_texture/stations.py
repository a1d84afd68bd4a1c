"""Measured values brought to every cell: regression on altitude by zones, and what is left by inverse distance.

Dachsbacher, Bolch and Stamminger 2006, section 5.1, bring temperature and rain from stations to the ground this way:
a gradient in each climatically homogeneous zone, of altitude and where it is needed of place.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.raster import Elevation, Grid, Labels, require_same_grid

Floats = npt.NDArray[np.float64]
Station = tuple[float, float, float, float]
"""East, north (in the system of the surface), altitude, all m, and the value measured there."""

Trend = Literal["altitude", "altitude_and_place"]

ALIKE = 1e-9
"""Stations whose altitudes or places differ by less than this share of their size say nothing of a gradient."""


@dataclass(frozen=True, slots=True)
class Regression:
    """value = level + altitude z + east x + north y, with x and y from `origin`, m."""

    origin: tuple[float, float]
    level: float
    altitude: float
    east: float
    north: float

    def at(self, x: Floats, y: Floats, z: Floats) -> Floats:
        """Return values at places and altitudes that fit each other by broadcasting."""
        flat = self.level + self.east * (x - self.origin[0]) + self.north * (y - self.origin[1])
        return np.asarray(flat + self.altitude * z)


def read_stations(path: Path) -> list[Station]:
    """Return the stations of a table whose first row names the columns: east, north, altitude and the value, last.

    Raises:
        ValueError: the table has no four columns of numbers.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"'{path.name}' is no text in UTF-8 (byte {error.start}); give a table") from error
    separator = next((mark for mark in ",;\t" if mark in text), ",")
    found: list[Station] = []
    for number, cells in enumerate(csv.reader(StringIO(text), delimiter=separator), 1):
        if not any(cell.strip() for cell in cells):
            continue
        try:
            east, north, altitude, value = map(float, cells)
        except ValueError as error:
            if not found and number == 1:
                continue
            raise ValueError(
                f"row {number} of '{path.name}' is no station; give four numbers: east, north, altitude, value"
            ) from error
        found.append((east, north, altitude, value))
    if not found:
        raise ValueError(f"'{path.name}' holds no stations; give rows of east, north, altitude, value")
    return found


def fit(stations: Sequence[Station], trend: Trend, where: str = "") -> Regression:
    """Return the least-squares regression of the values of stations on their altitude, and on their place.

    Args:
        stations: two at least for a trend of altitude, four with place, of altitudes and places that differ.
        trend: on what.
        where: which zone, for messages.

    Raises:
        ValueError: too few stations, or ones that all lie at one altitude or on one line.
    """
    table = np.array(stations, np.float64).reshape(-1, 4)
    needed = 2 if trend == "altitude" else 4
    if len(table) < needed:
        count = f"{len(table)} station{'s' * (len(table) != 1)}{where}"
        raise ValueError(f"{count} cannot say a trend of {trend.replace('_', ' ')}; give {needed} at least")
    if not np.isfinite(table).all():
        raise ValueError(f"a station{where} has a number that is not finite; leave it out")
    mean = table.mean(axis=0)
    columns = table[:, [2] if trend == "altitude" else [2, 0, 1]] - mean[[2] if trend == "altitude" else [2, 0, 1]]
    size = np.abs(columns).max(axis=0)
    scaled = columns / np.where(size > 0, size, 1)
    flat = bool((size <= ALIKE * (1 + np.abs(mean[2]))).any())
    if flat or np.linalg.matrix_rank(scaled, tol=1e-6 * np.sqrt(len(table))) < scaled.shape[1]:
        kind = "at different altitudes" if trend == "altitude" else "at different altitudes and not along one line"
        raise ValueError(f"the stations{where} say nothing of a trend of {trend.replace('_', ' ')}; give some {kind}")
    slope = np.linalg.lstsq(scaled, table[:, 3] - mean[3], rcond=None)[0] / size
    east, north = (float(slope[1]), float(slope[2])) if len(slope) > 1 else (0.0, 0.0)
    altitude = float(slope[0])
    return Regression(
        (float(mean[0]), float(mean[1])), float(mean[3]) - altitude * float(mean[2]), altitude, east, north
    )


def regionalize(
    surface: Elevation,
    stations: Sequence[Station],
    zones: Labels | None,
    *,
    trend: Trend,
    residuals: bool,
    transition: float,
    context: Context,
) -> npt.NDArray[np.float32]:
    """Return what stations measured for every cell: the regression of its zone, and the stations' residuals.

    Residuals are spread by inverse squared distance (Shepard 1968), so that every station is met.  A station belongs to
    the zone of its cell, or, outside of the raster and where there is no zone, of the nearest cell with one.

    Args:
        surface: in m.
        stations: east, north, altitude, value.
        zones: a number per cell, negative where there is none; None for one zone.
        trend: what the regression is on.
        residuals: interpolate them.
        transition: width over which a zone fades into the next, m (the standard deviation of a Gaussian).
        context: the engine's.

    Returns:
        float32, NaN where the surface is void or has no zone.

    Raises:
        ValueError: the surface is in degrees, the zones lie on another grid, or stations do not suffice (`fit`).
    """
    cell = require_projected(surface)
    table = np.array(stations, np.float64).reshape(-1, 4)
    parts: list[tuple[Regression, npt.NDArray[np.float32] | None]] = []
    left = np.zeros(len(table))
    for name, members, weight in _zones(surface, table, zones, transition, cell):
        context.progress(0.0)
        found = fit([(s[0], s[1], s[2], s[3]) for s in table[members].tolist()], trend, name)
        left[members] = table[members, 3] - found.at(table[members, 0], table[members, 1], table[members, 2])
        parts.append((found, weight))
    result = np.empty(surface.shape, np.float32)
    x, y = _middles(surface)
    for block in row_blocks(*surface.shape, context, cells=1 << 16):
        heights = surface.data[block].astype(np.float64)
        total, sum_of_weights = np.zeros((2, *heights.shape))
        for found, weight in parts:
            share = 1.0 if weight is None else weight[block].astype(np.float64)
            total += share * found.at(x, y[block, None], heights)
            sum_of_weights += share
        with np.errstate(invalid="ignore", divide="ignore"):
            values = total / sum_of_weights
        if residuals:
            values += _shepard(x, y[block], table[:, :2], left, min(cell))
        result[block] = values
    return result


def _middles(grid: Grid) -> tuple[Floats, Floats]:
    """Return the coordinates of the cells' middles: of columns eastwards, of rows southwards."""
    dx, dy = grid.cell_size
    rows, cols = grid.shape
    x, y = np.arange(0.5, cols), np.arange(0.5, rows)
    return np.asarray(grid.extent.west + x * dx), np.asarray(grid.extent.north - y * dy)


def _zones(
    surface: Elevation, table: Floats, zones: Labels | None, transition: float, cell: tuple[float, float]
) -> Iterator[tuple[str, npt.NDArray[np.bool_], npt.NDArray[np.float32] | None]]:
    """Yield for each zone its name in messages, which stations it has, and its weight in every cell."""
    if zones is None:
        yield "", np.ones(len(table), np.bool_), None
        return
    require_same_grid(surface, zones)
    inside = zones.data >= 0
    if not inside.any():
        raise ValueError("no cell belongs to a zone; number the zones from 0")
    x, y = _middles(zones)
    row, col = np.nonzero(inside)
    nearest = [int(np.argmin((x[col] - s[0]) ** 2 + (y[row] - s[1]) ** 2)) for s in table]
    owner = zones.data[row[nearest], col[nearest]] if len(table) else np.zeros(0, np.int32)
    for zone in np.unique(zones.data[inside]).tolist():
        weight = (zones.data == zone).astype(np.float32)
        if transition > 0:
            from scipy.ndimage import gaussian_filter

            weight = gaussian_filter(weight, (transition / cell[1], transition / cell[0]), mode="nearest")
            weight[~inside] = 0
        yield f" of zone {zone}", owner == zone, weight


def _shepard(x: Floats, y: Floats, places: Floats, values: Floats, cell: float) -> Floats:
    """Return values interpolated by inverse squared distance, in the middles of cells."""
    total, weights = np.zeros((len(y), len(x))), np.zeros((len(y), len(x)))
    for (east, north), value in zip(places, values, strict=True):
        squared = np.maximum((x - east) ** 2 + (y[:, None] - north) ** 2, (1e-3 * cell) ** 2)
        weight = 1 / squared
        total += weight * value
        weights += weight
    return np.asarray(total / weights)
