"""Finite elements of one cube in its elastomer."""
