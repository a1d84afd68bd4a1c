"""Texels of another map projection than the ground's: painted where they lie, not resampled.

The texels of a window have places of their own, found by projecting them one by one.  Neighbours still are neighbours:
differences between them become derivatives by the inverse of the Jacobian of their places.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph_texture.evaluate import Texture, paint
from nodegraph_texture.sampling import Level, Taps, sum_of, taps
from nodegraph_texture.scene import Scene

Floats = npt.NDArray[Any]
Doubles = npt.NDArray[np.float64]


class Warped(NamedTuple):
    """The texels of a window at any places; see `sampling.Places`.

    Attributes:
        x, y: of their middles, (rows, cols), m; finite.
        cell: width and height of a texel on the ground, m, about; one for all windows of a level.
    """

    x: Doubles
    y: Doubles
    cell: tuple[float, float]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.x.shape[0], self.x.shape[1]

    def points(self, at: tuple[Any, ...]) -> tuple[Doubles, Doubles]:
        """Return x and y, m, of the texels that indices of rows and columns select."""
        return self.x[at], self.y[at]

    def spline(self, level: Level) -> tuple[Floats, Floats, Floats, npt.NDArray[np.bool_] | None]:
        """Return float32 values, their derivatives per metre towards east and north, and which texels are void."""
        down, across = self._taps(level, cubic=True)
        values, east, north = (np.zeros(self.shape) for _ in range(3))
        for i in range(4):
            row = [level.values[down.first + i, across.first + j] for j in range(4)]
            value = sum_of(row[j] * across.weight[j] for j in range(4))
            values += down.weight[i] * value
            north -= down.slope[i] * value
            east += down.weight[i] * sum_of(row[j] * across.slope[j] for j in range(4))
        single = [array.astype(np.float32) for array in (values, east, north)]
        return single[0], single[1], single[2], _holes(level, down, across)

    def bilinear(self, level: Level) -> npt.NDArray[np.float32]:
        """Return float32 values, NaN where the cell that a texel lies in is void or there is none."""
        down, across = self._taps(level, cubic=False)
        last = level.shape[0] - 1, level.shape[1] - 1
        found = sum_of(
            level.values[np.minimum(down.first + i, last[0]), np.minimum(across.first + j, last[1])]
            * (down.weight[i] * across.weight[j])
            for i in (0, 1)
            for j in (0, 1)
        )
        values = np.asarray(found, np.float32)
        holes = _holes(level, down, across)
        if holes is not None:
            values[holes] = np.nan
        return values

    def gradient(self, rise: Floats) -> tuple[Floats, Floats]:
        """Return central differences of values per metre towards east and north; 0 along the border."""
        (x_i, x_j), (y_i, y_j), (r_i, r_j) = (_differences(values) for values in (self.x, self.y, rise))
        area = x_i * y_j - x_j * y_i
        east, north = np.zeros_like(rise), np.zeros_like(rise)
        inner = (slice(1, -1), slice(1, -1))
        with np.errstate(divide="ignore", invalid="ignore"):
            east[inner] = (r_i * y_j - r_j * y_i) / area
            north[inner] = (r_j * x_i - r_i * x_j) / area
        # Where places coincide, beyond the projection, there is no ground.
        return np.nan_to_num(east, posinf=0.0, neginf=0.0), np.nan_to_num(north, posinf=0.0, neginf=0.0)

    def turned(self, normals: Floats) -> Floats:
        """Return normals with components along columns, against rows, and up, from those towards east and north.

        The border is not right.
        """
        made = normals.copy()
        for part, sign, axis in ((0, 1.0, 0), (1, -1.0, 1)):
            x, y = _differences(self.x)[axis], _differences(self.y)[axis]
            length = sign * np.maximum(np.hypot(x, y), 1e-300)
            inner = normals[1:-1, 1:-1]
            made[1:-1, 1:-1, part] = inner[..., 0] * (x / length) + inner[..., 1] * (y / length)
        return made

    def _taps(self, level: Level, cubic: bool) -> tuple[Taps, Taps]:
        down, across = (level.north - self.y) / level.cell[1], (self.x - level.west) / level.cell[0]
        return taps(down, level.cell[1], level.shape[0], cubic), taps(across, level.cell[0], level.shape[1], cubic)


def paint_warped(scene: Scene, texels: Warped) -> Texture:
    """Paint a window without its rim of `rim(scene)` texels; normals are towards the east and north of the window.

    Texels have the same bits in whatever window they are.
    """
    made = paint(scene, scene.noises(texels.cell), texels)
    made = made._replace(normals=texels.turned(made.normals))
    reach = rim(scene)
    inner = slice(reach, texels.shape[0] - reach), slice(reach, texels.shape[1] - reach)
    return Texture(made.colour[inner], made.height[inner], made.normals[inner], made.coverage[inner])


def rim(scene: Scene) -> int:
    """Return how many texels around a window count; one at least, for the directions of its sides."""
    return max(1, scene.reach)


def _differences(values: Floats) -> tuple[Floats, Floats]:
    """Return half differences of the neighbours along columns and along rows, inside of the border."""
    return (values[1:-1, 2:] - values[1:-1, :-2]) / 2, (values[2:, 1:-1] - values[:-2, 1:-1]) / 2


def _holes(level: Level, down: Taps, across: Taps) -> npt.NDArray[np.bool_] | None:
    outside = np.asarray((down.nearest < 0) | (across.nearest < 0))
    if level.missing is not None:
        outside |= level.missing[np.maximum(down.nearest, 0), np.maximum(across.nearest, 0)]
    return outside if outside.any() else None
