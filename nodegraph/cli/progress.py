"""Watching a run: a live table on a terminal, a line for each node in a pipe.

Both are observers of the run's events and know nothing else of the engine.
"""

from __future__ import annotations

import sys
import threading
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol

from nodegraph.cli.console import Console
from nodegraph.cli.text import seconds
from nodegraph.events import Event, Failed, Finished, NodeRun, Planned, Progress, Started

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live

_ROWS = 12
_PER_SECOND = 10


class Watcher(Protocol):
    """An observer of one run that draws something."""

    def __call__(self, event: Event) -> None:
        """Take an event of the run."""

    def close(self) -> None:
        """Remove what was drawn."""


def watcher(console: Console) -> Watcher | None:
    """Return what shows a run to a person: a live table, lines, or nothing when they want quiet."""
    if console.quiet:
        return None
    if sys.stdout.isatty() and sys.stderr.isatty() and _can_draw():
        return LiveTable()
    return Lines(console)


def describe(run: NodeRun) -> str:
    """Return one line about a node that was computed or failed."""
    if run.status == "failed":
        return f"failed    {run.id}: {run.error}"
    return f"{run.status:<9} {run.id} ({seconds(run.seconds)}): {run.reason}"


def _can_draw() -> bool:
    import os

    return os.environ.get("TERM", "dumb") != "dumb"


class Lines:
    """Prints a line for each node that was computed or failed."""

    def __init__(self, console: Console) -> None:
        self._console = console

    def __call__(self, event: Event) -> None:
        """Take an event of the run."""
        if isinstance(event, (Finished, Failed)):
            # A reader who has gone must not end the run; the summary will notice.
            with suppress(BrokenPipeError):
                self._console.say(describe(event.run))

    def close(self) -> None:
        """Nothing was drawn that must go."""


class LiveTable:
    """A table of the running nodes with their progress, and a bar for the whole; it goes when the run is over.

    Drawn on standard error, so that results stay alone on standard output.  Nothing is drawn, and rich is not even
    imported, until a node starts: a run that is answered from the cache shows its summary only.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: dict[str, tuple[float, float | None, str]] = {}
        self._total = 0
        self._done = 0
        self._live: Live | None = None

    def __call__(self, event: Event) -> None:
        """Take an event of the run."""
        if isinstance(event, Planned):
            self._total = len(event.plan.demanded())
        elif isinstance(event, Started):
            with self._lock:
                self._running[event.node] = (time.monotonic(), None, "")
            if self._live is None:
                self._open()
        elif isinstance(event, Progress):
            with self._lock:
                begun = self._running.get(event.node, (time.monotonic(), None, ""))[0]
                self._running[event.node] = (begun, event.fraction, event.message)
        else:
            with self._lock:
                self._running.pop(event.run.id, None)
                self._done += 1

    def close(self) -> None:
        """Remove the table."""
        if self._live is not None:
            self._live.stop()

    def _open(self) -> None:
        from rich.console import Console as RichConsole
        from rich.live import Live

        self._live = Live(
            get_renderable=self.__rich__,
            console=RichConsole(stderr=True),
            refresh_per_second=_PER_SECOND,
            transient=True,
        )
        self._live.start()

    def __rich__(self) -> RenderableType:
        """Return what is drawn now."""
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        with self._lock:
            running = dict(self._running)
        table = Table.grid(padding=(0, 1))
        table.add_column(no_wrap=True, max_width=40)
        table.add_column(width=30)
        table.add_column(justify="right", no_wrap=True)
        table.add_column(no_wrap=True, overflow="ellipsis")
        now = time.monotonic()
        for id, (begun, fraction, message) in list(running.items())[:_ROWS]:
            share = None if fraction is None else 100 * min(max(fraction, 0.0), 1.0)
            bar = ProgressBar(total=None if share is None else 100, completed=share or 0, width=30)
            table.add_row(Text(id), bar, seconds(now - begun), Text(message))
        if len(running) > _ROWS:
            table.add_row(Text(f"... and {len(running) - _ROWS} more", style="dim"))
        total = max(self._total, self._done + len(running), 1)
        part = sum(min(max(fraction or 0.0, 0.0), 1.0) for _, fraction, _ in running.values())
        whole = ProgressBar(total=total, completed=self._done + part, width=30)
        table.add_row(Text("all", style="bold"), whole, f"{self._done}/{total}")
        return table
