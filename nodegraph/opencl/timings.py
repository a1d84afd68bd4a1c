"""How long kernels take, measured by the device itself."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyopencl as cl

_UNSETTLED = 4096


@dataclass(frozen=True, slots=True)
class KernelTiming:
    """The launches of one kernel: how many, and how long they ran on the device, seconds."""

    file: str
    kernel: str
    count: int
    min: float
    median: float
    max: float
    total: float


class Timings:
    """Collects the launches of kernels; print it, or read `rows`.  Made by `Device.timings`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pending: list[tuple[tuple[str, str], cl.Event]] = []
        self._seconds: dict[tuple[str, str], list[float]] = {}

    def add(self, file: str, kernel: str, event: cl.Event) -> None:
        """Remember one launch; its event needs a queue with profiling."""
        with self._lock:
            self._pending.append(((file, kernel), event))
            # An event keeps what it used alive: a long run must not gather them without end.
            if len(self._pending) >= _UNSETTLED:
                self._settle()

    def rows(self) -> list[KernelTiming]:
        """Return one row per kernel, the one that took most in all first.  Waits for launches that still run."""
        with self._lock:
            self._settle()
            rows = [
                KernelTiming(file, kernel, len(taken), min(taken), median(taken), max(taken), sum(taken))
                for (file, kernel), taken in self._seconds.items()
            ]
        return sorted(rows, key=lambda row: -row.total)

    def __str__(self) -> str:
        rows = self.rows()
        names = [f"{row.file}:{row.kernel}" for row in rows]
        width = max([6, *map(len, names)])
        lines = [f"{'kernel':<{width}}  {'count':>6}  {'min ms':>9}  {'median ms':>9}  {'max ms':>9}  {'total ms':>9}"]
        for name, row in zip(names, rows, strict=True):
            times = "  ".join([f"{1e3 * item:9.3f}" for item in (row.min, row.median, row.max, row.total)])
            lines.append(f"{name:<{width}}  {row.count:>6}  {times}")
        return "\n".join(lines)

    def _settle(self) -> None:
        pending, self._pending = self._pending, []
        for key, event in pending:
            event.wait()
            self._seconds.setdefault(key, []).append(1e-9 * (event.profile.end - event.profile.start))
