"""Values on disk: any damage is noticed, and nothing is ever half written."""

from __future__ import annotations

import errno
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nodegraph import codec, porttypes
from nodegraph.cache.store import DamagedError, ValueStore, verify
from tests.nodegraph import support as toy


def small(tmp_path: Path, value: Any = None) -> tuple[ValueStore, bytes, Path]:
    store = ValueStore(tmp_path / "values")
    value = toy.Word("abc") if value is None else value
    digest = codec.seal(value)
    store.write(digest, value)
    return store, digest, store.path(digest)


def test_a_value_is_found_under_its_digest(tmp_path: Path) -> None:
    store, digest, path = small(tmp_path)
    assert path.parent.name == digest.hex()[:2]
    assert path.name == f"{digest.hex()}.h5"
    assert store.read(digest).text == "abc"
    assert list(store.digests()) == [(digest, path.stat().st_size)]
    store.remove(digest)
    store.remove(digest)
    with pytest.raises(FileNotFoundError):
        store.read(digest)
    with pytest.raises(FileNotFoundError):
        verify(path, digest)


def test_a_value_is_plain_hdf5_to_other_tools(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    array = np.random.default_rng(1).normal(size=(40, 50)).astype(np.float32)
    _, _, path = small(tmp_path, toy.Height(array, 3.0))
    with h5py.File(path, "r") as file:
        assert np.array_equal(file["arrays/0"][()], array)
        assert b"Height" in file["structure"][()].tobytes()


def every_damage(content: bytes) -> Any:
    """Yield the content with every byte flipped, cut to every length, with a byte more, and as zeros."""
    for position in range(len(content)):
        changed = bytearray(content)
        changed[position] ^= (0x01, 0x80, 0xFF)[position % 3]
        yield bytes(changed)
    for length in range(len(content)):
        yield content[:length]
    yield content + b"\0"
    yield bytes(len(content))


def test_every_flipped_byte_and_every_length_is_noticed(tmp_path: Path) -> None:
    store, digest, path = small(tmp_path, (toy.Word("abc"), np.arange(6.0), 1.5))
    content = path.read_bytes()
    assert len(content) < 20_000
    count = 0
    for damaged in every_damage(content):
        path.write_bytes(damaged)
        with pytest.raises(DamagedError):
            verify(path, digest)
        if count % 50 == 0:
            with pytest.raises(DamagedError):
                store.read(digest)
        count += 1
    assert count == 2 * len(content) + 2
    path.write_bytes(content)
    assert store.read(digest)[0].text == "abc"


def test_the_header_counts_byte_by_byte(tmp_path: Path) -> None:
    _, digest, path = small(tmp_path)
    content = path.read_bytes()
    for position in range(512):
        changed = bytearray(content)
        changed[position] ^= 0x20
        path.write_bytes(changed)
        with pytest.raises(DamagedError):
            verify(path, digest)


def test_a_value_under_another_name_is_noticed(tmp_path: Path) -> None:
    store, _, path = small(tmp_path)
    other = codec.seal(toy.Word("other"))
    store.path(other).parent.mkdir(exist_ok=True)
    store.path(other).write_bytes(path.read_bytes())
    with pytest.raises(DamagedError, match="checksum does not match"):
        store.read(other)


def test_a_value_of_a_type_that_is_not_declared_here_is_no_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, digest, _ = small(tmp_path)
    monkeypatch.delitem(porttypes._by_key, porttypes.key_of(toy.Word))
    with pytest.raises(DamagedError, match=r"port type .*Word. is not declared here"):
        store.read(digest)


def test_a_writer_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = ValueStore(tmp_path)
    value = np.zeros(10_000)
    digest = codec.seal(value)

    def full(self: Path, target: Path) -> Path:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        store.write(digest, value)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("limit", [0, 400, 3000, 9000, 70_000])
def test_a_full_disk_is_an_os_error_and_leaves_nothing(tmp_path: Path, limit: int) -> None:
    """The limit on file sizes is a process's own, and behaves as a full disk does."""
    code = """
        import resource, sys
        from pathlib import Path
        import numpy as np
        from nodegraph import codec
        from nodegraph.cache.store import ValueStore
        import h5py
        store, value = ValueStore(Path(sys.argv[1])), (np.random.default_rng(1).normal(size=10_000), "x")
        digest = codec.seal(value)
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
        try:
            store.write(digest, value)
        except OSError as error:
            print("refused", error.errno)
    """
    assert toy.python(code, tmp_path, limit).startswith("refused")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_truly_full_disk(tmp_path: Path) -> None:
    """Needs the right to mount a small file system."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", disk], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("no right to mount")
    try:
        store = ValueStore(disk)
        value = np.random.default_rng(1).normal(size=20_000)
        digest = codec.seal(value)
        with pytest.raises(OSError, match=r"No space left|write"):
            store.write(digest, value)
        assert [path for path in disk.rglob("*") if path.is_file()] == []
    finally:
        subprocess.run(["umount", "-l", disk], check=False)


def test_leftovers_are_told_from_what_is_being_written(tmp_path: Path) -> None:
    store, digest, path = small(tmp_path)
    old, young = path.with_name(".a.part"), path.with_name(".b.part")
    old.write_bytes(b"x")
    young.write_bytes(b"x")
    os.utime(old, (1000, 1000))
    assert list(store.leftovers(older_than=2000)) == [old]
    assert [found for found, _ in store.digests()] == [digest]


def test_strange_files_in_the_folder_are_not_values(tmp_path: Path) -> None:
    store, digest, path = small(tmp_path)
    (path.parent / "not-hex.h5").write_bytes(b"")
    (path.parent / "readme.txt").write_bytes(b"")
    assert [found for found, _ in store.digests()] == [digest]


def test_two_writers_of_one_value(tmp_path: Path) -> None:
    from concurrent.futures import ThreadPoolExecutor

    store = ValueStore(tmp_path)
    value = toy.Height(np.random.default_rng(1).normal(size=(60, 60)))
    digest = codec.seal(value)
    with ThreadPoolExecutor(4) as pool:
        sizes = list(pool.map(lambda _: store.write(digest, value), range(12)))
    assert len(set(sizes)) == 1
    assert codec.seal(store.read(digest)) == digest
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [f"{digest.hex()}.h5"]
