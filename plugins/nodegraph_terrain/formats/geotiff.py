"""GeoTIFF: rasters as float32 and pictures as they are, deflated without loss, with place and system."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph import File
from nodegraph_terrain.formats.place import crs_of
from nodegraph_terrain.georeference import gdal, transform_of
from nodegraph_terrain.raster import Grid, Image, Raster


def write_raster(surface: Raster, name: str) -> File:
    """Write a raster; a void is NaN."""
    return File.of(name, _geotiff(surface, surface.data[None], nodata=float("nan"), predictor=3, units=surface.unit))


def write_image(image: Image, name: str, *, world_file: bool = False) -> File:
    """Write a picture.  It says itself where it lies, `world_file` or not."""
    del world_file
    profile: dict[str, Any] = {"photometric": "RGB", "predictor": 2}
    if image.data.shape[2] == 4:
        profile["alpha"] = "NON-PREMULTIPLIED"
    return File.of(name, _geotiff(image, np.moveaxis(image.data, 2, 0), **profile))


def _geotiff(grid: Grid, bands: npt.NDArray[Any], *, units: str = "", **profile: Any) -> bytes:
    """Return the bytes of a deflated, tiled GeoTIFF of bands (count, rows, columns)."""
    rows, cols = grid.shape
    crs = crs_of(grid.extent, "a GeoTIFF")
    if max(rows, cols) > 256:
        profile |= {"tiled": True, "blockxsize": 256, "blockysize": 256}
    with gdal() as rasterio, rasterio.MemoryFile() as memory:
        with memory.open(
            driver="GTiff", width=cols, height=rows, count=len(bands), dtype=bands.dtype.name, crs=crs,
            transform=transform_of(grid.extent, rows, cols), compress="deflate", zlevel=6, BIGTIFF="IF_SAFER",
            **profile,
        ) as dataset:  # fmt: skip
            dataset.write(bands)
            dataset.update_tags(AREA_OR_POINT="Area")
            if units not in ("", "1"):
                dataset.units = (units,)
        return bytes(memory.read())
