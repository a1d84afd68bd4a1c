"""The sample elevation model that comes with matplotlib."""

from __future__ import annotations

import numpy as np

from nodegraph import Forecast, node, whole
from nodegraph_terrain.forecasts import Outline
from nodegraph_terrain.raster import Elevation, Extent

_OUTLINE = Outline(
    344, 403, Extent(-84.41375, 36.44625, -84.41375 + 403 / 1200, 36.44625 + 344 / 1200, "EPSG:4326", "deg")
)


@node(version=1, locality=whole, title="Sample DEM")
def sample_dem() -> Elevation:
    """Give a real elevation model: the Jacksboro fault in Tennessee, with ridges that run south-west to north-east.

    344 rows by 403 columns of 3 arc-seconds (about 74 m by 92 m), EPSG:4326 in degrees, heights of 236 to 1076 m
    above sea level, no voids.  It ships with matplotlib (``sample_data/jacksboro_fault_dem.npz``), so it needs no
    download.  Link it through terrain.reproject for square cells in metres.

    Raises:
        FileNotFoundError: this installation of matplotlib came without its sample data.

    Source: SRTM, Farr et al. 2007, The Shuttle Radar Topography Mission, Reviews of Geophysics 45,
    doi:10.1029/2005RG000183.  Public domain (NASA/USGS).
    """
    from matplotlib.cbook import get_sample_data

    path = get_sample_data("jacksboro_fault_dem.npz", asfileobj=False)
    with np.load(path, allow_pickle=False) as archive:
        # xmin .. ymax are edges of cells, row 0 is the northern row and `ymin` holds the northern edge.
        heights = archive["elevation"].astype(np.float32)
        west, east = float(archive["xmin"]), float(archive["xmax"])
        south, north = sorted((float(archive["ymin"]), float(archive["ymax"])))
    return Elevation(heights, Extent(west, south, east, north, "EPSG:4326", "deg"))


@sample_dem.forecast
def _forecast() -> Forecast:
    return _OUTLINE.forecast(peak_bytes=2)
