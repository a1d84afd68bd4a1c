"""Multigrid for div(k grad u) = s on a grid of cells, some of them with given values.

A system is two arrays of conductances (one per side that two cells share) and the set of free cells; every other cell
has a given value, and nothing flows across the outer edge.  `solve` runs conjugate gradients preconditioned by one
V-cycle.

The hierarchy is black-box multigrid (Dendy 1982, doi:10.1016/0021-9991(82)90057-2): coarse cells are every second cell
along each axis (of any number), interpolation follows the operator, coarse operators are Galerkin products.  A coarse
operator so knows every given value and every impermeable wall of the finer ones, also those thinner than its cells: the
number of steps depends neither on the size nor on how the given values lie.

**Precision.**  All arrays may be float32.  Residuals are sums of conductance times *difference*: the difference of two
close float32 numbers is exact, so a residual is as accurate as the stored solution, far better than its size times the
rounding unit.  Conjugate gradients solve for a correction and are restarted from such a residual each time it has
fallen a thousandfold; the result is accepted only by a freshly computed residual.  Scalar products add up in float64.

**The tolerance is one of error**, not of residual: a V-cycle applied to the residual estimates the error itself, to
some ten percent, and its largest value decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from nodegraph import Context

Array = npt.NDArray[Any]
Offset = tuple[int, int]

COARSEST = 256
"""Grids of at most this many cells are solved by a dense inverse."""
MARGIN = 2
"""Cells that arrays of a level have beyond each edge, all 0, so that no neighbour's neighbour is missing."""
DAMPING = 0.8
"""Of the Jacobi smoother."""
FALL = 1e-6
"""Fall of r.z (a square) at which the residual is computed anew."""
STEPS_MAX = 400

TARGETS: tuple[Offset, ...] = ((0, 0), (0, 1), (1, 0), (1, 1), (1, -1))
"""Coarse couplings that are kept: the cell itself and one of each pair of neighbours."""
EDGES: tuple[Offset, ...] = ((0, 1), (0, -1), (1, 0), (-1, 0))
CORNERS: tuple[Offset, ...] = ((1, 1), (1, -1), (-1, 1), (-1, -1))
REACH: tuple[Offset, ...] = ((0, 0), *EDGES, *CORNERS)


class Grid(Protocol):
    """What conjugate gradients need of a system and its hierarchy: the arrays x, r, z, p and q stay inside."""

    def residual(self) -> None:
        """Set r = -A x - s."""

    def precondition(self) -> tuple[float, float]:
        """Set z to one V-cycle on r; return r.z and max |z|."""

    def turn(self, beta: float) -> None:
        """Set p = z + beta p."""

    def curvature(self) -> float:
        """Set q = A p; return p.q."""

    def advance(self, alpha: float) -> None:
        """Add alpha p to x and take alpha q from r."""

    def correct(self) -> None:
        """Add z to x."""


def iterate(grid: Grid, tolerance: float, scale: float, context: Context, steps: int = STEPS_MAX) -> int:
    """Solve by preconditioned conjugate gradients; return the number of V-cycles.

    Args:
        grid: the system, with a first guess.
        tolerance: largest error of any cell, relative to the scale.
        scale: range of the solution; the first correction counts where it is larger.
        context: for progress and cancellation.
        steps: after so many V-cycles it is given up.

    Raises:
        ArithmeticError: it did not converge.
    """
    cycles = 0
    while True:
        grid.residual()
        product, peak = grid.precondition()
        cycles += 1
        scale = max(scale, peak)
        if peak <= tolerance * scale:
            grid.correct()
            return cycles
        start = product
        beta = 0.0
        while True:
            context.progress(None, f"V-cycle {cycles}, error {peak / scale:.1e}")
            grid.turn(beta)
            curvature = grid.curvature()
            if not curvature > 0:
                break
            grid.advance(product / curvature)
            previous, (product, peak) = product, grid.precondition()
            cycles += 1
            if peak <= 0.5 * tolerance * scale or product <= FALL * start:
                break
            if cycles >= steps or not np.isfinite(product):
                raise ArithmeticError(f"multigrid did not converge in {steps} V-cycles; this is a bug")
            beta = product / previous
        if cycles >= steps:
            raise ArithmeticError(f"multigrid did not converge in {steps} V-cycles; this is a bug")


@dataclass(slots=True)
class Level:
    """One grid of the hierarchy; its arrays have a margin (`MARGIN`).

    Attributes:
        shape: rows and columns without the margin.
        diagonal: A(i, i); 0 where the cell has a given value.
        sides: minus the couplings to the neighbours of `TARGETS`, in that order, from the second on; the last two are
            missing on the finest grid.  The coupling to (1, -1) lies at the cell it starts from.
        inverse: damping / diagonal, 0 for given cells.
        weights: interpolation from each coarse cell to the 3 by 3 cells around it, by offset.
        solver: dense inverse of the coarsest operator over all its cells.
    """

    shape: tuple[int, int]
    diagonal: Array
    sides: tuple[Array, ...]
    inverse: Array
    weights: dict[Offset, Array]
    solver: Array | None = None

    def coupling(self, offset: Offset, step: Offset, coarse: tuple[int, int]) -> Array:
        """Return minus A(i, i + step) at the cells i = 2 J + offset of all coarse cells J."""
        forward = step if step in TARGETS else (-step[0], -step[1])
        start = offset if step in TARGETS else (offset[0] + step[0], offset[1] + step[1])
        return _sampled(self.sides[TARGETS.index(forward) - 1], start, coarse)


def _padded(shape: tuple[int, int]) -> tuple[int, int]:
    return shape[0] + 2 * MARGIN, shape[1] + 2 * MARGIN


def _sampled(array: Array, offset: Offset, coarse: tuple[int, int]) -> Array:
    """Return a padded array at the cells 2 J + offset of all coarse cells J."""
    row, col = MARGIN + offset[0], MARGIN + offset[1]
    return array[row : row + 2 * coarse[0] - 1 : 2, col : col + 2 * coarse[1] - 1 : 2]


def _inner(array: Array, shape: tuple[int, int], offset: Offset = (0, 0)) -> Array:
    row, col = MARGIN + offset[0], MARGIN + offset[1]
    return array[row : row + shape[0], col : col + shape[1]]


def coarse_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """Return how many cells the next grid has: every second one along either axis."""
    return (shape[0] + 1) // 2, (shape[1] + 1) // 2


def _level(shape: tuple[int, int], diagonal: Array, sides: tuple[Array, ...]) -> Level:
    inverse = np.zeros_like(diagonal)
    np.divide(DAMPING, diagonal, out=inverse, where=diagonal > 0)
    return Level(shape, diagonal, sides, inverse, {})


def _finest(system: System) -> Level:
    """Return the finest level: couplings between free cells only."""
    free = system.free
    shape = (free.shape[0], free.shape[1])
    diagonal, east, south = (np.zeros(_padded(shape), system.values.dtype) for _ in range(3))
    middle = _inner(diagonal, shape)
    for face, own, other in ((system.across, middle[:, :-1], middle[:, 1:]), (system.down, middle[:-1], middle[1:])):
        own += face
        other += face
    middle *= free
    _inner(east, shape)[:, :-1] = system.across * (free[:, :-1] & free[:, 1:])
    _inner(south, shape)[:-1] = system.down * (free[:-1] & free[1:])
    return _level(shape, diagonal, (east, south))


def _interpolation(level: Level) -> dict[Offset, Array]:
    """Return how much each coarse cell gives to the cells around it.

    A cell between two coarse ones takes the mean that its own equation gives, summed across the line through the two;
    a cell between four solves its equation.
    """
    shape = coarse_shape(level.shape)
    steps = EDGES if len(level.sides) == 2 else EDGES + CORNERS
    weights = {}
    middle = np.zeros(_padded(shape), level.diagonal.dtype)
    _inner(middle, shape)[...] = _sampled(level.diagonal, (0, 0), shape) > 0
    weights[0, 0] = middle
    for edge in EDGES:
        along = 0 if edge[0] else 1
        toward = [step for step in steps if step[along] == -edge[along]]
        away = [step for step in steps if step[along] == edge[along]]
        beside = [step for step in steps if step[along] == 0]
        given = _sum(level, edge, toward, shape)
        other = _sum(level, edge, away, shape)
        whole = _sampled(level.diagonal, edge, shape) - _sum(level, edge, beside, shape)
        weights[edge] = _quotient(given, np.maximum(whole, given + other), shape)
    for corner in CORNERS:
        row, col = corner
        given = level.coupling(corner, (-row, 0), shape) * _inner(weights[0, col], shape)
        given += level.coupling(corner, (0, -col), shape) * _inner(weights[row, 0], shape)
        if len(level.sides) == 4:
            given += level.coupling(corner, (-row, -col), shape)
        weights[corner] = _quotient(given, _sampled(level.diagonal, corner, shape), shape)
    return weights


def _sum(level: Level, offset: Offset, steps: list[Offset], shape: tuple[int, int]) -> Array:
    return np.sum([level.coupling(offset, step, shape) for step in steps], axis=0, dtype=level.diagonal.dtype)


def _quotient(given: Array, whole: Array, shape: tuple[int, int]) -> Array:
    made = np.zeros(_padded(shape), given.dtype)
    np.divide(given, whole, out=_inner(made, shape), where=whole > 0)
    return made


def _galerkin(level: Level) -> Level:
    """Return the next coarser level: P' A P.

    The rows of A P vanish at the cells between four coarse ones, which interpolation lets solve their equation: the
    sum runs over the coarse cell itself and the four beside it.
    """
    shape = coarse_shape(level.shape)
    steps = REACH[: 5 if len(level.sides) == 2 else 9]
    made = [np.zeros(_padded(shape), level.diagonal.dtype) for _ in TARGETS]
    for at in ((0, 0), *EDGES):
        for number, target in enumerate(TARGETS):
            row: Array | None = None
            for step in steps:
                source = at[0] + step[0] - 2 * target[0], at[1] + step[1] - 2 * target[1]
                if source not in level.weights:
                    continue
                given = _inner(level.weights[source], shape, target)
                if step == (0, 0):
                    term = _sampled(level.diagonal, at, shape) * given
                else:
                    term = -level.coupling(at, step, shape) * given
                row = term if row is None else row + term
            if row is not None:
                inner = _inner(made[number], shape)
                inner += row * _inner(level.weights[at], shape)
    for side in made[1:]:
        np.negative(side, out=side)
    return _level(shape, made[0], tuple(made[1:]))


def hierarchy(system: System) -> list[Level]:
    """Return all levels, the finest first."""
    levels = [_finest(system)]
    while (last := levels[-1]).shape[0] * last.shape[1] > COARSEST:
        last.weights = _interpolation(last)
        levels.append(_galerkin(last))
    last.solver = dense_inverse(last)
    return levels


def dense_inverse(level: Level) -> Array:
    """Return the inverse of a small level's operator over all its cells, 0 for given ones, in the level's precision."""
    rows, cols = level.shape
    number = np.full(_padded(level.shape), -1)
    _inner(number, level.shape)[...] = np.arange(rows * cols).reshape(rows, cols)
    count = rows * cols
    matrix = np.zeros((count, count))
    for step, side in zip(TARGETS[1:], level.sides, strict=False):
        inner = _inner(side, level.shape)
        y, x = np.nonzero(inner)
        own, other = _inner(number, level.shape)[y, x], _inner(number, level.shape, step)[y, x]
        matrix[own, other] = matrix[other, own] = -inner[y, x]
    diagonal = _inner(level.diagonal, level.shape).ravel().astype(np.float64)
    free = np.flatnonzero(diagonal > 0)
    matrix[np.arange(count), np.arange(count)] = diagonal
    inverse = np.zeros((count, count))
    inverse[np.ix_(free, free)] = np.linalg.inv(matrix[np.ix_(free, free)])
    return inverse.astype(level.diagonal.dtype)


def _defect(level: Level, guess: Array, right: Array, out: Array) -> None:
    """Set out = right - A guess (padded arrays)."""
    shape, inner = level.shape, _inner(out, level.shape)
    np.multiply(_inner(level.diagonal, shape), _inner(guess, shape), out=inner)
    np.subtract(_inner(right, shape), inner, out=inner)
    term = np.empty_like(inner)
    for step, side in zip(TARGETS[1:], level.sides, strict=False):
        np.multiply(_inner(side, shape), _inner(guess, shape, step), out=term)
        inner += term
        back = (-step[0], -step[1])
        np.multiply(_inner(side, shape, back), _inner(guess, shape, back), out=term)
        inner += term


def _cycle(levels: list[Level], depth: int, right: Array) -> Array:
    """Return an approximate solution: one symmetric V-cycle with a damped Jacobi step on either side."""
    level = levels[depth]
    shape = level.shape
    guess = np.zeros_like(right)
    if level.solver is not None:
        solved = level.solver @ _inner(right, shape).ravel()
        _inner(guess, shape)[...] = solved.reshape(shape)
        return guess
    np.multiply(level.inverse, right, out=guess)
    defect = np.zeros_like(right)
    _defect(level, guess, right, defect)
    coarse = coarse_shape(shape)
    restricted = np.zeros(_padded(coarse), right.dtype)
    inner = _inner(restricted, coarse)
    for offset, weight in level.weights.items():
        inner += _inner(weight, coarse) * _sampled(defect, offset, coarse)
    correction = _inner(_cycle(levels, depth + 1, restricted), coarse)
    for offset, weight in level.weights.items():
        fine = _sampled(guess, offset, coarse)
        fine += _inner(weight, coarse) * correction
    _defect(level, guess, right, defect)
    defect *= level.inverse
    guess += defect
    return guess


@dataclass(frozen=True, slots=True)
class System:
    """The equation: at every free cell the conductances times the differences to its neighbours sum to the source.

    Every connected set of free cells must touch a given value (`without_value` finds those that do not).

    Attributes:
        values: given values, and a first guess at free cells (rows, cols), in the precision to compute in.
        free: which cells are free.
        across: conductance between each cell and the one to its east (rows, cols - 1), not negative; or one for all.
        down: the same to the south (rows - 1, cols).
        source: per cell (rows, cols); none is 0.
    """

    values: Array
    free: Array
    across: Array | float = 1.0
    down: Array | float = 1.0
    source: Array | None = None


def without_value(free: Array, open_: Array) -> Array:
    """Return which free cells no given value reaches through cells that are open (do conduct)."""
    from scipy import ndimage

    labels, count = ndimage.label(open_)
    reached = np.zeros(count + 1, np.bool_)
    reached[np.unique(labels[~free])] = True
    reached[0] = False
    return np.asarray(free & ~reached[labels])


def solve(system: System, tolerance: float, context: Context) -> Array:
    """Return the solution on the host, given values unchanged.

    Args:
        system: the equation.
        tolerance: largest error of any cell, relative to the range of the given values (or of the solution, where
            that is larger).
        context: for progress and cancellation.
    """
    if not system.free.any():
        return system.values
    grid = HostGrid(system)
    iterate(grid, tolerance, spread(system), context)
    return grid.x


def spread(system: System) -> float:
    """Return the range of the given values; 0 where there are none."""
    given = system.values[~system.free]
    return float(given.max() - given.min()) if given.size else 0.0


class HostGrid:
    """A system in NumPy arrays of the precision of its values, for `iterate`."""

    def __init__(self, system: System) -> None:
        """Build the hierarchy; the system is not changed."""
        self.x = system.values.copy()
        self._free, self._across, self._down, self._source = system.free, system.across, system.down, system.source
        self._levels = hierarchy(system)
        self._shape = (self.x.shape[0], self.x.shape[1])
        padded = _padded(self._shape)
        self._right = np.zeros(padded, self.x.dtype)
        self.r = _inner(self._right, self._shape)
        self.p, self.q = np.zeros_like(self.x), np.zeros_like(self.x)
        self.z = self.p

    def _outflow(self, x: Array, out: Array) -> None:
        """Set out = A x at free cells as a sum of flows, 0 elsewhere."""
        flow = np.subtract(x[:, :-1], x[:, 1:])
        flow *= self._across
        out[:, :-1] = flow
        out[:, -1] = 0
        out[:, 1:] -= flow
        flow = np.subtract(x[:-1], x[1:])
        flow *= self._down
        out[:-1] += flow
        out[1:] -= flow
        out *= self._free

    def residual(self) -> None:
        """Set r = -A x - s."""
        self._outflow(self.x, self.q)
        np.negative(self.q, out=self.r)
        if self._source is not None:
            self.r -= self._source * self._free

    def precondition(self) -> tuple[float, float]:
        """Set z to one V-cycle on r; return r.z and max |z|."""
        self.z = _inner(_cycle(self._levels, 0, self._right), self._shape)
        return float(np.vdot(self.r, self.z)), float(max(self.z.max(), -self.z.min()))

    def turn(self, beta: float) -> None:
        """Set p = z + beta p."""
        self.p *= self.x.dtype.type(beta)
        self.p += self.z

    def curvature(self) -> float:
        """Set q = A p; return p.q."""
        self._outflow(self.p, self.q)
        return float(np.vdot(self.p, self.q))

    def advance(self, alpha: float) -> None:
        """Add alpha p to x and take alpha q from r."""
        factor = self.x.dtype.type(alpha)
        self.x += factor * self.p
        self.r -= factor * self.q

    def correct(self) -> None:
        """Add z to x."""
        self.x += self.z
