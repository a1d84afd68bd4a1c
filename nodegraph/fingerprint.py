"""A fingerprint of the code that computes a node: when it changes, the node is computed again.

It covers the module that declares the node, every module of a plugin package that this one imports (followed through
their import statements, without importing anything), and the OpenCL files they name: string constants ending in
``.cl``, beside the module, with the headers these include.  A package's ``__init__`` counts only where a name is
imported from it, so that editing one module of a plugin leaves the nodes of the others alone.

A node declared outside a file (a notebook cell, ``exec``) is fingerprinted by its byte code.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType
from typing import Any

from xxhash import xxh3_128_digest

from nodegraph.nodetypes import Node

_INCLUDE = re.compile(rb'^\s*#\s*include\s*"([^"]+)"', re.MULTILINE)


@dataclass(frozen=True, slots=True)
class _Scan:
    """What one source file holds: its digest, the module names it imports, the files it names."""

    stat: tuple[int, int]
    digest: bytes
    imports: tuple[tuple[str, tuple[str, ...]], ...]
    kernels: tuple[str, ...]


class Fingerprints:
    """Fingerprints of nodes, remembering what each source file holds while it is unchanged on disk.

    Args:
        packages: top-level packages whose modules count as plugin code.
    """

    def __init__(self, packages: Iterable[str]) -> None:
        self._packages = frozenset(packages)
        self._scans: dict[Path, _Scan] = {}
        self._nodes: dict[int, tuple[Node[..., Any], bytes]] = {}

    def of(self, node: Node[..., Any]) -> bytes:
        """Return the fingerprint of a node's code, 16 bytes.

        A node is read once per `Fingerprints`: its module is imported once, too.
        """
        known = self._nodes.get(id(node))
        if known is None or known[0] is not node:
            known = (node, self._compute(node))
            self._nodes[id(node)] = known
        return known[1]

    def files(self, node: Node[..., Any]) -> list[Path]:
        """Return the source files that the fingerprint of a node covers, sorted."""
        module = sys.modules.get(node.function.__module__)
        start = getattr(module, "__file__", None)
        return sorted(self._closure(node.function.__module__, Path(start))) if start else []

    def _compute(self, node: Node[..., Any]) -> bytes:
        files = self.files(node)
        parts = []
        for path in files:
            scan = self._scan(path)
            if scan is None:
                continue
            parts.append(scan.digest)
        changed_since = any(path.stat().st_mtime > node.declared_at for path in files)
        if changed_since or node.function.__code__.co_filename not in map(str, files):
            # The files do not say what runs here: a notebook cell, or a source edited after it was imported.
            parts = [b"code", _code_digest(node.function.__code__)]
            if node.twin is not None:
                parts.append(_code_digest(node.twin.function.__code__))
            if changed_since:
                parts.append(str(node.declared_at).encode())
        return xxh3_128_digest(b"".join(parts))

    def _closure(self, name: str, start: Path) -> set[Path]:
        """Return the files reached from a module through imports of plugin code."""
        packages = self._packages | {name.partition(".")[0]}
        found: set[Path] = set()
        pending = [(name, start)]
        while pending:
            module_name, path = pending.pop()
            if path in found:
                continue
            scan = self._scan(path)
            if scan is None:
                continue
            found.add(path)
            if path.suffix != ".py":
                pending += [("", path.parent / kernel) for kernel in scan.kernels if (path.parent / kernel).is_file()]
                continue
            pending += [("", path.parent / kernel) for kernel in scan.kernels if (path.parent / kernel).is_file()]
            is_package = path.name == "__init__.py"
            for target, names in scan.imports:
                absolute = _absolute(target, module_name, is_package)
                if absolute.partition(".")[0] in packages:
                    pending += self._modules(absolute, names)
        return found

    def _modules(self, name: str, imported: tuple[str, ...]) -> Iterator[tuple[str, Path]]:
        """Yield (module name, file) of what ``from name import imported`` runs."""
        folder = _locate(name)
        if folder is None:
            return
        if folder.is_file():
            yield name, folder
            return
        own = folder / "__init__.py"
        for item in imported or ("",):
            for candidate in (folder / f"{item}.py", folder / item / "__init__.py") if item else ():
                if candidate.is_file():
                    yield f"{name}.{item}", candidate
                    break
            else:
                if own.is_file():
                    yield name, own

    def _scan(self, path: Path) -> _Scan | None:
        try:
            status = path.stat()
            stamp = (status.st_mtime_ns, status.st_size)
            known = self._scans.get(path)
            if known is None or known.stat != stamp:
                known = _scan(path, stamp)
                self._scans[path] = known
        except OSError:
            return None
        return known


def _scan(path: Path, stamp: tuple[int, int]) -> _Scan:
    source = path.read_bytes()
    digest = xxh3_128_digest(source)
    if path.suffix != ".py":
        return _Scan(stamp, digest, (), tuple(match.decode() for match in _INCLUDE.findall(source)))
    imports: list[tuple[str, tuple[str, ...]]] = []
    kernels: list[str] = []
    try:
        tree = ast.parse(source)
    except SyntaxError:  # it was importable once; its bytes alone must do now
        return _Scan(stamp, digest, (), ())
    for item in ast.walk(tree):
        if isinstance(item, ast.Import):
            imports += [(alias.name, ()) for alias in item.names]
        elif isinstance(item, ast.ImportFrom):
            imports.append(("." * item.level + (item.module or ""), tuple(alias.name for alias in item.names)))
        elif isinstance(item, ast.Constant) and isinstance(item.value, str) and item.value.endswith((".cl", ".clh")):
            kernels.append(item.value)
    return _Scan(stamp, digest, tuple(imports), tuple(kernels))


def _absolute(target: str, module: str, is_package: bool) -> str:
    if not target.startswith("."):
        return target
    bare = target.lstrip(".")
    parts = module.split(".")
    up = len(target) - len(bare) - (1 if is_package else 0)
    base = parts[: len(parts) - up] if up else parts
    return ".".join([*base, *([bare] if bare else [])])


def _locate(name: str) -> Path | None:
    """Return the file of a module, or the folder of a package, without importing it."""
    top, *rest = name.split(".")
    module = sys.modules.get(top)
    if module is None:
        return None
    roots = [Path(item) for item in getattr(module, "__path__", [])]
    if not roots:
        own = getattr(module, "__file__", None)
        return Path(own) if own and not rest else None
    for root in roots:
        base = root.joinpath(*rest)
        if base.is_dir():
            return base
        if rest and (file := base.with_suffix(".py")).is_file():
            return file
    return None


def _code_digest(code: CodeType) -> bytes:
    """Return a digest of a function's byte code and constants; nested functions count, line numbers do not."""
    names = " ".join([*code.co_names, *code.co_varnames]).encode()
    constants = [_code_digest(item) if isinstance(item, CodeType) else repr(item).encode() for item in code.co_consts]
    return xxh3_128_digest(b"\0".join([code.co_code, names, *constants]))
