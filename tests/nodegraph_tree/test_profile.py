"""Cross-sections: piecewise quadratic, C1, through their points, with exact extremes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph_tree.profile import difference, evaluate, extremes, level, mixed, section, steepest_chord, stretched

_GAPS = st.lists(st.floats(0.01, 100), min_size=1, max_size=8)
_HEIGHTS = st.lists(st.floats(-100, 100), min_size=8, max_size=8)


@st.composite
def sections(draw, signed=True):
    gaps = draw(_GAPS)
    x = np.cumsum(gaps) - (draw(st.floats(0, sum(gaps))) if signed else gaps[0])
    return [(float(a), float(b)) for a, b in zip(x, draw(_HEIGHTS), strict=False)]


@given(sections(), st.sampled_from(["smooth", "straight"]))
def test_a_section_goes_through_its_points_and_stays_between_them(points, shape) -> None:
    made = section(points, shape)
    low, high = min(z for _, z in points), max(z for _, z in points)
    for x, z in points:
        side = made.left if x >= 0 else made.right
        assert evaluate(side, np.array([abs(x)]))[0][0] == pytest.approx(z, abs=1e-6)
    d = np.linspace(0, 900, 2001)
    for side in (made.left, made.right):
        value, _ = evaluate(side, d)
        assert value.min() >= low - 1e-6
        assert value.max() <= high + 1e-6
    assert made.left[0, 1] == pytest.approx(made.right[0, 1], abs=1e-6)


@given(sections())
def test_smooth_sections_have_one_slope_where_pieces_meet(points) -> None:
    made = section(points)
    for side in (made.left, made.right):
        at = side[1:, 0]
        steep = 1 + np.abs(side[:, 2:]).max()
        before = evaluate(side, np.nextafter(at, 0))
        after = evaluate(side, at)
        np.testing.assert_allclose(before[0], after[0], atol=1e-6 * steep)
        np.testing.assert_allclose(before[1], after[1], atol=1e-6 * steep)
    assert evaluate(made.left, np.zeros(1))[1] == pytest.approx(-evaluate(made.right, np.zeros(1))[1], abs=1e-6 * steep)


@given(sections(), sections(), st.floats(0, 300), st.floats(0, 300), st.floats(0, 1))
def test_extremes_differences_and_mixtures(points, others, near, wide, share) -> None:
    a, b = section(points), section(others)
    d = np.linspace(near, near + wide, 301)
    value, slope = evaluate(a.left, d)
    low, high, steep = extremes(a.left, near, near + wide)
    assert low <= value.min() + 1e-9
    assert high >= value.max() - 1e-9
    assert steep >= np.abs(slope).max() * (1 - 1e-9)
    other = evaluate(b.left, d)[0]
    np.testing.assert_allclose(evaluate(difference(a.left, b.left), d)[0], value - other, atol=1e-6)
    np.testing.assert_allclose(evaluate(mixed(a, b, share).left, d)[0], (1 - share) * value + share * other, atol=1e-6)
    np.testing.assert_allclose(evaluate(stretched(a, 2.0, 3.0).left, 2 * d)[0], 3 * value, atol=1e-6)
    apart = difference(a.left, a.right)
    own = np.abs(evaluate(apart, d)[0])
    assert (own <= (steepest_chord(apart, near, near + wide) + 1e-9) * d + 1e-6).all()


def test_one_side_is_mirrored_and_level_is_level() -> None:
    assert section([(0, 0), (5, 2)]).symmetric
    assert np.array_equal(section([(-5, 2), (0, 0)]).left, section([(0, 0), (5, 2)]).left)
    assert not section([(-5, 1), (0, 0), (5, 2)]).symmetric
    assert evaluate(level(3.0).left, np.array([0.0, 9.0]))[0].tolist() == [3.0, 3.0]
    assert evaluate(section([(4.0, 7.0)]).left, np.array([0.0, 9.0]))[0].tolist() == [7.0, 7.0]


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        ([], "one at least"),
        ([(0, 0, 0)], "distance, height"),
        ([(0, 0), (0, 1)], "rise"),
        ([(0, float("nan"))], "finite"),
    ],
)
def test_what_makes_no_section_is_refused(points, problem) -> None:
    with pytest.raises(ValueError, match=problem):
        section(points)
