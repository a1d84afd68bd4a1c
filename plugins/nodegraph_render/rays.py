"""Rays and what they hit: the vocabulary between cameras, tracers and shading."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]
Singles = npt.NDArray[np.float32]

SKY = -1
"""The layer of a ray that hits nothing."""


@dataclass(frozen=True, slots=True)
class Rays:
    """Rays in the scene: x east, y north, z up, m.

    Attributes:
        origin: where they begin, (n, 3), or (1, 3) for all from one point.
        direction: unit vectors, (n, 3), or (1, 3) for parallel rays.
        reach: how far they go at most, m, (n,) or one for all.
    """

    origin: Doubles
    direction: Doubles
    reach: Doubles | float = np.inf

    def __len__(self) -> int:
        return max(len(self.origin), len(self.direction))

    def within(self, reach: Doubles | float) -> Rays:
        """Return the same rays with another reach."""
        return replace(self, reach=reach)

    def at(self, depth: npt.NDArray[np.floating]) -> Doubles:
        """Return the points `depth` metres along the rays, (n, 3)."""
        return self.origin + self.direction * np.asarray(depth, np.float64)[:, None]


class Hits(NamedTuple):
    """What rays hit first.

    Attributes:
        depth: distance along the ray, m, (n,) float32; infinite where it hits nothing.
        normal: upward unit normal of the surface there, (n, 3) float32; zero where it hits nothing.
        layer: number of the surface that was hit, (n,) int8; `SKY` where nothing was.
        steps: evaluations of the elevation function, or cells visited, along the ray, (n,) int32.
    """

    depth: Singles
    normal: Singles
    layer: npt.NDArray[np.int8]
    steps: npt.NDArray[np.int32]
