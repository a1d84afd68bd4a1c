"""What else keeps a terrain in few bytes: JPEG 2000, and fewer cells."""

from __future__ import annotations

import zlib
from math import sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_terrain.georeference import gdal

Heights = npt.NDArray[Any]
CODES = 65535


def jpeg2000(heights: Heights, most: int, context: Context) -> tuple[int, Heights] | None:
    """Return size and heights of the best JPEG 2000 file (OpenJPEG, 9-7 wavelets, 16 bits) of at most so many bytes."""
    low, high = float(heights.min()), float(heights.max())
    codes = np.rint((heights - low) / ((high - low) or 1.0) * CODES).astype(np.uint16)
    best = None
    # The quality of GDAL's driver is the share of the bytes of the raw codes, in per cent.
    under, over = 0.0, 100.0
    for _ in range(12):
        context.progress()
        middle = min(100 * most / codes.nbytes, 100.0) if best is None and over == 100.0 else 0.5 * (under + over)
        size, decoded = _coded(codes, middle)
        if size <= most:
            best, under = (size, decoded), middle
            if size > 0.995 * most or middle == 100.0:
                break
        else:
            over = middle
    return None if best is None else (best[0], low + best[1].astype(np.float64) / CODES * (high - low))


def _coded(codes: npt.NDArray[np.uint16], quality: float) -> tuple[int, Heights]:
    rows, cols = codes.shape
    options = {"QUALITY": f"{quality:.6f}", "REVERSIBLE": "NO", "GMLJP2": "NO", "GeoJP2": "NO", "RESOLUTIONS": "6"}
    options |= {"BLOCKXSIZE": str(max(cols, 64)), "BLOCKYSIZE": str(max(rows, 64))}
    with gdal() as rasterio, rasterio.MemoryFile() as memory:
        profile = {"driver": "JP2OpenJPEG", "height": rows, "width": cols, "count": 1, "dtype": "uint16"}
        with memory.open(**profile, **options) as target:
            target.write(codes, 1)
        size = len(memory.getbuffer())
        with memory.open() as source:
            return size, source.read(1)


def fewer_cells(heights: Heights, most: int) -> tuple[int, Heights] | None:
    """Return size and heights of the terrain reduced, then enlarged, by cubic convolution; of at most so many bytes.

    Reduced heights are stored in 16 bits as the differences along rows, deflated: as in a GeoTIFF.
    """
    from PIL import Image

    rows, cols = heights.shape
    picture = Image.fromarray(heights.astype(np.float32))
    best = None
    under, over = 0.0, 1.0
    for _ in range(12):
        share = 0.5 * (under + over)
        wide, high = max(2, round(cols * sqrt(share))), max(2, round(rows * sqrt(share)))
        small = np.asarray(picture.resize((wide, high), Image.Resampling.BICUBIC), np.float64)
        low, step = small.min(), (small.max() - small.min()) / CODES or 1.0
        codes = np.rint((small - low) / step).astype(np.uint16)
        size = len(zlib.compress(np.diff(codes, axis=1, prepend=np.uint16(0)).tobytes(), 9))
        if size > most:
            over = share
            continue
        under = share
        kept = Image.fromarray((low + codes * step).astype(np.float32))
        best = size, np.asarray(kept.resize((cols, rows), Image.Resampling.BICUBIC), np.float64)
        if size > 0.995 * most:
            break
    return best
