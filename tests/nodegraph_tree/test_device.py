"""The stack machine: what is compiled when, what a third party brings, and what tiles see."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import pytest

from nodegraph import Context, port_type
from nodegraph.opencl import Device, list_devices
from nodegraph_terrain.raster import Extent
from nodegraph_tree.affine import affine, placed
from nodegraph_tree.basic import Constant, Plane
from nodegraph_tree.blend import blend
from nodegraph_tree.device import TILE, Kernel, sample_on_device
from nodegraph_tree.disc import Disc, Relief
from nodegraph_tree.function import ABSENT, Bounds, Box, ElevationFunction, Points, Sample
from nodegraph_tree.replace import replace as replaced

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

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


def test_a_third_party_brings_its_own_instruction(device, tmp_path):
    file = tmp_path / "acme.cl"
    file.write_text(CONE)
    Cone.kernel = Kernel("acme_cone", Path(file))
    cone = Cone(1070.0, 2070.0, 40.0, 50.0)
    root = replaced(Plane(2.0, 0.01, 0.02), [placed(cone, rotation=20.0, position=(300.0, -250.0)), cone])
    assert root.on_device
    height, weight = sampled(root, device)
    true_height, true_weight = expected(root)
    np.testing.assert_allclose(height, true_height, atol=2e-3)
    np.testing.assert_allclose(weight, true_weight, atol=1e-5)


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
