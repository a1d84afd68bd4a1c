"""Greedy insertion: a triangulated irregular network with few triangles to a stated error."""

from __future__ import annotations

from copy import copy
from typing import Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph.opencl import to_host
from nodegraph_render.delaunay import SIDE_MAX, Delaunay
from nodegraph_render.mesh import Mesh, checked_heights, corners_of, lattice_mesh, on_ground, whole_squares
from nodegraph_render.triangle_scan import Scan, owned_edges, twice_area
from nodegraph_terrain.raster import Elevation

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

GLANCE = 256
"""Samples of a triangle that is certainly to be split: the worst of so many is a good enough choice."""

FINEST = 0.97
"""With a budget, steps to a smaller error stop where they would lower it by less than this factor."""

MUST = 1e30
"""Stands for the error of a sample at the rim of a void, which must become a vertex."""


@node(version=1, locality=whole)
def mesh_tin(
    surface: Elevation,
    *,
    error: Annotated[
        float | None,
        Param(
            "Greatest vertical distance of any sample from the mesh; null: whatever max_triangles allows.",
            ge=0,
            unit="m",
        ),
    ] = 1.0,
    max_triangles: Annotated[int | None, Param("Stop before there are more triangles than this.", ge=2)] = None,
    context: Context,
) -> Mesh:
    """Make a triangulated irregular network: few triangles to a stated error, where the ground asks for them.

    Greedy insertion (Garland, Heckbert 1995) on a Delaunay triangulation of cell centres.  From the two triangles
    between the outermost cell centres on, the sample that lies furthest from the plane of its triangle is inserted,
    in rounds: a triangle takes its worst sample when none of its three neighbours has a worse one, so that what is
    inserted together hardly affects each other (2 % more triangles than one by one).  The triangulation is Delaunay in
    rows and columns, with exact predicates.  It ends when no sample lies more than `error` from the mesh: every
    sample is held against the triangle that covers it.

    With `max_triangles` it may end before: at the smallest error (found in steps down to 3 %) for which the triangles
    suffice.  The mesh's `error` is that error, and a warning is logged where it is more than was stated.

    Holes are the squares between four cell centres of which at least one is void; the mesh covers all others exactly
    (the rim of a void is kept at full detail).  Normals are those of the raster (Horn's gradient), UVs run over the
    raster's extent.

    Args:
        surface: elevation in metres, 2 x 2 cells or more, at most 28,000 rows or columns.
        error: in metres; 0 keeps every cell that is not in the plane of its surroundings.
        max_triangles: at least what the rims of voids take.
        context: the engine's.

    Raises:
        ValueError: neither an error nor a number is stated, the number is too small for the voids, or the raster is in
            degrees, has fewer than two rows or columns, or no square without a void.

    References:
        M. Garland, P. S. Heckbert (1995): Fast polygonal approximation of terrains and height fields. CMU-CS-95-181.
        L. De Floriani, B. Falcidieno, C. Pienovi (1985): Delaunay-based representation of surfaces defined over
        arbitrarily shaped domains. CVGIP 32(1). doi:10.1016/0734-189X(85)90004-5.
    """
    return _tin(surface, error, max_triangles, context)


@mesh_tin.opencl(rtol=0.0)
def _twin(surface: Elevation, *, error: float | None, max_triangles: int | None, context: Context) -> Mesh:
    # Points are inserted on the host; the device measures.
    return _tin(to_host(surface), error, max_triangles, context)


@mesh_tin.forecast
def _forecast(surface: Forecast, **_: object) -> Forecast:
    # How many triangles a surface needs is known only afterwards: reckon with a tenth of the plain mesh.
    return Forecast(surface.bytes * 2, surface.bytes * 8)


def _tin(surface: Elevation, error: float | None, max_triangles: int | None, context: Context) -> Mesh:
    if error is None and max_triangles is None:
        raise ValueError("state an error, a number of triangles, or both")
    heights = checked_heights(surface)
    if max(heights.shape) > SIDE_MAX:
        raise ValueError(f"a raster of {heights.shape} cells is over {SIDE_MAX:,} on a side; crop or resample it")
    squares = whole_squares(heights)
    cells, reached = insert_greedily(heights, squares, error or 0.0, max_triangles, context)
    if error is not None and reached > error:
        context.log.warning("%d triangles leave an error of %g m, not %g m", len(cells), reached, error)
    return lattice_mesh(surface, cells, reached, context)


def insert_greedily(
    heights: npt.NDArray[np.float32], squares: Flags, limit: float, budget: int | None, context: Context
) -> tuple[Ints, float]:
    """Return the corners (numbers of cells) of a greedy triangulation, and the error it has.

    Args:
        heights: the raster.
        squares: which squares between four cell centres are ground.
        limit: insert while a sample is further than this from its triangle.
        budget: most triangles on ground; None: any number.
        context: the engine's.
    """
    if not squares.all():
        heights = np.where(corners_of(squares), heights, np.float32(np.nan))
    growth = Growth(Scan(heights, context), squares, context)
    if budget is None:
        growth.insert(limit)
    else:
        if not growth.insert(MUST / 2, budget):
            raise ValueError(f"max_triangles {budget} is too small for the rims of the voids; fill_voids, or raise it")
        # On the way to a smaller error a greater one may come up for a while, so a budget that is used up anywhere
        # would leave any error: it goes in steps that end, and one that does not fit is tried again half as large.
        step = 0.5
        kept = growth.copy()
        while (reached := growth.error()) > limit and step < FINEST:
            if growth.insert(max(limit, reached * step), budget):
                kept = growth.copy()
            else:
                growth = kept.copy()
                step **= 0.5
    x, y = growth.on_ground()
    return y * heights.shape[1] + x, growth.error()


class Growth:
    """A triangulation that grows by its worst samples, with the greatest distance in each of its triangles."""

    def __init__(self, scan: Scan, squares: Flags, context: Context) -> None:
        rows, cols = scan.heights.shape
        self._scan, self._squares, self._context = scan, squares, context
        self._rim = None if squares.all() else _rim(squares)
        self._mesh = Delaunay(cols, rows)
        self._worst, self._where = self._measured(np.arange(2), np.inf)

    def copy(self) -> Growth:
        """Return one that grows by itself."""
        other = copy(self)
        other._mesh, other._worst, other._where = self._mesh.copy(), self._worst.copy(), self._where.copy()
        other._rim = None if self._rim is None else self._rim.copy()
        return other

    def error(self) -> float:
        """Return the greatest distance of all; exact after an `insert` that was finished."""
        return float(self._worst.max())

    def on_ground(self) -> tuple[Ints, Ints]:
        """Return columns and rows of the corners of the triangles that cover whole squares."""
        x, y = self._mesh.corners(self._mesh.alive())
        kept = on_ground(x, y, self._squares)
        return x[kept], y[kept]

    def insert(self, limit: float, budget: int | None = None) -> bool:
        """Insert until no sample is further than `limit` from its triangle; False where that is over the budget."""
        mesh, cols = self._mesh, self._scan.heights.shape[1]
        first = self.error()
        while (greatest := self.error()) > limit:
            if budget is not None and len(self.on_ground()[0]) >= budget:
                return False
            done = _done(first, greatest, limit) if budget is None else None
            self._context.progress(done, f"{mesh.count:,} triangles")
            open_ = np.flatnonzero(self._worst > limit)
            around = mesh.neighbours(open_)
            chosen = open_[(self._worst[open_, None] >= np.where(around < 0, -1, self._worst[around])).all(axis=1)]
            y, x = np.divmod(self._where[chosen], cols)
            if self._rim is not None:
                self._rim[y, x] = 0
            changed = mesh.insert(chosen, x, y)
            self._worst, self._where = np.resize(self._worst, mesh.count), np.resize(self._where, mesh.count)
            self._worst[~mesh.alive()] = 0
            self._worst[changed], self._where[changed] = self._measured(changed, limit)
        return budget is None or len(self.on_ground()[0]) <= budget

    def _measured(self, triangles: Ints, limit: float) -> tuple[Floats, Ints]:
        """Return the greatest distance in triangles, and where; above the limit there may be a greater one."""
        scan = self._scan
        x, y = self._mesh.corners(triangles)
        owned = owned_edges(x, y, scan.heights.shape)
        stride = np.maximum(np.sqrt(twice_area(x, y) / (2 * GLANCE)).astype(np.int64), 1)
        error, cell = scan.worst(x, y, least=self._rim, inclusive=owned, stride=stride)
        again = (error <= limit) & (stride > 1)
        error[again], cell[again] = scan.worst(x[again], y[again], least=self._rim, inclusive=owned[again])
        # A vertex is in the mesh already, whatever rounding makes of its distance; -1: no sample at all.
        is_vertex = (y * scan.heights.shape[1] + x == cell[:, None]).any(axis=1)
        return np.where(is_vertex, 0.0, np.maximum(error, 0.0)), cell


def _done(first: float, greatest: float, limit: float) -> float | None:
    """Return how much is done, as the error falls by equal factors in about equal times; None: not known."""
    if not 0 < limit < first < MUST:
        return None
    return float(0.9 * np.log(first / max(greatest, limit)) / np.log(first / limit))


def _rim(squares: Flags) -> npt.NDArray[np.float32]:
    """Return what counts as the error of the corners of squares with and without voids, in random order; else 0.

    With all of them as vertices, every side of such a square is an edge: a circle around it holds no other cell centre.
    """
    rim = corners_of(squares) & corners_of(~squares)
    rim[[0, 0, -1, -1], [0, -1, 0, -1]] = False
    order = np.random.default_rng(0).random(rim.shape, np.float32)
    return np.where(rim, np.float32(MUST) * (1 + order), np.float32(0))
