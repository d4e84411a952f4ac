"""Calibration of a cube from known loads, and the first tests of a new hub's pads.

A fit of the response to a table or a recording of loads, and what bring-up computes: the order of
the pads, their rest frequencies, and which cube is turned.
"""
