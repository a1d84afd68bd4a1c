"""Constraint functions from where surfaces lie: three rules, all within equation 1.

C = clamp(b prod_i F_i), and each layer hides its share of those before it.  So the picture shows class k with weight
C_k times the product of 1 - C_j over the later ones j: exactly the posterior of class k, if every C_k is the
probability of k *among the cells of no later class*.  The rules ``conditional`` and ``additive`` estimate that.

A product of conditional probabilities is no probability.  Its scale is set by area: b is such that the mean coverage of
the cells of no later class is the share of the class among them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_texture.agreement import visible_shares

Rule = Literal["additive", "conditional", "printed"]
Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

PASSES = 15
"""Of the additive rule over all quantities.

Where quantities are much alike that is short of the limit (by 0.015 of coverage on Everest), but no worse for ground
that was not learnt from: four times as many passes change agreement there by 0.003 at most.
"""

RIDGE = 10.0
"""Cells that hold odds and probabilities back to those of all: where few cells were seen, little is claimed."""

STEEPEST = 20.0
"""Of the logarithm of an additive function: what lies lower plays no part."""


class Fitted(NamedTuple):
    """What a layer appears by.

    Attributes:
        functions: F_i, (quantities, samples), 0 to 1.
        bias: b.
        reached: of each quantity, whether the mean of the function is what the printed rule asks for.
    """

    functions: Floats
    bias: float
    reached: tuple[bool, ...] = ()


@dataclass
class Fit:
    """Cells to fit to, and what was found for each class above each set of later ones.

    Attributes:
        counts: (classes, quantities, samples): cells of every class in every bin of every quantity.
        labels: (cells,) class of some of the cells.
        bins: (quantities, cells) bin of each quantity there.
        rule: how.
        smoothing: standard deviation of the Gaussian that smooths histograms, bins.
        sharpness: power that functions are raised to.
    """

    counts: npt.NDArray[np.int64]
    labels: npt.NDArray[Any]
    bins: npt.NDArray[Any]
    rule: Rule
    smoothing: float
    sharpness: float = 1.0
    known: dict[tuple[int, frozenset[int]], tuple[Fitted, Floats]] = field(default_factory=dict)

    def layer(self, number: int, later: frozenset[int]) -> tuple[Fitted, Floats]:
        """Return what class `number` appears by under some later ones, and its coverage of the cells."""
        if self.rule == "printed":
            later = frozenset()
        if (number, later) not in self.known:
            rest = ~np.isin(self.labels, list(later))
            fitted = self._fitted(number, later, rest)
            fitted = fitted._replace(functions=fitted.functions**self.sharpness)
            score = self._product(fitted.functions)
            if self.rule != "printed":
                share = float((self.labels[rest] == number).mean()) if rest.any() else 0.0
                fitted = fitted._replace(bias=area_bias(score[rest], share))
            self.known[number, later] = fitted, np.minimum(fitted.bias * score, 1.0)
        return self.known[number, later]

    def agreement(self, order: Sequence[int], root: int) -> float:
        """Return the share of cells whose class has the largest share of the picture, for an order of siblings."""
        covers = [self.layer(number, frozenset(order[place + 1 :]))[1] for place, number in enumerate(order)]
        winner = np.argmax(np.stack(visible_shares(covers)), axis=0)
        return float((np.array([root, *order])[winner] == self.labels).mean())

    def _fitted(self, number: int, later: frozenset[int], rest: Flags) -> Fitted:
        own = self.counts[number]
        if self.rule == "printed":
            found = [printed_function(counts) for counts in own]
            return Fitted(np.stack([function for function, _ in found]), 1.0, tuple([good for _, good in found]))
        if self.rule == "conditional":
            kept = [other for other in range(len(self.counts)) if other not in later]
            return Fitted(conditional_functions(own, self.counts[kept].sum(axis=0), self.smoothing), 1.0)
        held = self.labels[rest] == number
        return Fitted(additive_functions(self.bins[:, rest], held, own.shape[1], self.smoothing), 1.0)

    def _product(self, functions: Floats) -> Floats:
        product = np.ones(self.labels.shape)
        for function, bins in zip(functions, self.bins, strict=True):
            product *= function[bins]
        return product


def printed_function(counts: npt.NDArray[Any]) -> tuple[Floats, bool]:
    """Return a histogram scaled and clamped so that its mean is 1/2, and whether that can be.

    Where half of the bins or fewer are filled no scale reaches it: the function is then 1 where the class occurs, the
    limit of ever greater scales.  Dachsbacher et al. 2006, section 5.2.3.

    >>> printed_function(np.array([0, 2, 4, 4]))
    (array([0. , 0.4, 0.8, 0.8]), True)
    """
    half = len(counts) / 2
    filled = int((counts > 0).sum())
    if filled <= half:
        return (counts > 0).astype(np.float64), filled == half
    scale = _clamped_scale(counts.astype(np.float64), half)
    return np.minimum(scale * counts, 1.0), True


def conditional_functions(own: npt.NDArray[Any], every: npt.NDArray[Any], smoothing: float) -> Floats:
    """Return P(class | bin) of each quantity over its maximum: counts of the class divided by those of all.

    Both are smoothed, and `RIDGE` cells with the class's share of all are added to every bin.

    Args:
        own: (quantities, bins) cells of the class.
        every: likewise of the class and all that it may cover.
        smoothing: bins.
    """
    share = own.sum(axis=1, keepdims=True) / np.maximum(every.sum(axis=1, keepdims=True), 1)
    probability = (_smooth(own, smoothing) + RIDGE * share) / (_smooth(every, smoothing) + RIDGE)
    return np.asarray(probability / np.maximum(probability.max(axis=1, keepdims=True), 1e-30))


def additive_functions(bins: npt.NDArray[Any], held: Flags, count: int, smoothing: float) -> Floats:
    """Return F_i = exp(f_i - max f_i) of the additive model log(P / (1 - P)) = f_0 + sum_i f_i(q_i).

    So the product of all F_i is proportional to the odds of the class, with what quantities have in common counted
    once, which a product of conditional probabilities counts for each of them.  Fitted by local scoring: in turn, each
    f_i takes a Newton step of the likelihood in every bin, smoothed.

    Args:
        bins: (quantities, cells).
        held: whether a cell is of the class.
        count: of bins.
        smoothing: bins.

    Hastie and Tibshirani 1986, Generalized additive models, doi:10.1214/ss/1177013604.  O(passes cells quantities).
    """
    functions = np.zeros((len(bins), count))
    share = min(max(float(held.mean()), 1e-6), 1 - 1e-6) if held.size else 0.5
    # Cells in single precision, sums over them in double; `bincount` takes bins of this size as they are.
    odds = np.full(held.shape, np.log(share / (1 - share)), np.float32)
    places, own = bins.astype(np.intp), held.astype(np.float32)
    for _ in range(PASSES):
        for function, numbers in zip(functions, places, strict=True):
            # 1 / (1 + exp(-odds)), which would overflow.
            chance = np.tanh(odds / 2)
            chance += 1
            chance /= 2
            slope = np.bincount(numbers, own - chance, count)
            chance -= chance * chance
            curvature = np.bincount(numbers, chance, count)
            step = _smooth(slope, smoothing) / (_smooth(curvature, smoothing) + RIDGE)
            function += step
            odds += step.astype(np.float32)[numbers]
    seen = np.stack([np.bincount(numbers, minlength=count) > 0 for numbers in places])
    highest = np.where(seen, functions, -np.inf).max(axis=1, keepdims=True)
    return np.asarray(np.exp(np.clip(functions - highest, -STEEPEST, 0)))


def area_bias(score: npt.NDArray[Any], share: float) -> float:
    """Return b for which the mean of min(b score, 1) is `share`; full coverage where that is the most there can be.

    >>> area_bias(np.array([0.0, 1.0, 1.0, 2.0]), 0.5)
    0.5
    """
    positive = score[score > 0].astype(np.float64)
    target = share * len(score)
    if not len(positive) or target <= 0:
        return 0.0
    if len(positive) <= target:
        return float(1 / positive.min())
    return _clamped_scale(positive, target)


def _clamped_scale(values: Floats, total: float) -> float:
    """Return the scale for which the sum of min(scale * values, 1) is `total`; fewer than the positive ones."""
    falling = np.sort(values)[::-1]
    # With the first k full, the others must make up what is left of the total.
    tail = np.cumsum(falling[::-1])[::-1]
    full = np.arange(len(falling))
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = (total - full) / tail
        fits = np.flatnonzero((scale > 0) & (scale * falling <= 1 + 1e-12))
    return float(scale[fits[0]])


def best_order(fit: Fit, root: int, order: list[int], context: Context) -> tuple[list[int], float]:
    """Return the order of siblings that agrees best, by swaps of neighbours from a given one, and its agreement.

    Ends where no swap helps; each costs two layers.
    """
    best = fit.agreement(order, root)
    improved = True
    while improved:
        improved = False
        for place in range(len(order) - 1):
            context.progress(None, "order of layers")
            swapped = [*order[:place], order[place + 1], order[place], *order[place + 2 :]]
            found = fit.agreement(swapped, root)
            if found > best:
                order, best, improved = swapped, found, True
    return order, best


def _smooth(counts: npt.NDArray[Any], deviation: float) -> Floats:
    from scipy.ndimage import gaussian_filter1d

    values = np.asarray(counts, np.float64)
    return values if deviation <= 0 else np.asarray(gaussian_filter1d(values, deviation, mode="constant"))
