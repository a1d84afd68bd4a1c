"""The sky over a scene: its radiance in every direction, the light it sheds, and the haze in front of what is far.

Directions are unit vectors: east, north, up.  Radiance is in units of the sun's irradiance above the air per steradian.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph_render.atmosphere import (
    ALBEDO,
    ASYMMETRY,
    EARTH,
    GROUND,
    HAZE_HEIGHT,
    RAYLEIGH_HEIGHT,
    Air,
    Floats,
    along,
    bilinear,
    fading,
    intervals,
    path,
)
from nodegraph_render.sun import Sun

Singles = npt.NDArray[np.float32]
Reals = npt.NDArray[Any]
"""Single or double precision."""

ROWS, COLS = 160, 64
"""Size of the table of a sky: zenith angles, half of them above the horizon; azimuths, from the sun's onwards."""

LEVELS, SPACING = 128, 250.0
"""Heights at which the light that haze scatters is tabulated, and their distance, m."""

NIGHT = np.array([0.7e-6, 0.9e-6, 1.3e-6])
"""Radiance of a clear night without a moon: stars and airglow, as if it were several thousand times as bright.

True night is 1e-10 of day, in which a picture would be black; this leaves a hint of shape."""


@dataclass(frozen=True)
class Sky:
    """The light over a scene at one time.

    Attributes:
        air: the medium.
        direction: unit vector to the sun, (3,).
        chord: squared distance, on the unit sphere, from the centre of its disc to the edge; 0 where it has none.
        height: of the observer, m.
        table: radiance without the disc, (ROWS, COLS, 3) float32.
        sun: irradiance of the sun across its rays at the observer, (3,).
        harmonics: irradiance of sky and ground on a surface by its normal, (9, 3): see `irradiance`.
        level: irradiance of the sky on level ground, (3,).
        lit: for each of `LEVELS` heights, sunlight across its rays and light scattered more than once, (LEVELS, 6)
            float32.
    """

    air: Air
    direction: Floats
    chord: float
    height: float
    table: Singles
    sun: Floats
    harmonics: Floats
    level: Floats
    lit: Singles

    @classmethod
    def over(cls, height: float, sun: Sun, air: Air) -> Sky:
        """Return the sky as seen at `height` metres above the sea.

        Heights are rounded to a 64th of themselves or 16 m, which changes light by half a percent at most, one in thick
        haze under a low sun: so the frames of a flight share their skies, of which the last are kept.
        """
        return _over(_rounded(min(max(height, 1.0), 90_000.0)), sun.direction, sun.diameter, air)

    @property
    def disc(self) -> Floats:
        """Radiance of the sun's disc, (3,)."""
        return self.sun / (math.pi * self.chord) if self.chord > 0 else np.zeros(3)

    @property
    def bounce(self) -> Floats:
        """Radiance of level ground around the scene, (3,)."""
        return bounce(self.sun, self.direction, self.level)

    def radiance(self, direction: Reals, *, disc: bool = True) -> Floats:
        """Return the radiance from unit directions, (n, 3); with `disc`, the sun's own."""
        row, col = places(direction, self.height, self.direction)
        found = bilinear(self.table, row, col)
        if disc and self.chord > 0:
            apart = ((direction - self.direction) ** 2).sum(axis=1)
            # The disc's edge is as soft as a twentieth of it.
            share = np.clip(0.5 + (self.chord - apart) / (0.1 * self.chord), 0, 1)
            found = found + share[:, None] * self.disc
        return found

    def irradiance(self, normal: Reals) -> Floats:
        """Return the irradiance from sky and ground on surfaces of unit normals, (n, 3), nothing standing in the way.

        A quadratic function of the normal: in the first nine spherical harmonics, which hold nearly all of what diffuse
        surfaces show (Ramamoorthi and Hanrahan 2001, doi:10.1145/383259.383317), fitted over the upward normals, the
        level ones most.  Within 2.2 % where the sun stands 40 degrees high or more, 5 % at 20 and 11 % at 5, when much
        of the light comes from close around it.
        """
        return np.maximum(_basis(normal) @ self.harmonics, 0)

    def air_light(self, cosine: Reals, start: Reals, end: Reals, distance: Reals) -> tuple[Floats, Floats]:
        """Return what air does along straight paths: the share it lets through and the radiance it adds, (n, 3) each.

        The columns of molecules and of haze are exact for densities that fall exponentially with height; the light that
        they scatter is that in the middle of the path, and the shadows of mountains in the air are left out.

        Args:
            cosine: of the angle between the direction of view and the sun.
            start, end: heights of the ends, m.
            distance: length of the path, m, at most some 100 km: the Earth counts as flat.
        """
        low, high = np.maximum(start, 0), np.maximum(end, 0)
        molecules = (distance * _density(low, high, RAYLEIGH_HEIGHT))[:, None] * self.air.molecules
        haze = (distance * _density(low, high, HAZE_HEIGHT))[:, None] * self.air.haze
        depth = molecules + haze
        lit = bilinear(self.lit[:, None, :].repeat(2, axis=1), (low + high) / (2 * SPACING), np.zeros(len(low)))
        scattered, haze = molecules, ALBEDO * haze
        once = lit[:, :3] * (scattered * rayleigh(cosine)[:, None] + haze * mie(cosine)[:, None])
        return np.exp(-depth), (once + lit[:, 3:] * (scattered + haze)) * fading(depth)


def _rounded(height: float) -> float:
    step = min(2.0 ** math.floor(math.log2(height / 64)), 16.0)
    return round(height / step) * step


@lru_cache(maxsize=64)
def _over(height: float, towards: tuple[float, float, float], diameter: float, air: Air) -> Sky:
    direction = np.array(towards)
    table = _table(air, height, direction)
    heights = SPACING * np.arange(LEVELS, dtype=np.float64)
    mu = np.full(LEVELS, direction[2])
    lit = np.concatenate([air.sunlight(heights, mu), air.multiple(heights, mu)], axis=1).astype(np.float32)
    here = air.sunlight(np.array([height]), mu[:1])[0]
    level, harmonics = _irradiance(table, height, direction, here)
    chord = 4 * math.sin(math.radians(diameter / 4)) ** 2
    return Sky(air, direction, chord, height, table, here, harmonics, level, lit)


def rayleigh(cosine: Reals) -> Reals:
    """Return the phase function of molecules, 1/sr."""
    return (3 / (16 * math.pi)) * (1 + cosine * cosine)


def mie(cosine: Reals) -> Reals:
    """Return the phase function of haze (Henyey and Greenstein 1941), 1/sr."""
    g = ASYMMETRY
    return ((1 - g * g) / (4 * math.pi)) / np.maximum(1 + g * g - 2 * g * cosine, 1e-4) ** 1.5


def places(direction: Reals, height: float, sun: Floats) -> tuple[Floats, Floats]:
    """Return where directions lie in the table of a sky, as rows and columns.

    Rows are spaced by the square root of the angle from the horizon, where the sky changes most; the two rows at the
    horizon are not mixed.
    """
    dip, half = math.acos(EARTH / (EARTH + height)), ROWS // 2
    angle = np.arcsin(np.clip(direction[:, 2], -1, 1)) + dip
    up = half + np.sqrt(np.clip(angle / (math.pi / 2 + dip), 0, 1)) * (half - 1)
    down = half - 1 - np.sqrt(np.clip(-angle / (math.pi / 2 - dip), 0, 1)) * (half - 1)
    east, north = direction[:, 0], direction[:, 1]
    turn = np.arctan2(np.abs(east * sun[1] - north * sun[0]), east * sun[0] + north * sun[1]) / math.pi
    # Closer together near the sun.
    return np.where(angle >= 0, up, down), np.sqrt(turn) * (COLS - 1)


def bounce(sun: Floats, direction: Floats, level: Floats) -> Floats:
    """Return the radiance of level ground under a sun and a sky."""
    return np.asarray((sun * max(direction[2], 0.0) + level) * (GROUND / math.pi))


def _density(low: Reals, high: Reals, scale: float) -> Reals:
    """Return the mean of exp(-height / scale) between two heights."""
    rise = np.abs(high - low) / scale
    mean: Reals = np.exp(np.minimum(low, high) / -scale) * fading(rise)
    return mean


def _table(air: Air, height: float, sun: Floats) -> Singles:
    """Return the radiance of the sky by direction."""
    dip, half = math.acos(EARTH / (EARTH + height)), ROWS // 2
    share = np.linspace(0, 1, half) ** 2
    angle = np.concatenate([(-share * (math.pi / 2 - dip))[::-1], share * (math.pi / 2 + dip)]) - dip
    # Just above and below the horizon, not on it.
    angle += np.where(np.arange(ROWS) < half, -1e-4, 1e-4)
    turn = math.pi * np.linspace(0, 1, COLS) ** 2
    level = math.hypot(sun[0], sun[1])
    east, north = (sun[0] / level, sun[1] / level) if level > 1e-12 else (0.0, 1.0)
    flat = np.cos(angle)[:, None]
    direction = np.stack(
        [
            flat * (np.cos(turn) * east + np.sin(turn) * north),
            flat * (np.cos(turn) * north - np.sin(turn) * east),
            np.sin(angle)[:, None] + 0 * turn,
        ],
        axis=-1,
    )
    here = np.full((ROWS, COLS), height)
    distance, lands = path(here, direction[..., 2])
    cosine = direction @ sun
    light, through = np.zeros((ROWS, COLS, 3)), np.ones((ROWS, COLS, 3))
    for place, width in zip(*intervals(32), strict=True):
        at, mu_sun = along(here, direction, sun, distance * place)
        molecules, haze = air.scattering(at)
        length = (distance * width)[..., None]
        depth = air.extinction(at) * length
        once = molecules * rayleigh(cosine)[..., None] + haze * mie(cosine)[..., None]
        source = air.sunlight(at, mu_sun) * once + air.multiple(at, mu_sun) * (molecules + haze)
        light += through * source * (length * fading(depth))
        through = through * np.exp(-depth)
    at, mu_sun = along(here, direction, sun, distance)
    sea = np.zeros((ROWS, COLS))
    # Of the light on the ground, the sky's share is that of isotropic light scattered more than once, roughly.
    landed = air.sunlight(sea, mu_sun) * np.maximum(mu_sun, 0)[..., None] + math.pi * air.multiple(sea, mu_sun)
    light += np.where(lands[..., None], through * landed * (GROUND / math.pi), 0)
    return np.asarray(light + NIGHT, np.float32)


def _irradiance(table: Singles, height: float, sun: Floats, sunlight: Floats) -> tuple[Floats, Floats]:
    """Return the irradiance of the sky on level ground, and the coefficients of `Sky.irradiance`."""
    direction = _sphere(1 << 14)
    weight, rising = 4 * math.pi / len(direction), direction[:, 2] > 0
    light = bilinear(table, *places(direction, height, sun))
    level: Floats = weight * (np.maximum(direction[:, 2], 0)[:, None] * light).sum(axis=0)
    light[~rising] = bounce(sunlight, sun, level)
    normals = _sphere(512)[:256]  # the upper half
    shed = weight * np.maximum(normals @ direction.T, 0) @ light
    matter = 0.2 + normals[:, 2:]
    return level, np.asarray(np.linalg.lstsq(matter * _basis(normals), matter * shed, rcond=None)[0])


def _sphere(count: int) -> Floats:
    """Return unit vectors spread evenly, from the zenith down."""
    index = np.arange(count) + 0.5
    z, turn = 1 - 2 * index / count, index * math.pi * (1 + math.sqrt(5))
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def _basis(direction: Reals) -> Floats:
    """Return the first nine real spherical harmonics, (n, 9)."""
    x, y, z = direction[:, 0], direction[:, 1], direction[:, 2]
    return np.stack(
        [
            np.full(len(x), 0.282095),
            0.488603 * y,
            0.488603 * z,
            0.488603 * x,
            1.092548 * x * y,
            1.092548 * y * z,
            0.315392 * (3 * z * z - 1),
            1.092548 * x * z,
            0.546274 * (x * x - y * y),
        ],
        axis=1,
    )
