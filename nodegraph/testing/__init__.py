"""The contract kit: what every node promises, as checks that a plugin's author runs on their own nodes.

Three lines test a whole family::

    from nodegraph.testing import Example, parametrize_with_checks

    EXAMPLES = {"acme.invert": [Example({"mask": a_small_mask})]}

    @parametrize_with_checks("acme", EXAMPLES)
    def test_contract(check):
        check()

A node without examples fails, so that none is forgotten.  `check_node` runs all checks on one node.
"""

from __future__ import annotations

from nodegraph.testing.calls import Example, NotCheckedError
from nodegraph.testing.contract import CHECKS, check_node, checks_for

__all__ = ["CHECKS", "Example", "NotCheckedError", "check_node", "checks_for", "parametrize_with_checks"]


def __getattr__(name: str) -> object:
    # pytest is a tool of those who test, not a dependency of those who run.
    if name == "parametrize_with_checks":
        from nodegraph.testing.pytest_plugin import parametrize_with_checks

        return parametrize_with_checks
    raise AttributeError(f"module 'nodegraph.testing' has no attribute '{name}'")
