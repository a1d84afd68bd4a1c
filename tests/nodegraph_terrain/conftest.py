"""Shared fixtures of the terrain tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Return the folder of measured terrain beside the project, or skip."""
    if not DATA.is_dir():
        pytest.skip(f"real elevation data is not at {DATA}")
    return DATA


@pytest.fixture(scope="session")
def device() -> Any:
    """Return the OpenCL device that a run would choose, or skip."""
    from nodegraph.opencl import choose

    chosen = choose("auto")
    if chosen is None:
        pytest.skip("there is no OpenCL device here")
    return chosen
