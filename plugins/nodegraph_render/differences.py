"""How far two surfaces on one grid lie apart, in numbers."""

from __future__ import annotations

import json
import math
from dataclasses import fields

import numpy as np
import numpy.typing as npt

from nodegraph import Context, port_type
from nodegraph_render.map_sheet import on_ground
from nodegraph_render.rounding import multiples, round_step
from nodegraph_render.sheet import FRAME, SOFT, Sheet, decimals_of, number
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.gradient import horn_gradient
from nodegraph_terrain.raster import Elevation
from nodegraph_terrain.statistics import Histogram

Floats = npt.NDArray[np.float64]

BINS = 101


@port_type
class Differences:
    """How far a surface lies from a reference, over the cells that both know.

    Heights are in m, d = surface - reference.  A number that does not exist is NaN, such as the correlation with level
    ground; the PSNR of equal surfaces is infinite.

    Attributes:
        count: cells that both know.
        void_count: cells that one of them does not know.
        rmse: root of the mean of d^2.
        mean_absolute: mean of |d|.
        bias: mean of d; above zero where the surface lies too high.
        standard_deviation: of d around its mean.
        lowest, highest: extremes of d.
        largest: greatest |d|.
        le90: |d| that nine cells of ten do not exceed (linear error at 90 %).
        psnr: 20 log10((highest - lowest height of the reference) / rmse), dB.
        within: the tolerance that `share_within` counts for.
        share_within: share of cells with |d| <= within, 0 to 1.
        correlation: of the heights (Pearson).
        slope_rmse: root of the mean squared difference of the slopes, degrees.
        histogram: of d.
    """

    count: int
    void_count: int
    rmse: float
    mean_absolute: float
    bias: float
    standard_deviation: float
    lowest: float
    highest: float
    largest: float
    le90: float
    psnr: float
    within: float
    share_within: float
    correlation: float
    slope_rmse: float
    histogram: Histogram

    def to_json(self) -> str:
        """Return the numbers as strict JSON: those that are not finite are null, and ``equal`` tells why."""
        numbers = {item.name: getattr(self, item.name) for item in fields(self) if item.name != "histogram"}
        finite = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        return json.dumps({**finite, "equal": self.largest == 0}, allow_nan=False)

    def rows(self) -> list[tuple[str, str]]:
        """Return what each number is called and how people write it."""
        digits = 3 if self.largest < 10 else 2
        return [
            ("RMSE", f"{number(self.rmse, digits)} m"),
            ("mean |d|", f"{number(self.mean_absolute, digits)} m"),
            ("bias", f"{number(self.bias, digits)} m"),
            ("lowest", f"{number(self.lowest, digits)} m"),
            ("highest", f"{number(self.highest, digits)} m"),
            ("LE90", f"{number(self.le90, digits)} m"),
            (f"within {self.within:g} m", f"{100 * self.share_within:.1f} %"),
            ("PSNR", _decibels(self.psnr)),
            ("correlation", "–" if math.isnan(self.correlation) else f"{self.correlation:.4f}"),
            ("slope RMSE", f"{self.slope_rmse:.2f}°"),
            ("cells", number(self.count)),
            ("void", number(self.void_count)),
        ]


def differences(reference: Elevation, surface: Elevation, within: float, context: Context) -> Differences:
    """Return how far a surface lies from a reference on the same grid.

    Raises:
        ValueError: no cell is known in both, or a height is infinite.
    """
    cells = reference.shape[0] * reference.shape[1]
    known = ~(np.isnan(reference.data) | np.isnan(surface.data))
    count = int(known.sum())
    if count == 0:
        raise ValueError("no cell is known in both surfaces; compare surfaces of the same ground")
    if not (np.isfinite(reference.data[known]).all() and np.isfinite(surface.data[known]).all()):
        raise ValueError("a surface holds infinite heights; link it through terrain.clamp first")
    a, b = reference.data[known].astype(np.float64), surface.data[known].astype(np.float64)
    context.progress(0.2)
    d = b - a
    size = np.abs(d)
    rmse = math.sqrt(float(np.mean(d * d)))
    span = float(a.max() - a.min())
    low, high = float(d.min()), float(d.max())
    context.progress(0.4)
    ends = (low, high) if high > low else (low - 0.5, high + 0.5)
    counts, edges = np.histogram(d, BINS, ends)
    bias = float(d.mean())
    return Differences(
        count=count,
        void_count=cells - count,
        rmse=rmse,
        mean_absolute=float(size.mean()),
        bias=bias,
        standard_deviation=float(d.std()),
        lowest=low,
        highest=high,
        largest=float(size.max()),
        le90=float(np.percentile(size, 90)),
        psnr=psnr(span, rmse),
        within=within,
        share_within=float((size <= within).mean()),
        correlation=_correlation(a, b),
        slope_rmse=_slope_rmse(reference, surface, known, context),
        histogram=Histogram(edges, counts, "m"),
    )


def psnr(span: float, rmse: float) -> float:
    """Return the peak signal to noise ratio in dB, infinite where nothing differs.

    >>> psnr(1000.0, 1.0), psnr(1000.0, 0.0), psnr(0.0, 1.0)
    (60.0, inf, -inf)
    """
    if rmse == 0:
        return math.inf
    return 20 * math.log10(span / rmse) if span > 0 else -math.inf


def _correlation(a: Floats, b: Floats) -> float:
    a, b = a - a.mean(), b - b.mean()
    scale = math.sqrt(float(a @ a) * float(b @ b))
    return max(-1.0, min(1.0, float(a @ b) / scale)) if scale > 0 else math.nan


def _slope_rmse(reference: Elevation, surface: Elevation, known: npt.NDArray[np.bool_], context: Context) -> float:
    """Return how the slopes differ; a cell that one of the surfaces does not know is void in both."""
    total, count = 0.0, 0
    grids = [on_ground(grid, 1.0) for grid in (reference, surface)]
    if not known.all():
        grids = [grid.like(np.where(known, grid.data, np.float32(np.nan))) for grid in grids]
    for part in row_blocks(*reference.shape, context, start=0.5):
        slopes = [_steepness(grid, part) for grid in grids]
        d = slopes[1] - slopes[0]
        d = d[~np.isnan(d)]
        total, count = total + float(d @ d), count + len(d)
    return math.sqrt(total / count)


def _steepness(grid: Elevation, part: slice) -> Floats:
    east, north = horn_gradient(grid.data, part, grid.cell_size)
    return np.degrees(np.arctan(np.hypot(east.astype(np.float64), north.astype(np.float64))))


def _decibels(value: float) -> str:
    return "∞ (equal)" if value == math.inf else "−∞" if value == -math.inf else f"{number(value, 1)} dB"


def preview_differences(numbers: Differences) -> bytes:
    """Show the differences as a histogram, with the numbers beside it."""
    from nodegraph_terrain.formats.png import png

    em, wide, tall = 15.0, 640.0, 330.0
    sheet = Sheet(960, 420)
    left, top = 2.5 * em, 1.8 * em
    edges, counts = numbers.histogram.edges, numbers.histogram.counts
    low, high = float(edges[0]), float(edges[-1])
    x = left + (np.repeat(edges, 2) - low) / (high - low) * wide
    y = top + tall - np.concatenate([[0], np.repeat(counts, 2), [0]]) / max(1, int(counts.max())) * tall
    sheet.area(np.column_stack([x, y]), face="#5b8fb0")
    sheet.lines([[(left, top + tall), (left + wide, top + tall)]], colour=FRAME, width=1.2)
    step = round_step(high - low, 8)
    for value in multiples(low, high, step).tolist():
        place = left + (value - low) / (high - low) * wide
        sheet.lines([[(place, top + tall), (place, top + tall + 6)]], colour=FRAME, width=1.2)
        sheet.text(place, top + tall + 10, number(value, decimals_of(step)), 13, across="center")
    sheet.text(left + wide / 2, top + tall + 32, "surface − reference, m", 13, across="center")
    for row, (name, value) in enumerate(numbers.rows()):
        sheet.text(left + wide + 2.5 * em, top + 26 * row, name, 13, colour=SOFT)
        sheet.text(935, top + 26 * row, value, 13, across="right")
    return png(sheet.pixels())
