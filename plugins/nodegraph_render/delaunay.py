"""Delaunay triangulation of lattice points that grows by many points at a time.

Every triangle may take one point per call; it is split in three and then edges are flipped until each is locally
Delaunay again (Lawson 1977).  All splits of a call, and all flips that share no triangle, are done at once, as arrays:
the work follows what changes, not the size of the triangulation.  In-circle tests are exact, in 64-bit integers.

References:
    C. L. Lawson (1977): Software for C1 surface interpolation. Mathematical Software III, 161-194.
    L. Guibas, J. Stolfi (1985): Primitives for the manipulation of general subdivisions and the computation of Voronoi
    diagrams. ACM Transactions on Graphics 4(2). doi:10.1145/282918.282923.
"""

from __future__ import annotations

from copy import copy

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

SIDE_MAX = 28_000
"""Most columns or rows: up to here the products of the in-circle test fit 64-bit integers."""

_NEXT = np.array([1, 2, 0])


class Delaunay:
    """A triangulation of a rectangle of lattice points, from its two first triangles on.

    Half-edge ``3 t + k`` runs from corner k of triangle t to the next, counter-clockwise in (x, y).

    Attributes:
        count: triangles so far, dead ones included (a point on the border leaves one).
    """

    def __init__(self, columns: int, rows: int) -> None:
        x, y = columns - 1, rows - 1
        self.count = 2
        self._x = np.array([0, x, x, 0, x, 0])
        self._y = np.array([0, 0, y, 0, y, y])
        self._twin = np.array([-1, -1, 3, 2, -1, -1])
        self._moved = np.arange(6)
        self._owner = np.empty(2, np.int64)

    def copy(self) -> Delaunay:
        """Return one that grows by itself."""
        other = copy(self)
        for name in ("_x", "_y", "_twin", "_moved", "_owner"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def corners(self, triangles: Ints | Flags) -> tuple[Ints, Ints]:
        """Return columns and rows of the corners of triangles, (m, 3) each."""
        count = 3 * self.count
        return self._x[:count].reshape(-1, 3)[triangles], self._y[:count].reshape(-1, 3)[triangles]

    def alive(self) -> Flags:
        """Return which triangles are in the triangulation."""
        return np.asarray(self._x[: 3 * self.count : 3] >= 0)

    def neighbours(self, triangles: Ints) -> Ints:
        """Return, (m, 3), the triangles across the edges, -1 at the border."""
        twins = self._twin[3 * triangles[:, None] + np.arange(3)]
        return np.where(twins < 0, -1, twins // 3)

    def insert(self, triangles: Ints, x: Ints, y: Ints) -> Ints:
        """Put a point into each of some triangles; return the triangles that are new or have changed.

        Args:
            triangles: distinct, alive.
            x, y: a point inside of each, or on an edge of which no other triangle is given the same or another point.
        """
        edges = self._split(triangles, x, y)
        changed = [triangles, np.arange(self.count - 2 * len(triangles), self.count)]
        while len(edges):
            edges = edges[self._flippable(edges)]
            chosen = self._disjoint(edges)
            flipped = edges[chosen]
            if not len(flipped):
                break
            around = self._flip(flipped)
            changed.append(around // 3)
            # Some of the others have just been flipped from the other side, or become right: they are tested again.
            edges = np.concatenate([edges[~chosen], around])
        touched = np.zeros(self.count, bool)
        for part in changed:
            touched[part] = True
        return np.flatnonzero(touched & self.alive())

    def _split(self, triangles: Ints, x: Ints, y: Ints) -> Ints:
        """Split triangles abp, bcp, cap, and return their outer half-edges."""
        added = len(triangles)
        fresh = np.arange(self.count, self.count + 2 * added).reshape(2, -1)
        self._reserve(self.count + 2 * added)
        self.count += 2 * added
        first = 3 * triangles
        edges = np.stack([first, 3 * fresh[0], 3 * fresh[1]])
        old = np.stack([first, first + 1, first + 2])
        outer = self._twin[old]
        self._moved[old] = edges
        outer = np.where(outer < 0, -1, self._moved[outer])
        self._moved[old] = old
        for coordinate, point in ((self._x, x), (self._y, y)):
            corner = coordinate[old]
            coordinate[edges], coordinate[edges + 1], coordinate[edges + 2] = corner, corner[_NEXT], point
        self._link(edges.reshape(-1), outer.reshape(-1))
        self._link((edges + 1).reshape(-1), (edges[_NEXT] + 2).reshape(-1))
        # A point on the border leaves an empty triangle there.
        border = edges[outer < 0]
        (ax, bx, px), (ay, by, py) = ([values[border + k] for k in range(3)] for values in (self._x, self._y))
        empty = border[(bx - ax) * (py - ay) == (by - ay) * (px - ax)]
        for k in (1, 2):
            self._twin[self._twin[empty + k]] = -1
        self._x[empty] = -1
        return edges[outer >= 0]

    def _flippable(self, edges: Ints) -> Flags:
        """Return which half-edges have the far corner of their twin's triangle inside their circumcircle."""
        twin = self._twin[edges]
        inner = twin >= 0
        far = _previous(np.where(inner, twin, 0))
        x0, y0 = self._x[far], self._y[far]
        ax, ay = self._x[edges] - x0, self._y[edges] - y0
        after = _following(edges)
        bx, by = self._x[after] - x0, self._y[after] - y0
        before = _previous(edges)
        cx, cy = self._x[before] - x0, self._y[before] - y0
        inside = (
            (ax * ax + ay * ay) * (bx * cy - by * cx)
            + (bx * bx + by * by) * (cx * ay - cy * ax)
            + (cx * cx + cy * cy) * (ax * by - ay * bx)
        )
        return np.asarray(inner & (inside > 0))

    def _disjoint(self, edges: Ints) -> Flags:
        """Return a choice of half-edges no two of which share a triangle; it holds at least the last one."""
        both = np.stack([edges // 3, self._twin[edges] // 3], axis=1)
        rank = np.arange(len(edges))
        # Of repeated places the last assignment stays.
        self._owner[both.reshape(-1)] = np.repeat(rank, 2)
        return np.asarray((self._owner[both] == rank[:, None]).all(axis=1))

    def _flip(self, edges: Ints) -> Ints:
        """Turn edges ab, between triangles abc and bad, into dc; return the four half-edges around each."""
        twins = self._twin[edges]
        before, far = _previous(edges), _previous(twins)
        after, beyond = _following(edges), _following(twins)
        # abc becomes dbc, and bad becomes cad: db takes the place of ab, ca that of ba.
        outer = self._twin[np.stack([far, before])]
        self._moved[far], self._moved[before] = edges, twins
        outer = np.where(outer < 0, -1, self._moved[outer])
        self._moved[far], self._moved[before] = far, before
        for coordinate in (self._x, self._y):
            d, c = coordinate[far], coordinate[before]
            coordinate[edges], coordinate[twins] = d, c
        self._link(edges, outer[0])
        self._link(twins, outer[1])
        self._link(before, far)
        return np.concatenate([edges, twins, after, beyond])

    def _link(self, edges: Ints, twins: Ints) -> None:
        self._twin[edges] = twins
        inner = twins >= 0
        self._twin[twins[inner]] = edges[inner]

    def _reserve(self, triangles: int) -> None:
        if 3 * triangles <= len(self._x):
            return
        room = max(2 * len(self._x), 3 * triangles, 3072)
        old = len(self._x)
        self._x, self._y, self._twin = (np.resize(array, room) for array in (self._x, self._y, self._twin))
        self._moved = np.concatenate([self._moved, np.arange(old, room)])
        self._owner = np.empty(room // 3, np.int64)


def _following(edges: Ints) -> Ints:
    return np.where(edges % 3 == 2, edges - 2, edges + 1)


def _previous(edges: Ints) -> Ints:
    return np.where(edges % 3 == 0, edges + 2, edges - 1)
