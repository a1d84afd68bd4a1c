"""The stack machine: what is compiled when, what a third party brings, and what tiles see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nodegraph import Context, port_type
from nodegraph.opencl import Device, list_devices
from nodegraph_terrain.raster import Extent
from nodegraph_tree.affine import affine, placed
from nodegraph_tree.basic import Constant, Plane
from nodegraph_tree.blend import blend
from nodegraph_tree.device import (
    TILE,
    Frame,
    Kernel,
    Parameters,
    Pending,
    Shared,
    Tile,
    sample_on_device,
    tile_programs,
)
from nodegraph_tree.disc import Disc, Relief
from nodegraph_tree.function import ABSENT, EVERYWHERE, Bounds, Box, ElevationFunction, Floats, Points, Sample
from nodegraph_tree.replace import replace as replaced

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Fill

EXTENT = Extent(1000.0, 2000.0, 1000.0 + 150, 2000.0 + 130)
SHAPE = (130, 150)

CONE = """
#include "tree.h"
// p = {top east, north, height, radius}
static void acme_cone(State *s, P p, N n, D data)
{
    const float8 dx = s->x - p[0], dy = s->y - p[1];
    const float8 t = fmin(sqrt(dx * dx + dy * dy) / p[3], 1.0f);
    push(s, p[2] * (1.0f - t), (1.0f - t) * (1.0f - t));
}
"""


@port_type
class Cone(ElevationFunction):
    """A third party's primitive with an OpenCL instruction of its own."""

    x: float
    y: float
    height: float
    radius: float

    kernel: ClassVar[Kernel]

    @property
    def support(self) -> Box:
        return Box(self.x - self.radius, self.y - self.radius, self.x + self.radius, self.y + self.radius)

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        t = np.minimum(np.hypot(points.x - self.x, points.y - self.y) / self.radius, 1.0)
        return Sample(self.height * (1 - t), (1 - t) ** 2)

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        if not self.support.meets(box):
            return ABSENT
        steep = self.height / self.radius
        return Bounds(0.0, self.height, 0.0, 1.0, steep, 2 / self.radius, steep, steep)

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        emitter.add(self.kernel, [self.x - frame.ox, self.y - frame.oy, self.height, self.radius])


@port_type
class ManyCones(Cone):
    """The same with parameters that are computed for all tiles at once."""

    @property
    def single(self) -> tuple[Kernel, Fill]:
        return Cone.kernel, _cones

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        emitter.add(Cone.kernel, Pending(_cones, self, frame.ox, frame.oy))


def _cones(owners: Sequence[Cone], x: Floats, y: Floats, shared: Shared) -> Parameters:
    own = np.array([(item.x, item.y, item.height, item.radius) for item in owners])
    own[:, 0] -= x
    own[:, 1] -= y
    return Parameters(own, np.zeros((len(owners), 0), np.int64))


@pytest.fixture
def cone_kernel(tmp_path: Path) -> None:
    file = tmp_path / "acme.cl"
    file.write_text(CONE)
    Cone.kernel = Kernel("acme_cone", file)


@port_type
class Everywhere(ElevationFunction):
    """A tree of which every tile gets the whole program, to be run in all blocks."""

    operand: ElevationFunction

    @property
    def parts(self) -> tuple[ElevationFunction, ...]:
        return (self.operand,)

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        self.operand.emit(emitter, frame._replace(box=EVERYWHERE, block=None))


@pytest.fixture
def device() -> Device:
    return Device(list_devices()[0])


def sampled(root: ElevationFunction, device: Device, extent: Extent = EXTENT, shape: tuple[int, int] = SHAPE):
    height, weight = sample_on_device(root, extent, shape, device, Context())
    return device.to_host(height), device.to_host(weight)


def expected(root: ElevationFunction) -> tuple[np.ndarray, np.ndarray]:
    x = EXTENT.west + (np.arange(SHAPE[1]) + 0.5)
    y = EXTENT.north - (np.arange(SHAPE[0]) + 0.5)
    gx, gy = np.meshgrid(x, y)
    found = root.query(Points(gx.ravel(), gy.ravel()))
    height = np.where(found.weight >= 0.5, found.height, np.nan)
    return height.reshape(SHAPE), found.weight.reshape(SHAPE)


def test_editing_parameters_compiles_nothing(device):
    hill = Disc(1050.0, 2060.0, 60.0, 5.0, Relief("fbm", 4.0, 30.0, 3))
    sampled(blend([Plane(1.0, 0.1, 0.0), hill]), device)
    assert device.builds == 1
    other = replace(hill, x=1090.0, radius=44.0, relief=Relief("ridged", 9.0, 12.0, 6, seed=8))
    sampled(blend([Plane(3.0, 0.0, 0.4), other]), device)
    assert device.builds == 1
    sampled(replaced(Constant(1.0), [hill]), device)
    assert device.builds == 2


@pytest.mark.usefixtures("cone_kernel")
def test_a_third_party_brings_its_own_instruction(device):
    cone = Cone(1070.0, 2070.0, 40.0, 50.0)
    root = replaced(Plane(2.0, 0.01, 0.02), [placed(cone, rotation=20.0, position=(300.0, -250.0)), cone])
    assert root.on_device
    height, weight = sampled(root, device)
    true_height, true_weight = expected(root)
    np.testing.assert_allclose(height, true_height, atol=2e-3)
    np.testing.assert_allclose(weight, true_weight, atol=1e-5)


@pytest.mark.usefixtures("cone_kernel")
@given(st.integers(0, 2**32 - 1), st.integers(2, 60), st.sampled_from([0.0, 25.0]))
@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_how_parts_are_emitted_changes_nothing(device, seed, count, turn):
    """Pending or not, in few or many, of one kind or several, in some blocks or all, turned or not."""
    dice = np.random.default_rng(seed)
    places = np.stack([dice.uniform(990, 1160, count), dice.uniform(1990, 2140, count), dice.uniform(3, 40, count)], 1)
    cones = [(x, y, 5.0 + number, radius) for number, (x, y, radius) in enumerate(places.tolist())]
    relief = Relief("fbm", 4.0, 30.0, 3, seed=seed)

    def tree(*classes: type[Cone]) -> ElevationFunction:
        parts: list[ElevationFunction] = [classes[place % len(classes)](*cone) for place, cone in enumerate(cones)]
        parts += [Disc(x, y, 20.0, z, relief if z % 2 else Relief()) for x, y, z, _ in cones[:12]]
        return placed(blend(parts), rotation=turn, position=(0.0, 0.0)) if turn else blend(parts)

    plain = tree(Cone)
    true_height, true_weight = expected(plain)
    for root in (plain, tree(ManyCones), tree(Cone, ManyCones)):
        height, weight = sampled(root, device)
        # Near the threshold rounding decides what is terrain.
        np.testing.assert_array_equal(np.isnan(height), weight < 0.5)
        both = ~np.isnan(height) & ~np.isnan(true_height)
        np.testing.assert_allclose(height[both], true_height[both], atol=2e-3)
        np.testing.assert_allclose(weight, true_weight, atol=1e-4)
        for some, all_ in zip((height, weight), sampled(Everywhere(root), device), strict=True):
            np.testing.assert_array_equal(some, all_)


def test_the_stack_does_not_depend_on_how_many_tiles_there_are():
    tree = blend([Plane(1.0, 0.1, 0.0), Constant(2.0)])
    frame = Frame(Box(0.0, 0.0, 1.0, 1.0), 0.0, 1.0)
    one, many = (tile_programs(tree, [Tile(frame)] * count) for count in (1, 300))
    assert one.stack == many.stack
    assert one.frames == many.frames
    assert (many.starts == one.starts[1] * np.arange(301)).all()
    assert (many.code.reshape(300, -1, 4)[:, :, [0, 3]] == one.code[:, [0, 3]]).all()


@pytest.mark.parametrize("turn", [0.0, 33.0])
def test_blocks_hold_the_samples_of_all_boxes_that_they_meet(turn):
    dice = np.random.default_rng(4)
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    tile = Frame(Box(300.0, 800.0, 364.0, 864.0), 300.0, 864.0, block=(8.0, 16.0))
    frame = tile.carried((c, s, -s, c), (7.0, -3.0))
    west, south = (
        dice.uniform(frame.box.west - 20, frame.box.east, 200),
        dice.uniform(frame.box.south, frame.box.north, 200),
    )
    boxes = np.stack([west, south, west + dice.uniform(0, 30, 200), south + dice.uniform(0, 30, 200)], 1)
    right, down = np.meshgrid(np.arange(TILE) + 0.5, np.arange(TILE) + 0.5)
    x, y = frame.ox + c * right - s * down, frame.oy - s * right - c * down
    bit = (down // 16 * 8 + right // 8).astype(int)
    sizes = []
    for (w, s_, e, n), blocks in zip(boxes, frame.blocks_in(boxes).tolist(), strict=True):
        inside = (x >= w) & (x <= e) & (y >= s_) & (y <= n)
        assert all(blocks >> int(number) & 1 for number in np.unique(bit[inside]))
        sizes.append((blocks & 0xFFFFFFFF).bit_count())
    assert np.mean(sizes) < 20
    assert (frame._replace(block=None).blocks_in(boxes) == -1).all()


def test_a_sample_costs_what_overlaps_there():
    """The primitives that a sample runs through, for 100 and 10,000 that overlap alike: tiles alone have 10 times."""
    dice = np.random.default_rng(0)
    asked = []
    for count in (100, 10_000):
        radius = float(np.sqrt(4.0 * 1e6 / count / np.pi))
        tree = blend([Disc(x, y, radius, 0.0, Relief()) for x, y in dice.uniform(0, 1000, (count, 2)).tolist()])
        frames = [
            Frame(Box(x, y - 62.5, x + 62.5, y), x, y, block=(62.5 / 8, 62.5 / 4))
            for x in np.arange(0, 1000, 62.5).tolist()
            for y in np.arange(62.5, 1001, 62.5).tolist()
        ]
        made = tile_programs(tree, [Tile(frame) for frame in frames])
        discs = made.code[made.code[:, 0] == [kind.name for kind in made.kinds].index("tree_disc_flat")]
        asked.append(np.unpackbits(discs[:, 3:].copy().view(np.uint8)).sum() / 32 / len(frames))
    assert 4 < asked[0] < asked[1] < 2.5 * asked[0]


def test_a_chain_of_transforms_is_one(device):
    turned = Constant(1.0)
    tree: ElevationFunction = Plane(0.0, 1.0, 0.0)
    for _ in range(40):
        tree = affine(tree, (0.6, 0.8, -0.8, 0.6), (1.0, 2.0))
    assert len(tree.parts) == 1
    assert not tree.parts[0].parts
    np.testing.assert_allclose(sampled(blend([tree, turned]), device)[0], expected(blend([tree, turned]))[0], rtol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 3), (TILE, TILE), (TILE + 1, TILE - 1), (3 * TILE + 5, 2)])
def test_grids_of_any_shape(device, shape):
    extent = Extent(0.0, 0.0, 2.0 * shape[1], 3.0 * shape[0])
    height, weight = sampled(Plane(5.0, 0.25, 0.5), device, extent, shape)
    x = (np.arange(shape[1]) + 0.5) * 2
    y = 3.0 * shape[0] - (np.arange(shape[0]) + 0.5) * 3
    np.testing.assert_allclose(height, 5 + 0.25 * x + 0.5 * y[:, None], rtol=1e-6)
    assert (weight == 1).all()


def test_nothing_is_void(device):
    far = Disc(1e6, 1e6, 10.0, 5.0, Relief())
    height, weight = sampled(blend([far, far]), device)
    assert np.isnan(height).all()
    assert (weight == 0).all()


def test_kernels_count_in_the_code_of_a_node() -> None:
    from nodegraph.fingerprint import Fingerprints
    from nodegraph_tree.disc import disc
    from nodegraph_tree.evaluate import sample

    code = Fingerprints(["nodegraph_tree", "nodegraph_terrain"])
    assert {"tree.cl", "machine.h", "tree.h"} <= {path.name for path in code.files(sample)}
    assert {"disc.cl", "relief.h", "noise.h"} <= {path.name for path in code.files(disc)}
