"""Terrain vocabulary for nodegraph: rasters with roles and units, their import and export, filters and shading."""
