"""Reprojecting to square cells in metres."""

from __future__ import annotations

from math import ceil, cos, floor, radians, sqrt
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.forecasts import Outline, check_cells, outline
from nodegraph_terrain.georeference import bounds_in, crs_text, metre_crs, parse_crs, transformed
from nodegraph_terrain.interpolation import REACH, spline_coefficients, without_voids
from nodegraph_terrain.raster import Extent, Raster

T = TypeVar("T", bound=Raster)

PLACE_ERROR = 1e-3
"""Largest error of the place where a new cell takes its value, in old cells."""

_BLOCK = 1 << 18


@node(version=1, locality=whole)
def reproject(
    surface: T,
    *,
    cell_size: Annotated[
        float | None, Param("Side of the new cells; none: as many cells as before, about.", gt=0, unit="m")
    ] = None,
    crs: Annotated[
        str, Param("Projected system in metres, such as EPSG:32632; auto: the UTM zone of the centre.")
    ] = "auto",
    resampling: Annotated[
        Literal["nearest", "bilinear", "cubic"], Param("How values between cells are taken; cubic: B-spline.")
    ] = "cubic",
    trim: Annotated[bool, Param("Cut off the void border that turning the grid leaves.")] = True,
    context: Context,
) -> T:
    """Reproject a raster to square cells in metres.

    The new cells are aligned: their edges lie on whole multiples of `cell_size`, so two neighbouring tiles that are
    reprojected alike fit together.  Each new cell takes the value at the place of its centre in the old grid, exact to
    a thousandth of a cell; where the new cells are k times as large as the old ones, the mean of round(k) by round(k)
    places spread over it.  Between the old centres values are those of the ``nearest`` one, ``bilinear``, or those of
    the interpolating ``cubic`` B-spline, which is twice continuously differentiable.  A place is void where less than
    half of the bilinear weight falls on known cells.

    ``auto`` keeps a projected system that is in metres (except Mercator world maps, whose metres are not those of the
    ground) and takes the WGS 84 / UTM zone of the raster's centre for anything else; beyond 84 N and 80 S polar
    stereographic.  Without a `cell_size` a cell keeps its mean ground area, rounded to three digits.

    A grid that is turned or bent leaves cells without source along its border.  `trim` keeps the largest rectangle
    without any; it depends on where the raster lies, not on the voids in it.  Without `trim` these cells are void.
    Heights are not changed: no shift between vertical systems is applied.  Masks, shades and slopes are clamped to the
    range of their role.

    Raises:
        ValueError: the raster has no coordinate system, `crs` is unknown or not in metres, or the cells are larger than
            the raster or too many.

    References: Snyder 1987, Map projections, a working manual, doi:10.3133/pp1395 (computed by PROJ).  Unser 1999,
    Splines: a perfect fit for signal and image processing, doi:10.1109/79.799930.
    """
    target = metre_crs(crs, surface.extent)
    old = Outline(*surface.shape, surface.extent)
    side = cell_size if cell_size is not None else _ground_side(old)
    bounds = bounds_in(surface.extent, target)
    if bounds is None:
        raise ValueError(f"the raster lies outside of what {crs_text(target)[:60]} can show; choose another crs")
    width, height = _ground(old.extent)
    if side * side > 4 * width * height:
        raise ValueError(_no_cell(side))
    new = _aligned(bounds, side, crs_text(target))
    check_cells(new.rows, new.cols)
    where = _Places(old, new, target)
    sampler = _Sampler(surface.data, resampling)
    down, across = max(1, round(side * old.rows / height)), max(1, round(side * old.cols / width))
    heights = np.empty((new.rows, new.cols), np.float32)
    inside = np.empty((new.rows, new.cols), np.bool_)
    for part in row_blocks(new.rows, new.cols, context, cells=max(1, _BLOCK // (down * across))):
        heights[part], inside[part] = _means(where, sampler, part, down, across)
    result = type(surface)(np.asarray(surface.bounded(heights)), new.extent)
    if not trim:
        return result
    if not inside.any():
        raise ValueError(_no_cell(side))
    trimmed = result.window(*largest_rectangle(inside))
    return trimmed if trimmed.shape == result.shape else trimmed.like(trimmed.data.copy())


@reproject.forecast
def _forecast(surface: Forecast, *, cell_size: float | None, trim: bool, **_: object) -> Forecast:
    known = outline(surface)
    if known is None:
        return Forecast(surface.bytes * 2, surface.bytes)
    width, height = _ground(known.extent)
    side = cell_size if cell_size is not None else _ground_side(known)
    # The exact grid takes a projection to know; its size on the ground is near enough for a forecast.
    rows, cols = max(1, ceil(height / side)), max(1, ceil(width / side))
    predicted = Outline(rows, cols, Extent(0.0, 0.0, cols * side, rows * side)).forecast(peak_bytes=5 if trim else 1)
    return Forecast(predicted.bytes, predicted.peak + 17 * known.rows * known.cols + (64 << 20), predicted.about)


class _Places:
    """Where the new cells lie in the old grid, as fractional rows and columns of cell centres.

    The projection is computed on a lattice of every few cells and interpolated between by cubic splines; the lattice is
    refined until halfway between its points it is right to `PLACE_ERROR` cells.
    """

    def __init__(self, old: Outline, new: Outline, target: Any) -> None:
        self.old, self.new = old, new
        self._source, self._target = parse_crs(old.extent.crs), target
        step = 64
        while True:
            rows, cols = _lattice(new.rows, step), _lattice(new.cols, step)
            self._splines = [_spline(rows, cols, values) for values in self._exact(rows, cols)]
            between = (rows[:-1] + rows[1:]) / 2, (cols[:-1] + cols[1:]) / 2
            error = max(
                float(np.abs(spline(*between) - exact).max())
                for spline, exact in zip(self._splines, self._exact(*between), strict=True)
            )
            if error <= PLACE_ERROR or step == 1:
                return
            step //= 4

    def at(
        self, rows: npt.NDArray[np.float64], cols: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the old (row, column) of the grid of new `rows` and `cols`, counted in cells from the first edge."""
        row, col = (spline(rows, cols) for spline in self._splines)
        return row, col

    def _exact(
        self, rows: npt.NDArray[np.float64], cols: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        extent, (dx, dy) = self.new.extent, self.new.cell_size
        x, y = np.meshgrid(extent.west + cols * dx, extent.north - rows * dy)
        x, y = transformed(self._target, self._source, x, y)
        own, (dx, dy) = self.old.extent, self.old.cell_size
        if own.unit == "deg":
            # Longitudes count on from the raster's own, across 180 degrees if it lies there.
            middle = (own.west + own.east) / 2
            x = middle + np.mod(x - middle + 180, 360) - 180
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise ValueError(
                f"the raster reaches beyond what {crs_text(self._target)[:60]} can show; crop it or choose another crs"
            )
        return (own.north - y) / dy - 0.5, (x - own.west) / dx - 0.5


def _lattice(count: int, step: int) -> npt.NDArray[np.float64]:
    """Return positions from 0 to `count`, about `step` apart, at least the four that a cubic spline takes."""
    return np.linspace(0.0, count, max(4, ceil(count / step) + 1))


def _spline(rows: npt.NDArray[np.float64], cols: npt.NDArray[np.float64], values: npt.NDArray[np.float64]) -> Any:
    from scipy.interpolate import RectBivariateSpline

    return RectBivariateSpline(rows, cols, values, kx=3, ky=3, s=0)


class _Sampler:
    """Values between the centres of cells; NaN where they are not known."""

    def __init__(self, values: npt.NDArray[np.float32], method: str) -> None:
        missing = np.isnan(values)
        self._order = {"nearest": 0, "bilinear": 1, "cubic": 3}[method]
        self._known = ~missing if self._order and missing.any() else None
        if self._order == 3:
            self._values: npt.NDArray[Any] = spline_coefficients(
                values if self._known is None else without_voids(values, missing)
            )
        else:
            self._values = values if self._known is None else np.where(missing, np.float32(0), values)

    def at(self, row: npt.NDArray[np.float64], col: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the values at fractional rows and columns of centres; beyond the outer centres at most half a cell."""
        shift = REACH if self._order == 3 else 0
        found = self._take(self._values, (row + shift, col + shift), self._order)
        if self._known is not None:
            share = self._take(self._known.astype(np.float32), (row, col), 1)
            with np.errstate(divide="ignore", invalid="ignore"):
                found = np.where(share < 0.5, np.nan, found if self._order == 3 else found / share)
        return found

    @staticmethod
    def _take(values: npt.NDArray[Any], places: Any, order: int) -> npt.NDArray[np.float64]:
        from scipy import ndimage

        taken = ndimage.map_coordinates(values, places, output=np.float64, order=order, mode="nearest", prefilter=False)
        return np.asarray(taken)


def _means(
    where: _Places, sampler: _Sampler, part: slice, down: int, across: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Return the values of a block of new rows, means of `down` by `across` places each, and which lie inside."""
    rows = part.start + (np.arange((part.stop - part.start) * down) + 0.5) / down
    cols = (np.arange(where.new.cols * across) + 0.5) / across
    row, col = where.at(rows, cols)
    # The outer edge itself counts as inside, up to the error of the places.
    low = -0.5 - PLACE_ERROR
    inside = (row >= low) & (col >= low)
    inside &= (row <= where.old.rows - 1 - low) & (col <= where.old.cols - 1 - low)
    values = np.where(inside, sampler.at(row, col), np.nan)
    if down == across == 1:
        return values, inside
    known = ~np.isnan(values)
    groups = part.stop - part.start, down, where.new.cols, across
    total = np.where(known, values, 0.0).reshape(groups).sum(axis=(1, 3))
    count = known.reshape(groups).sum(axis=(1, 3))
    covered = inside.reshape(groups).sum(axis=(1, 3))
    places = down * across
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(2 * count >= places, total / count, np.nan)
    return mean, 2 * covered >= places


def _no_cell(side: float) -> str:
    return f"cell_size {side:g} m leaves no cell inside the raster; choose a smaller one"


def _ground(extent: Extent) -> tuple[float, float]:
    """Return width and height of an extent on the ground, in metres, on a sphere."""
    if extent.unit == "m":
        return extent.width, extent.height
    degree = 6_371_000 * radians(1)
    middle = radians((extent.south + extent.north) / 2)
    return extent.width * degree * max(cos(middle), 1e-3), extent.height * degree


def _ground_side(grid: Outline) -> float:
    """Return the side of a square as large as a cell on the ground, rounded to three digits."""
    width, height = _ground(grid.extent)
    return float(f"{sqrt(width / grid.cols * height / grid.rows):.3g}")


def _aligned(bounds: tuple[float, ...], side: float, crs: str) -> Outline:
    """Return the grid of cells on multiples of `side` that covers `bounds`."""
    # A thousandth of a cell is rounding, and not worth a row of its own.
    west, south = (floor(edge / side + 1e-3) for edge in bounds[:2])
    east, north = (ceil(edge / side - 1e-3) for edge in bounds[2:])
    rows, cols = max(1, north - south), max(1, east - west)
    return Outline(rows, cols, Extent(west * side, (north - rows) * side, (west + cols) * side, north * side, crs))


def largest_rectangle(inside: npt.NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return rows and columns of the largest rectangle of true cells, where every row's true cells are one run.

    Of a row with several runs the longest counts.  O(rows^2) on whole rows at a time.

    >>> largest_rectangle(np.array([[0, 1, 1, 0], [1, 1, 1, 1], [1, 1, 1, 0]], bool))
    (slice(0, 3, None), slice(1, 3, None))
    """
    start, stop = _runs(inside)
    best, found = 0, (0, 0, 0, 0)
    width = inside.shape[1]
    for top in range(inside.shape[0]):
        if (inside.shape[0] - top) * width <= best:
            break
        left = np.maximum.accumulate(start[top:])
        right = np.minimum.accumulate(stop[top:])
        areas = np.maximum(right - left, 0) * np.arange(1, len(left) + 1)
        index = int(np.argmax(areas))
        if areas[index] > best:
            best, found = int(areas[index]), (top, top + index + 1, int(left[index]), int(right[index]))
    return slice(found[0], found[1]), slice(found[2], found[3])


def _runs(inside: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return where the longest run of true cells of every row starts and stops (an empty row: 0, 0)."""
    some = inside.any(axis=1)
    start = np.where(some, inside.argmax(axis=1), 0)
    stop = np.where(some, inside.shape[1] - inside[:, ::-1].argmax(axis=1), 0)
    for row in np.flatnonzero(inside.sum(axis=1) != stop - start):
        changes = np.flatnonzero(np.diff(np.concatenate([[False], inside[row], [False]]).astype(np.int8)))
        longest = int(np.argmax(changes[1::2] - changes[::2]))
        start[row], stop[row] = changes[2 * longest], changes[2 * longest + 1]
    return start, stop
