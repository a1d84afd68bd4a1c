"""The direct answer: a run of which nothing has changed is answered without loading the engine.

Loading NumPy, pydantic and the plugins takes longer than anything else that a fully cached run does.  So a run that
ended well notes, as a compiler cache does in its direct mode, all that its answer depends on; the same call later
compares these notes with what is there now, using the standard library only, and prints what the whole way would have
printed: every node cached, every file right.  Whatever differs, is missing, damaged or in doubt leads to the whole way.

An answer depends on:

- the *call*: arguments, current folder, Python, machine, and the environment variables that are read on the way;
- *files*: the graph and its subgraphs, the sources of the engine, the plugins and the nodes, the files that nodes read,
  and the absence of sidecars that are not there.  Compared by size, times of change, inode and device;
- *folders* of that code: by the names in them, since a new file can come before another one at import;
- what is *installed* in the folders of ``sys.path``: names, and the text of entry points, since a plugin may be new;
- the *drivers* of OpenCL, since a device may have come or gone;
- the *history* of the graph in the cache's index: after another run of the same graph, this one would have to be noted
  there as the latest, and after the cache was cleared there is nothing to answer from;
- the *outputs*: files that the run wrote, by what the files hold, or by size and times once these are old enough.

Times of change have a grain of up to two seconds: a file that changed so shortly before the run began could change
again unseen.  An answer with such a file is not noted (outputs excepted: the run knows what it wrote).

Only a plain run is answered so; one that is forced, checked, reported, profiled or without a cache never is.
"""

# Importing pathlib would take as long as the whole answer does.
# ruff: noqa: PTH108, PTH109, PTH110, PTH112, PTH113, PTH116, PTH118, PTH120, PTH123, PTH208

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import sys
import time
from typing import TYPE_CHECKING, Any

from nodegraph import __version__
from nodegraph.cli import text
from nodegraph.places import ANSWERS, CACHE_VERSION, default_cache_folder

if TYPE_CHECKING:
    from pathlib import Path

    from nodegraph.run import Result

_FORM = 1
_GRAIN_NS = 2_000_000_000
_READ_AT_MOST = 64 << 20
_KEPT_ANSWERS = 256
# What the engine, platformdirs, Python and the drivers of OpenCL look at.
_VARIABLES = ("HOME", "LOCALAPPDATA", "USERPROFILE", "XDG_CACHE_HOME")
_PREFIXES = (
    "NODEGRAPH_",
    "PYTHON",
    "LD_",
    "OCL_",
    "OPENCL_",
    "POCL_",
    "PYOPENCL_",
    "CUDA_",
    "GPU_",
    "HIP_",
    "ROCR_",
    "ZE_",
)
_DRIVERS = ("/etc/OpenCL/vendors", "/dev/dri")
_DRIVER_FILES = ("/etc/ld.so.cache",)
_DRIVER_TEXTS = ("/sys/module/nvidia/version", "/sys/module/amdgpu/version")

Signature = list[int] | None
"""Size, time of change of contents and of the entry, inode and device; None where there is no such file."""


class Call:
    """One call of the program, as it was made: noted before anything is loaded that could change the process."""

    def __init__(self, arguments: list[str], started: int) -> None:
        self.arguments = arguments
        self.started = started
        self.facts = [
            _FORM,
            __version__,
            arguments,
            _here(),
            {name: value for name, value in os.environ.items() if name in _VARIABLES or name.startswith(_PREFIXES)},
            [sys.version, sys.executable, sys.prefix, *sys.path],
            list(os.uname()) if hasattr(os, "uname") else [sys.platform],
        ]
        self.name = _digest(json.dumps(self.facts, sort_keys=True).encode()) + ".json"


# Finding an answer.


def find(call: Call) -> dict[str, Any] | None:
    """Return the noted answer to a call, if all it depends on is as it was."""
    try:
        with open(os.path.join(_folder(call.arguments), ANSWERS, call.name), "rb") as file:
            seal, _, body = file.read().partition(b"\n")
        if seal != _digest(body).encode():
            return None
        answer: dict[str, Any] = json.loads(body)
        return answer if _holds(answer, call) else None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, sqlite3.Error):
        return None


def say(answer: dict[str, Any], call: Call) -> int:
    """Print what the run would have printed and return its exit status."""
    if not answer["quiet"]:
        colour = text.coloured(sys.stdout)
        print(text.headline({"cached": answer["nodes"]}, (time.time_ns() - call.started) / 1e9, colour=colour))
        for line in text.file_lines([], [output["path"] for output in answer["outputs"]], colour=colour):
            print(line)
    return 0


def _holds(answer: dict[str, Any], call: Call) -> bool:
    return (
        answer["facts"] == call.facts
        and all(_signature(path) == signature for path, signature in answer["files"].items())
        and all(_names(folder) == names for folder, names in answer["folders"].items())
        and _installed(answer["packages"]) == answer["installed"]
        and _drivers() == answer["drivers"]
        and _history(answer["index"], answer["graph"]) == answer["history"]
        and _outputs_hold(answer["outputs"])
    )


def _outputs_hold(outputs: list[dict[str, Any]]) -> bool:
    budget = _READ_AT_MOST
    for output in outputs:
        now = _signature(output["path"])
        if now is None or now[0] != output["size"]:
            return False
        if now == output["signature"]:
            continue
        budget -= now[0]
        if budget < 0:
            return False
        from xxhash import xxh3_128_hexdigest

        with open(output["path"], "rb") as file:
            if xxh3_128_hexdigest(file.read()) != output["digest"]:
                return False
    return True


# Noting an answer.


def note(call: Call, result: Result, folder: Path, *, quiet: bool) -> None:
    """Note the answer of a run that ended well, unless something it depends on changed too shortly ago.

    `folder` is where the files of the run are.
    """
    from nodegraph.atomic import write_atomically

    plan = result.plan
    if plan.cache.folder is None:
        return
    packages = _packages()
    sources = _code_files(result, packages)
    files = {path: _signature(path) for path in [*map(str, plan.network.sources), *sources, *_read_files(result)]}
    if not all(_settled(signature, call.started) for signature in files.values()) or not _read_as_planned(result):
        return
    index = str(plan.cache.folder / "index.sqlite")
    answer = {
        "facts": call.facts,
        "files": files,
        "folders": {folder: _names(folder) for folder in sorted({os.path.dirname(path) for path in sources})},
        "packages": packages,
        "installed": _installed(packages),
        "drivers": _drivers(),
        "index": index,
        "graph": plan.network.home,
        "history": _history(index, plan.network.home),
        "outputs": _outputs(result, folder),
        "nodes": len(plan.needed),
        "quiet": quiet,
    }
    if answer["history"] is None:
        return
    body = json.dumps(answer).encode()
    place = plan.cache.folder / ANSWERS / call.name
    try:
        write_atomically(place, _digest(body).encode() + b"\n" + body)
        _thin_out(place.parent)
    except OSError:
        return  # a full disk or a folder that cannot be written: the next run goes the whole way


def _packages() -> list[str]:
    """Return the packages whose code a run executes: the engine's and those of all plugins."""
    from nodegraph.plugins import registry

    return ["nodegraph", *sorted(registry().packages() - {"nodegraph"})]


def _code_files(result: Result, packages: list[str]) -> list[str]:
    """Return the sources that were loaded, and those that the fingerprints of the graph's nodes cover."""
    from nodegraph.plan import fingerprints

    codes = {(id(step.node), step.code): step for step in result.plan.network.steps}
    found = {str(path) for step in codes.values() for path in fingerprints().files(step.node, step.code)}
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in packages and (file := getattr(module, "__file__", None)):
            found.add(file)
    return sorted(found)


def _read_files(result: Result) -> list[str]:
    """Return every file that a needed node reads or would read if it were there."""
    steps = result.plan.network.steps
    entries = [entry for index in result.plan.needed for files in steps[index].files.values() for entry in files]
    return [str(candidate) for mark, path in entries for candidate in mark.candidates(path)]


def _read_as_planned(result: Result) -> bool:
    plan = result.plan
    return all(plan.files_unchanged(index) for index in plan.needed if plan.network.steps[index].files)


def _outputs(result: Result, folder: Path) -> list[dict[str, Any]]:
    plan, now = result.plan, time.time_ns()
    found: list[dict[str, Any]] = []
    for index in plan.needed:
        record = plan.record[index]
        for name, size, digest in record.files if record is not None else ():
            path = str(folder / name)
            signature = _signature(path)
            settled = signature is not None and _settled(signature, now)
            found.append({"path": path, "size": size, "digest": digest, "signature": signature if settled else None})
    return found


def _thin_out(folder: Path) -> None:
    """Keep the latest answers: a sweep over parameters would leave one for each value."""
    entries = [(entry.stat().st_mtime_ns, entry.path) for entry in os.scandir(folder)]
    if len(entries) > _KEPT_ANSWERS:
        for _, path in sorted(entries)[: len(entries) - _KEPT_ANSWERS // 2]:
            os.unlink(path)


# What is there now.


def _here() -> str:
    try:
        return os.getcwd()
    except OSError:  # the folder is gone; commands say so where it matters
        return ""


def _folder(arguments: list[str]) -> str:
    """Return the folder of the cache that a call names.

    A wrong guess does no harm: where it looks in another folder, it finds no answer to this call.
    """
    chosen = ""
    for position, argument in enumerate(arguments):
        if argument == "--cache-dir":
            chosen = arguments[position + 1]
        elif argument.startswith("--cache-dir="):
            chosen = argument.partition("=")[2]
    return os.path.join(chosen or default_cache_folder(), f"v{CACHE_VERSION}")


def _signature(path: str) -> Signature:
    try:
        status = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
    return [status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino, status.st_dev]


def _settled(signature: Signature, moment: int) -> bool:
    return signature is None or max(signature[1], signature[2]) < moment - _GRAIN_NS


def _names(folder: str) -> str:
    """Return a digest of the names in a folder of code, without what Python and editors put there."""
    names = [
        name for name in os.listdir(folder or ".") if not name.startswith(("__pycache__", ".")) and name[-1:] != "~"
    ]
    return _digest("\0".join(sorted(names)).encode("utf-8", "surrogateescape"))


def _installed(packages: list[str]) -> str:
    """Return a digest of the distributions in the folders of ``sys.path``, with their entry points."""
    parts: list[str] = []
    for folder in sys.path:
        try:
            names = sorted(os.listdir(folder or "."))
        except NotADirectoryError:
            parts.append(f"{folder} {_signature(folder)}")
            continue
        except FileNotFoundError:
            continue
        for name in names:
            stem, _, ending = name.rpartition(".")
            if ending in ("dist-info", "egg-info"):
                parts.append(f"{folder}/{name} {_text(f'{folder}/{name}/entry_points.txt')}")
            elif ending in ("pth", "egg-link", "egg") or (stem or name) in packages:
                parts.append(f"{folder}/{name}")
    return _digest("\0".join(parts).encode("utf-8", "surrogateescape"))


def _drivers() -> str:
    """Return a digest of what says which devices and drivers of OpenCL there are."""
    parts = [f"{path} {_signature(path)}" for path in _DRIVER_FILES]
    parts += [_text(path) for path in _DRIVER_TEXTS]
    for folder in _DRIVERS:
        if os.path.isdir(folder):
            parts += [f"{folder}/{name} {_text(f'{folder}/{name}')}" for name in sorted(os.listdir(folder))]
    if os.path.isdir("/dev"):
        parts += sorted(name for name in os.listdir("/dev") if name.startswith(("nvidia", "kfd")))
    return _digest("\0".join(parts).encode("utf-8", "surrogateescape"))


def _text(path: str) -> str:
    try:
        # Devices are only listed: opening one could block.
        if not os.path.isfile(path):
            return ""
        with open(path, "rb") as file:
            return file.read(1 << 16).decode("latin-1")
    except OSError:
        return ""


def _history(index: str, graph: str) -> str | None:
    """Return the checksum of what the cache's index notes as the latest run of a graph."""
    if not os.path.exists(index):
        return None
    connection = sqlite3.connect(index, timeout=0.2, isolation_level=None)
    try:
        row = connection.execute("SELECT sum FROM histories WHERE graph = ?", (graph,)).fetchone()
    finally:
        connection.close()
    return bytes(row[0]).hex() if row else None


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()
