"""What a node may ask of the engine while it runs: progress, cancellation, logging, randomness, the device."""

from __future__ import annotations

import logging
import zlib
from collections.abc import Callable
from functools import cached_property
from threading import Event
from typing import TYPE_CHECKING

from nodegraph.errors import Cancelled

if TYPE_CHECKING:
    import numpy as np

    from nodegraph.opencl import Device


class Context:
    """Handed to a node whose keyword parameter is annotated `Context`.

    A plain call of the node function, without an engine, gets an inert one: progress goes nowhere, nothing is ever
    cancelled, the seed is the call's parameter ``seed`` (0 where there is none) and there is no device.

    Attributes:
        node: the node's id in its graph.
        log: a logger named ``nodegraph.node.<node>``.
        device: the OpenCL device inside a twin, None in a host implementation.
    """

    def __init__(
        self,
        node: str = "",
        *,
        type_id: str = "",
        seed: int = 0,
        device: Device | None = None,
        cancelled: Event | None = None,
        report: Callable[[float | None, str], None] | None = None,
    ) -> None:
        self.node = node
        self.device = device
        self._type_id = type_id
        self._seed = seed
        self._cancelled = cancelled
        self._report = report

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

    @cached_property
    def log(self) -> logging.Logger:
        """The node's own logger."""
        return logging.getLogger(f"nodegraph.node.{self.node}" if self.node else "nodegraph.node")

    @cached_property
    def rng(self) -> np.random.Generator:
        """A random generator that depends on the node's type and on its parameter `seed` (0 where it has none).

        It does not depend on the other parameters: turning a knob never reshuffles the dice.
        """
        import numpy as np

        return np.random.default_rng([self._seed & 0xFFFFFFFFFFFFFFFF, zlib.crc32(self._type_id.encode())])
