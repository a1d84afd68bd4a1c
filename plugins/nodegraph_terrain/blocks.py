"""Large rasters in blocks of rows, so that temporaries stay in the processor's cache and a cancel takes effect."""

from __future__ import annotations

from collections.abc import Iterator

from nodegraph import Context

CELLS = 1 << 18
"""Cells of a block: a megabyte of float32, which a core's own cache holds."""

EVERYTHING = 1 << 30
"""A halo, in cells, that reaches past the edge of any raster: for nodes that look that far under some parameters."""


def row_blocks(
    rows: int, cols: int, context: Context, *, cells: int = CELLS, start: float = 0.0, stop: float = 1.0
) -> Iterator[slice]:
    """Yield consecutive row ranges of about `cells` cells each, reporting progress from `start` to `stop` between them.

    Raises:
        Cancelled: the run was cancelled.

    >>> [(part.start, part.stop) for part in row_blocks(5, 4, Context(), cells=8)]
    [(0, 2), (2, 4), (4, 5)]
    """
    step = max(1, cells // max(1, cols))
    for first in range(0, rows, step):
        context.progress(start + (stop - start) * first / rows)
        yield slice(first, min(rows, first + step))
    context.progress(stop)


GROUP = (8, 4)
"""Work items of a group.  Stated, as some drivers compile a kernel anew for each size of group they choose."""


def padded(group: tuple[int, int], items: int, lines: int) -> tuple[int, int]:
    """Return the least global size of whole groups that covers `items` by `lines`; kernels return early outside.

    >>> padded((8, 4), 13, 4)
    (16, 4)
    """
    return -(-items // group[0]) * group[0], -(-lines // group[1]) * group[1]
