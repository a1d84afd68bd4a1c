"""Geographic quantities: what decides which surface appears where, each a raster with a role and a unit.

A constraint of a layer names its quantity: that is the role in lower case (``temperature``), or the name of an `Other`.
`altitude` and `slope` come from the elevation itself.
"""

from __future__ import annotations

import re
from typing import ClassVar

from nodegraph import port_type
from nodegraph_terrain.raster import Raster

NAME = re.compile(r"[a-z][a-z0-9_]*")

FROM_ELEVATION = ("altitude", "slope")
"""Quantities that need no raster: m above sea level, and degrees from the horizontal."""


@port_type
class Temperature(Raster):
    """Mean air temperature near the ground, degC."""

    unit: ClassVar[str] = "degC"


@port_type
class Precipitation(Raster):
    """Rain and melted snow, mm/yr."""

    unit: ClassVar[str] = "mm/yr"


@port_type
class Radiation(Raster):
    """Mean power of the sun on the ground, W/m2."""

    unit: ClassVar[str] = "W/m2"


@port_type
class Irradiation(Raster):
    """Energy of the sun on the ground over a time, kWh/m2."""

    unit: ClassVar[str] = "kWh/m2"


@port_type
class Wetness(Raster):
    """Topographic wetness index ln(a / tan slope), a the drainage area per metre of contour."""

    unit: ClassVar[str] = "1"


@port_type
class SnowCover(Raster):
    """How much of the ground snow covers, 0 to 1."""

    unit: ClassVar[str] = "1"
    bounds: ClassVar[tuple[float, float] | None] = (0.0, 1.0)


@port_type
class Other(Raster):
    """Any further quantity, by name.

    Attributes:
        name: lower-case letters, digits and underscores.
    """

    name: str = "other"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not NAME.fullmatch(self.name) or self.name in FROM_ELEVATION:
            raise ValueError(
                f"'{self.name}' is no name for a quantity: use lower-case letters, digits and underscores, and not "
                f"{' or '.join(FROM_ELEVATION)}"
            )


QUANTITIES: tuple[type[Raster], ...] = (Temperature, Precipitation, Radiation, Irradiation, Wetness, SnowCover, Other)
"""Every role of this module."""


def quantity_name(raster: Raster) -> str:
    """Return what constraints call a raster: ``snow_cover`` for `SnowCover`, its own name for an `Other`."""
    return raster.name if isinstance(raster, Other) else role_name(type(raster))


def role_name(role: type[Raster]) -> str:
    """Return the name of a role as constraints have it.

    >>> role_name(SnowCover)
    'snow_cover'
    """
    return re.sub(r"(?<!^)(?=[A-Z])", "_", role.__name__).lower()
