"""The multigrid of `nodegraph_terrain.multigrid` on an OpenCL device."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nodegraph import Context
from nodegraph_terrain import multigrid
from nodegraph_terrain.multigrid import COARSEST, DAMPING, MARGIN, Level, System, coarse_shape, iterate, spread

if TYPE_CHECKING:
    from nodegraph.opencl import Device

KERNELS = Path(__file__).with_name("multigrid.cl")
GROUP = (64, 2)
"""Cells of a work group; arrays are widened to whole groups, so that no kernel asks where the raster ends."""
SUMS = 4096
"""Least number of floats that a work item sums."""


@dataclass(slots=True)
class _Level:
    """One grid on the device; the arrays of `multigrid.Level`, with all `sides` and all `weights` in one each."""

    shape: tuple[int, int]
    diagonal: Any
    inverse: Any
    sides: Any
    right: Any
    guess: Any
    spare: Any
    weights: Any = None
    solver: Any = None

    @property
    def size(self) -> tuple[int, int]:
        """Work items that cover the grid: whole groups."""
        return _up(self.shape[1], GROUP[0]), _up(self.shape[0], GROUP[1])

    @property
    def padded(self) -> tuple[int, int]:
        """Rows and columns of its arrays."""
        return self.size[1] + 2 * MARGIN, self.size[0] + 2 * MARGIN

    @property
    def stride(self) -> int:
        """Floats from row to row."""
        return self.padded[1]

    @property
    def plane(self) -> int:
        """Floats of one array."""
        return _plane(self.shape)


def _up(count: int, group: int) -> int:
    return -(-count // group) * group


def _plane(shape: tuple[int, int]) -> int:
    return (_up(shape[0], GROUP[1]) + 2 * MARGIN) * (_up(shape[1], GROUP[0]) + 2 * MARGIN)


def solve(device: Device, system: System, tolerance: float, context: Context) -> Any:
    """Return the solution as a device array, given values unchanged; else as `multigrid.solve`."""
    if not system.free.any():
        return device.from_host(system.values)
    grid = DeviceGrid(device, system)
    iterate(grid, tolerance, spread(system), context)
    return grid.solution()


class DeviceGrid:
    """A system on a device, in float32: what `multigrid.iterate` works on."""

    def __init__(self, device: Device, system: System) -> None:
        """Build the hierarchy; the system is in host arrays."""
        free = device.from_host(system.free.view(np.uint8))
        values = device.from_host(system.values)
        conductances = (system.across, system.down)
        arrays = [None if isinstance(item, float) else device.from_host(item) for item in conductances]
        numbers = [item if isinstance(item, float) else 0.0 for item in conductances]
        source = system.source
        self._device = device
        self._galerkin = device.program(KERNELS)
        self._finest = device.program(KERNELS, FINEST=1)
        self._source = None if source is None else device.from_host(source)
        rows, cols = shape = (int(values.shape[0]), int(values.shape[1]))
        top = self._empty_level(shape, sides=2)
        self._levels = [top]
        self.x, self.p, self.q = (device.zeros(_rounded(top.plane)) for _ in range(3))
        laid = (rows, cols, top.plane, top.stride)
        self._run(top, "finest", values, *arrays, *numbers, *laid, self.x, top.sides)
        coupled = device.zeros(2 * top.plane)
        diagonal = device.zeros(top.plane)
        self._run(top, "couplings", top.sides, free, DAMPING, *laid, diagonal, top.inverse, coupled)
        while (last := self._levels[-1]).shape[0] * last.shape[1] > COARSEST:
            self._levels.append(self._coarser(last, diagonal, coupled))
            diagonal, coupled = self._levels[-1].diagonal, self._levels[-1].sides
        last.solver = device.from_host(self._inverse(last, diagonal, coupled))
        # On a processor a work item reads a stretch; on a GPU neighbouring items read neighbouring vectors.
        items = max(1, min(4096, top.plane // SUMS))
        count = -(-top.plane // (8 * items))
        near = device.info.kind == "cpu"
        self._items, self._pattern = items, (count, count if near else 1, 1 if near else items)

    def _empty_level(self, shape: tuple[int, int], sides: int) -> _Level:
        zeros = self._device.zeros
        plane = _plane(shape)
        # Vectors that are summed are read in eights, by whole work items.
        right, guess, spare = (zeros(_rounded(plane)) for _ in range(3))
        return _Level(shape, None, zeros(plane), zeros(sides * plane), right, guess, spare)

    def _run(self, level: _Level, kernel: str, *args: Any) -> None:
        program = self._finest if level is self._levels[0] else self._galerkin
        self._device.run(program, kernel, level.size, *args, local_size=GROUP)

    def _coarser(self, fine: _Level, diagonal: Any, coupled: Any) -> _Level:
        made = self._empty_level(coarse_shape(fine.shape), sides=4)
        made.diagonal = self._device.zeros(made.plane)
        fine.weights = self._device.zeros(9 * made.plane)
        program = self._finest if fine is self._levels[0] else self._galerkin
        below = (diagonal, coupled, fine.plane, fine.stride)
        laid = (made.plane, made.stride, *made.shape)
        size = made.size
        self._device.run(program, "interpolation", size, *below, *laid, fine.weights, local_size=GROUP)
        outputs = (made.diagonal, made.inverse, made.sides)
        self._device.run(program, "galerkin", size, *below, fine.weights, DAMPING, *laid, *outputs, local_size=GROUP)
        return made

    def _inverse(self, level: _Level, diagonal: Any, coupled: Any) -> Any:
        """Return the dense inverse of the coarsest level, computed on the host."""
        rows, cols = level.shape

        def cut(flat: Any) -> Any:
            array = flat.reshape(level.padded)[: rows + 2 * MARGIN, : cols + 2 * MARGIN]
            return array.astype(np.float64)

        planes = self._device.to_host(coupled).reshape(-1, level.plane)
        host = Level(level.shape, cut(self._device.to_host(diagonal)), tuple(map(cut, planes)), np.empty(0), {})
        return multigrid.dense_inverse(host).astype(np.float32)

    # What `multigrid.iterate` asks for.

    def residual(self) -> None:
        """Set r = -A x - s."""
        top = self._levels[0]
        laid = (top.inverse, top.sides, top.plane, *top.shape, top.stride)
        self._run(top, "residual", self.x, self._source, *laid, top.right)

    def precondition(self) -> tuple[float, float]:
        """Set z to one V-cycle on r; return r.z and max |z|."""
        self._cycle(0)
        top = self._levels[0]
        return self._measure(top.right, top.spare)

    def turn(self, beta: float) -> None:
        """Set p = z + beta p."""
        self._flat("turn", self._levels[0].spare, beta, self.p)

    def curvature(self) -> float:
        """Set q = A p; return p.q."""
        top = self._levels[0]
        self._run(top, "outflow", self.p, top.inverse, top.sides, top.plane, top.stride, self.q)
        return self._measure(self.p, self.q)[0]

    def advance(self, alpha: float) -> None:
        """Add alpha p to x and take alpha q from r."""
        self._flat("advance", self.p, self.q, alpha, self.x, self._levels[0].right)

    def correct(self) -> None:
        """Add z to x."""
        self._flat("add", self._levels[0].spare, 1.0, self.x)

    def solution(self) -> Any:
        """Return x as a device array (rows, cols)."""
        top = self._levels[0]
        rows, cols = top.shape
        out = self._device.empty(top.shape)
        self._device.run(self._galerkin, "unpadded", (cols, rows), self.x, top.stride, rows, cols, out)
        return out

    def _flat(self, kernel: str, *args: Any) -> None:
        self._device.run(self._galerkin, kernel, _up(self._levels[0].plane, 64), *args, local_size=64)

    def _measure(self, a: Any, b: Any) -> tuple[float, float]:
        """Return a.b and max |b|."""
        sums, peaks = self._device.empty(self._items), self._device.empty(self._items)
        self._device.run(self._galerkin, "measure", self._items, a, b, *self._pattern, sums, peaks)
        total = self._device.to_host(sums).sum(dtype=np.float64)
        return float(total), float(self._device.to_host(peaks).max())

    def _cycle(self, depth: int) -> None:
        """Set a level's `spare` to an approximate solution for its `right`."""
        level = self._levels[depth]
        if level.solver is not None:
            rows, cols = level.shape
            arguments = (level.solver, level.right, rows, cols, level.stride, level.spare)
            self._device.run(self._galerkin, "direct", rows * cols, *arguments)
            return
        below = self._levels[depth + 1]
        system = (level.right, level.diagonal, level.inverse, level.sides, level.plane, level.stride)
        self._run(level, "start", level.inverse, level.right, level.stride, level.guess)
        self._run(level, "defect", level.guess, *system, level.spare)
        transfer = (level.weights, below.plane, below.stride, *below.shape)
        self._run(below, "restriction", level.spare, level.stride, *transfer, below.right)
        self._cycle(depth + 1)
        self._run(below, "prolongation", below.spare, *transfer, level.stride, level.guess)
        self._run(level, "smooth", level.guess, *system, level.spare)


def _rounded(plane: int) -> int:
    """Return room for a vector that is read in stretches by whole work items."""
    return plane + 8 * max(1, min(4096, plane // SUMS)) + 64
