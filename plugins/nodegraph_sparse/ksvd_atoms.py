"""New atoms for K-SVD: the main direction of a rest, or a step towards it."""

from __future__ import annotations

import numpy as np

from nodegraph_sparse.pursuit_rules import Floats


def exact(error: Floats, counted: int) -> Floats | None:
    """Return the atom of the greatest ||E d||: the first right singular vector of the columns that count.

    With v the left one, every column of the atom is the same sum E' v of its users, those that do not count too.
    Found from the smaller of E' E and E E'.

    Args:
        error: E, (m, K).
        counted: k, the columns that count.

    Returns:
        (K,), of norm 1 in the columns that count; none where nothing is left.
    """
    from scipy.linalg import eigh

    part = error[:, :counted]
    wide = len(part) < counted
    square = part @ part.T if wide else part.T @ part
    last = len(square) - 1
    direction = eigh(square, subset_by_index=(last, last), check_finite=False, overwrite_a=True)[1][:, 0]
    return combined(error, direction if wide else part @ direction, counted)


def combined(error: Floats, amounts: Floats, counted: int) -> Floats | None:
    """Return E' x as an atom: the best one for coefficients x, and a power step towards the singular vector."""
    atom = amounts @ error
    norm = np.linalg.norm(atom[:counted])
    return atom / norm if norm > 0 else None
