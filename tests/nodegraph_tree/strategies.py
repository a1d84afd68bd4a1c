"""Random trees of random nodes, and what the property tests do with them.

Scenes lie within some kilometres of `CENTRE`, 150 km from the origin on either axis, where float32 coordinates would be
1.6 cm apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st

from nodegraph import Context, port_type
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_tree.add import Add
from nodegraph_tree.affine import affine, placed
from nodegraph_tree.basic import Constant, Plane
from nodegraph_tree.bend import bend
from nodegraph_tree.blend import blend
from nodegraph_tree.by_terrain import by_terrain
from nodegraph_tree.carve import Carve
from nodegraph_tree.curve import curve
from nodegraph_tree.detail import LevelOfDetail
from nodegraph_tree.disc import Disc, NoiseField, Relief
from nodegraph_tree.distort import distort
from nodegraph_tree.falloff import derivative, fall_off, steepest_between
from nodegraph_tree.from_elevation import from_elevation
from nodegraph_tree.function import ABSENT, Bounds, Box, ElevationFunction, Points, Sample
from nodegraph_tree.image_curve import image_curve
from nodegraph_tree.image_quad import image_quad
from nodegraph_tree.landform import crater, lake, mesa
from nodegraph_tree.replace import Replace
from nodegraph_tree.ridge import ridge
from nodegraph_tree.river import river
from nodegraph_tree.road import road
from nodegraph_tree.twist import twist
from nodegraph_tree.union import Union

CENTRE = (150_000.0, 150_000.0)
SIZE = 4000.0
"""Side of the square that scenes fill."""


@port_type
class Bump(ElevationFunction):
    """A third party's primitive, without OpenCL: a wave under a round weight."""

    x: float
    y: float
    radius: float
    height: float

    @property
    def support(self) -> Box:
        return Box(self.x, self.y, self.x, self.y).grown(self.radius)

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        dx, dy = points.x - self.x, points.y - self.y
        far = np.hypot(dx, dy)
        weight = fall_off("wyvill", far / self.radius)
        rate = 3 / self.radius
        height = self.height * (1 + np.sin(rate * dx) * np.cos(rate * dy))
        if not gradient:
            return Sample(height, weight)
        steep = derivative("wyvill", far / self.radius) / self.radius / np.maximum(far, 1e-9)
        slope = (
            self.height
            * rate
            * np.stack([np.cos(rate * dx) * np.cos(rate * dy), -np.sin(rate * dx) * np.sin(rate * dy)])
        )
        return Sample(height, weight, slope, np.stack([steep * dx, steep * dy]))

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        near, far = (distance / self.radius for distance in box.distance(self.x, self.y))
        if near >= 1:
            return ABSENT
        least, most = fall_off("wyvill", np.array([far, near])).tolist()
        # |grad|^2 = (A k)^2 (cos^2 cos^2 + sin^2 sin^2) <= (A k)^2
        slope = abs(self.height) * 3 / self.radius
        ends = sorted((0.0, 2 * self.height))
        steep = steepest_between("wyvill", near, min(far, 1.0)) / self.radius
        return Bounds(*ends, least, most, slope, steep, most * slope, slope)


def _places(low: float = -SIZE / 5, high: float = SIZE / 5) -> st.SearchStrategy[float]:
    return st.floats(low, high, width=32).map(lambda value: round(value, 3))


_X = _places().map(lambda value: CENTRE[0] + value)
_Y = _places().map(lambda value: CENTRE[1] + value)
_RADII = st.floats(300, 2500).map(lambda value: round(value, 2))
_HEIGHTS = st.floats(-200, 800).map(lambda value: round(value, 2))
_FALLS = st.sampled_from(["wyvill", "cubic", "quintic", "plateau"])
_SEEDS = st.integers(0, 2**32 - 1)

_RELIEFS = st.builds(
    Relief,
    kind=st.sampled_from(["none", "gradient", "fbm", "billow", "ridged", "hybrid", "warped"]),
    amplitude=st.floats(-300, 300).map(lambda value: round(value, 2)),
    wavelength=st.floats(200, 2000),
    octaves=st.integers(1, 5),
    seed=_SEEDS,
)

PRIMITIVES: list[st.SearchStrategy[ElevationFunction]] = [
    st.builds(Constant, _HEIGHTS),
    # Heights at the centre of the scene, not at the origin of the coordinates.
    st.builds(
        lambda h, e, n: Plane(h - e * CENTRE[0] - n * CENTRE[1], e, n), _HEIGHTS, st.floats(-1, 1), st.floats(-1, 1)
    ),
    st.builds(Disc, _X, _Y, _RADII, _HEIGHTS, _RELIEFS, _FALLS),
    st.builds(Disc, _X, _Y, _RADII, _HEIGHTS, _RELIEFS, _FALLS),
    st.builds(NoiseField, _X, _Y, _HEIGHTS, _RELIEFS),
    st.builds(Bump, _X, _Y, _RADII, _HEIGHTS),
]
"""Leaves; other modules of tests append theirs."""


def _raster(seed: int) -> Elevation:
    dice = np.random.default_rng(seed)
    cells = np.cumsum(np.cumsum(dice.normal(size=(9, 12)), 0), 1) * 5
    return Elevation(cells.astype(np.float32), Extent(0.0, 0.0, 1200.0, 900.0))


def _image_quad(x: float, y: float, size: float, skew: float, seed: int, kind: Any) -> ElevationFunction:
    corners = ((x, y + size), (x + size, y + 0.8 * size), (x + size - skew, y + skew), (x + skew, y))
    return image_quad(_raster(seed), corners=corners, interpolation=kind)


def _image_grid(x: float, y: float, seed: int, kind: Any) -> ElevationFunction:
    return affine(from_elevation(_raster(seed), interpolation=kind), (1.0, 0.0, 0.0, 1.0), (-x, -y))


def _image_curve(x: float, y: float, dx: float, dy: float, width: float, seed: int) -> ElevationFunction:
    points = ((x, y), (x + 700.0, y + dx), (x + 1500.0, y + dy))
    return image_curve(_raster(seed), points=points, width=width)


_INTERPOLATIONS = st.sampled_from(["bilinear", "bicubic"])
PRIMITIVES += [
    st.builds(_image_quad, _X, _Y, st.floats(600, 2500), st.floats(-100, 100), _SEEDS, _INTERPOLATIONS),
    st.builds(_image_grid, _X, _Y, _SEEDS, _INTERPOLATIONS),
    st.builds(_image_curve, _X, _Y, _places(-300, 300), _places(-300, 300), st.floats(50, 250), _SEEDS),
]


def _skeletal() -> list[ElevationFunction]:
    """Return one primitive of every kind that has a curve or a contour for its skeleton."""
    x, y = CENTRE
    line = ((x - 1500.0, y - 600.0, 60.0), (x - 200.0, y + 300.0, 35.0), (x + 1300.0, y - 100.0, 10.0))
    branch = ((x - 500.0, y + 1400.0, 90.0), (x - 300.0, y + 800.0, 60.0), (x - 200.0, y + 300.0, 35.0))
    profiles = (((-60.0, 25.0), (0.0, 0.0), (60.0, 25.0)), ((-90.0, 40.0), (0.0, -5.0), (80.0, 30.0)))
    return [
        curve(points=line, sections=profiles, radius=400.0),
        curve(points=line, kind="polyline", sections=profiles[:1], radius=250.0, core=0.3),
        river(points=line, tributaries=(branch,), width=(40.0, 70.0), radius=450.0),
        road(points=line, width=12.0, radius=120.0),
        ridge(points=line, spurs=(branch,), radius=600.0, roughness=30.0),
        lake(centre=(x + 300.0, y - 400.0), radius=600.0, seed=3),
        mesa(centre=(x - 500.0, y + 200.0), radius=500.0, seed=4),
        crater(centre=(x + 100.0, y + 500.0), radius=450.0, peak=0.3, seed=5),
    ]


PRIMITIVES += [st.sampled_from(_skeletal())]

Trees = st.SearchStrategy[ElevationFunction]


def _moved(tree: ElevationFunction, dx: float, dy: float, turn: float, size: float, scale: float) -> ElevationFunction:
    """Move, turn and scale about the centre of the scene."""
    home = affine(tree, (1.0, 0.0, 0.0, 1.0), CENTRE)
    return placed(
        home, position=(CENTRE[0] + dx, CENTRE[1] + dy), rotation=turn, size=(size, size * 1.2), scale=scale, rise=5.0
    )


def _bent(tree: ElevationFunction, x: float, y: float, dx: float, dy: float, offsets: list[float]) -> ElevationFunction:
    reach = 1000.0 + 2.5 * max(map(abs, offsets))
    return bend(tree, start=(x, y), end=(x + dx, y + dy + 1.0), offsets=offsets, reach=reach)


def operators(parts: Trees) -> Trees:
    """Return trees of one more operator."""
    lists = st.lists(parts, min_size=1, max_size=4)
    percent = st.floats(0, 1)
    return st.one_of(
        lists.map(blend),
        st.builds(Replace, parts, lists.map(tuple), st.booleans()),
        st.builds(Add, parts, parts, st.booleans()),
        st.builds(Carve, parts, parts, st.sampled_from([0.0, 5.0, 60.0]), st.booleans()),
        st.builds(Union, st.tuples(parts, parts), st.just(2.0), st.sampled_from([2.0, 80.0]), st.booleans()),
        st.builds(
            by_terrain,
            parts,
            parts,
            lowest=st.sampled_from([None, 50.0]),
            highest=st.sampled_from([None, 300.0]),
            altitude_fade=st.floats(20, 300),
            gentlest=st.sampled_from([None, None, 5.0]),
            steepest=st.sampled_from([None, None, 20.0]),
            span=st.sampled_from([5.0, 40.0]),
        ),
        st.builds(
            _moved, parts, _places(-500, 500), _places(-500, 500), st.floats(-180, 180), st.floats(0.5, 2),
            st.floats(-1.5, 1.5),
        ),
        st.builds(
            lambda tree, x, y, r, a: twist(tree, centre=(x, y), radius=r, angle=a), parts, _X, _Y, _RADII,
            st.floats(-4, 4),
        ),
        st.builds(
            _bent, parts, _X, _Y, _places(50, 2000), _places(50, 2000),
            st.lists(st.floats(-400, 400), min_size=1, max_size=4),
        ),
        st.builds(
            lambda tree, w, share, octaves, seed: distort(
                tree, amplitude=0.2 * share * w / octaves, wavelength=w, octaves=octaves, seed=seed
            ),
            parts, st.floats(300, 3000), percent, st.integers(1, 3), _SEEDS,
        ),
        st.builds(
            lambda a, b, k, wide: LevelOfDetail(a, b, k, k + wide), parts, parts, st.floats(0, 0.6), st.floats(0.1, 0.4)
        ),
    )  # fmt: skip


def trees(leaves: int = 6) -> Trees:
    """Return random trees of one operator at least and up to so many leaves."""
    return operators(st.recursive(st.one_of(PRIMITIVES), operators, max_leaves=leaves))


DETAILS = st.sampled_from([1.0, 1.0, 0.0, 0.35, 0.7]) | st.floats(0, 1)


@dataclass(frozen=True)
class Window:
    """A box of the scene, with points in it."""

    box: Box
    points: Points


@st.composite
def windows(draw: Callable[[Any], Any], count: int = 200) -> Window:
    """Return a box, from a metre to the whole scene across, with its corners, edges and random points in it."""
    width, height = (10 ** draw(st.floats(0, 3.6)) for _ in range(2))
    west = CENTRE[0] + draw(_places()) - width / 2
    south = CENTRE[1] + draw(_places()) - height / 2
    box = Box(west, south, west + width, south + height)
    dice = np.random.default_rng(draw(st.integers(0, 2**20)))
    x, y = dice.random(count), dice.random(count)
    side = np.linspace(0, 1, 9)
    x = np.concatenate([x, np.repeat(side, 9)])
    y = np.concatenate([y, np.tile(side, 9)])
    return Window(box, Points(box.west + x * width, box.south + y * height, draw(DETAILS)))


def grid(extent: Extent, shape: tuple[int, int], detail: Any = 1.0) -> Points:
    """Return the cell centres of a grid as points."""
    rows, cols = shape
    x = extent.west + (np.arange(cols) + 0.5) * extent.width / cols
    y = extent.north - (np.arange(rows) + 0.5) * extent.height / rows
    across, down = np.meshgrid(x, y)
    return Points(across.ravel(), down.ravel(), detail)


def on_device(
    root: ElevationFunction, extent: Extent, shape: tuple[int, int], device: Any, detail: Any = 1.0
) -> tuple[Any, Any]:
    """Sample a tree on the device, flat arrays of height and weight."""
    from nodegraph_tree.device import sample_on_device

    found = sample_on_device(root, extent, shape, device, Context(), detail)
    height, weight = (device.to_host(item).ravel().astype(np.float64) for item in found)
    return height, weight
