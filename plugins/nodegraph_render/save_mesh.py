"""Meshes as files: OBJ, PLY, STL, glTF and GLB.

The writers are our own: they are short, and a library's lost what matters here (doubles in PLY, the names of material
and texture files, an error instead of a missing texture).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, File, OutputName, Param, node
from nodegraph_render.mesh import Mesh, draped
from nodegraph_terrain.formats.png import png
from nodegraph_terrain.raster import Image

FORMAT = "nodegraph-mesh/1"

ROUNDING = 0.005
"""Metres that single precision may move a vertex by where the coordinates are not made relative."""

LINES = 1 << 16
"""Lines of text that are written between two looks at whether the run was cancelled."""


@node(version=1)
def save_mesh(
    mesh: Mesh,
    texture: Image | None = None,
    *,
    name: Annotated[OutputName, Param("File to write; the suffix is the format: glb, gltf, obj, ply or stl.")],
    scale: Annotated[
        float, Param("Units of the file per metre; 0.01 prints 1 : 100,000 where a unit is 1 mm.", gt=0)
    ] = 1.0,
    recentre: Annotated[
        bool, Param("Make x and y relative to the middle of the mesh; what was taken off stands in the sidecar.")
    ] = True,
    context: Context,
) -> File:
    """Write a mesh to a file, with its texture where the format holds one.

    ==========  ======================================================================================================
    ``.glb``    glTF 2.0 in one file, texture inside.  y is up, as glTF wants it: (x, y, z) is written as (x, z, -y).
    ``.gltf``   The same as JSON, with ``<name>.bin`` and ``<name>.png`` beside it.
    ``.obj``    Wavefront OBJ, ten digits, with ``<name>.mtl`` and ``<name>.png`` where there is a texture.
    ``.ply``    Binary little-endian PLY with normals and texture coordinates s, t; the texture beside it.
    ``.stl``    Binary STL: triangles only.
    ==========  ======================================================================================================

    x is east, y north and z up (except in glTF), and one unit is a metre times `scale`.  Triangles are
    counter-clockwise seen from outside.  Beside every file stands ``<name>.json`` with origin, scale, coordinate
    system, axes and the mesh's error; glTF carries the same as ``extras`` of its node:

        coordinate in the terrain's system = coordinate in the file / scale + origin

    These formats hold single precision, which at the coordinates of a map is half a metre.  With `recentre` x and y
    are relative to the middle of the mesh, in whole metres, and z stays the elevation; a scene of 200 km then keeps
    its vertices to 4 mm.  Without it PLY is written in double precision.

    The same mesh gives the same bytes on every run.

    Args:
        mesh: what to write.
        texture: laid over the mesh from above, placed by its extent (see drape); none: the mesh's own.
        name: file to write.
        scale: multiplies all coordinates.
        recentre: make x and y relative.
        context: the engine's.

    Raises:
        ValueError: the suffix names no format, the format holds no texture or would move a vertex by more than 5 mm,
            or the texture does not fit the mesh.

    References:
        Khronos Group (2021): glTF 2.0 Specification.  G. Turk (1994): The PLY Polygon File Format.
    """
    suffix = PurePosixPath(name).suffix.lower()
    writer = _WRITERS.get(suffix)
    if writer is None:
        raise ValueError(f"'{name}' ends in '{suffix}'; choose one of {', '.join(_WRITERS)}")
    if texture is not None:
        if writer is _stl:
            raise ValueError("an STL file holds no texture; unlink it, or choose .glb, .obj or .ply")
        mesh = draped(mesh, texture)
    origin = np.zeros(3)
    if recentre:
        origin[:2] = np.rint((mesh.vertices[:, :2].min(axis=0) + mesh.vertices[:, :2].max(axis=0)) / 2)
    points = (mesh.vertices - origin) * scale
    moved = float(np.abs(points.astype(np.float32) - points).max()) / scale
    if not recentre and moved > ROUNDING and writer not in (_obj, _ply):
        raise ValueError(f"{suffix} holds single precision, which moves vertices by {moved:.2g} m; recentre the mesh")
    picture = None if mesh.texture is None or mesh.uvs is None else png(mesh.texture.data)
    about = {
        "format": FORMAT,
        "origin": origin.tolist(),
        "scale": scale,
        "unit": "m",
        "crs": mesh.crs,
        "axes": {"east": "x", "north": "-z", "up": "y"} if writer is _gltf else {"east": "x", "north": "y", "up": "z"},
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.triangles),
        "error": None if math.isnan(mesh.error) else mesh.error,
    }
    file = writer(_Sheet(name, points, mesh, picture, about, not recentre, context))
    sidecar = File.of(f"{name}.json", (json.dumps(about, indent=2, ensure_ascii=False) + "\n").encode())
    return File(file.name, file.content, (*file.sidecars, sidecar))


@dataclass(frozen=True, slots=True)
class _Sheet:
    """What a writer gets: the mesh, its coordinates in the file, the PNG of its texture, and what is told of it."""

    name: str
    points: npt.NDArray[np.float64]
    mesh: Mesh
    picture: bytes | None
    about: dict[str, Any]
    double: bool
    context: Context

    def beside(self, suffix: str) -> str:
        """Return the name of a file beside this one."""
        return str(PurePosixPath(self.name).with_suffix(suffix))


def _base(name: str) -> str:
    return PurePosixPath(name).name


# One writer per format.


def _stl(sheet: _Sheet) -> File:
    corners = sheet.points.astype(np.float32)[sheet.mesh.triangles]
    exact = sheet.points[sheet.mesh.triangles]
    normals = np.cross(exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0])
    length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    records = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    records["normal"] = normals / np.where(length > 0, length, 1)[:, None]
    records["corners"] = corners
    # Readers take a file that starts with "solid" for text.
    header = b"binary STL, z up, one unit is a metre times the scale in the sidecar".ljust(80)
    return File.of(sheet.name, header + np.uint32(len(records)).astype("<u4").tobytes() + records.tobytes())


def _ply(sheet: _Sheet) -> File:
    mesh, real = sheet.mesh, ("double", "<f8") if sheet.double else ("float", "<f4")
    columns: list[tuple[str, str, str, npt.NDArray[Any]]] = [
        (axis, *real, sheet.points[:, k]) for k, axis in enumerate("xyz")
    ]
    if mesh.normals is not None:
        columns += [(axis, "float", "<f4", mesh.normals[:, k]) for k, axis in enumerate(("nx", "ny", "nz"))]
    if mesh.uvs is not None:
        columns += [(axis, "float", "<f4", mesh.uvs[:, k]) for k, axis in enumerate("st")]
    rows = np.empty(len(mesh.vertices), [(axis, code) for axis, _, code, _ in columns])
    for axis, _, _, values in columns:
        rows[axis] = values
    faces = np.empty(len(mesh.triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.triangles
    picture = sheet.beside(".png")
    header = ["ply", "format binary_little_endian 1.0", "comment z up, one unit is a metre times the scale"]
    header += [f"comment TextureFile {_base(picture)}"] if sheet.picture is not None else []
    header += [f"element vertex {len(rows)}", *(f"property {kind} {axis}" for axis, kind, _, _ in columns)]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    content = "\n".join(header).encode() + rows.tobytes() + faces.tobytes()
    return File.of(sheet.name, content, *_picture(sheet, picture))


def _obj(sheet: _Sheet) -> File:
    mesh = sheet.mesh
    material, picture = sheet.beside(".mtl"), sheet.beside(".png")
    parts = [b"# z up, one unit is a metre times the scale in the sidecar\n"]
    sidecars: tuple[File, ...] = ()
    if sheet.picture is not None:
        # Names with blanks are read differently from program to program.
        text = f"newmtl ground\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {_base(picture)}\n"
        sidecars = (File.of(material, text.encode()), *_picture(sheet, picture))
        parts += [f"mtllib {_base(material)}\nusemtl ground\n".encode()]
    parts += _lines(sheet.context, b"v %.10g %.10g %.10g\n", sheet.points)
    form = "{0}"
    if mesh.uvs is not None:
        parts += _lines(sheet.context, b"vt %.7g %.7g\n", mesh.uvs)
        form = "{0}/{0}"
    if mesh.normals is not None:
        parts += _lines(sheet.context, b"vn %.5g %.5g %.5g\n", mesh.normals)
        form = "{0}/{0}/{0}" if mesh.uvs is not None else "{0}//{0}"
    repeats = form.count("{0}")
    line = f"f {' '.join([form.format('%d')] * 3)}\n".encode()
    parts += _lines(sheet.context, line, np.repeat(mesh.triangles.astype(np.int64) + 1, repeats, axis=1))
    return File.of(sheet.name, b"".join(parts), *sidecars)


def _lines(context: Context, form: bytes, values: npt.NDArray[Any]) -> list[bytes]:
    """Return the rows of an array as text, one line each."""
    parts = []
    for first in range(0, len(values), LINES):
        context.progress()
        block = values[first : first + LINES]
        parts.append(form * len(block) % tuple(block.reshape(-1).tolist()))
    return parts


def _gltf(sheet: _Sheet) -> File:
    mesh, picture = sheet.mesh, sheet.beside(".png")
    one_file = PurePosixPath(sheet.name).suffix.lower() == ".glb"
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    blob = bytearray()

    def view(content: bytes, **more: Any) -> int:
        blob.extend(bytes(-len(blob) % 4))
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(content), **more})
        blob.extend(content)
        return len(views) - 1

    def accessor(values: npt.NDArray[Any], kind: str, component: int, target: int, **more: Any) -> int:
        number = view(values.tobytes(), target=target)
        accessors.append({"bufferView": number, "componentType": component, "count": len(values), "type": kind, **more})
        return len(accessors) - 1

    def upright(vectors: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        return np.stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]], axis=1).astype("<f4")

    places = upright(sheet.points)
    box = {"min": places.min(axis=0).tolist(), "max": places.max(axis=0).tolist()}
    attributes = {"POSITION": accessor(places, "VEC3", 5126, 34962, **box)}
    if mesh.normals is not None:
        attributes["NORMAL"] = accessor(upright(mesh.normals), "VEC3", 5126, 34962)
    if mesh.uvs is not None:
        # v runs down in glTF.
        down = np.stack([mesh.uvs[:, 0], 1 - mesh.uvs[:, 1]], axis=1).astype("<f4")
        attributes["TEXCOORD_0"] = accessor(down, "VEC2", 5126, 34962)
    indices = accessor(mesh.triangles.astype("<u4").reshape(-1), "SCALAR", 5125, 34963)
    material: dict[str, Any] = {"name": "ground", "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}}
    record: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "nodegraph"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": PurePosixPath(sheet.name).stem, "extras": sheet.about}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0, "mode": 4}]}],
        "materials": [material],
    }
    if sheet.picture is not None:
        material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
        if mesh.texture is not None and mesh.texture.data.shape[2] == 4 and mesh.texture.data[..., 3].min() < 255:
            material["alphaMode"] = "MASK"
        source = {"bufferView": view(sheet.picture), "mimeType": "image/png"} if one_file else {"uri": _uri(picture)}
        record["images"] = [source]
        # Linear, with mipmaps; the border of the picture must not come in from the other side.
        record["samplers"] = [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]
        record["textures"] = [{"source": 0, "sampler": 0}]
    blob.extend(bytes(-len(blob) % 4))
    record |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(blob)}]}
    if not one_file:
        data = sheet.beside(".bin")
        record["buffers"][0]["uri"] = _uri(data)
        text = json.dumps(record, indent=1, allow_nan=False).encode()
        return File.of(sheet.name, text, File.of(data, blob), *_picture(sheet, picture))
    text = json.dumps(record, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(blob)
    head = np.array([0x46546C67, 2, length, len(text), 0x4E4F534A], "<u4").tobytes()
    return File.of(sheet.name, head + text + np.array([len(blob), 0x004E4942], "<u4").tobytes() + bytes(blob))


def _uri(name: str) -> str:
    from urllib.parse import quote

    return quote(_base(name))


def _picture(sheet: _Sheet, name: str) -> tuple[File, ...]:
    return () if sheet.picture is None else (File.of(name, sheet.picture),)


_WRITERS: dict[str, Callable[[_Sheet], File]] = {
    ".glb": _gltf,
    ".gltf": _gltf,
    ".obj": _obj,
    ".ply": _ply,
    ".stl": _stl,
}
