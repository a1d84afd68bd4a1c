"""Where things lie by default.  Imports nothing heavy: the command line asks before it loads the engine."""

from __future__ import annotations

import os

CACHE_VERSION = 2
"""The layout of the cache folder.  Each version has its own subfolder, so versions never meet."""

ANSWERS = "answers"
"""Subfolder of the cache with the answers that `nodegraph.cli.direct` remembers."""


def default_cache_folder() -> str:
    """Return the cache folder of this user: ``$NODEGRAPH_CACHE_DIR``, or the platform's place for caches."""
    if chosen := os.environ.get("NODEGRAPH_CACHE_DIR"):
        return chosen
    import platformdirs

    return platformdirs.user_cache_dir("nodegraph")
