"""Running a graph: plan it, schedule it, and hand over what came out."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nodegraph.cache import Cache, default_cache
from nodegraph.errors import Cancelled, NodeError, RunError
from nodegraph.events import NodeRun, Observer
from nodegraph.opencl import choose, is_on_device, to_host
from nodegraph.plan import Plan
from nodegraph.publish import Publisher
from nodegraph.scheduler import Scheduler

if TYPE_CHECKING:
    from nodegraph.graph import Graph


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
    required = device != "auto"
    return Plan(network, cache, targets, device=chosen, device_required=required, force=force, checked=checked)


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
    publisher = Publisher(folder, plan.cache)
    started, clock = time.time(), time.perf_counter()
    scheduler = Scheduler(plan, publisher, jobs=jobs, observers=observers, keep_values=keep_values, cancel=cancel)
    scheduler.execute()
    result = Result(scheduler, started, time.perf_counter() - clock)
    if check and result.cancelled:
        raise Cancelled("the run was cancelled; what was finished is kept")
    if check and result.errors:
        raise RunError(result)
    return result


def default_out(graph: Graph) -> Path:
    """Return where a graph's files go by default: ``out/<name of its file>`` in the current folder."""
    return Path("out") / (graph.path.stem if graph.path else "graph")


class Result:
    """What a run gave: values by ``result["node"]`` or ``result["node.port"]``, and what became of every node.

    Attributes:
        started: when, in seconds since the epoch.
        seconds: how long it took.
        cancelled: True where it was interrupted.
        errors: one `NodeError` for each node that failed.
    """

    def __init__(self, scheduler: Scheduler, started: float, seconds: float) -> None:
        self._scheduler = scheduler
        self.plan = scheduler.plan
        self.started = started
        self.seconds = seconds
        self.cancelled = scheduler.cancelled
        self.errors: tuple[NodeError, ...] = tuple(scheduler.errors)

    @property
    def ok(self) -> bool:
        """True where every node that was wanted has its result."""
        return not self.errors and not self.cancelled

    @property
    def files_written(self) -> list[Path]:
        """The files that the run wrote."""
        return list(self._scheduler.publisher.written)

    @property
    def files_kept(self) -> list[Path]:
        """The files that were right already."""
        return list(self._scheduler.publisher.kept)

    @cached_property
    def nodes(self) -> dict[str, NodeRun]:
        """What became of each node, by id, in topological order."""
        steps = self.plan.network.steps
        return {steps[index].id: self._scheduler.node_run(index) for index in self.plan.needed}

    def __getitem__(self, target: str) -> Any:
        """Return the value of a node's output.

        It is loaded from the cache, or computed again where it is no longer there.

        Raises:
            GraphError: there is no such node or output.
            NodeError: the node failed.
        """
        index, output = self.plan.network.find(target)
        values = self._scheduler.values[index]
        if values is None:
            digests = self.plan.digests[index]
            value = self.plan.cache.value(digests[output]) if digests is not None else None
            if value is not None:
                return value
            values = self._produce(target, index)
        value = values[output]
        return to_host(value) if is_on_device(value) else value

    def _produce(self, target: str, index: int) -> tuple[Any, ...]:
        step = self.plan.network.steps[index]
        for error in self.errors:
            if error.node == step.id:
                raise error
        required = self.plan.device_required
        plan = Plan(self.plan.network, self.plan.cache, [target], device=self.plan.device, device_required=required)
        again = Scheduler(plan, self._scheduler.publisher)
        again.execute(want=index)
        if again.errors:
            raise again.errors[0]
        values = again.values[index]
        if values is None:
            raise Cancelled(f"node '{step.id}' was not computed, as the run was cancelled")
        self._scheduler.values[index] = values
        return values
