"""From document to network: migrate, check, inline subgraphs, link, and order.

`build` turns a `Graph` into a `Network`: flat steps in topological order, every parameter validated, every link
resolved to a step and an output, conversions inserted as steps of their own.  It reports everything that is wrong at
once.  A subgraph's steps carry its node's id before theirs, ``valley/rivers``.

Linear in nodes plus links; no recursion along links, so a chain of any length is fine.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nodegraph import porttypes
from nodegraph.errors import GraphError, PluginError, Problem, nearest
from nodegraph.files import check_name
from nodegraph.formats import Format, Use
from nodegraph.migrate import migrate
from nodegraph.nodetypes import InputPort, Node
from nodegraph.parameters import Checked, InputFile, ParameterErrors
from nodegraph.plugins import Registry, registry

if TYPE_CHECKING:
    from nodegraph.graph import Graph

_UNKNOWN: type = type(None)
MAX_NESTING = 50
"""How deep graph files may contain each other."""


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


def build(graph: Graph, overrides: Mapping[str, Any]) -> Network:
    """Return the network of a graph, with parameters overridden by ``"node.parameter"`` or exposed name.

    Raises:
        GraphError: listing every problem, in the order of the file.
    """
    from nodegraph.graph import printable

    builder = _Builder(graph._registry or registry())
    top = builder.open(graph, "", "", overrides, None, ())
    builder.link(top)
    if not builder.problems:
        builder.convert()
    if builder.problems:
        raise GraphError(builder.in_order())
    steps = builder.steps
    place = [0] * len(steps)
    for position, step in enumerate(steps):
        place[step.index] = position
    consumers: list[list[int]] = [[] for _ in steps]
    for position, step in enumerate(steps):
        step.index = position
        step.inputs = [(port, place[source], output) for port, source, output in step.inputs]
        for _, source, _ in step.inputs:
            consumers[source].append(position)
    outputs = {name: (place[index], output) for name, (index, output) in builder.outputs.items()}
    ids = {step.id: position for position, step in enumerate(steps)}
    home = printable(graph.path.absolute()) if graph.path else f"<{graph.title}>"
    return Network(graph.name, home, steps, consumers, ids, outputs, builder.sources)


@dataclass(slots=True)
class _Scope:
    """One graph document during building: its nodes as steps or scopes, and the scope it is a node of."""

    name: str
    prefix: str
    data: dict[str, Any]
    outer: _Scope | None
    own_id: str
    steps: dict[str, Step] = field(default_factory=dict)
    scopes: dict[str, _Scope] = field(default_factory=dict)
    broken: set[str] = field(default_factory=set)
    fed: dict[tuple[str, str], str] = field(default_factory=dict)


class _Builder:
    def __init__(self, registry: Registry) -> None:
        self.registry = registry
        self.problems: list[Problem] = []
        self.steps: list[Step] = []
        self.sources: list[Path] = []
        self.places: dict[str, int] = {}
        self.outputs: dict[str, tuple[int, int]] = {}
        self.declared: dict[tuple[str, int, int], type] = {}

    def problem(self, where: str, message: str) -> None:
        self.problems.append(Problem(where, message))

    def in_order(self) -> list[Problem]:
        """Return the problems in the order of the file: those of the whole graph, then node by node."""

        def place(problem: Problem) -> int:
            where = problem.where
            while where and where not in self.places:
                where = where.rpartition(": ")[0]
            return self.places.get(where, -1)

        return sorted(dict.fromkeys(self.problems), key=place)

    # First: every node becomes a step, or a scope of its own.

    def open(
        self,
        graph: Graph,
        prefix: str,
        own_id: str,
        overrides: Mapping[str, Any],
        outer: _Scope | None,
        around: tuple[Path, ...],
    ) -> _Scope:
        name = graph.name if not outer else f"{outer.name}: node '{own_id}': {graph.name}"
        data = graph._data
        try:
            data, _ = migrate(data, self.registry)
        except GraphError as error:
            for item in error.problems:
                self.problem(f"{name}: {item.where}", item.message)
        scope = _Scope(name, prefix, data, outer, own_id)
        if graph.path:
            self.sources.append(graph.path.absolute())
        self._requirements(scope)
        values = self._parameter_values(scope, overrides)
        for name, entry in data.get("inputs", {}).items():
            self._exposed_input(scope, name, entry)
        if not data["nodes"]:
            self.problem(scope.name, "the graph has no nodes; add at least one under 'nodes'")
        for id, record in data["nodes"].items():
            self.places[f"{scope.name}: node '{id}'"] = len(self.places)
            params = {**record.get("params", {}), **values.get(id, {})}
            if record["type"] == "graph":
                self._open_subgraph(scope, graph, id, params, around)
            else:
                self._step(scope, graph.folder, id, record, params)
        for name, source in data.get("outputs", {}).items():
            self._resolve(scope, source, f"{scope.name}: output '{name}'")
        return scope

    def _requirements(self, scope: _Scope) -> None:
        if not scope.data.get("requires"):
            return
        from packaging.specifiers import InvalidSpecifier, SpecifierSet
        from packaging.version import InvalidVersion, Version

        for name, text in scope.data.get("requires", {}).items():
            where = f"{scope.name}: requires '{name}'"
            try:
                wanted = SpecifierSet(text)
            except InvalidSpecifier:
                self.problem(where, f"'{text}' is no version specifier; write it like '>=0.1'")
                continue
            plugin = self.registry.plugins.get(name)
            if plugin is None or plugin.error:
                why = f"is left out ({plugin.error})" if plugin else f"is not installed; install a version {text}"
                self.problem(where, f"the plugin {why}")
                continue
            try:
                fits = not plugin.version or wanted.contains(Version(plugin.version), prereleases=True)
            except InvalidVersion:
                fits = True
            if not fits:
                self.problem(where, f"version {plugin.version} is installed, the graph needs {text}")

    def _parameter_values(self, scope: _Scope, overrides: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Return parameter values by node: exposed ones first, direct overrides over them."""
        values: dict[str, dict[str, Any]] = {}
        nodes, exposed = scope.data["nodes"], scope.data.get("parameters", {})
        for name, entry in exposed.items():
            for drive in entry["drives"]:
                id, _, parameter = drive.partition(".")
                if id not in nodes or not parameter:
                    hint = nearest(id, nodes) if id not in nodes else "write it as 'node.parameter'"
                    self.problem(f"{scope.name}: parameter '{name}'", f"drives '{drive}', which does not exist; {hint}")
                elif not self._takes(nodes[id], parameter):
                    hint = nearest(parameter, self._parameter_names(nodes[id]))
                    self.problem(f"{scope.name}: node '{id}'", f"unknown parameter '{parameter}'; {hint}")
                elif name in overrides or "default" in entry:
                    values.setdefault(id, {})[parameter] = overrides.get(name, entry.get("default"))
        for name, value in overrides.items():
            id, _, parameter = name.partition(".")
            if not parameter and name not in exposed:
                known = [
                    *exposed,
                    *(f"{key}.{item}" for key, record in nodes.items() for item in self._parameter_names(record)),
                ]
                self.problem(scope.name, f"no parameter '{name}'; {nearest(name, known)}")
            elif parameter and id not in nodes:
                self.problem(scope.name, f"no node '{id}' to set '{parameter}' of; {nearest(id, nodes)}")
            elif parameter:
                values.setdefault(id, {})[parameter] = value
        return values

    def _parameter_names(self, record: Mapping[str, Any]) -> Iterable[str]:
        node = self._usable(record)
        return node.parameters.fields if node else ()

    def _takes(self, record: Mapping[str, Any], parameter: str) -> bool:
        """Say whether a node has a parameter, as far as is known here."""
        return self._usable(record) is None or parameter in self._parameter_names(record)

    def _usable(self, record: Mapping[str, Any]) -> Node[..., Any] | None:
        node = self.registry.find(record["type"])
        try:
            return node if node is not None and node.parameters else None
        except PluginError:  # badly declared: the node itself is reported
            return None

    def _exposed_input(self, scope: _Scope, name: str, entry: dict[str, Any]) -> None:
        where = f"{scope.name}: input '{name}'"
        if porttypes.named(entry["type"]) is None:
            self.registry.activate_all()
        if porttypes.named(entry["type"]) is None:
            names = [item for item, _ in porttypes.all_types()]
            self.problem(where, f"unknown port type '{entry['type']}'; {nearest(entry['type'], names)}")
        for feed in entry["feeds"]:
            id, _, port = feed.partition(".")
            record = scope.data["nodes"].get(id)
            node = self._usable(record) if record is not None else None
            if record is None:
                self.problem(where, f"feeds '{feed}', which does not exist; {nearest(id, scope.data['nodes'])}")
            elif node is not None and node.input(port) is None:
                hint = nearest(port, [item.name for item in node.inputs])
                self.problem(where, f"feeds '{feed}', but node '{id}' has no input '{port}'; {hint}")
            scope.fed[id, port] = name

    def _step(self, scope: _Scope, folder: Path, id: str, record: dict[str, Any], params: dict[str, Any]) -> None:
        where = f"{scope.name}: node '{id}'"
        node = self.registry.find(record["type"])
        if node is None:
            self.problem(where, self.registry.why_unknown(record["type"]))
            scope.broken.add(id)
            return
        for key in record:
            if key not in ("type", "version", "params", "inputs", "note"):
                known = ("type", "version", "params", "inputs", "note")
                self.problem(where, f"unknown key '{key}'; {nearest(key, known)}")
        if (saved := record.get("version")) is not None and saved > node.version:
            self.problem(
                where,
                f"saved with version {saved} of {node.id}, version {node.version} is installed; upgrade the plugin",
            )
        try:
            checked = node.parameters.check(params)
        except PluginError as error:
            self.problem(where, str(error))
            scope.broken.add(id)
            return
        except ParameterErrors as error:
            for _, message in error.items:
                self.problem(where, message)
            checked = Checked({}, b"")
        step = Step(scope.prefix + id, node, checked.values, checked.canonical, where)
        if checked.canonical:
            self._place_files(step, folder)
        scope.steps[id] = step
        step.index = len(self.steps)
        self.steps.append(step)

    def _place_files(self, step: Step, folder: Path) -> None:
        """Make file parameters absolute, starting at the graph's folder; check names of files to write."""
        parameters = step.node.parameters
        if parameters.input_files:
            step.params = dict(step.params)
        for item in parameters.input_files:
            value = step.params[item.name]
            step.params[item.name] = _absolute(value, folder)
            paths = step.params[item.name]
            if item.input_file is not None:
                flat = paths if isinstance(paths, (list, tuple)) else [paths]
                marked = [(item.input_file, path) for path in flat if isinstance(path, Path)]
                step.files[item.name] = [(self._read_as(step, item.name, mark, path), path) for mark, path in marked]
        for item in parameters.output_files:
            name = step.params[item.name]
            if name is None or item.output_file is None:
                continue
            try:
                check_name(name)
            except ValueError as error:
                self.problem(step.where, f"parameter '{item.name}': {error}")
            else:
                self._formats(step, item.name, item.output_file.type, name, "write")

    def _read_as(self, step: Step, parameter: str, mark: InputFile, path: Path) -> InputFile:
        """Return the mark of a file to read, with the sidecars that the reader of its format looks at."""
        formats = self._formats(step, parameter, mark.type, path.name, "read")
        more = tuple([suffix for item in formats for suffix in item.sidecars])
        return replace(mark, sidecars=tuple(dict.fromkeys(mark.sidecars + more))) if more else mark

    def _formats(self, step: Step, parameter: str, kind: type | None, name: str, use: Use) -> list[Format]:
        """Return the formats that a file may get, and note their code in the step.

        They are those of the process, whatever the graph's registry: nodes ask there, as they do when called by hand.
        """
        if kind is None:
            return []
        try:
            found = registry().formats().candidates(kind, name, use)
        except ValueError as error:
            self.problem(step.where, f"parameter '{parameter}': {error}")
            return []
        functions = [function for item in found for function in item.functions(use)]
        step.code = tuple(dict.fromkeys([*step.code, *functions]))
        return found

    def _open_subgraph(
        self, scope: _Scope, graph: Graph, id: str, params: dict[str, Any], around: tuple[Path, ...]
    ) -> None:
        from nodegraph.graph import Graph

        where = f"{scope.name}: node '{id}'"
        scope.broken.add(id)
        path = params.pop("path", None)
        if not isinstance(path, str) or not path:
            self.problem(where, "parameter 'path' is missing: the graph file, relative to this one")
            return
        try:
            file = (graph.folder / _without_tilde(Path(path))).resolve()
        except ValueError as error:  # a name that no file can have
            self.problem(where, f"{path!r} cannot be read ({error})")
            return
        here = (*around, graph.path.resolve()) if graph.path else around
        if file in here:
            self.problem(where, f"'{path}' contains itself; graph files must not form a circle")
            return
        if len(here) >= MAX_NESTING:
            self.problem(where, f"graph files are nested more than {MAX_NESTING} deep")
            return
        try:
            inner = Graph.load(file, registry=self.registry)
        except GraphError as error:
            for item in error.problems:
                self.problem(f"{where}: {item.where}", item.message)
            return
        exposed = inner._data.get("parameters", {})
        for name in [name for name in params if name not in exposed]:
            self.problem(where, f"unknown parameter '{name}'; {nearest(name, [*exposed, 'path'])}")
            del params[name]
        scope.broken.discard(id)
        scope.scopes[id] = self.open(inner, f"{scope.prefix}{id}/", id, params, scope, here)

    # Second: every link finds its source.

    def link(self, scope: _Scope) -> None:
        """Resolve the links of every step, scope by scope, then order the steps and resolve generic types."""
        pending = [scope]
        while pending:
            scope = pending.pop()
            pending.extend(scope.scopes.values())
            nodes = scope.data["nodes"]
            for id, step in scope.steps.items():
                self._link_step(scope, id, step, nodes[id].get("inputs", {}))
            for id, inner in scope.scopes.items():
                self._check_subgraph_inputs(scope, id, inner, nodes[id].get("inputs", {}))
                self._publish(inner)
        self._order()

    def _link_step(self, scope: _Scope, id: str, step: Step, links: dict[str, Any]) -> None:
        ports = step.node.inputs
        for name in links:
            if step.node.input(name) is None:
                self.problem(step.where, f"unknown input '{name}'; {nearest(name, [port.name for port in ports])}")
        for port in ports:
            given = links.get(port.name)
            where = f"{step.where}: input '{port.name}'"
            if given is None and (id, port.name) in scope.fed:
                self._link_fed(scope, scope.fed[id, port.name], step, port, where)
                continue
            listed = [given] if isinstance(given, str) else given or []
            if not listed and not port.optional and not port.variadic:
                self.problem(where, f"is not linked; it needs {_article(porttypes.describe(port.type))}")
            if len(listed) > 1 and not port.variadic:
                self.problem(where, f"takes one link, {len(listed)} are given")
            for text in listed:
                self._add_link(step, port, self._resolve(scope, text, where))

    def _add_link(self, step: Step, port: InputPort, source: tuple[Step, int] | None) -> None:
        if source is not None:
            step.inputs.append((port.name, source[0].index, source[1]))

    def _link_fed(self, scope: _Scope, name: str, step: Step, port: InputPort, where: str) -> None:
        """Link a port to what the graph around feeds into the exposed input `name`."""
        wanted, given = name, None
        outer: _Scope | None = scope
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
                self.problem(where, f"needs the graph's input '{name}', which nothing feeds")
            return
        listed = [given] if isinstance(given, str) else given
        if len(listed) > 1 and not port.variadic:
            self.problem(where, f"takes one link, {len(listed)} are given")
        at = f"{outer.name}: node '{inner.own_id}': input '{wanted}'"
        declared = porttypes.named(inner.data["inputs"][wanted]["type"])
        for text in listed:
            source = self._resolve(outer, text, at)
            self._add_link(step, port, source)
            if source is not None and declared is not None:
                self.declared[at, source[0].index, source[1]] = declared

    def _check_subgraph_inputs(self, scope: _Scope, id: str, inner: _Scope, links: dict[str, Any]) -> None:
        exposed = inner.data.get("inputs", {})
        for name in links:
            if name not in exposed:
                self.problem(f"{scope.name}: node '{id}'", f"unknown input '{name}'; {nearest(name, exposed)}")

    def _publish(self, inner: _Scope) -> None:
        """Let a person name the outputs of a subgraph: ``valley`` (the first) and ``valley.surface``."""
        own = inner.prefix.rstrip("/")
        for position, (name, text) in enumerate(inner.data.get("outputs", {}).items()):
            source = self._resolve(inner, text, f"{inner.name}: output '{name}'")
            if source is not None:
                self.outputs[f"{own}.{name}"] = (source[0].index, source[1])
                if position == 0:
                    self.outputs[own] = (source[0].index, source[1])

    def _resolve(self, scope: _Scope, text: str, where: str) -> tuple[Step, int] | None:
        """Return the step and output that a reference means, or None after noting the problem."""
        while True:
            id, _, port = text.partition(".")
            if id in scope.steps:
                step = scope.steps[id]
                position = step.node.output_index(port) if port else 0
                if position is None:
                    names = [item.name for item in step.node.outputs]
                    self.problem(where, f"node '{id}' has no output '{port}'; {nearest(port, names)}")
                    return None
                return step, position
            if id not in scope.scopes:
                if id not in scope.broken:
                    self.problem(
                        where, f"links to '{text}', but there is no node '{id}'; {nearest(id, scope.data['nodes'])}"
                    )
                return None
            scope = scope.scopes[id]
            exposed = scope.data.get("outputs", {})
            if not exposed or (port and port not in exposed):
                self.problem(where, f"node '{id}' has no output '{port}'; {nearest(port, exposed)}")
                return None
            text = exposed[port] if port else next(iter(exposed.values()))

    # Third: order, types, conversions.

    def _order(self) -> None:
        """Sort the steps topologically (Kahn), keeping the author's order where links leave a choice."""
        waiting = [len({source for _, source, _ in step.inputs}) for step in self.steps]
        consumers: list[list[int]] = [[] for _ in self.steps]
        for step in self.steps:
            for source in {source for _, source, _ in step.inputs}:
                consumers[source].append(step.index)
        ready = deque(index for index, count in enumerate(waiting) if count == 0)
        order: list[Step] = []
        while ready:
            index = ready.popleft()
            order.append(self.steps[index])
            for consumer in consumers[index]:
                waiting[consumer] -= 1
                if waiting[consumer] == 0:
                    ready.append(consumer)
        if len(order) < len(self.steps):
            self._report_cycle([step for step in self.steps if waiting[step.index] > 0])
        else:
            by_index = {step.index: step for step in order}
            for step in order:
                self._check_types(step, by_index)
            self._check_declared(by_index)
        self.steps = order

    def _report_cycle(self, stuck: list[Step]) -> None:
        import networkx

        inside = {step.index: step for step in stuck}
        graph = networkx.DiGraph(
            (source, step.index) for step in stuck for _, source, _ in step.inputs if source in inside
        )
        ids = [inside[source].id for source, _ in networkx.find_cycle(graph)]
        shown = ids if len(ids) <= 12 else [*ids[:6], "...", *ids[-5:]]
        where = inside[next(iter(inside))].where.partition(": node")[0]
        self.problem(where, f"the links form a cycle: {' -> '.join([*shown, ids[0]])}; remove one of them")

    def _check_types(self, step: Step, by_index: dict[int, Step]) -> None:
        bound: dict[str, type] = {}
        for name, source, output in step.inputs:
            port = step.node.input(name)
            if port is None:
                continue
            given = by_index[source].types[output]
            if given is _UNKNOWN:
                if port.variable:
                    bound[port.variable] = _UNKNOWN
                continue
            fits = porttypes.accepts(port.type, given)
            conversion = None if fits else self.registry.conversion(given, port.type)
            if port.variable:
                bound.setdefault(
                    port.variable, given if fits else conversion.outputs[0].type if conversion else port.type
                )
            if fits or conversion:
                continue
            origin = f"'{by_index[source].id}.{by_index[source].node.outputs[output].name}'"
            wanted, other = _article(porttypes.describe(port.type)), _article(porttypes.describe(given))
            self.problem(f"{step.where}: input '{name}'", f"takes {wanted}, but {origin} gives {other}")
        if self.problems:
            # A generic input that found no source says nothing of the output: no problem may follow from another.
            bound = {item.variable: _UNKNOWN for item in step.node.outputs if item.variable} | bound
        step.types = tuple([bound.get(item.variable, item.type) for item in step.node.outputs])

    def _check_declared(self, by_index: dict[int, Step]) -> None:
        """Hold what is linked to a subgraph's inputs against the types that its file declares for them."""
        for (where, source, output), declared in self.declared.items():
            given = by_index[source].types[output]
            fits = given is _UNKNOWN or porttypes.accepts(declared, given)
            if not fits and self.registry.conversion(given, declared) is None:
                origin = f"'{by_index[source].id}.{by_index[source].node.outputs[output].name}'"
                wanted, other = _article(porttypes.describe(declared)), _article(porttypes.describe(given))
                self.problem(where, f"takes {wanted}, but {origin} gives {other}")

    def convert(self) -> None:
        """Insert a step wherever a link needs a registered conversion; links that share a source share it."""
        by_index = {step.index: step for step in self.steps}
        made: dict[tuple[int, int, str], Step] = {}
        ordered: list[Step] = []
        for step in self.steps:
            for position, (name, source, output) in enumerate(step.inputs):
                port, given = step.node.input(name), by_index[source].types[output]
                if port is None or porttypes.accepts(port.type, given):
                    continue
                node = self.registry.conversion(given, port.type)
                if node is None:
                    continue
                key = (source, output, node.id)
                if key not in made:
                    checked = node.parameters.check({})
                    new = Step(
                        f"{by_index[source].id}:{node.name}", node, checked.values, checked.canonical, step.where
                    )
                    new.inputs = [(node.inputs[0].name, source, output)]
                    new.types = (node.outputs[0].type,)
                    new.index = len(by_index)
                    by_index[new.index] = new
                    made[key] = new
                    ordered.append(new)
                step.inputs[position] = (name, made[key].index, 0)
            ordered.append(step)
        self.steps = ordered


def _absolute(value: Any, folder: Path) -> Any:
    if isinstance(value, (list, tuple)):
        return type(value)(_absolute(item, folder) for item in value)
    return folder / _without_tilde(value) if isinstance(value, Path) else value


def _without_tilde(path: Path) -> Path:
    try:
        return path.expanduser()
    except RuntimeError:  # '~name' where there is nobody of that name
        return path


def _article(name: str) -> str:
    return f"an {name}" if name[:1] in "AEIOU" else f"a {name}"
