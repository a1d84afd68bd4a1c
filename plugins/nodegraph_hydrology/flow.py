"""Where water runs on a surface: a receiver for every cell, depressions and flats included.

Cells are numbered row by row in a grid with one void cell all around, so that a neighbour is a constant offset away.
Water that reaches the border of the raster or a void leaves: every known cell beside one of them that has no lower
neighbour is an outlet.  All steps work on whole arrays; what takes steps in turn (flats, sums along rivers) takes one
array operation per ring of cells or per cell of the longest path.

References:
    J. F. O'Callaghan, D. M. Mark (1984): The extraction of drainage networks from digital elevation data.
    doi:10.1016/S0734-189X(84)80011-0.
    D. G. Tarboton (1997): A new method for the determination of flow directions and upslope areas in grid digital
    elevation models. doi:10.1029/96WR03137.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.raster import Grid, Raster

Index = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Depressions = Literal["fill", "breach"]
Method = Literal["d8", "dinf"]

STEPS = ((0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1))
"""(rows, columns) to the eight neighbours, counter-clockwise from east."""


@dataclass(frozen=True)
class Lattice:
    """The cells of a raster with a rim of void ones, numbered row by row.

    Attributes:
        shape: (rows, columns) of the raster, without the rim.
        cell: (width, height) of a cell, m.
        height: (n,) float32, NaN where void.
    """

    shape: tuple[int, int]
    cell: tuple[float, float]
    height: npt.NDArray[np.float32]

    @classmethod
    def of(cls, surface: Raster) -> Lattice:
        """Number the cells of a raster.

        Raises:
            ValueError: it is in degrees, all void, or holds infinite heights.
        """
        cell = require_projected(surface)
        if np.isinf(surface.data).any():
            raise ValueError("the surface holds infinite heights; link it through terrain.clamp first")
        if np.isnan(surface.data).all():
            raise ValueError("every cell of the surface is void; water needs ground to run on")
        return cls(surface.shape, cell, np.pad(surface.data, 1, constant_values=np.nan).ravel())

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """How far the neighbours in the order of `STEPS` lie."""
        width = self.shape[1] + 2
        return tuple(down * width + right for down, right in STEPS)

    @cached_property
    def distances(self) -> tuple[float, ...]:
        """How far the centres of the neighbours in the order of `STEPS` lie, m."""
        return tuple(float(np.hypot(right * self.cell[0], down * self.cell[1])) for down, right in STEPS)

    @cached_property
    def known(self) -> Flags:
        """Cells with a height."""
        return ~np.isnan(self.height)

    @cached_property
    def edge(self) -> Flags:
        """Known cells beside the border or a void."""
        beside = np.zeros(len(self.height), np.bool_)
        void = np.flatnonzero(~self.known)
        for offset in self.offsets:
            beside[np.clip(void + offset, 0, len(beside) - 1)] = True
        return beside & self.known

    def inner(self, cells: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return values per cell as the rows and columns of the raster."""
        return cells.reshape(self.shape[0] + 2, self.shape[1] + 2)[1:-1, 1:-1]

    def positions(self, cells: Index, grid: Grid) -> Floats:
        """Return the centres of cells, (m, 2): east, north."""
        row, column = np.divmod(cells, self.shape[1] + 2)
        dx, dy = self.cell
        return np.stack([grid.extent.west + (column - 0.5) * dx, grid.extent.north - (row - 0.5) * dy], axis=1)


def steepest(lattice: Lattice, height: npt.NDArray[np.float32]) -> Index:
    """Return the neighbour of steepest descent of every cell (D8); -1 where none is lower, and at voids.

    Of equally steep ones, the first in the order of `STEPS`, straight before diagonal.
    """
    width = lattice.shape[1] + 2
    inside = slice(width + 1, len(height) - width - 1)
    best = np.zeros(inside.stop - inside.start)
    choice = np.full(len(best), -1, np.int8)
    for k in (0, 2, 4, 6, 1, 3, 5, 7):
        there = slice(inside.start + lattice.offsets[k], inside.stop + lattice.offsets[k])
        # In double precision no fall between two heights is lost.
        fall = np.subtract(height[inside], height[there], dtype=np.float64) / lattice.distances[k]
        better = fall > best  # false at voids
        np.copyto(best, fall, where=better)
        choice[better] = k
    receiver = np.full(len(height), -1, np.int64)
    flowing = np.flatnonzero(choice >= 0)
    receiver[flowing + inside.start] = flowing + inside.start + np.array(lattice.offsets)[choice[flowing]]
    return receiver


@dataclass(frozen=True)
class Flow:
    """Where the water of every cell goes.

    Attributes:
        lattice: the cells, with the heights as given.
        height: (n,) float32: after filling or breaching; never rises along the flow.
        receiver: (n,) the cell that each flows to along D8; -1 at outlets and voids.
        forced: cells of flats and breaches, which flow to their receiver under any method.
    """

    lattice: Lattice
    height: npt.NDArray[np.float32]
    receiver: Index
    forced: Flags

    @cached_property
    def _ordered(self) -> tuple[Index, Index]:
        """All known cells, each after its receiver, and where in this order the levels (hops to the outlet) end."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import breadth_first_order

        known = np.flatnonzero(self.lattice.known)
        root = len(self.receiver)
        above = np.where(self.receiver[known] >= 0, self.receiver[known], root)
        tree = csr_array((np.ones(len(known), np.int8), (above, known)), shape=(root + 1, root + 1))
        order, parent = breadth_first_order(tree, root)
        order = order[1:].astype(np.int64)
        place = np.zeros(root + 1, np.int64)
        place[root], place[order] = -1, np.arange(len(order))
        behind = place[parent[order]]
        ends = [0]
        while ends[-1] < len(order):
            # The next level: all whose receiver lies before its start.
            ends.append(int(np.searchsorted(behind, ends[-1])))
        return order, np.array(ends[1:], np.int64)

    def order(self) -> Index:
        """Return all known cells, each after the one it flows to (D8)."""
        return self._ordered[0]

    def gathered(self, values: npt.NDArray[Any], rule: np.ufunc = np.add) -> npt.NDArray[Any]:
        """Return for every cell the sum (or minimum ...) of `values` over it and all that drains through it."""
        total = values.copy()
        order, ends = self._ordered
        for start, stop in zip(ends[-2::-1].tolist(), ends[:0:-1].tolist(), strict=True):
            cells = order[start:stop]
            rule.at(total, self.receiver[cells], total[cells])
        return total

    def spread(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return for every known cell the value of its outlet."""
        ends = np.where(self.receiver >= 0, self.receiver, np.arange(len(self.receiver)))
        return np.asarray(values[followed(ends)])


def followed(jump: Index) -> Index:
    """Return where each cell ends when it follows `jump`, in which ends point to themselves."""
    while True:
        further = jump[jump]
        if np.array_equal(further, jump):
            return jump
        jump = further


def route(surface: Raster, depressions: Depressions, context: Context) -> Flow:
    """Return where the water of every cell of a surface goes.

    Args:
        surface: elevation in metres; cells may be rectangular.
        depressions: ``fill`` raises them to their lowest pass, ``breach`` cuts a channel from their bottom through it.
        context: for progress.

    Raises:
        ValueError: see `Lattice.of`.
    """
    from nodegraph_hydrology import depressions as ways

    lattice = Lattice.of(surface)
    context.progress(0.05, "flow directions")
    return ways.breached(lattice, context) if depressions == "breach" else ways.filled(lattice, context)


def accumulated(flow: Flow, values: Floats, method: Method) -> Floats:
    """Return the sum of `values` over every cell and all that drains through it.

    Under ``dinf`` a cell's water goes to two neighbours in parts (`nodegraph_hydrology.dinf`); the sums are the
    solution of the triangular system x = values + W x, cells taken from low to high.
    """
    if method == "d8":
        return np.asarray(flow.gathered(values), np.float64)
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import spsolve_triangular

    from nodegraph_hydrology.dinf import parts

    source, target, share = parts(flow)
    rank = np.zeros(len(values), np.int64)
    cells = flow.order()
    rank[cells] = np.arange(len(cells))
    # Along the flow the height falls, or stays and the way to the outlet is shorter.
    cells = cells[np.argsort(flow.height[cells], kind="stable")]
    rank[cells] = np.arange(len(cells))
    count = len(cells)
    diagonal = np.arange(count)
    row, column = np.concatenate([rank[target], diagonal]), np.concatenate([rank[source], diagonal])
    weight = np.concatenate([-share, np.ones(count)])
    # Positions are those of the transpose reversed, as the solver is faster on a lower triangle.
    system = csc_array((weight, (count - 1 - row, count - 1 - column)), shape=(count, count))
    solved = spsolve_triangular(system, values[cells][::-1].copy(), lower=True, unit_diagonal=True)
    total = np.zeros(len(values))
    total[cells] = solved[::-1]
    return total


def cell_areas(flow: Flow, method: Method, context: Context) -> Floats:
    """Return the area that drains through every cell of the lattice, m2."""
    context.progress(0.85, "drainage areas")
    own = np.where(flow.lattice.known, flow.lattice.cell[0] * flow.lattice.cell[1], 0.0)
    return accumulated(flow, own, method)
