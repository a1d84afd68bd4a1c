"""Numbers without a word about them: raw rows (.r16, .raw, .r32) and NumPy arrays (.npy), with our JSON beside them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import File
from nodegraph_terrain.formats.contents import Contents
from nodegraph_terrain.formats.heightmap import codes_of, explained, with_sidecar
from nodegraph_terrain.raster import Raster
from nodegraph_terrain.sidecar import Sidecar, beside

ByteOrder = Literal["little", "big"]


@contextmanager
def open_r16(
    path: Path, *, rows: int | None = None, columns: int | None = None, byte_order: ByteOrder = "little"
) -> Iterator[Contents]:
    """Open rows of unsigned 16-bit codes."""
    yield _raw(path, np.dtype("u2"), rows, columns, byte_order)


@contextmanager
def open_r32(
    path: Path, *, rows: int | None = None, columns: int | None = None, byte_order: ByteOrder = "little"
) -> Iterator[Contents]:
    """Open rows of float32."""
    yield _raw(path, np.dtype("f4"), rows, columns, byte_order)


def _raw(path: Path, dtype: np.dtype[Any], rows: int | None, columns: int | None, byte_order: ByteOrder) -> Contents:
    known = beside(path)
    rows = rows or (known.rows if known else None)
    columns = columns or (known.columns if known else None)
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
    cells = np.memmap(path, dtype.newbyteorder("<" if byte_order == "little" else ">"), "r", shape=(rows, columns))
    hint = "holds 16-bit codes; state minimum and maximum, the heights of code 0 and 65535" if dtype.kind == "u" else ""
    return _contents(path, cells, known, hint)


@contextmanager
def open_npy(path: Path) -> Iterator[Contents]:
    """Open an array of numpy.save."""
    try:
        cells = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError):
        raise ValueError(f"'{path.name}' is no complete .npy file of numbers; save it again with numpy.save") from None
    if not isinstance(cells, np.ndarray) or cells.ndim != 2 or 0 in cells.shape or cells.dtype.kind not in "iuf":
        raise ValueError(f"'{path.name}' holds {_describe(cells)}; expected a two-dimensional array of real numbers")
    yield _contents(path, cells, beside(path))


def _describe(cells: Any) -> str:
    return f"an array of shape {cells.shape} and type {cells.dtype}" if isinstance(cells, np.ndarray) else "an archive"


def _contents(path: Path, cells: npt.NDArray[Any], known: Sidecar | None, range_hint: str = "") -> Contents:
    rows, cols = cells.shape
    found = Contents(rows, cols, cells.dtype, lambda part: cells[part], range_hint=range_hint)
    return explained(found, path, known)


def write_r16(surface: Raster, name: str, *, minimum: float | None = None, maximum: float | None = None) -> File:
    """Write little-endian rows of 16-bit codes."""
    codes = codes_of(surface, name, minimum, maximum)
    content = codes.encode(surface.data).astype("<u2").tobytes()
    return with_sidecar(name, content, Sidecar.of(surface, "uint16", codes))


def write_r32(surface: Raster, name: str) -> File:
    """Write little-endian rows of float32."""
    return with_sidecar(name, surface.data.astype("<f4").tobytes(), Sidecar.of(surface, "float32"))


def write_npy(surface: Raster, name: str) -> File:
    """Write a little-endian float32 array."""
    buffer = BytesIO()
    np.lib.format.write_array(buffer, surface.data.astype("<f4", order="C"), version=(1, 0), allow_pickle=False)
    return with_sidecar(name, buffer.getvalue(), Sidecar.of(surface, "float32"))
