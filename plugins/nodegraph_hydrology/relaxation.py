"""Jacobi iteration and successive over-relaxation of a `System`, on the host and on OpenCL."""

from __future__ import annotations

from math import pi, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_terrain.blocks import GROUP, padded
from nodegraph_terrain.multigrid import System

if TYPE_CHECKING:
    from nodegraph.opencl import Device

Array = npt.NDArray[Any]
KERNELS = Path(__file__).parent / "kernels" / "relaxation.cl"
WORK = 1 << 27
"""Cells that a device is given at a time, so that a cancel need not wait for more."""


def best_relaxation(shape: tuple[int, int]) -> float:
    """Return the over-relaxation that converges fastest on a rectangle with given edges: 2 / (1 + sin(pi / n))."""
    return 2 / (1 + sin(pi / (max(shape) + 1)))


def _conductances(system: System, dtype: Any) -> tuple[Array, Array, Array]:
    """Return conductances across and down, and 1 over their sum at free cells (0 elsewhere)."""
    rows, cols = system.free.shape
    across = np.broadcast_to(np.asarray(system.across, dtype), (rows, cols - 1))
    down = np.broadcast_to(np.asarray(system.down, dtype), (rows - 1, cols))
    total = np.zeros((rows, cols), dtype)
    for face, own, other in ((across, total[:, :-1], total[:, 1:]), (down, total[:-1], total[1:])):
        own += face
        other += face
    inverse = np.zeros_like(total)
    np.divide(1, total, out=inverse, where=system.free & (total > 0))
    return across, down, inverse


def _rise(x: Array, across: Array, down: Array, inverse: Array) -> Array:
    """Return how far the weighted mean of the neighbours lies above each free cell."""
    rise = np.zeros_like(x)
    flow = np.subtract(x[:, 1:], x[:, :-1])
    flow *= across
    rise[:, :-1] = flow
    rise[:, 1:] -= flow
    flow = np.subtract(x[1:], x[:-1])
    flow *= down
    rise[:-1] += flow
    rise[1:] -= flow
    rise *= inverse
    return rise


def jacobi(system: System, iterations: int, context: Context) -> Array:
    """Return the values after so many Jacobi steps."""
    x = system.values.copy()
    across, down, inverse = _conductances(system, x.dtype)
    for step in range(iterations):
        context.progress(step / iterations, "Jacobi steps")
        x += _rise(x, across, down, inverse)
    return x


def sor(system: System, iterations: int, relaxation: float, context: Context) -> Array:
    """Return the values after so many steps of over-relaxation, one colour of the chessboard after the other."""
    x = system.values.copy()
    across, down, inverse = _conductances(system, x.dtype)
    odd = np.add.outer(np.arange(x.shape[0]), np.arange(x.shape[1])) & 1
    colours = [inverse * (odd == colour) * x.dtype.type(relaxation) for colour in (0, 1)]
    for step in range(iterations):
        context.progress(step / iterations, "SOR steps")
        for colour in colours:
            x += _rise(x, across, down, colour)
    return x


def relax_on(device: Device, system: System, iterations: int, relaxation: float | None, context: Context) -> Any:
    """Return the values as a device array after so many steps: of Jacobi, or with a `relaxation` of SOR."""
    rows, cols = system.values.shape
    conductances = (system.across, system.down)
    arrays = [
        None if isinstance(item, float) else device.from_host(np.ascontiguousarray(item)) for item in conductances
    ]
    numbers = [item if isinstance(item, float) else 0.0 for item in conductances]
    uniform = arrays == [None, None]
    program = device.program(KERNELS, UNIFORM=1) if uniform else device.program(KERNELS)
    fixed = (device.from_host(system.free.view(np.uint8)), *arrays, *numbers, rows, cols)
    every = max(1, WORK // (rows * cols))
    x, other = device.from_host(system.values), device.empty((rows, cols))
    if relaxation is not None:
        x = x + np.float32(0)
    for step in range(iterations):
        if step % every == 0:
            device.finish()
            context.progress(step / iterations, "Jacobi steps" if relaxation is None else "SOR steps")
        if relaxation is None:
            device.run(program, "jacobi", padded(GROUP, cols, rows), x, *fixed, other, local_size=GROUP)
            x, other = other, x if step else device.empty((rows, cols))
        else:
            for colour in (0, 1):
                size = padded(GROUP, -(-cols // 2), rows)
                device.run(program, "sor", size, x, *fixed, colour, relaxation, local_size=GROUP)
    return x
