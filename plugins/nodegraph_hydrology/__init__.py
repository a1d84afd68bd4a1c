"""Hydrology: river networks grown from drawn lines, ridges between them, and the terrain they shape, as nodes."""
