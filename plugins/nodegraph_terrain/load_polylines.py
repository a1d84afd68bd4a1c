"""Lines from files: GeoJSON, and tables of points."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, InputFile, Param, node
from nodegraph_terrain.georeference import horizontal, metre_crs, parse_crs, system_of
from nodegraph_terrain.polylines import Polylines, Property, reprojected
from nodegraph_terrain.raster import Extent

WGS84 = "EPSG:4326"

ROLES: Mapping[str, tuple[str, ...]] = {
    "x": ("x", "lon", "longitude", "lng", "long", "easting", "east"),
    "y": ("y", "lat", "latitude", "northing", "north"),
    "z": ("z", "height", "elevation", "altitude", "alt", "ele"),
    "line": ("line", "line_id", "lineid", "polyline", "track"),
}
"""What the columns of a table are called, by what they hold; the first names are the plainest."""

DEGREES = frozenset({"lon", "longitude", "lng", "long"})
"""Names of an x that is a longitude."""

_INTEGER = re.compile(r"-?(0|[1-9]\d{0,17})")
_NUMBER = re.compile(r"[+-]?((0|[1-9]\d*)(\.\d*)?|\.\d+)([eE][+-]?\d+)?|nan", re.IGNORECASE)


@dataclass
class _Found:
    """What a file holds: the points of each line, a record of properties for each, the system (None: not said)."""

    lines: list[npt.NDArray[np.float64]] = field(default_factory=list)
    records: list[dict[str, Any]] = field(default_factory=list)
    units: dict[str, str] = field(default_factory=dict)
    crs: str | None = None
    others: int = 0


@node(version=1)
def load_polylines(
    *,
    path: Annotated[Path, Param("GeoJSON (.geojson, .json), or a table of points."), InputFile(sidecars=(".prj",))],
    crs: Annotated[str, Param("Coordinate reference system, for files that do not say or say it wrong.")] = "",
    target_crs: Annotated[
        str, Param("System to bring the lines to, such as EPSG:32632; auto: the one in metres that suits them.")
    ] = "",
    columns: Annotated[
        tuple[str, ...],
        Param("Names for the columns of a table, in order: x, y, z, line, others, or '-' to leave out."),
    ] = (),
    context: Context,
) -> Polylines:
    """Load lines from GeoJSON, or from a table of points.

    **GeoJSON** (RFC 7946, and the 2008 form with a member ``crs``): LineString and MultiLineString become lines, and
    each ring of Polygon and MultiPolygon a closed line, at any depth of features and collections; points are left out.
    A third coordinate is a height in m.  Coordinates are WGS 84 longitude and latitude unless ``crs`` says otherwise; a
    ``crs`` of null means plain metres.  The properties of a feature (and its id) belong to each of its lines.

    **Tables** (.csv and any other suffix): one point per row, separated by commas, semicolons, tabs or blanks.  The
    first row may name the columns: x, y, z, line, or usual names such as lon, lat, easting, height.  Without names they
    are x, y[, z[, line]].  Rows with the same value of ``line`` are one line; without that column a blank row starts
    the next.  Further columns become properties where they have one value per line.  The system is that of a .prj file
    beside the table, WGS 84 where the columns are called lon and lat, else plain metres.

    A property is a bool, integer or number where all its values are (null and missing ones are NaN), else text.  A
    projected system in feet becomes the same projection in metres.  Lines without length are left out, with a warning.

    Args:
        path: the file.
        crs: read the coordinates in this system, whatever the file says.
        target_crs: reproject the lines; none keeps their system.
        columns: instead of the first row of a table.
        context: the engine's.

    Raises:
        FileNotFoundError, PermissionError: there is no such file, or it may not be read.
        ValueError: the file is no GeoJSON or table, holds no lines, has a point without numbers, or degrees out of
            range; or a system is unknown.

    Reference: H. Butler et al. (2016): The GeoJSON Format. RFC 7946. doi:10.17487/RFC7946.
    """
    text = _text(path)
    is_json = path.suffix.lower() in (".geojson", ".json") or text.lstrip()[:1] == "{"
    found = _geojson(text, context) if is_json else _table(text, path, columns, context)
    context.progress(0.7)
    stated = crs or found.crs
    source, _ = horizontal(parse_crs(stated)) if stated else (None, "")
    name, unit, factor = system_of(source)
    name = WGS84 if "CRS84" in name else name
    long = [index for index, line in enumerate(found.lines) if (line[:, :2] != line[0, :2]).any()]
    if len(long) < len(found.lines):
        context.log.warning("%d lines without length are left out", len(found.lines) - len(long))
    if not long and (found.lines or found.others):
        raise ValueError(f"'{path.name}' holds no lines, only {len(found.lines) + found.others} points")
    properties = _properties([found.records[index] for index in long], found.units)
    kept = _of_one_dimension([found.lines[index] for index in long])
    lines = Polylines.of(kept, properties, name, unit)
    if unit == "deg" and (np.abs(lines.points[:, :2]) > (360, 90)).any():
        raise ValueError(f"'{path.name}' has coordinates beyond the range of degrees; state its system (crs)")
    if factor != 1:
        lines.points[:, :2] *= factor
    return _brought_to(lines, target_crs)


def _text(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"'{path.name}' is no text in UTF-8 (byte {error.start}); give GeoJSON or a table") from error


def _brought_to(lines: Polylines, target: str) -> Polylines:
    if not target:
        return lines
    box = lines.bounds
    if target == "auto" and lines.crs:
        if box is None:
            return lines
        # A line may run straight east or north, where an extent has an area.
        west, south, east, north = (edge + pad for edge, pad in zip(box, (-1e-9, -1e-9, 1e-9, 1e-9), strict=True))
        target = metre_crs("auto", Extent(west, south, east, north, lines.crs, lines.unit)).to_wkt()
    return reprojected(lines, target)


def _of_one_dimension(lines: list[npt.NDArray[np.float64]]) -> list[npt.NDArray[np.float64]]:
    """Return the lines with three coordinates where any has them, a height that is not known being NaN."""
    if {line.shape[1] for line in lines} != {2, 3}:
        return lines
    return [np.pad(line, ((0, 0), (0, 3 - line.shape[1])), constant_values=np.nan) for line in lines]


# GeoJSON.


def _geojson(text: str, context: Context) -> _Found:
    try:
        document = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        where = f" at line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        raise ValueError(f"the file is damaged: no JSON{where}") from error
    if not isinstance(document, dict) or not isinstance(document.get("type"), str):
        raise ValueError("the file is no GeoJSON: it lacks a 'type', such as FeatureCollection")
    found = _Found(crs=_stated_crs(document))
    units = document.get("units")
    found.units = {str(key): str(unit) for key, unit in units.items()} if isinstance(units, dict) else {}
    for count, (geometry, record, where) in enumerate(_geometries(document)):
        if count % 4096 == 0:
            context.progress(0.3)
        parts = _parts(geometry, where)
        found.others += not parts
        found.lines += [_positions(part, where) for part in parts]
        found.records += [record] * len(parts)
    return found


def _stated_crs(document: Mapping[str, Any]) -> str | None:
    """Return the system that a document states; without a member ``crs`` it is WGS 84, and null is none."""
    stated = document.get("crs", {})
    if stated is None:
        return None
    if not stated:
        return WGS84
    name = stated.get("properties", {}).get("name") if isinstance(stated, dict) else None
    if not isinstance(name, str):
        raise ValueError("the member 'crs' of the file names no system; state it (crs)")
    return name


def _geometries(document: Mapping[str, Any]) -> Iterator[tuple[Mapping[str, Any], dict[str, Any], str]]:
    """Yield (geometry, properties, where) of everything in a document that is no collection, in order."""
    stack: list[tuple[Any, dict[str, Any], str]] = [(document, {}, "the file")]
    while stack:
        item, record, where = stack.pop()
        if item is None:
            continue
        if not isinstance(item, dict):
            raise ValueError(f"{where} holds {item!r:.40} where GeoJSON has an object")
        kind = item.get("type")
        if kind == "Feature":
            own = item.get("properties") or {}
            record = {str(key) or "unnamed": value for key, value in own.items()}
            if item.get("id") is not None:
                record.setdefault("id", item["id"])
            stack.append((item.get("geometry"), record, where))
        elif kind in ("FeatureCollection", "GeometryCollection"):
            members = item.get("features" if kind == "FeatureCollection" else "geometries")
            if not isinstance(members, list):
                raise ValueError(f"{where} is a {kind} without a list of members")
            noun = "feature" if kind == "FeatureCollection" else "geometry"
            stack += [(member, record, f"{noun} {index}") for index, member in enumerate(members)][::-1]
        else:
            yield item, record, where


def _parts(geometry: Mapping[str, Any], where: str) -> list[Any]:
    """Return the coordinates of each line of a geometry; none for points."""
    kind, coordinates = geometry.get("type"), geometry.get("coordinates")
    if kind in ("Point", "MultiPoint"):
        return []
    depth = {"LineString": 0, "MultiLineString": 1, "Polygon": 1, "MultiPolygon": 2}.get(str(kind))
    if depth is None:
        raise ValueError(f"{where} is a '{kind}', which GeoJSON does not know")
    parts: list[Any] = [coordinates]
    for _ in range(depth):
        if not all(isinstance(part, list) for part in parts):
            raise ValueError(f"{where} has coordinates that are no {kind}")
        parts = [inner for part in parts for inner in part]
    return [part for part in parts if part != []]


def _positions(part: Any, where: str) -> npt.NDArray[np.float64]:
    """Return the points of one line, (n, 2) or (n, 3)."""
    try:
        points = np.array(part)
    except ValueError:  # some positions have a height, others do not
        points = np.zeros(0)
    if points.ndim != 2 or points.dtype.kind not in "if":
        if not isinstance(part, list) or not all(isinstance(item, list) and len(item) >= 2 for item in part):
            raise ValueError(f"{where} has a line that is no list of [x, y] positions")
        try:
            points = np.array([[*item[:3], np.nan][:3] for item in part])
        except ValueError as error:
            raise ValueError(f"{where} has a position that is no list of numbers") from error
    if points.ndim != 2 or points.dtype.kind not in "if" or len(points) < 2 or points.shape[1] < 2:
        raise ValueError(f"{where} has a line without two positions of numbers")
    if not np.isfinite(points[:, :2]).all():
        raise ValueError(f"{where} has a position that is not finite")
    return points[:, :3].astype(np.float64)


# Tables.


def _table(text: str, path: Path, columns: Sequence[str], context: Context) -> _Found:
    rows, blanks = _rows(text)
    if not rows:
        raise ValueError(f"'{path.name}' is empty; give one point per row")
    named = not all(_NUMBER.fullmatch(cell) for cell in rows[0][:2])
    names = list(columns) or ([cell.lower() for cell in rows[0]] if named else ["x", "y", "z", "line"][: len(rows[0])])
    shown = list(columns) or (rows[0] if named else names)
    first = int(named)
    places = {role: _place(names, usual) for role, usual in ROLES.items()}
    if places["x"] is None or places["y"] is None or len(names) < 2:
        raise ValueError(f"'{path.name}' has no columns x and y, only {', '.join(shown)}; name them (columns)")
    numbers = [index for role in ("x", "y", "z") if (index := places[role]) is not None]
    short = next((row for row, cells in enumerate(rows) if len(cells) != len(names)), None)
    if short is not None:
        raise ValueError(f"row {short} of '{path.name}' has {len(rows[short])} cells, not {len(names)}")
    points = np.empty((len(rows) - first, len(numbers)))
    for column, index in enumerate(numbers):
        context.progress(0.2 * column)
        points[:, column] = _coordinates([cells[index] for cells in rows[first:]], path.name, empty=column == 2)
    groups = _groups(rows[first:], places["line"], [blank - first for blank in blanks])
    found = _Found(
        lines=[points[group] for group in groups.values()], crs=WGS84 if names[places["x"]] in DEGREES else None
    )
    for key, group in groups.items():
        if len(group) < 2:
            raise ValueError(f"line '{key}' of '{path.name}' has one point; a line needs two at least")
    beside = path.with_suffix(".prj")
    if beside.is_file():
        found.crs = beside.read_text(errors="replace")
    found.records = [{} for _ in groups]
    numbered = list(groups) == [str(index) for index in range(len(groups))]
    for index, name in enumerate(shown):
        if index in numbers or name in ("-", "") or (index == places["line"] and numbered):
            continue
        cells_of = [{rows[first + row][index] for row in group} for group in groups.values()]
        if any(len(cells) > 1 for cells in cells_of):
            context.log.warning("column '%s' is left out: it varies along a line", name)
            continue
        kind = _kind_of([cell for cells in cells_of for cell in cells])
        for record, cells in zip(found.records, cells_of, strict=True):
            record[name] = kind(next(iter(cells)))
    return found


def _rows(text: str) -> tuple[list[list[str]], list[int]]:
    """Return the cells of each row that has any, and before which of them blank rows stand."""
    sample = next((line for line in text.splitlines() if line.strip()), "")
    separator = next((mark for mark in (",", ";", "\t") if mark in sample), " ")
    reader = csv.reader(StringIO(text), delimiter=separator, skipinitialspace=True)
    rows: list[list[str]] = []
    blanks: list[int] = []
    try:
        for cells in reader:
            cells = [cell.strip() for cell in cells if cell or separator != " "]
            if any(cells):
                rows.append(cells)
            else:
                blanks.append(len(rows))
    except csv.Error as error:
        raise ValueError(f"the table is damaged at line {reader.line_num} ({error})") from error
    return rows, blanks


def _place(names: Sequence[str], usual: Sequence[str]) -> int | None:
    return next((names.index(name) for name in usual if name in names), None)


def _coordinates(cells: Sequence[str], name: str, *, empty: bool) -> npt.NDArray[np.float64]:
    """Return the numbers in cells, which may be `empty` (NaN) or not."""
    try:
        values = np.array([float(cell) if cell else np.nan for cell in cells])
        wrong = np.isinf(values) if empty else ~np.isfinite(values)
    except ValueError:
        wrong = np.array([not (_NUMBER.fullmatch(cell) or (empty and not cell)) for cell in cells])
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise ValueError(f"point {row} of '{name}' has '{cells[row]}' where a coordinate should be")
    return values


def _groups(rows: Sequence[Sequence[str]], line: int | None, blanks: Sequence[int]) -> dict[str, list[int]]:
    """Return the rows of each line, by the name of the line."""
    groups: dict[str, list[int]] = {}
    if line is not None:
        for row, cells in enumerate(rows):
            groups.setdefault(cells[line], []).append(row)
        return groups
    starts = sorted({0, *(blank for blank in blanks if 0 < blank < len(rows))})
    ends = [*starts[1:], len(rows)]
    return {str(index): list(range(*ends_of)) for index, ends_of in enumerate(zip(starts, ends, strict=True))}


def _kind_of(cells: Sequence[str]) -> Callable[[str], Any]:
    """Return what turns the cells of a column into values of one kind."""
    if all(cell in ("true", "false") for cell in cells):
        return lambda cell: cell == "true"
    if all(_INTEGER.fullmatch(cell) for cell in cells):
        return int
    if all(not cell or _NUMBER.fullmatch(cell) for cell in cells) and any(cells):
        return lambda cell: float(cell or "nan")
    return str


# Properties.


def _properties(records: Sequence[Mapping[str, Any]], units: Mapping[str, str]) -> list[Property]:
    names = dict.fromkeys(name for record in records for name in record)
    return [_property(name, [record.get(name) for record in records], units.get(name, "")) for name in names]


def _property(name: str, values: Sequence[Any], unit: str) -> Property:
    kinds = {type(value) for value in values}
    if kinds == {bool}:
        return Property(name, np.array(values, np.bool_), unit)
    fits = all(abs(value) < 1 << 63 for value in values if type(value) is int)
    if kinds == {int} and fits:
        return Property(name, np.array(values, np.int64), unit)
    if kinds & {int, float} and kinds <= {int, float, type(None)} and fits:
        return Property(name, np.array([np.nan if value is None else value for value in values], np.float64), unit)
    texts = ("" if value is None else value if isinstance(value, str) else json.dumps(value) for value in values)
    return Property(name, tuple(texts), unit)
