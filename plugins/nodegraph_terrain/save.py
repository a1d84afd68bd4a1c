"""Rasters and images as files."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import PurePosixPath
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import File, OutputName, Param, node, whole
from nodegraph_terrain.georeference import gdal, parse_crs, transform_of
from nodegraph_terrain.raster import Extent, Grid, Image, Raster
from nodegraph_terrain.sidecar import Codes, Sidecar

Range = tuple[float | None, float | None]


@node(version=1, locality=whole)
def save_elevation(
    surface: Raster,
    *,
    name: Annotated[OutputName, Param("File to write; the suffix is the format: tif, png, r16, r32, asc, npy or h5.")],
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

    The same raster gives the same bytes on every run.

    Raises:
        ValueError: the suffix names no format, a height lies outside of the stated range, every cell is void in a
            16-bit format without a stated range, or the format cannot hold the georeference.
    """
    suffix = PurePosixPath(name).suffix.lower()
    writer = _WRITERS.get(suffix)
    if writer is None:
        raise ValueError(f"'{name}' ends in '{suffix}'; choose one of {', '.join(_WRITERS)}")
    if (minimum is not None or maximum is not None) and writer not in (_png16, _r16):
        raise ValueError(f"'{name}' keeps heights as they are; minimum and maximum are for .png and .r16 only")
    return writer(surface, name, (minimum, maximum))


@node(version=1, locality=whole)
def save_image(
    image: Image,
    *,
    name: Annotated[OutputName, Param("File to write; the suffix is the format: png or tif.")],
    world_file: Annotated[bool, Param("Place a PNG on the map, by a world file (.pgw) and .prj beside it.")] = False,
) -> File:
    """Write a colour picture to a file: ``.png`` (sRGB) or ``.tif`` (GeoTIFF with extent and coordinate system).

    Three channels are red, green, blue; a fourth is straight alpha.  Both formats keep every value.  The same picture
    gives the same bytes on every run.

    Raises:
        ValueError: the suffix names neither format.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix in (".tif", ".tiff"):
        profile: dict[str, Any] = {"photometric": "RGB", "predictor": 2}
        if image.data.shape[2] == 4:
            profile["alpha"] = "NON-PREMULTIPLIED"
        return File.of(name, _geotiff(image, np.moveaxis(image.data, 2, 0), **profile))
    if suffix != ".png":
        raise ValueError(f"'{name}' ends in '{suffix}'; choose .png or .tif")
    sidecars = _world_file(name, image) if world_file else ()
    return File.of(name, png(image.data), *sidecars)


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


# One writer per format.


def _tif(surface: Raster, name: str, _: Range) -> File:
    return File.of(name, _geotiff(surface, surface.data[None], nodata=float("nan"), predictor=3, units=surface.unit))


def _geotiff(grid: Grid, bands: npt.NDArray[Any], *, units: str = "", **profile: Any) -> bytes:
    """Return the bytes of a deflated, tiled GeoTIFF of bands (count, rows, columns)."""
    rows, cols = grid.shape
    crs = _crs(grid.extent, "a GeoTIFF")
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


def _codes(surface: Raster, name: str, stated: Range) -> Codes:
    missing = np.isnan(surface.data)
    known = surface.data[~missing]
    if len(known):
        lowest, highest = float(known.min()), float(known.max())
    elif None in stated:
        raise ValueError(f"every cell is void, so '{name}' has no height range; state minimum and maximum")
    else:
        lowest, highest = float(stated[0] or 0.0), float(stated[1] or 0.0)
    minimum = lowest if stated[0] is None else float(stated[0])
    maximum = highest if stated[1] is None else float(stated[1])
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        raise ValueError(f"the raster holds infinite values, which '{name}' cannot; link it through terrain.clamp")
    if minimum > lowest or maximum < highest or minimum > maximum:
        raise ValueError(
            f"heights from {lowest:g} to {highest:g} do not fit the range {minimum:g} to {maximum:g} of '{name}'; "
            "widen it, or link the raster through terrain.clamp"
        )
    return Codes(minimum, maximum, 1, 65535, 0) if missing.any() else Codes(minimum, maximum)


def _with_sidecar(name: str, content: bytes, sidecar: Sidecar) -> File:
    return File.of(name, content, File.of(f"{name}.json", sidecar.to_bytes()))


def _png16(surface: Raster, name: str, stated: Range) -> File:
    codes = _codes(surface, name, stated)
    return _with_sidecar(name, png(codes.encode(surface.data)), Sidecar.of(surface, "uint16", codes))


def _r16(surface: Raster, name: str, stated: Range) -> File:
    codes = _codes(surface, name, stated)
    content = codes.encode(surface.data).astype("<u2").tobytes()
    return _with_sidecar(name, content, Sidecar.of(surface, "uint16", codes))


def _r32(surface: Raster, name: str, _: Range) -> File:
    return _with_sidecar(name, surface.data.astype("<f4").tobytes(), Sidecar.of(surface, "float32"))


def _npy(surface: Raster, name: str, _: Range) -> File:
    buffer = BytesIO()
    np.lib.format.write_array(buffer, surface.data.astype("<f4", order="C"), version=(1, 0), allow_pickle=False)
    return _with_sidecar(name, buffer.getvalue(), Sidecar.of(surface, "float32"))


def _asc(surface: Raster, name: str, _: Range) -> File:
    crs = _crs(surface.extent, "an ESRI ASCII grid")
    dx, dy = surface.cell_size
    known = surface.data[~np.isnan(surface.data)]
    lowest = float(known.min()) if len(known) else 0.0
    # Readers compare with the void value up to a few roundings: it stays well below every height.
    nodata = next((number for number in (-9999.0, -99999.0, -3.4e38) if lowest > number * (1 - 1e-4)), None)
    if nodata is None or not np.isfinite(known).all():
        raise ValueError(f"'{name}' cannot hold such heights (from {lowest:g}) beside a void value; choose .tif")
    square = abs(dx - dy) <= 1e-12 * dx
    rows, cols = surface.shape
    header = [
        f"ncols {cols}",
        f"nrows {rows}",
        f"xllcorner {surface.extent.west!r}",
        f"yllcorner {surface.extent.south!r}",
    ]
    header += [f"cellsize {dx!r}"] if square else [f"dx {dx!r}", f"dy {dy!r}"]
    # Readers take a grid whose first numbers look whole for integers: the void value is written as a real number.
    header += [f"NODATA_value {nodata!r}", ""]
    buffer = BytesIO("\n".join(header).encode())
    buffer.seek(0, 2)
    values = np.where(np.isnan(surface.data), np.float32(nodata), surface.data)
    for row in values.tolist():
        buffer.write(" ".join([f"{value:.9g}" for value in row]).encode() + b"\n")
    text = buffer.getvalue()
    sidecars = (_prj(name, crs),) if crs else ()
    return File.of(name, text, *sidecars)


def _h5(surface: Raster, name: str, _: Range) -> File:
    import h5py

    buffer = BytesIO()
    extent = surface.extent
    with h5py.File(buffer, "w", libver="v110") as file:
        file.create_dataset(
            "data", data=surface.data, dtype="<f4", chunks=True, compression="gzip", compression_opts=4, shuffle=True,
            fletcher32=True, track_times=False,
        )  # fmt: skip
        file.attrs["format"] = "nodegraph-raster/1"
        file.attrs["role"] = type(surface).__name__
        file.attrs["unit"] = surface.unit
        for edge in ("west", "south", "east", "north"):
            file.attrs[edge] = float(getattr(extent, edge))
        file.attrs["crs"] = extent.crs
        file.attrs["extent_unit"] = extent.unit
    return File.of(name, buffer.getvalue())


_WRITERS: dict[str, Callable[[Raster, str, Range], File]] = {
    ".tif": _tif,
    ".tiff": _tif,
    ".png": _png16,
    ".r16": _r16,
    ".r32": _r32,
    ".asc": _asc,
    ".npy": _npy,
    ".h5": _h5,
    ".hdf5": _h5,
}


# Georeference beside a file.


def _crs(extent: Extent, what: str) -> Any:
    """Return the rasterio CRS of an extent, or None where it has none."""
    if extent.crs:
        return parse_crs(extent.crs)
    if extent.unit == "deg":
        raise ValueError(f"the raster is in degrees without a coordinate system, which {what} cannot say; choose .h5")
    return None


def _prj(name: str, crs: Any) -> File:
    text = crs.to_wkt(version="WKT1_ESRI")
    return File.of(str(PurePosixPath(name).with_suffix(".prj")), text.encode())


def _world_file(name: str, image: Image) -> tuple[File, ...]:
    dx, dy = image.cell_size
    lines = (dx, 0.0, 0.0, -dy, image.extent.west + dx / 2, image.extent.north - dy / 2)
    world = File.of(str(PurePosixPath(name).with_suffix(".pgw")), "".join(f"{line!r}\n" for line in lines).encode())
    crs = _crs(image.extent, "a world file")
    return (world, _prj(name, crs)) if crs else (world,)
