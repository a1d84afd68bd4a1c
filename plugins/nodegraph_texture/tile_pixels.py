"""What tiles hold for programs that show them: painted texels as four bytes each."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nodegraph_texture.evaluate import Texture

Content = Literal["colour", "normals", "heights"]

LOWEST = -32768.0
"""Height of code 0, m; a code is 1/256 m."""


def pixels_of(texture: Texture, content: Content) -> npt.NDArray[np.uint8]:
    """Return texels as red, green, blue and alpha, (rows, columns, 4) uint8; alpha is 0 where there is no ground.

    - ``colour``: the picture, sRGB and the coverage of the root.
    - ``normals``: (n + 1) / 2 in 0 to 255, east in red, north in green, up in blue; void: straight up.
    - ``heights``: of the displaced ground in the Terrarium code, h = 256 red + green + blue / 256 - 32768 m, to 2 mm;
      void: 0 m.

    Raises:
        ValueError: a height has no code.

    Source of the codes of heights: Mapzen terrain tiles, data formats,
    https://github.com/tilezen/joerd/blob/master/docs/formats.md.
    """
    if content == "colour":
        return texture.colour
    void = np.isnan(texture.height)
    made = np.empty((*void.shape, 4), np.uint8)
    made[..., 3] = np.where(void, 0, 255)
    made[..., :3] = _normals(texture.normals, void) if content == "normals" else _codes(texture.height, void)
    return made


def _normals(normals: npt.NDArray[Any], void: npt.NDArray[np.bool_]) -> npt.NDArray[Any]:
    return np.rint((np.where(void[..., None], (0.0, 0.0, 1.0), normals) + 1) * 127.5).astype(np.uint8)


def _codes(height: npt.NDArray[Any], void: npt.NDArray[np.bool_]) -> npt.NDArray[Any]:
    known = np.where(void, 0, height).astype(np.float64)
    codes = np.rint((known - LOWEST) * 256).astype(np.int64)
    if codes.min() < 0 or codes.max() >= 1 << 24:
        raise ValueError(
            f"heights of {known.min():g} to {known.max():g} m do not fit the code of tiles, "
            f"{LOWEST:g} to {-LOWEST:g} m; check the unit of the elevation"
        )
    return np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=-1)
