"""Sparse construction trees: terrain as sums of few atoms of a dictionary [Guérin 2016]."""
