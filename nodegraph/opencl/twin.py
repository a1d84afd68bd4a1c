"""Values to a device and back.

A value is a tree of port types, tuples, scalars and arrays (`nodegraph.codec`).  Here its arrays change sides and
everything else stays as it is: the same classes, scalars and strings, and what was shared stays shared.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from nodegraph.porttypes import field_names

if TYPE_CHECKING:
    from nodegraph.opencl.device import Device

T = TypeVar("T")


def on_device(value: T, device: Device) -> T:
    """Return `value` with its arrays on `device`, as read-only device arrays.

    On a device that shares the host's memory no C-contiguous array is copied.  Arrays of text or dates, for which
    OpenCL has no type, stay on the host; arrays that are on the device already stay as they are.

    Raises:
        DeviceError: the device cannot hold an array.
        TypeError: the value contains itself.
    """

    def move(array: Any) -> Any:
        if isinstance(array, np.ndarray):
            return device.from_host(array) if device.accepts(array.dtype) else array
        return array if array.context == device.context else device.from_host(_array_on_host(array))

    return _replace_arrays(value, move)


def on_host(value: T) -> T:
    """Return `value` with its arrays on the host, waiting for the kernels that make them.

    On a device that shares the host's memory nothing is copied: the arrays are the memory that the kernels wrote.

    Raises:
        DeviceError: a kernel failed, or the device is gone.
        TypeError: the value contains itself.
    """
    return _replace_arrays(value, lambda array: array if isinstance(array, np.ndarray) else _array_on_host(array))


def is_on_device(value: object) -> bool:
    """Say whether any array of `value` is a device array."""
    device_array = _device_array_type()
    if device_array is None:
        return False
    stack, seen = [value], set()
    while stack:
        item = stack.pop()
        if isinstance(item, device_array):
            return True
        parts = _parts(item)
        if parts and id(item) not in seen:
            seen.add(id(item))
            stack.extend(parts)
    return False


def _array_on_host(array: Any) -> Any:
    from nodegraph.opencl.buffers import to_host

    return to_host(array)


def _device_array_type() -> type | None:
    # While nobody has loaded pyopencl there can be no device arrays, and asking must not load it.
    module = sys.modules.get("pyopencl.array")
    return None if module is None else getattr(module, "Array", None)


def _parts(item: Any) -> tuple[Any, ...] | None:
    if type(item) is tuple:
        return item
    names = field_names(type(item))
    return None if names is None else tuple([getattr(item, name) for name in names])


def _replace_arrays(value: T, replace: Callable[[Any], Any]) -> T:
    # An explicit stack: a construction tree may be deeper than the interpreter's.
    device_array = _device_array_type()
    done: dict[int, Any] = {}
    open_items: set[int] = set()
    stack: list[tuple[Any, bool]] = [(value, False)]
    while stack:
        item, parts_done = stack.pop()
        key = id(item)
        if key in done:
            continue
        if isinstance(item, np.ndarray) or (device_array is not None and isinstance(item, device_array)):
            done[key] = replace(item)
            continue
        parts = _parts(item)
        if not parts:
            done[key] = item
        elif parts_done:
            open_items.discard(key)
            done[key] = _rebuild(item, parts, tuple([done[id(part)] for part in parts]))
        elif key in open_items:
            raise TypeError("a value must not contain itself")
        else:
            open_items.add(key)
            stack.append((item, True))
            stack.extend([(part, False) for part in parts])
    result: T = done[id(value)]
    return result


def _rebuild(item: Any, old: tuple[Any, ...], new: tuple[Any, ...]) -> Any:
    if all(a is b for a, b in zip(old, new, strict=True)):
        return item
    if type(item) is tuple:
        return new
    # The value was checked when it was first made: setting the fields skips __init__ and its checks.
    built = object.__new__(type(item))
    for name, part in zip(field_names(type(item)) or (), new, strict=True):
        object.__setattr__(built, name, part)
    return built
