"""The JSON Schema of graph files, as an editor uses it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import pydantic
import pytest
from jsonschema import Draft202012Validator

from nodegraph import Graph, InputPath, Param, node
from nodegraph.plugins import Registry
from nodegraph.schema import graph_schema


class Stop(pydantic.BaseModel):
    """A colour at a height."""

    height: float
    colour: str = "red"


@node(version=2)
def paint(
    x: float,
    *rest: float,
    stops: list[Stop],
    size: Annotated[int, Param("How large.", ge=1, lt=9, unit="m")] = 3,
    mode: Literal["a", "b"] = "a",
    box: tuple[float, float] | None = None,
    path: InputPath = Path("x"),
) -> float:
    """Paint something."""
    return x


@node(version=1)
def one() -> float:
    """Give one."""
    return 1.0


@pytest.fixture(scope="module")
def registry() -> Registry:
    found = Registry()
    for item in (paint, one):
        item.family = "sch"
        found.register(item, "sch")
    return found


@pytest.fixture(scope="module")
def validator(registry: Registry) -> Draft202012Validator:
    schema = graph_schema(registry)
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


def document(params: dict | None = None, inputs: dict | None = None, **record) -> dict:
    return {
        "format": "nodegraph/1",
        "nodes": {
            "o": {"type": "sch.one"},
            "p": {"type": "sch.paint", "params": params or {}, "inputs": inputs or {}, **record},
        },
    }


@pytest.mark.parametrize(
    "data",
    [
        document(),
        document({"stops": [{"height": 1.0}], "size": 8, "mode": "b", "box": [1, 2], "path": "y"}),
        document({"box": None}, {"x": "o", "rest": ["o", "o.out"]}),
        document({}, {"rest": "o"}, note="words", version=1),
        {"format": "nodegraph/1", "nodes": {"a": {"type": "gone.thing", "params": {"any": 1}, "odd": 2}}},
        {"format": "nodegraph/1", "nodes": {"g": {"type": "graph", "params": {"path": "other.json"}}}},
        {**document(), "$schema": "schema.json", "layout": {"p": [0, 1]}, "title": "t", "requires": {"x": ">=1"}},
        {**document(), "parameters": {"k": {"default": 1, "drives": ["p.size"]}}, "outputs": {"o": "p"}},
        {**document(), "inputs": {"i": {"type": "Number", "feeds": ["p.x"]}}},
    ],
)
def test_right_documents_pass(validator, data):
    assert [error.message for error in validator.iter_errors(data)] == []


@pytest.mark.parametrize(
    ("data", "place"),
    [
        (document({"size": 9}), "$.nodes.p.params.size"),
        (document({"size": 0}), "$.nodes.p.params.size"),
        (document({"size": "3"}), "$.nodes.p.params.size"),
        (document({"mode": "c"}), "$.nodes.p.params.mode"),
        (document({"siez": 3}), "$.nodes.p.params"),
        (document({"stops": [{"colour": "x"}]}), "$.nodes.p.params.stops[0]"),
        (document({}, {"y": "o"}), "$.nodes.p.inputs"),
        (document({}, {"x": ["o", "o"]}), "$.nodes.p.inputs.x"),
        (document(version=3), "$.nodes.p.version"),
        (document(parms={}), "$.nodes.p"),
        ({"format": "nodegraph/1", "nodes": {"a": {"type": "sch.pant"}}}, "$.nodes.a.type"),
        ({"format": "nodegraph/1", "nodes": {"a": {"type": "nothing"}}}, "$.nodes.a.type"),
        ({"format": "nodegraph/2", "nodes": {}}, "$.format"),
        ({"format": "nodegraph/1", "nodes": {}, "node": {}}, "$"),
        ({**document(), "inputs": {"i": {"type": "Numbr", "feeds": ["p.x"]}}}, "$.inputs.i.type"),
    ],
)
def test_wrong_documents_do_not(validator, data, place):
    assert place in {error.json_path for error in validator.iter_errors(data)}


def test_editors_find_what_they_complete_with(registry):
    schema = graph_schema(registry)
    record = schema["$defs"]["NodeModel"]
    offered = {item["const"]: item["description"] for item in record["properties"]["type"]["anyOf"] if "const" in item}
    assert offered["sch.paint"] == "Paint something."
    (rule,) = [item for item in record["allOf"] if item["if"]["properties"]["type"]["const"] == "sch.paint"]
    size = rule["then"]["properties"]["params"]["properties"]["size"]
    assert size["description"] == "How large."
    assert size["default"] == 3
    assert size["unit"] == "m"
    assert "sch.paint:Stop" in schema["$defs"]


def test_a_built_graph_conforms(registry, validator):
    graph = Graph("built", registry=registry)
    first = graph.add("sch.one")
    graph.add("sch.paint", x=first, stops=[{"height": 3.0}], size=2)
    graph.validate()
    assert list(validator.iter_errors(graph.data)) == []


def test_without_any_plugin():
    validator = Draft202012Validator(graph_schema(Registry()))
    data = {"format": "nodegraph/1", "nodes": {"a": {"type": "any.thing"}}}
    assert list(validator.iter_errors(data)) == []
