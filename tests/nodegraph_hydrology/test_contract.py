"""Every node of hydrology keeps the contract; a node without an example here fails."""

from __future__ import annotations

from typing import Any

import numpy as np

from nodegraph.testing import Example, parametrize_with_checks
from nodegraph_hydrology.rasterize_features import rasterize_features
from nodegraph_hydrology.ridges import ridges
from nodegraph_hydrology.river_heights import river_heights
from nodegraph_hydrology.river_network import river_network
from nodegraph_terrain.polylines import Polylines
from nodegraph_terrain.raster import Elevation, Extent, Mask, Raster

LINES = Polylines.of(
    [np.array([[1000.0, 0.0], [1400.0, 1500.0], [900.0, 3600.0]]), np.array([[3900.0, 100.0], [3000.0, 3000.0]])]
)
OUTLINE = Polylines.of([np.array([[0.0, 0.0], [4000.0, 0.0], [4000.0, 4000.0], [0.0, 4000.0], [0.0, 0.0]])])
NETWORK = river_network(LINES, OUTLINE, depth=3)
RIVERS = river_heights(NETWORK)
RIDGES = ridges(RIVERS, OUTLINE)
FEATURES = rasterize_features(RIVERS, RIDGES, cell_size=100)
WIDE = Elevation(np.zeros((40, 50), np.float32), Extent(0.0, 0.0, 5000.0, 4000.0))
STROKES = np.zeros((18, 24), np.float32)
STROKES[3:6, 2:22] = STROKES[5:16, 11:14] = 1
EXTENT = Extent(0.0, 0.0, 480.0, 360.0)
GROUND = Elevation((100 + 20 * np.random.default_rng(5).random((18, 24))).astype(np.float32), EXTENT)
POINTS = Elevation(np.where(np.random.default_rng(6).random((18, 24)) < 0.1, GROUND.data, np.float32(np.nan)), EXTENT)
DIFFUSIVITY = Raster(np.random.default_rng(7).random((18, 24), np.float32), EXTENT)
PATCH = Elevation(50 * np.random.default_rng(8).random((9, 12), np.float32), Extent(90.0, 70.0, 330.0, 250.0))
PATCH_MASK = Mask(np.random.default_rng(9).random((9, 12), np.float32), PATCH.extent)

WIDE = Elevation(
    (np.add.outer(np.arange(20.0), np.zeros(20)) * -9 + 3 * np.random.default_rng(10).random((20, 20))).astype(
        np.float32
    ),
    Extent(0.0, 0.0, 4000.0, 4000.0),
)


def cases(*params: dict[str, Any], **inputs: Any) -> list[Example]:
    return [Example(inputs, item) for item in params]


EXAMPLES: dict[str, list[Example]] = {
    "hydrology.basins": cases(
        {},
        {"unit": "links", "threshold": 8000, "method": "dinf"},
        {"smallest": 3000, "depressions": "breach"},
        surface=GROUND,
    ),
    "hydrology.compare_networks": [
        *cases({}, {"inside": True, "method": "dinf"}, designed=NETWORK, terrain=WIDE),
        *cases(
            {"threshold": 4e5, "within": 3, "least_order": 1, "depressions": "breach"}, designed=NETWORK, terrain=WIDE
        ),
    ],
    "hydrology.carve_rivers": cases(
        {},
        {"flattest": 0, "steepest": None},
        {"flattest": 0.1, "steepest": 0.5, "reach": 300},
        surface=WIDE,
        network=RIVERS,
    ),
    "hydrology.drainage_area": cases({}, {"depressions": "breach", "method": "dinf"}, surface=GROUND),
    "hydrology.draw_network": [
        *cases({"size": 150}, {"size": 120, "width": 3, "lowest_order": 2, "legend": False}, network=NETWORK),
        *cases({"size": 150}, network=NETWORK, surface=WIDE),
    ],
    "hydrology.extract_ridges": cases(
        {"threshold": 8000}, {"threshold": 6000, "method": "inverted", "shortest": 40}, surface=GROUND
    ),
    "hydrology.extract_streams": cases(
        {"threshold": 8000}, {"threshold": 4000, "depressions": "breach", "method": "dinf"}, surface=GROUND
    ),
    "hydrology.headwaters": [
        *cases({}, {"spacing": 500, "variety": 0, "seed": 2}, network=NETWORK),
        *cases({"spacing": 400}, network=NETWORK, outline=OUTLINE),
    ],
    "hydrology.network_statistics": cases({}, {"title": "Rivers"}, network=NETWORK),
    "hydrology.stream_order": cases(
        {"threshold": 8000},
        {"threshold": 4000, "kind": "shreve", "depressions": "breach", "method": "dinf"},
        surface=GROUND,
    ),
    "hydrology.diffuse": [
        *cases({}, {"tolerance": 1e-3}, {"border": "fixed", "border_elevation": 90}, features=POINTS),
        *cases(
            {},
            {"method": "jacobi", "iterations": 20},
            {"method": "sor", "iterations": 20, "relaxation": 1.5},
            features=POINTS,
            diffusivity=DIFFUSIVITY,
        ),
    ],
    "hydrology.poisson_blend": [
        *cases({}, {"relief": 2, "mixed": True}, {"feather": 60}, base=GROUND, patch=PATCH),
        *cases({}, {"position": [200, 150], "rotation": 30, "size": 1.5}, base=GROUND, patch=PATCH, mask=PATCH_MASK),
    ],
    "hydrology.lines_from_mask": cases(
        {}, {"shortest": 60, "tolerance": 0, "threshold": 1}, mask=Mask(STROKES, EXTENT)
    ),
    "hydrology.lsystem": cases(
        {"iterations": 3},
        {"axiom": "A(1)", "rules": ["A(s) : s > 0.3 -> F(s*50)[+(25)A(s*0.7)][-A(s*0.6)] @ 2"], "seed": 3, "angle": 20},
        {"axiom": "F", "rules": ["F -> F+F"], "drawn": "F", "step": 5, "scale": 1, "start": [3, 4], "heading": 0},
        {"iterations": 1, "crs": "EPSG:32632"},
    ),
    "hydrology.enrich": [
        *cases(
            {"rounds": 2},
            {"rounds": 5, "limit": 60, "roughness": 0.3, "seed": 4},
            features=FEATURES.features,
            rivers=FEATURES.rivers,
        ),
        *cases({}, {"rounds": 0}, features=POINTS),
    ],
    "hydrology.rasterize_features": [
        *cases({}, {"extent": [500, -100, 3500, 3900], "cell_size": 50}, network=RIVERS),
        *cases({"cell_size": 100}, {"method": "bresenham", "cell_size": 40}, network=RIVERS, ridges=RIDGES),
        *cases({}, network=RIVERS, ridges=RIDGES, like=WIDE),
    ],
    "hydrology.ridges": [
        *cases({}, {"nearest": 6, "alpha": 1, "detour": 1, "seed": 2}, network=RIVERS),
        *cases(
            {"spacing": 50, "roughness": 0},
            {"roughness": 1, "wavelength": 500, "octaves": 2},
            network=RIVERS,
            outline=OUTLINE,
        ),
    ],
    "hydrology.river_heights": cases(
        {},
        {"relief": 300, "outlet_elevation": 20},
        {"mode": "concave"},
        {"mode": "concave", "concavity": 0.6, "steepness": 60, "hillslope": 200},
        {"steepest": 0.3, "least_fall": 0.2},
        network=NETWORK,
    ),
    "hydrology.river_network": [
        *cases({"depth": 3}, {"depth": 2, "generator": 4, "growth": "printed", "seed": 2, "angle": 40}, lines=LINES),
        *cases(
            {"max_depth": 3},
            {"max_depth": 4, "width": 6000, "jitter": 0, "sinuosity": 0, "bends": 0},
            {"depth": 2, "rules": ["G -> F[-G][+G]", "F -> F[--G]F"]},
            lines=LINES,
            outline=OUTLINE,
        ),
    ],
    "hydrology.river_rules": cases({}, {"generator": 3, "growth": "printed"}),
    "hydrology.sketch_line": cases(
        {"points": [[0, 0], [100, 50]]}, {"points": [[[0, 0], [9, 5]], [[30, 0], [8, 9], [9, 30]]], "crs": "EPSG:32632"}
    ),
}


@parametrize_with_checks("hydrology", EXAMPLES)
def test_contract(check):
    check()
