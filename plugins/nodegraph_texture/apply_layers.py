"""Painting the ground: colours, displaced heights, normals and coverage from layers."""

from __future__ import annotations

from dataclasses import replace
from math import floor, isfinite
from typing import Annotated, NamedTuple

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_terrain.forecasts import Outline, check_cells, outline
from nodegraph_terrain.raster import Elevation, Extent, Image, Normals, Raster
from nodegraph_texture.coverage import Coverage
from nodegraph_texture.evaluate import Texture, evaluate
from nodegraph_texture.layers import SurfaceLayers
from nodegraph_texture.scene import Scene, scene_of
from nodegraph_tree.function import ElevationFunction

Edges = tuple[float, float, float, float]

TEXELS = 4
"""Texels along a cell where nothing else is stated."""

ACROSS = 1024
"""Texels along the longer side of a construction tree where nothing else is stated."""


class Applied(NamedTuple):
    """What `apply_layers` gives; void texels are transparent, NaN or 0."""

    image: Image
    surface: Elevation
    normals: Normals
    coverage: Coverage


@node(version=1, locality=whole)
def apply_layers(
    layers: SurfaceLayers,
    surface: Elevation | None = None,
    function: ElevationFunction | None = None,
    *quantities: Raster,
    factor: Annotated[
        int | None, Param("Texels along a side of a cell; none: 4, or by cell_size.", ge=1, le=256)
    ] = None,
    cell_size: Annotated[float | None, Param("Side of a texel, in place of a factor.", gt=0, unit="m")] = None,
    extent: Annotated[
        Edges | None, Param("Outer edges (west, south, east, north) for a tree; none: its own.", unit="m")
    ] = None,
    crs: Annotated[str, Param("Coordinate reference system of a tree, such as EPSG:32616.")] = "",
    context: Context,
) -> Applied:
    """Paint the ground with layers: colours, displaced heights, normals, and how much each layer covers.

    Evaluates equations 1 and 2 (see texture.layer) at the middle of each texel.  Heights are an interpolating cubic
    B-spline through the surface's, or those of a construction tree; the slope of that ground is exact, and that of the
    bumps that layers add is by central differences over neighbouring texels.  Quantities are bilinear.  Where texels
    are larger than cells, means over 2 x 2, 4 x 4 ... cells stand in for these.

    The root paints everything; its own coverage, mostly 1, bounds that of all others and is the picture's alpha.

    With a `factor` the texture covers exactly the surface.  With a `cell_size` texels are squares of that side from the
    north-west corner on; a rest of less than a texel at the eastern and southern edge is left out.  A texel is void
    where the cell it lies in is: transparent, NaN, without coverage.  A void quantity gives a constraint 0.  Any window
    of the same texture has the same bits, see `nodegraph_texture.evaluate`.

    Args:
        layers: the hierarchy.
        surface: the ground as a raster in metres, or
        function: as a construction tree; it is asked on the host on every device.  For speed, sample it first.
        quantities: rasters that constraints name, over the same ground in the same system, of any cell size.
        factor: for a raster.
        cell_size: for either; a tree without one has 1024 texels along its longer side.
        extent: for a tree.
        crs: for a tree.
        context: the engine's.

    Returns:
        ``image``: sRGB and alpha; ``surface``: heights with all bumps, m; ``normals``: for shading; ``coverage``: C of
        each layer, for texture.coverage and texture.save_splat.

    Raises:
        ValueError: neither or both of surface and tree are linked; a layer depends on a quantity that is not linked; a
            quantity lies beside the ground, is in another system or in degrees; all cells are void.

    Complexity: layers x octaves of their noises for each texel that they appear at.

    Source: Dachsbacher, Bolch and Stamminger 2006: Procedural reproduction of terrain textures with geographic data,
    Vision, Modeling and Visualization, section 4, https://inria.hal.science/inria-00606769.
    """
    scene, grid = prepared(layers, surface, function, quantities, factor, cell_size, extent, crs, context)
    check_cells(grid.rows, grid.cols)
    return _named(scene, grid, evaluate(scene, grid.cell_size, 0, 0, grid.rows, grid.cols, context))


@apply_layers.opencl(rtol=5e-3)
def _twin(
    layers: SurfaceLayers,
    surface: Elevation | None = None,
    function: ElevationFunction | None = None,
    *quantities: Raster,
    factor: int | None,
    cell_size: float | None,
    extent: Edges | None,
    crs: str,
    context: Context,
) -> Applied:
    from nodegraph.opencl import to_host
    from nodegraph_texture.apply_opencl import evaluate_on_device

    device = context.device
    assert device is not None
    given = to_host(layers), to_host(surface), to_host(function), to_host(quantities)
    scene, grid = prepared(*given, factor, cell_size, extent, crs, context)
    check_cells(grid.rows, grid.cols)
    return _named(scene, grid, evaluate_on_device(scene, grid.cell_size, 0, 0, grid.rows, grid.cols, device, context))


@apply_layers.forecast
def _forecast(
    layers: Forecast,  # noqa: ARG001
    surface: Forecast | None = None,
    function: Forecast | None = None,  # noqa: ARG001
    *quantities: Forecast,  # noqa: ARG001
    factor: int | None,
    cell_size: float | None,
    extent: Edges | None,
    crs: str,
    **_: object,
) -> Forecast:
    known = None if surface is None else outline(surface)
    try:
        if known is not None:
            grid = texture_grid(known, factor, cell_size)
        elif extent is not None:
            grid = texture_grid(Outline(1, 1, Extent(*extent, crs)), None, cell_size or _tree_cell(Extent(*extent)))
        else:
            return Forecast(0, known=False)
        check_cells(grid.rows, grid.cols)
    except ValueError:
        return Forecast(0, known=False)
    # How many layers there are is not known: eight are usual.
    return grid.forecast(cell_bytes=4 + 4 + 12 + 8 * 4, peak_bytes=4)


def texture_grid(ground: Outline, factor: int | None, cell_size: float | None) -> Outline:
    """Return the grid of a texture.

    Raises:
        ValueError: both a factor and a cell size are stated, or texels are larger than the ground.
    """
    if cell_size is None:
        times = TEXELS if factor is None else factor
        grid = Outline(ground.rows * times, ground.cols * times, ground.extent)
    elif factor is not None:
        raise ValueError("factor and cell_size state the same thing; give one of them")
    else:
        box = ground.extent
        # A remainder of a millionth of a texel is rounding, not ground.
        rows, cols = (floor(side / cell_size + 1e-6) for side in (box.height, box.width))
        if rows < 1 or cols < 1:
            raise ValueError(
                f"a texel of {cell_size:g} m is larger than the ground of {box.width:g} x {box.height:g} m"
            )
        grid = Outline(rows, cols, replace(box, east=box.west + cols * cell_size, south=box.north - rows * cell_size))
    return grid


def prepared(
    layers: SurfaceLayers,
    surface: Elevation | None,
    function: ElevationFunction | None,
    quantities: tuple[Raster, ...],
    factor: int | None,
    cell_size: float | None,
    extent: Edges | None,
    crs: str,
    context: Context,
) -> tuple[Scene, Outline]:
    """Return what is textured and the grid of its texels, from the inputs and parameters of `apply_layers`.

    Raises:
        ValueError: as of `apply_layers`.
    """
    if surface is not None and function is not None:
        raise ValueError("the ground is given twice; link either a surface or a construction tree")
    if surface is not None:
        if extent is not None or crs:
            raise ValueError("extent and crs are for a construction tree; a surface has its own")
        grid = texture_grid(Outline(*surface.shape, surface.extent), factor, cell_size)
        return scene_of(layers, surface, quantities, context=context), grid
    if function is None:
        raise ValueError("there is no ground to paint; link a surface or a construction tree")
    if factor is not None:
        raise ValueError("a construction tree has no cells to divide by a factor; give cell_size")
    box = Extent(*extent, crs) if extent is not None else _support(function, crs)
    grid = texture_grid(Outline(1, 1, box), None, cell_size or _tree_cell(box))
    return scene_of(layers, function, quantities, grid.extent, context), grid


def _support(function: ElevationFunction, crs: str) -> Extent:
    box = function.support
    if not all(map(isfinite, box)):
        raise ValueError("the construction tree has no borders; give extent (west, south, east, north)")
    return Extent(box.west, box.south, box.east, box.north, crs)


def _tree_cell(box: Extent) -> float:
    return max(box.width, box.height) / ACROSS


def _named(scene: Scene, grid: Outline, made: Texture) -> Applied:
    box = grid.extent
    colours = tuple([step.layer.colour for step in scene.steps])
    return Applied(
        Image(made.colour, box),
        Elevation(made.height, box),
        Normals(made.normals, box),
        Coverage(made.coverage, box, scene.names, colours),
    )
