"""The Poisson equation on a patch of a raster, with given values around it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_terrain import multigrid, multigrid_opencl
from nodegraph_terrain.multigrid import System

if TYPE_CHECKING:
    from nodegraph.opencl import Device

Array = npt.NDArray[Any]

WORKERS = -1
"""Threads of a transform: all processors."""


def divergence(across: Array, down: Array) -> Array:
    """Return the backward-difference divergence of a field of forward differences, one per side that two cells share.

    Nothing flows across the outer edge.  Of the forward differences of a raster it is exactly the 5-point Laplacian.
    """
    total = np.zeros((across.shape[0], down.shape[1]), np.result_type(across, down))
    total[:, :-1] += across
    total[:, 1:] -= across
    total[:-1] += down
    total[1:] -= down
    return total


def solve_rectangle(values: Array, source: Array | None, across: float, down: float) -> Array:
    """Return the exact solution inside a raster whose outer rows and columns are given, by the sine transform.

    The 5-point operator is diagonal in the type-I discrete sine transform: O(n log n), in the precision of `values`.
    Without a source only one transform of the raster is needed, with one two.
    """
    from scipy.fft import dstn, idstn

    made = np.empty_like(values)
    for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        made[edge] = values[edge]
    rows, cols = values.shape[0] - 2, values.shape[1] - 2
    north, south, west, east = values[0, 1:-1], values[-1, 1:-1], values[1:-1, 0], values[1:-1, -1]
    if source is None:
        spectrum = _edge_spectrum((north, south), (west, east), across, down)
    else:
        right = source[1:-1, 1:-1].astype(values.dtype)
        right[0] -= down * north
        right[-1] -= down * south
        right[:, 0] -= across * west
        right[:, -1] -= across * east
        spectrum = dstn(right, type=1, overwrite_x=True, workers=WORKERS)
    spectrum /= np.add.outer(
        (down * _eigenvalues(rows)).astype(values.dtype), (across * _eigenvalues(cols)).astype(values.dtype)
    )
    made[1:-1, 1:-1] = idstn(spectrum, type=1, overwrite_x=True, workers=WORKERS)
    return made


def _edge_spectrum(rows: tuple[Array, Array], columns: tuple[Array, Array], across: float, down: float) -> Array:
    """Return the sine transform of what the rows north and south, the columns west and east of a raster bring in.

    A field that is zero but for its first row x and its last one y has the transform

        F[k, l] = 2 sin(pi k / (n + 1)) (X[l] - (-1)^k Y[l]),    k = 1 .. n,

    with X, Y the transforms of x and y; so has the transpose.
    """
    from scipy.fft import dst

    (north, south), (west, east) = ([dst(line, type=1) for line in pair] for pair in (rows, columns))
    along_rows, along_columns = ([a + b, a - b] for a, b in ((north, south), (west, east)))
    of_rows, of_columns = -down * _first_sines(len(west)), -across * _first_sines(len(north))
    spectrum = np.empty((len(west), len(north)), north.dtype)
    # Odd k come first.
    for i in (0, 1):
        for j in (0, 1):
            part = spectrum[i::2, j::2]
            np.multiply.outer(of_rows[i::2].astype(north.dtype), along_rows[i][j::2], out=part)
            part += np.multiply.outer(along_columns[j][i::2], of_columns[j::2].astype(north.dtype))
    return spectrum


def _first_sines(count: int) -> Array:
    """Return the sine transform of a 1 followed by zeros."""
    return np.asarray(2 * np.sin(np.arange(1, count + 1) * (np.pi / (count + 1))))


def _eigenvalues(count: int) -> Array:
    """Return the eigenvalues of the second difference of `count` values between two zeros."""
    return np.asarray(-4 * np.sin(np.arange(1, count + 1) * (np.pi / (2 * (count + 1)))) ** 2)


def solve(system: System, tolerance: float, context: Context, device: Device | None) -> Array:
    """Return the solution: by the sine transform where the free cells fill a rectangle, else by multigrid."""
    free, across, down = system.free, system.across, system.down
    if isinstance(across, float) and isinstance(down, float) and is_rectangle(free):
        return solve_rectangle(system.values, system.source, across, down)
    if device is None:
        return multigrid.solve(system, tolerance, context)
    return device.to_host(multigrid_opencl.solve(device, system, tolerance, context))


def is_rectangle(free: Array) -> bool:
    """Say whether all cells but the outer rows and columns are free, and none of those."""
    inside = free[1:-1, 1:-1]
    return bool(inside.size and inside.all()) and int(free.sum()) == inside.size
