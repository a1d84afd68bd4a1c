"""How much a tree is there: a share c(alpha) in [0, 1] that fades to nothing where its terrain ends.

An operator that mixes the heights of two trees needs both, but a height means nothing where its own weight is 0.  Where
the paper's formulas leave that open, the operators multiply the share of a tree by

    c = s (2 - s),  s = min(alpha / T, 1):

1 on the terrain (alpha >= T), so that the printed formulas hold there as they are, and falling to 0 at the edge of the
support without a crease (C1 wherever alpha is, for c'(T) = 0 and grad alpha vanishes where alpha does).

The bounds use s <= c <= 2 s, hence c <= 2 alpha / T, and |grad c| <= 2 / T |grad alpha|.
"""

from __future__ import annotations

import numpy as np

from nodegraph_tree.function import THRESHOLD, Bounds, Floats, product

STEEPEST = 2 / THRESHOLD
"""Largest derivative of c by alpha."""


def presence(weight: Floats) -> Floats:
    """Return c(alpha)."""
    s = np.minimum(weight * (1 / THRESHOLD), 1.0)
    found: Floats = s * (2 - s)
    return found


def presence_gradient(weight: Floats, weight_gradient: Floats) -> Floats:
    """Return the gradient of c, (2, n)."""
    s = np.minimum(weight * (1 / THRESHOLD), 1.0)
    return STEEPEST * (1 - s) * weight_gradient


def presence_slope(bounds: Bounds) -> float:
    """Bound |grad c| from the bounds of a tree."""
    return product(STEEPEST * (1 - min(bounds.weight_low / THRESHOLD, 1.0)), bounds.weight_slope)


def present_slope(bounds: Bounds) -> float:
    """Bound c |grad f|: on the terrain its slope, beyond it c |grad f| <= 2 / T alpha |grad f|."""
    if bounds.weight_low >= THRESHOLD:
        return bounds.slope
    return min(max(bounds.slope, STEEPEST * bounds.flux), max(bounds.slope, bounds.support_slope))
