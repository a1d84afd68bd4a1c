"""What must be computed, and why: metadata only.

A `Plan` walks the needed steps in topological order.  A step whose inputs' digests are all known has a key; the cache
either knows what comes out (then the digests of its outputs are known too, and the walk goes on) or the step must be
computed.  Steps behind one that must be computed stay *open* until its result is there: it may come out equal and cut
off everything below.  `nodegraph.run` continues exactly this walk while it computes.
"""

from __future__ import annotations

import functools
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from xxhash import xxh3_128_hexdigest

from nodegraph.cache import Cache, Recipe, Record, physical_memory
from nodegraph.cache import keys as cache_keys
from nodegraph.errors import GraphError, NodeError, nearest, sentence
from nodegraph.fingerprint import Code, Fingerprints
from nodegraph.network import Network, Step
from nodegraph.nodetypes import Forecast
from nodegraph.plugins import registry
from nodegraph.reasons import CHECKED, EVICTED, FORCED, NEVER, NOT_STORED, explain

if TYPE_CHECKING:
    from nodegraph.opencl import Device


_SCALARS = (bool, int, float, str)
_NO_FILES: dict[str, str] = {}


@dataclass(frozen=True, slots=True)
class Planned:
    """What a plan says of one node: ``cached``, ``compute``, ``open`` (depends on what is computed) or ``failed``.

    `bytes` is what its outputs weigh; without `known` only computing tells.
    """

    id: str
    type: str
    action: Literal["cached", "compute", "open", "failed"]
    reason: str
    bytes: int
    known: bool = True


class Plan:
    """Which steps are needed, which are known, and why the others are not.

    Lists are by step index.

    Attributes:
        network: what is planned.
        cache: where results are remembered.
        needed: steps the targets depend on, themselves included, in topological order.
        targets: (step, output) wanted.
        key: cache key once all inputs' digests are known.
        record: what the cache knows under that key, or what computing the step gave; set by `note`.
        weight: bytes of the outputs, as the record has it.
        share: what each consumer pays for having the outputs again where they are not stored, s.
        digests: content digests of the outputs once known.
        error: why a step cannot run, found while planning (a missing file).
        device: the OpenCL device that twins run on, or None.
        device_required: a person chose it, so that what it cannot do fails; else the host does it.
    """

    def __init__(
        self,
        network: Network,
        cache: Cache,
        targets: Iterable[str] = (),
        *,
        device: Device | None = None,
        device_required: bool = False,
        force: Iterable[str] = (),
        checked: bool = False,
    ) -> None:
        self.network = network
        self.cache = cache
        self.device = device
        self.device_required = device_required
        self.checked = checked
        wanted = list(targets)
        self.targets = [network.find(target) for target in wanted] or [(index, 0) for index in network.sinks()]
        self.needed = network.ancestors(index for index, _ in self.targets)
        self.forced = _forced(network, force)
        count = len(network.steps)
        self.key: list[bytes | None] = [None] * count
        self.record: list[Record | None] = [None] * count
        self.weight = array("q", bytes(8 * count))
        self.share = array("d", bytes(8 * count))
        self.digests: list[tuple[bytes, ...] | None] = [None] * count
        self.error: list[NodeError | None] = [None] * count
        self.recompute: dict[int, str] = {}
        self._files: dict[int, dict[str, bytes]] = {}
        self._types: dict[tuple[int, Code], tuple[bytes, str, str, str]] = {}
        self._history: dict[str, bytes] | None = None
        for index in self.needed:
            if all(self.digests[source] is not None for _, source, _ in network.steps[index].inputs):
                self.resolve(index)

    # Resolving one step; the scheduler goes on with this.

    def resolve(self, index: int) -> bool:
        """Give a step its key, all of whose inputs are known; return True when the cache knows the result.

        A file that cannot be read sets `error` instead.
        """
        step = self.network.steps[index]
        digests = self.digests
        inputs = [(port, digests[source][output]) for port, source, output in step.inputs]  # type: ignore[index]
        files = None
        if step.files:
            try:
                files = self._files[index] = {name: self._file_digest(step, name) for name in step.files}
            except (OSError, ValueError) as error:  # ValueError: a name that no file can have
                where = f"parameter '{next(iter(step.files))}': {sentence(error)}"
                self.error[index] = NodeError(step.id, step.node.id, where)
                self.error[index].__cause__ = error  # type: ignore[union-attr]
                return False
        self.key[index] = key = cache_keys.key(self._of_type(step)[0], step.canonical, inputs, files)
        record = self.cache.lookup(key)
        if record is not None and len(record.digests) != len(step.node.outputs):
            record = None
        self.note(index, record)
        if record is None or self.checked or index in self.forced:
            return False
        self.digests[index] = record.digests
        return True

    def note(self, index: int, record: Record | None) -> None:
        """Take what is known of a step's result, and from it what having its outputs again would take.

        Outputs that several steps consume count by a share for each, as area flow does in technology mapping: a chain
        or a tree is counted exactly, and shared ancestors are not counted once for every path to them, which would
        grow with the depth of a graph without limit.
        """
        self.record[index] = record
        if record is not None:
            self.weight[index] = sum(record.sizes)
            consumers = len(self.network.consumers[index])
            self.share[index] = 0.0 if record.worth_storing or not consumers else record.restore / consumers

    def _of_type(self, step: Step) -> tuple[bytes, str, str, str]:
        """Return what all steps of one node type and the same file formats share.

        That is the prefix of their keys, the type id, the fingerprint of their code, and the class of device.
        """
        node = step.node
        known = self._types.get((id(node), step.code))
        if known is None:
            code = fingerprints().of(node, step.code)
            device = self.device.class_id if self.device is not None and node.twin is not None else ""
            known = (cache_keys.prefix(node.id, node.version, code, device), node.id, code.hex(), device)
            self._types[id(node), step.code] = known
        return known

    def part_key(self, index: int, what: bytes) -> bytes:
        """Return the key of a part of a step's work: of its code and device, and a digest of all else that counts."""
        return cache_keys.key(self._of_type(self.network.steps[index])[0], b"part", [("", what)])

    def _file_digest(self, step: Step, name: str) -> bytes:
        parts = []
        for mark, path in step.files[name]:
            for file in mark.related(path):
                if file.is_dir():
                    raise IsADirectoryError(21, "Is a directory, a file is needed", str(file))
                parts.append(file.name.encode() + b"\0" + self.cache.file_digest(file))
        return b"\0".join(parts)

    def files_unchanged(self, index: int) -> bool:
        """Say whether the files that a step reads still hold what went into its key."""
        step = self.network.steps[index]
        try:
            return all(self._file_digest(step, name) == digest for name, digest in self._files[index].items())
        except OSError:
            return False

    def recipe(self, index: int) -> Recipe:
        """Return what goes into the key of a resolved step, readable."""
        step = self.network.steps[index]
        digests = self.digests
        ports = tuple([port for port, _, _ in step.inputs])
        inputs = b"".join([digests[source][output] for _, source, output in step.inputs])  # type: ignore[index]
        files = self._files_of(index) if step.files else _NO_FILES
        _, type_id, code, device = self._of_type(step)
        return Recipe(type_id, step.node.version, code, step.canonical.decode(), ports, inputs, files, device)

    def _files_of(self, index: int) -> dict[str, str]:
        files = {}
        for name, digest in self._files[index].items():
            names = ", ".join(path.name for _, path in self.network.steps[index].files[name])
            files[name] = f"{xxh3_128_hexdigest(digest)} {names}"
        return files

    # Why.

    def reason(self, index: int) -> str:
        """Return why a resolved step is computed."""
        if index in self.forced:
            return FORCED
        if index in self.recompute:
            return self.recompute[index]
        if self.checked and self.record[index] is not None:
            return CHECKED
        if self._history is None:
            self._history = self.cache.history(self.network.home)
        before = self._history.get(self.network.steps[index].id)
        if before is None:
            return NEVER
        if before == self.key[index]:
            return EVICTED
        old = self.cache.lookup(before)
        return explain(old.recipe, self.recipe(index)) if old is not None else "changed since it was last remembered"

    def reason_for_value(self, index: int) -> str:
        """Return why a step whose result is known is computed all the same: its value is not at hand."""
        record = self.record[index]
        return EVICTED if record is not None and record.worth_storing else NOT_STORED

    def remember(self) -> None:
        """Note the keys of the results of this run, for the reasons of the next."""
        history = self.cache.history(self.network.home) if self._history is None else self._history
        steps = self.network.steps
        fresh = {name: key for name, key in history.items() if name in self.network.ids}
        for index in self.needed:
            if (key := self.key[index]) is not None and self.digests[index] is not None:
                fresh[steps[index].id] = key
        if fresh != history:
            self.cache.set_history(self.network.home, fresh)
            self._history = fresh

    # What to expect.

    def demanded(self) -> set[int]:
        """Return the steps that will be computed as far as is known now, with known inputs whose values are gone."""
        compute = {index for index in self.needed if self.digests[index] is None and self.error[index] is None}
        stack = list(compute)
        while stack:
            for _, source, _ in self.network.steps[stack.pop()].inputs:
                digests = self.digests[source]
                if source not in compute and digests is not None and not all(map(self.cache.has, digests)):
                    compute.add(source)
                    self.recompute.setdefault(source, self.reason_for_value(source))
                    stack.append(source)
        return compute

    def entries(self) -> list[Planned]:
        """Return what the plan says of each needed node, in topological order."""
        compute = self.demanded()
        sizes = self.forecasts(compute)
        found = []
        for index in self.needed:
            step = self.network.steps[index]
            size, known = sizes[index].bytes, sizes[index].known
            error = self.error[index]
            if error is not None:
                found.append(Planned(step.id, step.node.id, "failed", error.message, 0))
            elif index not in compute:
                found.append(Planned(step.id, step.node.id, "cached", "", size))
            elif self.key[index] is not None:
                found.append(Planned(step.id, step.node.id, "compute", self.reason(index), size, known))
            else:
                sources = dict.fromkeys(port for port, source, _ in step.inputs if self.digests[source] is None)
                reason = "depends on input " + ", ".join(sources)
                found.append(Planned(step.id, step.node.id, "open", reason, size, known))
        return found

    def forecasts(self, compute: set[int]) -> dict[int, Forecast]:
        """Return what each needed step will weigh: as remembered where it is known, as the node forecasts where not."""
        found: dict[int, Forecast] = {}
        for index in self.needed:
            step = self.network.steps[index]
            inputs: dict[str, list[Forecast]] = {}
            for port, source, _ in step.inputs:
                inputs.setdefault(port, []).append(found[source])
            try:
                forecast = step.node.predict(inputs, step.params)
            except Exception:  # a forecast may fail on what the node itself will report better
                forecast = None
            if not isinstance(forecast, Forecast):
                forecast = Forecast(0, known=False)
            if not forecast.bytes and not all(output.type in _SCALARS for output in step.node.outputs):
                # Nothing can be told of what is made from something unknown, or from numbers in a way nobody told.
                told = step.node.forecasts and all(item.known for items in inputs.values() for item in items)
                forecast = replace(forecast, known=forecast.known and told)
            record = self.record[index]
            if record is not None:
                forecast = Forecast(sum(record.sizes), forecast.peak if index in compute else 0, forecast.about)
            found[index] = forecast
        return found

    def peak_bytes(self) -> int:
        """Return the bytes that values will take at most, computing one node after the other and releasing early."""
        compute = self.demanded()
        if not compute:
            return 0
        forecasts = self.forecasts(compute)
        held = {
            index: sum(1 for consumer in self.network.consumers[index] if consumer in compute) for index in self.needed
        }
        pinned = {index for index, _ in self.targets}
        live = peak = 0
        for index in self.needed:
            if index not in compute and not held[index]:
                continue
            live += forecasts[index].bytes
            peak = max(peak, live + forecasts[index].peak)
            if index in compute:
                for _, source, _ in self.network.steps[index].inputs:
                    held[source] -= 1
                    if held[source] == 0 and source not in pinned:
                        live -= forecasts[source].bytes
        return peak

    def check_memory(self) -> None:
        """Raise `GraphError` when the run cannot fit in memory, naming what it needs and the largest node."""
        if not any(self.network.steps[index].node.forecasts for index in self.needed):
            return
        peak, limit = self.peak_bytes(), physical_memory()
        if peak <= limit:
            return
        compute = self.demanded()
        forecasts = self.forecasts(compute)
        largest = max(compute, key=lambda index: forecasts[index].bytes)
        step = self.network.steps[largest]
        raise GraphError(
            f"the run needs {human_bytes(peak)} of memory, the machine has {human_bytes(limit)}; the largest value is "
            f"that of node '{step.id}' ({human_bytes(forecasts[largest].bytes)}): crop or resample before it",
            self.network.name,
        )


def human_bytes(count: int) -> str:
    """Return a number of bytes for a person.

    >>> human_bytes(3_500_000)
    '3.5 MB'
    """
    size = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"


@functools.cache
def fingerprints() -> Fingerprints:
    """Return the fingerprints of this process: code is read once, when its node is first planned."""
    return Fingerprints(registry().packages())


def _forced(network: Network, names: Iterable[str]) -> set[int]:
    found = set()
    for name in names:
        inside = [index for id, index in network.ids.items() if id == name or id.startswith(f"{name}/")]
        if not inside:
            raise GraphError(f"no node '{name}' to force; {nearest(name, network.ids)}", network.name)
        found.update(inside)
    return found
