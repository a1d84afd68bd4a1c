"""Pictures of patches, dictionaries and sparse codes for people."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from nodegraph import Context, Preview
from nodegraph_sparse.dictionary import Dictionary, Patches, SparseCode
from nodegraph_sparse.draw_dictionary import INK, draw_dictionary, sheet, tiles, usage_counts
from nodegraph_sparse.learning import Learning, preview_learning
from nodegraph_sparse.metric import mass
from nodegraph_sparse.rate_distortion import RateDistortion
from nodegraph_sparse.sparse_statistics import SparseStatistics
from nodegraph_sparse.sparse_statistics_plot import preview_rate_distortion, preview_sparse_statistics

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = 60
"""Patches or atoms of a preview."""


def preview_patches(patches: Patches) -> bytes:
    """Show patches from all over the terrain, with number and mean height."""
    from nodegraph_terrain.formats.png import png

    count = len(patches.samples)
    which = np.unique(np.linspace(0, count - 1, min(count, SHOWN)).round().astype(np.int64))
    drawn = tiles(patches.samples[which], 84, "relief", np.zeros(len(which), np.bool_), Context())
    labels = [f"{number}: {patches.means[number]:,.0f} m" for number in which.tolist()]
    some = f"{count:,} patches" if len(which) == count else f"{len(which)} of {count:,} patches"
    note = f"{some} of {patches.size} x {patches.size} samples, radius {patches.radius:,.6g} m, with their mean heights"
    return png(sheet(drawn, labels, 960, [(note, INK)]))


def preview_dictionary(dictionary: Dictionary) -> bytes:
    """Show atoms from all over the dictionary."""
    from nodegraph_terrain.formats.png import png

    return png(draw_dictionary(dictionary, order="spread", most=SHOWN, tile=84, width=960, context=Context()).data)


def preview_code(code: SparseCode) -> bytes:
    """Show how often atoms are used, and where patches keep a residual."""
    from matplotlib.figure import Figure

    if not code.grid.count:
        figure = Figure(figsize=(4.6, 0.6), dpi=120)
        figure.text(0.5, 0.5, f"no patches of a grid, {code.atoms:,} atoms", ha="center", va="center")
        return _png(figure)
    usage = np.sort(usage_counts(code))[::-1]
    used = int(np.count_nonzero(usage))
    grid = code.grid
    figure = Figure(figsize=(9.5, 4.4), dpi=120, layout="constrained")
    left, right = figure.subplots(1, 2)
    # Beyond the used ones there is nothing to see of a complete dictionary.
    left.stairs(usage[: max(used, 1)], fill=True, color="#3b6f8f")
    if used:
        left.set_yscale("log")
        left.set_ylim(bottom=0.7)
    left.yaxis.set_major_formatter("{x:,.0f}")
    left.set_xlabel(f"atoms by rank: {used:,} of {code.atoms:,} used")
    left.set_ylabel("patches that use the atom")
    left.spines[["top", "right"]].set_visible(False)
    half = grid.radius / 2
    edges = [grid.west - half, grid.west + (grid.cols - 0.5) * grid.radius]
    edges += [grid.north - (grid.rows - 0.5) * grid.radius, grid.north + half]
    samples = 1.0 if code.size is None else float(mass(code.size, code.metric).sum())
    remains = np.sqrt(np.maximum(code.residuals, 0) / samples).reshape(grid.rows, grid.cols)
    label = "norm of the residual, m x sqrt(samples)" if code.size is None else "root mean square of the residual, m"
    shown = right.imshow(remains, extent=(edges[0], edges[1], edges[2], edges[3]), cmap="magma", vmin=0)
    figure.colorbar(shown, ax=right, label=label, shrink=0.8)
    right.set_xlabel("east, m")
    right.set_ylabel("north, m")
    right.ticklabel_format(useOffset=False, style="plain")
    right.locator_params(nbins=4)
    return _png(figure)


def _png(figure: Figure) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


PREVIEWS: tuple[Preview, ...] = (
    Preview(Patches, preview_patches),
    Preview(Dictionary, preview_dictionary),
    Preview(SparseCode, preview_code),
    Preview(Learning, preview_learning),
    Preview(SparseStatistics, preview_sparse_statistics),
    Preview(RateDistortion, preview_rate_distortion),
)
"""How the types of this package are drawn."""
