"""Which surface lies where: classes from the colours of an image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph.errors import nearest
from nodegraph_terrain.raster import Elevation, Image, Labels, Mask, Raster, require_same_grid
from nodegraph_texture import classifiers
from nodegraph_texture.colour_table import (
    Colours,
    Flags,
    Floats,
    colour_codes,
    colour_table,
    hue_saturation_value,
    looked_up,
    used_pixels,
)
from nodegraph_texture.hue_saturation import GREY_HUE, GREY_THRESHOLD, Rectangle, greyed
from nodegraph_texture.surface_classes import SurfaceClasses, classes_of, colour_names

Numbers = npt.NDArray[np.int8]
Method = Literal["rectangles", "k_means", "gaussian_mixture", "som", "lvq"]

SAMPLES = 20_000
"""Cells that automatic methods learn from."""


class Classified(NamedTuple):
    """What `classify_surfaces` gives."""

    labels: Labels
    classes: SurfaceClasses


@node(version=1, locality=whole)
def classify_surfaces(
    image: Image,
    elevation: Elevation | None = None,
    near_infrared: Raster | None = None,
    shortwave: Raster | None = None,
    mask: Mask | None = None,
    *,
    method: Annotated[
        Method, Param("By rectangles in hue and saturation, or automatic; lvq learns from rectangles.")
    ] = "k_means",
    rectangles: Annotated[
        tuple[Rectangle, ...],
        Param("Surfaces by hue (deg), saturation and value (0 to 1); the first that fits counts."),
    ] = (),
    classes: Annotated[int, Param("How many, for automatic methods but lvq.", ge=2, le=32)] = 4,
    brightness: Annotated[
        float,
        Param("Weight of brightness beside hue and saturation; 0 ignores shading, and snow with it.", ge=0, le=10),
    ] = 1.0,
    grey_threshold: Annotated[float, GREY_THRESHOLD] = 8,
    grey_hue: Annotated[float, GREY_HUE] = 285,
    snow: Annotated[str, Param("Name of the class that clouds pass for; none: 'snow', else the whitest.")] = "",
    snow_altitude: Annotated[
        float | None, Param("Snow below is cloud, and left out; none: no such rule.", unit="m")
    ] = None,
    cloud_shortwave: Annotated[
        float | None, Param("Snow above this in shortwave infrared is cloud, and left out; none: no such rule.")
    ] = None,
    seed: Annotated[int, Param("Of automatic methods.", ge=0, lt=2**32)] = 0,
    context: Context,
) -> Classified:
    """Tell surfaces in an image apart.

    ``rectangles``: a person marks each surface in the plane of texture.hue_saturation_histogram, with a range of value
    where brightness matters.  What lies in none has no class.

    The automatic methods cluster features of colours: saturation times cosine and sine of hue, so that greys need no
    hue, and value, each group of unit variance; value counts `brightness` times.  Infrared bands are further
    features.  They learn from 20,000 cells drawn at random and sort classes from the most widespread:

    - ``k_means``: nearest of the centres that leave the least squared distance;
    - ``gaussian_mixture``: normal distributions with covariances of their own;
    - ``som``: a self-organising map, whose neurons join into classes;
    - ``lvq``: learning vector quantisation; what lies in rectangles is the training set, and every cell gets a class.

    Clouds pass for snow.  Snow lower than `snow_altitude`, or brighter in `shortwave` than `cloud_shortwave` (snow is
    dark there, clouds are not), is left out.

    Args:
        image: sRGB picture; transparent cells have no class.
        elevation: for `snow_altitude`; void cells of it have no class.
        near_infrared: a further feature, in any unit; void cells have no class.
        shortwave: likewise, and for `cloud_shortwave`.
        mask: cells to leave out where it is at least 1/2, such as cultivated land.
        method: how.
        rectangles: of ``rectangles`` and ``lvq``.
        classes: how many.
        brightness: weight of value among the features.
        grey_threshold: as of texture.hue_saturation_histogram, for rectangles.
        grey_hue: likewise.
        snow: which class the cloud rules apply to.
        snow_altitude: m.
        cloud_shortwave: in the unit of `shortwave`.
        seed: of the automatic methods.
        context: the engine's.

    Returns:
        ``labels``: the number of the class of each cell, -1 where there is none; ``classes``: names, mean colours and
        counts.  Automatic classes are called by their colours.

    Raises:
        ValueError: the grids differ; nothing is left to classify; there are fewer colours than classes; no rectangles,
            or none with cells; a rule lacks its raster; or all of it is cloud.

    Source: Dachsbacher, Bolch and Stamminger 2006, sections 5.2.1 and 6, https://inria.hal.science/inria-00606769.
    Methods: see `nodegraph_texture.classifiers`.
    """
    bands = [band for band in (near_infrared, shortwave) if band is not None]
    require_same_grid(image, *[grid for grid in (elevation, *bands, mask) if grid is not None])
    if _is_marked(method) and not rectangles:
        raise ValueError(f"method '{method}' needs rectangles; give some, or choose an automatic method")
    if snow_altitude is not None and elevation is None:
        raise ValueError("snow_altitude needs the elevation; link one, or leave the rule out")
    if cloud_shortwave is not None and shortwave is None:
        raise ValueError("cloud_shortwave needs shortwave; link the band, or leave the rule out")
    codes = colour_codes(image.data)
    used = _used(image, elevation, bands, mask)
    context.progress(0.1)
    cells = codes if used is None else codes[used]
    if not cells.size:
        raise ValueError("no cell is left to classify: all are transparent, void or masked out")
    # What depends on colour alone is found once for each colour.
    alone = method == "rectangles" or not bands
    table = colour_table(cells) if alone else Colours(cells.ravel(), np.ones(cells.size, np.int64))
    context.progress(0.3)
    names = tuple(dict.fromkeys(item.name for item in rectangles))
    marked = by_rectangles(table.rgb, rectangles, names, grey_threshold, grey_hue) if _is_marked(method) else None
    if marked is not None and marked.max() < 0:
        raise ValueError("no cell lies in any rectangle; look at the plot of texture.hue_saturation_histogram")
    count = classes if marked is None else len(names)
    if method == "rectangles" and marked is not None:
        found = marked
    else:
        values = [band.data.ravel() if used is None else band.data[used] for band in bands]
        found = _clustered(table, values, marked, method, count, brightness, seed, context)
    context.progress(0.7)
    tables = [_part(table, found == number, alone) for number in range(count)]
    if marked is None:
        order = np.array(sorted(range(count), key=lambda number: -int(tables[number].counts.sum())))
        found, tables = np.argsort(order).astype(np.int8)[found], [tables[number] for number in order]
        names = colour_names(classes_of(tuple(map(str, order)), tables).colours)
    if alone:
        labels = looked_up(codes, table, found)
        if used is not None:
            labels[~used] = -1
    else:
        labels = np.full(codes.shape, -1, np.int8)
        labels[np.ones(codes.shape, np.bool_) if used is None else used] = found
    surfaces = classes_of(names, tables)
    if snow_altitude is not None or cloud_shortwave is not None:
        white = _snow(surfaces, snow)
        cloud = np.zeros(codes.shape, np.bool_)
        if snow_altitude is not None and elevation is not None:
            cloud |= elevation.data < snow_altitude
        if cloud_shortwave is not None and shortwave is not None:
            cloud |= shortwave.data > cloud_shortwave
        labels[cloud & (labels == white)] = -1
        tables[white] = colour_table(codes[labels == white])
        surfaces = classes_of(names, tables)
        if not surfaces.counts.sum():
            raise ValueError("all of the image is cloud by the rules for snow; give another image, or loosen them")
    return Classified(Labels(labels, image.extent), surfaces)


@classify_surfaces.forecast
def _forecast(image: Forecast, *_: Forecast | None, **__: object) -> Forecast:
    return Forecast(image.bytes, 8 * image.bytes + (64 << 20), image.about)


def _used(image: Image, elevation: Elevation | None, bands: Sequence[Raster], mask: Mask | None) -> Flags | None:
    """Return which cells get a class; None: all."""
    used = used_pixels(image.data)
    for grid in (elevation, *bands):
        if grid is not None and not (known := np.isfinite(grid.data)).all():
            used = known if used is None else used & known
    if mask is not None:
        kept = ~(mask.data >= 0.5)
        used = kept if used is None else used & kept
    return used


def _is_marked(method: Method) -> bool:
    """Say whether a method takes its classes from rectangles."""
    return method in ("rectangles", "lvq")


def _part(table: Colours, own: Flags, distinct: bool) -> Colours:
    """Return some entries of a table, each colour once."""
    return Colours(table.codes[own], table.counts[own]) if distinct else colour_table(table.codes[own])


def by_rectangles(
    rgb: npt.NDArray[np.uint8], rectangles: Sequence[Rectangle], names: Sequence[str], threshold: float, grey_hue: float
) -> npt.NDArray[np.int8]:
    """Return the number of the name of the first rectangle that holds each colour, -1 for none."""
    planes = greyed(rgb, threshold, grey_hue)
    found = np.full(len(rgb), -1, np.int8)
    for item in reversed(rectangles):
        found[item.holds(*planes)] = names.index(item.name)
    return found


def colour_features(rgb: npt.NDArray[np.uint8]) -> Floats:
    """Return (n, 3): saturation times cosine and sine of hue, and value."""
    hue, saturation, value = hue_saturation_value(rgb)
    angle = np.radians(hue)
    return np.stack([saturation * np.cos(angle), saturation * np.sin(angle), value], axis=1)


def _clustered(
    table: Colours, bands: Sequence[Floats], trained: Numbers | None, method: Method, classes: int, brightness: float,
    seed: int, context: Context,
) -> Numbers:  # fmt: skip
    """Return the class of each entry of a table of colours, which counts as often as it occurs."""
    if len(table.codes) < classes and method != "lvq":
        raise ValueError(f"the image has {len(table.codes)} colours, fewer than {classes} classes; ask for fewer")
    features = np.concatenate([colour_features(table.rgb), *[band[:, None] for band in bands]], axis=1)
    weight = table.counts / table.counts.sum()
    mean = weight @ features
    variance = weight @ (features - mean) ** 2
    # Hue and saturation are one group of features.
    variance[:2] = variance[:2].sum()
    scale = np.where(variance > 0, 1 / np.sqrt(np.maximum(variance, 1e-12)), 0)
    scale[2] *= brightness
    features = ((features - mean) * scale).astype(np.float32)
    dice = np.random.default_rng(seed)
    if trained is None:
        places = dice.random(SAMPLES)
        samples = features[np.minimum(np.searchsorted(np.cumsum(weight), places), len(weight) - 1)]
        if len(np.unique(samples, axis=0)) < classes:
            raise ValueError(f"the image has too few different colours for {classes} classes; ask for fewer")
        context.progress(0.4)
        fit = {"k_means": classifiers.k_means, "gaussian_mixture": classifiers.gaussian_mixture, "som": classifiers.som}
        predict = fit[method](samples, classes, seed)
    else:
        known = np.flatnonzero(trained >= 0)
        chance = np.cumsum(table.counts[known]) / table.counts[known].sum()
        picked = known[np.minimum(np.searchsorted(chance, dice.random(SAMPLES)), len(known) - 1)]
        # Every class is there, however rare.
        picked = np.union1d(
            picked, [own[0] for own in (known[trained[known] == c] for c in range(classes)) if len(own)]
        )
        predict = classifiers.lvq(features[picked], trained[picked].astype(np.int32), classes, seed, context)
    context.progress(0.6)
    return predict(features).astype(np.int8)


def _snow(classes: SurfaceClasses, name: str) -> int:
    """Return the number of the class that clouds pass for."""
    if name or "snow" in classes.names:
        name = name or "snow"
        if name not in classes.names:
            raise ValueError(f"there is no class '{name}' to be snow; {nearest(name, classes.names)}")
        return classes.names.index(name)
    _, saturation, value = hue_saturation_value(np.rint(classes.colours * 255).astype(np.uint8))
    return int(np.argmax(np.where(classes.counts > 0, value * (1 - saturation), -1)))
