"""Cutting a terrain into the patches that are coded, or learned from."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node
from nodegraph_sparse.dictionary import Patches
from nodegraph_sparse.metric import Metric, means, offsets
from nodegraph_sparse.patch_grid import patch_grid
from nodegraph_sparse.windows import blocks, cut, half_side, turn
from nodegraph_terrain.forecasts import outline
from nodegraph_terrain.raster import Elevation

Rotations = Literal["none", "quarter", "any"]
Samples = npt.NDArray[Any]


@node(version=1)
def patches(
    surface: Elevation,
    *,
    radius: Annotated[float | None, Param("R, of the discs: a whole number of cells.", gt=0, unit="m")] = None,
    cells: Annotated[int | None, Param("R in cells of the terrain, instead of metres.", ge=1)] = None,
    metric: Annotated[Metric, Param("What samples count: weighted as in the blend, or plain, all alike.")] = "weighted",
    count: Annotated[int, Param("Patches at random places; 0: the grid that covers the terrain.", ge=0)] = 0,
    rotations: Annotated[Rotations, Param("How patches at random places are turned.")] = "none",
    mirror: Annotated[bool, Param("Take every other patch at random places as in a mirror, by chance.")] = False,
    seed: Annotated[int, Param("Another one gives other places.", ge=0)] = 0,  # noqa: ARG001
    context: Context,
) -> Patches:
    """Cut a terrain into pieces over discs, each less its mean.

    A patch is a square of 2 R / cell samples around a disc of radius R.  Its mean z, weighted by the metric, is kept
    apart: what is left has no product with a constant.

    - `count` 0: the patches of a square grid of step R, which cover the terrain (`PatchGrid`).  Blended with the
      weights (1 - (r/R)^2)^3 they give the terrain back.  Samples of border patches beyond the terrain are continued by
      odd reflection, 2 h(edge) - h(mirrored), which keeps slopes; they belong to border patches alone.
    - `count` > 0: that many patches from within the terrain, their centres on corners of cells, drawn evenly with
      repetition.  Each may be turned by chance, by ``quarter`` turns or by ``any`` angle (then resampled with a cubic
      B-spline), and mirrored: more to learn from.  Such patches do not cover the terrain and cannot be coded as one.

    Args:
        surface: a terrain in metres, with square cells and without voids.
        radius: R, m.
        cells: R / cell.  A graph that states it works on terrain of any cell size.
        metric: ``weighted`` by the blend, so that samples outside of the disc count nothing, or ``plain``.
        count: of random patches, or 0.
        rotations: ``none``, ``quarter`` or ``any``.
        mirror: half of the patches, by chance, as in a mirror.
        seed: of places, turns and mirrors.
        context: the engine's.

    Returns:
        n = about 4 w h / K patches of K = (2 R / cell)^2 samples: four times the cells of the terrain.

    Raises:
        ValueError: the terrain is in degrees, has voids, cells that are not square or less cells than a patch; the
            radius is stated twice or not at all, or is no whole number of cells; or patches of the grid are to be
            turned.

    Complexity: O(n K).

    Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum
    35(2), section 4.2, doi:10.1111/cgf.12821.
    """
    half = half_side(surface, radius, cells)
    if count == 0:
        if rotations != "none" or mirror:
            raise ValueError("turned or mirrored patches do not cover a terrain; give a count of random ones")
        return grid_patches(surface, half, metric, context)
    return _random_patches(surface, half, metric, count, rotations, mirror, context)


@patches.forecast
def _forecast(surface: Forecast, *, radius: float | None, cells: int | None, count: int, **_: object) -> Forecast:
    known = outline(surface)
    if known is None:
        return Forecast(4 * surface.bytes, 2 * surface.bytes)
    terrain = 4 * known.rows * known.cols
    size = 2 * (cells or (radius or 0) / known.cell_size[0])
    return Forecast(int(count * size**2 * 4) if count else 4 * terrain, 2 * terrain + (64 << 20))


def grid_patches(surface: Elevation, half: int, metric: Metric, context: Context) -> Patches:
    """Return the patches of `half` cells' radius that cover a surface in order."""
    rows, cols = surface.shape
    grid = patch_grid(surface.extent, (rows, cols), half)
    before = half - half // 2
    after = [half * count - before + half - side for count, side in ((grid.rows, rows), (grid.cols, cols))]
    beyond = [(before, max(0, count)) for count in after]
    heights = np.pad(surface.data, beyond, mode="reflect", reflect_type="odd")
    corners = half * np.stack(np.divmod(np.arange(grid.count), grid.cols), axis=1)
    samples = np.empty((grid.count, 2 * half, 2 * half), np.float32)
    levels = np.empty(grid.count)
    for part in blocks(grid.count, 2 * half):
        context.progress(part.start / grid.count)
        levels[part] = _centred(cut(heights, corners[part], 2 * half), metric, samples[part])
    return Patches(samples, levels, grid.centres, grid.radius, metric, grid)


def _random_patches(
    surface: Elevation, half: int, metric: Metric, count: int, rotations: Rotations, mirror: bool, context: Context
) -> Patches:
    rows, cols = surface.shape
    # A square turned by any angle reaches farther.
    reach = half + 1 + int((np.sqrt(2) - 1) * half) if rotations == "any" else half
    if min(rows, cols) < 2 * reach:
        raise ValueError(
            f"a terrain of {rows} by {cols} cells is too small to turn patches of {2 * half} by {2 * half} in: it "
            f"takes {2 * reach} cells; choose a smaller radius or quarter turns"
        )
    # Drawn apart, so that places stay when turns or mirrors are asked for.
    places, turning, mirroring = context.rng.spawn(3)
    centres = np.stack([places.integers(reach, side - reach + 1, count) for side in (rows, cols)], axis=1)
    mirrored = 4 * (mirroring.integers(0, 2, count) if mirror else np.zeros(count, np.int64))
    samples = np.empty((count, 2 * half, 2 * half), np.float32)
    levels = np.empty(count)
    heights = surface.data
    if rotations == "any":
        from scipy.ndimage import spline_filter

        angles = turning.uniform(0, 2 * np.pi, count)
        heights = spline_filter(surface.data.astype(np.float64), 3, mode="mirror")
    turns = mirrored + (turning.integers(0, 4, count) if rotations == "quarter" else 0)
    for part in blocks(count, 2 * half):
        context.progress(part.start / count)
        if rotations == "any":
            found = _turned(heights, centres[part], half, angles[part])
        else:
            found = cut(heights, centres[part] - half, 2 * half)
        levels[part] = _centred(turn(found, turns[part]), metric, samples[part])
    cell = surface.extent.width / cols
    places_m = np.stack(
        [surface.extent.west + cell * centres[:, 1], surface.extent.north - cell * centres[:, 0]], axis=1
    )
    return Patches(samples, levels, places_m, half * cell, metric)


def _turned(filtered: Samples, centres: Samples, half: int, angles: Samples) -> Samples:
    """Return windows around corners of cells, turned anticlockwise, from the B-spline coefficients of a map."""
    from scipy.ndimage import map_coordinates

    away = half * offsets(2 * half)
    cosine, sine = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    # What ends up down and right of the centre came from there turned back; rows run south.
    down, right = away[:, None] * cosine + away * sine, away * cosine - away[:, None] * sine
    # The corner between cells r - 1 and r lies at r - 1/2 in cell centres.
    where = np.stack([centres[:, 0, None, None] - 0.5 + down, centres[:, 1, None, None] - 0.5 + right])
    return np.asarray(map_coordinates(filtered, where, order=3, mode="mirror", prefilter=False))


def _centred(found: Samples, metric: Metric, into: Samples) -> Samples:
    """Write windows less their means into an array; return the means."""
    levels = means(found, metric)
    np.subtract(found, levels[:, None, None], out=into, casting="same_kind", dtype=np.float64)
    return levels
