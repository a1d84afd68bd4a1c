"""Producing the values of one step: load them, or gather the inputs, run the node, seal and remember what it gives.

This is what workers do without the scheduler's lock; it decides nothing about other steps.
"""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Event
from typing import Any

from xxhash import xxh3_128_digest

from nodegraph import codec
from nodegraph.cache.index import Record, load_seconds
from nodegraph.context import Context
from nodegraph.errors import Cancelled, DeviceError, NodeError, sentence
from nodegraph.events import Status
from nodegraph.files import File
from nodegraph.network import Step
from nodegraph.opencl import is_on_device, to_device, to_host
from nodegraph.plan import Plan
from nodegraph.porttypes import shape_text
from nodegraph.publish import Publisher, files_of

log = logging.getLogger("nodegraph.run")

_INERT = Context()
_PROGRESS_SECONDS = 0.05

Values = tuple[Any, ...]


@dataclass(slots=True)
class Outcome:
    """What producing a step gave: its outputs, their digests, and the record of computing them (None: loaded)."""

    status: Status
    values: Values = ()
    digests: tuple[bytes, ...] = ()
    record: Record | None = None


class Producer:
    """Produces steps of one plan.  Safe to use from several threads for different steps."""

    def __init__(
        self,
        plan: Plan,
        publisher: Publisher,
        cancel: Event,
        report: Callable[[str, float | None, str], None] | None,
    ) -> None:
        self._plan = plan
        self._publisher = publisher
        self._cancel = cancel
        self._report = report

    def load(self, index: int) -> Outcome | NodeError | None:
        """Return the values of a step whose digests are known from the cache; None where one is gone or damaged."""
        digests = self._plan.digests[index] or ()
        values = tuple([self._plan.cache.value(digest) for digest in digests])
        if any(value is None for value in values):
            return None
        return self._guarded(index, lambda: self._publish(index, Outcome("cached", values, digests), None))

    def compute(self, index: int, sources: Sequence[Values | None], *, handed_on: bool) -> Outcome | NodeError:
        """Run a step's node.

        Args:
            index: the step.
            sources: the outputs of each linked step, in the order of the links.
            handed_on: other steps consume the values, so that they may stay on the device.
        """
        return self._guarded(index, lambda: self._compute(index, sources, handed_on=handed_on))

    def _guarded(self, index: int, work: Callable[[], Outcome]) -> Outcome | NodeError:
        step = self._plan.network.steps[index]
        try:
            return work()
        except NodeError as error:
            return error
        except BaseException as error:  # whatever a node may raise fails that node only
            if isinstance(error, Cancelled) and self._cancel.is_set():
                return Outcome("cancelled")
            failure = NodeError(step.id, step.node.id, sentence(error))
            failure.__cause__ = error
            return failure

    def _compute(self, index: int, sources: Sequence[Values | None], *, handed_on: bool) -> Outcome:
        step, plan = self._plan.network.steps[index], self._plan
        twin = plan.device is not None and step.node.twin is not None
        started = time.perf_counter()
        try:
            values = self._call(step, sources, twin=twin)
        except DeviceError as error:
            if not twin or plan.device_required:
                raise
            # The device was nobody's wish, so what it cannot do (too large a raster, a driver's whim) is no failure.
            log.warning("node '%s' is computed without OpenCL: %s", step.id, error)
            values = self._call(step, sources, twin=False)
        seconds = time.perf_counter() - started
        if step.files and not self._plan.files_unchanged(index):
            raise ValueError("a file it reads changed while it ran; run again")
        return self._remember(index, values, seconds, handed_on=handed_on)

    def _call(self, step: Step, sources: Sequence[Values | None], *, twin: bool) -> Values:
        """Run the twin or the host implementation; what a twin gives is finished, and on the host if that is free."""
        inputs = self._inputs(step, sources, twin=twin)
        context = self._context(step, twin=twin) if twin or step.node.context_parameter is not None else _INERT
        values = step.node.run(inputs, step.params, context, twin=twin)
        if twin and self._plan.device is not None:
            self._plan.device.finish()
            if self._plan.device.unified:
                values = tuple([to_host(value) for value in values])
        return values

    def _inputs(self, step: Step, sources: Sequence[Values | None], *, twin: bool) -> dict[str, list[Any]]:
        device = self._plan.device
        gathered: dict[str, list[Any]] = {}
        for (port, _, output), values in zip(step.inputs, sources, strict=True):
            value = values[output] if values is not None else None
            if device is not None:
                if twin:
                    value = to_device(value, device)
                elif is_on_device(value):
                    value = to_host(value)
            gathered.setdefault(port, []).append(value)
        return gathered

    def _context(self, step: Step, *, twin: bool) -> Context:
        last = 0.0

        def report(fraction: float | None, message: str) -> None:
            nonlocal last
            moment = time.perf_counter()
            if self._report is not None and moment - last >= _PROGRESS_SECONDS:
                last = moment
                self._report(step.id, fraction, message)

        return Context(
            step.id,
            dice=step.node.name,
            seed=step.params.get("seed", 0),
            device=self._plan.device if twin else None,
            cancelled=self._cancel,
            report=report,
            remember=lambda what, compute: self._part(self._plan.network.ids[step.id], what, compute),
        )

    def _part(self, index: int, what: Any, compute: Callable[[], Any]) -> Any:
        """Return a part of a step's work from the cache, or compute it and keep it there at once."""
        plan = self._plan
        key = plan.part_key(index, codec.seal(what))
        known = None if plan.checked or index in plan.forced else plan.cache.lookup(key)
        value = plan.cache.value(known.digests[0]) if known is not None else None
        if value is not None:
            return value
        started = time.perf_counter()
        value = compute()
        seconds = time.perf_counter() - started
        size = codec.nbytes(value)
        recipe = plan.recipe(index)
        record = Record(key, (codec.seal(value),), (size,), seconds, seconds, (), recipe, size, (shape_text(value),))
        plan.cache.keep(record, (value,))
        return value

    # Remembering.

    def _remember(self, index: int, values: Values, seconds: float, *, handed_on: bool) -> Outcome:
        step, plan = self._plan.network.steps[index], self._plan
        key = plan.key[index] or b""
        sizes = tuple([codec.nbytes(value) for value in values])
        cost, held = self._weigh_inputs(step)
        restore, held = seconds + cost, held + sum(sizes)
        host: Values | None = values
        if plan.device is not None and any(map(is_on_device, values)):
            if handed_on and restore <= load_seconds(sum(sizes)):
                host = None
            else:
                host = tuple([to_host(value) for value in values])
                values = values if handed_on else host
        if host is None:
            # It stays on the device, and nobody has seen its bytes: its key identifies it.
            digests = tuple([xxh3_128_digest(b"device" + key + bytes([port])) for port in range(len(values))])
        else:
            digests = tuple([codec.seal(value) for value in host])
        self._compare(index, digests)
        files = files_of(values) if _hold_files(step.types) else ()
        shapes = tuple([shape_text(value) for value in values])
        record = Record(key, digests, sizes, seconds, restore, files, plan.recipe(index), held, shapes)
        # Kept first: where the files cannot be written, the result is not lost, and the next run only writes them.
        plan.cache.keep(record, host if host is not None else (None,) * len(values))
        return self._publish(index, Outcome("computed", values, digests, record), record)

    def _weigh_inputs(self, step: Step) -> tuple[float, int]:
        """Return what having the inputs again would take where they are not stored, s, and their bytes."""
        share, weight, cost, held = self._plan.share, self._plan.weight, 0.0, 0
        for _, source, _ in step.inputs:
            cost += share[source]
            held += weight[source]
        return cost, held

    def _compare(self, index: int, digests: tuple[bytes, ...]) -> None:
        """Compare what was computed with what was remembered, where it should be the same."""
        plan, step = self._plan, self._plan.network.steps[index]
        before = plan.record[index]
        if before is None or before.digests == digests:
            return
        if plan.checked:
            message = "computing again gave another value than the cache holds; the node is not deterministic"
            raise NodeError(step.id, step.node.id, message)
        log.warning("node '%s' computed another value than before; it is not deterministic", step.id)

    def _publish(self, index: int, outcome: Outcome, record: Record | None) -> Outcome:
        record = record or self._plan.record[index]
        if record is None or not record.files:
            return outcome
        step = self._plan.network.steps[index]
        try:
            self._publisher.claim(step.id, record.files)
            self._publisher.publish(outcome.values)
        except OSError as error:
            where = error.filename or self._publisher.folder
            message = f"cannot write '{where}' ({error.strerror or error}); choose another folder with --out"
            raise NodeError(step.id, step.node.id, message) from error
        return outcome


@functools.cache
def _hold_files(types: tuple[type, ...]) -> bool:
    return any(issubclass(kind, File) for kind in types)
