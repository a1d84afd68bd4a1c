"""Which boxes meet another: against asking each."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph_tree.box_index import GROUP, BoxIndex
from nodegraph_tree.function import EVERYWHERE, NOWHERE, Box

_EDGE = st.sampled_from([-math.inf, -3.0, -1.0, 0.0, 0.5, 1.0, 2.0, 7.0, math.inf])
_BOXES = st.builds(Box, _EDGE, _EDGE, _EDGE, _EDGE)


@given(st.lists(_BOXES, max_size=3 * GROUP), _BOXES)
def test_it_finds_what_meets(boxes: list[Box], box: Box) -> None:
    found = BoxIndex(boxes).meeting(box).tolist()
    assert found == [number for number, item in enumerate(boxes) if item.meets(box)]


@pytest.mark.parametrize("count", [0, 1, GROUP, GROUP + 1, 5000])
def test_it_finds_what_meets_among_many(count: int) -> None:
    dice = np.random.default_rng(count)
    corners = dice.uniform(0, 1000, (count, 2))
    sizes = dice.exponential(10, (count, 2))
    boxes = [Box(*row) for row in np.concatenate([corners, corners + sizes], 1).tolist()]
    index = BoxIndex(boxes)
    for _ in range(20):
        west, south = dice.uniform(-50, 1000, 2).tolist()
        box = Box(west, south, west + 60, south + 30)
        assert index.meeting(box).tolist() == [number for number, item in enumerate(boxes) if item.meets(box)]
    assert index.meeting(EVERYWHERE).tolist() == list(range(count))
    assert not len(index.meeting(NOWHERE))
