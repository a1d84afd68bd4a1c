"""Pictures of layers and splat maps for people."""

from __future__ import annotations

import numpy as np

from nodegraph import Context, Preview
from nodegraph_texture.coverage import Coverage, visible
from nodegraph_texture.draw_layers import draw_layers
from nodegraph_texture.hue_saturation import HueSaturationHistogram, preview_hue_saturation
from nodegraph_texture.layers import SurfaceLayers
from nodegraph_texture.surface_classes import SurfaceClasses, preview_classes
from nodegraph_texture.texture_tiles import TextureTiles
from nodegraph_texture.tile_tree import Tile

SHOWN = 24
"""Layers of a preview."""

SIDE = 1024
"""Most pixels along a side of a map."""


def preview_layers(layers: SurfaceLayers) -> bytes:
    """Show the hierarchy with its functions."""
    from nodegraph_terrain.formats.png import png

    return png(draw_layers(layers, width=1000, context=Context()).data)


def preview_coverage(coverage: Coverage) -> bytes:
    """Show a map of the layers in their colours, and beside it how much of the ground each has."""
    from io import BytesIO

    from matplotlib.figure import Figure

    step = max(1, -(-max(coverage.shape) // SIDE))
    data = coverage.data[step // 2 :: step, step // 2 :: step] if min(coverage.shape) > step else coverage.data
    weights = visible(data)
    colours = np.array(coverage.colours)
    painted = np.clip(weights @ colours, 0, 1)
    void = data[..., 0] <= 0
    picture = np.concatenate([painted, np.where(void, 0, 1)[..., None]], axis=-1)
    ground = ~void
    shares = weights[ground].mean(axis=0) if ground.any() else np.zeros(len(colours))
    most = np.argsort(-shares, kind="stable")[:SHOWN]
    figure = Figure(figsize=(10, 5.5), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 1.3))
    box = coverage.extent
    left.imshow(picture, extent=(box.west, box.east, box.south, box.north), interpolation="nearest")
    left.ticklabel_format(useOffset=False, style="plain")
    left.locator_params(nbins=4)
    bars = right.barh(range(len(most)), 100 * shares[most], color=colours[most], edgecolor="#555555", linewidth=0.7)
    right.bar_label(bars, fmt="%.1f", padding=3, fontsize=9)
    right.set_yticks(range(len(most)), [coverage.names[i].replace("$", r"\$")[:22] for i in most])
    right.set_ylim(max(len(most), 8) - 0.5, -0.5)
    right.set_xlabel("of the ground, %")
    right.margins(x=0.18)
    right.spines[["top", "right"]].set_visible(False)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def preview_tiles(tiles: TextureTiles) -> bytes:
    """Show the coarsest tile, which mostly is the whole."""
    from nodegraph_terrain.formats.png import png

    return png(tiles.pixels(Tile(0, 0, 0), "colour", border=0))


PREVIEWS: tuple[Preview, ...] = (
    Preview(SurfaceLayers, preview_layers),
    Preview(Coverage, preview_coverage),
    Preview(HueSaturationHistogram, preview_hue_saturation),
    Preview(SurfaceClasses, preview_classes),
    Preview(TextureTiles, preview_tiles),
)
"""How the types of this package are drawn."""
