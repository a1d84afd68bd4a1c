"""What pyopencl raises, as one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pyopencl as cl

from nodegraph.errors import DeviceError

_SMALLER = "use smaller data or another device"
_LOCAL = "give a smaller local size, or none"
_GONE = "the device is gone; start again, or without a device"

_CURES = {
    "MEM_OBJECT_ALLOCATION_FAILURE": _SMALLER,
    "OUT_OF_RESOURCES": _SMALLER,
    "OUT_OF_HOST_MEMORY": _SMALLER,
    "INVALID_BUFFER_SIZE": _SMALLER,
    "INVALID_WORK_GROUP_SIZE": _LOCAL,
    "INVALID_WORK_ITEM_SIZE": _LOCAL,
    "DEVICE_NOT_AVAILABLE": _GONE,
    "INVALID_COMMAND_QUEUE": _GONE,
    "INVALID_CONTEXT": _GONE,
}


@contextmanager
def guard(device: str, action: str) -> Iterator[None]:
    """Turn an error of pyopencl inside the block into a `DeviceError`.

    Args:
        device: the device's name, for the message.
        action: what the device could not do, as a verb: ``run kernel 'blur'``.
    """
    try:
        yield
    except cl.Error as error:
        raise _explain(device, action, error) from error


def _explain(device: str, action: str, error: cl.Error) -> DeviceError:
    codes: Any = cl.status_code
    code = str(codes.to_string(error.code, "error %d"))
    cure = _CURES.get(code)
    return DeviceError(f"OpenCL device '{device}' could not {action}: {code}" + (f"; {cure}" if cure else ""))
