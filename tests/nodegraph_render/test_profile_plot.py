from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from nodegraph.codec import seal
from nodegraph_render.profile import profile
from nodegraph_render.profile_plot import WATER, profile_plot
from nodegraph_render.sampling import bilinear
from nodegraph_terrain.polylines import Polylines, reprojected
from nodegraph_terrain.raster import Elevation, Extent
from nodegraph_tree.evaluate import Profile

ROWS, COLS, CELL = 30, 40, 25.0
EXTENT = Extent(5e5, 4e6, 5e5 + COLS * CELL, 4e6 + ROWS * CELL, "EPSG:32616")
Y, X = np.mgrid[0:ROWS, 0:COLS]
PLANE = Elevation((100 + 0.2 * (X + 0.5) * CELL).astype(np.float32), EXTENT)
HILLS = Elevation((300 + 80 * np.sin(X / 5) * np.cos(Y / 4)).astype(np.float32), EXTENT)
INSIDE = st.tuples(st.floats(13, 987), st.floats(13, 737)).map(lambda p: (EXTENT.west + p[0], EXTENT.south + p[1]))


def made(distance, height) -> Profile:
    distance, height = np.array(distance, np.float64), np.array(height, np.float64)
    return Profile(distance, distance, np.zeros_like(distance), height, np.isfinite(height).astype(np.float64))


@given(corners=st.lists(INSIDE, min_size=2, max_size=5, unique=True), spacing=st.none() | st.floats(3, 500))
def test_profiles_follow_the_line_and_the_bilinear_ground(corners, spacing) -> None:
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    if along[-1] < 1:
        return
    found = profile(HILLS, points=tuple(corners), spacing=spacing)
    steps = np.diff(found.distance)
    np.testing.assert_allclose(steps[:-1], spacing or CELL, rtol=1e-9)
    assert 0 < steps[-1] <= (spacing or CELL) * (1 + 1e-9)
    assert found.distance[-1] == pytest.approx(along[-1])
    np.testing.assert_allclose([found.x[0], found.y[0]], corners[0])
    np.testing.assert_allclose([found.x[-1], found.y[-1]], corners[-1])
    places = (EXTENT.north - found.y) / CELL - 0.5, (found.x - EXTENT.west) / CELL - 0.5
    expected = ndimage.map_coordinates(HILLS.data.astype(np.float64), places, order=1, mode="nearest")
    np.testing.assert_allclose(found.height, expected, atol=1e-6)
    assert (found.weight == 1).all()


def test_beyond_the_raster_and_beside_voids_is_void() -> None:
    data = np.array(PLANE.data)
    data[:, 10] = np.nan
    found = profile(
        PLANE.like(data), points=((EXTENT.west - 100, EXTENT.south + 300), (EXTENT.east + 100, EXTENT.south + 300))
    )
    column = (found.x - EXTENT.west) / CELL - 0.5
    void = (column < -0.5) | (column > COLS - 0.5) | ((column > 9) & (column < 11))
    np.testing.assert_array_equal(np.isnan(found.height), void)
    np.testing.assert_array_equal(found.weight, ~void)
    np.testing.assert_allclose(found.height[~void], (100 + 0.2 * np.clip(column, 0, 39)[~void] * CELL + 2.5), rtol=1e-6)


def test_bilinear_knows_centres_beside_voids_and_single_cells() -> None:
    data = np.array(HILLS.data)
    data[4, 5] = np.nan
    x, y = EXTENT.west + (X + 0.5) * CELL, EXTENT.north - (Y + 0.5) * CELL
    np.testing.assert_allclose(bilinear(HILLS.like(data), x, y), data, rtol=1e-6)
    single = Elevation(np.array([[7.0]], np.float32), Extent(0, 0, 10, 10))
    np.testing.assert_array_equal(
        bilinear(single, np.array([0, 5, 10, 11]), np.array([0, 5, 10, 5])), [7, 7, 7, np.nan]
    )


def test_linked_lines_are_brought_to_the_ground() -> None:
    corners = [[EXTENT.west + 50, EXTENT.south + 50], [EXTENT.west + 900, EXTENT.south + 600]]
    lines = Polylines.of([[[0, 0], [1, 1]], corners], crs=EXTENT.crs)
    own = profile(HILLS, lines, line_number=1, spacing=50.0)
    there = profile(HILLS, reprojected(lines, "EPSG:4326"), line_number=1, spacing=50.0)
    np.testing.assert_allclose(there.height, own.height, atol=1e-3)
    np.testing.assert_array_equal(own.height, profile(HILLS, points=tuple(map(tuple, corners)), spacing=50.0).height)


@pytest.mark.parametrize(
    ("lines", "params", "message"),
    [
        (None, {}, "missing or given twice"),
        (Polylines.of([[[0, 0], [1, 1]]]), {"points": ((0, 0), (1, 1))}, "missing or given twice"),
        (Polylines.of([[[0, 0], [1, 1]]]), {"line_number": 1}, "no line 1; the linked ones are 0 to 0"),
        (Polylines.of([[[0, 0], [1, 1]]], unit="deg"), {}, "in degrees and the surface in metres"),
        (None, {"points": ((0, 0), (0, 0))}, "no length"),
        (None, {"points": ((0, 0),)}, "two points at least"),
        (None, {"points": ((0, 0), (1, 1))}, "meets no height"),
        (None, {"points": ((0, 0), (1e6, 0)), "spacing": 0.001}, "too many samples"),
    ],
)
def test_lines_that_give_no_profile_are_refused(lines, params, message) -> None:
    with pytest.raises(ValueError, match=message):
        profile(PLANE, lines, **params)


def test_degrees_are_refused() -> None:
    degrees = Elevation(PLANE.data, Extent(-84, 36, -83, 37, "EPSG:4326", "deg"))
    with pytest.raises(ValueError, match=r"link it through terrain\.reproject"):
        profile(degrees, points=((-84, 36), (-83, 37)))


# The plot.


def shown(picture: np.ndarray, colour: str) -> np.ndarray:
    return (picture == [int(colour[i : i + 2], 16) for i in (1, 3, 5)]).all(axis=2)


@settings(max_examples=10)
@given(exaggeration=st.floats(0.5, 4))
def test_the_stated_exaggeration_is_that_of_the_picture(exaggeration: float) -> None:
    """A slope of one stands at the angle whose tangent is the exaggeration."""
    tent = made([0, 100, 200], [0, 100, 0])
    tall = 200 + round(200 * exaggeration * 4)
    picture = profile_plot(tent, styles=("line",), exaggeration=exaggeration, width=400, height=tall).data
    line = (picture[..., 0] > 150) & (picture[..., 1] < 90)
    row, col = np.nonzero(line)
    # The width of the line lies around both its foot and its tip.
    assert (np.ptp(row) - 1) / (np.ptp(col) / 2) == pytest.approx(exaggeration, rel=0.03)


def test_water_lies_on_the_ground_and_nowhere_else() -> None:
    valley = made([0, 100, 200, 300, 400], [50, 0, 30, 0, 50])
    pond = made([0, 400], [20, 20])
    picture = profile_plot(valley, pond, styles=("ground", "water"), width=800, height=400).data
    wet = shown(picture, WATER)
    assert wet.sum() > 500
    columns = np.flatnonzero(wet.any(axis=0))
    # Two ponds: the middle rises out of the water.
    assert (np.diff(columns) > 20).sum() == 1
    dry = profile_plot(valley, made([0, 400], [-20, -20]), styles=("ground", "water"), width=800, height=400).data
    assert not shown(dry, WATER).any()


def test_void_stretches_stay_empty() -> None:
    distance = np.linspace(0, 1000, 101)
    height = 100 + 20 * np.sin(distance / 100)
    whole = profile_plot(made(distance, height), width=600, height=300).data
    height[40:60] = np.nan
    torn = profile_plot(made(distance, height), width=600, height=300).data
    ground = (205, 183, 148)
    filled = [(np.abs(picture.astype(int) - ground).max(axis=2) < 3).any(axis=0) for picture in (whole, torn)]
    lost = np.flatnonzero(filled[0] & ~filled[1])
    assert 80 < len(lost) < 130
    assert lost.max() - lost.min() == len(lost) - 1


def test_the_same_profiles_give_the_same_picture() -> None:
    line = profile(HILLS, points=((EXTENT.west, EXTENT.south), (EXTENT.east, EXTENT.north)))
    words = {"title": "$a_b$ & <Ünïcode>", "names": ("ground", "roof_of_$100"), "styles": ("ground", "line")}
    first, second = (profile_plot(line, line, **words) for _ in range(2))
    assert seal(first) == seal(second)
    assert first.shape == (480, 1200)
    plain = profile_plot(line, line)
    assert (first.data != plain.data).any()


@pytest.mark.parametrize(
    ("profiles", "params", "message"),
    [
        ([], {}, "no profile is linked"),
        ([made([0], [1])], {}, "profile 0 has no length"),
        ([made([0, 1], [np.nan, np.nan])], {}, "no profile has a height"),
        ([made([0, 1], [np.inf, 1])], {}, "profile 0 holds infinite heights"),
        ([made([0, 1], [0, 1])], {"names": ("a", "b")}, "2 names are given for 1 profiles"),
        ([made([0, 1], [0, 1])], {"styles": ("line", "line")}, "2 styles are given for 1 profiles"),
        ([made([0, 1], [0, 1])], {"exaggeration": 40.0}, "take .* at most, or make the picture .* pixels high"),
        ([made([0, 1], [0, 1])], {"title": "long " * 200, "height": 200}, "leave no room for a plot"),
    ],
)
def test_what_cannot_be_plotted_is_refused(profiles, params, message) -> None:
    with pytest.raises(ValueError, match=message):
        profile_plot(*profiles, **params)


def test_the_way_out_of_a_steep_exaggeration_works() -> None:
    tent = made([0, 100, 200], [0, 100, 0])
    with pytest.raises(ValueError, match="pixels high") as refused:
        profile_plot(tent, exaggeration=9.0, width=600)
    words = str(refused.value).replace(",", "").split()
    tall = int(words[words.index("pixels") - 1])
    assert profile_plot(tent, exaggeration=9.0, width=600, height=tall).shape == (tall, 600)
    most = float(words[words.index("take") + 1])
    profile_plot(tent, exaggeration=most * 0.99, width=600)


def test_level_ground_is_plotted() -> None:
    assert profile_plot(made([0, 5], [3, 3])).data.std() > 5
