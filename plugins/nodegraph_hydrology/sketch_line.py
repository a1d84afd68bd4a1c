"""Lines to grow rivers from: given by their points, or found in a drawn mask."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node
from nodegraph_hydrology.thinning import skeleton, traced
from nodegraph_terrain.polylines import Polylines
from nodegraph_terrain.raster import Mask

Point = tuple[float, float]


@node(version=1)
def sketch_line(
    *,
    points: Annotated[
        tuple[Point, ...] | tuple[tuple[Point, ...], ...],
        Param("Points (x, y) of a line from the estuary upwards, or a list of such lines.", min_length=1, unit="m"),
    ],
    crs: Annotated[str, Param("Coordinate system of the points, empty if none.")] = "",
) -> Polylines:
    """Draw one line or several where rivers should run.

    The first point of a line is its estuary, the last its source.  Lines from files come through
    `terrain.load_polylines`, from a drawn picture through `lines_from_mask`.

    Args:
        points: of one line, ``[[0, 0], [100, 50]]``, or of several, ``[[[0, 0], [100, 50]], [[300, 0], [280, 90]]]``.
        crs: kept with the lines.

    Raises:
        ValueError: a line with fewer than two different points, or a point that is not finite.

    Source: Zhang et al. 2016, section IV.C, doi:10.1109/ACCESS.2016.2612700.
    """
    lines = points if isinstance(points[0][0], (tuple, list)) else (points,)
    arrays = []
    for number, line in enumerate(lines):
        array = np.array(line, np.float64)
        if array.ndim != 2 or array.shape[1] != 2 or len(np.unique(array, axis=0)) < 2:
            raise ValueError(
                f"line {number} has fewer than two different points; a river needs an estuary and a source"
            )
        arrays.append(array)
    return Polylines.of(arrays, crs=crs)


@node(version=1)
def lines_from_mask(
    mask: Mask,
    *,
    threshold: Annotated[float, Param("Least value that belongs to a line.", gt=0, le=1)] = 0.5,
    shortest: Annotated[float, Param("Lines and side branches shorter than this are left out.", ge=0, unit="m")] = 0.0,
    tolerance: Annotated[float, Param("How far a line may leave the middle of cells, in cells.", ge=0, le=10)] = 1.5,
    context: Context,
) -> Polylines:
    """Find the lines that are drawn in a mask.

    Strokes are thinned to their middle (Zhang and Suen 1984), the skeleton is traced from ends and junctions, side
    branches shorter than `shortest` are cut, and the lines simplified (Douglas and Peucker).  At a junction the two
    lines that go on most straight are joined, the others end one cell before it.  A closed stroke becomes a closed
    line.  A line begins at its end that is nearer to the border of the mask, as estuaries do.

    Args:
        mask: strokes; void counts as empty.
        threshold: of the mask.
        shortest: of the lines.
        tolerance: of the simplification.
        context: the engine's.

    Raises:
        ValueError: a mask in degrees, or without any stroke long enough.

    Takes time in proportion to the cells times half the width of the widest stroke.

    Source: T. Y. Zhang, C. Y. Suen (1984): A fast parallel algorithm for thinning digital patterns.
    doi:10.1145/357994.358023.
    """
    import shapely

    if mask.extent.unit != "m":
        raise ValueError("the mask is in degrees; link it through terrain.reproject to get metres")
    strokes = np.nan_to_num(mask.data) >= threshold
    thin = skeleton(strokes, context.progress)
    rows, columns = mask.shape
    dx, dy = mask.cell_size
    found = []
    for path in traced(thin, shortest / min(dx, dy)):
        lines = shapely.simplify(shapely.LineString(path[:, ::-1]), tolerance)
        cells = shapely.get_coordinates(lines)
        # From the end that is nearer to the border.
        inset = np.minimum(np.minimum(cells, [columns - 1, rows - 1] - cells).min(axis=1), 1e9)
        cells = cells if inset[0] <= inset[-1] else cells[::-1]
        line = np.stack([mask.extent.west + (cells[:, 0] + 0.5) * dx, mask.extent.north - (cells[:, 1] + 0.5) * dy], 1)
        if _length(line) >= max(shortest, 1e-9):
            found.append(line)
    if not found:
        raise ValueError("the mask holds no stroke that is long enough; draw lines with values of threshold or more")
    return Polylines.of(found, crs=mask.extent.crs)


def _length(line: npt.NDArray[np.float64]) -> float:
    return float(np.hypot(*np.diff(line, axis=0).T).sum())
