"""What stands in an elevation file, as its reader finds it: numbers yet, not heights in metres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.raster import Extent, Raster
from nodegraph_terrain.sidecar import Codes

Rows = Callable[[slice], npt.NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Contents:
    """What a file holds.

    Attributes:
        rows, cols: shape of the raster.
        dtype: type of its numbers: real ones.
        read: returns some rows as they stand in the file, (rows, cols), row 0 north; a masked array masks voids.
        extent: where it lies, as far as the file says.
        unit: unit of the heights, such as ``ft``; empty for metres.
        scale, offset: a height is scale * number + offset, where `codes` say nothing else.
        codes: how integers stand for heights, as far as the file says.
        range_hint: says that a height range must be stated, and which, where the numbers are codes that mean nothing
            without one.  Follows the name of the file in a sentence.
    """

    rows: int
    cols: int
    dtype: np.dtype[Any]
    read: Rows
    extent: Extent | None = None
    unit: str = ""
    scale: float = 1.0
    offset: float = 0.0
    codes: Codes | None = None
    range_hint: str = ""

    @classmethod
    def of(cls, raster: Raster) -> Contents:
        """Return what a file holds that was read at once."""
        return cls(*raster.shape, raster.data.dtype, lambda rows: raster.data[rows], raster.extent, raster.unit)


def damaged(path: Path) -> ValueError:
    """Return what to raise where a file begins well and ends too early."""
    return ValueError(f"'{path.name}' is damaged or cut short; get it again")
