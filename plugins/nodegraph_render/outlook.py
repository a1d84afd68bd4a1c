"""What a camera asks of a construction tree: which part of it, how fine its bounds, how much detail."""

from __future__ import annotations

import math
from collections import deque

from nodegraph import Context
from nodegraph_render.camera import Camera
from nodegraph_render.quadtree import Quadtree, build
from nodegraph_tree.function import Box, ElevationFunction

Edges = tuple[float, float, float, float]

HORIZON = 20.0
"""How far a scene without an end reaches around the eye, in distances from the eye to the target."""
LINES = 67
"""Lines of the picture that a leaf spans, at its distance: bounds take time, which fewer rays would not repay."""
ACROSS = (4, 16)
"""How many leaves fit the height of the picture, at least and at most."""
UNSEEN = 5.0
"""How much larger a leaf may be where the camera does not look."""
_RECENT: deque[tuple[ElevationFunction, object, Quadtree]] = deque(maxlen=4)
"""What was asked for last: shading asks for what tracing has built."""
STEPS_OF_DETAIL = 32
"""Detail falls in steps, so that leaves that lie side by side mostly have the same."""


def outlook(
    function: ElevationFunction,
    camera: Camera,
    extent: Edges | None,
    view_range: float | None,
    context: Context,
    lines: int = 1080,
) -> Quadtree:
    """Return the bounds of a tree as a camera needs them: small boxes near the eye, large ones far away.

    Args:
        function: the tree.
        camera: from where.
        extent: west, south, east, north of what is looked at, m; by default the tree's support, which for a tree
            without an end is cut at `HORIZON` times the distance from the eye to the target.
        view_range: distance from the eye at which no detail is left, m; None for all detail everywhere.  Between, the
            level of detail is 1 - 3 t^2 + 2 t^3 of t = distance / view_range, in steps of 1 / 32.
        context: for cancelling.
        lines: how many lines the picture has.

    Raises:
        ValueError: no terrain lies there.
    """
    wanted = (camera, extent, view_range, lines)
    for known, asked, tree in list(_RECENT):
        if known is function and asked == wanted:
            return tree
    tree = _build(function, camera, extent, view_range, context, lines)
    _RECENT.append((function, wanted, tree))
    return tree


def _build(
    function: ElevationFunction,
    camera: Camera,
    extent: Edges | None,
    view_range: float | None,
    context: Context,
    lines: int,
) -> Quadtree:
    across = min(max(lines / LINES, ACROSS[0]), ACROSS[1])
    region = _region(function, camera, extent)
    above = max(camera.eye[2] - function.bounds(region).high, 0.0)

    def distance(box: Box) -> float:
        return math.hypot(box.distance(camera.eye[0], camera.eye[1])[0], above)

    def fineness(box: Box) -> float:
        if not camera.field_of_view:
            return camera.span / across
        spans = 2 * math.tan(math.radians(camera.field_of_view) / 2) * distance(box)
        return max(spans, 1e-9) / across * (1 if _may_see(camera, box) else UNSEEN)

    def detail(box: Box) -> float:
        if view_range is None:
            return 1.0
        t = min(distance(box) / view_range, 1.0)
        return round((1 - t * t * (3 - 2 * t)) * STEPS_OF_DETAIL) / STEPS_OF_DETAIL

    return build(function, region, fineness, detail, context)


def _region(function: ElevationFunction, camera: Camera, extent: Edges | None) -> Box:
    region = function.support
    if extent is not None:
        region = region.intersection(Box(*extent))
    elif not all(map(math.isfinite, region)):
        (x, y, _), far = camera.eye, HORIZON * math.dist(camera.eye, camera.target)
        region = region.intersection(Box(x - far, y - far, x + far, y + far))
    if region.west >= region.east or region.south >= region.north:
        raise ValueError("no terrain lies in the extent that is looked at; move or widen it")
    return region


def _may_see(camera: Camera, box: Box) -> bool:
    """Say whether a camera may see something of a box; surely wrong only in pictures wider than 3:1."""
    forward = camera.axes[2]
    level = math.hypot(forward[0], forward[1])
    half = math.hypot(box.east - box.west, box.north - box.south) / 2
    x, y = (box.west + box.east) / 2 - camera.eye[0], (box.south + box.north) / 2 - camera.eye[1]
    distance = math.hypot(x, y)
    if level < 0.7 or distance <= half:
        return True
    spread = math.atan(3 * math.tan(math.radians(camera.field_of_view) / 2) / level)
    angle = math.acos(max(-1.0, min(1.0, (x * forward[0] + y * forward[1]) / (distance * level))))
    return angle - math.asin(half / distance) <= spread
