"""Sampling on OpenCL: for each tile of the raster a short program of what the tile can see.

The host walks the tree once per tile and drops what does not reach it; what is left becomes a list of instructions
for a stack machine in ``kernels/machine.h``, with all parameters in buffers.  Editing a parameter therefore never
recompiles: a program is compiled for each *set of kinds* of instruction, and a third party's kinds join through
`Kernel`.

**Precision.**  Coordinates on the device are float32 offsets from an origin that the host keeps in float64 (`Frame`):
the tile's corner, carried through every transform.  Parameters are made relative to it in float64, so that a sample
200 km from the scene's origin is as exact as one beside it.

**Blocks.**  What reaches a tile often reaches few of its samples.  An instruction is noted with the blocks of the tile
that it concerns (`Emitter.blocks`) and skipped in all others, where it would change nothing.

**Pending parameters.**  Computed for each tile and each primitive in it by itself, parameters would take longer than
the samples.  An instruction may be noted with what owns it (`Pending`): its parameters are computed with those of all
others of its kind, as arrays, when the last tile is emitted.

**Instructions.**  A function ``void name(State *s, P p, N n, D data)`` in a ``.cl`` file (see ``kernels/tree.h``):
`p` and `n` point to the float and integer parameters that `Emitter.add` was given, `data` to the arrays of
`Emitter.shared`.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

import nodegraph_terrain
from nodegraph import Context
from nodegraph_terrain.raster import Extent
from nodegraph_tree.frame import ALL, BLOCK, TILE, Frame, Tile
from nodegraph_tree.function import EVERYWHERE, THRESHOLD, Box, ElevationFunction, Floats, Points

if TYPE_CHECKING:
    from nodegraph.opencl import Device, Program

__all__ = [
    "BLOCK", "FOLDER", "NOTHING", "TILE", "Emitter", "Fill", "Frame", "Kernel", "Parameters", "Pending", "Programs",
    "Shared", "Tile", "sample_on_device", "tile_programs",
]  # fmt: skip

FOLDER = Path(__file__).with_name("kernels")
TREE = FOLDER / "tree.cl"
INCLUDE = (FOLDER, Path(nodegraph_terrain.__file__).parent)


@dataclass(frozen=True, slots=True)
class Kernel:
    """An instruction: the name of its function and the file that defines it."""

    name: str
    file: Path


@dataclass(slots=True)
class Shared:
    """Arrays that all tiles of one sampling share, such as the pixels of an image: stored once."""

    places: dict[int, int] = field(default_factory=dict)
    arrays: list[npt.NDArray[np.float32]] = field(default_factory=list)
    size: int = 0
    kept: list[Any] = field(default_factory=list)

    def place(self, values: npt.NDArray[Any]) -> int:
        """Return where an array begins in the shared buffer, adding it the first time."""
        if id(values) not in self.places:
            self.places[id(values)] = self.size
            self.kept.append(values)  # an id must not be used again
            self.arrays.append(np.ascontiguousarray(values, np.float32).ravel())
            self.size += values.size
        return self.places[id(values)]

    def buffer(self) -> npt.NDArray[np.float32]:
        """Return all arrays as one; one alone is not copied."""
        if len(self.arrays) == 1 and self.size:
            return self.arrays[0]
        return np.concatenate([*self.arrays, np.zeros(1, np.float32)])  # buffers must not be empty


class Parameters(NamedTuple):
    """The parameters of many instructions of one kind.

    Attributes:
        floats: of each, (n, k).
        heads: integers of each, (n, h).
        tails: further integers of all, one after the other, such as the places of origins on the lattices of noises.
        counts: how many of `tails` each has, (n,).
    """

    floats: Floats
    heads: npt.NDArray[np.int64]
    tails: npt.NDArray[np.int32] = np.zeros(0, np.int32)
    counts: npt.NDArray[np.int64] | int = 0


Fill = Callable[[Sequence[Any], Floats, Floats, Shared], Parameters]
"""``fill(owners, x, y, shared)`` returns the parameters of many owners' instructions, seen from (x, y) in float64."""


class Pending(NamedTuple):
    """Parameters that are computed for all tiles at once, when the last is emitted."""

    fill: Fill
    owner: Any
    x: float
    y: float


class Emitter:
    """Collects the instructions of many tiles.

    Attributes:
        tile: the one at hand.
        blocks: some of its blocks, as bits: what is added concerns no others and is skipped there.
        shared: arrays that instructions read.
    """

    def __init__(self) -> None:
        self.tile = Tile(Frame(EVERYWHERE, 0.0, 0.0))
        self.blocks = ALL
        self.shared = Shared()
        self._kinds: dict[str, tuple[int, Kernel]] = {}
        self._code, self._floats, self._ints = array("i"), array("f"), array("i")
        self._pending: dict[Fill, list[tuple[range, Sequence[Any], float, float]]] = {}
        self._level = self._deepest = self._frames = self._deepest_frame = 0

    def begin(self, tile: Tile) -> None:
        """Go on to the program of the next tile."""
        self.tile, self._level = tile, 0

    @property
    def detail(self) -> Floats | float:
        """The level of detail of the tile at hand."""
        return self.tile.detail

    def add(
        self, kernel: Kernel, floats: Iterable[float] | Pending = (), ints: Iterable[int] = (), *, pushes: int = 1
    ) -> None:
        """Append an instruction.

        Args:
            kernel: what to do.
            floats, ints: its parameters, rounded to float32 and int32; or, for both, how they are computed later.
            pushes: how many (f, alpha) pairs it leaves on the stack more than it takes.
        """
        if isinstance(floats, Pending):
            self._pend(floats.fill, len(self), 1, [floats.owner], floats.x, floats.y)
            floats = ()
        self._code.extend((self._kind(kernel), len(self._floats), len(self._ints), self.blocks))
        self._floats.extend(floats)
        self._ints.extend(ints)
        self._level += pushes
        if self._level > self._deepest:
            self._deepest = self._level

    def add_each(
        self,
        kernel: Kernel,
        fill: Fill,
        owners: Sequence[Any],
        frame: Frame,
        blocks: npt.NDArray[np.int32],
        then: Kernel,
    ) -> None:
        """Append for each owner an instruction with pending parameters, and one that joins its pair to the one below.

        The same as `add` for one after the other, each in its own `blocks`, but far faster.
        """
        code = np.zeros((len(owners), 2, 4), np.int32)
        code[:, :, 0] = self._kind(kernel), self._kind(then)
        code[:, :, 3] = (blocks & self.blocks)[:, None]
        self._pend(fill, len(self), 2, owners, frame.ox, frame.oy)
        self._code.frombytes(code.tobytes())
        self._deepest = max(self._deepest, self._level + 1)

    def _kind(self, kernel: Kernel) -> int:
        return self._kinds.setdefault(kernel.name, (len(self._kinds), kernel))[0]

    def _pend(self, fill: Fill, first: int, step: int, owners: Sequence[Any], x: float, y: float) -> None:
        rows = range(first, first + step * len(owners), step)
        self._pending.setdefault(fill, []).append((rows, owners, x, y))

    def __len__(self) -> int:
        """How many instructions there are."""
        return len(self._code) >> 2

    def nothing(self) -> None:
        """Append an instruction that leaves (0, 0): nothing reaches the tile."""
        self.add(NOTHING)

    def enter(self, kernel: Kernel, floats: Iterable[float] | Pending = (), ints: Iterable[int] = ()) -> None:
        """Append an instruction that pushes new coordinates; `leave` with one that drops them again."""
        self.add(kernel, floats, ints, pushes=0)
        self._frames += 1
        self._deepest_frame = max(self._deepest_frame, self._frames)

    def leave(self, kernel: Kernel, floats: Iterable[float] = (), ints: Iterable[int] = ()) -> None:
        """Append the instruction that ends what `enter` began."""
        self.add(kernel, floats, ints, pushes=0)
        self._frames -= 1

    def from_host(self, node: ElevationFunction, frame: Frame) -> None:
        """Compute a subtree with NumPy for the tile and append an instruction that reads the values."""
        (rows, cols), (dx, dy) = self.tile.shape, self.tile.step
        x, y = np.meshgrid((np.arange(cols) + 0.5) * dx, (np.arange(rows) + 0.5) * -dy)
        a, b, c, d = frame.linear
        points = Points(
            (frame.ox + a * x + b * y).ravel(),
            (frame.oy + c * x + d * y).ravel(),
            self.detail if isinstance(self.detail, (int, float)) else self.detail.ravel(),
        )
        sample = node.query(points)
        pair = np.zeros((2, TILE, TILE), np.float32)
        pair[0, :rows, :cols] = sample.height.reshape(x.shape)
        pair[1, :rows, :cols] = sample.weight.reshape(x.shape)
        self.add(FROM_HOST, ints=[self.shared.place(pair)])

    def programs(self, starts: Sequence[int]) -> Programs:
        """Return the programs of the tiles, which begin at `starts`, with pending parameters computed."""
        code = np.array(self._code, np.int32).reshape(-1, 4)
        names = sorted(self._kinds)
        order = np.empty(len(names), np.int32)
        order[[self._kinds[name][0] for name in names]] = np.arange(len(names))
        code[:, 0] = order[code[:, 0]]
        floats, ints = [np.array(self._floats, np.float32)], [np.array(self._ints, np.int32)]
        for fill, waiting in self._pending.items():
            rows = np.fromiter(chain.from_iterable([item[0] for item in waiting]), np.int64)
            owners = list(chain.from_iterable([item[1] for item in waiting]))
            x, y = np.repeat([item[2:] for item in waiting], [len(item[0]) for item in waiting], axis=0).T
            found = fill(owners, x, y, self.shared)
            one, (_, each), (_, head) = np.arange(len(rows)), found.floats.shape, found.heads.shape
            counts = np.broadcast_to(found.counts, len(rows))
            tails = np.cumsum(counts) - counts
            code[rows, 1] = sum(map(len, floats)) + each * one
            code[rows, 2] = sum(map(len, ints)) + head * one + tails
            floats.append(found.floats.astype(np.float32).ravel())
            ints.append(np.insert(found.tails, np.repeat(tails, head), found.heads.ravel()).astype(np.int32))
        return Programs(
            tuple([self._kinds[name][1] for name in names]),
            code,
            np.array(starts, np.int32),
            np.concatenate([*floats, np.zeros(1, np.float32)]),  # buffers must not be empty
            np.concatenate([*ints, np.zeros(1, np.int32)]),
            self.shared.buffer(),
            1 << max(2, (self._deepest + 1).bit_length()),  # in steps, so that few programs are compiled
            1 << max(1, (self._deepest_frame + 1).bit_length()),
        )


NOTHING = Kernel("tree_nothing", FOLDER / "basic.cl")
FROM_HOST = Kernel("tree_from_host", FOLDER / "basic.cl")


@dataclass(frozen=True, slots=True)
class Programs:
    """The programs of some tiles, as buffers.

    Attributes:
        kinds: of instructions that occur.
        code: (instructions, 4): which of the kinds, where its floats and integers begin, in which blocks it runs.
        starts: where in `code` each tile's program begins, and the end of the last.
        floats, ints, data: parameters, and the arrays that tiles share.
        stack, frames: how deep the stacks of pairs and of coordinates must be.
    """

    kinds: tuple[Kernel, ...]
    code: npt.NDArray[np.int32]
    starts: npt.NDArray[np.int32]
    floats: npt.NDArray[np.float32]
    ints: npt.NDArray[np.int32]
    data: npt.NDArray[np.float32]
    stack: int
    frames: int

    def compiled(self, device: Device, file: Path) -> Program:
        """Return the program of a kernel file that runs these (see ``kernels/machine.h``)."""
        return device.program(
            file,
            include=INCLUDE,
            before=sorted({kind.file for kind in self.kinds}),
            CASES=" ".join([f"CASE({position},{kind.name})" for position, kind in enumerate(self.kinds)]),
            STACK=self.stack,
            FRAMES=self.frames,
            TILE=TILE,
            BLOCK_COLUMNS=BLOCK[0],
            BLOCK_ROWS=BLOCK[1],
        )

    def buffers(self, device: Device) -> tuple[Any, ...]:
        """Return what `run_program` of ``kernels/machine.h`` reads, in its order, on a device."""
        return tuple([device.from_host(item) for item in (self.code, self.starts, self.floats, self.ints, self.data)])


def tile_programs(root: ElevationFunction, tiles: Iterable[Tile]) -> Programs:
    """Return for each tile the program of what it can see of a tree."""
    emitter, starts = Emitter(), [0]
    for tile in tiles:
        emitter.begin(tile)
        root.emit(emitter, tile.frame)
        starts.append(len(emitter))
    return emitter.programs(starts)


def sample_on_device(
    root: ElevationFunction,
    extent: Extent,
    shape: tuple[int, int],
    device: Device,
    context: Context,
    detail: Floats | float = 1.0,
    heaviest: float = math.inf,
) -> tuple[Any, Any]:
    """Sample a tree at the cell centres of a grid.

    Returns device arrays of height (NaN outside Omega_T) and weight.

    Args:
        root: the tree.
        extent: of the grid, m.
        shape: (rows, cols).
        device: where to compute.
        context: for progress and cancelling.
        detail: level of detail kappa, one or one per cell, (rows, cols).
        heaviest: what weights are held at; those of blends have no limit of their own.
    """
    rows, cols = shape
    programs = tile_programs(root, _tiles(extent, shape, detail, context))
    program, buffers = programs.compiled(device, TREE), programs.buffers(device)
    height, weight = device.empty(shape), device.empty(shape)
    dx, dy = extent.width / cols, extent.height / rows
    one = float(detail) if isinstance(detail, (int, float)) else 1.0
    many = None if isinstance(detail, (int, float)) else device.from_host(np.asarray(detail, np.float32))
    across, (wide, high) = -(-cols // TILE), BLOCK
    for first in range(0, rows, TILE * 4):
        count = min(TILE * 4, rows - first)
        context.progress(0.5 + 0.5 * first / rows)
        device.run(
            program, "sample", (across * (TILE // wide), -(-count // high) * high), *buffers, rows, cols, across, first,
            dx, dy, one, many, THRESHOLD, heaviest, height, weight, local_size=(1, high),
        )  # fmt: skip
        device.finish()
    return height, weight


def _tiles(extent: Extent, shape: tuple[int, int], detail: Floats | float, context: Context) -> Iterator[Tile]:
    """Yield the tiles of a grid, row by row."""
    rows, cols = shape
    dx, dy = extent.width / cols, extent.height / rows
    for top in range(0, rows, TILE):
        context.progress(0.5 * top / rows)
        for left in range(0, cols, TILE):
            high, wide = min(TILE, rows - top), min(TILE, cols - left)
            ox, oy = extent.west + left * dx, extent.north - top * dy
            frame = Frame(Box(ox, oy - high * dy, ox + wide * dx, oy), ox, oy, block=(BLOCK[0] * dx, BLOCK[1] * dy))
            level = detail if isinstance(detail, (int, float)) else detail[top : top + high, left : left + wide]
            yield Tile(frame, level, (high, wide), (dx, dy))
