"""Values as bytes: the content digest, the read-only freeze, and a form that files can hold.

All three follow from the fields of a port type.  A value is a tree (or, with shared parts, a DAG) of port types,
tuples, scalars, strings and arrays:

- `seal` makes every array read-only and returns the value's *content digest*: 16 bytes (xxh3-128) that depend on the
  type names, the field names, every scalar, and the shape, dtype, byte order and elements of every array, and on
  nothing else (memory layout and sharing do not matter).
- `encode` turns a value into plain JSON data plus a list of distinct arrays; `decode` builds an equal value again.
  Equal parts are stored once, so a construction tree that instances one mountain thirty times stores it once.

Both walk with an explicit stack: depth is bounded by memory, not by the interpreter.  Nothing is pickled and decoding
creates only declared port types.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from xxhash import xxh3_128_digest

from nodegraph.porttypes import field_names, key_of, named

Array = npt.NDArray[Any]


class UndecodableError(ValueError):
    """Encoded data does not describe a value of the port types that are declared here."""


@dataclass(frozen=True, slots=True)
class Encoded:
    """A value in two parts: `structure` is JSON data, `arrays` the distinct arrays it refers to by index."""

    structure: list[Any]
    arrays: list[Array]


def seal(value: Any) -> bytes:
    """Make every array in `value` read-only and return the 16-byte content digest.

    Raises:
        TypeError: `value` holds something that is no port type, scalar, string, tuple or numeric array.

    One pass over the bytes at the speed of xxh3 (several GB/s); arrays that are not C-contiguous are copied to hash.
    """
    if (leaf := _leaf_digest(value)) is not None:
        return leaf
    memo: dict[int, bytes] = {}
    _post_order(value, memo, _digest_of)
    return memo[id(value)]


def nbytes(value: Any) -> int:
    """Return the bytes that the distinct arrays and strings of `value` hold in memory (scalars count 32)."""
    if type(value) in (float, int, bool):
        return 32
    total, seen, stack = 0, set(), [value]
    while stack:
        item = stack.pop()
        if id(item) in seen:
            continue
        if (size := getattr(item, "nbytes", None)) is not None:  # an array, on the host or on a device
            seen.add(id(item))
            total += int(size)
        elif (children := _children(item)) is not None:
            seen.add(id(item))
            total += 32
            stack.extend(children)
        else:
            total += len(item) if isinstance(item, (str, bytes)) else 32
    return total


def encode(value: Any) -> Encoded:
    """Return `value` as JSON data and arrays.  Raises `TypeError` as `seal` does."""
    if _leaf_digest(value) is not None:
        return Encoded([0, [_leaf_row(value)]], [])
    digests: dict[int, bytes] = {}
    _post_order(value, digests, _digest_of)
    table: list[Any] = []
    arrays: list[Array] = []
    index: dict[bytes, int] = {}

    def place(item: Any, places: dict[int, int]) -> int:
        digest = digests[id(item)]
        if digest not in index:
            table.append(_row(item, places, arrays))
            index[digest] = len(table) - 1
        return index[digest]

    places: dict[int, int] = {}
    _post_order(value, places, place)
    return Encoded([places[id(value)], table], arrays)


def decode(encoded: Encoded) -> Any:
    """Return a value equal to the one that was encoded.  Raises `UndecodableError` when it cannot be."""
    try:
        root, table = encoded.structure
        built: list[Any] = []
        for row in table:
            built.append(_build(row, built, encoded.arrays))
        return built[root]
    except UndecodableError:
        raise
    except (IndexError, KeyError, TypeError, ValueError, AttributeError, struct.error, RecursionError) as error:
        raise UndecodableError(f"the encoded value is damaged: {error}") from error


def _post_order(value: Any, memo: dict[int, Any], visit: Callable[[Any, dict[int, Any]], Any]) -> None:
    """Call `visit(item, memo)` once for every composite item of `value`, parts before wholes, filling `memo` by id."""
    stack: list[tuple[Any, bool]] = [(value, False)]
    open_items: set[int] = set()
    while stack:
        item, parts_done = stack.pop()
        key = id(item)
        if key in memo:
            continue
        children = _children(item)
        if parts_done or not children:
            open_items.discard(key)
            memo[key] = visit(item, memo)
            continue
        if key in open_items:
            raise TypeError("a value must not contain itself")
        open_items.add(key)
        stack.append((item, True))
        stack.extend((child, False) for child in children if _children(child) is not None)


def _children(item: Any) -> tuple[Any, ...] | None:
    """Return the parts of a composite item (an array is one without parts), or None for a leaf."""
    if isinstance(item, np.ndarray):
        return ()
    if type(item) is tuple:
        return item
    names = field_names(type(item))
    return None if names is None else tuple([getattr(item, name) for name in names])


def _digest_of(item: Any, memo: dict[int, bytes]) -> bytes:
    if isinstance(item, np.ndarray):
        return _array_digest(item)
    names = field_names(type(item))
    children = _children(item)
    if children is None:
        raise _refuse(item)
    parts = [b"T" if names is None else b"O" + key_of(type(item)).encode()]
    if getattr(type(item), "computes", False):
        parts.append(_code_of(type(item), memo))
    for position, child in enumerate(children):
        parts.append(names[position].encode() if names else b"")
        digest = memo.get(id(child)) if _children(child) is not None else _leaf_digest(child)
        if digest is None:
            raise _refuse(child)
        parts.append(digest)
    return xxh3_128_digest(b"\0".join([len(part).to_bytes(4, "little") + part for part in parts]))


def _code_of(cls: type, memo: dict[int, bytes]) -> bytes:
    """Return the fingerprint of a class whose values are functions; each class is looked at once for a value."""
    if id(cls) not in memo:
        from nodegraph.plan import fingerprints

        memo[id(cls)] = fingerprints().of_class(cls)
    return memo[id(cls)]


def _leaf_digest(item: Any) -> bytes | None:
    kind = type(item)
    if kind is float:
        return xxh3_128_digest(b"f" + struct.pack("<d", item))
    if kind is str:
        return xxh3_128_digest(b"s" + item.encode("utf-8", "surrogatepass"))
    if kind is int:
        return xxh3_128_digest(b"i%x" % item if item >= 0 else b"i-%x" % -item)
    if kind is bool:
        return xxh3_128_digest(b"b1" if item else b"b0")
    if item is None:
        return xxh3_128_digest(b"n")
    if kind is bytes:
        return xxh3_128_digest(b"y" + item)
    return None


def _array_digest(array: Array) -> bytes:
    if type(array) is not np.ndarray or array.dtype.kind not in "biufcSUmM" or array.dtype.hasobject:
        raise _refuse(array)
    array.flags.writeable = False
    base = array.base
    while isinstance(base, np.ndarray):  # else a node that keeps the whole could change the part it gave away
        base.flags.writeable = False
        base = base.base
    contiguous = np.ascontiguousarray(array)
    raw = contiguous.reshape(-1).view(np.uint8) if array.nbytes else np.empty(0, np.uint8)
    if array.dtype.char in "gG":
        raw = _without_padding(raw, array.dtype)
    content = xxh3_128_digest(raw.data) if array.nbytes else b""
    return xxh3_128_digest(f"A{array.dtype.str}{array.shape}".encode() + content)


def _without_padding(raw: npt.NDArray[np.uint8], dtype: np.dtype[Any]) -> npt.NDArray[np.uint8]:
    """Return the bytes of long doubles with their padding set to zero: on x86 a number fills 10 of 12 or 16 bytes."""
    if np.finfo(np.longdouble).nmant != 63:
        return raw
    numbers = raw.reshape(-1, np.dtype(np.longdouble).itemsize).copy()
    numbers[:, slice(10, None) if dtype.isnative else slice(None, -10)] = 0
    return numbers.reshape(-1)


def _refuse(item: Any) -> TypeError:
    if isinstance(item, np.ndarray):
        name = type(item).__name__ if type(item) is not np.ndarray else f"array of dtype {item.dtype}"
        return TypeError(f"a value may not hold a {name}; use a plain numeric numpy.ndarray")
    return TypeError(
        f"a value may not hold a {type(item).__name__}; use port types, tuples, scalars, strings or arrays"
    )


# A row of the encoded table is a JSON value: a leaf as it is (floats that JSON cannot say are spelt out), or a list
# [tag, ...]: "a" array, "t" tuple and "o" object, both holding the rows of their parts by index.


def _row(item: Any, places: dict[int, int], arrays: list[Array]) -> Any:
    if isinstance(item, np.ndarray):
        arrays.append(item)
        return ["a", len(arrays) - 1]
    children = _children(item)
    if children is None:
        return _leaf_row(item)
    cells = [["r", places[id(child)]] if _children(child) is not None else _leaf_row(child) for child in children]
    names = field_names(type(item))
    if names is None:
        return ["t", cells]
    return ["o", key_of(type(item)), dict(zip(names, cells, strict=True))]


def _leaf_row(item: Any) -> Any:
    if isinstance(item, float) and not math.isfinite(item):
        return ["f", struct.pack("<d", item).hex()]
    if isinstance(item, bytes):
        return ["y", item.hex()]
    if isinstance(item, str) and not _is_utf8(item):
        return ["s", item.encode("utf-8", "surrogatepass").hex()]
    if isinstance(item, int) and not isinstance(item, bool) and abs(item) >= 1 << 53:
        return ["i", f"{item:x}"]
    return item


def _is_utf8(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _build(row: Any, built: list[Any], arrays: list[Array]) -> Any:
    if not isinstance(row, list):
        return row
    tag, *rest = row
    if tag == "r":
        return built[rest[0]]
    if tag == "a":
        return arrays[rest[0]]
    if tag == "t":
        return tuple([_build(cell, built, arrays) for cell in rest[0]])
    if tag == "o":
        return _build_object(rest[0], {name: _build(cell, built, arrays) for name, cell in rest[1].items()})
    if tag == "f":
        return struct.unpack("<d", bytes.fromhex(rest[0]))[0]
    if tag == "y":
        return bytes.fromhex(rest[0])
    if tag == "s":
        return bytes.fromhex(rest[0]).decode("utf-8", "surrogatepass")
    if tag == "i":
        return int(rest[0], 16)
    raise UndecodableError(f"the encoded value has an unknown tag {tag!r}")


def _build_object(name: str, fields: dict[str, Any]) -> Any:
    cls = named(name)
    names = field_names(cls) if cls is not None else None
    if cls is None or names is None:
        raise UndecodableError(f"port type '{name}' is not declared here")
    if tuple(fields) != names:
        raise UndecodableError(f"port type '{name}' has other fields now")
    # The value was checked when it was first made: setting the fields skips __init__ and its checks.
    value: Any = object.__new__(cls)
    for field, item in fields.items():
        object.__setattr__(value, field, item)
    return value
