"""The direct answer: right when nothing has changed, and never given when something has."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from pathlib import Path

import pytest

from nodegraph.cache import Cache
from nodegraph.cli import direct
from nodegraph.places import ANSWERS, CACHE_VERSION


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache" / f"v{CACHE_VERSION}"


@pytest.fixture
def reading(here: Path, write_graph) -> Path:
    """Return a graph with a node that reads a file."""
    Path("in.txt").write_text("words")
    return write_graph(
        "reading.json",
        {
            "r": {"type": "acme.reader", "params": {"path": "in.txt"}},
            "a": {"type": "acme.number"},
            "f": {"type": "acme.export", "inputs": {"x": "a"}},
        },
    )


def headline(out: str) -> str:
    return out.splitlines()[0].partition(" (")[0]


def test_the_second_call_is_answered_directly_and_says_the_same(cli, pair, answered):
    assert "3 computed" in cli("run", pair).out
    assert not answered()
    first = cli("run", pair)
    assert answered()
    assert first.status == 0
    assert not first.err
    shutil.rmtree(Path(os.environ["NODEGRAPH_CACHE_DIR"]) / f"v{CACHE_VERSION}" / ANSWERS)
    whole = cli("run", pair)
    assert not answered()
    assert headline(first.out) == headline(whole.out) == "3 nodes: 3 cached"
    assert first.out.splitlines()[1:] == whole.out.splitlines()[1:] == ["kept out/pair/x.txt"]


def test_quiet_stays_quiet(cli, pair, answered):
    cli("run", pair, "--quiet")
    assert cli("run", pair, "--quiet") == (0, "", "")
    assert answered()
    assert cli("run", pair).out


def test_other_arguments_are_another_call(cli, pair, answered):
    cli("run", pair)
    answered()
    for more in (["--set", "b.by=7"], ["--target", "a"], ["--out", "there"], ["--jobs", "1"], ["--device", "none"]):
        cli("run", pair, *more)
        assert not answered(), more
    assert Path("out/pair/x.txt").read_text() == "6\n"


def test_another_run_in_between_leads_the_whole_way(cli, pair, answered):
    """The cache notes the latest run of a graph, for the reasons of the next: a direct answer must not miss that."""
    cli("run", pair)
    cli("run", pair, "--set", "b.by=7", "--out", "there")
    answered()
    cli("run", pair)
    assert not answered()
    done = cli("run", pair, "--set", "b.by=8")
    assert "parameter by changed 2.0 -> 8.0" in done.out


@pytest.mark.parametrize(
    "option", [["--no-cache"], ["--force", "a"], ["--cache-mode", "checked"], ["--report", "r"], ["--profile", "p"]]
)
def test_special_runs_are_never_answered_directly(cli, pair, answered, option):
    for _ in range(2):
        cli("run", pair, *option)
        assert not answered()


def test_failed_runs_are_not_remembered(cli, write_graph, here, answered):
    graph = write_graph("g.json", {"bad": {"type": "acme.fails"}})
    for _ in range(2):
        assert cli("run", graph).status == 1
        assert not answered()


def test_runs_with_warnings_are_not_remembered(cli, pair, answered, cache):
    cli("run", pair)
    shutil.rmtree(cache / ANSWERS)
    for path in cache.glob("index.sqlite*"):
        path.write_bytes(b"no database" * 100)
    assert cli("run", pair).err.startswith("warning")
    assert not (cache / ANSWERS).exists()
    assert not cli("run", pair).err
    assert (cache / ANSWERS).exists()


def test_an_edited_graph(cli, pair, answered):
    cli("run", pair)
    cli("run", pair)
    assert answered()
    pair.write_text(pair.read_text().replace('"value": 3', '"value": 4'))
    done = cli("run", pair)
    assert not answered()
    assert "parameter value changed 3.0 -> 4.0" in done.out
    assert Path("out/pair/x.txt").read_text() == "8\n"


def test_an_edit_that_keeps_size_and_time(cli, pair, answered):
    cli("run", pair)
    before = pair.stat()
    answered()
    pair.write_text(pair.read_text().replace('"value": 3', '"value": 4'))
    os.utime(pair, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert "parameter value changed" in cli("run", pair).out
    assert not answered()


def test_an_edited_subgraph(cli, write_graph, here, answered):
    inner = write_graph("inner.json", {"a": {"type": "acme.number"}}, outputs={"out": "a"})
    outer = write_graph(
        "outer.json",
        {
            "i": {"type": "graph", "params": {"path": "inner.json"}},
            "f": {"type": "acme.export", "inputs": {"x": "i"}},
        },
    )
    cli("run", outer)
    cli("run", outer)
    assert answered()
    inner.write_text(inner.read_text().replace('"acme.number"', '"acme.number", "params": {"value": 9}'))
    cli("run", outer)
    assert not answered()
    assert Path("out/outer/x.txt").read_text() == "9\n"


def test_an_edited_input_file(cli, reading, answered):
    cli("run", reading)
    cli("run", reading)
    assert answered()
    Path("in.txt").write_text("WORDS")
    assert "file in.txt changed" in cli("run", reading).out
    assert not answered()
    cli("run", reading)
    assert answered()


def test_a_sidecar_that_comes_and_goes(cli, reading, answered):
    cli("run", reading)
    Path("in.prj").write_text("metres")
    cli("run", reading)
    assert not answered()
    cli("run", reading)
    assert answered()
    Path("in.prj").unlink()
    cli("run", reading)
    assert not answered()


@pytest.mark.parametrize("damage", ["remove", "edit", "same size"])
def test_outputs_that_are_not_right_are_put_right(cli, pair, answered, damage):
    cli("run", pair)
    cli("run", pair)
    assert answered()
    output = Path("out/pair/x.txt")
    if damage == "remove":
        output.unlink()
    else:
        output.write_text("7\n" if damage == "same size" else "another")
    done = cli("run", pair)
    assert not answered()
    assert "wrote out/pair/x.txt" in done.out
    assert output.read_text() == "6\n"


def test_an_output_that_was_only_touched_is_right(cli, pair, answered):
    cli("run", pair)
    answered()
    Path("out/pair/x.txt").touch()
    cli("run", pair)
    assert answered()


def test_large_young_outputs_go_the_whole_way(cli, pair, answered, monkeypatch):
    monkeypatch.setattr(direct, "_READ_AT_MOST", 1)
    # Young are only those whose age is asked for just now: the outputs.
    monkeypatch.setattr(direct, "_settled", lambda signature, moment: moment < time.time_ns() - 10**7)
    cli("run", pair)
    cli("run", pair)
    assert not answered()


@pytest.mark.parametrize("name", ["POCL_DEVICES", "OCL_ICD_VENDORS", "PYTHONHASHSEED", "HOME"])
def test_another_environment(cli, pair, answered, monkeypatch, name):
    cli("run", pair)
    answered()
    monkeypatch.setenv(name, "0")
    cli("run", pair)
    assert not answered()


def test_another_folder(cli, pair, answered, monkeypatch):
    cli("run", pair.absolute())
    answered()
    Path("deeper").mkdir()
    monkeypatch.chdir("deeper")
    assert "wrote out/pair/x.txt" in cli("run", pair.absolute() if pair.is_absolute() else "../pair.json").out
    assert not answered()


def test_a_new_plugin_and_a_new_version(cli, pair, answered, tmp_path, monkeypatch):
    more = tmp_path / "more"
    more.mkdir()
    monkeypatch.setattr(sys, "path", [*sys.path, str(more)])
    cli("run", pair)
    cli("run", pair)
    assert answered()
    info = more / "other-1.0.dist-info"
    info.mkdir()
    (info / "entry_points.txt").write_text("[nodegraph]\nother = other.plugin\n")
    cli("run", pair)
    assert not answered()
    cli("run", pair)
    assert answered()
    (info / "entry_points.txt").write_text("[nodegraph]\nother = other.plugins\n")
    cli("run", pair)
    assert not answered()


def test_a_cleared_cache(cli, pair, answered, cache, ran):
    cli("run", pair)
    assert (cache / ANSWERS).exists()
    ran()
    answered()
    cli("cache", "clear")
    assert not (cache / ANSWERS).exists()
    cli("run", pair)
    assert not answered()
    assert ran() == ["export", "number", "scale"]
    cache_object = Cache(cache.parent)
    cache_object.clear()
    cache_object.close()
    assert not (cache / ANSWERS).exists()


def test_a_removed_index(cli, pair, answered, cache):
    cli("run", pair)
    answered()
    for path in cache.glob("index.sqlite*"):
        path.unlink()
    assert "3 computed" in cli("run", pair).out
    assert not answered()


def test_damaged_answers_are_ignored(cli, pair, answered, cache):
    cli("run", pair)
    (path,) = (cache / ANSWERS).iterdir()
    good = path.read_bytes()
    for position in range(0, len(good), 97):
        bad = bytearray(good)
        bad[position] ^= 1
        path.write_bytes(bytes(bad))
        assert direct.find(direct.Call(["run", "pair.json"], 0)) is None
    for bad in (b"", good[:100], b"\n", b"x\n{}", direct._digest(b"[]").encode() + b"\n[]"):
        path.write_bytes(bad)
        assert direct.find(direct.Call(["run", "pair.json"], 0)) is None
    path.write_bytes(good)
    assert direct.find(direct.Call(["run", "pair.json"], 0)) is not None


def test_an_answer_to_another_call_is_no_answer(cli, pair, answered, cache):
    cli("run", pair)
    (path,) = (cache / ANSWERS).iterdir()
    other = direct.Call(["run", "other.json"], 0)
    path.rename(path.with_name(other.name))
    assert direct.find(other) is None


def test_young_files_are_not_trusted(cli, pair, cache):
    cli("run", pair)
    cli("run", pair)
    assert not (cache / ANSWERS).exists()


def test_odd_calls_find_nothing(here):
    for arguments in (
        ["run"],
        ["run", "--cache-dir"],
        ["run", "--cache-dir="],
        ["run", "\ud800"],
        ["run", "x" * 10**5],
    ):
        assert direct.find(direct.Call(arguments, 0)) is None


def test_answers_are_thinned_out(cli, pair, answered, cache, monkeypatch):
    monkeypatch.setattr(direct, "_KEPT_ANSWERS", 6)
    for value in range(12):
        cli("run", pair, "--set", f"b.by={value}")
    assert 3 <= len(list((cache / ANSWERS).iterdir())) <= 6


def test_a_cache_dir_given_either_way(cli, pair, answered, tmp_path):
    for arguments in (["--cache-dir", "elsewhere"], ["--cache-dir=elsewhere"]):
        cli("run", pair, *arguments)
        cli("run", pair, *arguments)
        assert answered()
    assert not (tmp_path / "cache").exists()


def test_large_graphs_do_not_bloat_answers(cli, write_graph, here, answered, cache):
    nodes = {f"n{i}": {"type": "acme.number", "params": {"value": i % 3}} for i in range(500)}
    cli("run", write_graph("g.json", nodes))
    cli("run", "g.json")
    assert answered()
    (path,) = (cache / ANSWERS).iterdir()
    assert path.stat().st_size < 50_000


# In processes of their own, with the clock as it is.


def loaded(here: Path, arguments: list[str], site: Path) -> tuple[str, set[str]]:
    """Call the program and return what it prints, and the modules it loaded."""
    import subprocess

    code = (
        "import sys; from nodegraph.cli import main; status = main(sys.argv[1:]);"
        "print(*sys.modules, file=open('modules.txt', 'w')); sys.exit(status)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(site)},
    )
    return done.stdout, set(Path("modules.txt").read_text().split())


def test_nothing_heavy_is_loaded_and_edited_code_is_noticed(here, pair, own_plugin, ran):
    time.sleep(2.1)
    out, modules = loaded(here, ["run", "pair.json"], own_plugin)
    assert "3 computed" in out
    # What a run does not use it does not load: no live table in a pipe, no networkx without a cycle.
    assert not modules & {"networkx", "rich", "rasterio", "matplotlib", "nodegraph.report", "nodegraph.profile"}
    out, modules = loaded(here, ["run", "pair.json"], own_plugin)
    assert "3 nodes: 3 cached" in out
    assert not modules & {"numpy", "pydantic", "typer", "click", "rich", "pluggy", "h5py", "importlib.metadata"}
    assert not [name for name in modules if name.startswith("acme")]
    ran()
    (own_plugin / "acme" / "helper.py").write_text("OFFSET = 1.0\n")
    out, modules = loaded(here, ["run", "pair.json"], own_plugin)
    assert "code changed" in out
    assert ran() == ["export", "number", "scale"]
    assert Path("out/pair/x.txt").read_text() == "8\n"
    # The change is too young: no answer may rest on it.
    out, modules = loaded(here, ["run", "pair.json"], own_plugin)
    assert "3 cached" in out
    assert "numpy" in modules


FORMAT = """
@hookimpl
def nodegraph_formats():
    from acme.nodes import Picture
    from acme.pictures import write
    from nodegraph import Format

    return [Format(Picture, (".pic",), "Picture", write=write)]
"""
WRITER = """
from nodegraph import File

def write(picture, name):
    from acme.pens import WIDTH
    return File.of(name, f"{picture.text} {WIDTH}".encode())
"""
KEEP = """
@node(version=1)
def keep(picture: Picture, *, name: Annotated[str, OutputFile(type=Picture)] = "a.pic") -> File:
    from nodegraph.plugins import registry
    (write,) = registry().formats().find(type(picture), name, "write").functions("write")
    return write(picture, name)
"""


def test_edited_code_of_a_format_is_noticed(here, write_graph, own_plugin, cache):
    """What its writer imports late is in no module that a cached run loads."""
    package = own_plugin / "acme"
    (package / "plugin.py").write_text((package / "plugin.py").read_text() + FORMAT)
    (package / "pictures.py").write_text(WRITER)
    (package / "pens.py").write_text("WIDTH = 1\n")
    nodes = (package / "nodes.py").read_text().replace("OutputName,", "OutputFile, OutputName,")
    (package / "nodes.py").write_text(nodes + KEEP)
    write_graph(
        "kept.json",
        {
            "a": {"type": "acme.number"},
            "b": {"type": "acme.draw", "inputs": {"x": "a"}},
            "c": {"type": "acme.keep", "inputs": {"picture": "b"}},
        },
    )
    time.sleep(2.1)
    assert "3 computed" in loaded(here, ["run", "kept.json"], own_plugin)[0]
    shutil.rmtree(cache / ANSWERS)
    _, modules = loaded(here, ["run", "kept.json"], own_plugin)
    assert "acme.pictures" in modules
    assert "acme.pens" not in modules
    out, modules = loaded(here, ["run", "kept.json"], own_plugin)
    assert "3 nodes: 3 cached" in out
    assert "numpy" not in modules
    (package / "pens.py").write_text("WIDTH = 2\n")
    out, _ = loaded(here, ["run", "kept.json"], own_plugin)
    assert "code changed" in out
    assert Path("out/kept/a.pic").read_text() == "1 2"


def test_a_fresh_answer_is_written_whole(cli, pair, answered, cache):
    cli("run", pair)
    (path,) = (cache / ANSWERS).iterdir()
    seal, _, body = path.read_bytes().partition(b"\n")
    answer = json.loads(body)
    assert seal.decode() == direct._digest(body)
    assert str(Path("pair.json").absolute()) in answer["files"]
    assert any(name.endswith("acme/helper.py") for name in answer["files"])
    assert any(name.endswith("nodegraph/plan.py") for name in answer["files"])
