"""Files as values: what an export node returns, and how a run publishes it.

An export node stays a pure function: it returns the bytes of a file under a relative name.  The engine writes them
below the output folder, and only when what is there differs, so a run that is answered from the cache leaves a right
file alone and puts a missing or damaged one back.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph.porttypes import port_type


@port_type
class File:
    """A file made by an export node: a relative name, its bytes, and files that belong beside it.

    Attributes:
        name: path relative to the output folder, with forward slashes; never absolute, never with ``..``.
        content: the bytes, (n,) uint8.
        sidecars: further files, such as a JSON with the height range.
    """

    name: str
    content: npt.NDArray[np.uint8]
    sidecars: tuple[File, ...] = ()

    def __post_init__(self) -> None:
        check_name(self.name)

    @classmethod
    def of(cls, name: str, content: bytes | bytearray | memoryview, *sidecars: File) -> File:
        """Make a file value from bytes."""
        return cls(name, np.frombuffer(content, np.uint8), sidecars)

    def all(self) -> tuple[File, ...]:
        """Return the file itself and every sidecar below it."""
        return (self, *(item for sidecar in self.sidecars for item in sidecar.all()))


def check_name(name: str) -> None:
    """Raise `ValueError` unless `name` is a relative path that stays inside the folder it is relative to."""
    parts = name.replace("\\", "/").split("/")
    if not name or name.startswith(("/", "\\")) or ":" in parts[0] or any(part in ("", ".", "..") for part in parts):
        raise ValueError(f"'{name}' is no file name inside the output folder; give a relative path without '..'")
    if any(ord(char) < 32 for char in name):
        raise ValueError(f"{name!r} holds control characters; give a plain file name")
