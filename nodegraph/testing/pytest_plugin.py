"""The contract kit for pytest: one test per node and promise, for every node of a family."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from nodegraph.testing.calls import Example

Check = Callable[[], None]


def parametrize_with_checks(
    family: str, examples: Mapping[str, Sequence[Example]]
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Parametrise a test function's argument ``check`` over every promise of every node of a family.

    A broken promise fails one test; those of the same node that build on it are skipped and say so.

    Args:
        family: of the registered nodes; a family without nodes is an error.
        examples: by type id; a node that is missing here fails, and so does an entry without a node.
    """
    from nodegraph.errors import nearest
    from nodegraph.plugins import registry
    from nodegraph.testing.contract import checks_for

    every = registry().nodes()
    nodes = [node for node in every if node.family == family]
    if not nodes:
        hint = nearest(family, {node.family for node in every})
        raise pytest.UsageError(f"no node of family '{family}' is registered; is its plugin installed? ({hint})")
    cases = [
        pytest.param(_skipping(check), id=f"{node.id}-{name}")
        for node in nodes
        for name, check in checks_for(node, examples.get(node.id, ()))
    ]
    strays = sorted(set(examples) - {node.id for node in nodes})
    cases += [pytest.param(_no_such_node(stray, family), id=f"{stray}-exists") for stray in strays]
    return pytest.mark.parametrize("check", cases)


def _skipping(check: Check) -> Check:
    from nodegraph.testing.calls import NotCheckedError

    def run() -> None:
        try:
            check()
        except NotCheckedError as unchecked:
            pytest.skip(str(unchecked))

    return run


def _no_such_node(type_id: str, family: str) -> Check:
    def check() -> None:
        raise AssertionError(f"there are examples for '{type_id}', but the family '{family}' has no such node")

    return check


@pytest.fixture
def nodegraph_cache(tmp_path: Path) -> Iterator[Any]:
    """A cache of the test's own, in a temporary folder."""
    from nodegraph.cache import Cache

    cache = Cache(tmp_path / "nodegraph-cache")
    yield cache
    cache.close()
