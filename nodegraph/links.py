"""Linking: every input of every step finds the step and output that feed it, into subgraphs and out of them."""

from __future__ import annotations

from typing import Any

from nodegraph import porttypes
from nodegraph.errors import Problems, nearest
from nodegraph.network import Step
from nodegraph.nodetypes import InputPort
from nodegraph.scopes import Scope


class Linker:
    """Links the steps of a scope and of those inside it.

    Attributes:
        outputs: (step, output) by the names of the subgraphs' outputs.
        declared: the port type that a subgraph's file declares for (where it is fed, source step, output).
    """

    def __init__(self, problems: Problems) -> None:
        self.problems = problems
        self.outputs: dict[str, tuple[int, int]] = {}
        self.declared: dict[tuple[str, int, int], type] = {}

    def link(self, scope: Scope) -> None:
        """Resolve the links of every step, scope by scope."""
        pending = [scope]
        while pending:
            scope = pending.pop()
            pending.extend(scope.scopes.values())
            nodes = scope.data["nodes"]
            for id, step in scope.steps.items():
                self._link_step(scope, id, step, nodes[id].get("inputs", {}))
            for id, inner in scope.scopes.items():
                self._check_subgraph_inputs(scope, id, inner, nodes[id].get("inputs", {}))
            self._publish(scope)

    def _link_step(self, scope: Scope, id: str, step: Step, links: dict[str, Any]) -> None:
        ports = step.node.inputs
        for name in links:
            if step.node.input(name) is None:
                self.problems.add(step.where, f"unknown input '{name}'; {nearest(name, [port.name for port in ports])}")
        for port in ports:
            given = links.get(port.name)
            where = f"{step.where}: input '{port.name}'"
            if given is None and (id, port.name) in scope.fed:
                self._link_fed(scope, scope.fed[id, port.name], step, port, where)
                continue
            listed = [given] if isinstance(given, str) else given or []
            if not listed and not port.optional and not port.variadic:
                self.problems.add(where, f"is not linked; it needs {porttypes.with_article(port.type)}")
            if len(listed) > 1 and not port.variadic:
                self.problems.add(where, f"takes one link, {len(listed)} are given")
            for text in listed:
                self._add_link(step, port, self._resolve(scope, text, where))

    def _add_link(self, step: Step, port: InputPort, source: tuple[Step, int] | None) -> None:
        if source is not None:
            step.inputs.append((port.name, source[0].index, source[1]))

    def _link_fed(self, scope: Scope, name: str, step: Step, port: InputPort, where: str) -> None:
        """Link a port to what the graph around feeds into the exposed input `name`."""
        wanted, given = name, None
        outer: Scope | None = scope
        inner = scope
        while outer is not None:
            inner, outer = outer, outer.outer
            if outer is None:
                break
            given = outer.data["nodes"][inner.own_id].get("inputs", {}).get(wanted)
            if given is not None or (inner.own_id, wanted) not in outer.fed:
                break
            wanted = outer.fed[inner.own_id, wanted]
        if given is None or outer is None:
            if not port.optional and not port.variadic:
                self.problems.add(where, f"needs the graph's input '{name}', which nothing feeds")
            return
        listed = [given] if isinstance(given, str) else given
        if len(listed) > 1 and not port.variadic:
            self.problems.add(where, f"takes one link, {len(listed)} are given")
        at = f"{outer.name}: node '{inner.own_id}': input '{wanted}'"
        declared = porttypes.named(inner.data["inputs"][wanted]["type"])
        for text in listed:
            source = self._resolve(outer, text, at)
            self._add_link(step, port, source)
            if source is not None and declared is not None:
                self.declared[at, source[0].index, source[1]] = declared

    def _check_subgraph_inputs(self, scope: Scope, id: str, inner: Scope, links: dict[str, Any]) -> None:
        exposed = inner.data.get("inputs", {})
        for name in links:
            if name not in exposed:
                self.problems.add(f"{scope.name}: node '{id}'", f"unknown input '{name}'; {nearest(name, exposed)}")

    def _publish(self, scope: Scope) -> None:
        """Resolve the outputs of a graph, and name those of a subgraph: ``valley`` (the first), ``valley.surface``."""
        own = scope.prefix.rstrip("/")
        for position, (name, text) in enumerate(scope.data.get("outputs", {}).items()):
            source = self._resolve(scope, text, f"{scope.name}: output '{name}'")
            if source is not None and own:
                self.outputs[f"{own}.{name}"] = (source[0].index, source[1])
                if position == 0:
                    self.outputs[own] = (source[0].index, source[1])

    def _resolve(self, scope: Scope, text: str, where: str) -> tuple[Step, int] | None:
        """Return the step and output that a reference means, or None after noting the problem."""
        while True:
            id, _, port = text.partition(".")
            if id in scope.steps:
                step = scope.steps[id]
                position = step.node.output_index(port) if port else 0
                if position is None:
                    names = [item.name for item in step.node.outputs]
                    self.problems.add(where, f"node '{id}' has no output '{port}'; {nearest(port, names)}")
                    return None
                return step, position
            if id not in scope.scopes:
                if id not in scope.broken:
                    self.problems.add(
                        where, f"links to '{text}', but there is no node '{id}'; {nearest(id, scope.data['nodes'])}"
                    )
                return None
            scope = scope.scopes[id]
            exposed = scope.data.get("outputs", {})
            if not exposed or (port and port not in exposed):
                self.problems.add(where, f"node '{id}' has no output '{port}'; {nearest(port, exposed)}")
                return None
            text = exposed[port] if port else next(iter(exposed.values()))
