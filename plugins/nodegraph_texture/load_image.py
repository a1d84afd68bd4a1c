"""Pictures of the ground, and bands of them, brought onto the grid of an elevation model."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, InputFile, Param, node, whole
from nodegraph_terrain.georeference import gdal, parse_crs, transform_of
from nodegraph_terrain.raster import Elevation, Extent, Image
from nodegraph_texture.quantities import Other

Resampling = Literal["nearest", "bilinear", "cubic", "average"]
Edges = tuple[float, float, float, float]

FILE = InputFile(sidecars=(".prj", ".tfw", ".jgw", ".pgw", ".wld", "*.aux.xml", "*.msk", "*.ovr", ".hdr"))
RESAMPLING = Param("How values between pixels are taken; the ground's cells may be finer or coarser.")
EXTENT = Param("Outer edges (west, south, east, north), for files that do not say or say it wrong.")
CRS = Param("Coordinate reference system, for files that do not say or say it wrong.")

_BLOCK = 1 << 20
_PLAIN = "EPSG:3857"
"""Stands for plain metres on both sides, where neither has a system."""


@node(version=1, locality=whole)
def load_image(
    grid: Elevation,
    *,
    path: Annotated[Path, Param("Any raster that GDAL reads."), FILE],
    bands: Annotated[
        tuple[int, int, int] | tuple[int] | None,
        Param("Red, green and blue, or one for grey, counted from 1; none: as the file says."),
    ] = None,
    resampling: Annotated[Resampling, RESAMPLING] = "bilinear",
    range: Annotated[
        tuple[float, float] | None, Param("Values that become black and white; needed unless the file has 8 bits.")
    ] = None,
    extent: Annotated[Edges | None, EXTENT] = None,
    crs: Annotated[str, CRS] = "",
    context: Context,
) -> Image:
    """Load a picture onto the grid of an elevation model, reprojected where it has another system.

    Each cell takes the value at its centre (``nearest``, ``bilinear`` or ``cubic`` between pixels); where cells are
    larger than pixels the kernels widen with them, so nothing is skipped, and ``average`` is the plain mean.  Cells
    outside of the picture, and those without data in it (no-data values, masks, alpha), are transparent black.

    A palette is resolved (with the nearest pixel, as colours are no numbers).  A file of one band is grey.  Codes of 8
    bits are taken as they are; anything else needs `range`, and values beyond it become black or white.

    Args:
        grid: elevation whose grid the picture is brought to.
        path: the file.
        bands: which bands are red, green and blue.
        resampling: between pixels.
        range: values of black and white.
        extent: where the picture lies, in `crs`.
        crs: system of the picture; for a picture and a grid without any, both are plain metres.
        context: the engine's.

    Returns:
        sRGB with alpha, of the grid of the elevation.

    Raises:
        FileNotFoundError, PermissionError: there is no such file, or it may not be read.
        ValueError: the file is no raster, has no such band, no georeference, or no system where the elevation has one;
            the picture and the elevation do not overlap; or it shows nothing there.

    Reference: GDAL raster drivers and warper, https://gdal.org.
    """
    with _opened(path) as dataset:
        numbers = _colour_bands(dataset, bands, path.name)
        palette = _palette(dataset, numbers)
        low, high = _range(dataset, numbers, range, path.name)
        cells = _warped(dataset, path.name, grid.extent, grid.shape, resampling if palette is None else "nearest",
                        numbers, extent, crs, context)  # fmt: skip
    values, alpha = cells[:-1], cells[-1]
    pixels = np.empty((*grid.shape, 4), np.uint8)
    pixels[..., 3] = np.where(np.isnan(values).any(axis=0), 0, np.clip(np.rint(alpha), 0, 255))
    if not pixels[..., 3].any():
        raise ValueError(f"'{path.name}' holds no data on the ground of the elevation; give another picture")
    if palette is not None:
        entries = palette[np.where(np.isnan(values[0]), 0, values[0]).astype(np.intp)]
        pixels[..., :3] = entries[..., :3]
        pixels[..., 3] = np.minimum(pixels[..., 3], entries[..., 3])
    else:
        with np.errstate(invalid="ignore"):
            codes = np.clip(np.rint((values - low) * (255 / (high - low))), 0, 255)
        pixels[..., :3] = np.moveaxis(np.nan_to_num(codes).astype(np.uint8), 0, 2)
    pixels[pixels[..., 3] == 0] = 0
    return Image(pixels, grid.extent)


@node(version=1, locality=whole)
def load_band(
    grid: Elevation,
    *,
    path: Annotated[Path, Param("Any raster that GDAL reads."), FILE],
    name: Annotated[str, Param("Of the quantity, such as near_infrared.")],
    band: Annotated[int, Param("Which band, counted from 1.", ge=1)] = 1,
    resampling: Annotated[Resampling, RESAMPLING] = "bilinear",
    extent: Annotated[Edges | None, EXTENT] = None,
    crs: Annotated[str, CRS] = "",
    context: Context,
) -> Other:
    """Load one band of a raster onto the grid of an elevation model: infrared, rainfall, or any other quantity.

    Values are those of the file, with its scale and offset applied; see `load_image` for the rest.  Cells outside of
    the raster or without data are void.

    Args:
        grid: elevation whose grid the band is brought to.
        path: the file.
        name: of the quantity.
        band: which one.
        resampling: between pixels.
        extent: where the raster lies, in `crs`.
        crs: system of the raster.
        context: the engine's.

    Raises:
        FileNotFoundError, PermissionError, ValueError: as of `load_image`.
    """
    with _opened(path) as dataset:
        _require_bands(dataset, (band,), path.name)
        scale, offset = dataset.scales[band - 1], dataset.offsets[band - 1]
        values, alpha = _warped(
            dataset, path.name, grid.extent, grid.shape, resampling, (band,), extent, crs, context
        )  # fmt: skip
    values = np.where((alpha < 128) | ~np.isfinite(values), np.float32(np.nan), values)
    if np.isnan(values).all():
        raise ValueError(f"'{path.name}' holds no data on the ground of the elevation; give another raster")
    return Other((values * scale + offset).astype(np.float32), grid.extent, name)


@load_image.forecast
def _forecast(grid: Forecast, **_: object) -> Forecast:
    return Forecast(grid.bytes, 6 * grid.bytes + (64 << 20), grid.about)


@load_band.forecast
def _forecast_band(grid: Forecast, **_: object) -> Forecast:
    return Forecast(grid.bytes, 4 * grid.bytes + (64 << 20), grid.about)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    if path.is_dir():
        raise ValueError(f"'{path}' is a folder; name the file in it")
    if not path.is_file():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    with gdal() as rasterio:
        from rasterio.errors import RasterioIOError

        try:
            with rasterio.open(path) as dataset:
                yield dataset
        except (RasterioIOError, rasterio._err.CPLE_BaseError) as error:
            raise ValueError(f"'{path.name}' cannot be read as a raster ({str(error).splitlines()[0]})") from error


def _require_bands(dataset: Any, numbers: Sequence[int], name: str) -> None:
    wrong = [number for number in numbers if not 1 <= number <= dataset.count]
    if wrong:
        raise ValueError(f"'{name}' has no band {wrong[0]}; it has {dataset.count}, counted from 1")


def _colour_bands(dataset: Any, bands: tuple[int, ...] | None, name: str) -> tuple[int, ...]:
    if bands is not None:
        _require_bands(dataset, bands, name)
        return bands
    said = [colour.name for colour in dataset.colorinterp]
    if {"red", "green", "blue"} <= set(said):
        return tuple([said.index(colour) + 1 for colour in ("red", "green", "blue")])
    return (1, 2, 3) if dataset.count >= 3 else (1,)


def _palette(dataset: Any, numbers: tuple[int, ...]) -> npt.NDArray[np.uint8] | None:
    """Return the (256, 4) colours of a palette, or None where values are brightness."""
    if len(numbers) > 1 or dataset.colorinterp[numbers[0] - 1].name != "palette":
        return None
    table = np.zeros((256, 4), np.uint8)
    for code, colour in dataset.colormap(numbers[0]).items():
        if code < 256:
            table[code] = colour
    return table


def _range(
    dataset: Any, numbers: Sequence[int], stated: Edges | tuple[float, float] | None, name: str
) -> tuple[float, float]:
    if stated is not None:
        if not stated[0] < stated[1]:
            raise ValueError(f"range {list(stated)} must rise: the value of black, then that of white")
        return stated[0], stated[1]
    kind = dataset.dtypes[numbers[0] - 1]
    if kind != "uint8":
        raise ValueError(f"'{name}' holds {kind}, not codes of 8 bits; state range, the values of black and white")
    return 0.0, 255.0


def _warped(
    dataset: Any, name: str, extent: Extent, shape: tuple[int, int], method: str, numbers: tuple[int, ...],
    edges: Edges | None, crs: str, context: Context,
) -> npt.NDArray[np.float32]:  # fmt: skip
    """Return bands and, last, alpha (0 to 255) on the grid that an extent and a shape give."""
    from rasterio.enums import Resampling as Methods
    from rasterio.errors import CRSError, RasterioError
    from rasterio.vrt import WarpedVRT
    from rasterio.windows import Window

    rows, columns = shape
    gcps, gcp_crs = dataset.gcps
    placed = bool(gcps) or not dataset.transform.is_identity or edges is not None
    if not placed:
        raise ValueError(f"'{name}' does not say where it lies; state extent (west, south, east, north) and crs")
    source = parse_crs(crs) if crs else dataset.crs or gcp_crs
    if not source and extent.crs:
        raise ValueError(f"'{name}' has no coordinate reference system, and the elevation has; state crs")
    if source and not extent.crs:
        raise ValueError(
            f"the elevation has no coordinate reference system, and '{name}' has; state it where it is loaded"
        )
    target = parse_crs(extent.crs or _PLAIN)
    given: dict[str, Any] = {"src_crs": source or target}
    if edges is not None:
        if not (edges[0] < edges[2] and edges[1] < edges[3]):
            raise ValueError(f"extent {list(edges)} must read west, south, east, north")
        given["src_transform"] = transform_of(Extent(*edges), dataset.height, dataset.width)
    options = {"crs": target, "transform": transform_of(extent, rows, columns), "width": columns, "height": rows}
    cells = np.empty((len(numbers) + 1, rows, columns), np.float32)
    _require_overlap(dataset, name, given, target, extent)
    has_alpha = any(colour.name == "alpha" for colour in dataset.colorinterp)
    try:
        with WarpedVRT(dataset, resampling=Methods[method], add_alpha=not has_alpha, **given, **options) as warped:
            alpha = [colour.name for colour in warped.colorinterp].index("alpha") + 1
            step = max(1, _BLOCK // columns)
            for top in range(0, rows, step):
                context.progress(top / rows)
                part = Window(0, top, columns, min(step, rows - top))
                cells[:, top : top + step] = warped.read([*numbers, alpha], window=part)
    except (CRSError, RasterioError) as error:
        raise ValueError(f"'{name}' cannot be brought to the grid of the elevation ({error})") from error
    # Alpha has the full range of the file's numbers.
    kinds = np.dtype(dataset.dtypes[0])
    if kinds.kind in "iu" and kinds != np.uint8:
        cells[-1] *= 255 / np.iinfo(kinds).max
    elif kinds.kind == "f":
        cells[-1] = np.where(cells[-1] > 0, 255, 0)
    context.progress(1.0)
    return cells


def _require_overlap(dataset: Any, name: str, given: dict[str, Any], target: Any, extent: Extent) -> None:
    from rasterio.errors import CRSError, RasterioError
    from rasterio.transform import array_bounds
    from rasterio.warp import transform_bounds

    if dataset.gcps[0] and "src_transform" not in given:
        return
    bounds = array_bounds(dataset.height, dataset.width, given.get("src_transform", dataset.transform))
    try:
        west, south, east, north = transform_bounds(given["src_crs"], target, *bounds, densify_pts=21)
    except (CRSError, RasterioError):
        return
    if not (west < extent.east and east > extent.west and south < extent.north and north > extent.south):
        here = [round(edge, 4) for edge in (extent.west, extent.south, extent.east, extent.north)]
        there = [round(edge, 4) for edge in (west, south, east, north)]
        raise ValueError(
            f"'{name}' and the elevation do not overlap: in the elevation's system the image covers {there} (west, "
            f"south, east, north), the elevation {here}; give a picture of the same ground"
        )
