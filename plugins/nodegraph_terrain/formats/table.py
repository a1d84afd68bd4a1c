"""The formats of rasters and pictures, by suffix."""

from __future__ import annotations

from nodegraph import Format
from nodegraph_terrain.formats import arrays, ascii_grid, gdal_raster, geotiff, hdf5, png
from nodegraph_terrain.raster import Image, Raster

_GDAL, _JSON, _OPEN = gdal_raster.SIDECARS, ("*.json",), gdal_raster.open_raster

FORMATS = (
    Format(Raster, (".tif", ".tiff"), "GeoTIFF", open=_OPEN, write=geotiff.write_raster, sidecars=_GDAL),
    Format(Raster, (".png",), "16-bit PNG", open=_OPEN, write=png.write_codes, sidecars=_GDAL),
    Format(Raster, (".r16",), "raw 16-bit codes", open=arrays.open_r16, write=arrays.write_r16, sidecars=_JSON),
    Format(Raster, (".raw",), "raw 16-bit codes", open=arrays.open_r16, sidecars=_JSON),
    Format(Raster, (".r32",), "raw float32", open=arrays.open_r32, write=arrays.write_r32, sidecars=_JSON),
    Format(Raster, (".asc",), "ESRI ASCII grid", open=_OPEN, write=ascii_grid.write_ascii_grid, sidecars=_GDAL),
    Format(Raster, (".npy",), "NumPy array", open=arrays.open_npy, write=arrays.write_npy, sidecars=_JSON),
    Format(Raster, (".h5", ".hdf5"), "HDF5", open=hdf5.open_hdf5, write=hdf5.write_hdf5, sidecars=_GDAL),
    Format(Raster, (".hgt",), "SRTM tile", open=_OPEN, sidecars=_GDAL),
    Format(Raster, (".dem",), "USGS DEM", open=_OPEN, sidecars=_GDAL),
    Format(Raster, ("",), "any other raster of GDAL", open=_OPEN, sidecars=_GDAL),
    Format(Image, (".png",), "PNG", write=png.write_image),
    Format(Image, (".tif", ".tiff"), "GeoTIFF", write=geotiff.write_image),
)
