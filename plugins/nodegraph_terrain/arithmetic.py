"""Arithmetic on rasters.  The result has the role of the first raster; a void in any raster gives a void."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, TypeVar

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, halo, node, pointwise
from nodegraph_terrain.blocks import EVERYTHING, row_blocks
from nodegraph_terrain.raster import Mask, Raster, require_same_grid

T = TypeVar("T", bound=Raster)
Floats = npt.NDArray[np.float32]


@node(version=1, locality=pointwise)
def add(
    surface: T,
    *others: Raster,
    constant: Annotated[float, Param("What to add to every cell, in the unit of the surface.")] = 0.0,
    context: Context,
) -> T:
    """Add rasters cell by cell, and a constant: surface + others + constant.

    Args:
        surface: gives the result its role.
        *others: any rasters on the same grid, in the same unit.
        constant: added to every cell.
        context: the engine's.

    Raises:
        ValueError: the rasters are on different grids, or a result is too large for float32.
    """
    return _fold(np.add, surface, others, constant, context)


@node(version=1, locality=pointwise)
def subtract(
    surface: T,
    *others: Raster,
    constant: Annotated[float, Param("What to subtract from every cell, in the unit of the surface.")] = 0.0,
    context: Context,
) -> T:
    """Subtract rasters cell by cell, and a constant: surface - others - constant.

    Args:
        surface: what to subtract from; gives the result its role.
        *others: any rasters on the same grid, in the same unit.
        constant: subtracted from every cell.
        context: the engine's.

    Raises:
        ValueError: the rasters are on different grids, or a result is too large for float32.
    """
    return _fold(np.subtract, surface, others, constant, context)


@node(version=1, locality=pointwise)
def multiply(
    surface: T,
    *others: Raster,
    factor: Annotated[float, Param("What to multiply every cell by.")] = 1.0,
    context: Context,
) -> T:
    """Multiply rasters cell by cell, and by a factor: surface * others * factor.

    Args:
        surface: gives the result its role.
        *others: any rasters on the same grid, as a rule without a unit (masks, factors).
        factor: multiplies every cell.
        context: the engine's.

    Raises:
        ValueError: the rasters are on different grids, or a result is too large for float32.
    """
    return _fold(np.multiply, surface, others, factor, context)


@node(version=1, locality=pointwise)
def minimum(
    surface: T,
    *others: Raster,
    limit: Annotated[float | None, Param("A value that no cell may exceed, in the unit of the surface.")] = None,
    context: Context,
) -> T:
    """Take the least of several rasters in each cell, and of a limit.

    Args:
        surface: gives the result its role.
        *others: any rasters on the same grid, in the same unit.
        limit: the result is this at most.
        context: the engine's.

    Raises:
        ValueError: the rasters are on different grids.
    """
    return _fold(np.minimum, surface, others, limit, context)


@node(version=1, locality=pointwise)
def maximum(
    surface: T,
    *others: Raster,
    limit: Annotated[float | None, Param("A value that no cell may fall below, in the unit of the surface.")] = None,
    context: Context,
) -> T:
    """Take the greatest of several rasters in each cell, and of a limit.

    Args:
        surface: gives the result its role.
        *others: any rasters on the same grid, in the same unit.
        limit: the result is this at least.
        context: the engine's.

    Raises:
        ValueError: the rasters are on different grids.
    """
    return _fold(np.maximum, surface, others, limit, context)


@node(version=1, locality=pointwise)
def mix(first: T, second: Raster, mask: Mask, *, context: Context) -> T:
    """Mix two rasters by a mask: (1 - mask) first + mask second.

    Where the mask is 0 only the first counts, where it is 1 only the second, even if the other is void there.

    Args:
        first: what shows where the mask is 0; gives the result its role.
        second: what shows where the mask is 1, in the same unit on the same grid.
        mask: 0 to 1 (values beyond are clipped); a void gives a void.
        context: the engine's.

    Raises:
        ValueError: the rasters are on different grids.
    """
    require_same_grid(first, second, mask)
    mixed = np.empty_like(first.data, order="C")
    for part in row_blocks(*first.shape, context):
        a, b, share = first.data[part], second.data[part], np.clip(mask.data[part], 0, 1)
        between = a * (1 - share) + b * share
        mixed[part] = np.where(share == 0, a, np.where(share == 1, b, between))
    return first.like(mixed)


@node(
    version=1,
    locality=halo(
        cells=lambda from_minimum, from_maximum, **_: EVERYTHING if from_minimum is None or from_maximum is None else 0
    ),
)
def remap(
    surface: T,
    *,
    from_minimum: Annotated[
        float | None, Param("Value that becomes to_minimum; null: the least of the raster.")
    ] = None,
    from_maximum: Annotated[float | None, Param("Value that becomes to_maximum; null: the greatest.")] = None,
    to_minimum: Annotated[float, Param("What from_minimum becomes.")] = 0.0,
    to_maximum: Annotated[float, Param("What from_maximum becomes; may be below to_minimum.")] = 1.0,
    curve: Annotated[
        tuple[tuple[float, float], ...],
        Param("Points [x, y] of a curve between the two ranges, both 0 to 1; empty: a straight line."),
    ] = (),
    clamp: Annotated[bool, Param("Hold what lies beyond the first range at its ends.")] = False,
    context: Context,
) -> T:
    """Carry one range of values over to another, along a straight line or a curve.

    t = (z - from_minimum) / (from_maximum - from_minimum), result = to_minimum + f(t) (to_maximum - to_minimum).

    Without a `curve` f(t) = t.  With one, f is the monotone cubic through its points (Fritsch & Butland 1984): it never
    overshoots them, and it holds its end values beyond the first and last point.  A raster of one value gets t = 0.

    Args:
        surface: gives the result its role.
        from_minimum: lower end of the range to carry over, in the raster's unit.
        from_maximum: upper end of it.
        to_minimum: what the lower end becomes.
        to_maximum: what the upper end becomes.
        curve: at least two points, x rising.
        clamp: hold t within 0..1.
        context: the engine's.

    Raises:
        ValueError: `from_minimum` is not below `from_maximum`, or the curve's x do not rise.

    References:
        F. N. Fritsch, J. Butland (1984): A method for constructing local monotone piecewise cubic interpolants. SIAM
        J. Sci. Stat. Comput. 5(2). doi:10.1137/0905021.
    """
    shape = _curve(curve) if curve else None
    low, high = from_minimum, from_maximum
    if low is None or high is None:
        least, greatest = math.nan, math.nan
        for part in row_blocks(*surface.shape, context, stop=0.2):
            least = float(np.fmin(least, np.fmin.reduce(surface.data[part], axis=None)))
            greatest = float(np.fmax(greatest, np.fmax.reduce(surface.data[part], axis=None)))
        low, high = least if low is None else low, greatest if high is None else high
        constant = low == high or math.isnan(least)
    else:
        constant = False
    if not constant and low >= high:
        raise ValueError(f"from_minimum {low:g} must be below from_maximum {high:g}")
    remapped = np.empty_like(surface.data, order="C")
    for part in row_blocks(*surface.shape, context, start=0.2):
        share = surface.data[part].astype(np.float64)
        share -= low
        share *= 0.0 if constant else 1.0 / (high - low)
        if clamp:
            np.clip(share, 0, 1, out=share)
        if shape is not None:
            share = shape(share)
        share *= to_maximum - to_minimum
        share += to_minimum
        remapped[part] = _fits(share)
    return surface.like(remapped)


@node(version=1, locality=pointwise)
def clamp(
    surface: T,
    *,
    minimum: Annotated[float | None, Param("Least value to keep; null: none.")] = None,
    maximum: Annotated[float | None, Param("Greatest value to keep; null: none.")] = None,
    context: Context,
) -> T:
    """Hold the values of a raster within a range.

    Args:
        surface: gives the result its role.
        minimum: what lies below becomes this.
        maximum: what lies above becomes this.
        context: the engine's.

    Raises:
        ValueError: `minimum` is above `maximum`.
    """
    if minimum is not None and maximum is not None and minimum > maximum:
        raise ValueError(f"minimum {minimum:g} must not be above maximum {maximum:g}")
    return _fold(np.minimum, _fold(np.maximum, surface, (), minimum, context), (), maximum, context)


@node(version=1, locality=pointwise)
def to_mask(
    surface: Raster,
    *,
    lower: Annotated[float, Param("Value below which the mask is 0, in the raster's unit.")] = 0.0,
    upper: Annotated[float, Param("Value from which on the mask is 1; equal to lower: a sharp threshold.")] = 1.0,
    invert: Annotated[bool, Param("Swap 0 and 1.")] = False,
    context: Context,
) -> Mask:
    """Make a mask of where a raster is high, with a smooth edge.

    t = (z - lower) / (upper - lower) clipped to 0..1, mask = t^2 (3 - 2 t); with `lower` = `upper` the mask is 1 where
    z >= upper.  Voids stay void.

    Args:
        surface: any raster.
        lower: where the mask begins to rise.
        upper: where it is full.
        invert: give 1 - mask.
        context: the engine's.

    Raises:
        ValueError: `lower` is above `upper`.
    """
    if lower > upper:
        raise ValueError(f"lower {lower:g} must not be above upper {upper:g}; set invert to select low values")
    mask = np.empty_like(surface.data, order="C")
    for part in row_blocks(*surface.shape, context):
        values = surface.data[part]
        if lower == upper:
            rise = np.where(np.isnan(values), np.nan, values >= upper).astype(np.float32)
        else:
            share = np.clip((values - np.float64(lower)) * (1 / (upper - lower)), 0, 1)
            rise = (share * share * (3 - 2 * share)).astype(np.float32)
        mask[part] = 1 - rise if invert else rise
    return Mask(mask, surface.extent)


def _fold(ufunc: np.ufunc, surface: T, others: tuple[Raster, ...], value: float | None, context: Context) -> T:
    """Apply a binary operation to a raster, others in turn, and a value if there is one."""
    require_same_grid(surface, *others)
    result = np.empty_like(surface.data, order="C")
    if value is not None and abs(value) > float(np.finfo(np.float32).max):
        raise ValueError(f"{value:g} is too large for float32; give a smaller number")
    try:
        with np.errstate(over="raise"):
            for part in row_blocks(*surface.shape, context):
                block = result[part]
                block[...] = surface.data[part]
                for other in others:
                    ufunc(block, other.data[part], out=block)
                if value is not None:
                    ufunc(block, np.float32(value), out=block)
    except FloatingPointError:
        raise ValueError("a result is too large for float32; use smaller values") from None
    return surface.like(result)


def _fits(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return `values`, or raise `ValueError` where one is too large for float32."""
    if np.fmax.reduce(np.abs(values), axis=None) > np.finfo(np.float32).max:
        raise ValueError("a result is too large for float32; use a narrower range")
    return values


def _curve(points: tuple[tuple[float, float], ...]) -> Callable[[Any], Any]:
    """Return the monotone cubic through the points, held beyond its ends."""
    from scipy.interpolate import PchipInterpolator

    x, y = np.array(points, np.float64).T
    if len(x) < 2 or not np.all(np.diff(x) > 0):
        raise ValueError("the curve needs two or more points whose x rise from each to the next")
    # Differences too small for a float64 count as none.
    with np.errstate(over="ignore"):
        cubic = PchipInterpolator(x, y)

    def held(share: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(cubic(np.clip(share, x[0], x[-1])))

    return held
