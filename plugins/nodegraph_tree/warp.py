"""Warps: a tree seen through a distortion of the plane (section 5.4).

A warp omega moves the points of the plane; the tree f o omega^-1, alpha o omega^-1 follows it.  Evaluation needs the
inverse only, so that is what is stored, as a displacement: omega^-1(p) = p + d(p).  Each kind has an analytic Jacobian
J = I + grad d, grad f = J^T (grad f_A o omega^-1).

=========  =======================================================================  =========================
kind       d(p)                                                                     one to one
=========  =======================================================================  =========================
Twist      a turn about a centre, by an angle that falls off with the distance     always
Bend       a shift across an axis, by a spline along it, falling off beside it     sup |shift| max |g'| < reach
Distort    two gradient noises                                                     sup |grad d| < 1
=========  =======================================================================  =========================

A displacement with a Lipschitz constant below 1 makes p + d(p) one to one and onto (Banach).  Where d is 0 the tree is
unchanged, bit for bit.

**Bounds.**  In a box where |d| <= m and the largest singular value of J is at most sigma, the tree is bounded by that
of the operand in the box grown by m, or in the box of half size sigma * half diagonal around the image of the centre;
slopes and fluxes times sigma.  `Distort` bounds both components of d in the box, each from below and above, and moves
the edges of the box by that.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from math import hypot, isfinite, pi, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from nodegraph import port_type
from nodegraph_terrain.noise import Noise, origins_of
from nodegraph_tree.affine import largest_singular_value
from nodegraph_tree.device import FOLDER, Frame, Kernel, Parameters, Pending
from nodegraph_tree.falloff import STEEPEST, derivative, fall_off, steepest_between
from nodegraph_tree.function import ABSENT, Bounds, Box, ElevationFunction, Floats, Points, Sample, product

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Shared

_TWIST, _BEND, _DISTORT = (Kernel(f"tree_{name}", FOLDER / "warp.cl") for name in ("twist", "bend", "distort"))
_LEAVE = Kernel("tree_leave", FOLDER / "basic.cl")


Instruction = tuple[Kernel, list[float] | Pending, list[int]]


class Shift(NamedTuple):
    """A displacement at points: d, (n,) m each, and its derivatives if asked for, (n,) each: xy is that of d_x by y."""

    x: Floats
    y: Floats
    xx: Floats | None = None
    xy: Floats | None = None
    yx: Floats | None = None
    yy: Floats | None = None


class Reach(NamedTuple):
    """What a warp does in a box: the greatest displacement, m, and the largest singular value of J."""

    shift: float
    stretch: float


_STILL = Reach(0.0, 1.0)


@port_type
class Warp(ElevationFunction):
    """A tree under a warp; the kinds are subclasses.

    Attributes:
        operand: the tree.
    """

    operand: ElevationFunction

    @property
    def parts(self) -> Sequence[ElevationFunction]:
        """The one operand."""
        return (self.operand,)

    def shift(self, x: Floats, y: Floats, *, gradient: bool = False) -> Shift:
        """Return the displacement d of omega^-1 at points."""
        raise NotImplementedError

    def reach(self, box: Box) -> Reach:
        """Bound displacement and stretch in a box."""
        raise NotImplementedError

    def instruction(self, emitter: Emitter, frame: Frame, to: tuple[float, float]) -> Instruction:
        """Return what enters the coordinates p + d(p) - `to`, for the samples of a frame."""
        raise NotImplementedError

    @property
    def support(self) -> Box:
        """Around what can be displaced into the support of the operand."""
        inner = self.operand.support
        return inner if inner.empty else inner.grown(self.reach(inner.grown(self.farthest)).shift)

    @property
    def farthest(self) -> float:
        """The greatest displacement anywhere, m."""
        raise NotImplementedError

    def carried(self, box: Box, reach: Reach) -> Box:
        """Return a box around the image of a box under omega^-1."""
        grown = box.grown(reach.shift)
        if not all(map(isfinite, box)):
            return grown
        x, y = (box.west + box.east) / 2, (box.south + box.north) / 2
        moved = self.shift(np.array([x]), np.array([y]))
        half = reach.stretch * hypot(box.east - box.west, box.north - box.south) / 2
        x, y = x + float(moved.x[0]), y + float(moved.y[0])
        return grown.intersection(Box(x - half, y - half, x + half, y + half))

    def closely(self, box: Box) -> tuple[Box, float]:
        """Return a box around the image of a box, and the stretch in it, as tight as bounds deserve."""
        reach = self.reach(box)
        return box if reach == _STILL else self.carried(box, reach), reach.stretch

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Ask the operand at the displaced points; gradients are multiplied by the transposed Jacobian."""
        moved = self.shift(points.x, points.y, gradient=gradient)
        sample = self.operand.query(points.moved(points.x + moved.x, points.y + moved.y), gradient=gradient)
        if sample.height_gradient is None or sample.weight_gradient is None:
            return sample
        slopes = []
        for east, north in (sample.height_gradient, sample.weight_gradient):
            slopes.append(
                np.stack([east + (moved.xx * east + moved.yx * north), north + (moved.xy * east + moved.yy * north)])
            )
        return Sample(sample.height, sample.weight, *slopes)

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound the operand in the carried box; slopes grow by the largest singular value of the Jacobian."""
        inside, stretch = self.closely(box)
        inner = self.operand.bounds(inside, detail)
        if inner.absent:
            return ABSENT
        return inner._replace(
            slope=product(stretch, inner.slope),
            weight_slope=product(stretch, inner.weight_slope),
            flux=product(stretch, inner.flux),
            support_slope=product(stretch, inner.support_slope),
        )

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Change coordinates around the operand; nothing to do where the tile is not displaced.

        The operand's frame begins where the tile's middle goes, so that its offsets stay small.
        """
        reach = self.reach(frame.box)
        if reach == _STILL:
            self.operand.emit(emitter, frame)
            return
        if not self.operand.on_device:
            emitter.from_host(self, frame)  # the samples are no longer those of an affine frame
            return
        box = self.carried(frame.box, reach)
        if not box.meets(self.operand.support):
            emitter.nothing()
            return
        x, y = (frame.box.west + frame.box.east) / 2, (frame.box.south + frame.box.north) / 2
        middle = self.shift(np.array([x]), np.array([y]))
        to = (float(middle.x[0]), float(middle.y[0]))
        emitter.enter(*self.instruction(emitter, frame, to))
        self.operand.emit(emitter, Frame(box, frame.ox + to[0], frame.oy + to[1]))
        emitter.leave(_LEAVE, [1.0, 0.0])


@port_type
class Twist(Warp):
    """A tree turned about a centre by an angle that falls off to 0 at a radius R, by (1 - (r/R)^2)^3 (C2).

    omega^-1 turns each circle back by its angle: one to one whatever the angle.  With the angle a(r), J is a turn times
    a shear by r a'(r), whose largest singular value is k/2 + sqrt(1 + k^2/4), k = r |a'(r)|.

    Attributes:
        x, y: the centre, m.
        radius: R, m.
        angle: at the centre, counter-clockwise, radians.
    """

    x: float
    y: float
    radius: float
    angle: float

    @property
    def farthest(self) -> float:
        """No point leaves its circle."""
        return 2 * self.radius

    @cached_property
    def support(self) -> Box:
        """That of the operand, and the disc if it reaches into that: turning leaves all else in place."""
        inner = self.operand.support
        disc = Box(self.x, self.y, self.x, self.y).grown(self.radius)
        return inner.union(disc) if inner.meets(disc) else inner

    def shift(self, x: Floats, y: Floats, *, gradient: bool = False) -> Shift:
        """Return (R(-a) - I)(p - c)."""
        east, north = x - self.x, y - self.y
        t = np.hypot(east, north) / self.radius
        turn = -self.angle * fall_off("wyvill", t)
        # cos - 1 without losing digits, and exactly 0 outside.
        lost, sine = -2 * np.sin(turn / 2) ** 2, np.sin(turn)
        dx, dy = lost * east - sine * north, lost * north + sine * east
        if not gradient:
            return Shift(dx, dy)
        # grad of the turn: a'(r) (p - c) / r, with g'(t) = -6 t (1 - t^2)^2 there is no division by r.
        rate = self.angle * 6 * np.maximum(1 - t * t, 0) ** 2 / self.radius**2
        spun_x, spun_y = -(north + dy), east + dx  # the derivative by the turn: the turned vector, turned by 90 degrees
        return Shift(
            dx,
            dy,
            lost + spun_x * rate * east,
            -sine + spun_x * rate * north,
            sine + spun_y * rate * east,
            lost + spun_y * rate * north,
        )

    def reach(self, box: Box) -> Reach:
        """Bound the chord 2 r sin(|a| / 2) and the shear |angle| 6 t^2 (1 - t^2)^2, greatest at t = 1/sqrt(3)."""
        near, far = (distance / self.radius for distance in box.distance(self.x, self.y))
        if near >= 1 or self.angle == 0:
            return _STILL
        far = min(far, 1.0)
        turn = abs(self.angle) * float(fall_off("wyvill", np.array(near)))
        peak = min(max(1 / sqrt(3), near), far)
        shear = abs(self.angle) * 6 * peak**2 * (1 - peak**2) ** 2
        return Reach(self.radius * far * 2 * np.sin(min(turn, pi) / 2), shear / 2 + sqrt(1 + shear**2 / 4))

    def instruction(self, emitter: Emitter, frame: Frame, to: tuple[float, float]) -> Instruction:  # noqa: ARG002
        """Centre relative to the frame, 1 / radius, angle, what to take off."""
        return _TWIST, [self.x - frame.ox, self.y - frame.oy, 1 / self.radius, -self.angle, *to], []


@port_type
class Bend(Warp):
    """A tree bent sideways along an axis, so that the straight axis becomes a curve.

    With s along the axis from its start (x, y), t across it to the left, and length L, points of the tree are moved by
    h(s) g(|t| / reach) to the left: omega^-1(s, t) = (s, t - h(s) g(|t| / reach)).  h is the cubic spline (C2) of L
    that has the given offsets at equal distances and is 0, level and without curvature at both ends and beyond; g is (1
    - u^2)^3.  One to one where t -> t - h g rises: sup |h| max |g'| < reach.

    J = (1, 0; -h' g, 1 - h g' / reach) in the coordinates of the axis.

    Attributes:
        x, y: where the axis starts, m.
        east, north: the direction of the axis, a unit vector.
        length: L, m.
        offsets: of the axis to the left, m, at L / (n + 3) times 2, 3, ..., n + 1.
        reach_across: beyond this distance from the axis nothing moves, m.
    """

    x: float
    y: float
    east: float
    north: float
    length: float
    offsets: tuple[float, ...]
    reach_across: float

    @property
    def step(self) -> float:
        """Distance between the offsets along the axis, m."""
        return self.length / (len(self.offsets) + 3)

    @cached_property
    def coefficients(self) -> Floats:
        """The weights of the B-splines at the offsets' places, so that the spline passes through the offsets."""
        count = len(self.offsets)
        matrix = (4 * np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)) / 6
        return np.linalg.solve(matrix, np.array(self.offsets))

    @cached_property
    def farthest(self) -> float:
        """Sup |h|: at the knots, or where the parabola h' is 0 between two."""
        weights = np.concatenate([np.zeros(4), self.coefficients, np.zeros(4)])
        a, b, c, d = weights[:-3], weights[1:-2], weights[2:-1], weights[3:]
        # h = k0 + k1 u + k2 u^2 + k3 u^3 for u in [0, 1] between two knots.
        k0, k1, k2, k3 = (a + 4 * b + c) / 6, (c - a) / 2, (a - 2 * b + c) / 2, (d - 3 * c + 3 * b - a) / 6
        greatest = float(np.abs(k0).max())
        for row in zip(k0, k1, k2, k3, strict=True):
            for root in np.roots([3 * row[3], 2 * row[2], row[1]]):
                if abs(root.imag) < 1e-9 and 0 < root.real < 1:
                    u = float(root.real)
                    greatest = max(greatest, abs(float(row[0] + u * (row[1] + u * (row[2] + u * row[3])))))
        return greatest

    @cached_property
    def steepest(self) -> float:
        """Sup |h'|: h' is a quadratic spline of weights (c_i - c_(i-1)) / step, and stays within them."""
        return float(np.abs(np.diff(np.concatenate([[0.0], self.coefficients, [0.0]]))).max()) / self.step

    def shift(self, x: Floats, y: Floats, *, gradient: bool = False) -> Shift:
        """Return -h(s) g(t) along the left-hand normal."""
        dx, dy = x - self.x, y - self.y
        along, across = self.east * dx + self.north * dy, self.east * dy - self.north * dx
        distance = np.abs(across) / self.reach_across
        beside = fall_off("wyvill", distance)
        offset, turned = np.zeros_like(along), np.zeros_like(along)
        for index, weight in enumerate(self.coefficients):
            u = along / self.step - (index + 2)
            wide, narrow = np.maximum(2 - np.abs(u), 0), np.maximum(1 - np.abs(u), 0)
            offset += weight / 6 * (wide**3 - 4 * narrow**3)
            turned -= weight / 2 * np.sign(u) * (wide**2 - 4 * narrow**2)
        moved = -offset * beside
        east, north = -self.north, self.east
        if not gradient:
            return Shift(moved * east, moved * north)
        by_along = -turned / self.step * beside
        by_across = -offset * derivative("wyvill", distance) * np.sign(across) / self.reach_across
        # grad of `moved` in x and y, along the constant normal.
        by_x, by_y = by_along * self.east + by_across * east, by_along * self.north + by_across * north
        return Shift(moved * east, moved * north, by_x * east, by_y * east, by_x * north, by_y * north)

    def reach(self, box: Box) -> Reach:
        """Bound the shift by sup |h| g, and J from the greatest |h' g| and 1 + |h g'| / reach beside the box."""
        if self.farthest == 0:
            return _STILL
        near, far = 0.0, 1.0
        if all(map(isfinite, box)):
            corners = [(x - self.x, y - self.y) for x in (box.west, box.east) for y in (box.south, box.north)]
            along = [self.east * x + self.north * y for x, y in corners]
            across = [self.east * y - self.north * x for x, y in corners]
            if max(along) <= 0 or min(along) >= self.length:
                return _STILL
            near = max(min(across), -max(across), 0.0) / self.reach_across
            far = max(map(abs, across)) / self.reach_across
            if near >= 1:
                return _STILL
        beside = float(fall_off("wyvill", np.array(near)))
        stretched = 1 + self.farthest * steepest_between("wyvill", near, min(far, 1.0)) / self.reach_across
        return Reach(
            self.farthest * beside, max(1.0, largest_singular_value((1.0, 0.0, self.steepest * beside, stretched)))
        )

    def instruction(self, emitter: Emitter, frame: Frame, to: tuple[float, float]) -> Instruction:  # noqa: ARG002
        """The axis relative to the frame, and the splines."""
        dx, dy = frame.ox - self.x, frame.oy - self.y
        # Along and across the axis at the frame's origin.
        along, across = self.east * dx + self.north * dy, self.east * dy - self.north * dx
        numbers = [along / self.step, across, self.east, self.north, 1 / self.step, 1 / self.reach_across, *to]
        return _BEND, [*numbers, *self.coefficients.tolist()], [len(self.offsets)]


@port_type
class Distort(Warp):
    """A tree distorted by noise: d = amplitude (n_x, n_y), two fractal sums of gradient noise within [-1, 1] (C2).

    |grad d| <= sqrt(2) amplitude lambda, lambda the Lipschitz constant of either sum; one to one where that is below 1.

    Attributes:
        amplitude: m.
        wavelength: of the largest features, m.
        octaves, gain: of the sums; wavelengths halve.
        seed: another seed, another distortion.
    """

    amplitude: float
    wavelength: float
    octaves: int = 1
    gain: float = 0.5
    seed: int = 0

    @cached_property
    def noises(self) -> tuple[Noise, Noise]:
        """The noises of both components."""
        # The second seed is far from those that people choose.
        return (
            Noise("fbm", octaves=self.octaves, wavelength=self.wavelength, gain=self.gain, seed=self.seed),
            Noise("fbm", octaves=self.octaves, wavelength=self.wavelength, gain=self.gain, seed=self.seed ^ 0x9E3779B9),
        )

    @cached_property
    def lipschitz(self) -> float:
        """Bound of |grad d|."""
        return sqrt(2) * abs(self.amplitude) * self.noises[0].lipschitz()

    @property
    def farthest(self) -> float:
        """Both components at their greatest."""
        return sqrt(2) * abs(self.amplitude)

    def shift(self, x: Floats, y: Floats, *, gradient: bool = False) -> Shift:
        """Return the two noises."""
        if self.amplitude == 0:
            zero = np.zeros_like(x)
            return Shift(*[zero] * 6) if gradient else Shift(zero, zero)
        if not gradient:
            return Shift(*(self.amplitude * noise.value(x, y) for noise in self.noises))
        first, second = (noise.sample(x, y) for noise in self.noises)
        values = (first.value, second.value, first.east, first.north, second.east, second.north)
        return Shift(*(self.amplitude * value for value in values))

    def reach(self, box: Box) -> Reach:  # noqa: ARG002
        """The same everywhere."""
        return Reach(self.farthest, 1 + self.lipschitz) if self.amplitude else _STILL

    def closely(self, box: Box) -> tuple[Box, float]:
        """Bound both components of d by what their noises are in the box, and |J| by 1 + |grad d|."""
        found = [noise.bounds_in(*box) for noise in self.noises]
        (west, east), (south, north) = (sorted((self.amplitude * low, self.amplitude * high)) for low, high, _ in found)
        stretch = 1 + abs(self.amplitude) * hypot(*(slope for _, _, slope in found))
        return Box(box.west + west, box.south + south, box.east + east, box.north + north), stretch

    def instruction(self, emitter: Emitter, frame: Frame, to: tuple[float, float]) -> Instruction:  # noqa: ARG002
        """The tables of both noises, which all tiles share, and the frame's origin on their lattices."""
        return _DISTORT, Pending(_distort, (self, to), frame.ox, frame.oy), []

    @cached_property
    def _tables(self) -> list[npt.NDArray[np.float32]]:
        return [noise.table().view(np.float32) for noise in self.noises]


def _distort(owners: Sequence[tuple[Distort, tuple[float, float]]], x: Floats, y: Floats, shared: Shared) -> Parameters:
    floats = np.array([(item.amplitude, *to) for item, to in owners])
    heads = [(*map(shared.place, item._tables), 4 * len(item.noises[0].lattices)) for item, _ in owners]
    origins = origins_of([noise for item, _ in owners for noise in item.noises], np.repeat(x, 2), np.repeat(y, 2))
    return Parameters(floats, np.array(heads), origins.view(np.int32), 2 * np.array(heads)[:, 2])


def twist(operand: ElevationFunction, *, centre: tuple[float, float], radius: float, angle: float) -> ElevationFunction:
    """Return a tree twisted by `angle` radians at the centre, nothing at the radius (m)."""
    if not (radius > 0 and isfinite(radius) and isfinite(angle) and all(map(isfinite, centre))):
        raise ValueError("a twist needs a finite centre and angle and a radius above 0")
    return operand if angle == 0 else Twist(operand, float(centre[0]), float(centre[1]), float(radius), float(angle))


def bend(
    operand: ElevationFunction,
    *,
    start: tuple[float, float],
    end: tuple[float, float],
    offsets: Sequence[float],
    reach: float,
) -> ElevationFunction:
    """Return a tree bent along the axis from `start` to `end`.

    Raises:
        ValueError: the axis has no length, or the bend would fold the plane.
    """
    length = hypot(end[0] - start[0], end[1] - start[1])
    if not (length > 0 and reach > 0 and all(map(isfinite, (*start, *end, reach, *offsets)))):
        raise ValueError("a bend needs an axis between two different points, finite offsets and a reach above 0")
    east, north = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    x, y = map(float, start)
    bent = Bend(operand, x, y, east, north, length, tuple(map(float, offsets)), float(reach))
    if not offsets or bent.farthest == 0:
        return operand
    least = bent.farthest * STEEPEST["wyvill"]
    if least >= reach:
        raise ValueError(
            f"a bend by {bent.farthest:.4g} m within {reach:g} m folds the ground; give a reach above {least:.4g} m"
        )
    return bent


def distort(
    operand: ElevationFunction,
    *,
    amplitude: float,
    wavelength: float,
    octaves: int = 1,
    gain: float = 0.5,
    seed: int = 0,
) -> ElevationFunction:
    """Return a tree distorted by noise.

    Raises:
        ValueError: the distortion would fold the plane.
    """
    if amplitude == 0:
        return operand
    made = Distort(operand, float(amplitude), float(wavelength), octaves, float(gain), seed)
    if not made.lipschitz < 1:
        most = abs(amplitude) / made.lipschitz
        raise ValueError(
            f"a displacement of {amplitude:g} m over {wavelength:g} m may fold the ground; give an amplitude below "
            f"{most:.4g} m, or a longer wavelength"
        )
    return made
