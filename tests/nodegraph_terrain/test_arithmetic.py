from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph_terrain.arithmetic import add, clamp, maximum, minimum, mix, multiply, remap, subtract, to_mask
from nodegraph_terrain.raster import Elevation, Extent, Mask, Raster


def raster(data: Any, role: type = Elevation) -> Any:
    data = np.atleast_2d(np.asarray(data, np.float32))
    return role(data, Extent(0, 0, data.shape[1], data.shape[0]))


A, B, C = raster([1, 2, np.nan]), raster([10, 0.5, 3], Raster), raster([2, 2, 2], Mask)


@pytest.mark.parametrize(
    ("node", "params", "expected"),
    [
        (add, {"constant": 100.0}, [113, 104.5]),
        (subtract, {"constant": 100.0}, [-111, -100.5]),
        (multiply, {"factor": 0.5}, [10, 1]),
        (minimum, {}, [1, 0.5]),
        (minimum, {"limit": 0.75}, [0.75, 0.5]),
        (maximum, {}, [10, 2]),
        (maximum, {"limit": 2.5}, [10, 2.5]),
    ],
)
def test_cell_by_cell_with_the_role_of_the_first(node: Any, params: dict[str, float], expected: list[float]) -> None:
    result = node(A, B, C, **params)
    assert type(result) is Elevation
    assert result.extent is A.extent
    np.testing.assert_allclose(result.data[0, :2], expected)
    assert np.isnan(result.data[0, 2])
    assert type(node(C, A)) is Mask


@pytest.mark.parametrize("node", [add, subtract, multiply, minimum, maximum, clamp])
def test_one_raster_alone_stays_as_it_is(node: Any) -> None:
    assert np.array_equal(node(A).data, A.data, equal_nan=True)


@given(values=st.lists(st.floats(-1e6, 1e6, width=32), min_size=1, max_size=20), low=st.floats(-1e5, 1e5))
def test_clamp_and_its_halves(values: list[float], low: float) -> None:
    high = low + 500
    given = clamp(raster(values), minimum=low, maximum=high).data[0]
    expected = np.clip(np.array(values, np.float32), np.float32(low), np.float32(high))
    assert np.array_equal(given, expected)
    assert np.array_equal(minimum(maximum(raster(values), limit=low), limit=high).data[0], expected)


def test_mix_by_the_mask() -> None:
    first, second = raster([1, 1, 1, 1, np.nan, 1]), raster([5, 5, 5, np.nan, 5, 5], Raster)
    mask = raster([0, 0.25, 7, 0, 1, np.nan], Mask)
    given = mix(first, second, mask)
    assert type(given) is Elevation
    np.testing.assert_array_equal(given.data[0], np.array([1, 2, 5, 1, 5, np.nan], np.float32))


def test_remap_straight_and_clamped() -> None:
    surface = raster([0, 5, 10, 20, np.nan])
    given = remap(surface, from_minimum=0.0, from_maximum=10.0, to_minimum=100.0, to_maximum=0.0).data[0]
    np.testing.assert_array_equal(given, [100, 50, 0, -100, np.nan])
    given = remap(surface, from_minimum=0.0, from_maximum=10.0, to_minimum=100.0, to_maximum=0.0, clamp=True).data[0]
    np.testing.assert_array_equal(given, [100, 50, 0, 0, np.nan])
    np.testing.assert_array_equal(remap(surface).data[0], [0, 0.25, 0.5, 1, np.nan])
    np.testing.assert_array_equal(remap(surface, from_minimum=10.0).data[0], [-1, -0.5, 0, 1, np.nan])


@given(
    heights=st.lists(st.floats(0, 1), min_size=2, max_size=6),
    at=st.lists(st.floats(-0.5, 1.5), min_size=1, max_size=9),
)
def test_a_curve_meets_its_points_and_stays_between_them(heights: list[float], at: list[float]) -> None:
    x = np.linspace(0, 1, len(heights))
    curve = tuple(zip(x.tolist(), heights, strict=True))
    fixed = {"from_minimum": 0.0, "from_maximum": 1.0, "curve": curve}
    np.testing.assert_allclose(remap(raster(x), **fixed).data[0], heights, atol=1e-6)
    for value, result in zip(at, remap(raster(at), **fixed).data[0], strict=True):
        k = int(np.clip(np.searchsorted(x, np.float32(value)) - 1, 0, len(x) - 2))
        low, high = sorted(heights[k : k + 2])
        ends = {heights[0], heights[-1]}
        assert low - 1e-6 <= result <= high + 1e-6 or any(abs(result - end) < 1e-6 for end in ends)


def test_rasters_of_one_value_or_none_go_through() -> None:
    assert remap(raster([3, 3]), to_minimum=7.0).data.tolist() == [[7, 7]]
    assert np.isnan(remap(raster([np.nan, np.nan])).data).all()


def test_masks_by_thresholds() -> None:
    surface = raster([0, 10, 15, 20, 30, np.nan])
    given = to_mask(surface, lower=10.0, upper=20.0)
    assert type(given) is Mask
    np.testing.assert_array_equal(given.data[0], [0, 0, 0.5, 1, 1, np.nan])
    sharp = to_mask(surface, lower=15.0, upper=15.0, invert=True)
    np.testing.assert_array_equal(sharp.data[0], [1, 1, 0, 0, 0, np.nan])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: add(A, raster([1, 2])), "do not match"),
        (lambda: mix(A, B, raster([1, 2], Mask)), "do not match"),
        (lambda: multiply(A, factor=1e300), "too large for float32"),
        (lambda: multiply(raster([1e30]), factor=1e30), "use smaller values"),
        (lambda: add(raster([3e38]), raster([3e38])), "use smaller values"),
        (lambda: remap(raster([0, 1]), to_maximum=1e300), "narrower range"),
        (lambda: remap(A, from_minimum=2.0, from_maximum=2.0), "must be below from_maximum"),
        (lambda: remap(A, curve=((0.0, 0.0),)), "two or more points"),
        (lambda: remap(A, curve=((0.0, 0.0), (0.0, 1.0))), "x rise"),
        (lambda: clamp(A, minimum=2.0, maximum=1.0), "must not be above maximum"),
        (lambda: to_mask(A, lower=2.0, upper=1.0), "set invert"),
    ],
)
def test_what_is_wrong_is_said(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
