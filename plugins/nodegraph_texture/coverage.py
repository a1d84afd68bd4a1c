"""Splat maps: how much each layer covers each texel, for game engines and for what builds on textures."""

from __future__ import annotations

import json
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Context, File, OutputName, Param, node, pointwise, port_type, whole
from nodegraph.errors import nearest
from nodegraph_terrain.blocks import row_blocks
from nodegraph_terrain.raster import Grid, Mask

Amount = Literal["coverage", "visible"]


@port_type
class Coverage(Grid):
    """Coverage of every layer, (rows, columns, layers) float32, 0 to 1; 0 where the ground is void.

    Attributes:
        names: of the layers, in the order of application.
        colours: of the layers, (layers, 3) sRGB, 0 to 1.
    """

    names: tuple[str, ...]
    colours: tuple[tuple[float, float, float], ...]

    axes = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.data.shape[2] == len(self.names) == len(self.colours):
            raise ValueError(f"coverage of shape {self.data.shape} needs as many names and colours as layers")


@node(version=1, locality=pointwise)
def coverage(
    layers: Coverage,
    *,
    name: Annotated[str, Param("Of the layer.")],
    amount: Annotated[
        Amount, Param("coverage: as the equation says; visible: what later layers leave of it in the picture.")
    ] = "coverage",
) -> Mask:
    """Take the coverage of one layer out of a splat map.

    ``visible`` is C_i times the product of 1 - C_j over all layers j that are applied later: the weight of the layer's
    colour in the picture.  These weights add up to the coverage of the root where that is 1, as it mostly is.

    Raises:
        ValueError: there is no layer of that name.
    """
    if name not in layers.names:
        raise ValueError(f"there is no layer '{name}'; {nearest(name, layers.names)}")
    number = layers.names.index(name)
    found = layers.data[..., number].copy()
    if amount == "visible":
        for later in range(number + 1, len(layers.names)):
            found *= 1 - layers.data[..., later]
    return Mask(found, layers.extent)


@node(version=1, locality=whole)
def save_splat(
    layers: Coverage,
    *,
    name: Annotated[OutputName, Param("File to write, .png; further pages are <name>_2.png and so on.")],
    context: Context,
) -> File:
    """Write splat maps for game engines: PNG pages of four layers each, in red, green, blue and alpha.

    A channel holds the share of the picture that a layer has (see ``visible`` of texture.coverage), 0 to 255.  The
    shares of a texel are rounded so that they add up to 255 over all pages, whatever they are, and to 0 where the
    ground is void.  A sidecar ``<name>.json`` says which channel of which page is which layer, with its colour.

    Raises:
        ValueError: the name does not end in .png.
    """
    from nodegraph_terrain.formats.png import png

    path = PurePosixPath(name)
    if path.suffix.lower() != ".png":
        raise ValueError(f"'{name}' must end in .png, the one format of splat maps")
    count = len(layers.names)
    shares = np.zeros((*layers.shape, -(-count // 4) * 4), np.uint8)
    for part in row_blocks(*layers.shape, context, cells=1 << 16, stop=0.8):
        shares[part, :, :count] = rounded_shares(visible(layers.data[part]))
    pages = [str(path)] + [str(path.with_stem(f"{path.stem}_{page + 1}")) for page in range(1, shares.shape[2] // 4)]
    table = [
        {"layer": layer, "page": pages[i // 4], "channel": "RGBA"[i % 4], "colour": [round(255 * c) for c in colour]}
        for i, (layer, colour) in enumerate(zip(layers.names, layers.colours, strict=True))
    ]
    files = []
    for number, page in enumerate(pages):
        context.progress(0.8 + 0.2 * number / len(pages))
        files.append(File.of(page, png(shares[..., 4 * number : 4 * number + 4])))
    about = File.of(str(path.with_suffix(".json")), (json.dumps({"layers": table}, indent=1) + "\n").encode())
    return File(files[0].name, files[0].content, (*files[1:], about))


def visible(covers: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the weights of the layers' colours, C_i times all later 1 - C_j, of the shape of the coverage."""
    left = np.cumprod(1 - covers[..., :0:-1], axis=-1)[..., ::-1]
    weights = covers.copy()
    weights[..., :-1] *= left
    return weights


def rounded_shares(weights: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Return weights as whole numbers that add up to 255 along the last axis, or to 0 where all weights are 0.

    By largest remainders (Hamilton's method): none is off by 1 or more from its exact share.
    """
    total = weights.sum(axis=-1, keepdims=True, dtype=np.float64)
    exact = 255 * np.divide(weights, total, out=np.zeros(weights.shape), where=total > 0)
    low = np.floor(exact)
    missing = np.rint(np.where(total > 0, 255, 0) - low.sum(axis=-1, keepdims=True))
    # The layers of the largest remainders get one more each.
    rank = np.argsort(np.argsort(low - exact, axis=-1, kind="stable"), axis=-1)
    return np.asarray(low + (rank < missing), np.uint8)
