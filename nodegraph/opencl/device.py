"""One OpenCL device, opened: its memory, its programs, and running kernels on it."""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl
import pyopencl.array as cla

from nodegraph.errors import DeviceError
from nodegraph.opencl import buffers
from nodegraph.opencl.arguments import bind
from nodegraph.opencl.devices import DeviceInfo, handle_of
from nodegraph.opencl.failures import guard
from nodegraph.opencl.programs import Define, Program, Programs
from nodegraph.opencl.timings import Timings


class Device:
    """An opened device; `nodegraph.opencl.choose` gives the one of the process.

    Any thread may call any method.  There is one in-order queue: what one thread enqueues after another has enqueued
    runs after it, so a value may be handed from thread to thread without waiting.  Kernels run behind the caller's
    back; `to_host` and `finish` wait, and only then does a failure inside a kernel show.

    Attributes:
        info: what the device says of itself.
        class_id: platform, device and driver version: devices of one class give the same results.
        context: the OpenCL context.
        queue: the in-order queue, with profiling.
        unified: whether arrays share the host's memory instead of being copied.
    """

    def __init__(self, info: DeviceInfo, *, unified: bool | None = None) -> None:
        """Open a listed device: a context and a queue of its own.

        Args:
            info: which one, from `list_devices`.
            unified: False copies arrays even where they could be shared (for tests of the other path); by default
                as the device says.

        Raises:
            DeviceError: the device cannot be opened.
        """
        self.info = info
        self.class_id = f"{info.platform} / {info.name} / {info.driver}"
        self.unified = info.unified if unified is None else unified
        handle = handle_of(info)
        with guard(info.name, "be opened"):
            self.context = cl.Context([handle])
            self.queue = cl.CommandQueue(self.context, properties=cl.command_queue_properties.PROFILING_ENABLE)
        self._memory = buffers.Memory(self.context, self.queue, info, self.unified)
        self._programs = Programs(self.context, info.name)
        self._timings: tuple[Timings, ...] = ()
        # Also at the interpreter's exit: kernels in flight must not outlive the NumPy memory that they write.
        weakref.finalize(self, _drain, self.queue)

    def __repr__(self) -> str:
        return f"<device {self.info}>"

    # Arrays.

    @property
    def bytes_alive(self) -> int:
        """Bytes of the arrays that were made on this device and live; shared host arrays do not count."""
        return self._memory.alive

    def accepts(self, dtype: np.dtype[Any]) -> bool:
        """Say whether an array of that dtype can be on the device: numbers and booleans, not text or dates."""
        return buffers.accepts(dtype)

    def empty(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike = np.float32) -> cla.Array:
        """Return a new C-contiguous array of undefined contents; an axis may be 0.

        Raises:
            DeviceError: there is no room; the message says how many bytes were wanted and how many are left.
        """
        return self._memory.empty(shape, dtype)

    def zeros(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike = np.float32) -> cla.Array:
        """Return a new array of zeros; else as `empty`."""
        return self._memory.zeros(shape, dtype)

    def empty_like(self, array: cla.Array | npt.NDArray[Any]) -> cla.Array:
        """Return a new array with the shape and dtype of `array`, C-contiguous; else as `empty`."""
        return self._memory.empty(array.shape, array.dtype)

    def from_host(self, array: npt.NDArray[Any]) -> cla.Array:
        """Return a NumPy array on the device, read-only: kernels take it where they declare ``const``.

        On a device that shares memory it is the same memory (the array is kept alive and must not change); an array
        that is not C-contiguous, not aligned to its elements or not of the machine's byte order is copied first.
        On any other device it is copied.

        Raises:
            DeviceError: there is no room, or OpenCL has no such type.
        """
        return self._memory.from_host(array)

    def to_host(self, array: cla.Array) -> npt.NDArray[Any]:
        """Return a device array as a NumPy array, waiting for what was enqueued before.

        On a device that shares memory the result is that memory: kernels that write the device array later change it.
        An array that came from the host unchanged comes back as the same object, where that still lives.

        Raises:
            DeviceError: a kernel failed, or the device is gone.
        """
        return buffers.to_host(array)

    # Kernels.

    @property
    def builds(self) -> int:
        """How often the compiler was called."""
        return self._programs.builds

    def program(
        self, path: Path, *, include: Sequence[Path] = (), before: Sequence[Path] = (), **defines: Define
    ) -> Program:
        """Return the program of a ``.cl`` file, compiled at most once per process for each contents and defines.

        Args:
            path: the kernel file; its ``#include "x"`` are looked up next to the including file, then in `include`.
            include: more folders with headers.
            before: files that stand before it in the same program, such as functions that it calls by name.
            defines: preprocessor definitions.  A float becomes a float literal (``0.5f``), a bool 0 or 1, a str stands
                as it is.

        Raises:
            DeviceError: a file cannot be read or compiled; the message says file, line and the compiler's first error.
        """
        return self._programs.get(path, include, defines, before)

    def run(
        self,
        program: Program | Path,
        kernel: str,
        global_size: int | tuple[int, ...],
        *args: Any,
        local_size: int | tuple[int, ...] | None = None,
        defines: Mapping[str, Define] | None = None,
        include: Sequence[Path] = (),
    ) -> cl.Event:
        """Enqueue a kernel and return its event, without waiting.

        Args:
            program: a kernel file, or what `program` returned.
            kernel: the kernel's name.
            global_size: work items per axis, the first one along a row: ``(cols, rows)`` for a raster.  An axis of 0
                runs nothing.
            args: device arrays, numbers, tuples of numbers for vectors, `Local` memory or None (a null pointer), held
                against the kernel's declaration.  A Python number becomes the declared type, where it fits; a NumPy
                scalar must have it.
            local_size: work items per group and axis, a divisor of `global_size`; by default the driver chooses.
            defines: as for `program`.
            include: as for `program`.

        Raises:
            DeviceError: the program cannot be compiled, an argument does not fit, or the device refuses.
        """
        if not isinstance(program, Program):
            program = self._programs.get(program, include, defines or {})
        elif defines or include:
            raise DeviceError(f"program {program.file} is compiled already; give defines and include to device.program")
        found = program.kernel(kernel)
        where = f"kernel '{kernel}' ({program.file})"
        handle = found.handle
        bound = bind(where, handle.num_args, found.parameters, args, self.context)
        size, group = _sizes(where, global_size, local_size)
        with guard(self.info.name, f"run {where}"):
            if 0 in size:
                return cl.enqueue_marker(self.queue)
            handle.set_args(*bound)
            event = cl.enqueue_nd_range_kernel(self.queue, handle, size, group)
            # Some drivers wait for more work before they start; the host has its own to do meanwhile.
            self.queue.flush()
            for timings in self._timings:
                timings.add(program.file, kernel, event)
        return event

    @contextmanager
    def timings(self) -> Iterator[Timings]:
        """Collect how long kernels take while the block runs, those of all threads; waits for them at its end.

        ``with device.timings() as timings: ...`` and then ``print(timings)``.  Only launches by `run` are collected,
        not the operators of arrays.
        """
        timings = Timings()
        self._timings = (*self._timings, timings)
        try:
            yield timings
        finally:
            self._timings = tuple([item for item in self._timings if item is not timings])
        self.finish()
        with guard(self.info.name, "time its kernels"):
            timings.rows()

    def finish(self) -> None:
        """Wait until everything enqueued so far is done.

        Raises:
            DeviceError: a kernel failed, or the device is gone.
        """
        with guard(self.info.name, "finish its work"):
            self.queue.finish()
        self._memory.finished()


def _sizes(
    where: str, global_size: int | tuple[int, ...], local_size: int | tuple[int, ...] | None
) -> tuple[tuple[int, ...], tuple[int, ...] | None]:
    size = _axes(global_size)
    if not 1 <= len(size) <= 3 or min(size) < 0:
        raise DeviceError(f"{where}: global size {global_size} must be one to three numbers, none negative")
    if local_size is None:
        return size, None
    group = _axes(local_size)
    if len(group) != len(size) or min(group) < 1:
        raise DeviceError(f"{where}: local size {local_size} must be {len(size)} positive numbers")
    if any(whole % part for whole, part in zip(size, group, strict=True)):
        fits = tuple([-(-whole // part) * part for whole, part in zip(size, group, strict=True)])
        raise DeviceError(
            f"{where}: global size {size} is no multiple of local size {group}; launch {fits} and return early outside"
        )
    return size, group


def _axes(size: int | tuple[int, ...]) -> tuple[int, ...]:
    return tuple([int(item) for item in size]) if isinstance(size, (tuple, list)) else (int(size),)


def _drain(queue: cl.CommandQueue) -> None:
    with suppress(cl.Error):
        queue.finish()
