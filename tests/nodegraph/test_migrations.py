"""Migrations: a graph file of an older version of a plugin means today what it meant then."""

from __future__ import annotations

import json
from typing import Any

import pytest

from nodegraph import Family, Graph, GraphError, Migration, node
from nodegraph.plugins import Registry
from tests.nodegraph import support as toy


@node(version=4)
def carve(surface: float, depth: float | None = None, *, width: float = 1.0, mode: str = "u") -> toy.Halves:
    """Carve: the node as it is today."""
    return toy.Halves(surface - (depth or 0.0), width)


@node(version=2)
def plain(x: float, *, level: float = 0.0) -> float:
    """Have a past, too."""
    return x + level


def metres(params: dict[str, Any]) -> dict[str, Any]:
    """Version 4 measures in metres what was in kilometres."""
    return {**params, **({"width": params["width"] * 1000} if "width" in params else {})}


MIGRATIONS = [
    Migration("old.dig", 2, new_type="new.dig", parameters={"w": "breadth"}),
    Migration(
        "new.dig",
        3,
        new_type="new.carve",
        parameters={"breadth": "width"},
        inputs={"ground": "surface", "d": "depth"},
        outputs={"out": "low", "rest": "high"},
    ),
    Migration("new.carve", 4, change=metres),
    Migration("new.plain", 2, parameters={"lvl": "level"}),
]


def registry(*migrations: Migration, order: int = 1) -> Registry:
    found = toy.toy_registry()
    for item in (carve, plain):
        item.family = "new"
    items = list(migrations or MIGRATIONS)[::order]
    found.add(toy.plugin("renamer", families=lambda: [Family("new", nodes=(carve, plain))], migrations=lambda: items))
    return found


def document(record: dict[str, Any], **sections: Any) -> dict[str, Any]:
    nodes = {"a": {"type": "toy.number", "params": {"value": 7}}, "n": {"inputs": {"ground": "a"}, **record}}
    return {"format": "nodegraph/1", **sections, "nodes": {**nodes, **sections.pop("nodes", {})}}


def load(data: dict[str, Any], **options: Any) -> Graph:
    return Graph.from_json(json.dumps(data), registry=registry(**options))


def migrated(data: dict[str, Any], **options: Any) -> dict[str, Any]:
    return load(data, **options).upgraded().data


@pytest.mark.parametrize("order", [1, -1])
def test_a_chain_from_the_first_version(order: int) -> None:
    data = document(
        {"type": "old.dig", "version": 1, "params": {"mode": "v", "w": 2}, "inputs": {"d": "a", "ground": "a"}},
        parameters={"wide": {"default": 3, "drives": ["n.w"]}},
        outputs={"result": "n.rest", "first": "n"},
    )
    data["nodes"]["after"] = {"type": "toy.add", "inputs": {"terms": ["n.out", "n", "n.rest", "a.out"]}}
    after = migrated(data, order=order)
    assert after["nodes"]["n"] == {
        "inputs": {"depth": "a", "surface": "a"},
        "type": "new.carve",
        "version": 4,
        "params": {"mode": "v", "width": 2000},
    } | {"type": "new.carve"}
    assert list(after["nodes"]["n"]["params"]) == ["mode", "width"], "the author's order stays"
    assert after["nodes"]["after"]["inputs"]["terms"] == ["n.low", "n", "n.high", "a.out"]
    assert after["parameters"] == {"wide": {"default": 3, "drives": ["n.width"]}}
    assert after["outputs"] == {"result": "n.high", "first": "n"}


@pytest.mark.parametrize(
    ("version", "type_id", "params", "expected"),
    [
        (1, "old.dig", {"w": 2}, {"width": 2000}),
        (2, "new.dig", {"breadth": 2}, {"width": 2000}),
        (3, "new.carve", {"width": 2}, {"width": 2000}),
        (4, "new.carve", {"width": 2}, {"width": 2}),
        (None, "old.dig", {"w": 2}, {"width": 2}),
        (None, "new.dig", {"breadth": 2}, {"width": 2}),
        (None, "new.carve", {"width": 2}, {"width": 2}),
    ],
)
def test_each_version_starts_where_it_stands(version: Any, type_id: str, params: Any, expected: Any) -> None:
    """A record without a version was written by hand: names migrate, meanings do not."""
    record: dict[str, Any] = {"type": type_id, "params": params, **({"version": version} if version else {})}
    record["inputs"] = {"surface" if type_id == "new.carve" else "ground": "a"}
    after = migrated(document(record))
    assert after["nodes"]["n"]["params"] == expected
    assert (after["nodes"]["n"]["type"], after["nodes"]["n"]["version"]) == ("new.carve", 4)
    assert after["nodes"]["n"]["inputs"] == {"surface": "a"}


def test_an_old_graph_runs_and_its_file_stays_as_it_is() -> None:
    data = document({"type": "old.dig", "version": 1, "params": {"w": 2}})
    text = json.dumps(data)
    graph = Graph.from_json(text, registry=registry())
    result = graph.run(cache=toy.memory_cache())
    assert (result["n.low"], result["n.high"]) == (7.0, 2000.0)
    assert graph.to_json() == text


def test_a_meaning_changes_for_graphs_built_before_it() -> None:
    """A graph made in Python when the node was at its first version, loaded when it is at its second."""
    first = node(version=1)(plain.function)
    first.family = "new"
    old = toy.toy_registry(first, family="new")
    graph = Graph(registry=old)
    graph.add("new.plain", "n", x=graph.add("toy.number", "a"), level=2.0)
    halved = Migration("new.plain", 2, change=lambda params: {**params, "level": params["level"] / 2})
    new = registry(halved)
    assert Graph.from_json(graph.to_json(), registry=new).run(cache=toy.memory_cache())["n"] == 2.0


def test_an_old_graph_and_its_upgrade_share_results() -> None:
    cache = toy.memory_cache()
    graph = load(document({"type": "old.dig", "version": 1, "params": {"w": 2}}))
    graph.run(cache=cache)
    again = graph.upgraded().run(cache=cache)
    assert set(toy.statuses(again).values()) == {"cached"}


def test_upgrading_a_current_graph_changes_nothing_but_versions() -> None:
    data = document({"type": "new.carve", "version": 4, "params": {}, "inputs": {"surface": "a"}})
    data["nodes"]["a"]["version"] = 1
    data["nodes"]["a"] = {"type": "toy.number", "version": 1, "params": {"value": 7}}
    text = json.dumps(data, indent=7)
    assert Graph.from_json(text, registry=registry()).upgraded().to_json() == text
    without = document({"type": "new.carve", "inputs": {"surface": "a"}})
    after = migrated(without)
    assert {id: record.get("version", 1) for id, record in after["nodes"].items()} == {"a": 1, "n": 4}
    assert list(after["nodes"]["n"])[:2] == ["type", "version"]


def test_upgrading_leaves_what_is_newer_and_what_is_unknown_alone() -> None:
    data = document({"type": "new.carve", "version": 9, "inputs": {"surface": "a"}})
    data["nodes"]["stranger"] = {"type": "acme.x", "version": 3, "params": {"lvl": 1}}
    after = migrated(data)
    assert after["nodes"]["n"]["version"] == 9
    assert after["nodes"]["stranger"] == data["nodes"]["stranger"]
    with pytest.raises(GraphError, match=r"saved with version 9 of new.carve, version 4 is installed"):
        load(document({"type": "new.carve", "version": 9, "inputs": {"surface": "a"}})).validate()


def test_exposed_inputs_follow() -> None:
    data = document(
        {"type": "old.dig", "version": 1, "inputs": {"ground": "a"}},
        inputs={"deep": {"type": "Number", "feeds": ["n.d"]}},
    )
    after = migrated(data)
    assert after["inputs"] == {"deep": {"type": "Number", "feeds": ["n.depth"]}}
    load(data).validate()


def test_a_name_that_is_valid_today_is_not_renamed_in_records_of_unknown_age() -> None:
    """`level` was renamed to `depth` once, and means something else since."""

    @node(version=3)
    def deep(x: float, *, level: float = 0.0, depth: float = 0.0) -> float:
        """Have a name twice."""
        return level + 10 * depth

    found = toy.with_migrations(Migration("new.deep", 2, parameters={"level": "depth"}), nodes=(deep,))

    def value(record: dict[str, Any]) -> Any:
        nodes = {"a": {"type": "toy.number"}, "n": {"type": "new.deep", "inputs": {"x": "a"}, **record}}
        graph = Graph.from_json(json.dumps({"format": "nodegraph/1", "nodes": nodes}), registry=found)
        return graph.run(cache=toy.memory_cache())["n"]

    assert value({"params": {"level": 1}}) == 1.0
    assert value({"params": {"level": 1}, "version": 1}) == 10.0
    assert value({"params": {"level": 1}, "version": 2}) == 1.0


def test_a_type_that_is_declared_again_is_not_renamed_in_records_of_unknown_age() -> None:
    @node(version=1)
    def reborn(x: float) -> float:
        """Have the name of an older node."""
        return x + 100

    found = toy.with_migrations(Migration("new.reborn", 2, new_type="new.plain"), nodes=(reborn, plain))
    nodes = {"a": {"type": "toy.number"}, "n": {"type": "new.reborn", "inputs": {"x": "a"}}}
    graph = Graph.from_json(json.dumps({"format": "nodegraph/1", "nodes": nodes}), registry=found)
    assert graph.run(cache=toy.memory_cache())["n"] == 101.0
    nodes["n"]["version"] = 1
    old = Graph.from_json(json.dumps({"format": "nodegraph/1", "nodes": nodes}), registry=found)
    assert old.run(cache=toy.memory_cache())["n"] == 1.0


def test_names_may_be_exchanged() -> None:
    found = toy.with_migrations(
        Migration("new.swap", 2, parameters={"p": "q", "q": "p"}, inputs={"a": "b", "b": "a"}), nodes=()
    )
    record = {"type": "new.swap", "version": 1, "params": {"p": 1, "q": 2}, "inputs": {"a": "x", "b": "x.out"}}
    data = {"format": "nodegraph/1", "nodes": {"x": {"type": "toy.number"}, "n": record}}
    after = Graph.from_json(json.dumps(data), registry=found).upgraded().data["nodes"]["n"]
    assert after["params"] == {"q": 1, "p": 2}
    assert after["inputs"] == {"b": "x", "a": "x.out"}


def test_old_and_new_name_together_lose_nothing() -> None:
    record = {"type": "new.plain", "inputs": {"x": "a"}, "params": {"lvl": 1, "level": 2}}
    after = migrated(document(record))
    assert after["nodes"]["n"]["params"] == {"lvl": 1, "level": 2}
    with pytest.raises(GraphError, match="unknown parameter 'lvl'"):
        load(document(record)).validate()


def test_other_nodes_with_the_same_names_are_left_alone() -> None:
    data = document({"type": "new.plain", "version": 1, "inputs": {"x": "a"}, "params": {"lvl": 1}})
    data["nodes"]["other"] = {"type": "acme.plain", "params": {"lvl": 1}, "inputs": {"n": "nn.lvl"}}
    data["layout"] = {"n": {"lvl": 1}}
    after = migrated(data)
    assert after["nodes"]["n"]["params"] == {"level": 1}
    assert after["nodes"]["other"] == data["nodes"]["other"]
    assert after["layout"] == data["layout"]


def test_a_change_gets_a_copy_and_its_failure_is_said() -> None:
    def destructive(params: dict[str, Any]) -> dict[str, Any]:
        params["at"].clear()
        return {"level": 1.0}

    record = {"type": "new.plain", "version": 1, "inputs": {"x": "a"}, "params": {"at": [1]}}
    data = {"format": "nodegraph/1", "nodes": {"a": {"type": "toy.number"}, "n": record}}
    graph = Graph.from_json(json.dumps(data), registry=registry(Migration("new.plain", 2, change=destructive)))
    graph.validate()
    assert graph.data == data

    def broken(params: dict[str, Any]) -> dict[str, Any]:
        return {"level": params["missing"]}

    graph = Graph.from_json(json.dumps(data), registry=registry(Migration("new.plain", 2, change=broken)))
    with pytest.raises(GraphError, match=r"node 'n': .*version 2"):
        graph.validate()


def test_migrations_of_one_version_all_apply() -> None:
    found = [
        Migration("new.plain", 2, parameters={"lvl": "height"}),
        Migration("new.plain", 2, parameters={"height": "level"}),
    ]
    record = {"type": "new.plain", "version": 1, "inputs": {"x": "a"}, "params": {"lvl": 5}}
    data = {"format": "nodegraph/1", "nodes": {"a": {"type": "toy.number"}, "n": record}}
    graph = Graph.from_json(json.dumps(data), registry=registry(*found))
    assert graph.run(cache=toy.memory_cache())["n"] == 6.0


def test_a_renaming_circle_ends() -> None:
    found = [Migration("new.x", 2, new_type="new.y"), Migration("new.y", 2, new_type="new.x")]
    for version in ({}, {"version": 1}):
        data = {"format": "nodegraph/1", "nodes": {"n": {"type": "new.x", **version}}}
        assert len(Graph.from_json(json.dumps(data), registry=registry(*found)).upgraded()) == 1


def test_inner_files_are_migrated_too(in_tmp: Any) -> None:
    inner = document({"type": "old.dig", "version": 1, "params": {"w": 2}}, outputs={"o": "n.rest"})
    (in_tmp / "inner.json").write_text(json.dumps(inner))
    outer = {"format": "nodegraph/1", "nodes": {"sub": {"type": "graph", "params": {"path": "inner.json"}}}}
    graph = Graph.from_json(json.dumps(outer), registry=registry())
    assert graph.run(cache=toy.memory_cache())["sub"] == 2000.0
