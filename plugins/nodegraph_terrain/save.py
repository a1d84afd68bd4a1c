"""Rasters and images as files."""

from __future__ import annotations

from typing import Annotated, Any

from nodegraph import File, OutputFile, Param, node, whole
from nodegraph.plugins import registry
from nodegraph_terrain.raster import Grid, Image, Raster


@node(version=1, locality=whole)
def save_elevation(
    surface: Raster,
    *,
    name: Annotated[
        str,
        OutputFile(type=Raster),
        Param("File to write; the suffix is the format: tif, png, r16, r32, asc, npy, h5, or a plugin's own."),
    ],
    minimum: Annotated[
        float | None, Param("Height of the lowest 16-bit code; none: the lowest height.", unit="m")
    ] = None,
    maximum: Annotated[
        float | None, Param("Height of the highest 16-bit code; none: the highest height.", unit="m")
    ] = None,
) -> File:
    """Write an elevation model, or any other raster, to a file.  terrain.load_elevation reads all of them back.

    - ``.tif``: GeoTIFF, float32, with the coordinate system; a void is NaN.  Compressed without loss.
    - ``.png``, ``.r16``: 16-bit codes, PNG or plain little-endian rows, and a sidecar ``<name>.json`` that gives the
      heights of the lowest and highest code, the void code, shape, extent and system.  A height is stored to the
      nearest of 65,536 steps (65,535 where there are voids: code 0 is then the void).  Stating `minimum` and `maximum`
      makes several tiles use the same steps.
    - ``.r32``, ``.npy``: float32 (little-endian rows, or a NumPy array), void NaN, with the same kind of sidecar.
    - ``.asc``: ESRI ASCII grid, nine digits (every float32 exactly), and a ``.prj`` with the system.
    - ``.h5``: HDF5 with the dataset ``data``, float32, void NaN, and attributes west, south, east, north, crs,
      extent_unit, unit and role.

    Plugins add formats; 'nodegraph types' lists them.  The same raster gives the same bytes on every run.

    Raises:
        ValueError: the suffix names no format, a height lies outside of the stated range, every cell is void in a
            16-bit format without a stated range, or the format cannot hold the georeference.
    """
    return _written(surface, name, "keeps heights as they are", minimum=minimum, maximum=maximum)


@node(version=1, locality=whole)
def save_image(
    image: Image,
    *,
    name: Annotated[
        str,
        OutputFile(type=Image),
        Param("File to write; the suffix is the format: png, tif, or a plugin's own."),
    ],
    world_file: Annotated[bool, Param("Place a PNG on the map, by a world file (.pgw) and .prj beside it.")] = False,
) -> File:
    """Write a colour picture to a file: ``.png`` (sRGB) or ``.tif`` (GeoTIFF with extent and coordinate system).

    Three channels are red, green, blue; a fourth is straight alpha.  Both formats keep every value.  The same picture
    gives the same bytes on every run.  Plugins add formats; 'nodegraph types' lists them.

    Raises:
        ValueError: the suffix names no format, or the format has no use for the stated world file.
    """
    return _written(image, name, "takes no world file", world_file=world_file or None)


def _written(grid: Grid, name: str, otherwise: str, **options: Any) -> File:
    """Return a grid as a file; an option that is stated and that the format does not know is refused."""
    formats = registry().formats()
    chosen = formats.find(type(grid), name, "write")
    stated = {key: value for key, value in options.items() if value is not None}
    if not stated.keys() <= chosen.takes("write"):
        usual = [item.suffixes[0] for item in formats.of(type(grid), "write") if options.keys() <= item.takes("write")]
        verb = "is" if len(options) == 1 else "are"
        raise ValueError(f"'{name}' {otherwise}; {' and '.join(options)} {verb} for {' and '.join(usual)} only")
    (write,) = chosen.functions("write")
    file: File = write(grid, name, **stated)
    return file
