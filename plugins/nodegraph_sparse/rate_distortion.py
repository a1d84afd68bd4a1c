"""How good a sparse terrain is for its bytes, beside other ways to store it."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node, port_type
from nodegraph_sparse.container import Precision, packed, unpacked
from nodegraph_sparse.ksvd import ksvd
from nodegraph_sparse.metric import Metric
from nodegraph_sparse.patches import grid_patches
from nodegraph_sparse.report import Report
from nodegraph_sparse.rivals import fewer_cells, jpeg2000
from nodegraph_sparse.save_sparse import only_used
from nodegraph_sparse.sparse_statistics import SparseStatistics, compared, described
from nodegraph_sparse.windows import half_side
from nodegraph_terrain.raster import Elevation


@port_type
class RateDistortion(Report):
    """Sparse terrains of several N and s, and what else gives in as many bytes.

    Attributes:
        rows: one for each N and s, by N, then s.
        jpeg2000: (rows,) PSNR of JPEG 2000 in the same bytes, dB; NaN where none is that small.
        bicubic: (rows,) PSNR of fewer cells in the same bytes, enlarged by cubic convolution, dB; likewise.
    """

    rows: tuple[SparseStatistics, ...]
    jpeg2000: npt.NDArray[Any]
    bicubic: npt.NDArray[Any]

    def records(self) -> list[dict[str, Any]]:
        """Return the rows, with the rivals."""
        found = []
        for row, wavelets, cubic in zip(self.rows, self.jpeg2000.tolist(), self.bicubic.tolist(), strict=True):
            rivals = {"psnr_jpeg2000": wavelets, "psnr_bicubic": cubic}
            found.append(row.records()[0] | {name: v if np.isfinite(v) else None for name, v in rivals.items()})
        return found


Positive = Annotated[int, Param(ge=1)]


@node(version=1)
def rate_distortion(
    surface: Elevation,
    *,
    radius: Annotated[float, Param("Of the discs: a whole number of cells.", gt=0, unit="m")],
    atoms: Annotated[tuple[Positive, ...], Param("Values of N.", min_length=1, max_length=16)] = (64, 128, 256),
    sparsity: Annotated[tuple[Positive, ...], Param("Values of s.", min_length=1, max_length=16)] = (1, 2, 4, 8),
    iterations: Annotated[int, Param("Of K-SVD.", ge=0)] = 10,
    metric: Annotated[Metric, Param("In which patches are learned and coded.")] = "weighted",
    coefficient_bits: Annotated[int | None, Param("As of save_sparse.", ge=2, le=16)] = 10,
    mean_bits: Annotated[int | None, Param("As of save_sparse.", ge=2, le=16)] = 14,
    atom_bits: Annotated[int | None, Param("As of save_sparse.", ge=2, le=16)] = 8,
    seed: Annotated[int, Param("Of the first atoms.", ge=0)] = 0,
    context: Context,
) -> RateDistortion:
    """Learn a terrain with several N and s, and compare error and bytes, also with other ways to store it.

    Each dictionary is learned from the terrain itself by ``sparse.ksvd`` and stored with its code as
    ``sparse.save_sparse`` does; the PSNR is of what that file gives back.  In the same bytes stand JPEG 2000 (9-7
    wavelets at 16 bits) and the terrain with fewer cells, deflated, enlarged by cubic convolution.

    For storage alone JPEG 2000 wins, by far: by 15 to 30 dB on the 344 by 403 cells of terrain.sample_dem at R = 8
    cells.  Fewer cells mostly win too: from 7 dB ahead (s = 1) to 0.3 dB behind (N = 64, s = 8); with small discs they
    are behind, by 0 to 4 dB at R = 4 cells on the Alps and Jacksboro (N = 128).  A sparse terrain stores each point
    four times over, in discs that overlap, and its own dictionary.  What it gives for that is a continuous function
    which can be edited, blended and drawn at any level of detail, and atoms that can be exchanged for finer ones.

    Args:
        surface: a terrain in metres, with square cells and without voids.
        radius: R.
        atoms: each at most the number of patches.
        sparsity: values of s.
        iterations: of ``sparse.ksvd``.
        metric: ``weighted`` or ``plain``.
        coefficient_bits: of the files; none: as they are, 64.
        mean_bits: likewise.
        atom_bits: likewise; none: 32.
        seed: of the first atoms.
        context: the engine's.

    Raises:
        ValueError: as of ``sparse.patches`` and ``sparse.ksvd``; or the terrain is flat.

    Complexity: that of ``sparse.ksvd`` for each N and s.

    Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum
    35(2), section 5.1 and table 1, doi:10.1111/cgf.12821.
    """
    half = half_side(surface, radius)
    if float(np.ptp(surface.data)) == 0:
        raise ValueError("the terrain is flat; there is nothing to learn")
    found = grid_patches(surface, half, metric, Context())
    precision = Precision(coefficient_bits, mean_bits, atom_bits)
    cases = [(count, most) for count in atoms for most in sparsity]
    rows: list[SparseStatistics] = []
    wavelets: list[float] = []
    cubic: list[float] = []
    for number, (count, most) in enumerate(cases):

        def report(share: float | None, _: str, number: int = number) -> None:
            context.progress(None if share is None else (number + share) / len(cases))

        inner = Context(context.node, report=report)
        learned = ksvd(found, atoms=count, sparsity=most, iterations=iterations, seed=seed, context=inner)
        dictionary, code = only_used(learned.dictionary, learned.code)
        stored = unpacked(packed(dictionary, code, precision), "the file")
        row = described(*stored, surface, precision, inner)
        rows.append(row)
        rivals = jpeg2000(surface.data, row.bytes, inner), fewer_cells(surface.data, row.bytes)
        for rival, psnr in zip(rivals, (wavelets, cubic), strict=True):
            psnr.append(np.nan if rival is None else compared(rival[1], surface.data).psnr)
    return RateDistortion(tuple(rows), np.array(wavelets), np.array(cubic))
