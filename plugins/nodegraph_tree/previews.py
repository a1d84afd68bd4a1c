"""Pictures of construction trees and profiles for people."""

from __future__ import annotations

from io import BytesIO
from math import isfinite

import numpy as np

from nodegraph import Context, Preview
from nodegraph_terrain.previews import preview_elevation
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_tree.evaluate import Profile, sample_grid
from nodegraph_tree.function import THRESHOLD, Box, ElevationFunction

SIDE = 512
"""Samples along the longer side of a preview."""

UNBOUNDED = Box(-5000.0, -5000.0, 5000.0, 5000.0)
"""What is shown of a tree that reaches everywhere, m."""


def preview_function(function: ElevationFunction) -> bytes:
    """Show the terrain within its support; ten kilometres around the origin where it has no end."""
    box = function.support
    if not all(map(isfinite, box)) or box.west >= box.east or box.south >= box.north:
        box = UNBOUNDED
    wide, high = box.east - box.west, box.north - box.south
    rows, cols = (max(1, round(SIDE * min(1.0, ratio))) for ratio in (high / wide, wide / high))
    shape = (rows, cols)
    extent = Extent(*box)
    height = np.empty(shape, np.float32)
    for place, part in sample_grid(function, extent, shape, Context()):
        height[place] = np.where(part.weight >= THRESHOLD, part.height, np.nan)
    return preview_elevation(Elevation(height, extent))


def preview_profile(profile: Profile) -> bytes:
    """Show height over distance, with gaps where there is no terrain."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.2), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    axes.plot(profile.distance, profile.height, color="#6b4f3a")
    axes.set_xlabel("distance, m")
    axes.set_ylabel("height, m")
    axes.spines[["top", "right"]].set_visible(False)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


PREVIEWS = (Preview(ElevationFunction, preview_function), Preview(Profile, preview_profile))
"""How the values of this plugin are drawn."""
