"""PNG: pictures in sRGB, and heights as 16-bit codes with a sidecar that says what they mean."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph import File
from nodegraph_terrain.formats.heightmap import codes_of, with_sidecar
from nodegraph_terrain.formats.place import world_file as world_file_of
from nodegraph_terrain.raster import Image, Raster
from nodegraph_terrain.sidecar import Sidecar


def png(pixels: npt.NDArray[Any]) -> bytes:
    """Return pixels, (rows, columns[, 3 or 4]) uint8 or (rows, columns) uint16, as the bytes of a PNG picture."""
    from PIL import Image as Picture
    from PIL.PngImagePlugin import PngInfo

    info = PngInfo()
    if pixels.dtype == np.uint8:
        info.add(b"sRGB", b"\0")
    buffer = BytesIO()
    Picture.fromarray(np.ascontiguousarray(pixels)).save(buffer, "PNG", pnginfo=info, compress_level=6)
    return buffer.getvalue()


def write_codes(surface: Raster, name: str, *, minimum: float | None = None, maximum: float | None = None) -> File:
    """Write a raster as 16-bit codes."""
    codes = codes_of(surface, name, minimum, maximum)
    return with_sidecar(name, png(codes.encode(surface.data)), Sidecar.of(surface, "uint16", codes))


def write_image(image: Image, name: str, *, world_file: bool = False) -> File:
    """Write a picture, placed on the map by a world file where one is wanted."""
    return File.of(name, png(image.data), *(world_file_of(name, image) if world_file else ()))
