"""Building graphs in Python: what `add`, `link`, `set` and the others write into the document."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nodegraph import Graph, GraphError, node
from tests.nodegraph import support as toy


def test_add_sorts_links_from_parameters() -> None:
    graph = toy.toy_graph()
    a = graph.add("toy.number", value=np.float64(2.5), tag=Path("x/y"))
    b = graph.add("toy.increase", "plus", x=a, by=np.int64(3))
    c = graph.add("toy.halves", x=b)
    graph.add("toy.add", terms=[a, c["high"], "plus.out"])
    graph.add("toy.maybe", x=a, y=None)
    assert (a.id, repr(b), str(c["high"])) == ("number", "<node 'plus'>", "halves.high")
    assert graph.data["nodes"] == {
        "number": {"type": "toy.number", "version": 1, "params": {"value": 2.5, "tag": "x/y"}},
        "plus": {"type": "toy.increase", "version": 1, "inputs": {"x": "number"}, "params": {"by": 3}},
        "halves": {"type": "toy.halves", "version": 1, "inputs": {"x": "plus"}},
        "add": {
            "type": "toy.add",
            "version": 1,
            "inputs": {"terms": ["number", "halves.high", "plus.out"]},
        },
        "maybe": {"type": "toy.maybe", "version": 1, "inputs": {"x": "number"}},
    }
    graph.validate()


def test_ids_are_numbered_where_taken() -> None:
    graph = toy.toy_graph()
    assert [graph.add("toy.number").id for _ in range(3)] == ["number", "number_2", "number_3"]
    graph.add("toy.number", "number_4")
    assert graph.add("toy.number").id == "number_5"
    graph.remove("number_2")
    assert graph.add("toy.number").id not in ("number", "number_3", "number_4", "number_5")
    assert len(graph) == 5
    assert "number" in graph
    assert "nope" not in graph


def test_a_node_of_another_graph_is_refused() -> None:
    """Both have a node 'number': by its id alone the one would pass for the other."""
    graph, other = toy.toy_graph(), toy.toy_graph(title="Valley")
    own, stranger = graph.add("toy.number"), other.add("toy.number")
    before = graph.to_json()
    message = r"^toys: 'number' is a node of another graph \('Valley'\); give one of this graph$"
    for link in (stranger, stranger["out"]):
        with pytest.raises(GraphError, match=message):
            graph.add("toy.increase", x=link)
        with pytest.raises(GraphError, match=message):
            graph.add("toy.add", terms=[own, link])
        with pytest.raises(GraphError, match=message):
            graph.add("graph", "sub", path="x.json", ground=link)
        with pytest.raises(GraphError, match=message):
            graph.set_output("o", link)
        with pytest.raises(GraphError, match=message):
            graph.run([link], cache=toy.memory_cache())
        with pytest.raises(GraphError, match=message):
            graph.plan(link, cache=toy.memory_cache())
    assert graph.to_json() == before
    assert graph.run(own["out"], cache=toy.memory_cache())[str(own["out"])] == 1.0


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (("toy.nmber",), {}, "unknown node type 'toy.nmber'; did you mean 'toy.number'?"),
        (("acme.x",), {}, "install the plugin that brings the family 'acme'"),
        (("toy.number", "a"), {}, "there is a node 'a' already"),
        (("toy.number", "a.b"), {}, "may hold only letters"),
        (("toy.number", "x y"), {}, "may hold only letters"),
        (("toy.number",), {"valeu": 1}, "'valeu' is neither port nor parameter of toy.number; did you mean 'value'?"),
        (("toy.number",), {"value": float("nan")}, "parameter 'value': not a JSON value"),
        (("toy.number",), {"value": {1, 2}}, "not a JSON value"),
        (("toy.number",), {"value": object()}, "not a JSON value"),
    ],
)
def test_add_refuses_what_is_wrong(arguments: tuple[str, ...], options: dict[str, Any], message: str) -> None:
    graph = toy.toy_graph()
    graph.add("toy.number", "a")
    before = graph.to_json()
    with pytest.raises(GraphError, match=message.replace("?", r"\?")):
        graph.add(*arguments, **options)
    assert graph.to_json() == before


def test_a_link_must_be_a_node_or_text() -> None:
    graph = toy.toy_graph()
    with pytest.raises(TypeError, match=r"3.0 is no node or output; give a handle"):
        graph.add("toy.increase", x=3.0)


def test_the_version_is_written() -> None:
    @node(version=3)
    def third() -> float:
        """Is of a later version."""
        return 1.0

    graph = toy.toy_graph(third)
    graph.add(third)
    graph.add("toy.number")
    assert graph.data["nodes"] == {
        "third": {"type": "toy.third", "version": 3},
        "number": {"type": "toy.number", "version": 1},
    }


def test_a_node_object_registers_itself() -> None:
    @node(version=1)
    def mine(x: float) -> float:
        """Be used at once."""
        return x + 1

    graph = Graph(registry=toy.toy_registry())
    handle = graph.add(mine, x=graph.add("toy.number"))
    assert graph.data["nodes"]["mine"]["type"] == "local.mine"
    assert graph.run(cache=toy.memory_cache())[handle.id] == 2.0


def test_linking_and_unlinking() -> None:
    graph = toy.toy_graph()
    a, b = graph.add("toy.number", "a"), graph.add("toy.number", "b", value=2.0)
    graph.add("toy.add", "sum")
    graph.link("sum.terms", a, b, a)
    assert graph.run(cache=toy.memory_cache())["sum"] == 4.0
    graph.link("sum.terms", "b")
    assert graph.data["nodes"]["sum"]["inputs"] == {"terms": "b"}
    graph.link("sum.terms")
    assert graph.run(cache=toy.memory_cache())["sum"] == 0.0
    with pytest.raises(GraphError, match="no node 'sun'; did you mean 'sum'"):
        graph.link("sun.terms", a)


def test_setting_parameters() -> None:
    graph = toy.toy_graph()
    graph.add("toy.number", "a")
    graph.set_parameter("level", drives=["a.value"], default=4.0)
    assert graph.run(cache=toy.memory_cache())["a"] == 4.0
    graph.set("level", 5.0)
    assert graph.run(cache=toy.memory_cache())["a"] == 5.0
    graph.set("a.tag", "t")
    assert graph.data["nodes"]["a"]["params"] == {"tag": "t"}
    with pytest.raises(GraphError, match="no exposed parameter 'levle'; did you mean 'level'"):
        graph.set("levle", 1)
    with pytest.raises(GraphError, match="no node 'b'"):
        graph.set("b.value", 1)
    with pytest.raises(GraphError, match="not a JSON value"):
        graph.set("a.value", float("inf"))


def test_removing_takes_links_and_layout_along() -> None:
    graph = toy.toy_graph()
    graph.add("toy.number", "a")
    graph.add("toy.number", "b")
    graph.add("toy.add", "sum", terms=["a", "b", "a.out"])
    graph.add("toy.increase", "more", x="a")
    graph._section("layout").update({"a": [0, 0], "b": [1, 1]})
    graph.remove("a")
    assert graph.data["nodes"] == {
        "b": {"type": "toy.number", "version": 1},
        "sum": {"type": "toy.add", "version": 1, "inputs": {"terms": ["b"]}},
        "more": {"type": "toy.increase", "version": 1, "inputs": {}},
    }
    assert graph.data["layout"] == {"b": [1, 1]}
    with pytest.raises(GraphError, match="no node 'a'"):
        graph.remove("a")


def test_sections_stand_in_their_usual_order() -> None:
    graph = toy.toy_graph()
    graph.add("toy.increase", "a")
    graph.set_output("result", graph.add("toy.number", "b"))
    graph.set_input("start", type="Number", feeds=["a.x"])
    graph.set_parameter("by", drives=["a.by"])
    assert list(graph.data) == ["format", "title", "parameters", "inputs", "outputs", "nodes"]
    assert graph.data["parameters"] == {"by": {"drives": ["a.by"]}}
    assert graph.data["outputs"] == {"result": "b"}


def test_networkx_sees_nodes_and_both_ports() -> None:
    graph = toy.toy_graph()
    graph.add("toy.halves", "parts", x=graph.add("toy.number", "a"))
    graph.add("toy.add", "sum", terms=["a", "parts.high"])
    found = graph.to_networkx()
    assert found.nodes["parts"]["type"] == "toy.halves"
    assert sorted(found.edges(data=True), key=str) == sorted(
        [
            ("a", "parts", {"source_port": "", "target_port": "x"}),
            ("a", "sum", {"source_port": "", "target_port": "terms"}),
            ("parts", "sum", {"source_port": "high", "target_port": "terms"}),
        ],
        key=str,
    )
    found.nodes["parts"]["type"] = "changed"
    assert graph.data["nodes"]["parts"]["type"] == "toy.halves"


def test_data_is_a_copy() -> None:
    graph = toy.toy_graph()
    graph.add("toy.number", "a")
    graph.data["nodes"].clear()
    assert len(graph) == 1


def test_a_parameter_given_to_the_graph_is_a_copy() -> None:
    @node(version=1)
    def points(*, at: list[float]) -> float:
        """Sum."""
        return sum(at)

    graph = toy.toy_graph(points)
    at = [1.0, 2.0]
    graph.add(points, at=at)
    at.append(5.0)
    assert graph.run(cache=toy.memory_cache())["points"] == 3.0


def test_saving_and_loading(tmp_path: Path) -> None:
    graph = toy.toy_graph(title="Title")
    graph.add("toy.number", "a")
    with pytest.raises(GraphError, match="the graph has no file yet"):
        graph.save()
    assert graph.name == "Title"
    path = graph.save(tmp_path / "deep" / "g.json")
    assert graph.name == "g.json"
    again = Graph.load(path, registry=toy.toy_registry())
    assert again.data == graph.data
    assert again.title == "Title"
    assert again.folder == path.parent


def test_a_graph_that_moves_takes_its_relative_paths_along(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "words.txt").write_text(name)
    graph = toy.toy_graph()
    graph.add("toy.read", "text", path="words.txt")
    graph.save(tmp_path / "a" / "g.json")
    assert graph.run(cache=toy.memory_cache())["text"] == "a"
    graph.save(tmp_path / "b" / "g.json")
    assert graph.run(cache=toy.memory_cache())["text"] == "b"


def test_a_graph_without_a_file_starts_in_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = toy.toy_graph()
    graph.add("toy.read", "text", path="words.txt")
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "words.txt").write_text(name)
        monkeypatch.chdir(tmp_path / name)
        assert graph.run(cache=toy.memory_cache())["text"] == name


def test_overrides_never_edit_the_graph() -> None:
    graph = toy.toy_graph()
    graph.add("toy.number", "a")
    before = graph.to_json()
    assert graph.run(cache=toy.memory_cache(), set={"a.value": np.float32(2.5)})["a"] == 2.5
    assert graph.to_json() == before
    assert graph.run(cache=toy.memory_cache())["a"] == 1.0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("a.valeu", 1, "unknown parameter 'valeu'; did you mean 'value'"),
        ("b.value", 1, "no node 'b' to set 'value' of"),
        ("valeu", 1, "no parameter 'valeu'"),
        ("a.value", "x", "parameter 'value': .*number, got \"x\""),
        ("a.value", float("nan"), "parameter 'value'|not a JSON value"),
        ("a.value", object(), "not a JSON value|not JSON values"),
        ("", 1, "no parameter ''"),
        (".", 1, "no node ''|no parameter"),
        ("a.", 1, "parameter ''|no parameter"),
    ],
)
def test_wrong_overrides_name_what_would_be_right(name: str, value: Any, message: str) -> None:
    graph = toy.toy_graph()
    graph.add("toy.number", "a")
    with pytest.raises(GraphError, match=message):
        graph.run(cache=toy.memory_cache(), set={name: value})
