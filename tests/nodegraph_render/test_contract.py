"""Every node of the render family keeps the contract; a node without an example here fails."""

from __future__ import annotations

from typing import Any

import numpy as np

from nodegraph.testing import Example, parametrize_with_checks
from nodegraph_render.camera import Camera
from nodegraph_render.contour_lines import contour_lines
from nodegraph_render.drape import drape
from nodegraph_render.flight import Film
from nodegraph_render.material import Ground, Imagery, Plain, Water
from nodegraph_render.mesh_adaptive import mesh_adaptive
from nodegraph_render.mesh_tin import mesh_tin
from nodegraph_render.profile import profile
from nodegraph_render.sun import Sun
from nodegraph_render.surface import Surface
from nodegraph_render.trace import Trace, sphere_trace
from nodegraph_render.turntable import turntable
from nodegraph_terrain.hillshade import hillshade
from nodegraph_terrain.polylines import Polylines
from nodegraph_terrain.raster import Elevation, Extent, Image
from nodegraph_terrain.resample import resample
from nodegraph_tree.basic import Constant

ROWS, COLS, CELL = 21, 33, 20.0
EXTENT = Extent(500_000.0, 4_000_000.0, 500_000.0 + COLS * CELL, 4_000_000.0 + ROWS * CELL, "EPSG:32616")
DICE = np.random.default_rng(5)
Y, X = np.mgrid[0:ROWS, 0:COLS].astype(np.float32)
HILLS = (400 + 60 * np.sin(X / 4) * np.cos(Y / 6) + DICE.normal(0, 2, (ROWS, COLS))).astype(np.float32)
SURFACE = Elevation(HILLS, EXTENT)
HOLEY = Elevation(np.where((X - 12) ** 2 + (Y - 9) ** 2 < 9, np.float32(np.nan), HILLS), EXTENT)
PICTURE = Image(DICE.integers(0, 256, (ROWS, COLS, 3)).astype(np.uint8), EXTENT)
MESH = mesh_adaptive(SURFACE, error=4.0)
TIN = mesh_tin(HOLEY, error=6.0)
TEXTURED = drape(MESH, PICTURE)
GENTLE = Elevation(400 + 10 * np.sin(X / 4) * np.cos(Y / 6), EXTENT)
"""No hill throws a shadow on another under a high sun, so that the last digit of a ray decides nothing."""

FINER = resample(SURFACE, cell_size=8.0)
WALKS = Polylines.of(
    [[[500_010, 4_000_020], [500_500, 4_000_400], [500_600, 4_000_050]], [[500_000, 4_000_400], [500_660, 4_000_010]]],
    crs="EPSG:32616",
)


def seen(*surfaces: Surface, supersampling: int = 1) -> Trace:
    x, y = (EXTENT.west + EXTENT.east) / 2, (EXTENT.south + EXTENT.north) / 2
    camera = Camera((x - 200, y - 500, 700), (x, y, 400))
    return sphere_trace(camera, *surfaces, width=18, height=12, supersampling=supersampling)


VIEW = Camera((500_100.0, 4_000_000.0, 900.0), (500_330.0, 4_000_200.0, 400.0))
DOWN = Camera((500_330.0, 4_000_200.0, 900.0), (500_330.0, 4_000_200.0, 400.0), up=(0.0, 1.0, 0.0))
GROUND = Surface(None, GENTLE, Ground(snow_line=405, tree_line=395, rock_slope=5))
DRAPED = Surface(None, GENTLE, Imagery(image=PICTURE))
LAKE = Surface(Constant(398.0), None, Water(wind=0.0))


def cases(*params: dict[str, Any], **inputs: Any) -> list[Example]:
    return [Example(inputs, item) for item in params]


TABLE = turntable(GENTLE, duration=1.0, pitch=50.0)
FILM = Film((PICTURE, Image(PICTURE.data[::-1].copy(), EXTENT)), 5.0, True)
EVEN = Film((PICTURE.window(slice(0, 20), slice(0, 32)),) * 3, 5.0)
KEYS = [
    {"time": 0, "eye": [500_100, 4_000_100, 600], "target": [500_400, 4_000_300, 400]},
    {"time": 1, "eye": [500_200, 4_000_100, 450], "target": [500_400, 4_000_300, 400], "field_of_view": 30},
    {"time": 3, "eye": [500_300, 4_000_200, 500], "target": [500_400, 4_000_300, 400]},
]
LOOP = [*KEYS, {**KEYS[0], "time": 4}]
TINY = {"width": 12, "height": 8, "supersampling": 1}


EXAMPLES: dict[str, list[Example]] = {
    "render.camera": [
        *cases(
            {"pitch": 40, "azimuth": 10, "roll": 3, "aspect": 1, "margin": 0.1},
            {"orthographic": True, "extent": [500_000, 4_000_000, 500_300, 4_000_200], "low": 0, "high": 900},
            {"eye": [500_100, 4_000_100, 900], "target": [500_100, 4_000_300, 400], "focal_length": 35},
            ground=SURFACE,
        ),
        *cases(
            {"eye": [0, 0, 9], "target": [1, 2, 3], "span": 8},
            {"eye": [0, 0, 9], "target": [1, 2, 3], "field_of_view": 20},
        ),
    ],
    "render.sun": [
        *cases({}, {"azimuth": 10, "altitude": 60, "diameter": 2}),
        *cases({"time": "2024-06-21T12:00Z", "latitude": 3, "longitude": 7}),
        *cases({"time": "2024-06-21T16:00:00-05:00"}, place=SURFACE),
    ],
    "render.path": [
        *cases({"keys": KEYS}, {"keys": LOOP, "closed": True, "curve": "monotone"}),
        *cases({"keys": LOOP, "closed": True, "constant_speed": True, "ease": 0.2, "clearance": 60}, ground=SURFACE),
    ],
    "render.turntable": [
        *cases({}, {"turns": 0.5, "aspect": 1}, ground=SURFACE),
        *cases({"target": [1, 2, 3], "distance": 9}),
    ],
    "render.sphere_trace": [
        *cases(
            {"width": 8, "height": 6},
            {"width": 5, "height": 4, "supersampling": 2, "share": 1e-3},
            camera=VIEW,
            surfaces=(GROUND,),
        ),
        *cases({"width": 6, "height": 4, "method": "plain"}, camera=VIEW, surfaces=(GROUND,)),
        *cases(
            {"width": 6, "height": 4, "extent": [0, 0, 9e5, 9e6]},
            {
                "width": 6,
                "height": 4,
                "epsilon": 0.5,
                "view_range": 5000,
                "extent": [499_000, 3_999_000, 502_000, 4_002_000],
            },
            camera=DOWN,
            surfaces=(LAKE,),
        ),
    ],
    "render.trace_channel": cases(
        *[{"channel": name} for name in ("elevation", "layer", "hit", "steps", "normal_up")],
        {},
        trace=seen(GROUND, LAKE),
    ),
    "render.picture": [
        *cases({**TINY, "sky_rays": 0}, camera=TABLE.camera(0.0), surfaces=(GROUND, LAKE)),
        *cases(
            {**TINY, "metering": "sun", "visibility": 20, "extent": [0, 0, 9e5, 9e6]},
            camera=TABLE.camera(0.3),
            sun=Sun(120, 60),
            surfaces=(GROUND,),
        ),
    ],
    "render.flight": [
        *cases(
            {**TINY, "frame_rate": 2, "sky_rays": 0},
            {**TINY, "frame_rate": 1, "sky_rays": 0, "extent": [0, 0, 9e5, 9e6]},
            path=TABLE,
            sun=Sun(120, 60),
            surfaces=(GROUND,),
        ),
    ],
    "render.save_film": [
        *cases({"name": "a/f.gif"}, {"name": "f.png"}, film=FILM),
        *cases({"name": "f.mp4", "quality": 30}, film=EVEN),
    ],
    "render.function_surface": cases({}, function=Constant(3.0)),
    "render.ground": cases({}, {"snow_line": 500, "seed": 3}, surface=LAKE),
    "render.imagery": cases({}, surface=GROUND, image=PICTURE),
    "render.plain": cases({}, {"red": 0.2}, surface=GROUND),
    "render.raster_surface": cases({}, raster=SURFACE),
    "render.shade": [
        *cases({"sky_rays": 0}, {"metering": "sun", "exposure": 1, "curve": "reinhard"}, trace=seen(GROUND, LAKE)),
        *cases({"visibility": 20}, trace=seen(DRAPED, supersampling=2), sun=Sun(120, 60)),
        *cases({}, trace=seen(Surface(None, GENTLE, Plain()), supersampling=3), sun=Sun(10, -5)),
    ],
    "render.water": cases({}, {"wind": 0, "clarity": 1}, surface=GROUND),
    "render.drape": cases({}, mesh=MESH, image=PICTURE),
    "render.mesh_adaptive": [*cases({"error": 5}, surface=SURFACE), *cases({"error": 0.5}, surface=HOLEY)],
    "render.mesh_grid": [*cases({}, surface=SURFACE), *cases({"stride": 3}, surface=HOLEY)],
    "render.mesh_solid": [
        *cases({}, {"thickness": 30}, {"kind": "skirt", "thickness": 15}, mesh=TEXTURED),
        *cases({}, {"base": -20}, {"kind": "skirt", "base": 100}, mesh=TIN),
    ],
    "render.mesh_tin": [
        *cases({"error": 5}, {"error": None, "max_triangles": 90}, surface=SURFACE),
        *cases({"error": 2, "max_triangles": 400}, surface=HOLEY),
    ],
    "render.save_mesh": [
        *cases(*({"name": f"a/b.{suffix}"} for suffix in ("glb", "gltf", "obj", "ply", "stl")), mesh=TEXTURED),
        *cases({"name": "b.glb", "scale": 0.01}, mesh=MESH, texture=PICTURE),
        *cases({"name": "b.ply", "recentre": False}, mesh=TIN),
    ],
    "render.compare": [
        *cases({"size": 200}, {"size": 210, "limit": 3, "title": "Apart"}, reference=SURFACE, surface=HOLEY),
        *cases({"size": 200, "resample": True}, reference=HOLEY, surface=FINER),
    ],
    "render.contour_lines": [
        *cases({}, {"interval": 20, "heights": True}, {"levels": [390, 410], "index": 2}, surface=SURFACE),
        *cases({"smooth": 3}, {"interval": 7, "base": 3}, surface=HOLEY),
    ],
    "render.profile": [
        *cases({}, {"spacing": 50, "line_number": 1}, surface=HOLEY, line=WALKS),
        *cases({"points": [[500_010, 4_000_020], [500_600, 4_000_400]]}, surface=SURFACE),
        *cases({"points": [[500_010, 4_000_020], [500_600, 4_000_200]]}, surface=SURFACE),
    ],
    "render.profile_plot": cases(
        {"width": 300, "height": 200},
        {"width": 310, "height": 220, "names": ["ground", "lake"], "styles": ["ground", "water"], "exaggeration": 1},
        {"width": 300, "height": 200, "names": ["a", "b"], "styles": ["line", "line"]},
        profiles=[profile(SURFACE, WALKS), profile(HOLEY, WALKS, line_number=1)],
    ),
    "render.relief_map": [
        *cases({"size": 200, "mode": "single"}, {"size": 210, "colours": "viridis", "minimum": 380}, surface=HOLEY),
        *cases(
            {"size": 200, "interval": 25, "coordinates": "lonlat", "line_colour": "#ff0000"},
            {"size": 200, "colours": [[300, "#000000"], [500, "#ffffff"]], "exaggeration": 2, "title": "There"},
            surface=SURFACE,
            shade=hillshade(SURFACE),
            image=PICTURE,
            contours=contour_lines(SURFACE),
            lines=WALKS,
        ),
    ],
}


@parametrize_with_checks("render", EXAMPLES)
def test_contract(check):
    check()
