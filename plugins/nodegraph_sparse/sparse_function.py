"""A sparse construction tree as a terrain: discs of atoms, blended."""

from __future__ import annotations

from functools import cached_property
from math import floor, hypot
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_sparse.patch_grid import PatchGrid
from nodegraph_sparse.sparse_bounds import BlendRanges, Indices
from nodegraph_tree.border import Border
from nodegraph_tree.device import Kernel
from nodegraph_tree.falloff import FallOff
from nodegraph_tree.from_elevation import Interpolation
from nodegraph_tree.function import ABSENT, Bounds, Box, ElevationFunction, Floats, Points, Sample, empty_sample
from nodegraph_tree.pixels import PAD, Range, basis

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Frame

_BLEND = Kernel("sparse_terrain", Path(__file__).with_name("kernels") / "sparse.cl")

POINTS = 1 << 14
"""Points that NumPy evaluates at once."""

HELD = 0.5
"""Radii beyond the outer centres from where weights stay as they are, so that some patch always counts."""


@port_type
class SparseTerrain(ElevationFunction):
    """Patches of atoms on a grid: f(p) = sum_i alpha_i F_i(p) / sum_i alpha_i, alpha_i = (1 - |p - c_i|^2 / R^2)^3.

    F_i = z_i + b(kappa) sum_j x_ij d_(k_ij)(p - c_i), where d interpolates the samples of an atom.  At a level of
    detail kappa < 1 the atoms fade by b = 1 - (1 - kappa^2)^3: down to the blend of the means z alone.

    Attributes:
        grid: where the centres c are; the terrain covers its extent.
        atoms: (N, size + 4, size + 4) float32, those that are used, each continued by two samples on every side.
        indices: k, (n, s) int32.
        coefficients: x, (n, s) float64, 0 where patches have fewer atoms.
        means: z, (n,) float64, m.
        margin: within the edges, over which the weight of the terrain falls, m.
        interpolation: of samples.
        fall_off: how that weight falls.
    """

    grid: PatchGrid
    atoms: npt.NDArray[Any]
    indices: npt.NDArray[Any]
    coefficients: npt.NDArray[Any]
    means: npt.NDArray[Any]
    margin: float
    interpolation: Interpolation = "bicubic"
    fall_off: FallOff = "cubic"

    @property
    def size(self) -> int:
        """Samples along a side of an atom."""
        return int(self.atoms.shape[1]) - 2 * PAD

    @property
    def _narrowest(self) -> float:
        """Half a sample, m: the least over which the weight falls."""
        return self.grid.radius / self.size

    @property
    def support(self) -> Box:
        """The extent of the grid, and what the weight needs beyond it to fall."""
        extent, beyond = self.grid.extent, max(self._narrowest - self.margin, 0.0)
        return Box(extent.west - beyond, extent.south - beyond, extent.east + beyond, extent.north + beyond)

    @cached_property
    def _border(self) -> Border:
        west, south, east, north = self.support
        edges = ((1.0, 0.0, west), (-1.0, 0.0, -east), (0.0, 1.0, south), (0.0, -1.0, -north))
        return Border(edges, max(self.margin, self._narrowest), self.fall_off)

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Blend the patches, four at most for each point: O(points * sparsity), in blocks of bounded memory."""
        whole = self._border.query(points.x, points.y)
        found = empty_sample(points, gradient=gradient)
        height, weight = found.height.copy(), whole.weight
        slope = np.zeros((2, *points.x.shape)) if gradient else None
        inside = np.flatnonzero(weight > 0)
        for start in range(0, len(inside), POINTS):
            some = inside[start : start + POINTS]
            detail = points.detail if isinstance(points.detail, (int, float)) else points.detail[some]
            part = self._blend(Points(points.x[some], points.y[some], detail), gradient)
            height[some] = part[0]
            if slope is not None:
                slope[:, some] = part[1:]
        return Sample(height, weight, slope, np.stack([whole.east, whole.north]) if gradient else None)

    def _blend(self, points: Points, gradient: bool) -> Floats:
        """Return f of points inside, and its derivatives towards east and north with `gradient`, (1 or 3, n)."""
        grid, half = self.grid, self.size // 2
        u, v = (points.x - grid.west) / grid.radius, (grid.north - points.y) / grid.radius
        held_u, held_v = np.clip(u, -HELD, grid.cols - 1 + HELD), np.clip(v, -HELD, grid.rows - 1 + HELD)
        west, north = np.floor(held_u), np.floor(held_v)
        # Beyond the discs themselves, where at most the weight still falls, heights stay as they are.
        c, r = (np.minimum(place, 1.0) * half - 0.5 for place in (u - west, v - north))
        left, top = np.clip(np.floor(c), -1, half - 1), np.clip(np.floor(r), -1, half - 1)
        (wx, dx), (wy, dy) = (
            [np.stack(item) for item in basis(self.interpolation, place)] for place in (c - left, r - top)
        )
        taps = [wy[:, None] * wx]
        if gradient:
            taps += [wy[:, None] * dx, dy[:, None] * wx]
        first = PAD + 1 - len(wx) // 2
        stride = 2 * half + 2 * PAD
        inside = (top.astype(np.int64) + first) * stride + left.astype(np.int64) + first
        reach = np.arange(len(wx))
        inside = inside + (reach[:, None] * stride + reach)[..., None]
        fade = faded(points.detail)
        flat = self.atoms.reshape(-1)
        total, blended = np.zeros(u.shape), np.zeros((len(taps), *u.shape))
        around = []
        for b in (0, 1):
            row = north.astype(np.int64) + b
            for a in (0, 1):
                column = west.astype(np.int64) + a
                there = (row >= 0) & (row < grid.rows) & (column >= 0) & (column < grid.cols)
                patch = np.where(there, row * grid.cols + column, 0)
                x, y = held_u - west - a, held_v - north - b
                base = np.where(there, np.maximum(1 - x * x - y * y, 0.0), 0.0)
                relief = np.zeros((len(taps), *u.shape))
                place = inside + ((1 - b) * stride + 1 - a) * half
                cells: Floats | float = 0.0
                for index, factor in zip(self.indices[patch].T, self.coefficients[patch].T, strict=True):
                    cells = cells + factor * flat[place + index.astype(np.int64) * stride**2]
                for kind, weights in enumerate(taps):
                    relief[kind] = fade * (weights * cells).sum(axis=(0, 1))
                relief[0] += self.means[patch]
                alpha = base**3
                total += alpha
                blended += alpha * relief
                around.append((-6 * base**2, x, y, relief[0]))
        blended /= total
        if not gradient:
            return blended
        # Per radius: as atoms change, and as patches take over from each other.
        along, down = blended[1] * half * (u - west <= 1), blended[2] * half * (v - north <= 1)
        moves_x = (u == held_u) / total
        moves_y = (v == held_v) / total
        for rate, x, y, value in around:
            turned = rate * (value - blended[0])
            along += turned * x * moves_x
            down += turned * y * moves_y
        return np.stack([blended[0], along / grid.radius, -down / grid.radius])

    @cached_property
    def _ranges(self) -> BlendRanges:
        return BlendRanges((self.grid.rows, self.grid.cols), self.size // 2, self.interpolation, self._patches)

    @cached_property
    def _smooth_ranges(self) -> BlendRanges:
        """Of the means alone."""
        return BlendRanges((self.grid.rows, self.grid.cols), 1, "bilinear", self._levels)

    def _patches(self, rows: Indices, cols: Indices) -> Floats:
        """Return the samples of patches, with those around."""
        which = rows[:, None] * self.grid.cols + cols
        found = np.zeros((*which.shape, *self.atoms.shape[1:]))
        for index, factor in zip(
            self.indices[which].transpose(2, 0, 1), self.coefficients[which].transpose(2, 0, 1), strict=True
        ):
            found += factor[..., None, None] * self.atoms[index]
        found += self.means[which][..., None, None]
        return found

    def _levels(self, rows: Indices, cols: Indices) -> Floats:
        level = self.means[rows[:, None] * self.grid.cols + cols]
        return np.tile(level[..., None, None], (2 + 2 * PAD, 2 + 2 * PAD))

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound the blend block by block (`nodegraph_sparse.sparse_bounds`), and the weight by the border.

        f(kappa) = (1 - b) f(0) + b f(1), each with bounds of its own.
        """
        part = box.intersection(self.support)
        if part.empty:
            return ABSENT
        around = self._border.bounds(part)
        if around.high <= 0:
            return ABSENT
        found = self._range(part, detail)
        middle = Points(np.array([0.5 * (part.west + part.east)]), np.array([0.5 * (part.south + part.north)]), detail)
        far = found.slope * 0.5 * hypot(part.east - part.west, part.north - part.south)
        low, high, slope = found
        if far < high - low:
            value = float(self._blend(middle, gradient=False)[0, 0])
            low, high = max(low, value - far), min(high, value + far)
        # Outside its extent there is nothing.
        least = around.low if part == box else 0.0
        return Bounds(low, high, least, around.high, slope, around.slope, around.high * slope, slope)

    def _range(self, part: Box, detail: float) -> Range:
        grid, share = self.grid, float(faded(detail))
        place = (
            (part.west - grid.west) / grid.radius, (part.east - grid.west) / grid.radius,
            (grid.north - part.north) / grid.radius, (grid.north - part.south) / grid.radius,
        )  # fmt: skip
        smooth = self._smooth_ranges.over(*place) if share < 1 else Range(0.0, 0.0, 0.0)
        rough = self._ranges.over(*place) if share > 0 else Range(0.0, 0.0, 0.0)
        low, high, slope = ((1 - share) * a + share * b for a, b in zip(smooth, rough, strict=True))
        return Range(low, high, slope / grid.radius)

    @cached_property
    def _tables(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        """What the device reads of each patch, (rows, cols, ...): mean and coefficients; atoms."""
        shape = (self.grid.rows, self.grid.cols, -1)
        floats = np.column_stack([self.means, self.coefficients]).astype(np.float32)
        return floats.reshape(shape), self.indices.astype(np.int32).reshape(shape)

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Emit the patches that reach into the tile."""
        edges = self._border.device(frame)
        if edges is None:
            emitter.nothing()
            return
        grid, part = self.grid, frame.box.intersection(self.support)
        spans = []
        for start, stop, count in (
            ((grid.north - part.north) / grid.radius, (grid.north - part.south) / grid.radius, grid.rows),
            ((part.west - grid.west) / grid.radius, (part.east - grid.west) / grid.radius, grid.cols),
        ):
            # A little more, for what rounding adds.
            first, last = floor(start - 1e-3), floor(stop + 1e-3) + 1
            spans.append(slice(min(max(first, 0), count - 1), min(max(last, 0), count - 1) + 1))
        rows, cols = spans
        floats, ints = (item[rows, cols] for item in self._tables)
        emitter.add(
            _BLEND,
            [
                (frame.ox - grid.west) / grid.radius - cols.start, 1 / grid.radius,
                (grid.north - frame.oy) / grid.radius - rows.start, -1 / grid.radius,
                -HELD - cols.start, grid.cols - 1 + HELD - cols.start,
                -HELD - rows.start, grid.rows - 1 + HELD - rows.start,
                *floats.ravel().tolist(), *edges[0],
            ],
            [
                emitter.shared.place(self.atoms), *floats.shape[:2], ints.shape[2], self.size // 2,
                int(self.interpolation == "bicubic"), *edges[1], *ints.ravel().tolist(),
            ],
        )  # fmt: skip


def faded(detail: Floats | float) -> Floats:
    """Return b, how much of the atoms there is at a level of detail."""
    return np.asarray(1 - (1 - np.square(detail)) ** 3)
