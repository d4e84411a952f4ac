# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Compensation: what the pads measure although nothing presses, computed and subtracted.

`models.py` has the values that a calibration states, one file each effect, and `compensation.py`
the sum of all effects, which `Reconstructor` subtracts from the stresses on the pads.
"""
