"""The value on the wire: `ElevationFunction`, a construction tree.

A node of the tree defines an elevation f(p), m, and a weight alpha(p) >= 0 over the plane, metres east and north.  Its
support Omega_0 is where alpha > 0; the terrain exists on Omega_T, where alpha >= T = 1/2.  Leaves are landform
primitives and inner nodes operators; a part that occurs twice is one object, so the tree is a directed acyclic graph.

Every class below and in the modules beside this one is a frozen port type: encoding, digest and read-only freezing
follow from its fields (a construction tree *is* such a value).  Evaluation comes in three forms:

- `ElevationFunction.query`: the reference, float64 NumPy, any points, with exact gradients on demand;
- `ElevationFunction.bounds`: what f, alpha and their gradients can be inside a box - never violated;
- `nodegraph_tree.device`: OpenCL, a program for each tile that holds what the tile can see and nothing else.

Source: Génevaux et al., Terrain modelling from feature primitives, Computer Graphics Forum 34(6), 2015,
doi:10.1111/cgf.12530; the bounds with the corrections stated where they are computed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import port_type

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Fill, Frame, Kernel

Floats = npt.NDArray[np.float64]

THRESHOLD = 0.5
"""T: the terrain exists where the weight is at least this."""

MAX_DEPTH = 150
"""How deep operators may be nested; n-ary operators and fused transforms keep real trees far below."""


class Points(NamedTuple):
    """Where a tree is asked: `x`, `y` (n,) metres; `detail`, the level of detail kappa in [0, 1], (n,) or one for
    all.
    """

    x: Floats
    y: Floats
    detail: Floats | float = 1.0

    def moved(self, x: Floats, y: Floats) -> Points:
        """Return the points elsewhere, with the same level of detail."""
        return Points(x, y, self.detail)

    def taken(self, where: npt.NDArray[np.bool_]) -> Points:
        """Return the points that `where` selects."""
        detail = self.detail if isinstance(self.detail, (int, float)) else self.detail[where]
        return Points(self.x[where], self.y[where], detail)


class Sample(NamedTuple):
    """What a tree answers: `height` f (m) and `weight` alpha, (n,), and on demand their gradients, (2, n), 1/m each.

    Outside the support the weight is 0 and the height any finite number.
    """

    height: Floats
    weight: Floats
    height_gradient: Floats | None = None
    weight_gradient: Floats | None = None


class Box(NamedTuple):
    """An axis-aligned box of the plane, m; edges may be infinite."""

    west: float
    south: float
    east: float
    north: float

    @property
    def empty(self) -> bool:
        """True where the box holds no point."""
        return self.west > self.east or self.south > self.north

    def meets(self, other: Box) -> bool:
        """Say whether the boxes have a point in common."""
        return (
            self.west <= other.east
            and other.west <= self.east
            and self.south <= other.north
            and other.south <= self.north
        )

    def union(self, other: Box) -> Box:
        """Return the smallest box around both; an empty one adds nothing."""
        if self.empty:
            return other
        if other.empty:
            return self
        return Box(
            min(self.west, other.west),
            min(self.south, other.south),
            max(self.east, other.east),
            max(self.north, other.north),
        )

    def intersection(self, other: Box) -> Box:
        """Return the part that both share; it may be empty."""
        return Box(
            max(self.west, other.west),
            max(self.south, other.south),
            min(self.east, other.east),
            min(self.north, other.north),
        )

    def grown(self, by: float) -> Box:
        """Return the box with `by` metres added on every side."""
        return Box(self.west - by, self.south - by, self.east + by, self.north + by)

    def distance(self, x: float, y: float) -> tuple[float, float]:
        """Return the least and the greatest distance from a point to the box."""
        dx = max(self.west - x, 0.0, x - self.east)
        dy = max(self.south - y, 0.0, y - self.north)
        fx, fy = max(abs(self.west - x), abs(self.east - x)), max(abs(self.south - y), abs(self.north - y))
        return math.hypot(dx, dy), math.hypot(fx, fy)


EVERYWHERE = Box(-math.inf, -math.inf, math.inf, math.inf)
NOWHERE = Box(math.inf, math.inf, -math.inf, -math.inf)


class Bounds(NamedTuple):
    """What a tree can be inside a box, for one level of detail; each is a bound, and some are not attained.

    Attributes:
        low, high: f on the support.
        weight_low, weight_high: alpha.
        slope: |grad f| on the terrain (alpha >= T).  A Lipschitz constant of f on convex parts of it.
        weight_slope: |grad alpha|.
        flux: alpha |grad f| on the support.  A blend of little weight can be arbitrarily steep where it fades out,
        which
            does no harm since that weighs next to nothing: this is the quantity that stays bounded.
    """

    low: float
    high: float
    weight_low: float
    weight_high: float
    slope: float
    weight_slope: float
    flux: float
    support_slope: float = math.inf

    @property
    def absent(self) -> bool:
        """True where the support does not reach into the box."""
        return self.weight_high <= 0

    @property
    def steepest(self) -> float:
        """Bound of |grad f| wherever alpha > 0: where the terrain fills the box, that is its slope."""
        return self.slope if self.weight_low >= THRESHOLD else self.support_slope


ABSENT = Bounds(math.inf, -math.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""The bounds of a tree whose support does not meet the box."""


@port_type
class ElevationFunction:
    """A terrain as a function: a construction tree of primitives and operators.

    A subclass is a primitive or an operator: a frozen port type whose fields are its parameters and its parts.  It
    implements `query`, `bounds` and `support`, and `emit` if it runs on OpenCL (else it is computed with NumPy, in the
    same tree).
    """

    computes: ClassVar[bool] = True

    @property
    def parts(self) -> Sequence[ElevationFunction]:
        """The subtrees of an operator, in order; a primitive has none."""
        return ()

    @property
    def support(self) -> Box:
        """A box around Omega_0."""
        raise NotImplementedError

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Return elevation and weight at any points, and their exact gradients when asked for.

        O(points * primitives that reach them).
        """
        raise NotImplementedError

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Return bounds of f, alpha and their gradients in a box, for a level of detail kappa."""
        raise NotImplementedError

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Append the OpenCL instructions that leave (f, alpha) on the stack, for the samples of one tile.

        The default computes this subtree with NumPy and hands the tile's values over, so that a primitive without
        OpenCL works in any tree.
        """
        emitter.from_host(self, frame)

    @property
    def single(self) -> tuple[Kernel, Fill] | None:
        """What a primitive is that emits one instruction with pending parameters: its kernel and what fills them.

        A blend then emits many of them in one go (`Emitter.add_each`) instead of calling `emit`.  None: anything else.
        """
        return None

    @property
    def on_device(self) -> bool:
        """True where this node and all below it have OpenCL instructions."""
        return type(self).emit is not ElevationFunction.emit and all(part.on_device for part in self.parts)


def product(first: float, second: float) -> float:
    """Return the product of two bounds, where nothing times infinity is nothing."""
    return 0.0 if first == 0 or second == 0 else first * second


def walk(root: ElevationFunction) -> Iterator[ElevationFunction]:
    """Yield every distinct node of a tree once, parts before wholes."""
    seen: set[int] = set()
    stack: list[tuple[ElevationFunction, bool]] = [(root, False)]
    while stack:
        node, ready = stack.pop()
        if id(node) in seen:
            continue
        if ready:
            seen.add(id(node))
            yield node
        else:
            stack.append((node, True))
            stack.extend((part, False) for part in node.parts)


def depth(root: ElevationFunction) -> int:
    """Return how many operators lie above the deepest primitive."""
    depths: dict[int, int] = {}
    for node in walk(root):
        depths[id(node)] = 1 + max((depths[id(part)] for part in node.parts), default=-1)
    return depths[id(root)]


def check_depth(root: ElevationFunction) -> None:
    """Raise `ValueError` when operators are nested deeper than `MAX_DEPTH`."""
    levels = depth(root)
    if levels > MAX_DEPTH:
        raise ValueError(
            f"the tree nests {levels} operators, {MAX_DEPTH} are possible; link many parts to one operator"
        )


def empty_sample(points: Points, *, gradient: bool) -> Sample:
    """Return the answer of nothing: weight 0 everywhere."""
    zero = np.zeros(points.x.shape)
    flat = np.zeros((2, *points.x.shape)) if gradient else None
    return Sample(zero, zero, flat, flat)


def box_around(points: Points) -> Box:
    """Return the smallest box around some points, of which there must be one."""
    return Box(float(points.x.min()), float(points.y.min()), float(points.x.max()), float(points.y.max()))


def numeric_gradient(node: ElevationFunction, points: Points, step: float = 1e-3) -> tuple[Floats, Floats]:
    """Return central differences of f and alpha, (2, n) each: what a node without analytic gradients uses."""
    found = []
    for dx, dy in ((step, 0.0), (0.0, step)):
        ahead = node.query(points.moved(points.x + dx, points.y + dy))
        behind = node.query(points.moved(points.x - dx, points.y - dy))
        found.append(((ahead.height - behind.height) / (2 * step), (ahead.weight - behind.weight) / (2 * step)))
    (fx, ax), (fy, ay) = found
    return np.stack([fx, fy]), np.stack([ax, ay])
