"""Colour: tinting a raster by its values, and laying shade over a picture."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import cache
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, halo, node, pointwise
from nodegraph.errors import nearest
from nodegraph_terrain.blocks import EVERYTHING, row_blocks
from nodegraph_terrain.raster import Image, Raster, Shade, require_same_grid

Floats = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
Colours = str | tuple[str, ...] | tuple[tuple[float, str], ...]

HYPSOMETRIC = (
    "#7ba37c", "#97b585", "#b9c995", "#dad9a8", "#e9dbad", "#e2c796",
    "#d2ac80", "#bf9778", "#b89c8c", "#cfc2bb", "#f7f5f3",
)  # fmt: skip
"""Layer tints of printed relief maps: valley green, straw, brown, grey rock, snow; evenly spaced."""

STEPS = 1024
"""Colours that an evenly spaced list is sampled to."""


@node(version=1, locality=halo(cells=lambda **params: 0 if _is_fixed(**params) else EVERYTHING))
def colour_relief(
    surface: Raster,
    *,
    colours: Annotated[
        Colours,
        Param('A matplotlib map or "hypsometric", a list of "#rrggbb" colours, or a list of [value, "#rrggbb"] stops.'),
    ] = "hypsometric",
    minimum: Annotated[float | None, Param("Value of the first colour; null: the least of the raster.")] = None,
    maximum: Annotated[float | None, Param("Value of the last colour; null: the greatest of the raster.")] = None,
    context: Context,
) -> Image:
    """Tint a raster by its values.

    A named map or a list of colours is spread evenly from `minimum` to `maximum`.  A matplotlib map gives exactly the
    colours that matplotlib would; a list is interpolated linearly in sRGB.  Stops ``[value, "#rrggbb"]``, with rising
    values in the raster's unit, have exactly their colours at their values.  What lies beyond the ends has the colour
    of the end.

    Args:
        surface: any raster.
        colours: the map, list or stops.
        minimum: value of the first colour, in the raster's unit; not with stops.
        maximum: value of the last colour; above `minimum`.
        context: the engine's.

    Returns:
        An opaque sRGB picture with alpha, of the same grid; voids are transparent black.

    Raises:
        ValueError: no such map, no such colour, values that do not rise, or `minimum` not below `maximum`.
    """
    stops, table = _table(colours)
    if stops is None:
        low, high = _range(surface, minimum, maximum, context)
    elif minimum is not None or maximum is not None:
        raise ValueError("stops with values fix the range themselves; leave out minimum and maximum")
    picture = np.zeros((*surface.shape, 4), np.uint8)
    for part in row_blocks(*surface.shape, context, start=0.0 if stops is not None else 0.2):
        void = np.isnan(surface.data[part])
        values = np.where(void, 0.0, surface.data[part].astype(np.float64))
        if stops is not None:
            for channel in range(3):
                picture[part, :, channel] = np.rint(np.interp(values, stops, table[:, channel]))
        else:
            # As matplotlib does: N colours share the range evenly, and the upper end belongs to the last.
            place = (values - low) / (high - low) * len(table) if high > low else np.zeros(values.shape)
            picture[part, :, :3] = table[np.clip(place, 0, len(table) - 1).astype(np.intp)]
        picture[part, :, 3] = 255
        picture[part][void] = 0
    return Image(picture, surface.extent)


Blend = Literal["multiply", "overlay", "soft_light"]


@node(version=1, locality=pointwise)
def blend_shade(
    image: Image,
    shade: Shade,
    *,
    mode: Annotated[Blend, Param("How the shade acts: multiply is strongest, soft_light gentlest.")] = "multiply",
    strength: Annotated[float, Param("How much the shade acts; 0 leaves the image as it is.", ge=0, le=2)] = 1.0,
    level: Annotated[
        float, Param("Shade that leaves the picture as it is: that of level ground.", gt=0, lt=1)
    ] = 0.7071,
    context: Context,
) -> Image:
    """Lay shade over a picture, as relief is printed.

    Level ground keeps its colour, so that the picture still matches its legend.

    ``multiply`` works on the sRGB codes c (0..1), as image editors do.  With the shade s below `level` l it dims,
    above it the distance from white is what shrinks, to a half in full light, so that nothing burns out:

        c' = c (1 - strength (1 - s / l)), at least 0           for s <= l
        c' = 1 - (1 - c) (1 - strength (s - l) / (2 (1 - l)))   for s > l

    ``overlay`` and ``soft_light`` change only the perceived lightness L (of Oklab, Ottosson 2020), so that colours keep
    their hue.  With t = 1/2 where the shade is `level`, falling to 0 in the dark and rising to 1 in full light, and
    t' = 1/2 + strength (t - 1/2) clipped to 0..1,

        overlay     L' = 2 L t'                          for L < 1/2, else 1 - 2 (1 - L) (1 - t')
        soft_light  L' = L - (1 - 2 t') L (1 - L)        for t' <= 1/2, else L + (2 t' - 1) (D(L) - L),

    D(L) = ((16 L - 12) L + 4) L for L <= 1/4, else sqrt(L) (W3C Compositing and Blending, Level 1).  Chroma follows:
    in proportion to L where it darkens, to 1 - L where it lightens.

    Args:
        image: sRGB picture; its alpha is kept.
        shade: 0 to 1 on the same grid.
        mode: ``multiply``, ``overlay`` or ``soft_light``.
        strength: how much the shade acts.
        level: the shade that leaves the picture as it is, sin(altitude) of the light: 0.7071 for 45 degrees.
        context: the engine's.

    Returns:
        The shaded picture; where the shade is void the picture is as it was.

    Raises:
        ValueError: image and shade are on different grids.

    References:
        B. Ottosson (2020): A perceptual color space for image processing. https://bottosson.github.io/posts/oklab/
        W3C (2024): Compositing and Blending Level 1. https://www.w3.org/TR/compositing-1/
    """
    require_same_grid(image, shade)
    if strength == 0:
        return image
    blended = image.data.copy()
    for part in row_blocks(*image.shape, context, cells=1 << 16):
        light = np.clip(shade.data[part], 0, 1)
        void = np.isnan(light)
        light[void] = level
        # One plane per channel.
        codes = np.ascontiguousarray(np.moveaxis(image.data[part, :, :3], 2, 0))
        relit = (
            _multiply(codes, light, strength, level)
            if mode == "multiply"
            else _relight(codes, np.clip(0.5 + strength * (_tone(light, level) - 0.5), 0, 1).astype(np.float32), mode)
        )
        np.copyto(blended[part, :, :3], np.moveaxis(relit, 0, 2), where=~void[:, :, None])
    return Image(blended, image.extent)


def _is_fixed(*, colours: Colours, minimum: float | None, maximum: float | None) -> bool:
    """Say whether the range of colours is known without the raster."""
    has_values = not isinstance(colours, str) and len(colours) > 0 and not isinstance(colours[0], str)
    return has_values or (minimum is not None and maximum is not None)


def _range(surface: Raster, minimum: float | None, maximum: float | None, context: Context) -> tuple[float, float]:
    """Return the range of the colours: what was given, else the least and greatest value."""
    if minimum is not None and maximum is not None:
        if minimum >= maximum:
            raise ValueError(f"minimum {minimum:g} must be below maximum {maximum:g}")
        return minimum, maximum
    low, high = math.nan, math.nan
    for part in row_blocks(*surface.shape, context, stop=0.2):
        low = float(np.fmin(low, np.fmin.reduce(surface.data[part], axis=None)))
        high = float(np.fmax(high, np.fmax.reduce(surface.data[part], axis=None)))
    low, high = low if minimum is None else minimum, high if maximum is None else maximum
    if maximum is not None and not low < maximum:
        # Nothing lies below the given end: a range below it, so that everything has the last colour.
        return maximum - max(1.0, abs(maximum)), maximum
    return low, high


def _table(colours: Colours) -> tuple[npt.NDArray[np.float64] | None, npt.NDArray[Any]]:
    """Return the values of stops (None for evenly spread colours) and the colours: (n, 3), 0 to 255."""
    if isinstance(colours, str):
        name = colours.removesuffix("_r")
        if name == "hypsometric":
            return None, _spread(HYPSOMETRIC if name == colours else HYPSOMETRIC[::-1])
        return None, _matplotlib_map(colours)
    if not colours:
        raise ValueError('colours are missing; give the name of a map, "#rrggbb" colours or [value, "#rrggbb"] stops')
    names = [item for item in colours if isinstance(item, str)]
    if names:
        return None, _spread(names)
    pairs = [item for item in colours if not isinstance(item, str)]
    stops = np.array([value for value, _ in pairs], np.float64)
    if not np.all(np.diff(stops) > 0):
        raise ValueError("the values of the colour stops must rise from each to the next")
    return stops, np.array([_rgb(text) for _, text in pairs], np.float64)


def _rgb(text: str) -> tuple[int, int, int]:
    if not re.fullmatch(r"#[0-9A-Fa-f]{6}", text):
        raise ValueError(f"colour '{text}' must read '#rrggbb', such as '#7ba37c'")
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)


def _spread(colours: Sequence[str]) -> Bytes:
    """Return `STEPS` colours that run evenly through a list."""
    nodes = np.array([_rgb(text) for text in colours], np.float64)
    at = np.linspace(0, len(nodes) - 1, STEPS)
    channels = [np.rint(np.interp(at, np.arange(len(nodes)), nodes[:, channel])) for channel in range(3)]
    return np.stack(channels, axis=1).astype(np.uint8)


def _matplotlib_map(name: str) -> Bytes:
    from matplotlib import colormaps

    if name not in colormaps:
        raise ValueError(f"there is no colour map '{name}'; {nearest(name, ['hypsometric', *colormaps])}")
    chosen = colormaps[name]
    return np.asarray(chosen(np.arange(chosen.N), bytes=True)[:, :3], np.uint8)


@cache
def _decoding() -> Floats:
    """Return linear light 0..1 for each sRGB code (IEC 61966-2-1)."""
    code = np.arange(256) / 255
    return np.asarray(np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4), np.float32)


@cache
def _encoding() -> Bytes:
    """Return the sRGB code for linear light in steps of 1/65535."""
    light = np.arange(65536) / 65535
    code = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(code * 255), np.uint8)


_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_OKLAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def _multiply(codes: Bytes, light: Floats, strength: float, level: float) -> Bytes:
    """Return the sRGB codes, (3, rows, cols), dimmed below the shade of level ground and lightened above it."""
    offset = light - np.float32(level)
    darker = np.clip(1 + np.float32(strength / level) * offset, 0, 1)
    lighter = np.clip(1 - np.float32(strength / (2 - 2 * level)) * offset, 0, 1)
    return np.asarray(np.rint(255 - (255 - codes * darker) * lighter), np.uint8)


def _tone(light: Floats, level: float) -> Floats:
    """Return 0 in the dark, 1/2 at the shade of level ground, 1 in full light."""
    darker, lighter = light * np.float32(0.5 / level), (light - np.float32(level)) * np.float32(0.5 / (1 - level))
    return np.asarray(np.where(light < level, darker, 0.5 + lighter), np.float32)


def _relight(codes: Bytes, tone: Floats, mode: Blend) -> Bytes:
    """Return sRGB codes, (3, rows, cols), with the Oklab lightness changed by `tone` (1/2: unchanged)."""
    planes = _decoding()[codes].reshape(3, -1)
    lightness, a, b = _OKLAB.astype(np.float32) @ np.cbrt(_CONES.astype(np.float32) @ planes)
    before, tone = np.clip(lightness, 0, 1), tone.reshape(-1)
    if mode == "overlay":
        after = np.where(before < 0.5, 2 * before * tone, 1 - 2 * (1 - before) * (1 - tone))
    else:
        lifted = np.where(before <= 0.25, ((16 * before - 12) * before + 4) * before, np.sqrt(before))
        darker = before - (1 - 2 * tone) * before * (1 - before)
        after = np.where(tone <= 0.5, darker, before + (2 * tone - 1) * (lifted - before))
    tiny = np.float32(1e-6)
    chroma = np.where(after < before, after / np.maximum(before, tiny), (1 - after) / np.maximum(1 - before, tiny))
    lab = np.stack([after, a * chroma, b * chroma]).astype(np.float32)
    cones = np.linalg.inv(_OKLAB).astype(np.float32) @ lab
    linear = np.linalg.inv(_CONES).astype(np.float32) @ (cones * cones * cones)
    steps = (np.clip(linear, 0, 1) * np.float32(65535) + np.float32(0.5)).astype(np.uint16)
    return np.asarray(_encoding()[steps].reshape(codes.shape), np.uint8)
