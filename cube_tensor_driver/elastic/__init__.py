"""Elasticity of the body around the cubes: contact on a half space, finite elements of one cube.

Also the pressure field between the cubes of a skin. Experiments that use it are in `research`.
"""
