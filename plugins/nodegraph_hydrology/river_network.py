"""River networks grown from drawn lines."""

from __future__ import annotations

from math import radians
from typing import Annotated

import numpy as np
import numpy.typing as npt

from nodegraph import Context, Param, node
from nodegraph_hydrology.crossings import Domain, Segments, crossings
from nodegraph_hydrology.drawn_stem import Stems, curved, shortened
from nodegraph_hydrology.lsystem import Growth as GrowthRule
from nodegraph_hydrology.lsystem import length_ratio, network_rules
from nodegraph_hydrology.lsystem_rules import Rule, parse_rules
from nodegraph_hydrology.network import RiverNetwork
from nodegraph_hydrology.river_growth import Growth, Style, grow
from nodegraph_terrain.polylines import Polylines

Floats = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

MOST = 1_000_000
"""Most links that are asked for."""


@node(version=1)
def river_network(
    lines: Polylines,
    outline: Polylines | None = None,
    *,
    generator: Annotated[int, Param("Interior links that replace an exterior one (phi).", ge=2, le=12)] = 2,
    growth: Annotated[GrowthRule, Param("R = P phi - 1, which fills the plane, or R = P (phi - 1) as printed.")] = (
        "plane_filling"
    ),
    max_depth: Annotated[int, Param("Steps of a line as long as the terrain is wide.", ge=1, le=16)] = 6,
    depth: Annotated[int | None, Param("Steps of every line; none: by its length.", ge=1, le=16)] = None,
    width: Annotated[float | None, Param("Of the terrain; none: of the outline or lines.", gt=0, unit="m")] = None,
    angle: Annotated[
        float, Param("Turn of a fork's branches; tributaries turn twice.", gt=0, le=60, unit="deg")
    ] = 30.0,
    jitter: Annotated[float, Param("Standard deviation of the turns.", ge=0, le=45, unit="deg")] = 8.0,
    sinuosity: Annotated[
        float, Param("Greatest displacement of a midpoint, over the length that it divides.", ge=0, le=0.3)
    ] = 0.15,
    bends: Annotated[int, Param("Midpoint displacements within each of the last links.", ge=0, le=5)] = 1,
    rules: Annotated[
        tuple[str, ...], Param("Productions of F and G instead of the generator's; river_rules lists those.")
    ] = (),
    seed: Annotated[int, Param("Another number grows other rivers.", ge=0)] = 0,  # noqa: ARG001
    context: Context,
) -> RiverNetwork:
    """Grow a river network from each line: the line is its main stem, and its first point the estuary.

    An L-system (`river_rules` lists it) replaces every exterior link by phi interior and phi + 1 exterior ones and
    every interior link by R + 1 interior and R exterior ones, with R = P phi - 1, P = (1 + sqrt(1 + 4 phi)) / (2 phi).
    Links get shorter by 1 / (P phi) per step, and their number grows by phi + R + 1.  Tokunaga's ratios of such
    networks are T_1 = phi - 1 and T_k = phi R (R + 1)^(k - 2), and R_B tends to phi + R + 1.  A greater phi is more
    feather-like.

    The steps of a line are its length over the width of the terrain times `max_depth`, rounded, from 1 to `max_depth`
    (eq. 3).  Stems bend by midpoint displacement, drawn lines run smoothly through their points.

    **No two rivers ever meet.**  Drawn lines come first and keep their place; one that meets an earlier one or the
    outline is cut short before it, with a warning.  In each step the stems of the step before come next: a bend or
    stretch that meets another river is taken back.  New branches follow, those on older stems first: each keeps a
    distance of half its length at its tip from all that is there; it bends for that, up to 30 degrees (40 at last) and
    to either side, then is shortened to 3/4 and 1/2, then left out.  Ratios after that are for
    `network_statistics` to say.  Takes O(n log n) time for n links.

    Args:
        lines: main stems, drawn from the estuary upwards, in metres.
        outline: closed lines that no river leaves; without it rivers run where they like.
        generator: phi.
        growth: how R follows from phi.
        max_depth: of eq. 3.
        depth: overrides eq. 3.
        width: of eq. 3; without it the longer side of the outline's box, or of the lines'.
        angle: theta.
        jitter: of the turns.
        sinuosity: 0 is straight.
        bends: each doubles the number of nodes.
        rules: productions of one's own: a stem of F and G with branches such as ``[--G]``.
        seed: of everything random.
        context: the engine's.

    Raises:
        ValueError: no line, lines in degrees, an outline that is open or crosses itself, a line that begins outside of
            it or on another one, rules that are no river's, or over a million links.

    Source: Zhang et al. 2016, section IV, doi:10.1109/ACCESS.2016.2612700; corrected where said above.
    """
    if not len(lines):
        raise ValueError("there is no line to grow rivers from; draw one from the estuary upwards")
    if lines.unit != "m":
        raise ValueError("the lines are in degrees; load them with a target_crs in metres")
    domain = Domain(None if outline is None else _rings(outline, lines.crs))
    drawn = shortened([line[:, :2].copy() for line in lines.lines()], domain, context.log.warning)
    depths = _depths(drawn, outline if outline is not None else lines, width, max_depth, depth)
    productions = river_productions(rules or network_rules(generator, growth))
    style = _style(productions, generator, angle, jitter, sinuosity)
    _check_size(productions, depths)
    length = np.array([np.hypot(*np.diff(line, axis=0).T).sum() for line in drawn])
    finest = length * style.ratio**depths / 2**bends
    stems = curved(drawn, finest, sinuosity, domain, context.rng)
    state = grow(stems, depths, productions, style, domain, context.rng, context.progress)
    return _network(state, stems, bends, sinuosity, domain, context.rng, lines.crs)


def river_productions(lines: tuple[str, ...] | list[str]) -> tuple[Rule, ...]:
    """Return productions that can be laid out as rivers.

    Raises:
        ValueError: one is no stem of F and G with branches of one link each.
    """
    rules = parse_rules(lines)
    for rule in rules:
        text = "".join(map(chr, rule.codes))
        plain = chr(rule.symbol) in "FG" and not rule.names and not rule.values
        depth = 0
        branch = ""
        for symbol in text:
            if symbol == "[":
                plain &= depth == 0 and text[0] in "FG"
                depth, branch = 1, ""
            elif symbol == "]":
                plain &= depth == 1 and branch.lstrip("+-") in ("F", "G") and branch[0] in "+-"
                depth = 0
            elif depth:
                branch += symbol
            else:
                plain &= symbol in "FG"
        if not plain or not text:
            raise ValueError(
                f"rule '{rule.text}' is no river's; write F or G, '->', then a stem of F and G "
                "with branches of one link, such as F[--G]F[-G][+G]"
            )
    return rules


def _style(rules: tuple[Rule, ...], generator: int, angle: float, jitter: float, sinuosity: float) -> Style:
    ratio = length_ratio(generator)
    outer = [rule for rule in rules if chr(rule.symbol) == "G"]
    weight = sum(rule.weight for rule in outer)
    pieces = sum(rule.weight * _stem_pieces(rule) for rule in outer) / weight if outer else 1 / ratio
    return Style(ratio, max(pieces * ratio, 1.0), radians(angle), radians(jitter), sinuosity)


def _stem_pieces(rule: Rule) -> int:
    text = "".join(map(chr, rule.codes))
    return sum(part.split("]")[-1].count("F") + part.split("]")[-1].count("G") for part in text.split("["))


def _depths(lines: list[Floats], area: Polylines, width: float | None, max_depth: int, depth: int | None) -> Index:
    if depth is not None:
        return np.full(len(lines), depth, np.int64)
    if width is None:
        assert area.bounds is not None
        west, south, east, north = area.bounds
        width = max(east - west, north - south)
    length = np.array([np.hypot(*np.diff(line, axis=0).T).sum() for line in lines])
    return np.clip(np.rint(length / width * max_depth), 1, max_depth).astype(np.int64)


def _check_size(rules: tuple[Rule, ...], depths: Index) -> None:
    """Refuse what would grow beyond `MOST` links: the expected numbers of F and G follow a matrix."""
    matrix = np.eye(2)
    for row, symbol in enumerate("FG"):
        own = [rule for rule in rules if chr(rule.symbol) == symbol]
        if own:
            counts = [[(rule.codes == ord(other)).sum() * rule.weight for other in "FG"] for rule in own]
            matrix[row] = np.sum(counts, axis=0) / sum(rule.weight for rule in own)
    total = sum(float((np.array([0.0, 1.0]) @ np.linalg.matrix_power(matrix, int(depth))).sum()) for depth in depths)
    if total > MOST:
        raise ValueError(f"{total:.3g} links would grow, over {MOST}; take a smaller max_depth, depth or generator")


def _rings(outline: Polylines, crs: str) -> list[Floats]:
    if outline.unit != "m":
        raise ValueError("the outline is in degrees; load it with a target_crs in metres")
    if outline.crs and crs and outline.crs != crs:
        raise ValueError("the lines and their outline have different coordinate systems; load both with one target_crs")
    if not len(outline) or not outline.closed.all():
        raise ValueError("the outline must be closed lines, each with its first point again as its last")
    return [ring[:, :2] for ring in outline.lines()]


def _network(
    state: Growth, stems: Stems, bends: int, sinuosity: float, domain: Domain, rng: np.random.Generator, crs: str
) -> RiverNetwork:
    """Return the links as nodes: those of the drawn curves, and those of all other links with their bends."""
    leads = np.flatnonzero(np.isfinite(state.along))
    others = np.flatnonzero(~np.isfinite(state.along))
    position, down, leader = _stem_nodes(stems, state.line[leads], state.along[leads], state.tip[leads])
    node_of = np.full(len(state.code) + 1, -1, np.int64)
    node_of[leads] = leader
    count, pieces = len(position), 2**bends
    node_of[others] = count + np.arange(len(others)) * pieces + pieces - 1
    points = _bent(state, stems, others, bends, sinuosity, domain, rng)
    below = count + np.arange(len(others) * pieces).reshape(-1, pieces) - 1
    if len(others):
        below[:, 0] = node_of[state.parent[others]]
    nodes = np.concatenate([position, points[:, 1:].reshape(-1, 2)])
    downstream = np.concatenate([down, below.reshape(-1)]).astype(np.int32)
    return RiverNetwork(nodes, downstream, np.full(len(nodes), np.nan), crs)


def _stem_nodes(stems: Stems, line: Index, along: Floats, tip: Floats) -> tuple[Floats, Index, Index]:
    """Return the nodes of the curves with those of the links inserted, where each flows, and the links' nodes."""
    span = stems.lengths
    owner = np.concatenate([stems.owner, line])
    place = np.concatenate([stems.along, np.minimum(along, span[line])])
    order = np.lexsort((place, owner))
    # A link's node within a hair of a curve's is that node.
    near = np.diff(place[order]) <= 1e-9 * span[owner[order][1:]]
    fresh = np.concatenate([[True], ~(near & (np.diff(owner[order]) == 0))])
    number = np.empty(len(order), np.int64)
    number[order] = np.cumsum(fresh) - 1
    chosen = order[fresh]
    position = np.concatenate([stems.points, tip])[chosen]
    down = np.arange(len(chosen)) - 1
    down[np.concatenate([[True], np.diff(owner[chosen]) != 0])] = -1
    return position, down, number[len(stems.points) :]


def _bent(
    state: Growth, stems: Stems, links: Index, bends: int, sinuosity: float, domain: Domain, rng: np.random.Generator
) -> Floats:
    """Return the points of links beside the drawn lines, (n, 2^bends + 1, 2); straight where a bend would meet."""
    points = np.stack([state.base(stems)[links], state.tip[links]], axis=1)
    fixed = stems.segments()
    for _ in range(bends):
        legs = np.diff(points, axis=1)
        straight = (points[:, :-1] + points[:, 1:]) / 2
        normal = np.stack([-legs[..., 1], legs[..., 0]], axis=-1)
        swing = sinuosity * rng.uniform(-1, 1, legs.shape[:2])
        while True:
            middle = straight + swing[..., None] * normal
            whole = np.empty((len(points), 2 * points.shape[1] - 1, 2))
            whole[:, ::2], whole[:, 1::2] = points, middle
            segments = Segments(whole[:, :-1].reshape(-1, 2), whole[:, 1:].reshape(-1, 2))
            wrong = ~domain.holds(segments)
            hit = crossings(fixed.joined(segments), len(fixed)).ravel() - len(fixed)
            wrong[hit[hit >= 0]] = True
            bad = wrong.reshape(len(points), -1).any(axis=1) & (swing != 0).any(axis=1)
            if not bad.any():
                break
            swing[bad] = 0
        points = whole
    return points
