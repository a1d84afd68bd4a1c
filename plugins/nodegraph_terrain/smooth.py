"""Gaussian smoothing that knows voids and edges."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Forecast, Param, halo, node
from nodegraph_terrain.blocks import GROUP, padded, row_blocks
from nodegraph_terrain.raster import Raster, require_metres

T = TypeVar("T", bound=Raster)
Floats = npt.NDArray[np.float32]
Weights = npt.NDArray[np.float64]

KERNELS = Path(__file__).with_name("smooth.cl")
DIRECT = 40
"""Largest kernel radius, in cells, that the host convolves tap by tap; beyond it the cosine transform is faster."""

WIDEST = 160
"""Largest kernel radius, in cells, that a CPU device convolves; beyond it the host's cosine transform is faster."""

MARGIN = 24
"""Zeros on either side of the kernel's weights, for work items that make several vectors of cells."""

TAPS = 1 << 27
"""Multiplications that a device is given at a time, so that a cancel need not wait for more."""


@node(version=1, locality=halo(metres=lambda sigma, truncate: truncate * sigma))
def gaussian_smooth(
    surface: T,
    *,
    sigma: Annotated[
        float, Param("Standard deviation of the kernel; 0 leaves the surface as it is.", ge=0, unit="m")
    ] = 60.0,
    truncate: Annotated[float, Param("Where the kernel is cut off, in standard deviations.", ge=1, le=8)] = 4.0,
    context: Context,
) -> T:
    """Smooth a surface with a Gaussian kernel.

    Each cell becomes the weighted mean of the cells around it, with weights

        w(i, j) = exp(-(i^2 + j^2) c^2 / (2 sigma^2)) / sum,   |i|, |j| <= r = floor(truncate sigma / c + 1/2),

    on square cells of side c (m).  Beyond the edges the surface is mirrored (the outer row and column are repeated).
    Voids take no part: the weights of the known cells are normalised to sum to 1 (Knutsson & Westin 1993), and voids
    stay voids.  The kernel is separable, so the work per cell grows with r, not r^2; the host turns to a cosine
    transform for wide kernels, of the same truncated weights.  A `sigma` below about 0.4 c changes little, as the
    kernel is sampled at cell centres.

    Args:
        surface: any raster in metres with square cells.
        sigma: standard deviation in metres, the same on the ground whatever the cell size.
        truncate: kernel radius in standard deviations.
        context: the engine's.

    Returns:
        A raster of the same role, shape and extent; values stay within the range of the input, to rounding.

    Raises:
        ValueError: the raster is in degrees or its cells are not square.

    References:
        H. Knutsson, C.-F. Westin (1993): Normalized and differential convolution. CVPR.
        doi:10.1109/CVPR.1993.341081.
    """
    weights = kernel(sigma / require_metres(surface), truncate, max(surface.shape))
    if weights.size == 1:
        return surface
    return surface.like(_smooth(surface.data, weights, context))


@gaussian_smooth.opencl(rtol=1e-4, atol=1e-3)
def _twin(surface: T, *, sigma: float, truncate: float, context: Context) -> T:
    device = context.device
    assert device is not None
    weights = kernel(sigma / require_metres(surface), truncate, max(surface.shape))
    if weights.size == 1:
        return surface
    # Typed as on the host; what it holds here are device arrays.
    heights: Any = surface.data
    if weights.size - 1 > WIDEST and device.info.kind == "cpu":
        wide: Any = device.from_host(_smooth(device.to_host(heights), weights, context))
        return surface.like(wide)
    rows, cols = surface.shape
    radius, reach = weights.size - 1, weights.size - 1 + MARGIN
    taps = np.pad(np.concatenate([weights[:0:-1], weights]), MARGIN).astype(np.float32)
    on_device, voids = device.from_host(taps), device.zeros(1, np.int32)
    mean: Any = device.empty_like(heights)
    smoothed: Any = device.empty_like(heights)

    def launch(name: str, inputs: list[Any], outputs: list[Any]) -> None:
        """Run a pass in bands of rows that take some hundredths of a second each."""
        upright = name.startswith("down")
        width, height, start = (8, 4, 0.5) if upright else (32, 1, 0.0)
        for part in row_blocks(rows, cols * weights.size, context, cells=TAPS, start=start, stop=start + 0.5):
            size = padded(GROUP, -(-cols // width), -(-(part.stop - part.start) // height))
            scalars = (reach, radius, rows, cols, part.start, part.stop)
            device.run(KERNELS, name, size, *inputs, on_device, *scalars, *outputs, local_size=GROUP)
            if part.stop < rows:
                device.finish()

    launch("across", [heights], [mean, voids])
    if device.to_host(voids)[0]:
        share = device.empty_like(heights)
        launch("across_voids", [heights], [mean, share])
        launch("down_voids", [heights, mean, share], [smoothed])
    else:
        launch("down", [mean], [smoothed])
    return surface.like(smoothed)


@gaussian_smooth.forecast
def _forecast(surface: Forecast, *, sigma: float, truncate: float) -> Forecast:  # noqa: ARG001
    # Where there are voids, a second array holds the weights of the known cells.
    return Forecast(surface.bytes, surface.bytes + (8 << 20), surface.about)


def kernel(sigma: float, truncate: float, size: int) -> Weights:
    """Return the half kernel w[0..r] for a `sigma` in cells, normalised so that w[0] + 2 sum(w[1:]) = 1.

    A mirrored raster of n cells repeats every 2 n: over very many repetitions of `size` any kernel is a plain mean, so
    the radius need not grow without bound.
    """
    radius = int(min(truncate * sigma + 0.5, max(64.0 * size, 1 << 20)))
    if radius == 0:
        return np.ones(1)
    taps = np.exp(-0.5 * (np.arange(radius + 1) / sigma) ** 2)
    total: float = taps[0] + 2.0 * taps[1:].sum()
    return np.asarray(taps / total)


def transfer(weights: Weights, size: int) -> Weights:
    """Return what the mirrored convolution of `size` samples multiplies their type-II cosine transform by.

    With the half kernel folded onto the period 2 n of the mirrored samples: H(k) = w0 + 2 sum_j w_j cos(pi j k / n).
    """
    offsets = np.arange(len(weights)) % (2 * size)
    folded = np.bincount(offsets, weights, 2 * size)
    folded += np.bincount(-offsets[1:] % (2 * size), weights[1:], 2 * size)
    return np.asarray(np.fft.rfft(folded).real[:size])


def _convolution(weights: Weights, size: int, axis: int) -> Callable[[Floats, Floats], None]:
    """Return a function that convolves a block along one axis with mirrored edges; its target may be the block."""
    if len(weights) - 1 <= DIRECT:
        from scipy.ndimage import correlate1d

        taps = np.concatenate([weights[:0:-1], weights])

        def direct(block: Floats, out: Floats) -> None:
            correlate1d(block, taps, axis=axis, mode="reflect", output=out)

        return direct
    from scipy.fft import dct, idct

    gain = transfer(weights, size)
    if axis == 0:
        gain = gain[:, None]

    def spectral(block: Floats, out: Floats) -> None:
        spectrum = dct(block.astype(np.float64), axis=axis, overwrite_x=True)
        spectrum *= gain
        out[...] = idct(spectrum, axis=axis, overwrite_x=True)

    return spectral


def _smooth(data: Floats, weights: Weights, context: Context) -> Floats:
    rows, cols = data.shape
    voids = any(bool(np.isnan(data[part]).any()) for part in row_blocks(rows, cols, context, stop=0.05))
    smoothed = np.empty_like(data, order="C")
    known = np.empty_like(smoothed) if voids else None
    convolve = _convolution(weights, cols, 1)
    for part in row_blocks(rows, cols, context, start=0.05, stop=0.45):
        block = data[part]
        if known is not None:
            void = np.isnan(block)
            convolve((~void).astype(np.float32), known[part])
            block = np.where(void, np.float32(0), block)
        convolve(block, smoothed[part])
    convolve = _convolution(weights, rows, 0)
    for part in row_blocks(cols, rows, context, start=0.45, stop=1.0):
        block = smoothed[:, part]
        convolve(block, block)
        if known is not None:
            share = known[:, part]
            convolve(share, share)
            void = np.isnan(data[:, part])
            np.divide(block, share, out=block, where=~void)
            block[void] = np.nan
    return smoothed
