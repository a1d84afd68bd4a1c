"""Killed at any instant: whatever SIGKILL interrupts, later runs give the same bytes and published files are whole."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from nodegraph.cache import Cache
from nodegraph.codec import seal
from nodegraph.places import CACHE_VERSION
from tests.faults import worker
from tests.faults.processes import Job, Nursery

ROOMY, TIGHT = 1 << 30, 1_500_000
"""Cache budgets: in the tight one a run evicts what others stored, so that kills hit the collector, too."""


@pytest.fixture(autouse=True)
def _no_warnings(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """A cache that was opened after a kill has nothing to complain of."""
    yield
    assert [record.getMessage() for record in caplog.get_records("call")] == []


@dataclass
class Lane:
    """One of the processes that share a cache: it runs, is killed, runs again, below an output folder of its own."""

    nursery: Nursery
    cache: Path
    out: Path
    reference: list[dict[str, Any]]
    dice: random.Random
    length: float
    kills: int = 0
    survivors: int = 0
    depths: list[int] = field(default_factory=list)
    shares: list[float] = field(default_factory=list)

    def storm(self, kills: int) -> None:
        """Be killed that often, at instants spread over the whole length of a run, and check what comes between."""
        instants = [(step + self.dice.random()) / kills for step in range(kills)]
        self.dice.shuffle(instants)
        while instants:
            job, variant = self.start()
            share = instants[-1]
            if self.dice.random() > 0.2 and job.kill(share * self.length):
                instants.pop()
                self.kills += 1
                self.depths.append(job.finished_nodes)
                self.shares.append(share)
            else:
                # Not meant to be killed, or it was faster: how long runs take changes with what is cached.
                self.length = 0.5 * (self.length + self.check(job, variant))
            self.published_names_are_whole()
            if self.dice.random() < 0.05:
                self.nursery.start("collect", cache=self.cache, budget=TIGHT).kill(self.dice.random() * 0.03)
        self.check(*self.start())

    def start(self) -> tuple[Job, int]:
        variant = self.dice.randrange(worker.VARIANTS)
        budget = self.dice.choice((ROOMY, ROOMY, TIGHT))
        job = self.nursery.start("run", cache=self.cache, out=self.out, variant=variant, budget=budget)
        return job, variant

    def check(self, job: Job, variant: int) -> float:
        """Check a run that nobody killed: no complaint, and every value and file as in an uncached run."""
        assert (job.wait(), job.stderr) == (0, "")
        expected = self.reference[variant]
        assert job.answer["failed"] == {}
        assert job.answer["values"] == expected["values"]
        assert worker.contents(self.out) == expected["files"]
        self.survivors += 1
        return job.seconds

    def published_names_are_whole(self) -> None:
        """Every file of the output folder is one that some run makes; half-written ones have hidden names."""
        for name, digest in worker.contents(self.out).items():
            assert any(run["files"].get(name) == digest for run in self.reference), name


def storm(folder: Path, kills: int, seed: int) -> list[Lane]:
    """Kill runs in two processes that share one cache; return what became of them."""
    cache = folder / "cache"
    with Nursery(folder / "a") as one, Nursery(folder / "b") as two:
        reference = one.do("reference", pace=0.0).answer
        length = one.do("run", cache=folder / "measured", out=folder / "out measured", variant=0).seconds
        lanes = [
            Lane(nursery, cache, folder / f"out {number}", reference, random.Random(seed + number), length)
            for number, nursery in enumerate((one, two))
        ]
        with ThreadPoolExecutor() as pool:
            for done in [pool.submit(lane.storm, kills // 2) for lane in lanes]:
                done.result()
    return lanes


def assert_cache_is_sound(folder: Path) -> None:
    """Nothing in a cache is damaged, and the collector removes what the killed left behind."""
    cache = Cache(folder)
    assert cache.verify() == []
    assert cache.folder is not None
    database = sqlite3.connect(cache.folder / "index.sqlite")
    assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    database.close()
    for path in folder.rglob("*.part"):
        os.utime(path, (0, 0))  # as old as leftovers must be to be nobody's work
    cache.collect()
    assert list(folder.rglob("*.part")) == []
    values = list((cache.folder / "values").rglob("*.h5"))
    assert len(values) == cache.summary().values
    for path in values:
        assert seal(cache.value(bytes.fromhex(path.stem))).hex() == path.stem
    cache.collect(0)
    assert list(cache.folder.rglob("*.h5")) == []
    cache.close()


def test_a_few_kills(tmp_path: Path) -> None:
    lanes = storm(tmp_path, kills=10, seed=1)
    assert sum(lane.kills for lane in lanes) == 10
    assert_cache_is_sound(tmp_path / "cache")


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_two_hundred_kills(tmp_path: Path) -> None:
    lanes = storm(tmp_path, kills=220, seed=2)
    kills, survivors = sum(lane.kills for lane in lanes), sum(lane.survivors for lane in lanes)
    shares = [share for lane in lanes for share in lane.shares]
    depths = [depth for lane in lanes for depth in lane.depths]
    quarters = [sum(quarter <= 4 * share < quarter + 1 for share in shares) for quarter in range(4)]
    print(f"{kills} kills, {survivors} whole runs between, kills by quarter of a run {quarters}, nodes done {depths}")
    assert kills >= 200
    assert survivors >= 20
    assert min(quarters) >= 40
    assert 0 in depths
    assert len(set(depths)) >= 8
    assert_cache_is_sound(tmp_path / "cache")


# Tight loops around the instants that matter.


@pytest.fixture(scope="module")
def nursery(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nursery]:
    with Nursery(tmp_path_factory.mktemp("faults") / "nursery") as nursery:
        yield nursery


def test_several_begin_a_new_cache_at_once(tmp_path: Path, nursery: Nursery) -> None:
    # SQLite gives up at once, without its busy timeout, when two connections make a database a WAL one.
    for count in range(20):
        folder = tmp_path / str(count)
        at = time.time() + 0.03
        jobs = [nursery.start("begin", cache=folder, variant=variant, at=at) for variant in range(3)]
        assert [(job.wait(), job.stderr) for job in jobs] == [(0, "")] * 3
        cache = Cache(folder)
        assert all(cache.lookup(worker.records(variant)[0].key) for variant in range(3))
        cache.close()


@pytest.mark.parametrize("kills", [pytest.param(6), pytest.param(60, marks=pytest.mark.slow)])
def test_killed_while_writing_the_index(tmp_path: Path, nursery: Nursery, kills: int) -> None:
    dice = random.Random(3)
    remembered: set[int] = set()
    for count in range(kills):
        job, other = (nursery.start("index", cache=tmp_path, variant=1000 * count + side) for side in (0, 500))
        assert job.kill(0.01 + 0.06 * dice.random())
        assert other.kill(0.02 + 0.06 * dice.random())
        assert (job.stderr, other.stderr) == ("", "")
        cache = Cache(tmp_path)
        for side in (0, 500):
            for number in range(1000 * count + side, 1000 * count + side + 200):
                found = [cache.lookup(record.key) for record in worker.records(number)]
                if not any(found):
                    break
                assert found == worker.records(number)
                remembered.add(number)
        cache.close()
    assert len(remembered) > kills
    cache = Cache(tmp_path)
    for number in remembered:  # what was remembered once stays, whoever is killed later
        assert [cache.lookup(record.key) for record in worker.records(number)] == worker.records(number)
    cache.close()
    assert_cache_is_sound(tmp_path)


@pytest.mark.parametrize("kills", [pytest.param(5), pytest.param(40, marks=pytest.mark.slow)])
def test_killed_while_storing_values(tmp_path: Path, nursery: Nursery, kills: int) -> None:
    dice = random.Random(4)
    for count in range(kills):
        job, other = (nursery.start("store", cache=tmp_path, variant=2 * count + side) for side in (0, 1))
        assert job.kill(0.02 + 0.04 * dice.random())
        assert other.kill(0.02 + 0.05 * dice.random())
        assert (job.stderr, other.stderr) == ("", "")
    assert any((tmp_path / f"v{CACHE_VERSION}" / "values").rglob("*.h5"))
    assert_cache_is_sound(tmp_path)


@pytest.mark.parametrize("kills", [pytest.param(6), pytest.param(60, marks=pytest.mark.slow)])
def test_killed_while_publishing(tmp_path: Path, nursery: Nursery, kills: int) -> None:
    dice = random.Random(5)
    seen = set()
    for _ in range(kills):
        job = nursery.start("publish", out=tmp_path)
        assert job.kill(0.02 + 0.03 * dice.random())
        assert job.stderr == ""
        content = (tmp_path / "deep" / "one.bin").read_bytes()
        assert len(content) == 1_500_000
        assert content.strip(content[:1]) == b""
        seen.add(content[:1])
        assert all(path.name.startswith(".") for path in tmp_path.rglob("*.part"))
    assert seen <= {b"a", b"b"}
    shutil.rmtree(tmp_path / "deep")
