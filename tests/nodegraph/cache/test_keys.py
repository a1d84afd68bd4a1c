"""Keys: two runs of a node share a key exactly when nothing that could change its result differs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from nodegraph import Graph, node
from nodegraph.cache import keys
from nodegraph.plan import Plan
from tests.nodegraph import support as toy

REGISTRY = toy.toy_registry()


def key_of(graph: Graph, id: str) -> bytes:
    """Return the key of a node, all of whose inputs are computed."""
    plan = graph.run([id], cache=toy.memory_cache()).plan
    found = plan.key[plan.network.ids[id]]
    assert found is not None
    return found


def load(nodes: dict[str, Any], **sections: Any) -> Graph:
    return Graph.from_json(json.dumps({"format": "nodegraph/1", **sections, "nodes": nodes}), registry=REGISTRY)


def base() -> dict[str, Any]:
    return {
        "a": {"type": "toy.number", "params": {"value": 1.0}},
        "b": {"type": "toy.number", "params": {"value": 2.0}},
        "n": {"type": "toy.join", "inputs": {"first": "a", "rest": ["a", "b"]}, "params": {"sep": ";"}},
    }


def changed(path: str, value: Any) -> dict[str, Any]:
    nodes: Any = base()
    *steps, last = path.split("/")
    place = nodes
    for step in steps:
        place = place[step]
    place[last] = value
    return nodes


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("n/params", {"sep": ":"}),
        ("n/params", {}),
        ("n/inputs/first", "b"),
        ("n/inputs/rest", ["b", "a"]),
        ("n/inputs/rest", ["a"]),
        ("n/inputs/rest", ["a", "b", "b"]),
        ("n/inputs", {"first": "a"}),
        ("a/params/value", 1.0000000000000002),
        ("a/params/value", -1.0),
    ],
)
def test_whatever_changes_the_result_changes_the_key(path: str, value: Any) -> None:
    assert key_of(load(changed(path, value)), "n") != key_of(load(base()), "n")


@pytest.mark.parametrize(
    "same",
    [
        load(base(), title="a title", layout={"n": [1, 2]}, note="x"),
        load(dict(reversed(base().items()))),
        load(changed("n", {"inputs": {"rest": ["a", "b"], "first": "a"}, "params": {"sep": ";"}, "type": "toy.join"})),
        load(changed("n/inputs/first", "a.out")),
        load(changed("n/note", "a remark")),
        load(changed("n/version", 1)),
        load(changed("a/params", {"value": 1, "tag": ""})),
        load(changed("a/params", {"tag": "", "value": 1.0})),
        load(base(), parameters={"s": {"default": ";", "drives": ["n.sep"]}}),
        load(
            {
                **base(),
                "a": {"type": "toy.increase", "inputs": {"x": "zero"}},
                "zero": {"type": "toy.number", "params": {"value": 0}},
            }
        ),
    ],
)
def test_whatever_does_not_change_the_result_leaves_the_key(same: Graph) -> None:
    assert key_of(same, "n") == key_of(load(base()), "n")


def test_another_name_of_a_node_leaves_its_key() -> None:
    nodes = base()
    nodes["m"] = nodes.pop("n")
    assert key_of(load(nodes), "m") == key_of(load(base()), "n")


@given(left=st.lists(st.sampled_from("abc"), max_size=4), right=st.lists(st.sampled_from("abc"), max_size=4))
@example(left=["a", "b"], right=["b", "a"])
def test_the_order_of_variadic_links_is_part_of_the_key(left: list[str], right: list[str]) -> None:
    digests = {name: name.encode() * 16 for name in "abc"}

    def of(names: list[str]) -> bytes:
        return keys.key(b"p" * 16, b"{}", [("xs", digests[name]) for name in names])

    assert (of(left) == of(right)) == (left == right)


ports = st.lists(st.tuples(st.text(max_size=3), st.binary(min_size=1, max_size=3)), max_size=4)
files = st.dictionaries(st.text(max_size=3), st.binary(max_size=3), max_size=2)
parts = st.tuples(st.binary(max_size=3), st.binary(max_size=3), ports, files)


@given(a=parts, b=parts)
@example(a=(b"p", b"", [("x", b"1"), ("y", b"2")], {}), b=(b"p", b"", [("y", b"2"), ("x", b"1")], {}))
@example(a=(b"p", b"", [("x", b"1"), ("y", b"2")], {}), b=(b"p", b"", [("x", b"2"), ("y", b"1")], {}))
@example(a=(b"p", b"", [("x", b"1")], {}), b=(b"p", b"", [("y", b"1")], {}))
@example(a=(b"p", b"", [("file x", b"1")], {}), b=(b"p", b"", [], {"x": b"1"}))
@example(a=(b"p", b"{}x", [], {}), b=(b"p", b"{}", [("x", b"")], {}))
def test_keys_differ_exactly_when_their_parts_do(a: Any, b: Any) -> None:
    def meaning(item: Any) -> Any:
        prefix, canonical, inputs, read = item
        by_port: dict[str, list[bytes]] = {}
        for port, digest in inputs:
            by_port.setdefault(port, []).append(digest)
        return prefix, canonical, by_port, read

    def of(item: Any) -> bytes:
        return keys.key(*item)

    # A port is an identifier, so none is called "file x".
    if any(port.startswith("file ") for item in (a, b) for port, _ in item[2]):
        return
    assert (of(a) == of(b)) == (meaning(a) == meaning(b))


@given(
    a=st.tuples(st.text(max_size=4), st.integers(0, 200), st.binary(max_size=3), st.text(max_size=3)),
    b=st.tuples(st.text(max_size=4), st.integers(0, 200), st.binary(max_size=3), st.text(max_size=3)),
)
@example(a=("t.f", 1, b"c", ""), b=("t.f", 2, b"c", ""))
@example(a=("t.f", 1, b"c", ""), b=("t.f", 1, b"d", ""))
@example(a=("t.f", 1, b"c", ""), b=("t.f", 1, b"c", "cpu"))
@example(a=("t.f1", 1, b"c", ""), b=("t.f", 11, b"c", ""))
def test_prefixes_differ_exactly_when_their_parts_do(a: Any, b: Any) -> None:
    assert (keys.prefix(*a) == keys.prefix(*b)) == (a == b)


def test_the_schema_of_keys_is_part_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    before = keys.prefix("t.f", 1, b"c")
    monkeypatch.setattr(keys, "SCHEMA", keys.SCHEMA + 1)
    assert keys.prefix("t.f", 1, b"c") != before


ARRAYS = [
    np.zeros(4),
    np.zeros((2, 2)),
    np.zeros((4, 1)),
    np.zeros(4, np.float32),
    np.zeros(4, np.int64),
    np.zeros(4, ">f8"),
    np.zeros(5),
    np.full(4, -0.0),
    np.full(4, np.nan),
]


@node(version=1)
def pick(*, which: int) -> np.ndarray:
    """Give one of several arrays of zeros."""
    return ARRAYS[which].copy()


@node(version=1)
def look(values: np.ndarray) -> str:
    """Look at an array."""
    return f"{values.shape} {values.dtype.str} {values.tobytes().hex()}"


def test_shape_dtype_and_byte_order_of_an_input_are_part_of_the_key() -> None:
    graph = toy.toy_graph(pick, look)
    for which in range(len(ARRAYS)):
        graph.add(look, f"look{which}", values=graph.add(pick, which=which))
    result = graph.run(cache=toy.memory_cache())
    plan = result.plan
    found = {plan.key[plan.network.ids[f"look{which}"]] for which in range(len(ARRAYS))}
    assert len(found) == len(ARRAYS)
    assert len({result[f"look{which}"] for which in range(len(ARRAYS))}) == len(ARRAYS)


@pytest.mark.parametrize(
    ("annotation", "values"),
    [
        (float, [0.0, 1.0, -1.0, 1e-300, 1e300, 0.1, 0.1 + 1e-17 * 8]),
        (int, [0, 1, -1, 10**30, 2**53, 2**53 + 1]),
        (bool, [True, False]),
        (str, ["", "a", "b", "ab", "ä", "a\u0308", "\u2028", '"', "\\"]),
        (list[float], [[], [0.0], [0.0, 0.0], [1.0, 2.0], [2.0, 1.0]]),
        (list[list[int]], [[], [[]], [[1], [2]], [[1, 2]], [[], [1, 2]]]),
        (dict[str, int], [{}, {"a": 1}, {"b": 1}, {"a": 2}, {"a": 1, "b": 1}]),
        (float | None, [None, 0.0, 1.0]),
        (str | float, ["1", 1.0, "1.0"]),
        (tuple[int, int], [(0, 1), (1, 0)]),
    ],
)
def test_every_value_of_a_parameter_has_its_own_key(annotation: Any, values: list[Any]) -> None:
    def function(*, p: Any) -> float:
        """Take anything."""
        return 1.0

    function.__annotations__["p"] = annotation
    taking = node(version=1)(function)
    canonical = [taking.parameters.check({"p": value}).canonical for value in values]
    assert len(set(canonical)) == len(values)


def test_the_order_of_names_inside_a_parameter_does_not_matter() -> None:
    @node(version=1)
    def taking(*, p: dict[str, int]) -> float:
        """Take names."""
        return 1.0

    assert taking.parameters.check({"p": {"a": 1, "b": 2}}) == taking.parameters.check({"p": {"b": 2, "a": 1}})


def test_the_version_and_the_name_of_a_type_are_part_of_the_key() -> None:
    def declared(name: str, version: int) -> Any:
        def function() -> float:
            """Give one."""
            return 1.0

        function.__name__ = name
        return node(version=version)(function)

    found = set()
    for name, version in (("f", 1), ("f", 2), ("g", 1)):
        graph = toy.toy_graph(item := declared(name, version))
        graph.add(item, "n")
        found.add(key_of(graph, "n"))
    assert len(found) == 3


def test_the_contents_and_the_name_of_a_file_are_part_of_the_key(tmp_path: Path) -> None:
    found = []
    for folder, name, text in (("a", "x.txt", "1"), ("a", "y.txt", "1"), ("a", "x.txt", "2"), ("b", "x.txt", "1")):
        path = tmp_path / folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        graph = toy.toy_graph()
        graph.add("toy.read", "n", path=str(path))
        found.append(key_of(graph, "n"))
    assert len(set(found)) == 3
    assert found[0] == found[3], "where it lies does not matter"


def test_keys_do_not_grow_along_a_chain() -> None:
    """A key that held every ancestor's would make chains quadratic, and early cut-off impossible."""
    import sys

    graph = toy.toy_graph()
    last = graph.add("toy.number")
    for _ in range(200):
        last = graph.add("toy.parity", x=last)
    plan = graph.run(cache=toy.memory_cache()).plan
    assert isinstance(plan, Plan)
    assert {len(key) for key in plan.key if key} == {16}
    assert len(set(plan.key)) == 2, "parity of one is one: the chain is one key"
    assert max(sys.getsizeof(record.recipe.inputs) for record in plan.record if record) < 200
