"""Commands about what is installed: nodes, types, plugins, devices, schema."""

from __future__ import annotations

import inspect
import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nodegraph.cli import text
from nodegraph.cli.complete import complete_types
from nodegraph.cli.session import session
from nodegraph.errors import GraphError, nearest

if TYPE_CHECKING:
    from nodegraph.nodetypes import Node


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    for command in (nodes, types, plugins, devices, schema):
        app.command()(command)


def nodes(
    context: typer.Context,
    name: Annotated[
        str | None,
        typer.Argument(help="A node type for all about it, or a word to look for.", autocompletion=complete_types),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything about the nodes found as JSON.")] = False,
) -> int:
    """List node types, look for some, or explain one."""
    from nodegraph.cli import nodehelp
    from nodegraph.plugins import registry

    here = session(context)
    known = {node.id: node for node in registry().nodes()}
    found = [known[name]] if name in known else [node for node in known.values() if _matches(node, name or "")]
    if not found:
        raise GraphError(f"no node type '{name}', and none that speaks of it; {nearest(name or '', known)}")
    if as_json:
        here.console.say(json.dumps([nodehelp.as_data(node) for node in found], indent=1, ensure_ascii=False))
    elif name is not None and len(found) == 1:
        here.console.say_all(nodehelp.as_text(found[0]))
    else:
        here.console.table([(node.id, node.summary) for node in found])
    return 0


def _matches(node: Node[..., Any], word: str) -> bool:
    """Say whether a node's id, title, category or first line holds a word, whatever its case."""
    return word.lower() in "\n".join([node.id, node.title, node.category, node.summary]).lower()


def types(context: typer.Context) -> int:
    """List the port types, what may travel on a link, and the file formats they can be read from and written to."""
    from nodegraph import porttypes
    from nodegraph.plugins import registry

    here = session(context)
    registry().activate_all()
    rows = []
    for name, cls in porttypes.all_types():
        bases = [porttypes.describe(base) for base in cls.__mro__[1:] if _is_base(base, cls)]
        rows.append((name, bases[0] if bases else "", porttypes.summary(cls)))
    here.console.table([("type", "is a", "what it is"), *rows])
    if formats := _formats():
        here.console.say()
        here.console.table([("type", "format", "is read from", "is written to", "plugin"), *formats])
    return 0


def _formats() -> list[tuple[str, ...]]:
    """Return a row for each file format: those of a type together, with the suffixes that are really its own."""
    from nodegraph import porttypes
    from nodegraph.plugins import registry

    known = registry().formats()
    rows: list[tuple[str, ...]] = []
    for item, plugin in sorted(known, key=lambda entry: porttypes.describe(entry[0].type)):
        reads, writes = (
            " ".join([suffix or "(any other)" for suffix in known.suffixes(item, use)]) for use in ("read", "write")
        )
        if reads or writes:
            rows.append((porttypes.describe(item.type), item.title, reads, writes, plugin))
    return rows


def _is_base(base: type, cls: type) -> bool:
    from nodegraph.porttypes import accepts, is_port_type

    return is_port_type(base) and accepts(base, cls)


def plugins(context: typer.Context) -> int:
    """List the installed plugins and what they bring.

    A broken one says why it is left out.
    """
    from nodegraph.plugins import registry

    here = session(context)
    known = registry()
    known.activate_all()
    rows = []
    for plugin in known.plugins.values():
        families = []
        for family in plugin.families:
            number = sum(node.family == family.name for node in known.nodes())
            families.append(f"{family.name} ({text.count(number, 'node')})")
        about = f"left out: {plugin.error}" if plugin.error else ", ".join(families)
        place = inspect.getsourcefile(plugin.module) if plugin.module is not None else None
        rows.append((plugin.name, plugin.version, about, place or ""))
    if not rows:
        here.console.say("no plugins are installed")
    else:
        here.console.table([("plugin", "version", "brings", "from"), *rows])
    return 0


def devices(context: typer.Context) -> int:
    """List the OpenCL devices, and which one 'auto' takes."""
    from nodegraph.opencl import choose, list_devices
    from nodegraph.plan import human_bytes

    here = session(context)
    found = list_devices()
    if not found:
        here.console.say("no OpenCL devices: nodes run without one")
        return 0
    chosen = choose("auto")
    rows = []
    for info in found:
        mark = "auto" if chosen is not None and chosen.info.id == info.id else ""
        units = text.count(info.compute_units, "unit")
        rows.append((info.id, info.kind, info.name, units, human_bytes(info.memory), mark, info.platform))
    here.console.table([("id", "kind", "name", "compute", "memory", "", "platform"), *rows])
    return 0


def schema(context: typer.Context) -> int:
    """Print the JSON Schema of graph files.

    It knows the parameters of every installed node.  Save it, and let an editor check and complete graph files with it
    by starting them with "$schema": "schema.json".
    """
    from nodegraph.schema import graph_schema

    session(context).console.say(json.dumps(graph_schema(), indent=1, ensure_ascii=False))
    return 0
