"""Previews of meshes: something is seen, it is the right way up and lit from the left."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Picture

from nodegraph.plugins import registry
from nodegraph_render.drape import drape
from nodegraph_render.mesh import Mesh
from nodegraph_render.mesh_grid import mesh_grid
from nodegraph_render.mesh_preview import preview_mesh
from nodegraph_render.mesh_solid import mesh_solid
from nodegraph_terrain.raster import Image

sys.path.insert(0, str(Path(__file__).parent))  # tests are no package
from meshes import raster

Y, X = np.mgrid[0:40, 0:50]
HILL = mesh_grid(raster(120 * np.exp(-((X - 25) ** 2 + (Y - 20) ** 2) / 80)))


SIDE = 400


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr("nodegraph_render.mesh_preview.LONG_SIDE", SIDE)


def picture(mesh: Mesh) -> np.ndarray:
    return np.asarray(Picture.open(io.BytesIO(preview_mesh(mesh))).convert("RGBA"), np.int64)


def test_it_is_the_registered_preview():
    assert registry().preview(Mesh).render is preview_mesh


def test_a_hill_is_lit_from_the_left():
    pixels = picture(HILL)
    assert max(pixels.shape[:2]) <= SIDE + 8
    seen = pixels[..., 3] == 255
    assert 0.3 < seen.mean() < 0.9
    middle = pixels.shape[1] // 2
    top = np.argmax(seen[:, middle])
    face = pixels[top + 25 : top + 65, :, :3].sum(axis=2)
    assert face[:, middle - 25 : middle - 4].mean() > 1.1 * face[:, middle + 4 : middle + 25].mean()


def test_texture_and_walls_are_shown():
    red = np.zeros((8, 8, 3), np.uint8)
    red[..., 0] = 255
    extent = raster(np.zeros((40, 50))).extent
    pixels = picture(mesh_solid(drape(HILL, Image(red, extent)), thickness=80))
    shown = pixels[pixels[..., 3] == 255]
    is_red = (shown[:, 1] < 10) & (shown[:, 2] < 10)
    assert 0.5 < is_red.mean() < 0.95
    assert (~is_red & (shown[:, 0] > shown[:, 2])).mean() > 0.05


@pytest.mark.parametrize("shape", [(2, 2), (2, 300), (300, 2)])
def test_flat_and_thin_meshes_are_drawn(shape):
    assert (picture(mesh_grid(raster(np.zeros(shape))))[..., 3] == 255).any()


def test_a_hidden_triangle_stays_hidden():
    """A small red triangle behind a large wall is not seen, one in front of it is."""
    wall = np.array([[-50, 0, 0], [50, 0, 0], [50, 9, 60], [-50, 9, 60]], np.float64)
    small = np.array([[-5, 0, 10], [5, 0, 10], [0, 2, 20]], np.float64)
    uvs = np.array([[0.9, 0.5]] * 4 + [[0.1, 0.5]] * 3, np.float32)
    pixels = np.zeros((4, 8, 3), np.uint8)
    pixels[:, :4, 0], pixels[:, 4:, 2] = 255, 255
    extent = raster(np.zeros((4, 8))).extent
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]], np.int32)
    up = np.tile(np.array([0, 0, 1], np.float32), (7, 1))
    red = []
    for depth in (-20.0, 20.0):
        vertices = np.concatenate([wall, small + np.array([0, depth, 0])])
        shown = picture(Mesh(vertices, triangles, up, uvs, Image(pixels, extent)))
        red.append(int(((shown[..., 0] > 90) & (shown[..., 2] < 60) & (shown[..., 3] == 255)).sum()))
    assert red[0] > 50
    assert red[1] == 0
