"""What this package brings to nodegraph."""

from __future__ import annotations

from collections.abc import Sequence

from nodegraph import Family, Preview, hookimpl

NODE_MODULES = (
    "disc",
    "curve",
    "river",
    "road",
    "ridge",
    "contour",
    "landform",
    "image_quad",
    "image_curve",
    "from_elevation",
    "scatter",
    "operators",
    "layers",
    "evaluate",
    "statistics",
)


@hookimpl
def nodegraph_families() -> Sequence[Family]:
    """List the family ``tree``."""
    return [
        Family("tree", modules=tuple(f"nodegraph_tree.{name}" for name in NODE_MODULES), title="Construction trees")
    ]


@hookimpl
def nodegraph_previews() -> Sequence[Preview]:
    """List how trees, layers and profiles are drawn."""
    from nodegraph_tree.previews import PREVIEWS

    return PREVIEWS
