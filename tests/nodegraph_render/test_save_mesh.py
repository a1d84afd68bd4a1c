"""Mesh files, read back by another library and, where that leaves something out, byte by byte."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from nodegraph_render.drape import drape
from nodegraph_render.mesh_adaptive import mesh_adaptive
from nodegraph_render.mesh_grid import mesh_grid
from nodegraph_render.mesh_solid import mesh_solid
from nodegraph_render.save_mesh import save_mesh
from nodegraph_terrain.raster import Elevation, Extent, Image

sys.path.insert(0, str(Path(__file__).parent))  # tests are no package
from meshes import raster

trimesh = pytest.importorskip("trimesh")

Y, X = np.mgrid[0:12, 0:17]
SURFACE = raster(40 * np.sin(X / 3) + 30 * np.cos(Y / 4) + 500)
MESH = mesh_adaptive(SURFACE, error=2.0)
PICTURE = Image(np.random.default_rng(0).integers(0, 256, (24, 34, 3)).astype(np.uint8), SURFACE.extent)
FORMATS = ("glb", "gltf", "obj", "ply", "stl")


def written(file, folder: Path) -> Path:
    for item in file.all():
        path = folder / item.name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(item.content.tobytes())
    return folder / file.name


def told(path: Path) -> dict:
    return json.loads(path.with_name(path.name + ".json").read_text())


def read(path: Path):
    scene = trimesh.load_scene(path, process=False)
    (mesh,) = scene.geometry.values()
    return mesh


def in_terrain(points: np.ndarray, path: Path) -> np.ndarray:
    """Undo axes, scale and origin as the sidecar tells."""
    about = told(path)
    if about["axes"]["up"] == "y":
        points = np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=1)
    return points / about["scale"] + about["origin"]


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("options", [{}, {"scale": 0.01}])
def test_every_format_comes_back(suffix, options, tmp_path):
    path = written(save_mesh(MESH, name=f"deep/er/hill.{suffix}", **options), tmp_path)
    back = read(path)
    corners = in_terrain(back.vertices, path)[back.faces]
    assert corners.shape == (len(MESH.triangles), 3, 3)
    assert np.allclose(corners, MESH.vertices[MESH.triangles], rtol=0, atol=1e-3)
    about = told(path)
    assert about["crs"] == "EPSG:32616"
    assert about["error"] == MESH.error <= 2.0
    assert about["triangles"] == len(MESH.triangles)


@pytest.mark.parametrize("suffix", ["glb", "gltf", "obj", "ply"])
def test_normals_and_texture_come_back(suffix, tmp_path):
    path = written(save_mesh(MESH, PICTURE, name=f"hill.{suffix}"), tmp_path)
    back = read(path)
    upright = back.vertex_normals
    if told(path)["axes"]["up"] == "y":
        upright = np.stack([upright[:, 0], -upright[:, 2], upright[:, 1]], axis=1)
    # OBJ readers may renumber: compare corner by corner.
    assert np.allclose(upright[back.faces], MESH.normals[MESH.triangles], atol=1e-4)
    expected = drape(MESH, PICTURE).uvs[MESH.triangles]
    assert np.allclose(back.visual.uv[back.faces], expected, atol=1e-6)
    material = back.visual.material
    picture = getattr(material, "baseColorTexture", None) or material.image
    assert np.array_equal(np.asarray(picture.convert("RGB")), PICTURE.data)


def test_the_texture_lies_the_right_way_round(tmp_path):
    """North-west red, the rest blue: the vertex in the north-west corner sees red."""
    pixels = np.zeros((40, 40, 3), np.uint8)
    pixels[..., 2] = 255
    pixels[:20, :20] = (255, 0, 0)
    path = written(save_mesh(MESH, Image(pixels, SURFACE.extent), name="a.glb"), tmp_path)
    back = read(path)
    colours = back.visual.to_color().vertex_colors[:, :3]
    places = in_terrain(back.vertices, path)
    west, north = SURFACE.extent.west, SURFACE.extent.north
    corner = np.argmin(np.hypot(places[:, 0] - west, places[:, 1] - north))
    others = (places[:, 0] > west + 100) | (places[:, 1] < north - 80)
    assert colours[corner].tolist() == [255, 0, 0]
    assert (colours[others] == (0, 0, 255)).all()


def test_glb_is_laid_out_as_the_specification_asks():
    content = save_mesh(MESH, PICTURE, name="a.glb").content.tobytes()
    magic, version, length, json_length, json_kind = np.frombuffer(content[:20], "<u4").tolist()
    assert (magic, version, length, json_kind) == (0x46546C67, 2, len(content), 0x4E4F534A)
    assert json_length % 4 == 0
    record = json.loads(content[20 : 20 + json_length])
    blob_length, blob_kind = np.frombuffer(content[20 + json_length : 28 + json_length], "<u4").tolist()
    blob = content[28 + json_length :]
    assert blob_kind == 0x004E4942
    assert blob_length == len(blob) == record["buffers"][0]["byteLength"]
    assert blob_length % 4 == 0
    for view in record["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= len(blob)
    place = record["accessors"][record["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    view = record["bufferViews"][place["bufferView"]]
    points = np.frombuffer(blob, "<f4", place["count"] * 3, view["byteOffset"]).reshape(-1, 3)
    assert points.min(axis=0).tolist() == place["min"]
    assert points.max(axis=0).tolist() == place["max"]
    assert record["nodes"][0]["extras"]["origin"][2] == 0
    heights = MESH.vertices[:, 2]
    assert np.ptp(points[:, 1]) == pytest.approx(np.ptp(heights), abs=1e-3), "y is up"


def test_one_folder_takes_every_format(tmp_path):
    names = [item.name for suffix in ("obj", "gltf") for item in save_mesh(MESH, PICTURE, name=f"a/b.{suffix}").all()]
    assert names == ["a/b.obj", "a/b.mtl", "a/b.png", "a/b.obj.json", "a/b.gltf", "a/b.bin", "a/b.png", "a/b.gltf.json"]


def test_a_printed_solid_is_watertight(tmp_path):
    path = written(save_mesh(mesh_solid(MESH, thickness=50), name="print.stl", scale=0.01), tmp_path)
    back = trimesh.load(io.BytesIO(path.read_bytes()), file_type="stl")
    assert back.is_watertight
    assert back.volume > 0
    assert back.extents[0] == pytest.approx(16 * 10 * 0.01, rel=1e-5)


def test_map_coordinates_need_double_precision(tmp_path):
    surface = Elevation(SURFACE.data, Extent(500_000.03, 4_000_000.07, 500_017.03, 4_000_012.07, "EPSG:32616"))
    mesh = mesh_grid(surface)
    for suffix in ("glb", "stl"):
        with pytest.raises(ValueError, match="recentre"):
            save_mesh(mesh, name=f"a.{suffix}", recentre=False)
    for suffix, step in (("ply", 0.0), ("obj", 1e-3)):
        path = written(save_mesh(mesh, name=f"a.{suffix}", recentre=False), tmp_path)
        back = read(path)
        assert told(path)["origin"] == [0, 0, 0]
        assert np.allclose(back.vertices[back.faces], mesh.vertices[mesh.triangles], rtol=0, atol=step)
    near = written(save_mesh(mesh, name="near.glb"), tmp_path)
    back = read(near)
    assert np.allclose(in_terrain(back.vertices, near)[back.faces], mesh.vertices[mesh.triangles], rtol=0, atol=1e-4)


def test_a_large_scene_keeps_its_centimetres(tmp_path):
    extent = Extent(300_000.0, 9_800_000.0, 500_000.0, 10_000_000.0, "EPSG:32733")
    mesh = mesh_grid(Elevation(np.random.default_rng(1).uniform(0, 9000, (30, 30)).astype(np.float32), extent))
    for suffix in FORMATS:
        path = written(save_mesh(mesh, name=f"a.{suffix}"), tmp_path)
        back = read(path)
        assert np.abs(in_terrain(back.vertices, path)[back.faces] - mesh.vertices[mesh.triangles]).max() < 0.005


def test_a_picture_of_part_of_the_mesh_or_of_elsewhere_is_refused():
    extent = SURFACE.extent
    small = Image(PICTURE.data, Extent(extent.west, extent.south, extent.east - 50, extent.north, extent.crs))
    foreign = Image(PICTURE.data, Extent(extent.west, extent.south, extent.east, extent.north, "EPSG:3857"))
    degrees = Image(PICTURE.data, Extent(8, 46, 9, 47, "EPSG:4326", "deg"))
    for picture, message in ((small, "cover"), (foreign, "reproject"), (degrees, "reproject")):
        with pytest.raises(ValueError, match=message):
            drape(MESH, picture)


def test_bad_names_are_refused():
    with pytest.raises(ValueError, match="choose one of"):
        save_mesh(MESH, name="a.fbx")
    with pytest.raises(ValueError, match="holds no texture"):
        save_mesh(MESH, PICTURE, name="a.stl")


def test_transparent_pictures_cut_holes():
    pixels = np.full((4, 4, 4), 255, np.uint8)
    pixels[0, 0, 3] = 0
    for data, mode in ((pixels, b"MASK"), (np.full_like(pixels, 255), b"")):
        content = save_mesh(MESH, Image(data, SURFACE.extent), name="a.glb").content.tobytes()
        assert (b"alphaMode" in content) == bool(mode)
