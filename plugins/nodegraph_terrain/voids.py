"""Filling voids: cells of unknown value between known ones."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_terrain import multigrid
from nodegraph_terrain.forecasts import outline
from nodegraph_terrain.raster import Raster, ground_cell

T = TypeVar("T", bound=Raster)

TOLERANCE = 1e-6
"""Largest error of multigrid, relative to the range of the values around a void."""
DIRECT = 2000
"""Voids of up to this many cells are solved by a factorization, larger ones by multigrid, each by itself."""
BATCH = 1 << 16
"""Cells of small voids that are factorized together: bounds the memory."""


@node(version=2, locality=whole)
def fill_voids(
    surface: T,
    *,
    method: Annotated[
        Literal["laplace", "nearest"],
        Param("laplace: smooth membrane over each void; nearest: the nearest known value."),
    ] = "laplace",
    maximum_size: Annotated[int | None, Param("Voids of more cells than this stay.", ge=1, unit="cells")] = None,
    context: Context,
) -> T:
    """Fill voids (NaN) from the values around them; known cells keep their values.

    ``laplace`` spans a membrane over each void: the solution h of

        (h[i, j-1] - 2 h[i, j] + h[i, j+1]) / dx^2 + (h[i-1, j] - 2 h[i, j] + h[i+1, j]) / dy^2 = 0

    in every void cell, with the known neighbours as boundary values and no slope across the raster's outer edge.  dx
    and dy are the sides of a cell on the ground (in degrees: dx shortened by the cosine of the raster's middle
    latitude).  The result has no new extremes: it lies between the lowest and the highest value around the void.
    Voids of up to 2,000 cells are solved by a factorization; larger ones by multigrid in their bounding box, to an
    error of 1e-6 of the relief around them, in time linear in its cells.

    ``nearest`` copies the value of the nearest known cell on the ground.

    A void is a set of void cells that share sides.  With `maximum_size`, larger ones stay as they are (a lake, the
    border that a projection leaves).

    Raises:
        ValueError: every cell is void.

    References: Reuter, Nelson, Jarvis 2007, An evaluation of void-filling interpolation methods for SRTM data,
    doi:10.1080/13658810601169899.  Dendy 1982, Black box multigrid, doi:10.1016/0021-9991(82)90057-2.
    """
    missing = np.isnan(surface.data)
    if not missing.any():
        return surface
    if missing.all():
        raise ValueError("the raster is all void; there is nothing to fill its voids from")
    from scipy import ndimage

    labels = np.zeros(missing.shape, np.int32)
    count = ndimage.label(missing, output=labels)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    wanted = sizes > 0 if maximum_size is None else (sizes > 0) & (sizes <= maximum_size)
    if not wanted.any():
        return surface
    filled = surface.data.copy()
    spacing = ground_cell(surface)
    if method == "nearest":
        context.progress(None, "nearest known cells")
        target = wanted[labels]
        nearest = ndimage.distance_transform_edt(
            missing, sampling=spacing[::-1], return_distances=False, return_indices=True
        )
        filled[target] = surface.data[nearest[0][target], nearest[1][target]]
        return surface.like(filled)
    boxes = ndimage.find_objects(labels)
    done, total = 0, int(sizes[wanted].sum())
    for batch in _batches(sizes, wanted):
        context.progress(done / total, f"{len(batch)} voids")
        if sizes[batch[0]] > DIRECT:
            _span(filled, labels, int(batch[0]), boxes[batch[0] - 1], spacing, context)
        else:
            _factorize(filled, labels, batch, boxes, spacing)
        done += int(sizes[batch].sum())
    context.progress(1.0)
    return surface.like(filled)


@fill_voids.forecast
def _forecast(surface: Forecast, *, method: str, **_: object) -> Forecast:
    known = outline(surface)
    cells = known.rows * known.cols if known else surface.bytes // 4
    # The number of voids is unknown before the data: reckon with a tenth of the cells.
    per_cell = 13 if method == "nearest" else 5 + 400 // 10
    return Forecast(surface.bytes, cells * per_cell, surface.about)


def _batches(sizes: npt.NDArray[np.int64], wanted: npt.NDArray[np.bool_]) -> Iterator[npt.NDArray[np.int64]]:
    """Yield each large void by itself, then the small ones by label in batches of about `BATCH` cells."""
    large = sizes > DIRECT
    for label in np.flatnonzero(wanted & large):
        yield np.array([label])
    small = np.flatnonzero(wanted & ~large)
    if len(small):
        yield from np.split(small, np.flatnonzero(np.diff(np.cumsum(sizes[small]) // BATCH)) + 1)


def _span(
    filled: npt.NDArray[np.float32],
    labels: npt.NDArray[np.int32],
    label: int,
    box: tuple[slice, slice],
    spacing: tuple[float, float],
    context: Context,
) -> None:
    """Solve the Laplace equation in one void by multigrid, in place."""
    from scipy.ndimage import binary_dilation

    rows, cols = (
        slice(max(0, part.start - 1), min(count, part.stop + 1)) for part, count in zip(box, filled.shape, strict=True)
    )
    free = labels[rows, cols] == label
    # The cells beside the void; what lies further off (other voids too) has no say.
    around = binary_dilation(free) & ~free
    known = filled[rows, cols][around]
    level = np.float32(known.mean(dtype=np.float64))
    values = np.where(around, filled[rows, cols] - level, np.float32(0))
    dx, dy = spacing
    solution = multigrid.solve(multigrid.System(values, free, dy / dx, dx / dy), TOLERANCE, context)
    # By the maximum principle only a numerical error lies outside.
    filled[rows, cols][free] = np.clip(solution[free] + level, known.min(), known.max())


def _factorize(
    filled: npt.NDArray[np.float32],
    labels: npt.NDArray[np.int32],
    batch: npt.NDArray[np.int64],
    boxes: list[Any],
    spacing: tuple[float, float],
) -> None:
    """Solve the Laplace equation in a batch of small voids, in place."""
    from scipy.sparse.linalg import splu

    rows, cols = _cells(labels, batch, boxes)
    matrix, right, level = _system(filled, rows, cols, spacing)
    solution = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A").solve(right) + level
    filled[rows, cols] = solution.astype(np.float32)


def _cells(
    labels: npt.NDArray[np.int32], batch: npt.NDArray[np.int64], boxes: list[Any]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return rows and columns of the cells of a batch in row-major order."""
    band = slice(min(boxes[i - 1][0].start for i in batch), max(boxes[i - 1][0].stop for i in batch))
    part = labels[band]
    if len(batch) == 1:
        rows, cols = np.nonzero(part == batch[0])
    else:
        member = np.zeros(int(part.max()) + 1, np.bool_)
        member[batch] = True
        rows, cols = np.nonzero(member[part])
    return rows + band.start, cols


def _system(
    values: npt.NDArray[np.float32],
    rows: npt.NDArray[np.int64],
    cols: npt.NDArray[np.int64],
    spacing: tuple[float, float],
) -> tuple[Any, npt.NDArray[np.float64], float]:
    """Return matrix and right side of the Laplace equation in the given cells, and the level the heights count from.

    Neighbours with a value move to the right side; neighbours beyond the edge drop out (no slope across it).
    """
    from scipy import sparse

    dx, dy = spacing
    across, down = dy / dx, dx / dy
    height, width = values.shape
    count = len(rows)
    flat = rows * width + cols
    diagonal, right, weight = np.zeros(count), np.zeros(count), np.zeros(count)
    own, other, entries = [], [], []
    for step_row, step_col, conductance in ((-1, 0, down), (0, -1, across), (0, 1, across), (1, 0, down)):
        row, col = rows + step_row, cols + step_col
        inside = (row >= 0) & (row < height) & (col >= 0) & (col < width)
        near = values[np.clip(row, 0, height - 1), np.clip(col, 0, width - 1)].astype(np.float64)
        known = inside & ~np.isnan(near)
        diagonal[inside] += conductance
        right[known] += conductance * near[known]
        weight[known] += conductance
        unknown = np.flatnonzero(inside & ~known)
        own.append(unknown)
        other.append(np.searchsorted(flat, row[unknown] * width + col[unknown]))
        entries.append(np.full(len(unknown), -conductance))
    # Heights count from their mean along the borders, so that the tolerance is one of relief, not of altitude.
    level = float(right.sum() / weight.sum())
    right -= weight * level
    index = np.arange(count)
    places = (np.concatenate([index, *own]), np.concatenate([index, *other]))
    matrix = sparse.csr_array((np.concatenate([diagonal, *entries]), places), shape=(count, count))
    return matrix, right, level
