"""The command line.  `main` is the program ``nodegraph``.

Start-up time is most of what a person waits for when nothing has changed, so imports follow use: this module and
`nodegraph.cli.direct` need the standard library only and may answer a run outright; the commands load the rest of the
engine inside their functions.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence

CANCELLED = 130
"""Exit status of a run that was interrupted, as shells give it."""

_BROKEN_PIPE = 141


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0 done, 1 a node failed, 2 the graph or the call is wrong.

    Args:
        arguments: those of the command line, without the program's name; by default those of this process.
    """
    started = time.time_ns()
    own = sys.argv[1:] if arguments is None else list(arguments)
    _prepare_streams()
    try:
        status = _answer(own, started)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read our output has enough of it.  The interpreter flushes once more when it ends: into nothing then.
        if arguments is None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    except OSError as error:
        print(f"error: the output cannot be written ({error.strerror or error})", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # so early that nothing had begun
        status = CANCELLED
    if status == CANCELLED and arguments is None:
        # A node that did not answer to the cancel still runs in its thread; nothing of it may hold up the exit.
        sys.stderr.flush()
        os._exit(status)
    return status


def _prepare_streams() -> None:
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by whoever started the program
            setattr(sys, name, open(os.devnull, "w"))  # noqa: PTH123, SIM115 - pathlib is slow, and it stays open
        elif hasattr(stream, "reconfigure"):
            # A terminal that cannot show a character gets its number, not an error.
            stream.reconfigure(errors="backslashreplace")


def _answer(arguments: list[str], started: int) -> int:
    call = None
    if arguments[:1] == ["run"] and "_NODEGRAPH_COMPLETE" not in os.environ:
        from nodegraph.cli import direct

        call = direct.Call(arguments, started)
        answer = direct.find(call)
        if answer is not None:
            return direct.say(answer, call)
    from nodegraph.cli.app import invoke

    return invoke(arguments, call)
