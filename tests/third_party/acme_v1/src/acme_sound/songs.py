"""Songs as terrain: a line for each row of the ground, a note for each cell, and a pitch is a height."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nodegraph import File
from nodegraph_terrain.raster import Elevation, Extent, Raster

_SEMITONE = 1.0  # metres
_CELL = 10.0


def read(path: Path) -> Elevation:
    """Read a song of MIDI note numbers."""
    pitches = np.loadtxt(path, np.float32, ndmin=2)
    rows, cols = pitches.shape
    return Elevation(pitches * np.float32(_SEMITONE), Extent(0.0, 0.0, cols * _CELL, rows * _CELL))


def write(surface: Raster, name: str) -> File:
    """Write the nearest notes."""
    pitches = np.rint(surface.data / _SEMITONE).astype(int)
    return File.of(name, "".join(" ".join(map(str, row)) + "\n" for row in pitches.tolist()).encode())
