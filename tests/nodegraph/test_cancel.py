"""Cancelling: a run stops within a second and keeps what is finished."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from nodegraph import Cancelled, Graph, node
from nodegraph.cache import Cache
from nodegraph.run import run_graph
from tests.nodegraph import support as toy


@pytest.fixture(autouse=True)
def _gate() -> Iterator[None]:
    toy.ran()
    toy.GATE.reset()
    yield
    toy.GATE.leave.set()


def cancelled_run(graph: Graph, cache: Cache, **options: Any) -> tuple[Any, float]:
    """Cancel a run once a node waits at the gate; return its result and the seconds until it ended."""
    cancel = threading.Event()
    since: list[float] = []

    def stop() -> None:
        assert toy.GATE.entered.wait(10)
        since.append(time.perf_counter())
        cancel.set()

    thread = threading.Thread(target=stop)
    thread.start()
    result = run_graph(graph, cache=cache, cancel=cancel, check=False, **options)
    ended = time.perf_counter()
    thread.join()
    return result, ended - since[0]


def around(kind: str) -> Graph:
    graph = toy.toy_graph()
    graph.add("toy.number", "before", value=5.0)
    graph.add(f"toy.{kind}", "waits", x="before")
    graph.add("toy.increase", "after", x="waits")
    return graph


@pytest.mark.parametrize("jobs", [1, 3])
def test_a_node_that_reports_progress_stops_at_once(jobs: int) -> None:
    cache = toy.memory_cache()
    result, seconds = cancelled_run(around("patient"), cache, jobs=jobs)
    assert seconds < 0.7
    assert result.cancelled
    assert not result.ok
    assert toy.statuses(result) == {"before": "computed", "waits": "cancelled", "after": "cancelled"}
    assert result.errors == ()
    toy.ran()
    toy.GATE.leave.set()
    again = around("patient").run(cache=cache)
    assert again["after"] == 6.0
    assert toy.statuses(again)["before"] == "cached", "what was finished is kept"
    assert toy.ran() == {"patient": 1, "increase": 1}


def test_a_node_that_hears_nothing_is_left_behind(caplog: pytest.LogCaptureFixture) -> None:
    result, seconds = cancelled_run(around("stubborn"), toy.memory_cache())
    assert seconds < 1.3
    assert toy.statuses(result) == {"before": "computed", "waits": "cancelled", "after": "cancelled"}
    assert "node 'waits' did not stop within a second" in caplog.text
    toy.GATE.leave.set()
    time.sleep(0.1)
    assert toy.statuses(result)["waits"] == "cancelled", "what comes too late changes nothing"
    assert toy.ran() == {"number": 1, "stubborn": 1}


@node(version=1)
def short(x: float, *, which: int) -> float:
    """Take a little time and report nothing."""
    toy.counted("short")
    toy.GATE.entered.set()
    time.sleep(0.03)
    return x + which


def test_no_node_begins_after_a_cancel() -> None:
    graph = toy.toy_graph(short)
    last = graph.add("toy.number")
    for which in range(60):
        last = graph.add(short, x=last, which=which)
    result, seconds = cancelled_run(graph, toy.memory_cache(), jobs=2)
    assert seconds < 0.5
    assert toy.ran()["short"] < 6
    assert result.cancelled


def test_a_cancel_before_the_run_computes_nothing() -> None:
    cancel = threading.Event()
    cancel.set()
    with pytest.raises(Cancelled, match="what was finished is kept"):
        run_graph(around("patient"), cache=toy.memory_cache(), cancel=cancel)
    assert toy.ran() == {}


def test_a_cancel_after_the_run_changes_nothing() -> None:
    cancel = threading.Event()
    toy.GATE.leave.set()
    result = run_graph(around("patient"), cache=toy.memory_cache(), cancel=cancel)
    cancel.set()
    assert not result.cancelled
    assert result["after"] == 6.0


def test_values_that_a_cancelled_run_did_not_reach_can_still_be_had() -> None:
    result, _ = cancelled_run(around("patient"), toy.memory_cache())
    toy.GATE.leave.set()
    assert result["after"] == 6.0


def test_interrupting_stops_the_run(tmp_path: Path) -> None:
    code = """
        import sys, threading, os, signal, time
        from tests.nodegraph import support as toy
        from nodegraph import Cancelled
        graph = toy.toy_graph()
        graph.add("toy.slow", "first", seconds=0.03)
        graph.add("toy.peak", "top", values="first")
        graph.add("toy.patient", "waits", x="top")
        def stop():
            toy.GATE.entered.wait(10)
            os.kill(os.getpid(), signal.SIGINT)
        threading.Thread(target=stop).start()
        began = time.perf_counter()
        try:
            graph.run(cache=__import__("nodegraph.cache").cache.Cache(sys.argv[1]))
        except Cancelled as error:
            print("cancelled", error.exit_status, time.perf_counter() - began < 2)
    """
    assert toy.python(code, tmp_path).split() == ["cancelled", "130", "True"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    graph = toy.toy_graph()
    graph.add("toy.slow", "first", seconds=0.03)
    assert toy.statuses(graph.run(cache=Cache(tmp_path))) == {"first": "cached"}


def test_a_nested_run_that_is_cancelled_fails_only_its_node() -> None:
    @node(version=1)
    def inner(x: float) -> float:
        """Run a graph of its own, which somebody cancels."""
        cancel = threading.Event()
        cancel.set()
        graph = toy.toy_graph()
        graph.add("toy.number")
        run_graph(graph, cache=toy.memory_cache(), cancel=cancel)
        return x

    graph = toy.toy_graph(inner)
    graph.add(inner, "inner", x=graph.add("toy.number"))
    graph.add("toy.number", "beside", value=4.0)
    result = graph.run(cache=toy.memory_cache(), check=False)
    assert toy.statuses(result) == {"number": "computed", "inner": "failed", "beside": "computed"}
