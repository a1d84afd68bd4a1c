"""The types on links: what each output gives, whether its consumers take it, and conversions where they do not.

A generic output (``def add(surface: T, ...) -> T``) has the type of what is linked to the inputs of its variable.
Where they differ it is the nearest type that all of them are: what comes of an elevation and a mask is a raster, and no
port that takes elevations may get it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from nodegraph import porttypes
from nodegraph.errors import Problems
from nodegraph.network import Step
from nodegraph.plugins import Registry

_UNKNOWN: type = type(None)


def check_types(
    steps: Sequence[Step], declared: Mapping[tuple[str, int, int], type], registry: Registry, problems: Problems
) -> None:
    """Give the outputs of steps their types, and note links whose types do not fit.

    Args:
        steps: sources before consumers.
        declared: the type that a subgraph's file declares for (where it is fed, source step, output).
        registry: where conversions are.
        problems: what is wrong so far.
    """
    by_index = {step.index: step for step in steps}
    for step in steps:
        _check_step(step, by_index, registry, problems)
    for (where, source, output), kind in declared.items():
        given = by_index[source].types[output]
        if given is not _UNKNOWN and not porttypes.accepts(kind, given) and registry.conversion(given, kind) is None:
            problems.add(where, _mismatch(kind, by_index[source], output))


def _check_step(step: Step, by_index: Mapping[int, Step], registry: Registry, problems: Problems) -> None:
    bound: dict[str, type] = {}
    for name, source, output in step.inputs:
        port = step.node.input(name)
        if port is None:
            continue
        given = by_index[source].types[output]
        if given is not _UNKNOWN and not porttypes.accepts(port.type, given):
            conversion = registry.conversion(given, port.type)
            if conversion is None:
                problems.add(f"{step.where}: input '{name}'", _mismatch(port.type, by_index[source], output))
            given = conversion.outputs[0].type if conversion is not None else port.type
        if port.variable:
            known = bound.get(port.variable, given)
            unknown = _UNKNOWN in (known, given)
            bound[port.variable] = _UNKNOWN if unknown else porttypes.nearest_common(known, given, port.type)
    if problems.found:
        # A generic input that found no source says nothing of the output: no problem may follow from another.
        bound = {item.variable: _UNKNOWN for item in step.node.outputs if item.variable} | bound
    step.types = tuple([bound.get(item.variable, item.type) for item in step.node.outputs])


def _mismatch(wanted: type, source: Step, output: int) -> str:
    origin = f"'{source.id}.{source.node.outputs[output].name}'"
    return f"takes {porttypes.with_article(wanted)}, but {origin} gives {porttypes.with_article(source.types[output])}"


def convert(steps: Sequence[Step], registry: Registry) -> list[Step]:
    """Return the steps with one more wherever links need a registered conversion; those of one source share it."""
    by_index = {step.index: step for step in steps}
    made: dict[tuple[int, int, str], Step] = {}
    found: list[Step] = []
    for step in steps:
        for position, (name, source, output) in enumerate(step.inputs):
            port, given = step.node.input(name), by_index[source].types[output]
            if port is None or porttypes.accepts(port.type, given):
                continue
            node = registry.conversion(given, port.type)
            if node is None:
                continue
            key = (source, output, node.id)
            if key not in made:
                checked = node.parameters.check({})
                new = Step(f"{by_index[source].id}:{node.name}", node, checked.values, checked.canonical, step.where)
                new.inputs = [(node.inputs[0].name, source, output)]
                new.types = (node.outputs[0].type,)
                new.index = len(by_index)
                by_index[new.index] = new
                made[key] = new
                found.append(new)
            step.inputs[position] = (name, made[key].index, 0)
        found.append(step)
    return found
