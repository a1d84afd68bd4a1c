"""Strokes in a picture as lines: thinning to one cell, and tracing from ends and junctions."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

Flags = npt.NDArray[np.bool_]
Cell = tuple[int, int]

AROUND = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))
"""The eight neighbours, clockwise from the one above."""


def skeleton(strokes: Flags, report: Callable[[], Any] = lambda: None) -> Flags:
    """Return the strokes thinned to their middle, by the two alternating passes of Zhang and Suen (1984)."""
    cells = np.pad(strokes, 1)
    changed = True
    while changed:
        changed = False
        report()
        for odd in (False, True):
            row, column = np.nonzero(cells)
            ring = np.stack([cells[row + dr, column + dc] for dr, dc in AROUND])
            north, east, south, west = ring[::2]
            count = ring.sum(axis=0)
            rises = (~ring & np.roll(ring, -1, axis=0)).sum(axis=0)
            gone = (count >= 2) & (count <= 6) & (rises == 1)
            if odd:
                gone &= ~(north & east & west) & ~(north & south & west)
            else:
                gone &= ~(north & east & south) & ~(east & south & west)
            cells[row[gone], column[gone]] = False
            changed |= bool(gone.any())
    return cells[1:-1, 1:-1]


def traced(thin: Flags, shortest: float) -> list[npt.NDArray[np.int64]]:
    """Return the lines of a skeleton as (k, 2) rows and columns, joined straight on through junctions.

    Side branches of less than `shortest` cells from an end to a junction are left out.
    """
    import networkx as nx

    # Cells touch by their sides, or by a corner where no side neighbour links them: no small triangles at junctions.
    cells = set(zip(*(part.tolist() for part in np.nonzero(thin)), strict=True))
    graph = nx.Graph()
    graph.add_nodes_from(cells)
    for row, column in cells:
        for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
            corner = dr and dc and ((row + dr, column) in cells or (row, column + dc) in cells)
            if (row + dr, column + dc) in cells and not corner:
                graph.add_edge((row, column), (row + dr, column + dc))
    while spurs := _spurs(graph, shortest):
        for path in spurs:
            graph.remove_nodes_from(path)
    return [np.array(path, np.int64) for path in _joined(_runs(graph)) if len(path) > 1]


def _spurs(graph: Any, shortest: float) -> list[list[Cell]]:
    """Return the shortest side branch of each junction, without the junction, if it is shorter than `shortest`."""
    found: dict[Cell, list[Cell]] = {}
    for path in sorted(_runs(graph), key=lambda path: (len(path), path)):
        outer, inner = (graph.degree(path[end]) for end in (0, -1))
        if min(outer, inner) == 1 and max(outer, inner) > 2 and len(path) - 1 < shortest:
            knot, branch = (path[-1], path[:-1]) if outer == 1 else (path[0], path[1:])
            found.setdefault(knot, branch)
    return list(found.values())


def _runs(graph: Any) -> list[list[Cell]]:
    """Return the paths between ends and junctions, and the closed ones."""
    knots = sorted(cell for cell in graph if graph.degree(cell) != 2)
    used: set[frozenset[Cell]] = set()
    runs = []
    for start in [*knots, *sorted(graph)]:
        for second in sorted(graph[start]):
            if frozenset((start, second)) in used:
                continue
            path = [start, second]
            used.add(frozenset(path))
            while graph.degree(path[-1]) == 2 and path[-1] != start:
                ahead = next(cell for cell in sorted(graph[path[-1]]) if cell != path[-2])
                used.add(frozenset((path[-1], ahead)))
                path.append(ahead)
            runs.append(path)
    return runs


def _joined(runs: list[list[Cell]]) -> list[list[Cell]]:
    """Join runs through junctions, the straightest pair first; those that are left end one cell before."""
    ends: dict[Cell, list[tuple[int, bool]]] = {}
    for number, path in enumerate(runs):
        if path[0] != path[-1]:
            ends.setdefault(path[0], []).append((number, True))
            ends.setdefault(path[-1], []).append((number, False))
    links: dict[tuple[int, bool], tuple[int, bool]] = {}
    short: set[tuple[int, bool]] = set()
    for _, members in sorted(ends.items()):
        if len(members) < 2:
            continue
        aim = {member: _aim(runs[member[0]], member[1]) for member in members}
        pairs = [pair for pair in combinations(members, 2) if pair[0][0] != pair[1][0]]
        best = min(pairs, key=lambda pair: float(aim[pair[0]] @ aim[pair[1]]), default=None)
        if best is not None:
            links[best[0]], links[best[1]] = best[1], best[0]
        short |= {member for member in members if best is None or member not in best}
    lines, done = [], set()
    for number in range(len(runs)):
        if number in done:
            continue
        # Back to where the joined line begins, then along it.
        current, at_start = number, True
        seen = {number}
        while (current, at_start) in links:
            previous, begins = links[current, at_start]
            if previous in seen:
                break
            seen.add(previous)
            current, at_start = previous, not begins
        line: list[Cell] = []
        while current not in done:
            done.add(current)
            path = runs[current] if at_start else runs[current][::-1]
            if (current, at_start) in short:
                path = path[1:]
            if (current, not at_start) in short:
                path = path[:-1]
            line += path[1:] if line else path
            if (current, not at_start) not in links:
                break
            current, at_start = links[current, not at_start]
        lines.append(line)
    return lines


def _aim(path: list[Cell], start: bool) -> npt.NDArray[np.float64]:
    """Return the direction in which a run leaves one of its ends."""
    some = path[:6] if start else path[-6:][::-1]
    leg = np.subtract(some[-1], some[0]).astype(np.float64)
    return np.asarray(leg / max(float(np.hypot(*leg)), 1e-9))
