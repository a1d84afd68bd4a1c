"""Water: what it mirrors, what it lets through, and how the wind ruffles it.

References:
    C. Cox, W. Munk (1954): Measurement of the roughness of the sea surface from photographs of the sun's glitter.
    J. Opt. Soc. Am. 44(11). doi:10.1364/JOSA.44.000838.
    R. M. Pope, E. S. Fry (1997): Absorption spectrum (380-700 nm) of pure water. Applied Optics 36(33).
    doi:10.1364/AO.36.008710.
    H. H. Poole, W. R. G. Atkins (1929): Photo-electric measurements of submarine illumination throughout the year.
    J. Mar. Biol. Assoc. 16(1). doi:10.1017/S0025315400029829: attenuation is 1.7 over the Secchi depth.
    W. J. Pierson, L. Moskowitz (1964): A proposed spectral form for fully developed wind seas. J. Geophys. Res. 69(24).
    doi:10.1029/JZ069i024p05181: the spectrum's peak is at 0.877 g / wind.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph_render.material import Water
from nodegraph_render.materials import Spots, steepness
from nodegraph_terrain.noise import Noise

Reals = npt.NDArray[Any]

INDEX = 1.333
"""Refractive index."""

ABSORPTION = np.array([0.267, 0.0545, 0.0101])
"""Of pure water at 612, 549 and 465 nm, 1/m."""

SHORTEST, LONGEST, RIPPLES = 0.1, 8.0, 5
"""Length of the largest ripples, m, at least and at most (a lake has no room for more), and their octaves."""

CALM = 1e-5
"""Variance of slopes that stands for the width of the sun's disc."""


def fresnel(cosine: Reals) -> Reals:
    """Return the share of unpolarised light that water mirrors, by the cosine of the angle to its normal.

    >>> fresnel(np.array([1.0, 0.0])).round(4).tolist()
    [0.0204, 1.0]
    """
    inside = np.sqrt(1 - (1 - cosine * cosine) / INDEX**2)
    across = (cosine - INDEX * inside) / (cosine + INDEX * inside)
    along = (inside - INDEX * cosine) / (inside + INDEX * cosine)
    share: Reals = (across * across + along * along) / 2
    return share


def refracted(direction: Reals, normal: Reals) -> Reals:
    """Return the unit directions of rays, (n, 3), once they are in water."""
    cosine = -np.einsum("ij,ij->i", direction, normal)
    inside = np.sqrt(1 - (1 - cosine * cosine) / INDEX**2)
    bent: Reals = direction / INDEX + ((cosine / INDEX) - inside)[:, None] * normal
    return bent


def attenuation(material: Water) -> npt.NDArray[np.float64]:
    """Return how fast light fades in water, 1/m, (3,): pure water's absorption, and 1.7 over the Secchi depth."""
    return ABSORPTION + 1.7 / material.clarity


def ripples(material: Water, spots: Spots, direction: Reals) -> tuple[Reals, Reals]:
    """Return the normals of ruffled water as far as a footprint shows them, and the variance of slopes that it hides.

    The variance of slopes, both ways together, is 0.003 + 0.00512 wind (Cox and Munk), the largest ripples as long as
    the waves of a developed sea, 0.83 wind^2 metres (Pierson and Moskowitz).  Of slopes within a footprint,
    those that face the viewer are seen more: with s their standard deviation along the view and t the angle of the view
    to the vertical, their mean is s^2 sin t / (cos t + 0.8 s sin t), exact at both ends.
    """
    up = spots.normal.astype(np.float64)
    if material.wind == 0:
        return up, np.full(len(up), CALM)
    total = 0.003 + 0.00512 * material.wind
    longest = min(max(0.83 * material.wind**2, SHORTEST), LONGEST)
    noise = Noise("fbm", RIPPLES, longest, seed=material.seed)
    # A pixel covers more water than its width where it is seen from the side.
    footprint = np.maximum(spots.footprint, 1e-3) / np.sqrt(np.maximum(-direction[:, 2], 0.01))
    share = np.clip(np.log2(longest / (2 * footprint)) / RIPPLES, 0, 1)
    east, north = np.zeros(len(up)), np.zeros(len(up))
    near = share > 0
    found = noise.sample(spots.position[near, 0], spots.position[near, 1], kappa=share[near])
    unit = math.sqrt(total / 2) / steepness(noise)
    east[near], north[near] = unit * found.east, unit * found.north
    hidden = CALM + total * (1 - share)
    level = np.hypot(direction[:, 0], direction[:, 1])
    spread = np.sqrt(hidden / 2)
    mean = spread**2 * level / (np.maximum(-direction[:, 2], 0) + 0.8 * spread * level + 1e-9)
    towards = -direction[:, :2] / np.maximum(level, 1e-9)[:, None]
    # Where water ends in the air it shows a side, which is upright.
    tilt = up / np.maximum(up[:, 2:], 1e-3)
    tilt[:, 0] += mean * towards[:, 0] - east
    tilt[:, 1] += mean * towards[:, 1] - north
    # What faces away from the viewer is hidden by what does not.
    normal = tilt / np.linalg.norm(tilt, axis=1)[:, None]
    facing = -np.einsum("ij,ij->i", direction, normal)
    normal -= np.minimum(facing - 0.01, 0)[:, None] * -direction
    return normal / np.linalg.norm(normal, axis=1)[:, None], hidden


def glint(direction: Reals, normal: Reals, sun: npt.NDArray[np.float64], variance: Reals) -> Reals:
    """Return the radiance of the sun mirrored by slopes too small to be seen, (n,), for an irradiance of 1 across it.

    F p / (4 cos v cos^4 b), with p the normal distribution of slopes and b the tilt of the facet that mirrors the sun.
    """
    half = sun - direction
    half = half / np.linalg.norm(half, axis=1)[:, None]
    up = np.maximum(half[:, 2], 1e-3)
    away = (half[:, :2] / up[:, None] - normal[:, :2] / np.maximum(normal[:, 2:], 1e-3)) ** 2
    density = np.exp(-away.sum(axis=1) / variance) / (math.pi * variance)
    facing = np.maximum(-np.einsum("ij,ij->i", direction, normal), 0.05)
    mirrored: Reals = fresnel(np.clip(half @ sun, 0, 1)) * density / (4 * facing * up**4)
    return mirrored
