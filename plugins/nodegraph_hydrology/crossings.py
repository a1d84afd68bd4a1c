"""Where segments of rivers meet that must not, and the search for free room: no two links ever cross.

Segments run upstream, from a base to a tip.  They may only meet where one begins, so each is tested from a millionth of
its length above its base: then any contact at all is a conflict, and neighbours need no special care.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

GAP = 1e-6
"""Share of a segment that is left out at its base."""

TIP_ROOM, MIDDLE_ROOM = 0.5, 0.28
"""Least distance of a new branch's tip and middle to other rivers, over its length."""

PAIR_ROOM = 0.4
"""Least distance between the tips and middles of two new branches, over the length of the longer."""

OUTLOOK = 1.7
"""Where a branch that will go on to branch looks for open land, over its length from the base."""

ATTEMPTS: tuple[tuple[tuple[int, ...], float], ...] = (
    ((0, -15, 15, -30, 30), 1.0),
    ((0, -15, 15, -30, 30), 0.75),
    ((0, -20, 20, -40, 40), 0.5),
)
"""What is tried in turn for a branch: by how many degrees it may bend (to either side), and its share of the length."""

MOST_SAMPLES = 1_000_000
"""Most points, about, at which the room beside rivers is judged."""

WANTED = ((0,), 1.0)
"""What the branches of the last step, most of all, try before: the wanted direction."""


@dataclass(frozen=True)
class Segments:
    """Segments from base to tip, (n, 2) each."""

    base: Floats
    tip: Floats

    def __len__(self) -> int:
        return len(self.base)

    def joined(self, other: Segments) -> Segments:
        """Return these segments and then those of another."""
        return Segments(np.concatenate([self.base, other.base]), np.concatenate([self.tip, other.tip]))

    def take(self, which: npt.NDArray[Any]) -> Segments:
        """Return the segments with these numbers, or those where a mask is true."""
        return Segments(self.base[which], self.tip[which])

    def samples(self, spacing: float) -> Floats:
        """Return points on the segments, tips and middles among them, at most `spacing` apart (bases left out)."""
        counts = 2 * np.maximum(np.ceil(np.hypot(*(self.tip - self.base).T) / (2 * spacing)), 1).astype(np.int64)
        owner = np.repeat(np.arange(len(self)), counts)
        place = (np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner] + 1) / counts[owner]
        return np.asarray(self.base[owner] + place[:, None] * (self.tip - self.base)[owner])


def crossings(segments: Segments, first: int = 0) -> Index:
    """Return the pairs (k, 2) of segments that touch, at least one of each pair numbered `first` or higher.

    Pairs whose boxes overlap come from a packed R-tree, and are then decided by signed areas; what is too close to
    tell (1e-12 of the product of the lengths) counts as touching.
    """
    import shapely

    if len(segments) - first < 1:
        return np.zeros((0, 2), np.int64)
    start = segments.base + GAP * (segments.tip - segments.base)
    lines = shapely.linestrings(np.stack([start, segments.tip], axis=1))
    one, two = shapely.STRtree(lines).query(lines[first:])
    one = one + first
    once = (one > two) | (two < first)
    once &= one != two
    one, two = one[once], two[once]
    a, b, c, d = start[one], segments.tip[one], start[two], segments.tip[two]
    slack = 1e-12 * np.maximum(np.hypot(*(b - a).T) * np.hypot(*(d - c).T), np.finfo(float).tiny)
    sides = [_area(a, b, c), _area(a, b, d), _area(c, d, a), _area(c, d, b)]
    sides = [np.where(np.abs(side) <= slack, 0.0, np.sign(side)) for side in sides]
    touch = (sides[0] * sides[1] <= 0) & (sides[2] * sides[3] <= 0)
    return np.stack([one[touch], two[touch]], axis=1)


def _area(a: Floats, b: Floats, c: Floats) -> Floats:
    """Return twice the signed area of triangles."""
    return np.asarray((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))


class Domain:
    """Where rivers may run: everywhere, or inside of closed lines (a line within a line is a hole)."""

    def __init__(self, rings: list[Floats] | None) -> None:
        import shapely

        self.shape: Any = None
        if rings is not None:
            shape = shapely.Polygon()
            for ring in rings:
                polygon = shapely.Polygon(ring)
                if not polygon.is_valid or polygon.area == 0:
                    raise ValueError(
                        f"the outline is no plain area near {ring[0].tolist()} ({shapely.is_valid_reason(polygon)}); "
                        "draw it without crossing itself"
                    )
                shape = shape.symmetric_difference(polygon)
            shapely.prepare(shape)
            self.shape = shape

    def border(self) -> Segments:
        """Return the segments of the outline."""
        import shapely

        if self.shape is None:
            return Segments(np.zeros((0, 2)), np.zeros((0, 2)))
        rings = [shapely.get_coordinates(ring) for ring in shapely.get_parts(self.shape.boundary)]
        return Segments(np.concatenate([ring[:-1] for ring in rings]), np.concatenate([ring[1:] for ring in rings]))

    def holds(self, segments: Segments) -> Flags:
        """Return which segments lie inside, or on the border."""
        import shapely

        if self.shape is None or not len(segments):
            return np.ones(len(segments), np.bool_)
        inside = np.asarray(shapely.intersects_xy(self.shape, *segments.tip.T), np.bool_)
        lines = shapely.linestrings(np.stack([segments.base, segments.tip], axis=1)[inside])
        inside[inside] = shapely.covers(self.shape, lines)
        return inside


def place_branches(
    base: Floats,
    stem: Floats,
    turn: Floats,
    length: Floats,
    rank: Index,
    present: Segments,
    domain: Domain,
    *,
    last: bool,
) -> tuple[Floats, Flags]:
    """Find room for new branches; return their tips and which of them found any.

    A branch wants to leave its stem by its turn with its length.  Where that comes too close to other rivers it bends
    (to the most open of several directions, on either side), then is shortened, then left out.  Those of lower rank
    number choose first; where two branches of one round are in each other's way, the second tries again.

    Args:
        base: (n, 2) where they leave.
        stem: (n,) upstream direction of the stem there, radians.
        turn: (n,) wanted turn from it, radians, counter-clockwise.
        length: (n,) m.
        rank: (n,) order in which they choose.
        present: all other rivers.
        domain: where rivers may run.
        last: nothing will grow from these; otherwise they turn to open land, away from rivers and the border.
    """
    from scipy.spatial import cKDTree

    count = len(base)
    tip = np.full((count, 2), np.nan)
    placed = np.zeros(count, np.bool_)
    if not count:
        return tip, placed
    near = present.joined(domain.border())
    # Beside tiny networks large ones are sampled less densely; what crosses is found all the same.
    extent = float(np.hypot(*(near.tip - near.base).T).sum())
    spacing = max(0.4 * float(length.min()), extent / MOST_SAMPLES)
    trees = [cKDTree(near.samples(spacing), balanced_tree=False, compact_nodes=False)]
    for bends, share in (WANTED, *ATTEMPTS) if last else ATTEMPTS:
        open_ = np.flatnonzero(~placed)
        if not len(open_):
            break
        wanted = share * length[open_]
        end, fits = _best_direction(
            base[open_], stem[open_], turn[open_], wanted, bends, trees, 0.0 if last else OUTLOOK
        )
        chosen = open_[fits]
        segments = Segments(base[chosen], end[fits])
        keep = domain.holds(segments) & _first_come(segments, rank[chosen])
        chosen, segments = chosen[keep], segments.take(keep)
        # Room is judged at points; whether anything crosses, exactly.
        clear = np.ones(len(chosen), np.bool_)
        hit = crossings(present.joined(segments), len(present)).ravel() - len(present)
        clear[hit[hit >= 0]] = False
        chosen, segments = chosen[clear], segments.take(clear)
        tip[chosen], placed[chosen] = segments.tip, True
        present = present.joined(segments)
        if len(chosen):
            trees.append(cKDTree(segments.samples(spacing), balanced_tree=False, compact_nodes=False))
    return tip, placed


def _best_direction(
    base: Floats, stem: Floats, turn: Floats, length: Floats, bends: tuple[int, ...], trees: list[Any], outlook: float
) -> tuple[Floats, Flags]:
    """Return for each branch the tip in its most open direction, and whether that has room."""
    offsets = np.radians(bends)
    turns = turn[:, None] + offsets
    cost = np.broadcast_to(0.25 * np.abs(offsets), turns.shape)
    if len(bends) > 1:
        turns = np.concatenate([turns, -turns], axis=1)
        cost = np.concatenate([cost, cost + 0.25], axis=1)
    heading = stem[:, None] + turns
    leg = length[:, None, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    ends, middles = base[:, None] + leg, base[:, None] + 0.5 * leg
    far = 1.2 * float(length.max())
    room, half = (_distance(points, trees, far) / length[:, None] for points in (ends, middles))
    score = np.minimum(np.minimum(room / 0.9, half / 0.45), 1.0) - cost
    if outlook:
        score += 0.7 * np.minimum(_distance(base[:, None] + outlook * leg, trees, far) / length[:, None], 1.2)
    score[(room < TIP_ROOM) | (half < MIDDLE_ROOM)] = -np.inf
    best = np.argmax(score, axis=1)
    rows = np.arange(len(base))
    return ends[rows, best], np.isfinite(score[rows, best])


def _distance(points: Floats, trees: list[Any], far: float) -> Floats:
    flat = points.reshape(-1, 2)
    found = [tree.query(flat, distance_upper_bound=far)[0] for tree in trees]
    return np.asarray(np.minimum.reduce(found)).reshape(points.shape[:-1])


def _first_come(segments: Segments, rank: Index) -> Flags:
    """Return which new segments keep their distance from all those that choose before them."""
    from scipy.spatial import cKDTree

    if len(segments) < 2:
        return np.ones(len(segments), np.bool_)
    length = np.hypot(*(segments.tip - segments.base).T)
    points = np.concatenate([segments.tip, (segments.base + segments.tip) / 2])
    pairs = cKDTree(points).query_pairs(PAIR_ROOM * float(length.max()), output_type="ndarray")
    one, two = (pairs % len(segments)).T
    apart = np.hypot(*(points[pairs[:, 0]] - points[pairs[:, 1]]).T)
    close = (one != two) & (apart < PAIR_ROOM * np.maximum(length[one], length[two]))
    one, two = one[close], two[close]
    later = np.where(rank[one] > rank[two], one, two)
    keep = np.ones(len(segments), np.bool_)
    keep[later] = False
    return keep
