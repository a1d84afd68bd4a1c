"""From document to network: migrate, check, inline subgraphs, link, order, and convert.

`build` turns a `Graph` into a `Network`: flat steps in topological order, every parameter validated, every link
resolved to a step and an output, conversions inserted as steps of their own.  It reports everything that is wrong at
once.  A subgraph's steps carry its node's id before theirs, ``valley/rivers``.

Linear in nodes plus links; no recursion along links, so a chain of any length is fine.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from nodegraph.errors import GraphError, Problems
from nodegraph.links import Linker
from nodegraph.linktypes import check_types, convert
from nodegraph.network import Network
from nodegraph.ordering import ordered
from nodegraph.plugins import registry
from nodegraph.scopes import Opener

if TYPE_CHECKING:
    from nodegraph.graph import Graph


def build(graph: Graph, overrides: Mapping[str, Any]) -> Network:
    """Return the network of a graph, with parameters overridden by ``"node.parameter"`` or exposed name.

    Raises:
        GraphError: listing every problem, in the order of the file.
    """
    from nodegraph.graph import printable

    reg = graph._registry or registry()
    problems = Problems()
    opener = Opener(reg, problems)
    scope = opener.open(graph, "", "", overrides, None, ())
    linker = Linker(problems)
    linker.link(scope)
    steps = ordered(opener.steps, problems)
    if steps is not None:
        check_types(steps, linker.declared, reg, problems)
    if steps is None or problems.found:
        raise GraphError(problems.in_order())
    steps = convert(steps, reg)
    place = [0] * len(steps)
    for position, step in enumerate(steps):
        place[step.index] = position
    consumers: list[list[int]] = [[] for _ in steps]
    for position, step in enumerate(steps):
        step.index = position
        step.inputs = [(port, place[source], output) for port, source, output in step.inputs]
        for _, source, _ in step.inputs:
            consumers[source].append(position)
    outputs = {name: (place[index], output) for name, (index, output) in linker.outputs.items()}
    ids = {step.id: position for position, step in enumerate(steps)}
    home = printable(graph.path.absolute()) if graph.path else f"<{graph.title}>"
    return Network(graph.name, home, steps, consumers, ids, outputs, opener.sources)
