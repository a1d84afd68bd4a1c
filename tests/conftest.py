"""What every test has: a cache folder of its own, and hypothesis without deadlines."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

hypothesis.settings.register_profile(
    "nodegraph",
    deadline=None,
    # A check of a change must tell of that change; new examples are sought wherever people run the tests.
    derandomize=bool(os.environ.get("CI")),
    max_examples=60,
    suppress_health_check=[hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.data_too_large],
)
hypothesis.settings.load_profile("nodegraph")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell has what it starts in the background ignore Ctrl-C, and that is inherited; the tests of Ctrl-C need it.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _own_cache_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No test reads or writes the cache of whoever runs it."""
    monkeypatch.setenv("NODEGRAPH_CACHE_DIR", str(tmp_path_factory.getbasetemp() / "user-cache"))
    yield
    if (module := sys.modules.get("nodegraph.cache")) is not None and module.default_cache.cache_info().currsize:
        module.default_cache().close()
        module.default_cache.cache_clear()


@pytest.fixture
def in_tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a temporary folder the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
