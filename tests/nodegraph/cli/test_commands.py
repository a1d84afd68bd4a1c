"""Every command beside ``run``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nodegraph import __version__
from nodegraph.places import CACHE_VERSION


def lines(text: str) -> list[str]:
    return text.splitlines()


def test_plan_says_what_a_run_would_do_and_runs_nothing(cli, pair, ran):
    done = cli("plan", pair)
    assert done.status == 0
    rows = [line.split() for line in lines(done.out)]
    assert rows[0] == ["node", "type", "action", "bytes", "reason"]
    assert [row[:3] for row in rows[1:4]] == [
        ["a", "acme.number", "compute"],
        ["b", "acme.scale", "open"],
        ["file", "acme.export", "open"],
    ]
    assert "depends on input x" in done.out
    assert lines(done.out)[-1].startswith("3 nodes: 1 compute, 2 open; peak memory ")
    assert ran() == []
    assert not Path("out").exists()
    cli("run", pair)
    ran()
    assert "3 nodes: 3 cached; peak memory 0 B" in cli("plan", pair).out
    done = cli("plan", pair, "--set", "factor=3")
    assert "parameter by changed 2.0 -> 3.0" in done.out
    Path("out/pair/x.txt").unlink()
    done = cli("plan", pair)
    assert "rewrite" in done.out
    assert "file x.txt is missing" in done.out
    assert ran() == []


def test_plan_says_where_only_computing_tells_the_memory(cli, write_graph, here):
    graph = write_graph("g.json", {"n": {"type": "acme.number"}, "a": {"type": "acme.grid", "inputs": {"x": "n"}}})
    done = cli("plan", graph)
    assert [line.split()[3] for line in lines(done.out)[1:3]] == ["0", "unknown"], "a number is small"
    assert "peak memory at least 0 B" in done.out
    cli("run", graph)
    assert "peak memory 0 B" in cli("plan", graph).out


def test_plan_takes_every_option_of_run(cli, pair, tmp_path, ran):
    options = "--target b --set b.by=3 --out o --cache-dir c --cache-mode checked --force a --jobs 1 --device none"
    done = cli("plan", pair, *options.split(), "--report", "r", "--profile", "p", "--traceback")
    assert done.status == 0
    assert cli("plan", pair, "--no-cache", "--quiet") == (0, "", "")
    assert not Path("r").exists()
    assert ran() == []


def test_plan_of_what_will_fail(cli, write_graph, here):
    graph = write_graph(
        "g.json",
        {"r": {"type": "acme.reader", "params": {"path": "no.txt"}}, "a": {"type": "acme.number"}},
    )
    done = cli("plan", graph)
    assert done.status == 1
    assert "failed" in done.out
    missing = Path("no.txt").absolute()
    said = f"error: g.json: node 'r' (acme.reader): parameter 'path': No such file or directory: {missing}\n"
    assert done.err == said


def test_explain(cli, pair, ran):
    done = cli("explain", pair)
    assert lines(done.out) == [
        "a (acme.number) is computed: never computed.",
        "b (acme.scale) depends on input x: it is computed unless that comes out as before.",
        "file (acme.export) depends on input x: it is computed unless that comes out as before.",
    ]
    cli("run", pair)
    ran()
    assert all(" is cached: its result is known (" in line for line in lines(cli("explain", pair).out))
    done = cli("explain", pair, "b", "--set", "factor=4")
    assert lines(done.out) == ["b (acme.scale) is computed: parameter by changed 2.0 -> 4.0."]
    Path("out/pair/x.txt").write_text("changed")
    done = cli("explain", pair, "file")
    assert lines(done.out) == ["file (acme.export) is cached, but writes its files again: file x.txt was changed."]
    assert lines(cli("explain", pair, "a", "--force", "a").out) == ["a (acme.number) is computed: forced."]
    done = cli("explain", pair, "bb")
    assert done.status == 2
    assert "did you mean 'b'?" in done.err
    assert ran() == []


def test_explain_a_node_that_no_target_needs_and_one_that_fails(cli, write_graph, here):
    graph = write_graph(
        "g.json",
        {"r": {"type": "acme.reader", "params": {"path": "no.txt"}}, "a": {"type": "acme.number"}},
    )
    assert "r (acme.reader) fails: parameter 'path': No such file" in cli("explain", graph).out
    assert len(lines(cli("explain", graph, "a").out)) == 1


def test_validate(cli, pair, write_graph):
    assert cli("validate", pair) == (0, "pair.json: valid, 3 nodes\n", "")
    write_graph("outer.json", {"i": {"type": "graph", "params": {"path": "inner.json"}}})
    write_graph("inner.json", {"a": {"type": "acme.number"}, "b": {"type": "acme.number"}}, outputs={"o": "a"})
    assert cli("validate", "outer.json").out == "outer.json: valid, 1 node (2 steps with subgraphs and conversions)\n"
    assert cli("validate", pair, "--set", "b.by=text").status == 2


def test_nodes(cli):
    done = cli("nodes")
    assert done.status == 0
    listed = [line.split()[0] for line in lines(done.out)]
    assert "acme.number" in listed
    assert listed == sorted(listed)
    assert len(lines(cli("nodes", "number").out)) > 1
    assert cli("nodes", "multiply").out == cli("nodes", "SCALE UP").out == cli("nodes", "acme.scale").out
    done = cli("nodes", "acme.nmber")
    assert done.status == 2
    assert "did you mean 'acme.number'?" in done.err


def test_the_help_of_one_node(cli):
    done = cli("nodes", "acme.number")
    assert lines(done.out) == [
        "acme.number  Number, version 1",
        "",
        "Give a number, slowly enough to be worth storing.",
        "",
        "Outputs",
        "  out  Number",
        "",
        "Parameters",
        "  value  number -1e+06 to 1e+06 m; default 1.0.  What it gives.",
        "  seed   integer; default 0",
    ]
    out = cli("nodes", "acme.grid").out
    assert '  mode   "flat" or "steep"; default "flat"' in out
    assert "  x  Number, optional" in out
    assert "Looks at the whole of its inputs" in out
    out = cli("nodes", "acme.scale").out
    assert "Long words about multiplying." in out
    assert "  path  file to read; required" in cli("nodes", "acme.reader").out
    assert "  name  name of a file to write" in cli("nodes", "acme.export").out
    assert "  terms  Number, any number" in cli("nodes", "acme.add").out


def test_nodes_as_json(cli):
    data = json.loads(cli("nodes", "--json").out)
    assert {item["id"] for item in data} >= {"acme.number", "acme.scale"}
    (data,) = json.loads(cli("nodes", "acme.scale", "--json").out)
    assert data["title"] == "Scale up"
    assert data["version"] == 2
    assert data["inputs"] == [{"name": "x", "type": "Number", "optional": False, "variadic": False}]
    assert data["outputs"] == [{"name": "out", "type": "Number"}]
    assert data["parameters"]["properties"]["by"]["default"] == 2.0
    (data,) = json.loads(cli("nodes", "acme.number", "--json").out)
    value = data["parameters"]["properties"]["value"]
    assert (value["minimum"], value["maximum"], value["unit"]) == (-1e6, 1e6, "m")


def test_types(cli):
    out = cli("types").out
    assert "Picture          A picture, as it were." in out or "A picture, as it were." in out
    row = next(line for line in lines(out) if line.startswith("Boolean"))
    assert "Integer" not in row


def test_types_lists_the_formats_of_each(cli):
    from nodegraph import Format
    from nodegraph.plugins import registry

    def read(path):
        return None

    assert "is read from" not in cli("types").out, "where no plugin has any"
    picture = registry().find("acme.draw").outputs[0].type
    for owner, suffixes in (("first", (".pic", ".picture")), ("second", (".pic",)), ("third", (".dot", ""))):
        registry().formats().add(Format(picture, suffixes, "A picture", read=read), owner)
    rows = [row.split() for row in lines(cli("types").out) if "A picture" in row and "Picture" in row.split()[:1]]
    assert rows[-2:] == [
        ["Picture", "A", "picture", ".pic", ".picture", "first"],
        ["Picture", "A", "picture", ".dot", "(any", "other)", "third"],
    ]


def test_plugins(cli):
    out = cli("plugins").out
    row = next(line for line in lines(out) if line.startswith("acme"))
    assert "1.5" in row
    assert "acme (11 nodes)" in row
    assert row.endswith("plugin.py")


def test_no_plugins(cli, monkeypatch):
    from nodegraph.plugins import registry

    registry.cache_clear()
    monkeypatch.setattr("nodegraph.plugins.entry_points", lambda group: [])
    assert cli("plugins").out == "no plugins are installed\n"
    assert cli("nodes", "x").status == 2


def test_devices(cli, monkeypatch):
    from nodegraph.opencl import DeviceInfo

    info = DeviceInfo("0:1", "Some platform", "Some GPU", "gpu", "3.0", "1", 64, 8 * 10**9, 10**9, False)

    class Chosen:
        def __init__(self):
            self.info = info

    monkeypatch.setattr("nodegraph.opencl.list_devices", lambda: [info])
    monkeypatch.setattr("nodegraph.opencl.choose", lambda spec: Chosen())
    done = cli("devices")
    assert done.status == 0
    assert " ".join(lines(done.out)[1].split()) == "0:1 gpu Some GPU 64 units 8.0 GB auto Some platform"
    monkeypatch.setattr("nodegraph.opencl.list_devices", list)
    assert cli("devices").out == "no OpenCL devices: nodes run without one\n"


def test_schema(cli):
    data = json.loads(cli("schema").out)
    assert data["$schema"].startswith("https://json-schema.org/")


def test_show(cli, pair):
    assert lines(cli("show", pair).out) == [
        "A pair (pair.json)",
        "  a     acme.number  value=3",
        "  b     acme.scale   x <- a",
        "  file  acme.export  x <- b",
    ]
    out = cli("show", pair, "--format", "mermaid").out
    assert lines(out)[0] == "flowchart LR"
    assert '  n0["a<br/><small>acme.number</small>"]' in out
    assert '  n0 -->|"x"| n1' in out
    out = cli("show", pair, "--format", "dot").out
    assert lines(out)[0] == 'digraph "A pair" {'
    assert '  "a" -> "b" [label="x"]' in out
    assert lines(out)[-1] == "}"


def test_show_what_cannot_run(cli, write_graph, here):
    graph = write_graph(
        "g.json",
        {
            "a": {"type": 'no."such"\\', "params": {"long": "x" * 99}},
            "b": {"type": "gone.b", "inputs": {"p": ["a.o", "c"]}},
        },
        title='"<&#',
    )
    for kind in ("text", "mermaid", "dot"):
        assert cli("show", graph, "--format", kind).status == 0
    assert '"no.\\"such\\"\\\\"' in cli("show", graph, "--format", "dot").out.replace("a\\n", "")
    assert "#quot;such#quot;" in cli("show", graph, "--format", "mermaid").out
    assert "o > p" in cli("show", graph, "--format", "dot").out


def test_preview(cli, write_graph, here, ran):
    graph = write_graph(
        "g.json",
        {
            "a": {"type": "acme.number", "params": {"value": 5}},
            "d": {"type": "acme.draw", "inputs": {"x": "a"}},
            "bad": {"type": "acme.fails"},
            "bd": {"type": "acme.draw", "inputs": {"x": "bad"}},
            "f": {"type": "acme.export", "inputs": {"x": "a"}},
        },
    )
    done = cli("preview", graph, "d", "-o", "d.png")
    assert done == (0, "wrote d.png\n", "")
    assert Path("d.png").read_bytes() == b"\x89PNG 5"
    assert ran() == ["number"]
    assert cli("preview", graph, "d.out", "-o", "sub/e.png", "--set", "a.value=6").status == 0
    assert Path("sub/e.png").read_bytes() == b"\x89PNG 6"
    assert not Path("out").exists()
    done = cli("preview", graph, "a", "-o", "a.png")
    assert done.status == 2
    assert "node 'a' gives Number, which no installed plugin draws" in done.err
    done = cli("preview", graph, "bd", "-o", "b.png")
    assert done.status == 1
    assert "node 'bad' (acme.fails): no luck" in done.err
    assert cli("preview", graph, "dd", "-o", "b.png").status == 2
    assert not Path("b.png").exists()
    done = cli("preview", graph, "d", "-o", ".")
    assert done.status == 2
    assert len(lines(done.err)) == 1


def test_cache_commands(cli, pair, tmp_path):
    folder = tmp_path / "cache"
    for command in ("info", "verify", "gc", "clear"):
        done = cli("cache", command)
        assert done.status == 0
        assert "nothing is remembered" in done.out
    assert not folder.exists()
    cli("run", pair)
    out = cli("cache", "info").out
    assert str(folder / f"v{CACHE_VERSION}") in out
    assert any(line.split() == ["results", "3"] for line in lines(out))
    assert cli("cache", "verify").out == "all is right\n"
    for path in folder.glob(f"v{CACHE_VERSION}/values/*/*.h5"):
        path.write_bytes(path.read_bytes()[:-1])
    done = cli("cache", "verify")
    assert "the checksum does not match; removed" in done.out
    assert "removed" in lines(done.out)[-1]
    assert cli("cache", "gc", "--max-size", "0").out.startswith("freed ")
    assert cli("cache", "gc").out.startswith("freed ")
    assert cli("cache", "clear", "--cache-dir", folder).out.startswith("freed ")
    assert any(line.split() == ["results", "0"] for line in lines(cli("cache", "info").out))


@pytest.mark.parametrize(
    ("size", "status"), [("5GB", 0), ("1.5 mb", 0), ("12", 0), ("7kb", 0), ("lots", 2), ("-1", 2), ("5XB", 2)]
)
def test_sizes(cli, pair, size, status):
    cli("run", pair)
    assert cli("cache", "gc", "--max-size", size).status == status


OLD = """{
  "format": "nodegraph/1",
  "nodes": {
    "a": {"type": "acme.number", "version": 1},
    "b": {"type": "acme.factor", "version": 1, "inputs": {"x": "a"}, "params": {"f": 3}},
    "s": {"type": "strange.thing", "odd": [1, 2]}
  },
  "parameters": {"k": {"default": 4, "drives": ["b.f"]}}
}
"""


def test_upgrade(cli, here):
    path = Path("old.json")
    path.write_text(OLD)
    done = cli("upgrade", path, "--dry-run")
    assert done.status == 0
    assert path.read_text() == OLD
    assert '-    "b": {"type": "acme.factor"' in done.out
    assert '+    "b": {"type": "acme.scale", "version": 2' in done.out
    done = cli("upgrade", path)
    assert lines(done.out)[-1] == "wrote old.json"
    data = json.loads(path.read_text())
    assert data["nodes"]["b"] == {"type": "acme.scale", "version": 2, "inputs": {"x": "a"}, "params": {"by": 3}}
    assert data["nodes"]["s"] == {"type": "strange.thing", "odd": [1, 2]}
    assert data["parameters"]["k"]["drives"] == ["b.by"]
    assert cli("upgrade", path).out == "old.json is up to date\n"


def test_an_old_graph_runs_without_an_upgrade(cli, here):
    path = Path("old.json")
    data = json.loads(OLD)
    del data["nodes"]["s"]
    path.write_text(json.dumps(data))
    assert cli("run", path, "--set", "k=5").status == 0


def test_version():
    assert __version__.count(".") == 2
