"""Clear air over a round Earth: how it dims light and scatters it, once and many times.

Light has three channels, at 612, 549 and 465 nm, the dominant wavelengths of the primaries of sRGB.  Molecules
(Rayleigh) and haze (Mie) thin out exponentially with height; ozone absorbs in a layer about 25 km up.  Haze follows
from the visibility V at sea level, the distance at which contrast falls to 2 %: by Koschmieder's law the extinction at
550 nm is 3.912 / V, of which haze has what molecules leave, and it falls with wavelength as lambda^-1.3 (Angstrom's
exponent of continental air).

Radiance is in units of the sun's irradiance above the air per steradian, irradiance in units of that irradiance.

References:
    S. Hillaire (2020): A scalable and production ready sky and atmosphere rendering technique. Computer Graphics Forum
    39(4). doi:10.1111/cgf.14050.  Equations 5 to 10: multiple scattering.
    E. Bruneton, F. Neyret (2008): Precomputed atmospheric scattering. Computer Graphics Forum 27(4).
    doi:10.1111/j.1467-8659.2008.01245.x.  The mapping of the table of transmittance; profiles and the spectra of
    molecules and ozone as in their implementation of 2017.
    H. Koschmieder (1924): Theorie der horizontalen Sichtweite. Beitraege zur Physik der freien Atmosphaere 12.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

EARTH = 6_360_000.0
"""Radius of the sea's surface, m."""

TOP = 6_460_000.0
"""Radius where the air ends, m."""

WAVELENGTHS = np.array([612.0, 549.0, 465.0])
"""Of the channels, nm."""

RAYLEIGH = 1.24062e-6 * (WAVELENGTHS / 1000) ** -4
"""Scattering by molecules at sea level, 1/m."""

OZONE = np.array([2.25e-6, 1.86e-6, 0.23e-6])
"""Absorption by ozone where it is densest, 1/m."""

RAYLEIGH_HEIGHT, HAZE_HEIGHT = 8000.0, 1200.0
"""Heights over which molecules and haze thin out by a factor e, m."""

ANGSTROM = 1.3
ALBEDO = 0.9
"""Share of what haze takes from a beam that it scatters."""

ASYMMETRY = 0.8
"""g of the Henyey-Greenstein phase function of haze."""

GROUND = 0.2
"""Reflectance of the Earth around the scene."""

CLEAREST = 3.912 / RAYLEIGH[1]
"""Visibility in air without haze, m."""


@dataclass(frozen=True, eq=False)
class Air:
    """A medium.

    Attributes:
        molecules: scattering by molecules at sea level, 1/m, (3,).
        haze: extinction by haze at sea level, 1/m, (3,).
        ozone: absorption by ozone where it is densest, 1/m, (3,).
    """

    molecules: Floats
    haze: Floats
    ozone: Floats

    @classmethod
    @lru_cache(maxsize=4)
    def of_visibility(cls, visibility: float) -> Air:
        """Return air in which one sees `visibility` metres far, at most `CLEAREST`."""
        haze = max(0.0, 3.912 / visibility - RAYLEIGH[1]) * (550.0 / WAVELENGTHS) ** ANGSTROM
        return cls(RAYLEIGH, haze, OZONE)

    def densities(self, height: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the densities of molecules, haze and ozone at heights above the sea (m), 1 where they are defined."""
        level = np.maximum(height, 0)
        ozone = np.maximum(0, 1 - np.abs(level - 25_000) / 15_000)
        return np.exp(level / -RAYLEIGH_HEIGHT), np.exp(level / -HAZE_HEIGHT), ozone

    def extinction(self, height: Floats) -> Floats:
        """Return the extinction at heights, 1/m, (..., 3)."""
        molecules, haze, ozone = self.densities(height)
        return molecules[..., None] * self.molecules + haze[..., None] * self.haze + ozone[..., None] * self.ozone

    def scattering(self, height: Floats) -> tuple[Floats, Floats]:
        """Return the scattering by molecules and by haze at heights, 1/m, (..., 3) each."""
        molecules, haze, _ = self.densities(height)
        return molecules[..., None] * self.molecules, haze[..., None] * (ALBEDO * self.haze)

    # The table of transmittance, over height and the cosine of the zenith angle.

    @cached_property
    def _transmittance(self) -> Floats:
        rows, cols, steps = 64, 256, 40
        across = math.sqrt(TOP**2 - EARTH**2)
        rho = across * np.linspace(0, 1, rows)[:, None]
        radius = np.sqrt(rho**2 + EARTH**2)
        nearest, farthest = TOP - radius, rho + across
        distance = nearest + np.linspace(0, 1, cols) * (farthest - nearest)
        mu = np.where(distance > 0, (across**2 - rho**2 - distance**2) / (2 * radius * np.maximum(distance, 1)), 1.0)
        mu = np.clip(mu, -1, 1)
        places, widths = intervals(steps)
        t = distance[..., None] * places
        height = np.sqrt(radius[..., None] ** 2 + t * t + 2 * radius[..., None] * mu[..., None] * t) - EARTH
        depth = (self.extinction(height) * (distance[..., None] * widths)[..., None]).sum(axis=-2)
        return np.asarray(np.exp(-depth))

    def transmittance(self, height: Floats, mu: Floats) -> Floats:
        """Return what comes through from outside the air, (..., 3), towards a zenith angle of cosine mu.

        The Earth below the horizon is not looked for.
        """
        radius = np.clip(height, 0, TOP - EARTH) + EARTH
        across = math.sqrt(TOP**2 - EARTH**2)
        rho = np.sqrt(np.maximum(radius**2 - EARTH**2, 0))
        distance = np.maximum(0, -radius * mu + np.sqrt(np.maximum(radius**2 * (mu**2 - 1) + TOP**2, 0)))
        nearest, farthest = TOP - radius, rho + across
        place = np.clip((distance - nearest) / np.maximum(farthest - nearest, 1), 0, 1)
        return bilinear(self._transmittance, rho / across * 63, place * 255)

    def sunlight(self, height: Floats, mu: Floats) -> Floats:
        """Return the irradiance of the sun across its rays, (..., 3), where it stands at a zenith angle of cosine mu.

        It sinks behind the round Earth within the width of its disc.
        """
        horizon = -np.sqrt(1 - (EARTH / (np.maximum(height, 0) + EARTH)) ** 2)
        risen = np.clip((mu - horizon) / 0.0093 + 0.5, 0, 1)
        return self.transmittance(height, mu) * (risen * risen * (3 - 2 * risen))[..., None]

    # Light that was scattered more than once.

    @cached_property
    def _multiple(self) -> Floats:
        """Radiance that scattering turns isotropic, over height (squared spacing) and the cosine of the sun's angle."""
        height = 1 + (TOP - EARTH - 2) * np.linspace(0, 1, 16)[:, None] ** 2
        mu_sun = np.linspace(-1, 1, 48)[None, :]
        height, mu_sun = np.broadcast_arrays(height, mu_sun)
        sun = np.stack([np.sqrt(1 - mu_sun**2), np.zeros_like(mu_sun), mu_sun], axis=-1)
        # The sun stands in the plane y = 0: one side of it tells of the other.
        count = 32
        index = np.arange(count) + 0.5
        z, turn = 1 - 2 * index / count, math.pi * (index * math.sqrt(5) % 1)
        once, again = np.zeros((*height.shape, 3)), np.zeros((*height.shape, 3))
        for direction in np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1):
            light, share = self._march(height, direction, sun)
            once += light / count
            again += share / count
        return np.asarray(once / (1 - again))

    def _march(self, height: Floats, direction: Floats, sun: Floats) -> tuple[Floats, Floats]:
        """Return light scattered once with an isotropic phase, and the share of the path that scatters."""
        distance, lands = path(height, np.full(height.shape, direction[2]))
        light, share = np.zeros((*height.shape, 3)), np.zeros((*height.shape, 3))
        through = np.ones((*height.shape, 3))
        for place, width in zip(*intervals(20), strict=True):
            here, mu_sun = along(height, direction, sun, distance * place)
            molecules, haze = self.scattering(here)
            length = (distance * width)[..., None]
            depth = self.extinction(here) * length
            part = through * (molecules + haze) * (length * fading(depth))
            light += part * self.sunlight(here, mu_sun) / (4 * math.pi)
            share += part
            through = through * np.exp(-depth)
        here, mu_sun = along(height, direction, sun, distance)
        ground = self.sunlight(np.zeros(height.shape), mu_sun) * np.maximum(mu_sun, 0)[..., None] * (GROUND / math.pi)
        return light + np.where(lands[..., None], through * ground, 0), share

    def multiple(self, height: Floats, mu_sun: Floats) -> Floats:
        """Return the isotropic radiance of light scattered more than once, (..., 3)."""
        row = np.sqrt(np.clip((height - 1) / (TOP - EARTH - 2), 0, 1)) * 15
        return bilinear(self._multiple, row, (np.clip(mu_sun, -1, 1) + 1) * 23.5)


VACUUM = Air(np.zeros(3), np.zeros(3), np.zeros(3))
"""No air at all."""


def intervals(count: int) -> tuple[Floats, Floats]:
    """Return middles and widths of the parts of a path of length 1, shorter near its start, where air is dense."""
    ends = np.linspace(0, 1, count + 1) ** 2
    return (ends[1:] + ends[:-1]) / 2, np.diff(ends)


def fading(depth: npt.NDArray[np.floating]) -> Floats:
    """Return (1 - exp(-depth)) / depth: what a path of that optical depth lets through of its own light."""
    small = np.maximum(depth, 1e-6)
    return np.asarray(-np.expm1(-small) / small)


def path(height: Floats, mu: Floats) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return how far a ray goes until it leaves the air or meets the sea, m, and whether it meets the sea."""
    radius = np.clip(height, 0, TOP - EARTH) + EARTH
    inside = radius**2 * (mu**2 - 1) + EARTH**2
    lands = (inside >= 0) & (mu < 0)
    sea = -radius * mu - np.sqrt(np.maximum(inside, 0))
    out = -radius * mu + np.sqrt(np.maximum(radius**2 * (mu**2 - 1) + TOP**2, 0))
    return np.maximum(np.where(lands, sea, out), 0), lands


def along(height: Floats, direction: Floats, sun: Floats, t: Floats) -> tuple[Floats, Floats]:
    """Return the height t metres along a ray, and the cosine of the sun's zenith angle there."""
    x, y, z = (direction[..., axis] * t for axis in range(3))
    up = z + np.clip(height, 0, TOP - EARTH) + EARTH
    radius = np.sqrt(x * x + y * y + up * up)
    return radius - EARTH, (x * sun[..., 0] + y * sun[..., 1] + up * sun[..., 2]) / radius


def bilinear(table: npt.NDArray[np.floating], row: Floats, col: Floats) -> Floats:
    """Return a table of vectors, (rows, cols, n), between its entries; places beyond its edges count as at them."""
    rows, cols, _ = table.shape
    row, col = np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)
    i, j = np.minimum(row.astype(np.intp), max(rows - 2, 0)), np.minimum(col.astype(np.intp), max(cols - 2, 0))
    u, v = (row - i)[..., None], (col - j)[..., None]
    flat, at = table.reshape(rows * cols, -1), i * cols + j
    upper = flat[at] + v * (flat[at + 1] - flat[at])
    lower = flat[at + cols] + v * (flat[at + cols + 1] - flat[at + cols])
    return np.asarray(upper + u * (lower - upper))
