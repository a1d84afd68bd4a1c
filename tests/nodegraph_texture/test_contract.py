"""Every node of texture keeps the contract; a node without an example here fails."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nodegraph import Context
from nodegraph.testing import Example, parametrize_with_checks
from nodegraph_terrain.raster import Elevation, Extent, Image, Labels, Mask, Raster
from nodegraph_texture.apply_layers import apply_layers
from nodegraph_texture.atlas import texture_atlas
from nodegraph_texture.classify_surfaces import classify_surfaces
from nodegraph_texture.coverage import Coverage
from nodegraph_texture.layer import layer
from nodegraph_texture.quantities import Precipitation, Radiation, Temperature
from nodegraph_texture.texture_tiles import texture_tiles
from nodegraph_tree.from_elevation import from_elevation

STATIONS = [[20, 20, 110, 8.0], [400, 300, 400, 5.5], [260, 90, 250, 7.1], [90, 310, 300, 6.2]]
TABLE = str(Path(__file__).with_name("stations.csv"))

EXTENT = Extent(0.0, 0.0, 480.0, 360.0)
RNG = np.random.default_rng(5)
ROWS, COLS = np.indices((18, 24))
HILLS = 300 + 120 * np.sin(ROWS / 4) * np.cos(COLS / 5) + 8 * RNG.random((18, 24))
HILLS[4:6, 7:10] = np.nan
GROUND = Elevation(HILLS.astype(np.float32), EXTENT)
ZONES = Labels(np.where(COLS < 12, 0, np.where(ROWS > 14, -1, 1)).astype(np.int32), EXTENT)
ONE_ZONE = Labels(np.where(ROWS > 14, -1, 3).astype(np.int32), EXTENT)
AREA = Raster((400 + 1e5 * RNG.random((18, 24)) ** 4).astype(np.float32), EXTENT)
WARMTH = Temperature((8 - 6 * ROWS / 17).astype(np.float32), EXTENT)
RAIN = Precipitation((900 + 40 * COLS).astype(np.float32), EXTENT)
SUN = Radiation((120 + 8 * COLS).astype(np.float32), EXTENT)
SNOW = layer(name="snow", colour="#ffffff", altitude=(300, 380, None, None), slope=(None, None, 30, 45),
             noise_scale=1.0, constraints={"temperature": (None, None, 6.0, 8.0)}, roughness=-2.0)  # fmt: skip
ROCK = layer(SNOW, name="rock", colour="#706050", roughness=9.0, relief_wavelength=80, variation=0.4)
SPLAT = apply_layers(ROCK, GROUND, None, WARMTH, factor=1).coverage
LAYERS = str(Path(__file__).with_name("rock_and_snow.json"))
PIXELS = np.dstack([60 + 7 * COLS, 200 - 9 * ROWS, 90 + 0 * ROWS, np.where(ROWS < 2, 0, 255)]).astype(np.uint8)
PICTURE = Image(PIXELS, EXTENT)
BAND = Raster((ROWS * 2.0 + RNG.random((18, 24))).astype(np.float32), EXTENT)
FIELDS = Mask((COLS > 20).astype(np.float32), EXTENT)
WARM_AND_COLD = [
    {"name": "warm", "hue": [330, 90], "saturation": [0.1, 1]},
    {"name": "snow", "hue": [90, 330], "value": [0.1, 1]},
]
SURFACES = classify_surfaces(PICTURE, classes=3)
COVERED = Coverage(
    np.stack([np.ones((18, 24)), COLS / 24, ROWS / 18], axis=-1).astype(np.float32),
    EXTENT, SURFACES.classes.names, ((0.2, 0.4, 0.6),) * 3,
)  # fmt: skip
PLACED = Elevation(GROUND.data, Extent(0.0, 0.0, 480.0, 360.0, "EPSG:32633"))
PICTURE_FILE = str(Path(__file__).with_name("picture.tif"))

TILES = texture_tiles(ROCK, GROUND, None, WARMTH, cell_size=2.5, tile_size=32, context=Context())
PLACED_TILES = texture_tiles(ROCK, PLACED, None, WARMTH, cell_size=10, tile_size=32, context=Context())
SEEN = {"eye": [240, -150, 560], "target": [240, 180, 320], "width": 160, "height": 90}
ATLAS = texture_atlas(TILES, **SEEN, context=Context())


def cases(*params: dict[str, Any], **inputs: Any) -> list[Example]:
    return [Example(inputs, item) for item in params]


EXAMPLES: dict[str, list[Example]] = {
    "texture.apply_layers": [
        *cases({}, {"factor": 1}, {"cell_size": 7.5}, layers=ROCK, surface=GROUND, quantities=[WARMTH, RAIN]),
        *cases(
            {"cell_size": 9, "extent": [40, 30, 400, 300], "crs": "EPSG:32632"},
            {"cell_size": 12, "extent": [40, 30, 412, 306]},
            layers=ROCK,
            function=from_elevation(GROUND),
            quantities=[WARMTH],
        ),
    ],
    "texture.coverage": cases({"name": "snow"}, {"name": "rock", "amount": "visible"}, layers=SPLAT),
    "texture.draw_quantities": [
        *cases(
            {"width": 200}, {"width": 160, "title": "Climate", "columns": 1}, surface=GROUND, quantities=[WARMTH, RAIN]
        ),
        *cases({"width": 160}, surface=GROUND, quantities=[GROUND, BAND, FIELDS]),
    ],
    "texture.draw_layers": cases({"width": 500}, {"width": 400, "title": "Rock and snow"}, layers=ROCK),
    "texture.layer": [
        *cases({"name": "base", "colour": "#706050"}, children=[SNOW]),
        *cases(
            {
                "name": "grass",
                "colour": "green",
                "altitude": [None, None, 500, 600],
                "slope": [0, 0, 20, 30],
                "constraints": {"wetness": [3, 4, 8, 9], "irradiation": [0, 9, [0.5, 1, 0.2]]},
                "noise_scale": 2,
                "noise_bias": 0.5,
                "noise_kind": "ridged",
                "noise_wavelength": 90,
                "noise_octaves": 4,
                "roughness": 1,
                "relief_kind": "billow",
                "relief_wavelength": 9,
                "relief_octaves": 3,
                "variation": 0.5,
                "variation_wavelength": 30,
                "variation_octaves": 2,
                "seed": 4,
            }
        ),
    ],
    "texture.load_layers": cases({"path": LAYERS}),
    "texture.quantity": cases({"name": "fields"}, raster=AREA),
    "texture.save_layers": cases({"name": "layers.json"}, layers=ROCK),
    "texture.save_splat": cases({"name": "splat.png"}, layers=SPLAT),
    "texture.classify_surfaces": [
        *cases(
            {},
            {"method": "gaussian_mixture", "classes": 2, "seed": 3, "brightness": 0.5},
            {"method": "som", "classes": 3},
            {"method": "lvq", "rectangles": WARM_AND_COLD, "grey_threshold": 20, "grey_hue": 100},
            image=PICTURE,
        ),
        *cases(
            {"method": "rectangles", "rectangles": WARM_AND_COLD, "snow": "snow", "snow_altitude": 300},
            {"cloud_shortwave": 20, "snow_altitude": 250},
            image=PICTURE,
            elevation=GROUND,
            near_infrared=BAND,
            shortwave=BAND,
            mask=FIELDS,
        ),
    ],
    "texture.estimate_layers": [
        *cases(
            {},
            {"rule": "printed", "samples": 64, "order": "size", "noise": 0, "variants": 0},
            {
                "rule": "conditional",
                "smoothing": 0,
                "wavelength": 50,
                "seed": 4,
                "sharpness": 2,
                "without": ["altitude"],
            },
            labels=SURFACES.labels,
            classes=SURFACES.classes,
            elevation=GROUND,
        ),
        *cases({}, labels=SURFACES.labels, classes=SURFACES.classes, elevation=GROUND, quantities=[WARMTH, RAIN]),
    ],
    "texture.hue_saturation_histogram": cases(
        {}, {"bins": 32, "grey_threshold": 30, "grey_hue": 300, "rectangles": WARM_AND_COLD}, image=PICTURE
    ),
    "texture.load_band": cases(
        {"path": PICTURE_FILE, "name": "near_infrared"},
        {"path": PICTURE_FILE, "name": "red", "band": 2, "resampling": "nearest", "extent": [0, 0, 500, 400]},
        grid=PLACED,
    ),
    "texture.load_image": cases(
        {"path": PICTURE_FILE},
        {"path": PICTURE_FILE, "bands": [3, 2, 1], "resampling": "cubic", "range": [10, 200], "crs": "EPSG:32633"},
        {"path": PICTURE_FILE, "bands": [1], "resampling": "average", "extent": [0, 0, 500, 400]},
        grid=PLACED,
    ),
    "texture.texture_report": [
        *cases(
            {"name": "r.png", "title": "Hills"},
            {},
            image=PICTURE,
            reproduction=PICTURE,
            labels=SURFACES.labels,
            classes=SURFACES.classes,
        ),
        *cases(
            {}, image=PICTURE, reproduction=PICTURE, labels=SURFACES.labels, classes=SURFACES.classes, coverage=COVERED
        ),
    ],
    "texture.precipitation": [
        *cases(
            {},
            {"base": 500, "altitude_gradient": 80, "east_gradient": 30, "north_gradient": -20},
            {"method": "upslope", "wind_direction": 225, "smoothing": 0},
            {"method": "linear", "wind_speed": 15, "rain_hours": 300, "air_temperature": 12, "air_lapse_rate": 4.5},
            {"stations": STATIONS, "trend": "altitude_and_place", "residuals": False},
            surface=GROUND,
        ),
        *cases({"stations": STATIONS, "transition": 60}, surface=GROUND, zones=ONE_ZONE),
    ],
    "texture.snow_cover": [
        *cases(
            {"latitude": 46},
            {"amplitude": 12, "warmest_day": 200, "day": 60, "sliding": False},
            {"latitude": -40, "yearly_precipitation": 2500, "degree_day_factor": 3, "variability": 2},
            surface=GROUND,
        ),
        *cases({"latitude": 46, "day": 100}, surface=GROUND, temperature=WARMTH, precipitation=RAIN, radiation=SUN),
    ],
    "texture.solar_radiation": cases(
        {"latitude": 46},
        {"latitude": -46, "first_day": 355, "last_day": 20, "step": 10, "cast_shadows": False},
        {"latitude": 70, "first_day": 80, "last_day": 80, "transmittance": 1, "directions": 16, "diffuse_share": 0.2},
        surface=GROUND,
    ),
    "texture.temperature": [
        *cases(
            {},
            {"lapse_rate": 5, "sea_level": None, "day": 15, "latitude": -30},
            {"sea_level": 20, "day": 15, "amplitude": 8, "warmest_day": 210},
            {"stations": STATIONS},
            {"table": TABLE, "residuals": False},
            surface=GROUND,
        ),
        *cases({"stations": STATIONS, "transition": 40}, surface=GROUND, zones=ZONES),
    ],
    "texture.save_atlas": cases({"name": "page.png"}, {"name": "a/b.png"}, image=ATLAS.image, table=ATLAS.table),
    "texture.save_tiles": [
        *cases(
            {"levels": [0, 1]},
            {
                "scheme": "tms",
                "format": "jpg",
                "quality": 60,
                "background": "teal",
                "name": "a",
                "address": "https://b/",
            },
            {"content": "heights", "format": "webp", "levels": [1, 1]},
            tiles=TILES,
        ),
        *cases({}, {"grid": "local", "content": "normals"}, tiles=PLACED_TILES),
    ],
    "texture.texture_atlas": cases(
        SEEN,
        {**SEEN, "field_of_view": 70, "budget": 0.02, "content": "normals"},
        {**SEEN, "eye": [240, 180, 900], "target": [240, 181, 300], "width": 90, "height": 160, "content": "heights"},
        tiles=TILES,
    ),
    "texture.texture_tiles": [
        *cases(
            {},
            {"factor": 2, "tile_size": 16, "border": 3, "levels": 3},
            {"cell_size": 7.5},
            layers=ROCK,
            surface=GROUND,
            quantities=[WARMTH, RAIN],
        ),
        *cases(
            {"cell_size": 9, "extent": [40, 30, 400, 300], "crs": "EPSG:32632"},
            {"extent": [40, 30, 412, 306]},
            layers=ROCK,
            function=from_elevation(GROUND),
            quantities=[WARMTH],
        ),
    ],
    "texture.tile_statistics": cases(
        {"views": [[[240, -150, 560], [240, 180, 320]], [[260, -150, 560], [260, 180, 320]]]},
        {
            "views": [[[240, -150, 560], [240, 180, 320]]],
            "width": 90,
            "height": 60,
            "field_of_view": 80,
            "budget": 0.1,
        },
        tiles=TILES,
    ),
    "texture.wetness": cases({}, {"least_slope": 0.05}, surface=GROUND, area=AREA),
}


@parametrize_with_checks("texture", EXAMPLES)
def test_contract(check):
    check()
