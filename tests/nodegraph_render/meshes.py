"""What the mesh tests share: rasters of any shape with voids, and measurements that use nothing of the meshers."""

from __future__ import annotations

from collections import Counter

import numpy as np
from hypothesis import strategies as st

from nodegraph_terrain.raster import Elevation, Extent

WEST, NORTH, CELL = 500_000.0, 4_000_000.0, 10.0


def raster(heights) -> Elevation:
    rows, cols = np.shape(heights)
    extent = Extent(WEST, NORTH - rows * CELL, WEST + cols * CELL, NORTH, "EPSG:32616")
    return Elevation(np.asarray(heights, np.float32), extent)


@st.composite
def rasters(draw, *, voids: bool = True, side: int = 24) -> Elevation:
    """Rough, smooth, stepped or flat ground; some with voids, as single cells or blocks."""
    rows, cols = draw(st.integers(2, side)), draw(st.integers(2, side))
    dice = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    y, x = np.mgrid[0:rows, 0:cols].astype(np.float32)
    kind = draw(st.sampled_from(["noise", "hills", "steps", "plane", "spike"]))
    heights = {
        "noise": dice.normal(0, 30, (rows, cols)),
        "hills": 100 * np.sin(x / dice.uniform(2, 9)) * np.cos(y / dice.uniform(2, 9)),
        "steps": dice.integers(0, 3, (rows, cols)) * 10.0,
        "plane": 0.25 * x - 0.5 * y + 900,
        "spike": np.where((x == cols // 2) & (y == rows // 3), 500.0, 0.0),
    }[kind].astype(np.float32)
    if voids and draw(st.booleans()):
        for _ in range(draw(st.integers(1, 4))):
            i, j = dice.integers(0, rows), dice.integers(0, cols)
            h, w = dice.integers(1, max(2, rows // 2), 2)
            heights[i : i + h, j : j + w] = np.nan
    return raster(heights)


def squares(surface: Elevation) -> np.ndarray:
    """Which squares between four cell centres are ground."""
    known = np.isfinite(surface.data)
    return known[1:, 1:] & known[1:, :-1] & known[:-1, 1:] & known[:-1, :-1]


def lattice(mesh) -> np.ndarray:
    """(n, 2) columns and rows of the vertices; fails where one is no cell centre."""
    places = (mesh.vertices[:, :2] - (WEST, NORTH)) / (CELL, -CELL) - 0.5
    assert np.abs(places - np.rint(places)).max() < 1e-6
    return np.rint(places).astype(np.int64)


def check_surface(mesh, surface: Elevation, limit: float) -> None:
    """Covers exactly the whole squares, once, from above, without cracks, and keeps to the error at every sample."""
    ground = squares(surface)
    places = lattice(mesh)
    assert np.array_equal(mesh.vertices[:, 2], surface.data[places[:, 1], places[:, 0]])
    a, b, c = (places[mesh.triangles[:, k]].astype(np.float64) * (1, -1) for k in range(3))
    area = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert (area > 0).all(), "counter-clockwise from above"
    assert area.sum() == ground.sum()

    edges = Counter()
    for triangle in mesh.triangles.tolist():
        for k in range(3):
            edges[triangle[k], triangle[(k + 1) % 3]] += 1
    assert max(edges.values()) == 1
    for (p, q), (u, v) in (((e[0], e[1]), (places[e[0]], places[e[1]])) for e in edges if e[::-1] not in edges):
        # A border edge runs along one row or column, with ground on exactly one side all the way.
        assert u[0] == v[0] or u[1] == v[1], (p, q)
        axis = int(u[0] == v[0])
        line = u[1 - axis]
        for step in range(min(u[axis], v[axis]), max(u[axis], v[axis])):
            beside = []
            for side in (line - 1, line):
                i, j = (step, side) if axis else (side, step)
                inside = 0 <= i < ground.shape[0] and 0 <= j < ground.shape[1]
                beside.append(bool(inside and ground[i, j]))
            assert sum(beside) == 1

    covered = np.zeros(surface.shape, bool)
    z = mesh.vertices[:, 2]
    for (p, q, r), whole in zip(mesh.triangles.tolist(), area * 2, strict=True):
        (x0, y0), (x1, y1), (x2, y2) = places[[p, q, r]]
        ys, xs = np.mgrid[min(y0, y1, y2) : max(y0, y1, y2) + 1, min(x0, x1, x2) : max(x0, x1, x2) + 1]
        u = ((x2 - x1) * (y1 - ys) - (y1 - y2) * (xs - x1)) / whole
        v = ((x0 - x2) * (y2 - ys) - (y2 - y0) * (xs - x2)) / whole
        w = 1 - u - v
        inside = (u >= -1e-12) & (v >= -1e-12) & (w >= -1e-12)
        distance = np.abs(u * z[p] + v * z[q] + w * z[r] - surface.data[ys, xs])[inside]
        assert not len(distance) or distance.max() <= max(limit, mesh.error) + 1e-9
        covered[ys[inside], xs[inside]] = True
    corners = np.zeros(surface.shape, bool)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        corners[i : i + ground.shape[0], j : j + ground.shape[1]] |= ground
    assert np.array_equal(covered, corners)
