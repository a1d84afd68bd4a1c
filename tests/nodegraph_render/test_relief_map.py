from __future__ import annotations

import math
import threading
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph import Context
from nodegraph.codec import seal
from nodegraph.errors import Cancelled
from nodegraph_render.contour_labels import place_labels, with_gaps
from nodegraph_render.contour_lines import contour_lines
from nodegraph_render.map_frame import ANGLES, north_and_scale
from nodegraph_render.map_frame import ground as ground_size
from nodegraph_render.relief_map import relief_map
from nodegraph_render.rounding import multiples, round_below, round_step
from nodegraph_render.sheet import SIDE_MAX, Sheet, measure, wrapped
from nodegraph_terrain.colour import HYPSOMETRIC
from nodegraph_terrain.hillshade import hillshade
from nodegraph_terrain.polylines import Polylines
from nodegraph_terrain.raster import Elevation, Extent, Image, Shade

ROWS, COLS, CELL = 60, 80, 30.0
EXTENT = Extent(5e5, 4e6, 5e5 + COLS * CELL, 4e6 + ROWS * CELL, "EPSG:32616")
Y, X = np.mgrid[0:ROWS, 0:COLS]
HILLS = Elevation((300 + 90 * np.sin(X / 9) * np.cos(Y / 7)).astype(np.float32), EXTENT)
LEVEL = Elevation(np.full((ROWS, COLS), 12, np.float32), EXTENT)
FLAT = {"size": 240, "interval": 0.0, "strength": 0.0}


def box_of(picture: Image, extent: Extent = EXTENT) -> tuple[slice, slice]:
    """Return rows and columns of the map within the sheet, from its extent."""
    sheet, (rows, cols) = picture.extent, picture.shape
    down, across = rows / sheet.height, cols / sheet.width
    top, left = round((sheet.north - extent.north) * down), round((extent.west - sheet.west) * across)
    return slice(top, top + round(extent.height * down)), slice(left, left + round(extent.width * across))


def inner(picture: Image, extent: Extent = EXTENT) -> np.ndarray:
    """Return the pixels of the map without its frame."""
    rows, cols = box_of(picture, extent)
    return picture.data[rows, cols][3:-3, 3:-3].astype(int)


def near(pixels: np.ndarray, colour: str, tolerance: int = 6) -> np.ndarray:
    return np.abs(pixels - [int(colour[i : i + 2], 16) for i in (1, 3, 5)]).max(axis=-1) <= tolerance


def test_the_map_has_its_size_and_its_place() -> None:
    picture = relief_map(HILLS, size=400)
    rows, cols = box_of(picture)
    assert (rows.stop - rows.start, cols.stop - cols.start) == (300, 400)
    # The frame runs along the very edge.
    edge = picture.data[rows, cols].astype(int)
    assert (edge[0].max(axis=1) < 150).all()
    assert (edge[:, 0].max(axis=1) < 150).all()
    assert (picture.data[rows, cols.stop].max(axis=1) < 150).all()
    assert (picture.data[rows.stop, cols].max(axis=1) < 150).all()
    assert picture.extent.crs == EXTENT.crs


def test_colours_are_those_of_the_legend() -> None:
    ramp = Elevation(np.tile(np.linspace(0, 100, COLS, dtype=np.float32), (ROWS, 1)), EXTENT)
    pixels = inner(relief_map(ramp, **FLAT))
    assert near(pixels[:, :2], HYPSOMETRIC[0]).all()
    assert near(pixels[:, -1], HYPSOMETRIC[-1]).all()
    stops = ((0.0, "#ff0000"), (50.0, "#00ff00"), (100.0, "#0000ff"))
    assert near(inner(relief_map(ramp, colours=stops, **FLAT))[:, :2], "#ff0000", 12).all()
    narrow = inner(relief_map(ramp, minimum=40.0, maximum=60.0, **FLAT))
    assert near(narrow[:, : narrow.shape[1] // 3], HYPSOMETRIC[0]).all()
    assert near(inner(relief_map(LEVEL, size=240)), HYPSOMETRIC[5], 2).all()


def test_the_light_comes_from_where_it_is_said_to() -> None:
    ridge = Elevation(np.tile(100 - 5 * np.abs(np.arange(COLS) - 40.0), (ROWS, 1)).astype(np.float32), EXTENT)
    for azimuth, sunny in ((270.0, 0), (90.0, 1)):
        pixels = inner(
            relief_map(ridge, size=240, interval=0.0, azimuth=azimuth, mode="single", colours=("#888888",) * 2)
        )
        halves = pixels[:, 10:110].mean(), pixels[:, -110:-10].mean()
        assert halves[sunny] > halves[1 - sunny] + 20


def test_own_shade_and_image_are_used() -> None:
    picture = Image(np.full((30, 40, 3), (10, 200, 30), np.uint8), EXTENT)
    assert near(inner(relief_map(HILLS, image=picture, **FLAT)), "#0ac81e").all()
    dark = Shade(np.zeros((15, 20), np.float32), EXTENT)
    assert inner(relief_map(HILLS, dark, size=240, interval=0.0)).max() < 20
    same = relief_map(HILLS, hillshade(HILLS), size=240, interval=0.0)
    assert inner(same).std() > 10
    half = np.full((30, 40, 4), 255, np.uint8)
    half[:, :20, 3] = 0
    clear = inner(relief_map(HILLS, image=Image(half, EXTENT), **FLAT))
    assert near(clear[:, :100], "#e6e6e6").all()
    assert (clear[:, -100:] == 255).all()


def test_voids_are_grey_and_in_the_legend() -> None:
    data = np.array(HILLS.data)
    data[20:40, 30:50] = np.nan
    pixels = inner(relief_map(HILLS.like(data), **FLAT))
    rows, cols = pixels.shape[:2]
    assert near(pixels[int(rows * 0.4) : int(rows * 0.6), int(cols * 0.42) : int(cols * 0.58)], "#e6e6e6").all()
    assert not near(pixels[: rows // 4], "#e6e6e6", 1).any()


def test_contours_lie_where_the_ground_has_their_height() -> None:
    """On level colours only the contours are dark; each dark pixel is within two pixels of the level."""
    cone = Elevation((200 - np.hypot(X - 39.5, Y - 29.5)).astype(np.float32), EXTENT)
    grey = {"size": 800, "colours": ("#ffffff", "#ffffff"), "strength": 0.0, "coordinates": "none"}
    pixels = inner(relief_map(cone, interval=10.0, index=0, **grey))
    row, col = np.nonzero(pixels.max(axis=2) < 200)
    radius = np.hypot((col + 3.5) / 10 - 40, (row + 3.5) / 10 - 30)
    written = np.abs(radius % 10 - 5) < 4.6
    # Heights are written on some; everything else is on a circle.
    assert len(row) > 2000
    assert written.mean() < 0.25


def test_linked_contours_and_lines_are_drawn() -> None:
    own = relief_map(HILLS, size=400, interval=25.0)
    linked = relief_map(HILLS, contours=contour_lines(HILLS, interval=25.0, smooth=4), size=400)
    assert (np.abs(inner(own) - inner(linked)).max(axis=2) > 60).mean() < 0.05
    line = Polylines.of([[[EXTENT.west, EXTENT.south], [EXTENT.east, EXTENT.north]]], crs=EXTENT.crs)
    crossed = inner(relief_map(HILLS, lines=line, line_colour="#ff00ff", line_width=20.0, **FLAT))
    row, col = np.nonzero(near(crossed, "#ff00ff"))
    height, width = crossed.shape[:2]
    assert np.abs(row / height + col / width - 1).max() < 0.06
    assert len(row) > 500
    far = Polylines.of([[[0, 0], [1, 1]]], crs="EPSG:4326", unit="deg")
    assert not near(relief_map(HILLS, lines=far, line_name="", line_colour="#ff00ff", **FLAT).data, "#ff00ff").any()
    bare = Polylines.of([[[EXTENT.west, EXTENT.south], [EXTENT.east, EXTENT.north]]])
    assert inner(relief_map(HILLS, contours=bare, size=240)).std() > 0


@pytest.mark.parametrize("coordinates", ["own", "lonlat", "none"])
@pytest.mark.parametrize(
    "extent",
    [
        EXTENT,
        Extent(-84.4, 36.4, -84.0, 36.8, "EPSG:4326", "deg"),
        Extent(179.5, -17, 180.5, -16, "EPSG:4326", "deg"),
        Extent(-1e6, -1e6, 1e6, 1e6, "EPSG:3413"),
        Extent(8e5, 8e6, 9e5, 8.1e6, "EPSG:3857"),
        Extent(0.0, 0.0, 8.0, 6.0),
        Extent(0.0, 0.0, 1e4, 30.0),
        Extent(0.0, 0.0, 30.0, 1e4),
    ],
)
def test_maps_of_any_place_and_shape(extent: Extent, coordinates: str) -> None:
    surface = Elevation(HILLS.data, extent)
    if coordinates == "lonlat" and not extent.crs:
        with pytest.raises(ValueError, match="no longitudes and latitudes"):
            relief_map(surface, size=200, coordinates=coordinates)
        return
    picture = relief_map(surface, size=200, coordinates=coordinates, title="A place", credit="Nobody")
    assert picture.data.std() > 20
    # Nothing is cut off: the outermost pixels are paper.
    for edge in (picture.data[0], picture.data[-1], picture.data[:, 0], picture.data[:, -1]):
        assert (edge == 255).all()


@pytest.mark.parametrize("data", [[[5.0]], [[5.0, 6.0]], np.zeros((2, 2)), [[np.nan, 1.0], [2.0, 3.0]]])
def test_tiny_and_level_surfaces_are_drawn(data) -> None:
    surface = Elevation(np.array(data, np.float32), Extent(0, 0, 100, 100))
    assert relief_map(surface, size=200).data.std() > 10


def test_the_same_map_every_time_under_any_configuration() -> None:
    words = {"title": "$x^2$ and <b> \\alpha", "credit": "50 % $", "size": 240}
    first = relief_map(HILLS, **words)
    with mpl.rc_context({"font.size": 30, "font.family": "serif", "axes.facecolor": "black", "text.color": "red"}):
        second = relief_map(HILLS, **words)
    assert seal(first) == seal(second)
    found: list[bytes] = []
    threads = [threading.Thread(target=lambda: found.append(seal(relief_map(HILLS, **words)))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [seal(first)] * 3


def test_degrees_without_contours_and_progress_that_rises() -> None:
    degrees = Elevation(HILLS.data, Extent(-84.4, 36.4, -84.0, 36.8, "EPSG:4326", "deg"))
    done: list[float] = []
    context = Context(report=lambda fraction, _: done.append(fraction or 0.0))
    relief_map(degrees, context=context, **FLAT)
    assert done == sorted(done)
    assert 0.9 < done[-1] <= 1


def test_cancelling_takes_effect() -> None:
    cancelled = threading.Event()
    cancelled.set()
    with pytest.raises(Cancelled):
        relief_map(HILLS, size=200, context=Context(cancelled=cancelled))


@pytest.mark.parametrize(
    ("surface", "params", "message"),
    [
        (np.full((3, 3), np.nan), {}, "every cell of the surface is void"),
        (np.array([[np.inf, 1], [1, 1]]), {}, "infinite heights"),
        (np.ones((3, 3)), {"minimum": 5.0, "maximum": 3.0}, "minimum 5 must be below maximum 3"),
        (np.ones((3, 3)), {"colours": ()}, "colours are missing"),
        (np.ones((3, 3)), {"colours": ((0.0, "#000000"), (1.0, "#ffffff")), "minimum": 0.0}, "stops with heights"),
        (np.ones((3, 3)), {"colours": "nosuch"}, "no colour map 'nosuch'"),
    ],
)
def test_what_cannot_be_drawn_is_refused(surface, params, message) -> None:
    with pytest.raises(ValueError, match=message):
        relief_map(Elevation(surface.astype(np.float32), Extent(0, 0, 90, 90)), size=200, **params)


def test_rasters_of_other_ground_are_refused() -> None:
    other = replace(EXTENT, west=EXTENT.west - 900)
    with pytest.raises(ValueError, match="the image does not cover the same ground"):
        relief_map(HILLS, image=Image(np.zeros((5, 5, 3), np.uint8), other), **FLAT)
    with pytest.raises(ValueError, match="the shade does not cover the same ground"):
        relief_map(HILLS, Shade(np.zeros((5, 5), np.float32), other), size=200)
    with pytest.raises(ValueError, match="colour 'blue' must read"):
        relief_map(HILLS, lines=Polylines.of([[[0, 0], [1, 1]]]), line_colour="blue", size=200)
    with pytest.raises(ValueError, match="the lines are in 'deg', the surface in 'm'"):
        relief_map(HILLS, lines=Polylines.of([[[0, 0], [1, 1]]], unit="deg"), size=200)


# Its parts.


def test_north_turns_with_the_meridians() -> None:
    """On a transverse Mercator the meridians lean by atan(tan(lon - lon0) sin(lat))."""
    from nodegraph_terrain.polylines import reprojected

    for lon, lat in ((-84.2, 36.6), (-89.5, 60.0), (-87.0, 45.0)):
        place = reprojected(Polylines.of([[[lon, lat], [lon, lat]]], crs="EPSG:4326", unit="deg"), "EPSG:32616")
        x, y = place.points[0]
        bearing, scale = north_and_scale(Extent(x - 500, y - 500, x + 500, y + 500, "EPSG:32616"))
        leaning = math.degrees(math.atan(math.tan(math.radians(lon + 87)) * math.sin(math.radians(lat))))
        # East of the central meridian true north lies to the left of the grid's.
        assert bearing == pytest.approx(-leaning, abs=0.01)
        assert scale == 1.0


def test_web_mercator_is_scaled_to_the_ground() -> None:
    y = 6_378_137 * math.log(math.tan(math.pi / 4 + math.radians(60) / 2))
    bearing, scale = north_and_scale(Extent(-1000, y - 1000, 1000, y + 1000, "EPSG:3857"))
    assert bearing == pytest.approx(0, abs=1e-6)
    assert scale == pytest.approx(0.5, rel=5e-3)


def test_degrees_are_drawn_in_true_proportion() -> None:
    wide, high = ground_size(Extent(-1, 59, 1, 61, "EPSG:4326", "deg"))
    assert wide / high == pytest.approx(0.5, rel=1e-3)


@given(span=st.floats(1e-6, 1e9), count=st.floats(1, 50))
def test_steps_are_round_and_few(span: float, count: float) -> None:
    step = round_step(span, count)
    assert float(f"{step:.0e}") == pytest.approx(step)
    assert f"{step:e}"[0] in "125"
    assert span / step <= count * (1 + 1e-5)
    assert span / step > count / 2.6
    assert round_below(span) <= span * (1 + 1e-9) < 2.6 * round_below(span)
    values = multiples(-span, span, step)
    assert ((values >= -span * (1 + 1e-8)) & (values <= span * (1 + 1e-8))).all()
    assert 0 in values


def test_angles_rise() -> None:
    assert list(ANGLES) == sorted(set(ANGLES))


@given(data=st.data())
def test_labels_stand_apart_on_their_lines(data: st.DataObject) -> None:
    dice = np.random.default_rng(data.draw(st.integers(0, 1 << 32)))
    along = np.linspace(0, 600, 200)
    lines = [
        np.column_stack([along, 40 + 60 * k + 15 * np.sin(along / dice.uniform(20, 90) + dice.uniform(0, 6))])
        for k in range(5)
    ]
    labels = place_labels(lines, [30.0] * 5, 10.0, (0, 0, 600, 340), spacing=200, clearance=20)
    for number, label in enumerate(labels):
        assert -90 <= label.turn <= 90
        assert 15 < label.x < 585
        # On its line, up to the bulge that was allowed.
        assert np.hypot(*(lines[label.line] - [label.x, label.y]).T).min() < 6
        for other in labels[:number]:
            assert math.hypot(label.x - other.x, label.y - other.y) >= 30 + 20
    for line in lines:
        gaps = [(label.at - label.gap / 2, label.at + label.gap / 2) for label in labels if lines[label.line] is line]
        pieces = with_gaps(line, gaps)
        lengths = sum(np.hypot(*np.diff(piece, axis=0).T).sum() for piece in pieces)
        whole = np.hypot(*np.diff(line, axis=0).T).sum()
        assert len(pieces) == len(gaps) + 1
        assert lengths == pytest.approx(whole - sum(stop - start for start, stop in gaps), rel=1e-3)


@given(words=st.lists(st.text("abcde", min_size=1, max_size=12), min_size=1, max_size=12), width=st.floats(20, 400))
def test_words_are_wrapped_within_the_width(words: list[str], width: float) -> None:
    lines = wrapped(" ".join(words), 12, width)
    assert " ".join(lines) == " ".join(words)
    for line in lines:
        assert " " not in line or measure(line, 12)[0] <= width


def test_pixels_are_laid_as_they_are() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (7, 9, 3)).astype(np.uint8)
    sheet = Sheet(30, 20)
    sheet.image(pixels, 4, 5)
    np.testing.assert_array_equal(sheet.pixels()[5:12, 4:13], pixels)
    with pytest.raises(ValueError, match="make it smaller"):
        Sheet(SIDE_MAX + 1, 10)


def test_lines_of_any_length_are_drawn() -> None:
    """Agg gives up on paths of a hundred thousand corners drawn at once."""
    sheet = Sheet(400, 300)
    dice = np.random.default_rng(1)
    walk = np.cumsum(dice.normal(0, 1, (200_000, 2)), axis=0) % (390, 290)
    sheet.lines([walk], colour="#000000", width=0.2)
    assert sheet.pixels().std() > 20
