"""Values that several parts take when nobody gives another one; SI units."""

from __future__ import annotations

SURFACE_DEPTH = 4e-3
"""From the cubes' centres to the skin's surface, m."""
CONTACT_PRESSURE = 300.0
"""A contact is where the pressure in the cubes' plane exceeds this, Pa."""

CONTACT_METHODS = ("interpolation", "inverse")
"""How contacts are found: from the pressure interpolated between the cubes, or from the surface's
traction through the elastomer."""

YOUNGS_MODULUS = 0.3e6
"""Of the elastomer, Pa: soft silicone."""
POISSONS_RATIO = 0.48
"""Of the elastomer, which is nearly incompressible."""

HALF_SIDE = 2e-3
"""Of a cube, m."""
REST_FREQUENCY = 100e3
"""Of a pad without load, Hz."""
BETA = 0.3
"""Of a pad: parasitic capacitance over that of the foam at rest (docs/physics.md, section 1)."""
FOAM_MODULUS = 0.3e6
"""Of a pad's foam, Pa."""
FREQUENCY_NOISE = 8e-6
"""Relative standard deviation of a frequency that is counted for 1 ms."""
