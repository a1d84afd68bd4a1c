"""Keeping a path clear of the ground."""

from __future__ import annotations

from typing import Any

import numpy as np

from nodegraph_render.camera_path import CameraPath
from nodegraph_render.rays import Doubles
from nodegraph_render.sampling import bilinear
from nodegraph_terrain.raster import Elevation

SPARE = 2e-3
"""Cells of the ground by which the eye is raised beyond the clearance."""


def lift_over(ground: Elevation, course: CameraPath, time: Doubles, clearance: float) -> Any:
    """Return by how much the eye has to be raised, a cubic spline over the time whose knots are even."""
    from scipy import ndimage
    from scipy.interpolate import CubicHermiteSpline

    mode = "wrap" if course.closed else "nearest"
    parts = 8
    # A little more, so that it is kept between the places where it is measured, too.
    wanted = clearance + SPARE * min(ground.cell_size)
    between = time[:-1, None] + np.diff(time)[:, None] * (np.arange(parts) / parts)
    spots = course.at(np.append(between.ravel(), time[-1]))[:, :3]
    needed = np.nan_to_num(bilinear(ground, spots[:, 0], spots[:, 1]) + wanted - spots[:, 2], nan=0.0)
    needed = np.maximum(needed, 0)
    # Each knot answers for what lies up to the next ones.
    needed = ndimage.maximum_filter1d(needed, 2 * parts + 1, mode="nearest")[::parts]
    if course.closed:
        needed = needed[:-1]
        needed[0] = max(needed[0], needed[-1])
    reach = max(1, len(needed) // 20)
    window = np.hanning(2 * reach + 3)[1:-1]
    lift = ndimage.maximum_filter1d(needed, 2 * reach + 1, mode=mode)
    lift = ndimage.convolve1d(lift, window / window.sum(), mode=mode)
    if course.closed:
        lift = np.append(lift, lift[0])
    slopes = np.gradient(lift, time)
    if course.closed:
        slopes[0] = slopes[-1] = (lift[1] - lift[-2]) / (time[1] - time[0]) / 2
    return CubicHermiteSpline(time, lift, slopes)
