"""`evaluate` on OpenCL: the same windows, in strips of rows.

Layers, constraints and noises are records in one buffer, so that editing them compiles nothing.  Texels are numbered
from the corner of the scene here, too: tiles of 64 x 64 carry the origins of the noises, in float64 until they reach
the device, and a window equals that part of any larger one bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

import nodegraph_terrain
from nodegraph import Context
from nodegraph_terrain.blocks import GROUP, padded
from nodegraph_texture.constraints import Constraint, Hat, Sampled
from nodegraph_texture.detail import Detail
from nodegraph_texture.evaluate import Texture
from nodegraph_texture.sampling import Level, Pyramid, Texels
from nodegraph_texture.scene import Noises, Scene

if TYPE_CHECKING:
    from nodegraph.opencl import Device

KERNELS = Path(__file__).parent / "kernels" / "layers.cl"
INCLUDE = (Path(nodegraph_terrain.__file__).parent,)

STRIP = 1 << 20
"""Texels of a strip, so that temporaries stay small and a cancel takes effect."""

TILE = 64
"""Side of a tile in texels, as the kernel has it."""

STEEP = 1e37
"""Rate of a ramp of no width."""

PAINTED = ("ground", "east", "north", "quantities", "rise", "risen", "colour", "covers")
"""Planes that painting reads and writes, in the order of the kernel's arguments."""

_LAYER = np.dtype(
    [
        ("parent", "i4"), ("first", "i4"), ("count", "i4"), ("noise", "i4", 3),
        ("bias", "f4"), ("scale", "f4"), ("roughness", "f4"), ("variation", "f4"), ("colour", "f4", 3),
        ("unused", "i4", 3),
    ]
)  # fmt: skip
_CONSTRAINT = np.dtype(
    [
        ("quantity", "i4"), ("sampled", "i4"), ("first", "i4"), ("count", "i4"),
        ("rise", "f4"), ("rise_rate", "f4"), ("rise_start", "f4"),
        ("fall", "f4"), ("fall_rate", "f4"), ("fall_start", "f4"), ("low", "f4"), ("rate", "f4"),
    ]
)  # fmt: skip
_DETAIL = np.dtype(
    [("table", "i4"), ("lattice", "i4"), ("kappa", "f4"), ("factor", "f4"), ("offset", "f4"), ("unused", "i4", 3)]
)


class Tables(NamedTuple):
    """All that the kernel knows of the layers.

    Attributes:
        words: noise tables, samples and records.
        places: where layers, constraints and noises begin, and how many lattices all noises have together.
        noises: those with lattices, in the order of the latter.
    """

    words: npt.NDArray[np.uint32]
    places: tuple[int, int, int, int]
    noises: list[Any]

    def origins(self, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.uint32]:
        """Return the origins of all noises at the middles of tiles, by rows and columns."""
        parts = [noise.origins(x, y[:, None]) for noise in self.noises]
        return np.concatenate(parts, axis=2).ravel() if parts else np.zeros(1, np.uint32)


def evaluate_on_device(
    scene: Scene,
    cell: float | tuple[float, float],
    row: int,
    col: int,
    rows: int,
    cols: int,
    device: Device,
    context: Context | None = None,
) -> Texture:
    """Return what `evaluate.evaluate` does, to rounding, as device arrays.  A tree is asked on the host.

    Raises:
        TypeError: a constraint is neither a hat nor sampled.
    """
    context = context or Context()
    sides = scene.texels(cell, range(0), range(0)).cell
    count, reach = len(scene.steps), scene.reach
    tables = _tables(scene, scene.noises(sides))
    words = device.from_host(tables.words)
    pictures: list[Any] = [device.empty((rows, cols, 4), np.uint8)]
    pictures += [device.empty((rows, cols, *rest)) for rest in ((), (3,), (count,))]
    left = (col - reach) // 8 * 8
    wide = -(-(col + cols + reach - left) // 8) * 8
    across = range(left, left + wide)
    most = max(1, STRIP // wide)
    high = min(rows, most) + 2 * reach
    memory = {
        "rise": device.empty((high, wide)),
        "risen": device.empty((high, wide)),
        "colour": device.empty((3, high, wide)),
        "covers": device.empty((count, high, wide)),
        "quantities": device.empty((max(1, len(scene.quantities)), high, wide)),
        "ground": device.empty((high, wide)),
        "east": device.empty((high, wide)),
        "north": device.empty((high, wide)),
    }
    cells = _Cells(device)
    passes = _passes(scene)
    program = device.program(KERNELS, include=INCLUDE)
    for top in range(0, rows, most):
        context.progress(top / rows)
        part = min(most, rows - top)
        texels = scene.texels(cell, range(row + top - reach, row + top + part + reach), across)
        high = part + 2 * reach
        holes = _ground(scene, texels, device, program, cells, memory)
        for number, name in enumerate(scene.quantities):
            _quantity(scene.quantities[name].level_for(sides), texels, number, device, program, cells, memory)
        tile_rows = np.arange(texels.rows.start // TILE, (texels.rows.stop - 1) // TILE + 1, dtype=np.float64)
        tile_cols = np.arange(across.start // TILE, (across.stop - 1) // TILE + 1, dtype=np.float64)
        origins = device.from_host(
            tables.origins(
                texels.west + (tile_cols * TILE + TILE // 2) * sides[0],
                texels.north - (tile_rows * TILE + TILE // 2) * sides[1],
            )
        )
        for begin, end, steep in passes:
            device.run(
                program, "paint", padded(GROUP, wide // 8, high), words, tables.places, origins, len(tile_cols),
                int(tile_rows[0]), int(tile_cols[0]), begin, end, int(steep), texels.rows.start, across.start,
                wide, high, *sides, *(memory[name] for name in PAINTED), local_size=GROUP,
            )  # fmt: skip
            memory["rise"], memory["risen"] = memory["risen"], memory["rise"]
        device.run(
            program, "finish", padded(GROUP, cols, part),
            *(memory[name] for name in ("ground", "east", "north", "rise", "colour", "covers")),
            holes, count, int(scene.displaces), wide, high, reach, col - left, part, cols, top, *sides, *pictures,
            local_size=GROUP,
        )  # fmt: skip
        device.finish()
    context.progress(1.0)
    return Texture(*pictures)


def _passes(scene: Scene) -> list[tuple[int, int, bool]]:
    """Return (begin, end, whether slopes are asked for) of the layers that are painted in one go."""
    begins = [0] + [number for number, step in enumerate(scene.steps) if step.refreshes and number]
    ends = [*begins[1:], len(scene.steps)]
    return [
        (begin, end, any(item.quantity == "slope" for step in scene.steps[begin:end] for item in step.constraints))
        for begin, end in zip(begins, ends, strict=True)
    ]


class _Cells:
    """Rasters on the device, each brought there once."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._kept: dict[int, tuple[Level, Any, Any, float]] = {}

    def of(self, level: Level) -> tuple[Any, Any, float]:
        """Return the cells less some height, which cells are void or None, and that height."""
        if id(level) not in self._kept:
            middle = float(np.median(level.values))
            values = self._device.from_host((level.values - middle).astype(np.float32))
            missing = None if level.missing is None else self._device.from_host(level.missing.view(np.uint8))
            self._kept[id(level)] = (level, values, missing, middle)
        return self._kept[id(level)][1:]


def _ground(scene: Scene, texels: Texels, device: Device, program: Any, cells: _Cells, memory: dict[str, Any]) -> Any:
    """Fill heights and gradients of a strip; return which texels are void, or None."""
    high, wide = texels.shape
    if not isinstance(scene.ground, Pyramid):
        found = scene.ground_at(texels)
        for name, plane in zip(("ground", "east", "north"), found[:3], strict=True):
            memory[name] = device.from_host(plane)
        return None if found.void is None else device.from_host(found.void.view(np.uint8))
    level = scene.ground.level_for(texels.cell)
    values, _, middle = cells.of(level)
    down, across = level.taps(texels, cubic=True)
    left, right = int(across.first.min()), int(across.first.max()) + 4
    columns = [device.empty((high, right - left)) for _ in range(2)]
    tables = [
        [device.from_host(np.ascontiguousarray(item, np.float32)) for item in (taps.weight, taps.slope)]
        for taps in (down, across)
    ]
    device.run(
        program, "spline_down", padded(GROUP, right - left, high), values, level.values.shape[1], left, right - left,
        device.from_host(down.first), *tables[0], high, *columns, local_size=GROUP,
    )  # fmt: skip
    device.run(
        program, "spline_across", padded(GROUP, wide, high), *columns, right - left, left,
        device.from_host(across.first), *tables[1], middle, wide, high,
        memory["ground"], memory["east"], memory["north"], local_size=GROUP,
    )  # fmt: skip
    holes = level.holes(down, across)
    return None if holes is None else device.from_host(holes.view(np.uint8))


def _quantity(
    level: Level,
    texels: Texels,
    number: int,
    device: Device,
    program: Any,
    cells: _Cells,
    memory: dict[str, Any],
) -> None:
    """Fill a plane of quantities of a strip."""
    high, wide = texels.shape
    values, missing, middle = cells.of(level)
    down, across = level.taps(texels, cubic=False)
    given = [
        device.from_host(np.ascontiguousarray(item))
        for taps in (down, across)
        for item in (taps.first, taps.weight.astype(np.float32), taps.nearest)
    ]
    device.run(
        program, "bilinear", padded(GROUP, wide, high), values, missing, *level.shape, *given, middle, wide, high,
        number, memory["quantities"], local_size=GROUP,
    )  # fmt: skip


def _tables(scene: Scene, noises: Sequence[Noises]) -> Tables:
    """Return the layers as records."""
    blocks: list[npt.NDArray[np.uint32]] = []
    size = 0

    def placed(block: npt.NDArray[Any]) -> int:
        nonlocal size
        words = np.ascontiguousarray(block).view(np.uint32).ravel()
        blocks.append(words)
        size += len(words)
        return size - len(words)

    layers = np.zeros(len(scene.steps), _LAYER)
    constraints = np.zeros(max(1, sum(len(step.constraints) for step in scene.steps)), _CONSTRAINT)
    quantities = {"altitude": 0, "slope": 1} | {name: 2 + i for i, name in enumerate(scene.quantities)}
    details: list[tuple[Any, ...]] = []
    kept: list[Any] = []
    lattices = first = 0
    for record, step, found in zip(layers, scene.steps, noises, strict=True):
        layer = step.layer
        for name in ("bias", "scale", "roughness", "variation", "colour"):
            record[name] = getattr(layer, name)
        record["parent"], record["first"], record["count"] = step.parent, first, len(step.constraints)
        for constraint in step.constraints:
            constraints[first]["quantity"] = quantities[constraint.quantity]
            _record(constraints[first], constraint, placed)
            first += 1
        for role, detail in enumerate(found):
            record["noise"][role] = -1 if detail is None else len(details)
            if detail is not None:
                details.append(_detail_record(detail, lattices, placed))
                if detail.noise is not None:
                    kept.append(detail.noise)
                    lattices += len(detail.noise.lattices)
    places = placed(layers), placed(constraints), placed(np.array(details or [(0,) * 5 + ((0, 0, 0),)], _DETAIL))
    return Tables(np.concatenate(blocks), (*places, lattices), kept)


def _detail_record(detail: Detail, lattice: int, placed: Any) -> tuple[Any, ...]:
    if detail.noise is None:
        return (-1, 0, 1.0, 0.0, detail.offset, (0, 0, 0))
    return (placed(detail.noise.table()), lattice, detail.kappa, detail.factor, detail.offset, (0, 0, 0))


def _record(record: Any, constraint: Constraint, placed: Any) -> None:
    """Fill the record of a constraint."""
    if isinstance(constraint, Sampled):
        count = len(constraint.samples)
        record["sampled"], record["count"], record["first"] = 1, count, placed(constraint.samples)
        record["low"], record["rate"] = constraint.low, (count - 1) / (constraint.high - constraint.low)
    elif isinstance(constraint, Hat):
        (start, end), (begin, last) = constraint.rise, constraint.fall
        record["rise"], record["rise_rate"], record["rise_start"] = _ramp(start, end)
        # The fall is a rise of the mirrored axis.
        place, record["fall_rate"], record["fall_start"] = _ramp(-last, -begin)
        record["fall"] = -place
    else:
        raise TypeError(f"a constraint of type {type(constraint).__name__} has no OpenCL form; use a hat or samples")


def _ramp(start: float, end: float) -> tuple[float, float, float]:
    """Return (place, rate, value at the place) of the ramp clamp((v - place) rate + value)."""
    if not math.isfinite(start):
        return 0.0, 0.0, 1.0 if start < 0 else 0.0
    if start == end:
        return start, STEEP, 1.0
    return start, min(1 / (end - start), STEEP), 0.0
