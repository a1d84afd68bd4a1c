"""Interpolating between the centres of cells, shared by resampling and reprojection."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

REACH = 12
"""Cells by which spline coefficients extend the grid: the prefilter forgets the edge by 0.268^12 = 1e-7."""


def spline_coefficients(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Return the coefficients of the interpolating cubic B-spline, extended by `REACH` cells on every side.

    The grid is extended by point reflection about its outer values, so that a plane stays a plane up to the edge.
    `values` hold no NaN.
    """
    from scipy import ndimage

    extended = values.astype(np.float64)
    for axis in (0, 1):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (REACH, REACH)
        if values.shape[axis] == 1:
            extended = np.pad(extended, pad, mode="edge")
        else:
            extended = np.pad(extended, pad, mode="reflect", reflect_type="odd")
    return np.asarray(ndimage.spline_filter(extended, order=3, mode="mirror"))


def without_voids(values: npt.NDArray[np.float32], missing: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    """Return the values with the nearest known one in every void, so that a spline can pass through."""
    from scipy import ndimage

    if missing.all():
        return np.zeros_like(values)
    nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(values[nearest[0], nearest[1]])
