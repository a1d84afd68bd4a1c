"""Export: files are written whole, left alone while they are right, and put back when they are not."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nodegraph import File, Graph, GraphError, RunError, node
from nodegraph.cache import Cache
from nodegraph.files import check_name
from tests.nodegraph import support as toy


@pytest.fixture(autouse=True)
def _count_anew() -> None:
    toy.ran()


@pytest.fixture
def cache(tmp_path: Path) -> Cache:
    return Cache(tmp_path / "cache")


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def exporting(name: str = "sub/x.txt") -> Graph:
    graph = toy.toy_graph()
    graph.add("toy.export", "file", x=graph.add("toy.number", "a", value=2.0), name=name)
    return graph


def listing(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_files_are_written_below_the_output_folder(cache: Cache, out: Path) -> None:
    result = exporting().run(cache=cache, out=out)
    assert listing(out) == {"sub/x.txt": b"2\n", "sub/x.txt.json": b'{"x": 2}'}
    assert result.files_written == [out / "sub/x.txt", out / "sub/x.txt.json"]
    assert result.files_kept == []


def test_the_default_folder_is_named_after_the_graph(in_tmp: Path) -> None:
    graph = exporting()
    graph.run(cache=toy.memory_cache())
    graph.save("valley.json")
    graph.run(cache=toy.memory_cache())
    assert (in_tmp / "out/graph/sub/x.txt").exists()
    assert (in_tmp / "out/valley/sub/x.txt").exists()


@pytest.mark.parametrize("fresh", [False, True])
def test_right_files_are_left_alone(cache: Cache, out: Path, fresh: bool, tmp_path: Path) -> None:
    exporting().run(cache=cache, out=out)
    for path in out.rglob("*.*"):
        os.utime(path, (1e9, 1e9))
    toy.ran()
    if fresh:
        cache.close()
        cache = Cache(tmp_path / "cache")
    result = exporting().run(cache=cache, out=out)
    assert toy.ran() == {}
    assert toy.statuses(result) == {"a": "cached", "file": "cached"}
    assert {path.stat().st_mtime for path in out.rglob("*.*")} == {1e9}
    assert (result.files_written, len(result.files_kept)) == ([], 2)


@pytest.mark.parametrize("harm", ["missing", "altered", "truncated", "same size", "folder"])
@pytest.mark.parametrize("which", ["sub/x.txt", "sub/x.txt.json"])
def test_wrong_files_are_put_back(cache: Cache, out: Path, harm: str, which: str) -> None:
    exporting().run(cache=cache, out=out)
    right = listing(out)
    path = out / which
    path.unlink()
    if harm == "altered":
        path.write_bytes(b"something else")
    elif harm == "truncated":
        path.write_bytes(right[which][:-1])
    elif harm == "same size":
        path.write_bytes(b"?" * len(right[which]))
    elif harm == "folder":
        path.mkdir()
        (path / "mine.txt").write_text("of a person")
        with pytest.raises(RunError, match=r"cannot write '.*'"):
            exporting().run(cache=cache, out=out)
        assert (path / "mine.txt").read_text() == "of a person"
        return
    result = exporting().run(cache=cache, out=out)
    assert listing(out) == right
    reason = toy.reasons(result)["file"]
    assert reason == (f"file {which} is missing" if harm == "missing" else f"file {which} was changed")
    assert result.files_written == [path]


def test_another_folder_gets_its_own_files_without_computing(cache: Cache, out: Path, tmp_path: Path) -> None:
    graph = toy.toy_graph()
    graph.add("toy.export", "file", x=graph.add("toy.peak", values=graph.add("toy.slow", value=2.0)))
    graph.run(cache=cache, out=out)
    toy.ran()
    graph.run(cache=cache, out=tmp_path / "elsewhere")
    assert listing(tmp_path / "elsewhere") == listing(out)
    assert "slow" not in toy.ran()


def test_two_nodes_of_one_file_name_are_refused(cache: Cache, out: Path) -> None:
    graph = exporting("x.txt")
    graph.add("toy.export", "second", x=graph.add("toy.number", "b", value=3.0), name="x.txt")
    for _ in range(2):
        with pytest.raises(RunError, match=r"writes 'x.txt', as node '.*' does; choose another name"):
            graph.run(cache=cache, out=out, jobs=1)
        assert (out / "x.txt").read_bytes() in (b"2\n", b"3\n")


def test_two_nodes_of_one_file_name_and_content_are_refused_too(cache: Cache, out: Path) -> None:
    graph = exporting("x.txt")
    graph.add("toy.export", "second", x="a", name="x.txt")
    with pytest.raises(RunError, match="choose another name"):
        graph.run(cache=cache, out=out)


@pytest.mark.parametrize(
    "name",
    ["", "/etc/x", "../x", "a/../../x", "a//b", "./x", "a/./b", "C:/x", "..\\x", "\\x", "a\nb", "a\0b", "..", "a/"],
)
def test_names_outside_the_folder_are_refused_before_anything_runs(name: str, out: Path) -> None:
    with pytest.raises(ValueError, match=r"file name|control characters"):
        check_name(name)
    with pytest.raises(GraphError, match="parameter 'name'"):
        exporting(name).run(cache=toy.memory_cache(), out=out)
    assert not out.exists()
    assert toy.ran() == {}


@pytest.mark.parametrize("name", ["x", "a/b/c.tif", "ümläut.png", "with space.txt", "..x", "x..", ".hidden", "a:b"[:1]])
def test_plain_names_are_accepted(name: str) -> None:
    check_name(name)


@node(version=1)
def escapes(x: float) -> File:
    """Choose a name that no parameter checked."""
    return File.of("../x.txt", b"x")


def test_a_name_chosen_by_the_node_is_checked_too(out: Path) -> None:
    graph = toy.toy_graph(escapes)
    graph.add(escapes, x=graph.add("toy.number"))
    with pytest.raises(RunError, match="no file name inside the output folder"):
        graph.run(cache=toy.memory_cache(), out=out)
    assert not (out.parent / "x.txt").exists()


def test_a_folder_that_cannot_be_written_fails_the_node_and_leaves_nothing(cache: Cache, out: Path) -> None:
    out.write_text("a file where the folder should be")
    with pytest.raises(RunError, match=r"node 'file' \(toy.export\): cannot write '.*'.*--out"):
        exporting().run(cache=cache, out=out)
    assert out.read_text() == "a file where the folder should be"
    out.unlink()
    result = exporting().run(cache=cache, out=out)
    assert result.ok
    assert listing(out)["sub/x.txt"] == b"2\n"


def test_no_permission(cache: Cache, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import tempfile

    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise PermissionError(13, "Permission denied", str(out / "sub"))

    with monkeypatch.context() as patched:
        patched.setattr(tempfile, "mkstemp", refuse)
        with pytest.raises(RunError, match=r"cannot write '.*sub' \(Permission denied\)"):
            exporting().run(cache=toy.memory_cache(), out=out)
    assert listing(out) == {}


def test_a_full_disk_leaves_what_stood_there(out: Path, cache: Cache) -> None:
    """The limit on file sizes is a process's own, and behaves as a full disk does."""
    code = """
        import resource, sys
        from pathlib import Path
        from nodegraph import File, RunError, node
        from tests.nodegraph import support as toy

        @node(version=1)
        def large(x: float) -> File:
            return File.of("x.bin", bytes([int(x)]) * 300_000)

        graph = toy.toy_graph(large)
        graph.add(large, "large", x=graph.add("toy.number", value=7.0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
        try:
            graph.run(cache=toy.memory_cache(), out=sys.argv[1])
        except RunError as error:
            print(error)
    """
    out.mkdir()
    (out / "x.bin").write_bytes(b"old")
    printed = toy.python(code, out)
    assert "cannot write" in printed
    assert "File too large" in printed
    assert listing(out) == {"x.bin": b"old"}


def test_permissions_follow_the_umask_and_stay(out: Path, cache: Cache) -> None:
    before = os.umask(0o022)
    try:
        exporting("x.txt").run(cache=cache, out=out)
        assert (out / "x.txt").stat().st_mode & 0o777 == 0o644
        (out / "x.txt").chmod(0o600)
        (out / "x.txt").write_text("other")
        exporting("x.txt").run(cache=cache, out=out)
        assert (out / "x.txt").stat().st_mode & 0o777 == 0o600
    finally:
        os.umask(before)


def test_sidecars_nest() -> None:
    file = File.of("a", b"1", File.of("b", b"2", File.of("c", b"3")), File.of("d", b"4"))
    assert [item.name for item in file.all()] == ["a", "b", "c", "d"]
    assert file.content.dtype == np.uint8


def test_an_empty_file_is_a_file(out: Path) -> None:
    @node(version=1)
    def empty(x: float) -> File:
        """Make an empty file."""
        return File.of("empty.bin", b"")

    graph = toy.toy_graph(empty)
    graph.add(empty, x=graph.add("toy.number"))
    graph.run(cache=toy.memory_cache(), out=out)
    assert listing(out) == {"empty.bin": b""}
