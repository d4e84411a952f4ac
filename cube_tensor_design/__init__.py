# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Design of a cube: finite elements, studies of layouts, and the source paper's experiments.

It computes what a driver needs (response matrices, influence functions), and runs without it.
"""
