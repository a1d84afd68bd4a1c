"""Graphs in graphs: what a file exposes, and how instances of it are linked, set and named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from nodegraph import Graph, GraphError
from nodegraph.cache import Cache
from tests.nodegraph import support as toy

INNER = {
    "format": "nodegraph/1",
    "title": "Inner",
    "parameters": {"by": {"default": 10, "drives": ["plus.by", "again.by"]}, "free": {"drives": ["plus.by"]}},
    "inputs": {"start": {"type": "Number", "feeds": ["plus.x"]}, "extra": {"type": "Number", "feeds": ["maybe.y"]}},
    "outputs": {"sum": "maybe", "high": "parts.high", "low": "parts.low"},
    "nodes": {
        "plus": {"type": "toy.increase"},
        "again": {"type": "toy.increase", "inputs": {"x": "plus"}},
        "maybe": {"type": "toy.maybe", "inputs": {"x": "again"}},
        "parts": {"type": "toy.halves", "inputs": {"x": "maybe"}},
    },
}


@pytest.fixture(autouse=True)
def _count_anew() -> None:
    toy.ran()


def write(path: Path, data: dict[str, Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data))
    return path


def outer(nodes: dict[str, Any], **sections: Any) -> dict[str, Any]:
    return {
        "format": "nodegraph/1",
        **sections,
        "nodes": {"a": {"type": "toy.number", "params": {"value": 0.5}}, **nodes},
    }


def use(**record: Any) -> dict[str, Any]:
    return {"type": "graph", "params": {"path": "inner.json", **record.pop("params", {})}, **record}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path / "inner.json", INNER)
    return tmp_path


def load(folder: Path, nodes: dict[str, Any], **sections: Any) -> Graph:
    return Graph.load(write(folder / "outer.json", outer(nodes, **sections)), registry=toy.toy_registry())


def run(folder: Path, nodes: dict[str, Any], **options: Any) -> Any:
    return load(folder, nodes).run(cache=toy.memory_cache(), **options)


def problems(folder: Path, nodes: dict[str, Any], **sections: Any) -> list[str]:
    with pytest.raises(GraphError) as caught:
        load(folder, nodes, **sections).validate()
    return [str(problem) for problem in caught.value.problems]


def test_ports_are_linked_and_outputs_named(folder: Path) -> None:
    nodes = {
        "sub": use(inputs={"start": "a"}),
        "first": {"type": "toy.increase", "inputs": {"x": "sub"}},
        "high": {"type": "toy.increase", "inputs": {"x": "sub.high"}},
    }
    result = run(folder, nodes)
    assert (result["first"], result["high"]) == (21.5, 1.5)
    assert (result["sub"], result["sub.sum"], result["sub.low"], result["sub.high"]) == (20.5, 20.5, 20.0, 0.5)
    assert result["sub/plus"] == 10.5
    assert set(result.nodes) == {"a", "sub/plus", "sub/again", "sub/maybe", "sub/parts", "first", "high"}


def test_targets_and_force_name_subgraphs(folder: Path) -> None:
    graph = load(folder, {"sub": use(inputs={"start": "a"}), "other": {"type": "toy.number"}})
    cache = toy.memory_cache()
    assert set(graph.run(["sub"], cache=cache).nodes) == {"a", "sub/plus", "sub/again", "sub/maybe"}
    assert graph.run(["sub.high"], cache=cache)["sub.high"] == 0.5
    toy.ran()
    graph.run(cache=cache, force=["sub"])
    assert toy.ran() == {"increase": 2, "maybe": 1, "halves": 1, "number": 1}
    with pytest.raises(GraphError, match="node 'sub' has no output 'hihg'; did you mean 'high'"):
        graph.run(["sub.hihg"], cache=cache)
    with pytest.raises(GraphError, match="no node 'sbu'; did you mean 'sub'"):
        graph.run(["sbu"], cache=cache)


def test_optional_inputs_may_stay_unfed_and_may_be_fed(folder: Path) -> None:
    assert run(folder, {"sub": use(inputs={"start": "a"})})["sub"] == 20.5
    assert run(folder, {"sub": use(inputs={"start": "a", "extra": "a"})})["sub"] == 21.0
    (found,) = problems(folder, {"sub": use()})
    assert found == (
        "outer.json: node 'sub': inner.json: node 'plus': input 'x': "
        "needs the graph's input 'start', which nothing feeds"
    )


def test_parameters_by_file_by_record_and_by_set(folder: Path) -> None:
    assert run(folder, {"sub": use(inputs={"start": "a"}, params={"by": 1})})["sub"] == 2.5
    assert run(folder, {"sub": use(inputs={"start": "a"})}, set={"sub.by": 2})["sub"] == 4.5
    sections = {"parameters": {"depth": {"default": 3, "drives": ["sub.by"]}}}
    graph = load(folder, {"sub": use(inputs={"start": "a"})}, **sections)
    assert graph.run(cache=toy.memory_cache())["sub"] == 6.5
    assert graph.run(cache=toy.memory_cache(), set={"depth": 4})["sub"] == 8.5
    assert run(folder, {"sub": use(inputs={"start": "a"}, params={"free": 100})})["sub"] == 110.5


def test_an_inner_file_runs_by_itself_when_its_inputs_are_linked(folder: Path) -> None:
    inner = Graph.load(folder / "inner.json", registry=toy.toy_registry())
    with pytest.raises(GraphError, match="needs the graph's input 'start'"):
        inner.validate()
    inner.add("toy.number", "own", value=1.0)
    inner.link("plus.x", "own")
    assert inner.run(cache=toy.memory_cache())["maybe"] == 21.0


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (
            use(inputs={"start": "a"}, params={"yb": 1}),
            "node 'sub': unknown parameter 'yb'; valid names: 'by', 'free', 'path'",
        ),
        (use(inputs={"start": "a", "strat": "a"}), "node 'sub': unknown input 'strat'; did you mean 'start'?"),
        (use(inputs={"start": "zz"}), "input 'start': links to 'zz', but there is no node 'zz'"),
        (use(inputs={"start": ["a", "a"]}), "takes one link, 2 are given"),
        (
            use(inputs={"start": "a"}, params={"by": "x"}),
            "inner.json: node 'plus': parameter 'by': should be a valid number",
        ),
        (use(inputs={"start": "a"}, params={"path": "absent.json"}), "absent.json: cannot be read (No such file"),
        (use(inputs={"start": "a"}, params={"path": 3}), "parameter 'path' is missing"),
        (use(inputs={"start": "h"}), "inner.json: node 'plus': input 'x': takes a Number, but 'h.out' gives a Height"),
    ],
)
def test_what_is_wrong_names_both_files(folder: Path, record: dict[str, Any], message: str) -> None:
    found = problems(folder, {"h": {"type": "toy.height"}, "sub": record})
    assert all(item.startswith("outer.json: node 'sub'") for item in found)
    assert any(message in item for item in found), found
    assert len(found) == len(set(found)) <= 2


def test_what_is_wrong_in_the_inner_file_is_listed_too(folder: Path) -> None:
    write(folder / "inner.json", {**INNER, "titel": "", "outputs": 3})
    found = problems(folder, {"sub": use(), "bad": {"type": "toy.nope"}})
    assert len(found) == 3
    write(
        folder / "inner.json",
        {**INNER, "outputs": {"sum": "nowhere"}, "nodes": {**INNER["nodes"], "x": {"type": "toy.increase"}}},
    )  # type: ignore[dict-item]
    found = problems(folder, {"sub": use(inputs={"start": "a"})})
    assert sorted(item.rpartition("inner.json: ")[2] for item in found) == [
        "node 'x': input 'x': is not linked; it needs a Number",
        "output 'sum': links to 'nowhere', but there is no node 'nowhere'; "
        "valid names: 'again', 'maybe', 'parts', 'plus', 'x'",
    ]


def test_an_unknown_output_of_a_subgraph(folder: Path) -> None:
    (found,) = problems(
        folder, {"sub": use(inputs={"start": "a"}), "after": {"type": "toy.increase", "inputs": {"x": "sub.hihg"}}}
    )
    assert found == "outer.json: node 'after': input 'x': node 'sub' has no output 'hihg'; did you mean 'high'?"


def test_two_instances_share_what_is_equal(folder: Path) -> None:
    nodes = {
        "one": use(inputs={"start": "a"}),
        "two": use(inputs={"start": "a"}),
        "three": use(inputs={"start": "a"}, params={"by": 1}),
        "sum": {"type": "toy.add", "inputs": {"terms": ["one", "two", "three"]}},
    }
    result = run(folder, nodes)
    assert result["sum"] == 20.5 + 20.5 + 2.5
    assert toy.ran()["increase"] == 4


def test_instances_feed_each_other(folder: Path) -> None:
    nodes = {"two": use(inputs={"start": "one.low"}), "one": use(inputs={"start": "a", "extra": "a"})}
    assert run(folder, nodes)["two"] == 41.0


def test_a_cycle_through_a_subgraph_is_found(folder: Path) -> None:
    found = problems(folder, {"one": use(inputs={"start": "two"}), "two": use(inputs={"start": "one"})})
    assert len(found) == 1
    assert "cycle" in found[0]
    assert "one/plus" in found[0]
    assert "two/plus" in found[0]


def test_nesting_passes_inputs_parameters_and_outputs_through(folder: Path) -> None:
    middle = {
        "format": "nodegraph/1",
        "parameters": {"depth": {"default": 2, "drives": ["core.by"]}},
        "inputs": {
            "begin": {"type": "Number", "feeds": ["core.start"]},
            "more": {"type": "Number", "feeds": ["core.extra"]},
        },
        "outputs": {"end": "core.low", "all": "core"},
        "nodes": {"core": {"type": "graph", "params": {"path": "inner.json"}}},
    }
    write(folder / "middle.json", middle)
    sub = {"type": "graph", "params": {"path": "middle.json"}, "inputs": {"begin": "a"}}
    result = run(folder, {"sub": sub, "after": {"type": "toy.increase", "inputs": {"x": "sub"}}})
    assert result["after"] == 5.0
    assert result["sub.all"] == 4.5
    assert result["sub/core.high"] == 0.5
    assert result["sub/core/plus"] == 2.5
    assert run(folder, {"sub": sub}, set={"sub.depth": 5})["sub"] == 10.0
    fed = {**sub, "inputs": {"begin": "a", "more": "a"}}
    assert run(folder, {"sub": fed})["sub"] == 5.0
    (found,) = problems(folder, {"sub": {**sub, "inputs": {}}})
    assert "needs the graph's input" in found


def test_paths_are_relative_to_the_file_they_stand_in(tmp_path: Path) -> None:
    reader = {
        "format": "nodegraph/1",
        "outputs": {"text": "text"},
        "nodes": {"text": {"type": "toy.read", "params": {"path": "data/words.txt"}}},
    }
    write(tmp_path / "parts" / "reader.json", reader)
    (tmp_path / "parts" / "data").mkdir()
    (tmp_path / "parts" / "data" / "words.txt").write_text("beside the inner file")
    between = {
        "format": "nodegraph/1",
        "outputs": {"t": "r"},
        "nodes": {"r": {"type": "graph", "params": {"path": "../parts/reader.json"}}},
    }
    write(tmp_path / "more" / "between.json", between)
    result = run(tmp_path, {"sub": {"type": "graph", "params": {"path": "more/between.json"}}})
    assert result["sub"] == "beside the inner file"


@pytest.mark.parametrize("spelling", ["outer.json", "./outer.json", "../{folder}/outer.json", "link.json"])
def test_a_file_that_contains_itself_is_refused(tmp_path: Path, spelling: str) -> None:
    (tmp_path / "link.json").symlink_to("outer.json")
    path = spelling.format(folder=tmp_path.name)
    (found,) = problems(tmp_path, {"sub": {"type": "graph", "params": {"path": path}}})
    assert "contains itself; graph files must not form a circle" in found


def test_a_circle_of_files_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "b.json", outer({"sub": {"type": "graph", "params": {"path": "outer.json"}}}))
    (found,) = problems(tmp_path, {"sub": {"type": "graph", "params": {"path": "b.json"}}})
    assert found == (
        "outer.json: node 'sub': b.json: node 'sub': 'outer.json' contains itself; graph files must not form a circle"
    )


def test_files_nested_too_deep_are_refused(tmp_path: Path) -> None:
    for level in range(60):
        write(tmp_path / f"g{level}.json", outer({"sub": {"type": "graph", "params": {"path": f"g{level + 1}.json"}}}))
    with pytest.raises(GraphError, match="nested more than 50 deep"):
        Graph.load(tmp_path / "g0.json", registry=toy.toy_registry()).validate()


def test_the_same_file_by_two_ways_is_no_circle(folder: Path) -> None:
    for name in ("left", "right"):
        data = {
            "format": "nodegraph/1",
            "inputs": {"start": {"type": "Number", "feeds": ["core.start"]}},
            "outputs": {"out": "core"},
            "nodes": {"core": use(params={"by": 1 if name == "left" else 2})},
        }
        write(folder / f"{name}.json", data)
    nodes = {
        name: {"type": "graph", "params": {"path": f"{name}.json"}, "inputs": {"start": "a"}}
        for name in ("left", "right")
    }
    result = run(folder, {**nodes, "sum": {"type": "toy.add", "inputs": {"terms": ["left", "right"]}}})
    assert result["sum"] == 2.5 + 4.5


def test_a_subgraph_without_outputs_still_runs(folder: Path) -> None:
    write(folder / "quiet.json", outer({}))
    result = run(folder, {"sub": {"type": "graph", "params": {"path": "quiet.json"}}})
    assert toy.statuses(result)["sub/a"] in ("computed", "cached")
    (found,) = problems(
        folder,
        {
            "sub": {"type": "graph", "params": {"path": "quiet.json"}},
            "x": {"type": "toy.increase", "inputs": {"x": "sub"}},
        },
    )
    assert "node 'sub' has no output" in found


def test_an_empty_subgraph_is_refused(folder: Path) -> None:
    write(folder / "empty.json", {"format": "nodegraph/1", "nodes": {}})
    (found,) = problems(folder, {"sub": {"type": "graph", "params": {"path": "empty.json"}}})
    assert "empty.json: the graph has no nodes" in found


def test_a_change_of_an_inner_file_is_seen(folder: Path) -> None:
    graph = load(folder, {"sub": use(inputs={"start": "a"})})
    cache = toy.memory_cache()
    assert graph.run(cache=cache)["sub"] == 20.5
    changed = json.loads(json.dumps(INNER))
    changed["parameters"]["by"]["default"] = 100
    write(folder / "inner.json", changed)
    result = graph.run(cache=cache)
    assert result["sub"] == 200.5
    assert toy.reasons(result)["sub/plus"] == "parameter by changed 10.0 -> 100.0"


def test_the_instance_and_not_the_place_decides_what_is_cached(folder: Path, tmp_path: Path) -> None:
    cache = Cache(tmp_path / "cache")
    load(folder, {"sub": use(inputs={"start": "a"})}).run(cache=cache)
    toy.ran()
    result = load(folder, {"renamed": use(inputs={"start": "a"})}).run(cache=cache)
    assert toy.ran() == {}
    assert result["renamed.high"] == 0.5


def test_building_with_subgraphs_in_python(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    graph = toy.toy_graph()
    a = graph.add("toy.number", "a", value=0.5)
    sub = graph.add("graph", "sub", path="inner.json", by=1, start=a, extra=a["out"])
    graph.add("toy.increase", x=sub["high"])
    assert graph.data["nodes"]["sub"] == {
        "type": "graph",
        "inputs": {"start": "a", "extra": "a.out"},
        "params": {"path": "inner.json", "by": 1},
    }
    assert graph.run(cache=toy.memory_cache())["increase"] == 1.0


def test_an_input_fed_twice_inside(folder: Path) -> None:
    data = json.loads(json.dumps(INNER))
    data["inputs"]["start"]["feeds"] = ["plus.x", "other.x"]
    data["nodes"]["other"] = {"type": "toy.increase", "params": {"by": 7}}
    data["outputs"]["other"] = "other"
    write(folder / "inner.json", data)
    result = run(folder, {"sub": use(inputs={"start": "a"})})
    assert (result["sub"], result["sub.other"]) == (20.5, 7.5)


def test_a_variadic_port_is_fed_a_list(folder: Path) -> None:
    data = {
        "format": "nodegraph/1",
        "inputs": {
            "terms": {"type": "Number", "feeds": ["join.rest"]},
            "first": {"type": "Number", "feeds": ["join.first"]},
        },
        "outputs": {"text": "join"},
        "nodes": {"join": {"type": "toy.join"}},
    }
    write(folder / "join.json", data)
    nodes = {
        "b": {"type": "toy.number", "params": {"value": 2}},
        "sub": {"type": "graph", "params": {"path": "join.json"}, "inputs": {"terms": ["b", "a", "b"], "first": "a"}},
    }
    assert run(folder, nodes)["sub"] == "0.5,2,0.5,2"


def test_an_outer_link_to_nothing_is_reported_even_where_the_inner_port_is_optional(folder: Path) -> None:
    (found,) = problems(folder, {"sub": use(inputs={"start": "a", "extra": "gone"})})
    assert found.startswith("outer.json: node 'sub': input 'extra': links to 'gone'")


def test_what_is_linked_is_held_against_the_declared_type(tmp_path: Path) -> None:
    data = json.loads(json.dumps(INNER))
    data["inputs"]["start"]["type"] = "Text"
    write(tmp_path / "inner.json", data)
    with pytest.raises(GraphError) as caught:
        load(tmp_path, {"c": use(inputs={"start": "a"})}).validate()
    assert [str(item) for item in caught.value.problems] == [
        "outer.json: node 'c': input 'start': takes a Text, but 'a.out' gives a Number"
    ]
