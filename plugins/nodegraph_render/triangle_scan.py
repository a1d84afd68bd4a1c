"""How far a raster's samples lie above or below triangles between them.

Lattice points are (x, y) = (column, row), and triangles are counter-clockwise in these axes (clockwise from above, as
rows run south).  Which samples a triangle covers is decided in exact integers.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from nodegraph import Context

if TYPE_CHECKING:
    from nodegraph.opencl import Device

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
T = TypeVar("T", np.int64, np.float64)

KERNELS = Path(__file__).parent / "kernels" / "triangle_scan.cl"
GROUP = 16

HOST_SAMPLES = 1 << 18
"""Samples that are worked on at a time: their temporaries stay in the processor's cache."""

DEVICE_SAMPLES = 1 << 26
"""The same for a device, so that a cancel need not wait for more."""


class Spans(NamedTuple):
    """Runs of samples: of the triangle numbered `triangle`, in `row`, columns `first` to `last`."""

    triangle: Ints
    row: Ints
    first: Ints
    last: Ints


class Worst(NamedTuple):
    """Per triangle: the greatest vertical distance of a covered sample (-1: it covers none), and which sample."""

    error: Floats
    cell: Ints


def twice_area(x: npt.NDArray[T], y: npt.NDArray[T]) -> npt.NDArray[T]:
    """Return twice the signed area of triangles, (m, 3) columns and rows."""
    return (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])


def owned_edges(x: Ints, y: Ints, shape: tuple[int, int]) -> Flags:
    """Return, (m, 3), whether the samples on the edge from corner k to k + 1 belong to the triangle.

    Of the two triangles at an edge exactly one owns its samples; the raster's border belongs to whoever is there.
    """
    next_x, next_y = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    own = (next_y < y) | ((next_y == y) & (next_x > x))
    for line, last in ((x, shape[1] - 1), (y, shape[0] - 1)):
        following = np.roll(line, -1, axis=1)
        own |= (line == following) & ((line == 0) | (line == last))
    return np.asarray(own)


def spans(x: Ints, y: Ints, inclusive: Flags | None = None, *, unit: int = 1) -> Spans:
    """Return the runs of lattice points inside of triangles.

    Args:
        x, y: (m, 3) corners, whole numbers, in units of ``1 / unit`` lattice steps; counter-clockwise or empty.
        inclusive: (m, 3) whether the points on an edge count; None: all do.
        unit: parts of a lattice step that the corners are given in.
    """
    lowest = -(-y.min(axis=1) // unit)
    count = np.maximum(y.max(axis=1) // unit - lowest + 1, 0)
    triangle = np.repeat(np.arange(len(x)), count)
    row = np.arange(len(triangle)) + np.repeat(lowest - (np.cumsum(count) - count), count)
    first = np.repeat(-(-x.min(axis=1) // unit), count)
    last = np.repeat(x.max(axis=1) // unit, count)
    inside = np.ones(len(row), bool)
    for corner in range(3):
        xa, ya, xb, yb = x[:, corner], y[:, corner], x[:, (corner + 1) % 3], y[:, (corner + 1) % 3]
        dx, dy = xb - xa, yb - ya
        strict = 0 if inclusive is None else 1 - inclusive[:, corner].astype(np.int64)
        # Inside: dx (row - ya) - dy (column - xa) >= strict.  The quotients are exact where they are whole, and else
        # further from a whole number than a float64 can err.
        rest = (dx * unit)[triangle] * row + (dy * xa - dx * ya - strict)[triangle]
        rise = (dy * unit)[triangle]
        with np.errstate(divide="ignore", invalid="ignore"):
            limit = rest / rise
            np.minimum(last, np.floor(limit), out=last, where=rise > 0, casting="unsafe")
            np.maximum(first, np.ceil(limit), out=first, where=rise < 0, casting="unsafe")
        inside &= (rise != 0) | (rest >= 0)
    inside &= first <= last
    return Spans(triangle[inside], row[inside], first[inside], last[inside])


class Scan:
    """Measures the samples of a raster against triangles, on the context's device where it has double precision.

    Host and device give the same to the last bit.

    Args:
        heights: the raster, C-contiguous.
        context: the engine's.
    """

    def __init__(self, heights: npt.NDArray[np.float32], context: Context) -> None:
        self.heights = heights
        self._context = context
        device = context.device
        self._device = device if device is not None and "cl_khr_fp64" in device.context.devices[0].extensions else None
        self._on_device: Any = None if self._device is None else self._device.from_host(heights)

    def worst(
        self,
        x: Ints,
        y: Ints,
        *,
        least: npt.NDArray[np.float32] | None = None,
        inclusive: Flags | None = None,
        stride: Ints | None = None,
    ) -> Worst:
        """Return the greatest distance between the samples and the plane of each triangle, and where it is.

        Args:
            x, y: (m, 3) corners, counter-clockwise, not empty.
            least: (rows, columns) distances that samples have at least; with it heights may be NaN.
            inclusive: as in `spans`.
            stride: (m) look at every so manyth column and row only.
        """
        count = len(x)
        result = Worst(np.full(count, -1.0), np.full(count, -1, np.int64))
        work = twice_area(x, y) // 2 // (1 if stride is None else stride**2) + 4
        for part in _blocks(work, HOST_SAMPLES if self._device is None else DEVICE_SAMPLES):
            self._context.progress()
            some = _Some(
                x[part],
                y[part],
                None if inclusive is None else inclusive[part],
                None if stride is None else stride[part],
            )
            if self._device is None:
                found = _on_host(self.heights, least, some)
            else:
                found = self._run(self._device, least, some)
            result.error[part], result.cell[part] = found
        return result

    def _run(self, device: Device, least: npt.NDArray[np.float32] | None, some: _Some) -> Worst:
        count = len(some.x)
        x, y = (device.from_host(each) for each in (some.x, some.y))
        # What came from the host must not change, and the caller's `least` will.
        floor = None if least is None else device.from_host(least.copy())
        inclusive = None if some.inclusive is None else device.from_host(some.inclusive.astype(np.uint8))
        stride = None if some.stride is None else device.from_host(some.stride)
        error, cell = device.empty(count, np.float64), device.empty(count, np.int64)
        arguments = (self._on_device, floor, self.heights.shape[1], count, x, y, inclusive, stride, error, cell)
        device.run(KERNELS, "worst_samples", -(-count // GROUP) * GROUP, *arguments, local_size=GROUP)
        return Worst(device.to_host(error), device.to_host(cell))


class _Some(NamedTuple):
    """Some of the triangles."""

    x: Ints
    y: Ints
    inclusive: Flags | None
    stride: Ints | None


def _blocks(work: Ints, most: int) -> Iterator[slice]:
    """Yield consecutive ranges with about that much work each."""
    block = np.cumsum(work) // most
    starts = np.flatnonzero(np.diff(block, prepend=-1)).tolist()
    for first, stop in pairwise([*starts, len(work)]):
        yield slice(first, stop)


def _on_host(raster: npt.NDArray[np.float32], least: npt.NDArray[np.float32] | None, some: _Some) -> Worst:
    x, y, inclusive, stride = some
    cols, heights = raster.shape[1], raster.reshape(-1)
    triangle, row, first, last = spans(x, y, inclusive)
    step: Ints | None = None
    if stride is not None:
        kept = (row - y[:, 0][triangle]) % stride[triangle] == 0
        triangle, row, first, last = triangle[kept], row[kept], first[kept], last[kept]
        step = stride[triangle]
        length = (last - first) // step + 1
    else:
        length = last - first + 1
    worst = Worst(np.full(len(x), -1.0), np.full(len(x), -1, np.int64))
    if not len(row):
        return worst

    # The plane of a triangle: z = z0 + east (x - x0) + south (y - y0).
    corner = heights[y * cols + x].astype(np.float64)
    area = twice_area(x, y).astype(np.float64)
    x1, x2, y1, y2 = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0], y[:, 1] - y[:, 0], y[:, 2] - y[:, 0]
    z1, z2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    east, south = (z1 * y2 - z2 * y1) / area, (z2 * x1 - z1 * x2) / area
    slope = east[triangle]
    plane = corner[:, 0][triangle] + slope * (first - x[:, 0][triangle]) + south[triangle] * (row - y[:, 0][triangle])
    if step is not None:
        slope = slope * step

    ends = np.cumsum(length)
    begins = ends - length
    run = np.repeat(np.arange(len(row)), length)
    along = np.arange(int(ends[-1])) - begins[run]
    cell = (row * cols + first)[run] + (along if step is None else along * step[run])
    distance = np.abs(slope[run] * along + plane[run] - heights[cell])
    if least is not None:
        distance = np.fmax(distance, least.reshape(-1)[cell])

    of_run = np.maximum.reduceat(distance, begins)
    heads = np.flatnonzero(np.diff(triangle, prepend=-1))
    of_triangle = np.maximum.reduceat(of_run, heads)
    which = triangle[heads]
    worst.error[which] = of_triangle
    # The first run that reaches its triangle's greatest distance, and the first sample in it.
    reaching = np.flatnonzero(of_run == np.repeat(of_triangle, np.diff(heads, append=len(row))))
    reaching = reaching[np.diff(triangle[reaching], prepend=-1) != 0]
    length, begins = length[reaching], begins[reaching]
    ends = np.cumsum(length)
    places = np.arange(int(ends[-1])) + np.repeat(begins - (ends - length), length)
    hits = np.flatnonzero(distance[places] == np.repeat(of_run[reaching], length))
    owner = np.searchsorted(ends, hits, side="right")
    hits = hits[np.diff(owner, prepend=-1) != 0]
    worst.cell[triangle[reaching]] = cell[places[hits]]
    return worst
