"""Writing the files of export nodes below the output folder, only where they are missing or differ."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from xxhash import xxh3_128_digest

from nodegraph.atomic import write_atomically
from nodegraph.cache import Cache
from nodegraph.files import File

Made = tuple[str, int, str]
"""A file as results remember it: name, size, digest of the contents."""


def files_of(values: Iterable[object]) -> tuple[Made, ...]:
    """Return what the `File`s among the outputs of a node are made of, sidecars included."""
    found = [item for value in values if isinstance(value, File) for item in value.all()]
    return tuple([(item.name, item.content.nbytes, xxh3_128_digest(item.content.data).hex()) for item in found])


def _write(path: Path, content: bytes) -> None:
    try:
        write_atomically(path, content)
    except OSError as error:
        if error.filename is not None and not str(error.filename).endswith(".part"):
            raise
        # It names the temporary file or none at all: neither tells which file it is about.
        raise OSError(error.errno, error.strerror, str(path)) from error


class Publisher:
    """Publishes files below one folder and keeps account of them.

    Attributes:
        written: paths written, in order.
        kept: paths that were right already.
    """

    def __init__(self, folder: Path, cache: Cache) -> None:
        self.folder = folder
        self.written: list[Path] = []
        self.kept: list[Path] = []
        self._cache = cache
        self._owners: dict[str, str] = {}

    def claim(self, node: str, files: Iterable[Made]) -> None:
        """Reserve the names of a node's files.  Raises `ValueError` when another node of the run makes the same one."""
        for name, _, _ in files:
            owner = self._owners.setdefault(name, node)
            if owner != node:
                raise ValueError(f"writes '{name}', as node '{owner}' does; choose another name")

    def stale(self, files: Iterable[Made]) -> str:
        """Return why the files must be written, or an empty text where all are right."""
        for name, size, digest in files:
            path = self.folder / name
            try:
                if path.stat().st_size != size or self._cache.file_digest(path).hex() != digest:
                    return f"file {name} was changed"
            except OSError:
                return f"file {name} is missing"
        return ""

    def confirm(self, files: Iterable[Made]) -> None:
        """Note that files are right as they are."""
        self.kept += [self.folder / name for name, _, _ in files]

    def publish(self, values: Iterable[object]) -> None:
        """Write the `File`s among `values` that are missing or differ.

        Raises:
            OSError: one cannot be written; what stood there before is whole.
        """
        for value in values:
            for item in value.all() if isinstance(value, File) else ():
                path = self.folder / item.name
                made = (item.name, item.content.nbytes, xxh3_128_digest(item.content.data).hex())
                if self.stale([made]):
                    _write(path, item.content.tobytes())
                    self.written.append(path)
                else:
                    self.kept.append(path)
