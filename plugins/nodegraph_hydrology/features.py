"""The value on the wire: `Features`, elevations known at scattered cells of a grid."""

from __future__ import annotations

from nodegraph import port_type
from nodegraph_terrain.raster import Elevation


@port_type
class Features(Elevation):
    """Elevations where they are known, such as along rivers and ridges; NaN in the free cells between."""
