"""The sun's path over a range of days, summed up by direction: how much direct radiation comes from where.

Sources: J. W. Spencer (1971): Fourier series representation of the position of the sun. Search 2(5), 172 (declination
within 0.04 degrees, distance within 0.01 %); F. Kasten, A. T. Young (1989): Revised optical air mass tables and
approximation formula. doi:10.1364/AO.28.004735; the sum over a map of the sky follows P. Fu, P. M. Rich (2002): A
geometric solar radiation model with applications in agriculture and forestry. doi:10.1016/S0168-1699(02)00115-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

SOLAR_CONSTANT = 1361.0
"""Power of the sun at the Earth's mean distance, W/m2 (Kopp and Lean 2011, doi:10.1029/2010GL045777)."""

BINS = 180
"""Height angles from 0 to 90 degrees, by which a sector's radiation is summed up."""

PRESSURES = 9
"""Air pressures from the highest to the lowest ground, for which it is."""


@dataclass(frozen=True, slots=True)
class SunPath:
    """Where the sun stands above the horizon, and how much its rays bring outside of the air.

    Attributes:
        azimuth: degrees clockwise from true north, (n,).
        altitude: degrees above the horizon, (n,), above 0.
        energy: Wh per m2 across the rays, (n,).
        hours: of the whole time, nights too.
    """

    azimuth: Floats
    altitude: Floats
    energy: Floats
    hours: float


@dataclass(frozen=True, slots=True)
class SkySector:
    """The direct radiation that comes from a sector of azimuths.

    Attributes:
        azimuth: of its middle, degrees.
        sums: (`PRESSURES`, `BINS` + 1, 3) float32: Wh/m2 along east, north and up (of the direction to the sun) that
            come from height angles above 0, 90 / BINS, ... 90 degrees, at the lowest to the highest pressure.
    """

    azimuth: float
    sums: npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Sky:
    """All direct radiation of a time.

    Attributes:
        directions: sectors of a full turn.
        sectors: those that the sun passes through.
        pressures: lowest and highest, at which the sums of sectors begin and end.
        hours: of the whole time, nights too.
    """

    directions: int
    sectors: list[SkySector]
    pressures: tuple[float, float]
    hours: float

    @property
    def on_level_ground(self) -> npt.NDArray[np.float32]:
        """Wh/m2 that level ground under an open sky gets, at the lowest to the highest pressure."""
        parts = [sector.sums[:, 0, 2] for sector in self.sectors]
        return np.sum(parts, axis=0, dtype=np.float32) if parts else np.zeros(PRESSURES, np.float32)

    def ways(self, *, everywhere: bool) -> list[tuple[float, SkySector | None]]:
        """Return the azimuths to look to, and the sector there: those with sun, or all of them."""
        sunny = {sector.azimuth: sector for sector in self.sectors}
        every = [360 * number / self.directions for number in range(self.directions)]
        return [(azimuth, sunny.get(azimuth)) for azimuth in (every if everywhere else sunny)]


def declination_and_distance(day: Floats) -> tuple[Floats, Floats]:
    """Return the sun's declination, radians, and the square of mean over true distance, on days from 1 (Spencer)."""
    angle = 2 * np.pi * (day - 1) / 365
    c1, s1, c2, s2, c3, s3 = (f(k * angle) for k in (1, 2, 3) for f in (np.cos, np.sin))
    declination = (
        0.006918 - 0.399912 * c1 + 0.070257 * s1 - 0.006758 * c2 + 0.000907 * s2 - 0.002697 * c3 + 0.00148 * s3
    )
    distance = 1.000110 + 0.034221 * c1 + 0.001280 * s1 + 0.000719 * c2 + 0.000077 * s2
    return declination, distance


def days_between(first: int, last: int) -> Floats:
    """Return the days of a range, over the turn of the year where `last` comes before `first`."""
    days = np.arange(first, last + 1 if last >= first else last + 366)
    return np.asarray((days - 1) % 365 + 1, np.float64)


def sun_path(latitude: float, first_day: int, last_day: int, minutes: float) -> SunPath:
    """Return where the sun stands, every so many minutes of solar time, on each day of a range.

    The declination is that of a day's noon.  The air bends no rays: the sun rises geometrically.  At noon by solar
    time it stands highest; sums over whole days need no equation of time.
    """
    days = days_between(first_day, last_day)
    count = max(1, round(1440 / minutes))
    declination, distance = (values[:, None] for values in declination_and_distance(days))
    hour = ((np.arange(count) + 0.5) / count * 2 - 1) * np.pi
    phi = np.radians(latitude)
    up = np.sin(phi) * np.sin(declination) + np.cos(phi) * np.cos(declination) * np.cos(hour)
    east = -np.cos(declination) * np.sin(hour)
    north = np.cos(phi) * np.sin(declination) - np.sin(phi) * np.cos(declination) * np.cos(hour)
    energy = np.broadcast_to(SOLAR_CONSTANT * distance * 24 / count, up.shape)
    day = up > 0
    azimuth = np.degrees(np.arctan2(east, north)[day]) % 360
    altitude = np.degrees(np.arcsin(np.minimum(up[day], 1)))
    return SunPath(azimuth, altitude, energy[day], 24.0 * len(days))


def air_mass(altitude: Floats) -> Floats:
    """Return how much air the rays cross at sea level, in that of the zenith, for altitudes from 0 degrees."""
    return np.asarray(1 / (np.sin(np.radians(altitude)) + 0.50572 * (altitude + 6.07995) ** -1.6364))


def pressure(height: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the air pressure at heights in m, as a share of that at sea level (ICAO standard atmosphere, to 11 km)."""
    base = np.maximum(1 - np.float32(2.25577e-5) * height, np.float32(0))
    return np.asarray(base ** np.float32(5.25588), np.float32)


def sky_sectors(
    path: SunPath, directions: int, bearing: float, transmittance: float, pressures: tuple[float, float]
) -> list[SkySector]:
    """Return the direct radiation of each sector of azimuths that the sun passes through.

    Args:
        path: of the sun.
        directions: sectors of a full turn; the middle of the first lies in the north of the grid.
        bearing: of true north on the grid, degrees.
        transmittance: share of the radiation that crosses the air from the zenith to sea level.
        pressures: lowest and highest, as shares of that at sea level.
    """
    azimuth = (path.azimuth + bearing) % 360
    sector = np.rint(azimuth * directions / 360).astype(np.intp) % directions
    level = np.cos(np.radians(path.altitude))
    ray = np.stack(
        [level * np.sin(np.radians(azimuth)), level * np.cos(np.radians(azimuth)), np.sin(np.radians(path.altitude))]
    )
    bin_of = np.minimum((path.altitude * (BINS / 90)).astype(np.intp), BINS - 1)
    mass = air_mass(path.altitude)
    sums = np.zeros((PRESSURES, 3, directions * BINS))
    for row, ratio in zip(sums, np.linspace(*pressures, PRESSURES), strict=True):
        energy = path.energy * transmittance ** (mass * ratio)
        for axis in range(3):
            row[axis] = np.bincount(sector * BINS + bin_of, energy * ray[axis], directions * BINS)
    table = np.zeros((directions, PRESSURES, BINS + 1, 3), np.float32)
    by_bin = sums.reshape(PRESSURES, 3, directions, BINS).transpose(2, 0, 3, 1)
    table[:, :, :-1] = np.cumsum(by_bin[:, :, ::-1], axis=2)[:, :, ::-1]
    return [SkySector(360 * k / directions, table[k]) for k in np.unique(sector).tolist()]
