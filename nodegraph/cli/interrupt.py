"""Ctrl-C: once stops cleanly and keeps what is finished, twice ends the program at once."""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import TracebackType
from typing import Any

from nodegraph.cli import CANCELLED

_SHOW_CURSOR = b"\r\x1b[K\x1b[?25h"


class Interrupts:
    """Catches Ctrl-C while its block runs.

    Attributes:
        cancel: set by the first Ctrl-C once nodes are running; the run polls it.
        running: set when nodes are running; before that, Ctrl-C raises KeyboardInterrupt as usual.
    """

    def __init__(self) -> None:
        self.cancel = threading.Event()
        self.running = False
        self._times = 0
        self._before: Any = None
        # Only the main thread may set handlers, and only it is interrupted.
        self._main = threading.current_thread() is threading.main_thread()

    def __enter__(self) -> Interrupts:
        if self._main:
            self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._main:
            signal.signal(signal.SIGINT, self._before)

    def _handle(self, *_: object) -> None:
        self._times += 1
        if self._times > 1:
            # No lock may be waited for here, so nothing that prints through Python's streams.
            if sys.stderr.isatty():
                os.write(sys.stderr.fileno(), _SHOW_CURSOR)
            os._exit(CANCELLED)
        if not self.running:
            raise KeyboardInterrupt
        self.cancel.set()
