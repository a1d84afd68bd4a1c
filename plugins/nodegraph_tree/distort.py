"""The distortion: a tree displaced by noise (see `warp`)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import hypot, sqrt
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_terrain.noise import Noise, origins_of
from nodegraph_tree.device import FOLDER, Frame, Kernel, Parameters, Pending
from nodegraph_tree.function import Box, ElevationFunction, Floats
from nodegraph_tree.warp import STILL, Instruction, Reach, Shift, Warp

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Shared

_DISTORT = Kernel("tree_distort", FOLDER / "warp.cl")


@port_type
class Distort(Warp):
    """A tree distorted by noise: d = amplitude (n_x, n_y), two fractal sums of gradient noise within [-1, 1] (C2).

    |grad d| <= sqrt(2) amplitude lambda, lambda the Lipschitz constant of either sum; one to one where that is below 1.

    Attributes:
        amplitude: m.
        wavelength: of the largest features, m.
        octaves, gain: of the sums; wavelengths halve.
        seed: another seed, another distortion.
    """

    amplitude: float
    wavelength: float
    octaves: int = 1
    gain: float = 0.5
    seed: int = 0

    @cached_property
    def noises(self) -> tuple[Noise, Noise]:
        """The noises of both components."""
        # The second seed is far from those that people choose.
        return (
            Noise("fbm", octaves=self.octaves, wavelength=self.wavelength, gain=self.gain, seed=self.seed),
            Noise("fbm", octaves=self.octaves, wavelength=self.wavelength, gain=self.gain, seed=self.seed ^ 0x9E3779B9),
        )

    @cached_property
    def lipschitz(self) -> float:
        """Bound of |grad d|."""
        return sqrt(2) * abs(self.amplitude) * self.noises[0].lipschitz()

    @property
    def farthest(self) -> float:
        """Both components at their greatest."""
        return sqrt(2) * abs(self.amplitude)

    def shift(self, x: Floats, y: Floats, *, gradient: bool = False) -> Shift:
        """Return the two noises."""
        if self.amplitude == 0:
            zero = np.zeros_like(x)
            return Shift(*[zero] * 6) if gradient else Shift(zero, zero)
        if not gradient:
            return Shift(*(self.amplitude * noise.value(x, y) for noise in self.noises))
        first, second = (noise.sample(x, y) for noise in self.noises)
        values = (first.value, second.value, first.east, first.north, second.east, second.north)
        return Shift(*(self.amplitude * value for value in values))

    def reach(self, box: Box) -> Reach:  # noqa: ARG002
        """The same everywhere."""
        return Reach(self.farthest, 1 + self.lipschitz) if self.amplitude else STILL

    def closely(self, box: Box) -> tuple[Box, float]:
        """Bound both components of d by what their noises are in the box, and |J| by 1 + |grad d|."""
        found = [noise.bounds_in(*box) for noise in self.noises]
        (west, east), (south, north) = (sorted((self.amplitude * low, self.amplitude * high)) for low, high, _ in found)
        stretch = 1 + abs(self.amplitude) * hypot(*(slope for _, _, slope in found))
        return Box(box.west + west, box.south + south, box.east + east, box.north + north), stretch

    def instruction(self, emitter: Emitter, frame: Frame, to: tuple[float, float]) -> Instruction:  # noqa: ARG002
        """The tables of both noises, which all tiles share, and the frame's origin on their lattices."""
        return _DISTORT, Pending(_distort, (self, to), frame.ox, frame.oy), []

    @cached_property
    def _tables(self) -> list[npt.NDArray[np.float32]]:
        return [noise.table().view(np.float32) for noise in self.noises]


def _distort(owners: Sequence[tuple[Distort, tuple[float, float]]], x: Floats, y: Floats, shared: Shared) -> Parameters:
    floats = np.array([(item.amplitude, *to) for item, to in owners])
    heads = [(*map(shared.place, item._tables), 4 * len(item.noises[0].lattices)) for item, _ in owners]
    origins = origins_of([noise for item, _ in owners for noise in item.noises], np.repeat(x, 2), np.repeat(y, 2))
    return Parameters(floats, np.array(heads), origins.view(np.int32), 2 * np.array(heads)[:, 2])


def distort(
    operand: ElevationFunction,
    *,
    amplitude: float,
    wavelength: float,
    octaves: int = 1,
    gain: float = 0.5,
    seed: int = 0,
) -> ElevationFunction:
    """Return a tree distorted by noise.

    Raises:
        ValueError: the distortion would fold the plane.
    """
    if amplitude == 0:
        return operand
    made = Distort(operand, float(amplitude), float(wavelength), octaves, float(gain), seed)
    if not made.lipschitz < 1:
        most = abs(amplitude) / made.lipschitz
        raise ValueError(
            f"a displacement of {amplitude:g} m over {wavelength:g} m may fold the ground; give an amplitude below "
            f"{most:.4g} m, or a longer wavelength"
        )
    return made
