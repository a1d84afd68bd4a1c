"""Options that several commands share, and what they mean together."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nodegraph.cli.complete import complete_graphs, complete_nodes, complete_set
from nodegraph.errors import GraphError

if TYPE_CHECKING:
    from nodegraph.cache import Cache
    from nodegraph.graph import Graph
    from nodegraph.plan import Plan


class CacheMode(StrEnum):
    """How the cache is used."""

    normal = "normal"
    checked = "checked"


GraphFile = Annotated[
    Path, typer.Argument(metavar="GRAPH", help="The graph file.", autocompletion=complete_graphs, show_default=False)
]
Targets = Annotated[
    list[str] | None,
    typer.Option(
        "--target",
        "-t",
        metavar="NODE[.PORT]",
        help="What is wanted, with all it depends on; by default every node that nothing consumes.  May be repeated.",
        autocompletion=complete_nodes,
        show_default=False,
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        "-s",
        metavar="NODE.PARAM=VALUE",
        help="A parameter for this run, or an exposed one by its NAME; the value is JSON, or else a text.  "
        "The file is not changed.  May be repeated.",
        autocompletion=complete_set,
        show_default=False,
    ),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        metavar="DIR",
        help="Where files of export nodes go; by default 'out/<graph name>' in the current folder.",
        show_default=False,
    ),
]
CacheDir = Annotated[
    Path | None,
    typer.Option(
        "--cache-dir",
        metavar="DIR",
        help="The cache folder; by default $NODEGRAPH_CACHE_DIR, or the user's place for caches.",
        show_default=False,
    ),
]
NoCache = Annotated[bool, typer.Option("--no-cache", help="Remember nothing and look nothing up.")]
Mode = Annotated[
    CacheMode,
    typer.Option("--cache-mode", help="'checked' computes everything and compares it with what the cache remembers."),
]
Force = Annotated[
    list[str] | None,
    typer.Option(
        "--force",
        "-f",
        metavar="NODE",
        help="Compute this node even if its result is known.  May be repeated.",
        autocompletion=complete_nodes,
        show_default=False,
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        "--jobs", "-j", min=1, metavar="N", help="Nodes computed at the same time; by default as many as processors."
    ),
]
DeviceName = Annotated[
    str, typer.Option("--device", metavar="auto|none|P:D", help="The OpenCL device; 'nodegraph devices' lists them.")
]
ReportFile = Annotated[
    Path | None, typer.Option("--report", metavar="FILE", help="Write what became of every node to this JSON file.")
]
ProfileFile = Annotated[
    Path | None,
    typer.Option("--profile", metavar="FILE", help="Write a trace for https://ui.perfetto.dev or chrome://tracing."),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
Traceback = Annotated[bool, typer.Option("--traceback", help="Print where in the code an error came from.")]


@dataclass(frozen=True, slots=True)
class Request:
    """What is asked of a graph, as `run`, `plan`, `explain` and `preview` take it."""

    file: Path
    targets: Sequence[str] | None = None
    settings: Sequence[str] | None = None
    out: Path | None = None
    cache_dir: Path | None = None
    no_cache: bool = False
    mode: CacheMode = CacheMode.normal
    force: Sequence[str] | None = None
    device: str = "auto"

    def graph(self) -> Graph:
        """Load the graph."""
        from nodegraph.graph import Graph

        return Graph.load(self.file)

    def cache(self) -> Cache:
        """Open the cache."""
        return open_cache(self.cache_dir, none=self.no_cache)

    def folder(self, graph: Graph) -> Path:
        """Return where the graph's files go."""
        from nodegraph.run import default_out

        return self.out if self.out is not None else default_out(graph)

    def overrides(self) -> dict[str, Any]:
        """Return the parameters that are set for this run."""
        return parse_settings(self.settings or ())

    def options(self) -> dict[str, Any]:
        """Return the arguments that `plan_graph` and `run_graph` share."""
        return {
            "targets": list(self.targets or ()),
            "overrides": self.overrides(),
            "cache": self.cache(),
            "device": self.device,
            "force": tuple(self.force or ()),
            "checked": self.mode is CacheMode.checked,
        }

    def plan(self, graph: Graph) -> Plan:
        """Say what a run would do."""
        from nodegraph.run import plan_graph

        return plan_graph(graph, **self.options())


def open_cache(folder: Path | None, *, none: bool = False) -> Cache:
    """Return the cache in a folder, by default that of this user; with `none`, one for this command only."""
    from nodegraph.cache import Cache
    from nodegraph.places import default_cache_folder

    return Cache(None if none else folder or default_cache_folder())


def parse_settings(texts: Sequence[str]) -> dict[str, Any]:
    """Return parameter values by name from ``NAME=VALUE`` texts; the last one of a name counts.

    >>> parse_settings(["smooth.sigma=60", "title=Alps", "sketch.points=[[0, 1]]"])
    {'smooth.sigma': 60, 'title': 'Alps', 'sketch.points': [[0, 1]]}
    """
    found: dict[str, Any] = {}
    for item in texts:
        name, separator, value = item.partition("=")
        if not separator or not name.strip():
            raise GraphError(f"--set '{item}': write it as NODE.PARAM=VALUE, or NAME=VALUE for an exposed parameter")
        found[name.strip()] = _value(value, f"--set '{name.strip()}'")
    return found


def _value(text: str, where: str) -> Any:
    from nodegraph.jsontext import parse

    try:
        json.loads(text)
    except RecursionError:
        pass
    except ValueError:
        return text
    # It is JSON as far as Python goes; what it says must be strict: no NaN, no 1e400, no name twice.
    return parse(text, where)
