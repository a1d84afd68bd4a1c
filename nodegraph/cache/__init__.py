"""What the scheduler remembers: results by key, values by content digest, in memory and on disk.

`Cache` is the one door to the parts behind it:

- `keys` says what identifies a result, `index` (SQLite) maps keys to results;
- `memory` holds values up to a budget, `store` (HDF5) holds them on disk.

A value is stored on disk only when loading it is faster than computing it again, counting what its inputs would cost
where they are not stored either.  Whatever goes wrong here - a crash, a full disk, damage, a folder that cannot be
written - costs time, never a wrong result.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, RLock
from typing import Any

from xxhash import xxh3_128

from nodegraph.cache.index import Index, Recipe, Record
from nodegraph.cache.memory import MemoryStore
from nodegraph.cache.store import DamagedError, ValueStore, verify
from nodegraph.places import ANSWERS, CACHE_VERSION, default_cache_folder

__all__ = ["Cache", "Recipe", "Record", "default_cache", "physical_memory"]

log = logging.getLogger("nodegraph.cache")

DISK_BUDGET = 20 << 30
_FLUSH_SECONDS = 0.25
_FLUSH_AT_ONCE = 0.05
_RECORDS_IN_MEMORY = 400_000
_STABLE_NS = 2_000_000_000


@dataclass(frozen=True, slots=True)
class Summary:
    """What a cache holds: its folder, entries and bytes."""

    folder: str
    results: int
    values: int
    bytes: int
    budget: int


class Cache:
    """Results and values, in memory and below `folder`.

    Args:
        folder: where the disk tier lies; None for a cache in memory only.  A folder that cannot be written costs a
            warning, and the cache then works in memory only.
        disk_budget: bytes of values on disk at most; the collector keeps what is expensive per byte.
        memory_budget: bytes of values in memory at most; by default an eighth of the machine's.
    """

    def __init__(
        self, folder: Path | str | None, *, disk_budget: int = DISK_BUDGET, memory_budget: int | None = None
    ) -> None:
        self.memory = MemoryStore(memory_budget if memory_budget is not None else physical_memory() // 8)
        self.disk_budget = disk_budget
        self.folder: Path | None = None
        self._index: Index | None = None
        self._store: ValueStore | None = None
        self._records: dict[bytes, Record] = {}
        self._pending: list[Record] = []
        self._histories: dict[str, dict[str, bytes]] = {}
        self._used: set[bytes] = set()
        self._flushed = time.monotonic()
        self._lock = Lock()
        self._counting = RLock()
        self._storing = True
        self._file_digests: dict[Path, tuple[tuple[int, ...], bytes]] = {}
        if folder is not None:
            self._open(Path(folder) / f"v{CACHE_VERSION}")

    def _open(self, folder: Path) -> None:
        try:
            self._index = Index(folder)
            self._store = ValueStore(folder / "values")
            self._store.folder.mkdir(exist_ok=True)
            self.folder = folder
            self._size = self._index.stored_bytes()
        except OSError as error:
            self._index = self._store = None
            why = error.strerror or error
            log.warning("the cache folder %s cannot be written (%s); running without it", folder.parent, why)

    # Results.

    def lookup(self, key: bytes) -> Record | None:
        """Return what is remembered under a key, or None.  About 10 microseconds from disk, 0.1 from memory."""
        record = self._records.get(key)
        if record is None and self._index is not None:
            record = self._index.result(key)
            if record is not None:
                self._remember(record)
        return record

    def keep(self, record: Record, values: Sequence[Any]) -> None:
        """Remember a result, and its values where that is worth while.  `values` are in the order of the outputs."""
        self._remember(record)
        for digest, size, value in zip(record.digests, record.sizes, values, strict=True):
            if value is not None:
                self.memory.put(digest, value, size, record.seconds)
                if self._store is not None and self._storing and record.worth_storing:
                    self._write_value(digest, value, record.restore)
        if self._index is None:
            return
        with self._lock:
            self._pending.append(record)
            age = time.monotonic() - self._flushed
            due = age > _FLUSH_SECONDS or record.seconds > _FLUSH_AT_ONCE
        if due:
            self.flush()

    def forget(self, key: bytes) -> None:
        """Drop a result from memory, so that it is looked up on disk again."""
        self._records.pop(key, None)

    def _remember(self, record: Record) -> None:
        if len(self._records) >= _RECORDS_IN_MEMORY:
            self._records.clear()
        self._records[record.key] = record

    # Values.

    def has(self, digest: bytes) -> bool:
        """Say whether a value can be had without computing it."""
        return digest in self.memory or self.stored(digest)

    def stored(self, digest: bytes) -> bool:
        """Say whether a value is on disk."""
        return self._store is not None and digest in self._store

    def value(self, digest: bytes) -> Any | None:
        """Return a value from memory or disk, or None; a damaged file is removed with a warning."""
        value = self.memory.get(digest)
        if value is not None or self._store is None:
            return value
        started = time.perf_counter()
        try:
            value = self._store.read(digest)
        except FileNotFoundError:
            return None
        except DamagedError as error:
            log.warning("a cached value is damaged and is computed again (%s)", error)
            self._discard(digest)
            return None
        except OSError as error:
            log.warning("a cached value cannot be read and is computed again (%s)", error.strerror or error)
            return None
        from nodegraph.codec import nbytes

        self.memory.put(digest, value, nbytes(value), time.perf_counter() - started)
        self._used.add(digest)
        return value

    def _write_value(self, digest: bytes, value: Any, seconds: float) -> None:
        if self._store is None or self._index is None or not self._index.writable or digest in self._store:
            return
        try:
            size = self._store.write(digest, value)
        except OSError as error:
            with self._lock:
                first, self._storing = self._storing, False
            self._index.complains = False
            if first:
                why = error.strerror or error
                log.warning("values cannot be stored in the cache (%s); they are kept in memory only", why)
            return
        self._index.add_stored(digest, size, seconds)
        with self._counting:
            self._size += size
            if self._size > self.disk_budget:
                self.collect()

    def _discard(self, digest: bytes) -> None:
        if self._store is not None and self._index is not None:
            try:
                self._store.remove(digest)
            except OSError:
                return
            self._index.forget_stored([digest])

    # Files that nodes read.

    def file_digest(self, path: Path) -> bytes:
        """Return the digest of a file's contents, 16 bytes.  An unchanged file is read once.

        Unchanged means the same size, inode and times; one of these no tool that copies or unpacks files can set back.
        A file changed in the last two seconds is read again, since a second change could carry the same time.

        Raises:
            OSError: it cannot be read.
        """
        status = path.stat()
        stamp = (status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino)
        stable = time.time_ns() - max(status.st_mtime_ns, status.st_ctime_ns) > _STABLE_NS
        known = self._file_digests.get(path)
        if known is None and self._index is not None and stable:
            known = self._index.file(_text(path))
        if known is not None and known[0] == stamp and stable:
            self._file_digests[path] = known
            return known[1]
        state = xxh3_128()
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                state.update(block)
        digest = state.digest()
        self._file_digests[path] = (stamp, digest)
        if self._index is not None and stable:
            self._index.set_file(_text(path), stamp, digest)
        return digest

    # The last run.

    def history(self, graph: str) -> dict[str, bytes]:
        """Return the key of each node in the last run of a graph."""
        return self._index.history(graph) if self._index is not None else self._histories.get(graph, {})

    def set_history(self, graph: str, keys: Mapping[str, bytes]) -> None:
        """Remember the key of each node of a graph."""
        if self._index is not None:
            self._index.set_history(graph, keys)
        else:
            self._histories[graph] = dict(keys)

    # Upkeep.

    def flush(self) -> None:
        """Write what is waiting to be remembered."""
        with self._lock:
            pending, self._pending = self._pending, []
            used, self._used = self._used, set()
            self._flushed = time.monotonic()
        if self._index is not None:
            if pending:
                self._index.add_results(pending)
            if used:
                self._index.renew(used)

    def collect(self, budget: int | None = None) -> int:
        """Remove the values of lowest priority until the rest fits the budget; return the bytes freed.

        Also takes up values that the index lost and removes what interrupted writers left behind.
        """
        if self._index is None or self._store is None:
            return 0
        with self._counting:
            return self._collect(self._store, self._index, self.disk_budget if budget is None else budget)

    def _collect(self, store: ValueStore, index: Index, limit: int) -> int:
        on_disk = dict(store.digests())
        known = index.stored()
        entries = [(digest, on_disk[digest], priority) for digest, _, priority in known if digest in on_disk]
        listed = {digest for digest, _, _ in entries}
        entries = [(digest, size, -1.0) for digest, size in on_disk.items() if digest not in listed] + entries
        total, freed, floor = sum(on_disk.values()), 0, None
        gone = [digest for digest, _, _ in known if digest not in on_disk]
        if total > limit:
            for digest, size, priority in entries:
                if total - freed <= limit * 9 // 10:
                    break
                try:
                    store.remove(digest)
                except OSError:  # somebody else's, or no file at all
                    continue
                gone.append(digest)
                freed, floor = freed + size, max(priority, 0.0)
        index.forget_stored(gone, floor)
        for path in store.leftovers(time.time() - 3600):
            with contextlib.suppress(OSError):
                path.unlink()
        self._size = total - freed
        return freed

    def verify(self) -> list[str]:
        """Check every stored value and every row; remove what is damaged and return a line for each."""
        if self._index is None or self._store is None:
            return []
        self.flush()
        found = []
        for digest, _ in self._store.digests():
            try:
                verify(self._store.path(digest), digest)
            except FileNotFoundError:
                continue
            except (DamagedError, OSError) as error:
                found.append(f"value {digest.hex()}: {error}; removed")
                self._discard(digest)
        found += [f"{table}: a row is damaged; removed" for table, _ in self._index.damaged_rows()]
        self._records.clear()
        if found:
            self._drop_answers()
        return found

    def clear(self) -> int:
        """Forget everything, in memory and on disk; return the bytes freed."""
        self.memory.clear()
        self._records.clear()
        self._pending.clear()
        self._file_digests.clear()
        self._histories.clear()
        if self._index is None or self._store is None:
            return 0
        freed = 0
        for digest, size in list(self._store.digests()):
            with contextlib.suppress(OSError):
                self._store.remove(digest)
                freed += size
        self._index.clear()
        self._drop_answers()
        self._size = 0
        return freed

    def _drop_answers(self) -> None:
        # What the command line noted of earlier runs rests on what was just removed.
        if self.folder is not None:
            shutil.rmtree(self.folder / ANSWERS, ignore_errors=True)

    def summary(self) -> Summary:
        """Return what the cache holds."""
        if self._index is None or self._store is None:
            return Summary("", len(self._records), len(self.memory), self.memory.size, self.memory.budget)
        self.flush()
        sizes = [size for _, size in self._store.digests()]
        results = self._index.counts().get("results", 0)
        return Summary(str(self.folder), results, len(sizes), sum(sizes), self.disk_budget)

    def close(self) -> None:
        """Write what is waiting and close the index."""
        self.flush()
        if self._index is not None:
            self._index.close()
            self._index = self._store = None


def _text(path: Path) -> str:
    return str(path).encode(errors="backslashreplace").decode()  # a name need not be UTF-8


def physical_memory() -> int:
    """Return the bytes of memory that this process may use at most: the machine's, or its control group's if less."""
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        total = 8 << 30
    for limit in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            total = min(total, int(Path(limit).read_text()))
        except (OSError, ValueError):
            continue
    return total


@functools.cache
def default_cache() -> Cache:
    """Return the cache of this process in the user's folder."""
    return Cache(default_cache_folder())
