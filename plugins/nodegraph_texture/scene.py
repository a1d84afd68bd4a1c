"""What is textured: ground, quantities and layers, checked against each other and laid out for evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph.errors import nearest
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.raster import Elevation, Extent, Raster
from nodegraph_texture.constraints import Constraint, Sampled
from nodegraph_texture.detail import Detail, detail_of
from nodegraph_texture.layers import SurfaceLayers
from nodegraph_texture.quantities import FROM_ELEVATION, quantity_name
from nodegraph_texture.sampling import Places, Pyramid, Texels
from nodegraph_tree.function import THRESHOLD, ElevationFunction, Points

Floats = npt.NDArray[np.float32]

UNKNOWN = 0.25
"""Share of the ground beyond the samples of a function from which that is told."""

LOOKED_AT = 1 << 16
"""Cells that the share is found from."""


class Ground(NamedTuple):
    """The ground at the texels of a window, before it is displaced; all (rows, cols) and free of NaN.

    Attributes:
        height: m.
        east, north: its derivatives.
        void: which texels have no ground; None: all have.
    """

    height: Floats
    east: Floats
    north: Floats
    void: npt.NDArray[np.bool_] | None


class Step(NamedTuple):
    """A layer in the order of application.

    Attributes:
        layer: the layer.
        parent: number of its parent, -1 for the root.
        refreshes: whether the slope must be computed anew, as layers before have displaced the ground.
        constraints: those of its own.
    """

    layer: SurfaceLayers
    parent: int
    refreshes: bool
    constraints: tuple[Constraint, ...]


class Noises(NamedTuple):
    """The noises of a layer at a level: of coverage, displacement and tint; None where they play no part."""

    cover: Detail | None
    relief: Detail | None
    tint: Detail | None


@dataclass(frozen=True)
class Scene:
    """Ground, quantities and layers, ready to be evaluated at any window of any level; see `scene`.

    Attributes:
        extent: what is textured, m; texels are counted from its north-west corner.
        ground: a raster with its coarser versions, or a construction tree.
        quantities: by name, those that constraints ask for.
        steps: the layers in the order of application.
    """

    extent: Extent
    ground: Pyramid | ElevationFunction
    quantities: dict[str, Pyramid]
    steps: tuple[Step, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the layers in the order of application."""
        return tuple([step.layer.name for step in self.steps])

    @property
    def displaces(self) -> bool:
        """Say whether any layer displaces the ground."""
        return any(step.layer.roughness for step in self.steps)

    @property
    def reach(self) -> int:
        """How many texels around a window count: one for each time that the slope of displaced ground is computed."""
        stale = False
        count = 0
        for step in self.steps:
            count += step.refreshes
            stale = (stale and not step.refreshes) or step.layer.roughness != 0
        return count + stale

    def texels(self, cell: float | tuple[float, float], rows: range, cols: range) -> Texels:
        """Return the texels of a window of the level of some size of texels."""
        sides = (cell, cell) if isinstance(cell, (int, float)) else cell
        return Texels(self.extent.west, self.extent.north, sides, rows, cols)

    def ground_at(self, texels: Places) -> Ground:
        """Return the ground: by cubic B-spline with its exact gradient, or as the tree gives it."""
        if isinstance(self.ground, Pyramid):
            return Ground(*texels.spline(self.ground.level_for(texels.cell)))
        shape = texels.shape
        x, y = texels.points(tuple(np.indices(shape)))
        found = self.ground.query(Points(x.ravel(), y.ravel()), gradient=True)
        assert found.height_gradient is not None
        height, east, north = (
            array.reshape(shape).astype(np.float32) for array in (found.height, *found.height_gradient)
        )
        void = (found.weight < THRESHOLD).reshape(shape)
        box = self.extent
        outside = (x < box.west) | (x > box.east) | (y < box.south) | (y > box.north)
        void |= outside
        return Ground(height, east, north, void if void.any() else None)

    def quantity_at(self, name: str, texels: Places) -> Floats:
        """Return a quantity, bilinear between the centres of cells; NaN where it is void or unknown."""
        pyramid = self.quantities[name]
        return texels.bilinear(pyramid.level_for(texels.cell))

    def noises(self, cell: tuple[float, float]) -> list[Noises]:
        """Return the noises of all layers at the level of some size of texels."""
        texel = max(cell)
        return [
            Noises(
                detail_of(item.noise, texel) if item.scale else None,
                detail_of(item.relief, texel) if item.roughness else None,
                detail_of(item.tint, texel) if item.variation else None,
            )
            for item in (step.layer for step in self.steps)
        ]


def scene_of(
    layers: SurfaceLayers,
    ground: Elevation | ElevationFunction,
    quantities: Sequence[Raster] = (),
    extent: Extent | None = None,
    context: Context | None = None,
) -> Scene:
    """Lay out what is to be textured.

    Args:
        layers: the root.
        ground: a raster in metres, or a construction tree.
        quantities: rasters whose roles name them.
        extent: what to texture, for a tree; a raster is textured as a whole.
        context: where to warn.

    Raises:
        ValueError: a constraint asks for a quantity that is not there; two rasters have one name; a raster is in
            degrees, in another system, or lies beside the ground; all cells of the ground are void.
    """
    box = _extent_of(ground, extent)
    steps = _steps(layers)
    named: dict[str, Raster] = {}
    for raster in quantities:
        name = quantity_name(raster)
        if name in named:
            raise ValueError(f"two rasters are linked as '{name}'; link one, or name the other by texture.quantity")
        named[name] = raster
    wanted: dict[str, Pyramid] = {}
    for step in steps:
        for constraint in step.constraints:
            name = constraint.quantity
            if name in FROM_ELEVATION or name in wanted:
                continue
            if name not in named:
                raise ValueError(
                    f"layer '{step.layer.name}' depends on {name}, but no raster of it is linked; "
                    f"{nearest(name, [*named, *FROM_ELEVATION])}"
                )
            _check_overlap(name, named[name], box, context or Context())
            wanted[name] = Pyramid(named[name].data, named[name].extent, cubic=False)
    known = named | ({"altitude": ground} if isinstance(ground, Elevation) else {})
    _tell_of_unknown_ground(steps, known, context or Context())
    source = Pyramid(ground.data, ground.extent, cubic=True) if isinstance(ground, Elevation) else ground
    return Scene(box, source, wanted, steps)


def _extent_of(ground: Elevation | ElevationFunction, extent: Extent | None) -> Extent:
    if isinstance(ground, Elevation):
        require_projected(ground)
        if np.isnan(ground.data).all():
            raise ValueError("the surface holds no heights: every cell is void")
        if np.isinf(ground.data).any():
            raise ValueError("the surface holds infinite heights; make them voids (NaN)")
        return ground.extent
    if extent is None:
        raise ValueError("where to texture the construction tree is missing; give extent (west, south, east, north)")
    return extent


def _steps(root: SurfaceLayers) -> tuple[Step, ...]:
    steps, stale = [], False
    for layer, parent, _ in root.walk():
        refreshes = stale and any(item.quantity == "slope" for item in layer.constraints)
        steps.append(Step(layer, parent, refreshes, layer.constraints))
        stale = (stale and not refreshes) or layer.roughness != 0
    return tuple(steps)


def _check_overlap(name: str, raster: Raster, box: Extent, context: Context) -> None:
    own = raster.extent
    if own.unit != "m":
        raise ValueError(f"{name} is in degrees; link it through terrain.reproject onto the surface")
    if own.crs and box.crs and own.crs != box.crs:
        raise ValueError(f"{name} is in another system than the surface; link it through terrain.reproject")
    wide = min(own.east, box.east) - max(own.west, box.west)
    high = min(own.north, box.north) - max(own.south, box.south)
    if wide <= 0 or high <= 0:
        raise ValueError(
            f"{name} ({own.west:g}, {own.south:g}, {own.east:g}, {own.north:g}) does not overlap the surface "
            f"({box.west:g}, {box.south:g}, {box.east:g}, {box.north:g}: west, south, east, north)"
        )
    share = wide * high / (box.width * box.height)
    if share < 0.999:
        context.log.warning("%s covers %.0f %% of the surface; elsewhere its constraints are 0", name, 100 * share)


def _tell_of_unknown_ground(steps: Sequence[Step], rasters: dict[str, Raster], context: Context) -> None:
    """Warn where much of a quantity lies beyond the samples of its functions, as with a climate of other ground."""
    ranges: dict[str, tuple[float, float]] = {}
    for step in steps:
        for item in step.constraints:
            if isinstance(item, Sampled) and item.quantity in rasters:
                low, high = ranges.get(item.quantity, (item.low, item.high))
                ranges[item.quantity] = min(low, item.low), max(high, item.high)
    for name, (low, high) in ranges.items():
        cells = rasters[name].data.ravel()
        cells = cells[:: max(1, cells.size // LOOKED_AT)]
        cells = cells[~np.isnan(cells)]
        share = float(((cells < low) | (cells > high)).mean()) if cells.size else 0.0
        if share > UNKNOWN:
            context.log.warning(
                "%.0f %% of the %s lies beyond what layers know of it (%g to %g); there it counts as the nearer end",
                100 * share, name, low, high,
            )  # fmt: skip
