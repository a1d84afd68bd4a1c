from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph_terrain import gradient_noise as base
from nodegraph_terrain.gradient_noise import CURVATURE, LIPSCHITZ, gradient_noise
from nodegraph_terrain.noise import KINDS, MOST, Noise, origins_of

DICE = np.random.default_rng(11)
Floats = npt.NDArray[np.float64]


def points(count: int, span: float = 1e4, about: float = 0.0, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.random.default_rng(seed).uniform(-span, span, (2, count))
    return x + about, y - 0.6 * about


@st.composite
def noises(draw: Any) -> Noise:
    octaves = draw(st.integers(1, 6))
    intervals: tuple[tuple[float, float], ...] = ()
    kind = draw(st.sampled_from(KINDS))
    if draw(st.booleans()):
        count = 1 if kind == "gradient" else octaves
        ends = [sorted(draw(st.tuples(st.integers(0, 9), st.integers(0, 9)))) for _ in range(count)]
        intervals = tuple((low / 10, (high + 1) / 10) for low, high in ends)
    return Noise(
        kind,
        octaves,
        wavelength=draw(st.floats(0.5, 1e4)),
        lacunarity=draw(st.floats(1, 4)),
        gain=draw(st.floats(0, 1.2)),
        seed=draw(st.integers(0, 2**32 - 1)),
        feedback=draw(st.floats(0, 4)),
        warp=draw(st.floats(0, 1)),
        intervals=intervals,
    )


# The gradient noise itself.


Derivatives = Callable[[Floats, Floats, Floats], Iterator[tuple[list[Floats], list[Floats]]]]


def test_slope_bound_is_certified() -> None:
    """Bisect the cell and the directions until a bound of sum |v_c| over each box is below the constant.

    v_c = w_c e + (grad w_c . e)(p - c) is linear up to a remainder, which summed over the corners is at most 400 h^2 in
    a box of half width h (from |s'| <= 15/8, |s''| <= 5.774, |s'''| <= 60), and a sum of norms of linear functions is
    convex: greatest at a corner of the box.  By symmetry half the cell and half the circle will do.
    """
    _certify(_first, 400, LIPSCHITZ / math.sqrt(2))


def test_curvature_bound_is_certified() -> None:
    """The same for e^T H e = sum g_c . v_c, H the second derivatives, v_c = (e^T H(w_c) e)(p - c) + 2 (grad w_c . e) e.

    For a symmetric H its greatest is also the most by which the gradient changes.  Half of the second derivatives of
    v_c by place and angle, summed over the corners, is at most 4000 (with |s''''| <= 360): 2065 + 354 + 354 by place,
    925 by place and angle, 95 by angle.
    """
    _certify(_second, 4000, CURVATURE / math.sqrt(2))


def _certify(derivatives: Derivatives, remainder: float, limit: float) -> None:
    turns = np.array(list(itertools.product((-1, 1), repeat=3)))
    half = 1 / 40
    axes = [np.arange(half, end + half, 2 * half) for end in (0.5, 0.5, math.pi)]
    boxes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    while len(boxes):
        assert half > 1e-4
        boxes = boxes[_greatest(derivatives, boxes, half * turns) + remainder * half**2 > limit]
        half /= 2
        boxes = (boxes[:, None] + half * turns).reshape(-1, 3)


def _greatest(derivatives: Derivatives, boxes: Floats, corners: Floats) -> Floats:
    total = np.zeros((len(boxes), len(corners)))
    for vector in derivatives(*boxes.T):
        linear = [v[0][:, None] + sum(np.outer(v[k + 1], corners[:, k]) for k in range(3)) for v in vector]
        total += np.hypot(*linear)
    return np.asarray(total.max(axis=1))


def _weights(x: Floats, y: Floats) -> Iterator[tuple[Floats, Floats, list[list[Floats]]]]:
    """Yield p - c of each corner and its w_c, differentiated i times by x and j times by y at [i][j]."""
    # Fade and its derivatives, from the upper side and from the lower one.
    along = [
        (
            t**3 * (t * (6 * t - 15) + 10),
            30 * (t * t - t) ** 2,
            60 * t * (t - 1) * (2 * t - 1),
            60 * (6 * t * (t - 1) + 1),
        )
        for t in (x, y)
    ]
    for i, j in itertools.product((0, 1), repeat=2):
        a, b = (
            side if far else (1 - side[0], *(-item for item in side[1:]))
            for side, far in zip(along, (i, j), strict=True)
        )
        yield x - i, y - j, [[one * other for other in b] for one in a]


def _first(x: Floats, y: Floats, angle: Floats) -> Iterator[tuple[list[Floats], list[Floats]]]:
    """Yield the components of v_c with their derivatives by x, y and the angle of e."""
    ex, ey = np.cos(angle), np.sin(angle)
    for px, py, w in _weights(x, y):
        one = w[0][0]
        g, turned = w[1][0] * ex + w[0][1] * ey, w[0][1] * ex - w[1][0] * ey
        gx, gy = w[2][0] * ex + w[1][1] * ey, w[1][1] * ex + w[0][2] * ey
        yield (
            [one * ex + g * px, w[1][0] * ex + gx * px + g, w[0][1] * ex + gy * px, turned * px - one * ey],
            [one * ey + g * py, w[1][0] * ey + gx * py, w[0][1] * ey + gy * py + g, one * ex + turned * py],
        )


def _second(x: Floats, y: Floats, angle: Floats) -> Iterator[tuple[list[Floats], list[Floats]]]:
    ex, ey = np.cos(angle), np.sin(angle)
    for px, py, w in _weights(x, y):
        g, turned = w[1][0] * ex + w[0][1] * ey, w[0][1] * ex - w[1][0] * ey
        gx, gy = w[2][0] * ex + w[1][1] * ey, w[1][1] * ex + w[0][2] * ey
        q, qx, qy = (
            w[2 + i][j] * ex * ex + 2 * w[1 + i][1 + j] * ex * ey + w[i][2 + j] * ey * ey
            for i, j in ((0, 0), (1, 0), (0, 1))
        )
        qa = 2 * ((w[0][2] - w[2][0]) * ex * ey + w[1][1] * (ex * ex - ey * ey))
        yield (
            [
                q * px + 2 * g * ex,
                qx * px + q + 2 * gx * ex,
                qy * px + 2 * gy * ex,
                qa * px + 2 * (turned * ex - g * ey),
            ],
            [
                q * py + 2 * g * ey,
                qx * py + 2 * gx * ey,
                qy * py + q + 2 * gy * ey,
                qa * py + 2 * (turned * ey + g * ex),
            ],
        )


def middles() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the middles of two million cells, where values and slopes can be greatest."""
    u, v = (np.indices((450, 450)).reshape(2, -1) + 0.5).astype(float)
    for part in range(10):
        yield u + 450 * part, v - 7000


def test_slope_comes_close_to_its_bound_and_never_passes_it() -> None:
    greatest = 0.0
    for u, v in middles():
        steep = np.hypot(*gradient_noise(u, v, 3, True)[1:])
        top = np.argsort(steep)[-20:].repeat(2500)
        near = DICE.uniform(-0.5, 0.5, (2, top.size))
        around = gradient_noise(u[top] + near[0], v[top] + near[1], 3, True)
        greatest = max(greatest, float(steep.max()), float(np.hypot(*around[1:]).max()))
    assert 0.97 * LIPSCHITZ < greatest <= LIPSCHITZ


def test_gradients_change_almost_as_fast_as_their_bound_and_never_faster() -> None:
    step, greatest = 1e-5, 0.0
    for u, v in itertools.islice(middles(), 1):
        # The greatest is at 0.144 from the middle along both axes, in that direction.
        for x, y in itertools.product((-1, 1), repeat=2):
            before, after = (
                np.array(gradient_noise(u + (0.1445 + far) * x, v + (0.1445 + far) * y, 3, True)[1:])
                for far in (-step, step)
            )
            greatest = max(greatest, float(np.hypot(*(after - before)).max()) / (2 * math.sqrt(2) * step))
    assert 0.95 * CURVATURE < greatest <= CURVATURE


def test_value_comes_close_to_its_bound_and_never_passes_it() -> None:
    assert 0.97 < max(np.abs(gradient_noise(u, v, 4)[0]).max() for u, v in middles()) <= 1
    u, v = DICE.uniform(-1e6, 1e6, (2, 200_000))
    assert np.abs(gradient_noise(u, v, 4)[0]).max() <= 1


def test_is_zero_at_lattice_points_and_zero_in_the_mean() -> None:
    u, v = np.indices((50, 50)).reshape(2, -1).astype(float)
    assert not gradient_noise(u - 20, v - 20, 9)[0].any()
    x, y = DICE.uniform(0, 2000, (2, 400_000))
    value = gradient_noise(x, y, 9)[0]
    assert abs(value.mean()) < 4 * value.std() / math.sqrt(value.size)
    at_one_point = [gradient_noise(np.array([0.4]), np.array([0.7]), seed)[0][0] for seed in range(4000)]
    assert abs(np.mean(at_one_point)) < 4 * np.std(at_one_point) / math.sqrt(4000)


@pytest.mark.parametrize("cell", [0, -7, 2**20, -(2**31) + 1000, 2**31 - 1000])
def test_second_derivatives_are_continuous_across_cells(cell: int) -> None:
    v = np.full(1, 0.37)
    for axis in (0, 1):

        def at(offset: float, axis: int = axis) -> np.ndarray:
            places = (np.full(1, cell + offset), v)
            return np.array(gradient_noise(*(places if axis == 0 else places[::-1]), 5, True)).ravel()

        h = 2.0**-12
        below, here, above = at(-h), at(0.0), at(h)
        assert np.abs(above - below).max() < 3 * LIPSCHITZ * 4 * h
        # One-sided differences of the derivatives would differ where a second derivative jumps.
        assert np.abs((above - here) - (here - below)).max() / h < 0.1


def test_directions_are_unit_and_even() -> None:
    column, row = DICE.integers(0, 2**32, (2, 400_000), dtype=np.uint32)
    east, north = base.directions(column, row)
    length = np.hypot(east, north) / math.sqrt(2)
    assert length.min() > 1 - 1.3e-4
    assert length.max() <= 1
    counts = np.histogram(np.arctan2(north, east), 16)[0] / (len(east) / 16)
    assert np.abs(counts - 1).max() < 0.03
    assert abs(east.mean()) < 0.01
    assert abs((east * north).mean()) < 0.01
    assert abs((east**2 - north**2).mean()) < 0.01


@pytest.mark.parametrize("what", ["column", "row", "seed"])
def test_every_bit_turns_half_of_the_bits(what: str) -> None:
    column, row = DICE.integers(0, 2**32, (2, 20_000), dtype=np.uint32)

    def bits(column: np.ndarray, row: np.ndarray, seed: int) -> np.ndarray:
        east, north = base.directions(base.columns(column, seed), base.rows(row, seed))
        # Where in its quadrant, in 2^-12 of it (nearly), and which quadrant.
        place = np.floor(np.arctan2(abs(north), abs(east)) * (2 / math.pi) * 4096).astype(int)
        return np.stack([east < 0, north < 0, *(place >> k & 1 for k in range(12))])

    before = bits(column, row, 5)
    for bit in range(32):
        flip = np.uint32(1 << bit)
        after = bits(
            column ^ flip if what == "column" else column,
            row ^ flip if what == "row" else row,
            5 ^ int(flip) if what == "seed" else 5,
        )
        assert np.abs((before != after).mean(axis=1) - 0.5).max() < 0.03, bit


@pytest.mark.parametrize(
    "shift",
    [
        (1, 0),
        (0, 1),
        (1, 1),
        (256, 0),
        (0, 65536),
        (2**20, 2**20),
        (2**30, 0),
        (0, 2**30),
        (2**31 - 1, 0),
        (0, 2**31 - 1),
    ],
)
def test_has_no_period(shift: tuple[int, int]) -> None:
    u, v = np.indices((300, 300)).reshape(2, -1) + 0.5 - 2.0**30
    here, there = gradient_noise(u, v, 1)[0], gradient_noise(u + shift[0], v + shift[1], 1)[0]
    # Neighbours share corners, and so are alike a little; others are not.
    assert abs(np.corrcoef(here, there)[0, 1]) < (0.4 if max(shift) == 1 else 0.015)


def test_seeds_are_unrelated() -> None:
    x, y = points(60_000)
    values = [Noise("fbm", 4, 50.0, seed=seed).value(x, y) for seed in (0, 1, 2, 3, 2**31, 2**32 - 1)]
    others = np.abs(np.corrcoef(values) - np.eye(len(values)))
    assert others.max() < 0.02


def test_octaves_are_unrelated() -> None:
    x, y = points(60_000)
    values = [gradient_noise(*_cells(lattice, x, y), lattice.seed)[0] for lattice in Noise("warped", 6, 20.0).lattices]
    assert np.abs(np.corrcoef(values) - np.eye(len(values))).max() < 0.02


def _cells(lattice: Any, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return lattice.xx * x + lattice.xy * y + lattice.u0, lattice.yx * x + lattice.yy * y + lattice.v0


def test_looks_alike_in_all_directions() -> None:
    noise = Noise("fbm", 6, 100.0, seed=8)
    x, y = points(70_000, 3e4)
    here = noise.value(x, y)
    alike = [
        np.mean((noise.value(x + 12 * np.cos(angle), y + 12 * np.sin(angle)) - here) ** 2)
        for angle in np.radians(np.arange(0, 180, 15))
    ]
    assert max(alike) / min(alike) < 1.25


# The sums.


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("about", [0.0, 3e8])
def test_gradient_is_that_of_the_value(kind: Any, about: float) -> None:
    noise = Noise(kind, 4, 100.0, seed=6)
    x, y = points(4000, 1e3, about)
    for kappa in (None, 0.6):
        sample = noise.sample(x, y, kappa=kappa)
        np.testing.assert_array_equal(sample.value, noise.value(x, y, kappa=kappa))
        h = 2.0**-10 if about else 2.0**-13
        east = (noise.value(x + h, y, kappa=kappa) - noise.value(x - h, y, kappa=kappa)) / (2 * h)
        north = (noise.value(x, y + h, kappa=kappa) - noise.value(x, y - h, kappa=kappa)) / (2 * h)
        wrong = (
            np.maximum(abs(east - sample.east), abs(north - sample.north)) / np.hypot(sample.east, sample.north).max()
        )
        # In a crease, and where a weight is cut off, the two sides differ.
        assert np.quantile(wrong, 0.99) < 1e-4
        if kind in ("gradient", "fbm", "warped"):
            assert wrong.max() < 1e-4


@settings(max_examples=60)
@given(noise=noises(), kappa=st.one_of(st.none(), st.floats(0, 1)), about=st.sampled_from([0.0, 1e6]))
def test_bounds_and_slope_bounds_hold(noise: Noise, kappa: float | None, about: float) -> None:
    weights = None if kappa is None else noise.weights(kappa)
    low, high = noise.bounds(weights)
    steepest = noise.lipschitz(weights)
    x, y = points(1500, 40 * noise.wavelength, about)
    for _ in range(3):
        sample = noise.sample(x, y, weights=weights)
        slopes = np.hypot(sample.east, sample.north)
        assert low - 1e-12 <= sample.value.min()
        assert sample.value.max() <= high + 1e-12
        assert slopes.max() <= steepest * (1 + 1e-9)
        # Go on around the steepest places.
        top = np.argsort(slopes)[-30:].repeat(50)
        near = DICE.normal(0, 0.02 * noise.wavelength, (2, top.size))
        x, y = x[top] + near[0], y[top] + near[1]
    distances = np.hypot(np.diff(x), np.diff(y))
    assert (np.abs(np.diff(noise.value(x, y, weights=weights))) <= steepest * distances * (1 + 1e-6) + 1e-9).all()


@settings(max_examples=120)
@given(
    noise=noises(),
    kappa=st.one_of(st.none(), st.floats(0, 1)),
    shape=st.tuples(st.floats(-5, 1), st.floats(-5, 1)),
    about=st.sampled_from([0.0, 1e6]),
    seed=st.integers(0, 99),
)
def test_bounds_in_a_box_hold(
    noise: Noise, kappa: float | None, shape: tuple[float, float], about: float, seed: int
) -> None:
    """Climb towards the steepest, the highest and the lowest places of boxes from 1e-5 to 10 wavelengths."""
    weights = None if kappa is None else noise.weights(kappa)
    dice = np.random.default_rng(seed)
    size = 10 ** np.array(shape)[:, None] * noise.wavelength
    corner = dice.uniform(-50, 50, (2, 1)) * noise.wavelength + about
    west, south, east, north = np.concatenate([corner, corner + size]).ravel().tolist()
    low, high, steepest = noise.bounds_in(west, south, east, north, weights)
    assert noise.bounds(weights)[0] <= low <= high <= noise.bounds(weights)[1]
    assert steepest <= noise.lipschitz(weights)
    place = dice.random((2, 1200))
    place[:, :4] = [[0, 0, 1, 1], [0, 1, 0, 1]]
    for reach in (0.1, 0.02, 0.004):
        sample = noise.sample(*(corner + place * size), weights=weights)
        slopes = np.hypot(sample.east, sample.north)
        assert low - 1e-13 <= sample.value.min()
        assert sample.value.max() <= high + 1e-13
        assert slopes.max() <= steepest * (1 + 1e-12) + 1e-13 / noise.wavelength
        best = np.concatenate([np.argsort(item)[-10:] for item in (slopes, sample.value, -sample.value)]).repeat(40)
        place = np.clip(place[:, best] + dice.normal(0, reach, (2, best.size)), 0, 1)


@pytest.mark.parametrize(
    ("kind", "near", "wide"),
    [("gradient", 0.8, 0.8), ("fbm", 0.55, 0.45), ("billow", 0.5, 0.45), ("ridged", 0.38, 0.22),
     ("hybrid", 0.45, 0.15), ("warped", 0.45, 0.35)],
)  # fmt: skip
def test_bounds_in_a_small_box_are_tight(kind: Any, near: float, wide: float) -> None:
    """How much of the bound of the slope is reached in boxes of 0.02 and of 0.1 wavelengths, with 8 octaves."""
    noise = Noise(kind, 8, 1000.0, seed=3)
    for size, least in ((20.0, near), (100.0, wide)):
        shares = []
        for x, y in DICE.uniform(-1e5, 1e5, (20, 2)):
            low, high, steepest = noise.bounds_in(x, y, x + size, y + size)
            sample = noise.sample(x + DICE.uniform(0, size, 3000), y + DICE.uniform(0, size, 3000))
            shares.append(np.hypot(sample.east, sample.north).max() / steepest)
            assert high - low <= math.sqrt(2) * size * steepest * (1 + 1e-9)
        assert np.median(shares) > least


def test_bounds_in_boxes_of_all_sizes() -> None:
    noise = Noise("fbm", 6, 100.0, seed=4)
    everywhere = (*noise.bounds(), noise.lipschitz())
    for box in ((-math.inf, -math.inf, math.inf, math.inf), (0.0, -math.inf, 1.0, math.inf), (-1e9, -1e9, 1e9, 1e9),
                (-1e308, 0.0, 1e308, 1.0), (1e13, 1e13, 1e13 + 1, 1e13 + 1)):  # fmt: skip
        assert noise.bounds_in(*box) == everywhere
    for x, y in ((3.0, 4.0), (-7e5, 2e6)):
        sample = noise.sample(x, y)
        low, high, steepest = noise.bounds_in(x, y, x, y)
        assert low <= sample.value <= high <= low + 1e-9
        assert np.hypot(sample.east, sample.north) <= steepest <= 1.0001 * np.hypot(sample.east, sample.north)
    assert noise.bounds_in(0.0, 0.0, 1.0, 1.0, np.zeros(6)) == (0.0, 0.0, 0.0)
    # A box inside another.
    outer, inner = noise.bounds_in(0.0, 0.0, 64.0, 64.0), noise.bounds_in(20.0, 30.0, 24.0, 34.0)
    assert outer[0] <= inner[0]
    assert inner[1] <= outer[1]
    assert inner[2] <= outer[2]


@given(noise=noises(), kappas=st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_bounds_of_more_detail_hold_for_less(noise: Noise, kappas: tuple[float, float]) -> None:
    less, more = (noise.weights(kappa) for kappa in sorted(kappas))
    assert (less <= more).all()
    assert noise.bounds(more)[0] - 1e-15 <= noise.bounds(less)[0]
    assert noise.bounds(less)[1] <= noise.bounds(more)[1] + 1e-15
    assert noise.lipschitz(less) <= noise.lipschitz(more) * (1 + 1e-12)
    assert noise.bounds(noise.weights(1.0)) == noise.bounds()
    assert noise.bounds()[1] == pytest.approx(1)


@settings(max_examples=40)
@given(noise=noises(), kappa=st.floats(0, 0.999))
def test_detail_comes_without_a_jump(noise: Noise, kappa: float) -> None:
    x, y = points(300, 10 * noise.wavelength)
    before, after = noise.value(x, y, kappa=kappa), noise.value(x, y, kappa=kappa + 1e-6)
    # db/dkappa is at most 1.73 over the length of an interval, at least 0.1 here or 1/6 by default; weights pass it on.
    assert (
        np.abs(after - before).max()
        < 1e-6 * 20 * (1 + noise.warp * noise.lipschitz() * noise.wavelength) * (1 + noise.feedback * 2) ** noise.count
    )


@pytest.mark.parametrize("kind", KINDS)
def test_kappa_is_level_at_0_and_everything_at_1(kind: Any) -> None:
    noise = Noise(kind, 5, 70.0)
    x, y = points(500)
    assert not noise.value(x, y, kappa=0).any()
    np.testing.assert_array_equal(noise.value(x, y, kappa=1), noise.value(x, y))
    # At 3/5 the first three octaves are there and the others are not, whatever stands for one of each point.
    three = noise.value(x, y, weights=[1, 1, 1, 0, 0][: noise.count])
    if kind != "gradient":
        np.testing.assert_allclose(noise.value(x, y, kappa=0.6), three, atol=1e-12)
    kappa = np.linspace(0, 1, 500)
    each = noise.sample(x, y, kappa=kappa)
    for index in (0, 150, 499):
        one = noise.sample(x[index], y[index], kappa=kappa[index])
        assert [float(part[index]) for part in each] == pytest.approx([float(part) for part in one], abs=1e-15)


def test_blocks_and_shapes_do_not_matter() -> None:
    noise = Noise("ridged", 3, 40.0)
    x, y = np.linspace(0, 500, 321), np.linspace(0, 300, 170)[:, None]
    whole = noise.sample(x, y)
    assert whole.value.shape == (170, 321)
    part = noise.sample(x[200:], y[60:90])
    for one, other in zip(whole, part, strict=True):
        np.testing.assert_array_equal(one[60:90, 200:], other)
    flat = noise.value(*(array.ravel() for array in np.broadcast_arrays(x, y)))
    np.testing.assert_array_equal(flat.reshape(170, 321), whole.value)
    assert noise.value(3.0, 4.0).shape == ()
    assert noise.sample([], []).value.shape == (0,)
    assert noise.value(np.zeros((2, 3, 0)), 1.0).shape == (2, 3, 0)
    weights = np.ones((3, 170, 321))
    np.testing.assert_array_equal(noise.value(x, y, weights=weights), whole.value)


def test_degenerate_parameters() -> None:
    x, y = points(400)
    one = Noise("fbm", 1, 60.0, seed=2).value(x, y)
    np.testing.assert_array_equal(Noise("fbm", 7, 60.0, gain=0, seed=2).value(x, y), one)
    np.testing.assert_array_equal(Noise("gradient", 7, 60.0, seed=2).value(x, y), one)
    np.testing.assert_array_equal(Noise("warped", 1, 60.0, warp=0, seed=2).value(x, y), one)
    np.testing.assert_allclose(Noise("billow", 1, 60.0, seed=2).value(x, y), abs(one))
    np.testing.assert_allclose(Noise("ridged", 1, 60.0, seed=2).value(x, y), (1 - abs(one)) ** 2)
    for kind in KINDS:
        full = Noise(kind, MOST, 1e9, lacunarity=2.0, feedback=0.0)
        assert np.isfinite(full.value(x, y)).all()
        assert math.isfinite(full.lipschitz())


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "white"},
        {"octaves": 0},
        {"octaves": MOST + 1},
        {"wavelength": 0.0},
        {"wavelength": math.nan},
        {"wavelength": math.inf},
        {"lacunarity": 0.9},
        {"lacunarity": math.nan},
        {"gain": -0.1},
        {"gain": math.nan},
        {"seed": -1},
        {"seed": 2**32},
        {"feedback": math.nan},
        {"warp": -1.0},
        {"octaves": 2, "intervals": ((0.0, 1.0),)},
        {"octaves": 1, "intervals": ((0.5, 0.5),)},
        {"octaves": 1, "intervals": ((math.nan, 1.0),)},
    ],
)
def test_wrong_parameters_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(reversed(wrong)).removesuffix("s")):
        Noise(**wrong)


def test_wrong_points_are_refused() -> None:
    noise = Noise("fbm", 2, 10.0)
    for x in (math.nan, math.inf, 2.0**31 * 10, -(2.0**31) * 10):
        with pytest.raises(ValueError, match="coordinates"):
            noise.value([0.0, x], [0.0, 0.0])
        with pytest.raises(ValueError, match="coordinates"):
            noise.origins(x, 0.0)
        with pytest.raises(ValueError, match="coordinates"):
            origins_of([noise, noise], np.array([0.0, x]), np.zeros(2))
    for kappa in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match="kappa"):
            noise.value(0.0, 0.0, kappa=kappa)
    for weights in ([0.5, 1.5], [math.nan, 0], [1.0], [[1.0, 1.0]]):
        with pytest.raises(ValueError, match="weights"):
            noise.value(0.0, 0.0, weights=weights)
    with pytest.raises(ValueError, match="not both"):
        noise.value(0.0, 0.0, kappa=1, weights=[1, 1])


def test_origins_of_many_are_those_of_each() -> None:
    several = [Noise("warped", 3, 10.0), Noise("gradient", 1, 77.0), Noise("fbm", 5, 5.0)]
    x, y = np.array([1e5, -3.0, 7e7]), np.array([0.0, 12.5, -8e6])
    each = [noise.origins(*place).ravel() for noise, *place in zip(several, x, y, strict=True)]
    np.testing.assert_array_equal(origins_of(several, x, y), np.concatenate(each))
