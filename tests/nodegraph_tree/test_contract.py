"""Every node of the construction trees keeps the contract; a node without an example here fails."""

from __future__ import annotations

from typing import Any

import numpy as np

from nodegraph.testing import Example, parametrize_with_checks
from nodegraph_terrain.raster import Elevation, Extent, Mask, Raster
from nodegraph_tree.basic import Constant, Plane
from nodegraph_tree.blend import blend
from nodegraph_tree.disc import Disc, Relief
from nodegraph_tree.layers import Layers

EXTENT = Extent(0.0, 0.0, 480.0, 360.0)
DICE = np.random.default_rng(5)
HILL = Disc(200.0, 150.0, 160.0, 30.0, Relief("fbm", 20.0, 90.0, 4))
KNOLL = Disc(300.0, 220.0, 90.0, 60.0, Relief("ridged", 15.0, 60.0, 3, seed=4))
GROUND = Plane(10.0, 0.05, -0.02)
SCENE = blend([GROUND, HILL, KNOLL])
SURFACE = Elevation((100 + 20 * DICE.random((18, 24))).astype(np.float32), EXTENT)
MASK = Mask(DICE.random((18, 24), np.float32), EXTENT)
LAYERS = Layers(("ground", "water"), (SCENE, Constant(20.0)))
LINE = [[0, 0], [200, 40], [420, 0]]
GRID = {"extent": [0, 0, 480, 360], "cell_size": 20}


def cases(*params: dict[str, Any], **inputs: Any) -> list[Example]:
    return [Example(inputs, item) for item in params]


EXAMPLES: dict[str, list[Example]] = {
    "tree.add": cases({}, {"grow": True}, base=SCENE, details=[KNOLL, HILL]),
    "tree.bend": cases({"start": [0, 0], "end": [400, 0], "offsets": [40, -20], "reach": 400}, function=SCENE),
    "tree.blend": cases({}, parts=[GROUND, HILL, KNOLL]),
    "tree.carve": cases({}, {"smooth": 8.0}, base=SCENE, tools=[KNOLL]),
    "tree.constant": cases({"height": 12.0}),
    "tree.contour": [
        *cases({"points": [[100, 0], [0, 120], [-90, 0], [0, -80]], "sections": [[[0, 0], [1, 5]]]}),
        *cases({"radius": [90, 110, 100], "sections": [[[0, 0], [1, 5]], [[0, 0], [1, 9]]], "angles": [0, 90]}),
        *cases(
            {"centre": [5, 6], "height": 4, "core": 0.5, "reach": 2, "sections": [[[0, 0], [1, 5]], [[0, 0], [1, 8]]]}
        ),
    ],
    "tree.curve": [
        *cases({"points": LINE}, {"points": [[0, 0, 5], [200, 50, 3], [400, 0, 1]], "kind": "polyline", "radius": 60}),
        *cases(
            {"points": LINE, "sections": [[[-5, 1], [0, 0], [5, 1]], [[-9, 2], [0, 0], [9, 2]]], "positions": [0, 1]}
        ),
        *cases({"points": LINE, "sections": [[[-5, 1], [0, 0], [5, 1]]], "tolerance": 0.1, "core": 0.2}),
    ],
    "tree.disc": [
        *cases({"radius": 500}, {"style": "hills", "centre": [30, 40], "seed": 3}),
        *cases({"kind": "ridged", "amplitude": 80, "wavelength": 300, "gain": 0.4, "fall_off": "quintic"}),
        *cases({"kind": "fbm", "amplitude": 10, "wavelength": 100, "octaves": 2, "intervals": [[0, 0.3], [0.4, 1]]}),
    ],
    "tree.from_elevation": [
        *cases({}, {"interpolation": "bicubic", "margin": 60, "scale": 2.0, "rise": 5.0}, surface=SURFACE),
        *cases({}, surface=SURFACE, mask=MASK),
    ],
    "tree.image_curve": cases(
        {"points": [[0, 0], [400, 50], [800, 0]], "width": 120},
        {"points": [[0, 0], [400, 60], [900, 0]], "width": 100, "scale": 0.5},
        images=[SURFACE],
    ),
    "tree.image_quad": [
        *cases({"corners": [[0, 300], [400, 320], [380, 0], [10, 10]]}, surface=SURFACE),
        *cases(
            {"corners": [[0, 300], [400, 300], [400, 0], [0, 0]], "interpolation": "bilinear", "margin": 50},
            surface=SURFACE,
            mask=MASK,
        ),
    ],
    "tree.instances": cases(
        {"positions": [[0, 0], [300, 50]]},
        {
            "positions": [[0, 0], [300, 50]],
            "rotations": [0, 45],
            "scales": [1, 2],
            "vertical_scales": [1, 0.5],
            "rises": [0, 3],
        },
        function=HILL,
    ),
    "tree.crater": [
        *cases({}, {"radius": 90, "peak": 0.3, "seed": 2}, {"height": 5, "rim": 0.1, "depth": 0.3, "reach": 2}),
        *cases({"centre": [200, 150], "radius": 60}, terrain=SCENE),
    ],
    "tree.lake": [
        *cases({}, {"points": [[100, 0], [0, 120], [-90, 0], [0, -80]]}, {"radius": 90, "seed": 2, "level": 4}),
        *cases({"centre": [200, 150], "radius": 60}, terrain=SCENE),
    ],
    "tree.mesa": cases({}, {"points": [[100, 0], [0, 120], [-90, 0], [0, -80]]}, {"radius": 90, "seed": 2}),
    "tree.layer": cases({"name": "ground"}, {"name": "water"}, layers=LAYERS),
    "tree.layers": cases({"names": ["ground", "top"]}, {"names": ["a", "b"]}, functions=[SCENE, KNOLL]),
    "tree.level_of_detail": cases({}, {"start": 0.1, "end": 0.5}, coarse=GROUND, fine=SCENE),
    "tree.noise": cases({}, {"kind": "warped", "octaves": 3, "intervals": [[0, 0.3], [0.3, 0.6], [0.6, 1]]}),
    "tree.normals": cases(
        GRID, {"extent": [0, 0, 480, 360], "rows": 9, "columns": 11, "crs": "EPSG:32616"}, function=SCENE
    ),
    "tree.pile": cases({}, {"smooth": 8.0}, base=SCENE, tools=[KNOLL]),
    "tree.plane": cases({}, {"height": 3, "origin": [5, 6], "east": 0.1, "north": 0.2}),
    "tree.query": cases(
        {"points": [[0, 0], [300, 200]]}, {"points": [[0, 0], [300, 250]], "spacing": 10}, function=SCENE
    ),
    "tree.replace": cases({}, {"grow": True}, base=GROUND, layers=[HILL, KNOLL]),
    "tree.ridge": cases(
        {"points": LINE}, {"points": LINE, "spurs": [[[200, 0], [220, 300]]], "roughness": 20, "radius": 300}
    ),
    "tree.river": [
        *cases({"points": LINE}, {"points": LINE, "tributaries": [[[150, 300], [200, 30]]], "depth": 3, "floor": 60}),
        *cases({"points": LINE, "kind": "meander", "width": 9}, terrain=SCENE),
        *cases({"points": LINE, "kind": "braided", "width": 40}, {"points": LINE, "kind": "stream", "width": [4, 8]}),
    ],
    "tree.road": [
        *cases({"points": LINE}, {"points": LINE, "width": 9, "height": 4}),
        *cases({"points": LINE}, terrain=SCENE),
    ],
    "tree.sample": [
        *cases(GRID, {"extent": [0, 0, 480, 360], "rows": 9, "columns": 11, "crs": "EPSG:32616"}, function=SCENE),
        *cases({**GRID, "viewpoint": [100, 100], "view_range": 500}, function=SCENE),
        *cases({"detail": 0.4}, function=SCENE, like=SURFACE, detail_map=Raster(MASK.data, EXTENT)),
    ],
    "tree.sample_layer": [
        *cases({"name": "water", **GRID}, layers=LAYERS),
        *cases({"extent": [0, 0, 480, 360], "rows": 9, "columns": 11, "crs": "EPSG:32616"}, layers=LAYERS),
        *cases({"detail": 0.4}, layers=LAYERS, like=SURFACE),
    ],
    "tree.scatter": [
        *cases({"extent": [0, 0, 3000, 2000], "spacing": 700}, function=HILL),
        *cases({"extent": [0, 0, 2000, 2000], "spacing": 600, "rotation": [0, 10], "scale": [1, 1]}, function=HILL),
        *cases({"extent": [0, 0, 2000, 2000], "vertical_scale": [1, 2], "rise": [0, 5], "seed": 4}, function=HILL),
        *cases({"spacing": 100, "sparsest": 0.1}, function=HILL, density=MASK),
    ],
    "tree.transform": cases(
        {}, {"position": [5, 6], "rotation": 30, "size": [2, 0.5], "height_scale": 2, "rise": 1}, function=SCENE
    ),
    "tree.tree_statistics": cases(
        {}, {"extent": [0, 0, 480, 360], "rows": 64, "columns": 64, "detail": 0.5}, function=SCENE
    ),
    "tree.twist": cases({"radius": 400}, {"centre": [100, 100], "radius": 300, "angle": 45}, function=SCENE),
    "tree.warp": cases(
        {"amplitude": 10, "wavelength": 200},
        {"amplitude": 5, "wavelength": 200, "octaves": 2, "gain": 0.2, "seed": 3},
        function=SCENE,
    ),
    "tree.weight_by_terrain": [
        *cases({"highest": 40}, {"lowest": 10, "highest": 50, "altitude_fade": 5}, function=KNOLL, terrain=SCENE),
        *cases({"gentlest": 2, "steepest": 20, "slope_fade": 3, "span": 5}, function=KNOLL, terrain=SCENE),
    ],
}


@parametrize_with_checks("tree", EXAMPLES)
def test_contract(check):
    check()
