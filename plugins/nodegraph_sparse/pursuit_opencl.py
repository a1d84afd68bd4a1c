"""The rounds of a pursuit on an OpenCL device with float64; BLAS makes the products."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from nodegraph_sparse.pursuit_rules import DEPENDENT, NOISE, Floats, Preference, Rule

if TYPE_CHECKING:
    from nodegraph.opencl import Device

KERNELS = Path(__file__).parent.joinpath("kernels/pursuit.cl")

LANES = 8
"""Atoms are padded with zeros to a multiple of this."""

ALGORITHMS = {"ols": 0, "omp": 1, "mp": 2}


def can_pursue(device: Device) -> bool:
    """Say whether the device computes in float64."""
    return "cl_khr_fp64" in device.context.devices[0].extensions


def work_group(device: Device) -> tuple[int, int]:
    """Return how many atoms a work item takes at a time, and how many work items follow a signal together."""
    return (LANES, 1) if device.info.kind == "cpu" else (1, 128)


def rounds_on(
    device: Device, unit: Floats, rule: Rule
) -> Callable[[Floats, Floats, Floats, Preference | None], tuple[npt.NDArray[Any], Floats, Floats]]:
    """Prepare for a dictionary, and return what takes signals through the rounds.

    Args:
        device: one that `can_pursue`.
        unit: (N, k), atoms of norm 1 or 0.
        rule: how to choose.

    Returns:
        From signals, their squared norms, tolerances and preference to atoms, coefficients and squared residuals.
    """
    padded = np.pad(unit, ((0, -len(unit) % LANES), (0, 0)))
    count = len(padded)
    products = padded @ padded.T
    gram, lengths, atoms = map(device.from_host, (products, products.diagonal().copy(), padded))
    lanes, group = work_group(device)
    groups = 16 * device.info.compute_units
    # A row of atoms of an odd number of cache lines: rows do not fall on each other in the cache.
    stride = count + LANES * (1 + count // LANES % 2)
    room = (3 + (rule.sparsity if rule.refits else 0)) * stride + 2 * (rule.sparsity + -rule.sparsity % LANES)
    scratch = device.empty(groups * room, np.float64)

    def rounds(
        signals: Floats, squares: Floats, tolerance: Floats, preference: Preference | None
    ) -> tuple[npt.NDArray[Any], Floats, Floats]:
        program = device.program(
            KERNELS,
            LANES=lanes,
            GROUP=group,
            ALGORITHM=ALGORITHMS[rule.selection],
            NONNEGATIVE=rule.nonnegative,
            WEIGHTED=preference is not None,
            DEPENDENT=repr(DEPENDENT),
            NOISE=repr(NOISE),
        )
        weights = sources = None
        kinds = 0
        if preference is not None:
            kinds = preference.weights.shape[1]
            weights = device.from_host(preference.weights)
            sources = device.from_host(np.pad(preference.sources, (0, count - len(unit))))
        indices = device.empty((len(signals), rule.sparsity), np.int32)
        coefficients = device.empty((len(signals), rule.sparsity), np.float64)
        residuals = device.empty(len(signals), np.float64)
        given = device.from_host(signals)
        device.run(
            program,
            "pursue",
            min(groups, len(signals)) * group,
            device.from_host(signals @ padded.T),
            gram,
            lengths,
            device.from_host(squares),
            device.from_host(tolerance),
            weights,
            sources,
            len(signals),
            count,
            rule.sparsity,
            rule.rounds,
            kinds,
            stride,
            room,
            scratch,
            indices,
            coefficients,
            local_size=group,
        )
        sizes = unit.shape[1], rule.sparsity
        device.run(program, "leave", len(signals), given, atoms, indices, coefficients, *sizes, residuals)
        device.finish()
        return device.to_host(indices), device.to_host(coefficients), device.to_host(residuals)

    return rounds
