"""Elasticity of the body around the cubes.

Contact on a half space, finite elements of one cube in its body, and the pressure field between the
cubes of a skin. Experiments that use it are in `research`, pictures in `plot`.
"""
