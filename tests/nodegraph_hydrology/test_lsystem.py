"""L-systems: against a plain rewriting of strings and a plain turtle, and the arithmetic of the river rules."""

from __future__ import annotations

from math import cos, radians, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodegraph_hydrology.lsystem import length_ratio, lsystem, network_rules, river_rules, tributaries
from nodegraph_hydrology.lsystem_rules import parse_rules, parse_string, rewrite


def grown(axiom, rules, iterations, **more):
    return lsystem(axiom=axiom, rules=tuple(rules), iterations=iterations, **more)


def plain_turtle(text, step, angle, heading=90.0):
    """Segments as a person would read the string, symbol by symbol."""
    x = y = 0.0
    stack, segments = [], []
    for symbol in text:
        if symbol in "FG":
            nx, ny = x + step * cos(radians(heading)), y + step * sin(radians(heading))
            segments.append((x, y, nx, ny))
            x, y = nx, ny
        elif symbol == "f":
            x, y = x + step * cos(radians(heading)), y + step * sin(radians(heading))
        elif symbol in "+-":
            heading += angle if symbol == "-" else -angle
        elif symbol == "|":
            heading += 180
        elif symbol == "[":
            stack.append((x, y, heading))
        elif symbol == "]":
            x, y, heading = stack.pop()
    return np.array(segments).reshape(-1, 4)


def segments_of(lines):
    parts = [np.concatenate([line[:-1], line[1:]], axis=1) for line in lines.lines()]
    return np.concatenate(parts) if parts else np.zeros((0, 4))


def in_order(segments):
    return segments[np.lexsort(np.round(segments, 6).T)]


balanced = st.recursive(
    st.text("FGf+-|X", max_size=6), lambda inner: st.builds("{}[{}]{}".format, inner, inner, inner), max_leaves=12
).filter(bool)


@given(balanced)
def test_turtle_agrees_with_a_plain_one(text):
    got = segments_of(grown(text, [], 0, step=1, scale=1, angle=35).lines)
    want = plain_turtle(text, 1, 35)
    assert len(got) == len(want)
    np.testing.assert_allclose(in_order(got), in_order(want), atol=1e-6)


@given(balanced, st.dictionaries(st.sampled_from("FGX"), balanced, max_size=3), st.integers(0, 3))
@settings(max_examples=50)
def test_rewriting_agrees_with_replacing_in_a_string(axiom, successors, iterations):
    want = axiom
    for _ in range(iterations):
        want = "".join(successors.get(symbol, symbol) for symbol in want)
        if len(want) > 20_000:
            return
    rules = [f"{symbol} -> {text}" for symbol, text in successors.items()]
    assert grown(axiom, rules, iterations, step=1e-3, scale=1).string == want


def test_known_curves_close():
    koch = grown("F-F-F-F", ["F -> F-F+F+FF-F-F+F"], 3, angle=90, scale=0.25, step=1)
    assert len(koch.lines) == 1
    assert len(koch.lines.points) == 4 * 8**3 + 1
    np.testing.assert_allclose(koch.lines.points[0], koch.lines.points[-1], atol=1e-9)


def test_parameters_and_conditions():
    tree = grown("A(1)", ["A(s) : s > 0.3 and not s > 5 -> F(s*2)[+(25)A(s/2)]A(s**2 - 0.1)"], 2)
    assert tree.string.startswith("F(2)[+(25)F(1)[+(25)A(0.25)]A(0.15)]F(1.8)[")
    assert tree.lines.lengths().sum() == pytest.approx(2 + 1 + 1.8)


def test_weights_are_chances():
    rules = parse_rules(["F -> A @ 1", "F -> B @ 3"])
    string, _ = parse_string("F" * 20_000)
    new, origin = rewrite(string, rules, np.random.default_rng(1))
    assert (new.codes == ord("B")).mean() == pytest.approx(0.75, abs=0.02)
    assert (origin == np.arange(20_000)).all()


@pytest.mark.parametrize(
    "rule",
    [
        "F", "-> F", "[ -> F", "F -> [F", "F -> F]", "F(s -> F", "F(s) -> F(t)", "F(s) -> F(s.real)", "F -> F @ 0",
        "F(s) -> F(__import__('os'))", "F(s) : s = 1 -> F", "F -> F @ x", "F(s) -> F(s, 1, 2, 3, 4)", "F(s,s) -> F",
        "F(s) -> F((lambda: 1)())", "F(s) -> F('a')", "F(s) : [1 for s in s] -> F",
    ],
)  # fmt: skip
def test_bad_rules_are_refused_in_a_sentence(rule):
    with pytest.raises(ValueError, match=r".+"):
        grown("F(1)F", [rule], 2)


def test_growth_without_bound_is_refused():
    with pytest.raises(ValueError, match="over 5000000"):
        grown("F", ["F -> FFFFFFFFFFFFFFFF"], 30)
    with pytest.raises(ValueError, match="not finite"):
        grown("A(1)", ["A(s) -> A(1/(s-1))"], 2)
    with pytest.raises(ValueError, match="range of numbers"):
        grown("F", [], 60, step=1e300, scale=10)


# River networks.


def links(text):
    """The tree of a river string as parents of drawn symbols, by a stack."""
    parent, current, stack = [], -1, []
    for symbol in text:
        if symbol in "FG":
            parent.append(current)
            current = len(parent) - 1
        elif symbol == "[":
            stack.append(current)
        elif symbol == "]":
            current = stack.pop()
    return parent


def streams(parent):
    """Numbers of streams by order, and of side tributaries (i, j): order i into order j."""
    children = [[] for _ in parent]
    for node, below in enumerate(parent):
        if below >= 0:
            children[below].append(node)
    order = [0] * len(parent)
    counts, sides = {}, {}
    for node in reversed(range(len(parent))):
        above = sorted((order[child] for child in children[node]), reverse=True)
        assert len(above) <= 2, "a node where more than two arrive"
        order[node] = 1 if not above else above[0] + (len(above) > 1 and above[0] == above[1])
        if not above or order[node] > above[0]:
            counts[order[node]] = counts.get(order[node], 0) + 1
        elif len(above) > 1:
            sides[above[1], order[node]] = sides.get((above[1], order[node]), 0) + 1
    return counts, sides


@pytest.mark.parametrize(("phi", "growth", "factor"), [(2, 4.0, 5), (3, 5.303, 5), (4, 6.562, 4)])
def test_link_counts_grow_by_phi_plus_r_plus_one(phi, growth, factor):
    r = tributaries(phi, "plane_filling")
    assert phi + r + 1 == pytest.approx(growth, abs=1e-3)
    assert 1 / length_ratio(phi) == pytest.approx(r + 1)
    rules = network_rules(phi, "plane_filling")
    ratios = []
    for seed in range(12):
        sizes = [sum(grown("G", rules, n, seed=seed).string.count(s) for s in "FG") for n in (factor, factor + 1)]
        ratios.append(sizes[1] / sizes[0])
    assert np.mean(ratios) == pytest.approx(growth, rel=0.02)


@pytest.mark.parametrize(("phi", "steps"), [(2, 6), (3, 5), (4, 5)])
@pytest.mark.parametrize("growth", ["plane_filling", "printed"])
def test_tokunaga_and_bifurcation_ratios_are_those_of_theory(phi, steps, growth):
    r = tributaries(phi, growth)
    counts, sides = {}, {}
    for seed in range(8):
        one, two = streams(links(grown("G", network_rules(phi, growth), steps, seed=seed).string))
        assert max(one) == steps + 1
        for total, part in ((counts, one), (sides, two)):
            for key, number in part.items():
                total[key] = total.get(key, 0) + number
    # Where enough streams of the higher order are there to tell.
    for k, want in enumerate([phi - 1, phi * r, phi * r * (r + 1)], start=1):
        pairs = [(j - k, j) for j in counts if j > k and counts[j] >= 40]
        assert pairs
        got = sum(sides.get(pair, 0) for pair in pairs) / sum(counts[j] for _, j in pairs)
        assert got == pytest.approx(want, rel=0.05), f"T_{k}"
    growth_factor = phi + r + 1
    exteriors = [(phi * growth_factor**t + r) / (phi + r) for t in range(steps + 1)]
    for order in range(1, 4):
        want = exteriors[steps + 1 - order] / exteriors[steps - order]
        assert counts[order] / counts[order + 1] == pytest.approx(want, rel=0.05)


def test_rules_can_be_listed_and_used():
    text = river_rules(generator=3)
    assert text.count("->") == 6
    assert sum(rule.weight for rule in parse_rules(text.split("\n")) if rule.symbol == ord("F")) == pytest.approx(1)
    assert grown("G", text.split("\n"), 2).string.count("G") > 4
