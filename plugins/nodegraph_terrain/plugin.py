"""What this package brings to nodegraph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nodegraph import Family, Node, Preview, hookimpl

NODE_MODULES = (
    "sample_dem",
    "load",
    "voids",
    "reproject",
    "resample",
    "crop",
    "smooth",
    "slope",
    "hillshade",
    "colour",
    "arithmetic",
    "statistics",
    "noise_raster",
    "conversions",
    "save",
)


@hookimpl
def nodegraph_families() -> Sequence[Family]:
    """List the family ``terrain``."""
    modules = tuple(f"nodegraph_terrain.{name}" for name in NODE_MODULES)
    return [Family("terrain", modules=modules, title="Terrain")]


@hookimpl
def nodegraph_port_types() -> Sequence[type]:
    """List the grid types and the histogram."""
    from nodegraph_terrain.raster import GRIDS, Extent
    from nodegraph_terrain.statistics import Histogram

    return [Extent, *GRIDS, Histogram]


@hookimpl
def nodegraph_conversions() -> Sequence[Node[..., Any]]:
    """List what turns a shade or a mask into a picture."""
    from nodegraph_terrain.conversions import mask_image, shade_image

    return [shade_image, mask_image]


@hookimpl
def nodegraph_previews() -> Sequence[Preview]:
    """List how the grid types are drawn."""
    from nodegraph_terrain.previews import PREVIEWS

    return PREVIEWS
