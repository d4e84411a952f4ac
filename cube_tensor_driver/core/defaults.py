"""Default values that several parts of the package share, in SI units."""

from __future__ import annotations

SURFACE_DEPTH = 4e-3
"""Distance from the centres of the cubes to the surface of the skin, in m."""

CONTACT_PRESSURE = 300.0
"""Pressure in the plane of the cubes, in Pa, above which a place counts as part of a contact."""

CONTACT_METHODS = ("interpolation", "inverse")
"""Names of the methods that find contacts.

The first interpolates the pressure between the cubes. The second computes the traction on the
surface from the elasticity of the layer above the cubes.
"""

YOUNGS_MODULUS = 0.3e6
"""Young's modulus of the elastomer, in Pa; the value is typical of soft silicone."""

POISSONS_RATIO = 0.48
"""Poisson's ratio of the elastomer, which is nearly incompressible."""

HALF_SIDE = 2e-3
"""Half side d0 of a cube (half its edge length), in m."""

REST_FREQUENCY = 100e3
"""Frequency of a pad without load, in Hz."""

BETA = 0.3
"""Ratio of a pad's parasitic capacitance to the capacitance of its foam at rest.

docs/physics.md, section 1, derives where it enters the pad law.
"""

FOAM_MODULUS = 0.3e6
"""Modulus of a pad's foam, in Pa."""

FREQUENCY_NOISE = 8e-6
"""Relative standard deviation of a frequency whose periods are counted for 1 ms."""
