"""Ordering steps topologically, and saying which links form a cycle where there is one."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from nodegraph.errors import Problems
from nodegraph.network import Step


def ordered(steps: Sequence[Step], problems: Problems) -> list[Step] | None:
    """Return the steps with sources before consumers (Kahn), in the author's order where links leave a choice.

    Where they form a cycle that is noted, and nothing returned.  O(steps + links).
    """
    waiting = [len({source for _, source, _ in step.inputs}) for step in steps]
    consumers: list[list[int]] = [[] for _ in steps]
    for step in steps:
        for source in {source for _, source, _ in step.inputs}:
            consumers[source].append(step.index)
    ready = deque(index for index, count in enumerate(waiting) if count == 0)
    order: list[Step] = []
    while ready:
        index = ready.popleft()
        order.append(steps[index])
        for consumer in consumers[index]:
            waiting[consumer] -= 1
            if waiting[consumer] == 0:
                ready.append(consumer)
    if len(order) == len(steps):
        return order
    _report_cycle([step for step in steps if waiting[step.index] > 0], problems)
    return None


def _report_cycle(stuck: list[Step], problems: Problems) -> None:
    import networkx

    inside = {step.index: step for step in stuck}
    graph = networkx.DiGraph((source, step.index) for step in stuck for _, source, _ in step.inputs if source in inside)
    ids = [inside[source].id for source, _ in networkx.find_cycle(graph)]
    shown = ids if len(ids) <= 12 else [*ids[:6], "...", *ids[-5:]]
    where = inside[next(iter(inside))].where.partition(": node")[0]
    problems.add(where, f"the links form a cycle: {' -> '.join([*shown, ids[0]])}; remove one of them")
