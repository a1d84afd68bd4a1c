"""Comparing values: rasters cropped, and whole values leaf by leaf."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from nodegraph.porttypes import field_names

Window = tuple[slice, slice]


def is_raster(value: Any) -> bool:
    """Say whether a value is on a grid that can be cropped: it has `shape` and ``window(rows, cols)``."""
    return hasattr(value, "window") and hasattr(value, "shape")


def windows(shape: tuple[int, int]) -> list[Window]:
    """Return windows in the interior, at every border and of a single cell."""
    thirds = [sorted({0, side // 3, 2 * side // 3, side}) for side in shape]
    rows, cols = ([slice(a, b) for a, b in itertools.pairwise(marks)] for marks in thirds)
    middle = (slice(shape[0] // 2, shape[0] // 2 + 1), slice(shape[1] // 2, shape[1] // 2 + 1))
    return [*itertools.product(rows, cols), middle]


def widened(window: Window, reach: int, shape: tuple[int, int]) -> Window:
    """Return the window with `reach` more cells on each side, as far as there are any."""
    rows, cols = (
        slice(max(part.start - reach, 0), min(part.stop + reach, side))
        for part, side in zip(window, shape, strict=True)
    )
    return rows, cols


def within(window: Window, wide: Window) -> Window:
    """Return where `window` lies inside `wide`."""
    rows, cols = (
        slice(part.start - around.start, part.stop - around.start) for part, around in zip(window, wide, strict=True)
    )
    return rows, cols


def leaves(value: Any) -> Iterator[Any]:
    """Yield the arrays, numbers and texts of a value in the order of its fields."""
    stack = [value]
    while stack:
        item = stack.pop()
        names = field_names(type(item))
        parts = item if isinstance(item, tuple) else None if names is None else [getattr(item, name) for name in names]
        if parts is None:
            yield item
        else:
            stack.extend(reversed(parts))


def difference(given: Any, expected: Any, *, rtol: float, atol: float) -> str:
    """Return in words how two arrays or scalars differ by more than is allowed, or an empty text.

    Allowed is ``atol`` and ``rtol`` times the range of the expected values.
    """
    if isinstance(expected, (bool, str, bytes, int)) or expected is None:
        return "" if given == expected else f"{given!r} is not {expected!r}"
    a, b = np.asarray(given), np.asarray(expected)
    if a.shape != b.shape:
        return f"shape {a.shape} is not {b.shape}"
    if a.dtype != b.dtype:
        return f"dtype {a.dtype} is not {b.dtype}"
    if b.size == 0 or not np.issubdtype(b.dtype, np.number):
        return "" if np.array_equal(a, b) else "its contents differ"
    wide = np.complex128 if np.issubdtype(b.dtype, np.complexfloating) else np.float64
    a, b = a.astype(wide), b.astype(wide)
    if not np.array_equal(np.isnan(a), np.isnan(b)):
        return "it is void (NaN) elsewhere"
    finite = np.isfinite(a) & np.isfinite(b)
    if not np.array_equal(a[~finite & ~np.isnan(a)], b[~finite & ~np.isnan(b)]):
        return "it is infinite elsewhere"
    if not finite.any():
        return ""
    largest = float(np.abs(b[finite]).max())
    span = float(np.ptp(b[finite])) if wide is np.float64 else largest
    allowed = atol + rtol * max(span, largest * 1e-6)
    worst = float(np.abs(a[finite] - b[finite]).max())
    return "" if worst <= allowed else f"by {worst:g}, allowed {allowed:g}"
