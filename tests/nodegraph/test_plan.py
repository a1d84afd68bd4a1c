"""Planning: what would be computed and why, and whether it fits in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest

from nodegraph import Forecast, Graph, GraphError, Param, RunError, node
from nodegraph.cache import Cache
from tests.nodegraph import support as toy


@pytest.fixture(autouse=True)
def _count_anew() -> None:
    toy.ran()


def actions(graph: Graph, cache: Cache, **options: Any) -> dict[str, tuple[str, str]]:
    return {entry.id: (entry.action, entry.reason) for entry in graph.plan(cache=cache, **options).entries()}


def chain() -> Graph:
    graph = toy.toy_graph()
    graph.add("toy.number", "a", value=2.0)
    graph.add("toy.increase", "b", x="a")
    graph.add("toy.increase", "c", x="b")
    return graph


def test_a_plan_runs_nothing_and_says_why() -> None:
    cache = toy.memory_cache()
    graph = chain()
    assert actions(graph, cache) == {
        "a": ("compute", "never computed"),
        "b": ("open", "depends on input x"),
        "c": ("open", "depends on input x"),
    }
    graph.run(cache=cache)
    assert set(actions(graph, cache).values()) == {("cached", "")}
    assert toy.ran() == {"number": 1, "increase": 2}


def test_a_plan_after_a_change(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    graph = chain()
    graph.run(cache=cache)
    assert actions(graph, cache, overrides={"b.by": 7.0}) == {
        "a": ("cached", ""),
        "b": ("compute", "parameter by changed 1.0 -> 7.0"),
        "c": ("open", "depends on input x"),
    }
    assert actions(graph, cache, force=["c"])["c"] == ("compute", "forced")
    assert list(actions(graph, cache, targets=["b"])) == ["a", "b"]


def test_a_plan_names_what_must_be_computed_again_for_its_value() -> None:
    cache = toy.memory_cache(budget=0)
    graph = chain()
    graph.run(cache=cache)
    assert actions(graph, cache, force=["c"]) == {
        "a": ("compute", "not stored, as it computes faster than it loads"),
        "b": ("compute", "not stored, as it computes faster than it loads"),
        "c": ("compute", "forced"),
    }


def test_a_missing_file_is_found_in_the_plan(tmp_path: Path) -> None:
    graph = toy.toy_graph()
    graph.add("toy.read", path=str(tmp_path / "absent"))
    action, reason = actions(graph, toy.memory_cache())["read"]
    assert action == "failed"
    assert "No such file" in reason


def test_changed_inputs_and_types(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    graph = toy.toy_graph()
    graph.add("toy.number", "a")
    graph.add("toy.number", "b", value=2.0)
    graph.add("toy.join", "text", first="a", rest=["a"])
    graph.add("toy.maybe", "maybe", x="a")
    graph.run(cache=cache)
    graph.link("text.rest", "a", "b")
    graph.link("maybe.y", "b")
    result = graph.run(cache=cache)
    assert toy.reasons(result)["text"] == "input rest has 2 links, had 1"
    assert toy.reasons(result)["maybe"] == "input y is linked now"
    graph.link("text.rest", "b", "a")
    graph.link("maybe.y")
    graph.link("maybe.x", "b")
    result = graph.run(cache=cache)
    assert toy.reasons(result)["text"] == "input rest changed"
    assert toy.reasons(result)["maybe"] == "input x changed; input y is not linked any more"
    graph.remove("maybe")
    graph.add("toy.increase", "maybe", x="a")
    assert toy.reasons(graph.run(cache=cache))["maybe"] == "type changed toy.maybe -> toy.increase"


def test_a_long_parameter_is_shortened_in_reasons(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    graph = toy.toy_graph()
    graph.add("toy.number", tag="short")
    graph.run(cache=cache)
    reason = toy.reasons(graph.run(cache=cache, set={"number.tag": "x" * 1000}))["number"]
    assert reason.startswith('parameter tag changed "short" -> "xxx')
    assert len(reason) < 100


def test_reasons_are_kept_where_the_folder_is_shared(tmp_path: Path) -> None:
    graph = chain()
    graph.save(tmp_path / "chain.json")
    first = Cache(tmp_path / "cache")
    graph.run(cache=first)
    first.close()
    result = graph.run(cache=Cache(tmp_path / "cache"), set={"a.value": 3.0})
    assert toy.reasons(result)["a"] == "parameter value changed 2.0 -> 3.0"


def test_reasons_without_a_folder() -> None:
    cache = toy.memory_cache()
    graph = chain()
    graph.run(cache=cache)
    assert toy.reasons(graph.run(cache=cache, set={"a.value": 3.0}))["a"] == "parameter value changed 2.0 -> 3.0"


def test_reasons_after_everything_was_forgotten(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    graph = chain()
    graph.run(cache=cache)
    cache.clear()
    assert toy.reasons(graph.run(cache=cache))["a"] == "never computed"


def test_the_version_of_a_node_is_a_reason(tmp_path: Path) -> None:
    def declare(version: int) -> Any:
        @node(version=version)
        def versioned() -> float:
            """Give one."""
            toy.counted("versioned")
            return 1.0

        return versioned

    cache = Cache(tmp_path)
    for version in (1, 2):
        graph = toy.toy_graph(declare(version))
        graph.add("toy.versioned", "v")
        graph.add("toy.increase", "after", x="v")
        result = graph.run(cache=cache)
    assert toy.reasons(result)["v"] == "version changed 1 -> 2"
    assert toy.statuses(result)["after"] == "cached"
    assert toy.ran() == {"versioned": 2, "increase": 1}


# Memory.


@node(version=1)
def huge(x: float | None = None, *, gigabytes: Annotated[float, Param("Size.", ge=0)] = 1e6) -> np.ndarray:
    """Say that it needs more than there is."""
    toy.counted("huge")
    return np.zeros(3)


@huge.forecast
def _(x: Forecast | None, *, gigabytes: float) -> Forecast:
    return Forecast(int(gigabytes * 1e9), peak=10)


@node(version=1)
def rubbish(x: float | None = None) -> float:
    """Forecast something that is no forecast."""
    return 1.0


rubbish.forecast(lambda x: 42)  # type: ignore[arg-type, return-value]


@node(version=1)
def raising(x: float | None = None) -> float:
    """Fail to forecast."""
    return 1.0


@raising.forecast
def _(x: Forecast | None) -> Forecast:
    raise OSError("no header")


def test_what_cannot_fit_is_refused_before_it_runs() -> None:
    graph = toy.toy_graph(huge)
    graph.add(huge, "giant", x=graph.add("toy.number"))
    with pytest.raises(GraphError) as caught:
        graph.run(cache=toy.memory_cache())
    message = str(caught.value)
    assert "1000.0 TB" in message
    assert "node 'giant'" in message
    assert "crop or resample" in message
    assert toy.ran() == {}
    assert graph.run(cache=toy.memory_cache(), set={"giant.gigabytes": 0.001}).ok


def test_early_release_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = toy.toy_graph(huge)
    last = None
    for index in range(5):
        last = graph.add(huge, f"h{index}", x=graph.add("toy.peak", f"p{index}", values=last) if last else None)
    peak = graph.plan(cache=toy.memory_cache(), overrides={f"h{k}.gigabytes": 1.0 for k in range(5)}).peak_bytes()
    assert 1e9 < peak < 2.6e9, "never more than two of five are alive"


@pytest.mark.parametrize("bad", [rubbish, raising])
def test_a_bad_forecast_stops_nothing(bad: Any) -> None:
    graph = toy.toy_graph(bad)
    graph.add(bad, "bad")
    graph.add("toy.increase", x="bad")
    assert graph.plan(cache=toy.memory_cache()).peak_bytes() >= 0
    assert graph.run(cache=toy.memory_cache())["increase"] == 2.0


def test_what_only_computing_tells_is_not_known() -> None:
    def known() -> dict[str, bool]:
        return {entry.id: entry.known for entry in graph.plan(cache=cache).entries()}

    graph, cache = toy.toy_graph(huge, raising), toy.memory_cache()
    graph.add("toy.slow")
    graph.add("toy.vandal", "same", values="slow")
    graph.add("toy.peak", "number", values="same")
    graph.add(huge, "told")
    graph.add(raising, "untold")
    assert known() == {"slow": False, "same": False, "number": True, "told": True, "untold": False}
    graph.run(["slow"], cache=cache)
    assert known() == {"slow": True, "same": True, "number": True, "told": True, "untold": False}


def test_a_known_result_is_forecast_as_it_was(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    graph = toy.toy_graph()
    graph.add("toy.slow", seconds=0.0, size=100_000)
    graph.run(cache=cache)
    entry = graph.plan(cache=cache).entries()[0]
    assert (entry.action, entry.bytes) == ("cached", 800_000)


def test_a_failing_run_is_planned_like_any_other() -> None:
    graph = toy.toy_graph()
    graph.add("toy.fails")
    cache = toy.memory_cache()
    with pytest.raises(RunError):
        graph.run(cache=cache)
    assert actions(graph, cache) == {"fails": ("compute", "never computed")}
