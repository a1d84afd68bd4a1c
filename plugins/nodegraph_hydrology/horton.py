"""The statistics of river networks: laws of Horton, Tokunaga and Hack."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, port_type, whole
from nodegraph_hydrology import topology
from nodegraph_hydrology.drainage import DrainageArea
from nodegraph_hydrology.horton_plot import plotted
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_terrain.raster import Extent, Image

Floats = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


@port_type
class NetworkStatistics:
    """What describes a river network.  A number that the network is too small for is NaN.

    A stream of order w is a longest run of reaches of that Strahler order.  Entry w - 1 of arrays belongs to order w.

    Attributes:
        counts: (W,) int64, streams of each order.
        lengths: (W,) mean length of streams, m.
        areas: (W,) mean drainage area at the lower ends of streams, m2.
        tributaries: (W, W) mean number of side tributaries of order i + 1 that join a stream of order j + 1.
        branching: (W - 1,) T_k, k from 1: mean number of side tributaries of k orders less, over all streams.
        bifurcation_ratio: R_B = N_w / N_(w+1), by regression of log N_w on w.
        length_ratio: R_L = L_(w+1) / L_w, by regression, without the highest order where two others are left.
        area_ratio: R_A = A_(w+1) / A_w, likewise.
        tokunaga_a, tokunaga_c: of T_k = a c^(k-1), by regression of log T_k on k from k = 2,
            weighted with the number of side tributaries that each T_k rests on.
        hack_exponent: h of L ~ A^h, of longest length above and area at the lower ends of streams.
        drainage_density: length of all rivers over their area, 1/m.
        sinuosity: length of all links over the straight distance of their ends.
        length: of all rivers, m.
        area: that all rivers drain, m2.
        measured: areas are those of a raster; otherwise each is the length of river above times `area` over `length`.
    """

    counts: npt.NDArray[np.int64]
    lengths: npt.NDArray[np.float64]
    areas: npt.NDArray[np.float64]
    tributaries: npt.NDArray[np.float64]
    branching: npt.NDArray[np.float64]
    bifurcation_ratio: float
    length_ratio: float
    area_ratio: float
    tokunaga_a: float
    tokunaga_c: float
    hack_exponent: float
    drainage_density: float
    sinuosity: float
    length: float
    area: float
    measured: bool

    def to_json(self) -> str:
        """Return everything as strict JSON; null where a number does not exist."""

        def plain(value: Any) -> Any:
            if isinstance(value, np.ndarray):
                return [plain(item) for item in value.tolist()]
            if isinstance(value, list):
                return [plain(item) for item in value]
            return None if isinstance(value, float) and not math.isfinite(value) else value

        return json.dumps({item.name: plain(getattr(self, item.name)) for item in fields(self)}, allow_nan=False)

    def rows(self) -> list[tuple[str, str]]:
        """Return what each number is called and how people write it."""

        def figure(value: float) -> str:
            return "–" if math.isnan(value) else f"{value:.2f}"

        return [
            ("bifurcation ratio $R_B$", figure(self.bifurcation_ratio)),
            ("length ratio $R_L$", figure(self.length_ratio)),
            ("area ratio $R_A$", figure(self.area_ratio)),
            ("Tokunaga a", figure(self.tokunaga_a)),
            ("Tokunaga c", figure(self.tokunaga_c)),
            ("Hack's exponent h", figure(self.hack_exponent)),
            ("drainage density", f"{figure(1000 * self.drainage_density)} /km"),
            ("sinuosity", figure(self.sinuosity)),
            ("rivers", f"{self.length / 1000:,.1f} km"),
            ("area", f"{self.area / 1e6:,.1f} km²" + ("" if self.measured else " (hull)")),
        ]


class Measured(NamedTuple):
    """What `network_statistics` gives."""

    statistics: NetworkStatistics
    plot: Image
    bifurcation_ratio: float
    length_ratio: float
    area_ratio: float


@node(version=1, locality=whole)
def network_statistics(
    network: RiverNetwork,
    area: DrainageArea | None = None,
    *,
    title: Annotated[str, Param("Written above the plot.")] = "",
    context: Context,
) -> Measured:
    """Measure the laws that river networks follow.

    - Horton: numbers, mean lengths and mean areas of streams are geometric in their order, with the ratios R_B = N_w /
      N_(w+1), R_L and R_A: the slopes of log10 over the orders, by least squares.  Most maps cut the highest order; it
      is left out of R_L and R_A where two others are left.
    - Tokunaga: T_(i,j) side tributaries of order i join a stream of order j, on average; T_k is the mean of
      T_(j-k,j), each stream counted once.  T_k = a c^(k-1) is fitted from k = 2 (T_1 of extracted networks hangs on
      the threshold), each k weighted with its number of side tributaries, as the variance of the logarithm of a count
      is about its reciprocal.  Of the streams that join at the head of a stream, two of the order below make it and
      are no side tributaries.
    - Hack: the longest length above grows as the area to the power h, about 0.57; over the lower ends of streams of
      order 3 and more, or 2 where there are fewer than 8 such.

    Args:
        network: rivers; several basins are taken together.
        area: drainage area of the ground that the rivers run on; without it, areas are in proportion to the length of
            river above, and in sum that of the convex hull.
        title: above the plot.
        context: the engine's.

    Returns:
        ``statistics``, ``plot``, and the three ratios of Horton.

    Raises:
        ValueError: a network without reaches, with a cycle, or with a node outside of the raster or on a void of it.

    References: R. E. Horton (1945), doi:10.1130/0016-7606(1945)56[275:EDOSAT]2.0.CO;2; J. T. Hack (1957), USGS
    Professional Paper 294-B; E. Tokunaga (1978), Geogr. Rep. Tokyo Metrop. Univ. 13; S. D. Peckham (1995),
    doi:10.1029/94WR03155.
    """
    statistics = measure(network, area)
    context.progress(0.5, "plot")
    plot = Image(plotted(statistics, title), Extent(0.0, 0.0, 1200.0, 800.0))
    return Measured(statistics, plot, statistics.bifurcation_ratio, statistics.length_ratio, statistics.area_ratio)


@network_statistics.forecast
def _forecast(network: Forecast, area: Forecast | None = None, **_: object) -> Forecast:
    return Forecast(1 << 22, 12 * network.bytes + (area.bytes if area else 0) + (64 << 20))


def measure(network: RiverNetwork, area: DrainageArea | None = None) -> NetworkStatistics:
    """Return the statistics of a network."""
    down = network.downstream.astype(np.int64)
    if not (down >= 0).any():
        raise ValueError("the river network has no reaches; it needs nodes that flow to others")
    reach = topology.reach_lengths(network.position, down)
    order = topology.strahler_order(down)
    top = int(order.max())
    length = float(reach.sum())
    streams = _streams(down, order)
    last, of = streams.last, order[streams.head]
    counts = np.bincount(of, minlength=top + 1)[1:]
    total = np.bincount(streams.number, reach, minlength=len(of))
    above = topology.upstream_sums(down, reach)
    if area is None:
        covered = _hull(network.position)
        drained = (above - reach) * (covered / length)
    else:
        drained = _sampled(area, network.position)
        covered = float(drained[down < 0].sum())
    lengths = np.bincount(of, total, minlength=top + 1)[1:] / counts
    areas = np.bincount(of, drained[last], minlength=top + 1)[1:] / counts
    sides = _side_tributaries(down, order, streams, top)
    tributaries = sides / counts
    rank = np.arange(1, top + 1)
    kept = slice(None, top - 1 if top > 2 else top)
    seen = np.array([np.trace(sides, k) for k in range(1, top)])
    branching = seen / np.cumsum(counts[::-1])[-2::-1]
    far = np.flatnonzero(seen[1:] > 0) + 1
    c, start = _line(far + 1.0, np.log10(branching[far]), seen[far])
    return NetworkStatistics(
        counts=counts,
        lengths=lengths,
        areas=areas,
        tributaries=tributaries,
        branching=branching,
        bifurcation_ratio=10 ** -_line(rank, np.log10(counts))[0],
        length_ratio=_ratio(rank[kept], lengths[kept]),
        area_ratio=_ratio(rank[kept], areas[kept]),
        tokunaga_a=10 ** (start + c),
        tokunaga_c=10**c,
        hack_exponent=_hack(down, reach, drained, last, of),
        drainage_density=length / covered if covered > 0 else math.nan,
        sinuosity=_sinuosity(network.position, down, reach),
        length=length,
        area=covered,
        measured=area is not None,
    )


class _Streams(NamedTuple):
    """Streams: the number of the one that each node belongs to, and the first and last node of each."""

    number: Index
    head: Index
    last: Index


def _streams(down: Index, order: Index) -> _Streams:
    """Return the longest runs of nodes of one order; the reach from its last node still belongs to it."""
    flowing = np.flatnonzero(down >= 0)
    same = flowing[order[down[flowing]] == order[flowing]]
    above = np.zeros(len(down), np.int64)
    np.add.at(above, down[same], 1)
    # A node that two of one order below join has a higher order, so at most one arrives of its own.
    head = np.flatnonzero(above == 0)
    onward = np.full(len(down), -1, np.int64)
    onward[same] = down[same]
    end = topology.basins(onward)
    last = end[head]
    number_of_end = np.full(len(down), -1, np.int64)
    number_of_end[last] = np.arange(len(head))
    return _Streams(number_of_end[end], head, last)


def _side_tributaries(down: Index, order: Index, streams: _Streams, top: int) -> Floats:
    """Return how many streams of order i + 1 join one of order j + 1 as side tributaries, (top, top)."""
    ends = streams.last[down[streams.last] >= 0]
    target = down[ends]
    joined = np.zeros((top, top))
    np.add.at(joined, (order[ends] - 1, order[target] - 1), 1)
    # Two of the order below make each stream; only those of the first order begin without.
    made = np.bincount(order[streams.head], minlength=top + 1)[2:]
    joined[np.arange(top - 1), np.arange(1, top)] -= 2 * made
    return joined


def _hack(down: Index, reach: Floats, drained: Floats, last: Index, of: Index) -> float:
    longest = _longest_above(down, reach)
    high = of >= 3 if (of >= 3).sum() >= 8 else of >= 2
    ends = last[high & (drained[last] > 0) & (longest[last] > 0)]
    return _line(np.log10(drained[ends]), np.log10(longest[ends]))[0]


def _longest_above(down: Index, reach: Floats) -> Floats:
    """Return the greatest distance from each node up to a source."""
    longest = np.zeros(len(down))
    order = topology.upstream_order(down)[::-1]
    hops = topology.hops(down)[order]
    for level in np.split(order, np.flatnonzero(np.diff(hops)) + 1):
        flowing = level[down[level] >= 0]
        np.maximum.at(longest, down[flowing], longest[flowing] + reach[flowing])
    return longest


def _sinuosity(position: npt.NDArray[Any], down: Index, reach: Floats) -> float:
    heads = topology.link_heads(down)
    flowing = np.flatnonzero(down >= 0)
    # A link's last reach leads into the next link, or to the outlet.
    last = flowing[(heads[down[flowing]] != heads[flowing]) | (down[down[flowing]] < 0)]
    chords = position[heads[last]] - position[down[last]]
    straight = float(np.hypot(chords[:, 0], chords[:, 1]).sum())
    return float(reach.sum()) / straight if straight > 0 else math.nan


def _hull(position: npt.NDArray[Any]) -> float:
    import shapely

    return float(shapely.MultiPoint(position).convex_hull.area)


def _sampled(area: DrainageArea, position: npt.NDArray[Any]) -> Floats:
    extent, (dx, dy) = area.extent, area.cell_size
    column = np.floor((position[:, 0] - extent.west) / dx).astype(np.int64)
    row = np.floor((extent.north - position[:, 1]) / dy).astype(np.int64)
    inside = (row >= 0) & (row < area.shape[0]) & (column >= 0) & (column < area.shape[1])
    values = np.full(len(position), np.nan)
    values[inside] = area.data[row[inside], column[inside]]
    if np.isnan(values).any():
        number = int(np.flatnonzero(np.isnan(values))[0])
        raise ValueError(f"node {number} of the network lies outside of the drainage areas; give those of its ground")
    return values


def _line(x: npt.NDArray[Any], y: Floats, weight: Floats | None = None) -> tuple[float, float]:
    """Return slope and intercept by (weighted) least squares; NaN without two different x."""
    if len(x) < 2 or float(np.ptp(x)) == 0:
        return math.nan, math.nan
    middle, height = float(np.average(x, weights=weight)), float(np.average(y, weights=weight))
    centred = (x - middle) * (1.0 if weight is None else weight)
    slope = float(centred @ y) / float(centred @ (x - middle))
    return slope, height - slope * middle


def _ratio(rank: npt.NDArray[Any], values: Floats) -> float:
    good = values > 0
    return 10 ** _line(rank[good], np.log10(values[good]))[0]
