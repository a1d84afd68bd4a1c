"""Growth of river networks: an L-system rewritten step by step, laid out so that no link meets another.

The string says which links there are, the layout where they lie.  One step rewrites all links of all networks at once:

1. The interior links of a production divide the old link.  An exterior link is stretched first (by 1/P), and division
   points move sideways, towards the tributary that joins there.  What then meets another river is straightened and
   shrinks back to where it was, which cannot cross since it did not before.
2. Branches look for room (`crossings.place_branches`): they bend, are shortened, or are left out with all that would
   have grown from them.  Drawn lines hold their places from the start; of two branches that want the same room the one
   on the older stem is first.
3. An interior link with nothing left above it is exterior again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi
from typing import Any

import numpy as np
import numpy.typing as npt

from nodegraph_hydrology.crossings import Domain, Segments, crossings, place_branches
from nodegraph_hydrology.drawn_stem import Stems
from nodegraph_hydrology.lsystem_rules import LString, Rule, rewrite
from nodegraph_hydrology.turtle import CLOCKWISE, CLOSE, COUNTER, OPEN, predecessors, structure

Floats = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

INTERIOR, EXTERIOR, DORMANT = (ord(symbol) for symbol in "FGX")


@dataclass(frozen=True)
class Style:
    """How a network is laid out.

    Attributes:
        ratio: length of a link over that of its predecessor.
        stretch: length of the stem that replaces an exterior link, over that of the link.
        angle: theta, radians.
        jitter: standard deviation of the turns, radians.
        sinuosity: greatest displacement of a midpoint, over the length that it divides.
    """

    ratio: float
    stretch: float
    angle: float
    jitter: float
    sinuosity: float


@dataclass(frozen=True)
class Growth:
    """Networks in growth: a string, and for each of its links in order (node numbers are link numbers).

    Attributes:
        string: ``[G][G]...``, one bracket per line at first.
        code: (n,) symbol of each link.
        parent: (n,) the link below, -1 at an estuary.
        line: (n,) the drawn line that it belongs to.
        tip: (n, 2) upper end; the base is that of the parent, or the begin of the line.
        along: (n,) for links of a main stem the distance of the tip on the drawn line; NaN for others.
        born: (n,) step at which its stem began, 0 for main stems.
        size: (n,) nominal length, m.
    """

    string: LString
    code: Index
    parent: Index
    line: Index
    tip: Floats
    along: Floats
    born: Index
    size: Floats

    def base(self, stems: Stems) -> Floats:
        """Return the lower end of each link."""
        below = self.tip[self.parent]
        return np.where((self.parent >= 0)[:, None], below, stems.points[stems.offsets[self.line]])

    def take(self, keep: Flags) -> Growth:
        """Return what is left when some links are dropped, each of them alone in its bracket."""
        if keep.all():
            return self
        nested = structure(self.string)
        drawn = np.flatnonzero(np.isin(self.string.codes, (INTERIOR, EXTERIOR, DORMANT)))
        gone = np.zeros(len(self.string) + 1, np.bool_)
        gone[nested.opening[drawn[~keep]]] = True
        number = np.append(np.cumsum(keep) - 1, -1)
        left = {name: getattr(self, name)[keep] for name in ("code", "line", "tip", "along", "born", "size")}
        return Growth(self.string.take(~gone[nested.opening]), parent=number[self.parent[keep]], **left)


def seedlings(stems: Stems, depths: Index, style: Style) -> Growth:
    """Return one exterior link per line, so long that its network ends with the line after that many steps."""
    count = len(depths)
    q = style.ratio
    size = stems.lengths / (style.stretch * (1 - q**depths) / (1 - q) + q**depths)
    code = np.full(count, DORMANT, np.int64)
    string = LString(np.tile(np.array([OPEN, DORMANT, CLOSE], np.uint32), count), np.full((3 * count, 4), np.nan))
    line = np.arange(count)
    zero = np.zeros(count, np.int64)
    return Growth(string, code, zero - 1, line, stems.at(line, size), size.copy(), zero, size)


def grow(
    stems: Stems,
    depths: Index,
    rules: tuple[Rule, ...],
    style: Style,
    domain: Domain,
    rng: np.random.Generator,
    report: Callable[[float], Any],
) -> Growth:
    """Return the networks after the steps of each line; those of fewer steps begin later."""
    state = seedlings(stems, depths, style)
    fixed = stems.segments()
    steps = int(depths.max())
    for step in range(steps):
        report(step / steps)
        state = _woken(state, depths, steps - step)
        state = _step(state, step + 1, stems, fixed, rules, style, domain, rng, step == steps - 1)
    return state


def _woken(state: Growth, depths: Index, left: int) -> Growth:
    codes = state.string.codes.copy()
    places = np.flatnonzero(np.isin(codes, (INTERIOR, EXTERIOR, DORMANT)))
    code = np.where((state.code == DORMANT) & (depths[state.line] >= left), EXTERIOR, state.code)
    codes[places] = code
    return replace(state, string=LString(codes, state.string.values), code=code)


def _step(
    old: Growth,
    step: int,
    stems: Stems,
    fixed: Segments,
    rules: tuple[Rule, ...],
    style: Style,
    domain: Domain,
    rng: np.random.Generator,
    last: bool,
) -> Growth:
    before = structure(old.string)
    drawn_before = np.isin(old.string.codes, (INTERIOR, EXTERIOR, DORMANT))
    string, source = rewrite(old.string, rules, rng)
    nested = structure(string)
    drawn = np.isin(string.codes, (INTERIOR, EXTERIOR, DORMANT))
    places = np.flatnonzero(drawn)
    number = np.append(np.cumsum(drawn) - 1, -1)
    parent = number[predecessors(string, nested, drawn)[places]]
    origin = (np.cumsum(drawn_before) - 1)[source[places]]
    code = string.codes[places].astype(np.int64)
    stem = nested.depth[places] == before.depth[source[places]]
    changed = np.bincount(origin, minlength=len(old.code)) > 1
    turns = _turns(string, nested.opening)[places]

    # Where along its old link each piece of a stem ends, and the leaders, whose way is drawn.
    pieces = np.bincount(origin[stem], minlength=len(old.code))
    rank = np.cumsum(stem) - 1
    share = (rank - (np.cumsum(pieces) - pieces)[origin] + 1) / pieces[origin]
    leading = np.isfinite(old.along)
    outer = old.code == EXTERIOR
    size = old.size * np.where(changed, style.ratio, 1.0)
    low = np.where(old.parent >= 0, np.nan_to_num(old.along[old.parent]), 0.0)
    high = old.along + np.where(outer & changed, (style.stretch - 1) * old.size, 0.0)
    along = np.where(stem & leading[origin], low[origin] + share * (high - low)[origin], np.nan)
    fork = ~stem & outer[origin] & (share >= 1)
    first = (
        fork & leading[origin] & (np.concatenate([[-1], origin[:-1]]) == origin) & np.concatenate([[True], stem[:-1]])
    )
    along[first] = (high + size)[origin[first]]

    state = Growth(
        string,
        code,
        parent,
        old.line[origin],
        np.full((len(places), 2), np.nan),
        along,
        np.where(stem | first, old.born[origin], step),
        size[origin],
    )
    state = _lay_stems(state, old, origin, stem, share, outer & changed, turns, stems, fixed, style, domain, rng)
    return _lay_branches(state, ~stem & ~first, turns, old.born[origin], stems, fixed, style, domain, rng, last)


def _turns(string: LString, opening: Index) -> Floats:
    """Return for each module the turns from the begin of its bracket to its end, counter-clockwise."""
    signs = (string.codes == COUNTER).astype(np.float64) - (string.codes == CLOCKWISE)
    inside = opening >= 0
    total = np.bincount(opening[inside], weights=signs[inside], minlength=len(string))
    return np.where(inside, total[opening], 0.0)


def _lay_stems(
    state: Growth,
    old: Growth,
    origin: Index,
    stem: Flags,
    share: Floats,
    grows: Flags,
    turns: Floats,
    stems: Stems,
    fixed: Segments,
    style: Style,
    domain: Domain,
    rng: np.random.Generator,
) -> Growth:
    """Divide the old links; straighten and shrink back those that would then meet something."""
    base, leg = old.base(stems), old.tip - old.base(stems)
    leads = np.isfinite(state.along)
    free = np.flatnonzero(stem & ~leads)
    normal = np.stack([-leg[:, 1], leg[:, 0]], axis=1)
    # The tributary that joins at a division point is the next branch; the stem bends towards it.
    branches = np.flatnonzero(~stem)
    side = np.zeros(len(stem))
    side[state.parent[branches]] = np.sign(turns[branches])
    side = np.where(rng.random(len(stem)) < 0.2, -side, side)
    swing = side * style.sinuosity * rng.uniform(0.3, 1.0, len(stem))
    count = np.bincount(origin[stem], minlength=len(old.code))[origin]
    swing *= np.where(share < 1, 2 / np.maximum(count, 2), 0.0)
    bent = np.ones(len(old.code), np.bool_)
    while True:
        stretch = np.where(grows & bent, style.stretch, 1.0)[origin[free]]
        shift = np.where(bent[origin[free]], swing[free], 0.0)
        tip = (
            base[origin[free]]
            + (share[free] * stretch)[:, None] * leg[origin[free]]
            + shift[:, None] * normal[origin[free]]
        )
        positions = state.tip.copy()
        positions[free] = tip
        positions[leads] = stems.at(state.line[leads], state.along[leads])
        state = replace(state, tip=positions)
        segments = Segments(state.base(stems)[free], tip)
        wrong = ~domain.holds(segments)
        hit = crossings(fixed.joined(segments), len(fixed)).ravel() - len(fixed)
        wrong[hit[hit >= 0]] = True
        wrong &= bent[origin[free]]
        if not wrong.any():
            return state
        bent[origin[free[wrong]]] = False


def _lay_branches(
    state: Growth,
    branch: Flags,
    turns: Floats,
    age: Index,
    stems: Stems,
    fixed: Segments,
    style: Style,
    domain: Domain,
    rng: np.random.Generator,
    last: bool,
) -> Growth:
    """Place the new branches, and drop those without room."""
    base = state.base(stems)
    new, laid = np.flatnonzero(branch), np.flatnonzero(~branch & ~np.isfinite(state.along))
    heading = np.arctan2(*(state.tip - base).T[::-1])
    above = np.full(len(heading), -1, np.int64)
    goes_on = np.flatnonzero(~branch & (state.parent >= 0))
    above[state.parent[goes_on]] = goes_on
    at = state.parent[new]
    # At a division point the stem's direction is the mean of the reaches below and above.
    upper = np.where(above[at] >= 0, heading[above[at]], heading[at])
    stem = heading[at] + ((upper - heading[at] + pi) % (2 * pi) - pi) / 2
    turn = turns[new] * style.angle
    turn += np.clip(rng.normal(0, 1, len(new)), -2, 2) * style.jitter
    rank = np.empty(len(new), np.int64)
    rank[np.lexsort((np.abs(turns[new]), age[new]))] = np.arange(len(new))
    present = fixed.joined(Segments(base[laid], state.tip[laid]))
    tip, placed = place_branches(base[new], stem, turn, state.size[new], rank, present, domain, last=last)
    positions = state.tip.copy()
    positions[new] = tip
    keep = np.ones(len(branch), np.bool_)
    keep[new] = placed
    size = state.size.copy()
    size[new] = np.where(placed, np.hypot(*(tip - base[new]).T), size[new])
    return _ends_exterior(replace(state, tip=positions, size=size).take(keep))


def _ends_exterior(state: Growth) -> Growth:
    """Make interior links exterior that have lost all above them."""
    sources = np.bincount(state.parent[state.parent >= 0], minlength=len(state.parent)) == 0
    code = np.where(sources & (state.code == INTERIOR), EXTERIOR, state.code)
    codes = state.string.codes.copy()
    codes[np.isin(codes, (INTERIOR, EXTERIOR, DORMANT))] = code
    return replace(state, string=LString(codes, state.string.values), code=code)
