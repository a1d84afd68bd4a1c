"""A reproduction beside what it reproduces: pictures, confusion matrix and numbers."""

from __future__ import annotations

import json
import math
from pathlib import PurePosixPath
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, File, Forecast, OutputName, Param, node, whole
from nodegraph.errors import nearest
from nodegraph_terrain.raster import Extent, Grid, Image, Labels, require_same_grid
from nodegraph_texture.agreement import cohens_kappa, colour_errors, confusion_matrix, overall_agreement
from nodegraph_texture.coverage import Coverage, visible
from nodegraph_texture.surface_classes import SurfaceClasses

MATRIX_NUMBERS = 12
"""Classes up to which the matrix has its numbers written in."""


class Report(NamedTuple):
    """What `texture_report` gives."""

    file: File
    picture: Image
    agreement: float
    kappa: float
    colour_error: float


@node(version=1, locality=whole)
def texture_report(
    image: Image,
    reproduction: Image,
    labels: Labels,
    classes: SurfaceClasses,
    coverage: Coverage | None = None,
    *,
    name: Annotated[OutputName, Param("Picture to write, .png; the numbers go to <name>.json.")] = "report.png",
    title: Annotated[str, Param("Written above.")] = "",
    context: Context,
) -> Report:
    """Report how far a texture reproduces the image that its layers were estimated from.

    The reproduced class of a cell is the one whose layers, variants included, have the largest share of the picture
    (see ``visible`` of texture.coverage); without `coverage`, the one whose mean colour is nearest to the
    reproduction's.  Only cells with a label count: with labels of held-out ground the report is of that.  Finer
    textures are brought to the cells of the labels by means.

    - agreement: share of cells with the right class; the share of the most widespread class stands beside it;
    - Cohen's kappa: agreement beyond what chance would bring, 0 to 1 (Cohen 1960, doi:10.1177/001316446002000104);
    - found and right of each class: share of its cells that are found, and of those called so that are right;
    - colour error: root of the mean squared difference of red, green and blue, 0 to 1.

    Args:
        image: the input, on the grid of the labels.
        reproduction: of texture.apply_layers, over the same ground, as fine or finer.
        labels: of texture.classify_surfaces.
        classes: what they stand for.
        coverage: of texture.apply_layers.
        name: of the picture.
        title: above it.
        context: the engine's.

    Returns:
        ``file``: the picture with a JSON beside it; ``picture``; ``agreement``, ``kappa`` and ``colour_error``.

    Raises:
        ValueError: the grids do not cover the same ground, the texture is coarser than the labels, no layer has the
            name of a class, no labelled cell is in both pictures, or the name does not end in .png.
    """
    path = PurePosixPath(name)
    if path.suffix.lower() != ".png":
        raise ValueError(f"'{name}' must end in .png, the format of the report")
    require_same_grid(image, labels)
    count = len(classes.names)
    if labels.data.max() >= count:
        raise ValueError(
            f"the labels run to {labels.data.max()}, but there are {count} classes; link both from one node"
        )
    made = np.rint(_to_cells(reproduction, labels)).astype(np.uint8)
    context.progress(0.2)
    known = labels.data >= 0
    for pixels in (image.data, made):
        if pixels.shape[2] == 4:
            known &= pixels[..., 3] >= 128
    if not known.any():
        raise ValueError("no cell with a label is opaque in both pictures; give textures of the same ground")
    found = _by_colour(made, classes) if coverage is None else _by_coverage(coverage, labels, classes)
    truth, found = np.where(known, labels.data, -1), np.where(known, found, -1)
    context.progress(0.4)
    matrix = confusion_matrix(truth, found, count)
    errors = np.where(known, colour_errors(image.data, made), np.float32(np.nan))
    numbers = _numbers(matrix, classes, float(np.sqrt(np.nanmean(errors.astype(np.float64) ** 2))))
    picture = _drawn(image.data, made, truth, found, errors, matrix, classes, numbers, labels.extent, title)
    context.progress(0.9)
    from nodegraph_terrain.formats.png import png

    text = json.dumps(numbers, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    file = File.of(str(path), png(picture), File.of(str(path.with_suffix(".json")), text.encode()))
    box = Extent(0.0, 0.0, float(picture.shape[1]), float(picture.shape[0]))
    kappa = numbers["kappa"]
    return Report(
        file,
        Image(picture, box),
        numbers["agreement"],
        math.nan if kappa is None else kappa,
        numbers["colour_error"],
    )


@texture_report.forecast
def _forecast(image: Forecast, *inputs: Forecast | None, **_: object) -> Forecast:
    largest = max([image.bytes, *(item.bytes for item in inputs if item is not None)])
    return Forecast(16 << 20, 4 * largest + (96 << 20))


def _to_cells(grid: Grid, labels: Labels) -> npt.NDArray[np.float32]:
    """Return the means of a grid's values over the cells of the labels."""
    ours, theirs = labels.extent, grid.extent
    (rows, columns), (dx, dy) = labels.shape, labels.cell_size
    edges = (
        abs(ours.west - theirs.west) / dx, abs(ours.east - theirs.east) / dx,
        abs(ours.south - theirs.south) / dy, abs(ours.north - theirs.north) / dy,
    )  # fmt: skip
    if max(edges) >= 1 or (ours.crs and theirs.crs and ours.crs != theirs.crs):
        raise ValueError("the texture and the labels cover different ground or systems; texture the same elevation")
    if grid.shape[0] < rows or grid.shape[1] < columns:
        raise ValueError(f"the texture has {grid.shape} texels, fewer than the labels' {labels.shape}; make it finer")
    values = grid.data
    for axis, (new, old) in enumerate(zip((rows, columns), grid.shape, strict=True)):
        if new < old:
            starts = np.arange(new) * old // new
            sums = np.add.reduceat(values, starts, axis=axis, dtype=np.float32)
            widths = np.diff(np.append(starts, old)).astype(np.float32)
            values = sums / widths.reshape([-1 if other == axis else 1 for other in range(3)])
    return np.asarray(values, np.float32)


def _by_colour(pixels: npt.NDArray[np.uint8], classes: SurfaceClasses) -> npt.NDArray[np.int32]:
    """Return the class with cells whose mean colour is nearest."""
    present = np.flatnonzero(classes.counts > 0)
    best = np.full(pixels.shape[:2], np.inf, np.float32)
    found = np.full(pixels.shape[:2], -1, np.int32)
    for number in present:
        offset = pixels[..., :3] / np.float32(255) - classes.colours[number].astype(np.float32)
        distance = (offset * offset).sum(axis=-1)
        nearer = distance < best
        best[nearer], found[nearer] = distance[nearer], number
    return found


def _by_coverage(coverage: Coverage, labels: Labels, classes: SurfaceClasses) -> npt.NDArray[np.int32]:
    """Return the class whose layers together have the largest share of the picture."""
    of_layer = [_class_of(layer, classes.names) for layer in coverage.names]
    if not any(number >= 0 for number in of_layer):
        raise ValueError(
            f"no layer has the name of a class; {nearest(coverage.names[0], classes.names)} (a variant is called "
            "'class / 1')"
        )
    shares = _to_cells(coverage.like(visible(coverage.data)), labels)
    total = np.zeros((*labels.shape, len(classes.names)), np.float32)
    for layer, number in enumerate(of_layer):
        if number >= 0:
            total[..., number] += shares[..., layer]
    return np.asarray(np.argmax(total, axis=-1), np.int32)


def _class_of(layer: str, names: tuple[str, ...]) -> int:
    for name in (layer, layer.rsplit(" / ", 1)[0]):
        if name in names:
            return names.index(name)
    return -1


def _numbers(matrix: npt.NDArray[np.int64], classes: SurfaceClasses, colour_error: float) -> dict[str, Any]:
    """Return all that the JSON says; null where a number does not exist."""
    right, truth, called = np.diag(matrix), matrix.sum(axis=1), matrix.sum(axis=0)
    kappa = cohens_kappa(matrix)
    return {
        "cells": int(matrix.sum()),
        "agreement": overall_agreement(matrix),
        "most_widespread": float(truth.max() / matrix.sum()),
        "kappa": None if math.isnan(kappa) else kappa,
        "colour_error": colour_error,
        "classes": [
            {
                "name": name,
                "cells": int(truth[number]),
                "found": float(right[number] / truth[number]) if truth[number] else None,
                "right": float(right[number] / called[number]) if called[number] else None,
            }
            for number, name in enumerate(classes.names)
        ],
        "confusion": matrix.tolist(),
    }


def _drawn(
    image: npt.NDArray[np.uint8], made: npt.NDArray[np.uint8], truth: npt.NDArray[Any], found: npt.NDArray[Any],
    errors: npt.NDArray[np.float32], matrix: npt.NDArray[np.int64], classes: SurfaceClasses, numbers: dict[str, Any],
    extent: Extent, title: str,
) -> npt.NDArray[np.uint8]:  # fmt: skip
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows, columns = truth.shape
    tall = min(max(extent.height / extent.width, 0.4), 1.6)
    figure = Figure(figsize=(15, 8.6 * tall + 1.6), dpi=90, facecolor="white")
    figure.set_layout_engine("constrained", w_pad=0.12, h_pad=0.12)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    step = max(1, -(-max(rows, columns) // 900))
    table = np.concatenate([np.rint(classes.colours * 255), [[235, 235, 235]]]).astype(np.uint8)
    shown = {
        "image": image,
        "reproduction": made,
        "surfaces": table[truth],
        "reproduced surfaces": table[found],
    }
    for axis, (label, pixels) in zip((axes[0, 0], axes[0, 1], axes[1, 0], axes[1, 1]), shown.items(), strict=True):
        axis.imshow(pixels[::step, ::step], aspect=tall * columns / rows, interpolation="nearest")
        axis.set_title(label)
        axis.set_axis_off()
    limit = max(float(np.nanpercentile(errors, 99)), 1e-3)
    drawn = axes[0, 2].imshow(
        errors[::step, ::step], aspect=tall * columns / rows, cmap="magma", vmin=0, vmax=limit, interpolation="nearest"
    )
    axes[0, 2].set_axis_off()
    axes[0, 2].set_title(f"colour error, RMS {numbers['colour_error']:.3f}")
    figure.colorbar(drawn, ax=axes[0, 2], shrink=0.7)
    _draw_matrix(axes[1, 2], matrix, numbers)
    if title:
        figure.suptitle(title.replace("$", r"\$"), fontsize=16)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_matrix(axis: Any, matrix: npt.NDArray[np.int64], numbers: dict[str, Any]) -> None:
    """Draw the shares of each class that went where, with the shares found and right at the edges."""
    count = len(matrix)
    shares = matrix / np.maximum(matrix.sum(axis=1, keepdims=True), 1)
    axis.imshow(shares, cmap="Blues", vmin=0, vmax=1)
    if count <= MATRIX_NUMBERS:
        for row in range(count):
            for column in range(count):
                share = shares[row, column]
                colour = "white" if share > 0.6 else "#333333"
                axis.text(column, row, f"{100 * share:.0f}", ha="center", va="center", color=colour, fontsize=10)

    def percent(share: float | None) -> str:
        return "–" if share is None else f"{100 * share:.0f} %"

    names = [item["name"].replace("$", r"\$")[:18] for item in numbers["classes"]]
    items = list(zip(names, numbers["classes"], strict=True))
    axis.set_yticks(range(count), [f"{name}\n{percent(item['found'])} found" for name, item in items], fontsize=9)
    axis.set_xticks(
        range(count), [f"{name}\n{percent(item['right'])} right" for name, item in items], fontsize=9, rotation=30,
        ha="right", rotation_mode="anchor",
    )  # fmt: skip
    axis.set_xlabel("reproduced as")
    axis.tick_params(length=0)
    kappa = numbers["kappa"]
    axis.set_title(
        f"agreement {100 * numbers['agreement']:.1f} % (widest class {100 * numbers['most_widespread']:.1f} %), "
        f"κ {'–' if kappa is None else f'{kappa:.2f}'}",
        fontsize=11,
    )
