"""Orders, links, distances and basins, against plain recursion and networkx."""

from __future__ import annotations

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodegraph_hydrology import topology as tp


@st.composite
def forests(draw):
    """Every node flows to an earlier one or nowhere, then the numbers are shuffled."""
    count = draw(st.integers(1, 60))
    reach = draw(st.integers(1, 60))
    down = [-1] + [draw(st.integers(max(-1, i - reach), i - 1)) for i in range(1, count)]
    mix = np.random.default_rng(draw(st.integers(0, 99))).permutation(count)
    result = np.full(count, -1, np.int32)
    result[mix] = [mix[d] if d >= 0 else -1 for d in down]
    return result


def plain(down):
    """Everything by walking a networkx graph, one node at a time."""
    graph = nx.DiGraph()
    graph.add_nodes_from(range(len(down)))
    graph.add_edges_from((i, int(d)) for i, d in enumerate(down) if d >= 0)
    strahler, shreve, head = {}, {}, {}
    for node in nx.topological_sort(graph):
        above = sorted((strahler[i] for i in graph.predecessors(node)), reverse=True)
        strahler[node] = 1 if not above else above[0] + (len(above) > 1 and above[0] == above[1])
        shreve[node] = sum(shreve[i] for i in graph.predecessors(node)) if above else 1
        single = list(graph.predecessors(node))
        head[node] = head[single[0]] if len(single) == 1 else node
    outlet, far = {}, {}
    for node in reversed(list(nx.topological_sort(graph))):
        below = int(down[node])
        outlet[node] = node if below < 0 else outlet[below]
        far[node] = 0 if below < 0 else far[below] + 1
    return [[table[i] for i in range(len(down))] for table in (strahler, shreve, head, outlet, far)]


@given(forests())
def test_agrees_with_plain_recursion(down):
    strahler, shreve, head, outlet, far = plain(down)
    assert tp.strahler_order(down).tolist() == strahler
    assert tp.shreve_magnitude(down).tolist() == shreve
    assert tp.link_heads(down).tolist() == head
    assert tp.basins(down).tolist() == outlet
    assert tp.hops(down).tolist() == far
    rank = np.argsort(tp.upstream_order(down))
    flows = down >= 0
    assert (rank[flows] > rank[down[flows]]).all()
    sources = np.isin(np.arange(len(down)), down, invert=True)
    assert tp.is_exterior(down).tolist() == sources[head].tolist()


@given(forests(), st.integers(0, 9))
def test_distances_add_up(down, seed):
    position = np.random.default_rng(seed).uniform(-1e4, 1e4, (len(down), 2))
    far = tp.distance_to_outlet(position, down)
    for node in range(len(down)):
        total, here = 0.0, node
        while down[here] >= 0:
            total += float(np.hypot(*(position[here] - position[down[here]])))
            here = int(down[here])
        assert far[node] == pytest.approx(total, rel=1e-12)


@pytest.mark.parametrize("down", [[0], [1, 0], [-1, 2, 3, 1], [1, 2, 0, 1]])
def test_cycles_are_refused(down):
    for function in (tp.strahler_order, tp.shreve_magnitude, tp.hops, tp.basins, tp.link_heads, tp.upstream_order):
        with pytest.raises(ValueError, match="cycle"):
            function(np.array(down))


def test_empty_and_long():
    none = np.zeros(0, np.int32)
    assert len(tp.strahler_order(none)) == len(tp.shreve_magnitude(none)) == len(tp.link_heads(none)) == 0
    chain = np.arange(-1, 200_000)
    assert tp.hops(chain)[-1] == 200_000
    assert (tp.strahler_order(chain) == 1).all()
    assert (tp.link_heads(chain) == 200_000).all()
