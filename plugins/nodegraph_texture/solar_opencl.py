"""`solar_radiation` on OpenCL: horizons and what comes from above them, all directions of a cell at once."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import nodegraph_terrain
from nodegraph import Context
from nodegraph_terrain.blocks import GROUP, padded, row_blocks
from nodegraph_texture.horizon import Step, level_count, steps
from nodegraph_texture.sun_path import BINS, PRESSURES, Sky

if TYPE_CHECKING:
    from nodegraph.opencl import Device

KERNELS = Path(__file__).parent / "kernels" / "solar.cl"
INCLUDE = (Path(nodegraph_terrain.__file__).parent,)

WORK = 1 << 27
"""Cells times looks that a device is given at a time, so that a cancel need not wait for more."""


def radiate_on_device(
    heights: Any,
    cell: tuple[float, float],
    sky: Sky,
    relief: tuple[float, float] | None,
    diffuse_share: float,
    device: Device,
    context: Context,
) -> tuple[Any, Any]:
    """Return what `solar_radiation` does, W/m2 and kWh/m2, as device arrays.

    Args:
        heights: (rows, cols) device array, m, NaN where void.
        cell: (width, height), m.
        sky: what it sends.
        relief: least and greatest height, for cast shadows; None for none.
        diffuse_share: of the sky.
        device: that holds the heights.
        context: the engine's.
    """
    rows, cols = heights.shape
    low, high = relief or (math.nan, math.nan)
    ways = sky.ways(everywhere=diffuse_share > 0)
    # Without known heights, too, there is no relief.
    looks = [steps(way, cell, (rows, cols), high - low) if low < high else [] for way, _ in ways]
    last = np.cumsum([len(look) for look in looks])
    directions, ranges = np.zeros((len(ways) + 1, 2), np.float32), np.full((len(ways) + 1, 3), -1, np.int32)
    tables = np.zeros((len(sky.sectors) + 1, PRESSURES, BINS + 1, 4), np.float32)
    number = 0
    for row, ((azimuth, sector), look) in enumerate(zip(ways, looks, strict=True)):
        directions[row] = math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))
        ranges[row] = last[row] - len(look), last[row], -1 if sector is None else number
        if sector is not None:
            tables[number, ..., :3] = sector.sums
            number += 1
    arrays = directions, ranges, *_tables(looks), tables, sky.on_level_ground
    on_device = [device.from_host(array) for array in arrays]
    program = device.program(KERNELS, include=INCLUDE)
    crossings = int(last[-1]) if len(last) else 0
    levels = _levels(heights, program, device) if crossings else heights
    per_pressure = (PRESSURES - 1) / (sky.pressures[1] - sky.pressures[0])
    diffuse = diffuse_share / (1 - diffuse_share) / sky.directions
    radiation, irradiation = device.empty((rows, cols)), device.empty((rows, cols))
    for part in row_blocks(rows, cols * (32 * len(ways) + crossings + 1), context, cells=WORK):
        device.run(
            program, "radiate", padded(GROUP, -(-cols // 8), part.stop - part.start), heights, levels, len(ways),
            *on_device, BINS, PRESSURES, rows, cols, part.start, part.stop, *cell, high, sky.pressures[0],
            per_pressure, diffuse, sky.hours, radiation, irradiation, local_size=GROUP,
        )  # fmt: skip
        if part.stop < rows:
            device.finish()
    return radiation, irradiation


def _tables(looks: list[list[Step]]) -> tuple[Any, Any]:
    """Return the looks of all directions as the kernel reads them; one that nobody looks at stands at the end."""
    every = [step for look in looks for step in look]
    cells, weights = np.zeros((len(every) + 1, 5), np.int32), np.zeros((len(every) + 1, 2), np.float32)
    for row, step in enumerate(every):
        cells[row] = step.level, *step.near, *step.far
        weights[row] = step.fraction, 1 / step.distance
    return cells, weights


def _levels(heights: Any, program: Any, device: Device) -> Any:
    """Return the levels of `horizon.pyramid`, one after another."""
    rows, cols = heights.shape
    count = level_count((rows, cols))
    levels: Any = device.empty((count, rows, cols))
    size = padded(GROUP, -(-cols // 8), rows)
    device.run(program, "ground", size, heights, rows, cols, levels, local_size=GROUP)
    for level in range(1, count):
        reach = max(1, 1 << level >> 2)
        device.run(program, "widen", size, levels, level, reach, rows, cols, local_size=GROUP)
    return levels
