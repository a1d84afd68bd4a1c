"""Meshes of rasters: what they cover, how they fit together, and how far they are from the samples."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph.errors import Cancelled
from nodegraph_render.mesh import Mesh
from nodegraph_render.mesh_adaptive import mesh_adaptive
from nodegraph_render.mesh_grid import mesh_grid
from nodegraph_render.mesh_tin import mesh_tin
from nodegraph_terrain.gradient import horn_gradient
from nodegraph_terrain.raster import Elevation, Extent

sys.path.insert(0, str(Path(__file__).parent))  # tests are no package
import itertools

from meshes import CELL, check_surface, lattice, raster, rasters, squares

MESHERS = {
    "grid": lambda surface, error: mesh_grid(surface),
    "adaptive": lambda surface, error: mesh_adaptive(surface, error=error),
    "tin": lambda surface, error: mesh_tin(surface, error=error),
}


@pytest.fixture(params=MESHERS)
def mesher(request):
    return MESHERS[request.param]


def hills(rows: int, cols: int) -> np.ndarray:
    y, x = np.mgrid[0:rows, 0:cols]
    dice = np.random.default_rng(rows * 1000 + cols)
    return 80 * np.sin(x / 7) * np.cos(y / 5) + dice.normal(0, 2, (rows, cols))


@pytest.mark.parametrize("name", MESHERS)
@settings(max_examples=80)
@given(surface=rasters(), error=st.sampled_from([0.0, 0.5, 5.0, 40.0]))
@example(surface=raster([[1, 2], [3, 7]]), error=0.0)
@example(surface=raster([[5, 5, np.nan], [5, 5, 5], [np.nan, 5, 5]]), error=1.0)
def test_it_covers_the_ground_once_and_keeps_to_its_error(name, surface, error):
    assume(squares(surface).any())
    mesh = MESHERS[name](surface, error)
    assert mesh.error <= error
    check_surface(mesh, surface, error)


@pytest.mark.parametrize("shape", [(2, 2), (2, 9), (9, 2), (3, 7), (3, 200), (17, 17), (34, 18)])
def test_any_shape_will_do(mesher, shape):
    surface = raster(hills(*shape))
    check_surface(mesher(surface, 4.0), surface, 4.0)


@pytest.mark.parametrize("name", ["adaptive", "tin"])
@pytest.mark.parametrize("shape", [(257, 129), (129, 130), (100, 99), (9, 700)])
def test_larger_shapes_will_do_too(name, shape):
    surface = raster(hills(*shape))
    check_surface(MESHERS[name](surface, 25.0), surface, 25.0)


@pytest.mark.parametrize("shape", [(2, 2), (3, 7), (257, 129), (2, 50), (3, 700), (100, 99)])
def test_flat_ground_gives_two_triangles(shape):
    for heights in (np.full(shape, 12.5), np.add.outer(np.arange(shape[0]) * 0.5, np.arange(shape[1]) * 2.0)):
        for mesh in (mesh_adaptive(raster(heights), error=0.0), mesh_tin(raster(heights), error=0.0)):
            assert len(mesh.triangles) == 2
            assert mesh.error == 0


def test_a_very_long_raster_is_a_row_of_squares():
    mesh = mesh_adaptive(raster(np.zeros((10, 10_000))), error=0.0)
    assert 2 < len(mesh.triangles) < 2 * 10_000 / 10


def test_the_error_told_is_the_error_measured(mesher):
    """No smaller and no larger: interpolate every sample by an independent library."""
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    surface = raster(hills(60, 45))
    mesh = mesher(surface, 6.0)
    x, y = lattice(mesh).T
    plane = LinearTriInterpolator(Triangulation(x, -y, mesh.triangles), mesh.vertices[:, 2])
    rows, cols = np.mgrid[0:60, 0:45]
    measured = np.abs(plane(cols.ravel(), -rows.ravel()).filled(np.nan) - surface.data.ravel())
    assert not np.isnan(measured).any()
    assert measured.max() == pytest.approx(mesh.error, abs=1e-9)


def test_fewer_triangles_for_a_larger_error():
    surface = raster(hills(120, 130))
    for mesher in (MESHERS["adaptive"], MESHERS["tin"]):
        counts = [len(mesher(surface, error).triangles) for error in (0.0, 2.0, 8.0, 30.0, 1000.0)]
        assert counts == sorted(counts, reverse=True)
        assert counts[-1] == 2
    assert len(mesh_tin(surface, error=8.0).triangles) < len(mesh_adaptive(surface, error=8.0).triangles)


def test_neighbouring_triangles_differ_by_one_level_at_most():
    surface = raster(np.where(np.hypot(*np.mgrid[-20:45, -20:45]) < 2, 300.0, 0.0))
    mesh = mesh_adaptive(surface, error=1.0)
    a, b, c = (lattice(mesh)[mesh.triangles[:, k]] for k in range(3))
    area = np.abs(np.cross(np.c_[b - a, np.zeros(len(a))], np.c_[c - a, np.zeros(len(a))])[:, 2])
    owner: dict[frozenset[int], list[float]] = {}
    for triangle, size in zip(mesh.triangles.tolist(), area.tolist(), strict=True):
        for k in range(3):
            owner.setdefault(frozenset((triangle[k], triangle[k - 1])), []).append(size)
    assert {max(pair) / min(pair) for pair in owner.values() if len(pair) == 2} <= {1.0, 2.0}


def test_normals_are_those_of_the_raster_and_uvs_run_over_its_extent(mesher):
    surface = raster(hills(30, 40))
    mesh = mesher(surface, 3.0)
    x, y = lattice(mesh).T
    east, north = (part[y, x] for part in horn_gradient(surface.data, slice(None), (CELL, CELL)))
    expected = np.stack([-east, -north, np.ones_like(east)], axis=1)
    assert np.allclose(mesh.normals, expected / np.linalg.norm(expected, axis=1)[:, None], atol=1e-6)
    extent = surface.extent
    assert np.allclose(mesh.uvs[:, 0] * extent.width + extent.west, mesh.vertices[:, 0], atol=1e-3)
    assert np.allclose(mesh.uvs[:, 1] * extent.height + extent.south, mesh.vertices[:, 1], atol=1e-3)
    assert mesh.crs == "EPSG:32616"


@given(stride=st.integers(1, 9), surface=rasters())
def test_stride_keeps_the_outline_and_stays_off_voids(stride, surface):
    assume(squares(surface).any())
    rows = np.union1d(np.arange(0, surface.shape[0], stride), surface.shape[0] - 1)
    cols = np.union1d(np.arange(0, surface.shape[1], stride), surface.shape[1] - 1)
    ground = squares(surface)
    expected = sum(
        (r1 - r0) * (c1 - c0)
        for r0, r1 in itertools.pairwise(rows)
        for c0, c1 in itertools.pairwise(cols)
        if ground[r0:r1, c0:c1].all()
    )
    if not expected:
        with pytest.raises(ValueError, match="smaller stride"):
            mesh_grid(surface, stride=stride)
        return
    mesh = mesh_grid(surface, stride=stride)
    a, b, c = (lattice(mesh)[mesh.triangles[:, k]] for k in range(3))
    u, v = b - a, c - a
    assert (v[:, 0] * u[:, 1] - u[:, 0] * v[:, 1]).sum() / 2 == expected


def test_the_grid_cuts_along_the_gentler_diagonal():
    mesh = mesh_grid(raster([[0, 9], [9, 0]]))
    shared = set(mesh.triangles[0]) & set(mesh.triangles[1])
    assert {mesh.vertices[k, 2] for k in shared} == {0.0} or {mesh.vertices[k, 2] for k in shared} == {9.0}
    ridge = mesh_grid(raster([[0, 9], [8, 0]]))
    assert {ridge.vertices[k, 2] for k in set(ridge.triangles[0]) & set(ridge.triangles[1])} == {0.0}


def test_coordinates_keep_millimetres_far_from_the_origin():
    extent = Extent(300_000.0, 9_800_000.0, 500_000.0, 10_000_000.0, "EPSG:32733")
    heights = hills(21, 21).astype(np.float32)
    mesh = mesh_grid(Elevation(heights, extent))
    step = 200_000 / 21
    assert mesh.vertices[0].tolist() == [300_000 + step / 2, 10_000_000 - step / 2, float(heights[0, 0])]
    assert np.allclose(np.diff(mesh.vertices[:21, 0]), step, atol=1e-6)


# Refusals.


def test_bad_rasters_are_refused(mesher):
    degrees = Elevation(np.zeros((4, 5), np.float32), Extent(8.0, 46.0, 9.0, 47.0, "EPSG:4326", "deg"))
    holes = np.ones((5, 5), np.float32)
    holes[::2] = np.nan
    for surface, message in (
        (degrees, "terrain.reproject"),
        (raster(np.zeros((1, 9))), "2 rows and 2 columns"),
        (raster(np.full((4, 4), np.nan)), "fill_voids"),
        (raster(holes), "fill_voids"),
        (raster([[0, np.inf], [0, 0]]), "terrain.clamp"),
    ):
        with pytest.raises(ValueError, match=message):
            mesher(surface, 1.0)


def test_a_mesh_that_is_none_is_refused():
    corners = np.zeros((3, 3))
    for changes in (
        {"triangles": np.array([[0, 1, 3]], np.int32)},
        {"triangles": np.empty((0, 3), np.int32)},
        {"vertices": np.array([[0, 0, np.nan]] * 3)},
        {"normals": np.zeros((2, 3), np.float32)},
        {"uvs": np.zeros((3, 3), np.float32)},
        {"vertices": np.zeros((3, 2))},
    ):
        fields = {"vertices": corners, "triangles": np.array([[0, 1, 2]], np.int32), **changes}
        with pytest.raises(ValueError):
            Mesh(**fields)


def test_a_cancel_takes_effect(mesher):
    from threading import Event

    stop = Event()
    stop.set()
    surface = raster(hills(40, 40))
    for node in (mesh_adaptive, mesh_tin, mesh_grid):
        with pytest.raises(Cancelled):
            node(surface, context=Context(cancelled=stop))
