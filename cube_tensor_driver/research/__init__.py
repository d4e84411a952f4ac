"""Experiments in the computer: the source paper's, and where each layout and field can be trusted.

A virtual bench with plates and rods, and studies on top of `elastic`. The driver needs nothing of
it; its pictures are in `plot`, its commands in `cli`.
"""
