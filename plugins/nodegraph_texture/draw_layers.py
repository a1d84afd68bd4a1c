"""The hierarchy of layers and their constraints as a picture."""

from __future__ import annotations

from math import isfinite
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node
from nodegraph_terrain.raster import Extent, Image
from nodegraph_texture.constraints import Constraint, Hat, Sampled
from nodegraph_texture.layers import SurfaceLayers
from nodegraph_texture.quantities import FROM_ELEVATION, QUANTITIES, Other, role_name

UNITS = {"altitude": "m", "slope": "deg"} | {role_name(cls): cls.unit for cls in QUANTITIES if cls is not Other}

ROW, HEAD, FOOT, RIM = 64, 58, 40, 18
"""Heights of a layer, of what stands above and below all, and the rim, px of a picture 1000 wide."""

TREE = 350
"""Width of the hierarchy, px likewise."""

INK, SOFT, FAINT = "#222222", "#777777", "#e6e6e6"

LARGEST = 16_384
"""Most pixels along a side."""


@node(version=1)
def draw_layers(
    layers: SurfaceLayers,
    *,
    width: Annotated[int, Param("Of the picture; its height goes by the number of layers.", ge=400, le=8192)] = 1200,
    title: Annotated[str, Param("Written above.")] = "",
    context: Context,
) -> Image:
    """Draw the hierarchy of layers with their functions: what lies on what, in which order, and where it appears.

    Each line is a layer, numbered in the order of application and indented under its parent, with its colour and how
    noise changes its coverage, heights and brightness.  Beside it stand its constraints, a column for each quantity:
    filled, F from 0 to 1; the grey line is what its parents leave of it.

    Args:
        layers: the root.
        width: pixels.
        title: above.
        context: the engine's.

    Returns:
        An opaque picture.

    Raises:
        ValueError: there are more layers than a picture can show.
    """
    table = list(layers.walk())
    scale = width / 1000
    high = HEAD + ROW * len(table) + FOOT + (26 if title else 0)
    if high * scale > LARGEST:
        raise ValueError(
            f"{len(table)} layers need a picture {high * scale:,.0f} pixels high, over {LARGEST:,}; narrow it"
        )
    context.progress(0.0)
    pixels = _painted(table, title, high, scale)
    context.progress(1.0)
    rows, cols = pixels.shape[:2]
    return Image(pixels, Extent(0.0, 0.0, float(cols), float(rows)))


def _painted(table: list[tuple[SurfaceLayers, int, int]], title: str, high: int, scale: float) -> npt.NDArray[np.uint8]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1000 / 72, high / 72), dpi=72 * scale, facecolor="white")
    canvas: Any = FigureCanvasAgg(figure)
    top = HEAD + (26 if title else 0)
    if title:
        figure.text(RIM / 1000, 1 - 30 / high, _plain(title), fontsize=18, color=INK, va="center", weight="bold")
    _draw_tree(figure, table, top, high)
    quantities = _quantities(table)
    gap = 26
    room = (1000 - TREE - RIM) / max(1, len(quantities))
    for place, quantity in enumerate(quantities):
        left = TREE + place * room
        wide = min(room - gap, 300)
        ends = _range(quantity, table)
        unit = UNITS.get(quantity, "")
        name = quantity.replace("_", " ") + (f", {unit}" if unit not in ("", "1") else "")
        figure.text(
            (left + wide / 2) / 1000, 1 - (top - 14) / high, _plain(name), fontsize=12.5, color=INK, ha="center"
        )
        for number in range(len(table)):
            below = high - top - (number + 1) * ROW
            box = (left / 1000, (below + 10) / high, wide / 1000, (ROW - 20) / high)
            _draw_function(figure, box, quantity, table, number, ends, last=number == len(table) - 1)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_tree(figure: Any, table: list[tuple[SurfaceLayers, int, int]], top: int, high: int) -> None:
    """Draw the hierarchy, with lines from each layer to its parent."""
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, 1000)
    axes.set_ylim(0, high)
    axes.set_axis_off()
    deepest = max(level for _, _, level in table)
    step = min(24.0, 120 / max(1, deepest))

    def middle(number: int) -> tuple[float, float]:
        return RIM + 36 + step * table[number][2], high - top - (number + 0.5) * ROW

    for number, (layer, parent, _) in enumerate(table):
        x, y = middle(number)
        if number:
            axes.plot([RIM, 1000 - RIM], [y + ROW / 2] * 2, color=FAINT, lw=1)
        if parent >= 0:
            above = middle(parent)
            axes.plot([above[0], above[0], x], [above[1] - 13, y, y], color=SOFT, lw=1.2, zorder=0.5)
        axes.text(RIM + 4, y, f"{number + 1}", fontsize=12, color=SOFT, va="center", ha="center")
        axes.add_patch(_swatch(x - 12, y - 13, layer.colour))
        axes.text(x + 22, y + 8, _plain(_cut(layer.name, (TREE - x - 40) / 8.2)), fontsize=14, color=INK, va="center")
        axes.text(
            x + 22, y - 10, _plain(_cut(_manner(layer), (TREE - x - 40) / 5.2)), fontsize=9.5, color=SOFT, va="center"
        )


def _draw_function(
    figure: Any,
    box: tuple[float, float, float, float],
    quantity: str,
    table: list[tuple[SurfaceLayers, int, int]],
    number: int,
    ends: tuple[float, float],
    last: bool,
) -> None:
    layer, parent, _ = table[number]
    axes = figure.add_axes(box)
    axes.patch.set_alpha(0)
    x = _places(quantity, table, ends)
    own = _at(layer, quantity, x)
    bound = np.ones(len(x))
    while parent >= 0:
        bound = bound * (1.0 if (found := _at(table[parent][0], quantity, x)) is None else found)
        parent = table[parent][1]
    if own is not None:
        axes.fill_between(x, own, color=layer.colour, lw=0)
        axes.plot(x, own, color=INK, lw=1.1)
    if (bound < 1).any():
        axes.plot(x, bound, color="#9a9a9a", lw=1.1, ls=(0, (4, 2)))
    axes.set_xlim(*ends)
    axes.set_ylim(-0.03, 1.06)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set_color("#bbbbbb")
    axes.set_yticks([])
    axes.tick_params(axis="x", labelsize=10.5, colors=SOFT, length=3)
    axes.locator_params(axis="x", nbins=4)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.6g}".replace("-", "−"))
    if not last:
        axes.tick_params(axis="x", labelbottom=False)


def _quantities(table: list[tuple[SurfaceLayers, int, int]]) -> list[str]:
    """Return what is constrained: altitude and slope first, then in the order of the layers."""
    used = dict.fromkeys(item.quantity for layer, _, _ in table for item in layer.constraints)
    return [name for name in FROM_ELEVATION if name in used] + [name for name in used if name not in FROM_ELEVATION]


def _functions(quantity: str, table: list[tuple[SurfaceLayers, int, int]]) -> list[Constraint]:
    return [item for layer, _, _ in table for item in layer.constraints if item.quantity == quantity]


def _range(quantity: str, table: list[tuple[SurfaceLayers, int, int]]) -> tuple[float, float]:
    """Return the values that a column spans."""
    ends: list[float] = []
    for item in _functions(quantity, table):
        if isinstance(item, Hat):
            ends += [end for end in (*item.rise, *item.fall) if isfinite(end)]
        elif isinstance(item, Sampled):
            ends += [item.low, item.high]
    if not ends:
        return 0.0, 1.0
    low, high = min(ends), max(ends)
    rim = 0.15 * (high - low) or max(1.0, abs(high) * 0.1)
    return (0.0 if quantity == "slope" and low >= 0 else low - rim), high + rim


def _places(
    quantity: str, table: list[tuple[SurfaceLayers, int, int]], ends: tuple[float, float]
) -> npt.NDArray[np.float64]:
    """Return where functions are drawn: everywhere, and on both sides of each step."""
    corners = [
        np.nextafter(end, towards)
        for item in _functions(quantity, table)
        if isinstance(item, Hat)
        for end in (*item.rise, *item.fall)
        if isfinite(end)
        for towards in (-np.inf, end, np.inf)
    ]
    return np.unique(np.clip([*np.linspace(*ends, 512), *corners], *ends))


def _at(layer: SurfaceLayers, quantity: str, x: npt.NDArray[np.float64]) -> npt.NDArray[Any] | None:
    """Return the product of a layer's own functions of a quantity, or None where it has none."""
    own = [item for item in layer.constraints if item.quantity == quantity]
    found: npt.NDArray[Any] | None = None
    for item in own:
        found = item.at(x) if found is None else found * item.at(x)
    return found


def _manner(layer: SurfaceLayers) -> str:
    """Say in a few words what noise does."""
    parts = []
    if layer.scale:
        parts.append(
            f"{layer.bias:g} {'+' if layer.scale > 0 else '−'} {abs(layer.scale):g} {layer.noise.kind} "
            f"{layer.noise.wavelength:g} m"
        )
    elif layer.bias != 1:
        parts.append(f"bias {layer.bias:g}")
    if layer.roughness:
        parts.append(f"relief {layer.roughness:g} m")
    if layer.variation:
        parts.append(f"tint {layer.variation:.0%}")
    return ", ".join(parts) or "even"


def _swatch(x: float, y: float, colour: tuple[float, float, float]) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((x, y), 26, 26, facecolor=colour, edgecolor="#555555", linewidth=0.8, zorder=2)


def _cut(words: str, room: float) -> str:
    """Return a text of at most so many letters."""
    return words if len(words) <= room else words[: max(1, int(room) - 1)].rstrip(" ,") + "…"


def _plain(words: str) -> str:
    """Return a text in which matplotlib finds no formulas."""
    return words.replace("$", r"\$")
