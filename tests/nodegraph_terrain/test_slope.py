from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph_terrain import blocks
from nodegraph_terrain.raster import Elevation, Extent, Raster, Slope
from nodegraph_terrain.slope import aspect, slope


def ground(data: np.ndarray, cell: tuple[float, float] = (1.0, 1.0)) -> Elevation:
    rows, cols = data.shape
    return Elevation(np.asarray(data, np.float32), Extent(0, 0, cols * cell[0], rows * cell[1]))


def plane(shape: tuple[int, int], east: float, north: float, cell: tuple[float, float]) -> np.ndarray:
    rows, cols = np.indices(shape)
    return 100 + east * cols * cell[0] - north * rows * cell[1]


def horn(data: np.ndarray, i: int, j: int, cell: tuple[float, float]) -> tuple[float, float]:
    """Horn's gradient of one cell, in plain Python after the documented rule."""
    rows, cols = data.shape

    def height(di: int, dj: int) -> float:
        inside = 0 <= i + di < rows and 0 <= j + dj < cols
        return float(data[i + di, j + dj]) if inside else math.nan

    def filled(di: int, dj: int) -> float:
        own, opposite = height(di, dj), height(-di, -dj)
        return 2 * height(0, 0) - opposite if math.isnan(own) else own

    def mean(pairs: list[tuple[float, float, int]]) -> float:
        known = [(a - b, weight) for a, b, weight in pairs if not math.isnan(a - b)]
        return sum(d * w for d, w in known) / sum(w for _, w in known) if known else 0.0

    across = mean([(filled(k, 1), filled(k, -1), 2 - abs(k)) for k in (-1, 0, 1)])
    down = mean([(filled(-1, k), filled(1, k), 2 - abs(k)) for k in (-1, 0, 1)])
    return across / (2 * cell[0]), down / (2 * cell[1])


@given(east=st.floats(-3, 3), north=st.floats(-3, 3), rows=st.integers(2, 6), cols=st.integers(2, 6))
def test_planes_are_exact_to_the_edges_and_beside_voids(east: float, north: float, rows: int, cols: int) -> None:
    cell = (30.0, 20.0)
    data = plane((rows, cols), east, north, cell)
    expected = math.degrees(math.atan(math.hypot(east, north)))
    np.testing.assert_allclose(slope(ground(data, cell)).data, expected, atol=2e-3)
    if rows > 3 and cols > 3:
        data[1, 2] = np.nan
        given = slope(ground(data, cell)).data
        assert np.isnan(given[1, 2])
        np.testing.assert_allclose(np.delete(given.ravel(), cols + 2), expected, atol=2e-3)


@given(
    rows=st.integers(1, 7),
    cols=st.integers(1, 7),
    voids=st.sampled_from([0.0, 0.2, 0.7]),
    seed=st.integers(0, 1000),
)
def test_agrees_with_horn_cell_by_cell(rows: int, cols: int, voids: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = rng.uniform(0, 50, (rows, cols)).astype(np.float32)
    data[rng.random(data.shape) < voids] = np.nan
    cell = (7.0, 11.0)
    steep, facing = slope(ground(data, cell), z_factor=2.0).data, aspect(ground(data, cell)).data
    for (i, j), height in np.ndenumerate(data):
        if math.isnan(height):
            assert math.isnan(steep[i, j])
            assert math.isnan(facing[i, j])
            continue
        east, north = horn(data, i, j, cell)
        assert steep[i, j] == pytest.approx(math.degrees(math.atan(2 * math.hypot(east, north))), abs=1e-3)
        if math.hypot(east, north) > 1e-3:
            turn = (facing[i, j] - math.degrees(math.atan2(-east, -north)) + 180) % 360 - 180
            assert abs(turn) < 0.05


@pytest.mark.parametrize(
    ("east", "north", "facing"),
    [(0, -1, 0), (-1, -1, 45), (-1, 0, 90), (-1, 1, 135), (0, 1, 180), (1, 1, 225), (1, 0, 270), (1, -1, 315)],
)
def test_aspect_is_the_way_down_by_the_compass(east: float, north: float, facing: float) -> None:
    given = aspect(ground(plane((5, 5), east, north, (1, 1))))
    assert type(given) is Raster
    np.testing.assert_allclose(given.data, facing, atol=1e-3)
    assert (given.data < 360).all()


def test_level_ground_faces_nowhere() -> None:
    assert np.isnan(aspect(ground(np.full((4, 4), 7.0))).data).all()
    assert (slope(ground(np.full((4, 4), 7.0))).data == 0).all()


def test_a_lonely_cell_is_level() -> None:
    data = np.full((5, 5), np.nan)
    data[2, 2] = 100
    given = slope(ground(data))
    assert type(given) is Slope
    assert given.data[2, 2] == 0
    assert np.isnan(given.data).sum() == 24
    assert slope(ground(np.array([[5.0]]))).data.tolist() == [[0.0]]


def test_large_rasters_in_blocks_are_seamless(monkeypatch: pytest.MonkeyPatch) -> None:
    data = np.random.default_rng(1).normal(0, 20, (37, 23)).astype(np.float32)
    whole = slope(ground(data, (10, 10))).data
    monkeypatch.setattr(blocks.row_blocks, "__kwdefaults__", {"cells": 23 * 4, "start": 0.0, "stop": 1.0})
    assert np.array_equal(slope(ground(data, (10, 10))).data, whole)


def test_refuses_degrees() -> None:
    given = Elevation(np.zeros((3, 3), np.float32), Extent(0, 0, 1, 1, unit="deg"))
    for node in (slope, aspect):
        with pytest.raises(ValueError, match=r"terrain\.reproject"):
            node(given)
