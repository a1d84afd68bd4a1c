"""Opening a document: every node becomes a step with checked parameters, or, as a subgraph, a scope of its own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nodegraph import porttypes
from nodegraph.errors import GraphError, PluginError, Problems, nearest
from nodegraph.files import check_name
from nodegraph.formats import Format, Use
from nodegraph.migrate import migrate
from nodegraph.network import Step
from nodegraph.nodetypes import Node
from nodegraph.parameters import Checked, InputFile, ParameterErrors
from nodegraph.plugins import Registry, registry

if TYPE_CHECKING:
    from nodegraph.graph import Graph

MAX_NESTING = 50
"""How deep graph files may contain each other."""


@dataclass(slots=True)
class Scope:
    """One graph document while a network is built.

    Attributes:
        name: how messages name it.
        prefix: what leads the ids of its steps.
        data: the document, migrated.
        outer: the scope it is a node of.
        own_id: the id of that node.
        steps: its nodes that are steps, by id.
        scopes: its nodes that are subgraphs, by id.
        broken: its nodes that are neither, since something is wrong with them.
        fed: the exposed input that feeds each (node, port).
    """

    name: str
    prefix: str
    data: dict[str, Any]
    outer: Scope | None
    own_id: str
    steps: dict[str, Step] = field(default_factory=dict)
    scopes: dict[str, Scope] = field(default_factory=dict)
    broken: set[str] = field(default_factory=set)
    fed: dict[tuple[str, str], str] = field(default_factory=dict)


class Opener:
    """Opens documents, one inside the other.

    Attributes:
        steps: the nodes of all documents that are no subgraphs, in the order of the files; not yet linked.
        sources: the files that were read.
    """

    def __init__(self, registry: Registry, problems: Problems) -> None:
        self.registry = registry
        self.problems = problems
        self.steps: list[Step] = []
        self.sources: list[Path] = []

    def open(
        self,
        graph: Graph,
        prefix: str,
        own_id: str,
        overrides: Mapping[str, Any],
        outer: Scope | None,
        around: tuple[Path, ...],
    ) -> Scope:
        """Return a document as a scope, with its nodes as steps and further scopes.

        Args:
            graph: the document.
            prefix: what leads the ids of its steps.
            own_id: the id of the node that it is, empty for the outermost.
            overrides: parameter values by exposed name, and in the outermost by ``node.parameter``.
            outer: the scope of that node.
            around: the files it is inside of.
        """
        name = graph.name if not outer else f"{outer.name}: node '{own_id}': {graph.name}"
        data = graph._data
        try:
            data = migrate(data, self.registry, overrides)
        except GraphError as error:
            for item in error.problems:
                self.problems.add(f"{name}: {item.where}", item.message)
        scope = Scope(name, prefix, data, outer, own_id)
        if graph.path:
            self.sources.append(graph.path.absolute())
        self._requirements(scope)
        values = self._parameter_values(scope, overrides)
        for name, entry in data.get("inputs", {}).items():
            self._exposed_input(scope, name, entry)
        if not data["nodes"]:
            self.problems.add(scope.name, "the graph has no nodes; add at least one under 'nodes'")
        for id, record in data["nodes"].items():
            self.problems.places[f"{scope.name}: node '{id}'"] = len(self.problems.places)
            params = {**record.get("params", {}), **values.get(id, {})}
            if record["type"] == "graph":
                self._open_subgraph(scope, graph, id, params, around)
            else:
                self._step(scope, graph.folder, id, record, params)
        return scope

    def _requirements(self, scope: Scope) -> None:
        if not scope.data.get("requires"):
            return
        from packaging.specifiers import InvalidSpecifier, SpecifierSet
        from packaging.version import InvalidVersion, Version

        for name, text in scope.data.get("requires", {}).items():
            where = f"{scope.name}: requires '{name}'"
            try:
                wanted = SpecifierSet(text)
            except InvalidSpecifier:
                self.problems.add(where, f"'{text}' is no version specifier; write it like '>=0.1'")
                continue
            plugin = self.registry.plugins.get(name)
            if plugin is None or plugin.error:
                why = f"is left out ({plugin.error})" if plugin else f"is not installed; install a version {text}"
                self.problems.add(where, f"the plugin {why}")
                continue
            try:
                fits = not plugin.version or wanted.contains(Version(plugin.version), prereleases=True)
            except InvalidVersion:
                fits = True
            if not fits:
                self.problems.add(where, f"version {plugin.version} is installed, the graph needs {text}")

    def _parameter_values(self, scope: Scope, overrides: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Return parameter values by node: exposed ones first, direct overrides over them."""
        values: dict[str, dict[str, Any]] = {}
        nodes, exposed = scope.data["nodes"], scope.data.get("parameters", {})
        for name, entry in exposed.items():
            for drive in entry["drives"]:
                id, _, parameter = drive.partition(".")
                if id not in nodes or not parameter:
                    hint = nearest(id, nodes) if id not in nodes else "write it as 'node.parameter'"
                    self.problems.add(
                        f"{scope.name}: parameter '{name}'", f"drives '{drive}', which does not exist; {hint}"
                    )
                elif not self._takes(nodes[id], parameter):
                    hint = nearest(parameter, self._parameter_names(nodes[id]))
                    self.problems.add(f"{scope.name}: node '{id}'", f"unknown parameter '{parameter}'; {hint}")
                elif name in overrides or "default" in entry:
                    values.setdefault(id, {})[parameter] = overrides.get(name, entry.get("default"))
        for name, value in overrides.items():
            id, _, parameter = name.partition(".")
            if not parameter and name not in exposed:
                known = [
                    *exposed,
                    *(f"{key}.{item}" for key, record in nodes.items() for item in self._parameter_names(record)),
                ]
                self.problems.add(scope.name, f"no parameter '{name}'; {nearest(name, known)}")
            elif parameter and id not in nodes:
                self.problems.add(scope.name, f"no node '{id}' to set '{parameter}' of; {nearest(id, nodes)}")
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

    def _exposed_input(self, scope: Scope, name: str, entry: dict[str, Any]) -> None:
        where = f"{scope.name}: input '{name}'"
        if porttypes.named(entry["type"]) is None:
            self.registry.activate_all()
        if porttypes.named(entry["type"]) is None:
            names = [item for item, _ in porttypes.all_types()]
            self.problems.add(where, f"unknown port type '{entry['type']}'; {nearest(entry['type'], names)}")
        for feed in entry["feeds"]:
            id, _, port = feed.partition(".")
            record = scope.data["nodes"].get(id)
            node = self._usable(record) if record is not None else None
            if record is None:
                self.problems.add(where, f"feeds '{feed}', which does not exist; {nearest(id, scope.data['nodes'])}")
            elif node is not None and node.input(port) is None:
                hint = nearest(port, [item.name for item in node.inputs])
                self.problems.add(where, f"feeds '{feed}', but node '{id}' has no input '{port}'; {hint}")
            scope.fed[id, port] = name

    def _step(self, scope: Scope, folder: Path, id: str, record: dict[str, Any], params: dict[str, Any]) -> None:
        where = f"{scope.name}: node '{id}'"
        node = self.registry.find(record["type"])
        if node is None:
            self.problems.add(where, self.registry.why_unknown(record["type"]))
            scope.broken.add(id)
            return
        for key in record:
            if key not in ("type", "version", "params", "inputs", "note"):
                known = ("type", "version", "params", "inputs", "note")
                self.problems.add(where, f"unknown key '{key}'; {nearest(key, known)}")
        if (saved := record.get("version")) is not None and saved > node.version:
            self.problems.add(
                where,
                f"saved with version {saved} of {node.id}, version {node.version} is installed; upgrade the plugin",
            )
        try:
            checked = node.parameters.check(params)
        except PluginError as error:
            self.problems.add(where, str(error))
            scope.broken.add(id)
            return
        except ParameterErrors as error:
            for _, message in error.items:
                self.problems.add(where, message)
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
                self.problems.add(step.where, f"parameter '{item.name}': {error}")
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
            self.problems.add(step.where, f"parameter '{parameter}': {error}")
            return []
        functions = [function for item in found for function in item.functions(use)]
        step.code = tuple(dict.fromkeys([*step.code, *functions]))
        return found

    def _open_subgraph(
        self, scope: Scope, graph: Graph, id: str, params: dict[str, Any], around: tuple[Path, ...]
    ) -> None:
        from nodegraph.graph import Graph

        where = f"{scope.name}: node '{id}'"
        scope.broken.add(id)
        path = params.pop("path", None)
        if not isinstance(path, str) or not path:
            self.problems.add(where, "parameter 'path' is missing: the graph file, relative to this one")
            return
        try:
            file = (graph.folder / _without_tilde(Path(path))).resolve()
        except ValueError as error:  # a name that no file can have
            self.problems.add(where, f"{path!r} cannot be read ({error})")
            return
        here = (*around, graph.path.resolve()) if graph.path else around
        if file in here:
            self.problems.add(where, f"'{path}' contains itself; graph files must not form a circle")
            return
        if len(here) >= MAX_NESTING:
            self.problems.add(where, f"graph files are nested more than {MAX_NESTING} deep")
            return
        try:
            inner = Graph.load(file, registry=self.registry)
        except GraphError as error:
            for item in error.problems:
                self.problems.add(f"{where}: {item.where}", item.message)
            return
        exposed = inner._data.get("parameters", {})
        for name in [name for name in params if name not in exposed]:
            self.problems.add(where, f"unknown parameter '{name}'; {nearest(name, [*exposed, 'path'])}")
            del params[name]
        scope.broken.discard(id)
        scope.scopes[id] = self.open(inner, f"{scope.prefix}{id}/", id, params, scope, here)


def _absolute(value: Any, folder: Path) -> Any:
    if isinstance(value, (list, tuple)):
        return type(value)(_absolute(item, folder) for item in value)
    return folder / _without_tilde(value) if isinstance(value, Path) else value


def _without_tilde(path: Path) -> Path:
    try:
        return path.expanduser()
    except RuntimeError:  # '~name' where there is nobody of that name
        return path
