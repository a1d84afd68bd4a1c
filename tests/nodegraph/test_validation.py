"""Validation: everything wrong is listed at once, in a sentence that names the place and what would be right."""

from __future__ import annotations

import json
from typing import Any

import pytest

from nodegraph import Graph, GraphError, node
from nodegraph.errors import PluginError
from tests.nodegraph import support as toy


def problems(nodes: dict[str, Any], **sections: Any) -> list[str]:
    graph = Graph.from_json(
        json.dumps({"format": "nodegraph/1", "nodes": nodes, **sections}), registry=toy.toy_registry()
    )
    with pytest.raises(GraphError) as caught:
        graph.validate()
    assert caught.value.exit_status == 2
    return [str(problem) for problem in caught.value.problems]


A = {"type": "toy.number"}


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ({"type": "toy.nmber"}, "node 'n': unknown node type 'toy.nmber'; did you mean 'toy.number'?"),
        (
            {"type": "acme.x"},
            "unknown node type 'acme.x': install the plugin that brings the family 'acme' (valid names: 'toy')",
        ),
        (
            {"type": ""},
            "node 'n': unknown node type '': install the plugin that brings the family '' (valid names: 'toy')",
        ),
        ({"type": "toy.number", "params": {"valeu": 1}}, "node 'n': unknown parameter 'valeu'; did you mean 'value'?"),
        (
            {"type": "toy.number", "params": {"value": "x"}},
            "node 'n': parameter 'value': should be a valid number, got \"x\"",
        ),
        (
            {"type": "toy.number", "params": {"value": None}},
            "node 'n': parameter 'value': should be a valid number, got null",
        ),
        (
            {"type": "toy.number", "params": {"value": True}},
            "node 'n': parameter 'value': should be a valid number, got true",
        ),
        ({"type": "toy.number", "params": {"tag": 3}}, "node 'n': parameter 'tag': should be a valid string, got 3"),
        (
            {"type": "toy.increase", "inputs": {"x": "a"}, "params": {"by": -1}},
            "node 'n': parameter 'by': should be greater than or equal to 0, got -1",
        ),
        (
            {"type": "toy.increase", "inputs": {"x": "a"}, "params": {"by": 10**400}},
            "node 'n': parameter 'by': should be a finite number, got 1000",
        ),
        ({"type": "toy.increase"}, "node 'n': input 'x': is not linked; it needs a Number"),
        ({"type": "toy.increase", "inputs": {"x": []}}, "node 'n': input 'x': is not linked; it needs a Number"),
        ({"type": "toy.steepness"}, "node 'n': input 'height': is not linked; it needs a Height"),
        ({"type": "toy.increase", "inputs": {"x": "a", "y": "a"}}, "node 'n': unknown input 'y'; valid names: 'x'"),
        (
            {"type": "toy.increase", "inputs": {"x": "aa"}},
            "node 'n': input 'x': links to 'aa', but there is no node 'aa'; did you mean 'a'?",
        ),
        ({"type": "toy.increase", "inputs": {"x": ""}}, "node 'n': input 'x': links to '', but there is no node ''"),
        (
            {"type": "toy.increase", "inputs": {"x": "a.otu"}},
            "node 'n': input 'x': node 'a' has no output 'otu'; did you mean 'out'?",
        ),
        ({"type": "toy.increase", "inputs": {"x": ["a", "a"]}}, "node 'n': input 'x': takes one link, 2 are given"),
        (
            {"type": "toy.steepness", "inputs": {"height": "a"}},
            "node 'n': input 'height': takes a Height, but 'a.out' gives a Number",
        ),
        (
            {"type": "toy.steepness", "inputs": {"height": "n"}},
            "the links form a cycle: n -> n; remove one of them",
        ),
        (
            {"type": "toy.number", "version": 9},
            "node 'n': saved with version 9 of toy.number, version 1 is installed; upgrade the plugin",
        ),
        ({"type": "toy.number", "parms": {}}, "node 'n': unknown key 'parms'; did you mean 'params'?"),
        ({"type": "graph"}, "node 'n': parameter 'path' is missing: the graph file, relative to this one"),
        (
            {"type": "graph", "params": {"path": "absent.json"}},
            "absent.json: cannot be read (No such file or directory)",
        ),
        ({"type": "graph", "params": {"path": "a\0b"}}, "cannot be read"),
        ({"type": "graph", "params": {"path": "~nobody-of-this-name/g.json"}}, "cannot be read"),
        ({"type": "graph", "params": {"path": "x" * 5000}}, "cannot be read (File name too long)"),
        ({"type": "graph", "params": {"path": "."}}, "cannot be read (Is a directory)"),
        (
            {"type": "toy.export", "inputs": {"x": "a"}, "params": {"name": "../x"}},
            "node 'n': parameter 'name': '../x' is no file name inside the output folder",
        ),
    ],
)
def test_one_wrong_node(record: dict[str, Any], message: str, in_tmp: Any) -> None:
    found = problems({"a": A, "n": record})
    assert len(found) == 1, found
    assert message in found[0]
    assert "\n" not in found[0]


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"parameters": {"p": {"drives": ["b.x"]}}}, "parameter 'p': drives 'b.x', which does not exist"),
        ({"parameters": {"p": {"drives": ["a"]}}}, "write it as 'node.parameter'"),
        ({"parameters": {"p": {"drives": ["a.valeu"]}}}, "unknown parameter 'valeu'; did you mean 'value'?"),
        (
            {"parameters": {"p": {"drives": ["a.valeu"], "default": 1}}},
            "unknown parameter 'valeu'; did you mean 'value'?",
        ),
        ({"parameters": {"p": {"drives": ["a.value"], "default": "x"}}}, "parameter 'value': should be a valid number"),
        ({"inputs": {"i": {"type": "Number", "feeds": ["b.x"]}}}, "input 'i': feeds 'b.x', which does not exist"),
        ({"inputs": {"i": {"type": "Number", "feeds": ["n.y"]}}}, "input 'i': feeds 'n.y'"),
        ({"inputs": {"i": {"type": "Nmber", "feeds": ["n.x"]}}}, "unknown port type 'Nmber'; did you mean 'Number'?"),
        ({"outputs": {"o": "b"}}, "output 'o': links to 'b', but there is no node 'b'"),
        ({"outputs": {"o": "a.x"}}, "output 'o': node 'a' has no output 'x'"),
        ({"requires": {"acme": ">=1"}}, "requires 'acme': the plugin is not installed; install a version >=1"),
        ({"requires": {"acme": "new"}}, "requires 'acme': 'new' is no version specifier; write it like '>=0.1'"),
    ],
)
def test_one_wrong_section(sections: dict[str, Any], message: str) -> None:
    found = problems({"a": A, "n": {"type": "toy.increase", "inputs": {"x": "a"}}}, **sections)
    assert len(found) == 1, found
    assert message in found[0]


def test_everything_is_listed_at_once() -> None:
    found = problems(
        {
            "a": {"type": "toy.nmber"},
            "b": {"type": "toy.number", "params": {"value": "x", "tga": "", "tag": 3}},
            "c": {"type": "toy.increase", "inputs": {"x": "zzz", "why": "a"}},
            "d": {"type": "toy.increase"},
            "e": {"type": "toy.increase", "inputs": {"x": "a"}, "params": {"by": -1}},
        },
        outputs={"o": "nowhere"},
        requires={"acme": ">=1"},
    )
    assert len(found) == 10
    assert len(set(found)) == 10


def test_problems_come_node_by_node_in_the_order_of_the_file() -> None:
    found = problems(
        {
            "a": {"type": "toy.increase", "params": {"by": -1}, "inputs": {"x": "gone"}},
            "b": {"type": "toy.increase", "params": {"by": -2}, "inputs": {"x": "gone"}},
        }
    )
    assert [item.split("node '")[1][0] for item in found] == ["a", "a", "b", "b"]


def test_types_are_checked_on_every_link() -> None:
    found = problems(
        {
            "h": {"type": "toy.height"},
            "c": {"type": "toy.cover"},
            "x": {"type": "toy.steepness", "inputs": {"height": "c"}},
            "y": {"type": "toy.add", "inputs": {"terms": ["h", "x", "c"]}},
        }
    )
    assert found == [
        "graph: node 'x': input 'height': takes a Height, but 'c.out' gives a Cover",
        "graph: node 'y': input 'terms': takes a Number, but 'h.out' gives a Height",
        "graph: node 'y': input 'terms': takes a Number, but 'c.out' gives a Cover",
    ]


def test_a_cycle_names_its_nodes_and_no_others() -> None:
    found = problems(
        {
            "a": A,
            "p": {"type": "toy.add", "inputs": {"terms": ["a", "r"]}},
            "q": {"type": "toy.increase", "inputs": {"x": "p"}},
            "r": {"type": "toy.increase", "inputs": {"x": "q"}},
            "after": {"type": "toy.increase", "inputs": {"x": "r"}},
        }
    )
    assert len(found) == 1
    names = found[0].split("cycle: ")[1].split(";")[0].split(" -> ")
    assert sorted(names[:-1]) == ["p", "q", "r"]
    assert names[0] == names[-1]


def test_a_long_cycle_is_shown_in_part() -> None:
    count = 10_000
    nodes = {f"n{k}": {"type": "toy.increase", "inputs": {"x": f"n{(k - 1) % count}"}} for k in range(count)}
    (found,) = problems(nodes)
    assert " -> ... -> " in found
    assert len(found) < 300


def test_a_chain_of_ten_thousand_nodes_is_valid() -> None:
    nodes: dict[str, Any] = {"n0": A}
    for k in range(1, 10_000):
        nodes[f"n{k}"] = {"type": "toy.increase", "inputs": {"x": f"n{k - 1}"}}
    text = json.dumps({"format": "nodegraph/1", "nodes": dict(reversed(nodes.items()))})
    graph = Graph.from_json(text, registry=toy.toy_registry())
    network = graph.network()
    assert [step.id for step in network.steps[:3]] == ["n0", "n1", "n2"]
    assert len(network.steps) == 10_000


def test_requirements_are_compared_with_what_is_installed() -> None:
    registry = toy.toy_registry()
    registry.add(toy.plugin("acme", version="1.4"))
    registry.add(toy.plugin("odd", version="no version"))
    for wanted, fits in ((">=1.0", True), ("==1.4", True), (">=2", False), ("<1.4", False), ("", True)):
        document = {"format": "nodegraph/1", "requires": {"acme": wanted, "odd": ">=1"}, "nodes": {"a": A}}
        graph = Graph.from_json(json.dumps(document), registry=registry)
        if fits:
            graph.validate()
        else:
            with pytest.raises(GraphError, match=r"version 1.4 is installed, the graph needs"):
                graph.validate()


def test_an_unlinked_optional_or_variadic_input_is_fine() -> None:
    graph = toy.toy_graph()
    graph.add("toy.add", "nothing")
    graph.add("toy.maybe", x=graph.add("toy.number"))
    graph.validate()


def test_a_badly_declared_node_is_a_problem_of_the_graphs_that_use_it() -> None:
    @node(version=1)
    def bad(x) -> float:  # type: ignore[no-untyped-def]
        """Lack an annotation."""
        return 1.0

    registry = toy.toy_registry(bad)
    fine = Graph.from_json(json.dumps({"format": "nodegraph/1", "nodes": {"a": A}}), registry=registry)
    fine.validate()
    nodes = {"a": A, "b": {"type": "toy.bad", "inputs": {"x": "a"}}, "c": {"type": "toy.increase"}}
    uses = Graph.from_json(json.dumps({"format": "nodegraph/1", "nodes": nodes}), registry=registry)
    with pytest.raises(GraphError) as caught:
        uses.validate()
    found = [str(problem) for problem in caught.value.problems]
    assert len(found) == 2
    assert "parameter 'x' needs a type annotation" in found[0]
    with pytest.raises(PluginError, match="needs a type annotation"):
        bad.inputs  # noqa: B018 - asking is the point
