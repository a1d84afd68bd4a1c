"""The graph document: JSON on disk, a `Graph` in Python.

>>> g = Graph(title="Count")
>>> g.set_parameter("n", default=3, drives=["numbers.n"])
>>> print(g.to_json(), end="")
{
  "format": "nodegraph/1",
  "title": "Count",
  "parameters": {"n": {"default": 3, "drives": ["numbers.n"]}},
  "nodes": {}
}

A `Graph` wraps the data of its file and edits it in place: what it does not know (the record of a node whose plugin is
not installed, a layout) is kept as it is, names keep the author's order, and saving an unchanged graph gives the same
bytes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from nodegraph import jsontext
from nodegraph.atomic import write_atomically
from nodegraph.document import FORMAT, NODE_ID, check_form
from nodegraph.errors import GraphError, Problem, nearest
from nodegraph.migrate import upgrade
from nodegraph.nodetypes import Node
from nodegraph.plugins import Registry, registry

if TYPE_CHECKING:
    import networkx

    from nodegraph.cache import Cache
    from nodegraph.events import Observer
    from nodegraph.network import Network
    from nodegraph.plan import Plan
    from nodegraph.run import Result

_KEY_ORDER = ("format", "title", "note", "requires", "parameters", "inputs", "outputs", "nodes", "layout")


class Ref(NamedTuple):
    """A node's output, as graph files write it: ``node`` (the only or first output) or ``node.port``."""

    node: str
    port: str = ""

    def __str__(self) -> str:
        return f"{self.node}.{self.port}" if self.port else self.node

    @classmethod
    def parse(cls, text: str) -> Ref:
        """Return the reference that `text` writes."""
        node, _, port = text.partition(".")
        return cls(node, port)


class Output(Ref):
    """A reference that knows its graph, so that no other takes it for one of its own: ``handle["port"]``."""

    graph: Graph


class Handle:
    """A node in a graph under construction: link it by passing it, or one of its outputs ``handle["port"]``."""

    def __init__(self, graph: Graph, id: str) -> None:
        self.graph = graph
        self.id = id

    def __getitem__(self, port: str) -> Output:
        output = Output(self.id, port)
        output.graph = self.graph
        return output

    def __repr__(self) -> str:
        return f"<node '{self.id}'>"


class Graph:
    """A dataflow graph: nodes with parameters, and links between their ports.

    Attributes:
        path: the file it was loaded from or saved to; relative paths in parameters start at its folder.
    """

    def __init__(self, title: str = "", *, registry: Registry | None = None) -> None:
        self.path: Path | None = None
        self._registry = registry
        self._data: dict[str, Any] = {"format": FORMAT, **({"title": title} if title else {}), "nodes": {}}
        self._original: tuple[str, str] = ("", "")
        self._edits = 0
        self._numbers: dict[str, int] = {}
        self._network: tuple[object, Network] | None = None

    # The file.

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, registry: Registry | None = None) -> Graph:
        """Read a graph file.

        Raises:
            GraphError: the file cannot be read or is no graph document; every problem of its form is listed.
        """
        path = Path(path)
        try:
            text = path.read_bytes()
        except (OSError, ValueError) as error:  # ValueError: a name that no file can have
            why = getattr(error, "strerror", None) or error
            raise GraphError(f"cannot be read ({why})", printable(path)) from error
        graph = cls.from_json(text, where=printable(path.name), registry=registry)
        graph.path = path
        return graph

    @classmethod
    def from_json(cls, text: str | bytes, *, where: str = "graph", registry: Registry | None = None) -> Graph:
        """Read a graph from JSON text.  Raises `GraphError` as `load` does."""
        data = jsontext.parse(text, where)
        if problems := check_form(data, where):
            raise GraphError(problems)
        graph = cls(registry=registry)
        graph._data = data
        graph._original = (_exact(data), text.decode() if isinstance(text, bytes) else text)
        return graph

    def to_json(self) -> str:
        """Return the document as JSON text: the text it was loaded from while it is unchanged, else the house style."""
        unchanged, text = self._original
        if unchanged and unchanged == _exact(self._data):
            return text
        return jsontext.write(self._data)

    def save(self, path: str | os.PathLike[str] | None = None) -> Path:
        """Write the graph file: aside first, then renamed into place, so that a crash leaves the old one whole."""
        target = Path(path) if path is not None else self.path
        if target is None:
            raise GraphError("the graph has no file yet; give a path", self.name)
        write_atomically(target, self.to_json().encode())
        self.path = target
        return target

    # What it holds.

    @property
    def data(self) -> dict[str, Any]:
        """The document as plain JSON data, a copy."""
        return json.loads(_exact(self._data))  # type: ignore[no-any-return]

    @property
    def title(self) -> str:
        """The title, for people."""
        return str(self._data.get("title", ""))

    @property
    def name(self) -> str:
        """What messages call the graph: its file name, else its title."""
        return printable(self.path.name) if self.path else self.title or "graph"

    @property
    def folder(self) -> Path:
        """The folder that relative paths start at."""
        return self.path.parent.absolute() if self.path else Path.cwd()

    @property
    def nodes(self) -> Mapping[str, Mapping[str, Any]]:
        """The node records by id, in the author's order."""
        return self._data["nodes"]  # type: ignore[no-any-return]

    def __len__(self) -> int:
        return len(self._data["nodes"])

    def __contains__(self, id: str) -> bool:
        return id in self._data["nodes"]

    # Building.

    def add(self, type: str | Node[..., Any], id: str = "", /, **ports_and_params: Any) -> Handle:
        """Add a node and return its handle.

        Args:
            type: a type id such as ``"terrain.slope"``, or a node object.
            id: the node's id; by default the last part of the type, numbered where taken.
            **ports_and_params: links for names that are input ports (a handle, ``handle["port"]``, ``"node.port"``, or
                a list of these), parameters for all others.

        Raises:
            GraphError: the type is unknown, the id is taken or malformed, or a name is neither port nor parameter.
        """
        reg = self._registry or registry()
        if isinstance(type, Node):
            declared: Node[..., Any] | None = reg.register(type) if reg.find(type.id) is not type else type
            type = declared.id if declared else ""
        else:
            declared = reg.find(type)
        if declared is None and type != "graph":
            raise GraphError(reg.why_unknown(type), self.name)
        id = id or self._free_id(type.rpartition(".")[2])
        if id in self._data["nodes"]:
            raise GraphError(f"there is a node '{id}' already; choose another id", self.name)
        if not NODE_ID.match(id):
            raise GraphError(f"node id '{id}' may hold only letters, digits, '_' and '-'", self.name)
        record: dict[str, Any] = {"type": type}
        if declared is not None:
            # What a tool writes says what it means: a record without a version was written by hand.
            record["version"] = declared.version
        inputs, params = {}, {}
        for name, value in ports_and_params.items():
            if (declared is None and _is_link(value)) or (declared is not None and declared.input(name)):
                if value is not None:
                    inputs[name] = self._link(value)
            elif declared is None or name in declared.parameters.fields:
                params[name] = _json_value(value, f"{self.name}: node '{id}': parameter '{name}'")
            else:
                names = [*(port.name for port in declared.inputs), *declared.parameters.fields]
                raise GraphError(f"'{name}' is neither port nor parameter of {type}; {nearest(name, names)}", self.name)
        if inputs:
            record["inputs"] = inputs
        if params:
            record["params"] = params
        self._data["nodes"][id] = record
        self._edits += 1
        return Handle(self, id)

    def link(self, port: str, *sources: Any) -> None:
        """Link the input ``"node.port"`` to one source, or several for a variadic port; no source unlinks it."""
        ref = Ref.parse(port)
        inputs = self._record(ref.node).setdefault("inputs", {})
        if sources:
            inputs[ref.port] = self._link(list(sources) if len(sources) > 1 else sources[0])
        else:
            inputs.pop(ref.port, None)
        self._edits += 1

    def set(self, name: str, value: Any) -> None:
        """Set the parameter ``"node.parameter"``, or the default of an exposed parameter ``"name"``."""
        ref = Ref.parse(name)
        clean = _json_value(value, f"{self.name}: '{name}'")
        if ref.port:
            self._record(ref.node).setdefault("params", {})[ref.port] = clean
        else:
            exposed = self._data.get("parameters", {})
            if name not in exposed:
                raise GraphError(f"no exposed parameter '{name}'; {nearest(name, exposed)}", self.name)
            exposed[name]["default"] = clean
        self._edits += 1

    def remove(self, id: str) -> None:
        """Remove a node, the links to it, and its place in the layout."""
        self._record(id)
        del self._data["nodes"][id]
        self._data.get("layout", {}).pop(id, None)
        for record in self._data["nodes"].values():
            inputs = record.get("inputs", {})
            for port, links in list(inputs.items()):
                kept = [link for link in _as_list(links) if Ref.parse(link).node != id]
                if not kept:
                    del inputs[port]
                elif len(kept) < len(_as_list(links)):
                    inputs[port] = kept
        self._edits += 1

    def set_parameter(self, name: str, *, drives: Sequence[str], default: Any = None) -> None:
        """Expose a parameter of the whole graph that drives ``"node.parameter"``s."""
        entry = {**({} if default is None else {"default": _json_value(default, name)}), "drives": list(drives)}
        self._section("parameters")[name] = entry

    def set_input(self, name: str, *, type: str, feeds: Sequence[str]) -> None:
        """Expose an input of the whole graph that feeds ``"node.port"``s; `type` names a port type."""
        self._section("inputs")[name] = {"type": type, "feeds": list(feeds)}

    def set_output(self, name: str, source: Any) -> None:
        """Expose an output of the whole graph."""
        self._section("outputs")[name] = self._link(source)

    def _link(self, value: Any) -> Any:
        if isinstance(value, (Handle, Output)) and value.graph is not self:
            node = value.id if isinstance(value, Handle) else value.node
            message = f"'{node}' is a node of another graph ('{value.graph.name}'); give one of this graph"
            raise GraphError(message, self.name)
        if isinstance(value, Handle):
            return value.id
        if isinstance(value, (Ref, str)):
            return str(value)
        if isinstance(value, (list, tuple)):
            return [self._link(item) for item in value]
        raise TypeError(f"{value!r} is no node or output; give a handle, handle['port'] or 'node.port'")

    def _targets(self, targets: Any) -> list[str]:
        one = isinstance(targets, (str, Handle, Ref))
        return [str(self._link(target)) for target in ([targets] if one else targets)]

    def _section(self, key: str) -> dict[str, Any]:
        if key not in self._data:
            self._data[key] = {}
            known = {name: self._data[name] for name in _KEY_ORDER if name in self._data}
            self._data = {**known, **self._data}
        self._edits += 1
        return self._data[key]  # type: ignore[no-any-return]

    def _record(self, id: str) -> dict[str, Any]:
        nodes = self._data["nodes"]
        if id not in nodes:
            raise GraphError(f"no node '{id}'; {nearest(id, nodes)}", self.name)
        return nodes[id]  # type: ignore[no-any-return]

    def _free_id(self, base: str) -> str:
        nodes = self._data["nodes"]
        if base not in nodes:
            return base
        number = self._numbers.get(base, 2)
        while f"{base}_{number}" in nodes:
            number += 1
        self._numbers[base] = number + 1
        return f"{base}_{number}"

    # Meaning.

    def network(self, overrides: Mapping[str, Any] | None = None) -> Network:
        """Return the graph checked, migrated, with its subgraphs inlined: what a plan starts from.

        Args:
            overrides: parameter values by ``"node.parameter"`` or exposed name, over those of the file.

        Raises:
            GraphError: listing every problem.
        """
        from nodegraph.build import build

        if overrides:
            return build(
                self, {name: _json_value(value, f"{self.name}: '{name}'") for name, value in overrides.items()}
            )
        state = (self._edits, self.folder, (self._registry or registry()).changes)
        if self._network is None or self._network[0] != (state, _stamps(self._network[1])):
            network = build(self, {})
            self._network = ((state, _stamps(network)), network)
        return self._network[1]

    def validate(self) -> None:
        """Raise `GraphError` listing everything that is wrong, or return."""
        self.network()

    def upgraded(self) -> Graph:
        """Return a copy with every plugin's migrations applied, and node versions written.

        Raises:
            GraphError: a migration failed, or the default of an exposed parameter would have to be two values.
        """
        graph = Graph(registry=self._registry)
        graph.path = self.path
        try:
            graph._data, changes = upgrade(self._data, self._registry or registry())
        except GraphError as error:
            problems = [Problem(f"{self.name}: {item.where}", item.message) for item in error.problems]
            raise GraphError(problems) from error
        graph._original = self._original
        graph._edits = len(changes)
        return graph

    def to_networkx(self) -> networkx.MultiDiGraph:
        """Return nodes and links as a networkx graph: node attributes are the records, edges carry both ports."""
        import networkx

        graph = networkx.MultiDiGraph(name=self.name)
        graph.add_nodes_from((id, dict(record)) for id, record in self._data["nodes"].items())
        for id, record in self._data["nodes"].items():
            for port, links in record.get("inputs", {}).items():
                for link in _as_list(links):
                    ref = Ref.parse(link)
                    graph.add_edge(ref.node, id, source_port=ref.port, target_port=port)
        return graph

    def plan(self, targets: Iterable[Any] = (), **options: Any) -> Plan:
        """Say what a run would compute and why, without running anything.  Options as for `run`."""
        from nodegraph.run import plan_graph

        return plan_graph(self, self._targets(targets), **options)

    def run(
        self,
        targets: Iterable[Any] = (),
        *,
        set: Mapping[str, Any] | None = None,
        cache: Cache | None = None,
        jobs: int | None = None,
        device: str = "auto",
        out: str | os.PathLike[str] | None = None,
        force: Iterable[str] = (),
        checked: bool = False,
        observers: Iterable[Observer] = (),
        check: bool = True,
    ) -> Result:
        """Compute what has changed and return the result: ``result["node"]``, ``result["node.port"]``.

        Args:
            targets: nodes or outputs wanted; by default every node that nothing consumes.
            set: parameter values for this run only, by ``"node.parameter"`` or exposed name.
            cache: where results are remembered; by default the cache of this user.
            jobs: nodes computed at the same time; by default the number of processors.
            device: ``auto``, ``none``, or ``platform:device``.
            out: where export nodes' files go; by default ``out/<graph name>`` in the current folder.
            force: ids of nodes to compute even where the cache knows their result.
            checked: compute everything and compare it with the cache; a difference fails the node.
            observers: called with every event of the run (`nodegraph.events`).
            check: raise `RunError` when a node failed; otherwise the result tells.

        Raises:
            GraphError: the graph or the call is wrong; nothing was run.
            RunError: a node failed and `check` is set.
            Cancelled: the run was interrupted (Ctrl-C); what was finished is kept in the cache.
        """
        from nodegraph.run import run_graph

        return run_graph(
            self,
            self._targets(targets),
            overrides=set,
            cache=cache,
            jobs=jobs,
            device=device,
            out=out,
            force=(force,) if isinstance(force, str) else tuple(force),
            checked=checked,
            observers=tuple(observers),
            check=check,
        )


def printable(path: str | os.PathLike[str]) -> str:
    """Return a path as text that can be printed and stored, where its bytes are no UTF-8, too."""
    return str(path).encode(errors="backslashreplace").decode()


def _stamps(network: Network) -> list[tuple[int, int] | None]:
    """Return size and time of change of the graph files that a network holds."""
    found: list[tuple[int, int] | None] = []
    for path in network.sources:
        try:
            status = path.stat()
            found.append((status.st_size, status.st_mtime_ns))
        except OSError:
            found.append(None)
    return found


def _exact(data: Any) -> str:
    """Return a text that is equal for two documents only when they agree in order and in number types."""
    return json.dumps(data, ensure_ascii=False)


def _as_list(links: str | list[str]) -> list[str]:
    return [links] if isinstance(links, str) else links


def _is_link(value: Any) -> bool:
    items = value if isinstance(value, list) else [value]
    return bool(items) and all(isinstance(item, (Handle, Ref)) for item in items)


def _json_value(value: Any, where: str) -> Any:
    """Return `value` as JSON data of its own (tuples become lists, NumPy scalars numbers, paths strings)."""
    if type(value) in (str, int, bool) or value is None:
        return value
    try:
        return json.loads(json.dumps(value, allow_nan=False, default=_plain_json))
    except (TypeError, ValueError, RecursionError) as error:
        raise GraphError([Problem(where, f"not a JSON value ({error})")]) from None


def _plain_json(value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no JSON value")
