"""Air temperature: how it falls with altitude and latitude, and how it turns with the year."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Context, InputFile, Param, node, whole
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.raster import Elevation, Labels
from nodegraph_texture.place import centre_latitude, latitudes
from nodegraph_texture.quantities import Temperature
from nodegraph_texture.stations import Station, read_stations, regionalize

Floats = npt.NDArray[np.float64]

YEAR = 365.2422
"""Days of a year."""

STATIONS = Param("Measured values, each [east, north, altitude, value], m; they replace the general law.")
TABLE = Param("The same as a table of four columns: east, north, altitude, value.")
RESIDUALS = Param("Add what the regression leaves at the stations, by inverse squared distance.")
TRANSITION = Param("How widely zones fade into each other.", ge=0, unit="m")
LATITUDE = Param("North is positive; none: of every cell, by the raster's system.", ge=-90, le=90, unit="deg")
AMPLITUDE = Param("Half of what the warmest differs from the coldest day; none: by latitude.", ge=0, unit="degC")
WARMEST = Param("Day of the year on which it is warmest; none: 25 days after midsummer.", ge=1, le=366)


@node(version=1, locality=whole)
def temperature(
    surface: Elevation,
    zones: Labels | None = None,
    *,
    lapse_rate: Annotated[float, Param("How much colder it is per km of altitude.", ge=-20, le=20, unit="K/km")] = 6.5,
    sea_level: Annotated[
        float | None, Param("Mean of the year at sea level; none: by latitude.", ge=-100, le=100, unit="degC")
    ] = 15.0,
    stations: Annotated[tuple[Station, ...], STATIONS] = (),
    table: Annotated[Path | None, TABLE, InputFile()] = None,
    residuals: Annotated[bool, RESIDUALS] = True,
    transition: Annotated[float, TRANSITION] = 0.0,
    day: Annotated[float | None, Param("Day of the year, from 1; none: the mean of the year.", ge=1, le=366)] = None,
    latitude: Annotated[float | None, LATITUDE] = None,
    amplitude: Annotated[float | None, AMPLITUDE] = None,
    warmest_day: Annotated[float | None, WARMEST] = None,
    context: Context,
) -> Temperature:
    """Give the air temperature near the ground: of the year, or of a day of it.

    Without stations,

        T = T_s - lapse_rate z / 1000,

    with T_s at `sea_level`: 15 degC and 6.5 K/km are the International Standard Atmosphere's (ICAO Doc 7488).  With
    none for `sea_level` it is the zonal mean of the northern hemisphere, in the two terms of Legendre that
    energy-balance models keep (North 1975): T_s = 15.0 - 27.3 (3 sin^2 latitude - 1) / 2, their projection from the
    means of zones of 10 degrees that Warren and Schneider (1979) list (which it meets within 3 degC to 80 N).

    With `stations`, T is their linear regression on altitude by least squares, one for each of the `zones`, and what
    it leaves at them, spread by inverse squared distance; `lapse_rate` and `sea_level` then have no say.

    On a `day` of the year, A cos(2 pi (day - warmest_day) / 365.2422) is added.  Without an `amplitude` it is a typical
    one of the north, A = 15.5 |sin latitude|: the first seasonal term of energy-balance models (North and Coakley
    1979), with a factor for which zonal means at 60 N swing by 13.4 degC; beside the equator they do by 13.5 (NCEP
    reanalysis, 1970 to 2000).  Give one where it matters: coasts have less, the inside of continents about twice as
    much, and at 60 S, where all is sea, zonal means swing by 2.  The warmest day is typical as well, a month after
    midsummer: 200 in the north, 382.6 - 365.2 = 17.4 in the south.

    Args:
        surface: elevation in metres; one in degrees will do without stations.
        zones: with stations: which cells have a climate of their own; a negative number is none, and void.
        lapse_rate: at most 9.8 K/km in dry air; negative for an inversion.
        sea_level: T_s.
        stations: annual means; two at least in every zone, at different altitudes, also from outside the raster.
        table: instead of or beside `stations`, a file; the first row may name the columns.
        residuals: meet the stations.
        transition: 0 leaves a step where zones meet.
        day: 1 is 1 January.
        latitude: for `sea_level` and `amplitude` without values, and the warmest day.
        amplitude: A.
        warmest_day: see above.
        context: the engine's.

    Returns:
        degC, of the same shape and extent; void cells stay void.

    Raises:
        ValueError: a latitude is needed and neither given nor known; zones without stations; too few stations in a
            zone; with stations a surface in degrees.

    References:
        S. G. Warren, S. H. Schneider (1979): Seasonal simulation as a test for uncertainties in the parameterizations
        of a Budyko-Sellers zonal climate model. J. Atmos. Sci. 36, 1377-1391.
        G. R. North (1975): Theory of energy-balance climate models. doi:10.1175/1520-0469(1975)032<2033:TOEBCM>2.0.CO;2
        G. R. North, J. A. Coakley (1979): Differences between seasonal and mean annual energy balance model
        calculations of climate and climate sensitivity. doi:10.1175/1520-0469(1979)036<1189:DBSAMA>2.0.CO;2
    """
    measured = [*stations, *(read_stations(table) if table is not None else ())]
    if zones is not None and not measured:
        raise ValueError("zones tell stations apart, and there are none; give stations, or unlink the zones")
    season = np.zeros((1, 1)) if day is None else yearly_swing(surface, day, latitude, amplitude, warmest_day)
    if measured:
        values = regionalize(
            surface, measured, zones, trend="altitude", residuals=residuals, transition=transition, context=context
        )
        return Temperature((values + season).astype(np.float32), surface.extent)
    base = zonal_mean(latitudes(surface, latitude)) if sea_level is None else np.array([[sea_level]])
    level = np.broadcast_to(base + season, surface.shape)
    values = np.empty(surface.shape, np.float32)
    for part in row_blocks(*surface.shape, context):
        values[part] = level[part] - lapse_rate / 1000 * surface.data[part]
    return Temperature(values, surface.extent)


def zonal_mean(latitude: Floats) -> Floats:
    """Return the mean temperature of a latitude in degrees, degC, in two terms of Legendre (see `temperature`)."""
    sine = np.sin(np.radians(latitude))
    return np.asarray(15.0 - 27.3 * (3 * sine * sine - 1) / 2)


def zonal_amplitude(latitude: Floats) -> Floats:
    """Return half of what summer typically differs from winter at a latitude in degrees, degC (see `temperature`)."""
    return np.asarray(15.5 * np.abs(np.sin(np.radians(latitude))))


def yearly_swing(
    surface: Elevation, day: float, latitude: float | None, amplitude: float | None, warmest_day: float | None
) -> Floats:
    """Return by how much a day is warmer than the mean of the year, degC, in an array that fits the cells."""
    size = np.array([[amplitude]]) if amplitude is not None else zonal_amplitude(latitudes(surface, latitude))
    if warmest_day is None:
        warmest_day = warmest(centre_latitude(surface.extent, latitude))
    return np.asarray(size * np.cos(2 * np.pi * (day - warmest_day) / YEAR))


def warmest(latitude: float) -> float:
    """Return the warmest day of the year at a latitude: a month after midsummer, half a year apart in the south."""
    return 200.0 if latitude >= 0 else 200.0 - YEAR / 2
