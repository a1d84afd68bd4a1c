"""A whole map as a dictionary: every window of it is an atom, and none is stored."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, port_type
from nodegraph_sparse.dictionary import BLOCK, Dictionary, SampledDictionary
from nodegraph_sparse.metric import Metric, mass
from nodegraph_sparse.windows import SYMMETRIES, blocks, cut, half_side, moments, shaped, turn
from nodegraph_terrain.forecasts import outline
from nodegraph_terrain.raster import Elevation

Samples = npt.NDArray[Any]


@port_type
class ExemplarDictionary(Dictionary):
    """A dictionary whose atoms are windows of a map: atom j is (window_j - mean_j) scale_j, turned.

    Attributes:
        heights: the map, (rows, cols) float32, m.
        corners: (N, 2) int32, row and column of the north-western sample of each window.
        turns: (N,) int8, the symmetry of the square that is applied; see `windows.turn`.
        means: (N,) float64, m.
        scales: (N,) float64, 1/m.
        side: samples along a side of a window.
        step: cells of the map from a sample to the next.
        cell: side of a cell of the map, m; 0 where it is unknown.
    """

    heights: npt.NDArray[Any]
    corners: npt.NDArray[Any]
    turns: npt.NDArray[Any]
    means: npt.NDArray[Any]
    scales: npt.NDArray[Any]
    side: int
    step: int = 1
    cell: float = 0.0

    computes: ClassVar[bool] = True

    @property
    def size(self) -> int:
        """Samples along a side of an atom."""
        return self.side

    def atoms(self, which: slice | npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Cut some atoms out of the map."""
        chosen = np.arange(self.count)[which]
        samples = np.empty((len(chosen), self.side, self.side), np.float32)
        for part in blocks(len(chosen), self.side):
            some = chosen[part]
            # In float64: heights are large against the relief of a window.
            found = cut(self.heights, self.corners[some], self.side, self.step).astype(np.float64)
            found -= self.means[some][:, None, None]
            found *= self.scales[some][:, None, None]
            samples[part] = turn(found.astype(np.float32), self.turns[some])
        return samples

    def exaggerations(self, which: npt.NDArray[Any], cell: float) -> npt.NDArray[Any]:
        """Return what the slopes of some windows are multiplied by."""
        return np.asarray(self.scales[which] * (self.step * self.cell / cell))

    def take(self, which: npt.NDArray[Any]) -> Dictionary:
        """Return the dictionary of some atoms: with samples of its own where these are less than the map."""
        sources = self.sources[which]
        if len(sources) * self.side**2 <= self.heights.size:
            return SampledDictionary(self.metric, sources, self.names, self.atoms(which))
        return replace(
            self, sources=sources, corners=self.corners[which], turns=self.turns[which], means=self.means[which],
            scales=self.scales[which],
        )  # fmt: skip


@node(version=1)
def exemplar_dictionary(
    surface: Elevation,
    *,
    radius: Annotated[float | None, Param("R, of the atoms' discs: a whole number of cells.", gt=0, unit="m")] = None,
    cells: Annotated[int | None, Param("R in cells, instead of metres: times the factor.", ge=1)] = None,
    factor: Annotated[int, Param("Cells of this terrain for one of `cells`, along a side.", ge=1, le=64)] = 1,
    atoms: Annotated[int | None, Param("N: that many windows, drawn evenly; none: all of them.", ge=1)] = None,
    stride: Annotated[int, Param("From an atom to the next, along rows and columns.", ge=1, unit="cells")] = 4,
    relief: Annotated[
        float, Param("Least root mean square of a window about its mean: flatter ones show noise.", ge=0, unit="m")
    ] = 0.0,
    symmetries: Annotated[bool, Param("Also take every atom turned and mirrored: eight times as many.")] = False,
    metric: Annotated[Metric, Param("In which atoms are normalised: as the patches to be coded.")] = "weighted",
    name: Annotated[str, Param("Of the terrain, among the sources of a dictionary.", min_length=1)] = "exemplar",
    seed: Annotated[int, Param("Another one draws other windows.", ge=0)] = 0,  # noqa: ARG001
    context: Context,
) -> ExemplarDictionary:
    """Make a terrain the complete dictionary of its patches, without storing them: the example map is the dictionary.

    The atoms are the windows of 2 R / cell by 2 R / cell cells at every `stride`-th row and column that lie within the
    terrain, each less its mean and divided by its norm in the metric.  The dictionary holds the map, and position, mean
    and norm of each atom (about 30 bytes); samples are cut out where they are asked for.  Flat windows (a norm below
    1e-6 of the greatest) are left out, and so are those of less `relief`: on measured plains, what the instrument adds
    is as high as the ground itself, and an atom of it makes cobbles on a mountain side.

    A multi-resolution dictionary of it is again a map with positions, the smaller one of reduced cells; it takes the
    least memory where the stride is a multiple of the factor.  To amplify a terrain by a factor, give its R in `cells`
    and that factor: the low atoms then fit its patches, whatever the cells of both terrains measure.

    Args:
        surface: a terrain in metres, with square cells and without voids.
        radius: R, m.
        cells: R in cells of the terrain that will be amplified.
        factor: that of ``sparse.multiresolution_dictionary``; 1 where the atoms describe terrain as fine as this.
        atoms: N, drawn without repetition among windows, and their turned and mirrored ones; all where there are less.
        stride: 1 takes every window there is.
        relief: 0 keeps all that are not flat; for radar heights 10 to 20 m.
        symmetries: the eight of the square.  Turned light stays right, turned rivers and faults do not.
        metric: ``weighted`` by the blend or ``plain``.
        name: of the one source.
        seed: of the choice of `atoms`.
        context: the engine's.

    Returns:
        About (rows / stride) (cols / stride) atoms unless fewer are asked for, by rows from the north-west; turned ones
        follow, turn by turn.

    Raises:
        ValueError: the terrain is in degrees, has voids, cells that are not square or less cells than an atom, or has
            no window of that relief; or the radius is stated twice or not at all, or is no whole number of cells.

    Complexity: O(N K) for means and norms.

    Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum
    35(2), section 5.3, doi:10.1111/cgf.12821.
    """
    size = 2 * half_side(surface, radius, None if cells is None else cells * factor)
    rows, cols = (np.arange(0, side - size + 1, stride, dtype=np.int32) for side in surface.shape)
    corners = np.stack([np.repeat(rows, len(cols)), np.tile(cols, len(rows))], axis=1)
    means, norms = window_moments(surface.data, corners, size, 1, metric, context)
    kept = shaped(norms, means, size, metric)
    if not kept.any():
        raise ValueError("the terrain is flat; a dictionary needs some relief")
    rough = norms / np.sqrt(mass(size, metric).sum())
    kept &= rough >= relief
    if not kept.any():
        raise ValueError(
            f"no window of the terrain has {relief:g} m of relief; the greatest is {rough.max():.4g} m, take less"
        )
    corners, means, scales = corners[kept], means[kept], 1 / norms[kept]
    times = SYMMETRIES if symmetries else 1
    count = times * len(corners)
    chosen = np.arange(count)
    if atoms is not None and atoms < count:
        chosen = np.sort(context.rng.choice(count, atoms, replace=False))
    turns, windows = np.divmod(chosen, len(corners))
    return ExemplarDictionary(
        metric, np.zeros(len(chosen), np.int32), (name,), surface.data, corners[windows], turns.astype(np.int8),
        means[windows], scales[windows], size, cell=surface.cell_size[0],
    )  # fmt: skip


@exemplar_dictionary.forecast
def _forecast(surface: Forecast, *, stride: int, symmetries: bool, **_: object) -> Forecast:
    known = outline(surface)
    cells = surface.bytes // 4 if known is None else known.rows * known.cols
    return Forecast(4 * cells + 29 * (cells // stride**2) * (8 if symmetries else 1), 32 * BLOCK)


def window_moments(
    heights: Samples, corners: Samples, size: int, step: int, metric: Metric, context: Context
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return mean and norm less the mean of each window of a map, in the metric; symmetries leave them as they are."""
    means, norms = np.empty(len(corners)), np.empty(len(corners))
    for part in blocks(len(corners), size):
        context.progress(part.start / len(corners))
        means[part], norms[part] = moments(cut(heights, corners[part], size, step), metric)
    return means, norms


def reduced_map(
    exemplar: ExemplarDictionary, factor: int, smoothing: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[Any], int]:
    """Return the map whose windows are the atoms of an exemplar reduced by a factor: (heights, corners, step).

    Means of factor by factor samples commute with cutting windows: each cell becomes the mean of itself and those
    south and east of it that make one sample with it, and windows start where they did, with longer steps.  Where all
    start on multiples of one another's steps only those cells are kept, a smaller map with a step of 1.

    Args:
        exemplar: whose map.
        factor: samples along a side that become one.
        smoothing: standard deviation of a Gaussian before, in low samples; it sees what surrounds a window.
    """
    heights = exemplar.heights.astype(np.float64)
    step = exemplar.step
    if smoothing > 0:
        from scipy.ndimage import gaussian_filter

        heights = gaussian_filter(heights, smoothing * factor * step, mode="reflect")
    for _ in range(2):
        length = heights.shape[0] - (factor - 1) * step
        total = heights[:length].copy()
        for sample in range(1, factor):
            total += heights[sample * step : sample * step + length]
        heights = (total / factor).T
    step *= factor
    corners = exemplar.corners
    phase = corners[0] % step
    if np.all(corners % step == phase):
        return heights[phase[0] :: step, phase[1] :: step].astype(np.float32), (corners - phase) // step, 1
    return heights.astype(np.float32), corners, step
