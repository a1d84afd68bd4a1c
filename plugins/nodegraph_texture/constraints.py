"""When a surface appears: functions from a quantity to [0, 1], by hand or measured.

Source: Dachsbacher, Bolch and Stamminger 2006: Procedural reproduction of terrain textures with geographic data,
Vision, Modeling and Visualization, sections 4.1 and 5.2.3, https://inria.hal.science/inria-00606769.
"""

from __future__ import annotations

from math import isfinite, isnan
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph import port_type

Floats = npt.NDArray[Any]

SAMPLES = 256
"""Samples of a measured function."""


@port_type
class Constraint:
    """How much a value of a quantity suits a surface.

    Attributes:
        quantity: ``altitude`` (m), ``slope`` (degrees) or the name of a geographic quantity, in its unit.
    """

    quantity: str

    def at(self, values: Floats) -> Floats:
        """Return F at some values, 0 to 1, of their shape and dtype; 0 where a value is void (NaN)."""
        raise NotImplementedError


@port_type
class Hat(Constraint):
    """A clamped hat: 0 up to `rise[0]`, 1 from `rise[1]` to `fall[0]`, 0 from `fall[1]`, linear between.

    The clamped minimum of two linear functions.  An end may be infinite: a hat that never rises or falls there.

    Attributes:
        rise: where it begins and ends to rise.
        fall: where it begins and ends to fall.
    """

    rise: tuple[float, float]
    fall: tuple[float, float]

    def __post_init__(self) -> None:
        # -0 is 0: equal constraints have equal bytes.
        object.__setattr__(self, "rise", (self.rise[0] + 0.0, self.rise[1] + 0.0))
        object.__setattr__(self, "fall", (self.fall[0] + 0.0, self.fall[1] + 0.0))
        ends = (*self.rise, *self.fall)
        if any(map(isnan, ends)) or not ends[0] <= ends[1] <= ends[2] <= ends[3]:
            raise ValueError(f"the hat of {self.quantity} must have four ends in rising order, not {ends}")
        if any(isfinite(first) != isfinite(second) for first, second in (self.rise, self.fall)):
            raise ValueError(f"the hat of {self.quantity} needs both ends of a rise or fall finite, or neither")

    def at(self, values: Floats) -> Floats:
        """Return the hat; a rise or fall of no width is a step, whose end counts as inside."""
        up, down = _ramp(values, *self.rise), _ramp(-values, -self.fall[1], -self.fall[0])
        return np.where(np.isnan(values), 0, np.minimum(up, down)).astype(values.dtype)


@port_type
class Sampled(Constraint):
    """A function of equidistant samples, linear between and constant beyond.

    Attributes:
        low, high: where the first and the last sample lie; low < high.
        samples: (n,) float32, 2 or more, 0 to 1.
    """

    low: float
    high: float
    samples: npt.NDArray[Any]

    def __post_init__(self) -> None:
        object.__setattr__(self, "low", self.low + 0.0)
        object.__setattr__(self, "high", self.high + 0.0)
        if not (isfinite(self.low) and isfinite(self.high) and self.low < self.high):
            raise ValueError(f"the samples of {self.quantity} must lie between two finite values, the lower first")
        if self.samples.ndim != 1 or len(self.samples) < 2:
            raise ValueError(f"the function of {self.quantity} needs two samples at least")
        values = np.asarray(self.samples)
        if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
            raise ValueError(f"the samples of {self.quantity} must lie in 0 to 1")
        object.__setattr__(self, "samples", np.add(values, 0, dtype=np.float32))

    def at(self, values: Floats) -> Floats:
        """Return the interpolated samples."""
        knots = np.linspace(self.low, self.high, len(self.samples))
        found = np.interp(values, knots, self.samples)
        return np.where(np.isnan(values), 0, found).astype(values.dtype)


def _ramp(values: Floats, start: float, end: float) -> Floats:
    if start == end:
        return np.where(values >= start, 1.0, 0.0)
    if not isfinite(start):
        return np.full(values.shape, 1.0 if start < 0 else 0.0)
    width = max(end - start, 1e-37)  # less would be 0 in float32
    with np.errstate(over="ignore"):
        return np.clip((values - start) / width, 0.0, 1.0)
