"""Surface layers from a classified image: when each surface appears."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.gradient import require_projected
from nodegraph_terrain.raster import Elevation, Labels, Raster, require_same_grid
from nodegraph_texture.constraint_fit import Fit, Fitted, Rule, best_order
from nodegraph_texture.constraints import SAMPLES, Sampled
from nodegraph_texture.layers import Colour, Roughness, SurfaceLayers
from nodegraph_texture.quantities import quantity_name
from nodegraph_texture.spline_slope import spline_slope
from nodegraph_texture.surface_classes import SHADES, SurfaceClasses

CELLS = 1 << 16
"""Cells, drawn at random, that biases, orders and additive functions are fitted to."""

WIDESPREAD = 0.05
"""Share of the cells from which a class has variants."""


EXTREMES = (0.5, 99.5)
"""Percentiles of a quantity between which its bins lie."""


class Estimated(NamedTuple):
    """What `estimate_layers` gives."""

    layers: SurfaceLayers
    agreement: float
    unreached: int


@node(version=1, locality=whole)
def estimate_layers(
    labels: Labels,
    classes: SurfaceClasses,
    elevation: Elevation,
    *quantities: Raster,
    rule: Annotated[Rule, Param("How functions follow from counts; additive agrees best.")] = "additive",
    without: Annotated[
        tuple[Literal["altitude", "slope"], ...], Param("What of the ground layers shall not depend on.")
    ] = (),
    samples: Annotated[int, Param("Samples of each function.", ge=2, le=4096)] = SAMPLES,
    smoothing: Annotated[float, Param("Gaussian that smooths counts, as a share of the range.", ge=0, le=0.5)] = 1 / 64,
    order: Annotated[
        Literal["search", "size"], Param("Of siblings: the one that agrees best, or from the most widespread.")
    ] = "search",
    sharpness: Annotated[
        float, Param("Power of the functions: above 1 surfaces blend less where either may be.", gt=0, le=16)
    ] = 1.0,
    noise: Annotated[float, Param("Share of the coverage that varies with noise.", ge=0, le=1)] = 0.25,
    variants: Annotated[int, Param("Children of each widespread surface in colours of its own.", ge=0, le=8)] = 2,
    wavelength: Annotated[float | None, Param("Of the noise; none: of eight cells.", gt=0, unit="m")] = None,
    seed: Annotated[int, Param("Of noise, variants and the cells that are drawn.", ge=0, lt=2**32)] = 0,  # noqa: ARG001
    context: Context,
) -> Estimated:
    """Learn when each surface appears, from where it lies.

    The most widespread class becomes the root, each further one a layer on it with its mean colour, whose constraints
    are functions of altitude, slope (that of texture.apply_layers at this resolution) and all quantities linked, from
    `samples` bins.  These lie between the percentiles 0.5 and 99.5; what lies beyond, here or on other ground, counts
    as the end, which so does not hang on a few extreme cells; texture.apply_layers warns where much does.

    - ``printed``: the histogram of the class, scaled and clamped to mean 1/2, as in the paper.  Where no more than half
      of the bins are filled that cannot be; the function is 1 where the class occurs, and `unreached` counts it.
    - ``conditional``: P(class | quantity), counts of the class over the terrain's own, relative to the maximum.
    - ``additive``: the product of all functions is proportional to the odds of the class by a logistic additive
      model, so that quantities which say the same are not counted twice.

    With the latter two, C of each layer estimates the probability of its class among the cells of no *later* sibling,
    since these hide it: then the shares of the picture are the posterior.  Bias b makes the mean coverage there the
    share of the class.  ``search`` swaps neighbouring siblings as long as that makes more cells agree.

    Variants are children without constraints of their own, of classes with 5 % of the cells or more: patches of noise
    in shades from within the class, darker and brighter ones evenly.

    Args:
        labels: numbers of classes, negative none.
        classes: what they stand for.
        elevation: in metres, on the grid of the labels.
        quantities: on the same grid.
        rule: how functions follow from counts.
        without: leave altitude out for layers that are to paint ground of other heights, and link the temperature.
        samples: of each function.
        smoothing: standard deviation, as a share of the range; ``printed`` takes counts as they are.
        order: of siblings.
        sharpness: 1 blends surfaces by their probabilities, which errs least in colour but looks like haze where the
            quantities tell little; 2 to 4 looks more like ground.
        noise: s_S / b_S of each layer.
        variants: how many.
        wavelength: m.
        seed: of all that is random.
        context: the engine's.

    Returns:
        ``layers``: the root; ``agreement``: share of the fitted cells whose class has the largest share of the
        picture, without noise; ``unreached``: functions of the printed rule whose mean stays below 1/2.

    Raises:
        ValueError: the grids differ or are in degrees; fewer than two classes have cells; labels have no name; two
            quantities have one name, or none is left; or a quantity is void where labels are, or infinite.

    Source: Dachsbacher, Bolch and Stamminger 2006, sections 5.2.2 and 5.2.3, https://inria.hal.science/inria-00606769;
    additive: see `nodegraph_texture.constraint_fit`.
    """
    require_projected(elevation)
    require_same_grid(labels, elevation, *quantities)
    count = len(classes.names)
    if labels.data.max() >= count:
        raise ValueError(
            f"the labels run to {labels.data.max()}, but there are {count} classes; link both from one node"
        )
    values = _values(elevation, quantities, without, context)
    known = labels.data >= 0
    for data in values.values():
        known &= ~np.isnan(data)
    if not known.any():
        raise ValueError(_too_few(labels, classes, ()))
    ranges = {name: _range(name, data, known) for name, data in values.items()}
    counts, fit_labels, bins = _counted(labels.data, values, ranges, known, count, samples, context)
    sizes = counts[:, 0].sum(axis=1)
    present = np.flatnonzero(sizes)
    if len(present) < 2:
        raise ValueError(_too_few(labels, classes, present.tolist()))
    fit = Fit(counts, fit_labels, bins, rule, smoothing * samples, sharpness)
    context.progress(0.5)
    root, *siblings = (int(number) for number in present[np.argsort(-sizes[present], kind="stable")])
    if order == "search":
        siblings, agreement = best_order(fit, root, siblings, context)
    else:
        agreement = fit.agreement(siblings, root)
    wave = wavelength if wavelength is not None else 8 * sum(elevation.cell_size) / 2
    dice = context.rng
    widespread = sizes >= WIDESPREAD * sizes.sum()

    def variants_of(number: int) -> tuple[SurfaceLayers, ...]:
        return _variants(classes, number, variants if widespread[number] else 0, wave, dice)

    children, unreached = [], 0
    for place, number in enumerate(siblings):
        fitted, _ = fit.layer(number, frozenset(siblings[place + 1 :]))
        unreached += fitted.reached.count(False)
        children.append(
            SurfaceLayers(
                classes.names[number],
                _colour(classes.colours[number]),
                _constraints(fitted, ranges, samples),
                noise=Roughness("fbm", wave, 6, 0.5, _seed(dice)),
                scale=noise * fitted.bias,
                bias=fitted.bias,
                children=variants_of(number),
            )
        )
    if unreached:
        context.log.warning(
            "%d functions of the printed rule stay below a mean of 1/2: too few bins are filled", unreached
        )
    base = SurfaceLayers(classes.names[root], _colour(classes.colours[root]), children=(*variants_of(root), *children))
    return Estimated(base, agreement, unreached)


@estimate_layers.forecast
def _forecast(labels: Forecast, *_: Forecast, **__: object) -> Forecast:
    return Forecast(1 << 16, 6 * labels.bytes + (128 << 20))


def _values(
    elevation: Elevation, quantities: tuple[Raster, ...], without: tuple[str, ...], context: Context
) -> dict[str, npt.NDArray[Any]]:
    """Return all quantities by name."""
    found: dict[str, npt.NDArray[Any]] = {}
    if "altitude" not in without:
        found["altitude"] = elevation.data
    if "slope" not in without:
        found["slope"] = spline_slope(elevation, context, stop=0.3)
    for raster in quantities:
        name = quantity_name(raster)
        if name in found:
            raise ValueError(f"two rasters are called '{name}'; link one, or give the other a name of its own")
        found[name] = raster.data
    if not found:
        raise ValueError("there is nothing for layers to depend on; link quantities, or keep altitude or slope")
    return found


def _range(name: str, data: npt.NDArray[Any], known: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Return the values between which the bins lie: all but the extremes, by at least `CELLS` cells."""
    seen = data.ravel() if known.all() else data[known]
    if not np.isfinite(seen).all():
        raise ValueError(f"{name} holds infinite values where there are labels; make them voids (NaN)")
    low, high = (float(end) for end in np.percentile(seen[:: max(1, len(seen) // CELLS)], EXTREMES))
    return (low, high) if low < high else (float(seen.min()), float(seen.max()) + 1.0)


def _counted(
    labels: npt.NDArray[np.int32], values: dict[str, npt.NDArray[Any]], ranges: dict[str, tuple[float, float]],
    known: npt.NDArray[np.bool_], classes: int, samples: int, context: Context,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[Any], npt.NDArray[np.int16]]:  # fmt: skip
    """Return cells by class, quantity and bin; and labels and bins of some cells drawn at random."""
    counts = np.zeros((classes, len(values), samples), np.int64)
    total = int(known.sum())
    drawn = np.sort(context.rng.choice(total, CELLS, replace=False, shuffle=False)) if total > CELLS else None
    kept_labels, kept_bins, passed = [], [], 0
    for part in row_blocks(len(labels), labels.shape[1], context, start=0.3, stop=0.5):
        own = known[part]
        whole_block = bool(own.all())
        numbers = labels[part].ravel() if whole_block else labels[part][own]
        some: slice | npt.NDArray[np.intp] = slice(None)
        if drawn is not None:
            first, last = np.searchsorted(drawn, (passed, passed + numbers.size))
            some = drawn[first:last] - passed
        passed += numbers.size
        kept_labels.append(numbers[some])
        # `bincount` takes whole numbers of this size as they are.
        offset = numbers * np.intp(samples)
        bins = []
        for row, (name, data) in enumerate(values.items()):
            low, high = ranges[name]
            block = data[part].ravel() if whole_block else data[part][own]
            place = (block - np.float32(low)) * np.float32(samples / (high - low))
            np.clip(place, 0, samples - 1, out=place)
            numbered = place.astype(np.intp)
            bins.append(numbered[some].astype(np.int16))
            numbered += offset
            counts[:, row] += np.bincount(numbered, minlength=classes * samples).reshape(classes, samples)
        kept_bins.append(np.stack(bins))
    return counts, np.concatenate(kept_labels), np.concatenate(kept_bins, axis=1)


def _constraints(fitted: Fitted, ranges: dict[str, tuple[float, float]], samples: int) -> tuple[Sampled, ...]:
    """Return functions with a sample in the middle of each bin."""
    found = []
    for function, (name, (low, high)) in zip(fitted.functions, ranges.items(), strict=True):
        half = (high - low) / samples / 2
        found.append(Sampled(name, low + half, high - half, function.astype(np.float32)))
    return tuple(found)


def _variants(
    classes: SurfaceClasses, number: int, count: int, wavelength: float, dice: np.random.Generator
) -> tuple[SurfaceLayers, ...]:
    """Return layers of one class in its own shades: one from each of `count` equal ranges of brightness."""
    shades = classes.shades[number]
    found = []
    for part in dice.permutation(count):
        shade = shades[
            int(dice.integers(part * SHADES // count, max(part * SHADES // count + 1, (part + 1) * SHADES // count)))
        ]
        own = Roughness("fbm", wavelength * float(2 ** dice.uniform(-1.5, 0.5)), 6, 0.55, _seed(dice))
        found.append((_colour(shade), own, float(dice.uniform(1.5, 2.5)), float(dice.uniform(0.1, 0.4))))
    return tuple(
        SurfaceLayers(f"{classes.names[number]} / {place + 1}", colour, noise=own, scale=scale, bias=bias)
        for place, (colour, own, scale, bias) in enumerate(found)
    )


def _colour(values: npt.NDArray[Any]) -> Colour:
    red, green, blue = (round(float(value), 4) for value in values)
    return red, green, blue


def _seed(dice: np.random.Generator) -> int:
    return int(dice.integers(1 << 31))


def _too_few(labels: Labels, classes: SurfaceClasses, present: Sequence[int]) -> str:
    if not present:
        if (labels.data < 0).all():
            return "the labels hold no class at all; give some from texture.classify_surfaces"
        return "no cell has a class, a height and a value of each quantity; link rasters of the same ground"
    return (
        f"only one class ('{classes.names[present[0]]}') has cells where all quantities are known; two at least make "
        "layers"
    )
