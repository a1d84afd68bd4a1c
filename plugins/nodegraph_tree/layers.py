"""Layers: several trees as materials over each other - rock, sand, water - each with its own surface (section 8.4)."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, port_type, whole
from nodegraph_terrain.forecasts import Outline
from nodegraph_terrain.raster import Elevation, Extent, Grid, Mask, Raster
from nodegraph_tree.evaluate import Area, CellSize, Columns, Detail, Edges, Rows, System, grid_of, sample_grid
from nodegraph_tree.function import THRESHOLD, ElevationFunction

Singles = npt.NDArray[np.float32]


@port_type
class Layers:
    """Surfaces of materials, from the lowest to the highest in order of their laying, each a construction tree.

    Attributes:
        names: of the materials.
        functions: their surfaces.
    """

    names: tuple[str, ...]
    functions: tuple[ElevationFunction, ...]

    def index(self, name: str) -> int:
        """Return the place of a layer.  Raises `ValueError` where there is none of that name."""
        if name not in self.names:
            raise ValueError(f"there is no layer '{name}'; the layers are {', '.join(self.names)}")
        return self.names.index(name)


@port_type
class Thickness(Raster):
    """How thick a layer lies over what is below it, m."""

    unit: ClassVar[str] = "m"
    bounds: ClassVar[tuple[float, float] | None] = (0.0, np.inf)


class SampledLayer(NamedTuple):
    """What `sample_layer` gives."""

    surface: Elevation
    thickness: Thickness
    visible: Mask


@node(version=1)
def layers(
    *functions: ElevationFunction,
    names: Annotated[tuple[str, ...], Param("Names of the materials, one for each, from the lowest up.", min_length=1)],
) -> Layers:
    """Take trees as the surfaces of materials: ground, then sand, then water.

    Each has a terrain of its own (alpha >= 1/2), beyond which the material is not.

    Args:
        functions: the surfaces, in the order in which the materials were laid.
        names: of the materials.

    Raises:
        ValueError: not as many names as functions, or a name twice or empty.

    Source: Génevaux et al. 2015, section 8.4 and figures 1, 20, 21, doi:10.1111/cgf.12530.
    """
    if len(names) != len(functions):
        raise ValueError(f"{len(names)} names do not fit {len(functions)} linked layers; give one for each")
    if len(set(names)) < len(names) or not all(name.strip() for name in names):
        raise ValueError("every layer needs a name of its own")
    return Layers(tuple(names), functions)


@node(version=1)
def layer(
    layers: Layers, *, name: Annotated[str, Param("Name of the material.", min_length=1)] = "ground"
) -> ElevationFunction:
    """Take one surface out of layers.

    Args:
        layers: from `tree.layers`.
        name: of the material.

    Raises:
        ValueError: there is no such layer.
    """
    return layers.functions[layers.index(name)]


@node(version=1, locality=whole)
def sample_layer(
    layers: Layers,
    like: Grid | None = None,
    *,
    name: Annotated[str, Param("Name of the material.", min_length=1)] = "ground",
    extent: Area = None,
    cell_size: CellSize = None,
    rows: Rows = None,
    columns: Columns = None,
    crs: System = "",
    detail: Detail = 1.0,
    context: Context,
) -> SampledLayer:
    """Sample one of several layers: its surface, how thick it is, and where it is on top.

    With f_j the surface of layer j where it is (alpha_j >= 1/2), layer i is thick

        max(f_i - max_(j < i) f_j, 0)

    metres, 0 where it is not, and void where nothing lies below: the lowest layer has no thickness.  It is visible
    where it is and no other one lies higher; of layers of the same height the later one is.

    Args:
        layers: from `tree.layers`.
        like: a grid to take extent, shape and system from.
        name: of the material.
        extent: outer edges of the outer cells.
        cell_size: the extent is grown to the east and south to whole cells.
        rows: of the grid.
        columns: of the grid.
        crs: noted on the result, never changes it.
        detail: level of detail.
        context: the engine's.

    Returns:
        ``surface``: f_i, m, void where the layer is not; ``thickness``, m; ``visible``: 1 or 0.

    Raises:
        ValueError: there is no such layer, or the grid is not given, or given twice.

    Source: Génevaux et al. 2015, section 8.4, doi:10.1111/cgf.12530.
    """
    grid, shape = grid_of(like, extent, cell_size, rows, columns, crs)
    index = layers.index(name)
    surfaces = []
    for function in layers.functions:
        height = np.empty(shape, np.float32)
        for place, part in sample_grid(function, grid, shape, context, detail):
            height[place] = np.where(part.weight >= THRESHOLD, part.height, np.nan)
        surfaces.append(height)
    return _compared(surfaces, index, grid)


@sample_layer.opencl(rtol=1e-4, atol=0.04)
def _twin(
    layers: Layers,
    like: Grid | None = None,
    *,
    name: str,
    extent: Edges | None,
    cell_size: float | None,
    rows: int | None,
    columns: int | None,
    crs: str,
    detail: float,
    context: Context,
) -> SampledLayer:
    from nodegraph.opencl import to_host
    from nodegraph_tree.device import sample_on_device

    device = context.device
    assert device is not None
    grid, shape = grid_of(like, extent, cell_size, rows, columns, crs)
    held = to_host(layers)
    index = held.index(name)
    surfaces = [
        device.to_host(sample_on_device(function, grid, shape, device, context, detail)[0])
        for function in held.functions
    ]
    surface, thickness, visible = _compared(surfaces, index, grid)
    arrays: list[Any] = [device.from_host(item.data) for item in (surface, thickness, visible)]
    return SampledLayer(surface.like(arrays[0]), thickness.like(arrays[1]), visible.like(arrays[2]))


@sample_layer.forecast
def _forecast(
    layers: Forecast,  # noqa: ARG001
    like: Forecast | None,
    *,
    extent: Edges | None,
    cell_size: float | None,
    rows: int | None,
    columns: int | None,
    **_: object,
) -> Forecast:
    if like is not None and isinstance(like.about, Outline):
        outline = like.about
    else:
        try:
            grid, (high, wide) = grid_of(None, extent, cell_size, rows, columns, "")
        except ValueError:
            return Forecast(0)
        outline = Outline(high, wide, grid)
    size = 4 * outline.rows * outline.cols
    return Forecast(3 * size, 8 * size, outline)


def _compared(surfaces: list[Singles], index: int, grid: Extent) -> SampledLayer:
    """Compare one surface with those below and above it."""
    own = surfaces[index]
    there = ~np.isnan(own)
    below = np.full_like(own, -np.inf)
    for other in surfaces[:index]:
        np.fmax(below, other, out=below)
    with np.errstate(invalid="ignore"):
        thick = np.where(there, np.maximum(own - below, 0), np.float32(0))
        thick[np.isneginf(below) & there] = np.nan
        seen = there & (own >= below)
        for other in surfaces[index + 1 :]:
            seen &= ~(other >= own)
    return SampledLayer(
        Elevation(own, grid), Thickness(thick.astype(np.float32), grid), Mask(seen.astype(np.float32), grid)
    )
