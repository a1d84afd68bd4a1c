"""What a node may ask of the engine while it runs: progress, cancellation, logging, randomness, the device."""

from __future__ import annotations

import logging
import operator
import zlib
from collections.abc import Callable
from functools import cached_property
from threading import Event
from typing import TYPE_CHECKING, Any, TypeVar

from nodegraph.errors import Cancelled

if TYPE_CHECKING:
    import numpy as np

    from nodegraph.opencl import Device

T = TypeVar("T")


class Context:
    """Handed to a node whose keyword parameter is annotated `Context`.

    A plain call of the node function, without an engine, gets an inert one: progress goes nowhere, nothing is ever
    cancelled, the dice are those of a run with the same parameters and there is no device.

    Attributes:
        node: the node's id in its graph.
        log: a logger named ``nodegraph.node.<node>``.
        device: the OpenCL device inside a twin, None in a host implementation.
    """

    def __init__(
        self,
        node: str = "",
        *,
        dice: str = "",
        seed: object = 0,
        device: Device | None = None,
        cancelled: Event | None = None,
        report: Callable[[float | None, str], None] | None = None,
        remember: Callable[[Any, Callable[[], Any]], Any] | None = None,
    ) -> None:
        self.node = node
        self.device = device
        self._dice = dice
        self._seed = operator.index(seed) if hasattr(seed, "__index__") else 0
        self._cancelled = cancelled
        self._report = report
        self._remember = remember

    def progress(self, fraction: float | None = None, message: str = "") -> None:
        """Report how much is done, 0 to 1 (None: unknown), and stop here if the run was cancelled.

        Call it at least every half second in long work, so that a cancel takes effect at once.  Costs about a
        microsecond.

        Raises:
            Cancelled: a person stopped the run.
        """
        if self._cancelled is not None and self._cancelled.is_set():
            raise Cancelled(f"node '{self.node}' was cancelled")
        if self._report is not None:
            self._report(fraction, message)

    def remembered(self, what: Any, compute: Callable[[], T]) -> T:
        """Return what `compute` gives: from the cache, where this node type computed it before for an equal `what`.

        For long work in parts, such as the frames of a film.  Each part is kept as soon as it is there: a run that was
        cancelled, failed or killed goes on where it was, and another run shares the parts that are the same.

        Args:
            what: a value (port types, tuples, scalars, strings, arrays) that says all that the part depends on, beside
                the node's code and device.
            compute: called where nothing is remembered; gives a value of a port type.
        """
        return compute() if self._remember is None else self._remember(what, compute)

    @cached_property
    def log(self) -> logging.Logger:
        """The node's own logger."""
        return logging.getLogger(f"nodegraph.node.{self.node}" if self.node else "nodegraph.node")

    @cached_property
    def rng(self) -> np.random.Generator:
        """A random generator that depends on the name of the node's type and on its parameter `seed`.

        The name is without the family, which a node gets only when its plugin is registered: a call in a notebook and a
        run throw the same dice.  The seed is 0 where the node has none, or one that is no integer.  The other
        parameters do not count: turning a knob never reshuffles the dice.
        """
        import numpy as np

        return np.random.default_rng([self._seed & 0xFFFFFFFFFFFFFFFF, zlib.crc32(self._dice.encode())])
