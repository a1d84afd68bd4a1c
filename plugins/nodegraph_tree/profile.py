"""Cross-sections: heights as piecewise-quadratic functions of the signed distance to a curve (section 4.1).

A `Section` holds its two sides apart, each as rows ``(begin, height, slope, bend)`` of pieces

    c(x) = height + (x - begin) (slope + (x - begin) bend),   begin <= x < begin of the next piece,

of the distance x >= 0 to the curve, the first beginning at 0 and the last without an end.

Through points, `section` lays the shape-preserving quadratic spline of Schumaker (1983): C1, between two points never
above or below both of them, at most two pieces an interval; or straight lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from nodegraph import port_type

Floats = npt.NDArray[np.float64]
Shape = Literal["smooth", "straight"]


@port_type
class Section:
    """A cross-section: pieces ``(begin, height, slope, bend)`` left and right of a curve, (n, 4) each.

    Both sides have the same height at 0.
    """

    left: Floats
    right: Floats

    @property
    def symmetric(self) -> bool:
        """True where both sides are the same."""
        return self.left.shape == self.right.shape and bool(np.array_equal(self.left, self.right))


def section(points: Sequence[Sequence[float]], shape: Shape = "smooth") -> Section:
    """Return the cross-section through points [signed distance, height], left of the curve positive.

    Points on one side only (no negative distance, or no positive one) are mirrored; what lies beyond the outermost
    continues level.

    Args:
        points: by rising distance, m each; at least one.
        shape: ``smooth`` (C1) or ``straight`` lines.

    Raises:
        ValueError: points that are not finite, not pairs, or do not rise in distance.
    """
    if not points or any(len(point) != 2 for point in points):
        raise ValueError("a cross-section needs points [distance, height], one at least")
    given = np.array(points, np.float64)
    if not np.isfinite(given).all():
        raise ValueError("a cross-section holds a number that is not finite")
    x, y = given.T
    if (np.diff(x) <= 0).any():
        raise ValueError("the distances of a cross-section must rise from point to point")
    if x[0] >= 0 or x[-1] <= 0:
        if x[0] < 0:
            x, y = -x[::-1], y[::-1]
        twice = x > 0
        x, y = np.concatenate([-x[twice][::-1], x]), np.concatenate([y[twice][::-1], y])
        pieces = _pieces(x, y, shape)
        side = _from(pieces, 0.0)
        return Section(side, side)
    pieces = _pieces(x, y, shape)
    return Section(_from(pieces, 0.0), _from(_pieces(-x[::-1], y[::-1], shape), 0.0))


def level(height: float = 0.0) -> Section:
    """Return the cross-section of one height."""
    side = np.array([[0.0, height, 0.0, 0.0]])
    return Section(side, side)


def mixed(first: Section, second: Section, share: float) -> Section:
    """Return (1 - share) first + share second."""
    if share <= 0 or first is second:
        return first
    if share >= 1:
        return second
    sides = []
    for a, b in ((first.left, second.left), (first.right, second.right)):
        begins = np.union1d(a[:, 0], b[:, 0])
        one, two = _begun(a, begins), _begun(b, begins)
        sides.append(np.column_stack([begins, (1 - share) * one + share * two]))
    return Section(*sides)


def stretched(given: Section, wide: float, high: float = 1.0) -> Section:
    """Return the section with distances multiplied by `wide` > 0 and heights by `high`."""
    factors = np.array([wide, high, high / wide, high / wide**2])
    return Section(given.left * factors, given.right * factors)


def evaluate(pieces: Floats, x: Floats) -> tuple[Floats, Floats]:
    """Return c and its derivative at distances x >= 0, of any shape."""
    index = np.maximum(np.searchsorted(pieces[:, 0], x, side="right") - 1, 0)
    begin, height, slope, bend = pieces[index].reshape(*x.shape, 4).transpose(-1, *range(x.ndim))
    u = x - begin
    return height + u * (slope + u * bend), slope + 2 * u * bend


def extremes(pieces: Floats, near: float, far: float) -> tuple[float, float, float]:
    """Return the least and greatest c and the greatest |c'| for distances from `near` to `far`; exact."""
    ends = np.append(pieces[1:, 0], np.inf)
    begin, height, slope, bend = pieces.T
    met = (begin <= far) & (ends >= near)
    begin, height, slope, bend, ends = (item[met] for item in (begin, height, slope, bend, ends))
    u, v = np.maximum(near, begin) - begin, np.minimum(far, ends) - begin
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.where(bend != 0, -slope / (2 * bend), u)
    turn = np.clip(turn, u, v)
    values = np.concatenate([height + t * (slope + t * bend) for t in (u, v, turn)])
    steep = np.concatenate([np.abs(slope + 2 * bend * t) for t in (u, v)])
    return float(values.min()), float(values.max()), float(steep.max())


def steepest_chord(pieces: Floats, near: float, far: float) -> float:
    """Bound |c(x)| / x for distances from `near` to `far`, of pieces that are 0 at 0."""
    steep = extremes(pieces, 0.0, far)[2]
    if near <= 0:
        return steep
    low, high, _ = extremes(pieces, near, far)
    return min(steep, max(-low, high) / near)


def difference(a: Floats, b: Floats) -> Floats:
    """Return the pieces of a - b."""
    begins = np.union1d(a[:, 0], b[:, 0])
    return np.column_stack([begins, _begun(a, begins) - _begun(b, begins)])


def _begun(pieces: Floats, begins: Floats) -> Floats:
    """Return (height, slope, bend) of the pieces re-begun at finer places, (n, 3)."""
    value, slope = evaluate(pieces, begins)
    index = np.maximum(np.searchsorted(pieces[:, 0], begins, side="right") - 1, 0)
    return np.column_stack([value, slope, pieces[index, 3]])


def _from(pieces: Floats, x: float) -> Floats:
    """Return the pieces from x on."""
    later = pieces[pieces[:, 0] > x]
    head = np.column_stack([[x], _begun(pieces, np.array([x]))])
    return np.concatenate([head, later])


def _pieces(x: Floats, y: Floats, shape: Shape) -> Floats:
    """Return pieces over the whole line, the first beginning before all points."""
    first = [x[0] - 1.0, y[0], 0.0, 0.0]
    last = [x[-1], y[-1], 0.0, 0.0]
    if len(x) == 1:
        return np.array([first, last])
    secant = np.diff(y) / np.diff(x)
    if shape == "straight":
        rows = np.column_stack([x[:-1], y[:-1], secant, np.zeros(len(secant))])
        return np.concatenate([[first], rows, [last]])
    slopes = np.zeros(len(x))
    left, right = secant[:-1], secant[1:]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        slopes[1:-1] = np.where(left * right > 0, 2 * left * right / (left + right), 0.0)
    half = np.diff(x) / 2
    # The slope halfway makes the interval rise as it must; with |slopes| <= 2 |secant| it has the secant's sign.
    middle = 2 * secant - 0.5 * (slopes[:-1] + slopes[1:])
    up, down = (middle - slopes[:-1]) / (2 * half), (slopes[1:] - middle) / (2 * half)
    halfway = y[:-1] + half * (slopes[:-1] + half * up)
    rows = np.stack(
        [np.column_stack([x[:-1], y[:-1], slopes[:-1], up]), np.column_stack([x[:-1] + half, halfway, middle, down])],
        axis=1,
    ).reshape(-1, 4)
    return np.concatenate([[first], rows, [last]])
