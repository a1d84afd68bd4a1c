"""Every terrain node keeps the contract; a node without an example here fails."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nodegraph.testing import Example, parametrize_with_checks
from nodegraph_terrain.polylines import Polylines, Property
from nodegraph_terrain.raster import Elevation, Extent, Image, Mask, Raster, Shade

ROWS, COLS = 37, 29
CELL = 30.0
EXTENT = Extent(500_000.0, 4_000_000.0, 500_000.0 + COLS * CELL, 4_000_000.0 + ROWS * CELL, "EPSG:32616")
DICE = np.random.default_rng(7)
ASCII = str(Path(__file__).with_name("contract.asc"))
Y, X = np.mgrid[0:ROWS, 0:COLS].astype(np.float32)


def hills(*, voids: bool = False) -> Elevation:
    """Rolling hills with a little noise, 300 to 700 m; with voids, a hole inside and one at the border."""
    data = 500 + 120 * np.sin(X / 4) * np.cos(Y / 6) + DICE.normal(0, 3, (ROWS, COLS))
    if voids:
        data[10:14, 8:12] = np.nan
        data[0, 20:] = np.nan
    return Elevation(data.astype(np.float32), EXTENT)


SOLID, HOLEY = hills(), hills(voids=True)
DEGREES = Elevation(SOLID.data, Extent(-84.5, 36.0, -84.5 + COLS / 1200, 36.0 + ROWS / 1200, "EPSG:4326", "deg"))
MASK = Mask(DICE.random((ROWS, COLS), np.float32), EXTENT)
SHADE = Shade(DICE.random((ROWS, COLS), np.float32), EXTENT)
PICTURE = Image(DICE.integers(0, 256, (ROWS, COLS, 4)).astype(np.uint8), EXTENT)
PLAIN = Raster(DICE.normal(0, 1, (ROWS, COLS)).astype(np.float32), EXTENT)

LINES = Polylines.of(
    [[[500_000, 4_000_000, 5], [500_100, 4_000_050, 6]], [[0, 0, 1], [9, 0, 1], [9, 9, 1], [0, 0, 1]]],
    [Property("level", np.array([5.5, 1.0]), "m"), Property("name", ("Elk", "Fork")), Property("order", np.arange(2))],
    "EPSG:32616",
)
TRACK = str(Path(__file__).with_name("contract.csv"))


def cases(*params: dict[str, Any], **inputs: Any) -> list[Example]:
    return [Example(inputs, item) for item in params]


BOTH = [Example({"surface": SOLID}), Example({"surface": HOLEY})]

EXAMPLES: dict[str, list[Example]] = {
    "terrain.add": cases({}, {"constant": 3.5}, surface=HOLEY, others=[PLAIN, SOLID]),
    "terrain.aspect": BOTH,
    "terrain.blend_shade": cases(
        {}, {"mode": "overlay", "strength": 0.7}, {"mode": "soft_light", "level": 0.5}, image=PICTURE, shade=SHADE
    ),
    "terrain.clamp": cases({"minimum": 450, "maximum": 550}, surface=HOLEY),
    "terrain.colour_relief": [
        *BOTH,
        *cases({"colours": "viridis", "minimum": 400, "maximum": 600}, surface=HOLEY),
        *cases({"colours": [[-1, "#000000"], [1, "#ffffff"]]}, surface=PLAIN),
    ],
    "terrain.crop": [
        *cases(
            {"rows": [3, 20], "columns": [5, 25]}, {"extent": [500_100, 4_000_100, 500_500, 4_000_500]}, surface=SOLID
        ),
        *cases({}, surface=SOLID, like=SOLID.window(slice(2, 9), slice(3, 8))),
    ],
    "terrain.fill_voids": cases({"method": "laplace"}, {"method": "nearest", "maximum_size": 5}, surface=HOLEY),
    "terrain.gaussian_smooth": [
        *cases({"sigma": 45}, {"sigma": 5000}, surface=SOLID),
        *cases({"sigma": 70, "truncate": 3}, {"sigma": 0}, surface=HOLEY),
    ],
    "terrain.hillshade": [
        Example({"surface": surface}, {"mode": mode, "cast_shadows": shadows, "altitude": 20, "azimuth": 30})
        for surface in (SOLID, HOLEY)
        for mode in ("single", "multidirectional")
        for shadows in (False, True)
    ],
    "terrain.load_elevation": cases(
        {"path": ASCII},
        {"path": ASCII, "extent": [0, 0, 400, 300], "crs": "EPSG:32616", "vertical_unit": "ft"},
    ),
    "terrain.load_polylines": cases(
        {"path": TRACK},
        {"path": TRACK, "crs": "EPSG:32616", "target_crs": "EPSG:32617", "columns": ["x", "y", "-", "line"]},
    ),
    "terrain.mask_image": cases({}, mask=MASK),
    "terrain.maximum": cases({}, {"limit": 480}, surface=HOLEY, others=[SOLID]),
    "terrain.minimum": cases({}, {"limit": 520}, surface=HOLEY, others=[SOLID]),
    "terrain.mix": cases({}, first=SOLID, second=HOLEY, mask=MASK),
    "terrain.multiply": cases({}, {"factor": 2.0}, surface=HOLEY, others=[MASK]),
    "terrain.remap": [
        *BOTH,
        *cases({"from_minimum": 400, "from_maximum": 600, "clamp": True}, surface=HOLEY),
        *cases({"curve": [[0, 0], [0.3, 0.8], [1, 1]]}, surface=SOLID),
    ],
    "terrain.noise": [
        *cases(
            {"extent": [1e6, 2e6, 1e6 + 900, 2e6 + 700], "cell_size": 10, "kind": "ridged", "seed": 3},
            {"rows": 20, "columns": 33, "kind": "warped", "wavelength": 3e4, "kappa": 0.6, "offset": 4000},
            {"rows": 9, "columns": 8, "kind": "gradient", "crs": "EPSG:32616"},
        ),
        *cases({}, {"kind": "hybrid", "octaves": 12, "gain": 0.8}, {"kind": "billow", "kappa": 0.3}, like=HOLEY),
    ],
    "terrain.reproject": [*cases({"cell_size": 60}, surface=DEGREES), *cases({"cell_size": 45}, surface=SOLID)],
    "terrain.resample": [
        *cases({"cell_size": 20, "method": "bilinear"}, {"cell_size": 20, "method": "cubic"}, surface=SOLID),
        *cases({"cell_size": 50, "method": "area"}, {"cell_size": 45, "method": "lanczos"}, surface=HOLEY),
        *cases({"factor": 1.7}, {"factor": 0.3, "method": "area"}, surface=SOLID),
        *cases({}, {"method": "area"}, surface=SOLID, like=HOLEY),
    ],
    "terrain.sample_dem": [Example()],
    "terrain.save_elevation": [
        *cases(
            *({"name": f"a/b{suffix}"} for suffix in (".tif", ".png", ".r16", ".r32", ".asc", ".npy", ".h5")),
            surface=HOLEY,
        )
    ],
    "terrain.save_image": cases({"name": "a.png"}, {"name": "a.tif"}, image=PICTURE),
    "terrain.save_polylines": cases(
        {"name": "a/b.geojson"}, {"name": "a.csv", "decimals": 2}, {"name": "a.json", "coordinates": "own"}, lines=LINES
    ),
    "terrain.shade_image": cases({}, shade=SHADE),
    "terrain.slope": [*BOTH, *cases({"z_factor": 2}, surface=HOLEY)],
    "terrain.statistics": [*BOTH, *cases({"bins": 16}, surface=HOLEY)],
    "terrain.subtract": cases({}, {"constant": 3.5}, surface=HOLEY, others=[PLAIN]),
    "terrain.to_mask": cases({"lower": 480, "upper": 520}, {"lower": 500, "upper": 500}, surface=HOLEY),
}


@parametrize_with_checks("terrain", EXAMPLES)
def test_contract(check):
    check()
