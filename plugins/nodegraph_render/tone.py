"""From linear light to a picture: exposure, tone mapping, sRGB."""

from __future__ import annotations

import math
from functools import cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from nodegraph_render.rays import Singles
from nodegraph_render.sky import Sky

Curve = Literal["filmic", "reinhard", "linear"]

BALANCE = np.array([0.989, 1.0, 1.017])
"""What the channels are multiplied by so that white ground under a sun 45 degrees high, and its sky, looks white."""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of the primaries of sRGB."""

KEY = 0.23
"""Exposed light of land in the mean."""

HIGHLIGHTS = 1.2
"""Exposed light that nine tenths of a picture stay below."""

_ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])


def automatic(sky: Sky) -> float:
    """Return the exposure of a light: what radiance is multiplied by so that 0.18 is middle grey.

    Full adaptation to the light on level ground would show dusk as bright as noon: a quarter of the change, in stops,
    is kept, and nothing is gained beyond the end of twilight.
    """
    up = max(float(sky.direction[2]), 0.0)
    given = float(LUMINANCE * BALANCE @ (sky.level + sky.sun * (up + 0.15 * math.sqrt(1 - up * up))))
    return float(1.62 * math.pi * max(given, 1e-5) ** -0.77)


def metered(picture: Singles, land: Singles, sky: Sky) -> float:
    """Return the exposure of a picture: between that of its light and that which suits what it shows.

    Land of a mean luminance (of the logarithm, by its share of each pixel) other than `KEY` moves the exposure half of
    the way there, by 0.6 stops at most: snow then keeps its shape, and woods are not black.  Where a tenth of the
    picture would be brighter than `HIGHLIGHTS`, as against a low sun, less light is let in, down to 1.2 stops.

    Args:
        picture: radiance, (rows, cols, 3).
        land: share of each pixel that is not sky, (rows, cols).
        sky: the light on the ground.
    """
    exposure, weight, change = automatic(sky), land.sum(dtype=np.float64), 1.0
    bright = picture @ (LUMINANCE * BALANCE * exposure).astype(np.float32)
    if weight > 0:
        mean = float((np.log(np.maximum(bright, 1e-9)) * land).sum(dtype=np.float64) / weight)
        change = min(max(math.sqrt(KEY / math.exp(mean)), 0.67), 1.5)
    tenth = float(np.quantile(bright, 0.9))
    return exposure * min(change, max(HIGHLIGHTS / max(tenth, 1e-9), 0.45))


def toned(light: Singles, curve: Curve) -> Singles:
    """Return linear display light, 0 to 1, of exposed linear light, (..., 3), where 0.18 is middle grey.

    - ``filmic``: the fit by S. Hill of the ACES reference and output transforms, which rolls off shadows and highlights
      as film does (Academy Color Encoding System, https://github.com/ampas/aces-core), scaled so that 0.18 stays 0.18.
    - ``reinhard``: L (1 + L / 16) / (1 + L) of the luminance L of the light over 0.82, hues kept (Reinhard et al. 2002,
      doi:10.1145/566654.566575, equation 4).
    - ``linear``: clipped.
    """
    light = np.maximum(light, np.float32(0))
    if curve == "filmic":
        x = (light * np.float32(1.4619)) @ _ACES_IN.T.astype(np.float32)
        x = (x * (x + np.float32(0.0245786)) - np.float32(0.000090537)) / (
            x * (np.float32(0.983729) * x + np.float32(0.4329510)) + np.float32(0.238081)
        )
        light = np.asarray(x @ _ACES_OUT.T.astype(np.float32), np.float32)
    elif curve == "reinhard":
        scaled = light / np.float32(0.82)
        bright = scaled @ LUMINANCE.astype(np.float32)
        light = np.asarray(scaled * ((1 + bright / 16) / (1 + bright))[..., None], np.float32)
    return np.asarray(np.clip(light, 0, 1), np.float32)


def encoded(light: Singles, first_row: int = 0) -> npt.NDArray[np.uint8]:
    """Return sRGB codes (IEC 61966-2-1) of linear display light, (rows, cols, 3).

    Rounded up or down by a fine fixed pattern (interleaved gradient noise, J. Jimenez 2014), so that smooth skies show
    no bands.
    """
    code = np.where(light <= 0.0031308, light * 12.92, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    rows, cols = light.shape[:2]
    y, x = np.arange(first_row, first_row + rows)[:, None], np.arange(cols)[None, :]
    dither = (52.9829189 * ((0.06711056 * x + 0.00583715 * y) % 1)) % 1
    return np.asarray(np.clip(np.floor(code * 255 + dither[..., None]), 0, 255), np.uint8)


def decoded(codes: npt.NDArray[np.uint8]) -> Singles:
    """Return linear light, 0 to 1, of sRGB codes."""
    return _decoding()[codes]


@cache
def _decoding() -> Singles:
    code = np.arange(256) / 255
    return np.asarray(np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4), np.float32)
