"""Solids and skirts: closed, facing outwards, with the right volume, whatever the holes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from nodegraph_render.mesh import Mesh, border_edges
from nodegraph_render.mesh_adaptive import mesh_adaptive
from nodegraph_render.mesh_grid import mesh_grid
from nodegraph_render.mesh_solid import mesh_solid
from nodegraph_render.mesh_tin import mesh_tin

sys.path.insert(0, str(Path(__file__).parent))  # tests are no package
from meshes import CELL, raster, rasters, squares

trimesh = pytest.importorskip("trimesh")

TOUCHING = raster(np.where(np.eye(9) * (np.arange(9) % 3 == 1), np.nan, np.add.outer(np.arange(9.0), np.arange(9.0))))
DIAMOND = np.full((9, 9), 5.0)
DIAMOND[[2, 4], [4, 2]] = np.nan


def body(mesh: Mesh):
    """Read by positions alone, as a slicer reads an STL."""
    corners = mesh.vertices[mesh.triangles].reshape(-1, 3)
    _, number = np.unique(corners, axis=0, return_inverse=True)
    return trimesh.Trimesh(_, number.reshape(-1, 3), process=False)


def volume_above(mesh: Mesh, level: float) -> float:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    area = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    return float((area * ((a + b + c)[:, 2] / 3 - level)).sum())


@pytest.mark.parametrize("mesher", [mesh_grid, lambda s: mesh_adaptive(s, error=5.0), lambda s: mesh_tin(s, error=5.0)])
@given(surface=rasters(side=14))
@example(surface=raster(DIAMOND))
@example(surface=TOUCHING)
def test_a_solid_is_closed_and_holds_what_lies_under_the_ground(mesher, surface):
    assume(squares(surface).any())
    ground = mesher(surface)
    low = float(ground.vertices[:, 2].min())
    solid = mesh_solid(ground, base=low - 50)
    read = body(solid)
    assert read.is_watertight
    assert read.is_winding_consistent
    # Corners that were moved apart take a hundredth of a few triangles with them.
    expected = volume_above(ground, low - 50)
    assert read.volume == pytest.approx(expected, rel=1e-9 if _untouched(ground) else 0.02)
    assert solid.vertices[:, 2].min() == low - 50


def _untouched(mesh: Mesh) -> bool:
    return bool(np.bincount(border_edges(mesh.triangles)[:, 0]).max() == 1)


def test_touching_holes_are_moved_apart():
    ground = mesh_grid(raster(DIAMOND))
    assert not _untouched(ground)
    solid = mesh_solid(ground, thickness=10)
    assert body(solid).is_watertight
    moved = np.setdiff1d(np.round(solid.vertices[:, 0] / CELL % 1, 6), [0.5])
    assert len(moved)
    places = np.unique(solid.vertices[:, :2], axis=0)
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2)
    assert 0 < gaps[gaps > 0].min() < 0.03 * CELL


def test_an_outline_without_holes_stands_on_a_fan():
    ground = mesh_grid(raster(np.add.outer(np.arange(12.0), np.arange(15.0))))
    around = 2 * (11 + 14)
    solid = mesh_solid(ground, thickness=7)
    assert len(solid.triangles) == len(ground.triangles) + 3 * around
    assert solid.vertices[:, 2].min() == -7
    assert solid.normals is None
    assert solid.uvs.shape == (len(solid.vertices), 2)


def test_thickness_is_a_twentieth_by_default():
    ground = mesh_grid(raster(np.zeros((5, 21))))
    assert mesh_solid(ground).vertices[:, 2].min() == pytest.approx(-20 * CELL / 20)


@given(surface=rasters(side=14), flat=st.booleans())
def test_a_skirt_is_walls_only(surface, flat):
    assume(squares(surface).any())
    ground = mesh_grid(surface)
    low = float(ground.vertices[:, 2].min())
    skirt = mesh_solid(ground, kind="skirt", base=low - 9) if flat else mesh_solid(ground, kind="skirt", thickness=9.0)
    around = len(border_edges(ground.triangles))
    assert len(skirt.triangles) == len(ground.triangles) + 2 * around
    assert skirt.normals.shape == skirt.vertices.shape
    read = body(skirt)
    walls = read.face_normals[len(ground.triangles) :]
    assert np.abs(walls[:, 2]).max() < 1e-9
    hem = skirt.vertices[np.unique(border_edges(skirt.triangles))]
    if flat:
        assert (hem[:, 2] == low - 9).all()
    else:
        edge = ground.vertices[np.unique(border_edges(ground.triangles))]
        assert np.allclose(sorted(set(hem[:, 2])), sorted(set(edge[:, 2] - 9)))


def test_walls_face_away_from_the_ground():
    ground = mesh_grid(raster(np.zeros((3, 3))))
    skirt = mesh_solid(ground, kind="skirt", thickness=5.0)
    a, b, c = (skirt.vertices[skirt.triangles[len(ground.triangles) :, k]] for k in range(3))
    outwards = (a + b + c) / 3 - ground.vertices.mean(axis=0)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), outwards) > 0).all()


def test_what_cannot_be_a_solid_is_refused():
    ground = mesh_grid(raster(np.zeros((4, 4))))
    with pytest.raises(ValueError, match="below the lowest vertex"):
        mesh_solid(ground, base=0.0)
    with pytest.raises(ValueError, match="not both"):
        mesh_solid(ground, base=-5.0, thickness=2.0)
    with pytest.raises(ValueError, match="closed already"):
        mesh_solid(mesh_solid(ground))
    twisted = Mesh(ground.vertices, np.concatenate([ground.triangles[:1], ground.triangles[1:, ::-1]]))
    with pytest.raises(ValueError, match="same way"):
        mesh_solid(twisted)
