"""Elasticity of the elastomer around the cubes: contacts on a half space or a bonded layer.

Kernels from loads on the surface to the stress at the cubes, and influence functions of pads.
"""
