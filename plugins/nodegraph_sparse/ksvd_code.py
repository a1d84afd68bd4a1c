"""Bettering a given sparse code: coefficients fitted anew, and one atom exchanged for another."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from nodegraph_sparse.pursuit_rules import DEPENDENT, Floats

Codes = npt.NDArray[np.int32]

PART = 1 << 21
"""Numbers of temporaries: 16 MB."""


def refit(signals: Floats, atoms: Floats, indices: Codes) -> tuple[Floats, Floats]:
    """Return the coefficients of given atoms by least squares, (n, s), and the squared residuals that they leave.

    Of dependent atoms the coefficients of least norm.

    Args:
        signals: (n, k).
        atoms: (N, k), of norm 1.
        indices: (n, s), -1 where none.
    """
    coefficients, residuals = np.zeros(indices.shape), np.empty(len(indices))
    sparsity = indices.shape[1]
    for part in parts(len(indices), sparsity * max(signals.shape[1], sparsity)):
        used = indices[part] >= 0
        chosen = atoms[indices[part]] * used[:, :, None]
        aims = chosen @ signals[part, :, None]
        inverse = np.linalg.pinv(chosen @ chosen.transpose(0, 2, 1), rcond=DEPENDENT, hermitian=True)
        coefficients[part] = np.where(used, (inverse @ aims)[:, :, 0], 0.0)
        rest = signals[part] - (coefficients[part, None] @ chosen)[:, 0]
        residuals[part] = np.einsum("ij,ij->i", rest, rest)
    return coefficients, residuals


def exchange(signals: Floats, atoms: Floats, indices: Codes, slot: int) -> Codes:
    """Return the codes with the best atom in one place, the others fixed: a step of orthogonal least squares.

    With P the projection on the span of the others, the best atom has the greatest <y, d - P d>^2 / |d - P d|^2.

    Args:
        signals: (n, k).
        atoms: (N, k), of norm 1.
        indices: (n, s), -1 where none.
        slot: which place; where it is empty the best atom is added.
    """
    gram = atoms @ atoms.T
    found = indices.copy()
    others = np.delete(indices, slot, axis=1)
    for part in parts(len(indices), len(atoms) * max(1, others.shape[1])):
        fixed, correlations = others[part], signals[part] @ atoms.T
        used = fixed >= 0
        basis = whitening(gram, fixed)
        along = basis @ (gram[fixed] * used[:, :, None])
        aims = np.take_along_axis(correlations, np.maximum(fixed, 0), 1) * used
        correlations -= ((basis @ aims[:, :, None]).transpose(0, 2, 1) @ along)[:, 0]
        apart = gram.diagonal() - np.einsum("ijk,ijk->ik", along, along)
        gains = np.where(apart > DEPENDENT, correlations**2 / np.maximum(apart, DEPENDENT), 0.0)
        best = gains.argmax(axis=1)
        gains = np.take_along_axis(gains, best[:, None], 1)[:, 0]
        found[part, slot] = np.where(gains > 0, best, indices[part, slot])
    return found


def summed(atoms: Floats, indices: Codes, coefficients: Floats) -> Floats:
    """Return the sums of atoms that codes say, (n, k)."""
    total = np.zeros((len(indices), atoms.shape[1]))
    for index, coefficient in zip(indices.T, coefficients.T, strict=True):
        total += coefficient[:, None] * atoms[index]
    return total


def whitening(gram: Floats, indices: Codes) -> Floats:
    """Return what makes orthonormal bases of atoms, (n, s, s): its product with their products with a vector.

    The inverse square root of their Gram matrix; rows of dependent directions are zero.

    Args:
        gram: (N, N), products of atoms.
        indices: (n, s), -1 where none.
    """
    used, some = indices >= 0, np.maximum(indices, 0)
    products = gram[some[:, :, None], some[:, None]] * used[:, :, None] * used[:, None]
    values, vectors = np.linalg.eigh(products)
    roots = np.where(values > DEPENDENT, values, np.inf) ** -0.5
    return np.asarray(roots[:, :, None] * vectors.transpose(0, 2, 1))


def parts(count: int, each: int) -> Iterator[slice]:
    """Yield ranges over signals of so many numbers each, of `PART` at most."""
    step = max(1, PART // each)
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))
