"""Which OpenCL devices there are, and which one to use.

pyopencl is loaded inside the functions: a machine without it, or without any driver, simply has no devices.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

from nodegraph.errors import DeviceError

if TYPE_CHECKING:
    import pyopencl as cl

    from nodegraph.opencl.device import Device

log = logging.getLogger("nodegraph.opencl")

KINDS = ("gpu", "accelerator", "cpu")
"""The kinds of device, the one that ``auto`` likes best first."""

_opened: dict[int, Device] = {}
_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """What a device says of itself.

    Attributes:
        id: ``platform:device``, two indexes as the driver counts them; what a person types.
        platform: the platform's name.
        name: the device's name.
        kind: ``gpu``, ``accelerator`` or ``cpu``.
        version: the OpenCL version it speaks, with the driver's remarks.
        driver: the driver's version.
        compute_units: how many compute units (cores, multiprocessors) it has.
        memory: size of its global memory, bytes.  A CPU's driver may report less than it can use.
        largest_allocation: the most bytes one array may hold.
        unified: whether host and device share one memory.
    """

    id: str
    platform: str
    name: str
    kind: str
    version: str
    driver: str
    compute_units: int
    memory: int
    largest_allocation: int
    unified: bool

    def __str__(self) -> str:
        return f"{self.id} {self.name} ({self.kind}, {self.compute_units} compute units, {size_text(self.memory)})"


def list_devices() -> list[DeviceInfo]:
    """Return every OpenCL device of this machine, by id.

    Never raises: without pyopencl, a driver or a device the list is empty, and a driver that fails is left out.
    """
    return [info for info, _ in _physical()]


def choose(spec: str = "auto") -> Device | None:
    """Return the device that `spec` asks for, opened once per process and shared by all threads.

    Args:
        spec: ``auto`` (a GPU before an accelerator before a CPU, the largest memory first; None where there is no
            device), ``none`` (no device: None) or an id such as ``0:1`` from `list_devices`.

    Raises:
        DeviceError: there is no such device, or it cannot be opened; the message lists the valid ones.
    """
    if spec == "none":
        return None
    found = _physical()
    if spec != "auto":
        for info, handle in found:
            if info.id == spec:
                return _open(info, handle)
        known = ", ".join([f"'{info.id}' ({info.name})" for info, _ in found])
        raise DeviceError(
            f"there is no OpenCL device '{spec}'; use 'auto', 'none'" + (f" or one of {known}" if known else "")
        )
    for info, handle in sorted(found, key=lambda item: (KINDS.index(item[0].kind), -item[0].memory)):
        try:
            return _open(info, handle)
        except DeviceError as error:
            log.warning("%s; trying the next device", error)
    return None


def size_text(nbytes: float) -> str:
    """Return a number of bytes for a person.

    >>> size_text(3_500_000_000), size_text(512)
    ('3.5 GB', '512 bytes')
    """
    for unit in ("TB", "GB", "MB", "kB"):
        scale = 1000 ** (1 + ("kB", "MB", "GB", "TB").index(unit))
        if nbytes >= scale:
            return f"{nbytes / scale:.3g} {unit}" if nbytes < 1000 * scale else f"{nbytes / scale:.0f} {unit}"
    return f"{nbytes:.0f} bytes"


def handle_of(info: DeviceInfo) -> cl.Device:
    """Return the driver's object for a listed device.  Raises `DeviceError` when the device is no longer there."""
    for known, handle in _physical():
        if known.id == info.id and known.name == info.name:
            return handle
    raise DeviceError(f"OpenCL device '{info.id}' ({info.name}) is no longer there; list the devices again")


def _open(info: DeviceInfo, handle: cl.Device) -> Device:
    from nodegraph.opencl.device import Device

    with _lock:
        device = _opened.get(handle.int_ptr)
        if device is None:
            device = _opened[handle.int_ptr] = Device(info)
        return device


def _physical() -> list[tuple[DeviceInfo, cl.Device]]:
    # Drivers fail in ways of their own (a missing library, a version they refuse, a GPU that fell off the bus), and
    # none of them may stop a program that can do without OpenCL.
    try:
        import pyopencl as cl

        platforms = cl.get_platforms()
    except Exception as error:
        log.debug("no OpenCL: %s", error)
        return []
    found = []
    for p, platform in enumerate(platforms):
        try:
            handles = platform.get_devices()
        except Exception as error:
            log.debug("OpenCL platform %d has no devices: %s", p, error)
            continue
        for d, handle in enumerate(handles):
            try:
                found.append((_describe(f"{p}:{d}", platform, handle), handle))
            except Exception as error:
                log.warning("OpenCL device '%d:%d' does not answer and is left out: %s", p, d, error)
    return found


def _describe(identity: str, platform: cl.Platform, handle: cl.Device) -> DeviceInfo:
    import pyopencl as cl

    bits = {"gpu": cl.device_type.GPU, "accelerator": cl.device_type.ACCELERATOR, "cpu": cl.device_type.CPU}
    return DeviceInfo(
        id=identity,
        platform=platform.name.strip(),
        name=handle.name.strip(),
        kind=next((kind for kind, bit in bits.items() if handle.type & bit), "accelerator"),
        version=handle.version.strip(),
        driver=handle.driver_version.strip(),
        compute_units=handle.max_compute_units,
        memory=handle.global_mem_size,
        largest_allocation=handle.max_mem_alloc_size,
        unified=bool(handle.host_unified_memory),
    )
