# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Calibration of a cube from known loads, and the first tests of the pads of a new hub.

The fit takes a table or a recording of loads. Bring-up measures the pads at rest, and finds their
order and the rotation of each cube from presses.
"""
