"""Pictures of the statistics of sparse terrains."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from nodegraph_sparse.rate_distortion import RateDistortion
from nodegraph_sparse.sparse_statistics import SparseStatistics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#1f5fa8", "#b3411e", "#2c7a3f", "#8a3d98", "#9a6b00", "#00767a")
MARKS = "osD^vP"


def preview_sparse_statistics(found: SparseStatistics) -> bytes:
    """Show the numbers as a table."""
    from matplotlib.figure import Figure

    rows = [
        ("samples of an atom K", f"{found.samples:,}"),
        ("atoms N", f"{found.atoms:,}"),
        ("of which used", f"{found.used:,}"),
        ("patches n", f"{found.patches:,}"),
        ("sparsity s", f"{found.sparsity:,}"),
        ("atoms of a patch, on average", f"{found.mean_sparsity:.2f}"),
        ("values t", f"{found.values:,}"),
        ("cells t0", f"{found.cells:,}"),
        ("ratio t / t0", f"{found.ratio:.2%}"),
        ("bytes as stored", f"{found.bytes:,}"),
        ("bytes to a cell", f"{found.bytes / found.cells:.2f}"),
        ("PSNR", _decibels(found.psnr)),
        ("root mean square error", _metres(found.rmse)),
        ("largest error", _metres(found.largest_error)),
    ]
    figure = Figure(figsize=(4.6, 0.27 * len(rows) + 0.25), dpi=120, facecolor="white")
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set_axis_off()
    axis.set_xlim(0, 1)
    axis.set_ylim(len(rows), 0)
    for number, (name, value) in enumerate(rows):
        if number % 2 == 0:
            axis.axhspan(number, number + 1, color="#f1f3f5", lw=0)
        axis.text(0.04, number + 0.5, name, va="center", fontsize=9.5, color="#333333")
        axis.text(0.96, number + 0.5, value, va="center", ha="right", fontsize=9.5, color="#111111")
    return _png(figure)


def preview_rate_distortion(found: RateDistortion) -> bytes:
    """Plot error over bytes, a line for each N, beside the rivals; and a table."""
    from matplotlib.figure import Figure

    rows = found.rows
    figure = Figure(figsize=(11, max(4.4, 0.24 * len(rows) + 1.2)), dpi=120, layout="constrained", facecolor="white")
    axis, table = figure.subplots(1, 2, width_ratios=(1.25, 1))
    sizes = np.array([row.bytes for row in rows]) / 1000
    for number, count in enumerate(dict.fromkeys(row.atoms for row in rows)):
        some = [place for place, row in enumerate(rows) if row.atoms == count]
        axis.plot(
            sizes[some], [rows[place].psnr for place in some], marker=MARKS[number % len(MARKS)], markersize=4.5,
            color=COLOURS[number % len(COLOURS)], lw=1.4, label=f"N = {count:,}",
        )  # fmt: skip
    order = np.argsort(sizes)
    for values, style, name in ((found.jpeg2000, "--", "JPEG 2000"), (found.bicubic, ":", "fewer cells, bicubic")):
        axis.plot(sizes[order], values[order], style, color="#555555", lw=1.4, label=name)
    axis.set_xscale("log")
    _label_sizes(axis, sizes)
    axis.set_xlabel("stored, kB")
    axis.set_ylabel("PSNR, dB")
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)
    axis.legend(frameon=False, fontsize=8.5)
    table.set_axis_off()
    table.set_xlim(0, 1)
    table.set_ylim(max(len(rows), 13) + 1.2, -0.2)
    places = (0.1, 0.18, 0.36, 0.52, 0.7, 0.86, 1.0)
    heads = ("N", "s", "kB", "t / t0", "PSNR", "JPEG 2000", "bicubic")
    for place, head in zip(places, heads, strict=True):
        table.text(place, 0.5, head, ha="right", va="center", fontsize=8, color="#555555")
    for line, (row, wavelets, cubic) in enumerate(zip(rows, found.jpeg2000, found.bicubic, strict=True), 1):
        if line % 2:
            table.axhspan(line, line + 1, color="#f1f3f5", lw=0)
        cells = (
            f"{row.atoms:,}", f"{row.sparsity}", f"{row.bytes / 1000:,.1f}", f"{row.ratio:.1%}",
            *(f"{value:.1f}" if np.isfinite(value) else "–" for value in (row.psnr, wavelets, cubic)),
        )  # fmt: skip
        for place, text in zip(places, cells, strict=True):
            table.text(place, line + 0.5, text, ha="right", va="center", fontsize=8, color="#111111")
    return _png(figure)


def _label_sizes(axis: Any, sizes: Any) -> None:
    """Write plain numbers of kilobytes below a logarithmic axis."""
    from matplotlib.ticker import FixedLocator, NullLocator

    nice = [digit * 10.0**power for power in range(-1, 7) for digit in (1, 2, 3, 5, 7)]
    shown = [size for size in nice if sizes.min() * 0.8 <= size <= sizes.max() * 1.25]
    axis.xaxis.set_major_locator(FixedLocator(shown))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.xaxis.set_major_formatter("{x:,g}")


def _decibels(value: float) -> str:
    return "–" if np.isnan(value) else "exact" if np.isposinf(value) else f"{value:.2f} dB"


def _metres(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.3g} m"


def _png(figure: Figure) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
