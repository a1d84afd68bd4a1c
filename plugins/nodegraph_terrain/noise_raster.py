"""Rough ground as a raster: a sum of noise at the centres of cells."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, pointwise
from nodegraph_terrain.blocks import GROUP, padded, row_blocks
from nodegraph_terrain.forecasts import Outline, check_cells, outline
from nodegraph_terrain.noise import MOST, Kind, Noise
from nodegraph_terrain.raster import Elevation, Extent, Grid

Edges = tuple[float, float, float, float]

KERNELS = Path(__file__).with_name("noise_raster.cl")
SPAN = 32
"""Cells of the finest lattice that a tile of the device reaches from its middle, at most, where 8 cells do not."""

WORK = 1 << 25
"""Cells times lattices that a device is given at a time, so that a cancel need not wait for more."""


@node(version=1, locality=pointwise)
def noise(
    like: Grid | None = None,
    *,
    extent: Annotated[Edges, Param("Outer edges (west, south, east, north), without a raster to follow.", unit="m")] = (
        0.0,
        0.0,
        10240.0,
        10240.0,
    ),
    cell_size: Annotated[float, Param("Side of a cell, without a raster to follow.", gt=0, unit="m")] = 20.0,
    rows: Annotated[int | None, Param("Rows, instead of a cell size.", ge=1)] = None,
    columns: Annotated[int | None, Param("Columns, instead of a cell size.", ge=1)] = None,
    crs: Annotated[str, Param("Coordinate reference system of the extent, such as EPSG:32632.")] = "",
    kind: Annotated[Kind, Param("How octaves are summed; gradient is a single one.")] = "fbm",
    octaves: Annotated[int, Param("Number of scales.", ge=1, le=MOST)] = 8,
    wavelength: Annotated[float, Param("Size of the largest features.", ge=1e-6, le=1e12, unit="m")] = 2000.0,
    lacunarity: Annotated[float, Param("Frequency of an octave over that of the one before.", ge=1, le=16)] = 2.0,
    gain: Annotated[float, Param("Amplitude of an octave over that of the one before.", ge=0, le=2)] = 0.5,
    feedback: Annotated[float, Param("How much height lets detail in: ridged, hybrid.", ge=0, le=16)] = 2.0,
    warp: Annotated[float, Param("Displacement in wavelengths: warped.", ge=0, le=4)] = 0.3,
    kappa: Annotated[float, Param("Level of detail: 0 is level, 1 has all octaves.", ge=0, le=1)] = 1.0,
    amplitude: Annotated[float, Param("What the noise, -1 to 1, is multiplied by.", unit="m")] = 500.0,
    offset: Annotated[float, Param("What is added then.", unit="m")] = 0.0,
    seed: Annotated[int, Param("Another one gives other ground.", ge=0, le=0xFFFFFFFF)] = 0,
    context: Context,
) -> Elevation:
    """Make rough ground: fractal noise at the centres of cells.

    height = offset + amplitude * noise(x, y), where the noise is one of the sums in `nodegraph_terrain.noise`:

    - ``gradient``: one octave, smooth hills; -1 to 1.
    - ``fbm``: fractional Brownian motion, equally rough everywhere; -1 to 1.
    - ``billow``: turbulence, round humps between creases; 0 to 1.
    - ``ridged``: Musgrave's ridged multifractal, sharp crests and smooth valleys; 0 to 1.
    - ``hybrid``: Musgrave's hybrid multifractal, smooth basins and rough heights; -0.18 to 1.
    - ``warped``: fbm with its domain displaced by fbm, as if folded; -1 to 1.

    These bounds are proven and seldom approached: fbm has a standard deviation of about 0.18.  Octaves finer than two
    cells only alias: with a lacunarity of 2, log2(wavelength / cell_size) octaves are enough.

    The noise is a function of the coordinates, the same at each point whatever the grid: neighbouring rasters
    fit, and a window is equal to the same window of a larger raster, bit for bit on the host (to 1e-6 of a cell where
    edges are no decimal numbers of as many digits).  It has no period within 2^31 cells of its finest octave from the
    origin; what lies beyond is refused.

    Args:
        like: any grid in metres: its extent, system and shape are taken, its contents ignored.
        extent: the rectangle to cover; with a `cell_size` it grows to the east and south to whole cells.
        cell_size: side of a square cell.
        rows, columns: the shape, both or none; cells may then be rectangular.
        crs: coordinate reference system of `extent`.
        kind: which sum.
        octaves: how many scales, each with its own seed and rotation.
        wavelength: side of the lattice's cells in the first octave.
        lacunarity: ratio of frequencies.
        gain: ratio of amplitudes.
        feedback: of ``ridged`` and ``hybrid``.
        warp: of ``warped``.
        kappa: continuous level of detail; octaves fade in one after the other.
        amplitude: height of the noise.
        offset: height at noise 0.
        seed: of all octaves.
        context: the engine's.

    Returns:
        Heights in metres, without voids.

    Raises:
        ValueError: the grid is in degrees or has too many cells, only one of rows and columns is given, or the extent
            is too far from the origin.

    References:
        K. Perlin (2002): Improving noise. ACM Trans. Graph. 21(3). doi:10.1145/566654.566636.
        F. K. Musgrave in D. S. Ebert et al. (2003): Texturing and Modeling: A Procedural Approach. 3rd ed., chapter 16.
    """
    grid = _grid(like, extent, cell_size, rows, columns, crs)
    ground = Noise(kind, octaves, wavelength, lacunarity, gain, seed, feedback, warp)
    x, y = centres(grid)
    heights = np.empty((grid.rows, grid.cols), np.float32)
    for part in row_blocks(grid.rows, grid.cols * len(ground.lattices), context):
        values = ground.value(x, y[part, None], kappa=None if kappa == 1 else kappa)
        values *= amplitude
        values += offset
        heights[part] = values
    return Elevation(heights, grid.extent)


@noise.opencl(rtol=1e-5)
def _twin(
    like: Grid | None = None,
    *,
    extent: Edges,
    cell_size: float,
    rows: int | None,
    columns: int | None,
    crs: str,
    kind: Kind,
    octaves: int,
    wavelength: float,
    lacunarity: float,
    gain: float,
    feedback: float,
    warp: float,
    kappa: float,
    amplitude: float,
    offset: float,
    seed: int,
    context: Context,
) -> Elevation:
    device = context.device
    assert device is not None
    grid = _grid(like, extent, cell_size, rows, columns, crs)
    ground = Noise(kind, octaves, wavelength, lacunarity, gain, seed, feedback, warp)
    width, height = grid.cell_size
    # The widest tile that keeps float32 exact on the finest lattice, of 8 to 256 cells.
    finest = max(lattice.frequency for lattice in ground.lattices) * max(width, height)
    tile = min(8, max(3, int(math.log2(2 * SPAN / finest)))) if finest < SPAN else 3
    side = 1 << tile
    x, y = (ends[side // 2 :: side] for ends in centres(grid, side))
    words = device.from_host(ground.table())
    heights: Any = device.empty((grid.rows, grid.cols))
    for part in row_blocks(len(y), grid.cols * side * len(ground.lattices), context, cells=WORK):
        origins = device.from_host(ground.origins(x, y[part, None]).ravel())
        first, last = part.start * side, min(grid.rows, part.stop * side)
        size = padded(GROUP, -(-grid.cols // 8), last - first)
        scalars = (tile, grid.rows, grid.cols, first, last, width, height, int(kappa != 1), kappa, amplitude, offset)
        device.run(KERNELS, "noise_cells", size, words, origins, *scalars, heights, local_size=GROUP)
        if last < grid.rows:
            device.finish()
    return Elevation(heights, grid.extent)


@noise.forecast
def _forecast(
    like: Forecast | None = None,
    *,
    extent: Edges,
    cell_size: float,
    rows: int | None,
    columns: int | None,
    crs: str,
    **_: object,
) -> Forecast:
    if like is not None:
        known = outline(like)
        return known.forecast() if known is not None else Forecast(like.bytes)
    try:
        return _grid(None, extent, cell_size, rows, columns, crs).forecast()
    except ValueError:
        return Forecast(0)


def centres(grid: Outline, multiple: int = 1) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the coordinates of the centres of columns and of rows, continued to a multiple of some number of each.

    Rounded to a decimal place below a millionth of a cell, so that a cell has the same ones in every window.

    >>> [ends.tolist() for ends in centres(Outline(1, 3, Extent(0.0, 0.0, 0.3, 0.1)))]
    [[0.05, 0.15, 0.25], [0.05]]
    """
    ends = []
    counts, edges, signs = (grid.cols, grid.rows), (grid.extent.west, grid.extent.north), (1, -1)
    for count, edge, size, sign in zip(counts, edges, grid.cell_size, signs, strict=True):
        whole = -(-count // multiple) * multiple
        places = 6 - math.floor(math.log10(size))
        ends.append(np.round(edge + sign * size * (np.arange(whole) + 0.5), places))
    return ends[0], ends[1]


def _grid(
    like: Grid | None, extent: Edges, cell_size: float, rows: int | None, columns: int | None, crs: str
) -> Outline:
    """Return the grid to fill."""
    if like is not None:
        if like.extent.unit != "m":
            raise ValueError("the grid linked to like is in degrees; link it through terrain.reproject to get metres")
        return Outline(*like.shape, like.extent)
    west, south, east, north = map(float, extent)
    box = Extent(west, south, east, north, crs)
    if (rows is None) != (columns is None):
        raise ValueError("give both rows and columns, or neither of them")
    if rows is None or columns is None:
        # An edge within a millionth of a cell of another is that one.
        rows, columns = (max(1, math.ceil(length / cell_size - 1e-6)) for length in (box.height, box.width))
        box = replace(box, south=box.north - rows * cell_size, east=box.west + columns * cell_size)
    check_cells(rows, columns)
    return Outline(rows, columns, box)
