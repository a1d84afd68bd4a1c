"""Triangle meshes: the port type, and what every mesher of rasters shares.

Coordinates are float64 and absolute, in the metres of the terrain's own coordinate system: a scene of 200 km keeps far
more than its centimetres (one step of float32 is 8 mm at 100 km and half a metre at the northings of UTM), borders stay
straight, and meshes of neighbouring tiles meet exactly, without an origin that every node would have to carry along.
Files of float32 get an origin where they are written (`save_mesh`).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from nodegraph import Context, port_type
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.gradient import horn_gradient, require_projected
from nodegraph_terrain.raster import Elevation, Image

Ints = npt.NDArray[np.int64]
Triangles = npt.NDArray[np.int32]
Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

CELLS_MAX, SIDE_MAX = 1 << 31, 1 << 24
"""Rasters of more cells, rows or columns are refused: vertices are numbered in 32 bits, and products of lengths must
be exact in a float64."""


@port_type
class Mesh:
    """Triangles in space: x east, y north, z up, in metres.

    Attributes:
        vertices: (n, 3) float64.
        triangles: (m, 3) int32 vertex numbers, counter-clockwise seen from outside (for terrain: from above).
        normals: (n, 3) float32 unit vectors, or None: every triangle is flat.
        uvs: (n, 2) float32 places in the texture, u to the right and v upwards, or None.
        texture: the picture that `uvs` refers to, or None.
        crs: coordinate reference system as ``EPSG:n`` or WKT; empty where none is known.
        error: greatest vertical distance, m, between the mesh and the samples it was made from; NaN: not known.
    """

    vertices: npt.NDArray[np.float64]
    triangles: npt.NDArray[np.int32]
    normals: npt.NDArray[np.float32] | None = None
    uvs: npt.NDArray[np.float32] | None = None
    texture: Image | None = None
    crs: str = ""
    error: float = math.nan

    def __post_init__(self) -> None:
        count = len(self.vertices)
        if self.vertices.shape != (count, 3) or self.triangles.shape != (len(self.triangles), 3):
            raise ValueError(
                f"vertices of shape {self.vertices.shape} and triangles of shape {self.triangles.shape} "
                "must both have three columns"
            )
        if self.normals is not None and self.normals.shape != (count, 3):
            raise ValueError(f"normals of shape {self.normals.shape} do not fit {count} vertices")
        if self.uvs is not None and self.uvs.shape != (count, 2):
            raise ValueError(f"uvs of shape {self.uvs.shape} do not fit {count} vertices")
        if not len(self.triangles) or self.triangles.min() < 0 or self.triangles.max() >= count:
            raise ValueError(f"a mesh needs triangles, of vertices 0 to {count - 1}")
        if not np.isfinite(self.vertices).all():
            raise ValueError("every vertex of a mesh must be finite")


# From a raster.


def checked_heights(surface: Elevation) -> npt.NDArray[np.float32]:
    """Return the heights of a raster that a mesh can be made of, C-contiguous.

    Raises:
        ValueError: degrees, fewer than two rows or columns, infinite heights, or too many cells.
    """
    require_projected(surface)
    rows, cols = surface.shape
    if min(rows, cols) < 2:
        raise ValueError(
            f"a raster of {rows} x {cols} cells spans no ground between cell centres; a mesh needs 2 rows and 2 columns"
        )
    if rows * cols >= CELLS_MAX or max(rows, cols) >= SIDE_MAX:
        raise ValueError(f"{rows:,} x {cols:,} cells are too many for one mesh; crop or resample the raster")
    if np.isinf(surface.data).any():
        raise ValueError("the raster holds infinite heights; link it through terrain.clamp")
    return np.ascontiguousarray(surface.data)


def whole_squares(heights: npt.NDArray[np.float32]) -> Flags:
    """Return, (rows - 1, columns - 1), which squares between four cell centres have no void corner.

    Raises:
        ValueError: there is none.
    """
    known = ~np.isnan(heights)
    whole = known[:-1] & known[1:]
    whole = whole[:, :-1] & whole[:, 1:]
    if not whole.any():
        raise ValueError("no four neighbouring cells are all known, so there is no ground; use terrain.fill_voids")
    return whole


def corners_of(squares: Flags) -> Flags:
    """Return, (rows, columns), which cell centres are corners of marked squares."""
    rows, cols = squares.shape
    marked = np.zeros((rows + 1, cols + 1), bool)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        marked[i : i + rows, j : j + cols] |= squares
    return marked


def on_ground(x: Ints, y: Ints, squares: Flags) -> Flags:
    """Return which triangles lie on marked squares, of triangles that lie on marked or on unmarked ones, not on both.

    Args:
        x, y: (m, 3) columns and rows of the corners; no triangle is empty.
        squares: as from `whole_squares`.
    """
    # The square into which one goes from the first corner towards the middle.
    east = 3 * x[:, 0] <= x.sum(axis=1)
    south = 3 * y[:, 0] <= y.sum(axis=1)
    return np.asarray(squares[y[:, 0] - 1 + south, x[:, 0] - 1 + east])


def lattice_mesh(surface: Elevation, cells: Ints, error: float, context: Context) -> Mesh:
    """Return the mesh whose triangles have their vertices at cell centres.

    Vertices are numbered row by row from the north-west, normals are those of the raster itself (Horn's gradient, so a
    coarse mesh is still shaded in full detail), and UVs run over the raster's extent, edge to edge.

    Args:
        surface: the raster, in metres.
        cells: (m, 3) numbers of cells, ``row * columns + column``, clockwise seen from above.
        error: what the mesh keeps of the raster.
        context: the engine's.
    """
    rows, cols = surface.shape
    used = np.zeros(rows * cols, bool)
    used[cells.reshape(-1)] = True
    chosen = np.flatnonzero(used)
    number = np.cumsum(used, dtype=np.int32)
    number -= 1
    row, col = np.divmod(chosen, cols)
    width, height = surface.cell_size
    vertices = np.empty((len(chosen), 3))
    vertices[:, 0] = surface.extent.west + (col + 0.5) * width
    vertices[:, 1] = surface.extent.north - (row + 0.5) * height
    vertices[:, 2] = surface.data[row, col]
    normals = np.empty((len(chosen), 3), np.float32)
    for part in row_blocks(rows, cols, context, start=0.9):
        first, last = np.searchsorted(row, (part.start, part.stop))
        if first < last:
            place = row[first:last] - part.start, col[first:last]
            east, north = (gradient[place] for gradient in horn_gradient(surface.data, part, (width, height)))
            normals[first:last] = np.stack([-east, -north, np.ones_like(east)], axis=1)
    normals /= np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
    uvs = np.stack([(col + 0.5) / cols, 1 - (row + 0.5) / rows], axis=1).astype(np.float32)
    triangles = np.ascontiguousarray(number[cells[:, ::-1]])
    return Mesh(vertices, triangles, normals, uvs, None, surface.extent.crs, error)


# What is asked of a mesh.


def draped(mesh: Mesh, image: Image) -> Mesh:
    """Return the mesh with a picture laid over it from above, placed by the picture's extent.

    Raises:
        ValueError: the picture has another coordinate system, or does not cover the mesh (within half a pixel).
    """
    extent = image.extent
    if extent.unit != "m" or (mesh.crs and extent.crs and mesh.crs != extent.crs):
        raise ValueError(
            f"the picture is in '{extent.crs or extent.unit}', the mesh in '{mesh.crs or 'm'}'; reproject the raster "
            "before it is coloured, so that both agree"
        )
    place = (mesh.vertices[:, :2] - (extent.west, extent.south)) / (extent.width, extent.height)
    slack = 0.5 / np.array(image.shape[::-1])
    if (place < -slack).any() or (place > 1 + slack).any():
        raise ValueError("the picture does not cover the mesh; colour the raster that the mesh was made of")
    uvs = np.clip(place, 0, 1).astype(np.float32)
    return Mesh(mesh.vertices, mesh.triangles, mesh.normals, uvs, image, mesh.crs or extent.crs, mesh.error)


def border_edges(triangles: npt.NDArray[np.integer]) -> Ints:
    """Return, (n, 2), the directed edges that no triangle uses the other way round; the mesh lies to their left.

    Raises:
        ValueError: two triangles use an edge in the same direction.
    """
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    span = int(edges.max()) + 1
    forward, backward = np.sort(edges[:, 0] * span + edges[:, 1]), edges[:, 1] * span + edges[:, 0]
    if (forward[1:] == forward[:-1]).any():
        raise ValueError("two triangles run along one edge in the same direction; turn them to face the same way")
    met = forward[np.minimum(np.searchsorted(forward, backward), len(forward) - 1)] == backward
    return np.asarray(edges[~met])
