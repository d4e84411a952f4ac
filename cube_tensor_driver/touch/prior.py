# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Prior of the traction on the surface, before any value is measured."""

AMPLITUDE = 20e3
"""Prior standard deviation of the pressure on the surface, in Pa, before any value is measured. The
value is the pressure of a firm touch."""
