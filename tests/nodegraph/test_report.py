"""The JSON report of a run."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from nodegraph import File, Graph, OutputName, node
from nodegraph.cache import Cache
from nodegraph.codec import seal
from nodegraph.plugins import Registry
from nodegraph.report import FORMAT, build, parse_shape, write
from nodegraph.run import run_graph


@node(version=3)
def array(*, n: int = 3) -> np.ndarray:
    """Give an array."""
    return np.zeros((n, 2), np.float32)


@node(version=1)
def total(values: np.ndarray) -> float:
    """Sum an array."""
    return float(values.sum())


@node(version=1)
def broken(values: np.ndarray) -> float:
    """Raise."""
    raise ValueError("no luck")


@node(version=1)
def after(x: float) -> float:
    """Come after."""
    return x


@node(version=1)
def save(x: float, *, name: OutputName = "x.txt") -> File:
    """Make a file."""
    return File.of(name, b"x")


@pytest.fixture
def graph() -> Graph:
    registry = Registry()
    for item in (array, total, broken, after, save):
        item.family = "rep"
        registry.register(item, "rep")
    graph = Graph("Reported", registry=registry)
    values = graph.add("rep.array", "a")
    sum_ = graph.add("rep.total", "t", values=values)
    graph.add("rep.after", "z", x=graph.add("rep.broken", "b", values=values))
    graph.add("rep.save", "f", x=sum_)
    return graph


def test_a_report_tells_what_became_of_every_node(graph, tmp_path):
    result = run_graph(graph, cache=Cache(tmp_path / "cache"), out=tmp_path / "out", check=False)
    report = build(graph, result, exit_status=1)
    assert report["report"] == FORMAT
    run = report["run"]
    assert run["exit_status"] == 1
    assert run["title"] == "Reported"
    assert run["device"] is None
    assert run["seconds"] > 0
    assert run["cancelled"] is False
    assert set(run["targets"]) == {"z.out", "f.out"}
    assert datetime.fromisoformat(run["start"]).tzinfo is not None
    assert {"nodegraph", "python", "numpy"} <= set(run["versions"])
    assert run["files"] == {"written": [str(tmp_path / "out" / "x.txt")], "kept": []}
    nodes = {item["id"]: item for item in report["nodes"]}
    assert {id: item["status"] for id, item in nodes.items()} == {
        "a": "computed",
        "t": "computed",
        "b": "failed",
        "z": "skipped",
        "f": "computed",
    }
    assert nodes["a"]["type"] == "rep.array"
    assert nodes["a"]["version"] == 3
    assert nodes["a"]["reason"] == "never computed"
    assert nodes["a"]["peak_bytes"] == 24
    digest = seal(np.zeros((3, 2), np.float32)).hex()
    assert nodes["a"]["outputs"] == [
        {"name": "out", "type": "Array", "shape": [3, 2], "dtype": "float32", "bytes": 24, "digest": digest}
    ]
    assert nodes["t"]["outputs"][0]["shape"] is None
    assert nodes["b"]["error"] == "no luck"
    assert nodes["b"]["outputs"] == []
    assert nodes["z"]["peak_bytes"] is None
    assert nodes["z"]["error"] is None


def test_cached_outputs_keep_their_shapes(graph, tmp_path):
    run_graph(graph, cache=Cache(tmp_path / "cache"), out=tmp_path / "out", check=False)
    result = run_graph(graph, ["f"], cache=Cache(tmp_path / "cache"), out=tmp_path / "out")
    report = build(graph, result, exit_status=0)
    nodes = {item["id"]: item for item in report["nodes"]}
    assert nodes["a"]["status"] == "cached"
    assert nodes["a"]["outputs"][0]["shape"] == [3, 2]
    assert nodes["a"]["outputs"][0]["dtype"] == "float32"
    assert report["run"]["files"]["kept"] == [str(tmp_path / "out" / "x.txt")]


def test_a_report_is_written_whole(tmp_path, monkeypatch):
    path = tmp_path / "r.json"
    write(path, {"a": "\u00fc"})
    assert json.loads(path.read_text("utf-8")) == {"a": "\u00fc"}

    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space"):
        write(path, {"a": 2})
    assert json.loads(path.read_text("utf-8")) == {"a": "\u00fc"}
    assert [item.name for item in tmp_path.iterdir()] == ["r.json"]


@pytest.mark.parametrize(
    ("text", "shape", "dtype"),
    [("(3,) float64", [3], "float64"), ("() int32", [], "int32"), ("(2, 0) <U3", [2, 0], "<U3"), ("", None, None)],
)
def test_shapes(text, shape, dtype):
    assert parse_shape(text) == (shape, dtype)


def test_without_a_cache_folder(graph):
    result = run_graph(graph, ["t"], cache=Cache(None))
    assert build(graph, result, exit_status=0)["run"]["cache"] is None
