"""Melodies for nodegraph."""
