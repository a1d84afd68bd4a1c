"""Elevation from files."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from nodegraph import Context, Forecast, InputFile, Param, node, whole
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.forecasts import Outline, check_cells
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.readers import Options, VerticalUnit, format_of, opened

_BLOCK = 1 << 22


@node(version=1, locality=whole)
def load_elevation(
    *,
    path: Annotated[
        Path | tuple[Path, ...],
        Param("The file with the heights, or several tiles of one grid."),
        InputFile(type=Elevation),
    ],
    band: Annotated[int, Param("Which band holds the heights.", ge=1)] = 1,
    minimum: Annotated[float | None, Param("Height of the integer code 0.", unit="m")] = None,
    maximum: Annotated[float | None, Param("Height of the largest integer code (65535 for 16 bits).", unit="m")] = None,
    rows: Annotated[int | None, Param("Rows of a raw file.", ge=1)] = None,
    columns: Annotated[int | None, Param("Columns of a raw file.", ge=1)] = None,
    byte_order: Annotated[Literal["little", "big"], Param("Byte order of a raw file.")] = "little",
    extent: Annotated[
        tuple[float, float, float, float] | None,
        Param("Outer edges (west, south, east, north), for files that do not say or say it wrong."),
    ] = None,
    cell_size: Annotated[float | None, Param("Side of a cell, for files that do not say.", gt=0, unit="m")] = None,
    crs: Annotated[str, Param("Coordinate reference system, for files that do not say or say it wrong.")] = "",
    nodata: Annotated[float | None, Param("A further number in the file that means void.")] = None,
    vertical_unit: Annotated[
        VerticalUnit, Param("Unit of the heights in the file; auto: as it says, else m.")
    ] = "auto",
    context: Context,
) -> Elevation:
    """Load an elevation model from one file, or from several tiles of one grid.

    Reads every raster format of GDAL (GeoTIFF, SRTM .hgt, USGS .dem, ESRI ASCII .asc, 16-bit PNG and so on), NumPy
    .npy, raw .r16 (unsigned) and .r32 (float), and the .h5 of terrain.save_elevation.  Plugins add formats; 'nodegraph
    types' lists them.  Heights are metres as the file has them: scale and offset tags are applied, feet become metres
    where the file (or `vertical_unit`) says so, and nothing is ever stretched to 0..1.  Voids (no data, masked,
    infinite) become NaN.

    Picture formats and .r16 hold codes, not heights: code c of largest code C is the height
    minimum + c (maximum - minimum) / C.  State that range, unless the JSON sidecar of terrain.save_elevation lies
    beside the file.  Unsigned integers of other formats are heights unless a range is stated.

    Where the file lies comes from the file itself or from its sidecars (.prj, world file, .aux.xml, our .json); a
    stated `extent` or `crs` goes first.  An .hgt tile is placed by its name (N27E086.hgt).  Tiles must share system,
    cell size and alignment; they may overlap (earlier files go first, their voids are filled by later ones) and leave
    gaps (voids).  A projected system in feet becomes the same projection in metres.

    Raises:
        FileNotFoundError, PermissionError: there is no such file, or it may not be read.
        ValueError: a file is empty, damaged, no raster, a colour picture, rotated, all void, or says too little; or the
            tiles do not fit together.

    Reference: GDAL raster drivers, https://gdal.org/drivers/raster/.
    """
    paths = _paths(path)
    options = Options(band, minimum, maximum, rows, columns, byte_order, extent, cell_size, crs, nodata, vertical_unit)
    with ExitStack() as held:
        # What tells its outline only when it is read is read once and held; the others are opened again for their rows.
        files = {item: held.enter_context(opened(item, options)) for item in paths if not _tells_ahead(item)}
        outlines = [files[item].outline if item in files else _outline(item, options) for item in paths]
        total, places = mosaic(outlines, [item.name for item in paths])
        check_cells(total.rows, total.cols)
        heights = np.full((total.rows, total.cols), np.nan, np.float32)
        for index, (item, (top, left)) in enumerate(zip(paths, places, strict=True)):
            start, stop = index / len(paths), (index + 1) / len(paths)
            with nullcontext(files[item]) if item in files else opened(item, options) as file:
                shape = file.outline.rows, file.outline.cols
                for part in row_blocks(*shape, context, cells=_BLOCK, start=start, stop=stop):
                    target = heights[top + part.start : top + part.stop, left : left + shape[1]]
                    np.copyto(target, file.read(part), where=np.isnan(target))
    if np.isnan(heights).all():
        raise ValueError(f"'{paths[0].name}' holds no heights: every cell is void")
    return Elevation(heights, total.extent)


@load_elevation.forecast
def _forecast(*, path: Path | tuple[Path, ...], **params: object) -> Forecast:
    """Read the heads only.  What is wrong with a file is for the node to say, and one without a head tells nothing."""
    params.pop("context", None)
    try:
        paths, options = _paths(path), Options(**params)  # type: ignore[arg-type]
        if not all(map(_tells_ahead, paths)):
            return Forecast(0, known=False)
        total, _ = mosaic([_outline(item, options) for item in paths])
    except (OSError, ValueError):
        return Forecast(0, known=False)
    return total.forecast(peak_bytes=1)


def mosaic(outlines: Sequence[Outline], names: Sequence[str] = ()) -> tuple[Outline, list[tuple[int, int]]]:
    """Return the grid that covers all tiles, and the (row, column) at which each of them lies in it.

    Raises:
        ValueError: the tiles differ in system or cell size (by 0.01 %), or are shifted by part of a cell (over 5 %).
    """
    first = outlines[0]
    dx, dy = first.cell_size
    offsets = []
    for index, tile in enumerate(outlines):
        pair = f"'{names[0]}' and '{names[index]}'" if names else "the tiles"
        if (tile.extent.crs, tile.extent.unit) != (first.extent.crs, first.extent.unit):
            raise ValueError(f"{pair} have different coordinate reference systems; load and reproject each by itself")
        if abs(tile.cell_size[0] / dx - 1) > 1e-4 or abs(tile.cell_size[1] / dy - 1) > 1e-4:
            raise ValueError(f"{pair} have different cell sizes; load and resample each by itself")
        down, right = (first.extent.north - tile.extent.north) / dy, (tile.extent.west - first.extent.west) / dx
        if abs(down - round(down)) > 0.05 or abs(right - round(right)) > 0.05:
            raise ValueError(f"{pair} are shifted by part of a cell; load and resample each by itself")
        offsets.append((round(down), round(right)))
    if len(outlines) == 1:
        return first, [(0, 0)]
    top, left = min(row for row, _ in offsets), min(col for _, col in offsets)
    bottom = max(row + tile.rows for (row, _), tile in zip(offsets, outlines, strict=True))
    right_end = max(col + tile.cols for (_, col), tile in zip(offsets, outlines, strict=True))
    extent = Extent(
        first.extent.west + left * dx,
        first.extent.north - bottom * dy,
        first.extent.west + right_end * dx,
        first.extent.north - top * dy,
        first.extent.crs,
        first.extent.unit,
    )
    return Outline(bottom - top, right_end - left, extent), [(row - top, col - left) for row, col in offsets]


def _tells_ahead(path: Path) -> bool:
    """Say whether a file tells its outline before its heights are read."""
    return format_of(path).open is not None


def _outline(path: Path, options: Options) -> Outline:
    with opened(path, options) as file:
        return file.outline


def _paths(path: Path | str | Sequence[Path | str]) -> list[Path]:
    found = [Path(path)] if isinstance(path, (str, Path)) else [Path(item) for item in path]
    if not found:
        raise ValueError("path is an empty list; name at least one file")
    return found
