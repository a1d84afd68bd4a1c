"""The SQLite index: what it knows is right or absent, whatever happened to its file."""

from __future__ import annotations

import json
import logging
import sqlite3
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from xxhash import xxh3_64_digest

from nodegraph.cache import Cache
from nodegraph.cache.index import Index, Recipe, Record
from nodegraph.places import CACHE_VERSION
from tests.nodegraph import support as toy


@pytest.fixture(autouse=True)
def _quiet(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    toy.ran()
    with caplog.at_level(logging.ERROR, "nodegraph.cache"):
        yield


def record(number: int, **changes: Any) -> Record:
    recipe = Recipe("t.f", 1, "c0de", '{"p":1}', ("x",), bytes([number % 256]) * 16, {"path": "ab words.txt"}, "")
    fields: dict[str, Any] = {
        "key": number.to_bytes(16, "little"),
        "digests": (bytes([number % 256]) * 16, b"\1" * 16),
        "sizes": (100, 2**40),
        "seconds": 0.25,
        "restore": 0.5,
        "files": (("out/x.png", 3, "ff"),),
        "recipe": recipe,
        "peak": 7,
        "shapes": ("(3, 4) float32", ""),
    }
    return Record(**{**fields, **changes})


def test_a_record_comes_back(tmp_path: Path) -> None:
    index = Index(tmp_path)
    records = [record(number) for number in range(100)]
    index.add_results(records)
    index.close()
    again = Index(tmp_path)
    assert [again.result(item.key) for item in records] == records
    assert again.result(b"\xff" * 16) is None
    assert again.counts()["results"] == 100
    again.close()


def test_many_misses_read_all_keys_once_and_stay_right(tmp_path: Path) -> None:
    index, other = Index(tmp_path), Index(tmp_path)
    index.add_results([record(number) for number in range(10)])
    for number in range(1000, 1200):
        assert index.result(record(number).key) is None
    assert index.result(record(5).key) == record(5)
    index.add_results([record(500)])
    assert index.result(record(500).key) == record(500)
    assert other.result(record(500).key) == record(500)
    index.close()
    other.close()


def test_histories_and_files(tmp_path: Path) -> None:
    index = Index(tmp_path)
    assert index.history("g") == {}
    index.set_history("g", {"a": b"\1" * 16, "b": b"\2" * 16})
    index.set_history("h", {"a": b"\3" * 16})
    index.set_history("g", {"a": b"\4" * 16})
    assert index.history("g") == {"a": b"\4" * 16}
    index.set_file("/x", (3, 4, 5), b"\xff")
    assert index.file("/x") == ((3, 4, 5), b"\xff")
    assert index.file("/y") is None
    index.clear()
    assert index.history("g") == {}
    index.close()


@pytest.mark.parametrize("body", [b"", b"{}", b"[]", b"nonsense", b"[1,2,3]", b"\xff", json.dumps([1] * 8).encode()])
def test_a_row_of_another_kind_is_a_miss(tmp_path: Path, body: bytes) -> None:
    """Written whole, by a program that means something else by it."""
    index = Index(tmp_path)
    for table, name in (("results", record(1).key), ("histories", "g"), ("files", "/x")):
        sum_ = xxh3_64_digest((name if isinstance(name, bytes) else name.encode()) + b"\0" + body)
        index._connection.execute(f"INSERT INTO {table} VALUES (?, ?, ?)", (name, body, sum_))
    assert index.result(record(1).key) is None
    assert index.history("g") == {}
    assert index.file("/x") is None
    index.close()


def test_rows_with_a_wrong_sum_are_misses_and_removed(tmp_path: Path) -> None:
    index = Index(tmp_path)
    index.add_results([record(1), record(2)])
    index._connection.execute("UPDATE results SET body = replace(body, '0.25', '0.35') WHERE key = ?", (record(1).key,))
    assert index.result(record(1).key) is None
    assert index.result(record(2).key) == record(2)
    assert [table for table, _ in index.damaged_rows()] == ["results"]
    assert index.counts()["results"] == 1
    index.close()


def test_what_is_stored_is_ordered_by_priority(tmp_path: Path) -> None:
    index = Index(tmp_path)
    index.add_stored(b"a" * 16, 10_000, 1.0)
    index.add_stored(b"b" * 16, 10_000, 30.0)
    index.add_stored(b"c" * 16, 10_000, 2.0)
    assert [digest[:1] for digest, _, _ in index.stored()] == [b"a", b"c", b"b"]
    assert index.stored_bytes() == 30_000
    index.forget_stored([b"a" * 16], floor=1.0)
    index.renew([b"c" * 16])
    assert [digest[:1] for digest, _, _ in index.stored()] == [b"b", b"c"], "use renews: the floor is added"
    index.close()


def test_a_file_that_is_no_database_is_begun_anew(tmp_path: Path) -> None:
    (tmp_path / "index.sqlite").write_bytes(b"this is no database, but long enough to look like one" * 100)
    index = Index(tmp_path)
    index.add_results([record(1)])
    assert index.result(record(1).key) == record(1)
    index.close()


def test_a_folder_instead_of_the_database_is_an_os_error(tmp_path: Path) -> None:
    (tmp_path / "index.sqlite").mkdir()
    with pytest.raises(OSError, match="cannot be opened"):
        Index(tmp_path)


# Flipped bytes.


def filled(folder: Path) -> Any:
    """Run a small graph whose values are stored, and return its outputs."""
    cache = Cache(folder, memory_budget=0)
    result = run(cache)
    outputs = [item.outputs for item in result.nodes.values()]
    cache.close()
    return outputs


def run(cache: Cache) -> Any:
    graph = toy.toy_graph()
    for number in range(3):
        slow = graph.add("toy.slow", f"s{number}", seconds=0.012, value=float(number))
        graph.add("toy.peak", f"p{number}", values=slow)
    graph.add("toy.add", "sum", terms=["p0", "p1", "p2"])
    result = graph.run(cache=cache, jobs=1)
    assert result["sum"] == 3.0
    assert result["s2"].tolist() == [2.0] * 8
    return result


def use_all(folder: Path, outputs: Any) -> None:
    """Do everything a program does with a cache; whatever it knows must be right and nothing may be raised."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cache = Cache(folder, memory_budget=0, disk_budget=3000)
        assert [item.outputs for item in run(cache).nodes.values()] == outputs
        cache.collect(budget=100)
        cache.summary()
        cache.verify()
        assert [item.outputs for item in run(cache).nodes.values()] == outputs
        cache.close()
        cache = Cache(folder)
        assert [item.outputs for item in run(cache).nodes.values()] == outputs
        cache.close()


def damaged_copies(content: bytes, positions: Any) -> Iterator[bytes]:
    for position in positions:
        changed = bytearray(content)
        changed[position] ^= (0x01, 0x80, 0xFF, 0x10)[position % 4]
        yield bytes(changed)


@pytest.mark.parametrize("stride", [61, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.timeout(1200)
def test_flipped_bytes_in_the_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stride: int) -> None:
    """The database and its write-ahead log: no result is ever wrong, and nothing is raised."""
    monkeypatch.setattr("tests.nodegraph.support.time.sleep", lambda seconds: None)
    outputs = filled(tmp_path / "whole")
    folder = tmp_path / "whole" / f"v{CACHE_VERSION}"
    database = (folder / "index.sqlite").read_bytes()
    used = [
        position for position in range(0, len(database), stride) if any(database[max(0, position - 60) : position + 60])
    ]
    place = tmp_path / "damaged"
    for content in [
        *damaged_copies(database, [*range(0, 100, 9), *used]),
        database[:1000],
        database[: len(database) // 2],
        b"",
    ]:
        target = place / f"v{CACHE_VERSION}"
        target.mkdir(parents=True, exist_ok=True)
        for path in target.glob("index.sqlite*"):
            path.unlink()
        (target / "index.sqlite").write_bytes(content)
        use_all(place, outputs)


@pytest.mark.timeout(300)
def test_flipped_bytes_in_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What another process wrote last is still in the log."""
    outputs = filled(tmp_path / "whole")
    monkeypatch.setattr("tests.nodegraph.support.time.sleep", lambda seconds: None)
    source = tmp_path / "source"
    keep = Cache(source, memory_budget=0)
    run(keep)
    keep.flush()
    log = (source / f"v{CACHE_VERSION}" / "index.sqlite-wal").read_bytes()
    database = (source / f"v{CACHE_VERSION}" / "index.sqlite").read_bytes()
    keep.close()
    assert len(log) > 10_000
    place = tmp_path / "damaged" / f"v{CACHE_VERSION}"
    place.mkdir(parents=True)
    for content in [*damaged_copies(log, range(0, len(log), 1499)), log[:5000], log[:31]]:
        for path in place.glob("index.sqlite*"):
            path.unlink()
        (place / "index.sqlite").write_bytes(database)
        (place / "index.sqlite-wal").write_bytes(content)
        use_all(tmp_path / "damaged", outputs)


def test_odd_rows_in_the_list_of_stored_values(tmp_path: Path) -> None:
    """That table has no checksum: whatever stands there may cost time only."""
    outputs = filled(tmp_path)
    path = tmp_path / f"v{CACHE_VERSION}" / "index.sqlite"
    connection = sqlite3.connect(path)
    odd = ["x", b"x", float("inf"), 1e308, -1e308, 2**62]
    for number, value in enumerate(odd):
        row = (bytes([number]) * 16, value, value, value)
        connection.execute("INSERT OR REPLACE INTO stored VALUES (?, ?, ?, ?)", row)
    connection.execute("INSERT OR REPLACE INTO stored VALUES ('text', 1, 1, 1)")
    connection.execute("INSERT OR REPLACE INTO state VALUES ('floor', 'high')")
    connection.commit()
    connection.close()
    use_all(tmp_path, outputs)


def test_damage_while_it_is_open(tmp_path: Path) -> None:
    cache = Cache(tmp_path, memory_budget=0)
    run(cache)
    cache.flush()
    for name in ("index.sqlite", "index.sqlite-wal"):
        path = tmp_path / f"v{CACHE_VERSION}" / name
        path.write_bytes(b"\xff" * path.stat().st_size)
    cache._records.clear()
    run(cache)
    cache.close()
    cache = Cache(tmp_path)
    run(cache)
    cache.close()


def test_two_caches_on_one_folder(tmp_path: Path) -> None:
    one, two = Cache(tmp_path), Cache(tmp_path)
    run(one)
    one.flush()
    toy.ran()
    result = run(two)
    assert set(toy.statuses(result).values()) == {"cached"}
    one.clear()
    run(two)
    run(one)
    assert sum(toy.ran().values()) >= 7
    one.close()
    two.close()
