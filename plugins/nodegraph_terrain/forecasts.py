"""What is known of a raster before it is computed: the shape and extent that memory forecasts pass downstream."""

from __future__ import annotations

from dataclasses import dataclass, replace

from nodegraph import Forecast
from nodegraph_terrain.raster import Extent

CELLS_MAX = 1 << 32
"""More cells than this are refused as a mistake: 16 GiB of float32."""


@dataclass(frozen=True, slots=True)
class Outline:
    """A raster without its cells.  `Forecast.about` of a raster holds one.

    Attributes:
        rows, cols: shape of the raster.
        extent: what it covers.
    """

    rows: int
    cols: int
    extent: Extent

    @property
    def cell_size(self) -> tuple[float, float]:
        """(width, height) of a cell, in the unit of the extent."""
        return self.extent.width / self.cols, self.extent.height / self.rows

    def window(self, rows: slice, cols: slice) -> Outline:
        """Return the outline of a part given by row and column ranges (with start and stop)."""
        dx, dy = self.cell_size
        extent = replace(
            self.extent,
            west=self.extent.west + cols.start * dx,
            east=self.extent.west + cols.stop * dx,
            north=self.extent.north - rows.start * dy,
            south=self.extent.north - rows.stop * dy,
        )
        return Outline(rows.stop - rows.start, cols.stop - cols.start, extent)

    def forecast(self, *, cell_bytes: int = 4, peak_bytes: int = 0) -> Forecast:
        """Return the forecast of a raster of this outline.

        Args:
            cell_bytes: bytes that one cell of the result takes.
            peak_bytes: bytes per cell that computing it takes beyond inputs and result.
        """
        cells = self.rows * self.cols
        return Forecast(cells * cell_bytes, cells * peak_bytes, self)


def outline(forecast: Forecast) -> Outline | None:
    """Return the outline that a forecast carries, or None."""
    return forecast.about if isinstance(forecast.about, Outline) else None


def check_cells(rows: int, cols: int) -> None:
    """Raise `ValueError` when a raster of that shape can only be a mistake."""
    if rows * cols > CELLS_MAX:
        raise ValueError(
            f"the result would have {rows:,} x {cols:,} cells, over the limit of {CELLS_MAX:,}; choose larger cells"
        )
