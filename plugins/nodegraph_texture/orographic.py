"""Rain over mountains: the linear theory of lifted air, and the plainer upslope and sheltering by the wind.

Source of the theory: R. B. Smith, I. Barstad (2004): A linear theory of orographic precipitation. J. Atmos. Sci. 61.
doi:10.1175/1520-0469(2004)061<1377:ALTOOP>2.0.CO;2.  Numbers in parentheses are its equations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.gradient import horn_gradient
from nodegraph_texture.horizon import horizon, pyramid, steps

Doubles = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

GRAVITY, GAS_DRY, GAS_VAPOUR = 9.80665, 287.05, 461.5
LATENT_HEAT, HEAT_CAPACITY = 2.5e6, 1005.0
"""m/s2; J/(kg K) of dry air and of vapour; J/kg of evaporation, J/(kg K) of air at constant pressure."""


@dataclass(frozen=True, slots=True)
class MoistAir:
    """What the theory needs to know of saturated air.

    Attributes:
        sensitivity: C_w, condensed water per volume of lifted air, kg/m3.
        scale_height: H_w, height over which the vapour thins, m.
        stability: N_m, moist buoyancy frequency, 1/s.
    """

    sensitivity: float
    scale_height: float
    stability: float


def moist_air(temperature: float, lapse_rate: float) -> MoistAir:
    """Return the air over ground at sea level.

    The vapour is saturated (Magnus' formula, Bolton 1980, doi:10.1175/1520-0493(1980)108<1046:TCOEPT>2.0.CO;2), and its
    lapse is the moist adiabat: C_w = rho_s Gamma_m / gamma, H_w = R_v T^2 / (L gamma) and N_m^2 =
    g / T (Gamma_m - gamma), after its section 2.

    Args:
        temperature: degC.
        lapse_rate: gamma, how much colder the air around is per km, K/km.

    Raises:
        ValueError: the air is so warm and its lapse so great that it would turn over by itself.
    """
    kelvin = temperature + 273.15
    vapour = 611.2 * math.exp(17.67 * temperature / (temperature + 243.5))
    mixing = 0.622 * vapour / (101325 - vapour)
    adiabat = (
        GRAVITY
        * (1 + LATENT_HEAT * mixing / (GAS_DRY * kelvin))
        / (HEAT_CAPACITY + LATENT_HEAT**2 * mixing * 0.622 / (GAS_DRY * kelvin**2))
    )
    gamma = lapse_rate / 1000
    if gamma >= adiabat:
        raise ValueError(
            f"air of {temperature:g} degC that cools by {lapse_rate:g} K/km is not stable; give an air_lapse_rate "
            f"below {1000 * adiabat:.2f} K/km"
        )
    return MoistAir(
        vapour / (GAS_VAPOUR * kelvin) * adiabat / gamma,
        GAS_VAPOUR * kelvin**2 / (LATENT_HEAT * gamma),
        math.sqrt(GRAVITY / kelvin * (adiabat - gamma)),
    )


def wind_vector(direction: float, speed: float) -> tuple[float, float]:
    """Return the wind towards east and north, m/s, from the direction that it comes from, degrees."""
    angle = math.radians(direction)
    return -speed * math.sin(angle), -speed * math.cos(angle)


def linear_precipitation(
    heights: Doubles,
    cell: tuple[float, float],
    wind: tuple[float, float],
    air: MoistAir,
    conversion_time: float,
    fallout_time: float,
) -> Doubles:
    """Return the precipitation that lifted air brings to a periodic surface, kg/(m2 s); negative where it dries.

    In Fourier space, with h the heights and sigma = U k + V l,

        P = C_w i sigma h / ((1 - i m H_w) (1 + i sigma tau_c) (1 + i sigma tau_f))      (49)

    with the vertical wavenumber m = sqrt((N_m^2 / sigma^2 - 1) (k^2 + l^2)), of the sign of sigma where it is real, and
    i |m| where it is not (12).  The mean of P is 0.

    Args:
        heights: (rows, cols) m, north first.
        cell: (width, height), m.
        wind: towards east and north, m/s.
        air: that is lifted.
        conversion_time, fallout_time: tau_c and tau_f, of cloud to rain and of rain to the ground, s.
    """
    rows, cols = heights.shape
    east = 2 * np.pi * np.fft.rfftfreq(cols, cell[0])[None, :]
    # Rows run southwards.
    north = -2 * np.pi * np.fft.fftfreq(rows, cell[1])[:, None]
    sigma = wind[0] * east + wind[1] * north
    # A wave that no wind crosses lifts nothing; any sigma will do to divide by.
    crossed = np.abs(sigma) > 1e-12
    safe = np.where(crossed, sigma, 1.0)
    squared = (air.stability**2 / safe**2 - 1) * (east**2 + north**2)
    root = np.sqrt(np.abs(squared))
    vertical = np.where(squared >= 0, np.sign(safe) * root, 1j * root)
    response = air.sensitivity * 1j * sigma / (1 - 1j * vertical * air.scale_height)
    response /= (1 + 1j * sigma * conversion_time) * (1 + 1j * sigma * fallout_time)
    spectrum = np.fft.rfft2(heights) * np.where(crossed, response, 0)
    return np.asarray(np.fft.irfft2(spectrum, s=(rows, cols)))


def padded(heights: Floats, cell: tuple[float, float], reach: float) -> tuple[Doubles, tuple[slice, slice]]:
    """Return a surface that goes on around itself without a step, and where the given one lies in it.

    Voids take the height of the nearest known cell.  Beyond the border the outer cells go on, and fade over `reach`
    metres to the mean height of the border: what blows out on one side does not come in on the other.
    """
    from scipy.fft import next_fast_len
    from scipy.ndimage import distance_transform_edt

    void = np.isnan(heights)
    filled = heights.astype(np.float64)
    if void.any():
        row, col = distance_transform_edt(void, sampling=cell[::-1], return_distances=False, return_indices=True)
        filled = filled[row, col]
    level = float(np.concatenate([filled[0], filled[-1], filled[:, 0], filled[:, -1]]).mean())
    margins, windows = [], []
    for size, side in zip(filled.shape, cell[::-1], strict=True):
        pad = math.ceil(reach / side)
        total = next_fast_len(size + 2 * pad, real=True)
        margins.append((pad, total - size - pad))
        outside = np.maximum(np.maximum(pad - np.arange(total), np.arange(total) - pad - size + 1), 0) / (pad + 1)
        windows.append(np.cos(np.pi / 2 * np.minimum(outside, 1)) ** 2)
    wide = level + (np.pad(filled, margins, mode="edge") - level) * windows[0][:, None] * windows[1]
    rows, cols = (slice(m[0], m[0] + size) for m, size in zip(margins, filled.shape, strict=True))
    return wide, (rows, cols)


def windward_and_leeward(
    heights: Floats,
    cell: tuple[float, float],
    direction: float,
    smoothing: float,
    windward: float,
    shadow: float,
    context: Context,
) -> Floats:
    """Return by what the wind multiplies the precipitation of every cell.

        (1 + windward max(0, w)) (1 - shadow sin S)

    with w the rise of the ground in the direction of the wind, per metre (the upslope model: Roe 2005, section 3), and
    S the height angle of the highest ground upwind (the maximum upwind slope of Winstral et al. 2002), both on heights
    smoothed by a Gaussian.

    Args:
        heights: (rows, cols), m, NaN where void.
        cell: (width, height), m.
        direction: where the wind comes from, degrees.
        smoothing: standard deviation of the Gaussian, m.
        windward, shadow: strengths; `shadow` at most 1.
        context: the engine's.
    """
    smooth = smoothed(heights, cell, smoothing)
    wind = wind_vector(direction, 1.0)
    ground = pyramid(smooth)
    look = steps(direction % 360, cell, (heights.shape[0], heights.shape[1]), ground.relief)
    factor = np.empty(heights.shape, np.float32)
    for part in row_blocks(heights.shape[0], heights.shape[1], context, cells=1 << 16, start=0.1):
        east, north = horn_gradient(smooth, part, cell)
        rise = np.maximum(east * np.float32(wind[0]) + north * np.float32(wind[1]), 0)
        tangent = horizon(ground, look, part, context)
        factor[part] = (1 + np.float32(windward) * rise) * (1 - np.float32(shadow) * np.sin(np.arctan(tangent)))
    return factor


def smoothed(heights: Floats, cell: tuple[float, float], sigma: float) -> Floats:
    """Return heights smoothed by a Gaussian, of the known cells around each; voids stay void."""
    from scipy.ndimage import gaussian_filter

    if sigma == 0:
        return heights
    known = ~np.isnan(heights)
    width = sigma / cell[1], sigma / cell[0]
    total = gaussian_filter(np.where(known, heights, 0).astype(np.float64), width, mode="nearest")
    weight = gaussian_filter(known.astype(np.float64), width, mode="nearest")
    return np.where(known, total / np.maximum(weight, 1e-12), np.nan).astype(np.float32)
