"""Numbers that describe a raster."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, port_type, whole
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.raster import Raster


@port_type
class Histogram:
    """How many cells lie in each of a row of equal bins.

    Attributes:
        edges: (n + 1,) float64, rising; bin i holds edges[i] <= value < edges[i + 1], the last one its upper edge too.
        counts: (n,) int64.
        unit: unit of the edges.
    """

    edges: npt.NDArray[np.float64]
    counts: npt.NDArray[np.int64]
    unit: str = ""

    def __post_init__(self) -> None:
        if self.edges.ndim != 1 or self.counts.shape != (len(self.edges) - 1,) or len(self.counts) < 1:
            raise ValueError(
                f"a histogram of {self.counts.shape} counts needs one edge more, not {self.edges.shape} edges"
            )


class Statistics(NamedTuple):
    """What `statistics` gives."""

    minimum: float
    maximum: float
    mean: float
    standard_deviation: float
    void_count: int
    void_fraction: float
    histogram: Histogram


@node(version=1, locality=whole)
def statistics(
    surface: Raster,
    *,
    bins: Annotated[int, Param("Bins of the histogram.", ge=1, le=65536)] = 256,
    context: Context,
) -> Statistics:
    """Describe the values of a raster: extremes, mean, spread, voids and a histogram.

    Mean and standard deviation are those of the known cells taken as a whole population (divided by n), summed in
    float64 block by block by the pairwise update of Chan, Golub & LeVeque (1983), which loses no digits on large
    rasters far above zero.  The histogram has `bins` equal bins from the least to the greatest value; on a raster of
    one value v they cover v - 1/2 to v + 1/2.

    Args:
        surface: any raster with at least one cell that is not void.
        bins: bins of the histogram.
        context: the engine's.

    Returns:
        ``minimum``, ``maximum``, ``mean``, ``standard_deviation`` in the raster's unit, ``void_count`` (cells),
        ``void_fraction`` (0 to 1) and ``histogram``.

    Raises:
        ValueError: every cell is void, or some are infinite.

    References:
        T. F. Chan, G. H. Golub, R. J. LeVeque (1983): Algorithms for computing the sample variance: analysis and
        recommendations. The American Statistician 37(3). doi:10.1080/00031305.1983.10483115.
    """
    count, mean, squares = 0, 0.0, 0.0
    low, high = math.inf, -math.inf
    for part in row_blocks(*surface.shape, context, stop=0.5):
        block = surface.data[part]
        known = block[~np.isnan(block)]
        if known.size == 0:
            continue
        low, high = min(low, float(known.min())), max(high, float(known.max()))
        if math.isinf(low) or math.isinf(high):
            raise ValueError("the raster holds infinite values; clamp it first")
        values = known.astype(np.float64)
        centre = float(values.mean())
        values -= centre
        total = count + known.size
        squares += float(values @ values) + (centre - mean) ** 2 * count * (known.size / total)
        mean += (centre - mean) * (known.size / total)
        count = total
    cells = surface.shape[0] * surface.shape[1]
    if count == 0:
        raise ValueError("every cell of the raster is void; statistics need at least one value")
    counts = np.zeros(bins, np.int64)
    ends = (low, high) if high > low else (low - 0.5, high + 0.5)
    edges = np.linspace(*ends, bins + 1)
    for part in row_blocks(*surface.shape, context, start=0.5):
        block = surface.data[part]
        counts += np.histogram(block[~np.isnan(block)].astype(np.float64), bins, ends)[0]
    # The mean of nearly equal values may round past an extreme.
    return Statistics(
        minimum=low,
        maximum=high,
        mean=min(max(mean, low), high),
        standard_deviation=math.sqrt(squares / count),
        void_count=cells - count,
        void_fraction=(cells - count) / cells,
        histogram=Histogram(edges, counts, surface.unit),
    )


@statistics.forecast
def _forecast(surface: Forecast, *, bins: int) -> Forecast:  # noqa: ARG001
    return Forecast(16 * bins + 512, 16 << 20)
