"""A graph as text, as a Mermaid diagram and in Graphviz's language.

Drawn from the document alone: whatever its nodes mean, and whether they are installed, does not matter.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from nodegraph.cli.text import columns
from nodegraph.graph import Graph, Ref

_LONGEST_VALUE = 40


def as_text(graph: Graph) -> list[str]:
    """Return a line for each node: id, type, parameters, and what its inputs are linked to."""
    head = f"{graph.title} ({graph.name})" if graph.title and graph.title != graph.name else graph.name
    rows = [(id, str(record["type"]), "  ".join(_facts(record))) for id, record in graph.nodes.items()]
    return [head, *columns(rows, indent=2)]


def as_mermaid(graph: Graph) -> list[str]:
    """Return a Mermaid flowchart (https://mermaid.js.org), which Markdown pages show as a picture."""
    names = {id: f"n{number}" for number, id in enumerate(graph.nodes)}
    lines = ["flowchart LR"]
    for id, record in graph.nodes.items():
        lines.append(f'  {names[id]}["{_mermaid(id)}<br/><small>{_mermaid(str(record["type"]))}</small>"]')
    for source, target, label in _links(graph):
        if source in names:
            lines.append(f'  {names[source]} -->|"{_mermaid(label)}"| {names[target]}')
    return lines


def as_dot(graph: Graph) -> list[str]:
    """Return a digraph for Graphviz (https://graphviz.org)."""
    lines = [f"digraph {_dot(graph.title or graph.name)} {{", "  rankdir=LR", "  node [shape=box, fontname=sans]"]
    for id, record in graph.nodes.items():
        lines.append(f"  {_dot(id)} [label={_dot(id, str(record['type']))}]")
    for source, target, label in _links(graph):
        if source in graph:
            lines.append(f"  {_dot(source)} -> {_dot(target)} [label={_dot(label)}]")
    return [*lines, "}"]


def _links(graph: Graph) -> Iterator[tuple[str, str, str]]:
    """Yield (source, target, label) of each link."""
    for id, record in graph.nodes.items():
        for port, links in record.get("inputs", {}).items():
            for link in [links] if isinstance(links, str) else links:
                source = Ref.parse(link)
                yield source.node, id, f"{source.port} > {port}" if source.port else port


def _facts(record: Mapping[str, Any]) -> Iterator[str]:
    for name, value in record.get("params", {}).items():
        text = json.dumps(value, ensure_ascii=False)
        yield f"{name}={text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + '...'}"
    for port, links in record.get("inputs", {}).items():
        yield f"{port} <- {links if isinstance(links, str) else ', '.join(links)}"


def _mermaid(text: str) -> str:
    escapes = {"&": "#amp;", '"': "#quot;", "<": "#lt;", ">": "#gt;", "#": "#35;"}
    return "".join(escapes.get(char, char) for char in text)


def _dot(*lines: str) -> str:
    return '"' + r"\n".join(line.replace("\\", r"\\").replace('"', r"\"") for line in lines) + '"'
