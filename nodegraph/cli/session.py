"""What a command knows of its call."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import typer

from nodegraph.cli.console import Console

if TYPE_CHECKING:
    from nodegraph.cli.direct import Call


@dataclass(slots=True)
class Session:
    """Where a command prints, and for a run also the call that it answers."""

    console: Console
    call: Call | None = None


def session(context: typer.Context, *, quiet: bool = False, tracebacks: bool = False) -> Session:
    """Return what a command knows of its call, with how it is to print."""
    found: Session = context.obj
    found.console.quiet, found.console.tracebacks = quiet, tracebacks
    return found
