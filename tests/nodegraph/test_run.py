"""Running: what is computed, what is answered from the cache, and what a failing node leaves alone."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nodegraph import Graph, GraphError, NodeError, RunError, node
from nodegraph.cache import Cache
from tests.nodegraph import support as toy


@pytest.fixture(autouse=True)
def _count_anew() -> None:
    toy.ran()


@pytest.fixture
def cache(tmp_path: Path) -> Cache:
    return Cache(tmp_path / "cache", memory_budget=1 << 28)


def chain() -> Graph:
    """number -> increase -> parity -> halves."""
    graph = toy.toy_graph()
    graph.add("toy.number", "start", value=2.0)
    graph.add("toy.increase", "more", x="start", by=3.0)
    graph.add("toy.parity", "odd", x="more")
    graph.add("toy.halves", "parts", x="odd")
    return graph


# Values.


def test_results_by_node_and_by_port() -> None:
    graph = toy.toy_graph()
    graph.add("toy.halves", "parts", x=graph.add("toy.number", value=2.25))
    result = graph.run(cache=toy.memory_cache())
    assert (result["parts"], result["parts.low"], result["parts.high"]) == (2.0, 2.0, 0.25)
    assert result["number.out"] == 2.25


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("partz", "no node 'partz'; did you mean 'parts'?"),
        ("parts.hihg", "node 'parts' has no output 'hihg'; did you mean 'high'?"),
    ],
)
def test_unknown_results_name_the_nearest(target: str, message: str) -> None:
    result = chain().run(cache=toy.memory_cache())
    with pytest.raises(GraphError, match=message.replace("?", r"\?")):
        result[target]
    with pytest.raises(GraphError, match=message.replace("?", r"\?")):
        chain().run([target], cache=toy.memory_cache())


def test_only_ancestors_of_the_targets_run() -> None:
    graph = chain()
    graph.add("toy.fails", x="start")
    result = graph.run(["odd"], cache=toy.memory_cache())
    assert toy.statuses(result) == {"start": "computed", "more": "computed", "odd": "computed"}
    assert result["odd"] == 1.0


def test_targets_may_be_handles_ports_or_one_of_them() -> None:
    graph = toy.toy_graph()
    parts = graph.add("toy.halves", "parts", x=graph.add("toy.number", value=2.25))
    cache = toy.memory_cache()
    assert graph.run([parts], cache=cache)["parts"] == 2.0
    assert graph.run([parts["high"]], cache=cache)["parts.high"] == 0.25
    assert graph.run("number", cache=cache)["number"] == 2.25
    assert graph.run(parts["high"], cache=cache)["parts.high"] == 0.25
    assert list(graph.run(parts, cache=cache, force="parts").nodes) == ["number", "parts"]


def test_a_value_that_was_not_a_target_is_loaded_or_computed_on_demand() -> None:
    graph = chain()
    result = graph.run(cache=toy.memory_cache(budget=0))
    assert toy.ran() == {"number": 1, "increase": 1, "parity": 1, "halves": 1}
    assert result["more"] == 5.0
    assert toy.ran() == {"number": 1, "increase": 1}
    assert result["more"] == 5.0
    assert toy.ran() == {}


def test_values_of_targets_are_dropped_where_nobody_wants_them(cache: Cache) -> None:
    from nodegraph.run import run_graph

    graph = toy.toy_graph()
    graph.add("toy.number", value=4.0)
    result = run_graph(graph, cache=toy.memory_cache(budget=0), keep_values=False)
    toy.ran()
    assert result["number"] == 4.0
    assert toy.ran() == {"number": 1}


# Remembering.


def test_second_run_computes_nothing(cache: Cache, tmp_path: Path) -> None:
    first = chain().run(cache=cache)
    assert set(toy.statuses(first).values()) == {"computed"}
    toy.ran()
    second = chain().run(cache=cache)
    assert toy.ran() == {}
    assert set(toy.statuses(second).values()) == {"cached"}
    assert set(toy.reasons(second).values()) == {""}
    assert [item.outputs for item in second.nodes.values()] == [item.outputs for item in first.nodes.values()]
    cache.close()
    third = chain().run(cache=Cache(tmp_path / "cache"))
    assert toy.ran() == {}
    assert set(toy.statuses(third).values()) == {"cached"}


def test_a_changed_parameter_recomputes_what_follows_and_nothing_else(cache: Cache) -> None:
    graph = chain()
    graph.add("toy.number", "other", value=9.0)
    graph.run(cache=cache)
    toy.ran()
    result = graph.run(cache=cache, set={"more.by": 4.0})
    assert toy.ran() == {"increase": 1, "parity": 1, "halves": 1}
    assert toy.statuses(result)["other"] == "cached"
    assert toy.reasons(result) == {
        "start": "",
        "other": "",
        "more": "parameter by changed 3.0 -> 4.0",
        "odd": "input x changed",
        "parts": "input x changed",
    }


def test_setting_back_answers_from_the_cache(cache: Cache) -> None:
    graph = chain()
    graph.run(cache=cache)
    graph.run(cache=cache, set={"more.by": 4.0})
    toy.ran()
    result = graph.run(cache=cache)
    assert toy.ran() == {}
    assert set(toy.statuses(result).values()) == {"cached"}


def test_an_equal_value_cuts_off_what_follows(cache: Cache) -> None:
    graph = chain()
    graph.run(cache=cache)
    toy.ran()
    result = graph.run(cache=cache, set={"more.by": 5.0})
    assert toy.ran() == {"increase": 1, "parity": 1}, "parity came out as before"
    assert toy.statuses(result) == {"start": "cached", "more": "computed", "odd": "computed", "parts": "cached"}


def test_forcing_computes_again_and_cuts_off(cache: Cache) -> None:
    graph = chain()
    graph.run(cache=cache)
    toy.ran()
    result = graph.run(cache=cache, force=["more"])
    assert toy.ran() == {"increase": 1}
    assert toy.reasons(result)["more"] == "forced"
    with pytest.raises(GraphError, match=r"no node 'mare' to force; did you mean 'more'\?"):
        graph.run(cache=cache, force=["mare"])


def test_what_is_stored_comes_back_from_disk(tmp_path: Path) -> None:
    graph = toy.toy_graph()
    graph.add("toy.peak", values=graph.add("toy.slow", value=3.0))
    with_disk = Cache(tmp_path)
    graph.run(cache=with_disk)
    with_disk.close()
    toy.ran()
    result = graph.run(cache=Cache(tmp_path))
    assert result["slow"].tolist() == [3.0] * 8
    assert toy.ran() == {}


def test_evicted_values_are_computed_again_and_say_so(tmp_path: Path) -> None:
    graph = toy.toy_graph()
    graph.add("toy.peak", values=graph.add("toy.slow", value=3.0))
    cache = Cache(tmp_path, memory_budget=0)
    graph.run(cache=cache)
    assert cache.collect(budget=0) > 0
    toy.ran()
    result = graph.run(["slow"], cache=cache)
    assert (toy.statuses(result), toy.reasons(result)) == ({"slow": "cached"}, {"slow": ""}), "its result is known"
    result = graph.run(cache=cache, force=["peak"])
    assert toy.ran() == {"slow": 1, "peak": 1}
    assert toy.reasons(result) == {"slow": "evicted", "peak": "forced"}


def test_cheap_values_are_not_stored_and_computed_again_when_needed() -> None:
    cache = toy.memory_cache(budget=0)
    graph = chain()
    graph.run(cache=cache)
    toy.ran()
    result = graph.run(cache=cache, force=["odd"])
    assert toy.ran() == {"number": 1, "increase": 1, "parity": 1}
    assert toy.reasons(result)["more"] == "not stored, as it computes faster than it loads"
    assert toy.statuses(result)["parts"] == "cached"


def test_a_value_collected_during_the_run_is_computed_again(tmp_path: Path) -> None:
    graph = toy.toy_graph()
    graph.add("toy.slow", "source", value=2.0)
    graph.add("toy.peak", values="source")
    cache = Cache(tmp_path, memory_budget=0)
    graph.run(cache=cache)
    toy.ran()

    def collect(event: Any) -> None:
        if type(event).__name__ == "Planned":
            cache.collect(budget=0)

    result = graph.run(cache=cache, force=["peak"], observers=[collect])
    assert result["peak"] == 2.0
    assert toy.ran() == {"slow": 1, "peak": 1}


def test_equal_nodes_are_computed_once() -> None:
    graph = toy.toy_graph()
    twins = [graph.add("toy.number", value=5.0) for _ in range(4)]
    after = [graph.add("toy.increase", x=twin) for twin in twins]
    graph.add("toy.add", "sum", terms=after)
    result = graph.run(cache=toy.memory_cache(), jobs=4)
    assert result["sum"] == 24.0
    assert toy.ran() == {"number": 1, "increase": 1, "add": 1}
    assert sorted(toy.statuses(result).values()) == ["cached"] * 6 + ["computed"] * 3


def test_equal_nodes_without_room_to_remember() -> None:
    graph = toy.toy_graph()
    twins = [graph.add("toy.number", value=5.0) for _ in range(3)]
    graph.add("toy.add", "sum", terms=[graph.add("toy.increase", x=twin) for twin in twins])
    assert graph.run(cache=toy.memory_cache(budget=0), jobs=3)["sum"] == 18.0


def test_equal_nodes_that_fail_all_fail() -> None:
    graph = toy.toy_graph()
    for name in ("a", "b"):
        graph.add("toy.increase", f"after_{name}", x=graph.add("toy.fails", name))
    result = graph.run(cache=toy.memory_cache(), check=False)
    assert toy.statuses(result) == {"a": "failed", "b": "failed", "after_a": "skipped", "after_b": "skipped"}


def test_ids_titles_and_layout_do_not_matter_to_the_cache(cache: Cache) -> None:
    chain().run(cache=cache)
    toy.ran()
    renamed = toy.toy_graph(title="something else")
    renamed.add("toy.number", "n", value=2)
    renamed.add("toy.increase", "i", x="n.out", by=3)
    renamed._section("layout")["n"] = [1, 2]
    assert renamed.run(cache=cache)["i"] == 5.0
    assert toy.ran() == {}


# Failing.


def test_a_failing_node_fails_only_what_follows_from_it(cache: Cache) -> None:
    graph = toy.toy_graph()
    graph.add("toy.number", "a", value=1.0)
    graph.add("toy.fails", "bad", x="a", message="the well is dry")
    graph.add("toy.increase", "below", x="bad")
    graph.add("toy.increase", "lowest", x="below")
    graph.add("toy.increase", "beside", x="a")
    with pytest.raises(RunError) as caught:
        graph.run(cache=cache)
    result = caught.value.result
    assert caught.value.exit_status == 1
    assert str(caught.value) == "node 'bad' (toy.fails): the well is dry"
    assert isinstance(result.errors[0].__cause__, ValueError)
    assert toy.statuses(result) == {
        "a": "computed",
        "bad": "failed",
        "below": "skipped",
        "lowest": "skipped",
        "beside": "computed",
    }
    assert toy.reasons(result)["below"] == "node 'bad' failed"
    assert toy.reasons(result)["lowest"] == "node 'below' skipped"
    assert result.nodes["bad"].error == "the well is dry"
    assert result["beside"] == 2.0
    for name in ("bad", "below"):
        with pytest.raises(NodeError, match="node 'bad'"):
            result[name]


def test_a_failed_node_is_tried_again_and_not_called_evicted(cache: Cache) -> None:
    graph = toy.toy_graph()
    graph.add("toy.fails", "bad")
    graph.run(cache=cache, check=False)
    toy.ran()
    again = graph.run(cache=cache, check=False)
    assert toy.ran() == {"fails": 1}
    assert toy.statuses(again) == {"bad": "failed"}
    assert graph.plan(cache=cache).entries()[0].reason == "never computed"


def test_a_node_that_returns_another_type_fails(cache: Cache) -> None:
    graph = toy.toy_graph()
    graph.add("toy.lies")
    with pytest.raises(RunError, match=r"node 'lies' \(toy.lies\): .*output 'out': expected Number, got Text"):
        graph.run(cache=cache)


@node(version=1)
def half_a_pair(x: float) -> toy.Halves:
    """Return something else than the NamedTuple."""
    return x  # type: ignore[return-value]


@node(version=1)
def raises_exit(x: float) -> float:
    """Leave as a program would."""
    raise SystemExit(3)


@node(version=1)
def raises_cancelled(x: float) -> float:
    """Raise the engine's own signal though nobody cancelled."""
    from nodegraph import Cancelled

    raise Cancelled("not by a person")


@node(version=1)
def raises_base(x: float) -> float:
    """Raise something that is no Exception, as bugs in compiled code do."""

    class Panic(BaseException):
        pass

    raise Panic("inside")


@node(version=1)
def raises_memory(x: float) -> float:
    """Ask for too much."""
    raise MemoryError


@node(version=1)
def endless(x: float) -> float:
    """Recur without end."""
    return endless.function(x)


@node(version=1)
def holds_a_list(x: float) -> toy.Word:
    """Put a list where a text belongs."""
    return toy.Word([x])  # type: ignore[arg-type]


@node(version=1)
def nothing(x: float) -> float:
    """Forget to return."""
    return None  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (half_a_pair, "returned float, expected Halves"),
        (raises_exit, "SystemExit: 3"),
        (raises_cancelled, "not by a person"),
        (raises_base, "Panic: inside"),
        (raises_memory, "out of memory"),
        (endless, "RecursionError"),
        (holds_a_list, "a value may not hold a list"),
        (nothing, "output 'out': expected Number, got NoneType"),
    ],
)
@pytest.mark.timeout(20)
def test_whatever_a_node_does_fails_that_node_only(bad: Any, message: str) -> None:
    graph = toy.toy_graph(bad)
    graph.add("toy.number", "a")
    graph.add(bad, "bad", x="a")
    if bad is holds_a_list:
        graph.add("toy.letters", "below", word="bad")
    else:
        graph.add("toy.increase", "below", x="bad")
    graph.add("toy.increase", "beside", x="a")
    result = graph.run(cache=toy.memory_cache(), check=False)
    assert toy.statuses(result) == {"a": "computed", "bad": "failed", "below": "skipped", "beside": "computed"}
    assert message in str(result.errors[0])
    assert "\n" not in str(result.errors[0])


def test_a_missing_file_fails_its_node_and_nothing_else(tmp_path: Path) -> None:
    graph = toy.toy_graph()
    graph.add("toy.read", "text", path=str(tmp_path / "absent.txt"))
    graph.add("toy.number", "a")
    seen: list[Any] = []
    result = graph.run(cache=toy.memory_cache(), check=False, observers=[seen.append])
    assert toy.statuses(result) == {"text": "failed", "a": "computed"}
    assert "parameter 'path': No such file or directory" in str(result.errors[0])
    assert [event.run.id for event in seen if type(event).__name__ == "Failed"] == ["text"]


@pytest.mark.parametrize("path", ["", ".", "~nobody-of-this-name/x", "a" * 300, "folder"])
def test_paths_that_are_no_files_are_refused_in_a_sentence(path: str, in_tmp: Path) -> None:
    (in_tmp / "folder").mkdir()
    graph = toy.toy_graph()
    graph.add("toy.read", "text", path=path)
    with pytest.raises((GraphError, RunError), match="path"):
        graph.run(cache=toy.memory_cache())


def test_a_path_with_a_null_byte_is_refused_in_a_sentence() -> None:
    graph = toy.toy_graph()
    graph.add("toy.read", "text", path="a\0b")
    with pytest.raises((GraphError, RunError), match="path"):
        graph.run(cache=toy.memory_cache())


# Files that are read.


def test_a_file_counts_by_its_contents(cache: Cache, in_tmp: Path) -> None:
    file = in_tmp / "words.txt"
    file.write_text("one")
    graph = toy.toy_graph()
    graph.add("toy.read", "text", path="words.txt")
    assert graph.run(cache=cache)["text"] == "one"
    assert toy.ran() == {"read": 1}
    file.touch()
    assert graph.run(cache=cache)["text"] == "one"
    assert toy.ran() == {}
    file.write_text("two")
    result = graph.run(cache=cache)
    assert (result["text"], toy.reasons(result)["text"]) == ("two", "file words.txt changed")
    file.write_text("one")
    toy.ran()
    assert graph.run(cache=cache)["text"] == "one"
    assert toy.ran() == {}


def test_the_same_file_elsewhere_is_the_same(cache: Cache, tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "words.txt").write_text("same")
        graph = toy.toy_graph()
        graph.add("toy.read", "text", path="words.txt")
        graph.save(tmp_path / folder / "graph.json")
        assert graph.run(cache=cache)["text"] == "same"
    assert toy.ran() == {"read": 1}


@node(version=1)
def meddles(*, path: toy.InputPath) -> str:
    """Read a file that changes meanwhile."""
    text = path.read_text()
    if text == "old":
        path.write_text("new")
    return text


def test_a_file_that_changes_while_it_is_read_is_never_remembered(cache: Cache, in_tmp: Path) -> None:
    file = in_tmp / "words.txt"
    file.write_text("old")
    graph = toy.toy_graph(meddles)
    graph.add(meddles, "text", path="words.txt")
    result = graph.run(cache=cache, check=False)
    if result.ok:  # whatever is said now must be true of the file as it was
        assert result["text"] == "old"
    assert graph.run(cache=cache)["text"] == "new"


def test_a_file_rewritten_with_its_old_time_and_size_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import os

    monkeypatch.setattr("nodegraph.cache._STABLE_NS", -(10**18))
    file = tmp_path / "words.txt"
    file.write_text("one")
    os.utime(file, (1e9, 1e9))
    graph = toy.toy_graph()
    graph.add("toy.read", "text", path=str(file))
    cache = Cache(tmp_path / "cache")
    assert graph.run(cache=cache)["text"] == "one"
    cache.close()
    file.write_text("two")
    os.utime(file, (1e9, 1e9))
    result = graph.run(cache=Cache(tmp_path / "cache"))
    assert (result["text"], toy.statuses(result)["text"]) == ("two", "computed")


# Values stay as they are.


def test_inputs_are_read_only() -> None:
    graph = toy.toy_graph()
    graph.add("toy.vandal", values=graph.add("toy.slow", seconds=0.0, value=2.0))
    result = graph.run(cache=toy.memory_cache(), check=False)
    assert "read-only" in str(result.errors[0])
    assert result["slow"].tolist() == [2.0] * 8
    assert not result["slow"].flags.writeable


_scratch = np.zeros(8)


@node(version=1)
def reuses_a_buffer(*, value: float) -> np.ndarray:
    """Give a view of an array that the next call writes into."""
    _scratch[:] = value
    return _scratch[:4]


def test_a_node_that_reuses_its_buffer_cannot_change_what_it_gave() -> None:
    graph = toy.toy_graph(reuses_a_buffer)
    graph.add(reuses_a_buffer, "a", value=1.0)
    cache = toy.memory_cache()
    first = graph.run(cache=cache)
    graph.run(cache=cache, set={"a.value": 2.0}, check=False)
    assert first["a"].tolist() == [1.0] * 4
    assert graph.run(cache=cache)["a"].tolist() == [1.0] * 4


@node(version=1)
def sorts_its_list(*, values: list[float] = [3.0, 1.0, 2.0]) -> float:  # noqa: B006 - that is what is tested
    """Change a list parameter in place, as careless code does."""
    first = values[0]
    values.sort()
    return first


@pytest.mark.parametrize("params", [{}, {"values": [3.0, 1.0, 2.0]}])
def test_a_node_cannot_change_its_parameters(params: dict[str, Any]) -> None:
    graph = toy.toy_graph(sorts_its_list)
    graph.add(sorts_its_list, "a", **params)
    for _ in range(2):
        assert graph.run(cache=toy.memory_cache())["a"] == 3.0


@node(version=1)
def big(x: float | None = None) -> np.ndarray:
    """Give an array that the test can watch."""
    value = np.zeros(1000)
    WATCHED.append(weakref.ref(value))
    return value


@node(version=1)
def alive(values: np.ndarray) -> float:
    """Count the watched arrays that are still there."""
    gc.collect()
    return float(sum(ref() is not None for ref in WATCHED))


WATCHED: list[weakref.ref[np.ndarray]] = []


@pytest.mark.parametrize("jobs", [1, 3])
def test_values_are_released_when_their_last_consumer_is_done(jobs: int) -> None:
    WATCHED.clear()
    graph = toy.toy_graph(big, alive)
    last = None
    for step in range(6):
        value = graph.add(big, f"big{step}", x=last)
        last = graph.add(alive, f"alive{step}", values=value)
    result = graph.run(cache=toy.memory_cache(budget=0), jobs=jobs)
    assert result["alive5"] <= 2.0, "five earlier arrays are released"
    del result
    gc.collect()
    assert sum(ref() is not None for ref in WATCHED) == 0


# Checking.


@node(version=1)
def dice() -> float:
    """Never the same."""
    toy.counted("dice")
    return float(len(toy.CALLS)) + float(np.random.default_rng().random())


def test_checked_mode_catches_what_is_not_deterministic(cache: Cache) -> None:
    graph = toy.toy_graph(dice)
    graph.add(dice, "dice")
    graph.add("toy.number", "a")
    graph.run(cache=cache)
    result = graph.run(cache=cache, checked=True, check=False)
    assert toy.statuses(result) == {"dice": "failed", "a": "computed"}
    assert "not deterministic" in str(result.errors[0])
    assert toy.reasons(result)["a"] == "checked against the cache"


def test_checked_mode_agrees_on_what_is(cache: Cache) -> None:
    chain().run(cache=cache)
    toy.ran()
    result = chain().run(cache=cache, checked=True)
    assert toy.ran() == {"number": 1, "increase": 1, "parity": 1, "halves": 1}
    assert result.ok


# Size.


@pytest.mark.timeout(60)
def test_a_chain_of_ten_thousand_nodes() -> None:
    graph = toy.toy_graph()
    last = graph.add("toy.number", value=0.0)
    for _ in range(10_000):
        last = graph.add("toy.increase", x=last)
    cache = toy.memory_cache()
    assert graph.run(cache=cache)[last.id] == 10_000.0
    assert toy.ran()["increase"] == 10_000
    again = graph.run(cache=cache)
    assert again[last.id] == 10_000.0
    assert toy.ran() == {}
    without_values = toy.memory_cache(budget=0)
    graph.run(cache=without_values)
    toy.ran()
    forced = graph.run(cache=without_values, force=[last.id])
    assert forced[last.id] == 10_000.0
    assert toy.ran()["increase"] == 10_000, "nothing was at hand, so the whole chain is computed again"


def test_a_wide_fan() -> None:
    graph = toy.toy_graph()
    start = graph.add("toy.number", value=1.0)
    fan = [graph.add("toy.increase", x=start, by=float(k)) for k in range(500)]
    graph.add("toy.add", "sum", terms=fan)
    assert graph.run(cache=toy.memory_cache(), jobs=4)["sum"] == 500 + 499 * 250


def test_the_empty_graph_is_refused() -> None:
    with pytest.raises(GraphError, match="the graph has no nodes"):
        toy.toy_graph().run(cache=toy.memory_cache())


# What a run says of itself.


def test_a_node_run_tells_outputs_and_cost() -> None:
    graph = toy.toy_graph()
    graph.add("toy.height", n=4)
    result = graph.run(cache=toy.memory_cache(), observers=[lambda event: None])
    run = result.nodes["height"]
    output = run.outputs[0]
    assert (output.name, output.type, output.shape) == ("out", "Height", "(4, 4) float32")
    assert output.bytes >= 64
    assert run.peak_bytes >= 64
    assert run.seconds > 0
    assert result.ok
    assert result.seconds > 0


def test_a_cached_node_tells_what_computing_took(tmp_path: Path) -> None:
    graph = toy.toy_graph()
    graph.add("toy.slow", seconds=0.03)
    graph.run(cache=Cache(tmp_path)).plan.cache.close()
    run = graph.run(cache=Cache(tmp_path)).nodes["slow"]
    assert run.status == "cached"
    assert run.seconds >= 0.03
    assert run.outputs[0].shape == "(8,) float64"


def test_a_graph_sees_a_node_declared_anew() -> None:
    graph = toy.toy_graph()

    def declare(by: int) -> Any:
        @node(version=by)
        def shift(x: float) -> float:
            """Shift."""
            return x + by

        return shift

    cache = toy.memory_cache()
    shift = declare(1)
    shift.family = "toy"
    graph.add(shift, "s", x=graph.add("toy.number", value=1.0))
    assert graph.run(cache=cache)["s"] == 2.0
    again = declare(2)
    again.family = "toy"
    assert graph._registry is not None
    graph._registry.register(again)
    assert graph.run(cache=cache)["s"] == 3.0


def test_the_default_cache_is_that_of_the_user() -> None:
    graph = chain()
    graph.run()
    toy.ran()
    assert toy.statuses(chain().run())["parts"] == "cached"
    assert toy.ran() == {}
