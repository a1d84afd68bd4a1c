"""The graph file's format: what keys it has and what they hold, as pydantic models.

The models check the form of a document and give its JSON Schema; the document itself stays the plain data it was read
as (see `nodegraph.graph`), so nothing an author wrote is lost or reordered.
"""

from __future__ import annotations

import re
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from nodegraph.errors import Problem, nearest

FORMAT = "nodegraph/1"
_FORMAT_NAME, _FORMAT_VERSION = "nodegraph", 1
NODE_ID = re.compile(r"[\w-]+\Z")


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class NodeModel(BaseModel):
    """One node: its type, its parameters where they differ from the defaults, and what its inputs are linked to."""

    model_config = ConfigDict(extra="allow", strict=True)

    type: str = Field(description="The node's type id, 'family.name', or 'graph' for another graph file.")
    version: int | None = Field(None, ge=1, description="The version of the node type that the record was saved with.")
    params: dict[str, Any] = Field({}, description="Parameters by name; defaults are left out.")
    inputs: dict[str, str | list[str]] = Field({}, description="Links by port: 'node', 'node.port', or a list of them.")
    note: str = Field("", description="A remark for readers.")


class ExposedParameter(_Strict):
    """A parameter of the whole graph, which drives parameters of its nodes."""

    default: Any = Field(None, description="The value until another is set; without it the nodes keep their own.")
    drives: list[str] = Field(min_length=1, description="The parameters it sets, as 'node.parameter'.")
    note: str = ""


class ExposedInput(_Strict):
    """An input of the whole graph, for when it is a node of another graph."""

    type: str = Field(description="The name of a port type.")
    feeds: list[str] = Field(min_length=1, description="The ports it is linked to, as 'node.port'.")
    note: str = ""


class Document(_Strict):
    """A whole graph file."""

    json_schema: str = Field("", alias="$schema", description="Where an editor finds the schema.")
    format: str = Field(description=f"'{FORMAT}'.")
    title: str = ""
    note: str = Field("", description="A remark for readers.")
    requires: dict[str, str] = Field({}, description="Plugins the graph needs, with version specifiers ('>=0.1').")
    parameters: dict[str, ExposedParameter] = Field({}, description="Parameters of the whole graph.")
    inputs: dict[str, ExposedInput] = Field({}, description="Inputs of the whole graph.")
    outputs: dict[str, str] = Field({}, description="Outputs of the whole graph, each 'node' or 'node.port'.")
    nodes: dict[str, NodeModel] = Field(description="The nodes by id.")
    layout: dict[str, Any] = Field({}, description="Where a graphical editor draws the nodes; never affects results.")


def check_form(data: Any, where: str) -> list[Problem]:
    """Return what is wrong with the form of a document, ignoring what its node types mean."""
    if not isinstance(data, dict):
        return [Problem(where, f"a graph is a JSON object, not {_kind(data)}")]
    if problem := _check_format(data.get("format"), where):
        return [problem]
    try:
        Document.model_validate(data)
    except ValidationError as error:
        return list(dict.fromkeys(_explain(item, where) for item in error.errors(include_url=False)))
    if not data["nodes"]:
        return [Problem(where, "the graph has no nodes; add at least one under 'nodes'")]
    return [
        Problem(where, f"node id '{name}' may hold only letters, digits, '_' and '-'")
        for name in data["nodes"]
        if not NODE_ID.match(name)
    ]


def _check_format(given: Any, where: str) -> Problem | None:
    if given is None:
        return Problem(where, f'\'format\' is missing; a graph file says "format": "{FORMAT}"')
    match = re.fullmatch(rf"{_FORMAT_NAME}/(\d{{1,9}})", given) if isinstance(given, str) else None
    if match is None:
        return Problem(where, f"format {given!r} is not a nodegraph format; expected '{FORMAT}'")
    if int(match[1]) > _FORMAT_VERSION:
        return Problem(where, f"format '{given}' is newer than this program reads ('{FORMAT}'); upgrade nodegraph")
    if int(match[1]) < _FORMAT_VERSION:
        return Problem(where, f"format '{given}' never existed; expected '{FORMAT}'")
    return None


def _explain(item: Any, where: str) -> Problem:
    path = [str(part) for part in item["loc"]]
    place = where
    if path[:1] == ["nodes"] and len(path) > 1:
        place, path = f"{where}: node '{path[1]}'", path[2:]
        if path[:1] == ["inputs"] and len(path) > 2:
            return Problem(place, f"'inputs.{path[1]}' should be 'node', 'node.port' or a list of these")
    name = ".".join(path)
    if item["type"] == "extra_forbidden":
        levels: dict[str, type[BaseModel]] = {"parameters": ExposedParameter, "inputs": ExposedInput}
        level = levels.get(path[0], Document) if len(path) > 1 else Document
        known = [field.alias or key for key, field in level.model_fields.items()]
        return Problem(place, f"unknown key '{name}'; {nearest(path[-1], known)}")
    if item["type"] == "missing":
        return Problem(place, f"'{name}' is missing")
    if not path:
        return Problem(place, f"must be a JSON object, not {_kind(item['input'])}")
    message = item["msg"].replace("Input should", "should", 1)
    message = message.replace("a valid dictionary", "an object").replace("a valid i", "an i").replace("a valid", "a")
    return Problem(place, f"'{name}' {message[:1].lower()}{message[1:]}, not {_kind(item['input'])}")


def _kind(data: Any) -> str:
    names = {dict: "an object", list: "a list", str: "a string", bool: "true or false", type(None): "null"}
    return names.get(type(data), "a number")
