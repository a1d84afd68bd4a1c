"""Opening one elevation file of any format: its outline from the header, then its heights, rows by rows."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.forecasts import Outline
from nodegraph_terrain.georeference import extent_from_transform, extent_of, gdal, horizontal, parse_crs, stated
from nodegraph_terrain.raster import Extent
from nodegraph_terrain.sidecar import Codes, Sidecar, beside

Rows = Callable[[slice], npt.NDArray[np.float32]]
VerticalUnit = Literal["auto", "m", "ft", "us-ft"]

RAW_TYPES = {".r16": "u2", ".raw": "u2", ".r32": "f4"}
PICTURES = ("PNG", "JPEG", "BMP", "GIF", "WEBP", "TGA", "SGI", "PNM", "XPM")
"""GDAL drivers of picture formats: their numbers are brightness, so a height range must be known."""

_METRES = {
    1.0: ("", "m", "metre", "metres", "meter", "meters"),
    0.3048: ("ft", "foot", "feet", "international foot", "intl foot"),
    1200 / 3937: (
        "us-ft",
        "us_ft",
        "usft",
        "ftus",
        "us survey foot",
        "us_survey_foot",
        "survey foot",
        "sfoot",
        "foot_us",
    ),
    0.01: ("cm", "centimetre", "centimeter"),
    0.001: ("mm", "millimetre", "millimeter"),
    1000.0: ("km", "kilometre", "kilometer"),
}
_FACTORS = {name: factor for factor, names in _METRES.items() for name in names}


@dataclass(frozen=True, slots=True)
class Options:
    """What the parameters of terrain.load_elevation state, for every file alike."""

    band: int = 1
    minimum: float | None = None
    maximum: float | None = None
    rows: int | None = None
    columns: int | None = None
    byte_order: Literal["little", "big"] = "little"
    extent: tuple[float, float, float, float] | None = None
    cell_size: float | None = None
    crs: str = ""
    nodata: float | None = None
    vertical_unit: VerticalUnit = "auto"

    @property
    def range(self) -> tuple[float, float] | None:
        """The stated height range."""
        if self.minimum is None and self.maximum is None:
            return None
        if self.minimum is None or self.maximum is None or self.maximum < self.minimum:
            raise ValueError("minimum and maximum state a height range together; give both, minimum first")
        return self.minimum, self.maximum

    def factor(self, unit: str, name: str) -> float:
        """Return the metres that one unit of the file's values is."""
        if self.vertical_unit != "auto":
            unit = self.vertical_unit
        factor = _FACTORS.get(unit.strip().lower())
        if factor is None:
            raise ValueError(
                f"'{name}' has values in '{unit}', which is no length; state vertical_unit to read heights"
            )
        return factor


@dataclass(frozen=True, slots=True)
class Opened:
    """An open file: what it covers, how many bytes a cell has in it, and how to read some of its rows as metres."""

    outline: Outline
    cell_bytes: int
    read: Rows


@contextmanager
def opened(path: Path, options: Options) -> Iterator[Opened]:
    """Open an elevation file of any format and yield what is in it.

    Raises:
        FileNotFoundError, PermissionError: there is no such file, or it may not be read.
        ValueError: it holds no heights that can be read, or too little is known of it; the sentence says what helps.
    """
    head = _head(path)
    suffix = path.suffix.lower()
    if suffix in RAW_TYPES:
        yield _raw(path, options, np.dtype(RAW_TYPES[suffix]))
    elif suffix == ".npy":
        yield _npy(path, options)
    elif suffix in (".h5", ".hdf5") and _is_own_hdf5(path):
        with _hdf5(path, options) as found:
            yield found
    else:
        if head.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"<", b"{"):
            raise ValueError(f"'{path.name}' only describes data kept in other files; load those files themselves")
        with _gdal_raster(path, options) as found:
            yield found


def _head(path: Path) -> bytes:
    if path.is_dir():
        raise ValueError(f"'{path}' is a folder; name the file in it")
    if not path.is_file():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    with path.open("rb") as file:
        head = file.read(512)
    if not head:
        raise ValueError(f"'{path.name}' is empty; expected a raster of heights")
    return head


# Formats without a header of their own.


def _raw(path: Path, options: Options, dtype: np.dtype[Any]) -> Opened:
    known = beside(path)
    rows = options.rows or (known.rows if known else None)
    columns = options.columns or (known.columns if known else None)
    size = path.stat().st_size
    if rows is None or columns is None:
        side = round((size / dtype.itemsize) ** 0.5)
        hint = f" (its size fits {side} x {side})" if side * side * dtype.itemsize == size else ""
        raise ValueError(f"'{path.name}' does not say its shape; state rows and columns{hint}")
    if rows * columns * dtype.itemsize != size:
        raise ValueError(
            f"'{path.name}' has {size:,} bytes, but {rows} x {columns} cells of {dtype.itemsize} bytes are "
            f"{rows * columns * dtype.itemsize:,}; state the right rows and columns"
        )
    ordered = dtype.newbyteorder("<" if options.byte_order == "little" else ">")
    cells = np.memmap(path, ordered, "r", shape=(rows, columns))
    codes = _codes(path.name, dtype, options, known)
    if codes is None and dtype.kind == "u":
        raise ValueError(
            f"'{path.name}' holds 16-bit codes; state minimum and maximum, the heights of code 0 and 65535"
        )
    return _array(path, options, cells, codes, known)


def _npy(path: Path, options: Options) -> Opened:
    try:
        cells = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError):
        raise ValueError(f"'{path.name}' is no complete .npy file of numbers; save it again with numpy.save") from None
    if not isinstance(cells, np.ndarray) or cells.ndim != 2 or 0 in cells.shape or cells.dtype.kind not in "iuf":
        raise ValueError(f"'{path.name}' holds {_describe(cells)}; expected a two-dimensional array of real numbers")
    known = beside(path)
    return _array(path, options, cells, _codes(path.name, cells.dtype, options, known), known)


def _describe(cells: Any) -> str:
    return f"an array of shape {cells.shape} and type {cells.dtype}" if isinstance(cells, np.ndarray) else "an archive"


def _array(path: Path, options: Options, cells: npt.NDArray[Any], codes: Codes | None, known: Sidecar | None) -> Opened:
    factor = options.factor(_unit(known), path.name)
    rows, cols = cells.shape
    _check_shape(path, known, rows, cols)
    extent = _extent(path.name, rows, cols, known.extent if known else None, options)

    def read(part: slice) -> npt.NDArray[np.float32]:
        return _heights(np.asarray(cells[part]), None, options.nodata, codes, 1.0, 0.0, factor)

    return Opened(Outline(rows, cols, extent), cells.dtype.itemsize, read)


def _check_shape(path: Path, known: Sidecar | None, rows: int, cols: int) -> None:
    if known is not None and (known.rows, known.columns) != (rows, cols):
        raise ValueError(
            f"'{path.name}' has {rows} x {cols} cells, but its sidecar '{path.name}.json' says {known.rows} x "
            f"{known.columns}; remove the sidecar or save the file again"
        )


def _unit(known: Sidecar | None) -> str:
    """Return the unit that a sidecar gives; a plain number (a mask, say) counts as metres."""
    return known.unit if known is not None and known.unit != "1" else ""


def _codes(name: str, dtype: np.dtype[Any], options: Options, known: Sidecar | None) -> Codes | None:
    """Return how the integers of a file stand for heights, or None where its numbers are heights as they are."""
    if options.range is None:
        return known.codes if known else None
    if dtype.kind != "u":
        raise ValueError(f"'{name}' holds heights as {dtype}; minimum and maximum apply to unsigned integers only")
    return Codes(*options.range, low=0, high=int(np.iinfo(dtype).max))


# HDF5 as terrain.save_elevation writes it.


def _is_own_hdf5(path: Path) -> bool:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return str(file.attrs.get("format", "")).startswith("nodegraph-raster/")
    except (OSError, KeyError, RuntimeError, ValueError):
        raise ValueError(f"'{path.name}' is no complete HDF5 file; it may be cut short") from None


@contextmanager
def _hdf5(path: Path, options: Options) -> Iterator[Opened]:
    import h5py

    with h5py.File(path, "r") as file:
        try:
            cells, attributes = file["data"], dict(file.attrs)
            west, south, east, north = (float(attributes[name]) for name in ("west", "south", "east", "north"))
            found = Extent(west, south, east, north, str(attributes["crs"]), str(attributes["extent_unit"]))
            rows, cols = cells.shape
            unit = str(attributes["unit"])
        except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError):
            raise ValueError(f"'{path.name}' is damaged; save it again with terrain.save_elevation") from None
        factor = options.factor("" if unit == "1" else unit, path.name)

        def read(part: slice) -> npt.NDArray[np.float32]:
            try:
                values = cells[part]
            except (OSError, RuntimeError):
                raise _damaged(path) from None
            return _heights(values, None, options.nodata, None, 1.0, 0.0, factor)

        extent = _extent(path.name, rows, cols, found, options)
        yield Opened(Outline(rows, cols, extent), int(cells.dtype.itemsize), read)


# Everything that GDAL reads.


@contextmanager
def _gdal_raster(path: Path, options: Options) -> Iterator[Opened]:
    with gdal() as rasterio:
        from rasterio.errors import RasterioError

        try:
            dataset = rasterio.open(path)
        except RasterioError:
            raise _unreadable(path) from None
        with dataset:
            yield _described(path, options, dataset)


def _described(path: Path, options: Options, dataset: Any) -> Opened:
    name, band = path.name, options.band
    if dataset.count == 0:
        inner = ", ".join(item.rsplit(":", 1)[-1] for item in dataset.subdatasets[:4]) or "none"
        raise ValueError(
            f"'{name}' holds several datasets ({inner}); save the one with the heights as a file of its own"
        )
    if band > dataset.count:
        raise ValueError(
            f"'{name}' has {dataset.count} band{'s' * (dataset.count > 1)}; band {band} is not one of them"
        )
    dtype = np.dtype(dataset.dtypes[band - 1])
    if dtype.kind not in "iuf":
        raise ValueError(f"'{name}' holds numbers of type {dtype}; expected real numbers")
    if dtype == np.uint8 and (dataset.colorinterp[band - 1].name == "palette" or dataset.count >= 3):
        raise ValueError(f"'{name}' is a colour picture; heights need one band of 16-bit or real numbers")
    known = beside(path) if dataset.driver in PICTURES else None
    codes = _codes(name, dtype, options, known)
    if codes is None and dataset.driver in PICTURES:
        raise ValueError(f"'{name}' does not say its heights; state minimum and maximum, those of black and white")
    rows, cols = int(dataset.height), int(dataset.width)
    crs, vertical = horizontal(dataset.crs)
    found, upside_down, mirrored = None, False, False
    if not dataset.transform.is_identity:
        try:
            found, upside_down, mirrored = extent_from_transform(dataset.transform, rows, cols, crs)
        except ValueError as error:
            raise ValueError(f"'{name}': {error}" if "coordinates" in str(error) else f"'{name}' {error}") from None
    elif dataset.gcps[0] and options.extent is None:
        raise ValueError(f"'{name}' is placed by control points only; give it a regular grid first, with gdalwarp")
    _check_shape(path, known, rows, cols)
    extent = _extent(name, rows, cols, known.extent if known else found, options)
    factor = options.factor(_unit(known) or dataset.units[band - 1] or vertical, name)
    scale, offset = float(dataset.scales[band - 1]), float(dataset.offsets[band - 1])

    def read(part: slice) -> npt.NDArray[np.float32]:
        from rasterio.errors import RasterioError
        from rasterio.windows import Window

        first, last = (rows - part.stop, rows - part.start) if upside_down else (part.start, part.stop)
        try:
            cells = dataset.read(band, window=Window(0, first, cols, last - first), masked=True)
        except RasterioError:
            raise _damaged(path) from None
        values, missing = np.asarray(cells.data), np.ma.getmaskarray(cells)
        flips = (slice(None, None, -1 if upside_down else 1), slice(None, None, -1 if mirrored else 1))
        return _heights(values[flips], missing[flips], options.nodata, codes, scale, offset, factor)

    return Opened(Outline(rows, cols, extent), dtype.itemsize + 1, read)


def _unreadable(path: Path) -> ValueError:
    if path.suffix.lower() == ".hgt":
        return ValueError(
            f"'{path.name}' is no SRTM tile: its name must give its south-west corner, such as N27E086.hgt, and it "
            "must have 1201 x 1201 or 3601 x 3601 heights of 2 bytes"
        )
    return ValueError(
        f"'{path.name}' is no raster that can be read; expected GeoTIFF, .hgt, .dem, .asc, 16-bit PNG, .npy, .r16, "
        ".r32, .h5 or another format of GDAL"
    )


def _damaged(path: Path) -> ValueError:
    return ValueError(f"'{path.name}' is damaged or cut short; get it again")


# What all formats share.


def _heights(
    values: npt.NDArray[Any],
    missing: npt.NDArray[np.bool_] | None,
    nodata: float | None,
    codes: Codes | None,
    scale: float,
    offset: float,
    factor: float,
) -> npt.NDArray[np.float32]:
    """Return what stands in a file as heights in metres; no data and infinities become NaN."""
    if nodata is not None:
        unknown = values == nodata
        missing = unknown if missing is None else missing | unknown
    if codes is not None:
        heights = codes.decode(values)
    elif scale == 1.0 and offset == 0.0 and values.dtype.itemsize <= 4:
        heights = values.astype(np.float32)
    else:
        with np.errstate(over="ignore", invalid="ignore"):
            heights = (values.astype(np.float64) * scale + offset).astype(np.float32)
    if factor != 1.0:
        heights *= np.float32(factor)
    if values.dtype.kind == "f":
        heights[~np.isfinite(heights)] = np.nan
    if missing is not None:
        heights[missing] = np.nan
    return heights


def _extent(name: str, rows: int, cols: int, found: Extent | None, options: Options) -> Extent:
    """Return where a raster lies: as stated, else as found in the file."""
    if options.extent is not None:
        crs = options.crs or (found.crs if found else "")
        try:
            return extent_of(*options.extent, horizontal(parse_crs(crs))[0] if crs else None)
        except ValueError as error:
            raise ValueError(f"'{name}': {error}") from None
    if found is not None:
        if options.crs:
            return stated(found, options.crs)
        if not found.crs and found.unit == "m" and _looks_like_degrees(found, cols):
            raise ValueError(
                f"'{name}' seems to be in degrees but has no coordinate reference system; state crs, such as EPSG:4326"
            )
        return found
    if options.cell_size is not None:
        extent = Extent(0.0, 0.0, cols * options.cell_size, rows * options.cell_size)
        if options.crs and (extent := stated(extent, options.crs)).unit != "m":
            raise ValueError(
                f"'{name}' cannot be placed by cell_size in degrees; state extent (west, south, east, north)"
            )
        return extent
    raise ValueError(
        f"'{name}' has no georeference; state cell_size (m), or extent (west, south, east, north) with crs"
    )


def _looks_like_degrees(extent: Extent, cols: int) -> bool:
    edges = (extent.west, extent.east, extent.south, extent.north)
    return max(map(abs, edges)) <= 360 and extent.width / cols < 0.05
