"""Plugins: the hooks they may implement, and loading them.

A plugin is a module named by an entry point of the group ``nodegraph``.  It lists what it brings through hooks, and
nothing else runs when it loads: a family names the modules of its nodes, and these are imported only when a graph uses
the family.  A plugin that breaks costs a warning that names it and its version, never the program.

The whole of a small plugin::

    from nodegraph import Family, hookimpl, node

    @node(version=1)
    def invert(mask: Mask) -> Mask:
        '''Swap inside and outside.'''
        return Mask(1 - mask.data, mask.extent)

    @hookimpl
    def nodegraph_families():
        return [Family("acme", modules=(__name__,))]
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from types import ModuleType
from typing import Any

import pluggy

from nodegraph.errors import PluginError, nearest, sentence
from nodegraph.formats import Format, Formats
from nodegraph.nodetypes import Node
from nodegraph.porttypes import accepts, is_port_type

GROUP = "nodegraph"
hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


@dataclass(frozen=True, slots=True)
class Family:
    """A set of node types under one name; ``name`` is the first part of their type ids.

    Attributes:
        name: an identifier, such as ``terrain``.
        modules: dotted names of the modules that declare the nodes; imported when the family is first used.
        nodes: node objects given directly, for families built in a program.
        title: what a menu shows.
    """

    name: str
    modules: tuple[str, ...] = ()
    nodes: tuple[Node[..., Any], ...] = ()
    title: str = ""


@dataclass(frozen=True, slots=True)
class Preview:
    """How to draw a port type: ``render(value)`` returns the bytes of a PNG picture."""

    type: type
    render: Callable[[Any], bytes]


@dataclass(frozen=True, slots=True)
class Migration:
    """What changed in a node type with version ``version``: applies to records that were saved before it.

    Attributes:
        type: the type id as older files name it.
        version: the first version of the node that has the change.
        new_type: the type id from then on, where the node was renamed.
        parameters, inputs, outputs: old name -> new name.
        change: rewrites the parameters where their meaning changed: gets a copy of them, returns the new ones.
    """

    type: str
    version: int
    new_type: str = ""
    parameters: Mapping[str, str] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    outputs: Mapping[str, str] = field(default_factory=dict)
    change: Callable[[dict[str, Any]], dict[str, Any]] | None = None


class Hooks:
    """The hook specifications: one typed function each.  Every hook is optional and runs in the main process only."""

    @hookspec
    def nodegraph_families(self) -> Sequence[Family]:  # type: ignore[empty-body]
        """List the node families of the plugin."""

    @hookspec
    def nodegraph_port_types(self) -> Sequence[type]:  # type: ignore[empty-body]
        """List the port types of the plugin, each declared with `@port_type`."""

    @hookspec
    def nodegraph_conversions(self) -> Sequence[Node[..., Any]]:  # type: ignore[empty-body]
        """List nodes of one input and one output that turn a port type into another where a link needs it."""

    @hookspec
    def nodegraph_previews(self) -> Sequence[Preview]:  # type: ignore[empty-body]
        """List how the plugin's port types are drawn; the entry for the nearest base class counts."""

    @hookspec
    def nodegraph_formats(self) -> Sequence[Format]:  # type: ignore[empty-body]
        """List the file formats that the plugin reads or writes, of its own port types or of another's."""

    @hookspec
    def nodegraph_migrations(self) -> Sequence[Migration]:  # type: ignore[empty-body]
        """List what changed in the plugin's node types, so that old graph files keep running."""


@dataclass
class Plugin:
    """One discovered plugin.  ``error`` says in a sentence why it could not be loaded."""

    name: str
    version: str
    module: ModuleType | None = None
    families: list[Family] = field(default_factory=list)
    error: str = ""
    activated: bool = False


class Registry:
    """Everything that plugins brought: node types by id, conversions, previews, file formats, migrations.

    Families are listed at once and imported when first asked for; `activate_all` imports every one of them.  File
    formats are listed when a node first asks for one.

    Attributes:
        plugins: by name, those that failed among them.
        changes: goes up whenever a plugin or a node is added or replaced.
    """

    def __init__(self) -> None:
        self.plugins: dict[str, Plugin] = {}
        self.changes = 0
        self._nodes: dict[str, Node[..., Any]] = {}
        self._families: dict[str, tuple[Plugin, Family]] = {}
        self._loaded_families: set[str] = set()
        self._conversions: list[Node[..., Any]] = []
        self._previews: list[Preview] = []
        self._formats = Formats()
        self._formats_listed: set[str] = set()
        self._manager = pluggy.PluginManager(GROUP)
        self._manager.add_hookspecs(Hooks)

    # Loading.

    def load(self, points: Iterable[EntryPoint]) -> None:
        """Load plugins one at a time, in order of name; a failing one warns and stays out."""
        for point in sorted(points, key=lambda item: item.name):
            plugin = Plugin(point.name, "")
            try:
                plugin.version = (point.dist.version if point.dist else "") or ""
                self.add(point.load(), plugin)
            except (Exception, SystemExit) as error:  # whatever a stranger's module may raise
                self.plugins.setdefault(plugin.name, plugin)
                self._leave_out(plugin, sentence(error))

    def add(self, module: ModuleType, plugin: Plugin | None = None) -> Plugin:
        """Add one plugin module.  Raises `PluginError` when its hooks break a rule; then nothing of it is kept."""
        plugin = plugin or Plugin(module.__name__, str(getattr(module, "__version__", "")))
        plugin.module = module
        try:
            self._manager.register(module, plugin.name)
            self._manager.check_pending()
            families: list[Family] = self._call(plugin, "nodegraph_families", Family)
            for position, family in enumerate(families):
                if family.name in self._families or family.name in [item.name for item in families[:position]]:
                    owner = self._families[family.name][0].name if family.name in self._families else plugin.name
                    raise PluginError(f"family '{family.name}' is already registered by plugin '{owner}'")
                if not family.name.isidentifier():
                    raise PluginError(f"family '{family.name}' must be an identifier")
                if not isinstance(family.modules, tuple):
                    raise PluginError(f"family '{family.name}': modules must be a tuple of names")
        except (PluginError, pluggy.PluginValidationError, ValueError) as error:
            if self._manager.get_plugin(plugin.name) is module:
                self._manager.unregister(module)
            raise PluginError(f"plugin '{plugin.name}': {sentence(error)}") from error
        plugin.families = families
        self.plugins[plugin.name] = plugin
        self.changes += 1
        for family in families:
            self._families[family.name] = (plugin, family)
        return plugin

    def register(self, node: Node[..., Any], family: str = "local") -> Node[..., Any]:
        """Register one node in the running program, under a family of its own choice (for notebooks and tests).

        A node of the same id from the same place in the source replaces the earlier one.
        """
        if node.family == "local":
            node.family = family
        known = self._nodes.get(node.id)
        if known is not None and known is not node and _home(known) != _home(node):
            raise PluginError(f"node '{node.id}' is already declared in {_home(known)[0]}; choose another name")
        if known is not node:
            self._nodes[node.id] = node
            self.changes += 1
        return node

    def _call(self, plugin: Plugin, hook: str, kind: type) -> list[Any]:
        """Call one hook of one plugin and return the list it gives (empty where it has none).

        Raises:
            PluginError: it fails, or gives something else than a list of `kind`.
        """
        others = [item for name, item in self._manager.list_name_plugin() if name != plugin.name]
        caller = self._manager.subset_hook_caller(hook, others)
        found: list[Any] = []
        try:
            for items in caller():
                found.extend(items)
        except Exception as error:  # whatever a stranger's hook may raise
            raise PluginError(f"{hook} failed ({sentence(error)})") from error
        for item in found:
            if not isinstance(item, kind):
                raise PluginError(f"{hook} must list {kind.__name__} objects, not {item!r}")
        return found

    def _leave_out(self, plugin: Plugin, error: str) -> None:
        plugin.error = error
        warnings.warn(f"{_called(plugin)} is left out: {plugin.error}", RuntimeWarning, stacklevel=3)

    def _activate(self, plugin: Plugin) -> None:
        """Take up what a plugin brings beside its nodes; where that fails, the plugin is left out."""
        if plugin.activated or plugin.error:
            return
        plugin.activated = True
        try:
            for cls in self._call(plugin, "nodegraph_port_types", type):
                if not is_port_type(cls):
                    raise PluginError(f"{cls.__name__} is no port type; declare it with @port_type")
            conversions: list[Node[..., Any]] = self._call(plugin, "nodegraph_conversions", Node)
            for node in conversions:
                required = [field.name for field in node.parameters.fields.values() if field.required]
                if len(node.inputs) != 1 or len(node.outputs) != 1 or required:
                    raise PluginError(
                        f"conversion '{node.name}' must have one input, one output and no required parameter"
                    )
            previews = self._call(plugin, "nodegraph_previews", Preview)
        except PluginError as error:
            self._leave_out(plugin, str(error))
            return
        for node in conversions:
            if node.family == "local":
                node.family = plugin.families[0].name if plugin.families else plugin.name
        self._conversions.extend(conversions)
        self._previews.extend(previews)

    def _load_family(self, name: str) -> None:
        if name in self._loaded_families or name not in self._families:
            return
        self._loaded_families.add(name)
        plugin, family = self._families[name]
        self._activate(plugin)
        if plugin.error:
            return
        try:
            nodes = [*family.nodes]
            for module_name in family.modules:
                module = importlib.import_module(module_name)
                nodes += [item for item in vars(module).values() if _declared_in(item, module)]
            for node in nodes:
                if node.family not in ("local", name):
                    raise PluginError(f"node '{node.name}' is already in family '{node.family}'")
                node.family = name
                self.register(node, name)
        except (Exception, SystemExit) as error:  # a stranger's module may raise anything
            self._leave_out(plugin, f"family '{name}': {sentence(error)}")

    def activate_all(self) -> None:
        """Import every family of every plugin."""
        for plugin in self.plugins.values():
            self._activate(plugin)
        for name in list(self._families):
            self._load_family(name)

    # Asking.

    def find(self, type_id: str) -> Node[..., Any] | None:
        """Return the node type of that id, importing its family when needed, or None."""
        known = self._nodes.get(type_id)
        if known is None:
            self._load_family(type_id.partition(".")[0])
            known = self._nodes.get(type_id)
        return known

    def nodes(self) -> list[Node[..., Any]]:
        """Return every node type of every plugin, sorted by id."""
        self.activate_all()
        return [self._nodes[key] for key in sorted(self._nodes)]

    def why_unknown(self, type_id: str) -> str:
        """Return a sentence that helps with an unknown type id: the nearest name, or the plugin to install."""
        family = type_id.partition(".")[0]
        if family in self._families:
            plugin = self._families[family][0]
            self._load_family(family)
            if plugin.error:
                return f"unknown node type '{type_id}': plugin '{plugin.name}' is left out ({plugin.error})"
        if names := [key for key in self._nodes if key.startswith(f"{family}.")]:
            return f"unknown node type '{type_id}'; {nearest(type_id, names)}"
        for plugin in self.plugins.values():
            if plugin.error and family and family in plugin.name:
                return f"unknown node type '{type_id}': plugin '{plugin.name}' is left out ({plugin.error})"
        close = nearest(family, {*self._families, *(key.partition(".")[0] for key in self._nodes)})
        return f"unknown node type '{type_id}': install the plugin that brings the family '{family}' ({close})"

    def conversion(self, source: type, target: type) -> Node[..., Any] | None:
        """Return the registered node that turns `source` into `target`, or None."""
        for plugin in self.plugins.values():
            self._activate(plugin)
        for node in self._conversions:
            if accepts(node.inputs[0].type, source) and accepts(target, node.outputs[0].type):
                return node
        return None

    def preview(self, cls: type) -> Preview | None:
        """Return how to draw values of `cls`: its own preview, else that of its nearest base class."""
        self.activate_all()
        by_type = {item.type: item for item in self._previews}
        return next((by_type[base] for base in cls.__mro__ if base in by_type), None)

    def formats(self) -> Formats:
        """Return the file formats of every plugin.

        They are taken in the order of the plugins, whoever asks first: of two with the same type and suffix, always
        the same one counts, and a warning names both.
        """
        for plugin in self.plugins.values():
            if plugin.error or plugin.name in self._formats_listed:
                continue
            self._formats_listed.add(plugin.name)
            try:
                added: list[Format] = self._call(plugin, "nodegraph_formats", Format)
            except PluginError as error:
                self._leave_out(plugin, str(error))
                continue
            for item in added:
                for clash in self._formats.add(item, plugin.name):
                    warnings.warn(f"{_called(plugin)}: {clash}", RuntimeWarning, stacklevel=2)
        return self._formats

    def migrations(self) -> list[Migration]:
        """Return the migrations of every plugin."""
        found: list[Migration] = []
        for plugin in self.plugins.values():
            if not plugin.error:
                try:
                    found += self._call(plugin, "nodegraph_migrations", Migration)
                except PluginError as error:
                    self._leave_out(plugin, str(error))
        return found

    def owner(self, type_id: str) -> Plugin | None:
        """Return the plugin whose family a type id belongs to, or None for nodes registered by the program."""
        entry = self._families.get(type_id.partition(".")[0])
        return entry[0] if entry else None

    def packages(self) -> frozenset[str]:
        """Return the top-level packages of all plugins: code in them counts for the fingerprints of nodes."""
        return frozenset(plugin.module.__name__.partition(".")[0] for plugin in self.plugins.values() if plugin.module)


@cache
def registry() -> Registry:
    """Return the registry of this process, loading every installed plugin on first use."""
    found = Registry()
    found.load(entry_points(group=GROUP))
    return found


def _called(plugin: Plugin) -> str:
    return f"plugin '{plugin.name}' {plugin.version}".rstrip()


def _declared_in(item: Any, module: ModuleType) -> bool:
    return isinstance(item, Node) and item.function.__module__ == module.__name__


def _home(node: Node[..., Any]) -> tuple[str, str]:
    return node.function.__module__, node.function.__qualname__
