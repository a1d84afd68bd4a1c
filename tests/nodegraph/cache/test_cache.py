"""The cache as a whole: whatever goes wrong with it costs time, never a wrong result and never a traceback."""

from __future__ import annotations

import errno
import logging
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nodegraph import Graph
from nodegraph.cache import Cache, default_cache, physical_memory
from nodegraph.cache.store import ValueStore
from nodegraph.places import CACHE_VERSION, default_cache_folder
from tests.nodegraph import support as toy


@pytest.fixture(autouse=True)
def _count_anew() -> None:
    toy.ran()


def stored(count: int = 3, size: int = 8) -> Graph:
    """A graph of values that are worth storing."""
    graph = toy.toy_graph()
    for number in range(count):
        slow = graph.add("toy.slow", f"s{number}", seconds=0.02, value=float(number), size=size)
        graph.add("toy.peak", f"p{number}", values=slow)
    return graph


def files(folder: Path) -> list[Path]:
    return sorted((folder / f"v{CACHE_VERSION}" / "values").rglob("*.h5"))


def filled(folder: Path, **options: Any) -> list[Path]:
    cache = Cache(folder, **options)
    stored().run(cache=cache)
    cache.close()
    toy.ran()
    return files(folder)


def again(folder: Path, **options: Any) -> tuple[Any, dict[str, int]]:
    """Run the graph in a new cache, asking for every value."""
    cache = Cache(folder, memory_budget=0, **options)
    result = stored().run(["s0", "s1", "s2", "p0", "p1", "p2"], cache=cache)
    for number in range(3):
        assert result[f"s{number}"].tolist() == [float(number)] * 8
        assert result[f"p{number}"] == number
    cache.close()
    return result, toy.ran()


def test_only_what_is_worth_it_is_stored(tmp_path: Path) -> None:
    assert len(filled(tmp_path)) == 3
    result, counts = again(tmp_path)
    assert set(toy.statuses(result).values()) == {"cached"}
    assert "slow" not in counts


@pytest.mark.parametrize("harm", ["flip", "cut", "empty", "gone", "swapped", "folder"])
def test_damaged_values_are_computed_again(tmp_path: Path, harm: str, caplog: pytest.LogCaptureFixture) -> None:
    paths = filled(tmp_path)
    content = [path.read_bytes() for path in paths]
    for path in paths[:2]:
        if harm == "flip":
            path.write_bytes(path.read_bytes()[:-100] + b"\xff" * 100)
        elif harm == "cut":
            path.write_bytes(path.read_bytes()[:1000])
        elif harm == "empty":
            path.write_bytes(b"")
        elif harm == "folder":
            path.unlink()
            path.mkdir()
        elif harm == "gone":
            path.unlink()
    if harm == "swapped":
        paths[0].write_bytes(content[1])
        paths[1].write_bytes(content[0])
    _, counts = again(tmp_path)
    assert counts["slow"] == 2 or harm == "folder"
    if harm not in ("gone", "folder"):
        assert "damaged and is computed again" in caplog.text
    if harm != "folder":
        assert [path.read_bytes() for path in files(tmp_path)] == content, "they are stored again as they were"
        assert "slow" not in again(tmp_path)[1]


def test_verify_finds_and_removes_damage(tmp_path: Path) -> None:
    paths = filled(tmp_path)
    paths[0].write_bytes(paths[0].read_bytes()[:-1])
    cache = Cache(tmp_path)
    found = cache.verify()
    assert len(found) == 1
    assert paths[0].stem in found[0]
    assert not paths[0].exists()
    assert cache.verify() == []
    cache.close()
    assert again(tmp_path)[1]["slow"] == 1


def test_clear_forgets_everything(tmp_path: Path) -> None:
    paths = filled(tmp_path)
    cache = Cache(tmp_path)
    before = cache.summary()
    assert (before.results, before.values) == (6, 3)
    assert before.bytes == sum(path.stat().st_size for path in paths)
    assert cache.clear() == before.bytes
    after = cache.summary()
    assert (after.results, after.values, after.bytes) == (0, 0, 0)
    assert files(tmp_path) == []
    cache.close()
    assert again(tmp_path)[1]["slow"] == 3


def test_collecting_keeps_to_the_budget_and_what_is_expensive(tmp_path: Path) -> None:
    graph = toy.toy_graph()
    for number in range(8):
        graph.add("toy.slow", f"cheap{number}", seconds=0.015, value=float(number), size=4000)
    graph.add("toy.slow", "dear", seconds=0.2, value=9.0, size=4000)
    cache = Cache(tmp_path, memory_budget=0)
    graph.run(cache=cache, jobs=4)
    sizes = [path.stat().st_size for path in files(tmp_path)]
    assert len(sizes) == 9
    freed = cache.collect(budget=sum(sizes) // 2)
    left = sum(path.stat().st_size for path in files(tmp_path))
    assert left <= sum(sizes) // 2
    assert freed == sum(sizes) - left
    toy.ran()
    graph.run(["dear"], cache=cache)["dear"]
    assert toy.ran() == {}
    assert cache.collect(budget=left) == 0
    assert cache.collect(budget=0) == left
    assert files(tmp_path) == []
    cache.close()


def test_the_disk_budget_holds_while_running(tmp_path: Path) -> None:
    cache = Cache(tmp_path, disk_budget=150_000, memory_budget=0)
    graph = toy.toy_graph()
    for number in range(12):
        graph.add("toy.slow", f"s{number}", seconds=0.015, value=float(number), size=4000)
    graph.run(cache=cache, jobs=4)
    assert 0 < sum(path.stat().st_size for path in files(tmp_path)) <= 150_000
    cache.close()


def test_values_that_cannot_be_removed_stop_nothing(tmp_path: Path) -> None:
    path = filled(tmp_path)[0]
    path.unlink()
    (path / "inside").mkdir(parents=True)
    cache = Cache(tmp_path, disk_budget=1, memory_budget=0)
    assert stored().run(cache=cache, force=["s0", "s1", "s2"]).ok
    assert cache.collect(budget=0) >= 0
    cache.clear()
    assert [item.is_dir() for item in files(tmp_path)] == [True]
    cache.close()


def test_values_the_index_lost_are_taken_up(tmp_path: Path) -> None:
    paths = filled(tmp_path)
    (tmp_path / f"v{CACHE_VERSION}" / "index.sqlite").unlink()
    cache = Cache(tmp_path)
    assert cache.summary().values == 3
    assert cache.collect(budget=0) > 0
    assert not any(path.exists() for path in paths)
    cache.close()


def test_leftovers_of_writers_that_died_are_removed(tmp_path: Path) -> None:
    path = filled(tmp_path)[0].with_name(".dead.part")
    path.write_bytes(b"half")
    os.utime(path, (1e9, 1e9))
    cache = Cache(tmp_path)
    cache.collect()
    assert not path.exists()
    assert len(files(tmp_path)) == 3
    cache.close()


# A folder that will not have it.


def warned(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


def test_a_file_in_place_of_the_folder_costs_one_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "cache"
    folder.write_text("not a folder")
    _, counts = again(folder)
    assert counts["slow"] >= 3
    assert len(warned(caplog)) == 1
    assert "cannot be written" in warned(caplog)[0]
    assert folder.read_text() == "not a folder"


def test_a_read_only_folder_costs_one_warning(tmp_path: Path) -> None:
    """In a process without the rights of root."""
    folder = tmp_path / "cache"
    folder.mkdir()
    folder.chmod(0o555)
    for parent in (tmp_path, *tmp_path.parents):
        if parent.stat().st_uid == os.getuid() and str(parent).startswith("/tmp/"):
            parent.chmod(parent.stat().st_mode | 0o055)
    code = """
        import logging, os, sys
        logging.basicConfig(stream=sys.stdout, format="%(levelname)s %(message)s")
        from tests.nodegraph import support as toy
        from nodegraph.cache import Cache
        import h5py
        toy.warm_up()
        if os.getuid() == 0:
            os.setuid(65534)
        graph = toy.toy_graph()
        graph.add("toy.peak", values=graph.add("toy.slow", value=3.0))
        cache = Cache(sys.argv[1])
        print(graph.run(cache=cache)["peak"])
        print(graph.run(cache=cache).nodes["peak"].status)
        cache.close()
    """
    printed = toy.python(code, folder).splitlines()
    assert len(printed) == 3
    assert printed[0].startswith("WARNING the cache folder")
    assert printed[1:] == ["3.0", "cached"]
    assert list(folder.iterdir()) == []


def test_a_cache_that_became_read_only_still_answers(tmp_path: Path) -> None:
    """Filled by somebody else: what it knows is used as far as SQLite can read it, and nothing is raised."""
    filled(tmp_path / "cache")
    for path in [tmp_path / "cache", *(tmp_path / "cache").rglob("*")]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    for parent in (tmp_path, *tmp_path.parents):
        if parent.stat().st_uid == os.getuid() and str(parent).startswith("/tmp/"):
            parent.chmod(parent.stat().st_mode | 0o055)
    code = """
        import os, sys
        from tests.nodegraph import support as toy
        from nodegraph.cache import Cache
        import h5py
        toy.warm_up()
        if os.getuid() == 0:
            os.setuid(65534)
        graph = toy.toy_graph()
        for number in range(3):
            graph.add("toy.slow", f"s{number}", seconds=0.02, value=float(number))
        cache = Cache(sys.argv[1])
        result = graph.run(cache=cache)
        print([result[f"s{number}"][0] for number in range(3)] == [0.0, 1.0, 2.0])
    """
    assert toy.python(code, tmp_path / "cache").splitlines()[-1] == "True"


def test_a_full_disk_while_storing_costs_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(self: ValueStore, digest: bytes, value: Any) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(ValueStore, "write", full)
        cache = Cache(tmp_path)
        result = stored().run(cache=cache)
        assert result["p2"] == 2.0
        cache.close()
    assert [text for text in warned(caplog) if "cannot be stored" in text] == warned(caplog)
    assert len(warned(caplog)) == 1
    toy.ran()
    assert again(tmp_path)[1]["slow"] == 3


@pytest.mark.parametrize("limit", [20_000, 60_000])
def test_a_full_disk_everywhere(tmp_path: Path, limit: int) -> None:
    """A limit on file sizes stops the index and the values alike; the run goes on and the next one is right."""
    code = """
        import resource, sys
        import h5py
        from tests.nodegraph import support as toy
        from nodegraph.cache import Cache
        graph = toy.toy_graph()
        for number in range(20):
            graph.add("toy.slow", f"s{number}", seconds=0.012, value=float(number), size=9000 if number % 2 else 8)
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
        cache = Cache(sys.argv[1])
        result = graph.run(cache=cache, jobs=2)
        print(result.ok, [float(result[f"s{number}"][-1]) for number in range(20)] == [float(n) for n in range(20)])
        cache.close()
    """
    assert toy.python(code, tmp_path, limit).split() == ["True", "True"]
    assert not list(tmp_path.rglob("*.part"))
    _, counts = again(tmp_path)
    assert counts["slow"] <= 6


def test_a_cache_of_a_newer_version_is_left_alone(tmp_path: Path) -> None:
    newer = tmp_path / "v999"
    newer.mkdir()
    (newer / "index.sqlite").write_text("from the future")
    filled(tmp_path)
    assert (newer / "index.sqlite").read_text() == "from the future"


# Several at once.


def test_two_caches_share_a_folder(tmp_path: Path) -> None:
    one, two = Cache(tmp_path, memory_budget=0), Cache(tmp_path, memory_budget=0)
    threads = [threading.Thread(target=lambda cache=cache: stored().run(cache=cache, jobs=2)) for cache in (one, two)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    toy.ran()
    for cache in (one, two):
        cache.flush()
        assert stored().run(["s0"], cache=cache)["s0"].tolist() == [0.0] * 8
    assert toy.ran() == {}
    one.collect(budget=0)
    assert stored().run(["s1"], cache=two)["s1"].tolist() == [1.0] * 8
    one.close()
    two.close()


def test_processes_share_a_folder(tmp_path: Path) -> None:
    code = """
        import sys
        from tests.nodegraph import support as toy
        from nodegraph.cache import Cache
        graph = toy.toy_graph()
        for number in range(6):
            slow = graph.add("toy.slow", f"s{number}", seconds=0.02, value=float(number))
            graph.add("toy.peak", f"p{number}", values=slow)
        result = graph.run(cache=Cache(sys.argv[1]))
        print([result[f"p{number}"] for number in range(6)] == [float(n) for n in range(6)])
    """
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(3) as pool:
        assert list(pool.map(lambda _: toy.python(code, tmp_path).strip(), range(3))) == ["True"] * 3
    result, counts = again(tmp_path)
    assert "slow" not in counts
    assert set(toy.statuses(result).values()) == {"cached"}


# Where it lies.


def test_the_folder_of_the_user(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("NODEGRAPH_CACHE_DIR", str(tmp_path / "mine"))
    assert default_cache_folder() == str(tmp_path / "mine")
    assert default_cache() is default_cache()
    assert default_cache().folder is not None
    assert default_cache().folder.parent == tmp_path / "mine"
    monkeypatch.delenv("NODEGRAPH_CACHE_DIR")
    assert "nodegraph" in default_cache_folder()


def test_memory_is_what_this_process_may_use() -> None:
    assert 1 << 26 < physical_memory() < 1 << 50


def test_a_cache_in_memory_only_has_no_folder() -> None:
    cache = toy.memory_cache()
    stored().run(cache=cache)
    summary = cache.summary()
    assert (summary.folder, summary.results) == ("", 6)
    assert summary.values >= 3
    assert (cache.collect(), cache.verify()) == (0, [])
    cache.clear()
    assert cache.summary().values == 0
    cache.close()


def test_values_in_memory_keep_to_the_budget() -> None:
    cache = toy.memory_cache(budget=10_000)
    graph = toy.toy_graph()
    for number in range(20):
        graph.add("toy.slow", f"s{number}", seconds=0.0, value=float(number), size=200)
    graph.run(cache=cache)
    assert 0 < cache.memory.size <= 10_000


def test_file_digests_follow_the_file(tmp_path: Path) -> None:
    cache = Cache(tmp_path / "cache")
    path = tmp_path / "data.bin"
    seen = set()
    for number in range(5):
        path.write_bytes(np.full(1000, number, np.uint8).tobytes())
        seen.add(cache.file_digest(path))
    assert len(seen) == 5
    os.utime(path, (1e9, 1e9))
    assert cache.file_digest(path) in seen
    with pytest.raises(FileNotFoundError):
        cache.file_digest(tmp_path / "absent")
    cache.close()
