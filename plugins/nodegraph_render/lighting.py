"""The light that leaves surfaces: sun, sky, ground and water, at points of a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nodegraph_render.material import Water
from nodegraph_render.materials import Spots, looks
from nodegraph_render.occlusion import lifted, sun_share
from nodegraph_render.rays import SKY, Doubles, Rays, Singles
from nodegraph_render.sky import Sky
from nodegraph_render.sun import Sun
from nodegraph_render.surface import Surface
from nodegraph_render.tracers import Tracer
from nodegraph_render.water import attenuation, fresnel, glint, refracted, ripples

Layers = npt.NDArray[np.int8]

SHADED = 0.6
"""Light of ground that hides the sky, in parts of that of level ground in the open: some of it lies in shadow."""


@dataclass(frozen=True)
class Scene:
    """What is lit, and by what.

    Attributes:
        surfaces: the layers.
        tracer: follows rays to the first of them.
        bed: the same without water; None where there is no water.
        bed_layers: numbers, among `surfaces`, of the layers that `bed` tells apart.
        sun: for the width of its disc.
        sky: the light, as seen from the ground.
    """

    surfaces: tuple[Surface, ...]
    tracer: Tracer
    bed: Tracer | None
    bed_layers: tuple[int, ...]
    sun: Sun
    sky: Sky


def lambert(albedo: Singles, normal: Singles, sunny: Singles, open_: Singles, sky: Sky) -> Singles:
    """Return the radiance of diffuse surfaces, (n, 3).

    L = albedo / pi (E_sun max(0, n . l) sunny + E_sky(n) open + pi 0.6 L_ground (1 - open))

    Args:
        albedo: reflectance, (n, 3).
        normal: unit normals, (n, 3).
        sunny: share of the sun that is seen, (n,).
        open_: share of the sky that is seen, (n,); see `occlusion.sky_share`.
        sky: the light.
    """
    facing = np.maximum(normal @ sky.direction.astype(np.float32), 0) * sunny
    light = facing[:, None] * sky.sun.astype(np.float32)
    light += open_[:, None] * sky.irradiance(normal).astype(np.float32)
    light += (1 - open_)[:, None] * (math.pi * SHADED * sky.bounce).astype(np.float32)
    return albedo * light * np.float32(1 / math.pi)


def leaving(scene: Scene, spots: Spots, layer: Layers, direction: Doubles, sunny: Singles, open_: Singles) -> Singles:
    """Return the radiance that leaves spots against rays of unit `direction`, (n, 3)."""
    light = np.zeros((len(layer), 3), np.float32)
    for number, surface in enumerate(scene.surfaces):
        on = layer == number
        if not on.any():
            continue
        own = spots.taken(on)
        if isinstance(surface.material, Water):
            light[on] = _water(scene, surface.material, own, direction[on], sunny[on], open_[on])
        else:
            light[on] = lambert(*looks(surface.material, own), sunny[on], open_[on], scene.sky)
    return light


def _water(scene: Scene, material: Water, spots: Spots, direction: Doubles, sunny: Singles, open_: Singles) -> Singles:
    """Return the radiance of water: what it mirrors, what comes from below, and the glint of the sun.

    L = F L_mirrored + (1 - F) ((1 - T) R / pi E + T L_bed) + glint, with F Fresnel's share, R the reflectance of deep
    water and T what is left after the way down to the bed and back up.
    """
    sky = scene.sky
    normal, hidden = ripples(material, spots, direction)
    cosine = np.clip(-np.einsum("ij,ij->i", direction, normal), 0.01, 1)
    share = fresnel(cosine)[:, None]
    mirror = direction + 2 * cosine[:, None] * normal
    mirror[:, 2] = np.maximum(mirror[:, 2], 0.005)
    mirror /= np.linalg.norm(mirror, axis=1)[:, None]
    light = share * _seen(scene, lifted(spots), mirror, spots.footprint)
    entering = sky.sun * (max(sky.direction[2], 0.0) * sunny)[:, None] + open_[:, None] * sky.level
    light += (1 - share) * _below(scene, material, spots, refracted(direction, normal), entering)
    if sky.sun.any():
        light += (sunny * glint(direction, normal, sky.direction, hidden))[:, None] * sky.sun
    return light.astype(np.float32)


def _seen(scene: Scene, start: Doubles, direction: Doubles, footprint: Singles) -> Doubles:
    """Return the radiance that rays from water meet: sky, or land, whose water counts as matt."""
    hits = scene.tracer(Rays(start, direction))
    light = scene.sky.radiance(direction, disc=False)
    land = hits.layer != SKY
    if land.any():
        depth = hits.depth[land].astype(np.float64)
        where = start[land] + direction[land] * depth[:, None]
        spots = Spots(where, hits.normal[land], footprint[land])
        sunny = sun_share(scene.tracer, spots, scene.sun, np.zeros(len(depth), np.intp), 1)
        matt = _matt(scene, spots, hits.layer[land], sunny, np.full(len(depth), 0.85, np.float32))
        cosine = direction[land] @ scene.sky.direction
        through, added = scene.sky.air_light(cosine, start[land, 2], where[:, 2], depth)
        light[land] = matt * through + added
    return light


def _below(scene: Scene, material: Water, spots: Spots, direction: Doubles, entering: Doubles) -> Doubles:
    """Return the radiance that comes up from water of an irradiance `entering` on top of it."""
    deep = entering * (np.array(material.colour) / math.pi)
    if scene.bed is None:
        return deep
    hits = scene.bed(Rays(spots.position, direction))
    found = hits.layer != SKY
    if found.any():
        way = hits.depth[found].astype(np.float64)
        down = -direction[found, 2] * way
        where = spots.position[found] + direction[found] * way[:, None]
        bed = Spots(where, hits.normal[found], spots.footprint[found])
        layers = np.asarray(scene.bed_layers, np.int8)[hits.layer[found]]
        albedo = np.zeros((len(way), 3))
        for number in np.unique(layers):
            on = layers == number
            albedo[on] = looks(scene.surfaces[number].material, bed.taken(on))[0]
        through = np.exp(-attenuation(material) * (way + down)[:, None])
        # Wet ground is darker than dry: light that it mirrors back into itself.
        deep[found] = through * (0.6 * albedo / math.pi) * entering[found] + (1 - through) * deep[found]
    return deep


def _matt(scene: Scene, spots: Spots, layer: Layers, sunny: Singles, open_: Singles) -> Singles:
    light = np.zeros((len(layer), 3), np.float32)
    for number in np.unique(layer):
        on = layer == number
        own = spots.taken(on)
        light[on] = lambert(*looks(scene.surfaces[number].material, own), sunny[on], open_[on], scene.sky)
    return light
