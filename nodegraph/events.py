"""What a run tells: five events, and what is known of each node when it is over.

Everything that watches a run - progress bars, the JSON report, the profile trace, a graphical runner - is a function
that takes these events.  Events of one run arrive one at a time, from the thread that runs the node; an observer that
raises is dropped with a warning and disturbs nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from nodegraph.plan import Plan

Status = Literal["computed", "cached", "skipped", "failed", "cancelled"]


@dataclass(frozen=True, slots=True)
class OutputInfo:
    """One output of a node that ran: its port, type, content digest, bytes, and shape and dtype where known."""

    name: str
    type: str
    digest: str
    bytes: int
    shape: str


@dataclass(frozen=True, slots=True)
class NodeRun:
    """What became of one node.

    Attributes:
        id, type, version: the node.
        status: ``computed``; ``cached`` (the result was known); ``skipped`` (an input failed); ``failed``;
            ``cancelled``.
        reason: why it was computed, skipped or failed, in words.
        seconds: what computing took now, or took when it was computed.
        start: seconds after the run began, for nodes that were computed.
        worker: number of the thread that computed it.
        peak_bytes: bytes of its inputs and outputs together, which it held at least; 0 where it was not computed.
        outputs: empty where nothing is known.
        error: the sentence for a person, where it failed.
    """

    id: str
    type: str
    version: int
    status: Status
    reason: str
    seconds: float
    start: float = 0.0
    worker: int = 0
    peak_bytes: int = 0
    outputs: tuple[OutputInfo, ...] = ()
    error: str = ""


class Planned(NamedTuple):
    """The plan is made and the run begins."""

    plan: Plan


class Started(NamedTuple):
    """A node begins to compute, `start` seconds after the run began, on thread `worker`."""

    node: str
    type: str
    start: float
    worker: int


class Progress(NamedTuple):
    """A node reports how much is done, 0 to 1 or None; at most twenty times a second."""

    node: str
    fraction: float | None
    message: str


class Finished(NamedTuple):
    """A node is computed."""

    run: NodeRun


class Failed(NamedTuple):
    """A node failed."""

    run: NodeRun


Event = Planned | Started | Progress | Finished | Failed
Observer = Callable[[Event], None]
