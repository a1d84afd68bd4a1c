"""L-systems with turtle interpretation, and the river networks of the paper as such a system."""

from __future__ import annotations

from math import floor, radians, sqrt
from typing import Annotated, Literal, NamedTuple

import numpy as np

from nodegraph import Context, Param, node
from nodegraph_hydrology.lsystem_rules import LString, parse_rules, parse_string, rewrite
from nodegraph_hydrology.turtle import predecessors, structure, walk
from nodegraph_terrain.polylines import Polylines, Property

Growth = Literal["plane_filling", "printed"]


class Grown(NamedTuple):
    """What an L-system gives: its lines, and the string that the turtle read."""

    lines: Polylines
    string: str


@node(version=1, title="L-system")
def lsystem(
    *,
    axiom: Annotated[str, Param("String to start from.", min_length=1)] = "G",
    rules: Annotated[
        tuple[str, ...], Param("Productions, such as 'F -> F[+G]F' or 'A(s) : s > 1 -> F(s)[+A(s/2)] @ 0.3'.")
    ] = ("G -> F[--G]F[-G][+G]", "F -> F[++G]F", "F -> F[--G]F"),
    iterations: Annotated[int, Param("How often every module is rewritten.", ge=0, le=64)] = 4,
    angle: Annotated[float, Param("Turn of '+' (clockwise) and '-' without a number.", unit="deg")] = 30.0,
    step: Annotated[float, Param("Length of a drawn symbol without a number, before scaling.", gt=0, unit="m")] = 1000,
    scale: Annotated[float, Param("Factor on the step per iteration.", gt=0, le=10)] = 0.5,
    start: Annotated[tuple[float, float], Param("Where the turtle starts (x, y).", unit="m")] = (0.0, 0.0),
    heading: Annotated[float, Param("Where it looks, counter-clockwise from east.", unit="deg")] = 90.0,
    drawn: Annotated[str, Param("Symbols that draw a line.", min_length=1)] = "FG",
    crs: Annotated[str, Param("Coordinate system of the lines, empty if none.")] = "",
    seed: Annotated[int, Param("Another number draws other productions.", ge=0)] = 0,  # noqa: ARG001
    context: Context,
) -> Grown:
    """Grow a string by productions and draw it with a turtle.

    A production reads ``predecessor : condition -> successor @ weight``: ``A(s) : s > 0.1 -> F(s)[+(25)A(s*0.7)] @ 2``.
    A symbol is one character with up to four parameters; of the productions that fit it one is drawn by weight, and
    what none fits stays.  Conditions and parameters are arithmetic, never code.

    The turtle reads: symbols of `drawn` (draw forward), ``f`` (move forward), ``+`` and ``-`` (turn clockwise, counter-
    clockwise), ``|`` (turn around), ``[`` and ``]`` (remember the state, return to it); all others mean nothing to it.
    The first parameter is a length in m or an angle in degrees; without one the step is step * scale^iterations.

    Each line runs to the end of its bracket and carries its bracket depth as ``depth``; a branch begins where it leaves
    its stem.  Takes time and memory in proportion to the length of the string.

    Args:
        axiom: string to start from.
        rules: productions.
        iterations: rewritings.
        angle: of a turn.
        step: of the turtle.
        scale: per iteration.
        start: of the turtle.
        heading: of the turtle at its start.
        drawn: symbols that draw.
        crs: of the lines.
        seed: of the choice among productions.
        context: the engine's.

    Raises:
        ValueError: a rule or axiom that cannot be read (the sentence says why), over five million modules, or a string
            that leaves the range of numbers.

    Source: Zhang et al. 2016, section IV.B, doi:10.1109/ACCESS.2016.2612700; Prusinkiewicz and Lindenmayer 1990,
    doi:10.1007/978-1-4613-8476-2.
    """
    productions = parse_rules(rules)
    string, _ = parse_string(axiom)
    for number in range(iterations):
        context.progress(number / (iterations + 1))
        string, _ = rewrite(string, productions, context.rng)
    length = step * scale**iterations
    return Grown(drawn_lines(string, drawn, length, angle, start, heading, crs), str(string))


def drawn_lines(
    string: LString, symbols: str, step: float, angle: float, start: tuple[float, float], heading: float, crs: str
) -> Polylines:
    """Return what the turtle draws: one line per run of drawn symbols in a bracket; angles in degrees."""
    drawn = np.isin(string.codes, [ord(symbol) for symbol in symbols])
    nested = structure(string)
    with np.errstate(over="ignore", invalid="ignore"):
        track = walk(
            string, nested, drawn=drawn, start=start, heading=radians(heading), angle=radians(angle), step=step
        )
    places = np.flatnonzero(drawn)
    if not np.isfinite(track.position[places]).all():
        raise ValueError("the turtle leaves the range of numbers; the steps grow too long for so many iterations")
    before = predecessors(string, nested, drawn)[places]
    first = np.empty((len(places), 2))
    lengths = np.where(np.isnan(string.values[places, 0]), step, string.values[places, 0])
    facing = track.heading[places]
    first = track.position[places] - lengths[:, None] * np.stack([np.cos(facing), np.sin(facing)], axis=-1)
    # A line goes on where the symbol before it is of the same bracket and ends where this one starts.
    span = np.abs(track.position[places]).max(initial=step)
    follows = (before >= 0) & (nested.opening[places] == nested.opening[before])
    follows &= np.abs(first - track.position[before]).max(axis=1, initial=0) <= 1e-9 * span
    order = np.lexsort((places, nested.opening[places]))
    starts = np.flatnonzero(~follows[order])
    counts = np.diff(np.append(starts, len(order)))
    ends = np.cumsum(counts + 1)
    points = np.empty((len(order) + len(starts), 2))
    heads = ends - counts - 1
    body = np.ones(len(points), np.bool_)
    body[heads] = False
    points[heads] = first[order[starts]]
    points[body] = track.position[places[order]]
    depth = Property("depth", nested.depth[places[order[starts]]])
    return Polylines(points, np.concatenate([[0], ends]).astype(np.int64), (depth,), crs)


@node(version=1)
def river_rules(
    *,
    generator: Annotated[int, Param("Interior links that replace an exterior one (phi).", ge=2, le=12)] = 2,
    growth: Annotated[Growth, Param("R = P phi - 1, which fills the plane, or R = P (phi - 1) as printed.")] = (
        "plane_filling"
    ),
) -> str:
    """List the productions of a river network as text, one a line: to be read, printed, and changed.

    F is an interior link, G an exterior one; ``-`` and ``+`` turn by theta to either side.  An exterior link becomes
    phi interior links with a tributary between each two and a fork of two at its end; an interior link becomes R + 1
    with R tributaries.  Sides alternate along a stem and begin on either side by chance; where R is broken, it is
    rounded up or down by chance.  No node gets more than two arrivals.

    Args:
        generator: phi.
        growth: how R follows from phi.

    Source: Zhang et al. 2016, section IV, with R = P phi - 1 where the print has R = P (phi - 1),
    doi:10.1109/ACCESS.2016.2612700.
    """
    return "\n".join(network_rules(generator, growth))


def network_rules(generator: int, growth: Growth) -> list[str]:
    """Return the productions that `river_rules` lists."""
    rules = [f"G -> {_stem(generator, side)}{fork}" for side, fork in (("-", "[-G][+G]"), ("+", "[+G][-G]"))]
    wanted = tributaries(generator, growth)
    low = floor(wanted)
    for count, share in ((low, low + 1 - wanted), (low + 1, wanted - low)):
        if share > 1e-9:
            weight = f" @ {share / 2:.12g}" if share < 1 else ""
            rules += [f"F -> {_stem(count + 1, side)}{weight}" for side in ("-" if count else "", "+")[not count :]]
    return rules


def tributaries(generator: int, growth: Growth) -> float:
    """Return R, the mean number of tributaries that an interior link gets per step."""
    ratio = (1 + sqrt(1 + 4 * generator)) / (2 * generator)
    # Exact where the root is: no rule for a chance of 1e-17.
    return round(ratio * generator - 1 if growth == "plane_filling" else ratio * (generator - 1), 12)


def length_ratio(generator: int) -> float:
    """Return the length of a link over that of its predecessor, 1 / (P phi)."""
    return 2 / (1 + sqrt(1 + 4 * generator))


def _stem(links: int, side: str) -> str:
    sides = (side, "+" if side == "-" else "-")
    return "F" + "".join(f"[{sides[number % 2] * 2}G]F" for number in range(links - 1))
