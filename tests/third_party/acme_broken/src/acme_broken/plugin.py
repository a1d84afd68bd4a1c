"""Needs a library that nobody installed."""

from __future__ import annotations

import a_library_that_nobody_installed  # noqa: F401
