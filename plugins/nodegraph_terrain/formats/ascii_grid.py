"""ESRI ASCII grid, nine digits (every float32 exactly), and a ``.prj`` with the system."""

from __future__ import annotations

from io import BytesIO

import numpy as np

from nodegraph import File
from nodegraph_terrain.formats.place import crs_of, prj
from nodegraph_terrain.raster import Raster


def write_ascii_grid(surface: Raster, name: str) -> File:
    """Write a raster; a void is a number far below every height."""
    crs = crs_of(surface.extent, "an ESRI ASCII grid")
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
    sidecars = (prj(name, crs),) if crs else ()
    return File.of(name, text, *sidecars)
