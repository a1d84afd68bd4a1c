"""What this package brings to nodegraph."""

from __future__ import annotations

from collections.abc import Sequence

from nodegraph import Family, Preview, hookimpl

NODE_MODULES: tuple[str, ...] = (
    "diffuse",
    "poisson_blend",
    "sketch_line",
    "lsystem",
    "river_network",
    "headwaters",
    "river_heights",
    "ridges",
    "rasterize_features",
    "carve_rivers",
    "enrich",
    "drainage",
    "streams",
    "divides",
    "horton",
    "draw_network",
    "compare_networks",
)


@hookimpl
def nodegraph_families() -> Sequence[Family]:
    """List the family ``hydrology``."""
    modules = tuple(f"nodegraph_hydrology.{name}" for name in NODE_MODULES)
    return [Family("hydrology", modules=modules, title="Hydrology")]


@hookimpl
def nodegraph_previews() -> Sequence[Preview]:
    """List how river networks are drawn."""
    from nodegraph_hydrology.previews import PREVIEWS

    return PREVIEWS
