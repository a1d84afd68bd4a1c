"""File formats: how the values of a port type are read from files and written to them, chosen by suffix.

A node that reads or writes files asks the registry for the format and leaves the rest to it, so that a plugin may bring
a format for the types and nodes of another::

    @node(version=1)
    def save_mesh(mesh: Mesh, *, name: Annotated[str, OutputFile(type=Mesh), Param("File to write.")]) -> File:
        '''Write a mesh in the format that the suffix names.'''
        write, = registry().formats().find(type(mesh), name, "write").functions("write")
        return write(mesh, name)

The mark ``OutputFile(type=Mesh)`` (or ``InputFile(type=Mesh)``) tells the engine the same: the suffix is checked before
anything runs, and the code of the format counts where the cache asks what computes the node.

A longer suffix goes before a shorter one (``.asc.gz`` before ``.gz``).  Among formats of one suffix that of the nearest
base class counts, as it does for previews: a plugin may take over ``.tif`` for elevations and leave other rasters as
they are.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import PurePosixPath
from types import FunctionType
from typing import Any, Literal

from nodegraph.errors import PluginError
from nodegraph.porttypes import describe, is_port_type

Use = Literal["read", "write"]
_USES: tuple[Use, ...] = ("read", "write")


@dataclass(frozen=True, slots=True)
class Format:
    """How a port type is read from and written to files of some suffixes.

    The functions get, as keyword parameters, those parameters of the node that they name.  They are plain functions of
    a module, so that a change of them, or of what they import, is noticed.

    Attributes:
        type: the port type.  The format counts for its subclasses, too, where they have none of that suffix.
        suffixes: such as ``(".tif", ".tiff")``, in lower case, the usual one first; the empty one stands for every
            name that no other format of the type knows.
        title: what a person calls it, such as ``GeoTIFF``.
        read: ``read(path, ...)`` returns the value in a file.
        open: ``open(path, ...)`` returns a context manager that gives what the head of a file says and reads the rest
            when asked, in the form that the nodes of the type want.  It goes before `read`, and plans use it to tell
            how much memory a file will take: it must be quick.
        write: ``write(value, name, ...)`` returns a `File`.
        sidecars: suffixes of further files that the reader looks at, as `InputFile` has them.
    """

    type: type
    suffixes: tuple[str, ...]
    title: str
    read: Callable[..., Any] | None = None
    write: Callable[..., Any] | None = None
    open: Callable[..., Any] | None = None
    sidecars: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not is_port_type(self.type):
            raise PluginError(f"format '{self.title}': {self.type!r} is no port type; declare it with @port_type")
        if not isinstance(self.suffixes, tuple) or not self.suffixes:
            raise PluginError(f"format '{self.title}': suffixes must be a tuple of at least one")
        for suffix in self.suffixes:
            if not isinstance(suffix, str) or suffix != suffix.lower() or suffix[:1] not in ("", ".") or suffix == ".":
                raise PluginError(f"format '{self.title}': suffix {suffix!r} must be like '.abc', in lower case")
        functions = {name: getattr(self, name) for name in ("read", "open", "write")}
        if not any(functions.values()):
            raise PluginError(f"format '{self.title}' is neither read nor written; give it read, open or write")
        for name, function in functions.items():
            if function is not None and not isinstance(function, FunctionType):
                raise PluginError(f"format '{self.title}': {name} must be a plain function, not {function!r}")

    def functions(self, use: Use) -> tuple[Callable[..., Any], ...]:
        """Return what reads the format (`open` first) or writes it; nothing where it does not."""
        given = (self.write,) if use == "write" else (self.open, self.read)
        return tuple([function for function in given if function is not None])

    def takes(self, use: Use) -> frozenset[str]:
        """Return the names of the keyword parameters of its reader or writer."""
        parameters = inspect.signature(self.functions(use)[0]).parameters.values()
        return frozenset(item.name for item in parameters if item.kind is item.KEYWORD_ONLY)


class Formats:
    """Formats by port type and suffix.  Iterating yields (format, name of the plugin), in order of registration."""

    def __init__(self) -> None:
        self._listed: list[tuple[Format, str]] = []
        self._owners: dict[tuple[Use, type, str], tuple[Format, str]] = {}

    def __iter__(self) -> Iterator[tuple[Format, str]]:
        return iter(self._listed)

    def add(self, added: Format, plugin: str) -> list[str]:
        """Add a format.

        Where another has the same type and suffix, that one keeps it; returns a sentence for each such suffix.
        """
        self._listed.append((added, plugin))
        clashes = {}
        for use in _USES:
            for suffix in added.suffixes if added.functions(use) else ():
                keeper, owner = self._owners.setdefault((use, added.type, suffix), (added, plugin))
                if keeper is not added:
                    clashes[suffix] = (
                        f"format '{added.title}' does not get '{suffix}' for {describe(added.type)}, "
                        f"which plugin '{owner}' has already"
                    )
        return list(clashes.values())

    def suffixes(self, item: Format, use: Use) -> tuple[str, ...]:
        """Return the suffixes with which a format is read or written: those that no other keeps from it."""
        kept = [suffix for suffix in item.suffixes if self._owners.get((use, item.type, suffix), ("",))[0] is item]
        return tuple(kept)

    def of(self, cls: type, use: Use) -> list[Format]:
        """Return the formats that values of `cls` can be read from or written to, in order of registration."""
        return [item for item, _ in self._listed if issubclass(cls, item.type) and self.suffixes(item, use)]

    def find(self, cls: type, name: str, use: Use) -> Format:
        """Return the format in which a file of that name holds, or will hold, a value of `cls`.

        Raises:
            ValueError: there is none; the sentence names those there are.
        """
        found = self._find(cls, name, use)
        if found is None:
            raise ValueError(self._refusal(cls, name, use))
        return found

    def candidates(self, cls: type, name: str, use: Use) -> list[Format]:
        """Return every format that `find` may give for what a port of `cls` carries.

        That is the one for `cls` itself; what is written may be of a subclass, too, and this have a format of its own.

        Raises:
            ValueError: there is none.
        """
        kinds = [cls]
        if use == "write":
            kinds += [item.type for item, _ in self._listed if item.type is not cls and issubclass(item.type, cls)]
        found = [item for kind in kinds if (item := self._find(kind, name, use)) is not None]
        if not found:
            raise ValueError(self._refusal(cls, name, use))
        return list(dict.fromkeys(found))

    def _find(self, cls: type, name: str, use: Use) -> Format | None:
        for suffix in _suffixes_of(name):
            for base in cls.__mro__:
                if (entry := self._owners.get((use, base, suffix))) is not None:
                    return entry[0]
        return None

    def _refusal(self, cls: type, name: str, use: Use) -> str:
        usual = [self.suffixes(item, use)[0] for item in self.of(cls, use)]
        if not usual:
            return f"no plugin {use}s files of {describe(cls)}; install one that does, for '{name}'"
        suffix = PurePosixPath(name).suffix.lower()
        end = f"ends in '{suffix}'" if suffix else "has no suffix"
        return f"'{name}' {end}; choose {one_of(usual)}"


def one_of(names: Iterable[str]) -> str:
    """Return names as a choice.

    >>> one_of([".a"]), one_of([".a", ".b"]), one_of([".a", ".b", ".c"])
    ('.a', '.a or .b', 'one of .a, .b, .c')
    """
    *most, last = dict.fromkeys(names)
    if len(most) > 1:
        return f"one of {', '.join([*most, last])}"
    return " or ".join([*most, last])


def _suffixes_of(name: str) -> Iterator[str]:
    """Yield what a file name ends in, the longest first, the empty suffix last.

    >>> list(_suffixes_of("N46.5/alps.ASC.gz"))
    ['.asc.gz', '.gz', '']
    """
    stem, *parts = PurePosixPath(name).name.lower().split(".")
    if not stem:  # a hidden file: its first dot begins no suffix
        parts = parts[1:]
    for first in range(len(parts)):
        yield "." + ".".join(parts[first:])
    yield ""
