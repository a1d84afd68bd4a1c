"""Port types: what may travel on a wire.

A port type is a frozen dataclass whose fields hold arrays, scalars, strings, tuples of these and other port types.
From its fields alone the engine derives the content digest, the read-only freeze and the HDF5 encoding
(`nodegraph.codec`), so a new type costs no storage code.  A subclass may travel wherever its base may.

Values of some types are functions: a terrain that can be asked anywhere.  What they give is the code of their class as
much as their fields.  Such a class says ``computes: ClassVar[bool] = True``, and the digest of its values covers that
code, so that whatever used them is computed again when it changes.

The scalars `bool`, `int`, `float` and `str` and plain `numpy.ndarray` are port types too.

>>> @port_type
... class Track:
...     '''A walked line, (n, 2) metres.'''
...     points: np.ndarray
...     name: str = ""
>>> describe(Track)
'Track'
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterator
from typing import Any, TypeVar, dataclass_transform

import numpy as np

from nodegraph.errors import PluginError

T = TypeVar("T", bound=type)

BUILTIN: dict[str, type] = {"Boolean": bool, "Integer": int, "Number": float, "Text": str, "Array": np.ndarray}
"""The port types that need no declaration, by name."""

_by_key: dict[str, type] = dict(BUILTIN)
_keys: dict[type, str] = {cls: name for name, cls in BUILTIN.items()}
_fields: dict[type, tuple[str, ...]] = {}


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def port_type(cls: T) -> T:
    """Declare a class as a port type: make it a frozen dataclass and register it.

    Two plugins may use one name: values are stored under the full name, with the module.  Declaring the same class
    again (a reloaded module, a notebook cell) replaces the earlier declaration.

    Raises:
        PluginError: the class is a dataclass already, and not a frozen one.
    """
    if "__dataclass_params__" not in cls.__dict__:
        cls = dataclasses.dataclass(frozen=True, eq=False)(cls)  # type: ignore[assignment]
    if not cls.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise PluginError(f"port type '{cls.__name__}' ({cls.__module__}): must be a frozen dataclass")
    key = f"{cls.__module__}.{cls.__qualname__}"
    _by_key[key] = cls
    _keys[cls] = key
    _fields[cls] = tuple(field.name for field in dataclasses.fields(cls))
    return cls


def is_port_type(cls: object) -> bool:
    """Say whether values of `cls` may travel on a wire."""
    return isinstance(cls, type) and cls in _keys


def describe(cls: type) -> str:
    """Return the name of a type as people write it: the class name, or that of the built-in."""
    return _keys[cls] if cls in BUILTIN.values() else cls.__name__


def with_article(cls: type) -> str:
    """Return the name of a type as a sentence has it: ``an Elevation``, ``a Mask``."""
    name = describe(cls)
    return f"an {name}" if name[:1] in "AEIOU" else f"a {name}"


def key_of(cls: type) -> str:
    """Return the name that stored values carry: with the module, so that no two types share it."""
    return _keys[cls]


def named(name: str) -> type | None:
    """Return the port type of that name, with or without its module; None where there is none, or more than one."""
    if name in _by_key:
        return _by_key[name]
    found = [cls for cls in _by_key.values() if cls.__name__ == name]
    return found[0] if len(found) == 1 else None


def field_names(cls: type) -> tuple[str, ...] | None:
    """Return the field names of a declared port type in order, or None for anything else."""
    return _fields.get(cls)


def all_types() -> Iterator[tuple[str, type]]:
    """Yield (name, class) of every declared port type, sorted by name."""
    yield from sorted(((describe(cls), cls) for cls in _by_key.values()), key=lambda item: (item[0], key_of(item[1])))


def summary(cls: type) -> str:
    """Return the first line of a port type's documentation."""
    if cls in BUILTIN.values():
        return "A NumPy array of numbers." if cls is np.ndarray else f"A Python {cls.__name__}."
    return (inspect.getdoc(cls) or "").split("\n", 1)[0]


def accepts(target: type, source: type) -> bool:
    """Say whether a value of `source` may enter a port of `target` as it is: the same type, or a subtype of it."""
    if source is bool:
        return target is bool
    return issubclass(source, target) or (target is float and source is int)


def nearest_common(first: type, second: type, bound: type) -> type:
    """Return the most special port type below `bound` that accepts both types, which `bound` accepts.

    >>> nearest_common(int, float, float).__name__
    'float'
    """
    wider = [float] if first is int else []
    for cls in [*first.__mro__, *wider]:
        if is_port_type(cls) and accepts(cls, second) and accepts(bound, cls):
            return cls
    return bound


def conform(value: Any, target: type) -> Any:
    """Return `value` as an instance of the port type `target`, or raise `TypeError` saying what it is instead.

    NumPy scalars become Python scalars and integers widen to `float`; nothing else is converted.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, target) and not (target is int and isinstance(value, bool)):
        return value
    if target is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if target is np.ndarray and type(value).__module__.startswith("pyopencl."):  # inside a twin
        return value
    raise TypeError(f"expected {describe(target)}, got {describe(type(value))}")


def shape_text(value: Any) -> str:
    """Return the shape and dtype of a value's largest array for reports, such as ``(344, 403) float32``."""
    if isinstance(value, (int, float, str)):
        return ""
    array: Any = None
    stack = [value]
    while stack:
        item = stack.pop()
        if hasattr(item, "dtype") and hasattr(item, "nbytes"):  # an array, on the host or on a device
            if array is None or item.nbytes > array.nbytes:
                array = item
        elif isinstance(item, tuple):
            stack.extend(item)
        elif (names := _fields.get(type(item))) is not None:
            stack.extend(getattr(item, name) for name in names)
    return "" if array is None else f"{array.shape} {array.dtype}"
