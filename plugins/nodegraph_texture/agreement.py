"""How far a reproduction agrees with what it reproduces: shares of layers, confusion, kappa, colour error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[Any]
Counts = npt.NDArray[np.int64]


def visible_shares(covers: Sequence[Floats]) -> list[Floats]:
    """Return how much of the picture each of some siblings has, first the root below them all.

    Each hides its share of what lies below: C_i times the product of 1 - C_j over all later ones.

    >>> visible_shares([np.array([0.5]), np.array([0.5])])
    [array([0.25]), array([0.25]), array([0.5])]
    """
    shares: list[Floats] = []
    left: Any = 1.0
    for cover in reversed(covers):
        shares.append(cover * left)
        left = left * (1 - cover)
    return [left, *reversed(shares)]


def confusion_matrix(truth: npt.NDArray[Any], found: npt.NDArray[Any], classes: int) -> Counts:
    """Return (classes, classes) counts of cells: row of the truth, column of what was found; negative ones left out.

    >>> confusion_matrix(np.array([0, 0, 1, -1]), np.array([0, 1, 1, 0]), 2).tolist()
    [[1, 1], [0, 1]]
    """
    both = (truth >= 0) & (found >= 0)
    pairs = truth[both].astype(np.intp) * classes + found[both]
    return np.bincount(pairs, minlength=classes * classes).reshape(classes, classes)


def overall_agreement(matrix: Counts) -> float:
    """Return the share of cells on the diagonal."""
    return float(np.trace(matrix) / matrix.sum())


def cohens_kappa(matrix: Counts) -> float:
    """Return (p - e) / (1 - e), e the agreement that chance would bring; NaN where chance brings all.

    Cohen 1960, A coefficient of agreement for nominal scales, doi:10.1177/001316446002000104.
    """
    total = matrix.sum()
    chance = float((matrix.sum(axis=0) / total) @ (matrix.sum(axis=1) / total))
    return float("nan") if chance == 1 else (overall_agreement(matrix) - chance) / (1 - chance)


def colour_errors(first: npt.NDArray[np.uint8], second: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Return the root of the mean squared difference of red, green and blue per cell, 0 to 1."""
    difference = (first[..., :3].astype(np.float32) - second[..., :3]) / np.float32(255)
    return np.asarray(np.sqrt(np.mean(difference * difference, axis=-1)))
