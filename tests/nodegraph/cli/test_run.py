"""``nodegraph run``: what it does, prints, and returns."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nodegraph.places import CACHE_VERSION


def lines(text: str) -> list[str]:
    return text.splitlines()


def test_first_run_computes_and_second_is_cached(cli, pair, ran):
    done = cli("run", pair)
    assert done.status == 0
    assert [line.split()[:2] for line in lines(done.out)[:3]] == [
        ["computed", "a"],
        ["computed", "b"],
        ["computed", "file"],
    ]
    assert all(line.endswith("never computed") for line in lines(done.out)[:3])
    assert lines(done.out)[3].startswith("3 nodes: 3 computed (")
    assert lines(done.out)[4:] == ["wrote out/pair/x.txt"]
    assert Path("out/pair/x.txt").read_text() == "6\n"
    assert not done.err
    before = Path("out/pair/x.txt").stat()
    assert ran() == ["export", "number", "scale"]

    done = cli("run", pair)
    assert done.status == 0
    assert lines(done.out)[0].startswith("3 nodes: 3 cached (")
    assert lines(done.out)[1:] == ["kept out/pair/x.txt"]
    assert Path("out/pair/x.txt").stat() == before
    assert ran() == []


def test_set_recomputes_what_follows_with_reasons_and_leaves_the_file(cli, pair, ran):
    text = pair.read_text()
    cli("run", pair)
    ran()
    done = cli("run", pair, "--set", "b.by=5")
    assert done.status == 0
    assert "parameter by changed 2.0 -> 5.0" in done.out
    assert "input x changed" in done.out
    assert "1 cached" in done.out
    assert ran() == ["export", "scale"]
    assert Path("out/pair/x.txt").read_text() == "15\n"
    assert pair.read_text() == text
    # Set back, every result is known; only the file has to be made again.
    done = cli("run", pair, "--set", "factor=2")
    assert "wrote out/pair/x.txt" in done.out
    assert "number" not in ran()
    assert Path("out/pair/x.txt").read_text() == "6\n"


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("a.valeu=1", "did you mean 'value'?"),
        ("c.value=1", "no node 'c' to set 'value' of"),
        ("facto=1", "did you mean 'factor'?"),
        ("a.value", "write it as NODE.PARAM=VALUE"),
        ("=1", "write it as NODE.PARAM=VALUE"),
        ("a.value=NaN", "NaN is not a JSON number"),
        ("a.value=1e400", "1e400 is not a JSON number"),
        ("a.value=1e9", "less than or equal to 1000000"),
        ("a.value=much", "parameter 'value'"),
        ('a.value={"x": 1, "x": 2}', "'x' stands twice"),
        ("a.value=" + "[" * 5000 + "]" * 5000, "nested too deeply"),
    ],
)
def test_wrong_settings(cli, pair, setting, said):
    done = cli("run", pair, "--set", setting)
    assert done.status == 2
    assert done.err.startswith("error: ")
    assert said in done.err
    assert len(lines(done.err)) == 1
    assert not Path("out").exists()


def test_set_takes_texts_that_are_no_json(cli, write_graph, here):
    graph = write_graph("g.json", {"g": {"type": "acme.grid"}})
    assert cli("run", graph, "--set", "g.label=two words", "--set", "g.mode=steep", "--set", "g.n=2").status == 0
    report = Path("r.json")
    cli("run", graph, "-s", 'g.label="3"', "--report", report)
    assert "label" in cli("run", graph, "--set", "g.label=3").err


def test_targets_out_and_no_cache(cli, pair, ran, tmp_path):
    done = cli("run", pair, "--target", "b")
    assert done.status == 0
    assert "2 nodes: 2 computed" in done.out
    assert cli("run", pair, "--out", "there", "-t", "file").status == 0
    assert Path("there/x.txt").exists()
    ran()
    assert cli("run", pair, "--no-cache", "--out", "there").status == 0
    assert ran() == ["export", "number", "scale"]
    done = cli("run", pair, "-t", "bb")
    assert done.status == 2
    assert "did you mean 'b'?" in done.err
    done = cli("run", pair, "-t", "b.outt")
    assert "did you mean 'out'?" in done.err


def test_cache_dir_is_used(cli, pair, tmp_path):
    cli("run", pair, "--cache-dir", tmp_path / "other")
    assert (tmp_path / "other" / f"v{CACHE_VERSION}" / "index.sqlite").exists()
    assert not (tmp_path / "cache").exists()
    assert "3 cached" in cli("run", pair, "--cache-dir", tmp_path / "other").out


def test_force(cli, pair, ran):
    cli("run", pair)
    ran()
    done = cli("run", pair, "--force", "a")
    assert "computed  a" in done.out
    assert "forced" in done.out
    assert ran()[0] == "number"
    assert "did you mean" in cli("run", pair, "--force", "fil").err


def test_checked(cli, pair, ran):
    cli("run", pair)
    ran()
    done = cli("run", pair, "--cache-mode", "checked")
    assert done.status == 0
    assert ran() == ["export", "number", "scale"]
    assert "checked against the cache" in done.out


def test_jobs(cli, write_graph, here):
    nodes = {f"n{i}": {"type": "acme.patient", "params": {"seconds": 0.3}} for i in range(4)}
    nodes["sum"] = {"type": "acme.add", "inputs": {"terms": [f"n{i}" for i in range(4)]}}
    for number, limits in ((1, (1.2, 60)), (4, (0.3, 1.15))):
        for i in range(4):
            nodes[f"n{i}"]["params"]["seconds"] = 0.3 + 1e-3 * i + 1e-5 * number
        graph = write_graph(f"g{number}.json", nodes)
        report = Path("r.json")
        assert cli("run", graph, "--jobs", number, "--report", report).status == 0
        assert limits[0] < json.loads(report.read_text())["run"]["seconds"] < limits[1]


def test_a_failing_node_fails_its_descendants_only(cli, write_graph, here):
    graph = write_graph(
        "g.json",
        {
            "bad": {"type": "acme.fails"},
            "after": {"type": "acme.scale", "inputs": {"x": "bad"}},
            "good": {"type": "acme.number"},
            "file": {"type": "acme.export", "inputs": {"x": "good"}},
        },
    )
    done = cli("run", graph)
    assert done.status == 1
    assert done.err == "error: g.json: node 'bad' (acme.fails): no luck\n"
    assert "failed    bad: no luck" in done.out
    assert "4 nodes: 2 computed, 1 skipped, 1 failed" in done.out
    assert Path("out/g/x.txt").exists()
    done = cli("run", graph, "--quiet")
    assert done == (1, "", "error: g.json: node 'bad' (acme.fails): no luck\n")


def test_traceback_only_when_asked(cli, write_graph, here):
    graph = write_graph("g.json", {"bad": {"type": "acme.fails"}})
    assert "Traceback" not in cli("run", graph).err
    done = cli("run", graph, "--traceback")
    assert "Traceback" in done.err
    assert 'raise ValueError("no luck")' in done.err
    Path("bad.json").write_text("{")
    assert "Traceback" in cli("run", "bad.json", "--traceback").err


def test_wrong_return_type(cli, write_graph, here):
    done = cli("run", write_graph("g.json", {"a": {"type": "acme.lies"}}))
    assert done.status == 1
    assert "expected Number, got Text" in done.err


def test_missing_input_file(cli, write_graph, here):
    done = cli("run", write_graph("g.json", {"a": {"type": "acme.reader", "params": {"path": "no.txt"}}}))
    assert done.status == 1
    assert len(lines(done.err)) == 1
    assert "no.txt" in done.err
    assert "No such file" in done.err


def test_outputs_that_cannot_be_written(cli, pair):
    Path("taken").write_text("a file")
    done = cli("run", pair, "--out", "taken")
    assert done.status == 1
    assert "cannot write" in done.err
    assert "--out" in done.err
    assert Path("taken").read_text() == "a file"


def test_a_cache_that_cannot_be_written_costs_a_warning(cli, pair):
    Path("taken").write_text("a file")
    done = cli("run", pair, "--cache-dir", "taken")
    assert done.status == 0
    assert done.err.startswith("warning: the cache folder")
    assert cli("run", pair, "--cache-dir", "taken", "--quiet").err == ""


def test_a_damaged_index_costs_a_warning(cli, pair, tmp_path):
    cli("run", pair)
    for path in (tmp_path / "cache" / f"v{CACHE_VERSION}").glob("index.sqlite*"):
        path.write_bytes(b"no database" * 100)
    done = cli("run", pair)
    assert done.status == 0
    assert "warning: " in done.err
    assert "3 nodes" in done.out


def test_quiet_prints_nothing(cli, pair):
    assert cli("run", pair, "--quiet") == (0, "", "")
    assert cli("run", pair, "-q") == (0, "", "")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the file is empty"),
        ("nodes: 3", "not JSON"),
        ("[]", "a graph is a JSON object"),
        ('{"nodes": {}}', "'format' is missing"),
        ('{"format": "svg/1", "nodes": {}}', "is not a nodegraph format"),
        ('{"format": "nodegraph/2", "nodes": {}}', "newer than this program reads"),
        ('{"format": "nodegraph/1", "nodes": {}}', "the graph has no nodes"),
        ('{"format": "nodegraph/1", "nodes": {"a": {"type": "acme.nmber"}}}', "did you mean 'acme.number'?"),
        ('{"format": "nodegraph/1", "nodes": {"a": {"type": "alpha.x"}}}', "install the plugin"),
        ('{"format": "nodegraph/1", "nodes": {"a": {"type": "acme.scale"}}}', "input 'x': is not linked"),
        ('{"format": "nodegraph/1", "nodes": {"a": {"type": "acme.scale", "inputs": {"x": "b"}}}}', "no node 'b'"),
        ('{"format": "nodegraph/1", "nodes": {"a": {"type": "acme.scale", "inputs": {"x": "a"}}}}', "a -> a"),
        ('{"format": "nodegraph/1", "nodes": {"a": {"type": "acme.number"}, "a": {}}}', "stands twice"),
        ('{"format": "nodegraph/1", "nodes": {"a": {"type": "acme.number", "params": {"value": NaN}}}}', "NaN"),
        ('{"format": "nodegraph/1", "nodes": {"a": {"type": "acme.number", "params": {"value": 1e400}}}}', "1e400"),
        ('{"format": "nodegraph/1", "nodes": {"a": ' + "[" * 10**5 + "]" * 10**5 + "}}", "nested too deeply"),
        (
            '{"format": "nodegraph/1", "nodes": {"a": {"type": "acme.number"}}, "requires": {"nope": ">=1"}}',
            "not installed",
        ),
        ('{"format": "nodegraph/1", "nodes": {"a": {"type": "acme.number"}}, "requires": {"acme": ">=2"}}', "1.5"),
    ],
)
@pytest.mark.parametrize("command", ["run", "plan", "validate"])
def test_wrong_graphs(cli, here, command, text, said):
    Path("g.json").write_text(text)
    done = cli(command, "g.json")
    assert done.status == 2
    assert not done.out
    assert said in done.err
    assert all(line.startswith("error: g.json: ") for line in lines(done.err))
    assert not Path("out").exists()


def test_all_problems_at_once(cli, write_graph, here):
    graph = write_graph(
        "g.json",
        {
            "a": {"type": "acme.number", "params": {"value": 1e7, "sed": 1}},
            "b": {"type": "acme.scale", "inputs": {"y": "a", "x": "g"}},
            "g": {"type": "acme.grid"},
        },
    )
    done = cli("validate", graph)
    assert done.status == 2
    assert len(lines(done.err)) == 4
    for word in ("1000000", "did you mean 'seed'?", "unknown input 'y'", "takes a Number"):
        assert word in done.err


def test_files_that_are_no_graphs(cli, here):
    assert "No such file" in cli("run", "no.json").err
    assert cli("run", ".").status == 2
    Path("b.json").write_bytes(b"\xff\xfe\x00")
    done = cli("run", "b.json")
    assert done.status == 2
    assert "not UTF-8" in done.err


def test_a_long_chain_runs(cli, write_graph, here):
    nodes = {"n0": {"type": "acme.number"}}
    for i in range(1, 10_000):
        nodes[f"n{i}"] = {"type": "acme.scale", "inputs": {"x": f"n{i - 1}"}, "params": {"by": 1.0001}}
    done = cli("run", write_graph("g.json", nodes), "--no-cache")
    assert done.status == 0
    assert "10000 nodes: 10000 computed" in done.out


@pytest.mark.parametrize("option", ["--report", "--profile"])
def test_places_that_cannot_be_written_are_refused_before_the_run(cli, pair, ran, option):
    Path("taken").write_text("a file")
    for path in (".", "taken/r.json"):
        done = cli("run", pair, option, path)
        assert done.status == 2
        assert "cannot be written" in done.err
    assert ran() == []


@pytest.mark.parametrize(
    "arguments",
    [
        ["run"],
        ["rnu"],
        ["run", "pair.json", "--jobs", "0"],
        ["run", "pair.json", "--jobs", "two"],
        ["run", "pair.json", "--cache-mode", "odd"],
        ["run", "pair.json", "--nope"],
        ["run", "pair.json", "more"],
        ["run", "pair.json", "--set"],
        ["show", "pair.json", "--format", "odd"],
        ["cache", "nope"],
    ],
)
def test_wrong_calls(cli, pair, arguments):
    done = cli(*arguments)
    assert done.status == 2
    assert done.err.startswith("error: ")
    assert len(lines(done.err)) == 1
    assert "--help" in done.err
    assert not done.out


def test_version_and_help(cli):
    assert cli("--version").out.startswith("nodegraph 0.")
    for arguments in ([], ["--help"], ["-h"], ["run", "--help"], ["cache"], ["cache", "--help"]):
        done = cli(*arguments)
        assert "Usage: nodegraph" in done.out + done.err
    assert cli().status == 0


def test_device_none_and_unknown(cli, pair):
    assert cli("run", pair, "--device", "none").status == 0
    done = cli("run", pair, "--device", "99:0")
    assert done.status == 2
    assert "no OpenCL device '99:0'" in done.err


def test_a_mistake_in_the_program_shows_where_it_is(cli, pair, monkeypatch):
    def broken(*arguments, **options):
        raise RuntimeError("oh")

    monkeypatch.setattr("nodegraph.run.run_graph", broken)
    done = cli("run", pair)
    assert done.status == 1
    assert "RuntimeError: oh" in done.err
    assert "a mistake in nodegraph" in done.err
