"""Patches: what they are cut from, what is taken off, and that they give the terrain back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph_sparse.metric import columns, fall_off, means
from nodegraph_sparse.patch_grid import patch_grid
from nodegraph_sparse.patches import patches
from nodegraph_sparse.windows import cut, turn
from nodegraph_terrain.raster import Elevation, Extent


def ground(rows, cols, cell=10.0, seed=0):
    heights = np.cumsum(np.random.default_rng(seed).normal(size=(rows, cols)), axis=1) + 400
    return Elevation(heights.astype(np.float32), Extent(1000.0, 2000.0, 1000 + cols * cell, 2000 + rows * cell))


@given(
    st.integers(1, 6),
    st.integers(0, 17),
    st.integers(0, 17),
    st.sampled_from(["weighted", "plain"]),
    st.integers(0, 99),
)
def test_blended_patches_give_the_terrain_back(half, more_rows, more_cols, metric, seed):
    surface = ground(2 * half + more_rows, 2 * half + more_cols, seed=seed)
    found = patches(surface, radius=10.0 * half, metric=metric)
    assert found.grid is not None
    assert vars(found.grid) == vars(patch_grid(surface.extent, surface.shape, half))
    total, weight = (np.zeros((surface.shape[0] + 4 * half, surface.shape[1] + 4 * half)) for _ in range(2))
    for samples, mean, (x, y) in zip(found.samples, found.means, found.centres, strict=True):
        row, col = round((surface.extent.north - y) / 10) + half, round((x - surface.extent.west) / 10) + half
        place = np.s_[row : row + 2 * half, col : col + 2 * half]
        total[place] += fall_off(2 * half) * (samples + mean)
        weight[place] += fall_off(2 * half)
    inside = np.s_[2 * half : 2 * half + surface.shape[0], 2 * half : 2 * half + surface.shape[1]]
    assert weight[inside].min() > 0
    np.testing.assert_allclose(total[inside] / weight[inside], surface.data, atol=2e-4)


@pytest.mark.parametrize("metric", ["weighted", "plain"])
@pytest.mark.parametrize("how", [{}, {"count": 30, "rotations": "quarter"}, {"count": 30, "rotations": "any"}])
def test_means_are_taken_off_in_the_metric(metric, how):
    found = patches(ground(40, 50), radius=50.0, metric=metric, **how)
    assert np.abs(means(found.samples, metric)).max() < 1e-5
    assert found.metric == metric
    assert found.samples.dtype == np.float32


def test_beyond_the_border_slopes_go_on():
    x, y = np.meshgrid(np.arange(23.0), np.arange(19.0))
    plane = Elevation((3 * x - 2 * y).astype(np.float32), Extent(0.0, 0.0, 23.0, 19.0))
    found = patches(plane, radius=4.0)
    np.testing.assert_allclose(found.samples, np.broadcast_to(found.samples[8], found.samples.shape), atol=1e-4)
    np.testing.assert_allclose(np.diff(found.samples[0], axis=1), 3, atol=1e-4)


def test_random_patches_are_windows_of_the_terrain():
    surface = ground(31, 37)
    found = patches(surface, radius=40.0, count=60, seed=3)
    assert found.grid is None
    corners = np.stack([(surface.extent.north - found.centres[:, 1]) / 10, (found.centres[:, 0] - 1000) / 10], axis=1)
    corners = np.rint(corners).astype(int) - 4
    assert corners.min() >= 0
    assert (corners + 8 <= surface.shape).all()
    assert len(np.unique(corners, axis=0)) > 30
    np.testing.assert_allclose(
        found.samples + found.means[:, None, None], cut(surface.data, corners, 8), atol=1e-3
    )  # fmt: skip


def test_quarter_turns_and_mirrors_are_symmetries_of_the_same_places():
    surface = ground(31, 37)
    straight = patches(surface, radius=40.0, count=80, seed=3)
    turned = patches(surface, radius=40.0, count=80, rotations="quarter", mirror=True, seed=3)
    np.testing.assert_array_equal(straight.centres, turned.centres)
    all_turns = np.stack([turn(straight.samples, np.full(80, number)) for number in range(8)])
    match = np.abs(all_turns - turned.samples).max(axis=(2, 3)) < 1e-4
    assert match.any(axis=0).all()
    assert match.any(axis=1).all()


def test_any_angle_turns_what_a_function_says():
    x, y = np.meshgrid(np.arange(120) - 59.5, 59.5 - np.arange(120))
    surface = Elevation((x + 0.25 * x * y / 30).astype(np.float32), Extent(-60.0, -60.0, 60.0, 60.0))
    found = patches(surface, radius=8.0, count=20, rotations="any", seed=1)
    away = np.arange(16) - 7.5
    east, north = np.meshgrid(away, -away)
    for samples, mean, (x0, y0) in zip(found.samples, found.means, found.centres, strict=True):
        angles = np.linspace(0, 2 * np.pi, 721)[:, None, None]
        px = x0 + east * np.cos(angles) + north * np.sin(angles)
        py = y0 - east * np.sin(angles) + north * np.cos(angles)
        errors = np.abs(px + 0.25 * px * py / 30 - (samples + mean)).max(axis=(1, 2))
        assert errors.min() < 0.1  # half a step of the angles searched
        assert errors.max() > 5


@given(st.integers(0, 7), st.integers(0, 7))
def test_turns_are_the_symmetries_of_the_square(first, second):
    window = np.arange(9.0).reshape(1, 3, 3)
    every = [turn(window, np.array([number]))[0].tolist() for number in range(8)]
    assert len({str(one) for one in every}) == 8
    assert turn(turn(window, np.array([first])), np.array([second]))[0].tolist() in every
    np.testing.assert_array_equal(turn(window, np.array([1]))[0], np.rot90(window[0]))
    np.testing.assert_array_equal(turn(window, np.array([4]))[0], window[0, :, ::-1])


def test_what_is_refused():
    surface = ground(20, 30)
    with pytest.raises(ValueError, match=r"25 m is 2.5 cells.* 20 or 30 m"):
        patches(surface, radius=25.0)
    with pytest.raises(ValueError, match=r"0.3 cells.*: 10 m"):
        patches(surface, radius=3.0)
    with pytest.raises(ValueError, match=r"smaller than one patch of 22 by 22.*at most 100 m"):
        patches(surface, radius=110.0)
    holed = surface.data.copy()
    holed[3, 4] = np.nan
    with pytest.raises(ValueError, match=r"1 of 600 cells have no height; fill"):
        patches(surface.like(holed), radius=40.0)
    with pytest.raises(ValueError, match="degrees"):
        patches(replace(surface, extent=Extent(8.0, 46.0, 9.0, 47.0, unit="deg")), radius=40.0)
    with pytest.raises(ValueError, match="beside their cells"):
        patches(replace(surface, extent=Extent(0.0, 0.0, 300.0, 201.0)), radius=40.0)
    with pytest.raises(ValueError, match="do not cover a terrain"):
        patches(surface, radius=40.0, rotations="quarter")
    with pytest.raises(ValueError, match="too small to turn"):
        patches(surface, radius=90.0, count=3, rotations="any")


def test_columns_of_patches_have_their_norms():
    found = patches(ground(24, 24), radius=40.0)
    vectors = columns(found.samples, "weighted")
    np.testing.assert_allclose((vectors**2).sum(axis=1), (fall_off(8) * found.samples**2).sum(axis=(1, 2)), rtol=1e-5)
