"""Georeference that goes into a file or beside it."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

from nodegraph import File
from nodegraph_terrain.georeference import parse_crs
from nodegraph_terrain.raster import Extent, Image


def crs_of(extent: Extent, what: str) -> Any:
    """Return the rasterio CRS of an extent, or None where it has none.

    Raises:
        ValueError: it is in degrees of no system, which `what` cannot say.
    """
    if extent.crs:
        return parse_crs(extent.crs)
    if extent.unit == "deg":
        raise ValueError(f"the raster is in degrees without a coordinate system, which {what} cannot say; choose .h5")
    return None


def prj(name: str, crs: Any) -> File:
    """Return the ``.prj`` beside a file."""
    text = crs.to_wkt(version="WKT1_ESRI")
    return File.of(str(PurePosixPath(name).with_suffix(".prj")), text.encode())


def world_file(name: str, image: Image) -> tuple[File, ...]:
    """Return the world file that places a PNG, and its ``.prj``."""
    dx, dy = image.cell_size
    lines = (dx, 0.0, 0.0, -dy, image.extent.west + dx / 2, image.extent.north - dy / 2)
    world = File.of(str(PurePosixPath(name).with_suffix(".pgw")), "".join(f"{line!r}\n" for line in lines).encode())
    crs = crs_of(image.extent, "a world file")
    return (world, prj(name, crs)) if crs else (world,)
