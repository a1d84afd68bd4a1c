"""Restricted quadtree triangulation: a mesh that is fine where the ground is rough, without cracks.

The hierarchy of right triangles (longest-edge bisection, 4-8 mesh) is laid over the raster by two maps from 2^k + 1
evenly halved lines to its rows and columns, so that a raster of any shape takes part: where it has fewer lines, some
coincide, and the triangles between them are empty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph.opencl import to_host
from nodegraph_render.mesh import Mesh, checked_heights, corners_of, lattice_mesh, on_ground, whole_squares
from nodegraph_render.triangle_scan import Scan, twice_area
from nodegraph_terrain.raster import Elevation

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

GLANCE = 64
"""Samples of a large triangle that are looked at first: most that must be split show it at once."""

SPARE = 16
"""Points of the hierarchy per cell of the raster; a raster that is too long for one square becomes a row of them."""


@node(version=1, locality=whole)
def mesh_adaptive(
    surface: Elevation,
    *,
    error: Annotated[float, Param("Greatest vertical distance of any sample from the mesh.", ge=0, unit="m")] = 1.0,
    context: Context,
) -> Mesh:
    """Make a mesh that is fine where the ground needs it: a restricted quadtree, triangulated without cracks.

    A right triangle is split at the middle of its longest edge until no cell centre that it covers lies more than
    `error` above or below its plane, together with the triangle across that edge (which is split first where it is
    larger), so no vertex ever lies on another triangle's edge.  Each triangle is held against every sample it covers,
    so the bound is that of the mesh itself, not an estimate added up through the hierarchy; the greatest distance
    found is the mesh's `error`.  Triangles are split from the coarsest down and only where needed: a plane
    gives two triangles (a very long raster, such as 10 x 10,000 cells, two for each of the squares it is made of).

    Holes are the squares between four cell centres of which at least one is void; the mesh covers all others exactly.
    Normals are those of the raster (Horn's gradient), UVs run over the raster's extent.

    Triangles with few shapes in a regular order suit level of detail and compression; `mesh_tin` needs about half as
    many.  Each level of the hierarchy looks at most once at every sample: O(n log n), about 0.1 to 1 s per million
    samples.

    Args:
        surface: elevation in metres, 2 x 2 cells or more, of any shape.
        error: in metres; 0 keeps every cell that is not exactly in the plane of its surroundings.
        context: the engine's.

    Raises:
        ValueError: the raster is in degrees, has fewer than two rows or columns, or no square without a void.

    References:
        W. Evans, D. Kirkpatrick, G. Townsend (2001): Right-triangulated irregular networks. Algorithmica 30.
        doi:10.1007/s00453-001-0006-x.
        P. Lindstrom, V. Pascucci (2002): Terrain simplification simplified. IEEE TVCG 8(3).
        doi:10.1109/TVCG.2002.1021577.
        R. Pajarola, E. Gobbetti (2007): Survey of semi-regular multiresolution models for interactive terrain
        rendering. The Visual Computer 23. doi:10.1007/s00371-007-0163-2.
    """
    return _adaptive(surface, error, context)


@mesh_adaptive.opencl(rtol=0.0)
def _twin(surface: Elevation, *, error: float, context: Context) -> Mesh:
    # Triangles are split on the host; the device measures.
    return _adaptive(to_host(surface), error, context)


@mesh_adaptive.forecast
def _forecast(surface: Forecast, **_: object) -> Forecast:
    # How many triangles a surface needs is known only afterwards: reckon with a quarter of the plain mesh.
    return Forecast(surface.bytes * 4, surface.bytes * 24)


def _adaptive(surface: Elevation, error: float, context: Context) -> Mesh:
    heights = checked_heights(surface)
    ground = Ground(heights, whole_squares(heights), context)
    cells, reached = refine(ground, error, context)
    return lattice_mesh(surface, cells, reached, context)


@dataclass(frozen=True, slots=True)
class Lattice:
    """The lines of the hierarchy and the raster's rows and columns that they stand for.

    A point of the hierarchy is numbered ``i * width + j`` by its lines.

    Attributes:
        rows, columns: for each line of the hierarchy; rising, every row and column comes up.
        levels: how often the side of a square can be halved.
    """

    rows: Ints
    columns: Ints
    levels: int

    @classmethod
    def over(cls, rows: int, columns: int) -> Lattice:
        """Return the hierarchy of a raster."""
        sides = rows - 1, columns - 1
        squares, levels = 1, (max(sides) - 1).bit_length()
        while squares << 2 * levels > max(SPARE * rows * columns, 1 << 20):
            squares *= 2
            levels = (max(min(sides), -(-max(sides) // squares)) - 1).bit_length()
        counts = [1 << levels, 1 << levels]
        counts[sides[1] > sides[0]] *= squares
        lines = [np.arange(count + 1) * side // count for count, side in zip(counts, sides, strict=True)]
        return cls(lines[0], lines[1], levels)

    @property
    def width(self) -> int:
        """Lines across."""
        return len(self.columns)

    def roots(self) -> Ints:
        """Return the two triangles of each square: apex, then the ends of the base, counter-clockwise in (j, i)."""
        side = 1 << self.levels
        found = []
        for i in range((len(self.rows) - 1) // side):
            for j in range((self.width - 1) // side):
                a, b, c, d = ((i + v) * side * self.width + (j + u) * side for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)))
                # Bases run between corners of even i + j: across the squares' edges the pattern is a mirror image.
                found += [[b, c, a], [d, a, c]] if (i + j) % 2 == 0 else [[a, b, d], [c, d, b]]
        return np.array(found)

    def parents(self, points: Ints, depth: int) -> Ints:
        """Return the apexes of the triangles that have these points in the middle of their bases.

        At even depth the points are centres of squares, at odd depth middles of squares' sides.
        """
        side = 1 << self.levels - depth // 2
        half, width = side // 2, self.width
        i, j = np.divmod(points, width)
        if depth % 2 == 0:
            # The two corners that the base does not join.
            away = half * width + np.where((i // side + j // side) % 2 == 0, -half, half)
            return np.concatenate([points - away, points + away])
        level = i % side == 0
        away = np.where(level, half * width, half)
        before = np.where(level, i, j) > 0
        after = np.where(level, i - len(self.rows), j - width) < -1
        return np.concatenate([(points - away)[before], (points + away)[after]])


class Ground:
    """The raster as the triangles of a hierarchy see it."""

    def __init__(self, heights: npt.NDArray[np.float32], squares: Flags, context: Context) -> None:
        self.lattice = Lattice.over(*heights.shape)
        self.squares = squares
        self.rim: npt.NDArray[np.float32] | None = None
        if not squares.all():
            # What touches the rim of a void must be split until it lies within one square.
            self.rim = np.where(corners_of(squares) & corners_of(~squares), np.float32(np.inf), np.float32(0))
            heights = np.where(corners_of(squares), heights, np.float32(np.nan))
        self._columns = heights.shape[1]
        self._scan = Scan(heights, context)

    def corners(self, triangles: Ints) -> tuple[Ints, Ints]:
        """Return columns and rows of the corners of triangles."""
        i, j = np.divmod(triangles, self.lattice.width)
        return self.lattice.columns[j], self.lattice.rows[i]

    def errors(self, triangles: Ints, limit: float) -> npt.NDArray[np.float64]:
        """Return the greatest distance of the samples that each triangle covers; above the limit it may be too low."""
        x, y = self.corners(triangles)
        errors = np.zeros(len(triangles))
        area = twice_area(x, y)
        # Three corners on one line would leave a vertex on the edge of a neighbour.
        distinct = [(x[:, k] != x[:, k - 1]) | (y[:, k] != y[:, k - 1]) for k in range(3)]
        errors[(area == 0) & distinct[0] & distinct[1] & distinct[2]] = np.inf
        todo = np.flatnonzero((area > 0) & ((np.ptp(x, axis=1) > 1) | (np.ptp(y, axis=1) > 1)))
        stride = np.sqrt(area[todo] / (2 * GLANCE)).astype(np.int64)
        large = stride > 1
        glance, stride = todo[large], stride[large]
        errors[glance] = self._scan.worst(x[glance], y[glance], least=self.rim, stride=stride).error
        todo = todo[errors[todo] <= limit]
        errors[todo] = self._scan.worst(x[todo], y[todo], least=self.rim).error
        return errors

    def cells(self, triangles: Ints) -> Ints:
        """Return the corners, as numbers of cells, of the triangles that cover ground."""
        x, y = self.corners(triangles)
        kept = twice_area(x, y) > 0
        x, y = x[kept], y[kept]
        kept = on_ground(x, y, self.squares)
        return np.asarray(y[kept] * self._columns + x[kept])


def refine(ground: Ground, limit: float, context: Context) -> tuple[Ints, float]:
    """Return the corners (numbers of cells) of the coarsest triangles that keep to an error, and the error they have.

    A triangle is a leaf when the middle of its base is no vertex.  Making a point a vertex makes the apexes of both
    triangles that it splits vertices, too (Lindstrom, Pascucci 2002, section 3), so leaves always fit each other.
    """
    lattice = ground.lattice
    vertex = np.zeros(len(lattice.rows) * lattice.width, bool)
    roots = lattice.roots()
    vertex[roots] = True
    last = 2 * lattice.levels
    nothing = np.empty((0, 3), np.int64)
    fresh, leaves = [roots, *([nothing] * last)], [nothing] * (last + 1)
    errors = [np.empty(0)] * (last + 1)
    while any(map(len, fresh)):
        touched = {depth for depth in range(last + 1) if len(fresh[depth])}
        for depth in range(last):
            context.progress()
            new, fresh[depth] = fresh[depth], nothing
            if not len(new):
                continue
            found = np.zeros(len(new))
            whole_ones = ~vertex[_middle(new)]
            found[whole_ones] = ground.errors(new[whole_ones], limit)
            leaves[depth] = np.concatenate([leaves[depth], new])
            errors[depth] = np.concatenate([errors[depth], found])
            points = _middle(new[found > limit])
            for above in range(depth, -1, -1):
                points = np.unique(points[~vertex[points]])
                if not len(points):
                    break
                vertex[points] = True
                touched.add(above)
                points = lattice.parents(points, above)
            # What is split now hands its halves on in this sweep; what a finer one forces to be, in the next.
            halves = _split(leaves, errors, depth, vertex)
            fresh[depth + 1] = np.concatenate([fresh[depth + 1], halves])
        leaves[last] = np.concatenate([leaves[last], fresh[last]])
        fresh[last] = nothing
        for depth in sorted(touched - {last}):
            halves = _split(leaves, errors, depth, vertex)
            fresh[depth + 1] = np.concatenate([fresh[depth + 1], halves])
    reached = max((float(part.max()) for part in errors if len(part)), default=0.0)
    return ground.cells(np.concatenate(leaves)), reached


def _middle(triangles: Ints) -> Ints:
    return (triangles[:, 1] + triangles[:, 2]) // 2


def _split(leaves: list[Ints], errors: list[npt.NDArray[np.float64]], depth: int, vertex: Flags) -> Ints:
    """Remove the leaves of a depth that have a vertex in the middle of their base; return their halves."""
    middle = _middle(leaves[depth])
    split = vertex[middle]
    (apex, first, second), middle = leaves[depth][split].T, middle[split]
    leaves[depth], errors[depth] = leaves[depth][~split], errors[depth][~split]
    return np.concatenate([np.stack([middle, apex, first], axis=1), np.stack([middle, second, apex], axis=1)])
