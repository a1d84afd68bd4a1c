"""Instances: where they stand, that they share one tree, and that ten thousand of them are quick."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph import Context, codec
from nodegraph_terrain.raster import Extent, Mask
from nodegraph_tree.affine import Affine, placed
from nodegraph_tree.blend import Blend, blend
from nodegraph_tree.disc import disc
from nodegraph_tree.function import Points, walk
from nodegraph_tree.scatter import instances, poisson_discs, scatter
from tests.nodegraph_tree.strategies import grid, on_device

MOUNTAIN = disc(radius=600.0, style="mountains", amplitude=200.0, wavelength=700.0, seed=4)


@pytest.fixture(scope="module")
def device() -> Any:
    from nodegraph.opencl import choose

    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen


def _nearest(points: Any) -> Any:
    from scipy.spatial import cKDTree

    return cKDTree(points).query(points, k=2)[0][:, 1]


@given(st.floats(60, 300), st.integers(0, 2**32))
@settings(max_examples=15)
def test_points_keep_their_distance_and_fill_the_area(spacing: float, seed: int) -> None:
    area = Extent(1e5, 2e5, 1e5 + 3000, 2e5 + 1500)
    points = poisson_discs(area, spacing, Context(seed=seed))
    assert ((points >= [area.west, area.south]) & (points <= [area.east, area.north])).all()
    if len(points) > 1:
        assert _nearest(points).min() >= spacing * (1 - 1e-12)
    again = poisson_discs(area, spacing, Context(seed=seed))
    assert np.array_equal(points, again)
    # Discs thrown until there is no room cover 55 % (without the rim).
    room = (area.width + spacing) * (area.height + spacing)
    assert 0.47 - 0.6 / len(points) ** 0.5 < len(points) * np.pi * spacing**2 / 4 / room < 0.62


def test_a_density_thins_the_points_out() -> None:
    area = Extent(0, 0, 6000, 6000)
    share = np.tile(np.linspace(0, 1, 60, dtype=np.float32), (60, 1))
    points = poisson_discs(area, 60.0, Context(seed=3), density=Mask(share, area))
    counts = np.histogram(points[:, 0], 6, (0, 6000))[0]
    # Bins of mean density 1/12, 3/12 ...
    expected = (np.arange(6) + 0.5) / 6 * counts[-1] / (5.5 / 6)
    assert (np.abs(counts - expected) < 0.12 * counts[-1]).all()
    near = _nearest(points)
    least = 60 / np.sqrt(np.clip(points[:, 0] / 6000, 0.02, 1))
    assert near.min() >= 59.9
    assert np.median(near[points[:, 0] < 1500] / least[points[:, 0] < 1500]) > 0.9
    none = np.where(share > 0.5, share, np.nan).astype(np.float32)
    right = poisson_discs(area, 100.0, Context(seed=3), density=Mask(none, area))
    assert right[:, 0].min() > 2900


def test_instances_share_the_tree_that_copies_repeat() -> None:
    places = ((0.0, 0.0), (500.0, 100.0), (900.0, 900.0))
    found = instances(MOUNTAIN, positions=places, rotations=(0.0, 45.0, 200.0), scales=(1.0, 2.0, 0.5), rises=(10.0,))
    copies = blend(
        [
            placed(codec.decode(codec.encode(MOUNTAIN)), position=p, rotation=turn, size=(size, size), rise=10.0)
            for p, turn, size in zip(places, (0.0, 45.0, 200.0), (1.0, 2.0, 0.5), strict=True)
        ]
    )
    points = Points(*np.random.default_rng(0).uniform(-800, 1800, (2, 4000)))
    one, other = found.query(points), copies.query(points)
    assert np.array_equal(one.weight, other.weight)
    assert np.array_equal(one.height, other.height)
    assert sum(node is MOUNTAIN for node in walk(found)) == 1
    assert len(list(walk(found))) == 5


def test_the_knobs_do_not_reshuffle_the_places() -> None:
    area = (0.0, 0.0, 5000.0, 5000.0)
    one = scatter(MOUNTAIN, extent=area, spacing=400.0, seed=5)
    other = scatter(
        MOUNTAIN, extent=area, spacing=400.0, seed=5, rotation=(0.0, 0.0), scale=(1.0, 1.0), rise=(5.0, 6.0)
    )
    assert isinstance(one, Blend)
    assert isinstance(other, Blend)

    def at(part: Any) -> tuple[float, float]:
        a, b, c, d = part.matrix
        area = a * d - b * c
        x, y = -part.shift[0], -part.shift[1]
        return (d * x - b * y) / area, (a * y - c * x) / area

    assert np.allclose([at(part) for part in one.operands], [at(part) for part in other.operands], atol=1e-6)
    assert {part.matrix for part in other.operands if isinstance(part, Affine)} == {(1.0, 0.0, -0.0, 1.0)}
    assert all(5 <= part.rise <= 6 for part in other.operands if isinstance(part, Affine))


@pytest.mark.slow
def test_ten_thousand_instances_are_small_and_quick(device: Any) -> None:
    started = time.perf_counter()
    many = scatter(MOUNTAIN, extent=(1e5, 1e5, 1.5e5, 1.5e5), spacing=395.0, seed=1)
    assert isinstance(many, Blend)
    assert 9000 < len(many.operands) < 11000
    encoded = codec.encode(many)
    size = len(json.dumps(encoded.structure))
    assert size < 350 * len(many.operands)
    assert sum(row[0] == "o" and row[1].endswith(".Disc") for row in encoded.structure[1] if isinstance(row, list)) == 1
    extent, shape = Extent(1.2e5, 1.2e5, 1.2e5 + 2000, 1.2e5 + 2000), (256, 256)
    height, weight = on_device(many, extent, shape, device)
    exact = many.query(grid(extent, shape))
    there = exact.weight >= 0.5 + 1e-4
    assert there.mean() > 0.8
    assert np.abs(height - exact.height)[there].max() < 0.01
    assert np.abs(weight - exact.weight).max() < 1e-4
    assert time.perf_counter() - started < 20


def test_what_cannot_be_scattered_is_refused() -> None:
    area = (0.0, 0.0, 5000.0, 5000.0)
    with pytest.raises(ValueError, match="where to scatter"):
        scatter(MOUNTAIN)
    with pytest.raises(ValueError, match="range of scale falls"):
        scatter(MOUNTAIN, extent=area, scale=(2.0, 1.0))
    with pytest.raises(ValueError, match="greater than 0"):
        scatter(MOUNTAIN, extent=area, scale=(0.0, 1.0))
    with pytest.raises(ValueError, match="more than 1,000,000"):
        scatter(MOUNTAIN, extent=area, spacing=0.1)
    empty = Mask(np.zeros((4, 4), np.float32), Extent(*area))
    with pytest.raises(ValueError, match="density is 0"):
        scatter(MOUNTAIN, empty)
    degrees = Mask(np.ones((4, 4), np.float32), Extent(0, 0, 1, 1, unit="deg"))
    with pytest.raises(ValueError, match="degrees"):
        scatter(MOUNTAIN, degrees)
    with pytest.raises(ValueError, match="2 rotations do not fit 3 positions"):
        instances(MOUNTAIN, positions=((0.0, 0.0),) * 3, rotations=(1.0, 2.0))
    with pytest.raises(ValueError, match="size of 0"):
        instances(MOUNTAIN, positions=((0.0, 0.0),), scales=(0.0,))
