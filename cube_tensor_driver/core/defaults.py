# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Default values that several parts of the package share, in SI units."""

from __future__ import annotations

SURFACE_DEPTH = 4e-3
"""Distance from the centres of the cubes to the surface of the skin, in m."""

CONTACT_PRESSURE = 300.0
"""Pressure in the plane of the cubes' centres, in Pa, above which a point of the plane counts as
part of a contact."""

CONTACT_METHODS = ("auto", "interpolation", "inverse")
"""Names of the methods that find contacts on the skin.

"interpolation" interpolates the pressure between the cubes. "inverse" computes the traction (force
per area) on the surface of the skin from the elasticity of the layer above the cubes. "auto" is
"inverse" if the skin file states the elastomer, otherwise "interpolation".
"""

YOUNGS_MODULUS = 0.3e6
"""Young's modulus of the elastomer around the cubes, in Pa; the value is typical of soft
silicone."""

POISSONS_RATIO = 0.48
"""Poisson's ratio of the elastomer around the cubes, which is nearly incompressible."""

HALF_SIDE = 2e-3
"""Half side d0 of a cube (half its edge length), in m."""

REST_FREQUENCY = 100e3
"""Frequency of a pad's oscillator without load, in Hz."""

BETA = 0.3
"""Ratio of a pad's parasitic capacitance to the capacitance of its foam without load.

docs/physics.md, section 1, derives how the stress on a pad depends on it.
"""

FOAM_MODULUS = 0.3e6
"""Elastic modulus of a pad's foam (stress per strain of its thickness), in Pa."""

FREQUENCY_NOISE = 8e-6
"""Standard deviation of a measured frequency, relative to the frequency.

It holds for a hub that counts the periods of the oscillator for 1 ms.
"""
