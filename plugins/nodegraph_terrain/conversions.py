"""What turns one raster type into another where a link needs it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nodegraph import node, pointwise
from nodegraph_terrain.raster import Image, Mask, Shade


@node(version=1, locality=pointwise)
def shade_image(shade: Shade) -> Image:
    """Show a shade as a grey picture: 0 is black, 1 white, a void transparent.

    Value = round(255 shade); a fourth channel is there only where voids are.  Used in links
    from a shade to an image.
    """
    return Image(_grey(shade.data), shade.extent)


@node(version=1, locality=pointwise)
def mask_image(mask: Mask) -> Image:
    """Show a mask as a grey picture: 0 is black, 1 white, a void transparent.

    Value = round(255 mask); a fourth channel is there only where voids are.  Used in links
    from a mask to an image.
    """
    return Image(_grey(mask.data), mask.extent)


def _grey(values: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    missing = np.isnan(values)
    grey = np.rint(np.where(missing, 0, np.clip(values, 0, 1)) * 255).astype(np.uint8)
    channels = [grey, grey, grey]
    if missing.any():
        channels.append(np.where(missing, 0, 255).astype(np.uint8))
    return np.stack(channels, axis=-1)
