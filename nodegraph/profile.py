"""The profile of a run: an observer that writes what ran when, in which thread, as a Chrome trace.

The file opens in https://ui.perfetto.dev and in chrome://tracing.  A node is a slice in the row of the thread that
computed it; inside it lies ``compute``, the node's own function: what is left of the slice is spent on sealing, storing
and publishing its values.  Where the run uses an OpenCL device, ``otherData.kernels`` holds the time of each kernel.

Format: "Trace Event Format", Google, https://docs.google.com/document/d/1CvAClvFfyA5R-PhYUmn5OOQtYMH4h6I0nSsKchNAySU.
"""

from __future__ import annotations

import json
import os
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nodegraph import __version__
from nodegraph.events import Event, Failed, Finished, NodeRun, Planned, Started

if TYPE_CHECKING:
    from nodegraph.opencl import Timings

_MICRO = 1e6


class Profile:
    """Observes one run; `write` it when the run is over.  ``graph`` names the trace."""

    def __init__(self, graph: str) -> None:
        self._graph = graph
        self._ended: list[tuple[NodeRun, float]] = []
        self._zero = time.perf_counter()
        self._started: dict[str, Started] = {}
        self._timings: Timings | None = None
        self._timing = ExitStack()

    def __call__(self, event: Event) -> None:
        """Take an event of the run."""
        now = time.perf_counter()
        if isinstance(event, Planned):
            self._zero = now
            if event.plan.device is not None:
                self._timings = self._timing.enter_context(event.plan.device.timings())
        elif isinstance(event, Started):
            # It says when it began on the run's own clock.  News may come late but never early: the earliest is right.
            self._zero = min(self._zero, now - event.start)
            self._started[event.node] = event
        elif isinstance(event, (Finished, Failed)):
            self._ended.append((event.run, now))

    def _slices(self) -> list[dict[str, Any]]:
        """Return the slices of all nodes; those of one thread follow each other."""
        rows: dict[int, list[tuple[float, float, NodeRun]]] = {}
        for run, moment in self._ended:
            end = moment - self._zero
            begun = self._started.get(run.id)
            if begun is None:  # it failed before it began: a file that is not there
                rows.setdefault(0, []).append((end, end, run))
            else:
                rows.setdefault(begun.worker, []).append((begun.start, end, run))
        slices = []
        for worker, row in sorted(rows.items()):
            row.sort(key=lambda item: item[0])
            # A thread may start its next node before the end of the last one is told.
            follows = [start for start, _, _ in row[1:]] + [float("inf")]
            for (start, end, run), limit in zip(row, follows, strict=True):
                end = min(max(end, start + run.seconds), limit)
                slices.append(_slice(run.id, run, start, end, worker, _facts(run)))
                if run.status == "computed":
                    slices.append(_slice("compute", run, start, min(start + run.seconds, end), worker, {}))
        return slices

    def trace(self) -> dict[str, Any]:
        """Return the trace as JSON data.  Waits for kernels that still run."""
        self._timing.close()
        slices = self._slices()
        workers = sorted({item["tid"] for item in slices})
        named = [_metadata("process_name", 0, f"nodegraph {self._graph}")]
        named += [_metadata("thread_name", item, f"worker {item}" if item else "not started") for item in workers]
        other: dict[str, Any] = {"graph": self._graph, "nodegraph": __version__}
        if self._timings is not None:
            other["kernels"] = [
                {
                    "file": row.file,
                    "kernel": row.kernel,
                    "count": row.count,
                    "min ms": 1e3 * row.min,
                    "median ms": 1e3 * row.median,
                    "max ms": 1e3 * row.max,
                    "total ms": 1e3 * row.total,
                }
                for row in self._timings.rows()
            ]
        return {"traceEvents": named + slices, "displayTimeUnit": "ms", "otherData": other}

    def write(self, path: Path) -> None:
        """Write the trace whole or not at all.  Raises OSError where it cannot be written."""
        from nodegraph.atomic import write_atomically

        write_atomically(path, json.dumps(self.trace()).encode())


def _facts(run: NodeRun) -> dict[str, str]:
    facts = {"type": run.type, "status": run.status, "reason": run.reason}
    if run.peak_bytes:
        facts["peak bytes"] = str(run.peak_bytes)
    for output in run.outputs:
        facts[f"output {output.name}"] = " ".join([output.type, output.shape]).strip()
    return facts


def _slice(name: str, run: NodeRun, start: float, end: float, worker: int, facts: dict[str, str]) -> dict[str, Any]:
    return {
        "name": name,
        "cat": run.type,
        "ph": "X",
        "ts": round(start * _MICRO, 3),
        "dur": round((end - start) * _MICRO, 3),
        "pid": os.getpid(),
        "tid": worker,
        "args": facts,
    }


def _metadata(kind: str, worker: int, name: str) -> dict[str, Any]:
    return {"name": kind, "ph": "M", "pid": os.getpid(), "tid": worker, "args": {"name": name}}
