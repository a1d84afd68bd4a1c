"""Precipitation: what falls in a year, by altitude, by place, and by the wind on mountains."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, InputFile, Param, node, whole
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.raster import Elevation, Labels
from nodegraph_texture.orographic import linear_precipitation, moist_air, padded, wind_vector, windward_and_leeward
from nodegraph_texture.quantities import Precipitation
from nodegraph_texture.stations import Station, Trend, read_stations, regionalize
from nodegraph_texture.temperature import RESIDUALS, STATIONS, TABLE, TRANSITION

Floats = npt.NDArray[np.float32]
Method = Literal["none", "upslope", "linear"]

RISE = 50.0
"""Typical rise with altitude, mm/yr per 100 m, where no theory makes it."""


@node(version=1, locality=whole)
def precipitation(
    surface: Elevation,
    zones: Labels | None = None,
    *,
    base: Annotated[float, Param("At sea level in the middle of the raster.", ge=0, le=30000, unit="mm/yr")] = 800.0,
    altitude_gradient: Annotated[
        float | None, Param("Rise per 100 m of altitude; none: 50, but 0 with linear, which makes it.", unit="mm/yr")
    ] = None,
    east_gradient: Annotated[float, Param("Rise per km eastwards.", unit="mm/yr/km")] = 0.0,
    north_gradient: Annotated[float, Param("Rise per km northwards.", unit="mm/yr/km")] = 0.0,
    stations: Annotated[tuple[Station, ...], STATIONS] = (),
    table: Annotated[Path | None, TABLE, InputFile()] = None,
    trend: Annotated[Trend, Param("With stations: what the regression is on.")] = "altitude",
    residuals: Annotated[bool, RESIDUALS] = True,
    transition: Annotated[float, TRANSITION] = 0.0,
    method: Annotated[
        Method, Param("How wind and mountains act: not, by upslope and shelter, or by linear theory.")
    ] = "none",
    wind_direction: Annotated[
        float, Param("Where the wind that brings rain comes from; 270 is west.", ge=-360, le=360, unit="deg")
    ] = 270.0,
    wind_speed: Annotated[float, Param("With linear.", gt=0, le=100, unit="m/s")] = 12.0,
    rain_hours: Annotated[
        float, Param("With linear: how long in a year moist air blows so.", ge=0, le=8766, unit="h")
    ] = 200.0,
    air_temperature: Annotated[
        float, Param("With linear: of the moist air at sea level.", ge=-40, le=40, unit="degC")
    ] = 7.0,
    air_lapse_rate: Annotated[
        float, Param("With linear: how much the air cools upwards; below the moist adiabat.", gt=0, lt=10, unit="K/km")
    ] = 5.0,
    conversion_time: Annotated[float, Param("With linear: from cloud to rain.", ge=0, le=20000, unit="s")] = 1000.0,
    fallout_time: Annotated[float, Param("With linear: from rain to the ground.", ge=0, le=20000, unit="s")] = 1000.0,
    windward: Annotated[float, Param("With upslope: gain per unit of rise along the wind.", ge=0, le=100)] = 1.5,
    shadow: Annotated[float, Param("With upslope: what a wall upwind would keep off.", ge=0, le=1)] = 1.0,
    smoothing: Annotated[
        float, Param("With upslope: how far rain drifts, the sigma of a Gaussian on the heights.", ge=0, unit="m")
    ] = 1000.0,
    context: Context,
) -> Precipitation:
    """Give the mean precipitation of a year.

    The background is

        B = base + altitude_gradient z / 100 + east_gradient x + north_gradient y,

    x and y in km from the middle of the raster, or with `stations` their linear regression on altitude (and place), one
    for each of the `zones`, and what it leaves at them, spread by inverse squared distance.  Wind and mountains act by
    a `method`:

    - ``none``: P = B.
    - ``upslope``: P = B (1 + windward max(0, w)) (1 - shadow sin S), with w the rise of the ground along the wind (Roe
      2005) and S the angle to the highest ground upwind (Winstral et al. 2002), of heights smoothed by `smoothing`.
    - ``linear``: P = B + rain_hours P_o, with P_o the theory of Smith and Barstad (2004): moist air that is lifted and
      sinks in waves over the mountains, and carries cloud and rain along for the two times, in Fourier space.
      Sensitivity, scale height and stability follow from temperature and lapse rate of the air (0.0087 kg/m3, 2,900 m
      and 0.0047 1/s by default).  Its mean is 0: rain on the windward side is what lacks on the leeward.

    P is never negative: where B + rain_hours P_o is, it is dry.

    Args:
        surface: elevation in metres.
        zones: with stations: which cells have a climate of their own; a negative number is none, and void.
        base: with stations, it and the gradients have no say.
        altitude_gradient: 30 to 100 is usual in temperate mountains; falls in the high zones of the tropics.
        east_gradient, north_gradient: see above.
        stations: annual sums in mm; two at least in every zone, four for a trend of place.
        table: instead of or beside `stations`, a file; the first row may name the columns.
        trend: ``altitude``, or ``altitude_and_place``.
        residuals: meet the stations.
        transition: how widely zones fade.
        method: see above; with ``linear`` give gradients only for what mountains do not make.
        wind_direction, wind_speed: a single wind that stands for those that bring rain.
        rain_hours: `base` falls in them, too; 200 is plausible, from no source.
        air_temperature, air_lapse_rate, conversion_time, fallout_time: of the linear theory; 200 to 2,000 s are usual.
        windward, shadow, smoothing: of the upslope method; plausible strengths, from no source: set them by what is
            known of the place.
        context: the engine's.

    Returns:
        mm/yr, of the same shape and extent; void cells stay void.

    Raises:
        ValueError: the surface is in degrees or has infinite heights; zones without stations; too few stations in a
            zone; the air is not stable.

    References: R. B. Smith, I. Barstad (2004), doi:10.1175/1520-0469(2004)061<1377:ALTOOP>2.0.CO;2; G. H. Roe (2005),
    doi:10.1146/annurev.earth.33.092203.122541; A. Winstral, K. Elder, R. E. Davis (2002),
    doi:10.1175/1525-7541(2002)003<0524:SSMOWR>2.0.CO;2.
    """
    cell = require_projected(surface)
    measured = [*stations, *(read_stations(table) if table is not None else ())]
    if zones is not None and not measured:
        raise ValueError("zones tell stations apart, and there are none; give stations, or unlink the zones")
    if np.isinf(surface.data).any():
        raise ValueError("the surface holds infinite heights; clamp it first")
    if measured:
        values = regionalize(
            surface, measured, zones, trend=trend, residuals=residuals, transition=transition, context=context
        )
    else:
        rise = altitude_gradient if altitude_gradient is not None else 0.0 if method == "linear" else RISE
        values = _background(surface, base, rise, east_gradient, north_gradient, context)
    if method == "upslope":
        values *= windward_and_leeward(surface.data, cell, wind_direction, smoothing, windward, shadow, context)
    elif method == "linear" and not np.isnan(surface.data).all():
        air = moist_air(air_temperature, air_lapse_rate)
        drift = wind_speed * (conversion_time + fallout_time)
        # Far enough for cloud and rain to fall out, and for the waves of the widest mountain to die down.
        reach = max(3 * drift, max(surface.extent.width, surface.extent.height) / 2)
        wide, inside = padded(surface.data, cell, min(reach, 4 * max(surface.extent.width, surface.extent.height)))
        context.progress(0.3)
        wind = wind_vector(wind_direction, wind_speed)
        rate = linear_precipitation(wide, cell, wind, air, conversion_time, fallout_time)[inside]
        values += (3600 * rain_hours * rate).astype(np.float32)
        context.progress(0.9)
    return Precipitation(np.maximum(values, 0), surface.extent)


@precipitation.forecast
def _forecast(surface: Forecast, **_: object) -> Forecast:
    # Twice as wide either way, in complex128, and some of that at a time.
    return Forecast(surface.bytes, 4 * 2 * 16 * surface.bytes, surface.about)


def _background(
    surface: Elevation, base: float, altitude: float, east: float, north: float, context: Context
) -> Floats:
    """Return precipitation by altitude and place, mm/yr."""
    rows, cols = surface.shape
    dx, dy = surface.cell_size
    x = (np.arange(cols) - (cols - 1) / 2) * dx / 1000
    y = ((rows - 1) / 2 - np.arange(rows)) * dy / 1000
    values = np.empty(surface.shape, np.float32)
    for part in row_blocks(rows, cols, context):
        values[part] = base + altitude / 100 * surface.data[part] + (east * x + north * y[part, None])
    return values
