"""Nodes of the family ``toy`` that count their own calls, a registry of them, and small helpers.

Counting makes caching itself an assertion: a test says which nodes ran, not only what came out.
"""

from __future__ import annotations

import subprocess
import sys
import textwrap
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np

from nodegraph import Context, File, Graph, InputPath, Node, OutputName, Param, node, port_type
from nodegraph.cache import Cache
from nodegraph.plugins import Family, Migration, Registry, hookimpl

CALLS: list[str] = []
"""Names of the toy nodes that ran since the test began, in order."""

STORED_SECONDS = 0.03
"""A toy node that sleeps this long is worth storing on disk."""


@port_type
class Surface:
    """A toy raster."""

    data: np.ndarray
    size: float = 1.0


@port_type
class Height(Surface):
    """A surface in metres."""


@port_type
class Cover(Surface):
    """A surface of 0..1."""


@port_type
class Word:
    """A text of its own type."""

    text: str


S = TypeVar("S", bound=Surface)


class Halves(NamedTuple):
    """A value in two parts."""

    low: float
    high: float


def counted(name: str) -> None:
    """Note that a toy node ran."""
    CALLS.append(name)


@node(version=1)
def number(*, value: Annotated[float, Param("What it gives.", unit="m")] = 1.0, tag: str = "") -> float:
    """Give a number."""
    counted("number")
    return value


@node(version=1)
def add(*terms: float) -> float:
    """Add numbers."""
    counted("add")
    return float(sum(terms))


@node(version=1)
def subtract(a: float, b: float) -> float:
    """Take b from a."""
    counted("subtract")
    return a - b


@node(version=1)
def increase(x: float, *, by: Annotated[float, Param("How much.", ge=0, le=1e9)] = 1.0) -> float:
    """Add to a number."""
    counted("increase")
    return x + by


@node(version=1)
def parity(x: float) -> float:
    """Give the remainder of a division by two: many inputs, few outputs."""
    counted("parity")
    return x % 2


@node(version=1)
def halves(x: float) -> Halves:
    """Split a number at its integer part."""
    counted("halves")
    return Halves(x // 1, x % 1)


@node(version=1)
def maybe(x: float, y: float | None = None) -> float:
    """Add y where it is linked."""
    counted("maybe")
    return x if y is None else x + y


@node(version=1)
def join(first: float, *rest: float, sep: str = ",") -> str:
    """Write numbers in the order of the links."""
    counted("join")
    return sep.join(f"{item:g}" for item in (first, *rest))


@node(version=1)
def height(*, n: Annotated[int, Param("Cells per side.", ge=0)] = 3, value: float = 1.0) -> Height:
    """Give a height."""
    counted("height")
    return Height(np.full((n, n), value, np.float32), float(n))


@node(version=1)
def cover(*, n: int = 3) -> Cover:
    """Give a cover."""
    counted("cover")
    return Cover(np.zeros((n, n), np.float32))


@node(version=1)
def double(surface: S) -> S:
    """Double a surface and keep its role."""
    counted("double")
    return type(surface)(surface.data * 2, surface.size)


@node(version=1)
def steepness(height: Height) -> float:
    """Take a height and nothing else."""
    counted("steepness")
    return float(np.abs(np.diff(height.data)).max(initial=0.0))


@node(version=1)
def mean(surface: Surface) -> float:
    """Take any surface."""
    counted("mean")
    return float(surface.data.mean()) if surface.data.size else 0.0


@node(version=1)
def letters(word: Word) -> float:
    """Count letters."""
    counted("letters")
    return float(len(word.text))


@node(version=1)
def slow(x: float | None = None, *, seconds: float = STORED_SECONDS, value: float = 0.0, size: int = 8) -> np.ndarray:
    """Take its time, so that its result is worth storing."""
    counted("slow")
    time.sleep(seconds)
    return np.full(size, value if x is None else x)


@node(version=1)
def peak(values: np.ndarray) -> float:
    """Give the largest number."""
    counted("peak")
    return float(values.max())


@node(version=1)
def fails(x: float | None = None, *, message: str = "no luck") -> float:
    """Raise."""
    counted("fails")
    raise ValueError(message)


@node(version=1)
def lies(x: float | None = None) -> float:
    """Return another type than it declares."""
    counted("lies")
    return "a text"  # type: ignore[return-value]


@node(version=1)
def vandal(values: np.ndarray) -> np.ndarray:
    """Try to change its input."""
    counted("vandal")
    values += 1
    return values


@node(version=1)
def read(*, path: InputPath) -> str:
    """Read a text file."""
    counted("read")
    return path.read_text()


@node(version=1)
def export(x: float, *, name: OutputName = "x.txt") -> File:
    """Make a text file with a sidecar."""
    counted("export")
    return File.of(name, f"{x:g}\n".encode(), File.of(f"{name}.json", b'{"x": %g}' % x))


class Gate:
    """Lets a test meet a node while it runs."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Close the gate."""
        self.entered = threading.Event()
        self.leave = threading.Event()


GATE = Gate()


@node(version=1)
def patient(x: float | None = None, *, context: Context) -> float:
    """Wait at the gate, answering to a cancel."""
    counted("patient")
    GATE.entered.set()
    while not GATE.leave.wait(0.01):
        context.progress(0.5, "waiting")
    return 1.0 if x is None else x


@node(version=1)
def stubborn(x: float | None = None) -> float:
    """Wait at the gate and hear nothing."""
    counted("stubborn")
    GATE.entered.set()
    GATE.leave.wait(20)
    return 1.0 if x is None else x


NODES: tuple[Node[..., Any], ...] = tuple([item for item in list(globals().values()) if isinstance(item, Node)])


def toy_registry(*more: Node[..., Any], family: str = "toy") -> Registry:
    """Return a registry of all toy nodes, and `more` of the same family, with no plugin."""
    found = Registry()
    for item in NODES:
        item.family = "toy"
        found.register(item, "toy")
    for item in more:
        item.family = family
        found.register(item, family)
    return found


def toy_graph(*more: Node[..., Any], title: str = "toys") -> Graph:
    """Return an empty graph that knows the toy nodes."""
    return Graph(title, registry=toy_registry(*more))


def ran() -> dict[str, int]:
    """Return how often each toy node ran, and start counting anew."""
    counts = dict(Counter(CALLS))
    CALLS.clear()
    return counts


def statuses(result: Any) -> dict[str, str]:
    """Return the status of each node of a run."""
    return {id: run.status for id, run in result.nodes.items()}


def reasons(result: Any) -> dict[str, str]:
    """Return the reason of each node of a run."""
    return {id: run.reason for id, run in result.nodes.items()}


def plugin(
    name: str,
    *,
    version: str = "1.0",
    families: Callable[[], Any] | None = None,
    port_types: Callable[[], Any] | None = None,
    conversions: Callable[[], Any] | None = None,
    previews: Callable[[], Any] | None = None,
    formats: Callable[[], Any] | None = None,
    migrations: Callable[[], Any] | None = None,
) -> ModuleType:
    """Return a plugin module with the given hooks."""
    module = ModuleType(name)
    module.__version__ = version  # type: ignore[attr-defined]
    hooks: Mapping[str, Callable[[], Any] | None] = {
        "nodegraph_families": families,
        "nodegraph_port_types": port_types,
        "nodegraph_conversions": conversions,
        "nodegraph_previews": previews,
        "nodegraph_formats": formats,
        "nodegraph_migrations": migrations,
    }
    for hook, function in hooks.items():
        if function is not None:
            setattr(module, hook, hookimpl(specname=hook)(function))
    return module


def with_migrations(*items: Migration, nodes: tuple[Node[..., Any], ...] = ()) -> Registry:
    """Return a registry of the toy nodes and one plugin, of the family ``new``, with migrations."""
    found = toy_registry()
    for item in nodes:
        item.family = "new"
    families = (lambda: [Family("new", nodes=nodes)]) if nodes else None
    found.add(plugin("renamer", families=families, migrations=lambda: list(items)))
    return found


def python(code: str, *arguments: object, cwd: Path | None = None, check: bool = True) -> str:
    """Run Python code in a fresh process and return what it prints; warnings are errors there, too."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(code), *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=60,
        check=False,
    )
    if check and done.returncode:
        raise AssertionError(f"exit {done.returncode}\n{done.stdout}\n{done.stderr}")
    return done.stdout + (done.stderr if not check else "")


def memory_cache(budget: int = 1 << 30) -> Cache:
    """Return a cache in memory only."""
    return Cache(None, memory_budget=budget)


def warm_up() -> None:
    """Load everything a run needs, for a process that is about to lose the right to read it."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        for _ in range(2):
            cache = Cache(folder, memory_budget=0)
            graph = toy_graph()
            graph.add("toy.peak", values=graph.add("toy.slow"))
            graph.run(["slow", "peak"], cache=cache)["slow"]
            cache.close()
    ran()
