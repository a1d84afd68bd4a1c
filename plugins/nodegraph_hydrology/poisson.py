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

    The 5-point operator is diagonal in the type-I discrete sine transform: two transforms, O(n log n), in float64.
    """
    from scipy.fft import dstn, idstn

    right = np.zeros((values.shape[0] - 2, values.shape[1] - 2))
    if source is not None:
        right += source[1:-1, 1:-1]
    right[0] -= down * values[0, 1:-1]
    right[-1] -= down * values[-1, 1:-1]
    right[:, 0] -= across * values[1:-1, 0]
    right[:, -1] -= across * values[1:-1, -1]
    spectrum = dstn(right, type=1, overwrite_x=True)
    spectrum /= np.add.outer(down * _eigenvalues(right.shape[0]), across * _eigenvalues(right.shape[1]))
    made = values.copy()
    made[1:-1, 1:-1] = idstn(spectrum, type=1, overwrite_x=True)
    return made


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
