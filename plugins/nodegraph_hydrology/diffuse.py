"""Diffusing scattered elevations over the ground between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, node, whole
from nodegraph_hydrology import relaxation as relaxations
from nodegraph_terrain import multigrid, multigrid_opencl
from nodegraph_terrain.multigrid import System
from nodegraph_terrain.raster import Elevation, Raster, ground_cell, require_same_grid

Array = npt.NDArray[Any]
Method = Literal["multigrid", "jacobi", "sor"]
Border = Literal["neumann", "fixed"]


@node(version=1, locality=whole)
def diffuse(
    features: Elevation,
    diffusivity: Raster | None = None,
    *,
    method: Annotated[
        Method, Param("multigrid: to a tolerance; jacobi and sor: a number of steps, however far they come.")
    ] = "multigrid",
    tolerance: Annotated[
        float, Param("Largest error of any cell, relative to the range of the features (multigrid).", ge=1e-6, le=0.1)
    ] = 1e-5,
    iterations: Annotated[int, Param("Steps of jacobi and sor.", ge=1, le=10_000_000)] = 5500,
    relaxation: Annotated[
        float | None,
        Param("Over-relaxation of sor; by default the best one for a rectangle with given edges.", gt=0, lt=2),
    ] = None,
    border: Annotated[
        Border, Param("neumann: level across the outer edge; fixed: outer cells without a feature have a given height.")
    ] = "neumann",
    border_elevation: Annotated[float, Param("That height.", ge=-1e6, le=1e6, unit="m")] = 0.0,
    context: Context,
) -> Elevation:
    """Fill the ground between scattered elevations by diffusion, as heat spreads from sources held at a temperature.

    The result h keeps every feature and solves

        div(k grad h) = 0

    in the free cells (NaN in `features`), by the five-point scheme: at each of them

        sum_n k_n (h_n - h) = 0 over the four neighbours n,

    with k_n the harmonic mean of the two cells' diffusivities, times the length of the side they share over the
    distance of their centres.  Without a `diffusivity` k is 1 everywhere.  Higher values spread features further; walls
    of diffusivity 0, however thin, let nothing through.  Free cells that no feature reaches because of such walls, and
    free cells of diffusivity 0 themselves, take the mean of all features, and a warning is logged.  The result lies
    within the range of the features.

    ``multigrid`` (conjugate gradients preconditioned by one V-cycle of black-box multigrid) takes about 10 cycles
    for 1e-4 and 12 for 1e-6, whatever the size and however few the features; time and memory are linear in the cells.
    Only openings one cell wide in walls of diffusivity 0 cost more, up to 40.
    ``jacobi`` is the paper's method: every free cell becomes the mean of its neighbours, `iterations` times, starting
    from the mean of the features.  n steps carry a feature over about sqrt(n) cells: on large rasters with sparse
    features 5,500 of them are far from the limit.  ``sor`` over-relaxes the two colours of a chessboard in turn; with
    a good factor a number of steps proportional to the side of the raster suffices.

    Args:
        features: elevations where they are known, NaN in free cells; rectangular cells and degrees count on the ground.
        diffusivity: not negative, without voids, on the same grid; only ratios count.
        method: multigrid, jacobi or sor.
        tolerance: of multigrid.
        iterations: of jacobi and sor.
        relaxation: of sor.
        border: what holds at the outer edge.
        border_elevation: see `border`.
        context: the engine's.

    Raises:
        ValueError: there is no feature at all; a feature is infinite; the diffusivity is negative, void or on another
            grid.

    References:
        H. Zhang, D. Qu, Y. Hou, F. Gao, F. Huang (2016): Synthetic modeling method for large scale terrain based on
        hydrology, section V.C (eqs. 6-7). IEEE Access 4. doi:10.1109/ACCESS.2016.2612700.
        J. E. Dendy (1982): Black box multigrid. J. Comput. Phys. 48. doi:10.1016/0021-9991(82)90057-2.
    """
    problem = _problem(features, diffusivity, border, border_elevation, context)
    if method == "multigrid":
        heights = multigrid.solve(problem.system, tolerance, context)
    elif method == "jacobi":
        heights = relaxations.jacobi(problem.system, iterations, context)
    else:
        factor = relaxation or relaxations.best_relaxation(features.shape)
        heights = relaxations.sor(problem.system, iterations, factor, context)
    return Elevation(problem.lifted(heights), features.extent)


@diffuse.opencl(rtol=1e-4, atol=1e-2)
def _twin(
    features: Elevation,
    diffusivity: Raster | None = None,
    *,
    method: Method,
    tolerance: float,
    iterations: int,
    relaxation: float | None,
    border: Border,
    border_elevation: float,
    context: Context,
) -> Elevation:
    from nodegraph.opencl import to_host

    device = context.device
    assert device is not None
    # What is set up is a few passes over the raster; the host's memory is where it is looked through.
    problem = _problem(to_host(features), to_host(diffusivity), border, border_elevation, context)
    if method == "multigrid":
        heights = multigrid_opencl.solve(device, problem.system, tolerance, context)
    else:
        factor = None if method == "jacobi" else relaxation or relaxations.best_relaxation(features.shape)
        heights = relaxations.relax_on(device, problem.system, iterations, factor, context)
    lifted: Any = device.from_host(problem.lifted(device.to_host(heights)))
    return Elevation(lifted, features.extent)


@diffuse.forecast
def _forecast(features: Forecast, diffusivity: Forecast | None = None, *, method: Method, **_: object) -> Forecast:
    # Vectors and the hierarchy of multigrid, in floats per cell; see `multigrid.Level`.
    per_cell = 26 if method == "multigrid" else 8
    return Forecast(features.bytes, features.bytes * (per_cell + (2 if diffusivity else 0)), features.about)


@dataclass(frozen=True, slots=True)
class _Problem:
    """The system to solve, in heights above a level: float32 then has digits for the relief, not for the altitude."""

    system: System
    level: float
    features: Array

    def lifted(self, heights: Array) -> Array:
        """Return the solution at its altitude, within the features' range; features exactly as they were given."""
        low, high = np.nanmin(self.features), np.nanmax(self.features)
        # By the maximum principle only a numerical error lies outside.
        risen = np.clip(heights + np.float32(self.level), low, high)
        return np.where(np.isnan(self.features), risen, self.features)


def _problem(
    features: Elevation, diffusivity: Raster | None, border: Border, border_elevation: float, context: Context
) -> _Problem:
    given = features.data
    if border == "fixed":
        given = given.copy()
        for edge in (given[0], given[-1], given[:, 0], given[:, -1]):
            edge[np.isnan(edge)] = border_elevation
    free = np.isnan(given)
    if free.all():
        raise ValueError("the features are all void (NaN); at least one cell must have an elevation")
    low, high = float(np.nanmin(given)), float(np.nanmax(given))
    if not np.isfinite([low, high]).all():
        raise ValueError("a feature has an infinite elevation; features must be finite, or NaN where free")
    mean = float(np.mean(given, where=~free, dtype=np.float64))
    dx, dy = ground_cell(features)
    across: Array | float = dy / dx
    down: Array | float = dx / dy
    solved = free
    if diffusivity is not None:
        require_same_grid(features, diffusivity)
        k = _relative(diffusivity.data)
        across = across * _harmonic_mean(k[:, :-1], k[:, 1:])
        down = down * _harmonic_mean(k[:-1], k[1:])
        if not k.all():
            cut_off = multigrid.without_value(free, k > 0)
            if cut_off.any():
                context.log.warning("no feature reaches %d free cells; they take the features' mean", cut_off.sum())
            solved = free & ~cut_off
    values = np.where(free, np.float32(0), given - np.float32(mean))
    return _Problem(System(values, solved, across, down), mean, given)


def _relative(diffusivity: Array) -> Array:
    """Return the diffusivity over its largest value, checked."""
    lowest = float(diffusivity.min())
    if np.isnan(lowest):
        raise ValueError("the diffusivity has voids (NaN); fill them, 0 is what lets nothing through")
    highest = float(diffusivity.max())
    if lowest < 0 or not np.isfinite(highest):
        raise ValueError(f"the diffusivity ranges from {lowest:g} to {highest:g}; it must be finite and not negative")
    return diffusivity / np.float32(highest) if highest > 0 else diffusivity


def _harmonic_mean(a: Array, b: Array) -> Array:
    total = a + b
    mean = np.zeros_like(total)
    np.divide(a, total, out=mean, where=total > 0)
    mean *= b
    mean *= 2
    return mean
