"""Everything about one node type, as text for a person and as data for a program.

All of it comes from the declaration: signature, `Param`s and docstring.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from typing import Any

from nodegraph.cli.text import columns
from nodegraph.nodetypes import Locality, Node
from nodegraph.parameters import Field, Param
from nodegraph.porttypes import describe

_LONGEST_DEFAULT = 60


def as_text(node: Node[..., Any]) -> list[str]:
    """Return the help of a node as lines."""
    lines = [f"{node.id}  {node.title}, version {node.version}", "", *node.help.splitlines(), ""]
    lines += _section("Inputs", [(port.name, _input(port)) for port in node.inputs])
    lines += _section("Outputs", [(port.name, describe(port.type) + _generic(port)) for port in node.outputs])
    properties, definitions = _properties(node)
    rows: list[tuple[str, ...]] = []
    for name, field in node.parameters.fields.items():
        kind = " ".join(filter(None, [type_text(properties[name], definitions, field), range_text(field.param)]))
        unit = f" {field.param.unit}" if field.param.unit else ""
        default = "required" if field.required else f"default {_short(properties[name].get('default'))}"
        rows.append((name, f"{kind}{unit}; {default}" + (f".  {text}" if (text := field.param.description) else "")))
    lines += _section("Parameters", rows)
    if node.twin is not None:
        lines.append(f"Has an OpenCL twin that agrees to {node.twin.rtol:g} of the range of values.")
    if node.locality is not None:
        lines.append(f"Looks at {_locality(node.locality)}.")
    return lines[: -1 if not lines[-1] else None]


def as_data(node: Node[..., Any]) -> dict[str, Any]:
    """Return all about a node as JSON data."""
    return {
        "id": node.id,
        "title": node.title,
        "version": node.version,
        "category": node.category,
        "summary": node.summary,
        "help": node.help,
        "inputs": [
            {
                "name": port.name,
                "type": describe(port.type),
                "optional": port.optional or port.variadic,
                "variadic": port.variadic,
            }
            for port in node.inputs
        ],
        "outputs": [{"name": port.name, "type": describe(port.type)} for port in node.outputs],
        "parameters": node.parameters.json_schema(),
        "opencl": node.twin is not None,
        "locality": node.locality.kind if node.locality is not None else None,
    }


def range_text(param: Param) -> str:
    """Return the bounds of a parameter.

    >>> range_text(Param(ge=0, lt=1)), range_text(Param(ge=0, le=1)), range_text(Param(gt=2)), range_text(Param())
    ('>= 0 and < 1', '0 to 1', '> 2', '')
    """
    if param.ge is not None and param.le is not None and param.gt is None and param.lt is None:
        return f"{param.ge:g} to {param.le:g}"
    signs = ((">=", param.ge), (">", param.gt), ("<=", param.le), ("<", param.lt))
    lengths = ((">=", param.min_length), ("<=", param.max_length))
    bounds = [f"{sign} {bound:g}" for sign, bound in signs if bound is not None]
    return " and ".join(bounds + [f"length {sign} {bound}" for sign, bound in lengths if bound is not None])


def type_text(schema: Any, definitions: dict[str, Any], field: Field | None = None) -> str:
    """Return the type that a JSON Schema describes, in words.

    >>> type_text({"type": "array", "items": {"type": "number"}}, {})
    'list of number'
    >>> type_text({"enum": ["a", "b"]}, {})
    '"a" or "b"'
    """
    if field is not None and field.input_file is not None:
        return "list of files to read" if schema.get("type") == "array" else "file to read"
    if field is not None and field.output_file is not None:
        return "name of a file to write"
    if "$ref" in schema:
        return type_text(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "const" in schema:
        return json.dumps(schema["const"])
    if "enum" in schema:
        return " or ".join(json.dumps(item, ensure_ascii=False) for item in schema["enum"])
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return " or ".join(dict.fromkeys(type_text(item, definitions) for item in schema[key]))
    if schema.get("type") == "array":
        if "prefixItems" in schema:
            return "[" + ", ".join(type_text(item, definitions) for item in schema["prefixItems"]) + "]"
        return f"list of {type_text(schema.get('items', {}), definitions)}"
    if schema.get("type") == "object" and schema.get("properties"):
        return "{" + ", ".join(f"{k}: {type_text(v, definitions)}" for k, v in schema["properties"].items()) + "}"
    kind = str(schema.get("type", "any value"))
    return {"string": "text", "boolean": "true or false"}.get(kind, kind)


def _properties(node: Node[..., Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    schema = node.parameters.json_schema()
    return schema.get("properties", {}), schema.get("$defs", {})


def _section(title: str, rows: list[tuple[str, ...]]) -> Iterator[str]:
    if rows:
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        yield title
        yield from columns(rows, indent=2, width=width)
        yield ""


def _input(port: Any) -> str:
    how = ", optional" if port.optional else ", any number" if port.variadic else ""
    return describe(port.type) + _generic(port) + how


def _generic(port: Any) -> str:
    return f" (same as every {port.variable})" if port.variable else ""


def _locality(locality: Locality) -> str:
    if locality.kind == "halo":
        return "a neighbourhood of each cell, as wide as its parameters say"
    return "each cell by itself" if locality.kind == "pointwise" else "the whole of its inputs for every cell"


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _LONGEST_DEFAULT else text[: _LONGEST_DEFAULT - 3] + "..."
