"""The filters and the analysis keep the promises of the contract kit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from nodegraph.testing import Example, checks_for
from nodegraph_terrain import arithmetic, colour, hillshade, slope, smooth, statistics
from nodegraph_terrain.raster import Elevation, Extent, Image, Mask, Raster, Shade

SHAPE = (37, 53)
EXTENT = Extent(1000, 2000, 1000 + 30 * SHAPE[1], 2000 + 30 * SHAPE[0], "EPSG:32633")


def _hills(voids: float) -> np.ndarray:
    rng = np.random.default_rng(5)
    rows, cols = np.indices(SHAPE)
    data = 500 + 120 * np.sin(rows / 4) * np.cos(cols / 6) + rng.normal(0, 5, SHAPE)
    data[rng.random(SHAPE) < voids] = np.nan
    return data.astype(np.float32)


GROUND, HOLED = Elevation(_hills(0), EXTENT), Elevation(_hills(0.05), EXTENT)
SHARE = ((_hills(0) - 380) / 240).clip(0, 1)
MASK, SHADE = Mask(SHARE, EXTENT), Shade(SHARE[::-1].copy(), EXTENT)
OTHER = Raster(_hills(0.02)[:, ::-1].copy(), EXTENT)
PICTURE = Image(np.random.default_rng(1).integers(0, 256, (*SHAPE, 4), np.uint8), EXTENT)
BOTH = [Example({"surface": GROUND}), Example({"surface": HOLED})]


def _with(*params: dict[str, Any], **inputs: Any) -> list[Example]:
    return [Example(inputs, item) for item in params]


EXAMPLES: dict[Any, list[Example]] = {
    smooth.gaussian_smooth: [*BOTH, *_with({"sigma": 20.0, "truncate": 3.0}, {"sigma": 5000.0}, surface=HOLED)],
    slope.slope: BOTH,
    slope.aspect: BOTH,
    hillshade.hillshade: [
        *BOTH,
        *_with({"mode": "multidirectional"}, {"cast_shadows": True, "altitude": 15.0, "azimuth": 30.0}, surface=HOLED),
        *_with({"mode": "multidirectional", "cast_shadows": True, "z_factor": 3.0}, surface=GROUND),
    ],
    colour.colour_relief: [
        *BOTH,
        *_with({"colours": "viridis", "minimum": 400.0, "maximum": 600.0}, surface=HOLED),
        *_with({"colours": [[400, "#000000"], [600.5, "#ffffff"]]}, surface=HOLED),
    ],
    colour.blend_shade: _with(
        {}, {"mode": "overlay", "strength": 0.7}, {"mode": "soft_light", "level": 0.5}, image=PICTURE, shade=SHADE
    ),
    arithmetic.add: _with({}, {"constant": 3.5}, surface=HOLED, others=[OTHER, GROUND]),
    arithmetic.subtract: _with({}, {"constant": 3.5}, surface=HOLED, others=[OTHER]),
    arithmetic.multiply: _with({}, {"factor": 2.0}, surface=HOLED, others=[MASK]),
    arithmetic.minimum: _with({}, {"limit": 450.0}, surface=HOLED, others=[OTHER]),
    arithmetic.maximum: _with({}, {"limit": 450.0}, surface=HOLED, others=[OTHER]),
    arithmetic.mix: _with({}, first=HOLED, second=OTHER, mask=MASK),
    arithmetic.remap: [
        *BOTH,
        *_with({"from_minimum": 400.0, "from_maximum": 600.0, "clamp": True}, surface=HOLED),
        *_with({"curve": [[0, 0], [0.5, 0.2], [1, 1]]}, surface=HOLED),
    ],
    arithmetic.clamp: _with({}, {"minimum": 420.0, "maximum": 580.0}, surface=HOLED),
    arithmetic.to_mask: _with({"lower": 400.0, "upper": 500.0}, {"lower": 450.0, "upper": 450.0}, surface=HOLED),
    statistics.statistics: BOTH,
}


def _cases() -> Iterator[Any]:
    for node, examples in EXAMPLES.items():
        for name, check in checks_for(node, examples):
            yield pytest.param(check, id=f"{node.name}-{name}")


@pytest.mark.parametrize("check", list(_cases()))
def test_contract(check: Callable[[], None]) -> None:
    check()
