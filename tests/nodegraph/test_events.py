"""Events: what observers hear of a run, in order, and that they cannot disturb it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

from nodegraph import Context, Graph, node
from nodegraph.events import Event, Failed, Finished, Planned, Progress, Started
from tests.nodegraph import support as toy


@pytest.fixture(autouse=True)
def _gate() -> Iterator[None]:
    toy.GATE.reset()
    yield
    toy.GATE.leave.set()


def graph_with_a_failure() -> Graph:
    graph = toy.toy_graph()
    graph.add("toy.number", "a")
    graph.add("toy.increase", "b", x="a")
    graph.add("toy.fails", "bad", x="b")
    graph.add("toy.increase", "below", x="bad")
    return graph


@pytest.mark.parametrize("jobs", [1, 4])
def test_events_come_in_order(jobs: int) -> None:
    seen: list[Event] = []
    result = graph_with_a_failure().run(cache=toy.memory_cache(), observers=[seen.append], check=False, jobs=jobs)
    assert isinstance(seen[0], Planned)
    assert seen[0].plan is result.plan
    names = [(type(event).__name__, getattr(event, "node", None) or event.run.id) for event in seen[1:]]  # type: ignore[union-attr]
    assert names == [
        ("Started", "a"),
        ("Finished", "a"),
        ("Started", "b"),
        ("Finished", "b"),
        ("Started", "bad"),
        ("Failed", "bad"),
    ]
    finished = [event.run for event in seen if isinstance(event, Finished)]
    assert [run.status for run in finished] == ["computed", "computed"]
    assert finished[1].outputs == result.nodes["b"].outputs
    failed = next(event.run for event in seen if isinstance(event, Failed))
    assert (failed.status, failed.error) == ("failed", "no luck")


def test_a_cached_run_tells_only_its_plan() -> None:
    cache = toy.memory_cache()
    graph = toy.toy_graph()
    graph.add("toy.number")
    graph.run(cache=cache)
    seen: list[Event] = []
    graph.run(cache=cache, observers=[seen.append])
    assert [type(event) for event in seen] == [Planned]


def test_events_of_many_threads_come_one_at_a_time() -> None:
    graph = toy.toy_graph()
    start = graph.add("toy.number")
    for k in range(40):
        graph.add("toy.increase", x=start, by=float(k))
    inside, overlaps, seen = threading.Lock(), [], []

    def observe(event: Event) -> None:
        if not inside.acquire(blocking=False):
            overlaps.append(event)
            return
        try:
            seen.append(event)
        finally:
            inside.release()

    graph.run(cache=toy.memory_cache(), observers=[observe], jobs=4)
    assert not overlaps
    starts = [event.node for event in seen if isinstance(event, Started)]
    ends = [event.run.id for event in seen if isinstance(event, Finished)]
    assert sorted(starts) == sorted(ends) == sorted(graph.nodes)
    for id in starts:
        places = [
            i
            for i, event in enumerate(seen)
            if getattr(event, "node", getattr(event, "run", None) and event.run.id) == id
        ]
        assert isinstance(seen[places[0]], Started), f"{id} begins before it ends"


def test_an_observer_that_raises_is_dropped_and_disturbs_nothing(caplog: pytest.LogCaptureFixture) -> None:
    calls: list[Event] = []

    def broken(event: Event) -> None:
        calls.append(event)
        raise RuntimeError("observer trouble")

    seen: list[Event] = []
    graph = toy.toy_graph()
    graph.add("toy.increase", x=graph.add("toy.number"))
    result = graph.run(cache=toy.memory_cache(), observers=[broken, seen.append])
    assert result.ok
    assert len(calls) == 1
    assert len(seen) == 5
    assert "observer trouble" in caplog.text


def test_progress_reaches_observers_and_not_too_often() -> None:
    @node(version=1)
    def chatty(x: float, *, context: Context) -> float:
        """Report far too often."""
        for step in range(2000):
            context.progress(step / 2000, f"step {step}")
        return x

    graph = toy.toy_graph(chatty)
    graph.add(chatty, "chatty", x=graph.add("toy.number"))
    seen: list[Event] = []
    result = graph.run(cache=toy.memory_cache(), observers=[seen.append])
    progress = [event for event in seen if isinstance(event, Progress)]
    assert 1 <= len(progress) <= 2 + 20 * result.seconds
    assert progress[0] == Progress("chatty", 0.0, "step 0")


def test_start_times_and_threads_are_told() -> None:
    """Three nodes that wait for each other can only end side by side, each on a thread of its own."""
    seen: list[Event] = []
    together = threading.Barrier(3, timeout=20)

    @node(version=1)
    def meets(*, which: int) -> float:
        """Wait for the others."""
        together.wait()
        return float(which)

    graph = toy.toy_graph(meets)
    for k in range(3):
        graph.add(meets, f"s{k}", which=k)
    result = graph.run(cache=toy.memory_cache(), observers=[seen.append], jobs=3)
    starts = {event.node: event for event in seen if isinstance(event, Started)}
    for id, run in result.nodes.items():
        assert run.start == starts[id].start >= 0
        assert run.worker == starts[id].worker
    assert len({run.worker for run in result.nodes.values()}) == 3


def test_a_slow_observer_does_not_hold_the_scheduler() -> None:
    """While an observer is told of one node, another node can be taken up."""
    together = threading.Barrier(2, timeout=5)

    @node(version=1)
    def meets(*, which: int) -> float:
        """Wait for the other."""
        together.wait()
        return float(which)

    graph = toy.toy_graph(meets)
    graph.add(meets, "m0", which=0)
    graph.add(meets, "m1", which=1)
    slow: list[Any] = []

    def observe(event: Event) -> None:
        threading.Event().wait(0.02)
        slow.append(event)

    assert graph.run(cache=toy.memory_cache(), observers=[observe], jobs=2).ok
    assert len(slow) == 5
