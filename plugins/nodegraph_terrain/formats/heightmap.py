"""What heightmaps share that cannot say for themselves what they hold: 16-bit codes, and the JSON beside the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from nodegraph import File
from nodegraph_terrain.formats.contents import Contents
from nodegraph_terrain.raster import Raster
from nodegraph_terrain.sidecar import Codes, Sidecar


def explained(found: Contents, path: Path, known: Sidecar | None) -> Contents:
    """Return the contents of a file with what its sidecar adds: place, unit, and what the codes mean.

    Raises:
        ValueError: the sidecar speaks of another shape.
    """
    if known is None:
        return found
    if (known.rows, known.columns) != (found.rows, found.cols):
        raise ValueError(
            f"'{path.name}' has {found.rows} x {found.cols} cells, but its sidecar '{path.name}.json' says "
            f"{known.rows} x {known.columns}; remove the sidecar or save the file again"
        )
    # A plain number (a mask, say) counts as metres.
    unit = known.unit if known.unit != "1" else ""
    return replace(found, extent=known.extent, unit=unit or found.unit, codes=known.codes)


def codes_of(surface: Raster, name: str, minimum: float | None, maximum: float | None) -> Codes:
    """Return codes for the heights of a raster, from the stated range or from its own.

    Raises:
        ValueError: heights lie outside of the range or are infinite, or there are none and no range is stated.
    """
    missing = np.isnan(surface.data)
    known = surface.data[~missing]
    if len(known):
        lowest, highest = float(known.min()), float(known.max())
    elif minimum is None or maximum is None:
        raise ValueError(f"every cell is void, so '{name}' has no height range; state minimum and maximum")
    else:
        lowest, highest = minimum, maximum
    low, high = lowest if minimum is None else float(minimum), highest if maximum is None else float(maximum)
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        raise ValueError(f"the raster holds infinite values, which '{name}' cannot; link it through terrain.clamp")
    if low > lowest or high < highest or low > high:
        raise ValueError(
            f"heights from {lowest:g} to {highest:g} do not fit the range {low:g} to {high:g} of '{name}'; "
            "widen it, or link the raster through terrain.clamp"
        )
    return Codes(low, high, 1, 65535, 0) if missing.any() else Codes(low, high)


def with_sidecar(name: str, content: bytes, sidecar: Sidecar) -> File:
    """Return a file with its sidecar."""
    return File.of(name, content, File.of(f"{name}.json", sidecar.to_bytes()))
