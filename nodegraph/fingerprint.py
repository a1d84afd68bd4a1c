"""A fingerprint of the code that computes a node: when it changes, the node is computed again.

It covers the module that declares the node, every module of a plugin package that this one imports (followed through
their import statements, without importing anything), and the OpenCL files they name: string constants ending in
``.cl``, beside the module or in a folder there, with the headers these include, which may lie in another plugin.  A
package's ``__init__`` counts only where a name is imported from it, so that editing one module of a plugin leaves the
nodes of the others alone.

What a node runs without importing it, the readers and writers of the file formats it uses, is given beside it and
counts in the same way, and by name: another function in the place of the first is another fingerprint.

A node declared outside a file (a notebook cell, ``exec``) is fingerprinted by its byte code and that of the functions
it calls there; what a function closes over counts everywhere.  Where a source was edited after it was imported, the
files do not say what runs here: the fingerprint is then one that no other process has.
"""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

from xxhash import xxh3_128_digest

from nodegraph.nodetypes import BEGAN, Node

_INCLUDE = re.compile(rb'^\s*#\s*include\s*"([^"]+)"', re.MULTILINE)


_Stamp = tuple[int, int, int, int]
Code = tuple[Callable[..., Any], ...]
"""Functions that compute a node beside its own: those of the file formats it uses."""


@dataclass(frozen=True, slots=True)
class _Known:
    """A fingerprint, and the state of the files it was taken from."""

    node: Node[..., Any]
    digest: bytes
    files: tuple[tuple[Path, _Stamp], ...]


@dataclass(frozen=True, slots=True)
class _Scan:
    """What one source file holds: its digest, the module names it imports, the files it names."""

    stat: _Stamp
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
        self._nodes: dict[tuple[int, Code], _Known] = {}
        self._classes: dict[type, tuple[bytes, tuple[tuple[Path, _Stamp], ...]]] = {}

    def of(self, node: Node[..., Any], code: Code = ()) -> bytes:
        """Return the fingerprint of a node's code, and of the further functions that it runs, 16 bytes.

        Costs a look at each file: a kernel that is edited meanwhile is compiled anew.
        """
        known = self._nodes.get((id(node), code))
        if known is None or known.node is not node or any(_stamp(path) != stamp for path, stamp in known.files):
            known = self._nodes[id(node), code] = self._compute(node, code)
        return known.digest

    def of_class(self, cls: type) -> bytes:
        """Return the fingerprint of what the methods of a class compute, those that it inherits among them."""
        known = self._classes.get(cls)
        if known is None or any(_stamp(path) != stamp for path, stamp in known[1]):
            known = self._classes[cls] = self._compute_class(cls)
        return known[0]

    def _compute_class(self, cls: type) -> tuple[bytes, tuple[tuple[Path, _Stamp], ...]]:
        files: set[Path] = set()
        parts = []
        for base in cls.__mro__:
            start = getattr(sys.modules.get(base.__module__), "__file__", None)
            found = self._closure(base.__module__, Path(start)) if start and base is not object else set()
            if not found:  # a class of a notebook
                functions = [item for _, item in sorted(vars(base).items()) if isinstance(item, FunctionType)]
                parts += [_function_digest(item, set(), everything=True) for item in functions]
            files |= found
        scans = [(path, scan) for path in sorted(files) if (scan := self._scan(path)) is not None]
        digest = xxh3_128_digest(b"".join([*parts, *(scan.digest for _, scan in scans)]))
        return digest, tuple((path, scan.stat) for path, scan in scans)

    def files(self, node: Node[..., Any], code: Code = ()) -> list[Path]:
        """Return the source files that the fingerprint of a node and of further functions covers, sorted."""
        found: set[Path] = set()
        for function in (*_implementations(node), *code):
            if start := getattr(sys.modules.get(function.__module__), "__file__", None):
                found |= self._closure(function.__module__, Path(start))
        return sorted(found)

    def _compute(self, node: Node[..., Any], code: Code) -> _Known:
        scans = [(path, scan) for path in self.files(node, code) if (scan := self._scan(path)) is not None]
        parts = [scan.digest for _, scan in scans]
        parts += [f"{function.__module__}.{function.__qualname__}".encode() for function in code]
        names = {str(path) for path, _ in scans}
        for function in (*_implementations(node), *code):
            in_file = getattr(getattr(function, "__code__", None), "co_filename", "") in names
            if not in_file or function.__closure__ or function in code:
                parts.append(_function_digest(function, set(), everything=not in_file))
        if _is_stale(node, scans):
            parts.append(f"edited after its import at {node.declared_at}".encode())
        return _Known(node, xxh3_128_digest(b"".join(parts)), tuple((path, scan.stat) for path, scan in scans))

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
            pending += [("", kernel) for name in scan.kernels for kernel in self._kernels(path, name, packages)]
            if path.suffix != ".py":
                continue
            is_package = path.name == "__init__.py"
            for target, names in scan.imports:
                absolute = _absolute(target, module_name, is_package)
                if absolute.partition(".")[0] in packages:
                    pending += self._modules(absolute, names)
        return found

    def _kernels(self, path: Path, name: str, packages: Iterable[str]) -> Iterator[Path]:
        """Yield the OpenCL files that a name in a source file may mean: all that could be, where it does not say."""
        folders = [path.parent]
        if path.suffix != ".py":  # a header: the folder that it is looked up in is an argument somewhere
            folders += [folder for package in sorted(packages) if (folder := _locate(package)) and folder.is_dir()]
        for folder in folders:
            found = [file for file in (folder / name, *folder.glob(f"*/{name}")) if file.is_file()]
            if found:
                yield from found
                return

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
            stamp = _stamp(path)
            known = self._scans.get(path)
            if stamp is not None and (known is None or known.stat != stamp):
                known = _scan(path, stamp)
                self._scans[path] = known
        except OSError:
            return None
        return known if stamp is not None else None


def _implementations(node: Node[..., Any]) -> Iterator[Any]:
    """Yield the functions that compute a node."""
    yield node.function
    if node.twin is not None:
        yield node.twin.function


def _stamp(path: Path) -> _Stamp | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ctime_ns, status.st_size, status.st_ino


def _is_stale(node: Node[..., Any], scans: list[tuple[Path, _Scan]]) -> bool:
    """Say whether a source file may hold something else than what was imported from it.

    The module of a node was read before the node was declared; nothing says when the others were, except that it was
    in this process.
    """
    own = getattr(sys.modules.get(node.function.__module__), "__file__", None)
    doubtful = set()
    for path, scan in scans:
        changed = 1e-9 * max(scan.stat[:2])
        if path.suffix == ".py" and changed > (node.declared_at if str(path) == own else BEGAN):
            doubtful.add(str(path))
    if not doubtful:
        return False
    return not doubtful.isdisjoint({getattr(module, "__file__", None) for module in list(sys.modules.values())})


def _scan(path: Path, stamp: _Stamp) -> _Scan:
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
    try:
        spec = importlib.util.find_spec(top) if module is None else None
    except (ImportError, ValueError):
        spec = None
    inside = spec.submodule_search_locations if spec is not None else getattr(module, "__path__", None)
    roots = [Path(item) for item in inside or ()]
    if not roots:
        own = spec.origin if spec is not None else getattr(module, "__file__", None)
        return Path(own) if own and not rest else None
    for root in roots:
        base = root.joinpath(*rest)
        if base.is_dir():
            return base
        if rest and (file := base.with_suffix(".py")).is_file():
            return file
    return None


def _function_digest(function: Any, seen: set[int], *, everything: bool) -> bytes:
    """Return a digest of a function's byte code and of what it closes over.

    With `everything`, the functions and constants of its own module that it names count, too.
    """
    if not isinstance(function, FunctionType) or id(function) in seen:
        return type(function).__name__.encode()
    seen.add(id(function))
    parts = [_code_digest(function.__code__)]
    for cell in function.__closure__ or ():
        try:
            parts.append(_content_digest(cell.cell_contents, function, seen, everything=everything))
        except ValueError:  # still empty
            parts.append(b"")
    if everything:
        for name in sorted(_names(function.__code__) & function.__globals__.keys()):
            value = function.__globals__[name]
            parts.append(name.encode() + _content_digest(value, function, seen, everything=True))
    return xxh3_128_digest(b"\0".join(parts))


def _content_digest(value: Any, user: FunctionType, seen: set[int], *, everything: bool) -> bytes:
    value = value.function if isinstance(value, Node) else value
    if isinstance(value, FunctionType) and value.__module__ == user.__module__:
        return _function_digest(value, seen, everything=everything)
    if isinstance(value, tuple):  # its text could hold addresses, those of functions for one
        return b"(" + b",".join([_content_digest(item, user, seen, everything=everything) for item in value]) + b")"
    if isinstance(value, (str, bytes, int, float, complex, type(None))):
        return repr(value).encode(errors="surrogatepass")
    return f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', type(value).__qualname__)}".encode()


def _names(code: CodeType) -> set[str]:
    inner = [_names(item) for item in code.co_consts if isinstance(item, CodeType)]
    return set(code.co_names).union(*inner)


def _code_digest(code: CodeType) -> bytes:
    """Return a digest of a function's byte code and constants; nested functions count, line numbers do not."""
    names = " ".join([*code.co_names, *code.co_varnames]).encode()
    return xxh3_128_digest(b"\0".join([code.co_code, names, *map(_constant_digest, code.co_consts)]))


def _constant_digest(item: Any) -> bytes:
    if isinstance(item, CodeType):
        return _code_digest(item)
    # The order of a set changes from process to process.
    return repr(sorted(map(repr, item)) if isinstance(item, frozenset) else item).encode(errors="surrogatepass")
