# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The kernel computes stress, residual and status from the frequencies of all cubes in one pass.

It is in C where that is compiled, else in numpy.
"""
