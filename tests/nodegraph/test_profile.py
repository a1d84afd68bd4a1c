"""The Chrome trace of a run."""

from __future__ import annotations

import json
import time
from collections import defaultdict
from itertools import pairwise

import pytest

from nodegraph import Graph, node
from nodegraph.cache import Cache
from nodegraph.plugins import Registry
from nodegraph.profile import Profile
from nodegraph.run import run_graph


@node(version=1)
def nap(x: float | None = None, *, seconds: float = 0.02, number: int = 0) -> float:
    """Take a moment."""
    time.sleep(seconds)
    return float(number)


@node(version=1)
def wreck(x: float) -> float:
    """Raise."""
    raise ValueError("no luck")


def trace(graph: Graph, **options) -> dict:
    profile = Profile(graph.name)
    run_graph(graph, cache=Cache(None), observers=[profile], check=False, **options)
    return json.loads(json.dumps(profile.trace()))


@pytest.fixture
def graph() -> Graph:
    registry = Registry()
    for item in (nap, wreck):
        item.family = "prof"
        registry.register(item, "prof")
    graph = Graph("Profiled", registry=registry)
    first = graph.add("prof.nap", "first")
    for number in range(6):
        graph.add("prof.nap", f"n{number}", x=first, number=number)
    graph.add("prof.wreck", "bad", x=first)
    return graph


def test_every_node_is_a_slice_in_the_row_of_its_thread(graph):
    found = trace(graph, jobs=2)
    events = found["traceEvents"]
    slices = [event for event in events if event["ph"] == "X" and event["name"] != "compute"]
    assert {event["name"] for event in slices} == {"first", "bad", *(f"n{number}" for number in range(6))}
    rows = {event["tid"] for event in slices}
    assert rows <= {1, 2}
    named = {event["tid"]: event["args"]["name"] for event in events if event["name"] == "thread_name"}
    assert named == {row: f"worker {row}" for row in rows}
    assert [event["args"]["name"] for event in events if event["name"] == "process_name"] == ["nodegraph Profiled"]
    first = next(event for event in slices if event["name"] == "first")
    assert first["cat"] == "prof.nap"
    assert first["args"]["reason"] == "never computed"
    assert first["dur"] >= 20_000
    for event in slices:
        assert event["ts"] >= 0
        if event["name"] != "first":
            assert event["ts"] >= first["ts"] + 20_000
    bad = next(event for event in slices if event["name"] == "bad")
    assert bad["args"]["status"] == "failed"


def test_slices_of_a_thread_never_overlap_and_compute_lies_inside(graph):
    rows = defaultdict(list)
    inside = {}
    for event in trace(graph, jobs=3)["traceEvents"]:
        if event["ph"] == "X" and event["name"] != "compute":
            rows[event["tid"]].append((event["ts"], event["ts"] + event["dur"]))
        elif event["ph"] == "X":
            inside[event["tid"], event["ts"]] = event["ts"] + event["dur"]
    for row, spans in rows.items():
        spans.sort()
        for (_, end), (start, _) in pairwise(spans):
            assert end <= start + 0.002
        for start, end in spans:
            assert inside.get((row, start), end) <= end + 0.002


def test_the_file_is_what_viewers_read(graph, tmp_path):
    profile = Profile("p")
    run_graph(graph, cache=Cache(None), observers=[profile], check=False)
    profile.write(tmp_path / "p.json")
    data = json.loads((tmp_path / "p.json").read_text())
    assert data["displayTimeUnit"] == "ms"
    for event in data["traceEvents"]:
        assert {"name", "ph", "pid", "tid"} <= set(event)
        assert event["ph"] in "XM"


def test_nothing_computed_is_an_empty_trace():
    profile = Profile("p")
    assert [event["name"] for event in profile.trace()["traceEvents"]] == ["process_name"]


def test_kernels_of_a_device(graph, monkeypatch):
    """The device's own timings, where the run has one."""
    from contextlib import contextmanager

    from nodegraph.events import Planned
    from nodegraph.opencl import KernelTiming

    class Timings:
        def rows(self):
            return [KernelTiming("smooth.cl", "rows", 2, 0.1, 0.2, 0.3, 0.4)]

    class Device:
        @contextmanager
        def timings(self):
            yield Timings()

    class Plan:
        device = Device()

    profile = Profile("p")
    profile(Planned(Plan()))
    (row,) = profile.trace()["otherData"]["kernels"]
    assert row["kernel"] == "rows"
    assert row["total ms"] == 400.0
