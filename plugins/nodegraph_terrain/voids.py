"""Filling voids: cells of unknown value between known ones."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_terrain.forecasts import outline
from nodegraph_terrain.raster import Raster

T = TypeVar("T", bound=Raster)

TOLERANCE = 1e-10
"""Largest residual of the Laplace equation, relative to the boundary values: far below one part of float32."""
DIRECT = 2000
"""Up to this many unknowns a factorization is faster than any hierarchy."""
BATCH = 1 << 19
"""Unknowns that are solved together (a larger single void is solved by itself): bounds the memory."""


@node(version=1, locality=whole)
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
    latitude).  The result has no new extremes: it lies between the lowest and the highest value around the void.  It
    is solved to a relative residual of 1e-10, by conjugate gradients preconditioned with smoothed aggregation
    multigrid, in about 400 bytes per void cell and time linear in their number.

    ``nearest`` copies the value of the nearest known cell on the ground.

    A void is a set of void cells that share sides.  With `maximum_size`, larger ones stay as they are (a lake, the
    border that a projection leaves).

    Raises:
        ValueError: every cell is void.

    References: Reuter, Nelson, Jarvis 2007, An evaluation of void-filling interpolation methods for SRTM data,
    doi:10.1080/13658810601169899.  Vanek, Mandel, Brezina 1996, Algebraic multigrid by smoothed aggregation,
    doi:10.1007/BF02238511.
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
    spacing = _spacing(surface)
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
        _fill(filled, labels, batch, boxes, spacing, context)
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


def _spacing(surface: Raster) -> tuple[float, float]:
    """Return the sides of a cell in ground proportions."""
    dx, dy = surface.cell_size
    if surface.extent.unit == "deg":
        middle = (surface.extent.south + surface.extent.north) / 2
        dx *= max(cos(radians(middle)), 1e-3)
    return dx, dy


def _batches(sizes: npt.NDArray[np.int64], wanted: npt.NDArray[np.bool_]) -> list[npt.NDArray[np.int64]]:
    """Group voids, in the order of their labels, into batches of at most `BATCH` cells or one void."""
    ids = np.flatnonzero(wanted)
    starts, room = [0], BATCH
    for position, size in enumerate(sizes[ids].tolist()):
        if size > room and position > starts[-1]:
            starts.append(position)
            room = BATCH
        room -= size
    return [ids[a:b] for a, b in zip(starts, [*starts[1:], len(ids)], strict=True)]


def _fill(
    filled: npt.NDArray[np.float32],
    labels: npt.NDArray[np.int32],
    batch: npt.NDArray[np.int64],
    boxes: list[Any],
    spacing: tuple[float, float],
    context: Context,
) -> None:
    """Solve the Laplace equation in the voids of a batch, in place."""
    rows, cols = _cells(labels, batch, boxes)
    system, right, level = _system(filled, rows, cols, spacing)
    solution = _solve(system, right, rows, cols, context) + level
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


def _solve(
    matrix: Any,
    right: npt.NDArray[np.float64],
    rows: npt.NDArray[np.int64],
    cols: npt.NDArray[np.int64],
    context: Context,
) -> npt.NDArray[np.float64]:
    """Solve a Laplace system by conjugate gradients with a multigrid preconditioner."""
    hierarchy = _hierarchy(matrix, rows, cols)
    norm = float(np.linalg.norm(right))
    solution = np.zeros_like(right)
    if norm == 0:
        return solution
    residual = right.copy()
    direction = correction = _cycle(hierarchy, 0, residual)
    product = float(residual @ correction)
    for _ in range(500):
        context.progress(None)
        applied = matrix @ direction
        step = product / float(direction @ applied)
        solution += step * direction
        residual -= step * applied
        if float(np.linalg.norm(residual)) <= TOLERANCE * norm:
            return solution
        correction = _cycle(hierarchy, 0, residual)
        previous, product = product, float(residual @ correction)
        direction = correction + (product / previous) * direction
    raise ArithmeticError("the Laplace equation did not converge in 500 steps")


@dataclass(frozen=True, slots=True)
class _Level:
    """One level of the hierarchy: its matrix, damped inverse diagonal, the way to the next; the last has a solver."""

    matrix: Any
    damped: npt.NDArray[np.float64]
    prolong: Any = None
    restrict: Any = None
    solver: Any = None


def _hierarchy(matrix: Any, rows: npt.NDArray[np.int64], cols: npt.NDArray[np.int64]) -> list[_Level]:
    """Build levels by smoothed aggregation over blocks of 3 by 3 cells, down to a system that is solved directly."""
    from scipy import sparse
    from scipy.sparse.linalg import splu

    levels = []
    while matrix.shape[0] > DIRECT:
        inverse = 1.0 / matrix.diagonal()
        rows, cols = rows // 3, cols // 3
        blocks, member = np.unique(rows * (int(cols.max()) + 1) + cols, return_inverse=True)
        if len(blocks) > 0.7 * len(member):
            break
        count = len(member)
        plain = sparse.csr_array((np.ones(count), member, np.arange(count + 1)), shape=(count, len(blocks)))
        prolong = (plain - sparse.diags_array(2 / 3 * inverse) @ (matrix @ plain)).tocsr()
        restrict = prolong.T.tocsr()
        levels.append(_Level(matrix, 2 / 3 * inverse, prolong, restrict))
        first = np.zeros(len(blocks), np.int64)
        first[member] = np.arange(count)
        rows, cols = rows[first], cols[first]
        matrix = (restrict @ (matrix @ prolong)).tocsr()
    levels.append(_Level(matrix, 1.0 / matrix.diagonal(), solver=splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A")))
    return levels


def _cycle(levels: list[_Level], depth: int, right: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return an approximate solution: one symmetric V-cycle with two damped Jacobi steps on either side."""
    level = levels[depth]
    if level.solver is not None:
        solved: npt.NDArray[np.float64] = level.solver.solve(right)
        return solved
    guess = level.damped * right
    guess += level.damped * (right - level.matrix @ guess)
    guess += level.prolong @ _cycle(levels, depth + 1, level.restrict @ (right - level.matrix @ guess))
    for _ in range(2):
        guess += level.damped * (right - level.matrix @ guess)
    return guess
