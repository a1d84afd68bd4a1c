"""The memory tier: a store bounded in bytes that keeps what is expensive per byte.

GreedyDual-Size (Cao and Irani, "Cost-aware WWW proxy caching algorithms", USENIX 1997): each value has a priority
``L + seconds / bytes``; the lowest leaves first and its priority becomes the new floor ``L``, so that values which are
not asked for age.  A 30 s result outlives any number of 10 ms ones of its size.
"""

from __future__ import annotations

import heapq
from threading import Lock
from typing import Any


class MemoryStore:
    """Values by digest, at most `budget` bytes of them.  Safe to use from several threads; O(log n) a call."""

    def __init__(self, budget: int) -> None:
        self.budget = budget
        self.size = 0
        self._values: dict[bytes, tuple[Any, int, float, float]] = {}
        self._heap: list[tuple[float, bytes]] = []
        self._floor = 0.0
        self._lock = Lock()

    def __contains__(self, digest: bytes) -> bool:
        return digest in self._values

    def __len__(self) -> int:
        return len(self._values)

    def get(self, digest: bytes) -> Any | None:
        """Return the value, or None; being asked for renews its priority."""
        entry = self._values.get(digest)
        if entry is None:
            return None
        value, size, rate, priority = entry
        if priority < self._floor + rate:
            with self._lock:
                if digest in self._values:
                    self._enter(digest, value, size, rate)
        return value

    def put(self, digest: bytes, value: Any, size: int, seconds: float) -> None:
        """Keep a value of `size` bytes that took `seconds` to compute, if it is worth its place."""
        if size > self.budget:
            return
        with self._lock:
            if digest in self._values:
                return
            self.size += size
            self._enter(digest, value, size, seconds / max(size, 64))
            while self.size > self.budget:
                self._evict()

    def discard(self, digest: bytes) -> None:
        """Forget a value."""
        with self._lock:
            entry = self._values.pop(digest, None)
            if entry is not None:
                self.size -= entry[1]

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._values.clear()
            self._heap.clear()
            self.size = 0

    def _enter(self, digest: bytes, value: Any, size: int, rate: float) -> None:
        priority = self._floor + rate
        self._values[digest] = (value, size, rate, priority)
        heapq.heappush(self._heap, (priority, digest))
        if len(self._heap) > 4 * len(self._values) + 64:  # renewed entries leave stale ones behind
            self._heap = [(entry[3], key) for key, entry in self._values.items()]
            heapq.heapify(self._heap)

    def _evict(self) -> None:
        while self._heap:
            priority, digest = heapq.heappop(self._heap)
            entry = self._values.get(digest)
            if entry is not None and entry[3] == priority:
                del self._values[digest]
                self.size -= entry[1]
                self._floor = priority
                return
