"""Blending a patch of terrain into another without a seam."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_hydrology import poisson
from nodegraph_hydrology.placement import Placed, Similarity, place
from nodegraph_terrain.multigrid import System, without_value
from nodegraph_terrain.raster import Elevation, Mask, ground_cell, require_same_grid

Array = npt.NDArray[Any]
TOLERANCE = 1e-6
"""Largest error of multigrid, relative to the height that the patch is moved by."""


@node(version=1, locality=whole)
def poisson_blend(
    base: Elevation,
    patch: Elevation,
    mask: Mask | None = None,
    *,
    position: Annotated[
        tuple[float, float] | None,
        Param("East and north of the patch's centre; none: where its own extent lies.", unit="m"),
    ] = None,
    rotation: Annotated[float, Param("Turn of the patch, counter-clockwise.", ge=-360, le=360, unit="deg")] = 0.0,
    size: Annotated[float, Param("Width of the patch on the ground, times its own.", gt=0, le=1000)] = 1.0,
    relief: Annotated[
        float, Param("The patch's gradients are multiplied by it; negative turns it upside down.", ge=-1000, le=1000)
    ] = 1.0,
    mixed: Annotated[bool, Param("Take the stronger gradient of patch and base: the base shows through.")] = False,
    feather: Annotated[
        float, Param("Distance from the seam over which the base's gradients turn into the patch's.", ge=0, unit="m")
    ] = 0.0,
    context: Context,
) -> Elevation:
    """Blend a patch of terrain into a base: the patch's slopes, at the base's height along the seam.

    Inside the region R that the patch covers, the result u solves the Poisson equation

        div grad u = div g in R,   u = base around R,

    for the guiding gradients g: `relief` times those of the patch, or with `mixed` wherever the base's is steeper that
    one, and within `feather` of the seam a smooth transition from the base's.  Poisson's equation closes the step at
    the seam; rough ground beside smooth ground still shows where one ends, which is what `feather` is for.

    Gradients are forward differences and the divergence takes backward ones, so that div grad is exactly the 5-point
    Laplacian: a block blended onto itself comes back unchanged.  What is solved for is u minus the patch, which is
    harmonic where g is the patch's gradient: the equation moves the patch up and down as smoothly as can be, and no
    digit of its detail is lost.

    R is made of the base's cells whose place in the patch, and those of their four neighbours, lie between known cell
    centres of the patch, and where the `mask` is at least a half.  So voids of the patch stay out of R.  Voids of the
    base stay void; they do not hold the patch, nor does the outer edge of the base, where the part of the patch beyond
    is cut off.  A part of R without any cell of the base around it is left as it was.  Cells outside R keep their
    values exactly.

    A rectangular R takes the exact sine transform, any other multigrid (error 1e-6 of the largest shift).

    Args:
        base: the terrain that is blended into.
        patch: the terrain that is blended in; cells of any size.  Between its cell centres heights are those of the
            cubic B-spline; where it has finer cells than the base, means.
        mask: how much of the patch counts, on the patch's grid.
        position: where the patch goes.
        rotation: about its centre.
        size: of the patch on the ground; heights stay (see `relief`).
        relief: scale of the gradients.
        mixed: mixed gradients.
        feather: width of the transition inside the seam.
        context: the engine's.

    Raises:
        ValueError: base and patch are not in the same unit or system; a patch in degrees is to be turned; the patch
            covers no cell of the base, or all of them.

    References:
        H. Zhang, D. Qu, Y. Hou, F. Gao, F. Huang (2016): Synthetic modeling method for large scale terrain based on
        hydrology, section VI (eqs. 7-9, with the signs corrected). IEEE Access 4. doi:10.1109/ACCESS.2016.2612700.
        P. Perez, M. Gangnet, A. Blake (2003): Poisson image editing. ACM Trans. Graph. 22(3).
        doi:10.1145/882262.882269.
    """
    where = _similarity(base, patch, position, rotation, size, feather)
    return _blend(base, patch, mask, where, relief, mixed, feather, context)


@poisson_blend.opencl(rtol=1e-5, atol=1e-2)
def _twin(
    base: Elevation,
    patch: Elevation,
    mask: Mask | None = None,
    *,
    position: tuple[float, float] | None,
    rotation: float,
    size: float,
    relief: float,
    mixed: bool,
    feather: float,
    context: Context,
) -> Elevation:
    from nodegraph.opencl import to_device, to_host

    assert context.device is not None
    where = _similarity(base, patch, position, rotation, size, feather)
    # The equation is solved on the device; placing the patch is the host's.
    blended = _blend(to_host(base), to_host(patch), to_host(mask), where, relief, mixed, feather, context)
    return to_device(blended, context.device)


@poisson_blend.forecast
def _forecast(base: Forecast, patch: Forecast, mask: Forecast | None = None, **_: object) -> Forecast:  # noqa: ARG001
    return Forecast(base.bytes, 40 * base.bytes + 8 * patch.bytes, base.about)


def _similarity(
    base: Elevation,
    patch: Elevation,
    position: tuple[float, float] | None,
    rotation: float,
    size: float,
    feather: float,
) -> Similarity:
    own, other = base.extent, patch.extent
    if own.unit != other.unit:
        raise ValueError(
            f"the base is in {own.unit}, the patch in {other.unit}; link both through terrain.reproject to get metres"
        )
    if own.unit == "deg" and (rotation % 360 != 0 or feather > 0):
        raise ValueError("in degrees there is no rotation or feather; link both through terrain.reproject")
    if position is None:
        if own.crs and other.crs and own.crs != other.crs:
            raise ValueError("base and patch are in different systems; reproject the patch, or state a position")
        position = (other.west + other.east) / 2, (other.south + other.north) / 2
    return Similarity(position, rotation, size)


def _blend(
    base: Elevation,
    patch: Elevation,
    mask: Mask | None,
    where: Similarity,
    relief: float,
    mixed: bool,
    feather: float,
    context: Context,
) -> Elevation:
    if mask is not None:
        require_same_grid(patch, mask)
    placed = place(base, patch, mask, where, context)
    region = None if placed is None else _region(base, placed)
    if placed is None or region is None or not region.any():
        raise ValueError("the patch covers no cell of the base; move it with position, or make it larger with size")
    box = _around(region)
    rows = slice(placed.rows.start + box[0].start, placed.rows.start + box[0].stop)
    cols = slice(placed.cols.start + box[1].start, placed.cols.start + box[1].stop)
    ground, heights = base.data[rows, cols].astype(np.float64), placed.heights[box]
    region = _held(region[box], ~np.isnan(ground))
    if not region.any():
        raise ValueError("the patch covers all of the base; there is no ground left around it to hold its height")
    if relief != 1:
        heights = relief * heights
    shift = _shift(region, ground, heights, ground_cell(base), mixed, feather, context)
    blended = base.data.copy()
    window = blended[rows, cols]
    np.add(heights, shift, out=window, where=region, casting="same_kind")
    return Elevation(blended, base.extent)


def _region(base: Elevation, placed: Placed) -> Array:
    """Return which cells of the placed part are to be solved for."""
    known = placed.known & placed.wanted
    around = placed.known
    rows, cols = base.shape
    # Beyond the placed part there is no patch; beyond the base there is nothing that would need one.
    beyond = (
        (placed.rows.start == 0, placed.rows.stop == rows),
        (placed.cols.start == 0, placed.cols.stop == cols),
    )
    padded = np.pad(around, 1)
    for axis, (first, last) in enumerate(beyond):
        edges = np.moveaxis(padded, axis, 0)
        edges[0], edges[-1] = first, last
    neighbours = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return np.asarray(known & neighbours & ~np.isnan(base.data[placed.rows, placed.cols]))


def _held(region: Array, known: Array) -> Array:
    """Return the part of the region that some cell of the base around it holds."""
    if poisson.is_rectangle(region) and known.all():
        return region
    return np.asarray(region & ~without_value(region | ~known, known))


def _around(region: Array) -> tuple[slice, slice]:
    """Return the bounding box of the region with the cells beside it."""
    spans = []
    for axis in (1, 0):
        hit = np.flatnonzero(region.any(axis=axis))
        spans.append(slice(max(0, int(hit[0]) - 1), min(region.shape[1 - axis], int(hit[-1]) + 2)))
    return spans[0], spans[1]


def _shift(
    region: Array,
    ground: Array,
    heights: Array,
    cell: tuple[float, float],
    mixed: bool,
    feather: float,
    context: Context,
) -> Array:
    """Return what is to be added to the patch's heights in the region."""
    dx, dy = cell
    across: Array | float = dy / dx
    down: Array | float = dx / dy
    void = np.isnan(ground)
    whole = not void.any()
    if not whole:
        across, down = across * ~(void[:, 1:] | void[:, :-1]), down * ~(void[1:] | void[:-1])
        ground = np.where(void, heights, ground)
    ring = _beside(region) & ~void
    difference = ground[ring] - heights[ring]
    level = float(difference.mean())
    source = None
    if mixed or feather > 0:
        source = _extra_divergence(region, ground, heights, across, down, cell, mixed, feather)
    # Over a rectangle rounding grows with the source's roughness; without one float32 has digits enough.
    exact = whole and poisson.is_rectangle(region)
    precision = np.float64 if exact and source is not None else np.float32
    values = np.zeros(region.shape, precision)
    values[ring] = difference - level
    if not whole:
        across, down = np.asarray(across, np.float32), np.asarray(down, np.float32)
    system = System(values, region, across, down, None if source is None else source.astype(precision, copy=False))
    return np.asarray(poisson.solve(system, TOLERANCE, context, context.device) + level)


def _beside(region: Array) -> Array:
    """Return the cells outside of the region that share a side with one inside."""
    touched = region.copy()
    for own, other in ((touched[1:], region[:-1]), (touched[:-1], region[1:])):
        own |= other
    for own, other in ((touched[:, 1:], region[:, :-1]), (touched[:, :-1], region[:, 1:])):
        own |= other
    return np.asarray(touched & ~region)


def _extra_divergence(
    region: Array,
    ground: Array,
    heights: Array,
    across: Array | float,
    down: Array | float,
    cell: tuple[float, float],
    mixed: bool,
    feather: float,
) -> Array:
    """Return the divergence of the guiding gradients less the patch's own."""
    from scipy import ndimage

    share = np.ones(region.shape)
    if feather > 0:
        distance = ndimage.distance_transform_edt(region, sampling=(cell[1], cell[0]))
        part = np.clip(distance / feather, 0, 1)
        share = part * part * (3 - 2 * part)
    extra = []
    for axis, conductance in ((1, across), (0, down)):
        of_patch, of_base = np.diff(heights, axis=axis), np.diff(ground, axis=axis)
        stronger = np.abs(of_patch) >= np.abs(of_base) if mixed else np.True_
        first, last = (share[:, :-1], share[:, 1:]) if axis else (share[:-1], share[1:])
        weight = np.where(stronger, (first + last) / 2, 0.0)
        extra.append(conductance * (1 - weight) * (of_base - of_patch))
    return np.where(region, poisson.divergence(extra[0], extra[1]), 0.0)
