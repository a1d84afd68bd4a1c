"""The contract kit for pytest: one test per node and promise, for every node of a family."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from nodegraph.testing.contract import Example

Check = Callable[[], None]


def parametrize_with_checks(
    family: str, examples: Mapping[str, Sequence[Example]]
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Parametrise a test function's argument ``check`` over every promise of every node of a family.

    Args:
        family: of the registered nodes; a family without nodes is an error.
        examples: by type id; a node that is missing here fails, and so does an entry without a node.
    """
    from nodegraph.plugins import registry
    from nodegraph.testing.contract import checks_for

    nodes = [node for node in registry().nodes() if node.family == family]
    if not nodes:
        raise pytest.UsageError(f"no node of family '{family}' is registered; is its plugin installed?")
    cases = [
        pytest.param(check, id=f"{node.id}-{name}")
        for node in nodes
        for name, check in checks_for(node, examples.get(node.id, ()))
    ]
    strays = sorted(set(examples) - {node.id for node in nodes})
    cases += [pytest.param(_no_such_node(stray), id=f"{stray}-exists") for stray in strays]
    return pytest.mark.parametrize("check", cases)


def _no_such_node(type_id: str) -> Check:
    def check() -> None:
        raise AssertionError(f"there are examples for '{type_id}', but no such node")

    return check


@pytest.fixture
def nodegraph_cache(tmp_path: Path) -> Iterator[Any]:
    """A cache of the test's own, in a temporary folder."""
    from nodegraph.cache import Cache

    cache = Cache(tmp_path / "nodegraph-cache")
    yield cache
    cache.close()
