"""The value on the wire: `SurfaceLayers`, a surface and those that lie on it.

Source: Dachsbacher, Bolch and Stamminger 2006: Procedural reproduction of terrain textures with geographic data,
Vision, Modeling and Visualization, section 4, https://inria.hal.science/inria-00606769.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from math import isfinite

from nodegraph import port_type
from nodegraph_terrain.noise import Kind, Noise
from nodegraph_texture.constraints import Constraint

Colour = tuple[float, float, float]
"""sRGB, red, green and blue, 0 to 1."""


@port_type
class Roughness:
    """A sum of noise: what varies coverage, displaces the ground or tints it.  See `nodegraph_terrain.noise`.

    Attributes:
        kind, wavelength (m), octaves, gain, seed: of the noise, whose values lie in [-1, 1].
    """

    kind: Kind = "fbm"
    wavelength: float = 200.0
    octaves: int = 8
    gain: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        Noise(self.kind, self.octaves, self.wavelength, gain=self.gain, seed=self.seed)  # says what is wrong
        object.__setattr__(self, "gain", self.gain + 0.0)


@port_type
class SurfaceLayers:
    """One surface layer and its children: the hierarchy as a value.

    With F_i its constraints, N its noise and C_P the coverage of its parent (1 for the root),

        C = clamp((bias + scale N) prod_i F_i) C_P,   colour' = (1 - C) colour + C own,   H' = H + C B_S D_S.

    Layers are applied depth first: a layer, then its children in order, each with all that belong to it.  Heights pass
    from each to the next, coverage from a parent to its children.

    Attributes:
        name: for people; unique among all.
        colour: of the surface.
        constraints: when it appears; all must hold.
        noise: N.
        scale, bias: s_S and b_S of N.
        relief: D_S, and `roughness`: B_S, m.
        variation: how far colours vary, as a factor of brightness, 0 to 1, and `tint`, the noise which does it.
        children: what lies on it, in order.
    """

    name: str
    colour: Colour
    constraints: tuple[Constraint, ...] = ()
    noise: Roughness = Roughness()
    scale: float = 0.0
    bias: float = 1.0
    relief: Roughness = Roughness()
    roughness: float = 0.0
    tint: Roughness = Roughness()
    variation: float = 0.0
    children: tuple[SurfaceLayers, ...] = ()

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise ValueError("a layer needs a name")
        numbers = {key: getattr(self, key) for key in ("scale", "bias", "roughness", "variation")}
        for key, number in numbers.items():
            if not isfinite(number):
                raise ValueError(f"{key} of layer '{self.name}' must be a finite number, not {number}")
            object.__setattr__(self, key, number + 0.0)  # -0 is 0: equal layers have equal bytes
        for key, shares in {"colour": self.colour, "variation": (self.variation,)}.items():
            if not all(0 <= share <= 1 for share in shares):
                raise ValueError(f"{key} of layer '{self.name}' must lie in 0 to 1")
        object.__setattr__(self, "colour", tuple(part + 0.0 for part in self.colour))
        twice = [name for name, count in Counter(item.name for item, _, _ in self.walk()).items() if count > 1]
        if twice:
            raise ValueError(f"two layers are called '{twice[0]}'; each needs a name of its own")

    def walk(self, parent: int = -1, level: int = 0) -> Iterator[tuple[SurfaceLayers, int, int]]:
        """Yield (layer, number of its parent or -1, level), depth first, which is the order of application."""
        stack: list[tuple[SurfaceLayers, int, int]] = [(self, parent, level)]
        number = 0
        while stack:
            layer, above, depth = stack.pop()
            yield layer, above, depth
            stack.extend((child, number, depth + 1) for child in reversed(layer.children))
            number += 1
