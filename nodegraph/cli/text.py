"""Text for terminals and pipes: colours where they are wanted, and the summary of a run.

Standard library only, since `nodegraph.cli.direct` prints through it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TextIO

_STYLES = {
    "bold": "1",
    "dim": "2",
    "computed": "32",
    "cached": "36",
    "written": "32",
    "failed": "1;31",
    "error": "1;31",
    "skipped": "33",
    "cancelled": "33",
    "warning": "33",
}
_STATUSES = ("computed", "cached", "skipped", "failed", "cancelled")
_LISTED = 20


def coloured(stream: TextIO) -> bool:
    """Say whether a stream is a terminal whose user wants colours (https://no-color.org)."""
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return False
    return stream.isatty()


def paint(text: str, style: str, colour: bool) -> str:
    """Return `text` in a style, or as it is without `colour`."""
    return f"\x1b[{_STYLES[style]}m{text}\x1b[0m" if colour and style in _STYLES else text


def count(number: int, noun: str) -> str:
    """Return a number of things.

    >>> count(1, "node"), count(2, "node")
    ('1 node', '2 nodes')
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def seconds(value: float) -> str:
    """Return a time for a person.

    >>> seconds(0.0004), seconds(0.0421), seconds(3.21), seconds(75), seconds(7385)
    ('0.4 ms', '42 ms', '3.2 s', '1 min 15 s', '2 h 3 min')
    """
    if value < 0.9995:
        return f"{value * 1e3:.1f} ms" if value < 0.00995 else f"{value * 1e3:.0f} ms"
    if value < 60:
        return f"{value:.1f} s"
    whole = round(value)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def headline(counts: Mapping[str, int], took: float, *, colour: bool = False) -> str:
    """Return the first line of a summary: how many nodes ended in which status.

    >>> headline({"cached": 5, "computed": 2}, 1.5)
    '7 nodes: 2 computed, 5 cached (1.5 s)'
    """
    parts = [paint(f"{counts[name]} {name}", name, colour) for name in _STATUSES if counts.get(name)]
    return f"{count(sum(counts.values()), 'node')}: {', '.join(parts)} {paint(f'({seconds(took)})', 'dim', colour)}"


def file_lines(written: Sequence[str], kept: Sequence[str], *, colour: bool = False) -> list[str]:
    """Return lines that name the files a run wrote and those that were right already."""
    return [
        *_listed([f"{paint('wrote', 'written', colour)} {name}" for name in written], "files written"),
        *_listed([paint(f"kept {name}", "dim", colour) for name in kept], "files kept"),
    ]


def _listed(lines: list[str], what: str) -> list[str]:
    if len(lines) <= _LISTED:
        return lines
    return [*lines[: _LISTED - 1], f"... and {len(lines) - _LISTED + 1} more {what}"]


def columns(rows: Iterable[Sequence[str]], *, indent: int = 0, width: int | None = None) -> list[str]:
    """Return rows as aligned lines; with a `width` the last column is broken there, under itself.

    >>> columns([("a", "first"), ("long", "second")])
    ['a     first', 'long  second']
    """
    table = [list(row) for row in rows]
    if not table:
        return []
    sizes = [max(len(row[position]) for row in table) for position in range(len(table[0]) - 1)]
    margin = indent + sum(size + 2 for size in sizes)
    lines = []
    for row in table:
        start = " " * indent + "".join(f"{cell:<{size}}  " for cell, size in zip(row, sizes, strict=False))
        first, *rest = _wrapped(row[-1], width - margin if width else None)
        lines.append((start + first).rstrip())
        lines += [(" " * margin + line).rstrip() for line in rest]
    return lines


def _wrapped(text: str, width: int | None) -> list[str]:
    if width is None or width < 20 or len(text) <= width:
        return [text]
    import textwrap

    return textwrap.wrap(text, width) or [""]
