"""Where the discs of a sparse terrain lie: on a square grid, a step of one radius apart."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_terrain.raster import Extent


@port_type
class PatchGrid:
    """Discs of radius R whose centres are R apart, so that every point lies in at least two of them but at borders.

    Patches are numbered by rows from the north-west.  A terrain of w by h cells and patches of K = (2 R / cell)^2
    samples has n = 4 w h / K of them (rounded up along each side): t0 = n K / 4 of the paper.

    Attributes:
        extent: what the terrain covers, in metres.
        radius: R, m.
        west, north: the first centre, m.
        rows, cols: of centres.
    """

    extent: Extent
    radius: float
    west: float
    north: float
    rows: int
    cols: int

    @property
    def count(self) -> int:
        """n, the number of patches."""
        return self.rows * self.cols

    @property
    def centres(self) -> npt.NDArray[np.float64]:
        """Return (n, 2), m: east, north."""
        x = self.west + self.radius * np.arange(self.cols)
        y = self.north - self.radius * np.arange(self.rows)
        return np.stack([np.tile(x, self.rows), np.repeat(y, self.cols)], axis=1)


def patch_grid(extent: Extent, shape: tuple[int, int], half: int) -> PatchGrid:
    """Return the grid for discs of `half` cells' radius over a raster of square cells.

    Centres lie on corners of cells, half a radius (rounded down to whole cells) inside of the northern and western
    border, so that the samples of all patches are cells of the raster.
    """
    rows, cols = shape
    cell = extent.width / cols
    first = (half // 2) * cell
    return PatchGrid(extent, half * cell, extent.west + first, extent.north - first, -(-rows // half), -(-cols // half))
