"""The colours of an image: each once, with how often it occurs.

A picture of millions of pixels has some hundred thousand colours.  What depends on colour alone is computed once for
each of them, and brought back to the pixels by a table of all 2^24.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]
Codes = npt.NDArray[np.uint32]
Flags = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float32]


class Colours(NamedTuple):
    """Different colours and how often they occur.

    Attributes:
        codes: (n,) uint32, 65536 red + 256 green + blue, rising.
        counts: (n,) int64.
    """

    codes: Codes
    counts: npt.NDArray[np.int64]

    @property
    def rgb(self) -> Bytes:
        """The colours, (n, 3) uint8."""
        return np.stack([self.codes >> 16, self.codes >> 8 & 255, self.codes & 255], axis=1).astype(np.uint8)


def colour_codes(pixels: Bytes) -> Codes:
    """Return 65536 red + 256 green + blue of (rows, columns, 3 or 4) pixels.

    >>> colour_codes(np.array([[[1, 2, 3]]], np.uint8)).item() == 0x010203
    True
    """
    codes = pixels[..., 0].astype(np.uint32)
    for channel in (1, 2):
        codes <<= 8
        codes |= pixels[..., channel]
    return codes


def colour_table(codes: Codes) -> Colours:
    """Return the different ones of any colour codes, with counts."""
    ordered = np.sort(codes, axis=None)
    if not len(ordered):
        return Colours(ordered, np.zeros(0, np.int64))
    first = np.concatenate([[0], np.flatnonzero(ordered[1:] != ordered[:-1]) + 1])
    return Colours(ordered[first], np.diff(np.append(first, len(ordered))))


def looked_up(codes: Codes, table: Colours, values: npt.NDArray[Any], missing: int = -1) -> npt.NDArray[Any]:
    """Return the value that belongs to each code, `missing` where it is not in the table; of the dtype of `values`."""
    every = np.full(1 << 24, missing, values.dtype)
    every[table.codes] = values
    return every[codes]


def used_pixels(pixels: Bytes) -> Flags | None:
    """Return which pixels show something, by at least half alpha; None: all do."""
    if pixels.shape[2] == 3:
        return None
    used = pixels[..., 3] >= 128
    return None if used.all() else used


def hue_saturation_value(rgb: Bytes) -> tuple[Floats, Floats, Floats]:
    """Return hue (degrees, 0 <= hue < 360), saturation and value (0 to 1) of (..., 3) sRGB codes.

    The hexcone of Smith 1978, Color gamut transform pairs, doi:10.1145/965139.807361.  Grey has hue 0.

    >>> [float(part[0]) for part in hue_saturation_value(np.array([[0, 0, 128]], np.uint8))]
    [240.0, 1.0, 0.501960813999176]
    """
    red, green, blue = (rgb[..., channel].astype(np.float32) for channel in range(3))
    high = np.maximum(np.maximum(red, green), blue)
    chroma = high - np.minimum(np.minimum(red, green), blue)
    safe = np.maximum(chroma, np.float32(1))
    sector = np.where(
        high == red, (green - blue) / safe, np.where(high == green, 2 + (blue - red) / safe, 4 + (red - green) / safe)
    )
    hue = np.where(sector < 0, sector + np.float32(6), sector) * np.float32(60)
    saturation = (chroma / np.maximum(high, np.float32(1))).astype(np.float32)
    return hue, saturation, (high / np.float32(255)).astype(np.float32)


def is_grey(rgb: Bytes, threshold: float) -> Flags:
    """Return which colours are grey or nearly so: their channels differ by at most `threshold` codes."""
    return np.asarray(rgb.max(axis=-1).astype(np.int16) - rgb.min(axis=-1) <= threshold)
