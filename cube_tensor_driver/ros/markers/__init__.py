# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Draws the picture of a skin for RViz and Foxglove, which the node `markers` publishes.

Lengths are often stated as multiples of the pitch, the distance of neighbouring cubes.
"""
