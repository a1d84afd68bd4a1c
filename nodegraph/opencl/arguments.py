"""Kernel arguments: from Python and device arrays to what a kernel declares, or a sentence why not.

OpenCL checks the size of an argument and nothing else: an int32 array where a kernel reads floats, or a result written
over shared input, would pass in silence.  So kernels are compiled with their declarations kept, and held against them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyopencl as cl
import pyopencl.array as cla

from nodegraph.errors import DeviceError
from nodegraph.opencl.buffers import Buffer

_DTYPES: dict[str, np.dtype[Any]] = {
    name: np.dtype(code)
    for names, code in (
        ("char", "i1"),
        ("uchar,unsigned char", "u1"),
        ("short", "i2"),
        ("ushort,unsigned short", "u2"),
        ("int", "i4"),
        ("uint,unsigned int", "u4"),
        ("long", "i8"),
        ("ulong,unsigned long", "u8"),
        ("half", "f2"),
        ("float", "f4"),
        ("double", "f8"),
    )
    for name in names.split(",")
}
_TYPE = re.compile(r"^(?:const )?([a-z ]+?)(2|3|4|8|16)? ?\*?$")


@dataclass(frozen=True, slots=True)
class Local:
    """Local memory for a ``__local`` pointer: `count` elements of `dtype`, shared by a work group."""

    count: int
    dtype: npt.DTypeLike = np.float32

    @property
    def nbytes(self) -> int:
        """The size in bytes."""
        return self.count * np.dtype(self.dtype).itemsize


@dataclass(frozen=True, slots=True)
class Parameter:
    """What a kernel declares of one parameter.

    Attributes:
        name: as the kernel calls it.
        type: its type in OpenCL C, such as ``float*`` or ``uint``.
        dtype: the elements' dtype, None for a type that NumPy does not know.
        width: 1, or how many elements a vector has.
        space: ``value`` for a scalar or vector, else ``global``, ``constant`` or ``local``.
        const: whether the kernel promises not to write through the pointer.
    """

    name: str
    type: str
    dtype: np.dtype[Any] | None
    width: int
    space: str
    const: bool


def parameters_of(kernel: cl.Kernel) -> tuple[Parameter, ...] | None:
    """Return the declared parameters, or None where the driver does not keep them."""
    info, spaces = cl.kernel_arg_info, cl.kernel_arg_address_qualifier
    names: dict[Any, str] = {spaces.GLOBAL: "global", spaces.CONSTANT: "constant", spaces.LOCAL: "local"}
    declared = []
    try:
        for index in range(kernel.num_args):
            kind = str(kernel.get_arg_info(index, info.TYPE_NAME))
            qualifiers: Any = kernel.get_arg_info(index, info.TYPE_QUALIFIER)
            found = _TYPE.match(kind)
            declared.append(
                Parameter(
                    name=str(kernel.get_arg_info(index, info.NAME)),
                    type=kind,
                    dtype=_DTYPES.get(found[1]) if found else None,
                    width=int(found[2] or 1) if found else 1,
                    space=names.get(kernel.get_arg_info(index, info.ADDRESS_QUALIFIER), "value"),
                    const=bool(qualifiers & cl.kernel_arg_type_qualifier.CONST),
                )
            )
    except cl.Error:
        return None
    return tuple(declared)


def bind(
    where: str, count: int, parameters: Sequence[Parameter] | None, args: Sequence[Any], context: cl.Context
) -> list[Any]:
    """Return `args` in the form that the kernel takes.

    - A device array must be C-contiguous, start at its buffer's start and hold the elements that the pointer names (a
      boolean array counts as ``char``, a complex one as ``float2``).  One that came from the host needs ``const``.
    - A Python number becomes what the kernel declares; a fraction for an integer, or an integer that does not fit, is
      refused.  A tuple or list of n numbers becomes an n-vector.
    - A NumPy scalar must be exactly what the kernel declares.
    - `Local` is local memory; None is a null pointer.

    Raises:
        DeviceError: an argument does not fit; the message names kernel, parameter and what would.
    """
    if len(args) != count:
        names = f" ({', '.join([item.name for item in parameters])})" if parameters else ""
        raise DeviceError(f"{where} takes {count} arguments{names}, got {len(args)}")
    known: Sequence[Parameter | None] = parameters if parameters is not None else [None] * count
    bound = []
    for index, (arg, parameter) in enumerate(zip(args, known, strict=True)):
        try:
            bound.append(_bind(arg, parameter, context))
        except _MisfitError as error:
            name = f"'{parameter.name}' ({parameter.type})" if parameter is not None else str(index + 1)
            raise DeviceError(f"{where}: argument {name} {error}") from None
    return bound


class _MisfitError(Exception):
    """Why an argument does not fit, to follow its name."""


def _bind(arg: Any, parameter: Parameter | None, context: cl.Context) -> Any:
    pointer = parameter is None or parameter.space != "value"
    if isinstance(arg, cla.Array):
        return _array(arg, parameter, context)
    if isinstance(arg, np.ndarray) and arg.ndim and pointer:
        raise _MisfitError("got a NumPy array; put it on the device first with device.from_host")
    if isinstance(arg, Local):
        if parameter is not None and parameter.space != "local":
            raise _MisfitError("got local memory, which only a __local pointer takes")
        return cl.LocalMemory(arg.nbytes)
    if isinstance(arg, cl.LocalMemory) or (arg is None and pointer):
        return arg
    if isinstance(arg, (cl.MemoryObjectHolder, cl.Sampler)):
        return arg
    if parameter is not None and parameter.space != "value":
        raise _MisfitError(f"got {_called(arg)}; give a {'Local' if parameter.space == 'local' else 'device array'}")
    return _value(arg, parameter)


def _array(array: cla.Array, parameter: Parameter | None, context: cl.Context) -> Any:
    if array.context != context:
        raise _MisfitError("is an array on another device; bring it here through the host")
    if not array.flags.c_contiguous:
        raise _MisfitError(f"is a view with strides {array.strides}; give a C-contiguous array")
    if array.offset:
        raise _MisfitError("is a view that starts inside its buffer; give the whole array and the offset as a number")
    if parameter is not None:
        if parameter.space not in ("global", "constant"):
            raise _MisfitError(f"got an array of dtype {array.dtype}")
        if parameter.dtype is not None and not _holds(array.dtype, parameter):
            raise _MisfitError(f"got an array of dtype {array.dtype}, expected {parameter.dtype}")
        if (
            isinstance(array.base_data, Buffer)
            and array.base_data.read_only
            and parameter.space == "global"
            and not parameter.const
        ):
            raise _MisfitError(
                "is not const and got an array from the host, which others read; "
                "declare it const, or give device.empty_like(...) for a result"
            )
    return array.base_data


def _holds(dtype: np.dtype[Any], parameter: Parameter) -> bool:
    wanted = parameter.dtype
    assert wanted is not None
    if dtype.fields is not None:  # a vector type of pyopencl.cltypes
        return True
    if dtype.kind == "b":
        return wanted.itemsize == 1
    if dtype.kind == "c":
        return wanted.kind == "f" and 2 * wanted.itemsize == dtype.itemsize and parameter.width % 2 == 0
    return dtype == wanted


def _value(arg: Any, parameter: Parameter | None) -> Any:
    if parameter is None or parameter.dtype is None:
        if isinstance(arg, (bool, int, float, tuple, list)):
            raise _MisfitError(
                f"got {_called(arg)}; give a NumPy scalar of the kernel's type, such as numpy.float32({arg})"
            )
        return arg
    dtype, width = parameter.dtype, parameter.width
    if isinstance(arg, (tuple, list, np.ndarray)) and np.ndim(arg) == 1:
        if len(arg) != width:
            raise _MisfitError(f"got {len(arg)} numbers, expected {width}")
        vector = np.zeros(4 if width == 3 else width, dtype)
        vector[:width] = [_number(item, dtype) for item in arg]
        return vector
    if isinstance(arg, np.void) and arg.nbytes == dtype.itemsize * (4 if width == 3 else width):
        return arg
    if width != 1:
        raise _MisfitError(f"got {_called(arg)}, expected {width} numbers")
    return _number(arg, dtype)


def _number(arg: Any, dtype: np.dtype[Any]) -> np.generic[Any]:
    made: np.generic[Any]
    if isinstance(arg, (np.generic, np.ndarray)):
        if arg.dtype != dtype or arg.ndim:
            raise _MisfitError(f"got {_called(arg)}, expected numpy.{dtype} or a Python number")
        made = dtype.type(arg)
    elif isinstance(arg, (bool, int)) and dtype.kind in "iu":
        bounds = np.iinfo(dtype)
        if not bounds.min <= arg <= bounds.max:
            raise _MisfitError(f"got {arg}, which does not fit {dtype}")
        made = dtype.type(arg)
    elif isinstance(arg, (bool, int, float)) and dtype.kind == "f":
        made = _float(arg, dtype)
    else:
        raise _MisfitError(f"got {_called(arg)}, expected a number for {dtype}")
    return made


def _float(arg: float, dtype: np.dtype[Any]) -> np.generic[Any]:
    with np.errstate(over="ignore"):
        made: np.generic[Any] = dtype.type(arg)
    if np.isinf(made) and abs(arg) != float("inf"):
        raise _MisfitError(f"got {arg}, which does not fit {dtype}")
    return made


def _called(arg: Any) -> str:
    if isinstance(arg, np.ndarray):
        return f"a NumPy array of {arg.dtype}"
    if isinstance(arg, np.generic):
        return f"numpy.{arg.dtype}({arg})"
    return f"{type(arg).__name__} {arg!r}" if isinstance(arg, (bool, int, float)) else f"a {type(arg).__name__}"
