"""The memory tier: bounded, and what is expensive per byte outlives what is cheap."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nodegraph.cache.memory import MemoryStore


def name(index: int) -> bytes:
    return index.to_bytes(16, "little")


def test_thirty_seconds_outlive_any_number_of_ten_milliseconds() -> None:
    store = MemoryStore(10_000)
    store.put(b"expensive", "value", 1000, 30.0)
    for index in range(1000):
        store.put(name(index), index, 1000, 0.01)
    assert store.get(b"expensive") == "value"
    assert len(store) == 10


def test_small_things_outlive_large_ones_of_the_same_cost() -> None:
    store = MemoryStore(10_000)
    for index in range(5):
        store.put(name(index), index, 100, 1.0)
    for index in range(5, 30):
        store.put(name(index), index, 4000, 1.0)
    assert all(store.get(name(index)) == index for index in range(5))


def test_what_is_used_stays_and_what_is_not_used_ages() -> None:
    store = MemoryStore(1000)
    store.put(b"used", 1, 100, 1.0)
    store.put(b"unused", 2, 100, 1.0)
    for index in range(100):
        store.get(b"used")
        store.put(name(index), index, 100, 0.9)
    assert store.get(b"used") == 1
    assert store.get(b"unused") is None


def test_what_is_larger_than_the_budget_is_not_kept() -> None:
    store = MemoryStore(100)
    store.put(b"a", 1, 60, 1.0)
    store.put(b"b", 2, 101, 1e9)
    assert (store.get(b"a"), store.get(b"b")) == (1, None)


def test_a_value_is_counted_once() -> None:
    store = MemoryStore(100)
    for _ in range(5):
        store.put(b"a", 1, 60, 1.0)
    assert (store.size, len(store)) == (60, 1)
    store.discard(b"a")
    store.discard(b"a")
    assert (store.size, len(store), b"a" in store) == (0, 0, False)
    store.put(b"a", 2, 70, 1.0)
    assert store.get(b"a") == 2
    store.clear()
    assert (store.size, len(store)) == (0, 0)


steps = st.tuples(
    st.sampled_from(["put", "put", "get", "discard"]),
    st.integers(0, 12),
    st.integers(0, 400),
    st.floats(0, 100, allow_nan=False),
)


@given(operations=st.lists(steps, max_size=120))
def test_the_budget_holds_whatever_is_done(operations: list[tuple[str, int, int, float]]) -> None:
    store, given_ = MemoryStore(1000), {}
    for action, key, size, seconds in operations:
        if action == "put":
            if name(key) not in store:
                given_[key] = size
            store.put(name(key), key, size, seconds)
        elif action == "get":
            assert store.get(name(key)) in (None, key)
        else:
            store.discard(name(key))
        held = [key for key in range(13) if name(key) in store]
        assert store.size == sum(given_[key] for key in held) <= 1000
        assert len(store) == len(held)


def test_many_threads() -> None:
    store = MemoryStore(5000)

    def work(seed: int) -> None:
        rng = np.random.default_rng(seed)
        for _ in range(2000):
            key = int(rng.integers(60))
            if rng.random() < 0.5:
                store.put(name(key), key, int(rng.integers(1, 500)), float(rng.random()))
            else:
                assert store.get(name(key)) in (None, key)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    assert 0 <= store.size <= 5000
