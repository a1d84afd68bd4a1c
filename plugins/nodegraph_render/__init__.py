"""Seeing terrain: cameras, sphere tracing, shading, meshes and maps, as nodes of the family ``render``."""
