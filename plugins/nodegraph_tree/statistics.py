"""Numbers that describe a construction tree: what it holds, what it can be, and what a sample of it costs."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, codec, node
from nodegraph_tree.by_terrain import ByTerrain
from nodegraph_tree.device import NOTHING, TILE, Emitter, Fill, Frame, Kernel, Pending, Tile
from nodegraph_tree.evaluate import Edges
from nodegraph_tree.function import Box, ElevationFunction, depth, walk


class TreeStatistics(NamedTuple):
    """What `tree_statistics` gives."""

    primitives: int
    operators: int
    instances: int
    depth: int
    bytes: int
    low: float
    high: float
    slope: float
    weight: float
    calls_per_sample: float
    rejected: float
    kinds: str


class _Counter(Emitter):
    """Counts the primitives that a tile would evaluate."""

    def __init__(self, leaves: dict[int, int]) -> None:
        super().__init__()
        self.calls = 0
        self._leaves = leaves

    def add(
        self,
        kernel: Kernel,
        floats: Iterable[float] | Pending = (),  # noqa: ARG002
        ints: Iterable[int] = (),  # noqa: ARG002
        *,
        pushes: int = 1,
    ) -> None:
        self.calls += pushes > 0 and kernel.name != NOTHING.name

    def add_each(
        self,
        kernel: Kernel,  # noqa: ARG002
        fill: Fill,  # noqa: ARG002
        owners: Sequence[Any],
        frame: Frame,  # noqa: ARG002
        blocks: npt.NDArray[np.int32],  # noqa: ARG002
        then: Kernel,  # noqa: ARG002
    ) -> None:
        self.calls += len(owners)

    def from_host(self, node: ElevationFunction, frame: Frame) -> None:  # noqa: ARG002
        self.calls += self._leaves[id(node)]


@node(version=1)
def tree_statistics(
    function: ElevationFunction,
    *,
    extent: Annotated[
        Edges | None, Param("Where to count and bound (west, south, east, north); none: the support.", unit="m")
    ] = None,
    rows: Annotated[int, Param("Rows of the grid whose samples are counted.", ge=1, le=65536)] = 1024,
    columns: Annotated[int, Param("Columns of the grid whose samples are counted.", ge=1, le=65536)] = 1024,
    detail: Annotated[float, Param("Level of detail kappa; 1 is all of it.", ge=0, le=1)] = 1.0,
    context: Context,
) -> TreeStatistics:
    """Describe a construction tree: its size, its bounds, and how much of it a sample evaluates.

    Args:
        function: the tree.
        extent: of the grid; also the box of the bounds.
        rows: of the grid.
        columns: of the grid.
        detail: level of detail.
        context: the engine's.

    Returns:
        ``primitives`` and ``operators``: how many distinct ones; ``instances``: primitives counted as often as they are
        used; ``depth``: operators above the deepest primitive; ``bytes``: of the stored tree (JSON text and arrays);
        ``low``, ``high`` (m), ``slope`` (m/m) and ``weight``: bounds of f on the support, of |grad f| on the terrain
        and of alpha; infinite ones where the tree has none.  ``calls_per_sample``: primitives evaluated for a sample of
        the grid, on average, after each tile of 64 x 64 has dropped what does not reach it; ``rejected``: the share of
        `instances` dropped, 0 to 1; both 0 where neither an extent is given nor the support is finite.  ``kinds``: how
        many of each node, as text.

    Raises:
        ValueError: the extent is empty.

    Source: what table 1 of Génevaux et al. 2015 lists, doi:10.1111/cgf.12530.
    """
    nodes = list(walk(function))
    leaves = _expanded(nodes)
    encoded = codec.encode(function)
    size = len(json.dumps(encoded.structure, separators=(",", ":"))) + sum(array.nbytes for array in encoded.arrays)
    box = function.support if extent is None else Box(*map(float, extent))
    if extent is not None and (box.east <= box.west or box.north <= box.south):
        raise ValueError(f"the extent {extent} is empty; give west < east and south < north")
    bounds = function.bounds(box, detail)
    calls = _calls(function, box, (rows, columns), leaves, detail, context)
    total = leaves[id(function)]
    kinds = Counter(type(item).__name__ for item in nodes)
    primitives = sum(not item.parts for item in nodes)
    return TreeStatistics(
        primitives=primitives,
        operators=len(nodes) - primitives,
        instances=total,
        depth=depth(function),
        bytes=size,
        low=bounds.low,
        high=bounds.high,
        slope=bounds.slope,
        weight=bounds.weight_high,
        calls_per_sample=calls or 0.0,
        rejected=0.0 if calls is None or total == 0 else max(0.0, 1.0 - calls / total),
        kinds=", ".join(
            f"{count} {name}" for name, count in sorted(kinds.items(), key=lambda item: (-item[1], item[0]))
        ),
    )


def _expanded(nodes: list[ElevationFunction]) -> dict[int, int]:
    """Return for each node, parts before wholes, how many primitives an unpruned sample of it evaluates."""
    leaves: dict[int, int] = {}
    for item in nodes:
        times = (1, 5) if isinstance(item, ByTerrain) and item.by_slope else [1] * len(item.parts)
        counts = [count * leaves[id(part)] for count, part in zip(times, item.parts, strict=True)]
        leaves[id(item)] = sum(counts) if item.parts else 1
    return leaves


def _calls(
    root: ElevationFunction,
    box: Box,
    shape: tuple[int, int],
    leaves: dict[int, int],
    detail: float,
    context: Context,
) -> float | None:
    """Return the primitives evaluated for a sample, averaged over the tiles of a grid; None without a finite box."""
    if box.empty or not all(abs(edge) < 1e300 for edge in box):
        return None
    rows, cols = shape
    dx, dy = (box.east - box.west) / cols, (box.north - box.south) / rows
    counter, total = _Counter(leaves), 0
    for top in range(0, rows, TILE):
        context.progress(top / rows)
        for left in range(0, cols, TILE):
            high, wide = min(TILE, rows - top), min(TILE, cols - left)
            ox, oy = box.west + left * dx, box.north - top * dy
            counter.calls, counter.tile = 0, Tile(Frame(Box(ox, oy - high * dy, ox + wide * dx, oy), ox, oy), detail)
            root.emit(counter, counter.tile.frame)
            total += counter.calls * high * wide
    return total / (rows * cols)
