# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Traction on the surface of a skin and contacts on it, from the values of all cubes."""
