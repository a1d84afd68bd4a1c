"""What surfaces reflect: linear reflectance at points, by material."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_render.material import Ground, Imagery, Material, Plain, Water
from nodegraph_render.rays import Doubles, Singles
from nodegraph_terrain.noise import Noise
from nodegraph_terrain.raster import Image

WOODS, MEADOW, ALPINE, SCREE, ROCK, SNOW = (
    (0.028, 0.041, 0.015, 0.50),
    (0.085, 0.110, 0.035, 0.15),
    (0.125, 0.122, 0.052, 0.35),
    (0.225, 0.205, 0.178, 0.60),
    (0.150, 0.138, 0.122, 1.00),
    (0.800, 0.825, 0.860, 0.20),
)
"""Natural ground: linear reflectance (red, green, blue), and how rough it is."""

KINDS = (WOODS, MEADOW, ALPINE, SCREE, ROCK, SNOW)

GAIN = 0.65
"""Of the octaves of patches: ragged borders."""

SPREAD = 5.0
"""What noise is multiplied by: it then varies by about 0.7 (its standard deviation)."""

FINEST = 4.0
"""Size of the smallest patches, m."""

RELIEF = 0.4
"""Standard deviation of the slopes of bare rock that the surface itself does not show, with all detail in sight."""


class Spots(NamedTuple):
    """Points of surfaces, as light falls on them.

    Attributes:
        position: x east, y north, z up, m, (n, 3).
        normal: upward unit normals, (n, 3).
        footprint: how much ground one sample stands for, m across, (n,): finer detail is left out.
    """

    position: Doubles
    normal: Singles
    footprint: Singles

    def taken(self, where: npt.NDArray[np.bool_]) -> Spots:
        """Return the spots that `where` selects."""
        return Spots(self.position[where], self.normal[where], self.footprint[where])


def looks(material: Material, spots: Spots) -> tuple[Singles, Singles]:
    """Return the linear reflectance of a material at spots, and its normals with the relief too fine for the surface.

    Returns:
        (n, 3) each.
    """
    if isinstance(material, Ground):
        return ground(material, spots.normal, spots.position[:, 2].astype(np.float32), patches(material, spots))
    if isinstance(material, Imagery):
        return imagery(material, spots)
    if isinstance(material, (Plain, Water)):
        return np.broadcast_to(np.asarray(material.colour, np.float32), (len(spots.position), 3)), spots.normal
    raise ValueError(f"the material {type(material).__name__} cannot be shaded; use render.ground, plain or imagery")


def noises(material: Ground) -> tuple[Noise, Noise]:
    """Return the two fields of patches of natural ground."""
    octaves = min(max(round(math.log2(material.patches / FINEST)), 1), 12)
    first, second = (
        Noise("fbm", octaves, material.patches, gain=GAIN, seed=(2 * material.seed + part) & 0xFFFFFFFF)
        for part in (0, 1)
    )
    return first, second


def visible(material: Ground, footprint: Singles) -> Singles:
    """Return the level of detail kappa at which patches below two footprints have faded."""
    octaves = noises(material)[0].count
    share = np.log2(material.patches / (2 * np.maximum(footprint, 1e-3))) / octaves
    return np.clip(share, 0, 1).astype(np.float32)


def patches(material: Ground, spots: Spots) -> Singles:
    """Return the two fields of patches at spots, of mean 0 and standard deviation about 0.7, and fine slopes.

    Returns:
        (4, n): the fields a and b, and slopes towards east and north, of standard deviation `RELIEF` in full detail.
    """
    kappa = visible(material, spots.footprint)
    x, y = spots.position[:, 0], spots.position[:, 1]
    first, second = noises(material)
    found, slope = first.sample(x, y, kappa=kappa), RELIEF / steepness(first)
    fields = [SPREAD * found.value, SPREAD * second.value(x, y, kappa=kappa), slope * found.east, slope * found.north]
    return np.stack(fields).astype(np.float32)


def steepness(noise: Noise) -> float:
    """Return the standard deviation of the slope of a sum of octaves along one axis, 1/m.

    One octave of amplitude and wavelength 1 has 0.8825, measured; octaves are independent.
    """
    slopes = noise.amplitudes * noise.lacunarity ** np.arange(noise.count) / noise.wavelength
    return float(0.8825 * math.sqrt(slopes @ slopes))


def ground(material: Ground, normal: Singles, altitude: Singles, fields: Singles) -> tuple[Singles, Singles]:
    """Return the reflectance and the fine normals of natural ground, (n, 3) each.

    Borders are where a smooth step between two limits is a half.  With s the steepness in degrees, z the altitude, a
    and b the two fields of patches times `variation`:

    - snow lies above the snow line, z + 180 a - 8 max(0, s - 25), and slides off where s + 12 b exceeds 52;
    - rock shows where s + 9 a exceeds the rock slope;
    - woods end at the tree line, z + 130 b; below it they cover slopes, while meadows keep to gentle ground;
    - between tree line and snow line grass gives way to scree.

    Args:
        material: the lines.
        normal: unit normals, (n, 3).
        altitude: m.
        fields: see `patches`.
    """
    f = np.float32
    a, b = fields[:2] * f(material.variation)
    steep = np.degrees(np.arccos(np.clip(normal[:, 2], -1, 1)))
    treeless = step(altitude + f(130) * b - f(material.tree_line), 50)
    wooded = step(steep - f(8) + f(9) * b, 3)
    reach = f(max(material.snow_line - material.tree_line, 200))
    bare = step((altitude + f(250) * a - f(material.tree_line)) / reach - f(0.5), 0.3)
    rocky = step(steep + f(9) * a - f(material.rock_slope), 4)
    drifts = altitude + f(180) * a - f(8) * np.maximum(steep - f(25), 0) - f(material.snow_line)
    snowy = step(drifts, 40) * (1 - step(steep + f(12) * b - f(52), 5))
    kind = _mix(_mix(MEADOW, WOODS, wooded), _mix(ALPINE, SCREE, bare), treeless)
    kind = _mix(kind, _mix(ROCK, SCREE, bare * f(0.5)), rocky)
    kind[:, :3] *= (f(1) + f(0.22) * np.clip(a + f(0.5) * b, -1.5, 1.5))[:, None]
    kind = _mix(kind, SNOW, snowy)
    rough = f(material.relief) * kind[:, 3]
    fine = normal.copy()
    fine[:, :2] -= rough[:, None] * fields[2:].T
    return kind[:, :3], fine / np.sqrt(np.einsum("ij,ij->i", fine, fine))[:, None]


def step(value: Singles, width: float) -> Singles:
    """Return a smooth step from 0 at -width to 1 at width."""
    t = np.clip(value * np.float32(0.5 / width) + np.float32(0.5), 0, 1)
    smooth: Singles = t * t * (3 - 2 * t)
    return smooth


def _mix(first: npt.ArrayLike, second: npt.ArrayLike, share: Singles) -> Singles:
    low, high = np.asarray(first, np.float32), np.asarray(second, np.float32)
    return np.asarray(low + (high - low) * share[:, None], np.float32)


def imagery(material: Imagery, spots: Spots) -> tuple[Singles, Singles]:
    """Return the reflectance of a draped picture, decoded from sRGB, over the looks of what it lies on.

    Bilinear between the centres of pixels, and between two levels of a pyramid of means where a footprint spans more
    than a pixel.
    """
    extent = material.image.extent
    u = (spots.position[:, 0] - extent.west) / extent.width
    v = (extent.north - spots.position[:, 1]) / extent.height
    inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
    pixel = max(material.image.cell_size)
    found = np.zeros((len(u), 4), np.float32)
    found[inside] = _looked_up(pyramid(material.image), u[inside], v[inside], spots.footprint[inside] / pixel)
    bare, normal = found[:, 3] < 1, spots.normal
    if bare.any():
        share = 1 - found[bare, 3:]
        albedo, fine = looks(material.below, spots.taken(bare))
        found[bare, :3] += share * albedo
        normal = normal.copy()
        normal[bare] += share * (fine - normal[bare])
        normal /= np.sqrt(np.einsum("ij,ij->i", normal, normal))[:, None]
    return found[:, :3], normal


@lru_cache(maxsize=4)
def pyramid(image: Image) -> tuple[Singles, ...]:
    """Return a picture in linear light times its alpha, (rows, cols, 4), and halved again and again."""
    from nodegraph_render.tone import decoded

    data = image.data
    level = np.ones((*data.shape[:2], 4), np.float32)
    level[..., :3] = decoded(data[..., :3])
    if data.shape[2] == 4:
        level[..., 3] = data[..., 3] / np.float32(255)
        level[..., :3] *= level[..., 3:]
    levels = [level]
    while max(level.shape[:2]) > 1:
        for axis in (0, 1):
            # Ends of the halves at shares of the side, so that odd sides stay where they are.
            level = _halved(level, axis)
        levels.append(level)
    return tuple(levels)


def _halved(level: Singles, axis: int) -> Singles:
    """Return means over halves as many equal parts of an axis."""
    count = level.shape[axis]
    if count == 1:
        return level
    half = (count + 1) // 2
    ends = np.linspace(0, count, half + 1)
    sums = np.concatenate([np.zeros_like(level.take([0], axis), np.float64), np.cumsum(level, axis, np.float64)], axis)
    whole = np.minimum(ends.astype(np.intp), count - 1)
    shape = [1] * level.ndim
    shape[axis] = -1
    part = (ends - whole).reshape(shape)
    at = sums.take(whole, axis) + part * level.take(whole, axis)
    return np.asarray(np.diff(at, axis=axis) * (half / count), np.float32)


def _looked_up(levels: tuple[Singles, ...], u: Doubles, v: Doubles, pixels: Singles) -> Singles:
    place = np.clip(np.log2(np.maximum(pixels, 1)), 0, len(levels) - 1)
    lower = np.minimum(place.astype(np.intp), max(len(levels) - 2, 0))
    share = (place - lower).astype(np.float32)
    found = np.zeros((len(u), 4), np.float32)
    for number, level in enumerate(levels):
        for at, weight in ((lower, 1 - share), (lower + 1, share)):
            some = (at == number) & (weight > 0)
            if some.any():
                found[some] += weight[some, None] * _bilinear(level, u[some], v[some])
    return found


def _bilinear(level: Singles, u: Doubles, v: Doubles) -> Singles:
    rows, cols, _ = level.shape
    x, y = np.clip(u * cols - 0.5, 0, cols - 1), np.clip(v * rows - 0.5, 0, rows - 1)
    j, i = np.minimum(x.astype(np.intp), max(cols - 2, 0)), np.minimum(y.astype(np.intp), max(rows - 2, 0))
    s, t = (x - j).astype(np.float32)[:, None], (y - i).astype(np.float32)[:, None]
    right, down = np.minimum(j + 1, cols - 1), np.minimum(i + 1, rows - 1)
    upper = level[i, j] + s * (level[i, right] - level[i, j])
    lower = level[down, j] + s * (level[down, right] - level[down, j])
    return np.asarray(upper + t * (lower - upper), np.float32)
