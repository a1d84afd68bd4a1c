"""What this package brings to nodegraph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nodegraph import Family, Format, Node, Preview, hookimpl

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
    "load_polylines",
    "save_polylines",
)


@hookimpl
def nodegraph_families() -> Sequence[Family]:
    """List the family ``terrain``."""
    modules = tuple(f"nodegraph_terrain.{name}" for name in NODE_MODULES)
    return [Family("terrain", modules=modules, title="Terrain")]


@hookimpl
def nodegraph_port_types() -> Sequence[type]:
    """List the grid types, the histogram and lines."""
    from nodegraph_terrain.polylines import Polylines, Property
    from nodegraph_terrain.raster import GRIDS, Extent
    from nodegraph_terrain.statistics import Histogram

    return [Extent, *GRIDS, Histogram, Polylines, Property]


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


@hookimpl
def nodegraph_formats() -> Sequence[Format]:
    """List the files that rasters are read from and written to, and pictures written to."""
    from nodegraph_terrain.formats.table import FORMATS

    return FORMATS
