"""The JSON beside a heightmap that cannot say for itself what it means: shape, height range, void, georeference.

`heights.png` has its sidecar in `heights.png.json`, written by terrain.save_elevation and found by
terrain.load_elevation.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph_terrain.raster import Extent, Raster

FORMAT = "nodegraph-heights/1"


@dataclass(frozen=True, slots=True)
class Codes:
    """How unsigned integers stand for heights.

    Code `low` is `minimum` and code `high` is `maximum`, linear between; code `void` (or none) is a void.
    """

    minimum: float
    maximum: float
    low: int = 0
    high: int = 65535
    void: int | None = None

    @property
    def step(self) -> float:
        """Height between two neighbouring codes."""
        return (self.maximum - self.minimum) / (self.high - self.low)

    def decode(self, codes: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        """Return heights; voids are NaN."""
        heights = self.minimum + (codes.astype(np.float64) - self.low) * self.step
        if self.void is not None:
            heights[codes == self.void] = np.nan
        return heights.astype(np.float32)

    def encode(self, heights: npt.NDArray[Any]) -> npt.NDArray[np.uint16]:
        """Return the nearest codes of heights inside the range; NaN becomes the void code."""
        scaled = np.zeros(heights.shape) if self.step == 0 else (heights.astype(np.float64) - self.minimum) / self.step
        codes = np.clip(np.rint(scaled) + self.low, self.low, self.high)
        missing = np.isnan(heights)
        codes[missing] = 0 if self.void is None else self.void
        return np.asarray(codes, np.uint16)


@dataclass(frozen=True, slots=True)
class Sidecar:
    """What a sidecar says.

    Attributes:
        rows, columns: shape of the raster.
        dtype: ``uint16`` or ``float32``, little-endian where the file itself does not say.
        extent: what the raster covers.
        unit: unit of the heights, such as ``m``.
        codes: how integers stand for heights; None for floats, whose void is NaN.
    """

    rows: int
    columns: int
    dtype: str
    extent: Extent
    unit: str = "m"
    codes: Codes | None = None

    @classmethod
    def of(cls, raster: Raster, dtype: str, codes: Codes | None = None) -> Sidecar:
        """Describe a raster that is saved as `dtype`."""
        return cls(*raster.shape, dtype, raster.extent, raster.unit, codes)

    def to_bytes(self) -> bytes:
        """Return the sidecar as JSON."""
        record: dict[str, Any] = {
            "format": FORMAT,
            "rows": self.rows,
            "columns": self.columns,
            "dtype": self.dtype,
            "byte_order": "little",
            "unit": self.unit,
        }
        if self.codes is not None:
            record |= {
                "minimum": self.codes.minimum,
                "maximum": self.codes.maximum,
                "minimum_code": self.codes.low,
                "maximum_code": self.codes.high,
                "void_code": self.codes.void,
            }
        record["extent"] = asdict(self.extent)
        return (json.dumps(record, indent=2, ensure_ascii=False) + "\n").encode()


def beside(path: Path) -> Sidecar | None:
    """Return the sidecar of the heightmap at `path`, or None where there is none (or a JSON of another kind).

    Raises:
        ValueError: it is one of ours, but damaged.
    """
    file = path.with_name(path.name + ".json")
    if not file.is_file():
        return None
    try:
        record = json.loads(file.read_bytes())
    except ValueError:
        raise ValueError(f"'{file.name}' is not valid JSON; remove or repair it, it belongs to '{path.name}'") from None
    if not isinstance(record, dict) or "format" not in record:
        return None
    if record["format"] != FORMAT:
        raise ValueError(f"'{file.name}' has format '{record['format']}', expected '{FORMAT}'; remove it or update")
    try:
        codes = None
        if record.get("minimum") is not None:
            void = record.get("void_code")
            codes = Codes(
                float(record["minimum"]),
                float(record["maximum"]),
                int(record["minimum_code"]),
                int(record["maximum_code"]),
                None if void is None else int(void),
            )
            if codes.high <= codes.low:
                raise ValueError
        edges = record["extent"]
        west, south, east, north = (float(edges[name]) for name in ("west", "south", "east", "north"))
        extent = Extent(west, south, east, north, str(edges["crs"]), str(edges["unit"]))
        rows, columns = int(record["rows"]), int(record["columns"])
        return Sidecar(rows, columns, str(record["dtype"]), extent, str(record.get("unit", "m")), codes)
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"'{file.name}' is damaged; save '{path.name}' again or remove the sidecar") from None
