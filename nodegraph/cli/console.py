"""Where a command's lines go: results to standard output, warnings and errors to standard error, one sentence each."""

from __future__ import annotations

import logging
import shutil
import sys
import traceback
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from nodegraph.cli.text import coloured, columns, paint
from nodegraph.errors import GraphError, NodegraphError, sentence


class Console:
    """What one command prints.

    Attributes:
        quiet: print errors only.
        tracebacks: print where an error came from, too.
        warned: a warning was given.
    """

    def __init__(self) -> None:
        self.quiet = False
        self.tracebacks = False
        self.warned = False

    def say(self, line: str = "", style: str = "") -> None:
        """Print a line of the command's result."""
        if not self.quiet:
            print(paint(line, style, coloured(sys.stdout)), flush=True)

    def say_all(self, lines: Iterable[str]) -> None:
        """Print lines of the command's result."""
        text = "\n".join(lines)
        if text and not self.quiet:
            print(text, flush=True)

    def table(self, rows: Iterable[tuple[str, ...]], *, indent: int = 0) -> None:
        """Print rows as aligned columns; on a terminal the last one is broken to fit."""
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        if lines := columns(rows, indent=indent, width=width):
            self.say_all(lines)

    def warn(self, message: str) -> None:
        """Print a warning."""
        self.warned = True
        if not self.quiet:
            _to_stderr("warning", message)

    def error(self, message: str) -> None:
        """Print an error."""
        _to_stderr("error", message)

    def report(self, error: BaseException, where: str = "") -> None:
        """Print what a person should read of an exception; each problem of a graph is a line of its own."""
        if isinstance(error, GraphError):
            for problem in error.problems:
                self.error(str(problem))
        else:
            message = str(error) if isinstance(error, NodegraphError) else sentence(error)
            self.error(f"{where}: {message}" if where else message)
        if self.tracebacks:
            self.trace(error)

    def trace(self, error: BaseException) -> None:
        """Print the traceback of an exception and of what caused it."""
        sys.stderr.writelines(traceback.format_exception(error))

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Turn Python warnings and the engine's log into lines while the block runs."""
        handler = _Handler(self)
        log = logging.getLogger("nodegraph")
        spread, log.propagate = log.propagate, False
        log.addHandler(handler)
        with warnings.catch_warnings():
            warnings.showwarning = self._show_warning
            try:
                yield
            finally:
                log.removeHandler(handler)
                log.propagate = spread

    def _show_warning(self, message: Warning | str, *_: object, **__: object) -> None:
        self.warn(" ".join(str(message).split()))


class _Handler(logging.Handler):
    def __init__(self, console: Console) -> None:
        super().__init__(logging.WARNING)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        message = " ".join(record.getMessage().split())
        if record.levelno >= logging.ERROR:
            self._console.error(message)
        else:
            self._console.warn(message)


def _to_stderr(kind: str, message: str) -> None:
    print(f"{paint(f'{kind}:', kind, coloured(sys.stderr))} {message}", file=sys.stderr, flush=True)
