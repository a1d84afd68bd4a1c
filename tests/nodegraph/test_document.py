"""The graph file: what is read is kept, what is wrong is named, and nothing but `GraphError` ever comes of it."""

from __future__ import annotations

import copy
import json
import math
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Graph, GraphError, jsontext
from nodegraph.document import Document
from tests.nodegraph import support as toy

REGISTRY = toy.toy_registry()
HEAD = '{"format": "nodegraph/1", "nodes": '


def load(data: Any) -> Graph:
    text = data if isinstance(data, (str, bytes)) else json.dumps(data)
    return Graph.from_json(text, registry=REGISTRY)


def problems(data: Any) -> list[str]:
    with pytest.raises(GraphError) as caught:
        load(data).validate()
    return [str(problem) for problem in caught.value.problems]


def document(**sections: Any) -> dict[str, Any]:
    return {"format": "nodegraph/1", "nodes": {"a": {"type": "toy.number"}}, **sections}


# Any document survives.

texts = st.text(st.characters(codec="utf-8"), max_size=8)
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=8,
)
ids = st.from_regex(r"[\w-]{1,8}", fullmatch=True)
known_keys = {"type", "version", "params", "inputs", "note"}


@st.composite
def records(draw: Any, names: list[str]) -> dict[str, Any]:
    """A node record, of a known type or of one nobody knows, with whatever another program put beside."""
    record: dict[str, Any] = {
        "type": draw(st.sampled_from(["toy.increase", "toy.add", "acme.unknown", "graph", "weird"]))
    }
    link = st.sampled_from(names) | st.sampled_from(names).map(lambda name: f"{name}.out")
    if draw(st.booleans()):
        record["params"] = draw(st.dictionaries(texts, values, max_size=3))
    if draw(st.booleans()):
        record["inputs"] = draw(st.dictionaries(texts, link | st.lists(link, max_size=3), max_size=3))
    if draw(st.booleans()):
        record["version"] = draw(st.integers(1, 9))
    extra = draw(st.dictionaries(texts.filter(lambda key: key not in known_keys), values, max_size=2))
    items = draw(st.permutations([*record.items(), *extra.items()]))
    return dict(items)


@st.composite
def documents(draw: Any) -> dict[str, Any]:
    names = draw(st.lists(ids, min_size=1, max_size=6, unique=True))
    sections: dict[str, Any] = {"format": "nodegraph/1", "nodes": {name: draw(records(names)) for name in names}}
    if draw(st.booleans()):
        sections["title"] = draw(texts)
    if draw(st.booleans()):
        sections["layout"] = draw(st.dictionaries(texts, values, max_size=3))
    if draw(st.booleans()):
        drives = st.lists(st.sampled_from(names).map(lambda name: f"{name}.p"), min_size=1, max_size=2)
        entry = st.fixed_dictionaries({"drives": drives}, optional={"default": values, "note": texts})
        sections["parameters"] = draw(st.dictionaries(texts, entry, max_size=2))
    return dict(draw(st.permutations(list(sections.items()))))


@given(
    data=documents(),
    indent=st.sampled_from([None, 0, 1, 4, "\t"]),
    ascii_only=st.booleans(),
    end=st.sampled_from(["", "\n", "\r\n "]),
)
def test_an_unchanged_document_is_saved_byte_for_byte(
    tmp_path_factory: pytest.TempPathFactory, data: Any, indent: Any, ascii_only: bool, end: str
) -> None:
    text = json.dumps(data, indent=indent, ensure_ascii=ascii_only) + end
    path = tmp_path_factory.getbasetemp() / "unchanged.json"
    path.write_bytes(text.encode())
    graph = Graph.load(path, registry=REGISTRY)
    assert graph.data == data
    assert list(graph.nodes) == list(data["nodes"])
    graph.save()
    assert path.read_bytes() == text.encode()


@given(data=documents())
def test_house_style_is_stable_and_loses_nothing(data: Any) -> None:
    text = jsontext.write(data)
    again = load(text)
    assert again.data == data
    assert json.dumps(again.data) == json.dumps(data), "the order and the types of numbers stay, too"
    assert jsontext.write(again.data) == text


@given(data=documents())
def test_an_edit_changes_only_what_it_says(data: Any) -> None:
    graph = load(data)
    graph.set(f"{next(iter(data['nodes']))}.newcomer", 3)
    graph._section("layout")["a"] = [0, 0]
    after = load(graph.to_json())
    expected = copy.deepcopy(data)
    next(iter(expected["nodes"].values())).setdefault("params", {})["newcomer"] = 3
    expected.setdefault("layout", {})["a"] = [0, 0]
    assert after.data == expected
    assert list(after.nodes) == list(data["nodes"])
    for id, record in data["nodes"].items():
        assert [key for key in after.nodes[id] if key in record] == list(record)


def test_a_change_and_back_is_no_change() -> None:
    text = '{ "nodes" : {"a":{"type":"toy.number","params":{"value":1e0}}},\n"format":"nodegraph/1"}'
    graph = load(text)
    graph.set("a.value", 2.0)
    assert graph.to_json() != text
    graph.set("a.value", 1.0)
    assert graph.to_json() == text


def test_line_ends_and_byte_order_mark_stay(tmp_path: Path) -> None:
    path = tmp_path / "g.json"
    content = b'\xef\xbb\xbf{"format": "nodegraph/1",\r\n "nodes": {"a": {"type": "toy.number"}}}\r\n'
    path.write_bytes(content)
    graph = Graph.load(path, registry=REGISTRY)
    graph.validate()
    graph.save()
    assert path.read_bytes() == content
    assert Graph.from_json(graph.to_json(), registry=REGISTRY).data == graph.data


def test_house_style_keeps_one_node_a_line() -> None:
    graph = toy.toy_graph(title="Ümläut")
    graph.add("toy.number", "a", value=2.0)
    graph.add("toy.increase", "b", x="a")
    assert graph.to_json() == (
        "{\n"
        '  "format": "nodegraph/1",\n'
        '  "title": "Ümläut",\n'
        '  "nodes": {\n'
        '    "a": {"type": "toy.number", "version": 1, "params": {"value": 2.0}},\n'
        '    "b": {"type": "toy.increase", "version": 1, "inputs": {"x": "a"}}\n'
        "  }\n"
        "}\n"
    )


def test_a_placeholder_loses_nothing_and_only_running_it_fails(tmp_path: Path) -> None:
    record = {
        "odd": {"deep": [1, 2.0, None, "x"]},
        "type": "acme.carve",
        "version": 7,
        "params": {"z": 1, "a": [2]},
        "inputs": {"surface": "a.out", "many": ["a", "a"]},
        "node_for_adding": 1,
        "": "",
    }
    data = document()
    data["nodes"]["carve"] = record
    graph = load(data)
    graph.set("a.value", 9.0)
    path = graph.save(tmp_path / "g.json")
    again = Graph.load(path, registry=REGISTRY)
    assert again.data["nodes"]["carve"] == record
    assert list(again.nodes["carve"]) == list(record)
    assert again.to_networkx().nodes["carve"]["params"] == {"z": 1, "a": [2]}
    with pytest.raises(GraphError, match="install the plugin that brings the family 'acme'"):
        again.run(cache=toy.memory_cache())


def test_saving_is_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = load(document())
    path = graph.save(tmp_path / "g.json")
    before = path.read_bytes()
    graph.set("a.value", 5.0)

    def full(self: Path, target: Any) -> Path:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", full)
        with pytest.raises(OSError, match="No space"):
            graph.save()
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["g.json"]


# What is wrong.


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("   \n", "the file is empty"),
        ("{", "not JSON: .* at line 1, column 2"),
        ('{"format": "nodegraph/1",\n "nodes": {,}}', "not JSON: .* at line 2, column 12"),
        ("nothing", "not JSON"),
        ("[]", "a graph is a JSON object, not a list"),
        ("3", "a graph is a JSON object, not a number"),
        ("null", "a graph is a JSON object, not null"),
        ('"text"', "a graph is a JSON object, not a string"),
        ("{}", "'format' is missing"),
        ('{"nodes": {}}', "'format' is missing"),
        ('{"format": "nodegraph/2", "nodes": {}}', "newer than this program reads.*upgrade nodegraph"),
        ('{"format": "nodegraph/0", "nodes": {}}', "never existed"),
        ('{"format": "nodegraph", "nodes": {}}', "is not a nodegraph format; expected 'nodegraph/1'"),
        ('{"format": 1, "nodes": {}}', "is not a nodegraph format"),
        ('{"format": "nodegraph/1"}', "'nodes' is missing"),
        (HEAD + "{}}", "the graph has no nodes"),
        (HEAD + "[]}", "'nodes' should be an object, not a list"),
        (HEAD + '{"a": {"type": "t.x"}, "a": {"type": "t.y"}}}', "the name 'a' stands twice"),
        (HEAD + '{"a": {"type": "t.x", "params": {"p": 1, "p": 2}}}}', "the name 'p' stands twice"),
        (HEAD + '{"a": {"type": "t.x", "params": {"p": NaN}}}}', "NaN is not a JSON number"),
        (HEAD + '{"a": {"type": "t.x", "params": {"p": -Infinity}}}}', "-Infinity is not a JSON number"),
        (HEAD + '{"a": {"type": "t.x", "params": {"p": 1e400}}}}', "1e400 is not a JSON number"),
        (HEAD + '{"a": {"type": "t.x", "params": {"p": -1e999}}}}', "-1e999 is not a JSON number"),
        (HEAD + '{"a": {"type": "t.x", "params": {"p": ' + "9" * 5000 + "}}}}", "a number is too long to read"),
        (HEAD + '{"a b": {"type": "t.x"}}}', "node id 'a b' may hold only letters"),
        (HEAD + '{"": {"type": "t.x"}}}', "node id '' may hold only letters"),
        (HEAD + '{"a.b": {"type": "t.x"}}}', "node id 'a.b' may hold only letters"),
        (HEAD + '{"a": {}}}', "node 'a': 'type' is missing"),
        (HEAD + '{"a": 3}}', "node 'a': must be a JSON object, not a number"),
        (HEAD + '{"str": {}}}', "node 'str': 'type' is missing"),
        (HEAD + '{"a": {"type": 3}}}', "node 'a': 'type' should be a string, not a number"),
        (HEAD + '{"a": {"type": "t.x", "version": 0}}}', "'version' should be greater than or equal to 1"),
        (
            HEAD + '{"a": {"type": "t.x", "version": "1"}}}',
            "'version' should be a integer|'version' should be an integer",
        ),
        (HEAD + '{"a": {"type": "t.x", "params": []}}}', "'params' should be an object, not a list"),
        (HEAD + '{"a": {"type": "t.x", "inputs": {"str": 3}}}}', "node 'a': 'inputs.str' should be"),
        (HEAD + '{"a": {"type": "t.x"}}, "titel": ""}', "unknown key 'titel'; did you mean 'title'?"),
        (HEAD + '{"a": {"type": "t.x"}}, "title": 3}', "'title' should be a string, not a number"),
        (HEAD + '{"a": {"type": "t.x"}}, "parameters": {"p": {}}}', "'parameters.p.drives' is missing"),
        (HEAD + '{"a": {"type": "t.x"}}, "parameters": {"p": {"drives": []}}}', "at least 1 item"),
        (
            HEAD + '{"a": {"type": "t.x"}}, "parameters": {"p": {"drives": ["a.x"], "defualt": 1}}}',
            "did you mean 'default'",
        ),
        (HEAD + '{"a": {"type": "t.x"}}, "outputs": {"o": ["a"]}}', "'outputs.o' should be a string, not a list"),
        (HEAD + '{"a": {"type": "t.x"}}, "title": "\\ud800"}', "surrogate"),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(text: str, message: str) -> None:
    with pytest.raises(GraphError, match=message) as caught:
        load(text)
    assert caught.value.exit_status == 2
    for problem in caught.value.problems:
        assert problem.where.startswith("graph")
        assert "\n" not in str(problem)
        assert len(str(problem)) < 300


@pytest.mark.parametrize("opening", ["[", '{"a":', '[{"a":'])
@pytest.mark.parametrize("depth", [150, 500, 990, 100_000])
def test_deep_nesting_is_refused(opening: str, depth: int) -> None:
    closing = {"[": "]", '{"a":': "}", '[{"a":': "}]"}[opening]
    nested = opening * depth + "1" + closing * depth
    for text in (nested, HEAD + '{"a": {"type": "toy.number", "params": {"tag": ' + nested + "}}}}"):
        with pytest.raises(GraphError, match=r"nested too deeply|JSON object, not a list|'format' is missing"):
            load(text)


def test_moderate_nesting_is_kept() -> None:
    value: Any = 1
    for _ in range(40):
        value = [value]
    graph = load(document(layout={"a": value}))
    graph.set("a.value", 2.0)
    assert load(graph.to_json()).data["layout"]["a"] == value
    graph.upgraded().validate()


@pytest.mark.parametrize(
    "content", [b"\xff\xfe{\x00", b"\x80", b'{"title": "\xe9"}', "{}".encode("utf-16"), b"\0" * 100]
)
def test_other_bytes_are_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "g.json"
    path.write_bytes(content)
    with pytest.raises(GraphError, match=r"g\.json: not (UTF-8|JSON)"):
        Graph.load(path, registry=REGISTRY)


def test_all_problems_of_the_form_are_listed_at_once() -> None:
    text = HEAD + '{"a": {"type": 3}, "b": {"params": {}}, "c": []}, "titel": 1, "layout": 3}'
    found = problems(text)
    assert len(found) == 5
    assert [name for name in ("'a'", "'b'", "'c'", "'titel'", "'layout'") if any(name in item for item in found)] == [
        "'a'",
        "'b'",
        "'c'",
        "'titel'",
        "'layout'",
    ]


def test_a_wrong_link_is_one_problem() -> None:
    assert len(problems(HEAD + '{"a": {"type": "t.x", "inputs": {"x": 3}}}}')) == 1
    assert len(problems(HEAD + '{"a": {"type": "t.x", "inputs": {"x": ["a", 3]}}}}')) == 1


@pytest.mark.parametrize("name", ["absent.json", "folder", "a/b/c.json"])
def test_a_file_that_cannot_be_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(GraphError, match="cannot be read"):
        Graph.load(tmp_path / name)


def test_a_path_no_file_can_have() -> None:
    with pytest.raises(GraphError, match="cannot be read"):
        Graph.load("a\0b.json")


def test_a_graph_file_with_a_name_that_is_no_text(tmp_path: Path) -> None:
    """Names of files are bytes; Python holds the odd ones as lone surrogates."""
    from nodegraph.cache import Cache

    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/gr\xffaph.json"))
    graph = load(document())
    try:
        graph.save(path)
    except OSError:
        pytest.skip("the file system takes only names in UTF-8")
    for _ in range(2):
        assert Graph.load(path, registry=REGISTRY).run(cache=Cache(tmp_path / "cache"))["a"] == 1.0


# Whatever is done to a valid file, only GraphError comes of it.

VALID = json.dumps(
    {
        "format": "nodegraph/1",
        "title": "Välid",
        "requires": {},
        "parameters": {"by": {"default": 2, "drives": ["b.by"]}},
        "outputs": {"sum": "c.out"},
        "nodes": {
            "a": {"type": "toy.number", "params": {"value": 1.5, "tag": "x"}},
            "b": {"type": "toy.increase", "version": 1, "inputs": {"x": "a"}, "note": "n"},
            "c": {"type": "toy.add", "inputs": {"terms": ["a", "b.out"]}},
            "d": {"type": "toy.halves", "inputs": {"x": "c"}},
            "e": {"type": "graph", "params": {"path": "absent.json"}},
            "f": {"type": "toy.export", "inputs": {"x": "d.high"}, "params": {"name": "f.txt"}},
            "g": {"type": "toy.read", "params": {"path": "words.txt"}},
        },
        "layout": {"a": [0, 0]},
    }
).encode()


def only_graph_errors(text: bytes) -> None:
    try:
        graph = Graph.from_json(text, registry=REGISTRY)
        assert load(graph.to_json()).data == graph.data
        graph.set_output("more", "a") if "a" in graph else None
        graph.upgraded().to_json().encode()
        graph.to_networkx()
        graph.validate()
    except GraphError as error:
        found = error
    else:
        return
    assert found.problems
    assert all(problem.message for problem in found.problems)
    str(found).encode()


@settings(max_examples=300)
@given(data=st.data())
def test_mutated_bytes_never_give_anything_but_graph_errors(data: Any) -> None:
    text = bytearray(VALID)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text)))
        kind = data.draw(st.sampled_from(["flip", "insert", "delete", "repeat", "cut"]))
        if kind == "flip" and at < len(text):
            text[at] = data.draw(st.integers(0, 255))
        elif kind == "insert":
            text[at:at] = data.draw(
                st.sampled_from([b'"', b"{", b"[", b"\\u0000", b"\\ud800", b"1e999", b",", b"null", b"\xff", b"~"])
            )
        elif kind == "delete":
            del text[at : at + data.draw(st.integers(1, 20))]
        elif kind == "repeat":
            text[at:at] = text[at : at + data.draw(st.integers(1, 60))]
        else:
            del text[at:]
    only_graph_errors(bytes(text))


odd = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from(
        [10**400, -1, 1e308, "", ".", "a", "a.", ".out", "graph", "toy.", "..", "a.out.x", "\0", "~x/y", "é\u2028"]
    )
    | st.lists(st.sampled_from(["a", "b.out", ""]), max_size=3)
    | st.dictionaries(st.sampled_from(["", "a", "x", "path", "type"]), st.sampled_from([1, "a", None, {}]), max_size=2)
)


@settings(max_examples=400)
@given(data=st.data())
def test_mutated_structure_never_gives_anything_but_graph_errors(data: Any) -> None:
    document: Any = json.loads(VALID)
    for _ in range(data.draw(st.integers(1, 3))):
        places: list[tuple[Any, Any]] = []
        stack = [document]
        while stack:
            item = stack.pop()
            keys = list(item) if isinstance(item, dict) else range(len(item))
            places += [(item, key) for key in keys]
            stack += [item[key] for key in keys if isinstance(item[key], (dict, list))]
        if not places:
            break
        holder, key = data.draw(st.sampled_from(places))
        kind = data.draw(st.sampled_from(["replace", "remove", "rename", "copy"]))
        if kind == "replace":
            holder[key] = data.draw(odd)
        elif kind == "remove":
            del holder[key]
        elif kind == "rename" and isinstance(holder, dict):
            holder[data.draw(st.sampled_from(["", "x", "type", "path", "a", "valeu", "\0"]))] = holder.pop(key)
        else:
            other, there = data.draw(st.sampled_from(places))
            if isinstance(other, dict) or there < len(other):
                other[there] = copy.deepcopy(holder[key])
    only_graph_errors(json.dumps(document).encode())


# The schema agrees.


def test_the_schema_of_the_document_describes_every_key() -> None:
    jsonschema = pytest.importorskip("jsonschema")
    schema = Document.model_json_schema(by_alias=True)
    validator = jsonschema.Draft202012Validator(schema)
    assert validator.is_valid(json.loads(VALID))
    assert not validator.is_valid({**json.loads(VALID), "titel": "x"})


def test_numbers_keep_their_kind() -> None:
    graph = load(document(layout={"a": [1, 1.0, -0.0, 10**30, 1e22, 0.1]}))
    graph.set("a.value", 2.0)
    kept = load(graph.to_json()).data["layout"]["a"]
    assert [type(item) for item in kept] == [int, float, float, int, float, float]
    assert math.copysign(1, kept[2]) == -1
    assert kept[3:] == [10**30, 1e22, 0.1]
