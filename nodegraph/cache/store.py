"""The disk tier's values: one HDF5 file each, named by content digest, that proves itself when it is read.

A file starts with a 512-byte user block that holds a magic line and the xxh3-128 of everything after it; then follows
plain HDF5 that any tool opens: a dataset ``structure`` (JSON, see `nodegraph.codec`), one dataset per large array below
``arrays``, and the small arrays packed into one dataset ``packed``.  The checksum is verified before HDF5 sees the
file, so that a flipped or missing byte is a miss, never a wrong value or a crash in the library.

Files are written beside their place and renamed into it: a reader sees all of one or none.
"""

from __future__ import annotations

import io
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from xxhash import xxh3_128

from nodegraph import codec

_BLOCK = 512
_MAGIC = b"nodegraph value 1\n"
_PACKED_BELOW = 4096
_NATIVE_KINDS = "iufb"


class DamagedError(Exception):
    """A stored value does not match its checksum or its name."""


class ValueStore:
    """Values on disk below one folder, by content digest.  Several processes may use one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, digest: bytes) -> Path:
        """Return where the value of that digest is or would be."""
        name = digest.hex()
        return self.folder / name[:2] / f"{name}.h5"

    def __contains__(self, digest: bytes) -> bool:
        # Not `Path.exists`: that raises where a folder may not be entered, and such a value is not there for us.
        return os.path.exists(self.path(digest))  # noqa: PTH110

    def write(self, digest: bytes, value: Any) -> int:
        """Store a value under its digest and return the file's size in bytes.

        Raises:
            OSError: it cannot be written (no space, no permission); nothing is left behind.
        """
        target = self.path(digest)
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=".", suffix=".part")
        aside = Path(name)
        try:
            with _Patient(handle) as file:
                try:
                    _write_hdf5(file, codec.encode(value))
                except (RuntimeError, ValueError, KeyError) as error:  # HDF5 reads back what could not be written
                    raise file.error or OSError(str(error)) from error
                if file.error is not None:
                    raise file.error
                checksum = _checksum(file)
                size = file.tell()
                file.seek(0)
                file.write(_header(digest, checksum))
                if file.error is not None:
                    raise file.error
            aside.replace(target)
        except BaseException:
            aside.unlink(missing_ok=True)
            raise
        return size

    def read(self, digest: bytes) -> Any:
        """Return the value of that digest.

        Raises:
            FileNotFoundError: it is not stored.
            DamagedError: the file is damaged, or holds types that are not declared here.
        """
        path = self.path(digest)
        verify(path, digest)
        try:
            return codec.decode(_read_hdf5(path))
        except codec.UndecodableError as error:
            raise DamagedError(str(error)) from error
        except (OSError, KeyError, ValueError) as error:
            if not path.exists():
                raise FileNotFoundError(path) from error
            raise DamagedError(f"{path.name}: {error}") from error

    def remove(self, digest: bytes) -> None:
        """Remove a value, if it is there."""
        self.path(digest).unlink(missing_ok=True)

    def digests(self) -> Iterator[tuple[bytes, int]]:
        """Yield (digest, size in bytes) of every stored value."""
        for path in self.folder.glob("??/*.h5"):
            try:
                yield bytes.fromhex(path.stem), path.stat().st_size
            except (ValueError, OSError):
                continue

    def leftovers(self, older_than: float) -> Iterator[Path]:
        """Yield files that interrupted writers left behind before the time `older_than` (seconds since the epoch)."""
        for path in self.folder.glob("??/.*.part"):
            try:
                if path.stat().st_mtime < older_than:
                    yield path
            except OSError:
                continue


def verify(path: Path, digest: bytes) -> None:
    """Raise `DamagedError` unless the file is whole and is the value of that digest (FileNotFoundError: not there)."""
    with path.open("rb") as file:
        header = file.read(_BLOCK)
        if header != _header(digest, _checksum(file)):
            raise DamagedError(f"{path.name}: the checksum does not match")


def _header(digest: bytes, checksum: bytes) -> bytes:
    return (_MAGIC + digest.hex().encode() + b"\n" + checksum.hex().encode() + b"\n").ljust(_BLOCK, b"\0")


def _checksum(file: Any) -> bytes:
    state = xxh3_128()
    file.seek(_BLOCK)
    while block := file.read(1 << 20):
        state.update(block)
    return state.digest()


class _Patient(io.FileIO):
    """A new file that notes a failing write and goes on: HDF5 cannot close a file whose end it cannot write."""

    def __init__(self, handle: int) -> None:
        super().__init__(handle, "r+b")
        self.error: OSError | None = None

    def write(self, data: Any, /) -> int:
        view = memoryview(data).cast("B")
        done = 0
        try:
            while done < len(view):
                done += super().write(view[done:]) or 0
        except OSError as error:
            self.error = self.error or error
        return len(view)

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0


def _write_hdf5(target: _Patient, encoded: codec.Encoded) -> None:
    import h5py

    packed, layout = bytearray(), []
    with h5py.File(target, "w", userblock_size=_BLOCK, libver="latest", track_order=False) as file:
        large = file.create_group("arrays")
        for position, array in enumerate(encoded.arrays):
            entry: dict[str, Any] = {"dtype": array.dtype.str, "shape": array.shape}
            if array.nbytes < _PACKED_BELOW:
                packed += b"\0" * (-len(packed) % 16)
                entry["at"] = len(packed)
                packed += np.ascontiguousarray(array).tobytes()
            else:
                native = array.dtype.kind in _NATIVE_KINDS and array.dtype.itemsize <= 8
                content = np.ascontiguousarray(array)
                large.create_dataset(str(position), data=content if native else content.reshape(-1).view(np.uint8))
            layout.append(entry)
        head = {"root": encoded.structure[0], "table": encoded.structure[1], "arrays": layout}
        text = json.dumps(head, separators=(",", ":"), allow_nan=False).encode()
        file.create_dataset("structure", data=np.frombuffer(text, np.uint8))
        file.create_dataset("packed", data=np.frombuffer(bytes(packed), np.uint8))


def _read_hdf5(path: Path) -> codec.Encoded:
    import h5py

    with h5py.File(path, "r", locking=False) as file:
        head = json.loads(file["structure"][()].tobytes())
        packed = file["packed"][()] if file["packed"].size else np.empty(0, np.uint8)
        arrays = [_read_array(file, packed, position, entry) for position, entry in enumerate(head["arrays"])]
    for array in arrays:
        array.flags.writeable = False
    return codec.Encoded([head["root"], head["table"]], arrays)


def _read_array(file: Any, packed: npt.NDArray[np.uint8], position: int, entry: Any) -> npt.NDArray[Any]:
    dtype, shape = np.dtype(entry["dtype"]), tuple(entry["shape"])
    if "at" in entry:
        count = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
        return packed[entry["at"] : entry["at"] + count].view(dtype).reshape(shape) if count else np.empty(shape, dtype)
    content: npt.NDArray[Any] = file[f"arrays/{position}"][()]
    return content if content.dtype == dtype and content.shape == shape else content.view(dtype).reshape(shape)
