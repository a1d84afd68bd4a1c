"""Running a plan: what the plan leaves open is decided while values come in.

The state of a run, by step index:

``plan.digests``  what the step's outputs are, known from the cache or from computing them.
``_unresolved``   how many links come from steps whose digests are not known yet; at zero the step is *resolved*: it
                  gets its key, and either the cache knows the result or it must be computed.
``_values``       the outputs themselves, while somebody may need them.
``_producing``    the step is queued, waiting for input values, or running.
``_missing``      how many input steps a producing step still waits for; those list it in ``_waiters``.
``_holders``      how many consumers may still need the values; at zero they are released.
``_status``       empty while open, then what became of it.

A worked example: a -> b -> c, where a's code changed.  a is resolved by the plan, not known, so it is *demanded*:
queued, computed, its digest noted.  That resolves b.  If a came out as before, b's key is known: b is cached, which
resolves c, cached as well, and nothing below a runs.  If not, b is demanded, has its one input at hand, and so on.  A
demanded step whose input is known but not at hand demands that input: it is loaded, or computed again in turn.

Workers are plain daemon threads.  One that finishes a step takes the newest ready step itself, so a chain runs in one
thread without hand-over, and depth comes before breadth, which keeps few values alive.  A step that does not answer to
a cancel is left behind with its thread after a second: the run ends without it.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xxhash import xxh3_128_digest

from nodegraph import codec
from nodegraph.cache import Cache, Record, default_cache
from nodegraph.cache.index import load_seconds
from nodegraph.context import Context
from nodegraph.errors import Cancelled, NodeError, RunError, sentence
from nodegraph.events import Event, Failed, Finished, NodeRun, Observer, OutputInfo, Planned, Progress, Started, Status
from nodegraph.files import File
from nodegraph.opencl import choose, is_on_device, to_device, to_host
from nodegraph.plan import Plan
from nodegraph.porttypes import describe, shape_text
from nodegraph.publish import Publisher, files_of

if TYPE_CHECKING:
    from nodegraph.graph import Graph

log = logging.getLogger("nodegraph.run")

GRACE_SECONDS = 0.9
_PROGRESS_SECONDS = 0.05


def plan_graph(
    graph: Graph,
    targets: Sequence[str] = (),
    *,
    overrides: Mapping[str, Any] | None = None,
    cache: Cache | None = None,
    device: str = "auto",
    force: Iterable[str] = (),
    checked: bool = False,
) -> Plan:
    """Return the plan of a run.  Arguments as for `nodegraph.graph.Graph.run`."""
    network = graph.network(overrides)
    uses_device = device not in ("auto", "none") or any(step.node.twin is not None for step in network.steps)
    chosen = choose(device) if uses_device else None
    cache = cache if cache is not None else default_cache()
    return Plan(network, cache, targets, device=chosen, force=force, checked=checked)


def run_graph(
    graph: Graph,
    targets: Sequence[str] = (),
    *,
    overrides: Mapping[str, Any] | None = None,
    cache: Cache | None = None,
    jobs: int | None = None,
    device: str = "auto",
    out: str | os.PathLike[str] | None = None,
    force: Iterable[str] = (),
    checked: bool = False,
    observers: Iterable[Observer] = (),
    check: bool = True,
    keep_values: bool = True,
    cancel: threading.Event | None = None,
) -> Result:
    """Run a graph and return the result.

    The arguments are those of `nodegraph.graph.Graph.run` and two for runners: `keep_values` holds the values of the
    targets in the result, and setting `cancel` from another thread stops the run.
    """
    plan = plan_graph(graph, targets, overrides=overrides, cache=cache, device=device, force=force, checked=checked)
    plan.check_memory()
    folder = Path(out) if out is not None else default_out(graph)
    run = Run(
        plan, Publisher(folder, plan.cache), jobs=jobs, observers=observers, keep_values=keep_values, cancel=cancel
    )
    result = run.execute()
    if check and result.cancelled:
        raise Cancelled("the run was cancelled; what was finished is kept")
    if check and result.errors:
        raise RunError(result)
    return result


def default_out(graph: Graph) -> Path:
    """Return where a graph's files go by default: ``out/<name of its file>`` in the current folder."""
    return Path("out") / (graph.path.stem if graph.path else "graph")


class Run:
    """One execution of a plan."""

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
        count = len(self._steps)
        self._needed = bytearray(count)
        for index in plan.needed:
            self._needed[index] = 1
        self._consumers = [
            [consumer for consumer in plan.network.consumers[index] if self._needed[consumer]]
            if self._needed[index]
            else []
            for index in range(count)
        ]
        self._unresolved = [0] * count
        self._values: list[tuple[Any, ...] | None] = [None] * count
        self._producing = bytearray(count)
        self._unloadable = bytearray(count)
        self._missing = [0] * count
        self._waiters: dict[int, list[int]] = {}
        self._holding = bytearray(self._needed)
        self._holders = [len(consumers) for consumers in self._consumers]
        self._equal_steps: dict[bytes, list[int]] = {}
        self._status: list[Status | None] = [None] * count
        self._reason = [""] * count
        self._seconds = [0.0] * count
        self._begun = [0.0] * count
        self._worker = [0] * count
        self._peak = [0] * count
        self._shapes: dict[int, tuple[str, ...]] = {}
        self._errors: list[NodeError] = []
        self._pinned = {index for index, _ in plan.targets} if keep_values else set()
        self._wanted: list[int] = []
        self._ready: list[int] = []
        self._open = 0
        self._idle = 0
        self._running: set[int] = set()
        self._workers = 0
        self._over = False
        self._crash: BaseException | None = None
        self._changed = threading.Condition(threading.Lock())
        self._emitting = threading.Lock()
        self._zero = time.perf_counter()

    # From outside.

    def want(self, index: int) -> None:
        """Have the values of a step at hand when the run is over, even where the cache knows its result."""
        self._wanted.append(index)

    def execute(self) -> Result:
        """Run to the end, to a cancel, or to the second interrupt; return what became of every node."""
        started = time.time()
        self._emit(Planned(self.plan))
        interrupted = False
        try:
            with self._changed:
                self._begin()
                self._spawn()
            while not self._wait():
                pass
        except KeyboardInterrupt:
            interrupted = True
            self._cancel.set()
        if self._cancel.is_set():
            self._wind_down()
        with self._changed:
            self._over = True
            self._changed.notify_all()
        if self._crash is not None:
            raise self._crash
        cancelled = interrupted or (self._cancel.is_set() and self._open > 0)
        self._conclude(cancelled)
        self.plan.remember()
        self._cache.flush()
        return Result(self, started, time.perf_counter() - self._zero, cancelled)

    def _wait(self) -> bool:
        """Wait until something ends the run; return True then."""
        with self._changed:
            # A wait without end could not see a cancel that is set from another thread.
            if self._open and self._crash is None and not self._cancel.is_set():
                self._changed.wait(0.1)
            return not self._open or self._crash is not None or self._cancel.is_set()

    def _wind_down(self) -> None:
        deadline = time.perf_counter() + GRACE_SECONDS
        with self._changed:
            self._ready.clear()
            self._changed.notify_all()
            while self._running and (left := deadline - time.perf_counter()) > 0:
                self._changed.wait(left)
            for index in sorted(self._running):
                log.warning("node '%s' did not stop within a second; it is left behind", self._steps[index].id)

    def _conclude(self, cancelled: bool) -> None:
        for index in self.plan.needed:
            if self._status[index] is None:
                self._status[index] = "cancelled" if cancelled else "cached"

    # Under the lock: deciding.

    def _begin(self) -> None:
        plan = self.plan
        demanded = []
        for index in plan.needed:
            step = self._steps[index]
            self._unresolved[index] = sum(1 for _, source, _ in step.inputs if plan.digests[source] is None)
            if plan.digests[index] is not None:
                self._settle_known(index)
            elif plan.error[index] is not None:
                self._open += 1
                demanded.append(index)
            else:
                self._open += 1
                if self._unresolved[index] == 0:
                    demanded.append(index)
        # The newest ready step runs first: the author's first source is pushed last.
        for index in reversed(demanded):
            error = plan.error[index]
            if error is not None:
                self._fail(index, error)
            elif self._status[index] is None:
                self._first(index)
        for index in self._wanted:
            if self.plan.digests[index] is not None:
                self._demand(index)

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
        self._status[index] = "cached"
        if record is not None:
            self._seconds[index] = record.seconds
            if record.files:
                try:
                    self.publisher.claim(self._steps[index].id, record.files)
                except ValueError as error:
                    self._open += 1
                    self._status[index] = None
                    self._fail(index, NodeError(self._steps[index].id, self._steps[index].node.id, str(error)))
                    return
                why = self.publisher.stale(record.files)
                if why:
                    self._reason[index] = why
                    self._open += 1
                    self._status[index] = None
                    self._demand(index)
                    return
                self.publisher.confirm(record.files)
        self._let_go(index)

    def _demand(self, index: int) -> None:
        """Have the values of a step produced, and before them whatever input values are not at hand."""
        stack = [index]
        while stack:
            current = stack.pop()
            if self._producing[current] or self._values[current] is not None:
                continue
            self._producing[current] = 1
            if self._status[current] == "cached":
                self._open += 1
                self._status[current] = None
            if self._loadable(current):
                self._push(current)
                continue
            if self.plan.record[current] is not None and not self._reason[current]:
                self._reason[current] = self.plan.reason_for_value(current)
            if not self._holding[current]:
                self._holding[current] = 1
                for _, source, _ in self._steps[current].inputs:
                    self._holders[source] += 1
            absent = {source for _, source, _ in self._steps[current].inputs if self._values[source] is None}
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
        if self._idle:
            self._changed.notify()

    def _spawn(self) -> None:
        """Start workers while there is more to do than they take."""
        while self._workers < self._jobs and len(self._ready) > self._idle:
            self._workers += 1
            self._idle += 1
            threading.Thread(
                target=self._work, args=(self._workers,), daemon=True, name=f"node-{self._workers}"
            ).start()

    def _let_go(self, index: int) -> None:
        """A step is settled: it needs its inputs' values no more; its own stay only for those who may."""
        if self._holding[index]:
            self._holding[index] = 0
            for _, source, _ in self._steps[index].inputs:
                self._holders[source] -= 1
                if not self._holders[source] and source not in self._pinned and not self._producing[source]:
                    self._values[source] = None
        if not self._holders[index] and index not in self._pinned:
            self._values[index] = None

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
                    self._open -= 1
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
                self._open -= 1
                self._settle_known(twin)
                self._resolve_consumers(twin)
            else:
                self._first(twin)

    def _fail(self, index: int, error: NodeError) -> None:
        """A step failed: so do its descendants, as skipped; everything else goes on."""
        self._errors.append(error)
        self._reason[index] = error.message
        self._stop(index, "failed")
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
            with self._changed:
                while True:
                    while not self._ready and not self._over and self._crash is None:
                        self._changed.wait()
                    if not self._ready:
                        return
                    index = self._ready.pop()
                    if self._status[index] is not None:
                        continue
                    self._idle -= 1
                    self._running.add(index)
                    self._spawn()
                    self._worker[index] = number
                    self._changed.release()
                    try:
                        outcome = self._produce(index)
                    finally:
                        self._changed.acquire()
                    self._running.discard(index)
                    self._idle += 1
                    self._accept(index, outcome)
                    if not self._open or self._cancel.is_set():
                        self._changed.notify_all()
        except (
            BaseException
        ) as error:  # a mistake in the scheduler itself must reach the caller, not vanish in a thread
            self._crash = error
            with self._changed:
                self._changed.notify_all()

    def _accept(self, index: int, outcome: _Outcome | NodeError | None) -> None:
        """Take what a worker brings back: values, a failure, or (None) a stored value that was not there after all."""
        if self._over or self._status[index] is not None:
            return
        if isinstance(outcome, NodeError):
            self._fail(index, outcome)
            self._emit_later(Failed, index)
            return
        if outcome is None:
            self._producing[index] = 0
            self._unloadable[index] = 1
            self._demand(index)
            return
        if outcome.cancelled:
            return
        new = self.plan.digests[index] is None
        self._values[index] = outcome.values
        self._settle(index, outcome.status)
        if new:
            self.plan.digests[index] = outcome.digests
            self._resolve_consumers(index)
        if outcome.status == "computed":
            self._emit_later(Finished, index)

    def _emit_later(self, kind: type[Finished] | type[Failed], index: int) -> None:
        if self._observers:
            self._emit(kind(self.node_run(index)))

    def _produce(self, index: int) -> _Outcome | NodeError | None:
        step = self._steps[index]
        if self._loadable(index):
            digests = self.plan.digests[index] or ()
            values = tuple([self._cache.value(digest) for digest in digests])
            if any(value is None for value in values):
                return None
            return self._published(index, _Outcome(values, digests, "cached"))
        node, twin = step.node, self.plan.device is not None and step.node.twin is not None
        begun = self._begun[index] = time.perf_counter() - self._zero
        if self._observers:
            self._emit(Started(step.id, node.id, begun, self._worker[index]))
        try:
            inputs = self._inputs(index, twin)
            context = self._context(index, twin) if node.context_parameter is not None or twin else _INERT
            started = time.perf_counter()
            values = node.run(inputs, step.params, context, twin=twin)
            if twin and self.plan.device is not None:
                self.plan.device.finish()
                if self.plan.device.unified:
                    values = tuple([to_host(value) for value in values])
            seconds = time.perf_counter() - started
            return self._published(index, self._record(index, values, seconds))
        except Cancelled:
            return _Outcome((), (), "cancelled", cancelled=True)
        except NodeError as error:
            return error
        except Exception as error:  # whatever a node may raise fails that node only
            failure = NodeError(step.id, node.id, sentence(error))
            failure.__cause__ = error
            return failure

    def _inputs(self, index: int, twin: bool) -> dict[str, list[Any]]:
        gathered: dict[str, list[Any]] = {}
        for port, source, output in self._steps[index].inputs:
            values = self._values[source]
            value = values[output] if values is not None else None
            if twin and self.plan.device is not None:
                value = to_device(value, self.plan.device)
            elif self.plan.device is not None and is_on_device(value):
                value = to_host(value)
            gathered.setdefault(port, []).append(value)
        return gathered

    def _context(self, index: int, twin: bool) -> Context:
        step = self._steps[index]
        last = [0.0]

        def report(fraction: float | None, message: str) -> None:
            moment = time.perf_counter()
            if self._observers and moment - last[0] >= _PROGRESS_SECONDS:
                last[0] = moment
                self._emit(Progress(step.id, fraction, message))

        seed = step.params.get("seed", 0)
        return Context(
            step.id,
            type_id=step.node.id,
            seed=seed if isinstance(seed, int) else 0,
            device=self.plan.device if twin else None,
            cancelled=self._cancel,
            report=report,
        )

    def _record(self, index: int, values: tuple[Any, ...], seconds: float) -> _Outcome:
        """Seal the outputs of a step and remember them; in checked mode compare them with what is remembered."""
        step, plan = self._steps[index], self.plan
        restore = seconds
        held = 0
        for _, source, _ in step.inputs:
            record = plan.record[source]
            if record is not None:
                held += sum(record.sizes)
                if not record.worth_storing:
                    restore += record.restore
        sizes = tuple([codec.nbytes(value) for value in values])
        self._seconds[index] = seconds
        self._peak[index] = held + sum(sizes)
        key = plan.key[index] or b""
        if plan.device is not None and any(map(is_on_device, values)):
            if restore <= load_seconds(sum(sizes)) and index not in self._pinned and self._consumers[index]:
                # It stays on the device and nobody has seen its bytes: its key identifies it.
                digests = tuple([xxh3_128_digest(b"device" + key + bytes([port])) for port in range(len(values))])
                kept: tuple[Any, ...] = (None,) * len(values)
                return self._remember(index, values, kept, digests, sizes, seconds, restore, ())
            host = tuple([to_host(value) for value in values])
            digests = tuple([codec.seal(value) for value in host])
            values = values if self._consumers[index] else host
            return self._remember(index, values, host, digests, sizes, seconds, restore, files_of(host))
        digests = tuple([codec.seal(value) for value in values])
        files = files_of(values) if any(issubclass(kind, File) for kind in step.types) else ()
        return self._remember(index, values, values, digests, sizes, seconds, restore, files)

    def _remember(
        self,
        index: int,
        values: tuple[Any, ...],
        host: tuple[Any, ...],
        digests: tuple[bytes, ...],
        sizes: tuple[int, ...],
        seconds: float,
        restore: float,
        files: tuple[tuple[str, int, str], ...],
    ) -> _Outcome:
        plan, key = self.plan, self.plan.key[index] or b""
        before = plan.record[index]
        known = plan.digests[index]
        if before is not None and before.digests != digests and (plan.checked or known is not None):
            step = self._steps[index]
            if plan.checked:
                message = "computing again gave another value than the cache holds; the node is not deterministic"
                raise NodeError(step.id, step.node.id, message)
            log.warning("node '%s' computed another value than before; it is not deterministic", step.id)
        record = Record(key, digests, sizes, seconds, restore, files, plan.recipe(index), self._peak[index])
        plan.record[index] = record
        if self._observers:
            self._shapes[index] = tuple([shape_text(value) for value in host])
        self._cache.keep(record, host)
        return _Outcome(values, digests, "computed")

    def _published(self, index: int, outcome: _Outcome) -> _Outcome:
        record = self.plan.record[index]
        if record is not None and record.files:
            step = self._steps[index]
            try:
                self.publisher.claim(step.id, record.files)
                self.publisher.publish(outcome.values)
            except ValueError as error:
                raise NodeError(step.id, step.node.id, str(error)) from error
            except OSError as error:
                where = error.filename or self.publisher.folder
                message = f"cannot write '{where}' ({error.strerror or error}); choose another folder with --out"
                raise NodeError(step.id, step.node.id, message) from error
        return outcome

    # Telling.

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
            shapes = self._shapes.get(index, ("",) * len(digests))
            ports = zip(step.node.outputs, step.types, digests, record.sizes, shapes, strict=True)
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
            self._peak[index],
            outputs,
            self._reason[index] if status == "failed" else "",
        )


_INERT = Context()


class _Outcome:
    """What producing a step gave."""

    __slots__ = ("cancelled", "digests", "status", "values")

    def __init__(
        self, values: tuple[Any, ...], digests: tuple[bytes, ...], status: Status, *, cancelled: bool = False
    ) -> None:
        self.values = values
        self.digests = digests
        self.status: Status = status
        self.cancelled = cancelled


class Result:
    """What a run gave: values by ``result["node"]`` or ``result["node.port"]``, and what became of every node.

    Attributes:
        started: when, in seconds since the epoch.
        seconds: how long it took.
        cancelled: True where it was interrupted.
        errors: one `NodeError` for each node that failed.
    """

    def __init__(self, run: Run, started: float, seconds: float, cancelled: bool) -> None:
        self._run = run
        self.plan = run.plan
        self.started = started
        self.seconds = seconds
        self.cancelled = cancelled
        self.errors: tuple[NodeError, ...] = tuple(run._errors)

    @property
    def ok(self) -> bool:
        """True where every node that was wanted has its result."""
        return not self.errors and not self.cancelled

    @property
    def files_written(self) -> list[Path]:
        """The files that the run wrote."""
        return list(self._run.publisher.written)

    @property
    def files_kept(self) -> list[Path]:
        """The files that were right already."""
        return list(self._run.publisher.kept)

    @cached_property
    def nodes(self) -> dict[str, NodeRun]:
        """What became of each node, by id, in topological order."""
        steps = self.plan.network.steps
        return {steps[index].id: self._run.node_run(index) for index in self.plan.needed}

    def __getitem__(self, target: str) -> Any:
        """Return the value of a node's output.

        It is loaded from the cache, or computed again where it is no longer there.

        Raises:
            GraphError: there is no such node or output.
            NodeError: the node failed.
        """
        index, output = self.plan.network.find(target)
        values = self._run._values[index]
        if values is None:
            digests = self.plan.digests[index]
            value = self.plan.cache.value(digests[output]) if digests is not None else None
            if value is not None:
                return value
            values = self._produce(target, index)
        value = values[output]
        return to_host(value) if self.plan.device and is_on_device(value) else value

    def _produce(self, target: str, index: int) -> tuple[Any, ...]:
        failed = {error.node: error for error in self.errors}
        step = self.plan.network.steps[index]
        if step.id in failed:
            raise failed[step.id]
        plan = Plan(self.plan.network, self.plan.cache, [target], device=self.plan.device)
        run = Run(plan, self._run.publisher)
        run.want(index)
        result = run.execute()
        if result.errors:
            raise result.errors[0]
        values = run._values[index]
        if values is None:
            raise Cancelled(f"node '{step.id}' was not computed, as the run was cancelled")
        self._run._values[index] = values
        return values
