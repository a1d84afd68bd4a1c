"""The sun: where light comes from."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Annotated

from nodegraph import Param, node, port_type
from nodegraph_terrain.place import centre_of, true_north
from nodegraph_terrain.raster import Elevation, Extent


@port_type
class Sun:
    """A sun at infinity.

    Attributes:
        azimuth: clockwise from north, degrees.
        altitude: above the horizon, degrees; below 0 it is night.
        diameter: angle that its disc spans, degrees; shadows are as soft as it is wide.
    """

    azimuth: float = 315.0
    altitude: float = 35.0
    diameter: float = 0.533

    @property
    def direction(self) -> tuple[float, float, float]:
        """Unit vector to the sun: east, north, up."""
        azimuth, altitude = math.radians(self.azimuth), math.radians(self.altitude)
        level = math.cos(altitude)
        return level * math.sin(azimuth), level * math.cos(azimuth), math.sin(altitude)


@node(version=1)
def sun(
    place: Elevation | None = None,
    *,
    azimuth: Annotated[
        float | None, Param("Clockwise from north; none: 315, north-west.", ge=-360, le=360, unit="deg")
    ] = None,
    altitude: Annotated[float | None, Param("Above the horizon; none: 35.", ge=-90, le=90, unit="deg")] = None,
    time: Annotated[
        str | None, Param("Instead of the angles: date, time and zone (ISO 8601), as 2024-06-21T17:30+02:00.")
    ] = None,
    latitude: Annotated[
        float | None, Param("With a time; north is positive; none: the linked raster's.", ge=-90, le=90, unit="deg")
    ] = None,
    longitude: Annotated[
        float | None, Param("With a time; east is positive; none: the linked raster's.", ge=-180, le=180, unit="deg")
    ] = None,
    refraction: Annotated[bool, Param("With a time: raised by the air, as it is seen.")] = True,
    diameter: Annotated[
        float, Param("Angle that its disc spans; shadows are as soft as it is wide.", ge=0, le=20, unit="deg")
    ] = 0.533,
) -> Sun:
    """Place the sun: by azimuth and altitude, or by place and time.

    By time it is where Meeus's low-accuracy theory puts it (`position`): within 0.01 degrees from 1950 to 2050 (0.02 to
    1900 and 2100), apart from the air, whose refraction varies by more than that near the horizon.

    Args:
        place: gives latitude and longitude, those of its centre, where they are not stated, if it has a coordinate
            system; the azimuth is then turned from true north to the grid's (meridian convergence).
        azimuth, altitude: as seen from the ground.
        time: the zone is needed: ``Z`` for UTC, or an offset such as ``-05:00``.
        latitude, longitude: both or none.
        refraction, diameter: see above; 0 makes shadows sharp.

    Raises:
        ValueError: angles and a time are given, the time has no zone or is outside of 1900 to 2100, or nothing says
            where that is.
    """
    if time is None:
        if latitude is not None or longitude is not None:
            raise ValueError("latitude and longitude need a time, such as 2024-06-21T12:00Z, to say where the sun is")
        return Sun(315.0 if azimuth is None else azimuth, 35.0 if altitude is None else altitude, diameter)
    when = moment(time)
    if azimuth is not None or altitude is not None:
        raise ValueError("the time and the place say where the sun is; leave out azimuth and altitude, or the time")
    if (latitude is None) != (longitude is None):
        raise ValueError("latitude and longitude belong together; give both, or none for those of the linked raster")
    centre, turn = _centre(place.extent) if place is not None and place.extent.crs else (None, 0.0)
    if latitude is not None and longitude is not None:
        centre = longitude, latitude
    if centre is None:
        raise ValueError("nothing says where it is that time; give latitude and longitude, or link a raster with a CRS")
    found, height = position(when, centre[1], centre[0], refraction=refraction)
    return Sun((found + turn) % 360, height, diameter)


def moment(text: str) -> datetime:
    """Return the time that ISO 8601 text names, with its zone.

    Raises:
        ValueError: it is none, has no zone, or lies outside of 1900 to 2100.
    """
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        found = None
    if found is None:
        raise ValueError(f"'{text}' is no date and time; write it as 2024-06-21T17:30+02:00")
    if found.tzinfo is None:
        raise ValueError(f"the time '{text}' has no zone; add one, as in 2024-06-21T17:30+02:00, or Z for UTC")
    if not 1900 <= found.year <= 2100:
        raise ValueError(f"the year {found.year} is outside of 1900 to 2100, for which the sun's place is known")
    return found


def position(time: datetime, latitude: float, longitude: float, *, refraction: bool = True) -> tuple[float, float]:
    """Return the sun's azimuth, clockwise from true north, and its altitude, degrees.

    The apparent place by the low-accuracy theory, with nutation and aberration in its largest terms, sidereal time, and
    the parallax of 8.8 arc seconds; `refraction` follows NOAA, for 1010 hPa and 10 degrees C.

    Args:
        time: with a zone; the minute by which dynamical time is ahead of it moves the sun by 0.001 degrees.
        latitude, longitude: degrees, north and east positive.
        refraction: add what the air raises it.

    References:
        J. Meeus (1998): Astronomical Algorithms, 2nd ed., chapters 12, 13 and 25.
        NOAA Global Monitoring Laboratory: Solar calculation details, https://gml.noaa.gov/grad/solcalc/calcdetails.html.
    """
    days = (time - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / 86400
    ascension, declination = _apparent(days / 36525)
    sidereal = 280.46061837 + 360.98564736629 * days + 0.000387933 * (days / 36525) ** 2
    hour, declination, phi = map(math.radians, (sidereal + longitude - ascension, declination, latitude))
    east = -math.cos(declination) * math.sin(hour)
    north = math.cos(phi) * math.sin(declination) - math.sin(phi) * math.cos(declination) * math.cos(hour)
    up = math.sin(phi) * math.sin(declination) + math.cos(phi) * math.cos(declination) * math.cos(hour)
    altitude = math.degrees(math.atan2(up, math.hypot(east, north)))
    altitude -= 8.794 / 3600 * math.cos(math.radians(altitude))
    azimuth = math.degrees(math.atan2(east, north)) % 360
    return azimuth, altitude + (_raised(altitude) if refraction else 0.0)


def _apparent(centuries: float) -> tuple[float, float]:
    """Return the apparent right ascension and declination of the sun, degrees, `centuries` after J2000."""
    t = centuries
    anomaly = math.radians(357.52911 + 35999.05029 * t - 0.0001537 * t * t)
    longitude = 280.46646 + 36000.76983 * t + 0.0003032 * t * t
    longitude += (1.914602 - 0.004817 * t - 0.000014 * t * t) * math.sin(anomaly)
    longitude += (0.019993 - 0.000101 * t) * math.sin(2 * anomaly) + 0.000289 * math.sin(3 * anomaly)
    lunar_node = math.radians(125.04 - 1934.136 * t)
    longitude -= 0.00569 + 0.00478 * math.sin(lunar_node)
    obliquity = 23.4392911 - 0.0130042 * t + 0.00256 * math.cos(lunar_node)
    along, tilt = math.radians(longitude), math.radians(obliquity)
    ascension = math.degrees(math.atan2(math.cos(tilt) * math.sin(along), math.cos(along)))
    # The equation of the equinoxes belongs to sidereal time; here it is taken off the right ascension.
    ascension += 0.00478 * math.sin(lunar_node) * math.cos(tilt)
    return ascension, math.degrees(math.asin(math.sin(tilt) * math.sin(along)))


def _raised(altitude: float) -> float:
    """Return by how much the air raises what stands at an altitude, degrees (NOAA)."""
    if altitude > 85:
        return 0.0
    slope = math.tan(math.radians(altitude))
    if altitude > 5:
        seconds = 58.1 / slope - 0.07 / slope**3 + 0.000086 / slope**5
    elif altitude > -0.575:
        seconds = 1735 + altitude * (-518.2 + altitude * (103.4 + altitude * (-12.79 + altitude * 0.711)))
    else:
        seconds = -20.774 / slope
    return seconds / 3600


def _centre(extent: Extent) -> tuple[tuple[float, float], float]:
    """Return longitude and latitude of the centre of an extent, and the bearing of true north on its grid, degrees."""
    centre = centre_of(extent)
    if not all(map(math.isfinite, centre)):
        raise ValueError("the centre of the linked raster lies nowhere on the Earth; give latitude and longitude")
    return centre, true_north(extent)
