"""Equations 1 and 2 at any window of any level: the reference, with NumPy.

    C = clamp((b_S + s_S N) prod_i F_i) C_P,   RGB' = (1 - C) RGB + C RGB_S,   H' = H + C B_S D_S,

one layer after the other, depth first: heights pass from each layer to the next, coverage from a parent to its
children.  The root paints all: its colour is what others are laid on, and its own coverage bounds theirs.

**Slope.**  Of the ground as it was, the exact derivative of its spline (or tree); of what layers before have added,
central differences over the two neighbouring texels.  So a window needs a rim of one texel for each time that this is
done (`Scene.reach`), and equals that part of any larger window bit for bit: texels are numbered from the corner of
the scene, and nothing that is computed for one depends on which others are computed with it.

Source: Dachsbacher, Bolch and Stamminger 2006: Procedural reproduction of terrain textures with geographic data,
Vision, Modeling and Visualization, section 4, https://inria.hal.science/inria-00606769.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context
from nodegraph_texture.sampling import Places
from nodegraph_texture.scene import Ground, Noises, Scene, Step

Floats = npt.NDArray[np.float32]

BLOCK = 256
"""Texels along the side of a block, so that temporaries stay small."""


class Texture(NamedTuple):
    """A window of a texture.

    Attributes:
        colour: (rows, cols, 4) uint8, sRGB and alpha.
        height: of the displaced ground, (rows, cols) float32, m; NaN where it is void.
        normals: (rows, cols, 3) float32, upward unit normals; NaN where it is void.
        coverage: of each layer, (rows, cols, layers) float32.
    """

    colour: npt.NDArray[np.uint8]
    height: Floats
    normals: Floats
    coverage: Floats

    @classmethod
    def empty(cls, shape: tuple[int, int], layers: int) -> Texture:
        """Return one of undefined contents."""
        return cls(
            np.empty((*shape, 4), np.uint8),
            np.empty(shape, np.float32),
            np.empty((*shape, 3), np.float32),
            np.empty((*shape, layers), np.float32),
        )


def evaluate(
    scene: Scene,
    cell: float | tuple[float, float],
    row: int,
    col: int,
    rows: int,
    cols: int,
    context: Context | None = None,
) -> Texture:
    """Return a window of the texture at a level.

    Args:
        scene: ground, quantities and layers.
        cell: side of a texel at this level, or its width and height, m.
        row, col: the first texel, counted at this level from the north-west corner of the scene.
        rows, cols: how many; texels beyond the scene are void.
        context: the engine's.
    """
    context = context or Context()
    made = Texture.empty((rows, cols), len(scene.steps))
    wholes: tuple[npt.NDArray[Any], ...] = made
    noises = scene.noises(scene.texels(cell, range(0), range(0)).cell)
    reach = scene.reach
    for top in range(0, rows, BLOCK):
        for left in range(0, cols, BLOCK):
            context.progress((top + BLOCK * left / cols) / rows)
            down, across = (slice(top, min(rows, top + BLOCK)), slice(left, min(cols, left + BLOCK)))
            window = (
                range(row + down.start - reach, row + down.stop + reach),
                range(col + across.start - reach, col + across.stop + reach),
            )
            found = paint(scene, noises, scene.texels(cell, *window))
            inner = slice(reach, len(window[0]) - reach), slice(reach, len(window[1]) - reach)
            parts: tuple[npt.NDArray[Any], ...] = found
            for whole, part in zip(wholes, parts, strict=True):
                whole[down, across] = part[inner]
    context.progress(1.0)
    return made


def paint(scene: Scene, noises: list[Noises], texels: Places) -> Texture:
    """Return a whole window at once; texels within `Scene.reach` of its border are not right."""
    ground = scene.ground_at(texels)
    quantities = {name: scene.quantity_at(name, texels) for name in scene.quantities}
    shape = texels.shape
    rise = np.zeros(shape, np.float32)
    east, north = ground.east, ground.north
    slope = degrees(east, north) if any(c.quantity == "slope" for s in scene.steps for c in s.constraints) else None
    root = scene.steps[0].layer
    colour = np.empty((*shape, 3), np.float32)
    colour[:] = root.colour
    covers = np.zeros((*shape, len(scene.steps)), np.float32)
    for number, (step, noise) in enumerate(zip(scene.steps, noises, strict=True)):
        if step.refreshes:
            slope = degrees(*_displaced(ground, rise, texels))
        suits = _suitability(step, ground.height + rise, slope, quantities, shape)
        if step.parent >= 0:
            suits[covers[..., step.parent] <= 0] = 0
        at = np.nonzero(suits > 0)
        if not len(at[0]):
            continue
        px, py = texels.points(at)
        layer = step.layer
        amount: Floats = np.full(len(px), layer.bias, np.float32)
        if noise.cover is not None:
            amount += np.float32(layer.scale) * noise.cover.at(px, py)
        cover = np.clip(amount * suits[at], np.float32(0), np.float32(1))
        if step.parent >= 0:
            cover *= covers[..., step.parent][at]
        covers[..., number][at] = cover
        if noise.relief is not None:
            rise[at] += cover * np.float32(layer.roughness) * noise.relief.at(px, py)
        own = np.asarray(layer.colour, np.float32)
        if noise.tint is not None:
            brightness = 1 + np.float32(layer.variation) * noise.tint.at(px, py)
            own = np.clip(brightness[:, None] * own, np.float32(0), np.float32(1))
        colour[at] = (1 - cover[:, None]) * colour[at] + cover[:, None] * own
    if scene.displaces:
        east, north = _displaced(ground, rise, texels)
    return _finished(ground, rise, east, north, colour, covers)


def _suitability(
    step: Step, height: Floats, slope: Floats | None, quantities: dict[str, Floats], shape: tuple[int, int]
) -> Floats:
    """Return the product of a layer's constraints."""
    suits = np.ones(shape, np.float32)
    for constraint in step.constraints:
        if constraint.quantity == "altitude":
            values: Floats | None = height
        else:
            values = slope if constraint.quantity == "slope" else quantities[constraint.quantity]
        assert values is not None
        suits *= constraint.at(values)
    return suits


def _displaced(ground: Ground, rise: Floats, texels: Places) -> tuple[Floats, Floats]:
    """Return the gradient towards east and north of the displaced ground; not right along the border."""
    east, north = texels.gradient(rise)
    return ground.east + east, ground.north + north


def degrees(east: Floats, north: Floats) -> Floats:
    """Return the steepness of a gradient in degrees from the horizontal."""
    return np.asarray(np.arctan(np.sqrt(east * east + north * north)) * np.float32(180 / np.pi))


def _finished(ground: Ground, rise: Floats, east: Floats, north: Floats, colour: Floats, covers: Floats) -> Texture:
    length = np.sqrt(1 + east * east + north * north)
    normals: Floats = np.stack([-east / length, -north / length, 1 / length], axis=-1, dtype=np.float32)
    pixels = np.empty((*rise.shape, 4), np.uint8)
    pixels[..., :3] = np.rint(colour * np.float32(255))
    pixels[..., 3] = np.rint(covers[..., 0] * np.float32(255))
    height = ground.height + rise
    if ground.void is not None:
        height[ground.void] = np.nan
        normals[ground.void] = np.nan
        pixels[ground.void] = 0
        covers[ground.void] = 0
    return Texture(pixels, height, normals, covers)
