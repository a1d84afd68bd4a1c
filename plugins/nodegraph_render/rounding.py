"""Round numbers, as people choose them for scales and legends."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, floor, log10

import numpy as np
import numpy.typing as npt


def round_step(span: float, count: float, *, factors: Sequence[float] = (1, 2, 5)) -> float:
    """Return the least round step (1, 2 or 5 times a power of ten) that divides `span` into at most `count` steps.

    >>> round_step(840, 16), round_step(0.3, 4), round_step(1000, 10)
    (100.0, 0.1, 100.0)
    """
    wanted = span / count
    power = 10.0 ** floor(log10(wanted))
    # A millionth is rounding: 1000 / 10 is 100, whatever its last digit.
    steps = [factor * power for factor in (*factors, 10 * factors[0])]
    step = next(step for step in steps if step >= wanted * (1 - 1e-6))
    return float(f"{step:.6g}")


def round_below(value: float) -> float:
    """Return the greatest round number (1, 2 or 5 times a power of ten) that is at most `value`.

    >>> round_below(7300), round_below(0.21)
    (5000.0, 0.2)
    """
    power = 10.0 ** floor(log10(value))
    step = max(factor * power for factor in (1, 2, 5, 10) if factor * power <= value * (1 + 1e-9))
    return float(f"{step:.6g}")


def multiples(low: float, high: float, step: float) -> npt.NDArray[np.float64]:
    """Return the multiples of `step` from `low` to `high`, both included.

    >>> multiples(0.05, 0.3, 0.1).tolist()
    [0.1, 0.2, 0.3]
    """
    first, last = ceil(low / step - 1e-9), floor(high / step + 1e-9)
    decimals = max(0, 3 - floor(log10(step)))
    return np.round(np.arange(first, last + 1) * step, decimals)
