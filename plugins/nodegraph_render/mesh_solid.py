"""Walls and a base under a terrain mesh: something to print, or skirts that hide the gaps between tiles."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Param, node
from nodegraph_render.mesh import Ints, Mesh, border_edges

Kind = Literal["solid", "skirt"]

APART = 0.01
"""By how much of the way to their triangles' other corners corners that touch are moved apart."""


@node(version=1)
def mesh_solid(
    mesh: Mesh,
    *,
    kind: Annotated[
        Kind, Param("solid: walls and a flat base, closed; skirt: walls that hang from the border.")
    ] = "solid",
    base: Annotated[
        float | None, Param("Elevation of the base; null: thickness below the lowest vertex.", unit="m")
    ] = None,
    thickness: Annotated[
        float | None,
        Param("Least height of the walls (skirt: their height); null: a twentieth of the longer side.", gt=0, unit="m"),
    ] = None,
) -> Mesh:
    """Turn a terrain mesh into a closed solid, or hang a skirt from its border.

    Every edge of the border (the outline, and the rims of holes) gets a vertical wall that faces away from the ground.
    A solid stands on a flat base that faces down: a fan where the mesh has one convex outline, else the mesh's own
    triangles, seen from below.  Every edge then belongs to exactly two triangles, which is what slicers for 3D
    printing and Boolean operations ask for.  Where holes touch at a corner, four walls would share an edge: the
    corners there are moved apart by a hundredth of the way to their neighbours.

    A solid has no normals (its edges are sharp: viewers shade its triangles flat); a skirt keeps those of the border,
    so that it is shaded like the ground above.  Walls and base take the UVs of the border above them.

    Args:
        mesh: a surface with a border, such as mesh_grid, mesh_adaptive and mesh_tin make.
        kind: ``solid`` or ``skirt``.
        base: elevation of the lower ends of the walls; below the lowest vertex.
        thickness: instead of `base`.

    Raises:
        ValueError: the mesh has no border (it is closed already), two of its triangles face opposite ways, `base` is
            not below the lowest vertex, or both `base` and `thickness` are given.
    """
    if base is not None and thickness is not None:
        raise ValueError("give either base or thickness, not both")
    lowest = float(mesh.vertices[:, 2].min())
    if base is not None and base >= lowest:
        raise ValueError(f"base {base:g} m must be below the lowest vertex, which is at {lowest:g} m")
    mesh = _parted(mesh)
    border = border_edges(mesh.triangles)
    if not len(border):
        raise ValueError("the mesh has no border, so it is closed already; link a surface to it")
    if thickness is None:
        thickness = float(np.ptp(mesh.vertices[:, :2], axis=0).max()) / 20
    level = lowest - thickness if base is None else base
    fan = kind == "solid" and _is_convex(mesh.vertices, border)
    # Which vertices are repeated below: all of them, or those of the border.
    above = np.arange(len(mesh.vertices)) if kind == "solid" and not fan else np.unique(border)
    count = len(mesh.vertices)
    below = np.full(count, -1)
    below[above] = count + np.arange(len(above))
    lower = mesh.vertices[above]
    if kind == "skirt" and base is None:
        lower = lower - (0, 0, thickness)
    else:
        lower[:, 2] = level
    first, second = border.T
    parts = [
        mesh.triangles,
        np.stack([second, first, below[first]], axis=1),
        np.stack([second, below[first], below[second]], axis=1),
    ]
    uvs = None if mesh.uvs is None else np.concatenate([mesh.uvs, mesh.uvs[above]])
    normals = None
    if kind == "skirt":
        normals = None if mesh.normals is None else np.concatenate([mesh.normals, mesh.normals[above]])
    elif fan:
        middle = count + len(above)
        centre = np.append(lower[:, :2].mean(axis=0), level)
        lower = np.concatenate([lower, centre[None]])
        uvs = None if uvs is None else np.concatenate([uvs, uvs[count:].mean(axis=0, keepdims=True)])
        parts.append(np.stack([below[second], below[first], np.full(len(border), middle)], axis=1))
    else:
        parts.append(below[mesh.triangles[:, ::-1]])
    triangles = np.concatenate(parts).astype(np.int32)
    vertices = np.concatenate([mesh.vertices, lower])
    return replace(mesh, vertices=vertices, triangles=triangles, normals=normals, uvs=uvs)


def _is_convex(vertices: npt.NDArray[np.float64], border: Ints) -> bool:
    """Say whether the border is one loop that only ever turns left: seen from its middle, each edge faces outwards."""
    first, second = border.T
    following = np.full(len(vertices), -1)
    following[first] = second
    loop, at = 0, first[0]
    while loop <= len(border):
        at = following[at]
        loop += 1
        if at == first[0]:
            break
    if loop != len(border):
        return False
    ahead = (vertices[second] - vertices[first])[:, :2]
    after = (vertices[following[second]] - vertices[second])[:, :2]
    turn = ahead[:, 0] * after[:, 1] - ahead[:, 1] * after[:, 0]
    scale = np.hypot(*ahead.T) * np.hypot(*after.T)
    return bool((turn >= -1e-9 * scale).all())


def _parted(mesh: Mesh) -> Mesh:
    """Return the mesh with a vertex of its own for each group of triangles that meets others only at that corner."""
    border = border_edges(mesh.triangles)
    starts = np.bincount(border[:, 0], minlength=len(mesh.vertices))
    touching = starts > 1
    if not touching.any():
        return mesh
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    triangles = mesh.triangles.astype(np.int64)
    flat = triangles.reshape(-1)
    corner = np.flatnonzero(touching[flat])
    # Around a vertex, a triangle hangs together with the one that shares the edge to its next corner.
    place = np.full(len(flat), -1)
    place[corner] = np.arange(len(corner))
    owner = corner // 3
    after = triangles[owner, (corner + 1) % 3]
    before = triangles[owner, (corner + 2) % 3]
    span = len(mesh.vertices)
    leaving, arriving = flat[corner] * span + after, flat[corner] * span + before
    order = np.argsort(arriving)
    found = np.searchsorted(arriving, leaving, sorter=order)
    match = order[np.minimum(found, len(order) - 1)]
    joined = arriving[match] == leaving
    graph = coo_array((np.ones(joined.sum()), (np.flatnonzero(joined), match[joined])), shape=(len(corner),) * 2)
    count, group = connected_components(graph, directed=False)
    # The first group at a vertex keeps its number.
    vertex = np.empty(count, np.int64)
    vertex[group] = flat[corner]
    kept = np.zeros(count, bool)
    kept[np.unique(vertex, return_index=True)[1]] = True
    number = np.where(kept, vertex, len(mesh.vertices) + np.cumsum(~kept) - 1)
    flat[corner] = number[group]
    origin = np.concatenate([np.arange(len(mesh.vertices)), vertex[~kept]])
    vertices = mesh.vertices[origin]
    # Towards the mean of the other corners of the group's triangles.
    others = (mesh.vertices[after] + mesh.vertices[before]) / 2
    weights = np.bincount(group)[:, None]
    mean = np.stack([np.bincount(group, others[:, axis]) for axis in range(3)], axis=1) / weights
    vertices[number] += APART * (mean - vertices[number])
    return replace(
        mesh,
        vertices=vertices,
        triangles=flat.reshape(-1, 3).astype(np.int32),
        normals=None if mesh.normals is None else mesh.normals[origin],
        uvs=None if mesh.uvs is None else mesh.uvs[origin],
        error=math.nan,
    )
