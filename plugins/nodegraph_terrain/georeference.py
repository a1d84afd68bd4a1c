"""Coordinate reference systems and geotransforms: the one place that speaks to rasterio about them.

rasterio is imported inside the functions: a graph without files never loads it.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from math import hypot, isclose, isfinite
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.raster import Extent

ROTATED = "is rotated or skewed against its grid; make it north-up first, such as with 'gdalwarp -t_srs EPSG:n in out'"


@contextmanager
def gdal() -> Iterator[Any]:
    """Enter a quiet GDAL environment and yield the rasterio module.

    A raster without georeference is no reason to warn: readers here decide what that means.  The filter is set for
    the process, because `warnings.catch_warnings` is not safe in threads.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    if ("ignore", None, NotGeoreferencedWarning, None, 0) not in warnings.filters:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
    with rasterio.Env():
        yield rasterio


def parse_crs(text: str) -> Any:
    """Return the rasterio CRS that `text` names (``EPSG:n``, WKT, PROJ).

    Raises:
        ValueError: nothing is known under that name.
    """
    with gdal():
        from rasterio.crs import CRS
        from rasterio.errors import CRSError

        try:
            found = CRS.from_user_input(text)
            found.to_wkt()
        except CRSError:
            found = None
    if found is None or not found:
        short = text if len(text) <= 60 else text[:57] + "..."
        raise ValueError(f"the coordinate reference system '{short}' is not known; give one such as EPSG:32632")
    return found


def crs_text(crs: Any) -> str:
    """Return a rasterio CRS as ``EPSG:n`` where it is one, else as WKT; empty for None."""
    if not crs:
        return ""
    epsg = crs.to_epsg() or _epsg_without_axes(crs)
    return f"EPSG:{epsg}" if epsg else str(crs.to_wkt())


def _epsg_without_axes(crs: Any) -> int | None:
    """Return the EPSG number of a CRS that differs from it only in the order of axes, as one from a .prj file does."""
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        found: int | None = CRS.from_wkt(crs.to_wkt(version="WKT1_ESRI")).to_epsg()
    except CRSError:
        return None
    return found


def horizontal(crs: Any) -> tuple[Any, str]:
    """Return the horizontal part of a compound CRS and the unit name of its vertical part (empty where none).

    Heights on wires are metres, whatever the file had: a vertical system in feet must not stay attached to them.
    """
    text = str(crs.to_wkt()) if crs else ""
    if not text.startswith("COMPD_CS["):
        return crs, ""
    parts = _wkt_parts(text)
    vertical = next((part for part in parts if part.startswith("VERT_CS[")), "")
    unit = next((part for part in _wkt_parts(vertical) if part.startswith("UNIT[")), "")
    return parse_crs(parts[1]), _wkt_parts(unit)[0].strip('"') if unit else ""


def system_of(crs: Any) -> tuple[str, str, float]:
    """Return the system in metres or degrees that a rasterio CRS becomes here: its text, unit, and what to multiply by.

    A projected CRS in feet or kilometres becomes the same projection in metres.  None, and a local or engineering
    system, which says nothing of where on the Earth something lies, become plain metres without a system.

    Raises:
        ValueError: the system has a unit that is neither an angle in degrees nor a length.
    """
    if not crs:
        return "", "m", 1.0
    if crs.is_geographic:
        name, factor = crs.units_factor
        if not isclose(factor, 0.017453292519943295, rel_tol=1e-9):
            raise ValueError(f"coordinates in {name} are not supported; convert them to degrees or metres")
        return crs_text(crs), "deg", 1.0
    if not crs.is_projected:
        return "", "m", 1.0
    factor = float(crs.linear_units_factor[1])
    if isclose(factor, 1.0, rel_tol=1e-9):
        return crs_text(crs), "m", 1.0
    proj = re.sub(r"\+(units|to_meter)=\S+", "", str(crs.to_proj4()))
    return crs_text(parse_crs(f"{proj} +units=m")), "m", factor


def extent_of(west: float, south: float, east: float, north: float, crs: Any) -> Extent:
    """Return an extent in metres or degrees from edges in the unit of `crs` (a rasterio CRS or None).

    Raises:
        ValueError: the system has a unit that is neither an angle in degrees nor a length.
    """
    text, unit, factor = system_of(crs)
    return Extent(west * factor, south * factor, east * factor, north * factor, text, unit)


def extent_from_transform(transform: Any, rows: int, cols: int, crs: Any) -> tuple[Extent, bool, bool]:
    """Return the extent of a grid with an affine geotransform, and whether its rows or columns run backwards.

    Raises:
        ValueError: the geotransform is rotated or sheared.
    """
    a, b, c, d, e, f = (float(value) for value in tuple(transform)[:6])
    if hypot(b * rows, d * cols) > 1e-6 * hypot(a * cols, e * rows) or a == 0 or e == 0:
        raise ValueError(ROTATED)
    x, y = sorted((c, c + a * cols)), sorted((f, f + e * rows))
    return extent_of(x[0], y[0], x[1], y[1], crs), e > 0, a < 0


def transform_of(extent: Extent, rows: int, cols: int) -> Any:
    """Return the affine geotransform of a north-up grid."""
    from rasterio.transform import Affine

    return Affine(extent.width / cols, 0.0, extent.west, 0.0, -extent.height / rows, extent.north)


def metre_crs(text: str, extent: Extent) -> Any:
    """Return the CRS in metres to reproject to: `text`, or for ``auto`` the one that suits `extent`.

    ``auto`` keeps a projected CRS in metres (but not a Mercator world map, whose metres are not metres on the ground)
    and otherwise takes the WGS 84 / UTM zone of the centre, or polar stereographic beyond 84 N and 80 S.
    """
    if not extent.crs:
        raise ValueError("the raster has no coordinate reference system; state one where it is loaded (crs)")
    source = parse_crs(extent.crs)
    if text != "auto":
        found, _ = horizontal(parse_crs(text))
        if not found.is_projected or not isclose(float(found.linear_units_factor[1]), 1.0, rel_tol=1e-9):
            raise ValueError(f"crs '{text}' is not in metres; give a projected one such as EPSG:32632, or auto")
        return found
    if source.is_projected and source.to_dict().get("proj") not in ("merc", "webmerc", "eqc", "cea", "mill"):
        return source
    with gdal():
        from rasterio.warp import transform

        x, y = (extent.west + extent.east) / 2, (extent.south + extent.north) / 2
        (lon,), (lat,) = transform(source, parse_crs("EPSG:4326"), [x], [y])
    if lat >= 84:
        return parse_crs("EPSG:32661")
    if lat < -80:
        return parse_crs("EPSG:32761")
    zone = int(((lon + 180) % 360) // 6) + 1
    return parse_crs(f"EPSG:{(32600 if lat >= 0 else 32700) + zone}")


def stated(extent: Extent, crs: str) -> Extent:
    """Return `extent` with its edges read in the stated system instead of its own."""
    found, _ = horizontal(parse_crs(crs))
    return extent_of(extent.west, extent.south, extent.east, extent.north, found)


def _wkt_parts(text: str) -> list[str]:
    """Split ``NAME[a,b[c,d],e]`` into its direct parts ``a``, ``b[c,d]``, ``e``; what is quoted splits nothing."""
    inner = text[text.find("[") + 1 : text.rfind("]")]
    parts, depth, quoted, start = [], 0, False, 0
    for position, char in enumerate(inner):
        if char == '"':
            quoted = not quoted
        elif quoted:
            continue
        elif char in "[(":
            depth += 1
        elif char in "])":
            depth -= 1
        elif char == "," and depth == 0:
            parts.append(inner[start:position])
            start = position + 1
    return [*parts, inner[start:]]


def bounds_in(extent: Extent, target: Any) -> tuple[float, float, float, float] | None:
    """Return the box (west, south, east, north) around `extent` in another system, or None if it has none there."""
    with gdal() as rasterio:
        from rasterio.errors import CRSError, RasterioError
        from rasterio.warp import transform_bounds

        try:
            found = transform_bounds(
                parse_crs(extent.crs), target, extent.west, extent.south, extent.east, extent.north, densify_pts=101
            )
        except (CRSError, RasterioError, rasterio._err.CPLE_BaseError):
            return None
    west, south, east, north = (float(edge) for edge in found)
    return (west, south, east, north) if all(map(isfinite, found)) and west < east and south < north else None


def transformed(
    source: Any, target: Any, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return points, given in the `source` CRS, in the `target` CRS; infinite where there is no such point."""
    found = np.full((2, x.size), np.inf)
    flat = x.ravel().tolist(), y.ravel().tolist()
    with gdal() as rasterio:
        from rasterio.warp import transform

        # One point without a place makes the whole call fail: such points are found by halving.
        pending = [slice(0, x.size)] if x.size else []
        while pending:
            part = pending.pop()
            try:
                found[:, part] = transform(source, target, flat[0][part], flat[1][part])
            except rasterio._err.CPLE_BaseError:
                middle = (part.start + part.stop) // 2
                pending += [
                    half for half in (slice(part.start, middle), slice(middle, part.stop)) if part.stop - part.start > 1
                ]
    return found[0].reshape(x.shape), found[1].reshape(x.shape)
