"""The layered body in three dimensions: axisymmetric elements about each lump under the whole head."""
