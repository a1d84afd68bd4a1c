"""The node that makes a terrain of a dictionary and a code."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node
from nodegraph_sparse.dictionary import BLOCK, Dictionary, SparseCode
from nodegraph_sparse.noise_dictionary import NoiseDictionary
from nodegraph_sparse.sparse_function import SparseTerrain
from nodegraph_tree.falloff import FallOff
from nodegraph_tree.from_elevation import Interpolation
from nodegraph_tree.function import ElevationFunction
from nodegraph_tree.pixels import PAD


@node(version=1)
def sparse_terrain(
    dictionary: Dictionary,
    code: SparseCode,
    *,
    interpolation: Annotated[Interpolation, Param("Of the samples of atoms: bicubic is C1, bilinear C0.")] = "bicubic",
    size: Annotated[
        int | None,
        Param("Samples along a side of atoms that are functions; none: the dictionary's own.", ge=2, le=4096),
    ] = None,
    factor: Annotated[
        int, Param("How many times as fine as the dictionary's own the samples of functions are.", ge=1, le=256)
    ] = 1,
    contrast: Annotated[float, Param("What the relief of atoms is multiplied by; means stay as they are.", ge=0)] = 1.0,
    exaggeration: Annotated[
        float | None, Param("How many times as steep as measured windows of an exemplar may be; none: any.", gt=0)
    ] = None,
    margin: Annotated[
        float, Param("Where the weight falls to 0 within the edges; 0: it is 1 up to them.", ge=0, unit="m")
    ] = 0.0,
    fall_off: Annotated[FallOff, Param("How the weight falls over the margin.")] = "cubic",
    context: Context,
) -> ElevationFunction:
    """Make a terrain of a dictionary and a code: a sparse construction tree, to be edited like any other.

    Over each disc of radius R around a centre c_i of the grid lies F_i(p) = z_i + sum_j x_ij d_(k_ij)(p - c_i), and

        f(p) = sum_i alpha_i(p) F_i(p) / sum_i alpha_i(p),  alpha_i(p) = (1 - |p - c_i|^2 / R^2)^3 in the disc.

    Atoms are interpolated through their samples: ``bicubic`` (Catmull-Rom) or ``bilinear``, and continued by odd
    reflection beyond the outer ones.  The dictionary is that of the code, or its counterpart in more detail, atom by
    atom: the ``high`` of a multi-resolution dictionary whose ``low`` was coded.  Atoms that no patch uses are left out.
    More than half a radius beyond the outer centres the alphas stay what they are; a terrain only reaches there where
    its radius is an odd number of cells, and by half a cell.

    Sampled at the cells of the terrain that was coded, the result is what the code says, to rounding.  The weight is 1
    inside and falls to 0 at the edges over the margin.  Without one it is 1 up to the very edges, so that finer samples
    cover the extent too, and falls to 0 beyond, over half a sample.  At a level of detail kappa < 1 what the atoms add
    to the blend of the means z is multiplied by 1 - (1 - kappa^2)^3.

    Args:
        dictionary: atoms d, of any kind.
        code: where patches are, with their means z, atoms k and coefficients x.
        interpolation: between samples.
        size: even; a noise dictionary's functions show more of themselves at a higher one.
        factor: the same, as a multiple of the dictionary's own size, whatever that is.
        contrast: 1 is what the code says.  Where discs overlap their atoms blend, and detail that differs from disc to
            disc loses height: amplified terrain comes closest to real ground at about 1.2.
        exaggeration: coefficients that would make an atom steeper, the contrast included, are lowered.  Gentle ground
            that stands for a mountain shows spires, holes and what its instrument added; 2 keeps amplified terrain free
            of them.  It holds for atoms of an exemplar alone, whose heights and cells are known.
        margin: at most half the narrower side.
        fall_off: of the weight over the margin.
        context: the engine's.

    Raises:
        ValueError: the dictionary has another number of atoms or another metric than the code's, an odd size or one
            that is no multiple of the code's; it holds no functions that could be sampled anew, or the size is stated
            twice; an atom, a mean or a coefficient is not finite; the grid is in degrees or reaches beyond its discs;
            or the margin is too wide.

    Complexity: O(s) a point, with 4 discs at most over it, 16 samples of each.  It holds the atoms that are used, and
    16 bytes a coefficient.

    Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum
    35(2), sections 4.1 and 5, doi:10.1111/cgf.12821.
    """
    if factor > 1:
        if size is not None:
            raise ValueError(f"the samples of atoms are stated twice; either {size} along a side or {factor} times")
        size = factor * dictionary.size
    if size is not None and size != dictionary.size:
        if not isinstance(dictionary, NoiseDictionary):
            raise ValueError(
                f"the dictionary holds samples, {dictionary.size} along a side, which cannot become {size}; leave the "
                "size out, or link a dictionary of noise"
            )
        dictionary = dictionary.resampled(size)
    _check(dictionary, code, margin)
    used, places = np.unique(code.indices, return_inverse=True)
    none = int(np.count_nonzero(used < 0))
    indices = np.maximum(places.reshape(code.indices.shape) - none, 0).astype(np.int32)
    coefficients = np.where(code.indices >= 0, contrast * code.coefficients, 0.0).astype(np.float64)
    if exaggeration is not None:
        cell = 2 * code.grid.radius / dictionary.size
        times = np.abs(coefficients) * dictionary.exaggerations(np.maximum(code.indices, 0), cell)
        coefficients /= np.maximum(times / exaggeration, 1.0)
    # Columns that no patch uses would cost as much as others.
    terms = int(np.count_nonzero((code.indices >= 0).any(axis=0)))
    atoms = _continued(dictionary, used[none:], context)
    return SparseTerrain(
        code.grid, atoms, indices[:, :terms], coefficients[:, :terms], code.means.astype(np.float64),
        margin, interpolation, fall_off,
    )  # fmt: skip


def _check(dictionary: Dictionary, code: SparseCode, margin: float) -> None:
    grid, extent, size = code.grid, code.grid.extent, dictionary.size
    if not grid.count:
        raise ValueError("the code has no patches: it is of patches at random places; link one of a grid")
    if dictionary.count != code.atoms:
        raise ValueError(
            f"the code is one of {code.atoms} atoms and the dictionary has {dictionary.count}; link the dictionary "
            "that the code was made with, or its high counterpart"
        )
    if dictionary.metric != code.metric:
        raise ValueError(
            f"the code was made in the {code.metric} metric and the dictionary in the {dictionary.metric} one; make "
            "both in the same"
        )
    if size % 2:
        raise ValueError(f"atoms of {size} by {size} samples have none on each other; give them an even size")
    if code.size is not None and size % code.size:
        raise ValueError(
            f"atoms of {size} samples along a side do not fit a code of patches of {code.size}; link the dictionary "
            "that the code was made with, or one of a multiple of its size"
        )
    if extent.unit != "m":
        raise ValueError("the grid of the code is in degrees; code a terrain in metres")
    west, north = (grid.west - extent.west) / grid.radius, (extent.north - grid.north) / grid.radius
    east = (extent.width / grid.radius) - west - (grid.cols - 1)
    south = (extent.height / grid.radius) - north - (grid.rows - 1)
    if max(west, north, east, south) > 1 + 1e-6:
        raise ValueError(
            f"the extent of the code reaches {max(west, north, east, south):.3g} radii beyond the outer centres of its "
            "grid; 1 is possible"
        )
    if 2 * margin > min(extent.width, extent.height):
        raise ValueError(
            f"a margin of {margin:g} m leaves nothing of a terrain {extent.width:g} m by {extent.height:g} m; "
            f"{0.5 * min(extent.width, extent.height):g} m are possible"
        )
    for name, values in (("mean", code.means), ("coefficient", code.coefficients)):
        wrong = np.argwhere(~np.isfinite(values))
        if len(wrong):
            where = tuple(wrong[0].tolist())
            raise ValueError(f"the {name} of patch {where[0]} is {values[where]}; it must be a finite number")


def _continued(dictionary: Dictionary, which: npt.NDArray[Any], context: Context) -> npt.NDArray[np.float32]:
    """Return some atoms, each with two more samples on every side, by odd reflection: slopes go on."""
    size = dictionary.size
    found = np.empty((len(which), size + 2 * PAD, size + 2 * PAD), np.float32)
    step = max(1, BLOCK // size**2)
    for start in range(0, len(which), step):
        context.progress(start / len(which))
        some = which[start : start + step]
        samples = dictionary.atoms(some)
        finite = np.isfinite(samples).all(axis=(1, 2))
        if not finite.all():
            raise ValueError(f"atom {some[int(np.argmin(finite))]} has samples that are not finite numbers")
        around = ((0, 0), (PAD, PAD), (PAD, PAD))
        found[start : start + len(some)] = np.pad(samples, around, mode="reflect", reflect_type="odd")
    return found
