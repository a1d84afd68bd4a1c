"""Any raster as a quantity that layers can depend on."""

from __future__ import annotations

from typing import Annotated

from nodegraph import Param, node, pointwise
from nodegraph_terrain.raster import Raster
from nodegraph_texture.quantities import Other


@node(version=1, locality=pointwise)
def quantity(
    raster: Raster,
    *,
    name: Annotated[str, Param("What constraints call it: lower-case letters, digits and underscores.")],
) -> Other:
    """Give a raster a name by which constraints of layers can ask for it: a distance to rivers, a mask of fields.

    Raises:
        ValueError: the text is no such name, or altitude or slope, which come from the ground itself.
    """
    return Other(raster.data, raster.extent, name)
