"""A small plugin in a folder of its own, installed as pip would leave it, and ways to call the program."""

from __future__ import annotations

import importlib.metadata
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from nodegraph.cli import direct, main
from nodegraph.plan import fingerprints
from nodegraph.plugins import registry

PLUGIN = '''"""The plugin."""

from nodegraph import Family, Migration, Preview, hookimpl


@hookimpl
def nodegraph_families():
    return [Family("acme", modules=("acme.nodes",))]


@hookimpl
def nodegraph_migrations():
    return [Migration("acme.factor", 2, new_type="acme.scale", parameters={"f": "by"})]


@hookimpl
def nodegraph_previews():
    from acme.nodes import Picture

    return [Preview(Picture, lambda value: b"\\x89PNG " + value.text.encode())]
'''

NODES = '''"""The nodes."""

import os
import time
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from acme.helper import OFFSET
from nodegraph import Context, File, InputFile, OutputName, Param, node, port_type, whole


@port_type
class Picture:
    """A picture, as it were."""

    text: str


def note(name):
    if path := os.environ.get("ACME_LOG"):
        with open(path, "a") as file:
            file.write(name + "\\n")


@node(version=1)
def number(
    *, value: Annotated[float, Param("What it gives.", ge=-1e6, le=1e6, unit="m")] = 1.0, seed: int = 0
) -> float:
    """Give a number, slowly enough to be worth storing."""
    note("number")
    time.sleep(0.02)
    return value + OFFSET


@node(version=2, title="Scale up")
def scale(x: float, *, by: Annotated[float, Param("The factor.")] = 2.0) -> float:
    """Multiply a number.

    Long words about multiplying.
    """
    note("scale")
    return x * by


@node(version=1, locality=whole)
def grid(x: float | None = None, *, n: int = 4, mode: Literal["flat", "steep"] = "flat", label: str = "") -> np.ndarray:
    """Give an array."""
    note("grid")
    return np.full((n, n), x or 0.0, np.float32)


@node(version=1)
def add(*terms: float) -> float:
    """Add numbers."""
    return float(sum(terms))


@node(version=1)
def fails(x: float | None = None) -> float:
    """Raise."""
    raise ValueError("no luck")


@node(version=1)
def lies(x: float | None = None) -> float:
    """Return another type."""
    return "text"


@node(version=1)
def reader(*, path: Annotated[Path, InputFile(sidecars=(".prj",))]) -> str:
    """Read a text."""
    note("reader")
    sidecar = path.with_suffix(".prj")
    return path.read_text() + (sidecar.read_text() if sidecar.exists() else "")


@node(version=1)
def export(x: float, *, name: OutputName = "x.txt") -> File:
    """Make a text file."""
    note("export")
    return File.of(name, f"{x:g}\\n".encode())


@node(version=1)
def draw(x: float) -> Picture:
    """Draw a number."""
    return Picture(f"{x:g}")


@node(version=1)
def patient(x: float | None = None, *, seconds: float = 30.0, context: Context) -> float:
    """Take long and answer to a cancel."""
    note("patient")
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        context.progress(0.5, "waiting")
        time.sleep(0.02)
    return 1.0


@node(version=1)
def stubborn(x: float | None = None, *, seconds: float = 30.0) -> float:
    """Take long and hear nothing."""
    note("stubborn")
    time.sleep(seconds)
    return 1.0
'''


class Done(NamedTuple):
    """How a call ended."""

    status: int
    out: str
    err: str


def write_plugin(folder: Path) -> Path:
    """Write the plugin below a folder, installed."""
    (folder / "acme").mkdir(parents=True)
    (folder / "acme" / "__init__.py").write_text('"""Acme."""\n')
    (folder / "acme" / "plugin.py").write_text(PLUGIN)
    (folder / "acme" / "nodes.py").write_text(NODES)
    (folder / "acme" / "helper.py").write_text("OFFSET = 0.0\n")
    info = folder / "acme-1.5.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.5\n")
    (info / "entry_points.txt").write_text("[nodegraph]\nacme = acme.plugin\n")
    return folder


@pytest.fixture(scope="session")
def plugin_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the plugin; nobody changes it."""
    return write_plugin(tmp_path_factory.mktemp("site"))


@pytest.fixture
def own_plugin(tmp_path: Path) -> Path:
    """Return a folder with the plugin for one test."""
    return write_plugin(tmp_path / "site")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in an empty folder, with a cache of its own."""
    folder = tmp_path / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("NODEGRAPH_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("ACME_LOG", str(tmp_path / "log"))
    for name in ("NO_COLOR", "_NODEGRAPH_COMPLETE"):
        monkeypatch.delenv(name, raising=False)
    return folder


def _forget() -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "acme"]:
        del sys.modules[name]
    registry.cache_clear()
    fingerprints.cache_clear()


@pytest.fixture
def acme(plugin_folder: Path, here: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Have the plugin, and no other, in this process."""
    monkeypatch.syspath_prepend(str(plugin_folder))
    points = [
        point
        for found in importlib.metadata.distributions(path=[str(plugin_folder)])
        for point in found.entry_points
        if point.group == "nodegraph"
    ]
    monkeypatch.setattr("nodegraph.plugins.entry_points", lambda group: points)
    _forget()
    yield
    _forget()


@pytest.fixture
def cli(acme: None, capsys: pytest.CaptureFixture[str]) -> Callable[..., Done]:
    """Return a function that calls the program in this process."""

    def call(*arguments: object) -> Done:
        capsys.readouterr()
        status = main([str(item) for item in arguments])
        out, err = capsys.readouterr()
        return Done(status, out, err)

    return call


@pytest.fixture
def program(here: Path, plugin_folder: Path) -> Callable[..., Done]:
    """Return a function that calls the program in a process of its own."""

    def call(*arguments: object, site: Path = plugin_folder, env: dict[str, str] | None = None) -> Done:
        done = subprocess.run(
            [sys.executable, "-m", "nodegraph", *map(str, arguments)],
            capture_output=True,
            text=True,
            timeout=60,
            env={**os.environ, "PYTHONPATH": str(site), **(env or {})},
            check=False,
        )
        return Done(done.returncode, done.stdout, done.stderr)

    return call


@pytest.fixture
def ran(tmp_path: Path) -> Callable[[], list[str]]:
    """Return a function that says which nodes ran since it was last asked."""

    def names() -> list[str]:
        log = tmp_path / "log"
        text = log.read_text() if log.exists() else ""
        log.write_text("")
        return sorted(text.split())

    return names


@pytest.fixture
def answered(monkeypatch: pytest.MonkeyPatch) -> Callable[[], bool]:
    """Return a function that says whether the last call was answered directly; young files are trusted."""
    monkeypatch.setattr(direct, "_GRAIN_NS", 0)
    found: list[bool] = []
    say = direct.say

    def saying(*arguments: Any) -> int:
        found.append(True)
        return say(*arguments)

    monkeypatch.setattr(direct, "say", saying)

    def last() -> bool:
        was = bool(found)
        found.clear()
        # The next change must carry another time, and the next run must begin after it.
        time.sleep(0.02)
        return was

    return last


def graph(path: Path | str, nodes: dict[str, Any], **more: Any) -> Path:
    """Write a graph file."""
    path = Path(path)
    path.write_text(json.dumps({"format": "nodegraph/1", **more, "nodes": nodes}))
    return path


@pytest.fixture
def write_graph() -> Callable[..., Path]:
    """Return a function that writes a graph file."""
    return graph


@pytest.fixture
def pair(here: Path) -> Path:
    """Return a graph: number -> scale -> export."""
    return graph(
        "pair.json",
        {
            "a": {"type": "acme.number", "params": {"value": 3}},
            "b": {"type": "acme.scale", "inputs": {"x": "a"}},
            "file": {"type": "acme.export", "inputs": {"x": "b"}},
        },
        title="A pair",
        parameters={"factor": {"default": 2, "drives": ["b.by"]}},
    )
