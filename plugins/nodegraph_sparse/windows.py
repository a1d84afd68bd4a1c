"""Square windows of a height map: what patches and the atoms of an exemplar are cut from."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph_sparse.dictionary import BLOCK
from nodegraph_sparse.metric import Metric, mass
from nodegraph_terrain.raster import Elevation, require_metres

Samples = npt.NDArray[Any]

FLAT = 1e-6
"""Windows of a smaller norm than this part of the greatest one are flat: they have no shape to normalise."""

SYMMETRIES = 8
"""Of the square: turn t is t % 4 quarters anticlockwise, after a mirror image east to west if t >= 4."""


def half_side(surface: Elevation, radius: float | None, cells: int | None = None) -> int:
    """Return how many cells of a surface a radius is, which is stated in metres or in cells.

    Raises:
        ValueError: the surface is in degrees, its cells are not square or it has voids; or the radius is stated twice
            or not at all, no whole number of cells, or too large for one patch.
    """
    if (radius is None) == (cells is None):
        raise ValueError("state the radius of the discs, either in metres (radius) or in cells")
    cell = require_metres(surface)
    rows, cols = surface.shape
    width, height = surface.cell_size
    if abs(width - height) * max(rows, cols) > 0.05 * cell:
        raise ValueError(
            f"the cells are {width:.9g} m by {height:.9g} m, which puts patches beside their cells over {rows} rows "
            f"and {cols} columns; link the raster through terrain.reproject to make them square"
        )
    unknown = int(np.count_nonzero(~np.isfinite(surface.data)))
    if unknown:
        raise ValueError(f"{unknown:,} of {rows * cols:,} cells have no height; fill them with terrain.fill_voids")
    if radius is None:
        radius = (cells or 0) * cell
    half = round(radius / cell)
    if half < 1 or abs(radius - half * cell) > 1e-3 * cell:
        low = max(1, int(radius / cell))
        nearest = f"{low * cell:.9g}" if radius < cell else f"{low * cell:.9g} or {(low + 1) * cell:.9g}"
        raise ValueError(
            f"a radius of {radius:.9g} m is {radius / cell:.6g} cells of {cell:.9g} m, and must be a whole number of "
            f"them: {nearest} m"
        )
    if min(rows, cols) < 2 * half:
        raise ValueError(
            f"a terrain of {rows} by {cols} cells is smaller than one patch of {2 * half} by {2 * half}; choose a "
            f"radius of at most {min(rows, cols) // 2 * cell:.9g} m"
        )
    return half


def cut(heights: Samples, corners: Samples, size: int, step: int = 1) -> Samples:
    """Return windows of a map, (n, size, size), a copy.

    Args:
        heights: (rows, cols).
        corners: (n, 2), row and column of the north-western sample of each.
        size: samples along a side.
        step: cells from a sample to the next.
    """
    span = (size - 1) * step + 1
    windows = np.lib.stride_tricks.sliding_window_view(heights, (span, span))[:, :, ::step, ::step]
    return windows[corners[:, 0], corners[:, 1]]


def turn(samples: Samples, turns: Samples) -> Samples:
    """Return windows, each turned by one of the symmetries of the square."""
    turned = np.empty_like(samples)
    for number in np.unique(turns):
        some = np.flatnonzero(turns == number)
        picked = samples[some]
        turned[some] = np.rot90(picked[:, :, ::-1] if number >= 4 else picked, int(number) % 4, axes=(1, 2))
    return turned


def moments(samples: Samples, metric: Metric) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the mean of each window and the norm of what is left without it, both (n,) and in the metric."""
    counts = mass(samples.shape[-1], metric).ravel()
    values = samples.reshape(len(samples), -1).astype(np.float64)
    means = values @ (counts / counts.sum())
    values -= means[:, None]
    np.square(values, out=values)
    return means, np.sqrt(values @ counts)


def shaped(norms: Samples, means: Samples, size: int, metric: Metric) -> npt.NDArray[np.bool_]:
    """Say which windows are not flat, from their norms and mean heights: below float32's steps is no relief either."""
    rounding = np.finfo(np.float32).eps * np.sqrt(mass(size, metric).sum()) * np.abs(means)
    found: npt.NDArray[np.bool_] = norms > np.maximum(FLAT * norms.max(), rounding)
    return found


def blocks(count: int, size: int) -> Iterator[slice]:
    """Yield ranges over `count` windows, of `BLOCK` samples at most."""
    step = max(1, BLOCK // size**2)
    for start in range(0, count, step):
        yield slice(start, min(start + step, count))
