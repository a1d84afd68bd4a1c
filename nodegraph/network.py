"""The flat network that a graph document means: steps in topological order, and how a person's names map to them.

`nodegraph.build` makes one from a `Graph`; plans and runs start from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nodegraph.errors import GraphError, nearest
from nodegraph.nodetypes import Node
from nodegraph.parameters import InputFile


@dataclass(slots=True)
class Step:
    """One node of the flat network.

    Attributes:
        id: its id, with the ids of the subgraphs around it before it.
        node: its type.
        params: validated parameters by name; file parameters are absolute paths.
        canonical: the parameters as JSON bytes for the cache key.
        where: how messages name it.
        inputs: links in the order of the ports: (port name, index of the source step, index of its output).
        types: port types of its outputs, generic ones resolved.
        index: position in the network.
        files: paths it reads, by parameter.
        code: what it runs beside its node: readers and writers of the file formats of its parameters.
    """

    id: str
    node: Node[..., Any]
    params: dict[str, Any]
    canonical: bytes
    where: str
    inputs: list[tuple[str, int, int]] = field(default_factory=list)
    types: tuple[type, ...] = ()
    index: int = -1
    files: dict[str, list[tuple[InputFile, Path]]] = field(default_factory=dict)
    code: tuple[Callable[..., Any], ...] = ()


@dataclass(slots=True)
class Network:
    """Steps in topological order, and how a person's names map to them.

    Attributes:
        name: the graph's name, for messages.
        home: what identifies the graph across runs (its file), for the reasons of the next run.
        steps: sources come before what consumes them.
        consumers: for each step, the indices of the steps linked to it (once per link).
        ids: step index by id.
        outputs: (step, output) by ``node`` and ``node.port`` for nodes that are subgraphs.
        sources: the files the network was read from.
    """

    name: str
    home: str
    steps: list[Step]
    consumers: list[list[int]]
    ids: dict[str, int]
    outputs: dict[str, tuple[int, int]]
    sources: list[Path]

    def find(self, target: str) -> tuple[int, int]:
        """Return (step, output) for ``node``, ``node.port`` or ``subgraph/node.port``.

        Raises:
            GraphError: there is no such node or output.
        """
        if target in self.outputs:
            return self.outputs[target]
        id, _, port = target.partition(".")
        if id in self.ids:
            step = self.steps[self.ids[id]]
            position = step.node.output_index(port) if port else 0
            if position is None:
                names = [item.name for item in step.node.outputs]
                raise GraphError(f"node '{id}' has no output '{port}'; {nearest(port, names)}", self.name)
            return step.index, position
        if id in self.outputs:
            names = [name.partition(".")[2] for name in self.outputs if name.startswith(f"{id}.")]
            raise GraphError(f"node '{id}' has no output '{port}'; {nearest(port, names)}", self.name)
        names = [*self.ids, *(name for name in self.outputs if "." not in name)]
        raise GraphError(f"no node '{id}'; {nearest(id, names)}", self.name)

    def ancestors(self, roots: Iterable[int]) -> list[int]:
        """Return the indices of `roots` and everything they depend on, in topological order."""
        needed = bytearray(len(self.steps))
        stack = list(roots)
        while stack:
            index = stack.pop()
            if not needed[index]:
                needed[index] = 1
                stack.extend(source for _, source, _ in self.steps[index].inputs)
        return [index for index, wanted in enumerate(needed) if wanted]

    def sinks(self) -> list[int]:
        """Return the steps that nothing consumes."""
        return [index for index, consumers in enumerate(self.consumers) if not consumers]
