"""What can go wrong, as one tree.

Every message is one sentence for a person: what is wrong, where, and what would be right.

::

    NodegraphError            anything below; `exit_status` says how a command ends
    ├── GraphError            the document or the call is wrong; lists every problem found (exit status 2)
    ├── PluginError           a plugin breaks a rule of the declarations (exit status 2)
    ├── DeviceError           an OpenCL device is missing, too small or failed (exit status 2)
    ├── NodeError             a node failed while it ran; carries the node and the cause (exit status 1)
    ├── RunError              some nodes of a run failed; carries the whole result (exit status 1)
    └── Cancelled             a person stopped the run (exit status 130)
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nodegraph.run import Result


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong in a graph: where it stands and what would be right."""

    where: str
    message: str

    def __str__(self) -> str:
        return f"{self.where}: {self.message}" if self.where else self.message


class Problems:
    """Collects what is wrong in a graph, so that all of it is reported at once, in the order of the file.

    Attributes:
        found: in the order of finding.
        places: the nodes as messages name them, numbered in the order of the file.
    """

    def __init__(self) -> None:
        self.found: list[Problem] = []
        self.places: dict[str, int] = {}

    def add(self, where: str, message: str) -> None:
        """Note a problem."""
        self.found.append(Problem(where, message))

    def in_order(self) -> list[Problem]:
        """Return the problems in the order of the file: those of the whole graph, then node by node."""

        def place(problem: Problem) -> int:
            where = problem.where
            while where and where not in self.places:
                where = where.rpartition(": ")[0]
            return self.places.get(where, -1)

        return sorted(dict.fromkeys(self.found), key=place)


class NodegraphError(Exception):
    """The base of every error that a user of nodegraph can cause or meet."""

    exit_status = 2


class GraphError(NodegraphError):
    """A graph file or a call is wrong.  `problems` lists everything found, in the order of the file."""

    def __init__(self, problems: Sequence[Problem] | str, where: str = "") -> None:
        self.problems: tuple[Problem, ...] = (
            (Problem(where, problems),) if isinstance(problems, str) else tuple(problems)
        )
        super().__init__("\n".join(map(str, self.problems)))


class PluginError(NodegraphError):
    """A declaration or a plugin breaks a rule; the message names the plugin, node or type."""


class DeviceError(NodegraphError):
    """An OpenCL device is missing, out of memory, or refused a kernel."""


class NodeError(NodegraphError):
    """A node failed while it ran; `node` is its id and `__cause__` the exception it raised."""

    exit_status = 1

    def __init__(self, node: str, type_id: str, message: str) -> None:
        self.node = node
        self.type_id = type_id
        self.message = message
        super().__init__(f"node '{node}' ({type_id}): {message}")


class RunError(NodegraphError):
    """Some nodes of a run failed; `result` holds everything that did finish."""

    exit_status = 1

    def __init__(self, result: Result) -> None:
        self.result = result
        super().__init__("\n".join(str(error) for error in result.errors))


class Cancelled(NodegraphError):
    """The run was cancelled; raised inside a node by `Context.progress`."""

    exit_status = 130


def nearest(name: str, names: Iterable[str]) -> str:
    """Return a hint naming the valid name nearest to `name`, or all of them when they are few.

    >>> nearest("sigmma", ["sigma", "mode"])
    "did you mean 'sigma'?"
    >>> nearest("zzz", ["sigma", "mode"])
    "valid names: 'mode', 'sigma'"
    """
    known = sorted(names)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if close:
        return f"did you mean '{close[0]}'?"
    if not known:
        return "there are none"
    if len(known) <= 12:
        return "valid names: " + ", ".join(f"'{item}'" for item in known)
    return f"there are {len(known)}, among them '{known[0]}' and '{known[-1]}'"


def sentence(error: BaseException) -> str:
    """Return what a person should read of `error`: its message, led by its class where that says more."""
    if isinstance(error, KeyError):
        return f"KeyError: {error}"
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return text or "out of memory"
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}: {error.filename}" if error.filename else error.strerror
    if isinstance(error, (NodegraphError, ValueError)) and text:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
