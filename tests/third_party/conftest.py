"""The plugins here are installed and tested in an environment of their own, never imported by this test run."""

from __future__ import annotations

collect_ignore = ["acme_v1", "acme_v2", "acme_broken"]
