"""Discs of ground - plains, hills, mountains - and noise without an edge (section 4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import chain
from math import inf, isfinite
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import numpy.typing as npt

from nodegraph import Param, node, port_type
from nodegraph_terrain.noise import MOST, Kind, Noise, origins_of
from nodegraph_tree.device import FOLDER, Kernel, Parameters, Pending
from nodegraph_tree.falloff import CODES, FallOff, derivative, fall_off, steepest_between
from nodegraph_tree.function import (
    ABSENT,
    EVERYWHERE,
    Bounds,
    Box,
    ElevationFunction,
    Floats,
    Points,
    Sample,
    empty_sample,
)

if TYPE_CHECKING:
    from nodegraph_tree.device import Emitter, Fill, Frame, Shared

Roughness = Literal["none", "gradient", "fbm", "billow", "ridged", "hybrid", "warped"]
Style = Literal["plain", "hills", "mountains"]

_FLAT = Kernel("tree_disc_flat", FOLDER / "disc.cl")
_ROUGH = Kernel("tree_disc_rough", FOLDER / "disc.cl")
_NOISE = Kernel("tree_noise", FOLDER / "disc.cl")


@port_type
class Relief:
    """Rough ground of no particular place: h(q) = amplitude * noise(q), m, of offsets q from a centre.

    Attributes:
        kind: of noise, see `nodegraph_terrain.noise`; ``none`` is level.
        amplitude: what the noise, which stays within -1 to 1, is multiplied by, m.
        wavelength: of the largest forms, m.
        octaves, lacunarity, gain, seed, feedback, warp: as in `Noise`.
        intervals: (k-, k+) of each octave on the axis of the level of detail; empty for an even split.
    """

    kind: Roughness = "none"
    amplitude: float = 0.0
    wavelength: float = 1000.0
    octaves: int = 8
    lacunarity: float = 2.0
    gain: float = 0.5
    seed: int = 0
    feedback: float = 2.0
    warp: float = 0.3
    intervals: tuple[tuple[float, float], ...] = ()

    @property
    def level(self) -> bool:
        """True where there is no noise."""
        return self.kind == "none" or self.amplitude == 0

    @cached_property
    def noise(self) -> Noise | None:
        """The noise itself; None where the ground is level."""
        if self.kind == "none" or self.amplitude == 0:
            return None
        kind: Kind = self.kind
        return Noise(
            kind, self.octaves, self.wavelength, self.lacunarity, self.gain, self.seed, self.feedback, self.warp,
            self.intervals,
        )  # fmt: skip

    def query(self, x: Floats, y: Floats, detail: Floats | float, *, gradient: bool) -> tuple[Floats, Floats | None]:
        """Return heights at offsets from the centre and their gradients, (2, n), when asked for."""
        if self.noise is None:
            return np.zeros(x.shape), np.zeros((2, *x.shape)) if gradient else None
        kappa = None if isinstance(detail, (int, float)) and detail >= 1 else detail
        if not gradient:
            return self.amplitude * self.noise.value(x, y, kappa=kappa), None
        found = self.noise.sample(x, y, kappa=kappa)
        return self.amplitude * found.value, self.amplitude * np.stack([found.east, found.north])

    def bounds(self, box: Box, detail: float) -> tuple[float, float, float]:
        """Return least and greatest height in a box of offsets, and the greatest slope; see `Noise.bounds_in`."""
        if self.noise is None:
            return 0.0, 0.0, 0.0
        low, high, slope = self.noise.bounds_in(*box, None if detail >= 1 else self.noise.weights(detail))
        ends = (self.amplitude * low, self.amplitude * high)
        return min(ends), max(ends), abs(self.amplitude) * slope

    @cached_property
    def table(self) -> npt.NDArray[np.float32]:
        """What the device reads of the noise, 32-bit words."""
        assert self.noise is not None
        return self.noise.table().view(np.float32)


def relief_parameters(
    reliefs: Sequence[Relief], floats: Floats, x: Floats, y: Floats, shared: Shared, *heads: npt.NDArray[np.int64]
) -> Parameters:
    """Return the parameters of instructions with a relief each, not level, seen from offsets (x, y) from its centre.

    Integers are where the noise's table starts, one of each of `heads`, and the origin's place on the lattices.
    """
    # Scenes share reliefs between many places: each is laid out once.
    numbers: dict[int, int] = {}
    which = np.array([numbers.setdefault(id(item), len(numbers)) for item in reliefs])
    known = {id(item): item for item in reliefs}.values()
    noises = [item.noise for item in known if item.noise is not None]
    tables = np.array([shared.place(item.table) for item in known])[which]
    counts = np.array([4 * len(item.lattices) for item in noises])[which]
    return Parameters(floats, np.column_stack([tables, *heads]), origins_of(noises, x, y, which).view(np.int32), counts)


@port_type
class Disc(ElevationFunction):
    """A round piece of ground: f(p) = height + relief(p - c), alpha(p) = g(|p - c| / radius).

    Attributes:
        x, y: centre c, m.
        radius: beyond which the weight is 0, m.
        height: the base, m.
        relief: what lies on it.
        fall_off: g.
    """

    x: float
    y: float
    radius: float
    height: float
    relief: Relief
    fall_off: FallOff = "wyvill"

    @property
    def support(self) -> Box:
        """Around the circle."""
        return Box(self.x - self.radius, self.y - self.radius, self.x + self.radius, self.y + self.radius)

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Return height and weight; the noise is computed only inside the circle."""
        dx, dy = points.x - self.x, points.y - self.y
        far = np.hypot(dx, dy)
        inside = far < self.radius
        found = empty_sample(points, gradient=gradient)
        if not inside.any():
            return found
        near = points.taken(inside)
        relief, slope = self.relief.query(dx[inside], dy[inside], near.detail, gradient=gradient)
        height, weight = found.height.copy(), found.weight.copy()
        height[inside] = self.height + relief
        t = far[inside] / self.radius
        weight[inside] = fall_off(self.fall_off, t)
        if slope is None:
            return Sample(height, weight)
        height_slope, weight_slope = np.zeros((2, *far.shape)), np.zeros((2, *far.shape))
        height_slope[:, inside] = slope
        # g'(0) = 0, so that any direction will do at the centre.
        steep = derivative(self.fall_off, t) / self.radius / np.maximum(far[inside], 1e-300)
        weight_slope[:, inside] = steep * dx[inside], steep * dy[inside]
        return Sample(height, weight, height_slope, weight_slope)

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound the relief in the box, cut to the circle's, and the weight by the nearest and the farthest distance."""
        near, far = box.distance(self.x, self.y)
        if near >= self.radius:
            return ABSENT
        part = box.intersection(self.support)
        low, high, slope = self.relief.bounds(
            Box(part.west - self.x, part.south - self.y, part.east - self.x, part.north - self.y), detail
        )
        t, end = near / self.radius, min(far / self.radius, 1.0)
        least, most = fall_off(self.fall_off, np.array([end, t])).tolist()
        return Bounds(
            self.height + low,
            self.height + high,
            least,
            most,
            slope,
            steepest_between(self.fall_off, t, end) / self.radius,
            most * slope,
            slope,
        )

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Emit the disc, with the lattices of the noise as seen from the tile's origin."""
        west, south, east, north = frame.box
        dx, dy = max(west - self.x, 0.0, self.x - east), max(south - self.y, 0.0, self.y - north)
        if dx * dx + dy * dy >= self.radius * self.radius:
            emitter.nothing()
        else:
            kernel, fill = self.single
            emitter.add(kernel, Pending(fill, self, frame.ox, frame.oy))

    @property
    def single(self) -> tuple[Kernel, Fill]:
        """Level or rough."""
        return (_FLAT, _flat) if self.relief.level else (_ROUGH, _rough)

    @cached_property
    def _numbers(self) -> tuple[float, ...]:
        return (self.x, self.y, 1 / self.radius, self.height, self.relief.amplitude, CODES[self.fall_off])


def _seen(discs: Sequence[Disc], x: Floats, y: Floats) -> tuple[Floats, npt.NDArray[np.int64]]:
    numbers = np.fromiter(chain.from_iterable([item._numbers for item in discs]), np.float64).reshape(-1, 6)
    numbers[:, 0] -= x
    numbers[:, 1] -= y
    return numbers[:, :5], numbers[:, 5].astype(np.int64)


def _flat(discs: Sequence[Disc], x: Floats, y: Floats, shared: Shared) -> Parameters:  # noqa: ARG001
    floats, codes = _seen(discs, x, y)
    return Parameters(floats, codes[:, None])


def _rough(discs: Sequence[Disc], x: Floats, y: Floats, shared: Shared) -> Parameters:
    floats, codes = _seen(discs, x, y)
    return relief_parameters([item.relief for item in discs], floats, -floats[:, 0], -floats[:, 1], shared, codes)


@port_type
class NoiseField(ElevationFunction):
    """Noise without an edge: f(p) = height + relief(p - c), alpha = 1.

    Attributes:
        x, y: c, m: where the noise has its origin.
        height: the base, m.
        relief: what lies on it.
    """

    x: float
    y: float
    height: float
    relief: Relief

    @property
    def support(self) -> Box:
        """Everywhere."""
        return EVERYWHERE

    def query(self, points: Points, *, gradient: bool = False) -> Sample:
        """Return the noise."""
        relief, slope = self.relief.query(points.x - self.x, points.y - self.y, points.detail, gradient=gradient)
        weight = np.ones(points.x.shape)
        return Sample(self.height + relief, weight, slope, np.zeros_like(slope) if slope is not None else None)

    def bounds(self, box: Box, detail: float = 1.0) -> Bounds:
        """Bound the relief in the box."""
        moved = Box(box.west - self.x, box.south - self.y, box.east - self.x, box.north - self.y)
        if not all(map(isfinite, moved)):
            moved = Box(-inf, -inf, inf, inf)
        low, high, slope = self.relief.bounds(moved, detail)
        return Bounds(self.height + low, self.height + high, 1.0, 1.0, slope, 0.0, slope, slope)

    def emit(self, emitter: Emitter, frame: Frame) -> None:
        """Emit the noise, or a constant where it is level."""
        if self.relief.noise is None:
            from nodegraph_tree.basic import Constant

            Constant(self.height).emit(emitter, frame)
        else:
            emitter.add(_NOISE, Pending(_everywhere, self, frame.ox, frame.oy))


def _everywhere(fields: Sequence[NoiseField], x: Floats, y: Floats, shared: Shared) -> Parameters:
    numbers = np.array([(item.height, item.relief.amplitude) for item in fields])
    east, north = x - [item.x for item in fields], y - [item.y for item in fields]
    return relief_parameters([item.relief for item in fields], numbers, east, north, shared)


_Centre = Annotated[tuple[float, float], Param("Centre (x, y).", unit="m")]
_KIND = Param("Noise: gradient, fbm, billow, ridged, hybrid, warped; none is level.")
_OCTAVES = Param("How many scales of forms.", ge=1, le=MOST)
_LACUNARITY = Param("How much finer each scale is than the one before.", ge=1, le=16)
_GAIN = Param("How much lower each scale is than the one before.", ge=0, le=2)
_SEED = Param("Another number gives other ground of the same kind.", ge=0, le=0xFFFFFFFF)
_FEEDBACK = Param("How much height lets finer scales in, for ridged and hybrid.", ge=0, le=16)
_WARP = Param("Displacement of warped, in wavelengths.", ge=0, le=4)
_INTERVALS = Param("Level of detail [from, to] in which each octave appears; none: split evenly.")
_Intervals = tuple[tuple[float, float], ...]


@node(version=1)
def disc(
    *,
    centre: _Centre = (0.0, 0.0),
    radius: Annotated[float, Param("Where the weight reaches 0.", gt=0, unit="m")] = 1000.0,
    height: Annotated[float, Param("Height of the base.", unit="m")] = 0.0,
    style: Annotated[Style, Param("Ready ground, in proportion to the radius; what is set below wins.")] = "plain",
    kind: Annotated[Roughness | None, _KIND] = None,
    amplitude: Annotated[float | None, Param("What the noise, -1 to 1, is multiplied by.", unit="m")] = None,
    wavelength: Annotated[float | None, Param("Size of the largest forms.", gt=0, unit="m")] = None,
    octaves: Annotated[int, _OCTAVES] = 8,
    lacunarity: Annotated[float, _LACUNARITY] = 2.0,
    gain: Annotated[float | None, _GAIN] = None,
    seed: Annotated[int, _SEED] = 0,
    feedback: Annotated[float, _FEEDBACK] = 2.0,
    warp: Annotated[float, _WARP] = 0.3,
    intervals: Annotated[_Intervals, _INTERVALS] = (),
    fall_off: Annotated[FallOff, Param("How the weight falls from 1 at the centre to 0.")] = "wyvill",
) -> ElevationFunction:
    """Make a round piece of ground: a plain, hills or mountains.

        f(p) = height + amplitude sum_i a_i b_i(kappa) eta_i(p - c),   alpha(p) = g(|p - c| / radius)

    with the noise of `nodegraph_terrain.noise`, whose octaves appear one by one as the level of detail kappa rises:
    b_i = 1 - (1 - t^2)^3 on the interval of octave i (the filter printed in the paper falls instead of rising).  The
    noise belongs to the disc: moving the centre moves its hills along.

    =========  ======  =========  ===============  =============  ====
    style      kind    amplitude  highest forms    wavelength     gain
    =========  ======  =========  ===============  =============  ====
    plain      none    0
    hills      fbm     radius/12  radius/12 above  radius/2       0.4
    mountains  ridged  radius/4   radius/4 above   radius         0.5
    =========  ======  =========  ===============  =============  ====

    Alone, a disc is terrain where g >= 1/2: with ``wyvill`` up to 0.454 radius.

    Args:
        centre: c.
        radius: of the support.
        height: base height.
        style: ready values of `kind`, `amplitude`, `wavelength` and `gain`.
        kind: of noise.
        amplitude: of the noise; a negative one turns it upside down.
        wavelength: of the first octave.
        octaves: number of octaves.
        lacunarity: ratio of frequencies.
        gain: ratio of amplitudes.
        seed: of the noise.
        feedback: of ``ridged`` and ``hybrid``.
        warp: of ``warped``.
        intervals: of the level of detail, one for each octave, within 0 to 1.
        fall_off: g: wyvill, cubic, quintic, plateau.

    Raises:
        ValueError: intervals that do not fit the octaves.

    Source: Génevaux et al. 2015, sections 4.1 and 6, doi:10.1111/cgf.12530.
    """
    ready: dict[Style, tuple[Roughness, float, float, float]] = {
        "plain": ("none", 0.0, 1.0, 0.5),
        "hills": ("fbm", 1 / 12, 0.5, 0.4),
        "mountains": ("ridged", 0.25, 1.0, 0.5),
    }
    own, high, wide, fade = ready[style]
    relief = Relief(
        own if kind is None else kind,
        radius * (high or 1 / 12) if amplitude is None else amplitude,
        radius * wide if wavelength is None else wavelength,
        octaves, lacunarity, fade if gain is None else gain, seed, feedback, warp, _rising(intervals),
    )  # fmt: skip
    return Disc(centre[0], centre[1], radius, height, _sound(relief), fall_off)


@node(version=1)
def noise(
    *,
    kind: Annotated[Roughness, _KIND] = "fbm",
    height: Annotated[float, Param("Height of the base.", unit="m")] = 0.0,
    amplitude: Annotated[float, Param("What the noise, -1 to 1, is multiplied by.", unit="m")] = 100.0,
    wavelength: Annotated[float, Param("Size of the largest forms.", gt=0, unit="m")] = 1000.0,
    octaves: Annotated[int, _OCTAVES] = 8,
    lacunarity: Annotated[float, _LACUNARITY] = 2.0,
    gain: Annotated[float, _GAIN] = 0.5,
    seed: Annotated[int, _SEED] = 0,
    feedback: Annotated[float, _FEEDBACK] = 2.0,
    warp: Annotated[float, _WARP] = 0.3,
    intervals: Annotated[_Intervals, _INTERVALS] = (),
    centre: _Centre = (0.0, 0.0),
) -> ElevationFunction:
    """Make rough ground without an edge: f(p) = height + amplitude sum_i a_i b_i(kappa) eta_i(p - c), alpha = 1.

    The noise is that of `nodegraph_terrain.noise`; its octaves appear one by one as the level of detail rises, as in
    `disc`.

    Args:
        kind: of noise.
        height: base height.
        amplitude: of the noise.
        wavelength: of the first octave.
        octaves: number of octaves.
        lacunarity: ratio of frequencies.
        gain: ratio of amplitudes.
        seed: of the noise.
        feedback: of ``ridged`` and ``hybrid``.
        warp: of ``warped``.
        intervals: of the level of detail, one for each octave, within 0 to 1.
        centre: c: another one shows another part of the same noise.

    Raises:
        ValueError: intervals that do not fit the octaves.

    Source: Génevaux et al. 2015, sections 4.1 and 6, doi:10.1111/cgf.12530.
    """
    relief = Relief(
        kind, amplitude, wavelength, octaves, lacunarity, gain, seed, feedback, warp, _rising(intervals)
    )  # fmt: skip
    return NoiseField(centre[0], centre[1], height, _sound(relief))


def _rising(intervals: _Intervals) -> _Intervals:
    return tuple([(float(low), float(high)) for low, high in intervals])


def _sound(relief: Relief) -> Relief:
    """Make the noise once, so that what is wrong with it is said here."""
    _ = relief.noise
    return relief
