"""What is looked at: surfaces, each a construction tree or a raster, and what they are made of."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from nodegraph import Param, node, port_type
from nodegraph_render.material import Ground, Imagery, Material, Plain, Water
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.raster import Elevation, Image
from nodegraph_tree.function import Box, ElevationFunction

Share = Annotated[float, Param("Linear reflectance.", ge=0, le=1)]


@port_type
class Surface:
    """One layer of a scene: the ground, or water over it.

    The solid is everything at or below the surface, within its domain: alpha >= 1/2 of a construction tree, the cell
    centres of a raster that is not void.  Exactly one of `function` and `raster` is given.

    Attributes:
        function: a construction tree.
        raster: heights, m; bilinear between the centres of cells.
        material: how it looks.
    """

    function: ElevationFunction | None
    raster: Elevation | None
    material: Material

    def __post_init__(self) -> None:
        if (self.function is None) == (self.raster is None):
            raise ValueError("a surface is either a construction tree or a raster")

    @property
    def box(self) -> Box:
        """A box around it, seen from above, m."""
        if self.function is not None:
            return self.function.support
        assert self.raster is not None
        extent = self.raster.extent
        return Box(extent.west, extent.south, extent.east, extent.north)


@node(version=1)
def function_surface(function: ElevationFunction) -> Surface:
    """Show a construction tree as natural ground.  Used in links from a tree to a surface; see `ground`."""
    return Surface(function, None, Ground())


@node(version=1)
def raster_surface(raster: Elevation) -> Surface:
    """Show a raster as natural ground.  Used in links from an elevation to a surface; see `ground`.

    Raises:
        ValueError: the raster is in degrees.
    """
    require_projected(raster)
    return Surface(None, raster, Ground())


@node(version=1)
def ground(
    surface: Surface,
    *,
    snow_line: Annotated[float, Param("Altitude above which level ground is white.", unit="m")] = 2800.0,
    tree_line: Annotated[float, Param("Altitude at which woods end.", unit="m")] = 1900.0,
    rock_slope: Annotated[float, Param("Steepness at which rock shows.", ge=0, le=90, unit="deg")] = 40.0,
    variation: Annotated[float, Param("How far borders wander and colours vary; 0: not at all.", ge=0, le=2)] = 1.0,
    relief: Annotated[float, Param("How rough ground is in detail that the surface lacks.", ge=0, le=2)] = 1.0,
    patches: Annotated[float, Param("Size of the largest patches of one kind.", ge=10, le=1e6, unit="m")] = 900.0,
    seed: Annotated[int, Param("Another one gives other patches.", ge=0, le=0x7FFFFFFF)] = 0,
) -> Surface:
    """Make a surface natural ground: woods, meadows, rock, scree and snow by altitude and steepness.

    Snow lies above the snow line, on slopes of over 25 degrees only higher up (8 m for each degree), and on none of
    over 52; rock shows where ground is steep; woods cover slopes below the tree line, meadows what is gentle; grass and
    scree lie between the two lines.  Noise of `patches` metres and less makes borders ragged (by some 100 m of altitude
    or 7 degrees of steepness at a variation of 1) and tilts normals by some 20 degrees on bare rock where `relief` is 1
    and 1 pixel shows less than 2 m.  `nodegraph_render.materials.ground` states the formulas.

    Args:
        surface: a construction tree or a raster.
        snow_line, tree_line: above sea level; the defaults are those of the Alps.
        rock_slope: see above.
        variation, relief, patches, seed: of the noise.
    """
    return replace(
        surface, material=Ground("ground", snow_line, tree_line, rock_slope, variation, relief, patches, seed)
    )


@node(version=1)
def plain(surface: Surface, *, red: Share = 0.4, green: Share = 0.38, blue: Share = 0.34) -> Surface:
    """Give a surface one colour, matt: what a model of clay looks like.

    Args:
        surface: a construction tree or a raster.
        red, green, blue: linear reflectance; fresh snow has 0.85, dry sand 0.4, woods 0.04.
    """
    return replace(surface, material=Plain("plain", (red, green, blue)))


@node(version=1)
def imagery(surface: Surface, image: Image) -> Surface:
    """Drape a picture over a surface, such as an aerial photograph or a map, placed by its extent.

    The picture's colours, decoded from sRGB, are the reflectance.  Where it ends or is transparent, what the surface
    was made of shows.

    Args:
        surface: a construction tree or a raster, in the picture's coordinate system.
        image: the picture, in metres.

    Raises:
        ValueError: the picture is in degrees or another system than the surface, or lies beside it.
    """
    extent = image.extent
    if extent.unit != "m":
        raise ValueError("the picture is in degrees; give it, and the surface, in one projected system in metres")
    system = surface.raster.extent.crs if surface.raster is not None else ""
    if system and extent.crs and system != extent.crs:
        raise ValueError(f"the picture is in {extent.crs} and the surface in {system}; reproject one to the other")
    box, own = surface.box, Box(extent.west, extent.south, extent.east, extent.north)
    common = box.intersection(own)
    if common.west >= common.east or common.south >= common.north:
        sides = ", ".join(f"{edge:g}" for edge in own)
        around = ", ".join(f"{edge:g}" for edge in box)
        raise ValueError(f"the picture ({sides}) does not overlap the surface ({around}: west, south, east, north)")
    return replace(surface, material=Imagery(name="imagery", image=image, below=surface.material))


@node(version=1)
def water(
    surface: Surface,
    *,
    clarity: Annotated[
        float, Param("Secchi depth, at which a white disc let down vanishes.", ge=0.05, le=80, unit="m")
    ] = 5.0,
    wind: Annotated[float, Param("Speed of the wind that ruffles it; 0: a mirror.", ge=0, le=20, unit="m/s")] = 3.0,
    red: Annotated[float, Param("Linear reflectance of deep water.", ge=0, le=1)] = 0.005,
    green: Annotated[float, Param("Linear reflectance of deep water.", ge=0, le=1)] = 0.020,
    blue: Annotated[float, Param("Linear reflectance of deep water.", ge=0, le=1)] = 0.028,
    seed: Annotated[int, Param("Another one gives other ripples.", ge=0, le=0xFFFFFFFF)] = 0,
) -> Surface:
    """Make a surface water: `tree.constant` is a lake or a sea, up to the shore of whatever ground rises above it.

    It mirrors sky and land by Fresnel's equations (2 % straight down, all at grazing angles), and the ground below
    shines through: light fades by exp(-K s) over a way of s metres, with K pure water's absorption plus 1.7 over
    `clarity`.  Ripples have the slopes that Cox and Munk (1954, doi:10.1364/JOSA.44.000838) measured, a variance of
    0.003 + 0.00512 `wind`; those too small to be seen widen the glint of the sun.

    Args:
        surface: the water's surface.
        clarity: 40 in a clear ocean, 5 in a lake, 0.3 in a muddy river.
        wind: 10 m above the water.
        red, green, blue: of light that comes back up from deep water.
        seed: of the ripples.
    """
    return replace(surface, material=Water("water", (red, green, blue), clarity, wind, seed))
