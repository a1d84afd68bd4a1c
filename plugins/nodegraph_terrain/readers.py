"""Opening one elevation file of any format: its outline from the head, then its heights in metres, rows by rows."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from nodegraph.formats import Format
from nodegraph.plugins import registry
from nodegraph_terrain.forecasts import Outline
from nodegraph_terrain.formats.contents import Contents
from nodegraph_terrain.georeference import extent_of, horizontal, parse_crs, stated
from nodegraph_terrain.raster import Elevation, Extent, Raster
from nodegraph_terrain.sidecar import Codes

Rows = Callable[[slice], npt.NDArray[np.float32]]
VerticalUnit = Literal["auto", "m", "ft", "us-ft"]

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
    """An open file: what it covers, and how to read some of its rows as metres."""

    outline: Outline
    read: Rows


def format_of(path: Path) -> Format:
    """Return the format of an elevation file, by its suffix."""
    return registry().formats().find(Elevation, path.name, "read")


@contextmanager
def opened(path: Path, options: Options) -> Iterator[Opened]:
    """Open an elevation file of any format and yield what is in it.

    Raises:
        FileNotFoundError, PermissionError: there is no such file, or it may not be read.
        ValueError: it holds no heights that can be read, or too little is known of it; the sentence says what helps.
    """
    _check_readable(path)
    chosen = format_of(path)
    function = chosen.functions("read")[0]
    given = {name: value for name, value in asdict(options).items() if name in chosen.takes("read")}
    if chosen.open is None:
        raster = function(path, **given)
        if not isinstance(raster, Raster):
            raise TypeError(
                f"the reader of {chosen.title} gave '{path.name}' as {type(raster).__name__}, not as Raster"
            )
        yield _in_metres(path.name, Contents.of(raster), options)
    else:
        with function(path, **given) as contents:
            yield _in_metres(path.name, contents, options)


def _check_readable(path: Path) -> None:
    if path.is_dir():
        raise ValueError(f"'{path}' is a folder; name the file in it")
    if not path.is_file():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    with path.open("rb") as file:
        if not file.read(1):
            raise ValueError(f"'{path.name}' is empty; expected a raster of heights")


def _in_metres(name: str, found: Contents, options: Options) -> Opened:
    """Return the contents of a file with what is stated of it applied."""
    if found.dtype.kind not in "iuf":
        raise ValueError(f"'{name}' holds numbers of type {found.dtype}; expected real numbers")
    codes = _codes(name, found, options)
    factor = options.factor(found.unit, name)
    rows, cols = found.rows, found.cols

    def read(part: slice) -> npt.NDArray[np.float32]:
        values = found.read(part)
        if values.shape != (part.stop - part.start, cols):
            raise ValueError(
                f"'{name}' gave {values.shape} cells for rows {part.start} to {part.stop} of {cols} columns"
            )
        return _heights(values, found, codes, options.nodata, factor)

    return Opened(Outline(rows, cols, _extent(name, rows, cols, found.extent, options)), read)


def _codes(name: str, found: Contents, options: Options) -> Codes | None:
    """Return how the integers of a file stand for heights, or None where its numbers are heights as they are."""
    if options.range is None:
        if found.codes is None and found.range_hint:
            raise ValueError(f"'{name}' {found.range_hint}")
        return found.codes
    if found.dtype.kind != "u":
        raise ValueError(
            f"'{name}' holds heights as {found.dtype}; minimum and maximum apply to unsigned integers only"
        )
    return Codes(*options.range, low=0, high=int(np.iinfo(found.dtype).max))


def _heights(
    cells: npt.NDArray[np.generic], found: Contents, codes: Codes | None, nodata: float | None, factor: float
) -> npt.NDArray[np.float32]:
    """Return what stands in a file as heights in metres; no data and infinities become NaN."""
    missing = np.ma.getmaskarray(cells) if isinstance(cells, np.ma.MaskedArray) else None
    values = np.asarray(cells.data if isinstance(cells, np.ma.MaskedArray) else cells)
    if nodata is not None:
        unknown = values == nodata
        missing = unknown if missing is None else missing | unknown
    if codes is not None:
        heights = codes.decode(values)
    elif found.scale == 1.0 and found.offset == 0.0 and values.dtype.itemsize <= 4:
        heights = values.astype(np.float32)
    else:
        with np.errstate(over="ignore", invalid="ignore"):
            heights = (values.astype(np.float64) * found.scale + found.offset).astype(np.float32)
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
