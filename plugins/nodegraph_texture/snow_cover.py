"""Snow cover: where the snow of a year lies, and how long."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.gradient import horn_gradient, require_projected
from nodegraph_terrain.raster import Elevation, require_same_grid
from nodegraph_texture.place import centre_latitude, latitudes
from nodegraph_texture.quantities import Precipitation, Radiation, SnowCover, Temperature
from nodegraph_texture.snow_slide import slide
from nodegraph_texture.temperature import AMPLITUDE, LATITUDE, WARMEST, YEAR, warmest, zonal_amplitude

Doubles = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

STEPS = 36
"""Steps of a year, some ten days each."""

YEARS = 3
"""Years that snow is followed, from the warmest day; the last one counts."""

PHASES = np.cos(2 * np.pi * (np.arange(STEPS) + 0.5) / STEPS)
"""How warm each is, 1 the warmest and -1 the coldest."""

RAIN_OR_SNOW = 1.0
"""Air temperature at which snow is as likely as rain, degC (northern mean: Jennings et al. 2018)."""


@node(version=1, locality=whole)
def snow_cover(
    surface: Elevation,
    temperature: Temperature | None = None,
    precipitation: Precipitation | None = None,
    radiation: Radiation | None = None,
    *,
    yearly_precipitation: Annotated[
        float, Param("Without a linked precipitation: everywhere.", ge=0, unit="mm/yr")
    ] = 1000.0,
    day: Annotated[float | None, Param("Day of the year, from 1; none: the mean of the year.", ge=1, le=366)] = None,
    degree_day_factor: Annotated[
        float | None, Param("Melt per day and degC above 0; none: 4.5, or 1.8 with radiation.", ge=0, unit="mm/d/K")
    ] = None,
    radiation_factor: Annotated[
        float, Param("With radiation: melt per day, degC and W/m2 besides.", ge=0, unit="mm m2/(d K W)")
    ] = 0.0144,
    latitude: Annotated[float | None, LATITUDE] = None,
    amplitude: Annotated[float | None, AMPLITUDE] = None,
    warmest_day: Annotated[float | None, WARMEST] = None,
    variability: Annotated[
        float, Param("How much days vary around the mean of their season (sigma).", gt=0, le=20, unit="degC")
    ] = 4.0,
    closed_cover: Annotated[
        float, Param("Snow that covers 85 % of the ground, mm of water; less lies in patches.", gt=0, unit="mm")
    ] = 40.0,
    sliding: Annotated[bool, Param("Let snow slide off steep ground.")] = True,
    density: Annotated[float, Param("With sliding: of settled snow.", gt=0, le=917, unit="kg/m3")] = 300.0,
    context: Context,
) -> SnowCover:
    """Give how much of the ground is covered by snow, on a day or in the mean of the year.

    A balance of snow is followed for three years in steps of ten days, from the warmest day on; the last year counts:

        S' = max(0, S + snowfall - melt),    melt = (f + f_r I) E[max(0, T)],    cover = tanh(1.26 S / closed_cover).

    T swings around the linked temperature through the year, by `amplitude` (see `texture.temperature`), and from day to
    day by a normal distribution of sigma `variability`: E is its positive part (Calov and Greve 2005), and the share of
    the precipitation that is snow is that of the days below 1 degC (Jennings et al. 2018).  Precipitation is spread
    evenly over the year.  With a potential direct radiation I, in W/m2, sunny slopes melt earlier (Hock 1999); link one
    of the season of melt.  The cover of a patchy depth is that of Essery and Pomeroy (2004), for snow that varies by
    `closed_cover` (sigma) from place to place.

    The factors of melt are typical values of snow, no constants: models after Hock take an f of 4.5 without radiation,
    and of 1.8 to 4 with an f_r of 0.0144 to 0.0072; fit them where there are measurements.

    With `sliding` the snow of a winter that is too much for its slope, 3178.4 slope^-1.998 m of the `density`
    (Bernhardt and Schulz 2010, with the numbers of Marsh et al. 2020), slides down to where it holds (Gruber 2007),
    and falls there instead: none is lost.

    Args:
        surface: elevation in metres.
        temperature: mean of the year, such as that of `texture.temperature` without a day; without one, 15 degC at sea
            level and 6.5 K/km.
        precipitation: of the year.
        radiation: such as that of `texture.solar_radiation`.
        yearly_precipitation: instead of a linked one.
        day: 1 is 1 January; none for how long snow lies, as a share of the year and of the ground.
        degree_day_factor: f.
        radiation_factor: f_r; 0.0144 a day is 0.6e-3 mm m2/(h K W) an hour.
        latitude: for `amplitude` without a value, and the warmest day.
        amplitude, warmest_day: the turn of the year.
        variability: of days.
        closed_cover: about half of it where the ground is smooth.
        sliding: see above.
        density: what turns the depth that a slope holds into water; 300 is typical of a settled winter's snow.
        context: the engine's.

    Returns:
        0 to 1, of the same shape and extent; void where an input is.

    Raises:
        ValueError: the surface is in degrees, the inputs lie on different grids, precipitation or radiation is
            negative, or a latitude is needed and neither given nor known.

    References: R. Hock (1999): A distributed temperature-index ice- and snowmelt model including potential direct solar
    radiation, doi:10.3189/S0022143000003087; R. Hock (2003), doi:10.1016/S0022-1694(03)00257-9; R. Calov, R. Greve
    (2005), J. Glaciol. 51(172); K. S. Jennings et al. (2018), doi:10.1038/s41467-018-03629-7; R. Essery, J. Pomeroy
    (2004), doi:10.3189/172756404781815275; M. Bernhardt, K. Schulz (2010), doi:10.1029/2010GL043086; C. B. Marsh, J. W.
    Pomeroy, H. S. Wheater (2020), doi:10.5194/gmd-13-225-2020; S. Gruber (2007), doi:10.1029/2006WR004868.
    """
    cell = require_projected(surface)
    linked = [item for item in (temperature, precipitation, radiation) if item is not None]
    require_same_grid(surface, *linked)
    for item in (precipitation, radiation):
        if item is not None and (item.data < 0).any():
            raise ValueError(f"the {type(item).__name__.lower()} is below 0 somewhere; clamp it first")
    swing = np.array([[amplitude]]) if amplitude is not None else zonal_amplitude(latitudes(surface, latitude))
    peak = warmest_day if warmest_day is not None else warmest(centre_latitude(surface.extent, latitude))
    wave = np.broadcast_to(swing, surface.shape)
    mean = (15 - 0.0065 * surface.data if temperature is None else temperature.data).astype(np.float32)
    rain = np.full(surface.shape, yearly_precipitation, np.float32) if precipitation is None else precipitation.data
    mean = np.where(np.isnan(surface.data + rain + (0 if radiation is None else radiation.data)), np.nan, mean)
    melting: npt.NDArray[np.float32] | np.float32
    melting = np.float32((4.5 if radiation is None else 1.8) if degree_day_factor is None else degree_day_factor)
    melting = np.broadcast_to(melting if radiation is None else melting + radiation_factor * radiation.data, mean.shape)
    resting = _after_sliding(surface, mean, rain, wave, variability, density, cell, context) if sliding else None
    cover = np.empty(mean.shape, np.float32)
    for part in row_blocks(*surface.shape, context, cells=1 << 16, start=0.3):
        snow = _snowfall(mean[part], rain[part], wave[part], variability)
        if resting is not None:
            # Where none falls, what slides there arrives in the cold of the year.
            snow += 1e-6 * (1 - PHASES[:, None, None])
            snow *= resting[part] / snow.sum(axis=0)
        melt = _melt(mean[part], melting[part], wave[part], variability)
        lying, covers = np.zeros(snow.shape[1:]), []
        for number in range(YEARS * STEPS):
            lying = np.maximum(lying + snow[number % STEPS] - melt[number % STEPS], 0)
            if number >= (YEARS - 1) * STEPS:
                covers.append(np.tanh(1.26 * lying / closed_cover))
        cover[part] = np.mean(covers, axis=0) if day is None else _on(np.array(covers), (day - peak) / YEAR)
    return SnowCover(cover, surface.extent)


@snow_cover.forecast
def _forecast(surface: Forecast, *_linked: Forecast | None, **_: object) -> Forecast:
    return Forecast(surface.bytes, 24 * surface.bytes + (64 << 20), surface.about)


def _snowfall(mean: Floats, rain: Floats, wave: Doubles, sigma: float) -> Doubles:
    """Return the snow of each step of a year, mm: what falls on days below `RAIN_OR_SNOW`."""
    from scipy.special import ndtr

    cold = ndtr((RAIN_OR_SNOW - mean - wave * PHASES[:, None, None]) / sigma)
    return np.asarray(cold * rain / STEPS)


def _melt(mean: Floats, factor: Floats, wave: Doubles, sigma: float) -> Doubles:
    """Return what could melt in each step of a year, mm."""
    return np.asarray(factor * positive_part(mean + wave * PHASES[:, None, None], sigma) * (YEAR / STEPS))


def positive_part(mean: Doubles, sigma: float) -> Doubles:
    """Return the mean of max(0, T) where T is normal: sigma phi(mean / sigma) + mean Phi(mean / sigma)."""
    from scipy.special import ndtr

    place = mean / sigma
    return np.asarray(sigma * np.exp(-place * place / 2) / np.sqrt(2 * np.pi) + mean * ndtr(place))


def _on(covers: Doubles, turn: float) -> Doubles:
    """Return the cover at a time, in turns of a year from the warmest day, between the ends of steps."""
    place = turn % 1 * len(covers) - 1
    first = int(np.floor(place))
    share = place - first
    return np.asarray(covers[first] * (1 - share) + covers[(first + 1) % len(covers)] * share)


def _after_sliding(
    surface: Elevation,
    mean: Floats,
    rain: Floats,
    wave: Doubles,
    sigma: float,
    density: float,
    cell: tuple[float, float],
    context: Context,
) -> Floats:
    """Return the snow of a winter after what steep ground cannot hold has slid, mm."""
    winter, slope = np.empty((2, *mean.shape), np.float32)
    for part in row_blocks(*surface.shape, context, cells=1 << 16, stop=0.15):
        winter[part] = _snowfall(mean[part], rain[part], wave[part], sigma).sum(axis=0)
        slope[part] = np.degrees(np.arctan(np.hypot(*horn_gradient(surface.data, part, cell))))
    return slide(winter, surface.data, slope, density, cell, context)
