"""Overhead of the engine per node, beside Dask's schedulers and Hamilton in the same run.

Graphs of nodes that do next to nothing: what is measured is what each engine adds.  nodegraph is timed with its cache
on disk (the default) and in memory only, the first time (cold) and again (cached); the peers remember nothing, so both
times they compute.

    uv run --group bench python benchmarks/engine.py [--nodes 1000] [--repeat 5] [--large]

Figures are medians; ratios are to nodegraph cold on disk: above 1 the peer takes longer.
"""

from __future__ import annotations

import argparse
import gc
import random
import statistics
import sys
import tempfile
import time
import types
from collections.abc import Callable
from functools import partial
from pathlib import Path

from nodegraph import Graph, node
from nodegraph.cache import Cache

Edges = list[list[int]]
"""For each node, the nodes it depends on."""


@node(version=1)
def join(*xs: int, step: int = 1) -> int:
    """Add numbers."""
    return sum(xs) + step


def join_plain(*xs: int) -> int:
    return sum(xs) + 1


def chain(count: int) -> Edges:
    return [[index - 1] if index else [] for index in range(count)]


def fan(count: int) -> Edges:
    """One source, many in the middle, one sink."""
    return [[]] + [[0] for _ in range(count - 2)] + [list(range(1, count - 1))]


def random_dag(count: int, reach: int | None = None) -> Edges:
    """Each node on up to three earlier ones, of the last `reach` if given; a last one on all that nothing else uses."""
    dice = random.Random(1)
    edges = [
        sorted({dice.randrange(max(0, index - (reach or index)), index) for _ in range(min(index, 3))})
        for index in range(count - 1)
    ]
    used = {source for sources in edges for source in sources}
    return [*edges, [index for index in range(count - 1) if index not in used]]


SHAPES: dict[str, Callable[[int], Edges]] = {
    "chain": chain,
    "fan": fan,
    "random": random_dag,
    "near": partial(random_dag, reach=50),
}


def nodegraph_graph(edges: Edges) -> Graph:
    graph = Graph("benchmark")
    handles = []
    for index, sources in enumerate(edges):
        # Every node differs in a parameter, so that none is answered by another's result.
        handles.append(graph.add(join, f"n{index}", xs=[handles[source] for source in sources], step=index))
    return graph


def dask_graph(edges: Edges) -> dict[str, object]:
    return {f"n{i}": (join_plain, *(f"n{source}" for source in sources)) for i, sources in enumerate(edges)}


def hamilton_driver(edges: Edges) -> object:
    from hamilton import ad_hoc_utils, driver

    functions = []
    for index, sources in enumerate(edges):
        names = [f"n{source}" for source in sources]
        arguments = ", ".join(f"{name}: int" for name in names)
        body = f"def n{index}({arguments}) -> int:\n    return {' + '.join([*names, '1'])}\n"
        scope: dict[str, object] = {}
        exec(body, scope)
        function = scope[f"n{index}"]
        assert isinstance(function, types.FunctionType)
        functions.append(function)
    module = ad_hoc_utils.create_temporary_module(*functions, module_name=f"bench_{len(edges)}_{id(edges)}")
    return driver.Builder().with_modules(module).build()


def median_seconds(prepare: Callable[[], Callable[[], object]], repeat: int) -> float:
    times = []
    for _ in range(repeat):
        work = prepare()
        gc.collect()
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def measure(edges: Edges, repeat: int, hamilton: bool) -> dict[str, float]:
    """Return seconds by engine."""
    found: dict[str, float] = {}
    target = f"n{len(edges) - 1}"

    def compiled() -> Graph:
        graph = nodegraph_graph(edges)
        graph.network()
        return graph

    def with_cache(folder: Path | None, graph: Graph) -> Callable[[], object]:
        cache = Cache(folder)
        return lambda: graph.run([target], cache=cache)

    with tempfile.TemporaryDirectory() as temporary:
        folders = iter(Path(temporary) / str(number) for number in range(10_000))
        found["nodegraph validate"] = median_seconds(lambda: nodegraph_graph(edges).network, repeat)
        graph = compiled()
        found["nodegraph cold, disk"] = median_seconds(lambda: with_cache(next(folders), graph), repeat)
        found["nodegraph cold, memory"] = median_seconds(lambda: with_cache(None, graph), repeat)
        warm = next(folders)
        cache = Cache(warm)
        graph.run([target], cache=cache)
        found["nodegraph cached, same process"] = median_seconds(
            lambda: lambda: graph.run([target], cache=cache), repeat
        )
        cache.close()
        found["nodegraph cached, fresh index"] = median_seconds(lambda: with_cache(warm, graph), repeat)
    import dask
    import dask.threaded

    plain = dask_graph(edges)
    found["dask synchronous"] = median_seconds(lambda: lambda: dask.get(plain, target), repeat)
    found["dask threaded"] = median_seconds(lambda: lambda: dask.threaded.get(plain, target), repeat)
    if hamilton:
        driver = hamilton_driver(edges)
        found["hamilton"] = median_seconds(lambda: lambda: driver.execute([target]), repeat)  # type: ignore[attr-defined]
    return found


def report(name: str, edges: Edges, found: dict[str, float]) -> None:
    base = found["nodegraph cold, disk"]
    print(f"\n{name}, {len(edges)} nodes, {sum(map(len, edges))} links")
    print(f"  {'':34}{'us per node':>12}{'whole, ms':>12}{'ratio':>8}")
    for engine, seconds in found.items():
        print(f"  {engine:34}{seconds / len(edges) * 1e6:12.1f}{seconds * 1e3:12.1f}{seconds / base:8.2f}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, default=1000)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--large", action="store_true", help="also 10,000 and 100,000 nodes, without Hamilton")
    parser.add_argument("--shape", choices=SHAPES, action="append", help="these shapes only")
    options = parser.parse_args()
    for count in (options.nodes, 10_000, 100_000) if options.large else (options.nodes,):
        for name in options.shape or SHAPES:
            edges = SHAPES[name](count)
            report(name, edges, measure(edges, options.repeat, hamilton=count == options.nodes))
    return 0


if __name__ == "__main__":
    sys.path.pop(0)  # this folder, whose sparse.py would stand in for the package that Dask imports
    sys.setrecursionlimit(20_000)  # for Hamilton, which walks a chain recursively
    sys.exit(main())
