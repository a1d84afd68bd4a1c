"""The JSON Schema of graph files, with the parameters and ports of every installed node.

Editors check and complete graph files with it.  A node type that is not installed is allowed, since a file may be
written for another machine; an unknown type of an installed family is not.  Nothing is required of parameters and
inputs, since exposed ones of the whole graph may feed them: what is missing, validation says.
"""

from __future__ import annotations

import re
from typing import Any

from nodegraph.document import FORMAT, Document, NodeModel
from nodegraph.nodetypes import Node
from nodegraph.plugins import Registry, registry
from nodegraph.porttypes import all_types, describe

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def graph_schema(installed: Registry | None = None) -> dict[str, Any]:
    """Return the schema as JSON data.  By default of the nodes of every installed plugin."""
    nodes = (installed or registry()).nodes()
    schema = Document.model_json_schema(by_alias=True)
    definitions = schema.setdefault("$defs", {})
    schema = {"$schema": DIALECT, **schema, "title": "A nodegraph graph file"}
    schema["properties"]["format"]["const"] = FORMAT
    definitions["ExposedInput"]["properties"]["type"]["enum"] = [name for name, _ in all_types()]
    record = definitions["NodeModel"]
    record["properties"]["type"] = _type_names(nodes)
    record["allOf"] = [_only_for(node, definitions) for node in nodes]
    return schema


def _type_names(nodes: list[Node[..., Any]]) -> dict[str, Any]:
    families = "|".join(sorted({re.escape(node.family) for node in nodes}))
    named = [{"const": node.id, "title": node.title, "description": node.summary} for node in nodes]
    subgraph = {"const": "graph", "title": "Graph file", "description": "Another graph file as a node."}
    elsewhere = {
        "type": "string",
        "pattern": rf"^(?!(?:{families or '(?!)'})\.)\w+\.\w+$",
        "description": "A node of a plugin that is not installed here.",
    }
    return {"description": "The node's type id.", "anyOf": [*named, subgraph, elsewhere]}


def _only_for(node: Node[..., Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Return what holds for records of one node type."""
    return {
        "if": {"properties": {"type": {"const": node.id}}, "required": ["type"]},
        "then": {
            "propertyNames": {"enum": list(NodeModel.model_fields)},
            "properties": {
                "version": {"maximum": node.version},
                "params": _parameters(node, definitions),
                "inputs": _inputs(node),
            },
        },
    }


def _parameters(node: Node[..., Any], definitions: dict[str, Any]) -> dict[str, Any]:
    # Definitions of nested models move to the top, where references are looked up, under the node's name.
    schema = node.parameters.model.model_json_schema(ref_template=f"#/$defs/{node.id}:{{model}}")
    for name, definition in schema.pop("$defs", {}).items():
        definitions[f"{node.id}:{name}"] = definition
    schema.pop("required", None)
    return {**schema, "title": node.title, "additionalProperties": False}


def _inputs(node: Node[..., Any]) -> dict[str, Any]:
    properties: dict[str, Any] = {}
    for port in node.inputs:
        link: dict[str, Any] = {"type": "string"}
        if port.variadic:
            link = {"anyOf": [link, {"type": "array", "items": link}]}
        else:
            # One link in a list is the same link.
            link = {"anyOf": [link, {"type": "array", "items": link, "maxItems": 1}]}
        how = "; optional" if port.optional else "; any number of links" if port.variadic else ""
        properties[port.name] = {**link, "description": f"{describe(port.type)}{how}."}
    return {"type": "object", "properties": properties, "additionalProperties": False}
