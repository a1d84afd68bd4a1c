"""OpenCL: devices, programs, memory, and values that hold device arrays.

Importing this package costs nothing and needs no OpenCL: pyopencl is loaded when a device is first asked for, and where
it, or any device, is missing, `list_devices` is empty and `choose("auto")` is None.

A twin gets its device from the context and its rasters' arrays as device arrays::

    KERNELS = Path(__file__).with_name("smooth.cl")

    @gaussian_smooth.opencl(rtol=1e-5)
    def _(surface: Elevation, *, sigma: float, context: Context) -> Elevation:
        device = context.device
        out = device.empty_like(surface.data)
        rows, cols = surface.shape
        device.run(KERNELS, "smooth", (cols, rows), surface.data, out, sigma)
        return surface.like(out)

**Writing kernels.**  `Device.run` checks every argument against the kernel's own declaration, so say what you mean:

- An input is ``__global const float*``.  Arrays that came from the host are inputs: a kernel that declares one without
  ``const`` is refused, because on a CPU device the array *is* the host's memory, which others read.  An assignment from
  Python (``surface.data += 1``, ``surface.data[0] = 1``) cannot be refused, so never write one to an input.
- Assume the alignment of the element, nothing more.  Host memory is shared as it lies (NumPy aligns to 16 bytes, a
  window of a raster to 4), so read and write vectors with ``vloadN`` and ``vstoreN``; a cast to ``float4*`` or wider
  crashes.
- Arrays are C-contiguous, row 0 north.  Launch over ``(cols, rows)``, so that ``get_global_id(0)`` walks along a row.
- NaN is a void.  The compiler options keep NaN and infinity meaningful; do not rely on ``-cl-fast-relaxed-math``.
- ``#include "noise.h"`` finds a header next to the file that includes it; editing it rebuilds the program.
- What varies from run to run is an argument; ``defines`` are for what the compiler should know, and each set of them is
  a program of its own.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nodegraph.opencl import twin
    from nodegraph.opencl.arguments import Local as Local
    from nodegraph.opencl.device import Device as Device
    from nodegraph.opencl.devices import DeviceInfo as DeviceInfo
    from nodegraph.opencl.devices import choose as choose
    from nodegraph.opencl.devices import list_devices as list_devices
    from nodegraph.opencl.programs import Program as Program
    from nodegraph.opencl.programs import source_files as source_files
    from nodegraph.opencl.timings import KernelTiming as KernelTiming
    from nodegraph.opencl.timings import Timings as Timings
    from nodegraph.opencl.twin import is_on_device as is_on_device

    to_device = twin.on_device
    to_host = twin.on_host

_HOME = {
    "Device": ("device", "Device"),
    "DeviceInfo": ("devices", "DeviceInfo"),
    "KernelTiming": ("timings", "KernelTiming"),
    "Local": ("arguments", "Local"),
    "Program": ("programs", "Program"),
    "Timings": ("timings", "Timings"),
    "choose": ("devices", "choose"),
    "is_on_device": ("twin", "is_on_device"),
    "list_devices": ("devices", "list_devices"),
    "source_files": ("programs", "source_files"),
    "to_device": ("twin", "on_device"),
    "to_host": ("twin", "on_host"),
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'nodegraph.opencl' has no attribute '{name}'")
    module, attribute = _HOME[name]
    value = getattr(importlib.import_module(f"nodegraph.opencl.{module}"), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
