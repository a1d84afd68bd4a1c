"""Everything that GDAL reads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph.plugins import registry
from nodegraph_terrain.formats.contents import Contents, damaged
from nodegraph_terrain.formats.heightmap import explained
from nodegraph_terrain.georeference import extent_from_transform, gdal, horizontal
from nodegraph_terrain.raster import Elevation
from nodegraph_terrain.sidecar import beside

PICTURES = ("PNG", "JPEG", "BMP", "GIF", "WEBP", "TGA", "SGI", "PNM", "XPM")
"""GDAL drivers of picture formats: their numbers are brightness, so a height range must be known."""

SIDECARS = (
    "*.json",
    "*.aux.xml",
    "*.msk",
    ".aux",
    ".prj",
    ".hdr",
    ".wld",
    ".tfw",
    ".tifw",
    ".pgw",
    ".jgw",
    ".bpw",
    ".gfw",
)
"""What GDAL, or this module, looks at beside a file."""


@contextmanager
def open_raster(path: Path, *, band: int = 1, extent: tuple[float, ...] | None = None) -> Iterator[Contents]:
    """Open a band of a raster; a stated `extent` makes up for a place that only control points give."""
    with path.open("rb") as file:
        if file.read(512).lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"<", b"{"):
            raise ValueError(f"'{path.name}' only describes data kept in other files; load those files themselves")
    with gdal() as rasterio:
        from rasterio.errors import RasterioError

        try:
            dataset = rasterio.open(path)
        except RasterioError:
            raise _unreadable(path) from None
        with dataset:
            yield _contents(path, dataset, band, placed=extent is not None)


def _contents(path: Path, dataset: Any, band: int, *, placed: bool) -> Contents:
    name = path.name
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
    if dtype == np.uint8 and (dataset.colorinterp[band - 1].name == "palette" or dataset.count >= 3):
        raise ValueError(f"'{name}' is a colour picture; heights need one band of 16-bit or real numbers")
    rows, cols = int(dataset.height), int(dataset.width)
    crs, vertical = horizontal(dataset.crs)
    extent, upside_down, mirrored = None, False, False
    if not dataset.transform.is_identity:
        try:
            extent, upside_down, mirrored = extent_from_transform(dataset.transform, rows, cols, crs)
        except ValueError as error:
            raise ValueError(f"'{name}': {error}" if "coordinates" in str(error) else f"'{name}' {error}") from None
    elif dataset.gcps[0] and not placed:
        raise ValueError(f"'{name}' is placed by control points only; give it a regular grid first, with gdalwarp")

    def read(part: slice) -> npt.NDArray[Any]:
        from rasterio.errors import RasterioError
        from rasterio.windows import Window

        first, last = (rows - part.stop, rows - part.start) if upside_down else (part.start, part.stop)
        try:
            cells = dataset.read(band, window=Window(0, first, cols, last - first), masked=True)
        except RasterioError:
            raise damaged(path) from None
        flipped: npt.NDArray[Any] = cells[:: -1 if upside_down else 1, :: -1 if mirrored else 1]
        return flipped

    found = Contents(
        rows, cols, dtype, read, extent, dataset.units[band - 1] or vertical, float(dataset.scales[band - 1]),
        float(dataset.offsets[band - 1]),
    )  # fmt: skip
    if dataset.driver not in PICTURES:
        return found
    hint = "does not say its heights; state minimum and maximum, those of black and white"
    return explained(replace(found, range_hint=hint), path, beside(path))


def _unreadable(path: Path) -> ValueError:
    if path.suffix.lower() == ".hgt":
        return ValueError(
            f"'{path.name}' is no SRTM tile: its name must give its south-west corner, such as N27E086.hgt, and it "
            "must have 1201 x 1201 or 3601 x 3601 heights of 2 bytes"
        )
    formats = registry().formats()
    others = [
        formats.suffixes(item, "read")[0] for item in formats.of(Elevation, "read") if item.open is not open_raster
    ]
    return ValueError(
        f"'{path.name}' is no raster that can be read; expected GeoTIFF, .hgt, .dem, .asc, 16-bit PNG, "
        f"{', '.join(others)} or another format of GDAL"
    )
