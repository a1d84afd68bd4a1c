from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from nodegraph_render.contour_lines import contour_lines
from nodegraph_terrain.polylines import Polylines
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_terrain.sample_dem import sample_dem

CELL = (30.0, 20.0)


def raster(data: np.ndarray, west: float = 5e5, south: float = 4e6) -> Elevation:
    rows, cols = data.shape
    return Elevation(data, Extent(west, south, west + cols * CELL[0], south + rows * CELL[1], "EPSG:32616"))


def cells(surface: Elevation, lines: Polylines) -> np.ndarray:
    """Return the points as fractional (row, column) of centres."""
    extent, (dx, dy) = surface.extent, surface.cell_size
    return np.array([(extent.north - lines.points[:, 1]) / dy - 0.5, (lines.points[:, 0] - extent.west) / dx - 0.5])


def level_of_points(lines: Polylines) -> np.ndarray:
    return np.repeat(lines.get("level").values, np.diff(lines.offsets))


@st.composite
def surfaces(draw: st.DrawFn, *, voids: bool = True) -> Elevation:
    """Rasters of any heights or of few whole ones, so that levels pass through centres; with voids."""
    shape = draw(st.tuples(st.integers(2, 9), st.integers(2, 9)))
    heights = draw(st.sampled_from([st.floats(0, 40, width=32), st.integers(0, 4).map(lambda step: 10.0 * step)]))
    data = draw(arrays(np.float32, shape, elements=heights))
    if voids and draw(st.booleans()):
        data[draw(arrays(np.bool_, shape, elements=st.integers(0, 9).map(lambda n: n == 0)))] = np.nan
    if np.isnan(data).all():
        data[0, 0] = 3
    return raster(data)


@given(surface=surfaces())
def test_points_lie_on_straights_between_centres_where_they_reach_the_level(surface: Elevation) -> None:
    lines = contour_lines(surface, interval=10.0)
    places = cells(surface, lines)
    rounding = 1e-6
    on_row, on_col = (np.abs(axis - np.rint(axis)) < rounding for axis in places)
    assert (on_row | on_col).all()
    # Snapped, so that a void beside the straight has no weight.
    places = np.where([on_row, on_col], np.rint(places), places)
    found = ndimage.map_coordinates(np.nan_to_num(surface.data.astype(np.float64)), places, order=1)
    np.testing.assert_allclose(found, level_of_points(lines), atol=40 * 1e-6)


@given(surface=surfaces())
def test_every_crossed_straight_has_exactly_one_point(surface: Elevation) -> None:
    """Found another way: count the neighbours of which one lies above a level and the other does not."""
    level = 17.3
    lines = contour_lines(surface, levels=(level,))
    data = surface.data.astype(np.float64)
    quads = ~np.isnan(data[:-1, :-1] + data[1:, :-1] + data[:-1, 1:] + data[1:, 1:])
    in_quad = np.pad(quads, 1)
    across = (in_quad[1:, 1:-1] | in_quad[:-1, 1:-1]) & ((data[:, 1:] > level) != (data[:, :-1] > level))
    down = (in_quad[1:-1, 1:] | in_quad[1:-1, :-1]) & ((data[1:] > level) != (data[:-1] > level))
    assert len(lines.points) - lines.closed.sum() == across.sum() + down.sum()


@given(surface=surfaces())
def test_lines_are_whole(surface: Elevation) -> None:
    """No point repeats the one before; a line ends at the border or a void, or where it began."""
    lines = contour_lines(surface, interval=10.0)
    rows, cols = surface.shape
    for line, (row, col) in zip(lines.lines(), ends(surface, lines), strict=True):
        assert (line[1:] != line[:-1]).any(axis=1).all()
        if (line[0] == line[-1]).all():
            continue
        for place in zip(row, col, strict=True):
            near = [np.clip([np.floor(x - 1e-6), np.ceil(x + 1e-6)], 0, None).astype(int) for x in place]
            window = surface.data[near[0][0] : near[0][1] + 1, near[1][0] : near[1][1] + 1]
            at_border = not (1e-6 < place[0] < rows - 1 - 1e-6 and 1e-6 < place[1] < cols - 1 - 1e-6)
            wider = surface.data[max(near[0][0] - 1, 0) : near[0][1] + 2, max(near[1][0] - 1, 0) : near[1][1] + 2]
            assert at_border or np.isnan(window).any() or np.isnan(wider).any()


def ends(surface: Elevation, lines: Polylines) -> list[tuple[np.ndarray, np.ndarray]]:
    row, col = cells(surface, lines)
    pairs = zip(lines.offsets[:-1], lines.offsets[1:] - 1, strict=True)
    return [(row[[first, last]], col[[first, last]]) for first, last in pairs]


@given(height=st.floats(50, 500), west=st.floats(-1e6, 1e6))
def test_a_cone_has_circles(height: float, west: float) -> None:
    rows, cols = 121, 81
    y, x = (np.arange(rows) - 60) * -CELL[1], (np.arange(cols) - 40) * CELL[0]
    cone = raster((height * (1 - np.hypot(x, y[:, None]) / 1100)).astype(np.float32), west)
    lines = contour_lines(cone, levels=(0.25 * height, 0.5 * height, 0.75 * height))
    assert len(lines) == 3
    assert lines.closed.all()
    centre = [west + 40.5 * CELL[0], 4e6 + 60.5 * CELL[1]]
    for line, level in zip(lines.lines(), lines.get("level").values, strict=True):
        radius = 1100 * (1 - level / height)
        away = np.hypot(*(line - centre).T)
        # A chord of a cell lies that far inside its circle at most.
        assert np.abs(away - radius).max() < np.hypot(*CELL) ** 2 / (8 * radius) + 0.1
        assert twice_area(line) == pytest.approx(2 * np.pi * radius**2, rel=0.01)


def twice_area(line: np.ndarray) -> float:
    x, y = (line - line[0]).T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))


@given(surface=surfaces(voids=False))
def test_higher_ground_lies_on_the_left(surface: Elevation) -> None:
    """Segment by segment, by the slope of the quad that it crosses."""
    lines = contour_lines(surface, levels=(17.3,))
    for line in lines.lines():
        middle = (line[1:] + line[:-1]) / 2
        along = np.diff(line, axis=0)
        left = np.column_stack([-along[:, 1], along[:, 0]])
        row, col = cells(surface, Polylines.of([np.vstack([middle, middle[:1]])]))
        row, col = (np.floor(axis[:-1]).astype(int) for axis in (row, col))
        corner = [surface.data[row + i, col + j] for i in (0, 1) for j in (0, 1)]
        # The gradient of the quad in its middle; in a saddle it does not tell the sides.
        east = (corner[1] + corner[3] - corner[0] - corner[2]) / 2 / CELL[0]
        north = (corner[0] + corner[1] - corner[2] - corner[3]) / 2 / CELL[1]
        above = np.sum([value > 17.3 for value in corner], axis=0)
        saddle = (above == 2) & ((corner[0] > 17.3) == (corner[3] > 17.3))
        uphill = left[:, 0] * east + left[:, 1] * north
        assert (uphill[~saddle] > -1e-3).all()


def test_summits_turn_left_and_hollows_right() -> None:
    hill = np.zeros((9, 9), np.float32)
    hill[4, 4] = 10
    assert [twice_area(line) > 0 for line in contour_lines(raster(hill), levels=(5,)).lines()] == [True]
    assert [twice_area(line) > 0 for line in contour_lines(raster(-hill), levels=(-5,)).lines()] == [False]


def test_levels_count_from_the_base_and_every_fifth_is_an_index() -> None:
    ramp = raster(np.tile(np.linspace(-7, 100, 40, dtype=np.float32), (3, 1)))
    lines = contour_lines(ramp, interval=10.0)
    levels = lines.get("level")
    assert levels.unit == "m"
    np.testing.assert_array_equal(levels.values, np.arange(0, 100, 10))
    np.testing.assert_array_equal(lines.get("index").values, levels.values % 50 == 0)
    shifted = contour_lines(ramp, interval=10.0, base=3.0, index=2)
    np.testing.assert_array_equal(shifted.get("level").values, np.arange(-7, 100, 10))
    np.testing.assert_array_equal(shifted.get("index").values, (shifted.get("level").values - 3) % 20 == 0)
    stated = contour_lines(ramp, levels=(50, 20, 70, 200), index=2)
    np.testing.assert_array_equal(stated.get("level").values, [20, 50, 70])
    np.testing.assert_array_equal(stated.get("index").values, [True, False, True])
    assert not contour_lines(ramp, interval=10.0, index=0).get("index").values.any()
    assert 6 <= len(contour_lines(ramp)) <= 16


def test_a_plateau_at_a_level_is_outlined_once() -> None:
    """A level that the ground reaches without passing: a sea at 0, whole heights."""
    sea = np.zeros((6, 7), np.float32)
    sea[2:4, 2:5] = 5
    lines = contour_lines(raster(sea), interval=5.0)
    assert len(lines) == 1
    assert lines.closed.all()
    assert lines.get("level").values == [0]
    assert Counter(map(tuple, lines.points[:-1].tolist())).most_common(1)[0][1] == 1
    pit = np.full((5, 5), 5, np.float32)
    pit[2, 2] = 0
    assert len(contour_lines(raster(pit), levels=(0.0,))) == 0


@pytest.mark.parametrize("data", [np.full((4, 4), 3.0), np.array([[1.0, 2.0, 3.0]]), np.array([[5.0]])])
def test_level_ground_and_single_rows_have_no_lines(data: np.ndarray) -> None:
    lines = contour_lines(raster(data.astype(np.float32)), heights=True)
    assert len(lines) == 0
    assert lines.points.shape == (0, 3)


def test_lines_stop_at_voids() -> None:
    ramp = np.tile(np.arange(20, dtype=np.float32)[:, None], (1, 20))
    ramp[8:12, 9:11] = np.nan
    surface = raster(ramp)
    lines = contour_lines(surface, levels=(9.5,))
    assert len(lines) == 2
    row, col = cells(surface, lines)
    np.testing.assert_allclose(row, 9.5, atol=1e-6)
    assert not ((col > 8 + 1e-6) & (col < 11 - 1e-6)).any()


def test_heights_are_the_third_coordinate() -> None:
    surface = sample_dem()
    flat, tall = contour_lines(surface), contour_lines(surface, heights=True)
    np.testing.assert_array_equal(tall.points[:, :2], flat.points)
    np.testing.assert_array_equal(tall.points[:, 2], level_of_points(flat))
    assert (flat.crs, flat.unit) == ("EPSG:4326", "deg")


def test_smooth_lines_follow_the_spline_and_keep_its_voids() -> None:
    y, x = np.mgrid[0:24, 0:30]
    waves = raster((50 * np.sin(x / 4) * np.cos(y / 5)).astype(np.float32))
    coarse, fine = contour_lines(waves, levels=(20,)), contour_lines(waves, levels=(20,), smooth=8)
    errors = []
    for lines in (coarse, fine):
        row, col = cells(waves, lines)
        inside = (row > 2) & (row < 21) & (col > 2) & (col < 27)
        errors.append(np.abs(50 * np.sin(col / 4) * np.cos(row / 5) - 20)[inside].max())
    assert errors[1] < 0.1 * errors[0]
    holey = np.array(waves.data)
    holey[10, 12] = np.nan
    row, col = cells(waves, contour_lines(raster(holey), interval=3.0, smooth=4))
    # Every quad beside the void is left out, and no other.
    assert not ((np.abs(row - 10) < 1 - 1e-6) & (np.abs(col - 12) < 1 - 1e-6)).any()
    assert ((np.abs(row - 10) < 2) & (np.abs(col - 12) < 2)).any()


@pytest.mark.parametrize(
    ("data", "params", "message"),
    [
        ([[np.nan, np.nan], [np.nan, np.nan]], {}, "every cell of the surface is void"),
        ([[np.inf, 0], [0, 0]], {}, "infinite heights"),
        ([[0, 1000], [0, 1000]], {"interval": 0.01}, "an interval of 0.01 m gives 100,001 levels from 0 to 1000 m"),
        ([[0, 1], [0, 1]], {"levels": (0.5, 0.5)}, "a level is given twice"),
    ],
)
def test_what_cannot_be_contoured_is_refused(data, params, message) -> None:
    with pytest.raises(ValueError, match=message):
        contour_lines(raster(np.array(data, np.float32)), **params)
