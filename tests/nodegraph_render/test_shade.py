from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph import Context, Graph
from nodegraph.errors import Cancelled
from nodegraph_render import atmosphere, materials, tone, water
from nodegraph_render import shade as module
from nodegraph_render.atmosphere import VACUUM, Air
from nodegraph_render.camera import Camera
from nodegraph_render.lighting import lambert
from nodegraph_render.material import Ground, Imagery, Material, Plain, Water
from nodegraph_render.materials import Spots
from nodegraph_render.occlusion import Facets, sky_share, smoothed, spread, turns
from nodegraph_render.rays import SKY, Hits, Rays
from nodegraph_render.shade import Lit, lit_picture, shade
from nodegraph_render.sky import Sky
from nodegraph_render.sun import Sun
from nodegraph_render.surface import Surface, imagery
from nodegraph_render.trace import Trace, sphere_trace
from nodegraph_render.tracers import Settings, surface_tracer
from nodegraph_terrain.raster import Elevation, Extent, Image

WHITE = Plain("white", (1.0, 1.0, 1.0))
CLEAR = Air.of_visibility(80_000.0)
NOON = Sun(315.0, 35.0)


def level(z: float) -> Any:
    """Return what follows rays to an endless plane."""

    def trace(rays: Rays) -> Hits:
        count = len(rays)
        origin, direction = (np.broadcast_to(array, (count, 3)) for array in (rays.origin, rays.direction))
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(direction[:, 2] < 0, (z - origin[:, 2]) / direction[:, 2], np.inf)
        depth = np.where(depth <= rays.reach, depth, np.inf)
        hit = np.isfinite(depth)
        normal = np.where(hit[:, None], np.array([0.0, 0.0, 1.0]), 0.0).astype(np.float32)
        return Hits(depth.astype(np.float32), normal, np.where(hit, 0, SKY).astype(np.int8), np.ones(count, np.int32))

    return trace


def raster(data: np.ndarray, cell: float = 1.0, west: float = 0.0, south: float = 0.0, crs: str = "") -> Elevation:
    rows, cols = data.shape
    return Elevation(np.asarray(data, np.float32), Extent(west, south, west + cols * cell, south + rows * cell, crs))


def hills(rows: int = 40, cols: int = 50, cell: float = 10.0) -> Elevation:
    y, x = np.mgrid[0:rows, 0:cols]
    return raster(60 * np.sin(x / 5) * np.cos(y / 6) + 8 * np.sin(x * 1.3 + y), cell)


def flat(height: float) -> Elevation:
    """Return level ground, or water, for kilometres around."""
    return raster(np.full((3, 3), height), 4000.0, -6000.0, -6000.0)


def above(grid: Elevation, rows: int, cols: int) -> Camera:
    """Return the map's camera: straight down on all of a grid."""
    extent = grid.extent
    x, y = (extent.west + extent.east) / 2, (extent.south + extent.north) / 2
    assert extent.width / extent.height == pytest.approx(cols / rows)
    return Camera((x, y, 5000.0), (x, y, 0.0), (0.0, 1.0, 0.0), 0.0, extent.height)


def traced(surface: Surface, camera: Camera, rows: int, cols: int, k: int = 1) -> Trace:
    return sphere_trace(camera, surface, width=cols, height=rows, supersampling=k)


def lit(trace: Trace, sun: Sun = NOON, *, sky_rays: int = 0, device: Any = None, visibility: float = 80_000.0) -> Lit:
    context = Context(device=device)
    tracers = [surface_tracer(surface, trace.camera, Settings(), device, context) for surface in trace.surfaces]
    return lit_picture(trace, tracers, sun, visibility, sky_rays, context)


def unit(*vectors: Sequence[float]) -> np.ndarray:
    array = np.array(vectors, np.float64)
    return array / np.linalg.norm(array, axis=1)[:, None]


@pytest.fixture(scope="module")
def device() -> Any:
    from nodegraph.opencl import choose

    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


# Light.


def test_a_white_plane_in_a_vacuum_sends_back_the_suns_irradiance_over_pi() -> None:
    for altitude in (90.0, 30.0):
        sky = Sky.over(0.0, Sun(200.0, altitude), VACUUM)
        up, one = np.array([[0, 0, 1]], np.float32), np.ones(1, np.float32)
        light = lambert(np.ones((1, 3), np.float32), up, one, one, sky)
        np.testing.assert_allclose(light, math.sin(math.radians(altitude)) / math.pi, rtol=1e-4)


@pytest.mark.parametrize("altitude", [90.0, 40.0, 8.0])
def test_a_white_plane_under_a_sky_sends_back_what_falls_on_it(altitude: float) -> None:
    """The picture of a plane from above is (sun + sky) / pi, the sky integrated here on a grid of its own."""
    surface, sun = Surface(None, raster(np.zeros((8, 8))), WHITE), Sun(130.0, altitude)
    found = lit(traced(surface, above(surface.raster, 4, 4), 4, 4), sun)
    rise, turn = (np.arange(400) + 0.5) / 400 * math.pi / 2, (np.arange(600) + 0.5) / 600 * 2 * math.pi
    a, b = (array.ravel() for array in np.meshgrid(rise, turn))
    direction = np.stack([np.cos(a) * np.sin(b), np.cos(a) * np.cos(b), np.sin(a)], axis=1)
    weight = np.cos(a) * np.sin(a) * (math.pi / 800) * (2 * math.pi / 600)
    sky = Sky.over(0.0, sun, CLEAR)
    expected = weight @ sky.radiance(direction, disc=False) + sky.sun * math.sin(math.radians(altitude))
    np.testing.assert_allclose(
        found.light, np.broadcast_to(expected / math.pi, (4, 4, 3)), rtol=0.01 if altitude > 20 else 0.03
    )


def test_sunlight_at_the_zenith_is_what_the_columns_of_air_leave() -> None:
    molecules = atmosphere.RAYLEIGH * 8000 * (1 - math.exp(-100 / 8))
    depth = molecules + CLEAR.haze * 1200 + atmosphere.OZONE * 15_000
    np.testing.assert_allclose(CLEAR.sunlight(np.zeros(1), np.ones(1))[0], np.exp(-depth), rtol=2e-3)


def test_the_sun_sets_smoothly_and_reddens() -> None:
    mu = np.sin(np.radians(np.linspace(-2, 30, 400)))
    light = CLEAR.sunlight(np.zeros(400), mu)
    assert (np.diff(light, axis=0) >= -1e-9).all()
    assert (light[mu < -0.01] == 0).all()
    low = light[np.searchsorted(mu, math.sin(math.radians(3)))]
    assert low[0] > 1.5 * low[1] > 1.5 * low[2]


@pytest.mark.parametrize(("altitude", "error"), [(80.0, 0.022), (40.0, 0.022), (20.0, 0.052), (5.0, 0.112)])
def test_irradiance_by_harmonics_is_near_that_by_summing_the_sky(altitude: float, error: float) -> None:
    sky = Sky.over(500.0, Sun(50.0, altitude), CLEAR)
    count = 40_000
    index = np.arange(count) + 0.5
    z, turn = 1 - 2 * index / count, index * math.pi * (1 + math.sqrt(5))
    flat = np.sqrt(1 - z * z)
    direction = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    light = np.where(z[:, None] > 0, sky.radiance(direction, disc=False), sky.bounce)
    normals = unit((0, 0, 1), (1, 0, 1), (0, -1, 2), (-1, 1, 0.5), (1, 1, 0.1))
    expected = np.maximum(normals @ direction.T, 0) @ light * (4 * math.pi / count)
    np.testing.assert_allclose(sky.irradiance(normals), expected, rtol=error)


def test_the_sky_is_blue_above_whitish_at_the_horizon_and_brightest_at_the_sun() -> None:
    sun = Sun(180.0, 40.0)
    sky = Sky.over(300.0, sun, CLEAR)
    zenith, horizon = sky.radiance(unit((0, 0, 1), (0, 1, 0.02)))
    assert zenith[2] > 2 * zenith[0]
    assert horizon[2] < 1.5 * horizon[0]
    assert horizon.min() > zenith.max()
    disc, beside = sky.radiance(np.array([sun.direction, Sun(180.0, 41.0).direction]))
    assert (disc > 1000 * beside).all()
    # The disc gives the irradiance that the sun has.
    assert disc * math.pi * math.radians(sun.diameter / 2) ** 2 == pytest.approx(sky.sun, rel=0.01)


@given(
    distance=st.floats(1.0, 9e4), more=st.floats(1.01, 3.0), start=st.floats(0, 5000), end=st.floats(0, 5000),
    visibility=st.floats(2e3, 2.8e5),
)  # fmt: skip
def test_haze_grows_with_distance(distance: float, more: float, start: float, end: float, visibility: float) -> None:
    sky = Sky.over(100.0, Sun(10.0, 30.0), CLEAR)
    sky = Sky(Air.of_visibility(round(visibility, -3)), *[getattr(sky, n) for n in list(Sky.__dataclass_fields__)[1:]])
    both = np.array([distance, distance * more])
    through, added = sky.air_light(np.full(2, 0.3), np.full(2, start), np.full(2, end), both)
    # Where air hides everything, it is as bright as it can be.
    assert ((through[1] < through[0]) & (added[1] >= added[0] * (1 - 1e-12))).all()
    assert (added[1] > added[0])[through[0] > 1e-6].all()
    assert (through[:, 2] < through[:, 0]).all()  # blue fades first
    assert ((through > 0) & (through < 1)).all()


def test_through_level_air_contrast_falls_to_2_percent_at_the_visibility() -> None:
    for visibility in (10_000.0, 80_000.0):
        sky = Sky.over(0.0, Sun(), Air.of_visibility(visibility))
        zero = np.zeros(1)
        through, _ = sky.air_light(zero, zero, zero, np.array([visibility]))
        assert through[0, 1] == pytest.approx(0.02, rel=0.01)


# Shadows.


@pytest.mark.parametrize("azimuth", [90.0, 270.0])
def test_the_edge_of_a_shadow_lies_where_geometry_says(azimuth: float) -> None:
    wall, altitude = 20.0, 30.0
    data = np.zeros((12, 120))
    data[:, 60] = wall
    surface = Surface(None, raster(data), WHITE)
    found = lit(traced(surface, above(surface.raster, 12, 120), 12, 120), Sun(azimuth, altitude)).light[6, :, 1]
    away = np.arange(120) - 60
    away = -away if azimuth == 90 else away
    reach = wall / math.tan(math.radians(altitude))
    bright, dark = found[away < -3].mean(), found[(away > 3) & (away < reach - 3)].mean()
    assert dark < 0.4 * bright
    half = np.flatnonzero((away > 3) & (found < (bright + dark) / 2))
    assert away[half].max() == pytest.approx(reach, abs=1.0)
    np.testing.assert_allclose(found[away > reach + 2], bright, rtol=1e-3)


def test_a_wider_sun_throws_softer_shadows() -> None:
    data = np.zeros((12, 120))
    data[:, 60] = 20.0
    surface = Surface(None, raster(data), WHITE)
    trace = traced(surface, above(surface.raster, 12, 120), 12, 120)
    widths = []
    for diameter in (0.0, 0.533, 6.0):
        line = lit(trace, Sun(270.0, 30.0, diameter)).light[:, 64:, 1].mean(axis=0)
        share = (line - line.min()) / (line.max() - line.min())
        widths.append(int(((share > 0.05) & (share < 0.95)).sum()))
    # The penumbra spans h diameter / sin^2(altitude) = 8.4 m for 6 degrees.
    assert widths[0] <= 1
    assert widths[0] <= widths[1] < widths[2]
    assert widths[2] == pytest.approx(20 * math.radians(6) / math.sin(math.radians(30)) ** 2, abs=2.5)


def test_a_plane_sees_all_of_the_sky_and_the_floor_of_a_trench_its_part() -> None:
    """Between walls whose tops stand `angle` high on both sides, cos(angle) of the light of an even sky arrives."""
    spots = Spots(np.array([[0.0, 0.0, 0.0]]), np.array([[0, 0, 1]], np.float32), np.array([1e-3], np.float32))
    turn = np.zeros(1, np.intp)
    assert sky_share(level(0.0), spots, turn, 64)[0] == 1
    for angle in (20.0, 45.0, 70.0):

        def trench(rays: Rays, angle: float = angle) -> Hits:
            direction = rays.direction
            low = direction[:, 2] < np.abs(direction[:, 0]) * math.tan(math.radians(angle))
            return Hits(np.where(low, 1.0, np.inf).astype(np.float32), *[np.zeros(0)] * 3)  # type: ignore[arg-type]

        share = sky_share(trench, spots, turn, 4096)[0]
        assert share == pytest.approx(math.cos(math.radians(angle)), abs=0.01)


def test_light_from_the_sky_is_free_of_noise() -> None:
    """On a smooth bowl, neighbours differ by no more than the bowl does."""
    y, x = np.mgrid[0:60, 0:80] - np.array([30, 40])[:, None, None]
    bowl = Surface(None, raster(0.008 * (x * x + y * y)), WHITE)
    trace = traced(bowl, above(bowl.raster, 120, 160), 120, 160)
    light = lit(trace, Sun(0.0, -2.0), sky_rays=8).light[10:-10, 10:-10, 1]
    rough = light - (np.roll(light, 1, 1) + np.roll(light, -1, 1)) / 2
    assert np.abs(rough[:, 1:-1]).max() < 0.01 * light.mean()
    assert light[50, 70] < 0.95 * light.max()  # the floor is darker


def test_runs_of_sixteen_turns_cover_the_square_evenly() -> None:
    rows, cols = np.mgrid[0:4, 0:4]
    assert sorted(turns(rows, cols).ravel()) == list(range(16))
    x, y = spread(np.arange(16 * 8))
    counts, *_ = np.histogram2d(x, y, bins=4, range=[[0, 1], [0, 1]])
    assert counts.min() >= 6
    assert counts.max() <= 10


def test_smoothing_keeps_to_a_surface() -> None:
    rng = np.random.default_rng(3)
    rows, cols = np.mgrid[0:20, 0:24].astype(np.float32)
    step = np.where(cols < 12, 0, 50).astype(np.float32)
    facets = Facets(
        np.stack([cols, -rows, step], axis=-1),
        np.broadcast_to(np.array([0, 0, 1], np.float32), (20, 24, 3)),
        np.ones((20, 24), np.float32),
        np.ones((20, 24), bool),
    )
    values = (step / 50 + 0.1 * rng.normal(size=step.shape)).astype(np.float32)
    found = smoothed(values, facets, Context())
    assert np.abs(found - step / 50).max() < 0.12
    assert found.std() < values.std()
    np.testing.assert_allclose(smoothed(step, facets, Context()), step, atol=1e-4)


# Materials.


def test_a_draped_picture_lands_on_the_right_metres() -> None:
    rng = np.random.default_rng(1)
    grid = hills()
    # Shifted against the raster, with cells of another size, over a part of it.
    picture = Image(rng.integers(30, 256, (5, 8, 3)).astype(np.uint8), Extent(95.0, 60.0, 415.0, 260.0))
    camera = above(grid, 80, 100)
    plain = lit(traced(Surface(None, grid, WHITE), camera, 80, 100)).light
    draped = lit(traced(Surface(None, grid, Imagery(image=picture, below=WHITE)), camera, 80, 100)).light
    x, y = (np.arange(100) + 0.5) * 5, 400 - (np.arange(80) + 0.5) * 5
    inside = np.ix_((y > 60) & (y < 260), (x > 95) & (x < 415))
    np.testing.assert_allclose(
        np.delete(draped, np.flatnonzero((x > 90) & (x < 420)), 1)[:, :5], plain[:, :5], rtol=1e-5
    )
    colour = draped[inside] / plain[inside]
    i, j = (260 - y[(y > 60) & (y < 260)]) / 40 - 0.5, (x[(x > 95) & (x < 415)] - 95) / 40 - 0.5
    from scipy.ndimage import map_coordinates

    linear = tone.decoded(picture.data).astype(np.float64)
    at = np.meshgrid(i, j, indexing="ij")
    for channel in range(3):
        expected = map_coordinates(linear[..., channel], at, order=1, mode="nearest")
        np.testing.assert_allclose(colour[..., channel], expected, atol=2e-3)


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 99))
def test_the_pyramid_of_a_picture_keeps_its_mean(rows: int, cols: int, seed: int) -> None:
    data = np.random.default_rng(seed).integers(0, 256, (rows, cols, 4)).astype(np.uint8)
    levels = materials.pyramid(Image(data, Extent(0, 0, cols, rows)))
    assert levels[-1].shape[:2] == (1, 1)
    for one in levels:
        np.testing.assert_allclose(one.mean(axis=(0, 1)), levels[0].mean(axis=(0, 1)), rtol=1e-4, atol=1e-6)


def test_far_away_a_fine_picture_is_its_mean() -> None:
    data = np.zeros((64, 64, 3), np.uint8)
    data[::2, ::2] = data[1::2, 1::2] = 255
    material = Imagery(image=Image(data, Extent(0.0, 0.0, 64.0, 64.0)))
    position = np.random.default_rng(0).uniform(8, 56, (50, 3))
    up = np.tile(np.array([[0, 0, 1]], np.float32), (50, 1))
    near, far = (materials.looks(material, Spots(position, up, np.full(50, f, np.float32)))[0] for f in (0.01, 8.0))
    assert near.std() > 0.1
    np.testing.assert_allclose(far, 0.5, atol=0.01)


def looks(material: Ground, steep: float, altitude: float) -> tuple[np.ndarray, np.ndarray]:
    """Return reflectance and normal of ground without noise."""
    angle = math.radians(steep)
    normal = np.array([[math.sin(angle), 0, math.cos(angle)]], np.float32)
    albedo, fine = materials.ground(material, normal, np.array([altitude], np.float32), np.zeros((4, 1), np.float32))
    return albedo[0], fine[0]


def test_natural_ground_by_altitude_and_steepness() -> None:
    alps = Ground()
    for steep, altitude, kind in (
        (2, 500, materials.MEADOW), (20, 500, materials.WOODS), (60, 500, materials.ROCK), (10, 1990, materials.ALPINE),
        (10, 3500, materials.SNOW), (45, 2000, materials.ROCK),
    ):  # fmt: skip
        np.testing.assert_allclose(looks(alps, steep, altitude)[0], kind[:3], rtol=0.02)
    assert looks(alps, 70, 3500)[0].max() < 0.3  # too steep for snow
    assert looks(Ground(snow_line=100.0), 5, 300)[0].min() > 0.7


def test_variation_and_relief_of_zero_leave_straight_lines_and_smooth_ground() -> None:
    rng = np.random.default_rng(0)
    position = np.stack([*rng.uniform(0, 5000, (2, 500)), np.full(500, 2790.0)], axis=1)
    spots = Spots(position, np.tile(np.array([[0, 0, 1]], np.float32), (500, 1)), np.full(500, 5, np.float32))
    albedo, normal = materials.looks(Ground(variation=0.0, relief=0.0), spots)
    assert np.ptp(albedo, axis=0).max() < 1e-6
    assert (normal == spots.normal).all()
    albedo, normal = materials.looks(Ground(), spots)
    assert np.ptp(albedo, axis=0).max() > 0.3
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
    assert normal[:, 2].min() < 0.999


def test_patches_too_fine_for_a_footprint_fade() -> None:
    rng = np.random.default_rng(0)
    position = np.stack([*rng.uniform(0, 50_000, (2, 4000)), np.zeros(4000)], axis=1)
    deviations = []
    for size in (0.5, 100.0, 5000.0):
        up = np.tile(np.array([[0, 0, 1]], np.float32), (4000, 1))
        fields = materials.patches(Ground(), Spots(position, up, np.full(4000, size, np.float32)))
        deviations.append(fields.std(axis=1))
    assert 0.5 < deviations[0][0] < 0.9
    assert deviations[0][2] == pytest.approx(materials.RELIEF, rel=0.1)
    assert (deviations[1][2:] < 0.3 * deviations[0][2:]).all()
    assert (deviations[2] == 0).all()


# Water.


def test_fresnel() -> None:
    assert water.fresnel(np.ones(1))[0] == pytest.approx(0.0204, abs=1e-4)
    assert water.fresnel(np.zeros(1))[0] == 1
    brewster = math.cos(math.atan(water.INDEX))
    inside = math.sqrt(1 - (1 - brewster**2) / water.INDEX**2)
    across = ((brewster - water.INDEX * inside) / (brewster + water.INDEX * inside)) ** 2
    assert water.fresnel(np.array([brewster]))[0] == pytest.approx(across / 2)  # nothing along the plane


@given(st.floats(0, 1), st.floats(0, 1))
def test_fresnel_never_falls_towards_grazing(a: float, b: float) -> None:
    low, high = sorted((a, b))
    first, second = water.fresnel(np.array([low, high]))
    assert 0.02 < second <= first + 1e-12 <= 1 + 1e-9


def test_light_bends_by_snell() -> None:
    down = unit((1, 0, -1), (0, 0.3, -1), (0, 0, -1))
    bent = water.refracted(down, np.tile([[0.0, 0.0, 1.0]], (3, 1)))
    np.testing.assert_allclose(np.linalg.norm(bent, axis=1), 1)
    np.testing.assert_allclose(np.hypot(*bent[:, :2].T) * water.INDEX, np.hypot(*down[:, :2].T), atol=1e-12)


def test_ripples_have_the_slopes_of_the_wind_seen_or_hidden() -> None:
    rng = np.random.default_rng(0)
    position = np.stack([*rng.uniform(0, 900, (2, 20_000)), np.zeros(20_000)], axis=1)
    up, down = np.tile([[0, 0, 1]], (20_000, 1)).astype(np.float32), np.tile([[0.0, 0.0, -1.0]], (20_000, 1))
    for wind in (1.0, 8.0):
        total = 0.003 + 0.00512 * wind
        normal, hidden = water.ripples(Water(wind=wind), Spots(position, up, np.full(20_000, 0.01, np.float32)), down)
        slopes = normal[:, :2] / normal[:, 2:]
        assert slopes.var(axis=0).sum() == pytest.approx(total, rel=0.1)
        assert hidden.max() < 1e-4
        normal, hidden = water.ripples(Water(wind=wind), Spots(position, up, np.full(20_000, 50, np.float32)), down)
        np.testing.assert_allclose(hidden, total, rtol=0.01)
        np.testing.assert_allclose(normal, up, atol=1e-6)


def lake(depth: float, clarity: float, k: int = 1) -> tuple[Trace, Lit]:
    bed = Surface(None, raster(np.full((20, 20), -depth), 100.0), WHITE)
    surface = Surface(None, flat(0.0), Water(clarity=clarity, wind=0.0))
    camera = Camera((1000.0, 1000.0, 800.0), (1000.0, 1000.001, 0.0), field_of_view=30.0)
    trace = sphere_trace(camera, bed, surface, width=6, height=6, supersampling=k)
    return trace, lit(trace, Sun(90.0, 50.0))


def test_deep_water_hides_its_bed_and_shallow_water_tints_it() -> None:
    lights = [lake(depth, 5.0)[1].light.mean(axis=(0, 1)) for depth in (0.3, 3.0, 30.0)]
    assert (lights[0] > lights[1]).all()
    assert (lights[1] > lights[2]).all()
    assert lights[1][0] / lights[1][2] < 0.6 * lights[0][0] / lights[0][2]  # red goes first
    assert lake(30.0, 0.5)[1].light.mean(axis=(0, 1)) == pytest.approx(lake(60.0, 0.5)[1].light.mean(axis=(0, 1)))


def test_water_at_a_grazing_angle_is_a_mirror_of_the_sky() -> None:
    sea = Surface(None, flat(0.0), Water(wind=0.0))
    camera = Camera((0.0, 0.0, 3.0), (0.0, 60.0, 0.5), field_of_view=10.0)
    trace = sphere_trace(camera, sea, width=8, height=8)
    light = lit(trace, Sun(90.0, 50.0), visibility=280_000.0).light
    _, direction = camera.rays(8, 8).origin, camera.rays(8, 8).direction.reshape(8, 8, 3)
    mirrored = direction * [1, 1, -1]
    sky = Sky.over(1.0, Sun(90.0, 50.0), Air.of_visibility(280_000.0))
    row = np.flatnonzero((trace.layer == 0).all(axis=1))[0]
    share = water.fresnel(-direction[row, :, 2])
    assert (share > 0.6).all()
    expected = share[:, None] * sky.radiance(mirrored[row], disc=False)
    assert (light[row] > 0.95 * expected).all()
    assert (light[row] < 1.25 * expected).all()


@pytest.mark.parametrize("altitude", [35.0, 60.0])
def test_glitter_holds_all_of_the_light_that_water_mirrors(altitude: float) -> None:
    """Over all directions of view, the glint adds up to Fresnel's share of the sunlight."""
    sun, share = np.array(Sun(0.0, altitude).direction), math.sin(math.radians(altitude))
    count = 200_000
    index = np.arange(count) + 0.5
    z, turn = index / count, index * math.pi * (1 + math.sqrt(5))
    flat = np.sqrt(1 - z * z)
    view = -np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    normal = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (count, 3))
    found = water.glint(view, normal, sun, np.full(count, 0.003))
    expected = water.fresnel(np.array([share]))[0] * share
    assert found @ z * (2 * math.pi / count) == pytest.approx(expected, rel=0.05)
    brightest = -view[found.argmax()]
    np.testing.assert_allclose(brightest, sun * [1, -1, 1] * [1, 1, 1], atol=0.06)


# The picture.


def test_middle_grey_stays_and_brighter_light_is_brighter() -> None:
    ramp = np.repeat(np.geomspace(1e-4, 1e3, 200)[None, :, None], 3, axis=2).astype(np.float32)
    for curve in ("filmic", "reinhard", "linear"):
        found = tone.toned(ramp, curve)
        assert (np.diff(found[0, :, 1]) >= 0).all()
        assert found.min() >= 0
        assert found.max() <= 1
        grey = tone.toned(np.full((1, 1, 3), 0.18, np.float32), curve)
        np.testing.assert_allclose(grey, 0.18, atol=5e-3)


def test_metering_keeps_woods_snow_and_skies_in_range() -> None:
    sky, land = Sky.over(0.0, NOON, CLEAR), np.ones((4, 10), np.float32)
    plain = tone.automatic(sky)
    grey = np.full((4, 10, 3), tone.KEY / plain, np.float32)
    assert tone.metered(grey, land, sky) == pytest.approx(plain, rel=0.02)
    for scale, change in ((0.5, math.sqrt(2)), (2.0, math.sqrt(0.5)), (0.01, 1.5), (4.0, 0.67)):
        assert tone.metered(grey * np.float32(scale), land, sky) == pytest.approx(plain * change, rel=0.02)
    assert tone.metered(grey, 0 * land, sky) == pytest.approx(plain)
    glare = grey.copy()
    glare[:, 5:] = 1.6 * tone.HIGHLIGHTS / plain
    land[:, 5:] = 0
    assert tone.metered(glare, land, sky) == pytest.approx(plain / 1.6, rel=0.03)
    assert tone.metered(100 * glare, land, sky) == pytest.approx(0.45 * plain)


def test_codes_are_those_of_srgb_in_the_mean() -> None:
    codes = np.arange(5, 250).astype(np.uint8)
    linear = np.broadcast_to(tone.decoded(codes)[:, None, None, None], (245, 64, 64, 3))
    for code, light in zip(codes, linear, strict=True):
        assert abs(tone.encoded(light).mean() - code) <= 0.52  # floor of code + a number from 0 to 1
    # Between codes the pattern mixes both, so a slow ramp has no steps wider than a code.
    mixed = tone.encoded(np.full((64, 64, 3), (tone.decoded(codes)[100] + tone.decoded(codes)[101]) / 2, np.float32))
    assert set(np.unique(mixed)) <= {105, 106}
    assert 0.3 < (mixed == 106).mean() < 0.7


def scene(k: int = 1, rows: int = 30, cols: int = 40) -> Trace:
    grid = hills()
    surfaces = (
        Surface(None, grid, Ground(snow_line=40, tree_line=10, rock_slope=25)),
        Surface(None, flat(-25.0), Water(wind=0.0)),
    )
    camera = Camera((200.0, -300.0, 260.0), (250.0, 200.0, 0.0), field_of_view=50.0)
    return sphere_trace(camera, *surfaces, width=cols, height=rows, supersampling=k)


def test_it_is_deterministic_and_bands_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    trace = scene(2)
    first = shade(trace, sky_rays=2)
    assert first.data.dtype == np.uint8
    assert first.shape == (30, 40)
    assert np.array_equal(shade(trace, sky_rays=2).data, first.data)
    monkeypatch.setattr(module.pixels, "BAND", 500)
    assert np.array_equal(shade(trace, sky_rays=2).data, first.data)


def test_a_pixel_is_the_mean_of_its_samples() -> None:
    """With nothing traced but the first rays, a coarse picture is the fine one averaged."""
    coarse, fine = scene(3, 10, 12), scene(1, 30, 36)
    assert np.array_equal(coarse.layer, fine.layer)
    sun = Sun(0.0, 60.0, 0.0)
    a, b = lit(coarse, sun), lit(fine, sun)
    np.testing.assert_allclose(a.light, b.light.reshape(10, 3, 12, 3, 3).mean(axis=(1, 3)), rtol=1e-5)
    np.testing.assert_allclose(a.land, (fine.layer != SKY).reshape(10, 3, 12, 3).mean(axis=(1, 3)))


@pytest.mark.parametrize("k", [1, 2])
@pytest.mark.parametrize("altitude", [50.0, 6.0, -4.0])
def test_the_twin_agrees(device: Any, k: int, altitude: float) -> None:
    trace = scene(k)
    surfaces = (*trace.surfaces, Surface(None, flat(-30.0), WHITE))  # under water: never first
    trace = Trace(trace.camera, surfaces, k, trace.depth, trace.normal, trace.layer, trace.steps)
    # The same shadows, so that only the shading differs.
    context = Context()
    tracers = [surface_tracer(surface, trace.camera, Settings(), None, context) for surface in surfaces]
    host = lit_picture(trace, tracers, Sun(250.0, altitude), 50_000.0, 2, context)
    twin = lit_picture(trace, tracers, Sun(250.0, altitude), 50_000.0, 2, Context(device=device))
    np.testing.assert_allclose(twin.light, host.light, rtol=2e-3, atol=1e-4 * host.light.max())


def test_the_twin_agrees_on_maps_draped_and_plain(device: Any) -> None:
    grid = hills()
    picture = Image(np.random.default_rng(2).integers(0, 256, (9, 9, 4)).astype(np.uint8), Extent(100, 50, 300, 250))
    materials: list[Material] = [WHITE, Ground(tree_line=0.0), Imagery(image=picture)]
    for material in materials:
        trace = traced(Surface(None, grid, material), above(grid, 20, 25), 20, 25)
        host, twin = lit(trace), lit(trace, device=device)
        np.testing.assert_allclose(twin.light, host.light, rtol=2e-3, atol=1e-4 * host.light.max())


def test_an_empty_scene_is_an_honest_sky() -> None:
    surface = Surface(None, raster(np.zeros((5, 5))), WHITE)
    camera = Camera((0.0, 0.0, 100.0), (0.0, 1000.0, 400.0))
    trace = traced(surface, camera, 12, 16)
    assert (trace.layer == SKY).all()
    # Above the haze of the horizon.
    picture = shade(trace, Sun(180.0, 40.0)).data[:8].astype(int)
    assert (picture[..., 2] >= picture[..., 0]).all()
    assert picture[0, :, 2].mean() - picture[0, :, 0].mean() > 20
    assert 40 < picture.mean() < 230


def test_night_is_dark_but_no_number_is_lost() -> None:
    trace = scene()
    means = []
    for altitude in (40.0, -5.0, -8.0, -90.0):
        found = lit(trace, Sun(200.0, altitude), sky_rays=1)
        assert np.isfinite(found.light).all()
        assert found.light.min() > 0
        means.append(shade(trace, Sun(200.0, altitude), sky_rays=1).data.mean())
    assert means[0] > 60
    assert means[3] < 40
    assert means == sorted(means, reverse=True)
    assert means[0] > 1.2 * means[1]


def test_a_map_keeps_its_place() -> None:
    grid = raster(np.zeros((8, 10)), 25.0, 500_000.0, 4_000_000.0, "EPSG:32616")
    extent = shade(traced(Surface(None, grid, WHITE), above(grid, 16, 20), 16, 20)).extent
    for edge in ("west", "south", "east", "north"):
        assert getattr(extent, edge) == pytest.approx(getattr(grid.extent, edge), abs=1e-6)
    assert extent.crs == "EPSG:32616"


def test_a_cancel_takes_effect_within_a_second() -> None:
    trace = scene(2, 150, 200)
    stop = threading.Event()
    timer = threading.Timer(0.5, stop.set)
    timer.start()
    started = time.monotonic()
    with pytest.raises(Cancelled):
        shade(trace, sky_rays=64, context=Context(cancelled=stop))
    assert time.monotonic() - started < 1.7


# Bad input.


def test_bad_suns_are_refused() -> None:
    trace = scene(1, 4, 4)
    for sun in (Sun(math.nan, 10.0), Sun(0.0, math.inf), Sun(0.0, 10.0, math.nan)):
        with pytest.raises(ValueError, match="sun"):
            shade(trace, sun)


def test_pictures_that_do_not_fit_are_refused() -> None:
    surface = Surface(None, raster(np.zeros((8, 8)), 10.0, crs="EPSG:32616"), WHITE)
    data = np.zeros((3, 3, 3), np.uint8)
    for extent, words in (
        (Extent(80.0, 0.0, 90.0, 10.0, "EPSG:32616"), "overlap"),
        (Extent(0.0, 0.0, 80.0, 80.0, "EPSG:32617"), "EPSG:32617"),
        (Extent(0.0, 0.0, 1.0, 1.0, "EPSG:4326", "deg"), "degrees"),
    ):
        with pytest.raises(ValueError, match=words):
            imagery(surface, Image(data, extent))
    assert isinstance(imagery(surface, Image(data, Extent(0.0, 0.0, 80.0, 80.0))).material, Imagery)


def test_trees_and_rasters_link_straight_to_a_surface() -> None:
    graph = Graph()
    dem = graph.add("terrain.noise", "dem", rows=8, columns=8, extent=[0, 0, 800, 800])
    lake = graph.add("tree.constant", "lake", height=3.0)
    graph.add("render.ground", "land", surface=dem, snow_line=9.0)
    graph.add("render.water", "water", surface=lake)
    graph.validate()
    result = graph.run()
    land, sea = result["land"], result["water"]
    assert isinstance(sea.material, Water)
    assert isinstance(land.material, Ground)
    assert land.raster.shape == (8, 8)
    assert land.material.snow_line == 9
