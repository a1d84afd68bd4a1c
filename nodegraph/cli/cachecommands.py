"""``nodegraph cache``: what is remembered, and its upkeep."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodegraph.cli import text
from nodegraph.cli.options import CacheDir, open_cache
from nodegraph.cli.session import session
from nodegraph.errors import GraphError

if TYPE_CHECKING:
    from nodegraph.cache import Cache
    from nodegraph.cli.console import Console

app = typer.Typer(help="See and keep up what is remembered of earlier runs.")

_UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}


@app.callback(invoke_without_command=True)
def _group(context: typer.Context) -> None:
    """See and keep up what is remembered of earlier runs."""
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command()
def info(context: typer.Context, cache_dir: CacheDir = None) -> int:
    """Say where the cache is and what it holds."""
    from nodegraph.plan import human_bytes

    console = session(context).console
    cache = _existing(console, cache_dir)
    if cache is not None:
        found = cache.summary()
        console.table(
            [
                ("folder", found.folder),
                ("results", str(found.results)),
                ("values", f"{found.values}, {human_bytes(found.bytes)} of at most {human_bytes(found.budget)}"),
            ]
        )
    return 0


@app.command()
def verify(context: typer.Context, cache_dir: CacheDir = None) -> int:
    """Check what is stored and remove what is damaged."""
    console = session(context).console
    cache = _existing(console, cache_dir)
    if cache is not None:
        damaged = cache.verify()
        console.say_all(damaged)
        console.say(f"{text.count(len(damaged), 'damaged entry')} removed" if damaged else "all is right")
    return 0


@app.command()
def gc(
    context: typer.Context,
    cache_dir: CacheDir = None,
    size: Annotated[
        str | None,
        typer.Option("--max-size", metavar="SIZE", help="Keep at most this much, such as '5GB'; by default the limit."),
    ] = None,
) -> int:
    """Remove values until the rest fits.

    Those that are cheapest to compute per byte go first, and with them what crashes left behind.
    """
    from nodegraph.plan import human_bytes

    console = session(context).console
    budget = _bytes(size) if size is not None else None
    cache = _existing(console, cache_dir)
    if cache is not None:
        console.say(f"freed {human_bytes(cache.collect(budget))}")
    return 0


@app.command()
def clear(context: typer.Context, cache_dir: CacheDir = None) -> int:
    """Forget everything."""
    from nodegraph.plan import human_bytes

    console = session(context).console
    cache = _existing(console, cache_dir)
    if cache is not None:
        console.say(f"freed {human_bytes(cache.clear())}")
    return 0


def _existing(console: Console, folder: Path | None) -> Cache | None:
    """Return the cache, unless there is none: asking for it must not make one."""
    from nodegraph.places import default_cache_folder

    place = folder or Path(default_cache_folder())
    if not place.is_dir():
        console.say(f"there is no cache in {place}: nothing is remembered")
        return None
    return open_cache(place)


def _bytes(size: str) -> int:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kmgt]?)b?", size.strip().lower())
    if match is None:
        raise GraphError(f"--max-size '{size}': write it as a number with a unit, such as '500MB' or '5GB'")
    return int(float(match[1]) * _UNITS[match[2]])
