"""Pictures of rivers for people."""

from __future__ import annotations

from io import BytesIO

import numpy as np

from nodegraph import Preview
from nodegraph_hydrology.drainage import DrainageArea
from nodegraph_hydrology.horton import NetworkStatistics
from nodegraph_hydrology.horton_plot import preview_statistics
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.topology import strahler_order


def preview_river_network(network: RiverNetwork) -> bytes:
    """Show rivers as lines that grow wider and darker with their Strahler order; outlets are dots."""
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 8), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    order = strahler_order(network.downstream)
    highest = max(int(order.max(initial=1)), 2)
    blues = colormaps["Blues"]
    # The small ones first: the large rivers lie over the ends of what joins them.
    for level in range(1, highest + 1):
        nodes = np.flatnonzero((order == level) & (network.downstream >= 0))
        legs = np.stack([network.position[nodes], network.position[network.downstream[nodes]]], axis=1)
        share = (level - 1) / (highest - 1)
        axes.add_collection(
            LineCollection(
                list(legs), linewidths=0.35 + 3.2 * share**1.6, colors=[blues(0.5 + 0.45 * share)], capstyle="round"
            )
        )
    outlets = network.position[network.downstream < 0]
    axes.scatter(outlets[:, 0], outlets[:, 1], s=14, color=blues(1.0), zorder=3)
    axes.autoscale_view()
    axes.set_aspect(1)
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.locator_params(nbins=5)
    axes.spines[["top", "right"]].set_visible(False)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def preview_drainage_area(area: DrainageArea) -> bytes:
    """Show the logarithm of drainage areas, slopes dark and rivers bright."""
    from nodegraph_terrain.previews import preview_raster
    from nodegraph_terrain.raster import Raster

    return preview_raster(Raster(np.log10(area.data), area.extent))


PREVIEWS: tuple[Preview, ...] = (
    Preview(RiverNetwork, preview_river_network),
    Preview(NetworkStatistics, preview_statistics),
    Preview(DrainageArea, preview_drainage_area),
)
"""How the types of this package are drawn."""
