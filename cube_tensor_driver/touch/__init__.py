"""Traction on the surface of a skin and contacts on it, from the values of all cubes."""
