"""A picture of a mesh for people: lit from the left, seen obliquely, with its edges where they can be told apart."""

from __future__ import annotations

from math import cos, radians, sin
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_render.mesh import Mesh
from nodegraph_render.triangle_scan import spans, twice_area
from nodegraph_terrain.formats.png import png
from nodegraph_terrain.previews import ramp

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

LONG_SIDE = 1024
"""Pixels along the longer side of the picture."""

FINER = 2
"""Samples along a pixel's side."""

FRACTIONS = 16
"""Parts of a sample that corners are rounded to: inside or outside is then decided in whole numbers."""

AZIMUTH, ALTITUDE = 205.0, 38.0
"""Where the viewer stands: clockwise from north, above the horizon; far away, so that parallels stay parallel."""

LIGHT = np.array([-0.66, 0.20, 0.72])
"""Direction to the light: from the viewer's left and a little from behind the ground."""

RELIEF = 0.14
"""Share of the mesh's width that its relief is raised to, at most `RAISED` times."""

RAISED = 4.0

ROOMY = 80.0
"""Samples that the middle triangle must cover for edges to be drawn."""

_TINTS = ("#54794f", "#7f9a5f", "#b5b878", "#d8c793", "#bd9f74", "#9a8270", "#b7aea8", "#fbfaf8")
_WALL = np.array([0.18, 0.13, 0.09])
_BLOCK = 1 << 15

SUN, SKY = np.array([1.0, 0.96, 0.88]), np.array([0.86, 0.94, 1.1])
"""Colours of the light of the sun and of the sky."""

STEEP = 1e-3
"""Upward part of the normals of upright walls."""


class _Scene(NamedTuple):
    """The mesh as it is drawn; its triangles are clockwise from outside, which the screen's downward y turns round."""

    mesh: Mesh
    points: Floats
    triangles: Ints
    x: Ints
    y: Ints
    normals: Floats
    raised: float


def preview_mesh(mesh: Mesh) -> bytes:
    """Show the mesh obliquely from the south-south-west, in its texture or tinted by height; low relief is raised."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    size = high - low
    raised = min(RAISED, max(1.0, RELIEF * max(size[0], size[1]) / max(size[2], 1e-9)))
    points = (mesh.vertices - (low + high) / 2) * (1, 1, raised)
    axes = _view()
    seen = points @ axes.T
    flat = seen[:, :2]
    span = np.maximum(np.ptp(flat, axis=0), 1e-9)
    zoom = (LONG_SIDE - 8) * FINER / span.max()
    columns, rows = (np.ceil(span * zoom / FINER).astype(int) + 8) * FINER
    # Screen y runs down; the triangles that face the viewer then run clockwise, and are turned round.
    x = np.rint(((flat[:, 0] - flat[:, 0].min()) * zoom + 4 * FINER) * FRACTIONS).astype(np.int64)
    y = np.rint(((flat[:, 1].max() - flat[:, 1]) * zoom + 4 * FINER) * FRACTIONS).astype(np.int64)
    triangles = mesh.triangles[:, ::-1].astype(np.int64)
    a, b, c = (points[triangles[:, k]] for k in (2, 1, 0))
    scene = _Scene(mesh, points, triangles, x, y, _unit(np.cross(b - a, c - a)), raised)
    owner, area = _visible(scene, seen[:, 2], int(columns), int(rows))
    low_tint, high_tint = _tinted(scene)
    pixels = np.zeros((int(rows) * int(columns), 4), np.float32)
    places = np.flatnonzero(owner >= 0)
    for first in range(0, len(places), _BLOCK):
        place = places[first : first + _BLOCK]
        triangle = owner[place]
        row, column = np.divmod(place, columns)
        weights = _weights(scene, triangle, column, row)
        colour = _colours(scene, triangle, weights, low_tint, high_tint, axes)
        if area > ROOMY:
            colour *= _edges(scene, triangle, weights)[:, None]
        pixels[place, :3], pixels[place, 3] = np.clip(colour, 0, 1), 1
    means = pixels.reshape(rows // FINER, FINER, columns // FINER, FINER, 4).mean(axis=(1, 3))
    cover = np.maximum(means[..., 3:], 1e-9)
    # Light is added up in linear light and written as sRGB.
    linear = np.clip(means[..., :3] / cover, 0, 1)
    codes = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return png(np.rint(np.concatenate([codes, means[..., 3:]], axis=2) * 255).astype(np.uint8))


def _view() -> Floats:
    """Return the directions to the right, up and to the viewer."""
    turn, lift = radians(AZIMUTH), radians(ALTITUDE)
    towards = np.array([sin(turn) * cos(lift), cos(turn) * cos(lift), sin(lift)])
    right = np.array([-cos(turn), sin(turn), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def _visible(scene: _Scene, near: Floats, columns: int, rows: int) -> tuple[Ints, float]:
    """Return which triangle each sample shows (-1: none), and how many samples the middle one covers."""
    depth = np.full(rows * columns, -np.inf)
    owner = np.full(rows * columns, -1)
    areas = []
    for first in range(0, len(scene.triangles), _BLOCK):
        corners = scene.triangles[first : first + _BLOCK]
        area = twice_area(scene.x[corners], scene.y[corners])
        facing = np.flatnonzero(area > 0)
        corners, area = corners[facing], area[facing]
        areas.append(area)
        cx, cy = scene.x[corners], scene.y[corners]
        # Nearness is a plane over the screen.
        z = near[corners]
        x1, x2, y1, y2 = cx[:, 1] - cx[:, 0], cx[:, 2] - cx[:, 0], cy[:, 1] - cy[:, 0], cy[:, 2] - cy[:, 0]
        z1, z2 = z[:, 1] - z[:, 0], z[:, 2] - z[:, 0]
        across, down = (z1 * y2 - z2 * y1) / area * FRACTIONS, (z2 * x1 - z1 * x2) / area * FRACTIONS
        base = z[:, 0] - (across * cx[:, 0] + down * cy[:, 0]) / FRACTIONS
        runs = spans(cx, cy, unit=FRACTIONS)
        length = runs.last - runs.first + 1
        run = np.repeat(np.arange(len(length)), length)
        column = np.arange(len(run)) + (runs.first - np.cumsum(length) + length)[run]
        place = (runs.row * columns)[run] + column
        distance = (base[runs.triangle] + down[runs.triangle] * runs.row)[run] + across[runs.triangle][run] * column
        closer = np.flatnonzero(distance > depth[place])
        closer = closer[np.argsort(distance[closer], kind="stable")]
        # Of repeated places the last, nearest, stays.
        depth[place[closer]] = distance[closer]
        owner[place[closer]] = (facing + first)[runs.triangle][run[closer]]
    area = np.concatenate(areas)
    return owner, float(np.median(area)) / (2 * FRACTIONS**2) if len(area) else 0.0


def _weights(scene: _Scene, triangle: Ints, column: Ints, row: Ints) -> Floats:
    """Return barycentric weights, (n, 3), of samples in triangles."""
    corners = scene.triangles[triangle]
    x, y = scene.x[corners] - (column * FRACTIONS)[:, None], scene.y[corners] - (row * FRACTIONS)[:, None]
    cross = np.stack([x[:, k - 2] * y[:, k - 1] - x[:, k - 1] * y[:, k - 2] for k in range(3)], axis=1)
    return np.asarray(cross / cross.sum(axis=1, keepdims=True))


def _edges(scene: _Scene, triangle: Ints, weights: Floats) -> Floats:
    """Return how bright samples stay near the edges of their triangles."""
    corners = scene.triangles[triangle]
    x, y = scene.x[corners] / FRACTIONS, scene.y[corners] / FRACTIONS
    length = np.hypot(np.roll(x, -1, 1) - np.roll(x, -2, 1), np.roll(y, -1, 1) - np.roll(y, -2, 1))
    distance = (weights * twice_area(x, y)[:, None] / np.maximum(length, 1e-9)).min(axis=1)
    return np.asarray(1 - 0.45 * np.clip(1.3 - distance, 0, 1))


def _tinted(scene: _Scene) -> tuple[float, float]:
    """Return the heights that the tints run between.  Walls reach far below the ground: only upper sides count."""
    upper = scene.points[scene.triangles[scene.normals[:, 2] > STEEP], 2]
    low, high = np.percentile(upper, [0.5, 99.5]) if upper.size else (0.0, 0.0)
    return (float(low), float(high)) if high > low else (float(low) - 1, float(high) + 1)


def _colours(scene: _Scene, triangle: Ints, weights: Floats, low: float, high: float, axes: Floats) -> Floats:
    """Return the light, (n, 3) linear, that samples send to the viewer."""
    mesh, corners = scene.mesh, scene.triangles[triangle]
    normals = scene.normals[triangle]
    wall = np.abs(normals[:, 2]) < STEEP
    if mesh.normals is not None:
        # Slopes grow with the raised relief.
        level = mesh.normals.astype(np.float64)[corners] * (1, 1, 1 / scene.raised)
        normals = _unit(np.einsum("ij,ijk->ik", weights, level))
    if mesh.texture is not None and mesh.uvs is not None:
        rows, columns = mesh.texture.shape
        place = np.einsum("ij,ijk->ik", weights, mesh.uvs[corners].astype(np.float64))
        column = np.clip(place[:, 0] * columns, 0, columns - 1).astype(int)
        row = np.clip((1 - place[:, 1]) * rows, 0, rows - 1).astype(int)
        codes = mesh.texture.data[row, column, :3] / 255
    else:
        share = (np.einsum("ij,ij->i", weights, scene.points[:, 2][corners]) - low) / (high - low)
        codes = ramp(share[None].astype(np.float32), _TINTS)[0, :, :3] / 255
    albedo = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    albedo[wall] = _WALL
    right, up = axes[0], np.array([0.0, 0.0, 1.0])
    light = _unit((LIGHT @ np.stack([right, np.cross(up, right), up]))[None])[0]
    sun = np.maximum(normals @ light, 0)
    sky = 0.5 + 0.5 * normals[:, 2]
    # What stands upright is lit by the viewer's side of the sky, too.
    front = np.where(wall, 0.35 * np.maximum(normals @ axes[2], 0), 0)
    bright = 1.05 * sun[:, None] * SUN + (0.42 * sky + front)[:, None] * SKY
    return np.asarray(albedo * bright)


def _unit(vectors: Floats) -> Floats:
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    return np.asarray(vectors / np.maximum(length, 1e-300)[:, None])
