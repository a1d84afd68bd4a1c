"""Lines as files: GeoJSON, and tables of points."""

from __future__ import annotations

import csv
import json
from io import StringIO
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, File, OutputName, Param, node
from nodegraph_terrain.georeference import parse_crs
from nodegraph_terrain.load_polylines import ROLES, WGS84
from nodegraph_terrain.polylines import Polylines, Property, reprojected

Coordinates = Literal["auto", "wgs84", "own"]

PLAIN = "The coordinates are plain metres, in no coordinate reference system."

DECIMALS = {"m": 4, "deg": 9}
"""Decimals that hold a tenth of a millimetre."""

_RESERVED = frozenset(name for names in ROLES.values() for name in names)


@node(version=1)
def save_polylines(
    lines: Polylines,
    *,
    name: Annotated[OutputName, Param("File to write; the suffix is the format: geojson, json or csv.")],
    coordinates: Annotated[
        Coordinates, Param("WGS 84, the lines' own system, or auto: WGS 84 in GeoJSON where the system is known.")
    ] = "auto",
    decimals: Annotated[
        int | None, Param("Decimals of coordinates; none: a tenth of a millimetre.", ge=0, le=17)
    ] = None,
    context: Context,
) -> File:
    """Write lines to a file.  terrain.load_polylines reads both formats back.

    - ``.geojson``, ``.json``: a FeatureCollection with one LineString per line and its properties; a height is the
      third coordinate.  RFC 7946 knows one system, WGS 84 longitude and latitude: lines in another are reprojected,
      and cut where they cross 180 degrees.  ``own`` keeps their coordinates and names the system in a member ``crs``,
      as the form of 2008 did and most programs still read.  Lines without any system keep their metres, with ``crs``
      null and a note.  Units of properties are kept in a member ``units``.
    - ``.csv``: one point per row: x, y (lon, lat for degrees), the height as z where there is one, the number of its
      line, and the properties of the line.  The lines' own system, in a ``.prj`` file beside it.  A property that is
      called as one of the usual names of coordinates is written with an underscore; units are not kept.

    The same lines give the same bytes on every run.

    Args:
        lines: any lines; none at all give a file without lines.
        name: the file.
        coordinates: in which system; GeoJSON in another than WGS 84 is no RFC 7946.
        decimals: 9 for degrees and 4 for metres by default; 17 keep every number as it is.
        context: the engine's.

    Raises:
        ValueError: the suffix names no format, a property is infinite, the lines have no system that WGS 84 could be
            computed from, or are in degrees of no system.

    Reference: H. Butler et al. (2016): The GeoJSON Format. RFC 7946. doi:10.17487/RFC7946.
    """
    suffix = PurePosixPath(name).suffix.lower()
    if suffix not in (".geojson", ".json", ".csv"):
        raise ValueError(f"'{name}' ends in '{suffix}'; choose .geojson, .json or .csv")
    if lines.unit == "deg" and not lines.crs:
        raise ValueError("the lines are in degrees of no system, which no file can say; state it where they come from")
    if coordinates == "wgs84" and not lines.crs:
        raise ValueError("the lines have no coordinate reference system to reach WGS 84 from; choose coordinates own")
    if coordinates == "wgs84" or (coordinates == "auto" and lines.crs and suffix != ".csv"):
        lines = reprojected(lines, WGS84)
    if suffix == ".csv":
        return _csv(lines, name, decimals, context)
    return File.of(name, _geojson(lines, decimals, context).encode())


def _rounded(points: npt.NDArray[np.float64], unit: str, decimals: int | None) -> npt.NDArray[np.float64]:
    """Return the points to so many decimals, heights to those of metres; zero has no sign."""
    if decimals is not None and decimals >= 17:
        return points
    plan = np.round(points[:, :2], DECIMALS[unit] if decimals is None else decimals)
    return np.hstack([plan, np.round(points[:, 2:], DECIMALS["m"] if decimals is None else decimals)]) + 0.0


def _geojson(lines: Polylines, decimals: int | None, context: Context) -> str:
    head: dict[str, Any] = {"type": "FeatureCollection"}
    if not lines.crs:
        head |= {"crs": None, "note": PLAIN}
    elif lines.crs != WGS84:
        name = lines.crs.replace("EPSG:", "urn:ogc:def:crs:EPSG::") if lines.crs.startswith("EPSG:") else lines.crs
        head["crs"] = {"type": "name", "properties": {"name": name}}
    units = {item.name: item.unit for item in lines.properties if item.unit}
    if units:
        head["units"] = units
    texts = []
    for index, (record, points) in enumerate(zip(_records(lines), lines.lines(), strict=True)):
        if index % 4096 == 0:
            context.progress(index / len(lines))
        parts = _cut(points) if lines.crs == WGS84 else [points]
        places = [_positions(_rounded(part, lines.unit, decimals)) for part in parts]
        kind, shown = ("LineString", places[0]) if len(places) == 1 else ("MultiLineString", places)
        feature = {"type": "Feature", "properties": record, "geometry": {"type": kind, "coordinates": shown}}
        texts.append(json.dumps(feature, ensure_ascii=False, allow_nan=False))
    opening = json.dumps(head, ensure_ascii=False)[:-1]
    return opening + ', "features": [\n' + ",\n".join(texts) + "\n]}\n"


def _positions(points: npt.NDArray[np.float64]) -> list[list[float]]:
    if points.shape[1] == 2 or not np.isnan(points[:, 2]).any():
        return points.tolist()  # type: ignore[no-any-return]
    return [[value for value in point if value == value] for point in points.tolist()]


def _cut(points: npt.NDArray[np.float64]) -> list[npt.NDArray[np.float64]]:
    """Return the pieces of a line in degrees on either side of 180 degrees, which no line of GeoJSON should cross."""
    jumps = np.flatnonzero(np.abs(np.diff(points[:, 0])) > 180)
    if not len(jumps):
        return [points]
    pieces, start = [], np.zeros((0, points.shape[1]))
    first = 0
    for jump in jumps.tolist():
        before, after = points[jump], points[jump + 1]
        side = np.copysign(180.0, before[0])
        beyond = after[0] + 2 * side
        share = (side - before[0]) / (beyond - before[0]) if beyond != before[0] else 0.0
        edge = before + share * (after - before)
        pieces.append(np.vstack([start, points[first : jump + 1], [[side, *edge[1:]]]]))
        start, first = np.array([[-side, *edge[1:]]]), jump + 1
    pieces.append(np.vstack([start, points[first:]]))
    # A line that touches 180 degrees with its end has no length on one side.
    return [piece for piece in pieces if (piece[:, :2] != piece[0, :2]).any()]


def _records(lines: Polylines) -> list[dict[str, Any]]:
    """Return the properties of each line as JSON values; what is not known is null."""
    columns = {item.name: _json_values(item) for item in lines.properties}
    return [{name: values[index] for name, values in columns.items()} for index in range(len(lines))]


def _json_values(item: Property) -> list[Any]:
    if isinstance(item.values, tuple):
        return list(item.values)
    if item.values.dtype.kind != "f":
        return list(item.values.tolist())
    if np.isinf(item.values).any():
        line = int(np.flatnonzero(np.isinf(item.values))[0])
        raise ValueError(f"property '{item.name}' of line {line} is infinite, which GeoJSON cannot say")
    return [None if value != value else value for value in item.values.tolist()]


def _csv(lines: Polylines, name: str, decimals: int | None, context: Context) -> File:
    buffer = StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    plan = ["lon", "lat"] if lines.unit == "deg" else ["x", "y"]
    writer.writerow([*plan, *["z"][: lines.points.shape[1] - 2], "line", *_column_names(lines)])
    columns = [_csv_values(item) for item in lines.properties]
    for index, points in enumerate(lines.lines()):
        if index % 4096 == 0:
            context.progress(index / len(lines))
        tail = [str(index), *(values[index] for values in columns)]
        for point in _rounded(points, lines.unit, decimals).tolist():
            writer.writerow([*("" if value != value else repr(value) for value in point), *tail])
    content = buffer.getvalue().encode()
    if not lines.crs:
        return File.of(name, content)
    prj = parse_crs(lines.crs).to_wkt(version="WKT1_ESRI")
    return File.of(name, content, File.of(str(PurePosixPath(name).with_suffix(".prj")), prj.encode()))


def _column_names(lines: Polylines) -> list[str]:
    return [f"{item.name}_" if item.name.lower() in _RESERVED else item.name for item in lines.properties]


def _csv_values(item: Property) -> list[str]:
    if isinstance(item.values, tuple):
        return list(item.values)
    if item.values.dtype.kind == "b":
        return ["true" if value else "false" for value in item.values.tolist()]
    return [repr(value) for value in item.values.tolist()]
