"""OpenCL programs: kernel files to compiled kernels, each compiled once.

Headers are put into the source here, not by the compiler: the text alone then says what a program is.  It is the key of
the cache in memory, and of the caches on disk (the driver's own, as in PoCL and NVIDIA's driver, else pyopencl's), of
which some would miss an edited header.  ``#line`` keeps the compiler's messages at the file and line they belong to.
"""

from __future__ import annotations

import logging
import math
import os
import re
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xxhash

from nodegraph.errors import DeviceError, nearest

if TYPE_CHECKING:
    import pyopencl as cl

    from nodegraph.opencl.arguments import Parameter

log = logging.getLogger("nodegraph.opencl")

OPTIONS = ("-cl-std=CL1.2", "-cl-kernel-arg-info")
"""What every program is compiled with."""

Define = bool | int | float | str

_INCLUDE = re.compile(r'^\s*#\s*include\s*(?:"([^"]+)"|<([^>]+)>)')
_ONCE = re.compile(r"^\s*#\s*pragma\s+once\b")
_COMMENT = re.compile(r'"(?:\\.|[^"\\])*"|//.*|/\*|\*/')
_MESSAGE = re.compile(
    r"^(?:(?P<kind1>error|warning):\s*)?(?P<file>[^:\n]*):(?P<line>\d+):(?:\d+:)?\s*"
    r"(?:(?:fatal )?(?P<kind2>error|warning):\s*)?(?P<text>.+)$",
    re.MULTILINE,
)
_SETTLED = 2.0


@dataclass(frozen=True, slots=True)
class Kernel:
    """One kernel, for the one thread that asked for it: setting arguments is not thread-safe."""

    file: str
    name: str
    handle: cl.Kernel
    parameters: tuple[Parameter, ...] | None


class Program:
    """A compiled kernel file.  Any thread may use it.

    Attributes:
        file: the name of the kernel file.
        handle: the compiled program.
    """

    def __init__(self, file: str, handle: cl.Program) -> None:
        import pyopencl as cl

        self.file = file
        self.handle = handle
        self.kernel_names: tuple[str, ...] = tuple(
            [name for name in str(handle.get_info(cl.program_info.KERNEL_NAMES)).split(";") if name]
        )
        self._parameters: dict[str, tuple[Parameter, ...] | None] = {}
        self._of_thread = threading.local()

    def kernel(self, name: str) -> Kernel:
        """Return the calling thread's kernel of that name.  Raises `DeviceError` when the file has none."""
        mine: dict[str, Kernel] = self._of_thread.__dict__
        found = mine.get(name)
        if found is None:
            found = mine[name] = self._make(name)
        return found

    def __repr__(self) -> str:
        return f"<program {self.file}: {', '.join(self.kernel_names)}>"

    def _make(self, name: str) -> Kernel:
        import pyopencl as cl

        from nodegraph.opencl.arguments import parameters_of

        if name not in self.kernel_names:
            raise DeviceError(f"kernel file {self.file} has no kernel '{name}'; {nearest(name, self.kernel_names)}")
        try:
            handle = cl.Kernel(self.handle, name)
        except cl.Error as error:
            raise DeviceError(f"kernel '{name}' of {self.file} cannot be made: {error}") from error
        if name not in self._parameters:
            self._parameters[name] = parameters_of(handle)
        return Kernel(self.file, name, handle, self._parameters[name])


class Programs:
    """The programs of one device.  Any thread may use it; `builds` counts how often the compiler was called."""

    def __init__(self, context: cl.Context, device: str) -> None:
        self.builds = 0
        self._context = context
        self._device = device
        self._lock = threading.Lock()
        self._sources: dict[tuple[tuple[str, ...], tuple[Path, ...]], _Source] = {}
        self._programs: dict[tuple[bytes, str], Program] = {}

    def get(
        self, path: Path, include: Sequence[Path], defines: Mapping[str, Define], before: Sequence[Path] = ()
    ) -> Program:
        """Return the program of a kernel file, compiled where it, what stands before it or a header has changed.

        Costs a look at the time stamp of each file when it is known.

        Raises:
            DeviceError: a file cannot be read, a define makes no sense, or the compiler refuses the source.
        """
        place = (tuple([os.fspath(item) for item in (*before, path)]), tuple(include))
        source = self._sources.get(place)
        if source is None or not source.is_current():
            source = self._sources[place] = _read([Path(item) for item in place[0]], place[1])
        head = _define_lines(defines)
        key = (source.digest, head)
        found = self._programs.get(key)
        if found is None:
            # One at a time: two threads that want the same program compile it once, and compilers take much memory.
            with self._lock:
                found = self._programs.get(key)
                if found is None:
                    found = self._programs[key] = self._build(Path(path).name, head + source.text)
        return found

    def _build(self, file: str, text: str) -> Program:
        import pyopencl as cl

        self.builds += 1
        started = time.perf_counter()
        with _compiler_output() as output:
            try:
                built = _compile(self._context, text)
            except cl.Error as error:
                raise DeviceError(
                    f"OpenCL device '{self._device}' cannot compile {_complaint(file, str(error))}"
                ) from error
        log.debug("compiled %s in %.3f s", file, time.perf_counter() - started)
        if said := "\n".join(output):
            log.warning("the OpenCL compiler remarks on %s", _complaint(file, said))
            log.debug("all it said:\n%s", said)
        return Program(file, built)


def source_files(path: Path, include: Sequence[Path] = ()) -> tuple[Path, ...]:
    """Return a kernel file and every header that it includes: what its results depend on.

    Raises:
        DeviceError: a file cannot be read.
    """
    return tuple([Path(item) for item, _, _ in _read([Path(path)], tuple(include)).stamps])


@dataclass(frozen=True, slots=True)
class _Source:
    """A kernel file with its headers in place: the text, and from which files it was read, in which state."""

    text: str
    digest: bytes
    stamps: tuple[tuple[str, int, int], ...]
    settled: bool

    def is_current(self) -> bool:
        # A file written within the clock tick in which it was read would keep its time stamp: until all are older than
        # that they are read again.
        return self.settled and all(_stamp(known[0]) == known for known in self.stamps)


def _read(paths: Sequence[Path], include: tuple[Path, ...]) -> _Source:
    stamps: dict[Path, tuple[str, int, int]] = {}
    text = "\n".join([line for path in paths for line in _expand(path, include, stamps, ())]) + "\n"
    newest = max(changed for _, changed, _ in stamps.values())
    settled = time.time() - 1e-9 * newest > _SETTLED
    return _Source(text, xxhash.xxh3_128_digest(text.encode()), tuple(stamps.values()), settled)


def _expand(
    path: Path, include: tuple[Path, ...], stamps: dict[Path, tuple[str, int, int]], inside: tuple[Path, ...]
) -> Iterator[str]:
    if path in inside:
        chain = " -> ".join([item.name for item in (*inside[inside.index(path) :], path)])
        raise DeviceError(f"kernel file {inside[0].name}: headers include each other in a circle ({chain}); cut it")
    stamps[path] = _stamp(str(path))
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceError(f"kernel file {path} cannot be read as text: {error}") from error
    guard = ""
    yield _line(1, path)
    in_comment = False
    for number, line in enumerate(lines, 1):
        header = None if in_comment else _header(line, path, include)
        in_comment = _ends_in_comment(line, in_comment)
        if header is not None:
            yield from _expand(header, include, stamps, (*inside, path))
            yield _line(number + 1, path)
        elif not guard and _ONCE.match(line):
            guard = "NODEGRAPH_ONCE_" + xxhash.xxh3_64_hexdigest(str(path).encode())
            yield f"#ifndef {guard}\n#define {guard}\n{_line(number + 1, path)}"
        else:
            yield line
    if guard:
        yield "#endif"


def _header(line: str, path: Path, include: tuple[Path, ...]) -> Path | None:
    found = _INCLUDE.match(line)
    if found is None:
        return None
    name = found[1] or found[2]
    places = ([path.parent] if found[1] else []) + list(include)
    # What is not here is left to the compiler: it may be the driver's, or behind an #if; else the compiler says where.
    return next((place / name for place in places if (place / name).is_file()), None)


def _ends_in_comment(line: str, inside: bool) -> bool:
    for token in _COMMENT.findall(line):
        if token == "/*":
            inside = True
        elif token == "*/":
            inside = False
        elif not inside and token.startswith("//"):
            break
    return inside


def _line(number: int, path: Path) -> str:
    # The name alone: where a plugin is installed must not make it another program.
    name = path.name.replace("\\", "\\\\").replace('"', '\\"')
    return f'#line {number} "{name}"'


def _stamp(path: str) -> tuple[str, int, int]:
    try:
        status = os.stat(path)  # noqa: PTH116 - at every launch, and a third of the time that a Path takes
    except OSError as error:
        raise DeviceError(f"kernel file {path} cannot be read: {error.strerror or error}") from error
    return path, status.st_mtime_ns, status.st_size


def _define_lines(defines: Mapping[str, Define]) -> str:
    return "".join([f"#define {name} {_literal(name, value)}\n" for name, value in sorted(defines.items())])


def _literal(name: str, value: Define) -> str:
    if not re.fullmatch(r"[A-Za-z_]\w*", name, re.ASCII):
        raise DeviceError(f"'{name}' is no name for a kernel define; use letters, digits and underscores")
    if isinstance(value, str):
        if "\n" in value:
            raise DeviceError(f"kernel define '{name}' must be one line of text")
        return value
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, int):
        return f"({value})"
    if isinstance(value, float):
        if math.isnan(value):
            return "NAN"
        return f"({'-' * (value < 0)}INFINITY)" if math.isinf(value) else f"({value!r}f)"
    raise DeviceError(f"kernel define '{name}' must be a bool, int, float or str, not {type(value).__name__}")


def _compile(context: cl.Context, text: str) -> cl.Program:
    import pyopencl as cl

    program: cl.Program = cl.Program(context, text)
    try:
        program.build(list(OPTIONS))
    except cl.Error:
        raise
    except Exception as error:
        # pyopencl's cache on disk (used where the driver has none) stumbles over folders that it cannot write.
        log.debug("pyopencl's compiler cache failed and is not used: %s", error)
        uncached: Any = False
        program = cl.Program(context, text)
        program.build(list(OPTIONS), cache_dir=uncached)
    return program


def _complaint(file: str, said: str) -> str:
    r"""Return the first error (else the first remark) in what a compiler said: ``file line n: text``.

    >>> _complaint("a.cl", "warning: a.cl:1:2: hm\nerror: b.h:3:7: use of undeclared identifier 'x'")
    "b.h line 3: use of undeclared identifier 'x'"
    >>> _complaint("a.cl", "a.cl:7:1: error: expected ';'")
    "a.cl line 7: expected ';'"
    """
    remarks = list(_MESSAGE.finditer(said))
    errors = [item for item in remarks if "error" in (item["kind1"], item["kind2"])]
    for item in errors or remarks:
        return f"{item['file'] or file} line {item['line']}: {item['text'].strip()}"
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    return (
        f"{file}: {next((line for line in lines if 'error' in line.lower()), lines[0] if lines else 'no reason given')}"
    )


_collecting = threading.local()
_hook_lock = threading.Lock()


@contextmanager
def _compiler_output() -> Iterator[list[str]]:
    """Collect what pyopencl would warn of: the compiler's remarks on a program of this thread that it did accept.

    pyopencl passes them through `warnings`, whose filters belong to the whole process and cannot be changed safely
    while other threads run, and says in them only that there is something to say.
    """
    _hook_compiler_output()
    output: list[str] = []
    _collecting.output = output
    try:
        yield output
    finally:
        _collecting.output = None


def _hook_compiler_output() -> None:
    import pyopencl as cl

    with _hook_lock:
        original = cl.compiler_output
        if getattr(original, "of_nodegraph", False):
            return

        def compiler_output(text: str) -> None:
            output = getattr(_collecting, "output", None)
            if output is None:
                original(text)
            else:
                output.append(text)

        compiler_output.of_nodegraph = True  # type: ignore[attr-defined]
        cl.compiler_output = compiler_output
