"""Pictures of the laws that a river network follows."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from nodegraph_hydrology.horton import NetworkStatistics


def plotted(numbers: NetworkStatistics, title: str = "") -> npt.NDArray[np.uint8]:
    """Return a picture, 800 x 1200: the laws of Horton and Tokunaga, with the numbers beside them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

    figure = Figure(figsize=(12, 8), dpi=100, layout="constrained", facecolor="white")
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    order = np.arange(1, len(numbers.counts) + 1)
    count = len(order)
    kept = count - 1 if count > 2 else count
    panels = (
        ("streams", numbers.counts.astype(float), numbers.bifurcation_ratio, "R_B", -1, count),
        ("mean length, km", numbers.lengths / 1000, numbers.length_ratio, "R_L", 1, kept),
        ("mean area, km²", numbers.areas / 1e6, numbers.area_ratio, "R_A", 1, kept),
    )
    for axis, (label, values, ratio, name, sign, used) in zip(axes.flat, panels, strict=False):
        good = values > 0
        axis.semilogy(order[good], values[good], "o", color="#2b6ca3")
        fitted = np.flatnonzero(good[:used])
        if math.isfinite(ratio) and len(fitted) > 1:
            middle = np.log10(values[fitted]).mean() - sign * math.log10(ratio) * order[fitted].mean()
            along = order[fitted[[0, -1]]]
            axis.semilogy(along, 10 ** (middle + sign * math.log10(ratio) * along), color="#c2572d", lw=1.4)
            axis.set_title(f"${name} = {ratio:.2f}$", fontsize=12)
        axis.set_xlabel("order")
        axis.set_ylabel(label)
    axis = axes[1, 0]
    k = np.arange(1, len(numbers.branching) + 1)
    good = numbers.branching > 0
    axis.semilogy(k[good], numbers.branching[good], "o", color="#2b6ca3")
    if math.isfinite(numbers.tokunaga_c):
        axis.semilogy(k, numbers.tokunaga_a * numbers.tokunaga_c ** (k - 1.0), color="#c2572d", lw=1.4)
        axis.set_title(f"$T_k = {numbers.tokunaga_a:.2f} \\cdot {numbers.tokunaga_c:.2f}^{{k-1}}$", fontsize=12)
    axis.set_xlabel("k")
    axis.set_ylabel("side tributaries $T_k$")
    for axis in axes.flat[:4]:
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=20))
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.5g}"))
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    for axis in axes.flat[4:]:
        axis.set_axis_off()
    for row, (name, text) in enumerate(numbers.rows()):
        place = 0.97 - 0.098 * row
        axes[1, 1].text(0.0, place, name, transform=axes[1, 1].transAxes, fontsize=12, color="#555555")
        axes[1, 1].text(0.75, place, text, transform=axes[1, 1].transAxes, fontsize=12)
    if title:
        figure.suptitle(title.replace("$", r"\$"), fontsize=15)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def preview_statistics(numbers: NetworkStatistics) -> bytes:
    """Show the laws that were fitted, with the numbers beside them."""
    from nodegraph_terrain.formats.png import png

    return png(plotted(numbers))
