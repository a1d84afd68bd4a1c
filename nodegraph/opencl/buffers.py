"""A device's memory: arrays on it, and the way between NumPy and them.

On a device that shares the host's memory every array lies in NumPy memory that OpenCL is told to use
(``CL_MEM_USE_HOST_PTR``): going either way copies nothing.  On any other device arrays are copied.

OpenCL keeps its own buffers until the commands that use them are done, but it does not know who owns the host memory
behind them.  So when such a buffer dies, its memory is kept until a marker, put behind everything that was enqueued
before, has been reached.
"""

from __future__ import annotations

import os
import threading
import weakref
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl
import pyopencl.array as cla

from nodegraph.errors import DeviceError
from nodegraph.opencl.devices import DeviceInfo, size_text
from nodegraph.opencl.failures import guard

HostArray = npt.NDArray[Any]

ALIGNMENT = 4096
"""Alignment of the arrays that a device with shared memory makes, bytes: a page, which integrated GPUs ask for."""

_WORTH_ASKING = 16 << 20
"""From this many bytes on the host is asked what memory it has left: asking takes some 50 microseconds."""


class Buffer(cl.Buffer):
    """An OpenCL buffer that knows the host memory behind it.

    Attributes:
        memory: the device memory that it was taken from.
        host: the shared NumPy memory, C-contiguous; None where host and device do not share.
        source: the array it was made from, as a reference that may have died; None for a result.
        read_only: whether kernels may only read it.
    """

    memory: Memory
    host: HostArray | None = None
    source: Callable[[], HostArray | None] | None = None
    read_only: bool = False


class Memory:
    """The memory of one device: what is alive on it, and new arrays.  Any thread may use it."""

    def __init__(self, context: cl.Context, queue: cl.CommandQueue, info: DeviceInfo, unified: bool) -> None:
        self.info = info
        self.unified = unified
        self._context = context
        self.queue = queue
        self._lock = threading.Lock()
        self._alive = 0
        # Filled by finalizers, which may run at any moment in any thread, also in one that holds the lock: appending to
        # a deque is all they do.
        self._dead: deque[tuple[int, cl.Event | None, HostArray | None]] = deque()

    @property
    def alive(self) -> int:
        """Bytes of the arrays made here that live, or may still be used by a running kernel."""
        with self._lock:
            self._bury()
            return self._alive

    def empty(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> cla.Array:
        """Return a new array of undefined contents.  Raises `DeviceError` when there is no room."""
        return self._array(shape, dtype, None)

    def zeros(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> cla.Array:
        """Return a new array of zeros.  Raises `DeviceError` when there is no room."""
        shape = (shape,) if isinstance(shape, int) else tuple(shape)
        nbytes = prod(shape) * np.dtype(dtype).itemsize
        return self._array(shape, dtype, self.allocate(nbytes, zero=True) if nbytes else None)

    def allocate(self, nbytes: int, *, zero: bool = False) -> Buffer:
        """Return a new buffer of `nbytes` > 0 bytes; also what `pyopencl.array` calls for the results of operators.

        Raises:
            DeviceError: the device, or the host where they share memory, has not that many bytes left.
        """
        nbytes = int(nbytes)
        self._reserve(nbytes)
        try:
            with guard(self.info.name, f"allocate {size_text(nbytes)}"):
                if self.unified:
                    host = _page_aligned(nbytes, zero)
                    buffer = Buffer(self._context, cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR, hostbuf=host)
                else:
                    host = None
                    buffer = Buffer(self._context, cl.mem_flags.READ_WRITE, nbytes)
                    if zero:
                        cl.enqueue_fill_buffer(self.queue, buffer, np.zeros(1, np.uint8), 0, nbytes)
        except BaseException:
            self._dead.append((nbytes, None, None))
            raise
        self._adopt(buffer, nbytes, host)
        return buffer

    def from_host(self, array: npt.ArrayLike) -> cla.Array:
        """Return `array` on the device, read-only; shared where the device shares memory, else copied.

        An array that is not C-contiguous, aligned and of the machine's byte order is copied first.
        """
        given = np.asarray(array)
        if not accepts(given.dtype):
            raise DeviceError(f"OpenCL has no type for an array of dtype {given.dtype}; keep it on the host")
        ready = given
        if not (given.flags.c_contiguous and given.flags.aligned and given.dtype.isnative):
            ready = np.array(given, dtype=given.dtype.newbyteorder("="), order="C", subok=False)
        if not ready.nbytes:
            return self._array(ready.shape, ready.dtype, None)
        buffer = self._share(ready, copied=ready is not given) if self.unified else self._upload(ready)
        buffer.read_only = True
        if self.unified:
            buffer.source = _always(ready)
        elif not given.flags.writeable and ready is given:
            # Sealed, so what lies here can be found again there; a weak reference, so that it may be let go.
            buffer.source = weakref.ref(given)
        return self._array(ready.shape, ready.dtype, buffer)

    def finished(self) -> None:
        """Let go of everything that died; call it when the queue is empty."""
        with self._lock:
            self._bury()

    def _share(self, array: HostArray, *, copied: bool) -> Buffer:
        # What the caller holds already takes no memory of its own here.
        nbytes = array.nbytes if copied else 0
        self._reserve(array.nbytes, takes=nbytes, asks_host=False)
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.USE_HOST_PTR
        try:
            with guard(self.info.name, f"share an array of {size_text(array.nbytes)}"):
                buffer = Buffer(self._context, flags, hostbuf=array)
        except BaseException:
            self._dead.append((nbytes, None, None))
            raise
        self._adopt(buffer, nbytes, array)
        return buffer

    def _upload(self, array: HostArray) -> Buffer:
        buffer = self.allocate(array.nbytes)
        with guard(self.info.name, f"receive an array of {size_text(array.nbytes)}"):
            cl.enqueue_copy(self.queue, buffer, array, is_blocking=True)
        return buffer

    def _array(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike, buffer: Buffer | None) -> cla.Array:
        shape = (shape,) if isinstance(shape, int) else tuple(map(int, shape))
        return cla.Array(self.queue, shape, np.dtype(dtype), allocator=self.allocate, data=buffer)

    def _adopt(self, buffer: Buffer, nbytes: int, host: HostArray | None) -> None:
        buffer.memory = self
        buffer.host = host
        weakref.finalize(buffer, _mourn, self.queue, self._dead, nbytes, host).atexit = False

    def _reserve(self, nbytes: int, *, takes: int | None = None, asks_host: bool = True) -> None:
        takes = nbytes if takes is None else takes
        name = self.info.name
        if nbytes > self.info.largest_allocation:
            raise DeviceError(
                f"OpenCL device '{name}' takes arrays of up to {size_text(self.info.largest_allocation)} and was asked "
                f"for {size_text(nbytes)}; use smaller data or another device"
            )
        with self._lock:
            self._bury()
            if takes > self._room(takes, asks_host):
                # What died may still be waiting for kernels in flight.
                with guard(name, "finish its work"):
                    self.queue.finish()
                self._bury()
                if takes > (room := self._room(takes, asks_host)):
                    raise DeviceError(
                        f"OpenCL device '{name}' has {size_text(max(0, room))} of memory left and was asked for "
                        f"{size_text(takes)}; use smaller data or another device"
                    )
            self._alive += takes

    def _room(self, takes: int, asks_host: bool) -> float:
        # A CPU's memory is the host's, whatever its driver reports (PoCL reports a part and serves the whole).
        room: float = float("inf") if self.unified and self.info.kind == "cpu" else self.info.memory - self._alive
        if self.unified and asks_host and takes >= _WORTH_ASKING:
            room = min(room, host_memory_left())
        return room

    def _bury(self) -> None:
        while self._dead:
            nbytes, marker, _ = self._dead[0]
            if marker is not None and _is_pending(marker):
                break
            self._dead.popleft()
            self._alive -= nbytes


def accepts(dtype: np.dtype[Any]) -> bool:
    """Say whether OpenCL has a type for the elements: numbers of up to 8 bytes (complex: 16) and booleans."""
    return dtype.kind in "biufc" and dtype.itemsize <= (16 if dtype.kind == "c" else 8)


def to_host(array: cla.Array) -> HostArray:
    """Return a device array as a NumPy array, waiting for the kernels that write it.

    Where host and device share memory it is that memory itself, not a copy: later kernels that write the device array
    write it too.

    Raises:
        DeviceError: a kernel failed, or the device is gone.
    """
    buffer = array.base_data
    if array.size == 0 or buffer is None:
        return np.empty(array.shape, array.dtype)
    if isinstance(buffer, Buffer):
        source = None if buffer.source is None else buffer.source()
        if source is not None and _is_whole(array, source):
            return source
        with guard(buffer.memory.info.name, f"return an array of {size_text(array.nbytes)}"):
            if buffer.host is None:
                return _download(array, buffer, buffer.memory.queue)
            if not buffer.read_only:
                _synchronise(buffer, buffer.memory.queue)
            return np.ndarray(array.shape, array.dtype, buffer.host, array.offset, array.strides)
    if not isinstance(buffer, cl.Buffer) or array.queue is None:
        raise DeviceError("this device array was not made by nodegraph.opencl and has no buffer or queue of its own")
    with guard(array.queue.device.name, f"return an array of {size_text(array.nbytes)}"):
        return _download(array, buffer, array.queue)


def host_memory_left() -> float:
    """Return the bytes of memory that this process may still take, infinity where nobody says."""
    figures: list[float] = [float("inf")]
    with suppress(OSError, ValueError, IndexError):
        meminfo = Path("/proc/meminfo").read_text()
        figures.append(1024 * int(meminfo.split("MemAvailable:")[1].split()[0]))
    if len(figures) == 1:
        with suppress(OSError, ValueError, AttributeError):
            figures.append(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    # A container may be given less than the machine has; the page cache counts as used there, but yields.
    for folder, limit, usage, cache in (
        ("/sys/fs/cgroup", "memory.max", "memory.current", "inactive_file "),
        ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file "),
    ):
        with suppress(OSError, ValueError, IndexError):
            most, used = (int(Path(folder, name).read_text()) for name in (limit, usage))
            figures.append(most - used + int(Path(folder, "memory.stat").read_text().split(cache)[1].split()[0]))
    return min(figures)


def _synchronise(buffer: cl.Buffer, queue: cl.CommandQueue) -> None:
    # Mapping is what makes shared memory hold the results, by the standard; unmapping hands the memory back.
    flat, _ = cl.enqueue_map_buffer(queue, buffer, cl.map_flags.READ, 0, (buffer.size,), np.dtype(np.uint8))
    flat.base.release(queue)


def _download(array: cla.Array, buffer: cl.Buffer, queue: cl.CommandQueue) -> HostArray:
    if array.flags.c_contiguous:
        result = np.empty(array.shape, array.dtype)
        cl.enqueue_copy(queue, result, buffer, src_offset=array.offset, is_blocking=True)
        return result
    memory = np.empty(buffer.size, np.uint8)
    cl.enqueue_copy(queue, memory, buffer, is_blocking=True)
    return np.ndarray(array.shape, array.dtype, memory, array.offset, array.strides)


def _is_whole(array: cla.Array, source: HostArray) -> bool:
    return (
        array.offset == 0
        and array.shape == source.shape
        and array.dtype == source.dtype
        and tuple(array.strides) == source.strides
    )


def _page_aligned(nbytes: int, zero: bool) -> HostArray:
    try:
        memory = (np.zeros if zero else np.empty)(nbytes + ALIGNMENT, np.uint8)
    except MemoryError as error:
        raise DeviceError(f"the host has not the {size_text(nbytes)} left that a device array needs") from error
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + nbytes]


def _always(array: HostArray) -> Callable[[], HostArray]:
    return lambda: array


def _is_pending(marker: cl.Event) -> bool:
    # A negative status is an error: whatever was to come does not come any more.
    try:
        return marker.command_execution_status > 0
    except cl.Error:
        return False


def _mourn(
    queue: cl.CommandQueue,
    dead: deque[tuple[int, cl.Event | None, HostArray | None]],
    nbytes: int,
    host: HostArray | None,
) -> None:
    marker = None
    # A device that is gone has nothing in flight that could still need the memory.
    with suppress(cl.Error):
        marker = cl.enqueue_marker(queue)
    dead.append((nbytes, marker, host))
