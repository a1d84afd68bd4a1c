"""A full disk: runs go on without the cache after one warning, and published files are whole.

A limit on the size of files stands for the full disk: as root or not, it fails writes half-way, as a quota does.  Where
the system lets a process have file systems of its own, a small one shows a disk that is really full.
"""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.faults.processes import Nursery

LIMITS = (1_000, 20_000, 40_000, 100_000, 200_000)
"""From "not even the index" to "all but one value"."""


@pytest.fixture(scope="module")
def nursery(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nursery]:
    with Nursery(tmp_path_factory.mktemp("full") / "nursery") as nursery:
        yield nursery


@pytest.fixture(scope="module")
def reference(nursery: Nursery) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = nursery.do("reference", pace=0.0).answer
    return found


def statuses(answer: dict[str, Any]) -> dict[str, int]:
    return dict(Counter(answer["statuses"].values()))


VALUES = ["total", "softer4"]


@pytest.mark.parametrize("limit", LIMITS)
def test_the_cache_cannot_be_written(
    tmp_path: Path, nursery: Nursery, reference: list[dict[str, Any]], limit: int
) -> None:
    cache = tmp_path / "cache"
    job = nursery.do("run", cache=cache, out=tmp_path, variant=1, targets=VALUES, limit=limit)
    assert job.answer["values"] == {name: reference[1]["values"][name] for name in VALUES}
    assert job.answer["failed"] == {}
    warnings = job.stderr.splitlines()
    assert len(warnings) == 1
    assert any(text in warnings[0] for text in ("running without it", "not remembered", "kept in memory only"))
    assert list(cache.rglob("*.part")) == []
    # With room again, the same folder serves.
    for _ in range(2):
        job = nursery.do("run", cache=cache, out=tmp_path, variant=1, targets=VALUES)
        assert job.stderr == ""
        assert job.answer["values"]["total"] == reference[1]["values"]["total"]
    assert set(statuses(job.answer)) == {"cached"}


@pytest.mark.parametrize("limit", LIMITS)
def test_what_the_cache_knew_is_kept(
    tmp_path: Path, nursery: Nursery, reference: list[dict[str, Any]], limit: int
) -> None:
    cache = tmp_path / "cache"
    nursery.do("run", cache=cache, out=tmp_path, variant=0, targets=VALUES)
    job = nursery.do("run", cache=cache, out=tmp_path, variant=5, targets=VALUES, limit=limit)
    assert job.answer["values"]["total"] == reference[5]["values"]["total"]
    assert len(job.stderr.splitlines()) == 1
    job = nursery.do("run", cache=cache, out=tmp_path, variant=0, targets=VALUES)
    assert (job.stderr, set(statuses(job.answer))) == ("", {"cached"})


def test_a_file_cannot_be_published(tmp_path: Path, nursery: Nursery, reference: list[dict[str, Any]]) -> None:
    cache, out = tmp_path / "cache", tmp_path / "out"
    targets = ["export0", "export3"]  # 1 kB and 180 kB
    nursery.do("run", cache=cache, out=out, variant=0, targets=targets)
    before = nursery.do("look", out=out).answer["files"]
    nursery.do("run", cache=cache, out=out, variant=1, targets=["softer0", "softer3"])
    job = nursery.do("run", cache=cache, out=out, variant=1, targets=targets, limit=100_000)
    what = f"cannot write '{out / 'layers' / '3.bin'}' (File too large); choose another folder with --out"
    assert job.answer["failed"] == {"export3": f"node 'export3' (fault.export): {what}"}
    assert "Traceback" not in job.stderr
    now = nursery.do("look", out=out).answer
    assert now["leftovers"] == []
    assert now["files"]["layers/3.bin"] == before["layers/3.bin"]
    assert now["files"]["layers/0.bin"] == reference[1]["files"]["layers/0.bin"]
    job = nursery.do("run", cache=cache, out=out, variant=1, targets=targets)
    assert (job.stderr, job.answer["failed"]) == ("", {})
    expected = {name: digest for name, digest in reference[1]["files"].items() if name in now["files"]}
    assert nursery.do("look", out=out).answer["files"] == expected


# A disk that is really full.


@pytest.fixture(scope="module")
def small_disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Nursery, Path]]:
    """A process that sees a file system of 300 kB at the path."""
    base = tmp_path_factory.mktemp("small")
    mount = base / "mount"
    mount.mkdir()
    own = ["unshare", "--user", "--map-root-user", "--mount"]
    script = 'mount -t tmpfs -o size=300k none "$0" && exec "$@"'
    try:
        trial = [*own, "sh", "-c", script, str(mount), sys.executable, "-c", "import nodegraph"]
        subprocess.run(trial, check=True, capture_output=True, timeout=60)
    except (OSError, subprocess.SubprocessError):
        pytest.skip("this system lets no process mount a file system of its own")
    with Nursery(base / "nursery", [*own, "sh", "-c", script, str(mount), sys.executable]) as nursery:
        yield nursery, mount


def test_the_cache_fills_the_disk(
    tmp_path: Path, small_disk: tuple[Nursery, Path], reference: list[dict[str, Any]]
) -> None:
    nursery, mount = small_disk
    for folder, variant in (("once", 1), ("once", 2), ("none left", 3)):
        job = nursery.do("run", cache=mount / folder, out=tmp_path, variant=variant, targets=VALUES)
        assert job.answer["values"]["total"] == reference[variant]["values"]["total"]
        assert len(job.stderr.splitlines()) == 1, job.stderr
    assert nursery.do("look", out=mount).answer["leftovers"] == []


def test_an_output_fills_the_disk(
    tmp_path: Path, small_disk: tuple[Nursery, Path], reference: list[dict[str, Any]]
) -> None:
    nursery, mount = small_disk
    nursery.do("clear", out=mount)
    out = mount / "out"
    targets = ["export0", "export3"]
    nursery.do("run", cache=tmp_path / "cache", out=out, variant=0, targets=targets)
    before = nursery.do("look", out=out).answer["files"]
    job = nursery.do("run", cache=tmp_path / "cache", out=out, variant=1, targets=targets)
    failed = job.answer["failed"]
    assert list(failed) == ["export3"]
    assert f"cannot write '{out / 'layers' / '3.bin'}' (No space left on device)" in failed["export3"]
    assert job.stderr == ""
    now = nursery.do("look", out=out).answer
    assert now["leftovers"] == []
    assert now["files"]["layers/3.bin"] == before["layers/3.bin"]
    assert now["files"]["layers/0.bin"] == reference[1]["files"]["layers/0.bin"]
