"""Calling a node the way the engine does, on values of the test's own.

A node gets fresh, writable copies of an example's values each time, so that one that changes its input spoils nothing
for the next check: whether it does is a check of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from nodegraph import codec
from nodegraph.context import Context
from nodegraph.errors import sentence
from nodegraph.nodetypes import Node
from nodegraph.parameters import Checked, ParameterErrors
from nodegraph.porttypes import conform

if TYPE_CHECKING:
    from nodegraph.opencl import Device

AnyNode = Node[..., Any]
Linked = dict[str, list[Any]]


@dataclass(frozen=True)
class Example:
    """One way to call a node.

    Attributes:
        inputs: a value by port name; a list of values for a variadic port.  Small ones keep the checks fast; rasters
            should have sides that differ and, where the node allows them, voids.
        params: JSON values by parameter name.
    """

    inputs: Mapping[str, Any] = field(default_factory=dict)
    params: Mapping[str, Any] = field(default_factory=dict)


class BrokenError(AssertionError):
    """A node breaks the promise that the check named `promise` looks after; any check may come across it."""

    def __init__(self, node: AnyNode, promise: str, message: str) -> None:
        self.promise = promise
        super().__init__(f"{node.id}: {message}")


class NotCheckedError(Exception):
    """A check has nothing to say, because another promise is `broken` that it builds on."""

    def __init__(self, broken: BrokenError) -> None:
        self.broken = broken
        super().__init__(f"{broken} (the check '{broken.promise}' fails)")


class Call:
    """A node together with one example that fits it.

    Attributes:
        linked: the example's values by port, sealed: read-only, as values on wires are.
        checked: its parameters.
    """

    def __init__(self, node: AnyNode, example: Example) -> None:
        self.node = node
        self.example = example
        self.checked = checked(node, example.params)
        self.linked = _linked(node, example.inputs)
        self.before = {port: [codec.seal(value) for value in values] for port, values in self.linked.items()}

    @property
    def inputs(self) -> list[tuple[str, Any]]:
        """(port, value) of every linked value."""
        return [(port, value) for port, values in self.linked.items() for value in values]

    def copies(self) -> Linked:
        """Return writable copies of the linked values."""
        return {port: [_copy(value) for value in values] for port, values in self.linked.items()}

    def changed(self, linked: Linked) -> str:
        """Return the first port of `linked` whose values are no longer what the example says, or an empty text."""
        for port, values in linked.items():
            if [codec.seal(value) for value in values] != self.before[port]:
                return port
        return ""

    def run(
        self, linked: Linked | None = None, *, device: Device | None = None, promise: str = "outputs_conform"
    ) -> tuple[Any, ...]:
        """Run the node as the engine does, its twin with a `device`, and return its outputs.

        Raises:
            BrokenError: it failed, or returned other types than it declares.
        """
        context = Context(dice=self.node.name, seed=self.checked.values.get("seed", 0), device=device)
        params = self.node.parameters.check(self.example.params).values
        inputs = self.copies() if linked is None else linked
        try:
            return self.node.run(inputs, params, context, twin=device is not None)
        except Exception as error:  # whatever a node may raise
            what = "its OpenCL twin" if device is not None else "it"
            raise BrokenError(self.node, promise, f"{what} fails on an Example: {sentence(error)}") from error

    def plain(self) -> tuple[Any, ...]:
        """Call the node as the ordinary function that it is, without the engine, and return its outputs."""
        copies = self.copies()
        arguments: list[Any] = []
        for port in self.node.inputs:
            values = copies.get(port.name, [])
            arguments += values if port.variadic else values or [None]
        try:
            result = self.node(*arguments, **self.node.parameters.check(self.example.params).values)
        except Exception as error:  # whatever a node may raise
            message = f"a plain call fails on an Example: {sentence(error)}"
            raise BrokenError(self.node, "outputs_conform", message) from error
        return tuple(result) if hasattr(result, "_fields") else (result,)

    def digests(self, values: Sequence[Any]) -> list[bytes]:
        """Return the content digests of outputs.  Raises `BrokenError` where one cannot be stored."""
        try:
            return [codec.seal(value) for value in values]
        except TypeError as error:
            raise BrokenError(self.node, "values_encode", f"an output cannot be stored: {error}") from error

    def repeats(self) -> bool:
        """Say whether computing twice gives the same bytes."""
        return self.digests(self.run()) == self.digests(self.run())

    def broken(self, promise: str, message: str) -> BrokenError:
        """Return what to raise when two computations differ; one that never repeats itself breaks another promise."""
        if self.repeats():
            return BrokenError(self.node, promise, message)
        return BrokenError(self.node, "deterministic", "the same call gave two different values")


def calls(node: AnyNode, examples: Sequence[Example]) -> list[Call]:
    """Return a call for each example.  Raises `BrokenError` when there is none or one does not fit the node."""
    if not examples:
        raise BrokenError(node, "examples_fit", "give at least one Example")
    return [Call(node, example) for example in examples]


def checked(node: AnyNode, params: Mapping[str, Any]) -> Checked:
    """Return parameters after validation.  Raises `BrokenError` when they, or the node's defaults, are not valid."""
    try:
        return node.parameters.check(params)
    except ParameterErrors as error:
        own = all(name in node.parameters.fields and name not in params for name, _ in error.items)
        missing = any(node.parameters.fields[name].required for name, _ in error.items) if own else True
        if missing:
            raise BrokenError(node, "examples_fit", f"an Example does not fit: {error}") from error
        raise BrokenError(node, "parameters_sound", f"a default is not valid: {error}") from error
    except Exception as error:  # pydantic, on an annotation that it cannot check
        raise BrokenError(node, "parameters_sound", f"the parameters cannot be checked: {sentence(error)}") from error


def _linked(node: AnyNode, inputs: Mapping[str, Any]) -> Linked:
    unknown = sorted(set(inputs) - {port.name for port in node.inputs})
    if unknown:
        raise BrokenError(node, "examples_fit", f"an Example names inputs that do not exist: {', '.join(unknown)}")
    found: Linked = {}
    for port in node.inputs:
        given = inputs.get(port.name)
        values = [] if given is None else list(given) if port.variadic else [given]
        if not values and not port.optional and not port.variadic:
            raise BrokenError(node, "examples_fit", f"an Example must give the input '{port.name}'")
        try:
            values = [conform(value, port.type) for value in values]
            for value in values:
                codec.seal(value)
        except TypeError as error:
            raise BrokenError(node, "examples_fit", f"an Example's input '{port.name}': {error}") from error
        if values:
            found[port.name] = values
    return found


def _copy(value: Any) -> Any:
    encoded = codec.encode(value)
    return codec.decode(codec.Encoded(encoded.structure, [array.copy(order="K") for array in encoded.arrays]))
