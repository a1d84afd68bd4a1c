"""A process of the fault tests: it warms up once, then forks a child for every job it reads from standard input.

Forking makes a run as cheap as its nodes, so hundreds of them can be killed in a minute.  One line of JSON per job; the
answer is the child's process id.  A child stays a zombie until the line ``{"reap": pid}`` asks for its exit status, so
its id is never somebody else's when it is killed.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from nodegraph import File, Graph, OutputName, Param, node
from nodegraph.cache import Cache, Recipe, Record
from nodegraph.plugins import Registry

PACE = 1.0
"""How long nodes take, as a factor.  No parameter: the reference is computed at pace 0 and must come out the same."""

LAYERS = ((12, 15), (40, 25), (90, 12), (150, 30), (220, 20), (60, 40))
"""Cells per side and milliseconds of each layer: values of 1 kB to 390 kB."""

VARIANTS = 30


def rest(milliseconds: float) -> None:
    time.sleep(milliseconds * PACE / 1000)


@node(version=1)
def field(
    *,
    seed: Annotated[int, Param("Which field.")] = 0,
    side: Annotated[int, Param("Cells per side.")] = 10,
    milliseconds: Annotated[float, Param("How long it takes.")] = 0.0,
) -> np.ndarray:
    """Give noise."""
    rest(milliseconds)
    return np.random.default_rng(seed).standard_normal((side, side))


@node(version=1)
def blur(values: np.ndarray, *, times: int = 1, milliseconds: float = 0.0) -> np.ndarray:
    """Take the mean of neighbours."""
    rest(milliseconds)
    for _ in range(times):
        values = 0.2 * (values + sum(np.roll(values, step, axis) for step in (-1, 1) for axis in (0, 1)))
    return values


@node(version=1)
def total(*fields: np.ndarray, scale: float = 1.0) -> float:
    """Add up everything: too cheap to be stored."""
    return float(sum(item.sum() for item in fields)) * scale


@node(version=1)
def export(values: np.ndarray, *, scale: float = 1.0, name: OutputName = "x.bin", milliseconds: float = 0.0) -> File:
    """Make a file of the cells, with a sidecar."""
    rest(milliseconds)
    content = (values * scale).tobytes()
    digest = hashlib.sha256(content).hexdigest()
    return File.of(name, content, File.of(f"{name}.json", json.dumps({"scale": scale, "digest": digest}).encode()))


def build(path: Path) -> Graph:
    """Return the graph of all runs: layers of noise, blurred twice, summed and exported."""
    registry = Registry()
    for item in (field, blur, total, export):
        item.family = "fault"
        registry.register(item, "fault")
    graph = Graph("faults", registry=registry)
    for number, (side, milliseconds) in enumerate(LAYERS):
        graph.add("fault.field", f"field{number}", side=side, milliseconds=milliseconds)
        graph.add("fault.blur", f"soft{number}", values=f"field{number}", times=1, milliseconds=milliseconds / 2)
        graph.add("fault.blur", f"softer{number}", values=f"soft{number}", times=3, milliseconds=milliseconds / 2)
        graph.add("fault.export", f"export{number}", values=f"softer{number}", name=f"layers/{number}.bin")
    graph.add("fault.export", "slow_export", values="soft4", name="slow.bin", milliseconds=15)
    graph.add("fault.total", "total", fields=[f"softer{number}" for number in range(len(LAYERS))])
    exports = [f"export{number}.scale" for number in range(len(LAYERS))]
    graph.set_parameter("scale", default=1.0, drives=["total.scale", "slow_export.scale", *exports])
    graph.save(path)
    return graph


def parameters(variant: int) -> dict[str, Any]:
    """Return what differs from run to run: some fields get other seeds, others stay, the scale goes up and down."""
    seeds = {f"field{number}.seed": 100 * number + variant // (1 + number % 3) % 7 for number, _ in enumerate(LAYERS)}
    return {**seeds, "soft1.times": 1 + variant % 3, "scale": 1.0 + variant % 4}


# Jobs.


def run(graph: Graph, job: dict[str, Any]) -> dict[str, Any]:
    """Run the graph once and return the digests of its values and what was said."""
    cache = Cache(job["cache"], disk_budget=job.get("budget", 1 << 30))
    events = os.open(job["events"], os.O_WRONLY | os.O_APPEND | os.O_CREAT) if job.get("events") else None

    def observe(event: object) -> None:
        if events is not None and type(event).__name__ == "Finished":
            os.write(events, b".")

    targets = job.get("targets", [])
    result = graph.run(
        targets, set=parameters(job["variant"]), cache=cache, out=job["out"], device="none", jobs=2,
        observers=[observe], check=False,
    )  # fmt: skip
    failed = {error.node: str(error) for error in result.errors}
    wanted = targets or ["total", "softer4", *(f"export{number}" for number in range(len(LAYERS)))]
    values = {name: digest(result[name]) for name in wanted if name not in failed}
    cache.close()
    return {"values": values, "failed": failed, "statuses": {id: run.status for id, run in result.nodes.items()}}


def digest(value: Any) -> str:
    """Return a digest that owes nothing to the engine."""
    if isinstance(value, File):
        value = value.content
    content = value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
    return hashlib.sha256(content).hexdigest()


def reference(graph: Graph, job: dict[str, Any]) -> list[dict[str, Any]]:
    """Run every variant without a cache; return the digests of values and of published files."""
    found = []
    for variant in range(VARIANTS):
        with tempfile.TemporaryDirectory() as out:
            answer = run(graph, {"cache": None, "variant": variant, "out": out})
            answer["files"] = contents(Path(out))
            found.append(answer)
    return found


def look(graph: Graph, job: dict[str, Any]) -> dict[str, Any]:
    """Return what lies below a folder that only this process may see: digests, and names of leftovers."""
    folder = Path(job["out"])
    return {"files": contents(folder), "leftovers": [path.name for path in folder.rglob("*.part")]}


def clear(graph: Graph, job: dict[str, Any]) -> None:
    """Remove everything below a folder that only this process may see."""
    for path in Path(job["out"]).iterdir():
        shutil.rmtree(path)


def contents(folder: Path) -> dict[str, str]:
    """Return the digest of every published file below a folder, by name; hidden ones are nobody's."""
    paths = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(paths)}


def begin(graph: Graph, job: dict[str, Any]) -> None:
    """Open a cache, at a set time together with others, and remember one result."""
    while time.time() < job["at"]:
        pass
    cache = Cache(job["cache"])
    cache.keep(records(job["variant"])[0], [None])
    cache.close()


def collect(graph: Graph, job: dict[str, Any]) -> int:
    """Collect garbage over and over."""
    cache = Cache(job["cache"])
    while True:
        cache.collect(job["budget"])


def index(graph: Graph, job: dict[str, Any]) -> int:
    """Write results to the index over and over, in transactions of several sizes."""
    cache = Cache(job["cache"])
    for number in itertools.count(job["variant"]):
        for record in records(number):
            cache.keep(record, [None])
        cache.set_history(f"graph {number % 5}", {"a": record.key, "b": record.key})
        cache.flush()
    return 0


def records(number: int) -> list[Record]:
    """Return the results of one transaction: their contents follow from their keys."""
    found = []
    for place in range(1 + number % 40):
        key = hashlib.md5(f"{number} {place}".encode()).digest()
        recipe = Recipe("fault.field", 1, key.hex(), key.hex() * 8, ("values",), key, {}, "")
        found.append(Record(key, (key[::-1],), (number,), 0.001, 0.001, (), recipe))
    return found


def store(graph: Graph, job: dict[str, Any]) -> int:
    """Store values over and over."""
    cache = Cache(job["cache"])
    dice = np.random.default_rng(job["variant"])
    from nodegraph.codec import seal

    while True:
        value = dice.standard_normal((3, 40_000))
        content = seal(value)
        recipe = Recipe("fault.field", 1, "", "", (), b"", {}, "")
        cache.keep(Record(content, (content,), (value.nbytes,), 5.0, 5.0, (), recipe), [value])


def publish(graph: Graph, job: dict[str, Any]) -> int:
    """Publish two versions of one file in turn, over and over."""
    from nodegraph.publish import Publisher

    versions = [File.of("deep/one.bin", bytes([letter]) * 1_500_000) for letter in b"ab"]
    for number in itertools.count():
        Publisher(Path(job["out"]), Cache(None)).publish([versions[number % 2]])
    return 0


JOBS = {item.__name__: item for item in (run, reference, look, clear, begin, collect, index, store, publish)}


def child(graph: Graph, job: dict[str, Any]) -> int:
    """Do one job in a process of its own; return its exit status."""
    global PACE
    PACE = job.get("pace", 1.0)
    errors = os.open(job["stderr"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(errors, 2)
    try:
        if job.get("limit") is not None:
            # Python ignores SIGXFSZ, so a write beyond the limit fails as one on a full disk does.
            resource.setrlimit(resource.RLIMIT_FSIZE, (job["limit"], resource.RLIM_INFINITY))
        answer = JOBS[job["kind"]](graph, job)
        if job.get("limit") is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        aside = Path(job["answer"] + ".aside")
        aside.write_text(json.dumps(answer))
        aside.replace(job["answer"])
        return 0
    except BaseException:
        traceback.print_exc()
        return 1


def main() -> None:
    """Warm up, then fork a child for each line."""
    folder = Path(sys.argv[1])
    graph = build(folder / "graph.json")
    global PACE
    PACE = 0.0
    with tempfile.TemporaryDirectory() as warm:
        run(graph, {"cache": None, "variant": 0, "out": warm})
        from nodegraph.cache.store import ValueStore

        store = ValueStore(Path(warm) / "values")  # loads h5py and the HDF5 library
        store.write(b"0" * 16, 1.0)
        store.read(b"0" * 16)
    for thread in threading.enumerate():
        if thread is not threading.current_thread():
            thread.join(5)
    for line in sys.stdin:
        job = json.loads(line)
        if "reap" in job:
            _, status = os.waitpid(job["reap"], 0)
            print(os.waitstatus_to_exitcode(status), flush=True)
            continue
        pid = os.fork()
        if pid == 0:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            os._exit(child(graph, job))
        print(pid, flush=True)


if __name__ == "__main__":
    main()
