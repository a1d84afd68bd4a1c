"""Blending: the weighted mean of any number of trees (section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import chain, groupby
from math import inf
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_tree.box_index import BoxIndex
from nodegraph_tree.device import FOLDER, Kernel
from nodegraph_tree.function import (
    ABSENT,
    NOWHERE,
    THRESHOLD,
    Bounds,
    Box,
    ElevationFunction,
    Floats,
    Points,
    Sample,
)

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Fill, Frame

_BLEND = Kernel("tree_blend", FOLDER / "operators.cl")

_FEW = 8
"""Up to this many operands it does not pay to tell apart the blocks of a tile."""

_PAIRS = 512
"""Up to this many operands the bound compares each with each."""


@port_type
class Blend(ElevationFunction):
    """A blend of trees: f = sum(alpha_i f_i) / sum(alpha_i), alpha = sum(alpha_i).

    Associative and commutative; build it with `blend`, which makes one of nested ones.
    """

    operands: tuple[ElevationFunction, ...]

    @property
    def parts(self) -> Sequence[ElevationFunction]:
        """The operands."""
        return self.operands

    @cached_property
    def support(self) -> Box:
        """Around all operands."""
        box = NOWHERE
        for part in self.operands:
            box = box.union(part.support)
        return box

    @cached_property
    def _sorted(self) -> tuple[ElevationFunction, ...]:
        """The operands, those that are one and the same instruction side by side."""
        kinds: dict[tuple[Kernel, Fill] | None, list[ElevationFunction]] = {}
        for part in self.operands:
            kinds.setdefault(part.single, []).append(part)
        return tuple(chain.from_iterable(kinds.values()))

    @cached_property
    def _index(self) -> BoxIndex:
        return BoxIndex([part.support for part in self._sorted])

    def reaching(self, box: Box) -> list[ElevationFunction]:
        """Return the operands whose support meets a box, in an order that does not depend on it."""
        return [self._sorted[number] for number in self._index.meeting(box).tolist()]

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Return the weighted mean; each operand is asked only where it reaches.

        The mean is kept up to date, f + (alpha_i / alpha)(f_i - f), rather than divided at the end: where alpha_i is 0
        nothing changes, and where no other operand reaches, f_i comes out as it is, bit for bit.
        """
        size = points.x.shape
        height, weight = np.zeros(size), np.zeros(size)
        height_slope = np.zeros((2, *size)) if gradient else None
        weight_slope = np.zeros((2, *size)) if gradient else None
        for part in self.operands:
            near = part.support
            where = (points.x >= near.west) & (points.x <= near.east)
            where &= (points.y >= near.south) & (points.y <= near.north)
            if not where.any():
                continue
            sample = part.query(points.taken(where), gradient=gradient)
            before, total = weight[where], weight[where] + sample.weight
            share = np.divide(sample.weight, total, out=np.zeros_like(total), where=total > 0)
            step = sample.height - height[where]
            if height_slope is not None and weight_slope is not None:
                assert sample.height_gradient is not None
                assert sample.weight_gradient is not None
                turned = (1 - share) * sample.weight_gradient - share * weight_slope[:, where]
                # With nothing before, the share is 1 and does not change; its limit where weights vanish is of no use.
                turned = np.divide(turned, total, out=np.zeros_like(turned), where=(total > 0) & (before > 0))
                height_slope[:, where] += share * (sample.height_gradient - height_slope[:, where]) + turned * step
                weight_slope[:, where] += sample.weight_gradient
            # The first to reach a point is taken as it is: 0 + (f_i - 0).
            height[where] += share * step
            weight[where] = total
        return Sample(height, weight, height_slope, weight_slope)

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        r"""Bound the blend from the bounds of the operands that reach the box.

        *f* is a mean, with weights that are known to intervals: see `greatest_mean`.

        *The gradient* is sum_i beta_i grad f_i + sum_i (f_i - f) grad alpha_i / alpha, beta_i = alpha_i / alpha.  The
        first sum is such a mean too, of bounds of |grad f_i| on the supports; an operand without one adds flux_i /
        alpha instead.  The second is at most sum_i lambda_i |f_i - f| / alpha, lambda_i bounding |grad alpha_i|.  That
        is convex in f, so it is greatest at an end of the interval of f; and as f is a mean of the f_k also where f is
        one of them, at an end of its interval: max_k sum_(i != k) lambda_i |f_i - f_k|.  For two operands this is
        max(lambda_A, lambda_B) sup|f_A - f_B| / alpha: the printed bound (appendix) with the factor 1 / alpha that it
        drops.  alpha >= T on the terrain.

        Multiplied by alpha the sums give the flux.  O(n^2) up to 512 operands in the box, then O(n log n).
        """
        found = [bounds for part in self.reaching(box) if not (bounds := part.bounds(box, detail)).absent]
        if not found:
            return ABSENT
        if len(found) == 1:
            return found[0]
        parts = np.array(found)
        lows, highs, lightest, heaviest = parts[:, :4].T
        low, high = -greatest_mean(-lows, lightest, heaviest), greatest_mean(highs, lightest, heaviest)
        least, most = float(lightest.sum()), float(heaviest.sum())
        pull, flux = _pull(parts, low, high), float(parts[:, 6].sum())
        terrain = max(least, THRESHOLD)
        steepest = np.array([item.steepest for item in found])
        return Bounds(
            low,
            high,
            least,
            most,
            _mean_slope(parts, steepest, terrain) + pull / terrain,
            float(parts[:, 5].sum()),
            flux + pull,
            _mean_slope(parts, steepest, least) + (pull / least if least > 0 else 0.0 if pull == 0 else inf),
        )

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Sum up what reaches the tile."""
        numbers = self._index.meeting(frame.box)
        parts = [self._sorted[number] for number in numbers.tolist()]
        if len(parts) > _FEW:
            _emit_many(parts, frame.blocks_in(self._index.boxes[numbers]), emitter, frame)
            return
        if not parts:
            emitter.nothing()
        for place, part in enumerate(parts):
            part.emit(emitter, frame)
            if place:
                emitter.add(_BLEND, pushes=-1)


def _emit_many(
    parts: Sequence[ElevationFunction], blocks: npt.NDArray[np.int32], emitter: Emitter, frame: Frame
) -> None:
    """Sum up operands, each in the blocks that it reaches; those that are one and the same instruction in one go."""
    emitter.nothing()
    whole, first = emitter.blocks, 0
    for single, same in groupby(parts, lambda part: part.single):
        some = list(same)
        theirs = blocks[first : first + len(some)]
        first += len(some)
        if single is not None:
            kernel, fill = single
            emitter.add_each(kernel, fill, some, frame, theirs, _BLEND)
            continue
        for part, emitter.blocks in zip(some, (whole & theirs).tolist(), strict=True):
            part.emit(emitter, frame)
            emitter.add(_BLEND, pushes=-1)
        emitter.blocks = whole


def greatest_mean(values: Floats, least: Floats, most: Floats) -> float:
    """Return the greatest weighted mean of values with weights between `least` and `most`.

    Linear over linear in each weight: values above the mean have all the weight that they can, those below the least.
    O(n log n).
    """
    highest = float(values.max())
    if not np.isfinite(values).all():
        return highest
    order = np.argsort(-values)
    v, light, heavy = values[order], least[order], most[order]
    # Above a place the greatest weights, below it the least ones.
    moment = np.cumsum(heavy * v) + (np.cumsum((light * v)[::-1])[::-1] - light * v)
    weight = np.cumsum(heavy) + (np.cumsum(light[::-1])[::-1] - light)
    mean = float((moment / weight).max())
    return min(mean + 1e-14 * len(v) * float(np.abs(v).max()), highest)  # what rounding may have lost


def _mean_slope(parts: Floats, steepest: Floats, least: float) -> float:
    """Bound the weighted mean of |grad f_i| where the weights sum to `least` or more."""
    bounded = np.isfinite(steepest)
    mean = greatest_mean(np.where(bounded, steepest, 0.0), parts[:, 2], parts[:, 3])
    flux, others = float(parts[:, 6].sum()), float(parts[~bounded, 6].sum())
    if least <= 0:
        return mean + (0.0 if others == 0 else inf)
    return min(mean + others / least, flux / least)


def _pull(parts: Floats, low: float, high: float) -> float:
    """Bound sum_i lambda_i |f_i - f|, for f from `low` to `high` that is a mean of the f_k."""
    lows, highs, slopes = parts[:, 0], parts[:, 1], parts[:, 5]
    if not (slopes > 0).any():
        return 0.0
    if not (np.isfinite(lows).all() and np.isfinite(highs).all()):
        return inf
    greatest = max(float(slopes @ np.maximum(highs - f, f - lows)) for f in (low, high))
    if len(parts) > _PAIRS:
        return greatest
    as_one = 0.0
    for ends in (lows, highs):
        apart = np.maximum(highs[:, None] - ends, ends - lows[:, None])
        np.fill_diagonal(apart, 0.0)
        as_one = max(as_one, float((slopes @ apart).max()))
    return min(greatest, as_one)


def blend(operands: Sequence[ElevationFunction]) -> ElevationFunction:
    """Return the blend of trees, with nested blends taken apart; one operand is returned itself."""
    flat: list[ElevationFunction] = []
    stack = list(reversed(operands))
    while stack:
        part = stack.pop()
        if isinstance(part, Blend):
            stack.extend(reversed(part.operands))
        else:
            flat.append(part)
    return flat[0] if len(flat) == 1 else Blend(tuple(flat))
