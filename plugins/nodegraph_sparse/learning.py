"""The value on the wire that tells how a dictionary was learned."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_sparse.dictionary import Patches
from nodegraph_sparse.ksvd_sweep import Sweeps
from nodegraph_sparse.metric import mass
from nodegraph_sparse.report import Report


@port_type
class Learning(Report):
    """How the error fell, from the first atoms (entry 0) over each iteration.

    Attributes:
        objective: F, (iterations + 1,) float64, m2 samples: what all patches together lack, squared in the metric.
        rmse: (iterations + 1,) float64, m: the root of F over the sum of the masses of all samples.
        replaced: (iterations + 1,) int32, unused atoms that were replaced.
        kept: (iterations + 1,) int32, patches whose former atoms were better than those that the pursuit found.
        atoms: N.
        patches: n.
        sparsity: s.
    """

    objective: npt.NDArray[Any]
    rmse: npt.NDArray[Any]
    replaced: npt.NDArray[Any]
    kept: npt.NDArray[Any]
    atoms: int
    patches: int
    sparsity: int

    @property
    def iterations(self) -> int:
        """How many there were: less than asked for where nothing more changed."""
        return len(self.objective) - 1

    def records(self) -> list[dict[str, Any]]:
        """Return a row for each iteration, from the first atoms (0) on."""
        names = ("objective", "rmse", "replaced", "kept")
        rows = zip(*(getattr(self, name).tolist() for name in names), strict=True)
        return [{"iteration": number, **dict(zip(names, row, strict=True))} for number, row in enumerate(rows)]


def learning(patches: Patches, atoms: int, sparsity: int, sweeps: Sweeps) -> Learning:
    """Return how sweeps over patches went, with errors in metres."""
    count = len(patches.samples)
    masses = count * float(mass(patches.size, patches.metric).sum())
    rmse = np.sqrt(sweeps.objective / masses)
    return Learning(sweeps.objective, rmse, sweeps.replaced, sweeps.kept, atoms, count, sparsity)


def preview_learning(found: Learning) -> bytes:
    """Plot the error over the iterations, and what was replaced and kept."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(8, 4.6), dpi=120, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    steps = np.arange(found.iterations + 1)
    above.plot(steps, found.rmse, "o-", color="#2b6ca3", markersize=3.5, lw=1.4)
    above.set_ylabel("root mean square error, m")
    first, last = float(found.rmse[0]), float(found.rmse[-1])
    above.set_ylim(0, 1.15 * first or 1.0)
    above.annotate(f"{first:.4g} m", (0, first), (7, 3), textcoords="offset points")
    if found.iterations:
        above.annotate(f"{last:.4g} m", (steps[-1], last), (0, 7), textcoords="offset points", ha="right")
    above.set_title(
        f"{found.atoms:,} atoms for {found.patches:,} patches, s = {found.sparsity}", loc="left", fontsize=10, pad=10
    )
    below.bar(steps, found.kept / found.patches * 100, color="#b9c7d3", label="patches that keep their atoms, %")
    replaced = found.replaced > 0
    if replaced.any():
        share = found.replaced[replaced] / found.atoms * 100
        below.plot(steps[replaced], share, "D", color="#c2572d", markersize=5, label="atoms replaced, %")
    below.set_ylim(0, 100)
    below.set_ylabel("%")
    below.set_xlabel("iteration")
    below.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    below.legend(frameon=False, fontsize=8, loc="upper left", ncols=2, bbox_to_anchor=(0, 1.3))
    for axis in (above, below):
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(axis="y", alpha=0.25)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
