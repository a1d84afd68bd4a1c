"""Quantities in patches of the plane: an interval of their values, and a ball that holds their gradients.

The arithmetic of `noise_bounds`, which proves it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

Patches = Floats
"""A quantity in patches, six rows: its least and greatest value and that at the centre; of the ball of its gradients
the centre (east, north) and the radius."""


def steepest(found: Patches) -> Floats:
    """Return the longest gradient in the ball."""
    longest: Floats = np.hypot(found[3], found[4]) + found[5]
    return longest


def anchored(found: Patches, radius: Floats | float) -> Patches:
    """Return a quantity with values no farther from that at the centre than its slope allows."""
    reach = steepest(found) * radius
    # Rounding may have put the value itself just outside.
    np.maximum(found[0], np.minimum(found[2] - reach, found[1]), out=found[0])
    np.minimum(found[1], np.maximum(found[2] + reach, found[0]), out=found[1])
    return found


def folded(found: Patches) -> Patches:
    """Return |q|; where its sign is not known its gradients lie around 0."""
    low, high, value, east, north, spread = found
    sign = np.sign(np.sign(low) + np.sign(high))
    return np.stack(
        [
            np.maximum(np.maximum(low, -high), 0.0),
            np.maximum(high, -low),
            np.abs(value),
            sign * east,
            sign * north,
            np.where(sign == 0, steepest(found), spread),
        ]
    )


def product(a: Patches, b: Patches) -> Patches:
    """Return a b, where b is not negative."""
    a_low, a_high, a_value, a_east, a_north, a_spread = a
    b_low, b_high, b_value, b_east, b_north, b_spread = b
    a_mid, b_mid = 0.5 * (a_low + a_high), 0.5 * (b_low + b_high)
    made = np.empty(b.shape)
    np.minimum(a_low * b_low, a_low * b_high, out=made[0])
    np.maximum(a_high * b_low, a_high * b_high, out=made[1])
    np.multiply(a_value, b_value, out=made[2])
    made[3:5] = b_mid * a[3:5] + a_mid * b[3:5]
    made[5] = (b_high - b_mid) * np.hypot(a_east, a_north) + b_high * a_spread
    made[5] += (a_high - a_mid) * np.hypot(b_east, b_north) + np.maximum(a_high, -a_low) * b_spread
    return made


def square(a: Patches) -> Patches:
    """Return a^2, where a is not negative."""
    low, high, _, east, north, spread = a
    made: Patches = a * (low + high)
    made[:3] = a[:3] * a[:3]
    made[5] = (high - low) * np.hypot(east, north) + 2 * high * spread
    return made


def steepest_below(a: Patches, b: Patches, rate: float) -> Floats:
    """Return the greatest |grad(rate a b)| where 0 < rate a b < 1, b not negative.

    It is at most rate (b lambda(a) + a lambda(b)), which rises with both and is convex along a b = 1 / rate: greatest
    at an end of that curve, or where both are greatest.
    """
    limit = 1 / max(rate, 1e-150)
    a_most = np.minimum(a[1], limit / np.maximum(b[0], 1e-150))
    b_most = np.minimum(b[1], limit / np.maximum(a[0], 1e-150))
    a_least = np.minimum(a[1], limit / np.maximum(b_most, 1e-150))
    b_least = np.minimum(b[1], limit / np.maximum(a_most, 1e-150))
    steep, turned = steepest(a), steepest(b)
    greatest: Floats = rate * np.maximum(b_least * steep + a_most * turned, b_most * steep + a_least * turned)
    return greatest


def cut(made: Patches, limit: Floats, rate: float) -> Patches:
    """Return clamp(rate made, 0, 1), with a limit of its slope where that is between."""
    made = rate * made
    free, none = (made[0] >= 0) & (made[1] <= 1), (made[0] >= 1) | (made[1] <= 0)
    around = np.where(none, 0.0, np.minimum(steepest(made), limit))
    made[5] = np.where(free, made[5], around)
    made[3:5] *= free
    np.minimum(np.maximum(made[:3], 0.0), 1.0, out=made[:3])
    return made
