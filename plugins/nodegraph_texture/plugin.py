"""What this package brings to nodegraph."""

from __future__ import annotations

from collections.abc import Sequence

from nodegraph import Family, Preview, hookimpl

NODE_MODULES: tuple[str, ...] = (
    "layer",
    "quantity",
    "apply_layers",
    "coverage",
    "draw_layers",
    "save_layers",
    "load_layers",
    "temperature",
    "precipitation",
    "solar_radiation",
    "wetness",
    "snow_cover",
    "draw_quantities",
    "load_image",
    "hue_saturation",
    "classify_surfaces",
    "estimate_layers",
    "texture_report",
    "texture_tiles",
    "tile_statistics",
    "atlas",
    "export_tiles",
)


@hookimpl
def nodegraph_families() -> Sequence[Family]:
    """List the family ``texture``."""
    modules = tuple(f"nodegraph_texture.{name}" for name in NODE_MODULES)
    return [Family("texture", modules=modules, title="Texturing")]


@hookimpl
def nodegraph_port_types() -> Sequence[type]:
    """List the geographic quantities, the layers, their splat maps, and texture tiles."""
    from nodegraph_texture.atlas import AtlasTable
    from nodegraph_texture.coverage import Coverage
    from nodegraph_texture.hue_saturation import HueSaturationHistogram
    from nodegraph_texture.layers import SurfaceLayers
    from nodegraph_texture.quantities import QUANTITIES
    from nodegraph_texture.surface_classes import SurfaceClasses
    from nodegraph_texture.texture_tiles import TextureTiles
    from nodegraph_texture.tile_statistics import TileCounts

    own = (SurfaceLayers, Coverage, HueSaturationHistogram, SurfaceClasses, TextureTiles, TileCounts, AtlasTable)
    return [*QUANTITIES, *own]


@hookimpl
def nodegraph_previews() -> Sequence[Preview]:
    """List how layers and splat maps are drawn."""
    from nodegraph_texture.previews import PREVIEWS

    return PREVIEWS
