"""Sampling on OpenCL: for each tile of the raster a short program of what the tile can see.

The host walks the tree once per tile and drops what does not reach it; what is left becomes a list of instructions
for a stack machine in ``kernels/tree.cl``, with all parameters in buffers.  Editing a parameter therefore never
recompiles: a program is compiled for each *set of kinds* of instruction, and a third party's kinds join through
`Kernel`.

**Precision.**  Coordinates on the device are float32 offsets from an origin that the host keeps in float64 (`Frame`):
the tile's corner, carried through every transform.  Parameters are made relative to it in float64, so that a sample
200 km from the scene's origin is as exact as one beside it.

**Instructions.**  A function ``void name(State *s, P p, N n, D data)`` in a ``.cl`` file (see ``kernels/tree.h``):
`p` and `n` point to the float and integer parameters that `Emitter.add` was given, `data` to the arrays of
`Emitter.shared`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

import nodegraph_terrain
from nodegraph import Context
from nodegraph_terrain.raster import Extent
from nodegraph_tree.function import THRESHOLD, Box, ElevationFunction, Floats, Points

if TYPE_CHECKING:
    from nodegraph.opencl import Device

FOLDER = Path(__file__).with_name("kernels")
TREE = FOLDER / "tree.cl"
INCLUDE = (FOLDER, Path(nodegraph_terrain.__file__).parent)
TILE = 64
"""Samples along the side of a tile."""


@dataclass(frozen=True, slots=True)
class Kernel:
    """An instruction: the name of its function and the file that defines it."""

    name: str
    file: Path


class Frame(NamedTuple):
    """The samples of a tile in the coordinates of a node: position = (ox, oy) + linear . offset in the tile, float64.

    `box` lies around them; what does not reach it need not be emitted.
    """

    box: Box
    ox: float
    oy: float
    linear: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)

    def carried(self, matrix: tuple[float, float, float, float], shift: tuple[float, float]) -> Frame:
        """Return the frame in the coordinates q = matrix . p + shift."""
        a, b, c, d = matrix
        e, f, g, h = self.linear
        corners = [(x, y) for x in (self.box.west, self.box.east) for y in (self.box.south, self.box.north)]
        xs = [a * x + b * y + shift[0] for x, y in corners]
        ys = [c * x + d * y + shift[1] for x, y in corners]
        return Frame(
            Box(min(xs), min(ys), max(xs), max(ys)),
            a * self.ox + b * self.oy + shift[0],
            c * self.ox + d * self.oy + shift[1],
            (a * e + b * g, a * f + b * h, c * e + d * g, c * f + d * h),
        )


@dataclass(slots=True)
class Shared:
    """Arrays that all tiles of one sampling share, such as the pixels of an image: stored once."""

    places: dict[int, int] = field(default_factory=dict)
    arrays: list[npt.NDArray[np.float32]] = field(default_factory=list)
    size: int = 0
    kept: list[Any] = field(default_factory=list)

    def place(self, array: npt.NDArray[Any]) -> int:
        """Return where an array begins in the shared buffer, adding it the first time."""
        if id(array) not in self.places:
            self.places[id(array)] = self.size
            self.kept.append(array)  # an id must not be used again
            self.arrays.append(np.ascontiguousarray(array, np.float32).ravel())
            self.size += array.size
        return self.places[id(array)]

    def buffer(self) -> npt.NDArray[np.float32]:
        """Return all arrays as one."""
        return np.concatenate(self.arrays) if self.arrays else np.zeros(1, np.float32)


class Pending(NamedTuple):
    """Integer parameters that are computed for all tiles at once, when the last is emitted.

    ``fill(owners, x, y)`` gets every pending owner of that function with its coordinates (float64) and returns the
    parameters of all of them, one after the other; `size` says how many this owner has.
    """

    fill: Callable[[Sequence[Any], Floats, Floats], npt.NDArray[np.int32]]
    owner: Any
    x: float
    y: float
    size: int


class Emitter:
    """Collects the instructions of the tiles of one sampling.

    Attributes:
        detail: the level of detail of the tile at hand, a number or an array like the offsets.
    """

    def __init__(self) -> None:
        self.kernels: dict[str, tuple[Kernel, int]] = {}
        self.code: list[tuple[int, int, int, int]] = []
        self.floats: list[float] = []
        self.ints: list[int] = []
        self.shared = Shared()
        self.offsets: tuple[Floats, Floats] = (np.zeros(0), np.zeros(0))
        self.detail: Floats | float = 1.0
        self._pending: dict[Any, list[tuple[int, Pending]]] = {}
        self._level = self._deepest = self._frames = self._deepest_frame = 0

    def add(
        self, kernel: Kernel, floats: Iterable[float] = (), ints: Iterable[int | Pending] = (), *, pushes: int = 1
    ) -> None:
        """Append an instruction.

        Args:
            kernel: what to do.
            floats, ints: its parameters, rounded to float32 and int32.
            pushes: how many (f, alpha) pairs it leaves on the stack more than it takes.
        """
        known = self.kernels.get(kernel.name)
        if known is None:
            known = self.kernels[kernel.name] = (kernel, len(self.kernels))
        self.code.append((known[1], len(self.floats), len(self.ints), 0))
        self.floats.extend(floats)
        words = self.ints
        for item in ints:
            if isinstance(item, Pending):
                self._pending.setdefault(item.fill, []).append((len(words), item))
                words.extend([0] * item.size)
            else:
                words.append(item)
        self._level += pushes
        if self._level > self._deepest:
            self._deepest = self._level

    def nothing(self) -> None:
        """Append an instruction that leaves (0, 0): nothing reaches the tile."""
        self.add(NOTHING)

    def enter(self, kernel: Kernel, floats: Iterable[float] = (), ints: Iterable[int | Pending] = ()) -> None:
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
        x, y = self.offsets
        a, b, c, d = frame.linear
        points = Points(
            (frame.ox + a * x + b * y).ravel(),
            (frame.oy + c * x + d * y).ravel(),
            self.detail if isinstance(self.detail, (int, float)) else self.detail.ravel(),
        )
        sample = node.query(points)
        shape = (TILE, TILE)
        rows, cols = x.shape
        pair = np.zeros((2, *shape), np.float32)
        pair[0, :rows, :cols] = sample.height.reshape(x.shape)
        pair[1, :rows, :cols] = sample.weight.reshape(x.shape)
        self.add(FROM_HOST, ints=[self.shared.place(pair)])

    def end(self) -> int:
        """End the program of a tile and return how many instructions all programs have now."""
        self._level = 0
        return len(self.code)

    def words(self) -> npt.NDArray[np.int32]:
        """Return the integer parameters of all instructions, pending ones computed."""
        words = np.array(self.ints or [0], np.int32)
        for fill, waiting in self._pending.items():
            xs, ys = np.array([(item.x, item.y) for _, item in waiting]).T
            filled = fill([item.owner for _, item in waiting], xs, ys)
            places, counts = np.array([(place, item.size) for place, item in waiting]).T
            ends = np.cumsum(counts)
            starts = np.repeat(places - (ends - counts), counts)
            words[starts + np.arange(ends[-1])] = filled
        return words

    @property
    def stack(self) -> int:
        """How many pairs the stack must hold, in steps so that few programs are compiled."""
        return 1 << max(2, (self._deepest + 1).bit_length())

    @property
    def frames(self) -> int:
        """How many coordinates must be held at the same time, in steps."""
        return 1 << max(1, (self._deepest_frame + 1).bit_length())


NOTHING = Kernel("tree_nothing", FOLDER / "basic.cl")
FROM_HOST = Kernel("tree_from_host", FOLDER / "basic.cl")


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
    emitter = Emitter()
    starts = [0]
    for frame, part in _tiles(extent, shape, emitter, detail):
        context.progress(0.5 * part)
        root.emit(emitter, frame)
        starts.append(emitter.end())
    names = sorted(emitter.kernels)
    order = {emitter.kernels[name][1]: position for position, name in enumerate(names)}
    code = np.array(emitter.code, np.int32).reshape(-1, 4)
    code[:, 0] = [order[number] for number in code[:, 0].tolist()]
    files = sorted({emitter.kernels[name][0].file for name in names})
    program = device.program(
        TREE,
        include=INCLUDE,
        before=files,
        CASES=" ".join([f"CASE({position},{name})" for position, name in enumerate(names)]),
        STACK=emitter.stack,
        FRAMES=emitter.frames,
        TILE=TILE,
    )
    height, weight = device.empty(shape), device.empty(shape)
    dx, dy = extent.width / cols, extent.height / rows
    one = float(detail) if isinstance(detail, (int, float)) else 1.0
    many = None if isinstance(detail, (int, float)) else device.from_host(np.asarray(detail, np.float32))
    buffers = (
        device.from_host(code),
        device.from_host(np.array(starts, np.int32)),
        device.from_host(np.array(emitter.floats or [0.0], np.float32)),
        device.from_host(emitter.words()),
        device.from_host(emitter.shared.buffer()),
    )
    across = -(-cols // TILE)
    for first in range(0, rows, TILE * 4):
        count = min(TILE * 4, rows - first)
        context.progress(0.5 + 0.5 * first / rows)
        device.run(
            program, "sample", (across * TILE // 8, count), *buffers, rows, cols, across, first, dx, dy, one, many,
            THRESHOLD, heaviest, height, weight, local_size=(TILE // 8, 1),
        )  # fmt: skip
        device.finish()
    return height, weight


def _tiles(
    extent: Extent, shape: tuple[int, int], emitter: Emitter, detail: Floats | float
) -> Iterator[tuple[Frame, float]]:
    """Yield the frame of every tile, row by row, with the share of those done; set the emitter to it."""
    rows, cols = shape
    dx, dy = extent.width / cols, extent.height / rows
    for top in range(0, rows, TILE):
        for left in range(0, cols, TILE):
            high, wide = min(TILE, rows - top), min(TILE, cols - left)
            ox, oy = extent.west + left * dx, extent.north - top * dy
            x, y = (np.arange(wide) + 0.5) * dx, -(np.arange(high) + 0.5) * dy
            emitter.offsets = (np.broadcast_to(x, (high, wide)), np.broadcast_to(y[:, None], (high, wide)))
            if not isinstance(detail, (int, float)):
                emitter.detail = np.asarray(detail)[top : top + high, left : left + wide]
            else:
                emitter.detail = detail
            yield Frame(Box(ox, oy - high * dy, ox + wide * dx, oy), ox, oy), top / rows
