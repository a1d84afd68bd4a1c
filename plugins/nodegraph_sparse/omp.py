"""Coding the patches of a terrain by the atoms of a dictionary."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from nodegraph import Context, Forecast, Param, node
from nodegraph.errors import nearest
from nodegraph_sparse.dictionary import Dictionary, Patches, SparseCode
from nodegraph_sparse.metric import mass
from nodegraph_sparse.pursuit import pursue_samples
from nodegraph_sparse.pursuit_rules import Floats, Selection
from nodegraph_terrain.raster import Mask


@node(version=1)
def omp(
    patches: Patches,
    dictionary: Dictionary,
    *style: Mask,
    sparsity: Annotated[int, Param("s: the most atoms of a patch.", ge=1)] = 8,
    error: Annotated[float, Param("Root mean square error at which a patch is good enough.", ge=0, unit="m")] = 0.0,
    selection: Annotated[
        Selection, Param("How atoms are chosen: ols (least residual), omp (greatest product) or mp (no refit).")
    ] = "ols",
    nonnegative: Annotated[bool, Param("Allow no negative coefficients: they turn relief upside down.")] = False,
    weights: Annotated[
        dict[str, float] | None, Param("How much the atoms of each source are wanted, 0 to 1; 1 where not named.")
    ] = None,
    context: Context,
) -> SparseCode:
    """Describe each patch as a sum of few atoms, by greedy pursuit.

    Atoms are chosen one at a time for each patch d (less its mean), until there are s or the rest is small:

    - ``ols`` (orthogonal least squares): the atom k which leaves the least, min over k and all coefficients x of
      ||d - sum_j x_j d_j||^2: what the paper prints.  At s = 8 it leaves 14 to 30 % less than ``omp``.
    - ``omp`` (orthogonal matching pursuit): the atom of the greatest product with what is left; then all coefficients
      are fitted anew.
    - ``mp`` (matching pursuit): the same atom, but only its own coefficient changes; s is the number of steps.

    Products and norms are of the metric of the patches, which must be that of the dictionary.  Non-negative, atoms are
    added only the right way up, and coefficients are fitted by non-negative least squares on the chosen atoms.

    Styles: where a dictionary has several sources, each is wanted by its weight in `weights` times its mask at the
    centre of the patch.  What an atom would gain (by how much the squared residual falls) is multiplied by it when
    atoms are compared; 0 forbids.  A patch all of whose sources are forbidden keeps only its mean.

    Args:
        patches: of a grid, from ``sparse.patches``.
        dictionary: atoms of as many samples as the patches.
        style: none, or one mask for each source of the dictionary in the order of its names.  They need to cover the
            terrain, in any resolution; sampled bilinearly.
        sparsity: s; more than the atoms span is the same as what they span.
        error: sqrt(||rest||^2 / sum of the masses of samples), m: a patch ends with less than s atoms where it is
            reached.  0: at s atoms, or where nothing is left.
        selection: ``ols``, ``omp`` or ``mp``.
        nonnegative: allow no negative coefficients.
        weights: by names of sources.
        context: the engine's.

    Returns:
        Numbers of atoms and coefficients, float64, and the squared norm of what is left of each patch.

    Raises:
        ValueError: the patches lie on no grid; sizes or metrics differ; there are masks for some sources only, or one
            that has voids or does not cover the terrain; a weight names no source or is out of range.

    Complexity: O(n N (K + s^2)) up to 8,192 atoms; beyond, dictionaries are searched in blocks and never held, at
    O(s n N K), or O(s^2 n N K / 2) for ``ols``.

    Sources: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, section 4.3,
    doi:10.1111/cgf.12821; see `nodegraph_sparse.pursuit` for those of the algorithms.
    """
    return _code(patches, dictionary, style, sparsity, error, selection, nonnegative, weights or {}, context)


@omp.opencl(rtol=1e-6, atol=1e-6)
def _twin(
    patches: Patches,
    dictionary: Dictionary,
    *style: Mask,
    sparsity: int,
    error: float,
    selection: Selection,
    nonnegative: bool,
    weights: dict[str, float] | None,
    context: Context,
) -> SparseCode:
    from nodegraph.opencl import to_host

    # BLAS makes the products of patches and atoms; what it makes them of is looked through in the host's memory.
    given = to_host(patches), to_host(dictionary), to_host(style)
    return _code(*given, sparsity, error, selection, nonnegative, weights or {}, context)


@omp.forecast
def _forecast(patches: Forecast, dictionary: Forecast, *style: Forecast, sparsity: int, **_: object) -> Forecast:  # noqa: ARG001
    # Patches of the usual 16 by 16 samples; what a pursuit works on is of fixed size but for the Gram matrix.
    count = patches.bytes // 1024 + 1
    return Forecast(count * (12 * sparsity + 16), 2 * dictionary.bytes + (256 << 20), known=False)


def _code(
    patches: Patches,
    dictionary: Dictionary,
    style: tuple[Mask, ...],
    sparsity: int,
    error: float,
    selection: Selection,
    nonnegative: bool,
    weights: dict[str, float],
    context: Context,
) -> SparseCode:
    grid = patches.grid
    if grid is None:
        raise ValueError("the patches lie at random places; only those of a grid (count 0) can be coded as a terrain")
    if patches.size != dictionary.size:
        raise ValueError(
            f"patches of {patches.size} by {patches.size} samples do not match atoms of {dictionary.size} by "
            f"{dictionary.size}; choose a radius of {dictionary.size / 2:g} cells"
        )
    if patches.metric != dictionary.metric:
        raise ValueError(f"the patches are of the {patches.metric} metric and the atoms of the {dictionary.metric} one")
    found = pursue_samples(
        patches.samples,
        dictionary,
        sparsity,
        selection=selection,
        tolerance=error**2 * float(mass(patches.size, patches.metric).sum()),
        nonnegative=nonnegative,
        weights=_preference(patches, dictionary, style, weights),
        device=context.device,
        context=context,
    )
    return SparseCode(
        grid,
        found.indices,
        found.coefficients,
        patches.means,
        found.residuals,
        dictionary.count,
        patches.metric,
        patches.size,
    )


def _preference(
    patches: Patches, dictionary: Dictionary, style: tuple[Mask, ...], weights: dict[str, float]
) -> Floats | None:
    """Return how much each source is wanted at each patch, (n, sources); None where all are alike."""
    names = dictionary.names
    for name, weight in weights.items():
        if name not in names:
            raise ValueError(f"weights: the dictionary has no source '{name}'; {nearest(name, names)}")
        if not 0 <= weight <= 1:
            raise ValueError(f"the weight of '{name}' is {weight:g} and must be between 0 and 1")
    if style and len(style) != len(names):
        raise ValueError(
            f"{len(style)} style masks for the {len(names)} sources of the dictionary ({', '.join(names)}): link one "
            "for each, in this order"
        )
    wanted = np.tile([weights.get(name, 1.0) for name in names], (len(patches.means), 1))
    for source, mask in enumerate(style):
        wanted[:, source] *= _at_centres(mask, patches, names[source])
    return None if (wanted == 1).all() else wanted


def _at_centres(mask: Mask, patches: Patches, name: str) -> Floats:
    """Return a mask at the centres of patches, bilinear between the centres of its cells."""
    from scipy.ndimage import map_coordinates

    assert patches.grid is not None
    data: Any = mask.data
    if not ((data >= 0) & (data <= 1)).all():
        raise ValueError(f"the style mask of '{name}' has voids or values out of 0 to 1; fill or clamp it first")
    terrain, extent = patches.grid.extent, mask.extent
    dx, dy = mask.cell_size
    if (
        extent.west > terrain.west + dx
        or extent.east < terrain.east - dx
        or extent.south > terrain.south + dy
        or extent.north < terrain.north - dy
    ):
        raise ValueError(f"the style mask of '{name}' does not cover the terrain; crop or extend it to the same extent")
    if extent.unit != terrain.unit or (extent.crs and terrain.crs and extent.crs != terrain.crs):
        raise ValueError(f"the style mask of '{name}' is in another coordinate system than the terrain; reproject it")
    east, north = patches.centres.T
    at = [(extent.north - north) / dy - 0.5, (east - extent.west) / dx - 0.5]
    return np.asarray(map_coordinates(data.astype(np.float64), at, order=1, mode="nearest"))
