"""The disk tier's index: SQLite (WAL) from keys to results, shared by several processes.

Tables (every row of `results`, `histories` and `files` carries a checksum of itself, since SQLite has none):

``results``    key -> what came out: digests and sizes of the outputs, seconds, files made, and the recipe, that is all
               that went into the key in readable form, which the next run needs to say what changed.
``histories``  graph -> key of each of its nodes in its last run.
``files``      path -> size, times of change, inode and digest of a file that was read, so that it is hashed once.
``stored``     value digest -> size, cost and priority of a value on disk, for the garbage collector.

A damaged database is set aside and begun anew: what it knew is computed again.
"""

from __future__ import annotations

import contextlib
import logging
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple, TypeVar

import orjson
from xxhash import xxh3_64_digest

log = logging.getLogger("nodegraph.cache")
T = TypeVar("T")

_SCHEMA = """
CREATE TABLE IF NOT EXISTS results (key BLOB PRIMARY KEY, body BLOB NOT NULL, sum BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS histories (graph TEXT PRIMARY KEY, body BLOB NOT NULL, sum BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS files (path TEXT PRIMARY KEY, body BLOB NOT NULL, sum BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS stored (
    digest BLOB PRIMARY KEY, size INTEGER NOT NULL, rate REAL NOT NULL, priority REAL NOT NULL
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS state (name TEXT PRIMARY KEY, value REAL NOT NULL);
"""
_DAMAGED = {
    sqlite3.SQLITE_CORRUPT,
    sqlite3.SQLITE_NOTADB,
    sqlite3.SQLITE_ERROR,
    sqlite3.SQLITE_SCHEMA,
}
# Of the failures of the disk only these speak of what is stored; a full disk or a quota fails in writing, and what is
# there stays good.
_DAMAGED_IO = {sqlite3.SQLITE_IOERR_READ, sqlite3.SQLITE_IOERR_SHORT_READ, sqlite3.SQLITE_IOERR_CORRUPTFS}
_BUSY = {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}
_BUSY_SECONDS = 20.0
_MISSES_PER_LOOK, _KEYS_PER_MISS = 32, 30
_TABLES = ("results", "histories", "files")
_REFUSED = (sqlite3.DatabaseError, UnicodeDecodeError)
"""What SQLite raises.  Where a damaged schema is no text, quoting it in a message fails."""
_ODD = (ValueError, TypeError, ArithmeticError, LookupError, AttributeError, MemoryError)
"""What an entry raises that holds something else than it should."""
_SOUND = """typeof(digest) = 'blob' AND typeof(size) = 'integer' AND size BETWEEN 0 AND 1000000000000000
    AND typeof(priority) = 'real' AND abs(priority) < 1e12"""
"""Rows of `stored` that can be true: that table has no checksums, as it decides only what leaves first."""


_FIXED_SECONDS = 10e-3
_READ_BYTES_PER_SECOND = 1.2e9


def load_seconds(size: int) -> float:
    """Estimate what storing is worth for a value of `size` bytes, s: reading it, and a fixed part.

    Measured on two cores: 3 ms to open, check and decode a small file, twice that to write it, 1.2 GB/s beyond.
    """
    return _FIXED_SECONDS + size / _READ_BYTES_PER_SECOND


class Recipe(NamedTuple):
    """All that went into a key, readable: what the reasons of the next run are made from.

    ``code`` is the fingerprint as hex, ``params`` JSON text, ``ports`` the input of each link and ``inputs`` the value
    digests there, 16 bytes each, one after the other (thousands of recipes are held, most of them with several links),
    ``files`` digest and name of each file read by parameter, ``device`` the class of the device or empty.
    """

    type: str
    version: int
    code: str
    params: str
    ports: tuple[str, ...]
    inputs: bytes
    files: Mapping[str, str]
    device: str

    def links(self, port: str) -> list[bytes]:
        """Return the value digests that come in at a port, in order."""
        return [self.inputs[16 * place : 16 * place + 16] for place, name in enumerate(self.ports) if name == port]


class Record(NamedTuple):
    """What is remembered of one computed node.

    Attributes:
        key: its cache key.
        digests, sizes: content digest and bytes of each output, in order.
        seconds: what computing it took.
        restore: seconds to have its values again: the same plus its share of that of inputs which are not stored.
        files: (name, size, digest) of files that its outputs hold, for export nodes.
        recipe: what went into the key.
        peak: bytes of the node's inputs and outputs together.
        shapes: shape and dtype of each output's largest array as text, empty where it has none.
    """

    key: bytes
    digests: tuple[bytes, ...]
    sizes: tuple[int, ...]
    seconds: float
    restore: float
    files: tuple[tuple[str, int, str], ...]
    recipe: Recipe
    peak: int = 0
    shapes: tuple[str, ...] = ()

    @property
    def worth_storing(self) -> bool:
        """True where loading the values from disk is faster than having them computed again."""
        return self.restore > _FIXED_SECONDS and self.restore > load_seconds(sum(self.sizes))

    def body(self) -> bytes:
        """Return the record as JSON bytes, without its key."""
        digests = [digest.hex() for digest in self.digests]
        type_id, version, code, params, ports, inputs, files, device = self.recipe
        recipe = (type_id, version, code, params, ports, inputs.hex(), files, device)
        data = (
            digests,
            self.sizes,
            round(self.seconds, 6),
            round(self.restore, 6),
            self.files,
            recipe,
            self.peak,
            self.shapes,
        )
        return orjson.dumps(data)

    @classmethod
    def parse(cls, key: bytes, body: bytes) -> Record:
        """Return the record that `body` describes."""
        digests, sizes, seconds, restore, files, recipe, peak, shapes = orjson.loads(body)
        type_id, version, code, params, ports, inputs, read, device = recipe
        return cls(
            key,
            tuple(bytes.fromhex(item) for item in digests),
            tuple(sizes),
            seconds,
            restore,
            tuple((name, size, digest) for name, size, digest in files),
            Recipe(type_id, version, code, params, tuple(ports), bytes.fromhex(inputs), read, device),
            peak,
            tuple(shapes),
        )


class Index:
    """The SQLite index below one folder.  Safe to use from several threads and processes.

    Reading never fails: what cannot be read is absent.  Writing fails quietly after one warning (a full disk), and the
    index then only reads.

    Attributes:
        writable: False after writing failed.
        complains: give that one warning; False where the same was said already.

    Raises:
        OSError: the folder cannot be created or written to.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "index.sqlite"
        self._lock = RLock()
        self.writable = True
        self.complains = True
        self._keys: set[bytes] | None = None
        self._misses = 0
        folder.mkdir(parents=True, exist_ok=True)
        try:
            self._connection = self._open()
        except _REFUSED as error:
            if not _is_damage(error):
                raise OSError(f"the cache index cannot be opened ({error})") from error
            self._set_aside(error)

    def _open(self) -> sqlite3.Connection:
        deadline = time.monotonic() + _BUSY_SECONDS
        while True:
            try:
                return self._open_once()
            except sqlite3.DatabaseError as error:
                # Where several processes begin a database at once, SQLite refuses all but one without waiting.
                if _code(error) not in _BUSY or time.monotonic() > deadline:
                    raise
            time.sleep(0.01)

    def _open_once(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self._path, timeout=_BUSY_SECONDS, isolation_level=None, check_same_thread=False)
        try:
            connection.execute("PRAGMA journal_mode=WAL")
            connection.execute("PRAGMA synchronous=NORMAL")
            present = {row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type='table'")}
            if not {"results", "histories", "files", "stored", "state"} <= present:
                connection.executescript(_SCHEMA)
            connection.execute("BEGIN IMMEDIATE")
            connection.execute("ROLLBACK")
        except BaseException:
            connection.close()
            raise
        self._inode = self._path.stat().st_ino
        return connection

    # Guarding: every access goes through one of these two.

    def _read(self, work: Callable[[sqlite3.Connection], T], absent: T) -> T:
        with self._lock:
            try:
                return work(self._connection)
            except _REFUSED as error:
                self._failed(error)
            except _ODD as error:
                log.warning("a cache entry cannot be read (%s); it is computed again", error)
            return absent

    def _write(self, work: Callable[[sqlite3.Connection], None]) -> None:
        with self._lock:
            if not self.writable:
                return
            try:
                self._connection.execute("BEGIN IMMEDIATE")
                work(self._connection)
                self._connection.execute("COMMIT")
            except (*_REFUSED, *_ODD) as error:
                with contextlib.suppress(*_REFUSED):
                    self._connection.execute("ROLLBACK")
                if isinstance(error, _REFUSED):
                    self._failed(error)
                else:
                    log.warning("a cache entry cannot be written (%s); it is not remembered", error)

    def _failed(self, error: Exception) -> None:
        if _is_damage(error):
            self._set_aside(error)
        elif _code(error) in _BUSY:
            log.warning("the cache index is busy with another process; this result is not remembered")
        elif self.writable:
            self.writable = False
            if self.complains:
                log.warning("the cache index cannot be written (%s); results are not remembered", error)

    def _set_aside(self, error: Exception) -> None:
        """Begin anew after damage, unless another process has done so already."""
        with self._lock:
            with contextlib.suppress(sqlite3.Error, AttributeError):
                self._connection.close()
            try:
                if not hasattr(self, "_inode") or self._path.stat().st_ino == self._inode:
                    log.warning("the cache index is damaged (%s); it is begun anew", error)
                    for suffix in ("-wal", "-shm", ""):
                        Path(f"{self._path}{suffix}").unlink(missing_ok=True)
            except OSError:
                pass
            try:
                self._connection = self._open()
            except (*_REFUSED, OSError) as again:
                log.warning("the cache index cannot be begun anew (%s); results are not remembered", again)
                self.writable = False
                self._connection = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
                self._connection.executescript(_SCHEMA)

    # Rows with a checksum.

    def _get(self, table: str, column: str, name: Any, parse: Callable[[bytes], T]) -> T | None:
        def work(connection: sqlite3.Connection) -> T | None:
            row = connection.execute(f"SELECT body, sum FROM {table} WHERE {column} = ?", (name,)).fetchone()
            if row is None:
                return None
            if row[1] != _sum(name, row[0]):
                log.warning("an entry of the cache index is damaged; it is computed again")
                return None
            try:
                return parse(row[0])
            except _ODD as error:
                log.warning("an entry of the cache index cannot be read (%s); it is computed again", error)
                return None

        return self._read(work, None)

    def result(self, key: bytes) -> Record | None:
        """Return the record of a key, or None.

        A query that finds nothing costs as much as reading some thirty keys in a row.  So once misses have cost as much
        as reading all keys would, all are read, and later misses are answered from memory; results that other processes
        add from then on are computed again here.
        """
        if self._keys is not None and key not in self._keys:
            return None
        record = self._get("results", "key", key, lambda body: Record.parse(key, body))
        if record is not None:
            return record
        self._misses += 1
        if self._keys is None and self._misses % _MISSES_PER_LOOK == 0:
            query = "SELECT COUNT(*) FROM results"
            rows = self._read(lambda connection: int(connection.execute(query).fetchone()[0]), 0)
            if rows <= self._misses * _KEYS_PER_MISS:
                query = "SELECT key FROM results"
                self._keys = self._read(lambda connection: _first_column(connection, query), None)
        return None

    def add_results(self, records: Iterable[Record]) -> None:
        """Remember results, in one transaction."""
        rows = []
        for record in records:
            try:
                body = record.body()
            except TypeError as error:  # the name of a file need not be text
                log.warning("a result of %s is not remembered (%s)", record.recipe.type, error)
                continue
            rows.append((record.key, body, _sum(record.key, body)))
        if self._keys is not None:
            self._keys.update(row[0] for row in rows)
        self._write(lambda connection: _many(connection, "INSERT OR REPLACE INTO results VALUES (?, ?, ?)", rows))

    def history(self, graph: str) -> dict[str, bytes]:
        """Return the key of each node in the graph's last run."""

        def parse(body: bytes) -> dict[str, bytes]:
            return {id: bytes.fromhex(key) for id, key in orjson.loads(body).items()}

        return self._get("histories", "graph", graph, parse) or {}

    def set_history(self, graph: str, keys: Mapping[str, bytes]) -> None:
        """Remember the key of each node of a graph."""
        body = orjson.dumps({id: key.hex() for id, key in keys.items()})
        row = (graph, body, _sum(graph, body))
        self._write(lambda connection: _many(connection, "INSERT OR REPLACE INTO histories VALUES (?, ?, ?)", [row]))

    def file(self, path: str) -> tuple[tuple[int, ...], bytes] | None:
        """Return size, times of change in ns and inode of a file as last read, and its digest, or None."""

        def parse(body: bytes) -> tuple[tuple[int, ...], bytes]:
            *stamp, digest = orjson.loads(body)
            return tuple(map(int, stamp)), bytes.fromhex(digest)

        return self._get("files", "path", path, parse)

    def set_file(self, path: str, stamp: tuple[int, ...], digest: bytes) -> None:
        """Remember what a file held."""
        body = orjson.dumps([*stamp, digest.hex()])
        row = (path, body, _sum(path, body))
        self._write(lambda connection: _many(connection, "INSERT OR REPLACE INTO files VALUES (?, ?, ?)", [row]))

    # What is stored, for the collector.

    def add_stored(self, digest: bytes, size: int, seconds: float) -> None:
        """Note a value on disk: its file size and what it cost."""
        rate = seconds / max(size, 4096)

        def work(connection: sqlite3.Connection) -> None:
            priority = self._floor(connection) + rate
            connection.execute("INSERT OR REPLACE INTO stored VALUES (?, ?, ?, ?)", (digest, size, rate, priority))

        self._write(work)

    def renew(self, digests: Iterable[bytes]) -> None:
        """Renew the priority of values that were used."""

        def work(connection: sqlite3.Connection) -> None:
            floor = self._floor(connection)
            rows = [(floor, digest) for digest in digests]
            connection.executemany("UPDATE stored SET priority = ? + rate WHERE digest = ?", rows)

        self._write(work)

    def forget_stored(self, digests: Iterable[bytes], floor: float | None = None) -> None:
        """Drop values from the list; `floor` is the priority below which all have gone."""

        def work(connection: sqlite3.Connection) -> None:
            connection.executemany("DELETE FROM stored WHERE digest = ?", [(digest,) for digest in digests])
            if floor is not None:
                connection.execute("INSERT OR REPLACE INTO state VALUES ('floor', ?)", (floor,))

        self._write(work)

    def stored(self) -> list[tuple[bytes, int, float]]:
        """Return (digest, size, priority) of all values on disk, lowest priority first."""
        query = f"SELECT digest, size, priority FROM stored WHERE {_SOUND} ORDER BY priority, digest"
        return self._read(lambda connection: [tuple(row) for row in connection.execute(query)], [])

    def stored_bytes(self) -> int:
        """Return the bytes of all values on disk, as far as the index knows."""
        query = f"SELECT COALESCE(SUM(size), 0) FROM stored WHERE {_SOUND}"
        return self._read(lambda connection: int(connection.execute(query).fetchone()[0]), 0)

    def _floor(self, connection: sqlite3.Connection) -> float:
        query = "SELECT value FROM state WHERE name = 'floor' AND typeof(value) = 'real' AND abs(value) < 1e12"
        row = connection.execute(query).fetchone()
        return float(row[0]) if row else 0.0

    # The whole.

    def counts(self) -> dict[str, int]:
        """Return the number of rows of each table."""

        def work(connection: sqlite3.Connection) -> dict[str, int]:
            tables = (*_TABLES, "stored")
            return {name: connection.execute(f"SELECT COUNT(*) FROM {name}").fetchone()[0] for name in tables}

        return self._read(work, {})

    def damaged_rows(self) -> Iterator[tuple[str, Any]]:
        """Yield (table, name) of every row whose checksum is wrong, and remove it."""
        for table, column in zip(_TABLES, ("key", "graph", "path"), strict=True):
            query = f"SELECT {column}, body, sum FROM {table}"
            rows: list[Any] = self._read(lambda connection, query=query: list(connection.execute(query)), [])  # type: ignore[misc]
            bad = [name for name, body, sum_ in rows if sum_ != _sum(name, body)]
            statement = f"DELETE FROM {table} WHERE {column} = ?"
            if bad:
                self._write(lambda c, statement=statement, bad=bad: _many(c, statement, [(name,) for name in bad]))  # type: ignore[misc]
            yield from ((table, name) for name in bad)

    def clear(self) -> None:
        """Forget everything."""

        def work(connection: sqlite3.Connection) -> None:
            for table in (*_TABLES, "stored", "state"):
                connection.execute(f"DELETE FROM {table}")

        self._write(work)

    def close(self) -> None:
        """Close the connection."""
        with self._lock:
            self._connection.close()


def _many(connection: sqlite3.Connection, statement: str, rows: list[Any]) -> None:
    connection.executemany(statement, rows)


def _first_column(connection: sqlite3.Connection, query: str) -> set[bytes] | None:
    return {bytes(row[0]) for row in connection.execute(query)}


def _sum(name: Any, body: Any) -> bytes:
    if not isinstance(body, bytes):  # a damaged row may hold anything
        return b""
    return xxh3_64_digest((name if isinstance(name, bytes) else str(name).encode()) + b"\0" + body)


def _is_damage(error: Exception) -> bool:
    return (
        isinstance(error, UnicodeDecodeError)
        or _code(error) in _DAMAGED
        or getattr(error, "sqlite_errorcode", 0) in _DAMAGED_IO
    )


def _code(error: Exception) -> int:
    # Extended codes hold the primary one in their low byte.
    return getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & 0xFF
