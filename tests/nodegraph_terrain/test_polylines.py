from __future__ import annotations

import itertools
import json
import logging
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image as Picture

from nodegraph import File
from nodegraph.codec import decode, encode, seal
from nodegraph_terrain.load_polylines import load_polylines
from nodegraph_terrain.polylines import Polylines, Property, reprojected
from nodegraph_terrain.previews import preview_polylines
from nodegraph_terrain.save_polylines import save_polylines

UTM = "EPSG:32616"
METRES = st.floats(-9e6, 9e6).map(lambda value: round(value, 6))
TEXTS = st.text(st.characters(codec="utf-8", exclude_categories=["C"]), max_size=8).map(str.strip)


def write(file: File, folder: Path) -> Path:
    for item in folder.iterdir():
        item.unlink()
    for item in file.all():
        (folder / item.name).write_bytes(item.content.tobytes())
    return folder / file.name


def text_file(folder: Path, text: str, name: str = "a.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


@st.composite
def polylines(draw: st.DrawFn, *, places: bool = True) -> Polylines:
    crs, unit, x, y = draw(
        st.sampled_from(
            [("", "m", METRES, METRES), (UTM, "m", st.floats(3e5, 7e5), st.floats(3e6, 5e6))]
            + [("EPSG:4326", "deg", st.floats(-89, 89), st.floats(-85, 85))] * places
        )
    )
    point = st.tuples(x, y)
    if draw(st.booleans()):
        point = st.tuples(x, y, st.floats(-1e4, 1e4) | st.just(np.nan))
    shape = st.lists(point, min_size=2, max_size=6, unique_by=lambda p: (round(p[0], 3), round(p[1], 3)))
    lines = draw(st.lists(shape, min_size=1, max_size=5))
    lines = [[*line, line[0]] if draw(st.booleans()) else line for line in lines]
    count = len(lines)

    def column(values: st.SearchStrategy, dtype: type) -> np.ndarray:
        return np.array(draw(st.lists(values, min_size=count, max_size=count)), dtype)

    properties = [
        Property("flag", column(st.booleans(), np.bool_)),
        Property("order", column(st.integers(-(1 << 53), 1 << 53), np.int64)),
        # One that is no whole number keeps the column one of floats.
        Property("level", np.append(column(st.floats(-1e6, 1e6) | st.just(np.nan), np.float64)[1:], 0.5), "m"),
        Property("name", (*draw(st.lists(TEXTS, min_size=count - 1, max_size=count - 1)), 'River, "Old"')),
    ]
    chosen = draw(st.lists(st.sampled_from(properties), unique_by=lambda item: item.name))
    return Polylines.of(lines, chosen, crs, unit)


def same(given: Polylines, expected: Polylines, *, tolerance: float) -> None:
    np.testing.assert_array_equal(given.offsets, expected.offsets)
    width = given.points.shape[1]
    # Heights that nobody knows are not written, so that a file of them has none.
    assert width == expected.points.shape[1] or np.isnan(expected.points[:, 2]).all()
    np.testing.assert_allclose(given.points, expected.points[:, :width], rtol=0, atol=tolerance)
    assert (given.crs, given.unit) == (expected.crs, expected.unit)
    assert [item.name for item in given.properties] == [item.name for item in expected.properties]
    for one, other in zip(given.properties, expected.properties, strict=True):
        if isinstance(other.values, tuple):
            assert one.values == other.values
        else:
            np.testing.assert_array_equal(one.values, other.values)
            assert one.values.dtype == other.values.dtype


IN_FOLDER = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@IN_FOLDER
@given(lines=polylines(), decimals=st.sampled_from([17, None, 5]))
def test_geojson_comes_back(lines: Polylines, decimals: int | None, tmp_path: Path) -> None:
    path = write(save_polylines(lines, name="a.geojson", coordinates="own", decimals=decimals), tmp_path)
    digits = decimals or (4 if lines.unit == "m" else 9)
    heights = decimals or 4
    tolerance = 0.0 if decimals == 17 else 0.51 * 10.0 ** -min(digits, heights)
    again = load_polylines(path=path)
    same(again, lines, tolerance=tolerance)
    assert [item.unit for item in again.properties] == [item.unit for item in lines.properties]
    np.testing.assert_array_equal(again.closed, lines.closed)


@IN_FOLDER
@given(lines=polylines(), decimals=st.sampled_from([17, None]))
def test_tables_come_back(lines: Polylines, decimals: int | None, tmp_path: Path) -> None:
    path = write(save_polylines(lines, name="a.csv", decimals=decimals), tmp_path)
    again = load_polylines(path=path)
    if len(lines.points[0]) == 3 and np.isnan(lines.points[:, 2]).all():
        lines = replace(lines, points=again.points)
    same(again, lines, tolerance=0.0 if decimals == 17 else 0.51e-4)


@given(lines=polylines())
def test_the_codec_keeps_them(lines: Polylines) -> None:
    again = decode(encode(lines))
    assert seal(again) == seal(lines)
    same(again, lines, tolerance=0.0)


@IN_FOLDER
@given(lines=polylines(places=False).filter(lambda lines: lines.crs))
def test_geojson_is_wgs84_and_comes_back_in_another_system(lines: Polylines, tmp_path: Path) -> None:
    path = write(save_polylines(lines, name="a.geojson"), tmp_path)
    document = json.loads(path.read_text())
    assert "crs" not in document
    assert load_polylines(path=path).crs == "EPSG:4326"
    # A billionth of a degree is a tenth of a millimetre.
    same(load_polylines(path=path, target_crs=UTM), lines, tolerance=3e-4)


@given(lines=polylines(), data=st.data())
def test_lines_are_taken_one_by_one(lines: Polylines, data: st.DataObject) -> None:
    chosen = data.draw(st.lists(st.integers(0, len(lines) - 1)))
    taken = lines.take(np.array(chosen, np.int64))
    whole = list(lines.lines())
    for number, line in zip(chosen, taken.lines(), strict=True):
        np.testing.assert_array_equal(line, whole[number])
    masked = lines.take(lines.closed)
    assert len(masked) == lines.closed.sum()
    assert masked.closed.all()
    np.testing.assert_allclose(taken.lengths(), lines.lengths()[np.array(chosen, np.int64)], rtol=1e-12)


def test_lengths_bounds_and_closed_lines() -> None:
    square = [[0, 0], [3, 0], [3, 4], [0, 0]]
    lines = Polylines.of([square, [[10, 10], [13, 14]], [[0, 0], [1, 1], [0, 0]]])
    np.testing.assert_allclose(lines.lengths(), [12, 5, 2 * np.sqrt(2)])
    np.testing.assert_array_equal(lines.closed, [True, False, False])
    assert lines.bounds == (0, 0, 13, 14)
    assert Polylines.of([]).bounds is None
    assert len(Polylines.of([]).lengths()) == 0


def test_degrees_are_measured_on_the_sphere() -> None:
    quarter = np.column_stack([np.linspace(0, 90, 91), np.zeros(91)])
    meridian = np.column_stack([np.full(46, 7.0), np.linspace(0, 90, 46)])
    lengths = Polylines.of([quarter, meridian], crs="EPSG:4326", unit="deg").lengths()
    np.testing.assert_allclose(lengths, 10_007_557, rtol=1e-5)


@pytest.mark.parametrize(
    ("points", "offsets", "message"),
    [
        (np.zeros((3, 2)), [0, 1, 3], "line 0 has 1 points; a line needs two"),
        (np.zeros((3, 2)), [0, 2], "offsets of polylines must go from 0 to the 3 points"),
        (np.zeros((3, 4)), [0, 3], r"must be \(n, 2\) or \(n, 3\)"),
        (np.array([[0, 0], [1, 1], [0, 0], [np.nan, 1]]), [0, 2, 4], "line 1 has a point that is not finite"),
        (np.array([[0, 0, 0], [1, 1, np.inf]]), [0, 2], "line 0 has a point that is not finite"),
    ],
)
def test_broken_lines_are_refused(points, offsets, message) -> None:
    with pytest.raises(ValueError, match=message):
        Polylines(points, np.array(offsets))


def test_broken_properties_are_refused() -> None:
    line = [[0, 0], [1, 1]]
    with pytest.raises(ValueError, match="2 values for 1 lines"):
        Polylines.of([line], [Property("a", np.zeros(2))])
    with pytest.raises(ValueError, match="one name"):
        Polylines.of([line], [Property("a", np.zeros(1)), Property("a", ("x",))])
    with pytest.raises(ValueError, match="one bool, number or text per line"):
        Property("a", np.zeros((2, 2)))


def test_reprojecting_agrees_with_known_places() -> None:
    """The central meridian of a zone is 500 km east, whatever the latitude; the equator is 0 north."""
    lines = Polylines.of([[[-87, 0], [-87, 30], [-84, 0]]], crs="EPSG:4326", unit="deg")
    there = reprojected(lines, UTM)
    assert (there.crs, there.unit) == (UTM, "m")
    np.testing.assert_allclose(there.points[:2, 0], 500_000, atol=1e-3)
    np.testing.assert_allclose(there.points[[0, 2], 1], 0, atol=1e-3)
    # EPSG's own worked figures for 3 degrees from the central meridian at the equator.
    np.testing.assert_allclose(there.points[2, 0], 833_978.56, atol=0.02)
    np.testing.assert_allclose(reprojected(there, "EPSG:4326").points, lines.points, atol=1e-9)
    with pytest.raises(ValueError, match="no coordinate reference system"):
        reprojected(Polylines.of([[[0, 0], [1, 1]]]), UTM)


@given(data=st.data())
def test_lines_are_cut_where_a_system_ends(data: st.DataObject) -> None:
    """Beyond the pole there is nothing."""
    point = st.tuples(st.floats(-89, -85), st.sampled_from([-80.0, 0.0, 45.5, 91.0]))
    parts = data.draw(st.lists(st.lists(point, min_size=2, max_size=7), min_size=1, max_size=4))
    number = Property("number", np.arange(len(parts)))
    lines = Polylines.of(parts, [number], "EPSG:4326", "deg")
    expected = []
    for owner, part in enumerate(parts):
        for inside, run in itertools.groupby(part, key=lambda place: place[1] < 91):
            found = list(run)
            if inside and len(found) > 1:
                expected.append((owner, found))
    cut = reprojected(lines, UTM, cut=True)
    assert cut.get("number").values.tolist() == [owner for owner, _ in expected]
    back = list(reprojected(cut, "EPSG:4326").lines())
    for line, (_, run) in zip(back, expected, strict=True):
        np.testing.assert_allclose(line, run, atol=1e-7)
    if any(place[1] == 91 for part in parts for place in part):
        with pytest.raises(ValueError, match="lies outside of what EPSG:32616 can show"):
            reprojected(lines, UTM)


def test_feet_become_metres(tmp_path: Path) -> None:
    """EPSG:2274 is Tennessee in US survey feet."""
    feet = reprojected(Polylines.of([[[-86, 35.5], [-85.9, 35.6]]], crs="EPSG:4326", unit="deg"), "EPSG:2274")
    document = {
        "type": "LineString",
        "coordinates": (feet.points / (1200 / 3937)).tolist(),
        "crs": {"type": "name", "properties": {"name": "EPSG:2274"}},
    }
    loaded = load_polylines(path=text_file(tmp_path, json.dumps(document), "a.json"))
    assert loaded.unit == "m"
    np.testing.assert_allclose(loaded.points, feet.points, atol=1e-6)
    np.testing.assert_allclose(loaded.lengths(), reprojected(feet, UTM).lengths(), rtol=2e-3)


GEOMETRIES = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "id": 7,
            "properties": {"name": "Clear Fork", "order": 3},
            "geometry": {"type": "MultiLineString", "coordinates": [[[1, 2], [3, 4]], [[5, 6, 70], [7, 8, 90]]]},
        },
        {"type": "Feature", "properties": None, "geometry": {"type": "Point", "coordinates": [0, 0]}},
        {"type": "Feature", "properties": {"order": None, "tags": ["a"]}, "geometry": None},
        {
            "type": "Feature",
            "properties": {"order": 4, "tags": ["a", 1]},
            "geometry": {
                "type": "GeometryCollection",
                "geometries": [
                    {
                        "type": "Polygon",
                        "coordinates": [[[0, 0], [9, 0], [9, 9], [0, 0]], [[2, 1], [3, 1], [3, 2], [2, 1]]],
                    },
                    {"type": "MultiPolygon", "coordinates": [[[[4, 0], [5, 0], [5, 1], [4, 0]]]]},
                ],
            },
        },
    ],
}


def test_every_geometry_of_geojson_is_read(tmp_path: Path) -> None:
    lines = load_polylines(path=text_file(tmp_path, json.dumps(GEOMETRIES), "a.geojson"))
    assert (lines.crs, lines.unit) == ("EPSG:4326", "deg")
    np.testing.assert_array_equal(np.diff(lines.offsets), [2, 2, 4, 4, 4])
    np.testing.assert_array_equal(lines.closed, [False, False, True, True, True])
    np.testing.assert_array_equal(lines.points[:4, 2], [np.nan, np.nan, 70, 90])
    values = {item.name: item.values for item in lines.properties}
    assert values["name"] == ("Clear Fork", "Clear Fork", "", "", "")
    np.testing.assert_array_equal(values["order"], [3, 3, 4, 4, 4])
    np.testing.assert_array_equal(values["id"], [7, 7, np.nan, np.nan, np.nan])
    assert values["tags"] == ("", "", *['["a", 1]'] * 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "the file is damaged: no JSON at line 1"),
        ("{}", "no GeoJSON: it lacks a 'type'"),
        ('{"type": "Point", "coordinates": [0, 0]}', "holds no lines, only 1 points"),
        ('{"type": "LineString", "coordinates": [[0, 0]]}', "without two positions"),
        ('{"type": "LineString", "coordinates": [[0, 0], ["1", 2]]}', "position"),
        ('{"type": "LineString", "coordinates": [[0, 0], [1]]}', "no list of"),
        ('{"type": "LineString", "coordinates": [[0, 0], [NaN, 1]]}', "not finite"),
        ('{"type": "LineString", "coordinates": [[0, 0], null]}', "no list of"),
        ('{"type": "LineString", "coordinates": [[500000, 4e6], [500001, 4e6]]}', "beyond the range of degrees"),
        ('{"type": "Curve", "coordinates": []}', "a 'Curve', which GeoJSON does not know"),
        ('{"type": "FeatureCollection"}', "without a list of members"),
        ('{"type": "FeatureCollection", "features": [3]}', "feature 0 holds 3"),
        ('{"type": "Polygon", "coordinates": 3}', "no Polygon"),
        ('{"type": "LineString", "crs": {"type": "link"}, "coordinates": [[0, 0], [1, 1]]}', "names no system"),
        ('{"type": "LineString", "coordinates": [[1, 1], [1, 1]]}', "holds no lines"),
    ],
)
def test_broken_geojson_is_refused(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        load_polylines(path=text_file(tmp_path, text, "a.geojson"))


@given(
    content=st.recursive(
        st.none() | st.integers(0, 3) | st.just("LineString"), lambda inner: st.lists(inner, max_size=3)
    )
)
def test_wrong_coordinates_never_end_in_anything_but_a_sentence(content, tmp_path_factory) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.geojson"
    path.write_text(json.dumps({"type": "MultiLineString", "coordinates": content}))
    try:
        loaded = len(load_polylines(path=path))
    except ValueError as error:
        loaded = len(str(error)) // 200
    assert loaded == 0


def test_lines_without_length_are_left_out_with_a_warning(tmp_path: Path, caplog) -> None:
    document = {"type": "MultiLineString", "coordinates": [[[1, 1], [1, 1]], [[1, 1], [2, 2]]]}
    with caplog.at_level(logging.WARNING):
        lines = load_polylines(path=text_file(tmp_path, json.dumps(document), "a.geojson"))
    assert len(lines) == 1
    assert "1 lines without length" in caplog.text


def test_null_crs_means_plain_metres(tmp_path: Path) -> None:
    lines = Polylines.of([[[0, 0], [1e6, 2e6]]])
    path = write(save_polylines(lines, name="a.geojson"), tmp_path)
    document = json.loads(path.read_text())
    assert document["crs"] is None
    assert "plain metres" in document["note"]
    again = load_polylines(path=path)
    assert (again.crs, again.unit) == ("", "m")
    assert load_polylines(path=path, crs=UTM).crs == UTM
    with pytest.raises(ValueError, match="choose coordinates own"):
        save_polylines(lines, name="a.geojson", coordinates="wgs84")


@pytest.mark.parametrize("name", ["urn:ogc:def:crs:OGC:1.3:CRS84", "urn:ogc:def:crs:EPSG::4326", "EPSG:4326"])
def test_names_of_wgs84(name: str, tmp_path: Path) -> None:
    document = {
        "type": "LineString", "coordinates": [[-84, 36], [-83, 37]],
        "crs": {"type": "name", "properties": {"name": name}},
    }  # fmt: skip
    lines = load_polylines(path=text_file(tmp_path, json.dumps(document), "a.geojson"))
    assert lines.crs == "EPSG:4326"
    assert lines.bounds == (-84, 36, -83, 37)


def test_auto_is_the_zone_of_the_lines(tmp_path: Path) -> None:
    document = {"type": "LineString", "coordinates": [[-85, 36], [-85, 36.5]]}
    lines = load_polylines(path=text_file(tmp_path, json.dumps(document), "a.geojson"), target_crs="auto")
    assert (lines.crs, lines.unit) == (UTM, "m")
    assert lines.lengths()[0] == pytest.approx(55_480, rel=2e-3)


def test_lines_are_cut_at_180_degrees(tmp_path: Path) -> None:
    lines = Polylines.of([[[179, 10], [-179, 20], [-178, 20]], [[170, 0], [175, 0]]], crs="EPSG:4326", unit="deg")
    document = json.loads(write(save_polylines(lines, name="a.geojson"), tmp_path).read_text())
    first, second = (feature["geometry"] for feature in document["features"])
    assert first["type"] == "MultiLineString"
    assert first["coordinates"] == [[[179, 10], [180, 15]], [[-180, 15], [-179, 20], [-178, 20]]]
    assert second["type"] == "LineString"


@pytest.mark.parametrize(
    ("text", "points", "sizes"),
    [
        ("0,0\n1,1\n", 2, [2]),
        ("x,y\n0,0\n1,1\n2,2\n", 2, [3]),
        ("0;0;5\r\n1;1;6\r\n", 3, [2]),
        ("0 0\n1 1\n\n2 2\n3 3\n\n\n", 2, [2, 2]),
        ("  0   0 7 1\n1 1 7 1\n2 2 7 2\n3 3 7 2\n", 3, [2, 2]),
        ("line\teasting\tnorthing\na\t0\t0\nb\t5\t5\na\t1\t1\nb\t6\t6\n", 2, [2, 2]),
        ("Y,X,height\n0,1,\n2,3,4\n", 3, [2]),
    ],
)
def test_tables_of_many_kinds(text: str, points: int, sizes: list[int], tmp_path: Path) -> None:
    lines = load_polylines(path=text_file(tmp_path, text, "a.txt"))
    assert lines.points.shape[1] == points
    np.testing.assert_array_equal(np.diff(lines.offsets), sizes)
    assert (lines.crs, lines.unit) == ("", "m")


def test_longitudes_say_their_system_and_columns_may_be_named(tmp_path: Path, caplog) -> None:
    path = text_file(tmp_path, "lat,lon,time,river\n36,-84,1,Elk\n37,-85,2,Elk\n")
    with caplog.at_level(logging.WARNING):
        lines = load_polylines(path=path)
    assert (lines.crs, lines.bounds) == ("EPSG:4326", (-85, 36, -84, 37))
    assert "'time' is left out" in caplog.text
    assert [item.name for item in lines.properties] == ["river"]
    named = load_polylines(path=path, columns=("x", "y", "-", "line"), crs=UTM)
    assert (named.crs, named.bounds) == (UTM, (36, -85, 37, -84))
    assert named.get("line").values == ("Elk",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "no columns x and y, only a, b"),
        ("x,y\n1,2\n3\n", r"row 2 .* has 1 cells, not 2"),
        ("x,y\n1,2\n3,four\n", "point 1 of 'a.csv' has 'four'"),
        ("x,y\n1,2\n3,\n", "point 1 of 'a.csv' has ''"),
        ("x,y\n1,2\n3,inf\n", "point 1 of 'a.csv' has 'inf'"),
        ("x,y,line\n1,2,a\n3,4,b\n", "line 'a' of 'a.csv' has one point"),
    ],
)
def test_broken_tables_are_refused(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        load_polylines(path=text_file(tmp_path, text))


def test_what_no_file_can_say_is_refused() -> None:
    line = [[0, 0], [1, 1]]
    with pytest.raises(ValueError, match=r"ends in '\.shp'; choose"):
        save_polylines(Polylines.of([line]), name="a.shp")
    with pytest.raises(ValueError, match="degrees of no system"):
        save_polylines(Polylines.of([line], unit="deg"), name="a.csv")
    with pytest.raises(ValueError, match="property 'a' of line 0 is infinite"):
        save_polylines(Polylines.of([line], [Property("a", np.array([np.inf]))]), name="a.geojson")


def test_not_utf_8(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe1,2\n")
    with pytest.raises(ValueError, match="no text in UTF-8"):
        load_polylines(path=tmp_path / "a.csv")


@pytest.mark.parametrize("suffix", ["geojson", "csv"])
def test_no_lines_at_all_come_back(suffix: str, tmp_path: Path) -> None:
    path = write(save_polylines(Polylines.of([]), name=f"a.{suffix}"), tmp_path)
    assert len(load_polylines(path=path)) == 0


@pytest.mark.parametrize("name", ["x", "Height", "line"])
def test_properties_never_pass_for_coordinates(name: str, tmp_path: Path) -> None:
    lines = Polylines.of([[[0, 0], [1, 1]]], [Property(name, np.array([7.5]))])
    again = load_polylines(path=write(save_polylines(lines, name="a.csv"), tmp_path))
    assert again.points.shape == (2, 2)
    assert again.get(f"{name}_").values == [7.5]


@pytest.mark.parametrize(
    "lines",
    [
        Polylines.of([]),
        Polylines.of([[[0, 0], [0, 0]]], [Property("$", np.array([np.nan]))]),
        Polylines.of([[[-84, 36], [-83, 37]]], [Property("level", np.array([3.0]), "m")], "EPSG:4326", "deg"),
    ],
)
def test_every_set_of_lines_has_a_preview(lines: Polylines) -> None:
    picture = preview_polylines(lines)
    assert picture == preview_polylines(lines)
    assert Picture.open(BytesIO(picture)).size[0] == 960
