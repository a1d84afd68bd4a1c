"""Commands about graph files: validate, show, upgrade, preview."""

from __future__ import annotations

import difflib
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from nodegraph.cli import text
from nodegraph.cli.complete import complete_nodes
from nodegraph.cli.options import (
    CacheDir,
    DeviceName,
    GraphFile,
    NoCache,
    Request,
    Settings,
    Traceback,
)
from nodegraph.cli.session import session
from nodegraph.errors import GraphError, RunError


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    for command in (validate, show, preview, upgrade):
        app.command()(command)


class Format(StrEnum):
    """How a graph is drawn."""

    text = "text"
    mermaid = "mermaid"
    dot = "dot"


def validate(context: typer.Context, graph: GraphFile, settings: Settings = None, traceback: Traceback = False) -> int:
    """Check a graph file and list all that is wrong with it."""
    here = session(context, tracebacks=traceback)
    request = Request(graph, settings=settings)
    loaded = request.graph()
    network = loaded.network(request.overrides())
    inside = f" ({text.count(len(network.steps), 'step')} with subgraphs and conversions)"
    here.console.say(
        f"{loaded.name}: valid, {text.count(len(loaded), 'node')}{inside if len(network.steps) != len(loaded) else ''}"
    )
    return 0


def show(
    context: typer.Context,
    graph: GraphFile,
    format: Annotated[Format, typer.Option("--format", help="How to draw it.")] = Format.text,
    traceback: Traceback = False,
) -> int:
    """Draw a graph as text or as a diagram.

    Graphs that cannot run are drawn, too.
    """
    from nodegraph.cli import drawing

    here = session(context, tracebacks=traceback)
    loaded = Request(graph).graph()
    here.console.say_all(getattr(drawing, f"as_{format.value}")(loaded))
    return 0


def preview(
    context: typer.Context,
    graph: GraphFile,
    node: Annotated[
        str,
        typer.Argument(metavar="NODE[.PORT]", help="The output to draw.", autocompletion=complete_nodes),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.png", help="The picture to write.")],
    settings: Settings = None,
    cache_dir: CacheDir = None,
    no_cache: NoCache = False,
    device: DeviceName = "auto",
    traceback: Traceback = False,
) -> int:
    """Draw what a node gives as a PNG picture.

    It is computed where it is not known.
    """
    from nodegraph.atomic import write_atomically
    from nodegraph.plugins import registry
    from nodegraph.porttypes import describe
    from nodegraph.run import run_graph

    here = session(context, tracebacks=traceback)
    request = Request(graph, [node], settings, None, cache_dir, no_cache, device=device)
    loaded = request.graph()
    network = loaded.network(request.overrides())
    index, port = network.find(node)
    kind = network.steps[index].types[port]
    drawn = registry().preview(kind)
    if drawn is None:
        raise GraphError(f"node '{node}' gives {describe(kind)}, which no installed plugin draws", loaded.name)
    try:
        value = run_graph(loaded, **request.options())[node]
    except RunError as failed:
        for error in failed.result.errors:
            here.console.report(error, loaded.name)
        return 1
    # A value may be of a more special type than its port says, with a picture of its own.
    drawn = registry().preview(type(value)) or drawn
    write_atomically(output, drawn.render(value))
    here.console.say(f"wrote {output}")
    return 0


def upgrade(
    context: typer.Context,
    graph: GraphFile,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show the change, write nothing.")] = False,
    traceback: Traceback = False,
) -> int:
    """Bring a graph file up to date with the plugins.

    Applies what the plugins say has changed in their nodes, shows the difference and writes the file.
    """
    here = session(context, tracebacks=traceback)
    loaded = Request(graph).graph()
    upgraded = loaded.upgraded()
    before, after = loaded.to_json(), upgraded.to_json()
    if before == after:
        here.console.say(f"{loaded.name} is up to date")
        return 0
    colour = text.coloured(sys.stdout)
    styles = {"+": "computed", "-": "failed", "@": "cached"}
    lines = difflib.unified_diff(before.splitlines(), after.splitlines(), str(graph), str(graph), lineterm="")
    here.console.say_all([text.paint(line, styles.get(line[:1], ""), colour) for line in lines])
    if not dry_run:
        upgraded.save()
        here.console.say(f"wrote {graph}")
    return 0
