"""Texturing: surface layers that know the ground, and how to fit them to a satellite image [Dachsbacher 2006]."""
