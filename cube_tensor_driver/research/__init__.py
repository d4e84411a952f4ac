"""Experiments on a virtual bench: the source paper's figures, and where each layout can be trusted.

The driver needs nothing of it.
"""
