"""Cache keys: what identifies the result of a node before it is computed.

A key is the xxh3-128 of, in this order: the schema version of keys, the node's type id, its version, the fingerprint of
its code, its canonical parameters by name, the *value digest* of each linked input with the name of its port, the
digest of each external file it reads, and the class of device where results differ by device.  It never holds the keys
of ancestors: an input that comes out equal in bytes cuts off everything below it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from operator import itemgetter

from xxhash import xxh3_128_digest

_PORT = itemgetter(0)
_SIXTEEN = (16).to_bytes(4, "little")
"""How long a digest is: there is one for every link, so it is not made anew."""

SCHEMA = 2
"""Raised when keys come to mean something else; older results are then never found again.

2: the dice of a node depend on its name, no longer on its family.
"""


def prefix(type_id: str, version: int, code: bytes, device: str = "") -> bytes:
    """Return the part of a key that all nodes of one type share."""
    parts = (str(SCHEMA).encode(), type_id.encode(), str(version).encode(), code, device.encode())
    return xxh3_128_digest(b"".join(map(_framed, parts)))


def key(
    prefix: bytes, canonical: bytes, inputs: Iterable[tuple[str, bytes]], files: Mapping[str, bytes] | None = None
) -> bytes:
    """Return the key of one node, 16 bytes.

    Args:
        prefix: of its type, from `prefix`.
        canonical: its parameters as JSON bytes with sorted names, defaults filled in.
        inputs: (port name, value digest) of each link; the order matters within a port (variadic), not between ports.
        files: digest of the contents of the files it reads, by parameter.
    """
    parts = [_framed(prefix), _framed(canonical)]
    for port, digest in sorted(inputs, key=_PORT):
        parts += (_framed_name(port), _SIXTEEN if len(digest) == 16 else _length(digest), digest)
    if files:
        for name in sorted(files):
            parts += (_framed_name("file " + name), _framed(files[name]))
    return xxh3_128_digest(b"".join(parts))


def _length(part: bytes) -> bytes:
    # Each part is led by its length, so that no two lists of parts give the same bytes.
    return len(part).to_bytes(4, "little")


def _framed(part: bytes) -> bytes:
    return _length(part) + part


@cache
def _framed_name(name: str) -> bytes:
    return _framed(name.encode())
