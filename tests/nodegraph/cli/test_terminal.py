"""Terminals, pipes and Ctrl-C: the program in a process of its own."""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

ANSI = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


@contextmanager
def started(arguments: list[str], site: Path, **options) -> Iterator[subprocess.Popen]:
    process = subprocess.Popen(
        [sys.executable, "-m", "nodegraph", *arguments], env={**os.environ, "PYTHONPATH": str(site)}, **options
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()


def wait_for(log: Path, name: str) -> None:
    end = time.monotonic() + 20
    while not (log.exists() and name in log.read_text()):
        assert time.monotonic() < end, f"{name} did not start"
        time.sleep(0.02)


def on_terminal(arguments: list[str], site: Path, env: dict[str, str] | None = None) -> tuple[int, str]:
    """Run on a terminal of its own and return exit status and what it showed."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "PYTHONPATH": str(site), "TERM": "xterm-256color", "COLUMNS": "80", **(env or {})}
    process = subprocess.Popen(
        [sys.executable, "-m", "nodegraph", *arguments], stdin=theirs, stdout=theirs, stderr=theirs, env=environment
    )
    os.close(theirs)
    shown = b""
    while True:
        ready, _, _ = select.select([ours], [], [], 30)
        assert ready, "nothing came for half a minute"
        try:
            block = os.read(ours, 65536)
        except OSError:  # the other side is closed
            break
        if not block:
            break
        shown += block
    os.close(ours)
    return process.wait(), shown.decode()


@pytest.fixture
def slow(write_graph, here: Path) -> Path:
    return write_graph(
        "slow.json",
        {
            "a": {"type": "acme.number"},
            "p": {"type": "acme.patient", "inputs": {"x": "a"}},
            "f": {"type": "acme.export", "inputs": {"x": "p"}},
        },
    )


@pytest.mark.parametrize("kind", ["patient", "stubborn"])
def test_one_interrupt_stops_within_a_second_and_keeps_what_is_finished(slow, plugin_folder, program, tmp_path, kind):
    slow.write_text(slow.read_text().replace("acme.patient", f"acme.{kind}"))
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with started(["run", "slow.json"], plugin_folder, **pipes) as process:
        wait_for(tmp_path / "log", kind)
        time.sleep(0.1)
        begun = time.monotonic()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=10)
        took = time.monotonic() - begun
    assert process.returncode == 130
    assert took < (0.9 if kind == "patient" else 1.6)
    assert "cancelled; 1 node finished is kept" in err
    assert "Traceback" not in err
    assert ("did not stop within a second" in err) == (kind == "stubborn")
    assert "3 nodes: 1 computed, 2 cancelled" in out
    done = program("explain", "slow.json")
    assert "a (acme.number) is cached" in done.out
    assert "p (" in done.out


def test_a_second_interrupt_ends_at_once(slow, plugin_folder, tmp_path):
    slow.write_text(slow.read_text().replace("acme.patient", "acme.stubborn"))
    with started(["run", "slow.json"], plugin_folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        wait_for(tmp_path / "log", "stubborn")
        process.send_signal(signal.SIGINT)
        time.sleep(0.2)
        begun = time.monotonic()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=5) == 130
        assert time.monotonic() - begun < 0.4


def test_an_interrupt_before_the_run(plugin_folder, here, own_plugin, write_graph):
    (own_plugin / "acme" / "nodes.py").write_text(
        "import os, time\nopen(os.environ['ACME_LOG'], 'w').write('importing')\ntime.sleep(20)\n"
    )
    write_graph("g.json", {"a": {"type": "acme.number"}})
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    for command, said in (("run", "cancelled; 0 nodes finished are kept"), ("validate", "error: cancelled")):
        log = Path(os.environ["ACME_LOG"])
        log.unlink(missing_ok=True)
        with started([command, "g.json"], own_plugin, **pipes) as process:
            wait_for(log, "importing")
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=5)
        assert process.returncode == 130
        assert said in err
        assert "Traceback" not in err


def test_an_interrupted_run_still_writes_its_report(slow, plugin_folder, tmp_path):
    arguments = ["run", "slow.json", "--report", "r.json", "--profile", "p.json", "--quiet"]
    with started(arguments, plugin_folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        wait_for(tmp_path / "log", "patient")
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=10)
    assert process.returncode == 130
    assert out == err == ""
    assert '"cancelled": true' in Path("r.json").read_text()
    assert '"exit_status": 130' in Path("r.json").read_text()
    assert Path("p.json").exists()


def test_a_terminal_gets_a_live_table_and_a_summary(write_graph, here, plugin_folder):
    write_graph(
        "g.json",
        {
            "wait": {"type": "acme.patient", "params": {"seconds": 0.5}},
            "f": {"type": "acme.export", "inputs": {"x": "wait"}},
        },
    )
    status, shown = on_terminal(["run", "g.json"], plugin_folder)
    assert status == 0
    assert "\x1b[?25l" in shown  # the cursor is hidden while the table lives
    assert shown.count("\x1b[?25h") >= 1
    assert "waiting" in shown
    assert "0/2" in shown
    plain = ANSI.sub("", shown)
    assert "2 nodes: 2 computed (" in plain
    assert "wait  never computed" in plain
    assert "wrote out/g/x.txt" in plain
    assert "computed  wait" not in plain


def test_no_color_and_dumb_terminals(write_graph, here, plugin_folder):
    write_graph("g.json", {"wait": {"type": "acme.patient", "params": {"seconds": 0.2}}})
    _, shown = on_terminal(["run", "g.json", "--no-cache"], plugin_folder, {"NO_COLOR": "1"})
    assert not re.search(r"\x1b\[[0-9;]*3[0-9]m", shown)
    _, shown = on_terminal(["run", "g.json", "--no-cache"], plugin_folder, {"TERM": "dumb"})
    assert "\x1b" not in shown
    assert "computed  wait" in shown


def test_warnings_above_the_table_stay_whole(write_graph, here, plugin_folder):
    write_graph(
        "g.json",
        {"s": {"type": "acme.patient", "params": {"seconds": 0.3}}, "bad": {"type": "acme.fails"}},
    )
    status, shown = on_terminal(["run", "g.json"], plugin_folder)
    assert status == 1
    assert "error: g.json: node 'bad' (acme.fails): no luck" in ANSI.sub("", shown)


def test_an_interrupt_on_a_terminal_restores_the_cursor(slow, plugin_folder, tmp_path):
    slow.write_text(slow.read_text().replace("acme.patient", "acme.stubborn"))
    ours, theirs = pty.openpty()
    environment = {**os.environ, "PYTHONPATH": str(plugin_folder), "TERM": "xterm"}
    process = subprocess.Popen(
        [sys.executable, "-m", "nodegraph", "run", "slow.json"], stdout=theirs, stderr=theirs, env=environment
    )
    os.close(theirs)
    wait_for(tmp_path / "log", "stubborn")
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    shown = b""
    while select.select([ours], [], [], 5)[0]:
        try:
            block = os.read(ours, 65536)
        except OSError:
            break
        if not block:
            break
        shown += block
    os.close(ours)
    assert process.wait(5) == 130
    assert shown.rindex(b"\x1b[?25h") > shown.rindex(b"\x1b[?25l")


def test_a_pipe_gets_plain_lines(program, pair):
    done = program("run", pair)
    assert done.status == 0
    assert "\x1b" not in done.out + done.err


def test_a_reader_who_has_enough(plugin_folder, pair, here):
    for arguments in (["schema"], ["run", "pair.json"]):
        with started(arguments, plugin_folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            process.stdout.close()
            err = process.stderr.read().decode()
            status = process.wait(30)
        assert err == ""
        assert status == 141
    assert Path("out/pair/x.txt").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_an_output_that_cannot_be_written(plugin_folder, pair):
    for arguments in (["schema"], ["run", "pair.json"], ["--help"]):
        with (
            Path("/dev/full").open("w") as full,
            started(arguments, plugin_folder, stdout=full, stderr=subprocess.PIPE, text=True) as process,
        ):
            err = process.stderr.read()
            assert process.wait(30) in (2, 120)
        assert "No space left on device" in err
        assert "Traceback" not in err


def test_closed_streams(plugin_folder, pair):
    command = f"{sys.executable} -m nodegraph run pair.json >&- 2>&-"
    done = subprocess.run(command, shell=True, env={**os.environ, "PYTHONPATH": str(plugin_folder)}, check=False)
    assert done.returncode == 0
    assert Path("out/pair/x.txt").exists()


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_terminals_of_any_encoding(program, write_graph, here, encoding):
    write_graph("g.json", {"gr\u00fcn_\u5c71": {"type": "acme.number"}}, title="\u5c71")
    for arguments in (["run", "g.json"], ["show", "g.json"], ["show", "g.json", "--format", "mermaid"]):
        done = program(*arguments, env={"PYTHONIOENCODING": encoding})
        assert done.status == 0
        assert done.err == ""


def test_a_broken_plugin_costs_a_warning(program, pair, own_plugin):
    info = own_plugin / "broken-2.5.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 2.5\n")
    (info / "entry_points.txt").write_text("[nodegraph]\nbroken = broken_plugin\n")
    (own_plugin / "broken_plugin.py").write_text("import nothing_of_that_name\n")
    done = program("run", pair, site=own_plugin)
    assert done.status == 0
    assert done.err.startswith("warning: plugin 'broken' 2.5 is left out: ModuleNotFoundError")
    assert len(done.err.splitlines()) == 1
    assert program("run", pair, "--quiet", site=own_plugin).err == ""
    # A run that warns is never answered directly: the warning must come again.
    assert program("run", pair, site=own_plugin).err == done.err


def test_two_plugins_of_one_family(program, pair, own_plugin):
    info = own_plugin / "copy-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: copy\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[nodegraph]\ncopycat = copycat\n")
    (own_plugin / "copycat.py").write_text(
        "from nodegraph import Family, hookimpl\n\n@hookimpl\ndef nodegraph_families():\n    return [Family('acme')]\n"
    )
    done = program("run", pair, site=own_plugin)
    assert done.status == 0
    assert "'acme' is already registered by plugin 'acme'" in done.err


def test_completion(here, pair, plugin_folder):
    def offered(*words: str) -> list[str]:
        done = subprocess.run(
            [sys.executable, "-m", "nodegraph"],
            capture_output=True,
            text=True,
            check=False,
            env={
                **os.environ,
                "PYTHONPATH": str(plugin_folder),
                "_NODEGRAPH_COMPLETE": "complete_bash",
                "COMP_WORDS": " ".join(["nodegraph", *words]),
                "COMP_CWORD": str(len(words)),
            },
        )
        assert done.stderr == ""
        return done.stdout.split()

    Path("more").mkdir()
    assert "run" in offered("r")
    assert offered("run", "--tar") == ["--target"]
    assert offered("run", "pair.json", "--target", "fi") == ["file"]
    assert set(offered("run", "pair.json", "--force", "a")) == {"a"}
    assert set(offered("run", "pair.json", "--set", "f")) == {"factor=", "file."}
    assert offered("run", "pair.json", "--set", "b.b") == ["b.by="]
    assert set(offered("run", "p")) == {"pair.json"}
    assert set(offered("run", "m")) == {"more/"}
    assert set(offered("explain", "pair.json", "b")) == {"b"}
    assert "acme.number" in offered("nodes", "acme.n")
    Path("pair.json").write_text("{half")
    assert offered("run", "pair.json", "--target", "f") == []


def test_completion_script(here, plugin_folder):
    done = subprocess.run(
        [sys.executable, "-m", "nodegraph"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "_NODEGRAPH_COMPLETE": "source_bash"},
    )
    assert "complete" in done.stdout
    assert "nodegraph" in done.stdout
