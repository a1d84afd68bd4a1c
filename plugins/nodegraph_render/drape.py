"""Laying a picture over a mesh."""

from __future__ import annotations

from nodegraph import node
from nodegraph_render.mesh import Mesh, draped
from nodegraph_terrain.raster import Image


@node(version=1)
def drape(mesh: Mesh, image: Image) -> Mesh:
    """Lay a picture over a mesh from above, placed by the picture's extent.

    A vertex at (x, y) gets u = (x - west) / (east - west) and v = (y - south) / (north - south).  The picture may have
    any resolution and reach further than the mesh.

    Raises:
        ValueError: the picture has another coordinate system, or does not cover the mesh (within half a pixel).
    """
    return draped(mesh, image)
