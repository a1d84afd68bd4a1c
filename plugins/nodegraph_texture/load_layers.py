"""Layers from a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from nodegraph import InputFile, Param, node
from nodegraph_texture.layer_file import read
from nodegraph_texture.layers import SurfaceLayers


@node(version=1)
def load_layers(
    *, path: Annotated[Path, Param("A JSON file as texture.save_layers writes it."), InputFile()]
) -> SurfaceLayers:
    """Load layers from a JSON file, as texture.save_layers writes it and people edit it.

    Raises:
        FileNotFoundError, PermissionError: there is no such file, or it may not be read.
        ValueError: the file is damaged or of another format, or has unknown keys or bad values; every problem is told
            with its place.
    """
    return read(Path(path).read_bytes(), Path(path).name)
