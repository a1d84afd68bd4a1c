"""Layers as a file."""

from __future__ import annotations

from typing import Annotated

from nodegraph import File, OutputName, Param, node
from nodegraph_texture.layer_file import written
from nodegraph_texture.layers import SurfaceLayers


@node(version=1)
def save_layers(
    layers: SurfaceLayers,
    *,
    name: Annotated[OutputName, Param("File to write, such as layers.json.")],
) -> File:
    """Write layers to a JSON file that a person can edit; texture.load_layers reads exactly the same back.

    `nodegraph_texture.layer_file` describes the format: a hat is four numbers, with null for an open side, a measured
    function a list of samples; what has its default is left out.

    Raises:
        ValueError: the name does not end in .json, or the hierarchy has more than 24 levels.
    """
    if not name.lower().endswith(".json"):
        raise ValueError(f"'{name}' must end in .json, the one format of layers")
    return File.of(name, written(layers).encode())
