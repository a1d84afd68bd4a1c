"""``nodegraph plan`` and ``nodegraph explain``: what a run would do now, and why.  Neither computes anything."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodegraph.cli import text
from nodegraph.cli.complete import complete_nodes
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

if TYPE_CHECKING:
    from nodegraph.plan import Plan


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command()(plan)
    app.command()(explain)


@dataclass(frozen=True, slots=True)
class Prospect:
    """What a run would do with one node: ``cached``, ``rewrite`` (its files), ``compute``, ``open`` or ``failed``."""

    id: str
    type: str
    action: str
    reason: str
    bytes: int
    known: bool


def prospects(plan: Plan, folder: Path) -> list[Prospect]:
    """Return what a run that publishes its files in `folder` would do, in topological order."""
    from nodegraph.publish import Publisher

    publisher = Publisher(folder, plan.cache)
    found = []
    for index, entry in zip(plan.needed, plan.entries(), strict=True):
        action, reason, record = str(entry.action), entry.reason, plan.record[index]
        if action == "cached" and record is not None and (why := publisher.stale(record.files)):
            action, reason = "rewrite", why
        found.append(Prospect(entry.id, entry.type, action, reason, entry.bytes, entry.known))
    return found


def plan(
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
    """Say what a run would compute, why, and what it would take.

    Takes every option of 'run', so that one word turns a run into its plan; nothing runs, so --jobs, --report and
    --profile change nothing.  Actions: 'cached', 'compute', 'open' (its input is computed and may come out as before),
    'rewrite' (only its files), 'failed'.

    Exit status: 0 it can run, 1 a node will fail, 2 the graph or the call is wrong or it does not fit in memory.
    """
    from nodegraph.plan import human_bytes

    del jobs, report, profile
    here = session(context, quiet=quiet, tracebacks=traceback)
    request = Request(graph, target, settings, out, cache_dir, no_cache, cache_mode, force, device)
    loaded = request.graph()
    planned = request.plan(loaded)
    found = prospects(planned, request.folder(loaded))
    sizes = [human_bytes(item.bytes) if item.known else "unknown" for item in found]
    rows = [(item.id, item.type, item.action, size, item.reason) for item, size in zip(found, sizes, strict=True)]
    here.console.table([("node", "type", "action", "bytes", "reason"), *rows])
    counts = Counter(item.action for item in found)
    here.console.say(
        f"{text.count(len(found), 'node')}: {', '.join(f'{number} {action}' for action, number in counts.items())}; "
        f"peak memory {'at least ' if 'unknown' in sizes else ''}{human_bytes(planned.peak_bytes())}"
    )
    planned.check_memory()
    failures = [error for index in planned.needed if (error := planned.error[index]) is not None]
    for error in failures:
        here.console.report(error, loaded.name)
    return 1 if failures else 0


def explain(
    context: typer.Context,
    graph: GraphFile,
    node: Annotated[
        str | None, typer.Argument(metavar="[NODE]", help="One node only.", autocompletion=complete_nodes)
    ] = None,
    target: Targets = None,
    settings: Settings = None,
    out: Out = None,
    cache_dir: CacheDir = None,
    no_cache: NoCache = False,
    cache_mode: Mode = CacheMode.normal,
    force: Force = None,
    device: DeviceName = "auto",
    traceback: Traceback = False,
) -> int:
    """Say in sentences what would become of each node, and why."""
    here = session(context, tracebacks=traceback)
    # A node is asked about even where the targets do not need it.
    targets = [node] if node and not target else target
    request = Request(graph, targets, settings, out, cache_dir, no_cache, cache_mode, force, device)
    loaded = request.graph()
    planned = request.plan(loaded)
    wanted = planned.network.steps[planned.network.find(node)[0]].id if node else None
    for item in prospects(planned, request.folder(loaded)):
        if wanted is None or item.id == wanted:
            here.console.say_all(_sentences(item, planned))
    return 0


def _sentences(item: Prospect, plan: Plan) -> Iterator[str]:
    from nodegraph.plan import human_bytes

    name = f"{item.id} ({item.type})"
    index = plan.network.ids[item.id]
    record = plan.record[index]
    if item.action == "cached":
        took = f", computed in {text.seconds(record.seconds)}" if record is not None else ""
        yield f"{name} is cached: its result is known ({human_bytes(item.bytes)}{took})."
    elif item.action == "rewrite":
        yield f"{name} is cached, but writes its files again: {item.reason}."
    elif item.action == "compute":
        yield f"{name} is computed: {item.reason}."
    elif item.action == "open":
        yield f"{name} {item.reason}: it is computed unless that comes out as before."
    else:
        yield f"{name} fails: {item.reason}."
