"""What surfaces are made of: data alone; `materials` and `water` say what light makes of it."""

from __future__ import annotations

from dataclasses import field

from nodegraph import port_type
from nodegraph_terrain.raster import Image

Colour = tuple[float, float, float]
"""Linear reflectance (red, green, blue), 0 to 1."""


@port_type
class Material:
    """How a surface looks.

    Attributes:
        name: for people, such as ``ground``.
    """

    name: str = "ground"


@port_type
class Ground(Material):
    """Natural ground: woods, meadows, rock, scree and snow by altitude, steepness and the way that it faces.

    Attributes:
        snow_line: altitude above which level ground is white, m.
        tree_line: altitude at which woods end, m.
        rock_slope: steepness at which rock shows, degrees.
        variation: how far the borders wander and colours vary, 0 (lines of constant altitude) to 2; 1 is natural.
        relief: how rough the ground is in detail finer than the surface, 0 (smooth) to 2; 1 is natural.
        patches: size of the largest patches, m.
        seed: another one gives other patches.
    """

    snow_line: float = 2800.0
    tree_line: float = 1900.0
    rock_slope: float = 40.0
    variation: float = 1.0
    relief: float = 1.0
    patches: float = 900.0
    seed: int = 0


@port_type
class Plain(Material):
    """One colour everywhere.

    Attributes:
        colour: linear reflectance.
    """

    colour: Colour = (0.4, 0.38, 0.34)


@port_type
class Imagery(Material):
    """A picture from above, placed by its extent; where it ends or is transparent, what it lies on shows.

    Attributes:
        image: the picture, in metres.
        below: what it lies on.
    """

    image: Image = field(kw_only=True)
    below: Material = field(default_factory=Ground, kw_only=True)


@port_type
class Water(Material):
    """Water: it mirrors sky and land, and the ground below it shines through where it is shallow.

    Attributes:
        colour: linear reflectance of deep water.
        clarity: Secchi depth, at which a white disc let down from above vanishes, m.
        wind: speed of the wind that ruffles it, m/s; 0 is a mirror.
        seed: another one gives other ripples.
    """

    name: str = "water"
    colour: Colour = (0.005, 0.02, 0.028)
    clarity: float = 5.0
    wind: float = 3.0
    seed: int = 0
