"""Running a plan: what the plan leaves open is decided while values come in.

The state of a run, by step index:

``plan.digests``  what the step's outputs are, known from the cache or from computing them.
``_unresolved``   how many links come from steps whose digests are not known yet; at zero the step is *resolved*: it
                  gets its key, and either the cache knows the result or it must be computed.
``values``        the outputs themselves, while somebody may need them.
``_producing``    the step is queued, waiting for input values, or running.
``_missing``      how many input steps a producing step still waits for; those list it in ``_waiters``.
``_holders``      how many consumers may still need the values; at zero they are released.
``_status``       empty while open, then what became of it.

A worked example: a -> b -> c, where a's code changed.  a is resolved by the plan, not known, so it is *demanded*:
queued, computed, its digest noted.  That resolves b.  If a came out as before, b's key is known: b is cached, which
resolves c, cached as well, and nothing below a runs.  If not, b is demanded, has its one input at hand, and so on.  A
demanded step whose input is known but not at hand demands that input: it is loaded, or computed again in turn.

Workers are plain daemon threads.  One that finishes a step takes the newest ready step itself, so a chain runs in one
thread without hand-over, and depth comes before breadth, which keeps few values alive.  Others join once a node has run
for two milliseconds, or nodes typically take a fifth of one, and leave when that is over: handing over trivial nodes
would cost more than they do.
A step that does not answer to a cancel is left behind with its thread after a second: the run ends without it.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from array import array
from collections.abc import Iterable
from typing import Any

from nodegraph.errors import NodeError, sentence
from nodegraph.events import Event, Failed, Finished, NodeRun, Observer, OutputInfo, Planned, Progress, Started, Status
from nodegraph.plan import Plan
from nodegraph.porttypes import describe
from nodegraph.produce import Outcome, Producer
from nodegraph.publish import Publisher

log = logging.getLogger("nodegraph.run")

GRACE_SECONDS = 0.9
_LOOK_SECONDS = 2e-3
_PATIENT_SECONDS = 20e-3
_SHARE_SECONDS = 2e-4


class Scheduler:
    """One execution of a plan.

    Attributes:
        plan: what is executed; its digests and records fill as steps are computed.
        publisher: writes the files of export nodes.
        values: outputs by step, while somebody may need them; those of the targets stay.
        errors: one for each step that failed.
        cancelled: True when it was over before all was done.
    """

    def __init__(
        self,
        plan: Plan,
        publisher: Publisher,
        *,
        jobs: int | None = None,
        observers: Iterable[Observer] = (),
        keep_values: bool = True,
        cancel: threading.Event | None = None,
    ) -> None:
        self.plan = plan
        self.publisher = publisher
        self._steps = plan.network.steps
        self._cache = plan.cache
        self._jobs = max(1, jobs or os.cpu_count() or 1)
        self._observers = list(observers)
        self._cancel = cancel or threading.Event()
        self.cancelled = False
        count = len(self._steps)
        self._needed = bytearray(count)
        for index in plan.needed:
            self._needed[index] = 1
        self._consumers = plan.network.consumers
        if len(plan.needed) < count:
            self._consumers = [list(filter(self._needed.__getitem__, consumers)) for consumers in self._consumers]
        self._unresolved = [0] * count
        self.values: list[tuple[Any, ...] | None] = [None] * count
        self._producing = bytearray(count)
        self._computed = bytearray(count)
        self._loading = bytearray(count)
        self._unloadable = bytearray(count)
        self._missing = [0] * count
        self._waiters: dict[int, list[int]] = {}
        self._holding = bytearray(self._needed)
        self._holders = [len(consumers) for consumers in self._consumers]
        self._equal_steps: dict[bytes, list[int]] = {}
        self._status: list[Status | None] = [None] * count
        self._reason = [""] * count
        self._seconds = [0.0] * count
        self._begun = array("d", bytes(8 * count))
        self._worker = [0] * count
        self.errors: list[NodeError] = []
        self._pinned = {index for index, _ in plan.targets} if keep_values else set()
        self._ready: list[int] = []
        self._open = 0
        self._idle = 0
        self._typical = 0.0
        self._running: set[int] = set()
        self._workers = 0
        self._over = False
        self._crash: BaseException | None = None
        self._lock = threading.Lock()
        self._work_waits = threading.Condition(self._lock)
        self._progressed = threading.Condition(self._lock)
        self._outbox: list[Event] = []
        self._telling = 0
        self._emitting = threading.Lock()
        self._zero = time.perf_counter()
        self._producer = Producer(plan, publisher, self._cancel, self._report if self._observers else None)

    # From outside.

    def execute(self, want: int | None = None) -> None:
        """Run to the end, or until it is cancelled or interrupted (Ctrl-C).

        With `want`, the values of that step are at hand afterwards, even where the cache knows its result.
        """
        self._emit(Planned(self.plan))
        interrupted = False
        try:
            with self._lock:
                self._begin()
                if want is not None and self.plan.digests[want] is not None:
                    self._demand(want)
                self._tell()
                if self._ready:
                    self._start_worker()
            while not self._wait():
                pass
        except KeyboardInterrupt:
            interrupted = True
            self._cancel.set()
        if self._cancel.is_set():
            self._wind_down()
        with self._lock:
            self._over = True
            self._work_waits.notify_all()
        if self._crash is not None:
            raise self._crash
        self.cancelled = interrupted or (self._cancel.is_set() and self._open > 0)
        self._conclude()
        self.plan.remember()
        self._cache.flush()

    def _wait(self) -> bool:
        """Wait until something ends the run; return True then."""
        with self._lock:
            busy = self._open or self._telling
            if busy and self._crash is None and not self._cancel.is_set():
                # A wait without end could not see a cancel that is set from another thread.
                self._progressed.wait(_LOOK_SECONDS if self._ready else _PATIENT_SECONDS)
                busy = self._open or self._telling
                if self._ready and self._worth_sharing():
                    self._share()
            return not busy or self._crash is not None or self._cancel.is_set()

    def _wind_down(self) -> None:
        deadline = time.perf_counter() + GRACE_SECONDS
        with self._lock:
            self._ready.clear()
            while self._running and (left := deadline - time.perf_counter()) > 0:
                self._progressed.wait(left)
            for index in sorted(self._running):
                log.warning("node '%s' did not stop within a second; it is left behind", self._steps[index].id)

    def _conclude(self) -> None:
        for index in self.plan.needed:
            if self._status[index] is None:
                self._status[index] = "computed" if self._computed[index] else "cancelled"

    # Under the lock: deciding.

    def _begin(self) -> None:
        plan = self.plan
        self._open = len(plan.needed)
        for index in plan.needed:
            links = self._steps[index].inputs
            self._unresolved[index] = sum(1 for _, source, _ in links if plan.digests[source] is None)
        demanded = []
        for index in plan.needed:
            error = plan.error[index]
            if self._status[index] is not None:
                continue
            if plan.digests[index] is not None:
                self._settle_known(index)
            elif error is not None:
                self._fail(index, error)
            elif self._unresolved[index] == 0:
                demanded.append(index)
        # The newest ready step runs first: the author's first source is pushed last.
        for index in reversed(demanded):
            if self._status[index] is None:
                self._first(index)

    def _first(self, index: int) -> None:
        """Compute a step that has just been resolved, unless an equal one is under way: then wait for that."""
        key = self.plan.key[index] or b""
        under_way = self._equal_steps.get(key)
        if under_way is not None and index not in self.plan.forced and not self.plan.checked:
            under_way.append(index)
            return
        self._equal_steps.setdefault(key, [])
        self._reason[index] = self.plan.reason(index)
        self._demand(index)

    def _settle_known(self, index: int) -> None:
        """A step's result is known: it is cached, unless its files must be written."""
        record = self.plan.record[index]
        if record is not None and record.files:
            try:
                self.publisher.claim(self._steps[index].id, record.files)
            except ValueError as error:
                self._fail(index, NodeError(self._steps[index].id, self._steps[index].node.id, str(error)))
                return
            if why := self.publisher.stale(record.files):
                self._reason[index] = why
                self._demand(index)
                return
            self.publisher.confirm(record.files)
        self._seconds[index] = record.seconds if record is not None else 0.0
        self._status[index] = "cached"
        self._open -= 1
        self._let_go(index)

    def _demand(self, index: int) -> None:
        """Have the values of a step produced, and before them whatever input values are not at hand."""
        stack = [index]
        while stack:
            current = stack.pop()
            if self._producing[current] or self.values[current] is not None:
                continue
            self._producing[current] = 1
            if self._status[current] is not None:  # known or computed earlier, but its values are not at hand
                self._open += 1
                self._status[current] = None
            self._loading[current] = self._loadable(current)
            if self._loading[current]:
                self._push(current)
                continue
            if self.plan.record[current] is not None and not self._reason[current]:
                self._reason[current] = self.plan.reason_for_value(current)
            if not self._holding[current]:
                self._holding[current] = 1
                for _, source, _ in self._steps[current].inputs:
                    self._holders[source] += 1
            absent = {source for _, source, _ in self._steps[current].inputs if self.values[source] is None}
            self._missing[current] = len(absent)
            for source in absent:
                self._waiters.setdefault(source, []).append(current)
            stack.extend(absent)
            if not absent:
                self._push(current)

    def _loadable(self, index: int) -> bool:
        digests = self.plan.digests[index]
        return digests is not None and not self._unloadable[index] and all(map(self._cache.has, digests))

    def _push(self, index: int) -> None:
        self._ready.append(index)

    def _worth_sharing(self) -> bool:
        """Say whether nodes take long enough that handing them to another thread costs less than it gains."""
        if self._typical > _SHARE_SECONDS:
            return True
        now = time.perf_counter() - self._zero
        return any(now - self._begun[index] > _LOOK_SECONDS for index in self._running)

    def _crowded(self) -> bool:
        """Say whether a worker does better to wait: another one runs trivial nodes, and two would only hinder it."""
        return bool(self._running) and not self._worth_sharing()

    def _share(self) -> None:
        """Wake workers, and start more, while there is more to do than they take."""
        self._work_waits.notify(len(self._ready))
        while self._workers < self._jobs and len(self._ready) > self._idle:
            self._start_worker()

    def _start_worker(self) -> None:
        self._workers += 1
        self._idle += 1
        threading.Thread(target=self._work, args=(self._workers,), daemon=True, name=f"node-{self._workers}").start()

    def _let_go(self, index: int) -> None:
        """A step is settled: it needs its inputs' values no more; its own stay only for those who may."""
        if self._holding[index]:
            self._holding[index] = 0
            for _, source, _ in self._steps[index].inputs:
                self._holders[source] -= 1
                if not self._holders[source] and source not in self._pinned and not self._producing[source]:
                    self.values[source] = None
        if not self._holders[index] and index not in self._pinned:
            self.values[index] = None

    def _settle(self, index: int, status: Status) -> None:
        """Note what became of a step; then wake who waits for its values and resolve who waits for its digests."""
        self._producing[index] = 0
        self._status[index] = status
        self._open -= 1
        for waiter in self._waiters.pop(index, ()):
            self._missing[waiter] -= 1
            if not self._missing[waiter]:
                self._push(waiter)
        self._let_go(index)

    def _resolve_consumers(self, index: int) -> None:
        """A step's digests have become known: resolve its consumers, and on through those the cache knows."""
        stack = [index]
        while stack:
            for consumer in self._consumers[stack.pop()]:
                self._unresolved[consumer] -= 1
                if self._unresolved[consumer] or self._status[consumer] is not None:
                    continue
                if self.plan.resolve(consumer):
                    self._settle_known(consumer)
                    stack.append(consumer)
                elif (error := self.plan.error[consumer]) is not None:
                    self._fail(consumer, error)
                else:
                    self._first(consumer)
        self._release_equal_steps(index)

    def _release_equal_steps(self, index: int) -> None:
        """Let steps of the same key as a finished one go on: the cache knows their result now."""
        for twin in self._equal_steps.pop(self.plan.key[index] or b"", ()):
            if self._status[twin] is not None:
                continue
            if self.plan.resolve(twin):
                self._settle_known(twin)
                self._resolve_consumers(twin)
            else:
                self._first(twin)

    def _fail(self, index: int, error: NodeError) -> None:
        """A step failed: so do its descendants, as skipped; everything else goes on."""
        self.errors.append(error)
        self._reason[index] = error.message
        self._stop(index, "failed")
        if self._observers:
            self._outbox.append(Failed(self.node_run(index)))
        stack = [index]
        while stack:
            current = stack.pop()
            for consumer in self._consumers[current]:
                if self._status[consumer] is None:
                    self._reason[consumer] = f"node '{self._steps[current].id}' {self._status[current]}"
                    self._stop(consumer, "skipped")
                    stack.append(consumer)
        for twin in self._equal_steps.pop(self.plan.key[index] or b"", ()):
            if self._status[twin] is None:
                self._first(twin)

    def _stop(self, index: int, status: Status) -> None:
        self._producing[index] = 0
        self._status[index] = status
        self._open -= 1
        self._waiters.pop(index, None)
        self._let_go(index)

    # In the workers: producing.

    def _work(self, number: int) -> None:
        try:
            with self._lock:
                while True:
                    while not self._over and self._crash is None and (not self._ready or self._crowded()):
                        self._work_waits.wait()
                    if not self._ready or self._over or self._crash is not None or self._cancel.is_set():
                        return
                    index = self._ready.pop()
                    if self._status[index] is not None:
                        continue
                    self._idle -= 1
                    self._running.add(index)
                    self._begun[index] = time.perf_counter() - self._zero
                    if self._ready and self._typical > _SHARE_SECONDS:
                        self._share()
                    self._worker[index] = number
                    self._lock.release()
                    try:
                        outcome = self._produce(index)
                    finally:
                        self._lock.acquire()
                    self._running.discard(index)
                    self._idle += 1
                    self._accept(index, outcome)
                    self._tell()
                    if not self._open or self._cancel.is_set():
                        self._progressed.notify_all()
        except (
            BaseException
        ) as error:  # a mistake in the scheduler itself must reach the caller, not vanish in a thread
            with self._lock:
                self._crash = error
                self._progressed.notify_all()
                self._work_waits.notify_all()

    def _accept(self, index: int, outcome: Outcome | NodeError | None) -> None:
        """Take what a worker brings back: values, a failure, or (None) a stored value that was not there after all."""
        if self._over or self._status[index] is not None:
            return
        if isinstance(outcome, NodeError):
            self._fail(index, outcome)
        elif outcome is None:
            self._producing[index] = 0
            self._unloadable[index] = 1
            self._demand(index)
        elif outcome.status != "cancelled":
            new = self.plan.digests[index] is None
            self.values[index] = outcome.values
            if outcome.record is not None:
                self.plan.note(index, outcome.record)
                self._seconds[index] = outcome.record.seconds
                self._typical += 0.1 * (outcome.record.seconds - self._typical)
                self._computed[index] = 1
            self._settle(index, "computed" if self._computed[index] else "cached")
            if new:
                self.plan.digests[index] = outcome.digests
                self._holders[index] += 1  # until it is clear what its consumers' consumers demand
                self._resolve_consumers(index)
                self._holders[index] -= 1
                self._let_go(index)
            if outcome.status == "computed" and self._observers:
                self._outbox.append(Finished(self.node_run(index)))

    def _produce(self, index: int) -> Outcome | NodeError | None:
        if self._loading[index]:  # decided when it was queued: had it not been there, its inputs would be at hand
            return self._producer.load(index)
        begun = self._begun[index] = time.perf_counter() - self._zero
        step = self._steps[index]
        if self._observers:
            self._emit(Started(step.id, step.node.id, begun, self._worker[index]))
        sources = [self.values[source] for _, source, _ in step.inputs]
        handed_on = index not in self._pinned and bool(self._consumers[index])
        return self._producer.compute(index, sources, handed_on=handed_on)

    # Telling.

    def _tell(self) -> None:
        """Send what waits in the outbox.  Called under the lock and gives it up meanwhile: observers may be slow."""
        if not self._outbox:
            return
        events, self._outbox = self._outbox, []
        self._telling += 1
        self._lock.release()
        try:
            for event in events:
                self._emit(event)
        finally:
            self._lock.acquire()
            self._telling -= 1

    def _report(self, node: str, fraction: float | None, message: str) -> None:
        self._emit(Progress(node, fraction, message))

    def _emit(self, event: Event) -> None:
        if not self._observers:
            return
        with self._emitting:
            for observer in list(self._observers):
                try:
                    observer(event)
                except Exception as error:  # an observer must not disturb the run
                    log.warning("an observer failed and is dropped (%s)", sentence(error))
                    self._observers.remove(observer)

    def node_run(self, index: int) -> NodeRun:
        """Return what became of a step."""
        step, record, digests = self._steps[index], self.plan.record[index], self.plan.digests[index]
        status = self._status[index] or "cancelled"
        outputs: tuple[OutputInfo, ...] = ()
        if digests is not None and record is not None and status in ("computed", "cached"):
            ports = zip(step.node.outputs, step.types, digests, record.sizes, record.shapes, strict=True)
            outputs = tuple(
                [
                    OutputInfo(port.name, describe(kind), digest.hex(), size, shape)
                    for port, kind, digest, size, shape in ports
                ]
            )
        return NodeRun(
            step.id,
            step.node.id,
            step.node.version,
            status,
            self._reason[index],
            self._seconds[index],
            self._begun[index],
            self._worker[index],
            record.peak if record is not None and status == "computed" else 0,
            outputs,
            self._reason[index] if status == "failed" else "",
        )
