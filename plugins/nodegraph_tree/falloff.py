"""Fall-offs: how the weight of a primitive decreases with the distance d to its skeleton, from 1 to 0 at radius r.

All are functions g(t) of t = d / r on [0, 1], C1, with g(0) = 1, g'(0) = 0 or a stated slope, g(1) = g'(1) = 0.

===========  =======================================  =======================
name         g(t)                                     max |g'|
===========  =======================================  =======================
wyvill       (1 - t^2)^3                              96 sqrt(5) / 125 = 1.717
cubic        1 - 3 t^2 + 2 t^3                        1.5
quintic      1 - 10 t^3 + 15 t^4 - 6 t^5              1.875
plateau      1 for t <= 1/2, then cubic of 2 t - 1    3
===========  =======================================  =======================

``wyvill`` is that of the paper (section 4.1 and appendix; its constant is right as printed).
"""

from __future__ import annotations

from math import sqrt
from typing import Literal

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
FallOff = Literal["wyvill", "cubic", "quintic", "plateau"]

STEEPEST: dict[FallOff, float] = {"wyvill": 96 * sqrt(5) / 125, "cubic": 1.5, "quintic": 1.875, "plateau": 3.0}
"""Largest |g'(t)|: the Lipschitz constant of the weight is this over the radius."""

CODES: dict[FallOff, int] = {"wyvill": 0, "cubic": 1, "quintic": 2, "plateau": 3}
"""How the OpenCL function ``fall_off`` numbers them."""


def fall_off(kind: FallOff, t: Floats) -> Floats:
    """Return g(t); t may have any shape and exceed 1, where g is 0."""
    t = np.clip(t, 0.0, 1.0)
    if kind == "wyvill":
        return (1 - t * t) ** 3
    if kind == "cubic":
        return (1 - t) ** 2 * (1 + 2 * t)
    if kind == "quintic":
        return (1 - t) ** 3 * (1 + t * (3 + 6 * t))
    return fall_off("cubic", 2 * t - 1)


def derivative(kind: FallOff, t: Floats) -> Floats:
    """Return g'(t), 0 beyond 1."""
    inside = t < 1
    t = np.clip(t, 0.0, 1.0)
    if kind == "wyvill":
        slope = -6 * t * (1 - t * t) ** 2
    elif kind == "cubic":
        slope = -6 * t * (1 - t)
    elif kind == "quintic":
        slope = -30 * t * t * (1 - t) ** 2
    else:
        return 2 * derivative("cubic", 2 * t - 1) * (t > 0.5)
    return slope * inside


def steepest_between(kind: FallOff, near: float, far: float) -> float:
    """Return the largest |g'(t)| for t in [near, far]: at an end, or where |g'| peaks inside."""
    peak = {"wyvill": 1 / sqrt(5), "cubic": 0.5, "quintic": 0.5, "plateau": 0.75}[kind]
    if near <= peak <= far:
        return STEEPEST[kind]
    ends = np.abs(derivative(kind, np.array([near, far])))
    return float(ends.max())
