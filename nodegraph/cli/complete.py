"""What the shell offers when a person presses Tab.

Each function takes the context with what was typed before, and the beginning of the word; whatever goes wrong offers
nothing, since a shell has no place for an error.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import typer


def complete_graphs(incomplete: str) -> list[str]:
    """Offer JSON files and folders."""
    folder, _, start = incomplete.rpartition("/")
    base = Path(folder or ("/" if incomplete.startswith("/") else "."))
    lead = f"{folder}/" if folder or incomplete.startswith("/") else ""
    found = []
    with suppress(OSError):
        for path in sorted(base.iterdir()):
            if path.name.startswith(start) and not (path.name.startswith(".") and not start):
                if path.is_dir():
                    found.append(f"{lead}{path.name}/")
                elif path.suffix == ".json":
                    found.append(f"{lead}{path.name}")
    return found


def complete_nodes(context: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    """Offer the node ids of the graph, with their types."""
    return [(id, kind) for id, kind in _records(context) if id.startswith(incomplete)]


def complete_set(context: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    """Offer exposed parameters, and the parameters of a node once its id is there."""
    id, dot, _ = incomplete.partition(".")
    if "=" in incomplete:
        return []
    if not dot:
        parameters = _document(context).get("parameters")
        exposed = [(f"{name}=", "exposed parameter") for name in (parameters if isinstance(parameters, dict) else ())]
        nodes = [(f"{name}.", kind) for name, kind in _records(context)]
        return [item for item in [*exposed, *nodes] if item[0].startswith(incomplete)]
    found: list[tuple[str, str]] = []
    with suppress(Exception):
        from nodegraph.plugins import registry

        node = registry().find(dict(_records(context))[id])
        fields = node.parameters.fields.values() if node else ()
        found = [(f"{id}.{field.name}=", field.param.description) for field in fields]
    return [item for item in found if item[0].startswith(incomplete)]


def complete_types(incomplete: str) -> list[tuple[str, str]]:
    """Offer node types."""
    found: list[tuple[str, str]] = []
    with suppress(Exception):
        from nodegraph.plugins import registry

        found = [(node.id, node.summary) for node in registry().nodes() if node.id.startswith(incomplete)]
    return found


def _records(context: typer.Context) -> Iterator[tuple[str, str]]:
    for id, record in _document(context).get("nodes", {}).items():
        yield id, str(record.get("type", "")) if isinstance(record, dict) else ""


def _document(context: typer.Context) -> dict[str, Any]:
    # The engine would refuse a graph that is half-written, and takes longer to load than a person waits for a key.
    # An option that still waits for its value leaves the graph among the arguments that are not sorted out.
    for path in [context.params.get("graph", ""), *context.args]:
        with suppress(OSError, ValueError, RecursionError):
            data = json.loads(Path(path or "").read_bytes())
            if isinstance(data, dict) and isinstance(data.get("nodes"), dict):
                return data
    return {}
