"""A plugin by strangers: built, installed beside the project's own wheel, run, upgraded, and taken away again."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
UV = os.environ.get("UV") or shutil.which("uv")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(UV is None, reason="builds and installs with uv"),
]

OLD_GRAPH = """\
{
  "format": "nodegraph/1",
  "title": "A tune of the old days",
  "requires": {"acme_sound": ">=0.1"},
  "parameters": {"up": {"default": 5, "drives": ["higher.semitones"]}},
  "nodes": {
    "tune": {"type": "acme.scale", "version": 1, "params": {"notes": 9, "tempo": 150}},
    "higher": {"type": "acme.transpose", "version": 1, "inputs": {"melody": "tune"}},
    "by_hand": {"type": "acme.transpose", "inputs": {"melody": "higher"}, "params": {"semitones": -2}},
    "volume": {"type": "acme.loudness", "inputs": {"wave": "by_hand"}},
    "file": {"type": "acme.write_tune", "inputs": {"melody": "by_hand"}, "params": {"name": "deep/tune.txt"}}
  },
  "layout": {"tune": [0, 0], "higher": [200, 0]}
}
"""
NEW_NODES = """\
{
  "tune": {"type": "acme.scale", "version": 2, "params": {"notes": 9, "tempo": 0.4}},
  "higher": {"type": "acme.shift", "version": 2, "inputs": {"melody": "tune"}},
  "by_hand": {"type": "acme.shift", "version": 2, "inputs": {"melody": "higher"}, "params": {"interval": -2}},
  "volume": {"type": "acme.loudness", "inputs": {"wave": "by_hand"}},
  "file": {"type": "acme.write_tune", "inputs": {"melody": "by_hand"}, "params": {"name": "deep/tune.txt"}}
}
"""
PITCHES = [60, 62, 64, 65, 67, 69, 71, 72, 74]
TUNE = "".join(f"{pitch + 3} 0.4\n" for pitch in PITCHES)


def in_order(text: str, *, parameters: list[str] | None = None, nodes: dict[str, Any] | None = None) -> str:
    """Return a graph as text that shows its data and their order; whether a version 1 is said does not matter."""
    data = json.loads(text)
    if parameters is not None:
        data["parameters"]["up"]["drives"] = parameters
    if nodes is not None:
        data["nodes"] = nodes
    for record in data["nodes"].values():
        if record.get("version") == 1:
            del record["version"]
    return json.dumps(data)


def call(*command: str | Path, cwd: Path, env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(item) for item in command], cwd=cwd, env=env, capture_output=True, text=True, timeout=600, check=False
    )


def uv(*arguments: str | Path, cwd: Path) -> None:
    assert UV is not None
    done = call(UV, *arguments, cwd=cwd)
    assert done.returncode == 0, f"uv {' '.join(map(str, arguments))}\n{done.stdout}{done.stderr}"


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The wheels of the project and of the plugins, built as their authors would."""
    found = {}
    for name, source in {"nodegraph": ROOT, **{item.name: item for item in HERE.glob("acme_*")}}.items():
        folder = tmp_path_factory.mktemp(name)
        uv("build", "--quiet", "--wheel", "--python", sys.executable, "--out-dir", folder, source, cwd=folder)
        (found[name],) = folder.glob("*.whl")
    return found


@dataclass
class Environment:
    """A fresh environment with nodegraph in it, in a folder where commands run."""

    folder: Path
    home: Path

    @property
    def python(self) -> Path:
        return self.home / ("Scripts/python.exe" if os.name == "nt" else "bin/python")

    @property
    def variables(self) -> dict[str, str]:
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "PYTEST", "VIRTUAL"))}
        return {**kept, "NODEGRAPH_CACHE_DIR": str(self.folder / "cache"), "COLUMNS": "200"}

    def install(self, *wheels: Path, alone: bool = False) -> None:
        uv(
            "pip",
            "install",
            "--quiet",
            "--python",
            self.python,
            *(["--no-deps"] if alone else []),
            *wheels,
            cwd=self.home,
        )

    def uninstall(self, *names: str) -> None:
        uv("pip", "uninstall", "--quiet", "--python", self.python, *names, cwd=self.home)

    def nodegraph(self, *arguments: str | Path, status: int = 0) -> subprocess.CompletedProcess[str]:
        done = call(self.python.with_name("nodegraph"), *arguments, cwd=self.folder, env=self.variables)
        assert done.returncode == status, f"exit {done.returncode}\n{done.stdout}{done.stderr}"
        assert "Traceback" not in done.stderr
        return done

    def run(self, *arguments: str | Path) -> dict[str, Any]:
        """Run a graph and return the report's nodes by id."""
        report = self.folder / "report.json"
        done = self.nodegraph("run", *arguments, "--report", report)
        assert done.stderr == ""
        return {item["id"]: item for item in json.loads(report.read_text())["nodes"]}

    def pytest(self, tests: Path, copy: Path) -> str:
        """Run a plugin's own tests, where no other project's settings apply, and return the last line."""
        shutil.copytree(tests, copy)
        done = call(self.python, "-m", "pytest", "-q", "-W", "error", copy, cwd=copy, env=self.variables)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def environment(wheels: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Environment:
    folder = tmp_path_factory.mktemp("place")
    made = Environment(folder, folder / "environment")
    uv("venv", "--quiet", "--python", sys.executable, made.home, cwd=folder)
    assert UV is not None
    uv("pip", "install", "--quiet", "--python", made.python, wheels["nodegraph"], "pytest", cwd=folder)
    return made


@pytest.fixture
def acme(environment: Environment, wheels: dict[str, Path]) -> Iterator[Environment]:
    """The environment with version 1 of the plugin, whatever is installed at the end."""
    environment.install(wheels["acme_v1"])
    yield environment
    environment.uninstall("acme-sound")


def test_the_wheel_of_the_project_is_whole(wheels: dict[str, Path]) -> None:
    with zipfile.ZipFile(wheels["nodegraph"]) as wheel:
        names = set(wheel.namelist())
        (entries,) = [wheel.read(name).decode() for name in names if name.endswith("entry_points.txt")]
        (metadata,) = [wheel.read(name).decode() for name in names if name.endswith("METADATA")]
    sources = [ROOT / "nodegraph", *(path for path in (ROOT / "plugins").iterdir() if (path / "plugin.py").exists())]
    for source in sources:
        files = [path for path in source.rglob("*") if path.suffix in (".py", ".cl", ".clh", ".h", ".typed")]
        assert {str(path.relative_to(source.parent)) for path in files} <= names
        assert f"{source.name}/py.typed" in names
        if source.name != "nodegraph":
            assert re.search(rf"^{source.name} = ", entries, re.MULTILINE)
    assert "nodegraph = nodegraph.cli:main" in entries
    assert "[pytest11]\nnodegraph = nodegraph.testing.pytest_plugin" in entries
    assert not any(name.startswith(("tests", "benchmarks", "graphs", "plugins")) for name in names)
    assert "License-Expression: MIT" in metadata


def test_the_project_runs_from_its_wheel(environment: Environment) -> None:
    done = environment.nodegraph("plugins")
    assert "nodegraph_terrain" in done.stdout
    assert str(environment.home) in done.stdout
    if (graph := ROOT / "graphs" / "first_light.json").exists():
        environment.nodegraph("run", graph, "--out", environment.folder / "first light")
        assert any((environment.folder / "first light").rglob("*.png"))


def test_a_plugin_from_install_to_uninstall(acme: Environment, wheels: dict[str, Path]) -> None:
    old = acme.folder / "old.json"
    old.write_text(OLD_GRAPH)
    written = acme.folder / "out" / "old" / "deep" / "tune.txt"

    # Installed: it is listed, and explains its nodes.
    listed = acme.nodegraph("plugins")
    assert re.search(r"acme_sound +0\.1\.0 +acme \(5 nodes\)", listed.stdout)
    assert listed.stderr == ""
    assert "acme.transpose" in acme.nodegraph("nodes", "acme").stdout
    assert "How far upwards." in acme.nodegraph("nodes", "acme.transpose").stdout
    assert "Melody" in acme.nodegraph("types").stdout

    # It runs, converts, is cached and drawn.
    first = acme.run(old)
    assert {item["status"] for item in first.values()} == {"computed"}
    assert any(item["type"] == "acme.as_wave" for item in first.values())
    assert written.read_text() == TUNE
    assert {item["status"] for item in acme.run(old).values()} == {"cached"}
    acme.nodegraph("preview", old, "tune", "-o", acme.folder / "tune.png")
    assert (acme.folder / "tune.png").read_bytes().startswith(b"\x89PNG")
    assert "passed" in acme.pytest(HERE / "acme_v1" / "tests", acme.folder / "tests of v1")

    # Version 2 renames a node and a parameter and changes what another means: the old graph gives the same.
    acme.install(wheels["acme_v2"], alone=True)
    assert re.search(r"acme_sound +0\.2\.0", acme.nodegraph("plugins").stdout)
    written.unlink()
    second = acme.run(old)
    assert written.read_text() == TUNE
    assert [item["type"] for item in second.values()].count("acme.shift") == 2
    for name in ("tune", "higher", "by_hand", "volume", "file"):
        digests = [[output["digest"] for output in nodes[name]["outputs"]] for nodes in (first, second)]
        assert digests[0] == digests[1], name
    acme.run(old, "--set", "up=6")
    assert written.read_text().startswith("64 0.4\n")
    assert old.read_text() == OLD_GRAPH
    assert "passed" in acme.pytest(HERE / "acme_v2" / "tests", acme.folder / "tests of v2")

    # Upgraded: the difference is shown, the file rewritten, and it still gives the same.
    diff = acme.nodegraph("upgrade", old).stdout
    assert '-    "higher": {"type": "acme.transpose", "version": 1, "inputs": {"melody": "tune"}},' in diff
    assert '+    "higher": {"type": "acme.shift", "version": 2, "inputs": {"melody": "tune"}},' in diff
    upgraded = old.read_text()
    assert in_order(upgraded) == in_order(OLD_GRAPH, parameters=["higher.interval"], nodes=json.loads(NEW_NODES))
    assert "up to date" in acme.nodegraph("upgrade", old).stdout
    acme.run(old)
    assert written.read_text() == TUNE

    # Taken away: the graph keeps everything, can be shown, and says what to install.
    acme.uninstall("acme-sound")
    assert "acme" not in acme.nodegraph("plugins").stdout
    assert "acme.shift" in acme.nodegraph("show", old).stdout
    for command in ("run", "validate", "plan"):
        done = acme.nodegraph(command, old, status=2)
        assert "acme_sound" in done.stderr
        assert "install" in done.stderr
    resave = "import sys; from nodegraph import Graph; Graph.load(sys.argv[1]).save(sys.argv[2])"
    done = call(acme.python, "-c", resave, old, acme.folder / "again.json", cwd=acme.folder, env=acme.variables)
    assert done.returncode == 0, done.stderr
    assert (acme.folder / "again.json").read_bytes() == old.read_bytes()
    assert "up to date" in acme.nodegraph("upgrade", old).stdout
    assert old.read_text() == upgraded
    acme.install(wheels["acme_v2"], alone=True)
    assert {item["status"] for item in acme.run(old).values()} == {"cached"}


def test_a_format_from_install_to_uninstall(acme: Environment, wheels: dict[str, Path]) -> None:
    """A stranger teaches terrain.load_elevation and save_elevation a format of its own."""
    graph, written = acme.folder / "songs.json", acme.folder / "out" / "songs" / "higher.song"
    (acme.folder / "hills.song").write_text("60 62 64\n65 67 69\n")
    nodes: dict[str, Any] = {
        "hills": {"type": "terrain.load_elevation", "params": {"path": "hills.song"}},
        "higher": {"type": "terrain.add", "inputs": {"surface": "hills"}, "params": {"constant": 4.0}},
        "file": {"type": "terrain.save_elevation", "inputs": {"surface": "higher"}, "params": {"name": "higher.song"}},
        "tif": {"type": "terrain.save_elevation", "inputs": {"surface": "hills"}, "params": {"name": "hills.tif"}},
        "again": {"type": "terrain.load_elevation", "params": {"path": "plain.asc"}},
    }
    (acme.folder / "plain.asc").write_text("ncols 2\nnrows 1\nxllcorner 0\nyllcorner 0\ncellsize 30\n1 2\n")
    graph.write_text(json.dumps({"format": "nodegraph/1", "nodes": nodes}))

    # Installed: it is listed, reads and writes, and is cached.
    assert re.search(r"Raster +Song +\.song +\.song +acme_sound", acme.nodegraph("types").stdout)
    first = acme.run(graph)
    assert {item["status"] for item in first.values()} == {"computed"}
    assert written.read_text() == "64 66 68\n69 71 73\n"
    assert {item["status"] for item in acme.run(graph).values()} == {"cached"}
    for _ in range(2):
        assert "5 nodes: 5 cached" in acme.nodegraph("run", graph).stdout

    # Another version reads and writes in another way: what it had a hand in is computed again, and nothing else.
    acme.install(wheels["acme_v2"], alone=True)
    second = acme.run(graph)
    assert second["hills"]["reason"] == "code changed"
    assert second["file"]["reason"] == "code changed; input surface changed"
    assert second["tif"]["reason"] == "input surface changed"
    assert second["again"]["status"] == "cached"
    assert written.read_text() == "62 64 66\n67 69 71\n"
    assert "5 nodes: 5 cached" in acme.nodegraph("run", graph).stdout

    # Taken away: what would be written is refused before anything runs, what is read says what can be.
    acme.uninstall("acme-sound")
    done = acme.nodegraph("run", graph, status=2)
    assert "node 'file': parameter 'name': 'higher.song' ends in '.song'; choose one of .tif, .png" in done.stderr
    del nodes["file"]
    graph.write_text(json.dumps({"format": "nodegraph/1", "nodes": nodes}))
    done = acme.nodegraph("run", graph, "--target", "hills", status=1)
    assert "'hills.song' is no raster that can be read; expected GeoTIFF" in done.stderr


def test_a_graph_without_requires_names_the_family(environment: Environment) -> None:
    graph = environment.folder / "bare.json"
    graph.write_text('{"format": "nodegraph/1", "nodes": {"tune": {"type": "acme.scale"}}}')
    done = environment.nodegraph("run", graph, status=2)
    assert "node 'tune'" in done.stderr
    assert "install the plugin that brings the family 'acme'" in done.stderr


def test_a_plugin_that_cannot_be_imported_is_only_a_warning(acme: Environment, wheels: dict[str, Path]) -> None:
    graph = acme.folder / "whole.json"
    graph.write_text(OLD_GRAPH)
    acme.install(wheels["acme_broken"], alone=True)
    try:
        done = acme.nodegraph("plugins")
        assert re.search(r"acme_broken +3\.1\.4 +left out: .*a_library_that_nobody_installed", done.stdout)
        assert "acme_sound" in done.stdout
        done = acme.nodegraph("run", graph, "--out", acme.folder / "beside broken")
        (warning,) = done.stderr.splitlines()
        assert warning.startswith("warning: plugin 'acme_broken' 3.1.4 is left out: ")
        assert "a_library_that_nobody_installed" in warning
        assert (acme.folder / "beside broken" / "deep" / "tune.txt").read_text() == TUNE
    finally:
        acme.uninstall("acme-broken")
    assert acme.nodegraph("run", graph, "--out", acme.folder / "beside broken").stderr == ""
