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
    assert after["parameters"] == {"wide": {"default": 3000, "drives": ["n.width"]}}
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


# A parameter of the whole graph whose value goes through a migration.


def driving(*drives: str, version: int | None = 3, **entry: Any) -> dict[str, Any]:
    """Two nodes side by side: `n` of version 3, whose width becomes metres with 4, and `m` of today."""
    record = {"type": "new.carve", "params": {"width": 2}, "inputs": {"surface": "a"}}
    data = document({**record, **({"version": version} if version else {})})
    data["nodes"]["n"]["inputs"] = record["inputs"]
    data["nodes"]["m"] = {**record, "version": 4}
    return {**data, "parameters": {"wide": {**entry, "drives": list(drives)}}}


def widths(graph: Graph, **options: Any) -> tuple[Any, Any]:
    result = graph.run(["n", "m"], cache=toy.memory_cache(), **options)
    return result["n.high"], result["m.high"]


def test_a_driven_value_goes_through_the_change() -> None:
    """Kilometres the graph's parameter was, and is: also where a person sets it, or a graph around this one."""
    graph = load(driving("n.width", default=3))
    assert widths(graph) == (3000.0, 2.0)
    assert widths(graph, set={"wide": 5}) == (5000.0, 2.0)
    assert widths(graph, set={"n.width": 5}) == (5.0, 2.0), "a node's own parameter has the meaning of today"
    assert widths(load(driving("n.width"))) == (2000.0, 2.0)
    assert widths(load(driving("n.width")), set={"wide": 5}) == (5000.0, 2.0)
    assert widths(load(driving("n.width", default=3, version=None))) == (3.0, 2.0), "of unknown age"


def test_of_several_driven_nodes_each_gets_the_value_that_its_version_means() -> None:
    graph = load(driving("n.width", "m.width", default=3))
    assert widths(graph) == (3000.0, 3.0)
    assert widths(graph, set={"wide": 5}) == (5000.0, 5.0)
    with pytest.raises(GraphError, match=r"'wide': its default is 3000 for 'n.width' and 3 for 'm.width', .* two"):
        graph.upgraded()


def test_upgrading_rewrites_the_default_and_the_result_stays() -> None:
    old = load(driving("n.width", default=3))
    new = old.upgraded()
    assert new.data["parameters"] == {"wide": {"default": 3000, "drives": ["n.width"]}}
    assert new.data["nodes"]["n"] == {**old.data["nodes"]["n"], "version": 4, "params": {"width": 2000}}
    assert widths(new) == widths(old)
    assert widths(new, set={"wide": 5}) == (5.0, 2.0), "its value has the new meaning now"
    both = driving("n.width", "m.width", default=3)
    both["nodes"]["m"]["version"] = 3
    assert load(both).upgraded().data["parameters"]["wide"]["default"] == 3000
    assert widths(load(both).upgraded()) == widths(load(both)) == (3000.0, 3000.0)
    assert migrated(driving("n.width"))["parameters"] == {"wide": {"drives": ["n.width"]}}


def test_a_driven_value_is_followed_through_renames_before_and_after_its_change() -> None:
    found = [
        Migration("new.carve", 2, parameters={"w": "breadth"}),
        Migration("new.carve", 3, change=lambda params: {name: value * 10 for name, value in params.items()}),
        Migration("new.carve", 4, parameters={"breadth": "width"}),
        Migration("new.carve", 4, change=metres),
    ]
    data = driving("n.w", version=1, default=3)
    data["nodes"]["n"]["params"] = {}
    graph = Graph.from_json(json.dumps(data), registry=registry(*found))
    assert widths(graph) == (30000.0, 2.0)
    after = graph.upgraded()
    assert after.data["parameters"] == {"wide": {"default": 30000, "drives": ["n.width"]}}
    assert widths(after) == (30000.0, 2.0)


def test_what_follows_from_a_driven_value_is_upgraded_with_it() -> None:
    def mode_of(params: dict[str, Any]) -> dict[str, Any]:
        return {"mode": "wide" if params.get("width", 1.0) > 2 else "u", **metres(params)}

    for own in ({}, {"width": 2}):
        data = driving("n.width", default=3)
        data["nodes"]["n"]["params"] = own
        graph = Graph.from_json(json.dumps(data), registry=registry(Migration("new.carve", 4, change=mode_of)))
        after = graph.upgraded().data
        assert after["nodes"]["n"]["params"] == {"mode": "wide", **metres(own)}
        assert after["parameters"]["wide"]["default"] == 3000


def test_the_last_of_two_parameters_that_drive_one_has_its_way() -> None:
    data = driving("n.width", "m.width", default=3)
    data["parameters"]["wider"] = {"default": 4, "drives": ["n.width"]}
    graph = load(data)
    assert widths(graph) == (4000.0, 3.0)
    after = graph.upgraded()
    assert widths(after) == (4000.0, 3.0)
    assert {name: entry["default"] for name, entry in after.data["parameters"].items()} == {"wide": 3, "wider": 4000}


def test_a_driven_parameter_that_a_change_replaces() -> None:
    """The old graph runs; a default for something else is nothing that upgrading could guess."""

    def halved(params: dict[str, Any]) -> dict[str, Any]:
        return {"width": params["radius"] * 2} if "radius" in params else params

    data = driving("n.radius", default=3)
    data["nodes"]["n"]["params"] = {}
    graph = Graph.from_json(json.dumps(data), registry=registry(Migration("new.carve", 4, change=halved)))
    assert widths(graph) == (6.0, 2.0)
    with pytest.raises(GraphError, match=r"graph: parameter 'wide': drives 'n.radius', which a migration replaced"):
        graph.upgraded()


def test_a_graph_around_an_old_one_goes_on_saying_kilometres(in_tmp: Any) -> None:
    (in_tmp / "inner.json").write_text(json.dumps({**driving("n.width", default=3), "outputs": {"o": "n.high"}}))
    outer = {"format": "nodegraph/1", "nodes": {"sub": {"type": "graph", "params": {"path": "inner.json", "wide": 5}}}}
    assert Graph.from_json(json.dumps(outer), registry=registry()).run(cache=toy.memory_cache())["sub"] == 5000.0


def test_wrong_drives_are_reported_through_a_migration() -> None:
    for drive, message in (("n", "write it as 'node.parameter'"), ("x.width", "does not exist"), ("n.wdth", "wdth")):
        with pytest.raises(GraphError, match=message):
            load(driving(drive, default=3)).validate()


def test_inner_files_are_migrated_too(in_tmp: Any) -> None:
    inner = document({"type": "old.dig", "version": 1, "params": {"w": 2}}, outputs={"o": "n.rest"})
    (in_tmp / "inner.json").write_text(json.dumps(inner))
    outer = {"format": "nodegraph/1", "nodes": {"sub": {"type": "graph", "params": {"path": "inner.json"}}}}
    graph = Graph.from_json(json.dumps(outer), registry=registry())
    assert graph.run(cache=toy.memory_cache())["sub"] == 2000.0
