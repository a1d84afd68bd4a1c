"""``nodegraph run``: compute what has changed, show how it goes, and say what became of it."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from nodegraph.cli import CANCELLED, direct, text
from nodegraph.cli.console import Console
from nodegraph.cli.interrupt import Interrupts
from nodegraph.cli.options import (
    CacheDir,
    CacheMode,
    DeviceName,
    Force,
    GraphFile,
    Jobs,
    Mode,
    NoCache,
    Out,
    ProfileFile,
    Quiet,
    ReportFile,
    Request,
    Settings,
    Targets,
    Traceback,
)
from nodegraph.cli.session import session
from nodegraph.errors import GraphError

if TYPE_CHECKING:
    from nodegraph.events import Event, Observer
    from nodegraph.graph import Graph
    from nodegraph.profile import Profile
    from nodegraph.run import Result

_SHOWN_REASONS = 15


def add_to(app: typer.Typer) -> None:
    """Add the command to the program."""
    app.command()(run)


def run(
    context: typer.Context,
    graph: GraphFile,
    target: Targets = None,
    settings: Settings = None,
    out: Out = None,
    cache_dir: CacheDir = None,
    no_cache: NoCache = False,
    cache_mode: Mode = CacheMode.normal,
    force: Force = None,
    jobs: Jobs = None,
    device: DeviceName = "auto",
    report: ReportFile = None,
    profile: ProfileFile = None,
    quiet: Quiet = False,
    traceback: Traceback = False,
) -> int:
    """Compute what has changed in a graph.

    The rest is taken from the cache.

    Ctrl-C stops the run within a second and keeps what is finished; a second Ctrl-C ends it at once.

    Exit status: 0 done, 1 a node failed, 2 the graph or the call is wrong, 130 cancelled.
    """
    here = session(context, quiet=quiet, tracebacks=traceback)
    request = Request(graph, target, settings, out, cache_dir, no_cache, cache_mode, force, device)
    for kind, path in (("report", report), ("profile", profile)):
        _check_place(kind, path)
    started = here.call.started if here.call is not None else time.time_ns()
    traced = _profile(request, profile)
    watched, loaded, result = _execute(here.console, request, jobs, traced)
    if loaded is None or result is None:
        _say_cancelled(here.console, 0)
        return CANCELLED
    status = CANCELLED if result.cancelled else 1 if result.errors else 0
    _summarise(here.console, loaded, result, (time.time_ns() - started) / 1e9, reasons=not watched)
    if report is not None:
        from nodegraph.report import build, write

        contents = build(loaded, result, exit_status=status)
        status = _write(here.console, "report", lambda: write(report, contents)) or status
    if profile is not None and traced is not None:
        status = _write(here.console, "profile", lambda: traced.write(profile)) or status
    plain = not (no_cache or force or report or profile or cache_mode is not CacheMode.normal)
    if status == 0 and plain and not here.console.warned and here.call is not None:
        direct.note(here.call, result, request.folder(loaded), quiet=quiet)
    return status


def _profile(request: Request, path: Path | None) -> Profile | None:
    if path is None:
        return None
    from nodegraph.profile import Profile

    return Profile(request.file.name)


def _execute(
    console: Console, request: Request, jobs: int | None, traced: Profile | None
) -> tuple[bool, Graph | None, Result | None]:
    """Run, and say whether each node was printed as it finished; no result where Ctrl-C came before the run began."""
    from nodegraph.cli.progress import Lines, watcher
    from nodegraph.run import run_graph

    watching = watcher(console)
    observers: list[Observer] = [item for item in (watching, traced) if item is not None]
    try:
        with Interrupts() as interrupts:

            def begun(_: Event) -> None:
                interrupts.running = True

            loaded = request.graph()
            result = run_graph(
                loaded,
                **request.options(),
                jobs=jobs,
                out=request.folder(loaded),
                observers=[begun, *observers],
                check=False,
                keep_values=False,
                cancel=interrupts.cancel,
            )
    except KeyboardInterrupt:
        return False, None, None
    finally:
        if watching is not None:
            watching.close()
    return isinstance(watching, Lines), loaded, result


def _summarise(console: Console, graph: Graph, result: Result, took: float, *, reasons: bool) -> None:
    nodes = list(result.nodes.values())
    for error in result.errors:
        console.report(error, graph.name)
    if result.cancelled:
        _say_cancelled(console, sum(run.status == "computed" for run in nodes))
    colour = text.coloured(sys.stdout)
    console.say(text.headline(Counter(run.status for run in nodes), took, colour=colour))
    if reasons:
        computed = [(run.id, run.reason) for run in nodes if run.status == "computed"]
        console.table(computed[:_SHOWN_REASONS], indent=2)
        if len(computed) > _SHOWN_REASONS:
            console.say(f"  ... and {len(computed) - _SHOWN_REASONS} more")
    written, kept = list(map(str, result.files_written)), list(map(str, result.files_kept))
    for line in text.file_lines(written, kept, colour=colour):
        console.say(line)


def _say_cancelled(console: Console, finished: int) -> None:
    if not console.quiet:
        kept = "1 node finished is kept" if finished == 1 else f"{finished} nodes finished are kept"
        print(f"cancelled; {kept}", file=sys.stderr, flush=True)


def _check_place(kind: str, path: Path | None) -> None:
    """Refuse a file that cannot be written before the run, which may take an hour."""
    if path is None:
        return
    folder = path.absolute().parent
    while not folder.exists():
        folder = folder.parent
    if path.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        raise GraphError(f"--{kind} '{path}' cannot be written; give the name of a file in a folder that can be")


def _write(console: Console, kind: str, work: Callable[[], None]) -> int:
    try:
        work()
    except OSError as error:
        console.error(f"the {kind} cannot be written ({error.strerror or error})")
        return 2
    return 0
