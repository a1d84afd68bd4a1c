"""What this package brings to nodegraph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nodegraph import Family, Node, Preview, hookimpl

NODE_MODULES: tuple[str, ...] = (
    "camera",
    "sun",
    "path",
    "turntable",
    "picture",
    "flight",
    "save_film",
    "surface",
    "trace",
    "trace_channel",
    "shade",
    "mesh_grid",
    "mesh_adaptive",
    "mesh_tin",
    "mesh_solid",
    "drape",
    "save_mesh",
    "contour_lines",
    "profile",
    "profile_plot",
    "relief_map",
    "compare",
)


@hookimpl
def nodegraph_families() -> Sequence[Family]:
    """List the family ``render``."""
    return [Family("render", modules=tuple(f"nodegraph_render.{name}" for name in NODE_MODULES), title="Rendering")]


@hookimpl
def nodegraph_conversions() -> Sequence[Node[..., Any]]:
    """List what turns a construction tree or a raster into a surface."""
    from nodegraph_render.surface import function_surface, raster_surface

    return [function_surface, raster_surface]


@hookimpl
def nodegraph_previews() -> Sequence[Preview]:
    """List how traces, meshes and differences are drawn."""
    from nodegraph_render.differences import Differences, preview_differences
    from nodegraph_render.mesh import Mesh
    from nodegraph_render.mesh_preview import preview_mesh
    from nodegraph_render.trace import Trace
    from nodegraph_render.trace_channel import preview_trace

    return [Preview(Trace, preview_trace), Preview(Mesh, preview_mesh), Preview(Differences, preview_differences)]
