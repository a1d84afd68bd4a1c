"""`parametrize_with_checks` in a test run of its own: what is missing, stray, broken or unknown."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

PLUGIN = """
    import numpy as np
    from nodegraph import node
    from nodegraph.plugins import registry
    from nodegraph.testing import Example, parametrize_with_checks

    @node(version=1)
    def more(values: np.ndarray) -> np.ndarray:
        '''Add one.'''
        return values + 1

    @node(version=1)
    def wild(values: np.ndarray) -> np.ndarray:
        '''Promise numbers and give a text.'''
        return "text"

    for item in (more, wild):
        registry().register(item, "kit")
    ON_ARRAY = [Example({"values": np.zeros(3)})]
"""


def run_pytest(folder: Path, code: str) -> tuple[int, str]:
    """Run a test module in a fresh process; return its exit status and what it printed."""
    path = folder / "test_it.py"
    path.write_text(textwrap.dedent(PLUGIN) + textwrap.dedent(code))
    command = [sys.executable, "-m", "pytest", "-v", "-rs", "-p", "no:cacheprovider", str(path)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    return done.returncode, done.stdout + done.stderr


def test_every_promise_of_every_node_is_a_test(tmp_path: Path) -> None:
    status, output = run_pytest(
        tmp_path,
        """
        @parametrize_with_checks("kit", {"kit.more": ON_ARRAY, "kit.wild": ON_ARRAY, "kit.gone": []})
        def test_contract(check):
            check()

        @parametrize_with_checks("kit", {"kit.wild": ON_ARRAY})
        def test_forgotten(check):
            check()

        def test_fixture(nodegraph_cache):
            assert nodegraph_cache.folder is not None
        """,
    )
    lines = output.splitlines()

    def ended(test: str) -> str:
        return next(line.split()[1] for line in lines if f"::{test} " in line)

    assert status == 1, output
    assert ended("test_contract[kit.more-deterministic]") == "PASSED"
    assert ended("test_contract[kit.wild-outputs_conform]") == "FAILED"
    assert ended("test_contract[kit.wild-deterministic]") == "SKIPPED"
    assert "(the check 'outputs_conform' fails)" in output
    assert ended("test_contract[kit.gone-exists]") == "FAILED"
    assert "there are examples for 'kit.gone', but the family 'kit' has no such node" in output
    assert ended("test_forgotten[kit.more-examples_fit]") == "FAILED"
    assert "kit.more: give at least one Example" in output
    assert ended("test_forgotten[kit.more-documented]") == "PASSED"
    assert ended("test_fixture") == "PASSED"
    failed = {line.split()[0].partition("::")[2] for line in lines if " FAILED" in line and "::" in line.split()[0]}
    assert len(failed) == 4, failed


def test_an_unknown_family_is_a_usage_error(tmp_path: Path) -> None:
    status, output = run_pytest(
        tmp_path,
        """
        @parametrize_with_checks("kitt", {})
        def test_contract(check):
            check()
        """,
    )
    assert status in (2, 4), output  # interrupted while collecting, or a wrong call, as of pytest's version
    assert "no node of family 'kitt' is registered; is its plugin installed? (did you mean 'kit'?)" in output
    assert "passed" not in output
