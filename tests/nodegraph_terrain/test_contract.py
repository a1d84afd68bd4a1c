"""Every terrain node keeps the contract; a node without an example here fails."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nodegraph.testing import Example, parametrize_with_checks
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


def picture() -> Image:
    return Image(DICE.integers(0, 256, (ROWS, COLS, 3)).astype(np.uint8), EXTENT)


SOLID, HOLEY = hills(), hills(voids=True)
DEGREES = Elevation(SOLID.data, Extent(-84.5, 36.0, -84.5 + COLS / 1200, 36.0 + ROWS / 1200, "EPSG:4326", "deg"))
MASK = Mask(DICE.random((ROWS, COLS), np.float32), EXTENT)
SHADE = Shade(DICE.random((ROWS, COLS), np.float32), EXTENT)
PLAIN = Raster(DICE.normal(0, 1, (ROWS, COLS)).astype(np.float32), EXTENT)


def arithmetic(**other: object) -> list[Example]:
    return [Example({"surface": SOLID, "others": [PLAIN, HOLEY]}), Example({"surface": HOLEY}, other)]


EXAMPLES: dict[str, list[Example]] = {
    "terrain.add": arithmetic(constant=2.5),
    "terrain.subtract": arithmetic(constant=2.5),
    "terrain.multiply": arithmetic(factor=2.5),
    "terrain.minimum": arithmetic(limit=480.0),
    "terrain.maximum": arithmetic(limit=520.0),
    "terrain.aspect": [Example({"surface": SOLID}), Example({"surface": HOLEY})],
    "terrain.blend_shade": [
        Example({"image": picture(), "shade": SHADE}, {"mode": mode}) for mode in ("multiply", "overlay", "soft_light")
    ],
    "terrain.clamp": [Example({"surface": HOLEY}, {"minimum": 450, "maximum": 550})],
    "terrain.colour_relief": [
        Example({"surface": HOLEY}),
        Example({"surface": SOLID}, {"colours": "viridis", "minimum": 400, "maximum": 600}),
        Example({"surface": PLAIN}, {"colours": [[-1, "#000000"], [1, "#ffffff"]]}),
    ],
    "terrain.crop": [
        Example({"surface": SOLID}, {"rows": [3, 20], "columns": [5, 25]}),
        Example({"surface": SOLID}, {"extent": [500_100, 4_000_100, 500_500, 4_000_500]}),
        Example({"surface": SOLID, "like": SOLID.window(slice(2, 9), slice(3, 8))}),
    ],
    "terrain.fill_voids": [
        Example({"surface": HOLEY}, {"method": "laplace"}),
        Example({"surface": HOLEY}, {"maximum_size": 5}),
    ],
    "terrain.gaussian_smooth": [
        Example({"surface": SOLID}, {"sigma": 45}),
        Example({"surface": HOLEY}, {"sigma": 70, "truncate": 3}),
        Example({"surface": PLAIN}, {"sigma": 0}),
    ],
    "terrain.hillshade": [
        Example({"surface": surface}, {"mode": mode, "cast_shadows": shadows, "altitude": 20})
        for surface in (SOLID, HOLEY)
        for mode in ("single", "multidirectional")
        for shadows in (False, True)
    ],
    "terrain.load_elevation": [
        Example({}, {"path": ASCII}),
        Example({}, {"path": ASCII, "extent": [0, 0, 400, 300], "crs": "EPSG:32616", "vertical_unit": "ft"}),
    ],
    "terrain.mask_image": [Example({"mask": MASK})],
    "terrain.mix": [Example({"first": SOLID, "second": HOLEY, "mask": MASK})],
    "terrain.remap": [
        Example({"surface": HOLEY}, {"from_minimum": 400, "from_maximum": 600, "to_minimum": 0, "to_maximum": 1}),
        Example({"surface": SOLID}, {"curve": [[0, 0], [0.3, 0.8], [1, 1]], "clamp": True}),
    ],
    "terrain.reproject": [
        Example({"surface": DEGREES}, {"cell_size": 60}),
        Example({"surface": SOLID}, {"cell_size": 45}),
    ],
    "terrain.resample": [
        Example({"surface": surface}, {"cell_size": size, "method": method})
        for surface, size, method in (
            (SOLID, 20, "bilinear"),
            (HOLEY, 50, "area"),
            (SOLID, 20, "cubic"),
            (HOLEY, 45, "lanczos"),
        )
    ],
    "terrain.sample_dem": [Example()],
    "terrain.save_elevation": [
        Example({"surface": HOLEY}, {"name": f"a/height{suffix}"})
        for suffix in (".tif", ".png", ".r16", ".r32", ".asc", ".npy", ".h5")
    ],
    "terrain.save_image": [Example({"image": picture()}, {"name": name}) for name in ("a.png", "a.tif")],
    "terrain.shade_image": [Example({"shade": SHADE})],
    "terrain.slope": [Example({"surface": SOLID}), Example({"surface": HOLEY}, {"z_factor": 2})],
    "terrain.statistics": [Example({"surface": HOLEY}, {"bins": 16})],
    "terrain.to_mask": [Example({"surface": HOLEY}, {"lower": 480, "upper": 520})],
}


@parametrize_with_checks("terrain", EXAMPLES)
def test_contract(check):
    check()
