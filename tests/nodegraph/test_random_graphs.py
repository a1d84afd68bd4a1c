"""Random graphs, run in every way: whatever is cached, stored, evicted, forced or fails, the values are right."""

from __future__ import annotations

import tempfile
from typing import Any

from hypothesis import example, given, settings
from hypothesis import strategies as st

from nodegraph import Graph, node
from nodegraph.cache import Cache
from tests.nodegraph import support as toy

Shape = list[tuple[str, tuple[int, ...], float]]


@node(version=1)
def mix(*xs: float, by: float = 1.0, spread: float = 7.0) -> float:
    """Fold numbers in order, into few different results, so that early cut-offs happen."""
    total = by
    for x in xs:
        total = total * 3 + x
    return total % spread


@node(version=1)
def breaks(*xs: float, by: float = 1.0) -> float:
    """Fail on some inputs."""
    if int(sum(xs) + by) % 3 == 0:
        raise ValueError("a multiple of three")
    return sum(xs) + by


@st.composite
def shapes(draw: Any, most: int = 14) -> Shape:
    count = draw(st.integers(1, most))
    found: Shape = []
    for index in range(count):
        kind = draw(st.sampled_from(["mix", "mix", "mix", "breaks"]))
        links = draw(st.lists(st.integers(0, index - 1), max_size=3)) if index else []
        found.append((kind, tuple(links), float(draw(st.integers(0, 3)))))
    return found


def build(shape: Shape) -> Graph:
    graph = toy.toy_graph(mix, breaks)
    for index, (kind, links, by) in enumerate(shape):
        graph.add(f"toy.{kind}", f"n{index}", xs=[f"n{link}" for link in links], by=by)
    return graph


def expected(shape: Shape) -> list[float | None]:
    """Return the value of each node by calling the functions, None where it or an ancestor fails."""
    values: list[float | None] = []
    for kind, links, by in shape:
        given_ = [values[link] for link in links]
        try:
            function = mix if kind == "mix" else breaks
            values.append(None if None in given_ else function(*given_, by=by))  # type: ignore[arg-type]
        except ValueError:
            values.append(None)
    return values


def check(shape: Shape, cache: Cache, **options: Any) -> None:
    result = build(shape).run(cache=cache, check=False, **options)
    values = expected(shape)
    for id, run in result.nodes.items():
        value = values[int(id[1:])]
        if value is None:
            assert run.status in ("failed", "skipped"), id
            kind, links, _ = shape[int(id[1:])]
            own = kind == "breaks" and all(values[link] is not None for link in links)
            assert run.status == ("failed" if own else "skipped"), id
        else:
            assert run.status in ("computed", "cached"), id
            assert result[id] == value, id


@given(shape=shapes(), jobs=st.sampled_from([1, 2, 5]), budget=st.sampled_from([0, 100, 1 << 20]))
def test_a_cold_run_is_right(shape: Shape, jobs: int, budget: int) -> None:
    check(shape, toy.memory_cache(budget), jobs=jobs)


@given(data=st.data(), shape=shapes(10), jobs=st.sampled_from([1, 3]), budget=st.sampled_from([0, 100, 1 << 20]))
def test_runs_one_after_the_other_are_right(data: Any, shape: Shape, jobs: int, budget: int) -> None:
    cache = toy.memory_cache(budget)
    for _ in range(data.draw(st.integers(2, 5))):
        if data.draw(st.booleans()):
            changed = data.draw(st.integers(0, len(shape) - 1))
            kind, links, _ = shape[changed]
            shape = [*shape[:changed], (kind, links, float(data.draw(st.integers(0, 3)))), *shape[changed + 1 :]]
        ids = [f"n{index}" for index in range(len(shape))]
        targets = data.draw(st.lists(st.sampled_from(ids), max_size=2))
        force = data.draw(st.lists(st.sampled_from(ids), max_size=1))
        check(shape, cache, jobs=jobs, targets=targets, force=force)


@settings(max_examples=15)
@given(data=st.data(), shape=shapes(8))
@example(data=None, shape=[("mix", (), 1.0), ("mix", (0,), 1.0)])
def test_runs_with_everything_on_disk_are_right(data: Any, shape: Shape) -> None:
    from nodegraph.cache import index

    with tempfile.TemporaryDirectory() as folder:
        before, index._FIXED_SECONDS = index._FIXED_SECONDS, 0.0
        try:
            for _ in range(3):
                cache = Cache(folder, memory_budget=0)
                check(shape, cache, jobs=2)
                if data is not None and data.draw(st.booleans()):
                    cache.collect(budget=data.draw(st.integers(0, 10_000)))
                cache.close()
        finally:
            index._FIXED_SECONDS = before


@given(shape=shapes())
def test_one_thread_and_many_agree_on_digests(shape: Shape) -> None:
    one = build(shape).run(cache=toy.memory_cache(), check=False, jobs=1)
    many = build(shape).run(cache=toy.memory_cache(), check=False, jobs=4)
    assert [item.outputs for item in one.nodes.values()] == [item.outputs for item in many.nodes.values()]


@given(shape=shapes())
def test_a_plan_says_what_the_run_does(shape: Shape) -> None:
    cache = toy.memory_cache()
    graph = build(shape)
    graph.run(cache=cache, check=False)
    entries = graph.plan(cache=cache).entries()
    again = graph.run(cache=cache, check=False)
    for entry in entries:
        status = again.nodes[entry.id].status
        assert (entry.action == "cached") == (status == "cached"), entry
