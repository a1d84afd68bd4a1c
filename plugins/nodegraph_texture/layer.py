"""A surface layer as a node: its children are linked to it, so that the hierarchy is the graph."""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping
from math import inf
from typing import Annotated

import numpy as np

from nodegraph import Param, node
from nodegraph_terrain.gradient_noise import scrambled
from nodegraph_terrain.noise import MOST, Kind
from nodegraph_texture.constraints import Constraint, Hat, Sampled
from nodegraph_texture.layers import Colour, Roughness, SurfaceLayers
from nodegraph_texture.quantities import FROM_ELEVATION, NAME

End = float | None
Ends = tuple[End, End, End, End]
Function = tuple[float, float, tuple[float, ...]]

Wavelength = Annotated[float, Param("Size of its largest patches or bumps.", ge=1e-3, le=1e9, unit="m")]
Octaves = Annotated[int, Param("Number of its scales, each half as large as the one before.", ge=1, le=MOST)]


@node(version=1)
def layer(
    *children: SurfaceLayers,
    name: Annotated[str, Param("Of the layer; no two layers of a hierarchy share one.", min_length=1)],
    colour: Annotated[str, Param('Of the surface: "#rrggbb", or a name of CSS.')],
    altitude: Annotated[
        Ends | None, Param("Where it appears: from none at a to all at b, and from all at c to none at d.", unit="m")
    ] = None,
    slope: Annotated[Ends | None, Param("The same for the steepness of the ground.", unit="deg")] = None,
    constraints: Annotated[
        dict[str, Ends | Function],
        Param("The same for further quantities by name, in their units; or [low, high, [samples]], of 0 to 1."),
    ] = {},  # noqa: B006
    noise_scale: Annotated[float, Param("s_S: how far noise, -1 to 1, changes the coverage.", ge=-100, le=100)] = 0.0,
    noise_bias: Annotated[
        float, Param("b_S: coverage where the noise is 0; above 1 it saturates.", ge=-100, le=100)
    ] = 1.0,
    noise_kind: Annotated[Kind, Param("Of the noise of coverage; see terrain.noise.")] = "fbm",
    noise_wavelength: Wavelength = 200.0,
    noise_octaves: Octaves = 8,
    roughness: Annotated[
        float, Param("B_S: height of bumps of noise 1 where it covers all.", ge=-1e4, le=1e4, unit="m")
    ] = 0.0,
    relief_kind: Annotated[Kind, Param("Of the noise of bumps.")] = "fbm",
    relief_wavelength: Wavelength = 50.0,
    relief_octaves: Octaves = 8,
    variation: Annotated[float, Param("How far brightness varies, as a factor.", ge=0, le=1)] = 0.0,
    variation_wavelength: Wavelength = 100.0,
    variation_octaves: Octaves = 8,
    seed: Annotated[int | None, Param("Of its noises; none: by the name.", ge=0, le=0xFFFFFFFF)] = None,
) -> SurfaceLayers:
    """Describe a surface: what it looks like, where it appears, and which surfaces lie on it.

    With F_i the constraints, N the noise, C_P the coverage of the layer below (1 for the root),

        C = clamp((noise_bias + noise_scale N) prod_i F_i) C_P,
        colour' = (1 - C) colour + C own,   own = clamp(colour (1 + variation N_V)),
        height' = height + C roughness N_R

    (equations 1 and 2).  A layer appears only where its parent does: grass on soil, flowers on grass.  Layers are
    applied depth first, each followed by all that lie on it, and children in the order of their links: later ones cover
    earlier ones.  texture.draw_layers shows the order.  Colours mix as sRGB codes, as in the paper.

    A hat [a, b, c, d] is 0 up to a, 1 from b to c, 0 from d on and linear between; null at both ends of a side leaves
    that side open: [1800, 2100, null, null] is whatever lies high enough.  A rise of no width is a step.

    Noise is never finer than a texel can show, see `nodegraph_texture.detail`.

    Args:
        children: layers that lie on this one, the first applied first.
        name: for people, files and masks.
        colour: of the material in even light.
        altitude: above sea level, of the ground with the bumps of earlier layers.
        slope: degrees from the horizontal, of the same ground.
        constraints: of temperature, precipitation, radiation, irradiation, wetness, snow_cover, or any raster that
            texture.quantity gave a name; a hat, or samples from `low` to `high`, evenly spaced, with linear
            interpolation.
        noise_scale, noise_bias, noise_kind, noise_wavelength, noise_octaves: N.  With a bias of 0.5 and a scale of 2,
            say, a layer breaks up into patches; a bias above 1 and a scale as large make ragged borders only.
        roughness, relief_kind, relief_wavelength, relief_octaves: N_R.
        variation, variation_wavelength, variation_octaves: N_V.
        seed: of all three.

    Raises:
        ValueError: no such colour, a hat whose ends do not rise, samples beyond 0 to 1, no such name of a quantity, or
            two layers of one name.

    Source: Dachsbacher, Bolch and Stamminger 2006: Procedural reproduction of terrain textures with geographic data,
    Vision, Modeling and Visualization, section 4, https://inria.hal.science/inria-00606769.
    """
    first = zlib.crc32(name.encode()) if seed is None else seed
    return SurfaceLayers(
        name,
        colour_of(colour),
        tuple(_constraints(altitude, slope, constraints)),
        Roughness(noise_kind, noise_wavelength, noise_octaves, seed=first),
        noise_scale,
        noise_bias,
        Roughness(relief_kind, relief_wavelength, relief_octaves, seed=scrambled(first, 1)),
        roughness,
        Roughness("fbm", variation_wavelength, variation_octaves, seed=scrambled(first, 2)),
        variation,
        children,
    )


def colour_of(text: str) -> Colour:
    """Return red, green and blue, 0 to 1, of ``#rrggbb`` or a name.

    Raises:
        ValueError: the text is neither.
    """
    if re.fullmatch("#[0-9a-fA-F]{6}", text):
        red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
        return red, green, blue
    from matplotlib.colors import CSS4_COLORS

    if text.lower() not in CSS4_COLORS:
        raise ValueError(f"'{text}' is no colour; write #rrggbb, or a name of CSS such as sienna")
    return colour_of(str(CSS4_COLORS[text.lower()]))


def hat_of(quantity: str, ends: Ends) -> Hat:
    """Return a hat whose open sides are None.

    Raises:
        ValueError: the ends do not rise, or a side is half open.
    """
    a, b = (-inf if end is None else float(end) for end in ends[:2])
    c, d = (inf if end is None else float(end) for end in ends[2:])
    return Hat(quantity, (a, b), (c, d))


def _constraints(altitude: Ends | None, slope: Ends | None, others: Mapping[str, Ends | Function]) -> list[Constraint]:
    found: list[Constraint] = []
    for quantity, ends in zip(FROM_ELEVATION, (altitude, slope), strict=True):
        if ends is not None:
            found.append(hat_of(quantity, ends))
    for quantity, function in others.items():
        check_quantity(quantity)
        if quantity in [item.quantity for item in found]:
            raise ValueError(f"{quantity} is constrained twice; leave it out of constraints or set {quantity} to null")
        if len(function) == 3:
            low, high, samples = function
            found.append(Sampled(quantity, float(low), float(high), np.array(samples, np.float32)))
        else:
            found.append(hat_of(quantity, function))
    return found


def check_quantity(name: str) -> None:
    """Raise `ValueError` where a text cannot name a quantity."""
    if not NAME.fullmatch(name):
        raise ValueError(f"'{name}' is no name of a quantity; use lower-case letters, digits and underscores")
