"""HDF5 with the dataset ``data`` and its georeference as attributes; other HDF5 files are left to GDAL."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy.typing as npt

from nodegraph import File
from nodegraph_terrain.formats import gdal_raster
from nodegraph_terrain.formats.contents import Contents, damaged
from nodegraph_terrain.raster import Extent, Raster

FORMAT = "nodegraph-raster/1"


@contextmanager
def open_hdf5(path: Path, *, band: int = 1, extent: tuple[float, ...] | None = None) -> Iterator[Contents]:
    """Open an HDF5 file of `write_hdf5`, or of any other kind that GDAL knows."""
    if not _is_own(path):
        with gdal_raster.open_raster(path, band=band, extent=extent) as found:
            yield found
        return

    import h5py

    with h5py.File(path, "r") as file:
        try:
            cells, attributes = file["data"], dict(file.attrs)
            west, south, east, north = (float(attributes[name]) for name in ("west", "south", "east", "north"))
            place = Extent(west, south, east, north, str(attributes["crs"]), str(attributes["extent_unit"]))
            rows, cols = cells.shape
            unit = str(attributes["unit"])
        except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError):
            raise ValueError(f"'{path.name}' is damaged; save it again with terrain.save_elevation") from None

        def read(part: slice) -> npt.NDArray[Any]:
            try:
                values: npt.NDArray[Any] = cells[part]
            except (OSError, RuntimeError):
                raise damaged(path) from None
            return values

        yield Contents(rows, cols, cells.dtype, read, place, "" if unit == "1" else unit)


def _is_own(path: Path) -> bool:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return str(file.attrs.get("format", "")).startswith("nodegraph-raster/")
    except (OSError, KeyError, RuntimeError, ValueError):
        raise ValueError(f"'{path.name}' is no complete HDF5 file; it may be cut short") from None


def write_hdf5(surface: Raster, name: str) -> File:
    """Write a raster and its georeference, compressed and with checksums."""
    import h5py

    buffer = BytesIO()
    extent = surface.extent
    with h5py.File(buffer, "w", libver="v110") as file:
        file.create_dataset(
            "data", data=surface.data, dtype="<f4", chunks=True, compression="gzip", compression_opts=4, shuffle=True,
            fletcher32=True, track_times=False,
        )  # fmt: skip
        file.attrs["format"] = FORMAT
        file.attrs["role"] = type(surface).__name__
        file.attrs["unit"] = surface.unit
        for edge in ("west", "south", "east", "north"):
            file.attrs[edge] = float(getattr(extent, edge))
        file.attrs["crs"] = extent.crs
        file.attrs["extent_unit"] = extent.unit
    return File.of(name, buffer.getvalue())
