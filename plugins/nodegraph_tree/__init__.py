"""Construction trees: terrain as a function, built from landform primitives and operators [Génevaux 2015]."""
